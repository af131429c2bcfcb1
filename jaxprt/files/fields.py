"""Checks of loaded objects: that their fields hold what the annotations of their classes say."""

import collections.abc
import dataclasses
import functools
import inspect
import types
import typing
from typing import Any

import jax
import jaxtyping
import numpy as np

_PLAIN: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (float, int, np.floating, np.integer),
    str: (str,),
}


def names(kind: Any) -> list[str]:
    """Names of the fields of a data class or a named tuple."""
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    return list(kind._fields)


def check(value: Any, *, batched: bool = False) -> None:
    """Refuses an object whose fields do not hold what its class says, and runs the checks of the class.

    Arrays must have the annotated kind of numbers and the annotated axes. Axes of one name have one size in all fields.
    They may be NumPy arrays where the class says JAX. Loading calls no constructors, which run the checks of classes.

    Args:
        value: An object of a data class or a named tuple.
        batched: Whether arrays may have further leading axes; see `holds_models`.

    Raises:
        ValueError: A field holds something else, or a check of the class fails.
    """
    kind = type(value)
    with jaxtyping.jaxtyped("context"):
        for name in names(kind):
            content, hint = getattr(value, name), _hints(kind)[name]
            if not _fits(content, hint, batched):
                raise ValueError(f"{name} of {kind.__name__} must be {_text(hint)}, got {_described(content)}")
    _run_checks(value)


def _run_checks(value: Any) -> None:
    """Calls the checks that constructors of `equinox.Module` call: those of all base classes."""
    for base in type(value).__mro__:
        if "__check_init__" in vars(base):
            try:
                vars(base)["__check_init__"](value)
            except Exception as error:
                raise ValueError(str(error)) from error


def holds_models(kind: type, name: str) -> bool:
    """Whether a field holds any BRDF. Arrays of its model may have further leading axes, of vertices or of a set."""
    hint = _hints(kind)[name]
    several = typing.get_origin(hint) in (tuple, typing.Union, types.UnionType)
    items = typing.get_args(hint) if several else (hint,)
    return any(item is Any or _is_callable(item) for item in items)


@functools.cache
def _hints(kind: type) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _fits(value: Any, hint: Any, batched: bool) -> bool:
    """Whether a value is what an annotation says. Annotations of no simple form allow everything."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is None or hint is type(None):
        return value is None
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option, batched) for option in arguments)
    if _is_callable(hint):
        return callable(value)
    if origin in (tuple, list):
        return isinstance(value, origin) and _items_fit(value, origin, arguments, batched)
    if origin in (dict, collections.abc.Mapping):
        return isinstance(value, dict) and all(_fits(item, arguments[1], batched) for item in value.values())
    if origin is not None or not inspect.isclass(hint) or hint in (Any, jaxtyping.PyTree):
        return True
    if issubclass(hint, jaxtyping.AbstractArray):
        return _array_fits(value, hint, batched)
    if hint in (np.ndarray, jax.Array):
        return isinstance(value, np.ndarray | jax.Array)
    if hint in _PLAIN:
        return isinstance(value, _PLAIN[hint]) and (hint is bool or not isinstance(value, bool | np.bool_))
    return isinstance(value, hint)


def _items_fit(value: Any, origin: type, arguments: tuple, batched: bool) -> bool:
    if origin is list or arguments[1:] == (...,):
        return all(_fits(item, arguments[0], batched) for item in value)
    return len(value) == len(arguments) and all(map(_fits, value, arguments, [batched] * len(value)))


def _array_fits(value: Any, hint: Any, batched: bool) -> bool:
    """Whether an array of JAX or NumPy has the annotated numbers and axes. Plain numbers may stand for axes of none."""
    if isinstance(value, bool | int | float | complex | np.generic):
        value = np.asarray(value)
    if not isinstance(value, np.ndarray | jax.Array):
        return False
    axes = hint.dim_str
    if batched and "*" not in axes and "..." not in axes:
        axes = f"... {axes}"
    return isinstance(value, hint.dtype[type(value) if isinstance(value, np.ndarray) else jax.Array, axes])


def _is_callable(hint: Any) -> bool:
    return collections.abc.Callable in (hint, typing.get_origin(hint))


def _text(hint: Any) -> str:
    if inspect.isclass(hint) and issubclass(hint, jaxtyping.AbstractArray):
        return f"an array {hint.dtype.__name__}[{hint.dim_str}]"
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(map(_text, arguments))
    if origin is tuple:
        return f"a tuple of {', '.join('...' if item is ... else _text(item) for item in arguments)}"
    if hint is type(None):
        return "None"
    return getattr(hint, "__name__", str(hint))


def _described(value: Any) -> str:
    if isinstance(value, np.ndarray | jax.Array):
        return f"an array of {value.dtype} {list(value.shape)}"
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)[:80]
    return f"a {type(value).__name__}"
