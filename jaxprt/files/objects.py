"""Saving, loading and pickling of the package's objects: transports, BRDFs, plans, lights, meshes.

A saved object is a folder with a NumPy file for each array and a JSON description of the object's classes and fields.
It contains no pickle. Loading creates only objects of this package's classes, or of classes that other packages have
registered, and fills their fields; it never calls a function that a file names.

A folder may come from a stranger. Nothing is unpickled, nothing but modules of this package is imported because a file
names it, and only regular files in the folder are read. Whatever differs from what `jaxprt.files.objects.save` writes
is refused.
"""

import collections.abc
import dataclasses
import functools
import importlib
import inspect
import json
import os
import re
import sys
import types
import typing
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
from jax.core import Tracer

from jaxprt import require
from jaxprt.files import arrays, extensions, inputs, outputs
from jaxprt.files.inputs import JsonObject

_PLAIN: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (float, int, np.floating, np.integer),
    str: (str,),
}
VERSION = 3
FORMAT = "jaxprt object"
HEADER = "object.json"
# Functions that fields may hold. Files and pickles store their names.
_FUNCTIONS = {
    "jaxprt.sphere.hemisphere:disk_coordinates",
    "jaxprt.sphere.hemisphere:parabolic_coordinates",
    "jaxprt.sphere.hemisphere:polar_coordinates",
    "jaxprt.brdf.navigation:_identity",
    "jaxprt.brdf.navigation:_log",
    "jaxprt.brdf.navigation:_log_roughness",
    "jaxprt.brdf.places:identity",
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


def _run_checks(value: object) -> None:
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
def _hints(kind: type) -> JsonObject:
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


def _is_callable(hint: object) -> bool:
    return collections.abc.Callable in (hint, typing.get_origin(hint))


def _text(hint: object) -> str:
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


def _described(value: object) -> str:
    if isinstance(value, np.ndarray | jax.Array):
        return f"an array of {value.dtype} {list(value.shape)}"
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value)[:80]
    return f"a {type(value).__name__}"


def construct(kind: type, field: JsonObject) -> Any:
    """An object with these fields. Nothing is converted, checked or called, as when JAX unflattens a pytree."""
    if not dataclasses.is_dataclass(kind):
        return tuple.__new__(kind, field.values())
    result = object.__new__(kind)
    for name, value in field.items():
        object.__setattr__(result, name, value)
    return result


class _KnownError(Exception):
    """What a folder holds that cannot be loaded for another reason than damage, and what to do."""

    def __init__(self, what: str, cure: str = "load it with the version of jaxprt that saved it"):
        super().__init__(f"{what}, or it is damaged: {cure}")


class _Reader:
    """Makes `value`, the object that a description states. Refuses what does not have the form that `save` writes."""

    def __init__(self, path: Path, content: Any):
        tree, table, self._algorithm = _parts(content, {"tree": dict, "array": list, "algorithm": dict})
        for name, version in self._algorithm.items():
            _check_module(name)
            if algorithm_of(name) != version:
                raise _KnownError(
                    f"was made by version {str(version)[:80]} of the algorithm in {name}, this jaxprt has version "
                    f"{algorithm_of(name)}, which gives other results",
                    "compute it again",
                )
        self._arrays: list[Any] = [_read(path, number, entry) for number, entry in enumerate(table)]
        self.value = self._make(tree, False)

    def _make(self, node: Any, batched: bool) -> Any:
        """The value that a node of the description represents."""
        kinds = {"value", "array", "tuple", "list", "dict", "function", "class"} & set(node)
        if len(kinds) != 1:
            raise ValueError(f"its description must have one kind for each value, got {', '.join(map(str, node))}")
        (kind,) = kinds
        if kind == "value":
            (value,) = _parts(node, {"value": object})
            if value is not None and not isinstance(value, bool | int | float | str):
                raise ValueError(f"a plain value must be a number or text, got a {type(value).__name__}")
            return value
        if kind == "array":
            return self._array(*_parts(node, {"array": int, "kind": str}))
        if kind in ("tuple", "list"):
            (items,) = _parts(node, {kind: list})
            return (tuple if kind == "tuple" else list)(self._make(item, batched) for item in items)
        if kind == "dict":
            (items,) = _parts(node, {"dict": dict})
            return {key: self._make(item, batched) for key, item in items.items()}
        if kind == "function":
            (name,) = _parts(node, {"function": str})
            if name not in _FUNCTIONS:
                raise _KnownError(f"names the function {name!r}, which this jaxprt does not have")
            return function(name)
        name, field = _parts(node, {"class": str, "field": dict})
        return self._object(name, field, batched)

    def _object(self, name: str, field: JsonObject, batched: bool) -> Any:
        kind = _class(name)
        if list(field) != names(kind):
            came, wanted = ", ".join(field), ", ".join(names(kind))
            raise _KnownError(f"holds a {name} with the fields {came}, this jaxprt's has {wanted}")
        if kind.__module__ not in self._algorithm:
            raise ValueError(f"its description must state the algorithm of {kind.__module__}, got none")
        result = construct(
            kind, {key: self._make(node, batched or holds_models(kind, key)) for key, node in field.items()}
        )
        check(result, batched=batched)
        return result

    def _array(self, number: int, kind: str) -> Any:
        """An array of its original kind. Fields that share an array share the loaded one."""
        if not 0 <= number < len(self._arrays) or kind not in ("jax", "numpy", "scalar"):
            raise ValueError(f"its arrays must be from 0 to {len(self._arrays) - 1}, got {kind[:80]!r} array {number}")
        value = self._arrays[number]
        if kind == "scalar":
            if value.shape:
                raise ValueError(f"array {number} must be a single number, got {list(value.shape)}")
            return value[()]
        if kind == "numpy" and isinstance(value, np.ndarray) and not value.flags.writeable:
            self._arrays[number] = value = np.array(value)
        if kind == "jax" and isinstance(value, np.ndarray):
            if jax.dtypes.canonicalize_dtype(value.dtype) != value.dtype:
                what = f"holds arrays of {value.dtype}, which JAX has only with jax_enable_x64"
                raise _KnownError(what, "enable it to load them")
            self._arrays[number] = value = jax.device_put(value)
        return value


def _parts(node: Any, form: dict[str, type]) -> list[Any]:
    """The values of an object in the description, which must have these names and types and no others."""
    if not isinstance(node, dict) or set(node) != set(form):
        came = ", ".join(map(str, node))[:80] if isinstance(node, dict) else f"a {type(node).__name__}"
        raise ValueError(f"its description must have {', '.join(form)} together, got {came}")
    for name, kind in form.items():
        value = node[name]
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise ValueError(f"{name} of its description must be a {kind.__name__}, got a {type(value).__name__}")
    return [node[name] for name in form]


def _read(path: Path, number: int, entry: Any) -> np.ndarray:
    """Maps an array and verifies its checksum."""
    name, shape, expected = _parts(entry, {"dtype": str, "shape": list, "checksum": int})
    what = f"array {number} of {name[:40]} {str(shape)[:80]}"
    if not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"{what} must have a shape of whole numbers")
    try:
        dtype = jnp.dtype(name)
        if dtype.name != name or (dtype.kind not in "biufc" and not is_extended(dtype)):
            raise ValueError("it is not of numbers")
        kind = storable(np.empty(0, dtype)).dtype.str
        file = path / f"{number}.npy"
        inputs.check(file, "an array of a saved object", links=False)
        value = arrays.open_array(file, arrays.read_header(file, tuple(shape), kind), tuple(shape), kind).view(dtype)
        right = checksum(value) == expected
    except Exception as error:
        raise ValueError(f"{what} cannot be read: {error}") from error
    if not right:
        raise ValueError(f"{what} is not what was saved")
    return value


def _class(name: str) -> type:
    """A data class of this package, or one that another package has registered, by name."""
    module, _, kind = name.partition(":")
    _check_module(module)
    result = extensions.CLASSES.get(name) or getattr(sys.modules.get(module), kind, None)
    if not isinstance(result, type) or result.__module__ != module or not _is_known(result):
        raise _KnownError(f"names the class {name[:80]!r}, which this jaxprt does not have")
    return result


def _check_module(name: str) -> None:
    """Imports a module of this package. Modules of other packages are never imported because a file names them."""
    if re.fullmatch(r"jaxprt(\.[a-z][a-z_]*)+", name):
        try:
            importlib.import_module(name)
        except ImportError:
            raise _KnownError(f"names the module {name[:80]!r}, which this jaxprt does not have") from None
    elif name not in extensions.modules():
        raise _KnownError(
            f"names the module {name[:80]!r}, of which no class is registered",
            "import the package that calls jaxprt.register for its classes",
        )


def _is_known(kind: type) -> bool:
    """Whether files may hold objects of a class: a data class of this package, or a registered one."""
    ours = kind.__module__.startswith("jaxprt.") and extensions.is_data(kind)
    return ours or extensions.CLASSES.get(extensions.full_name(kind)) is kind


def algorithm_of(module: str) -> Any:
    """Versions of the algorithms that compute the objects of a module."""
    return getattr(sys.modules.get(module), "ALGORITHM", 1)


def function_name(value: object) -> str | None:
    """Name under which files store a function; None for what is not one of those functions."""
    name = f"{getattr(value, '__module__', None)}:{getattr(value, '__qualname__', None)}"
    return name if name in _FUNCTIONS else None


def function(name: str) -> Any:
    """The function that `function_name` names."""
    module, _, inner = name.partition(":")
    return getattr(importlib.import_module(module), inner)


def is_extended(dtype: np.dtype) -> bool:
    """Whether a type is one that JAX adds to NumPy's, such as bfloat16."""
    return dtype.type.__module__ == "ml_dtypes"


def storable(value: np.ndarray) -> np.ndarray:
    """The array in a type of NumPy's own. Arrays of other types are reinterpreted as integers of equal size."""
    return value.view(f"uint{8 * value.dtype.itemsize}") if is_extended(value.dtype) else value


def checksum(value: np.ndarray) -> int:
    """CRC-32 of the values of an array."""
    return zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)


@require.arguments(path=partial(require.path, "path"))
def save(path: str | os.PathLike, object: Any) -> None:
    """Saves an object of this package, or tuples, lists and dictionaries of such objects, without loss.

    Objects of other packages are saved if `jaxprt.register` has their classes.

    The folder is written under a temporary name and renamed when it is complete, so a killed process never leaves an
    incomplete object. An existing folder or file is never replaced.

    Args:
        path: The folder to create, including missing parent folders.
        object: The object to save: a mesh, a light, a camera, a BRDF in any form, a transport, a plan, a material, an
            array or a plain value.

    Raises:
        FileExistsError: `path` already exists.
        TypeError: The object holds something that cannot be saved: a function, such as a BRDF that is not a model of
            this package, an object of a class that is not registered, values that JAX is tracing, or fields that the
            object's class does not allow, such as gradients in place of parameters.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or name another path")
    leaves: list[tuple[Any, np.ndarray]] = []
    modules: set[str] = set()
    tree = _describe(object, type(object).__name__, leaves, modules)
    table = [{"dtype": array.dtype.name, "shape": array.shape, "checksum": checksum(array)} for _, array in leaves]
    algorithm = {name: algorithm_of(name) for name in modules}
    content = json.dumps({"tree": tree, "array": table, "algorithm": algorithm})
    header = {"format": FORMAT, "version": VERSION}
    header |= {"content": content, "checksum": zlib.crc32(content.encode())}
    with outputs.new_folder(path) as new:
        for number, (_, array) in enumerate(leaves):
            stored = storable(array)
            with (new / f"{number}.npy").open("xb") as file:
                arrays.write_header(file, stored.shape, stored.dtype.str)
                file.write(stored.reshape(-1).view(np.uint8).data)
        (new / HEADER).write_text(json.dumps(header))


@require.arguments(path=partial(require.path, "path"))
def load(path: str | os.PathLike) -> Any:
    """Loads an object that `save` has written, with the same classes, structure, types and bits.

    Args:
        path: The folder.

    Returns:
        The object. JAX arrays are placed on the default device, and NumPy arrays remain NumPy arrays. On CPUs the JAX
        arrays are memory-mapped: only used parts take memory. An object larger than the memory can therefore be loaded,
        and `jaxprt.systems.ranges.take` extracts a range of its vertices. The files may be deleted while they are in
        use, but must not be changed.

    Raises:
        FileNotFoundError: `path` does not exist.
        ValueError: The folder was not written by `save`, is damaged, was saved by a newer version of this package or by
            a version whose algorithms give other results, or holds 64-bit numbers while JAX is set to 32 bits.
    """
    path = Path(path)
    if not os.path.exists(path):  # unlike Path.exists, False for names that no file can have
        raise FileNotFoundError(f"{path}: there is no such folder")
    try:
        header = inputs.store_header(path, HEADER, "the description of a saved object")
    except FileNotFoundError:
        header = {}
    except Exception as error:
        raise ValueError(
            f"{path} must be a folder that jaxprt.files.save wrote, got one that cannot be read: it is damaged, {error}"
        ) from error
    if header.get("format") != FORMAT:
        came = str(header.get("format", "another kind of file or folder"))[:80]
        raise ValueError(
            f"{path} must be a folder that jaxprt.files.save wrote, got {came}, or it is damaged; a folder of "
            "precomputed data is read by jaxprt.precompute(scene, path=)"
        )
    version, text = header.get("version"), header.get("content")
    if version != VERSION or type(version) is not int:
        newer = isinstance(version, int) and version > VERSION
        earlier = "precompute and save it anew, or load it with the version of jaxprt that saved it"
        cure = "update jaxprt" if newer else earlier
        raise ValueError(
            f"{path} must have format version {VERSION}, got {str(version)[:80]}: {cure}, or it is damaged"
        )
    if not isinstance(text, str) or zlib.crc32(text.encode("utf-8", "replace")) != header.get("checksum"):
        raise ValueError(f"{path} is damaged: its description is not what was saved")
    try:
        return _Reader(path, json.loads(text)).value
    except _KnownError as error:
        raise ValueError(f"{path} {error}") from error
    except MemoryError:
        raise
    except RecursionError:
        raise ValueError(f"{path} is damaged: its description is nested too deeply") from None
    except Exception as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def reduced(object: Any) -> tuple:
    """The value that `__reduce__` must return for an object whose fields hold jitted functions.

    Pickle then stores the package's own functions by name, and other functions as usual.

    Args:
        object: A dataclass or Module of this package.
    """
    field = {item.name: getattr(object, item.name) for item in dataclasses.fields(object)}
    name = {key: text for key, value in field.items() if (text := function_name(value)) is not None}
    return _restore, (type(object), {key: value for key, value in field.items() if key not in name}, name)


def _restore(kind: type, field: JsonObject, name: dict[str, str]) -> Any:
    return construct(kind, field | {key: function(path) for key, path in name.items()})


def _describe(value: Any, place: str, arrays: list, modules: set[str], batched: bool = False) -> JsonObject:
    """Describes a value as JSON. Appends its arrays to the list, and adds the modules of its classes to the set."""
    if value is None or type(value) in (bool, int, float, str):
        return {"value": value}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _describe_array(value, place, arrays)
    if type(value) in (tuple, list):
        parts = [_describe(item, f"{place}[{n}]", arrays, modules, batched) for n, item in enumerate(value)]
        return {type(value).__name__: parts}
    if type(value) is dict and all(isinstance(key, str) for key in value):
        items = {key: _describe(item, f"{place}[{key!r}]", arrays, modules, batched) for key, item in value.items()}
        return {"dict": items}
    if (name := function_name(value)) is not None:
        return {"function": name}
    kind = type(value)
    if not _is_known(kind):
        got = f"the function {value}" if callable(value) and hasattr(value, "__name__") else f"a {kind.__name__}"
        cure = ", whose package must call jaxprt.register for it" if extensions.is_data(kind) else ""
        raise TypeError(f"{place} must be an object of jaxprt, arrays or plain values to be saved, got {got}{cure}")
    modules.add(kind.__module__)
    field = {
        name: _describe(getattr(value, name), f"{place}.{name}", arrays, modules, batched or holds_models(kind, name))
        for name in names(kind)
    }
    try:
        check(value, batched=batched)
    except ValueError as error:
        raise TypeError(f"{place} must be a valid {kind.__name__} to be saved and loaded again: {error}") from error
    return {"class": extensions.full_name(kind), "field": field}


def _describe_array(value: Any, place: str, arrays: list) -> JsonObject:
    if isinstance(value, Tracer):
        raise TypeError(f"{place} must have values to be saved, got one that JAX is tracing")
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.extended):
        raise TypeError(f"{place} must be an array of numbers to be saved, got {value.dtype}")
    kind = "jax" if isinstance(value, jax.Array) else "numpy" if isinstance(value, np.ndarray) else "scalar"
    for number, (known, _) in enumerate(arrays):
        if known is value:
            return {"array": number, "kind": kind}
    plain = np.asarray(value)
    if plain.dtype.kind not in "biufc" and not is_extended(plain.dtype):
        raise TypeError(f"{place} must be an array of numbers to be saved, got {plain.dtype}")
    arrays.append((value, np.ascontiguousarray(plain, plain.dtype.newbyteorder("=")).reshape(plain.shape)))
    return {"array": len(arrays) - 1, "kind": kind}
