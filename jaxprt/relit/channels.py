"""What a part of a scene is to a system: a mesh with shading frames, a BRDF of channels, and their weights.

A metallic-roughness material is a sum of fixed gray BRDFs with textures as weights, see
`jaxprt.brdf.MetallicRoughness.terms`. The fixed ones are the channels of one BRDF, which a system tabulates or factors
once. Where roughness varies, they are tabulated over its logarithm.
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
from jaxprt.brdf.varying import Channels, PerVertex
from jaxprt.compile import jit
from jaxprt.scene import Mesh, Part
from jaxprt.scene.material import Surface, TexturedMaterial
from jaxprt.scene.points import Points
from jaxprt.sphere import directions
from jaxprt.systems.protocol import Blend

_SMOOTHEST = 1e-3**0.5  # roughness below which GGX stays as it is
_STEP = 1.5  # from one tabulated roughness to the next, at most
_EQUAL = 1e-3  # roughness, anisotropy and normals that vary less are equal
_RARE = 0.02  # least typical weight of a channel, relative to the largest
_NAMES = ("diffuse", "mirror", "rim", "bare diffuse")  # of the terms of MetallicRoughness
_BARE = (3,)  # the term of a material that is ideally diffuse


class RoughnessFamily(eqx.Module):
    """Terms of `MetallicRoughness` as channels, for any roughness: a function that makes a BRDF.

    Attributes:
        term: Which of the terms.
        scale: Factor of each.
        anisotropy: Strength of the anisotropy, along the tangent.
    """

    term: tuple[int, ...] = eqx.field(static=True)
    scale: Float[Array, " k"]
    anisotropy: Float[Array, ""]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF of a roughness, given its natural logarithm."""
        each = MetallicRoughness(roughness=jnp.exp(log_roughness), anisotropy=self.anisotropy).terms()
        return Channels(tuple(each[k] for k in self.term), self.scale)


class ShininessFamily(eqx.Module):
    """Diffuse base and lobe of `BlinnPhong` as channels, for any exponent: a function that makes a BRDF.

    Attributes:
        scale: Factor of each.
    """

    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF of a roughness, the square root of 2 / (exponent + 2), given its natural logarithm."""
        return Channels((Lambert(1.0), BlinnPhong(0.0, 1.0, 2 * jnp.exp(-2 * log_roughness) - 2)), self.scale)


class Shading(eqx.Module):
    """A part of a scene, as systems take it.

    Attributes:
        mesh: The part's mesh, with normals of the normal map and tangents along the anisotropy.
        brdf: The BRDF, with as many channels as `blend` has weights. With `knot` it is a function that makes one: a
            `RoughnessFamily`, or a `ShininessFamily`.
        exact: The BRDF of every vertex, for the exact sum.
        knot: Logarithms of roughness at which to tabulate; empty where roughness does not vary.
        blend: Weights of each vertex, and logarithms of its roughness; None for a part whose material is a BRDF that
            stays.
        emitted: Radiance that the surface emits; None for none.
        term: Which of the terms of `MetallicRoughness` the channels are.
        scale: Factor of each channel, by which the weights are divided.
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
    """A material at the vertices of a part, for the system that the part was precomputed with.

    Attributes:
        blend: What the system takes; None for a part whose material is a BRDF.
        emitted: Radiance that the surface emits; None for none.
    """

    blend: Blend | None
    emitted: Float[Array, "v 3"] | None = None


def of_part(part: Part, *, roughness: tuple[float, float] | None = None) -> Shading:
    """A part of a scene, as systems take it.

    A texture of anisotropy is replaced by its mean, with a warning.

    Args:
        part: The part.
        roughness: Least and largest roughness of materials that it may have later, beside those of its own; of
            `BlinnPhong` the square root of 2 / (exponent + 2).

    Raises:
        TypeError: The material is a BRDF of another form: a table that holds the cosine, or one BRDF for each vertex.
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
    """A part of Blinn-Phong whose colors and exponent may change; one that stays where no roughness is given."""
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
    """The same weights for so many vertices or points."""
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
    """Another material on a part that was precomputed.

    Textures of color, metallic, specular and emission, and within the range that was precomputed of roughness, may be
    anything. Inside `jax.jit`, where values are not known, vertices that need what was not precomputed get NaN.
    Derivatives leave out terms that were not precomputed.

    Args:
        part: The part.
        shading: From `of_part`.
        material: The material.

    Raises:
        ValueError: The material takes texture coordinates that the mesh does not have, or has a term, a roughness, an
            anisotropy or a normal map that were not precomputed.
        TypeError: A metallic-roughness material for a part of Blinn-Phong, or the other way around.
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
    """A material at points of a part, its textures averaged over the points' pixels.

    Args:
        part: The part.
        shading: From `of_part`.
        material: A material that `appearance` takes, an `Appearance` at the vertices, or None for the part's.
        points: On the part's triangles.
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
    """The BRDF of points of a part for the exact sum, and what they emit.

    Textures are averaged over the points' pixels, and read at points of no picture.
    """
    if not isinstance(part.material, TexturedMaterial):
        return shading.exact, None
    surface = part.surface(points)
    return PerVertex(_material(surface)), surface.emissive


def _fits(name: str, shading: Shading, new: MetallicRoughness) -> Array:
    """Whether the terms and the roughness of each vertex were precomputed; refuses those that were not, if known."""
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
        raise ValueError(
            f"part {name!r} was precomputed for roughness from {low:.3f} to {high:.3f}, got a material from "
            f"{jnp.min(new.roughness):.3f} to {jnp.max(new.roughness):.3f}: precompute it with a material of both"
        )
    return fits & inside


def roughness_range(shading: Shading) -> tuple[Array, Array]:
    """Least and largest roughness that a part was precomputed for."""
    if not shading.knot:
        old = _old(shading).roughness
        return jnp.min(old), jnp.max(old)
    (knot,) = shading.knot
    # What is smoother than the first knot has the BRDF of that.
    least, most = jnp.exp(knot[0]), jnp.exp(knot[-1])
    return jnp.where(least <= _SMOOTHEST + _EQUAL, 0, least), most


def exponent_range(shading: Shading) -> tuple[float, float]:
    """Least and largest exponent that a part of Blinn-Phong was precomputed for."""
    (knot,) = shading.knot
    least, most = (2 * np.exp(-2 * knot[each]) - 2 for each in (-1, 0))
    return max(float(least), 0.0), float(most)


def _check_shape(part: Part, shading: Shading, surface: Surface, new: MetallicRoughness) -> None:
    """Refuses another anisotropy and other normals than the precomputed frames and tables have, where known."""
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
    """Whether JAX traces none of the arrays."""
    return not any(isinstance(each, Tracer) for each in jax.tree.leaves(value))


def _blend(material: MetallicRoughness, term: tuple[int, ...], scale: Array, *, varies: bool) -> Blend:
    weight = material.coefficient()[:, np.asarray(term)] / scale[:, None]
    return Blend(weight, (jnp.log(jnp.maximum(material.roughness, _SMOOTHEST)),) if varies else ())


def _emitted(surface: Surface) -> Float[Array, "v 3"] | None:
    return None if _known(surface.emissive) and not np.any(np.asarray(surface.emissive)) else surface.emissive


def _material(surface: Surface) -> MetallicRoughness:
    """The material of every vertex, its anisotropy one number along the tangent."""
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
            f"part {name!r} has a texture of anisotropy, from {strength.min():.2f} to {strength.max():.2f}; "
            f"its mean {strength.mean():.2f} stands for it",
            stacklevel=3,
        )


def _knots(roughness: Float[Array, " v"], *, least: float = _SMOOTHEST) -> tuple[np.ndarray, ...]:
    """Logarithms of roughness between the least and the largest; none where these are equal."""
    low, high = (max(float(each), least) for each in (jnp.min(roughness), jnp.max(roughness)))
    if high - low <= _EQUAL:
        return ()
    count = 1 + int(np.ceil(np.log(high / low) / np.log(_STEP)))
    return (np.linspace(np.log(low), np.log(high), count),)


def _turned(mesh: Mesh, surface: Surface) -> Mesh:
    """The mesh with the normals of the normal map, and tangents along the direction of anisotropy."""
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
