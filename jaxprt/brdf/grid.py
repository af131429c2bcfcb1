"""Interpolation in tables of BRDFs over the view direction and parameters: knots, neighbors and weights."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import mapped


def as_argument(brdf: Callable) -> Callable:
    """A BRDF as an argument for jitted functions. Plain functions are not arrays and are wrapped."""
    if getattr(brdf, "holds_cosine", False):
        raise TypeError(
            f"the BRDF must return values in 1/sr, got a {type(brdf).__name__}, whose values include the cosine of the "
            "light's direction: give the BRDF that the table was made from"
        )
    return jax.tree_util.Partial(brdf) if jax.tree_util.all_leaves([brdf]) else brdf


def check(brdf: object) -> None:
    """Refuses anything but a function of two directions that returns real numbers.

    Raises:
        TypeError: The BRDF is not a function of wi and wo, or its values are not arrays of floating point.
    """
    required = "the BRDF must be a function (wi, wo) -> values in 1/sr, such as jaxprt.brdf.Lambert(0.5)"
    if not callable(brdf):
        raise TypeError(f"{required}, got {require.shown(brdf)}")
    if getattr(brdf, "holds_cosine", False):
        as_argument(brdf)
    direction = jax.ShapeDtypeStruct((1, 3), jnp.result_type(float))
    try:
        value = jax.eval_shape(brdf, direction, direction)
    except Exception as error:
        raise TypeError(
            f"{required}, got {require.shown(brdf)}, which raises {type(error).__name__}: {error}"
        ) from error
    dtype = getattr(value, "dtype", None)
    if dtype is None or not jnp.issubdtype(dtype, jnp.floating):
        got = type(value).__name__ if dtype is None else dtype
        raise TypeError(f"the values of the BRDF must be an array of floating point, got {got}")


def check_family(brdf: Any, knot: Any) -> None:
    """Refuses anything but a BRDF, or, with knots, anything but a function of the parameters. `check` has the rest."""
    if not isinstance(knot, Sequence) or isinstance(knot, str | bytes):
        raise TypeError(f"knot must be a list with the values of each parameter, got {require.shown(knot)}")
    if not len(knot):
        check(brdf)
    elif not callable(brdf):
        raise TypeError(f"the BRDF must be a function of the parameters, with knots, got {require.shown(brdf)}")


def check_knots(knot: Sequence[np.ndarray]) -> tuple[np.ndarray, ...]:
    """The knots of each parameter, converted to float64."""
    for number, values in enumerate(knot):
        require.real(f"knots of parameter {number}", values)
    if len(knot) > 2:
        raise ValueError(f"at most two parameters can be tabulated, got {len(knot)}")
    knots = tuple(np.asarray(values, np.float64) for values in knot)
    for number, values in enumerate(knots):
        if values.ndim != 1 or len(values) < 2 or not np.all(np.isfinite(values)) or not np.all(np.diff(values) > 0):
            raise ValueError(
                f"knots of parameter {number} must be at least two finite increasing numbers, got {values}"
            )
    return knots


def place(knot: Float[Array, " k"], parameter: Float[Array, "*v"]) -> Float[Array, "*v"]:
    """Fractional index of parameters among knots, such as 1.5 halfway from the second to the third; clamped."""
    low = jnp.clip(jnp.searchsorted(knot, parameter, side="right") - 1, 0, len(knot) - 2)
    fraction = (parameter - knot[low]) / (knot[low + 1] - knot[low])
    return jnp.clip(low + fraction, 0, len(knot) - 1)


def neighbors(place: Float[Array, "*v"], *, size: int) -> tuple[Int[Array, "*v"], Float[Array, "*v"]]:
    """Index of the lower neighbor of a fractional index, and the weight of the upper neighbor. Places are clamped.

    It is differentiable in the place between the first and the last knot.
    """
    place = jnp.clip(place, 0, size - 1)
    low = jax.lax.stop_gradient(jnp.clip(jnp.floor(place), 0, size - 2))
    return low.astype(jnp.int32), place - low


def among(
    knots: Sequence[Float[Array, " _"]], parameter: Sequence[Float[Array, "*v"]]
) -> list[tuple[Int[Array, "*v"], Float[Array, "*v"]]]:
    """The `neighbors` of the values of each parameter among its knots."""
    return [neighbors(place(knot, value), size=len(knot)) for knot, value in zip(knots, parameter, strict=True)]


def read(
    row: Float[Array, " r *q"], axis: Sequence[tuple[Int[Array, " v"], Float[Array, " v"]]]
) -> Float[Array, "r v"]:
    """Rows of a table, interpolated multilinearly along each axis of nodes."""
    count = len(axis[0][0])
    spot, weight = jnp.zeros((1, count), jnp.int32), jnp.ones((1, count), axis[0][1].dtype)
    for size, (low, upper) in zip(row.shape[1:], axis, strict=True):
        spot = jnp.concatenate([spot * size + low, spot * size + low + 1])
        weight = jnp.concatenate([weight * (1 - upper), weight * upper])
    # Row by row, so that a row stays in the cache while all views are looked up.
    return mapped(
        lambda one: sum(one.at[s].get(mode="promise_in_bounds") * w for s, w in zip(spot, weight, strict=True)),
        row.reshape(len(row), -1),
    )
