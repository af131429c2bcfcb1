"""Parameters of a light or a material as one flat array, and their bounds."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from jaxprt import require

_INSIDE = 0.01  # of a range: how far from a bound a start is moved
_AT = 1e-4  # of a range: how close to a bound a number is at it
_LOG = 100.0  # ratio of bounds above which a number is fitted in its logarithm


def raveled(start: PyTree, steps: int) -> tuple[Array, Callable]:
    """The numbers of the start as one array, and the function that restores its structure."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        raise TypeError(f"steps must be a whole number, got {steps!r}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    outside(start)
    for each in jax.tree.leaves(start):
        if not isinstance(each, jax.Array | np.ndarray | np.generic | float | int) or isinstance(each, bool):
            raise TypeError(f"the start must be arrays and numbers, in a pytree, got a {type(each).__name__}")
    start = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), start)
    first, unravel = ravel_pytree(start)
    if not first.size:
        raise ValueError("the start must hold at least one number, got none")
    require.finite("the start, its numbers in a row,", first)
    return first, unravel


def outside(*values: PyTree) -> None:
    """Refuses a call inside `jax.jit` or another transformation, where values are not known."""
    traced = any(isinstance(each, Tracer) for each in jax.tree.leaves(values))
    if traced or isinstance(jnp.zeros(()) + 0, Tracer):
        raise TypeError(
            "a fit needs concrete values: call it outside of jax.jit, jax.vmap and jax.grad, got traced arrays"
        )


def bound(bound: PyTree, start: PyTree, none: float) -> np.ndarray:
    """The bound of each number, given as one number, a pytree like the start, or None, which may replace a leaf."""
    outside(bound)
    (bounds, made), (values, whole) = (jax.tree.flatten(each, is_leaf=lambda x: x is None) for each in (bound, start))
    if made != whole:
        if not jax.tree_util.treedef_is_leaf(made):
            raise ValueError(f"bounds must be one number, or made like the start, {whole}, got {made}")
        bounds = bounds * len(values)
    parts = []
    for each, value in zip(bounds, values, strict=True):
        shape = np.shape(value) if value is not None else (0,)
        number = np.asarray(none if each is None else each)
        if number.dtype.kind not in "iuf" or (number.shape != shape and number.ndim):
            raise ValueError(
                f"a bound must be a number, None, or an array like what it bounds, {list(shape)}, got "
                f"{number.dtype}{list(number.shape)}"
            )
        parts.append(np.broadcast_to(number.astype(float), shape).ravel())
    return np.concatenate(parts)


def check(first: Array, low: np.ndarray, high: np.ndarray) -> None:
    """Refuses a start outside its bounds, which are compared in the precision of the start."""
    x = np.asarray(first)
    crossed = np.flatnonzero(~(low < high))
    if crossed.size:
        n = crossed[0]
        raise ValueError(f"lower bounds must be less than upper ones, number {n} has {low[n]:.6g} and {high[n]:.6g}")
    wrong = np.flatnonzero(~((low.astype(x.dtype) <= x) & (x <= high.astype(x.dtype))))
    if wrong.size:
        n = wrong[0]
        raise ValueError(
            f"the start must lie between its bounds, {wrong.size} of {len(first)} numbers do not: number {n} is "
            f"{first[n]:.6g}, the bounds are {low[n]:.6g} and {high[n]:.6g}"
        )


def freed(first: Array, low: np.ndarray, high: np.ndarray) -> tuple[Array, Callable, Callable]:
    """Unbounded variables for bounded numbers, the map back to the numbers, and which numbers are at a bound.

    A number between two bounds is the sine of its variable; a number with one bound is a hyperbola of it. A long step
    cannot get stuck there, as it can with a logistic function.

    Reference: James and Roos 1975, MINUIT.
    """
    x = np.asarray(first, float)
    below, above = np.isfinite(low), np.isfinite(high)
    both, one = below & above, below ^ above
    logs = both & (low > 0) & (high > _LOG * np.where(low > 0, low, 1))
    a, b = (np.where(both, np.where(logs, np.log(np.where(logs, e, 1)), e), none) for e, none in ((low, 0), (high, 1)))
    place = np.clip((np.where(logs, np.log(np.where(logs, x, 1)), x) - a) / (b - a), _INSIDE, 1 - _INSIDE)
    sign, edge = np.where(above, -1.0, 1.0), np.where(below, low, np.where(above, high, 0.0))
    size = np.where(x != 0, np.abs(x), 1.0)
    away = np.where(one, np.maximum(sign * (x - edge) / size, _INSIDE), 0)
    free = np.where(both, np.arcsin(2 * place - 1), np.where(one, np.sqrt(away * (away + 2)), x / size))

    def bounded(u: Array) -> Array:
        between = a + (b - a) * (1 + jnp.sin(u)) / 2
        between = jnp.where(logs, jnp.exp(jnp.where(logs, between, 0)), between)
        beyond = edge + sign * size * (jnp.sqrt(u**2 + 1) - 1)
        return jnp.where(both, between, jnp.where(one, beyond, u * size)).astype(first.dtype)

    def pinned(u: Array) -> np.ndarray:
        place = np.asarray(u, float)
        away = np.where(both, (1 - np.abs(np.sin(place))) / 2, np.sqrt(place**2 + 1) - 1)
        return (both | one) & (away < _AT)

    return jnp.asarray(free, first.dtype), bounded, pinned
