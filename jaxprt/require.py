"""Checks of values where they enter the package, with errors that name what was required and what came.

Values inside `jax.jit`, `jax.vmap` or `jax.grad` are not known while Python runs: these checks let them pass. There a
NaN reaches every vertex that reads it.
"""

from typing import Any

import numpy as np
from jax.core import Tracer


def finite(name: str, value: Any) -> None:
    """Refuses NaN and infinity.

    Args:
        name: What the value is, for the message: "the eye".
        value: A number or an array.

    Raises:
        ValueError: Some values are not finite; says how many, and where the first one is.
    """
    if isinstance(value, Tracer):
        return
    known = np.asarray(value)
    if known.dtype.kind == "f":
        _require(name, "finite", known, np.asarray(np.isfinite(known)))


def at_least(name: str, value: Any, least: float, *, slack: float = 0.0) -> None:
    """Refuses NaN, infinity and values below a bound.

    Args:
        name: What the value is, for the message: "the albedo".
        value: A number or an array.
        least: The bound.
        slack: By how much rounding may miss it.

    Raises:
        ValueError: Some values are not finite, or below the bound; says how many, and where the first one is.
    """
    finite(name, value)
    if not isinstance(value, Tracer):
        known = np.asarray(value)
        _require(name, f"at least {least:g}", known, np.asarray(known >= least - slack))


def position(name: str, value: Any) -> None:
    """Refuses what is not one finite position. Shapes are known inside `jax.jit` too.

    Args:
        name: What the value is, for the message: "the eye".
        value: An array or a list.

    Raises:
        ValueError: It has not three values in one row, or some are not finite.
    """
    if np.shape(value) != (3,):
        raise ValueError(f"{name} must be one position, [3], got an array of shape {list(np.shape(value))}")
    finite(name, value)


def _require(name: str, what: str, known: np.ndarray, right: np.ndarray) -> None:
    if right.all():
        return
    wrong = np.argwhere(~right)
    where = f", first at {tuple(map(int, wrong[0]))}" if known.ndim else ""
    raise ValueError(
        f"{name} must be {what}, got {len(wrong)} of {known.size} values that are not{where}: {known[tuple(wrong[0])]}"
    )


def between(name: str, value: int | None, low: int, high: int) -> None:
    """Refuses a number outside a range.

    Args:
        name: What the number is, for the message: "terms".
        value: The number; None passes.
        low: The least that is allowed.
        high: The most that is allowed.

    Raises:
        ValueError: The number is outside the range.
    """
    if value is not None and not low <= value <= high:
        raise ValueError(f"{name} must be between {low} and {high}, got {value}")
