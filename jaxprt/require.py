"""Checks of arguments at the package's interface. Errors state what was required and what was given.

The `name` of a value is its description for messages, such as "the eye", and the `source` of an object the name of the
function that makes such objects.

Values inside `jax.jit`, `jax.vmap` or `jax.grad` are not known while Python runs, so these checks let them pass. A NaN
then reaches every vertex that depends on it.
"""

import functools
import inspect
import os
import pathlib
import warnings
from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

Function = TypeVar("Function", bound=Callable)
Kind = TypeVar("Kind")

LARGEST = 1e32  # magnitude of numbers that enter: sums over all texels and small factors fit into float32
_ORTHOGONAL = 1e-4  # deviation of M M^T from the identity, due to rounding
_MOST = 2**31 - 1  # largest index of 32 bits
_AXES = 64  # most axes of an array in NumPy


def real(name: str, value: object) -> None:
    """Refuses anything but real numbers: text, booleans, complex numbers, masked arrays, None and other objects.

    Numbers, nested lists of them, NumPy and JAX arrays pass. The type is checked inside `jax.jit` too.
    """
    wrong = unreal(value)
    if wrong:
        raise TypeError(f"{name} must be real numbers, got {wrong}")


def unreal(value: object) -> str:
    """What a value is that does not consist of real numbers; empty if it does."""
    if isinstance(value, np.ma.MaskedArray):
        return "a masked array: fill its masked values first"
    if isinstance(value, str | bytes):
        return f"the text {value[:40]!r}"
    known = _array_of(value)
    if known is None:
        return f"{_describe(value)}, which is not an array of numbers"
    if jnp.issubdtype(known.dtype, jnp.integer) or jnp.issubdtype(known.dtype, jnp.floating):
        return ""
    if known.dtype == object:
        return "an integer of more than 64 bits" if isinstance(value, int) else _describe(value)
    names = {"b": "booleans", "c": "complex numbers", "U": "text", "S": "text"}
    return names.get(getattr(known.dtype, "kind", ""), f"values of type {known.dtype}")


def _array_of(value: object) -> Any:
    """Converts a value to an array of NumPy, or of JAX for lists of values inside `jax.jit`; None if it cannot."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return value
    for convert in (np.asarray, jnp.asarray):  # NumPy cannot convert lists of values inside `jax.jit`.
        try:
            return convert(value)
        except (TypeError, ValueError, OverflowError):
            if _is_too_deep(value):  # JAX would recurse until Python's stack is spent for good.
                break
    return None


def _is_too_deep(value: object) -> bool:
    """Whether lists hold themselves, or are nested more deeply than arrays have axes."""
    level = [value]
    for _ in range(_AXES + 1):
        level = list({id(row): row for rows in level if isinstance(rows, list | tuple) for row in rows}.values())
    return bool(level)


def floating(value: object, *, dtype: Any = None) -> Any:
    """Real numbers as a JAX array of floating point, for the fields of classes.

    Half precision becomes float32, because sums over the sphere overflow in it. float64 stays only where the caller has
    enabled it. Anything but real numbers is returned unchanged: the check of the class refuses it by the field's name.

    Args:
        value: A number, a list or an array.
        dtype: Type of the result; None for the value's own, or the default one for integers.
    """
    if unreal(value):
        return value
    known = _array_of(value)
    if dtype is None:
        dtype = _float_type(known.dtype)
    if isinstance(known, jax.Array):
        return known if known.dtype == dtype else known.astype(dtype)
    with np.errstate(over="ignore"):  # The check of the class refuses infinity.
        known = known.astype(dtype)
    with jax.ensure_compile_time_eval():  # What is known stays known while JAX traces a function.
        return jax.device_put(known)  # jnp.asarray would be a program for each shape.


def repeated(value: object, length: int) -> Any:
    """The result of `floating` in the default type, with one number alone repeated."""
    value = floating(value, dtype=jnp.result_type(float))
    return jnp.broadcast_to(value, (length,)) if isinstance(value, jax.Array) and value.ndim == 0 else value


def _float_type(dtype: Any) -> Any:
    """The type of floating point for numbers of a type."""
    if not jnp.issubdtype(dtype, jnp.floating):
        return jnp.result_type(float)
    wide = np.float64 if dtype.itemsize > 4 else np.float32
    return jax.dtypes.canonicalize_dtype(wide)


def finite(name: str, value: object) -> None:
    """Refuses anything but real numbers, and refuses NaN, infinity and numbers above 1e32 in magnitude.

    Sums of products of larger numbers overflow in float32, and differences of infinities are NaN.
    """
    real(name, value)
    known = _array_of(value)
    if isinstance(known, Tracer):
        return
    known = np.asarray(known)
    if known.dtype.kind != "f" or known.dtype.itemsize < 4:  # In float16 the limit is infinite.
        known = known.astype(np.float64)
    if np.all(np.abs(known) <= LARGEST):  # false for NaN
        return
    _require(name, "finite", known, np.isfinite)
    _require(name, f"at most {LARGEST:g} in magnitude", known, lambda known: np.abs(known) <= LARGEST)


def at_least(name: str, value: object, least: float, *, slack: float = 0.0) -> None:
    """Refuses what `finite` refuses, and values below a bound.

    `slack` is a tolerance for rounding errors.
    """
    finite(name, value)
    _require(name, f"at least {least:g}", value, lambda known: known >= least - slack)


def within(name: str, value: object, low: int, high: int) -> None:
    """Refuses arrays with integers outside a range."""
    real(name, value)
    _require(name, f"between {low} and {high}", value, lambda known: (known >= low) & (known <= high))


def _require(name: str, what: str, value: object, fits: Callable[[np.ndarray], Any]) -> None:
    """Refuses numbers of which some do not fit, unless JAX traces them."""
    known = _array_of(value)
    if isinstance(known, Tracer):
        return
    known = np.asarray(known)
    wrong = np.argwhere(~np.asarray(fits(known)))
    if not len(wrong):
        return
    where = f", first at {tuple(map(int, wrong[0]))}" if known.ndim else ""
    raise ValueError(
        f"{name} must be {what}, got {len(wrong)} of {known.size} values that are not{where}: {known[tuple(wrong[0])]}"
    )


def position(name: str, value: object, *, points: int | None = None) -> Array:
    """Refuses values that are not a finite position. The shape is checked inside `jax.jit` too.

    Args:
        name: Description of the value.
        value: An array or a list.
        points: Number of points if the value may be one position for each point; None if it must be a single position.

    Returns:
        The position as an array of floating point.

    Raises:
        TypeError: The value does not consist of real numbers.
        ValueError: The shape is neither [3] nor, with `points`, [points 3], or some values are not finite.
    """
    real(name, value)
    shape = np.shape(_array_of(value))
    if shape not in ((3,), (points, 3)):
        raise ValueError(f"{name} must be one position, [3], got an array of shape {list(shape)}")
    finite(name, value)
    return floating(value)


def colors(name: str, radiance: Any) -> None:
    """Refuses light that has neither one color nor three, as materials of scenes have, by ValueError."""
    if np.shape(radiance)[-1:] not in ((1,), (3,)):
        raise ValueError(f"{name} must have 1 or 3 colors, got {np.shape(radiance)[-1]}")


def rotation(name: str, value: object) -> Array:
    """Refuses anything but a proper rotation matrix [3 3]. Inside `jax.jit` only its shape is checked.

    Returns:
        The matrix as an array of floating point.

    Raises:
        TypeError: The value does not consist of real numbers.
        ValueError: The shape is another one, or the matrix mirrors, scales or shears.
    """
    real(name, value)
    known = _array_of(value)
    fits = known.shape == (3, 3)
    if fits and not isinstance(known, Tracer):
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = np.asarray(known, np.float64)
            fits = np.allclose(matrix @ matrix.T, np.eye(3), rtol=0, atol=_ORTHOGONAL) and np.linalg.det(matrix) > 0
    if not fits:
        got = known.tolist() if np.ndim(known) < 3 and not isinstance(known, Tracer) else _describe(known)
        raise ValueError(f"{name} must be a 3 x 3 rotation matrix, got {got}")
    return floating(value)


def number(name: str, value: Any, low: float, *, high: float = LARGEST, above: bool = False) -> None:
    """Refuses anything but one real number (TypeError) within a range (ValueError); with `above`, not its lower end."""
    real(name, value)
    if np.ndim(_array_of(value)):
        raise TypeError(f"{name} must be one number, got {_describe(value)}")
    if isinstance(value, Tracer):
        return
    if not np.isfinite(_array_of(value)):
        raise ValueError(f"{name} must be finite, got {value}")
    if not low <= float(value) <= high or (above and float(value) == low):
        raise ValueError(f"{name} must be {'above' if above else 'at least'} {low:g} and at most {high:g}, got {value}")


def whole(name: str, value: object) -> int:
    """The value if it is a whole number; others are refused by TypeError."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{name} must be a whole number, got {shown(value)}")
    return int(value)


def count(name: str, value: object, *, least: int = 0, most: int = _MOST) -> None:
    """Refuses anything but a whole number (TypeError) within a range (ValueError)."""
    size = whole(name, value)
    if not least <= size <= most:
        bound = f"at least {least}" if size < least else f"at most {most}"
        bound = bound if most == _MOST else f"between {least} and {most}"
        raise ValueError(f"{name} must be {bound}, got {value}")


def path(name: str, value: object) -> None:
    """Refuses anything but the name of a file or folder, as text or a path, by TypeError."""
    if not isinstance(value, str | os.PathLike):
        raise TypeError(f"{name} must be a path, as text or pathlib.Path, got {shown(value)}")
    if isinstance(os.fspath(value), bytes) or not os.fspath(value) or "\0" in os.fspath(value):
        raise ValueError(f"{name} must be a path, got {shown(value)}")


def executor(value: object) -> None:
    """Refuses anything but None and objects with the method `submit` of `concurrent.futures.Executor`, by TypeError."""
    if value is not None and not callable(getattr(value, "submit", None)):
        raise TypeError(
            f"executor must be None or an executor such as concurrent.futures.ProcessPoolExecutor, got {shown(value)}"
        )


def function(name: str, value: object) -> None:
    """Refuses anything but None and a function, by TypeError."""
    if value is not None and not callable(value):
        raise TypeError(f"{name} must be a function or None, got {shown(value)}")


def length(name: str, value: Any, count: int) -> None:
    """Refuses an array with another number of rows, which have the name."""
    shape = np.shape(value)
    if not shape or shape[0] != count:
        raise ValueError(f"the number of {name} must be {count}, got {shape[0] if shape else 'one number'}")


def memory(what: str, needed: int, advice: str, *, in_files: bool = False) -> None:
    """Refuses a computation, before it starts, whose result does not fit into the memory of the device or machine.

    On Linux the free memory of this machine is MemAvailable, limited by the process's control group. On other systems
    it is not known, and nothing is refused.

    Args:
        what: Description of the data for the message: "transfer matrices of degree 14 for 36,000 vertices".
        needed: Required bytes.
        advice: How to reduce the required memory, for the message.
        in_files: Whether the result is in memory-mapped files. If JAX computes on the CPU, a lack of memory is then
            only a warning.

    Raises:
        MemoryError: The result does not fit. The message states how much is needed, how much is free, and what to do.
    """
    free = available_memory()
    if free is None or needed <= free:
        return
    size = f"{what} take {needed / 1e9:.1f} GB, and {free / 1e9:.1f} GB are free"
    if not in_files or jax.devices()[0].platform != "cpu":
        raise MemoryError(f"{size}; {advice}")
    warnings.warn(
        f"{size}: they stay in files, and each new light reads all of them. To avoid this, {advice}", stacklevel=4
    )


def available_memory() -> int | None:
    """Bytes that are free for arrays on JAX's default device; None if not known."""
    free = [_host_memory()]
    device = jax.devices()[0]
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        if "bytes_limit" in stats:
            free.append(stats["bytes_limit"] - stats.get("bytes_in_use", 0))
    known = [bytes_free for bytes_free in free if bytes_free is not None]
    return min(known) if known else None


def _host_memory() -> int | None:
    """Bytes of memory that are free on this machine for this process; None if not known."""
    try:
        with open("/proc/meminfo") as file:
            lines = dict(line.split(":", 1) for line in file)
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    try:
        group = pathlib.Path("/sys/fs/cgroup")
        most, used = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        stated = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return min(free, most - used + int(stated.get("inactive_file", 0)))  # cached files that can be dropped
    except (OSError, ValueError):  # no control group, or one without a limit
        return free


def kind(name: str, value: object, *wanted: type[Kind], source: str) -> Kind:
    """The value if it is of one of the wanted classes; others are refused by TypeError."""
    if isinstance(value, wanted):
        return value
    names = " or ".join(kind.__name__ for kind in wanted)
    raise TypeError(f"{name} must be of class {names}, which {source} makes, got {_describe(value)}")


def array(name: str, value: object, *axes: str, source: str = "") -> None:
    """Refuses anything but arrays (TypeError) of an allowed shape (ValueError).

    `axes` are the shapes, such as "v 3", in which letters stand for any size.
    """
    shape = value.shape if isinstance(value, jax.Array | np.ndarray) else None
    if shape is not None and any(_fits(shape, axis.split()) for axis in axes):
        return
    required = " or ".join(f"[{', '.join(axis.split())}]" for axis in axes)
    advice = f", which {source} makes" if source else ""
    message = f"{name} must be an array {required}{advice}, got {_describe(value)}"
    raise TypeError(message) if shape is None else ValueError(message)


def arguments(**check: Callable[[Any], Any]) -> Callable[[Function], Function]:
    """Decorates a function with checks of its arguments. As the outermost decorator, the checks run outside `jax.jit`.

        @require.arguments(eye=partial(require.finite, "the eye"))
        @jax.jit
        def radiance(..., eye): ...

    Args:
        check: A function for each argument, by its name, that raises an error if the argument is wrong. If it returns a
            value, the decorated function is called with this value.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*argument, **named):
            bound = signature.bind_partial(*argument, **named)
            for name, door in check.items():
                if name in bound.arguments:
                    converted = door(bound.arguments[name])
                    if converted is not None:
                        bound.arguments[name] = converted
            return function(*bound.args, **bound.kwargs)

        return cast(Function, call)

    return decorate


def _fits(shape: tuple[int, ...], axes: list[str]) -> bool:
    """Whether a shape has the given number of axes, and the sizes of those axes that are numbers."""
    return len(shape) == len(axes) and all(
        not want.isdigit() or int(want) == got for want, got in zip(axes, shape, strict=True)
    )


def _describe(value: object) -> str:
    if isinstance(value, jax.Array | np.ndarray):
        return f"an array of shape {list(value.shape)}"
    return f"one of class {type(value).__name__}"


def shown(value: object) -> str:
    """A value in at most 40 letters, and its class."""
    if isinstance(value, jax.Array | np.ndarray):
        return _describe(value)
    try:
        text = repr(value)
    except RecursionError:
        text = "lists or objects that are nested too deeply"
    return f"{text if len(text) <= 40 else text[:37] + '...'} of class {type(value).__name__}"
