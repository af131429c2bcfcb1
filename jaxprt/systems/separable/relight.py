"""Relighting by the separable system: the dot product of a light-modulated and a view-modulated tuple per vertex.

When the light changes, call `light_tuple` again; when the eye moves, call `view_tuple` again. Keep the other result.
"""

from functools import partial, reduce
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import isolated, jit, linear
from jaxprt.scene.environment import Environment
from jaxprt.sphere import directions, haar
from jaxprt.systems import protocol
from jaxprt.systems.separable.factorization import SeparableBrdf, check_mark

_STEPS = (1 << 15) - 1  # highest level in signed 16 bits


@runtime_checkable
class Transport(Protocol):
    """Interface of precomputed transport: what relighting needs from sparse, quantized and clustered transport.

    Attributes:
        position: Vertex positions in world units, in the order of the mesh.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        rms: Root mean square of the transport over vertices and terms, for each wavelet coefficient.
        mark: Samples of the BRDF's light factors, from `factorization.marked`; None if unknown.
    """

    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    mark: Float[Array, "r m"] | None

    @property
    def terms(self) -> int:
        """Number of BRDF terms."""
        ...

    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Multiplies the transport by Haar coefficients of the light: one value per vertex, term and color."""
        ...


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, SeparableBrdf, source="jaxprt.separable.factor")


@require.arguments(light=protocol.one_light)
@jit
def project(light: Environment) -> Float[Array, "b c"]:
    """Haar coefficients of an environment. Each cubemap face is transformed separately.

    The solid angles of texels are part of the transport, so radiance is transformed without weights.

    Args:
        light: One environment. The edge n of its cubemap faces must be a power of two.

    Returns:
        b = 6 n n coefficients per color, in units of radiance.
    """
    coefficient = haar.forward(light.radiance)
    return coefficient.reshape(-1, coefficient.shape[-1])


@partial(jit, static_argnames=("threshold",))
def choose_by_magnitude(coefficient: Float[Array, "b c"], *, threshold: int = 1024) -> Float[Array, "b c"]:
    """Sets light coefficients below a threshold in signed 16 bits to zero, as published.

    `choose_by_transport` reaches a smaller error with fewer coefficients.

    Args:
        coefficient: Haar coefficients of the light, from `project`.
        threshold: Smallest magnitude kept, in multiples of the largest magnitude of each color / 32767.

    Returns:
        The coefficients, zero where dropped. Kept ones are not rounded; `quantize` rounds.

    Reference: Wang, Tran, Luebke 2004, section 3.4.
    """
    return jnp.where(jnp.abs(_level(coefficient)) >= threshold, coefficient, 0)


@jit
def quantize(coefficient: Float[Array, "b c"]) -> Float[Array, "b c"]:
    """Rounds light coefficients to signed 16 bits: to multiples of the largest magnitude of each color / 32767.

    Args:
        coefficient: Haar coefficients of the light, from `project`.

    Returns:
        Rounded coefficients in the same units. Rounding has a zero derivative, so gradients reach the largest
        coefficient only, which sets the scale.

    Reference: Wang, Tran, Luebke 2004, section 3.4.
    """
    return _level(coefficient) * (jnp.max(jnp.abs(coefficient), 0) / _STEPS)


def _level(coefficient: Array) -> Array:
    """Coefficients as multiples of the largest magnitude of each color / 32767, rounded."""
    largest = jnp.max(jnp.abs(coefficient), 0)
    quantum = jnp.where(largest > 0, largest, 1) / _STEPS
    return jnp.round(coefficient / quantum)


@partial(jit, static_argnames=("count",))
def choose_by_area(coefficient: Float[Array, "b c"], *, count: int) -> Float[Array, "b c"]:
    """Keeps the `count` light coefficients with the largest magnitude times area of the basis function.

    Args:
        coefficient: Haar coefficients of the light, from `project`.
        count: Number of coefficients to keep.

    Returns:
        The coefficients, zero where dropped.

    Reference: Ng, Ramamoorthi, Hanrahan 2003, section 5.
    """
    size = haar.face_edge(coefficient.shape[0])
    area = jnp.tile(haar.area(size=size).ravel(), 6)
    return _choose(coefficient, area, count)


@partial(jit, static_argnames=("count",))
def choose_by_transport(
    coefficient: Float[Array, "b c"], rms: Float[Array, " b"], *, count: int
) -> Float[Array, "b c"]:
    """Keeps the `count` light coefficients with the largest magnitude times rms of the transport.

    This orders coefficients by their mean squared contribution to the picture.

    Args:
        coefficient: Haar coefficients of the light, from `project`.
        rms: Root mean square of the transport for each coefficient, `Transport.rms`.
        count: Number of coefficients to keep.

    Returns:
        The coefficients, zero where dropped.
    """
    return _choose(coefficient, rms, count)


def _choose(coefficient: Array, weight: Array, count: int) -> Array:
    if not 1 <= count <= coefficient.shape[0]:
        raise ValueError(f"count must be between 1 and {coefficient.shape[0]}, got {count}")
    _, index = jax.lax.top_k(jnp.linalg.norm(coefficient, axis=1) * weight, count)
    return jnp.zeros_like(coefficient).at[index].set(coefficient[index])


@jax.custom_jvp
def _product(light: Array, view: Array) -> Array:
    return _sum(light, view)


@_product.defjvp
def _(primal, tangent):
    light, view = primal
    parts = [
        linear(_sum, _spread_gray if x.shape[2] < fixed.shape[2] else _spread, fixed, x)
        for fixed, x in ((view, tangent[0]), (light, tangent[1]))
    ]
    return _sum(light, view), parts[0] + parts[1]


def _sum(fixed: Array, x: Array) -> Array:
    # Written out term by term, because XLA's CPU code for a reduction over the middle axis takes ten times as long.
    return reduce(jnp.add, (fixed[:, term] * x[:, term] for term in range(fixed.shape[1])))


def _spread(fixed: Array, cotangent: Array) -> Array:
    """Transpose of `_sum`. JAX's own transpose pads every term."""
    return fixed * cotangent[:, None]


def _spread_gray(fixed: Array, cotangent: Array) -> Array:
    """`_spread` for a gray factor beside a colored one: sums over colors, written out for the same reason as `_sum`."""
    colors = range(cotangent.shape[1])
    return reduce(jnp.add, (fixed[..., c] * cotangent[:, None, c] for c in colors))[..., None]


def light_tuple(transport: Transport, light: Environment, *, light_keep: int | None = None) -> Float[Array, "v r c"]:
    """The light-modulated tuple of every vertex: light times visibility, cosine and the light factor of each term.

    Call it again when the light changes; it does not depend on the view.

    Args:
        transport: Precomputed transport.
        light: The environment. Its cubemap must have the size of the transport's.
        light_keep: Number of light coefficients to keep, chosen by `choose_by_transport`; all if None. Keeping all
            takes no more time, because coefficients are read from a dense table.

    Returns:
        One value per vertex, term and color, with vertices in the order of the mesh.

    Raises:
        ValueError: The light is a batch, has another cubemap size than the transport, or is not finite.
    """
    require.kind("the light", light, Environment, source="jaxprt.scene.load_environment")
    coefficient = project(protocol.one_light(light, size=haar.face_edge(transport.rms.shape[0])))
    if light_keep is not None:
        coefficient = choose_by_transport(coefficient, transport.rms, count=light_keep)
    return transport.apply(coefficient)


@require.arguments(brdf=_brdf)
def view_tuple(transport: Transport, brdf: SeparableBrdf, eye: Float[Array, "3"]) -> Float[Array, "v r c"]:
    """The view-modulated tuple of every vertex: view maps looked up in the direction to the eye.

    Call it again when the eye moves; it does not depend on the light.

    Args:
        transport: Precomputed transport, which holds the vertices.
        brdf: The factored BRDF of the transport.
        eye: Position of the viewer in world units.

    Returns:
        One value per vertex, term and color, with vertices in the order of the mesh.

    Raises:
        ValueError: The eye is not one finite position, or the transport was made for another BRDF. Neither can be
            checked inside `jax.jit`, where NaN in the eye reaches all vertices.

    Reference: Wang, Tran, Luebke 2004, sections 3.1 and 3.4.
    """
    check_mark(transport.mark, brdf.light_map)
    return view_factors(brdf, transport.position, transport.frame, eye)


def view_factors(
    brdf: SeparableBrdf, position: Float[Array, "v 3"], frame: Float[Array, "v 3 3"], eye: Float[Array, "*p 3"]
) -> Float[Array, "v r c"]:
    """View maps looked up for given positions and frames: `view_tuple` without a transport.

    Args:
        brdf: The factored BRDF.
        position: Positions in world units.
        frame: Shading frames; rows are tangent, bitangent, normal.
        eye: Position of the viewer in world units: one, or one for each position.

    Raises:
        ValueError: The eye is not finite, or is neither one position nor one for each.
    """
    eye = require.position("the eye", eye, each=len(position))
    return _view_factors(brdf, position, frame, eye)


@jit
def _view_factors(brdf: SeparableBrdf, position: Array, frame: Array, eye: Array) -> Array:
    return brdf.view(directions.view(frame, position, eye))


def modulate(
    view: Float[Array, "v r d"], weight: Float[Array, "v n w"], *, terms: tuple[int, ...]
) -> Float[Array, "v r e"]:
    """Gives every vertex its own BRDF, a weighted sum of n basis BRDFs, by weighting the terms of the view tuple.

    For a texture that multiplies a whole BRDF, n is 1. For a texture on the diffuse part only, join the diffuse part
    and the rest with `jaxprt.separable.join`, and give the rest a weight of 1. Neither the transport nor the light
    tuple depends on the weights, so changing them costs no more than changing the view. The result is linear in the
    weights.

    Args:
        view: `view_tuple` of the joined BRDF.
        weight: Weight of each of n basis BRDFs at each vertex, per color or for all colors.
        terms: Number of terms of each basis BRDF, in the order of `jaxprt.separable.join`.

    Returns:
        The view tuple for `combine`. It has colors if the BRDF or the weights have.

    Raises:
        ValueError: The number of weights or of terms does not match `terms`, or a weight is not finite. Values cannot
            be checked inside `jax.jit`, where NaN reaches the vertices that have such a weight.

    Reference: Wang, Tran, Luebke 2004, section 3.1.
    """
    if weight.shape[1] != len(terms) or view.shape[1] != sum(terms):
        raise ValueError(
            f"terms must hold one number for each of {weight.shape[1]} weights and sum to the {view.shape[1]} terms of "
            f"the view tuple, got {terms}"
        )
    require.length("vertices of the weights", weight, len(view))
    require.finite("the weights", weight)
    return _modulated(view, weight, terms=terms)


@partial(jit, static_argnames=("terms",))
def _modulated(view: Array, weight: Array, *, terms: tuple[int, ...]) -> Array:
    return view * weight[:, np.repeat(np.arange(len(terms)), terms)]


@isolated
def combine(light: Float[Array, "v r c"], view: Float[Array, "v r d"]) -> Float[Array, "v e"]:
    """Radiance: the dot product of the light tuple and the view tuple over the terms r.

    Args:
        light: The result of `light_tuple`, with the c colors of the light.
        view: The result of `view_tuple`, with the d colors of the BRDF.

    Returns:
        Linear radiance of each vertex in e = max(c, d) colors. If one tuple is gray, it is used for all colors.

    Raises:
        ValueError: The tuples differ in vertices, terms or colors, and neither is gray.
    """
    (c, d), shapes = (light.shape[-1], view.shape[-1]), (list(light.shape), list(view.shape))
    if light.shape[:2] != view.shape[:2] or (c != d and 1 not in (c, d)):
        raise ValueError(
            f"light and view must have the same vertices, terms and colors, got {shapes[0]} and {shapes[1]}"
        )
    return _product(light, view)


@require.arguments(brdf=_brdf, light=protocol.one_light)
def radiance(
    transport: Transport,
    brdf: SeparableBrdf,
    light: Environment,
    *,
    eye: Float[Array, "3"],
    light_keep: int | None = None,
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    Differentiable in the light, the eye, the view maps and the transport's values. The light maps are part of the
    transport and not read here, so gradients with respect to the BRDF cover the view maps only. For gradients with
    respect to the parameters of a BRDF model use `jaxprt.reference.radiance`.

    Args:
        transport: Precomputed transport.
        brdf: The factored BRDF of the transport.
        light: The environment. Its cubemap must have the size of the transport's.
        eye: Position of the viewer in world units.
        light_keep: Number of light coefficients to keep, chosen by `choose_by_transport`; all if None.

    Returns:
        Linear radiance per vertex, in units of the light's radiance.

    Raises:
        TypeError: The BRDF is not a `SeparableBrdf`, or the light is not an `Environment`.
        ValueError: The transport was made for another BRDF, the light is a batch or has another cubemap size than the
            transport, or the light or the eye is not finite.

    Reference: Wang, Tran, Luebke 2004, equation 6.
    """
    if brdf.terms != transport.terms:
        raise ValueError(f"the BRDF must have the transport's {transport.terms} terms, got {brdf.terms}")
    lit = light_tuple(transport, light, light_keep=light_keep)
    return combine(lit, view_tuple(transport, brdf, eye))
