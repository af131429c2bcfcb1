"""Scenes without clear coats and sheens, for pages, whose modules know one roughness for each vertex."""

import dataclasses
import warnings
from typing import Any

import jax.numpy as jnp

from jaxprt.brdf import ClearCoat, Sheen
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit import channels
from jaxprt.relit.channels import Shading
from jaxprt.relit.groups import Place
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Part, TexturedMaterial
from jaxprt.systems import bright_texels, harmonic, lobe, standard
from jaxprt.systems.protocol import Blend
from jaxprt.systems.standard.layered import BASE


def without_layers(scene: RelitScene) -> RelitScene:
    """A relit scene in direct light with the bases of its parts under layers, with one warning that names these parts.

    A scene without clear coats and sheens is returned as it is.
    """
    layered = [shading.layered for shading in scene.shading]
    if not any(layered):
        return scene
    old = scene.scene
    names = ", ".join(repr(part.name) for part, has in zip(old.parts, layered, strict=True) if has)
    warnings.warn(f"the page shows these parts without their clear coats and sheens: {names}", stacklevel=3)
    parts = [_bare(part) if has else part for part, has in zip(old.parts, layered, strict=True)]
    shadings = [_base(shading) if has else shading for shading, has in zip(scene.shading, layered, strict=True)]
    systems = [scene.part_system(number) for number in range(len(parts))]
    systems = [_alone(system) if has else system for system, has in zip(systems, layered, strict=True)]
    counts, alone = [len(part.mesh.position) for part in parts], [[number] for number in range(len(parts))]
    place = Place.of(counts, alone, [False] * len(counts))
    return RelitScene(dataclasses.replace(old, parts=parts), shadings, place, systems)


def _bare(part: Part) -> Part:
    """The part with the base of its material."""
    assert isinstance(part.material, TexturedMaterial)
    return dataclasses.replace(part, material=channels.without_layers(part.material))


def _base(shading: Shading) -> Shading:
    """The base of a part under a layer."""
    table, blend, exact = standard.METALLIC_ROUGHNESS, shading.blend, shading.exact
    assert blend is not None
    assert isinstance(exact, PerVertex)
    assert isinstance(exact.model, ClearCoat | Sheen)
    weight = jnp.asarray(blend.weight[:, :BASE] + blend.weight[:, BASE : 2 * BASE])
    return dataclasses.replace(
        shading,
        brdf=table.family,
        exact=PerVertex(exact.model.base),
        knot=table.knots,
        blend=Blend(weight, blend.parameter[:1]),
        term=table.term,
        scale=table.scale,
        table=table,
    )


def _alone(system: Any) -> Any:
    """The system of a part under a layer with the tables of its base."""
    table = standard.METALLIC_ROUGHNESS
    if isinstance(system, bright_texels.BrightTexels):
        return dataclasses.replace(system, system=_alone(system.system), brdf=table.family)
    if isinstance(system, harmonic.HarmonicSystem):
        return dataclasses.replace(system, brdf=table.harmonics(system.brdf.degree))
    assert isinstance(system, lobe.LobeSystem)
    return dataclasses.replace(system, brdf=table.lobes(system.brdf.lobes // 2))
