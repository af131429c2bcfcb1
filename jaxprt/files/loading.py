"""Reading of saved objects: the description is checked part by part, and each object by the checks of its class.

A folder may come from a stranger. Nothing is unpickled, only data classes of this package are looked up, and only
regular files in the folder are read. Whatever differs from what `jaxprt.files.objects.save` writes is refused.
"""

import dataclasses
import importlib
import json
import os
import re
import sys
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxprt.files import fields, inputs, mapped

VERSION = 2
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


def load(path: Path) -> Any:
    """The object in a folder; `jaxprt.files.objects.load` explains it."""
    if not os.path.exists(path):  # unlike Path.exists, False for names that no file can have
        raise FileNotFoundError(f"{path}: there is no such folder")
    try:
        header = _header(path)
    except Exception as error:
        raise ValueError(
            f"{path} must be a folder that jaxprt.files.save wrote, got one that cannot be read: it is damaged, {error}"
        ) from error
    if header.get("format") != FORMAT:
        came = str(header.get("format", "another kind of folder"))[:80]
        raise ValueError(f"{path} must be a folder that jaxprt.files.save wrote, got {came}, or it is damaged")
    version, text = header.get("version"), header.get("content")
    if version != VERSION or type(version) is not int:
        newer = isinstance(version, int) and version > VERSION
        cure = "update jaxprt" if newer else "load it with the version of jaxprt that saved it"
        raise ValueError(
            f"{path} must have format version {VERSION}, got {str(version)[:80]}: {cure}, or it is damaged"
        )
    if not isinstance(text, str) or zlib.crc32(text.encode("utf-8", "replace")) != header.get("checksum"):
        raise ValueError(f"{path} is damaged: its description is not what was saved")
    try:
        return _Reader(path, json.loads(text)).value
    except _KnownError as error:
        raise ValueError(str(error)) from error
    except MemoryError:
        raise
    except RecursionError:
        raise ValueError(f"{path} is damaged: its description is nested too deeply") from None
    except Exception as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def construct(kind: type, field: dict[str, Any]) -> Any:
    """An object with these fields. Nothing is converted, checked or called, as when JAX unflattens a pytree."""
    if not dataclasses.is_dataclass(kind):
        return tuple.__new__(kind, field.values())
    result = object.__new__(kind)
    for name, value in field.items():
        object.__setattr__(result, name, value)
    return result


class _KnownError(Exception):
    """A folder that cannot be loaded for a reason other than damage."""


class _Reader:
    """Makes the object that a description states. Whatever does not have the form that `save` writes is refused.

    Attributes:
        value: The object.
    """

    def __init__(self, path: Path, content: Any):
        self._path = path
        tree, table, self._algorithm = _parts(content, {"tree": dict, "array": list, "algorithm": dict})
        for name, version in self._algorithm.items():
            self._check_algorithm(name, version)
        self._arrays: list[Any] = [_read(path, number, entry) for number, entry in enumerate(table)]
        self.value = self._make(tree, False)

    def _check_algorithm(self, name: str, version: Any) -> None:
        _check_module(name)
        if algorithm(name) != version:
            raise _KnownError(
                f"{self._path} was made by version {str(version)[:80]} of the algorithm in {name}, this jaxprt has "
                f"version {algorithm(name)}, which gives other results, or it is damaged: compute it again"
            )

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
                raise _KnownError(
                    f"{self._path} names the function {name!r}, which this version of jaxprt does not save: it is "
                    "damaged, or was saved by another version"
                )
            return function(name)
        name, field = _parts(node, {"class": str, "field": dict})
        return self._object(name, field, batched)

    def _object(self, name: str, field: dict[str, Any], batched: bool) -> Any:
        kind = _class(self._path, name)
        if list(field) != fields.names(kind):
            raise _KnownError(
                f"{self._path} holds a {name} with the fields {', '.join(field)}, this jaxprt's has "
                f"{', '.join(fields.names(kind))}: load it with the version of jaxprt that saved it, or it is damaged"
            )
        if kind.__module__ not in self._algorithm:
            raise ValueError(f"its description must state the algorithm of {kind.__module__}, got none")
        result = construct(
            kind, {key: self._make(node, batched or fields.holds_models(kind, key)) for key, node in field.items()}
        )
        fields.check(result, batched=batched)
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
                raise _KnownError(
                    f"{self._path} holds arrays of {value.dtype}, which JAX has only with jax_enable_x64: enable it to "
                    "load them, or it is damaged"
                )
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
        inputs.check_unlinked(file, "an array of a saved object")
        value = mapped.open_array(file, mapped.read_header(file, tuple(shape), kind), tuple(shape), kind).view(dtype)
        right = checksum(value) == expected
    except Exception as error:
        raise ValueError(f"{what} cannot be read: {error}") from error
    if not right:
        raise ValueError(f"{what} is not what was saved")
    return value


def _class(path: Path, name: str) -> type:
    """A data class of this package, by name. Nothing else is ever looked up."""
    module, _, kind = name.partition(":")
    try:
        _check_module(module)
    except ValueError as error:
        raise _KnownError(f"{path} {error}") from None
    result = getattr(sys.modules[module], kind, None)
    if not isinstance(result, type) or result.__module__ != module or not is_ours(result):
        raise _KnownError(
            f"{path} names the class {name[:80]!r}, which this jaxprt does not have: it is damaged, or was saved by "
            "another version"
        )
    return result


def _check_module(name: str) -> None:
    """Imports a module of this package. Refuses all other modules."""
    try:
        if not re.fullmatch(r"jaxprt(\.[a-z][a-z_]*)+", name):
            raise ImportError(name)
        importlib.import_module(name)
    except ImportError:
        raise ValueError(
            f"names the module {name[:80]!r}, which this jaxprt does not have: it is damaged, or was saved by another "
            "version"
        ) from None


def is_ours(kind: type) -> bool:
    """Whether a class is a data class or a named tuple of this package."""
    named = issubclass(kind, tuple) and hasattr(kind, "_fields")
    return kind.__module__.startswith("jaxprt.") and (dataclasses.is_dataclass(kind) or named)


def algorithm(module: str) -> Any:
    """Versions of the algorithms that compute the objects of a module."""
    return getattr(sys.modules[module], "ALGORITHM", 1)


def function_name(value: Any) -> str | None:
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


def _header(path: Path) -> dict[str, Any]:
    """The header of a saved object, of the current version or of version 1, which zarr wrote."""
    if (path / HEADER).exists():
        inputs.check_unlinked(path / HEADER, "an object that jaxprt.files.save wrote")
        return inputs.json_object(path / HEADER, "the description of a saved object")
    if (path / "zarr.json").exists():
        inputs.check_unlinked(path / "zarr.json", "an object that jaxprt.files.save wrote")
        return dict(inputs.json_object(path / "zarr.json", "the description of a saved object").get("attributes", {}))
    return {}
