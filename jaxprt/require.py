"""Checks of arguments where they enter the package, with errors that name what was required and what came.

Values inside `jax.jit`, `jax.vmap` or `jax.grad` are not known while Python runs: these checks let them pass. There a
NaN reaches every vertex that reads it.
"""

import functools
import inspect
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.core import Tracer

Function = TypeVar("Function", bound=Callable)


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


def position(name: str, value: Any, *, each: int | None = None) -> None:
    """Refuses what is not one finite position. Shapes are known inside `jax.jit` too.

    Args:
        name: What the value is, for the message: "the eye".
        value: An array or a list.
        each: A number of points for each of which there may be a position of its own.

    Raises:
        ValueError: It has not three values in one row, or in one row for each point, or some are not finite.
    """
    if np.shape(value) not in ((3,), (each, 3)):
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


def within(name: str, value: Any, low: int, high: int) -> None:
    """Refuses arrays with whole numbers outside a range.

    Args:
        name: What the numbers are, for the message: "the texels".
        value: The array.
        low: The least that is allowed.
        high: The most that is allowed.

    Raises:
        ValueError: Some numbers are outside the range; says how many, and where the first one is.
    """
    if not isinstance(value, Tracer):
        known = np.asarray(value)
        _require(name, f"between {low} and {high}", known, np.asarray((known >= low) & (known <= high)))


def length(name: str, value: Any, count: int) -> None:
    """Refuses an array with another number of rows.

    Args:
        name: What the array is, for the message: "the light's coefficients".
        value: The array.
        count: The number of rows that it must have.

    Raises:
        ValueError: The array has another number of rows.
    """
    if value.shape[0] != count:
        raise ValueError(f"{name} must be {count}, got {value.shape[0]}")


def memory(what: str, needed: int, advice: str, *, in_files: bool = False) -> None:
    """Refuses work whose result does not fit into the memory of the device, or of this machine, before it begins.

    What is free on this machine is Linux's MemAvailable, and what a limit of the process's group leaves; elsewhere
    nothing is refused.

    Args:
        what: What takes the memory, for the message: "transfer matrices of degree 14 for 36,000 vertices".
        needed: Its bytes.
        advice: What takes less.
        in_files: Whether it stays in files that are mapped. Where JAX computes on the processor that is a warning.

    Raises:
        MemoryError: It does not fit; says how much is needed, how much is free, and what to do.
    """
    free = available_memory()
    if free is None or needed <= free:
        return
    size = f"{what} take {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free"
    if not in_files or jax.devices()[0].platform != "cpu":
        raise MemoryError(f"{size}; {advice}")
    warnings.warn(f"{size}: they stay in files, and each new light reads all of these; or {advice}", stacklevel=4)


def available_memory() -> int | None:
    """Bytes that an array may take where JAX puts it; None where that is not known."""
    free = [_host_memory()]
    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" in stats:
            free.append(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    known = [each for each in free if each is not None]
    return min(known) if known else None


def _host_memory() -> int | None:
    """Bytes that are free on this machine for this process."""
    try:
        with open("/proc/meminfo") as file:
            lines = dict(line.split(":", 1) for line in file)
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    try:
        with open("/sys/fs/cgroup/memory.max") as limit, open("/sys/fs/cgroup/memory.current") as used:
            return min(free, int(limit.read()) - int(used.read()))
    except (OSError, ValueError):  # No group, or one without a limit.
        return free


def kind(name: str, value: Any, *wanted: type, source: str) -> None:
    """Refuses objects of other classes than those wanted.

    Args:
        name: What the value is, for the message: "the light".
        value: The object.
        wanted: The classes.
        source: The function that makes one.

    Raises:
        TypeError: The object is of another class.
    """
    if not isinstance(value, wanted):
        names = " or ".join(each.__name__ for each in wanted)
        raise TypeError(f"{name} must be of class {names}, which {source} makes, got {_described(value)}")


def array(name: str, value: Any, *axes: str, source: str = "") -> None:
    """Refuses what is no array, or has other axes.

    Args:
        name: What the value is, for the message: "the eye".
        value: The array.
        axes: Each way in which its axes may be, as "v 3": letters stand for any size.
        source: The function that makes one, if there is one.

    Raises:
        TypeError: The value is no array.
        ValueError: It has another number of axes, or a size that is not the one required.
    """
    shape = value.shape if isinstance(value, jax.Array | np.ndarray) else None
    if shape is not None and any(_fits(shape, each.split()) for each in axes):
        return
    required = " or ".join(f"[{', '.join(each.split())}]" for each in axes)
    made = f", which {source} makes" if source else ""
    message = f"{name} must be an array {required}{made}, got {_described(value)}"
    raise TypeError(message) if shape is None else ValueError(message)


def arguments(**check: Callable[[Any], None]) -> Callable[[Function], Function]:
    """Decorates a function with checks of its arguments, which run before it: outside `jax.jit` if they come first.

        @require.arguments(eye=partial(require.finite, "the eye"))
        @jax.jit
        def radiance(..., eye): ...

    Args:
        check: For the name of each argument a function that raises.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def checked(*argument, **named):
            given = signature.bind_partial(*argument, **named).arguments
            for name, each in check.items():
                if name in given:
                    each(given[name])
            return function(*argument, **named)

        return cast(Function, checked)

    return decorate


def _fits(shape: tuple[int, ...], axes: list[str]) -> bool:
    """Whether a shape has the axes, and the sizes of those that are numbers."""
    return len(shape) == len(axes) and all(
        not want.isdigit() or int(want) == got for want, got in zip(axes, shape, strict=True)
    )


def _described(value: Any) -> str:
    if isinstance(value, jax.Array | np.ndarray):
        return f"an array of shape {list(value.shape)}"
    return f"one of class {type(value).__name__}"
