"""Least-squares solvers. This is the only module that imports jaxopt."""

import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.compile import jit

_INSIDE = 0.01  # of a range: how far from a bound a start is moved
_AT = 1e-4  # of a range: how close to a bound a number is at it
_LOG = 100.0  # ratio of bounds above which a number is fitted in its logarithm
DENSE = 512  # numbers whose derivatives are held, all of them
_KNOWN = 1e-4  # of the largest singular value: what has less cannot be told from rounding
_UNKNOWN = 1e-3  # of a number's square outside what is known, that makes it unknown
_BLOCKS = 32  # of pixels
_TINY = 1e-30
_ROUNDED = 1e-9  # of squared singular values
_LINEAR = 1e-3  # of the start's residual, that a linear function may be off
_SETTLED = 1e-6  # relative decrease of the squared residual
_MINOR = 1e-3  # that a refused step promised
_EXACT = 1e-6  # residual that is rounding
_PATIENT = 3  # steps without more than that
_REFUSED = 8  # steps that would only have made it worse; each next is 2, 4, 8, ... times shorter
_LEAST = 1e-3  # of the largest squared derivative: others count as that
_PROBES = 16  # random combinations of pixels, for mean squares of derivatives
_POWER = 20  # steps to the largest curvature
_SAFETY = 1.1


def ravel(start: PyTree, steps: int) -> tuple[Array, Callable]:
    """The numbers of the start as one array, and the function that restores its structure."""
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer):
        raise TypeError(f"steps must be a whole number, got {steps!r}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, got {steps}")
    outside(start)
    for leaf in jax.tree.leaves(start):
        if not isinstance(leaf, jax.Array | np.ndarray | np.generic | float | int) or isinstance(leaf, bool):
            raise TypeError(f"the start must be arrays and numbers, in a pytree, got a {type(leaf).__name__}")
    start = jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), start)
    first, unravel = ravel_pytree(start)
    if not first.size:
        raise ValueError("the start must hold at least one number, got none")
    require.finite("the start, its numbers in a row,", first)
    return first, unravel


def outside(*values: PyTree) -> None:
    """Refuses a call inside `jax.jit` or another transformation, where values are not known."""
    traced = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(values))
    if traced or isinstance(jnp.zeros(()) + 0, Tracer):
        raise TypeError(
            "a fit needs concrete values: call it outside of jax.jit, jax.vmap and jax.grad, got traced arrays"
        )


def bound(bound: PyTree, start: PyTree, none: float) -> np.ndarray:
    """The bound of each number, given as one number, a pytree like the start, or None, which may replace a leaf."""
    outside(bound)
    (bounds, form), (values, whole) = (jax.tree.flatten(tree, is_leaf=lambda x: x is None) for tree in (bound, start))
    if form != whole:
        if not jax.tree_util.treedef_is_leaf(form):
            raise ValueError(f"bounds must be one number, or made like the start, {whole}, got {form}")
        bounds = bounds * len(values)
    parts = []
    for limit, value in zip(bounds, values, strict=True):
        shape = np.shape(value) if value is not None else (0,)
        number = np.asarray(none if limit is None else limit)
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


def unbound(first: Array, low: np.ndarray, high: np.ndarray) -> tuple[Array, Callable, Callable]:
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


class Fit(NamedTuple):
    """The result of a fit.

    Attributes:
        value: The light or material, with the structure of the start. What the pictures do not determine keeps its
            starting value.
        residual: Relative L2 difference from the pictures, at the start and after each step.
        deviation: Standard deviation of each parameter, estimated from how much blocks of pixels disagree about it. It
            is infinite for parameters that the pictures do not determine and for parameters at a bound. The deviations
            of the others assume that those stay fixed. Deviations do not reveal a wrong model; the residual does. With
            more than 512 parameters they are lower bounds, because a change of one may be compensated by others.
        determined: Orthonormal combinations of parameters that the pictures determine, in the order of `ravel_pytree`;
            for a material, combinations of its unbounded variables. None with more than 512 parameters.
    """

    value: PyTree
    residual: np.ndarray
    deviation: PyTree
    determined: Float[np.ndarray, "r n"] | None

    @property
    def rank(self) -> int | None:
        """Number of combinations of parameters that the pictures determine."""
        return None if self.determined is None else len(self.determined)


def _with_slopes(function: Callable) -> Callable[[Array], tuple[Float[Array, " m"], Float[Array, "n m"]]]:
    """A function and its Jacobian, column by column from one linearization, so that no batch is held in memory."""

    def both(x):
        value, along = jax.linearize(function, x)
        return value, jax.lax.map(along, jnp.eye(len(x), dtype=x.dtype))

    return jit(both)


@eqx.filter_jit
def _slopes(function: Callable, x: Array) -> tuple[Float[Array, " m"], Float[Array, "n m"]]:
    """`_with_slopes` of a function that is a pytree: the next function with the same shapes needs no compiling."""
    return _with_slopes(function)(x)


def _determined_directions(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions whose singular values are above rounding, and these values."""
    square, axis = np.linalg.eigh(rows @ rows.T)
    value = np.sqrt(np.maximum(square, 0))
    known = value > _KNOWN * max(value[-1], np.finfo(np.float32).tiny)
    return axis[:, known], value[known]


def _scores(axis: np.ndarray, value: np.ndarray, rows: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Standard error of the solution along each direction, by leaving out blocks of neighboring pixels."""
    # Noise averages out between pixels. The residual of a wrong model is correlated between neighbors, and averages out
    # between blocks at best.
    along, count = axis.T @ rows, min(_BLOCKS, len(left))
    whole, blocks = np.diag(value**2), []
    for part in np.array_split(np.arange(len(left)), count):
        local = along[:, part]
        without = whole * (1 + _ROUNDED) - local @ local.T  # Never singular, also where one block determines all.
        # The block moves the directions by (S^2 - J_b^T J_b)^-1 J_b^T r_b, with singular values S, when it is left out:
        # the jackknife of Efron 1982; Bell and McCaffrey 2002 for clusters that the fit has partly followed.
        blocks.append(np.linalg.solve(without, local @ left[part]))
    moved = np.stack(blocks, 1) * np.sqrt((count - 1) / count)
    least = np.linalg.norm(left) / np.sqrt(max(1, len(left) - len(value))) / value  # of independent noise
    size = np.linalg.norm(moved, axis=1)
    # So many blocks determine a deviation to one part in sqrt(2 blocks): three of these are no sign of clusters.
    size, known = np.where(size > least * (1 + 3 / np.sqrt(2 * count)), size, least), size
    return moved * (size / np.maximum(known, _TINY))[:, None]


def _deviation(axis: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Standard deviation of each parameter; infinite outside the span of the directions."""
    deviation = np.linalg.norm(axis @ scores, axis=1)
    return np.where(1 - np.sum(axis**2, 1) > _UNKNOWN, np.inf, deviation)


def _finite(*arrays: Array) -> None:
    outside(arrays)
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError(
            "the radiance at the start (or prior), and its derivatives, must be finite, got NaN or infinities"
        )


def at_once(function: Callable, first: Array, unravel: Callable, error: float) -> Fit:
    """Solves a linear problem by singular values. What is not determined keeps its starting value.

    Directions are left out so that the deviations of the kept ones together stay below `error` times the solution's
    norm. Truncation as in Hansen 1998, "Rank-deficient and discrete ill-posed problems".
    """
    r, slope = _slopes(function, first)
    _finite(r, slope)
    before, rows = np.asarray(r, np.float64), np.asarray(slope, np.float64)
    axis, value = _determined_directions(rows)
    part = -(axis.T @ (rows @ before)) / value**2
    # What is determined of a direction does not depend on the others. The first pass leaves out those that only follow
    # what the numbers cannot explain, the second judges by what then remains; more would judge by light left out.
    for _ in range(2):
        wrong = np.linalg.norm(_scores(axis, value, rows, before + axis @ part @ rows), axis=1)
        best = np.argsort(wrong)
        good = np.cumsum(wrong[best] ** 2) <= error**2 * np.cumsum(part[best] ** 2)
        keep = best[: np.max(np.flatnonzero(good), initial=-1) + 1]
        axis, value, part = axis[:, keep], value[keep], part[keep]
    scores = _scores(axis, value, rows, before + axis @ part @ rows)
    solution = first + jnp.asarray(axis @ part, first.dtype)
    left, expected = float(np.linalg.norm(_slopes(function, solution)[0])), np.linalg.norm(before + axis @ part @ rows)
    if not abs(left - expected) < _LINEAR * np.linalg.norm(before):
        raise ValueError(
            f"the radiance must be linear in the light: the residual should be {expected:.3g}, and is {left:.3g}; "
            "other functions can be fitted by material"
        )
    deviation = jnp.asarray(_deviation(axis, scores), first.dtype)
    return Fit(unravel(solution), np.array([np.linalg.norm(before), left]), unravel(deviation), axis.T)


_product = jit(jnp.vdot)


@functools.cache
def _jaxopt() -> Any:
    """The package jaxopt, imported at first use, because the import is slow."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # jaxopt says that it is not developed further.
        import jaxopt
    return jaxopt


@functools.cache
def _marquardt_steps() -> tuple[Callable, Callable, Callable]:
    """Programs for the first state, the next state and one step of jaxopt's Levenberg-Marquardt method."""
    solver = _jaxopt().LevenbergMarquardt(
        # Residual and Jacobian are arguments of these programs, so that fits of the same shapes share them.
        lambda u, residual, jac: residual,
        materialize_jac=True,
        solver="cholesky",
        damping_parameter=1e-3,
        implicit_diff=False,
        jit=False,
    )
    # jaxopt 0.8.5 does not read its argument jac_fun where it holds derivatives.
    solver._jac_fun = lambda u, residual, jac: jac
    direction = jit(lambda free, state: solver.update(free, state, state.residual, state.jac).state.delta)
    return jit(solver.init_state), jit(solver.update), direction


def marquardt(
    function: Callable,
    free: Array,
    bounded: Callable,
    pinned: Callable,
    unravel: Callable,
    steps: int,
    *,
    held: int = 0,
) -> Fit:
    """Levenberg-Marquardt steps in unbounded variables. After convergence the residuals repeat the last one."""
    evaluate = _with_slopes(function)

    def both(place):
        residual, slope = evaluate(place)
        return residual, slope.T

    begin, update, direction = _marquardt_steps()
    state = begin(free, *both(free))
    _finite(state.residual, state.jac)
    history, still, refused = [float(jnp.linalg.norm(state.residual))], 0, 0
    for _ in range(steps if np.any(np.asarray(state.jac)) else 0):  # A flat objective has no steps.
        moved, tried = update(free, state, *both(free + direction(free, state)))
        if not all(np.isfinite(values).all() for values in (moved, tried.residual, tried.jac)):
            grow = state.increase_factor
            tried = state._replace(
                damping_factor=state.damping_factor * grow, increase_factor=2 * grow, delta=tried.delta
            )
            moved = free
        refused = refused + 1 if np.array_equal(moved, free) else 0  # Too long a step: the next is shorter.
        promised = jnp.abs(_product(tried.delta, state.damping_factor * tried.delta - state.gradient))
        free, state = moved, tried
        history.append(float(jnp.linalg.norm(state.residual)))
        brought, least = (promised, _MINOR) if refused else (history[-2] ** 2 - history[-1] ** 2, _SETTLED)
        still = still + 1 if brought <= least * history[-2] ** 2 else still if refused else 0
        if still == _PATIENT or refused == _REFUSED or history[-1] < _EXACT:
            break
    rows, left = np.asarray(state.jac, np.float64).T, np.asarray(state.residual, np.float64)
    rows = np.where(pinned(free)[:, None], 0, rows)
    axis, value = _determined_directions(rows)
    deviation = _deviation(axis, _scores(axis, value, rows, left))
    determined = axis if not held else _determined_directions(rows[:, :-held])[0]
    value, rate = jit(lambda u: jax.jvp(bounded, (u,), (jnp.ones_like(u),)))(free)
    known = np.isfinite(deviation)
    deviation = np.where(known, np.where(known, deviation, 0) * np.abs(rate), np.inf)
    return Fit(unravel(value), np.array(history), unravel(jnp.asarray(deviation, free.dtype)), determined.T)


def _units(back: Callable, count: int, dtype) -> tuple[Array, Array]:
    """Squared norms of the Jacobian's columns, estimated by random signs, and the parameters' units: inverse roots."""
    probe = jax.random.rademacher(jax.random.key(0), (_PROBES, count), dtype)
    square = jnp.mean(jax.lax.map(lambda vector: back(vector)[0] ** 2, probe), 0)
    whole = jnp.max(square)
    return square, 1 / jnp.sqrt(square + _LEAST * jnp.where(whole > 0, whole, 1))


def _step_length(curved: Callable, x: Array) -> Array:
    """A safe step length: the inverse of the largest eigenvalue of the curvature, by power iteration."""
    tiny = jnp.finfo(x.dtype).tiny

    def step(_, towards):
        return curved(towards / jnp.maximum(jnp.linalg.norm(towards), tiny))

    towards = jax.random.normal(jax.random.key(1), x.shape, x.dtype)
    largest = jnp.linalg.norm(jax.lax.fori_loop(0, _POWER, step, towards))
    return 1 / (_SAFETY * jnp.maximum(largest, tiny))


def _first_order(value: Callable, bounded: bool, length, steps: int) -> Any:
    """Makes a solver of jaxopt: projected gradients with fixed steps within bounds, L-BFGS with line search without."""
    options = {"maxiter": steps, "implicit_diff": False}
    if not bounded:
        return _jaxopt().LBFGS(value, **options)
    box = _jaxopt().projection.projection_box
    return _jaxopt().ProjectedGradient(value, box, stepsize=lambda _: length, **options)


def descend(function: Callable, first: Array, unravel: Callable, bound, prior: Callable | None, steps: int) -> Fit:
    """First-order descent, with each parameter scaled by how much it changes the residual.

    Momentum is reset where the objective rises.

    Reference: O'Donoghue and Candes 2015, "Adaptive restart for accelerated gradient schemes".
    """
    count = len(jax.eval_shape(function, first))
    bounded = any(np.isfinite(side).any() for side in bound)

    def extra(x):
        return jnp.zeros((), x.dtype) if prior is None else prior(unravel(x))

    def both(left, x):
        """The residual's norm, and the objective."""
        return jnp.linalg.norm(left), jnp.sum(left**2) / 2 + extra(x)

    def solver(size, length) -> Any:
        return _first_order(lambda y: both(function(size * y), size * y)[1], bounded, length, steps)

    @jit
    def begin(x, bound):
        left, along = jax.linearize(function, x)
        back = jax.linear_transpose(along, x)
        square, size = _units(back, count, x.dtype)
        limit = [tuple(side / size for side in bound)] if bounded else []

        def curved(towards):
            bent = size * back(along(size * towards))[0]
            slope = jax.grad(lambda y: extra(size * y))
            return bent + jax.jvp(slope, (x / size,), (towards,))[1]

        length = _step_length(curved, x) if bounded else 0.0
        state = solver(size, length).init_state(x / size, *limit)
        return square, (size, length), limit, x / size, state, both(left, x)

    @jit
    def update(y, state, limit, scales):
        moved, state = solver(*scales).update(y, state, *limit)
        return moved, state, both(function(scales[0] * moved), scales[0] * moved)

    bound = tuple(jnp.asarray(side, first.dtype) for side in bound)
    square, scales, limit, y, start, (norm, now) = begin(first, bound)
    _finite(square, norm, now)
    state = start
    history, last, still = [float(norm)], float(now), 0
    for step in range(steps):
        moved, state, (norm, now) = update(y, state, limit, scales)
        if not np.isfinite(moved).all():
            _finite(*([] if step else [moved]))  # The prior's derivatives: the others are checked.
            break
        norm, now = float(norm), float(now)
        still = still + 1 if last - now <= _SETTLED * abs(last) else 0
        if bounded and now > last:  # Momentum went too far: it starts anew from the place before.
            state = start._replace(velocity=y)
            norm, now, moved = history[-1], last, y
        y, last = moved, now
        history.append(norm)
        if still == _PATIENT:
            break
    noise = history[-1] ** 2 / max(1, count)
    deviation = _deviations(np.asarray(square), np.asarray(y), limit, noise)
    return Fit(unravel(scales[0] * y), np.array(history), unravel(jnp.asarray(deviation, first.dtype)), None)


def _deviations(square: np.ndarray, place: np.ndarray, limit: Sequence, noise: float) -> np.ndarray:
    """Deviation of each parameter; infinite where the residual hardly depends on it, and at its bounds."""
    known = square > _KNOWN**2 * square.max()
    for low, high in limit:
        known &= (np.asarray(low) < place) & (place < np.asarray(high))
    return np.where(known, np.sqrt(noise / np.where(square > 0, square, 1)), np.inf)
