"""Relighting by the separable system: a light-modulated and a view-modulated tuple per vertex, and their product.

Turning the light redoes only `light_tuple`, moving the eye only `view_tuple`; the caller keeps the other.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.brdf.separable import SeparableBrdf
from jaxprt.scene.environment import Environment
from jaxprt.sphere import directions, haar
from jaxprt.transport.sparse import SparseTransport

_STEPS = (1 << 15) - 1  # signed 16 bits


@jax.jit
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


@partial(jax.jit, static_argnames=("threshold",))
def choose_by_magnitude(coefficient: Float[Array, "b c"], *, threshold: int = 1024) -> Float[Array, "b c"]:
    """Quantizes to signed 16 bits per color and drops what is below the threshold, as published.

    Args:
        coefficient: Coefficients of the light.
        threshold: Smallest magnitude kept, in steps of the largest coefficient of each color / 32767.

    Returns:
        Coefficients with zeros where dropped; kept ones are not rounded.

    Reference: Wang, Tran, Luebke 2004, section 3.4.
    """
    largest = jnp.max(jnp.abs(coefficient), 0)
    quantum = jnp.where(largest > 0, largest, 1) / _STEPS
    return jnp.where(jnp.round(jnp.abs(coefficient) / quantum) >= threshold, coefficient, 0)


@partial(jax.jit, static_argnames=("count",))
def choose_by_area(coefficient: Float[Array, "b c"], *, count: int) -> Float[Array, "b c"]:
    """Keeps the `count` coefficients largest in magnitude times the area of their basis function.

    Reference: Ng, Ramamoorthi, Hanrahan 2003, section 5.
    """
    size = haar.face_edge(coefficient.shape[0])
    area = jnp.tile(haar.area(size=size).ravel(), 6)
    return _choose(coefficient, area, count)


@partial(jax.jit, static_argnames=("count",))
def choose_by_transport(
    coefficient: Float[Array, "b c"], rms: Float[Array, " b"], *, count: int
) -> Float[Array, "b c"]:
    """Keeps the `count` coefficients largest in magnitude times the rms of the transport that they meet.

    That is the order of their mean squared contribution to the picture.

    Args:
        coefficient: Coefficients of the light.
        rms: `SparseTransport.rms`.
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


def light_tuple(
    transport: SparseTransport, light: Environment, *, light_keep: int | None = None
) -> Float[Array, "v r c"]:
    """The light side: what changes when the light turns.

    Args:
        transport: Precomputed transport.
        light: The environment, on the size of cubemap that the transport was made for.
        light_keep: Coefficients of the light to keep, chosen by `choose_by_transport`; all of them if None. Keeping
            all costs no more here, since the light is read through a dense table.

    Returns:
        The light-modulated tuple of every vertex.

    Raises:
        ValueError: The light is a batch, or its cubemap is not six faces of the transport's size.
    """
    size = haar.face_edge(transport.rms.shape[0])
    if light.radiance.shape[:-1] != (6, size, size):
        raise ValueError(f"the light must be one environment [6, {size}, {size}, c], got {list(light.radiance.shape)}")
    coefficient = project(light)
    if light_keep is not None:
        coefficient = choose_by_transport(coefficient, transport.rms, count=light_keep)
    return transport.apply(coefficient)


@jax.jit
def view_tuple(transport: SparseTransport, brdf: SeparableBrdf, eye: Float[Array, "3"]) -> Float[Array, "v r c"]:
    """The view side: view maps looked up at each vertex's direction to the eye; zero where it looks away.

    Args:
        transport: Whose vertices.
        brdf: The factored BRDF of the transport.
        eye: Position of the viewer in world units.

    Returns:
        The view-modulated tuple of every vertex.

    Reference: Wang, Tran, Luebke 2004, sections 3.1 and 3.4.
    """
    local = jnp.einsum("vij,vj->vi", transport.frame, eye - transport.position)
    return brdf.view(directions.normalize(local))


@jax.jit
def combine(light: Float[Array, "v r c"], view: Float[Array, "v r d"]) -> Float[Array, "v e"]:
    """Dot product of the two tuples: outgoing radiance per vertex and color.

    Args:
        light: `light_tuple`; its c channels are the light's, one if that is gray.
        view: `view_tuple`; its d channels are the BRDF's.

    Returns:
        Linear radiance in e colors, the larger of c and d: a gray side serves all colors of the other.
    """
    return jnp.sum(light * view, 1)


def radiance(
    transport: SparseTransport,
    brdf: SeparableBrdf,
    light: Environment,
    *,
    eye: Float[Array, "3"],
    light_keep: int | None = None,
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    Differentiable in the light, the eye, the view maps and the transport's values. The light maps are not read: they
    are in the transport. So the gradient in the BRDF is the view maps' part alone; for parameters of a BRDF
    model take `jaxprt.relight.reference.radiance`.

    Args:
        transport: Precomputed transport.
        brdf: The factored BRDF that it was made for.
        light: The environment.
        eye: Position of the viewer in world units.
        light_keep: As in `light_tuple`.

    Returns:
        Linear radiance per vertex, in the light's units.

    Raises:
        ValueError: The BRDF has another number of terms than the transport, or as in `light_tuple`. That the
            transport was made for this BRDF is not known and not checked.

    Reference: Wang, Tran, Luebke 2004, equation 6.
    """
    if brdf.terms != transport.index.shape[2]:
        raise ValueError(f"the BRDF must have the transport's {transport.index.shape[2]} terms, got {brdf.terms}")
    return combine(light_tuple(transport, light, light_keep=light_keep), view_tuple(transport, brdf, eye))
