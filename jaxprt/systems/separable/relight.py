"""Relighting by the separable system: a light-modulated and a view-modulated tuple per vertex, and their product.

Turning the light redoes only `light_tuple`, moving the eye only `view_tuple`; the caller keeps the other.
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
from jaxprt.systems.separable.factorization import SeparableBrdf, check_mark

_STEPS = (1 << 15) - 1  # signed 16 bits


@runtime_checkable
class Transport(Protocol):
    """What relighting asks of precomputed transport, however it is stored.

    Attributes:
        position: Vertex positions in world units, in the mesh's order.
        frame: Rows are tangent, bitangent, normal.
        rms: Root mean square over vertices and terms of each coefficient.
        mark: Some values of the light factors that it was made of, see `factorization.marked`; None if unknown.
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
        """Transport times light coefficients, per vertex, term and color."""
        ...


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, SeparableBrdf, source="jaxprt.separable.factor")


def _environment(value: Any) -> None:
    require.kind("the light", value, Environment, source="jaxprt.scene.load_environment")
    require.finite("the light", value.radiance)


@require.arguments(light=_environment)
@jit
def project(light: Environment) -> Float[Array, "b c"]:
    """Haar coefficients of an environment, each cubemap face by itself.

    Solid angles are in the transport, so the radiance is transformed as it is.

    Args:
        light: One environment; edges of faces a power of two.

    Returns:
        Coefficients on b = 6 n n, in the light's units.
    """
    coefficient = haar.forward(light.radiance)
    return coefficient.reshape(-1, coefficient.shape[-1])


@partial(jit, static_argnames=("threshold",))
def choose_by_magnitude(coefficient: Float[Array, "b c"], *, threshold: int = 1024) -> Float[Array, "b c"]:
    """Drops what is below the threshold in signed 16 bits per color, as published.

    It keeps 691 of the 24,576 coefficients of Grace, 878 of Eucalyptus and 372 of St Peter's, in one color or more;
    the published count is 200 to 600. Radiance of the bunny and its ground is then off by 5.2, 1.2 and 8.4 %, and with
    200 coefficients by `choose_by_transport` by 0.5, 0.3 and 0.5 %.

    Args:
        coefficient: Coefficients of the light.
        threshold: Smallest magnitude kept, in steps of the largest coefficient of each color / 32767.

    Returns:
        Coefficients with zeros where dropped; kept ones are not rounded, which is for `quantize`.

    Reference: Wang, Tran, Luebke 2004, section 3.4.
    """
    return jnp.where(jnp.abs(_level(coefficient)) >= threshold, coefficient, 0)


@jit
def quantize(coefficient: Float[Array, "b c"]) -> Float[Array, "b c"]:
    """Rounds to signed 16 bits: multiples of the largest coefficient of each color / 32767.

    That changes the radiance of the bunny under Grace by 3e-5, under St Peter's by 8e-5 of its norm.

    Args:
        coefficient: Coefficients of the light.

    Returns:
        Rounded coefficients, in the same units. Derivatives are those of the largest alone: the rest are steps.

    Reference: Wang, Tran, Luebke 2004, section 3.4.
    """
    return _level(coefficient) * (jnp.max(jnp.abs(coefficient), 0) / _STEPS)


def _level(coefficient: Array) -> Array:
    """Whole multiples of the largest coefficient of each color / 32767."""
    largest = jnp.max(jnp.abs(coefficient), 0)
    quantum = jnp.where(largest > 0, largest, 1) / _STEPS
    return jnp.round(coefficient / quantum)


@partial(jit, static_argnames=("count",))
def choose_by_area(coefficient: Float[Array, "b c"], *, count: int) -> Float[Array, "b c"]:
    """Keeps the `count` coefficients largest in magnitude times the area of their basis function.

    Reference: Ng, Ramamoorthi, Hanrahan 2003, section 5.
    """
    size = haar.face_edge(coefficient.shape[0])
    area = jnp.tile(haar.area(size=size).ravel(), 6)
    return _choose(coefficient, area, count)


@partial(jit, static_argnames=("count",))
def choose_by_transport(
    coefficient: Float[Array, "b c"], rms: Float[Array, " b"], *, count: int
) -> Float[Array, "b c"]:
    """Keeps the `count` coefficients largest in magnitude times the rms of the transport that they meet.

    That is the order of their mean squared contribution to the picture.

    Args:
        coefficient: Coefficients of the light.
        rms: `Transport.rms`.
        count: How many to keep.

    Returns:
        Coefficients with zeros where dropped.
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
    # Written out term by term: a reduction over the middle axis costs XLA's CPU code ten times as much.
    return reduce(jnp.add, (fixed[:, term] * x[:, term] for term in range(fixed.shape[1])))


def _spread(fixed: Array, cotangent: Array) -> Array:
    """The transpose; JAX's own pads every term."""
    return fixed * cotangent[:, None]


def _spread_gray(fixed: Array, cotangent: Array) -> Array:
    """The same for what is gray beside colors, written out for the same reason."""
    colors = range(cotangent.shape[1])
    return reduce(jnp.add, (fixed[..., c] * cotangent[:, None, c] for c in colors))[..., None]


@require.arguments(light=_environment)
def light_tuple(transport: Transport, light: Environment, *, light_keep: int | None = None) -> Float[Array, "v r c"]:
    """The light side: what changes when the light turns.

    Args:
        transport: Precomputed transport.
        light: The environment, on the size of cubemap that the transport was made for.
        light_keep: Coefficients of the light to keep, chosen by `choose_by_transport`; all of them if None. Keeping
            all costs no more here, since the light is read through a dense table.

    Returns:
        The light-modulated tuple of every vertex, in the mesh's order.

    Raises:
        ValueError: The light is a batch, its cubemap is not six faces of the transport's size, or it is not finite.
    """
    require.finite("the light", light.radiance)
    size = haar.face_edge(transport.rms.shape[0])
    if light.radiance.shape[:-1] != (6, size, size):
        raise ValueError(f"the light must be one environment [6, {size}, {size}, c], got {list(light.radiance.shape)}")
    coefficient = project(light)
    if light_keep is not None:
        coefficient = choose_by_transport(coefficient, transport.rms, count=light_keep)
    return transport.apply(coefficient)


@require.arguments(brdf=_brdf)
def view_tuple(transport: Transport, brdf: SeparableBrdf, eye: Float[Array, "3"]) -> Float[Array, "v r c"]:
    """The view side: view maps looked up at each vertex's direction to the eye.

    Args:
        transport: Whose vertices.
        brdf: The factored BRDF of the transport.
        eye: Position of the viewer in world units.

    Returns:
        The view-modulated tuple of every vertex, in the mesh's order.

    Raises:
        ValueError: The eye is not one position, or not finite: inside `jax.jit` its values are not known, and all
            vertices get NaN. Or the transport was made for another BRDF: values that JAX is tracing are not compared,
            nor is transport that does not know its BRDF.

    Reference: Wang, Tran, Luebke 2004, sections 3.1 and 3.4.
    """
    check_mark(transport.mark, brdf.light_map)
    return view_factors(brdf, transport.position, transport.frame, eye)


def view_factors(
    brdf: SeparableBrdf, position: Float[Array, "v 3"], frame: Float[Array, "v 3 3"], eye: Float[Array, "*p 3"]
) -> Float[Array, "v r c"]:
    """View maps looked up for any positions and frames: `view_tuple` without a transport.

    Raises:
        ValueError: The eye is neither one position nor one for each, or not finite.
    """
    require.position("the eye", eye, each=len(position))
    return _view_factors(brdf, position, frame, eye)


@jit
def _view_factors(brdf: SeparableBrdf, position: Array, frame: Array, eye: Array) -> Array:
    return brdf.view(directions.view(frame, position, eye))


def modulate(
    view: Float[Array, "v r d"], weight: Float[Array, "v n w"], *, terms: tuple[int, ...]
) -> Float[Array, "v r e"]:
    """Gives every vertex a BRDF of its own: the view tuple with the terms of n basis BRDFs weighted.

    A texture over all of one BRDF is n = 1; a texture on its diffuse part is `jaxprt.separable.join` of that part
    and the rest, with weight 1 for the rest. Neither transport nor the light tuple depends on the weights, so new ones
    cost no more than a view change. Linear in the weights, and differentiable in them.

    Args:
        view: `view_tuple` of the joined BRDF.
        weight: Of each vertex, in the mesh's order, each basis BRDF, and each color or all colors alike.
        terms: Number of terms of each basis BRDF, in the order of `jaxprt.separable.join`.

    Returns:
        The view tuple for `combine`, in the colors of the BRDF or of the weights, whichever are more.

    Raises:
        ValueError: The weights' n or the tuple's r do not fit the terms, or weights are not finite. Inside `jax.jit`
            values are not known, and NaN reaches the vertices that have it.

    Reference: Wang, Tran, Luebke 2004, section 3.1.
    """
    if weight.shape[1] != len(terms) or view.shape[1] != sum(terms):
        raise ValueError(
            f"terms must be one number for each of {weight.shape[1]} weights that add up to the tuple's "
            f"{view.shape[1]}, got {terms}"
        )
    require.length("the vertices of the weights", weight, len(view))
    require.finite("the weights", weight)
    return _modulated(view, weight, terms=terms)


@partial(jit, static_argnames=("terms",))
def _modulated(view: Array, weight: Array, *, terms: tuple[int, ...]) -> Array:
    return view * weight[:, np.repeat(np.arange(len(terms)), terms)]


@isolated
def combine(light: Float[Array, "v r c"], view: Float[Array, "v r d"]) -> Float[Array, "v e"]:
    """Dot product of the two tuples: outgoing radiance per vertex and color.

    Args:
        light: `light_tuple`; its c channels are the light's, one if that is gray.
        view: `view_tuple`; its d channels are the BRDF's.

    Returns:
        Linear radiance in e colors, the larger of c and d: a gray side serves all colors of the other.

    Raises:
        ValueError: The tuples are of other vertices, other terms, or unlike colors.
    """
    (c, d), shapes = (light.shape[-1], view.shape[-1]), (list(light.shape), list(view.shape))
    if light.shape[:2] != view.shape[:2] or (c != d and 1 not in (c, d)):
        raise ValueError(
            f"light and view must have the same vertices, terms and colors, got {shapes[0]} and {shapes[1]}"
        )
    return _product(light, view)


@require.arguments(brdf=_brdf, light=_environment)
def radiance(
    transport: Transport,
    brdf: SeparableBrdf,
    light: Environment,
    *,
    eye: Float[Array, "3"],
    light_keep: int | None = None,
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    Differentiable in the light, the eye, the view maps and the transport's values. The light maps are not read: they
    are in the transport. So the gradient in the BRDF is the view maps' part alone; for parameters of a BRDF
    model take `jaxprt.reference.radiance`.

    Args:
        transport: Precomputed transport.
        brdf: The factored BRDF that it was made for.
        light: The environment.
        eye: Position of the viewer in world units.
        light_keep: As in `light_tuple`.

    Returns:
        Linear radiance per vertex, in the light's units.

    Raises:
        TypeError: The BRDF is not factored, or the light is no Environment.
        ValueError: The BRDF has another number of terms than the transport, the transport was made for another BRDF,
            or as in `light_tuple`.

    Reference: Wang, Tran, Luebke 2004, equation 6.
    """
    if brdf.terms != transport.terms:
        raise ValueError(f"the BRDF must have the transport's {transport.terms} terms, got {brdf.terms}")
    lit = light_tuple(transport, light, light_keep=light_keep)
    return combine(lit, view_tuple(transport, brdf, eye))
