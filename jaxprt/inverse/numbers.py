"""Numbers of a light or a material in a row, with bounds and without."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

_INSIDE = 0.01  # of a range: how far from a bound a start is moved
_LOG = 100.0  # ratio of bounds above which a number is fitted in its logarithm


def raveled(start: PyTree, steps: int) -> tuple[Array, Callable]:
    """The start's numbers in a row, and how they are put back."""
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    for each in jax.tree.leaves(start):
        if not isinstance(each, jax.Array | np.ndarray | np.generic | float | int) or isinstance(each, bool):
            raise TypeError(f"the start must be arrays and numbers, in a pytree, got a {type(each).__name__}")
    start = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), start)
    first, unravel = ravel_pytree(start)
    if not first.size or not np.isfinite(first).all():
        raise ValueError(f"the start must be finite numbers, at least one, got {first.size}")
    return first, unravel


def bound(bound: PyTree, start: PyTree, none: float) -> np.ndarray:
    """A bound of each number, from one for all, a pytree like the start, or None."""
    if bound is None:
        bound = none
    whole = jax.tree.structure(start)
    if jax.tree.structure(bound) == whole or not jax.tree_util.all_leaves([bound]):
        if jax.tree.structure(bound) != whole:
            raise ValueError(f"bounds must be one number, or made like the start, {whole}")
        rows = zip(jax.tree.leaves(bound), jax.tree.leaves(start), strict=True)
        parts = [np.broadcast_to(np.asarray(b, float), np.shape(x)).ravel() for b, x in rows]
        return np.concatenate(parts)
    return np.full(sum(np.size(x) for x in jax.tree.leaves(start)), float(bound))


def check(first: Array, low: np.ndarray, high: np.ndarray) -> None:
    """Refuses starts outside their bounds, as these are in the start's precision."""
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


def freed(first: Array, low: np.ndarray, high: np.ndarray) -> tuple[Array, Callable]:
    """Numbers without bounds that stand for those with, and the way back.

    Between two bounds x is a sine, beyond one a hyperbola, which a long step cannot leave for good, as it can logits.

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

    return jnp.asarray(free, first.dtype), bounded
