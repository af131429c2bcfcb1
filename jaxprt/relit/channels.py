"""Converts a part of a scene to the input of the systems: a mesh with shading frames, and a BRDF with weights.

A metallic-roughness material is a sum of fixed gray BRDFs whose weights are textures; see
`jaxprt.brdf.MetallicRoughness.terms`. The fixed BRDFs are the channels of one BRDF, which a system tabulates or factors
once. If roughness varies, they are tabulated over its logarithm.
"""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt.brdf import BlinnPhong, Lambert, MetallicRoughness, grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import jit
from jaxprt.scene import Mesh, Part
from jaxprt.scene.material import Surface, TexturedMaterial
from jaxprt.scene.points import Points
from jaxprt.sphere import directions
from jaxprt.systems.protocol import Blend
from jaxprt.systems.standard.families import RoughnessFamily, ShininessFamily

_SMOOTHEST = 1e-3**0.5  # smaller roughness is treated as this one
_STEP = 1.5  # largest ratio of neighboring tabulated roughnesses
_EQUAL = 1e-3  # tolerance for equal roughness, anisotropy and normals
_RARE = 0.02  # smallest scale of a channel, relative to the largest
_NAMES = ("diffuse", "mirror", "rim", "bare diffuse")  # names of the terms of MetallicRoughness
_BARE = (3,)  # the only term of a Lambertian material


class Shading(eqx.Module):
    """A part of a scene as input of the systems.

    Attributes:
        mesh: The part's mesh, with normals from the normal map and tangents along the anisotropy.
        brdf: The BRDF, with one channel for each weight of `blend`. If `knot` is not empty, it is a function from the
            logarithm of roughness to a BRDF: a `RoughnessFamily` or a `ShininessFamily`.
        exact: The BRDF at every vertex, for the exact sum over all texels.
        knot: Logarithms of roughness at which to tabulate the BRDF; empty if roughness does not vary.
        blend: Weights of the channels at each vertex, and the logarithm of roughness there if it varies. None for a
            part with a BRDF that cannot change.
        emitted: Radiance that the surface emits; None if it does not emit.
        term: Indices of the terms of `MetallicRoughness` that are channels.
        scale: Factor of each channel. The weights of `blend` are divided by it.
    """

    mesh: Mesh
    brdf: Callable
    exact: Callable
    knot: tuple[np.ndarray, ...] = ()
    blend: Blend | None = None
    emitted: Float[Array, "v 3"] | None = None
    term: tuple[int, ...] = eqx.field(static=True, default=())
    scale: Float[Array, " k"] | None = None


class Appearance(eqx.Module):
    """A material evaluated at the vertices of a part, in the form that the part's system takes.

    Attributes:
        blend: Weights of the BRDF's channels; None for a part with a BRDF that cannot change.
        emitted: Radiance that the surface emits; None if it does not emit.
    """

    blend: Blend | None
    emitted: Float[Array, "v 3"] | None = None


def of_part(part: Part, *, roughness: tuple[float, float] | None = None) -> Shading:
    """Converts a part of a scene to a `Shading`, the input of the systems.

    A texture of anisotropy is replaced by its mean, with a warning.

    Args:
        part: The part.
        roughness: Smallest and largest roughness that the part's material may have after precomputation, in addition to
            the roughness it has now. For `BlinnPhong`, roughness is the square root of 2 / (exponent + 2).

    Raises:
        TypeError: The material is one BRDF for each vertex, or a table that already includes the cosine.
    """
    if not isinstance(part.material, TexturedMaterial):
        if isinstance(part.material, PerVertex):
            raise TypeError(
                f"the material of part {part.name!r} must be one BRDF for all vertices or a TexturedMaterial, "
                "got a BRDF for each vertex"
            )
        brdf = grid.as_argument(part.material)
        if isinstance(brdf, BlinnPhong) and roughness is not None:
            return _shiny(part.mesh, brdf, roughness)
        return Shading(part.mesh, brdf, brdf)
    surface = part.surface()
    _warn_of_varying_anisotropy(part.name, surface)
    material = _material(surface)
    term = material.needed() or _BARE
    if term == _BARE:
        brdf, knot, scale = Lambert(1.0), (), jnp.ones(1)
    else:
        knot = _knots(material.roughness if roughness is None else jnp.append(material.roughness, jnp.array(roughness)))
        scale = jnp.mean(jnp.abs(material.coefficient()[:, np.asarray(term)]), (0, 2))
        scale = jnp.maximum(scale, _RARE * jnp.max(scale))
        brdf = RoughnessFamily(term, scale, material.anisotropy[0])
        if not knot:
            brdf = brdf(jnp.log(jnp.maximum(jnp.mean(material.roughness), _SMOOTHEST)))
    blend = _blend(material, term, scale, varies=bool(knot))
    mesh = _turned(part.mesh, surface)
    return Shading(mesh, brdf, PerVertex(material), knot, blend, _emitted(surface), term, scale)


def _shiny(mesh: Mesh, brdf: BlinnPhong, roughness: tuple[float, float]) -> Shading:
    """A part with a Blinn-Phong material. Its colors and exponent may change only if a range of roughness is given."""
    own = jnp.exp(_log_roughness(brdf.exponent))
    knot = _knots(jnp.append(own, jnp.array(roughness)), least=min(_SMOOTHEST, float(own)))
    if not knot:
        return Shading(mesh, brdf, brdf)
    scale = jnp.stack([jnp.mean(brdf.diffuse), jnp.mean(brdf.specular)])
    scale = jnp.maximum(scale, _RARE * jnp.max(scale)) + (jnp.max(scale) <= 0)
    blend = _shiny_blend(brdf, scale, len(mesh.position))
    return Shading(mesh, ShininessFamily(scale), brdf, knot, blend, scale=scale)


def _log_roughness(exponent: Array) -> Array:
    return jnp.log(2 / (exponent + 2)) / 2


def _shiny_blend(brdf: BlinnPhong, scale: Array, count: int) -> Blend:
    """The weights of a Blinn-Phong material, the same for every vertex or point."""
    weight = jnp.stack([jnp.broadcast_to(each, (3,)) for each in (brdf.diffuse, brdf.specular)]) / scale[:, None]
    roughness = jnp.broadcast_to(_log_roughness(brdf.exponent), (count,))
    return Blend(jnp.broadcast_to(weight, (count, *weight.shape)), (roughness,))


def _shiny_appearance(part: Part, shading: Shading, brdf: BlinnPhong) -> Appearance:
    assert shading.scale is not None
    least, most = exponent_range(shading)
    if _known(brdf.exponent) and not least * (1 - _EQUAL) <= float(brdf.exponent) <= most * (1 + _EQUAL):
        raise ValueError(
            f"part {part.name!r} was precomputed for exponents from {least:.3g} to {most:.3g}, got {brdf.exponent:.3g}"
        )
    return Appearance(_shiny_blend(brdf, shading.scale, len(part.mesh.position)))


def appearance(part: Part, shading: Shading, material: TexturedMaterial | BlinnPhong) -> Appearance:
    """Evaluates a new material at the vertices of a precomputed part.

    Textures of color, metallic, specular and emission may have any values. Roughness must be in the precomputed range.
    Inside `jax.jit`, where values are unknown, vertices that need something that was not precomputed get NaN.
    Derivatives ignore terms that were not precomputed.

    Args:
        part: The part.
        shading: The `Shading` of the part, from `of_part`.
        material: The new material.

    Raises:
        ValueError: The material uses texture coordinates that the mesh lacks, or has a term, a roughness, an anisotropy
            or a normal map that was not precomputed.
        TypeError: The part was precomputed with a Blinn-Phong material and the new one is metallic-roughness, or vice
            versa.
    """
    shiny = isinstance(shading.brdf, ShininessFamily)
    if isinstance(material, BlinnPhong) != shiny:
        kind = "BlinnPhong" if shiny else "TexturedMaterial"
        raise TypeError(f"the material of part {part.name!r} must be a {kind}, got {type(material).__name__}")
    if isinstance(material, BlinnPhong):
        return _shiny_appearance(part, shading, material)
    surface = dataclasses.replace(part, material=material).surface()
    new = _material(surface)
    _check_shape(part, shading, surface, new)
    assert shading.scale is not None
    blend = _blend(new, shading.term, shading.scale, varies=bool(shading.knot))
    fits = _fits(part.name, shading, new)
    weight = jnp.where(fits[:, None, None], blend.weight, jnp.nan) if isinstance(fits, Tracer) else blend.weight
    return Appearance(Blend(weight, blend.parameter), _emitted(surface))


def at_points(part: Part, shading: Shading, material: Any, points: Points) -> Appearance:
    """Evaluates a material at points of a part. Its textures are averaged over the pixel of each point.

    Args:
        part: The part.
        shading: The `Shading` of the part, from `of_part`.
        material: A material that `appearance` takes, an `Appearance` at the vertices, or None for the part's own
            material.
        points: Points on the part's triangles.
    """
    if isinstance(material, Appearance):
        return jax.tree.map(points.carry, material)
    own = part.material if material is None else material
    if isinstance(own, BlinnPhong) and isinstance(shading.brdf, ShininessFamily):
        assert shading.scale is not None
        return Appearance(_shiny_blend(own, shading.scale, len(points)))
    if not isinstance(own, TexturedMaterial):
        return Appearance(None)
    surface = (part if material is None else dataclasses.replace(part, material=material)).surface(points)
    assert shading.scale is not None
    blend = _blend(_material(surface), shading.term, shading.scale, varies=bool(shading.knot))
    return Appearance(blend, surface.emissive)


def exact_at(part: Part, shading: Shading, points: Points) -> tuple[Callable, Array | None]:
    """The BRDF at points of a part for the exact sum over all texels, and the radiance that the points emit.

    Textures are averaged over the pixel of each point. At points that do not belong to a picture they are sampled.
    """
    if not isinstance(part.material, TexturedMaterial):
        return shading.exact, None
    surface = part.surface(points)
    return PerVertex(_material(surface)), surface.emissive


def _fits(name: str, shading: Shading, new: MetallicRoughness) -> Array:
    """Whether the terms and the roughness of each vertex were precomputed. If values are known, refuses others."""
    missing = np.setdiff1d(np.arange(len(_NAMES)), shading.term)
    needed = jnp.any(new.coefficient()[:, missing] != 0, (0, 2))
    if _known(needed) and np.any(np.asarray(needed)):
        names = [_NAMES[k] for k in missing[np.asarray(needed)]]
        raise ValueError(
            f"part {name!r} was precomputed without the terms that the new material needs ({', '.join(names)}): "
            "precompute it with a material that has them"
        )
    fits = ~jnp.any(new.coefficient()[:, missing] != 0, (1, 2))
    if shading.term == _BARE:
        return fits
    low, high = roughness_range(shading)
    inside = (new.roughness >= low - _EQUAL) & (new.roughness <= high + _EQUAL)
    if _known(inside) and not np.all(np.asarray(inside)):
        given = jax.lax.stop_gradient(new.roughness)
        raise ValueError(
            f"part {name!r} was precomputed for roughness from {low:.3f} to {high:.3f}, got a material from "
            f"{jnp.min(given):.3f} to {jnp.max(given):.3f}: precompute it with a material that covers "
            "both ranges"
        )
    return fits & inside


def roughness_range(shading: Shading) -> tuple[Array, Array]:
    """Smallest and largest roughness that a part was precomputed for."""
    if not shading.knot:
        old = _old(shading).roughness
        return jnp.min(old), jnp.max(old)
    (knot,) = shading.knot
    # Smaller roughness is treated as that of the first knot.
    least, most = jnp.exp(knot[0]), jnp.exp(knot[-1])
    return jnp.where(least <= _SMOOTHEST + _EQUAL, 0, least), most


def exponent_range(shading: Shading) -> tuple[float, float]:
    """Smallest and largest exponent that a Blinn-Phong part was precomputed for."""
    (knot,) = shading.knot
    least, most = (2 * np.exp(-2 * knot[each]) - 2 for each in (-1, 0))
    return max(float(least), 0.0), float(most)


def _check_shape(part: Part, shading: Shading, surface: Surface, new: MetallicRoughness) -> None:
    """Refuses an anisotropy or normals that differ from the precomputed ones, if their values are known."""
    if not _known(surface, shading):
        return
    before, now = (float(each.anisotropy[0]) for each in (_old(shading), new))
    anisotropic = before > _EQUAL and shading.term != _BARE
    if abs(before - now) > _EQUAL and shading.term != _BARE:
        raise ValueError(
            f"part {part.name!r} was precomputed for an anisotropy of {before:.3f}, got a material of {now:.3f}"
        )
    mesh = _turned(part.mesh, surface)
    for field, matters in (("normal", True), ("tangent", anisotropic)):
        first, second = (np.asarray(getattr(each, field)) for each in (shading.mesh, mesh))
        if matters and np.abs(first - second).max() > _EQUAL:
            what = {"normal": "normal map", "tangent": "direction of anisotropy"}[field]
            raise ValueError(
                f"part {part.name!r} was precomputed with another {what}, or with none: precompute it with the new one"
            )


def _old(shading: Shading) -> MetallicRoughness:
    """The material that a part was precomputed with."""
    assert isinstance(shading.exact, PerVertex)
    assert isinstance(shading.exact.model, MetallicRoughness)
    return shading.exact.model


def _known(*value: Any) -> bool:
    """Whether no array is traced by JAX."""
    return not any(isinstance(each, Tracer) for each in jax.tree.leaves(value))


def _blend(material: MetallicRoughness, term: tuple[int, ...], scale: Array, *, varies: bool) -> Blend:
    weight = material.coefficient()[:, np.asarray(term)] / scale[:, None]
    return Blend(weight, (jnp.log(jnp.maximum(material.roughness, _SMOOTHEST)),) if varies else ())


def _emitted(surface: Surface) -> Float[Array, "v 3"] | None:
    return None if _known(surface.emissive) and not np.any(np.asarray(surface.emissive)) else surface.emissive


def _material(surface: Surface) -> MetallicRoughness:
    """The material at every vertex. Its anisotropy is the mean strength, along the tangent."""
    ones = jnp.ones_like(surface.roughness)
    return MetallicRoughness(
        base_color=surface.base_color,
        metallic=surface.metallic,
        roughness=surface.roughness,
        ior=surface.ior,
        specular=surface.specular,
        specular_color=surface.specular_color,
        anisotropy=jnp.mean(surface.anisotropy) * ones,
        rotation=0 * ones,
    )


def _warn_of_varying_anisotropy(name: str, surface: Surface) -> None:
    strength = np.asarray(surface.anisotropy)
    if np.ptp(strength) > _EQUAL:
        warnings.warn(
            f"the anisotropy of part {name!r} varies from {strength.min():.2f} to {strength.max():.2f} over its "
            f"texture, which is not supported: its mean {strength.mean():.2f} is used everywhere",
            stacklevel=3,
        )


def _knots(roughness: Float[Array, " v"], *, least: float = _SMOOTHEST) -> tuple[np.ndarray, ...]:
    """Logarithms of roughness between the smallest and the largest; none if these are equal."""
    low, high = (max(float(each), least) for each in (jnp.min(roughness), jnp.max(roughness)))
    if high - low <= _EQUAL:
        return ()
    count = 1 + int(np.ceil(np.log(high / low) / np.log(_STEP)))
    return (np.linspace(np.log(low), np.log(high), count),)


def _turned(mesh: Mesh, surface: Surface) -> Mesh:
    """The mesh with normals from the normal map, and tangents along the anisotropy."""
    flat = bool(np.all(np.asarray(surface.normal) == [0, 0, 1]))
    straight = bool(np.all(np.asarray(surface.direction) == [1, 0])) or not np.any(np.asarray(surface.anisotropy))
    if flat and straight:
        return mesh
    normal, tangent = _frames(mesh.normal, mesh.tangent, surface)
    return eqx.tree_at(lambda each: (each.normal, each.tangent), mesh, (normal, tangent))


@jit
def _frames(normal: Array, tangent: Array, surface: Surface) -> tuple[Array, Array]:
    frame = directions.frame(normal, tangent)
    turned = jnp.einsum("vi,vij->vj", surface.normal, frame, precision="highest")
    along = jnp.einsum("vi,vij->vj", surface.direction, frame[:, :2], precision="highest")
    return turned, directions.frame(turned, along)[:, 0]
