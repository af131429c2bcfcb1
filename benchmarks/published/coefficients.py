"""Choosing and rounding the light's wavelet coefficients: published thresholds, areas, and the transport's size."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import haar

_STEPS = (1 << 15) - 1  # highest level in signed 16 bits


@partial(jit, static_argnames=("threshold",))
def choose_by_magnitude(coefficient: Float[Array, "b c"], *, threshold: int = 1024) -> Float[Array, "b c"]:
    """Sets light coefficients below a threshold in signed 16 bits to zero, as published.

    `choose_by_transport` reaches a smaller error with fewer coefficients.

    Args:
        coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.
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
        coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.

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
        coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.
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
        coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.
        rms: Root mean square of the transport for each coefficient, `rms` of the transport.
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
