"""The brightest texels of a light one by one, exactly: stored visibility times the BRDF itself."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.transport.direct import DirectTransport


@partial(jax.jit, static_argnames=("count",))
def split(light: Environment, *, count: int) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment]:
    """Takes the brightest texels out of a light, as far as they stand out.

    Args:
        light: One environment.
        count: Number of texels to take.

    Returns:
        Numbers of the texels; the radiance by which each stands out, in its own color, so that what is left of it has
        the flux of the brightest texel not taken; and the environment without that.

    Raises:
        ValueError: As many texels as there are, or none.
    """
    size, colors = light.radiance.shape[-2:]
    if not 1 <= count < 6 * size * size:
        raise ValueError(f"count must be between 1 and {6 * size * size - 1}, got {count}")
    radiance = light.radiance.reshape(-1, colors)
    flux = jnp.sum(radiance, -1) * cubemap.solid_angle(size=size).ravel()
    bright, texel = jax.lax.top_k(flux, count + 1)
    share = 1 - bright[-1] / jnp.where(bright[:-1] > 0, bright[:-1], 1)
    texel, excess = texel[:-1], radiance[texel[:-1]] * jnp.maximum(share, 0)[:, None]
    rest = radiance.at[texel].add(-excess).reshape(light.radiance.shape)
    return texel, excess, Environment(rest)


@jax.jit
def radiance(
    transport: DirectTransport,
    brdf: Callable,
    texel: Int[Array, " t"],
    excess: Float[Array, "t c"],
    *,
    eye: Float[Array, "3"],
) -> Float[Array, "v c"]:
    """Radiance that vertices send to the eye, of light from some texels.

    Args:
        transport: Visibility of the vertices.
        brdf: A model: a pytree that is callable, (wi, wo) -> value [*b c] in 1/sr on local directions.
        texel: Numbers of the texels.
        excess: Radiance of each, as `split` returns it.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance per vertex in the light's units; zero where the eye is below a vertex's horizon.
        Differentiable in the BRDF's parameters, the excess and the eye.

    Reference: Wang, Tran, Luebke 2004, equation 1, for single texels.
    """
    size = haar.face_edge(transport.level.shape[0])
    direction = cubemap.direction(size=size).reshape(-1, 3)[texel]
    area = cubemap.vector_area(size=size).reshape(-1, 3)[texel]
    wo = directions.normalize(jnp.einsum("vij,vj->vi", transport.frame, eye - transport.position))
    # Vertices last, which XLA's CPU code turns into vectors of them.
    value = jax.vmap(brdf, in_axes=1, out_axes=1)
    frame, wo = jnp.moveaxis(transport.frame, 0, 2), wo.T
    colors = max(jax.eval_shape(value, wo, wo).shape[0], excess.shape[1])

    def step(total, argument):
        direction, area, excess, visible = argument
        cosine = jnp.maximum(_along(frame[2], area), 0) * visible
        wi = jnp.stack([_along(axis, direction) for axis in frame])
        return total + value(wi, wo) * cosine * excess[:, None], None

    start = jnp.zeros((colors, wo.shape[1]), wo.dtype)
    return jax.lax.scan(step, start, (direction, area, excess, transport.visible(texel)))[0].T


def _along(axis: Float[Array, "3 v"], direction: Float[Array, "3"]) -> Float[Array, " v"]:
    return axis[0] * direction[0] + axis[1] * direction[1] + axis[2] * direction[2]
