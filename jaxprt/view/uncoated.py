"""Scenes without clear coats, for pages, whose modules know one roughness for each vertex."""

import dataclasses
import warnings
from typing import Any

import jax.numpy as jnp

from jaxprt.brdf.coat import ClearCoat
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit.channels import Shading
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.systems import bright_texels, harmonic, lobe, standard
from jaxprt.systems.protocol import Blend
from jaxprt.systems.standard.coated import BASE


def without_coats(scene: Scene, shadings: Any, systems: Any) -> tuple[Scene, list[Shading], list[Any]]:
    """The parts of a relit scene with their bases alone, with one warning that names the parts with a coat.

    Args:
        scene: The scene.
        shadings: The `Shading` of each part.
        systems: The system of each part.
    """
    coated = [shading.table is standard.COATED for shading in shadings]
    if not any(coated):
        return scene, list(shadings), list(systems)
    names = ", ".join(repr(part.name) for part, has in zip(scene.parts, coated, strict=True) if has)
    warnings.warn(f"the page shows these parts without their clear coats: {names}", stacklevel=3)
    parts = [_bare(part) if has else part for part, has in zip(scene.parts, coated, strict=True)]
    pairs = list(zip(shadings, systems, coated, strict=True))
    return (
        dataclasses.replace(scene, parts=parts),
        [_base(shading) if has else shading for shading, _, has in pairs],
        [_alone(system) if has else system for _, system, has in pairs],
    )


def _bare(part: Part) -> Part:
    """The part with the base of its material."""
    assert isinstance(part.material, TexturedMaterial)
    return dataclasses.replace(part, material=dataclasses.replace(part.material, clearcoat=0.0, clearcoat_texture=None))


def _base(shading: Shading) -> Shading:
    """The base of a coated part."""
    table, blend, exact = standard.METALLIC_ROUGHNESS, shading.blend, shading.exact
    assert blend is not None
    assert isinstance(exact, PerVertex)
    assert isinstance(exact.model, ClearCoat)
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
    """The system of a coated part with the tables of its base."""
    table = standard.METALLIC_ROUGHNESS
    if isinstance(system, bright_texels.BrightTexels):
        return dataclasses.replace(system, system=_alone(system.system), brdf=table.family)
    if isinstance(system, harmonic.HarmonicSystem):
        return dataclasses.replace(system, brdf=table.harmonics(system.brdf.degree))
    assert isinstance(system, lobe.LobeSystem)
    return dataclasses.replace(system, brdf=table.lobes(system.brdf.lobes // 2))
