"""Tables of BRDFs over the view direction and over parameters: their knots, their neighbors, and how they are read."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.compile import mapped


def as_argument(brdf: Callable) -> Callable:
    """A BRDF that jitted functions take: a plain function is not an array and must be wrapped.

    Raises:
        TypeError: It is a table whose values hold the cosine of the light's direction too.
    """
    if getattr(brdf, "holds_cosine", False):
        raise TypeError(
            f"the BRDF must give values in 1/sr; those of {type(brdf).__name__} hold the cosine of the light's "
            "direction too: give the BRDF that the table was made from"
        )
    return jax.tree_util.Partial(brdf) if jax.tree_util.all_leaves([brdf]) else brdf


def checked(knot: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The knots of each parameter in float64.

    Raises:
        ValueError: There are more than two parameters, or knots are not at least two finite increasing numbers.
    """
    if len(knot) > 2:
        raise ValueError(f"at most two parameters can be tabulated, got {len(knot)}")
    every = tuple(np.asarray(values, np.float64) for values in knot)
    for number, values in enumerate(every):
        if values.ndim != 1 or len(values) < 2 or not np.all(np.isfinite(values)) or not np.all(np.diff(values) > 0):
            raise ValueError(
                f"knots of parameter {number} must be at least two finite increasing numbers, got {values}"
            )
    return every


def place(knot: Float[Array, " k"], parameter: Float[Array, "*v"]) -> Float[Array, "*v"]:
    """Where parameters lie among knots: 1.5 halfway between the second and the third; the ends for those outside."""
    low = jnp.clip(jnp.searchsorted(knot, parameter, side="right") - 1, 0, len(knot) - 2)
    fraction = (parameter - knot[low]) / (knot[low + 1] - knot[low])
    return jnp.clip(low + fraction, 0, len(knot) - 1)


def neighbors(place: Float[Array, "*v"], *, size: int) -> tuple[Int[Array, "*v"], Float[Array, "*v"]]:
    """The lower of the two neighbors of a place among so many, and the weight of the upper; the ends for those outside.

    Differentiable in the place within the ends.
    """
    place = jnp.clip(place, 0, size - 1)
    low = jax.lax.stop_gradient(jnp.clip(jnp.floor(place), 0, size - 2))
    return low.astype(jnp.int32), place - low


def read(row: Float[Array, "r *q"], axis: Sequence[tuple[Int[Array, " v"], Float[Array, " v"]]]) -> Float[Array, "r v"]:
    """Rows of a table, multilinearly between the neighbors on each of the axes of their nodes."""
    count = len(axis[0][0])
    spot, weight = jnp.zeros((1, count), jnp.int32), jnp.ones((1, count), axis[0][1].dtype)
    for size, (low, upper) in zip(row.shape[1:], axis, strict=True):
        spot = jnp.concatenate([spot * size + low, spot * size + low + 1])
        weight = jnp.concatenate([weight * (1 - upper), weight * upper])
    # Row by row, so that a row stays in the cache while all views read it.
    return mapped(
        lambda one: sum(one.at[s].get(mode="promise_in_bounds") * w for s, w in zip(spot, weight, strict=True)),
        row.reshape(len(row), -1),
    )
