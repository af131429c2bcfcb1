"""What a part of a scene is to a system: a mesh with shading frames, a BRDF of channels, and their weights.

A metallic-roughness material is a sum of fixed gray BRDFs with textures as weights, see
`jaxprt.brdf.MetallicRoughness.terms`. The fixed ones are the channels of one BRDF, which a system tabulates or factors
once. Where roughness varies, too, they are tabulated over its logarithm.
"""

import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt.brdf import MetallicRoughness
from jaxprt.brdf.varying import Channels, PerVertex
from jaxprt.scene import Mesh, Part
from jaxprt.scene.material import Surface, TexturedMaterial
from jaxprt.sphere import directions
from jaxprt.systems.protocol import Blend

_SMOOTHEST = 0.0317  # roughness below which GGX stays as it is
_STEP = 1.5  # from one tabulated roughness to the next, at most
_EQUAL = 1e-3  # roughness and anisotropy that vary less are one number
_RARE = 0.02  # least typical weight of a channel, relative to the largest


class Shading(NamedTuple):
    """A part of a scene, as systems take it.

    Attributes:
        mesh: Its mesh, with normals of the normal map and tangents along the anisotropy.
        brdf: The BRDF, with as many channels as `blend` has weights; with knots a function of the parameter.
        knot: Values of the logarithm of roughness at which to tabulate; none where it does not vary.
        blend: Weights and parameters of each vertex; None for a BRDF that is given whole.
        exact: The BRDF of every vertex, for the exact sum.
        emitted: Radiance that the surface emits; None for none.
        term: Which of the material's terms the channels are.
        scale: What the weights are relative to.
    """

    mesh: Mesh
    brdf: Callable
    knot: tuple[np.ndarray, ...]
    blend: Blend | None
    exact: Callable
    emitted: Float[Array, "v 3"] | None
    term: tuple[int, ...] = ()
    scale: Float[Array, " k"] | None = None


def of_part(part: Part) -> Shading:
    """A part as systems take it."""
    if not isinstance(part.material, TexturedMaterial):
        return Shading(part.mesh, part.material, (), None, part.material, None)
    surface = part.surface()
    material = _material(surface, part.name)
    knot = _knots(material.roughness)
    term = material.needed()
    scale = jnp.mean(material.coefficient()[:, np.asarray(term)], (0, 2))
    scale = jnp.maximum(scale, _RARE * jnp.max(scale))
    strength, smooth = float(jnp.mean(material.anisotropy)), float(jnp.mean(material.roughness))

    def at(roughness: Array | float) -> Channels:
        each = MetallicRoughness(roughness=roughness, anisotropy=strength).terms()
        return Channels(tuple(each[k] for k in term), scale)

    brdf = (lambda logarithm: at(jnp.exp(logarithm))) if knot else at(smooth)
    emitted = surface.emissive if np.any(np.asarray(surface.emissive)) else None
    mesh = _turned(part.mesh, surface)
    return Shading(mesh, brdf, knot, _blend(material, knot, term, scale), PerVertex(material), emitted, term, scale)


def blended(part: Part, shading: Shading, material: TexturedMaterial) -> Blend:
    """The weights of another material on a part that was made ready.

    Raises:
        ValueError: The material has a reflection, or a roughness, that was not made ready.
    """
    new = _material(eqx.tree_at(lambda each: each.material, part, material).surface(), part.name)
    missing = sorted(set(new.needed()) - set(shading.term))
    if missing:
        names = [("diffuse", "mirror", "rim", "bare diffuse")[k] for k in missing]
        raise ValueError(
            f"part {part.name!r} was precomputed without the {' and '.join(names)} term, which the new material needs: "
            "precompute it with a material that has them"
        )
    old = np.asarray(shading.exact.model.roughness)  # pyright: ignore[reportFunctionMemberAccess]
    low, high = float(old.min()), float(old.max())
    if not isinstance(new.roughness, Tracer):
        least, most = float(jnp.min(new.roughness)), float(jnp.max(new.roughness))
        if least < low - _EQUAL or most > high + _EQUAL:
            raise ValueError(
                f"part {part.name!r} was precomputed for roughness from {low:.3f} to {high:.3f}, "
                f"got a material from {least:.3f} to {most:.3f}"
            )
    assert shading.scale is not None
    return _blend(new, shading.knot, shading.term, shading.scale)


def _blend(material: MetallicRoughness, knot: tuple, term: tuple[int, ...], scale: Array) -> Blend:
    weight = material.coefficient()[:, np.asarray(term)] / scale[:, None]
    parameter = (jnp.log(jnp.maximum(material.roughness, _SMOOTHEST)),) if knot else ()
    return Blend(weight, parameter)


def _material(surface: Surface, name: str) -> MetallicRoughness:
    """The material of every vertex, its anisotropy along the tangent."""
    strength = np.asarray(jax.lax.stop_gradient(surface.anisotropy))
    if np.ptp(strength) > _EQUAL:
        warnings.warn(
            f"part {name!r} has a texture of anisotropy, from {strength.min():.2f} to {strength.max():.2f}; "
            f"its mean {strength.mean():.2f} stands for it",
            stacklevel=3,
        )
    ones = jnp.ones_like(surface.roughness)
    return MetallicRoughness(
        base_color=surface.base_color,
        metallic=surface.metallic,
        roughness=surface.roughness,
        ior=surface.ior,
        specular=surface.specular,
        specular_color=surface.specular_color,
        anisotropy=float(strength.mean()) * ones,
        rotation=0 * ones,
    )


def _knots(roughness: Float[Array, " v"]) -> tuple[np.ndarray, ...]:
    """Logarithms of roughness between the least and the largest; none where these are alike."""
    low, high = (max(float(each), _SMOOTHEST) for each in (jnp.min(roughness), jnp.max(roughness)))
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


@jax.jit
def _frames(normal: Array, tangent: Array, surface: Surface) -> tuple[Array, Array]:
    frame = directions.frame(normal, tangent)
    turned = jnp.einsum("vi,vij->vj", surface.normal, frame)
    along = jnp.einsum("vi,vij->vj", surface.direction, frame[:, :2])
    return turned, directions.frame(turned, along)[:, 0]
