"""Errors of factored BRDFs: in reflected radiance under a light, and over random pairs of directions."""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, directions


@runtime_checkable
class Terms(Protocol):
    """A BRDF given by a light factor and a view factor for each term, such as `jaxprt.separable.SeparableBrdf`."""

    def light(self, wi: Float[Array, "*b 3"]) -> Float[Array, "*b r l"]:
        """Light factors of all terms r, gray or per color l."""
        ...

    def view(self, wo: Float[Array, "*b 3"]) -> Float[Array, "*b r c"]:
        """View factors of all terms r, per color c."""
        ...


def light_errors(
    brdf: Callable, factored: Terms, light: Environment, *, frames: int = 32, views: int = 32
) -> Float[Array, " r"]:
    """Relative L2 error of radiance reflected under a light, without shadows, for each number of terms.

    Normals are spread evenly over the sphere, and views over the hemisphere. The BRDF and its terms are both sampled at
    the centers of the light's texels, so the error is that of the factorization only.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        factored: The factored BRDF.
        light: One environment.
        frames: Number of normals.
        views: Number of views for each normal.

    Returns:
        Error of the first term, of the first two terms, and so on. Zero if all radiance is zero.

    Raises:
        ValueError: The light is a batch.
    """
    if light.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(light.radiance.shape)}")
    return _light_errors(jax.tree_util.Partial(brdf), factored, light, _spread(frames, -1), _spread(views, 0))


@jit
def _light_errors(brdf: Callable, factored: Terms, light: Environment, normal: Array, view: Array) -> Array:
    size = light.radiance.shape[1]
    direction, area = (each(size=size).reshape(-1, 3) for each in (cubemap.direction, cubemap.vector_area))
    table = light.radiance.reshape(len(direction), -1)
    factor = factored.view(view)

    def one(axes):
        wi = directions.to_local(axes, direction)
        received = table * jnp.maximum(directions.to_local(axes, area)[:, 2:], 0)
        met = jnp.einsum("drl,dc->rlc", factored.light(wi), received)
        met = met[:, 0] if met.shape[1] == 1 else jnp.einsum("rcc->rc", met)
        by_terms = jnp.cumsum(factor * met, 1)

        def exact(wo):
            return jnp.sum(brdf(wi, jnp.broadcast_to(wo, wi.shape)) * received, 0)

        true = jax.lax.map(exact, view)
        return jnp.sum((by_terms - true[:, None]) ** 2, (0, 2)), jnp.sum(true**2)

    error, whole = jax.lax.map(one, directions.frame(normal, jnp.zeros_like(normal)))
    whole = jnp.sum(whole)
    return jnp.sqrt(jnp.sum(error, 0) / jnp.where(whole > 0, whole, 1))


def _spread(count: int, lowest: int) -> Array:
    """Directions with z above `lowest`, spread evenly on a golden spiral."""
    height = 1 - (1 - lowest) * (np.arange(count) + 0.5) / count
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - height**2)
    return jnp.asarray(np.stack([radius * np.cos(turn), radius * np.sin(turn), height], -1), jnp.result_type(float))


def sample_error(
    brdf: Callable, factored: Callable, *, samples: int = 80_000
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """RMS difference of two BRDFs over random pairs of directions, weighted by the cosine of the incident direction.

    The error is sqrt(sum cos_i |f - g|^2 / sum cos_i), with squares averaged over colors. Both directions are drawn
    independently, uniformly in solid angle above the horizon; every call draws the same ones. Half of the views lie
    within 30 degrees of the horizon, where glossy BRDFs have their largest values and contribute most of the error. The
    error of rendered radiance can be much smaller; `light_errors` measures it.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        factored: The factored BRDF, or any other BRDF with the same number of colors, or gray.
        samples: Number of pairs of directions.

    Returns:
        The error in 1/sr, and the error relative to the root mean square of the BRDF with the same weights. The latter
        is zero if both are zero.

    Raises:
        ValueError: `samples` is below 1.

    Reference: Wang, Tran, Luebke 2004, section 4.3. The paper does not state the distribution of its samples; uniform
    sampling is our choice.
    """
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    return _sample_error(brdf, factored, samples)


@eqx.filter_jit
def _sample_error(brdf: Callable, factored: Callable, samples: int) -> tuple[Array, Array]:
    height, turn = jax.random.uniform(jax.random.key(0), (2, 2, samples), jnp.result_type(float))
    height = 1 - height  # in (0, 1], above the horizon
    radius, angle = jnp.sqrt(1 - height**2), 2 * jnp.pi * turn
    wi, wo = jnp.stack([radius * jnp.cos(angle), radius * jnp.sin(angle), height], -1)
    value = brdf(wi, wo)
    weight = wi[:, 2:] / jnp.sum(wi[:, 2])
    error, size = (jnp.sqrt(jnp.sum(weight * f**2) / f.shape[-1]) for f in (factored(wi, wo) - value, value))
    return error, error / jnp.where((error == 0) & (size == 0), 1, size)
