"""Saving, loading and pickling of the package's objects: transports, BRDFs, plans, lights, meshes.

A saved object is a folder with a NumPy file for each array and a JSON description of the object's classes and fields.
It contains no pickle. Loading creates only objects of this package's classes and fills their fields; it never calls a
function that a file names.
"""

import dataclasses
import importlib
import json
import os
import re
import shutil
import sys
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxprt import require
from jaxprt.files import mapped

VERSION = 2
_FORMAT = "jaxprt object"
_HEADER = "object.json"
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


@require.arguments(path=partial(require.path, "path"))
def save(path: str | os.PathLike, object: Any) -> None:
    """Saves an object of this package, or tuples, lists and dictionaries of such objects, without loss.

    The folder is written under a temporary name and renamed when it is complete, so a killed process never leaves an
    incomplete object. An existing folder or file is never replaced.

    Args:
        path: The folder to create, including missing parent folders.
        object: The object to save: a mesh, a light, a camera, a BRDF in any form, a transport, a plan, a material, an
            array or a plain value.

    Raises:
        FileExistsError: `path` already exists.
        TypeError: The object holds something that cannot be saved: a function, such as a BRDF that is not a model of
            this package, an object of another package, or values that JAX is tracing.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or name another path")
    arrays: list[tuple[Any, np.ndarray]] = []
    modules: set[str] = set()
    tree = _describe(object, type(object).__name__, arrays, modules)
    table = [{"dtype": each.dtype.name, "shape": each.shape, "checksum": _checksum(each)} for _, each in arrays]
    content = json.dumps({"tree": tree, "array": table, "algorithm": {name: _algorithm(name) for name in modules}})
    header = {"format": _FORMAT, "version": VERSION, "content": content, "checksum": zlib.crc32(content.encode())}
    aside = path.with_name(f"{path.name}.{os.getpid()}.new")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        aside.mkdir(parents=True)
        for number, (_, each) in enumerate(arrays):
            stored = _storable(each)
            with (aside / f"{number}.npy").open("xb") as file:
                mapped.write_header(file, stored.shape, stored.dtype.str)
                file.write(stored.reshape(-1).view(np.uint8).data)
        (aside / _HEADER).write_text(json.dumps(header))
        if path.exists():
            raise FileExistsError(f"{path} exists; remove it or name another path")
        aside.rename(path)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


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
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such folder")
    try:
        header = _header(path)
    except Exception as error:
        raise ValueError(
            f"{path} must be a folder that jaxprt.files.save wrote, got one that cannot be read"
        ) from error
    if header.get("format") != _FORMAT:
        found = header.get("format", "another kind of folder")
        raise ValueError(f"{path} must be a folder that jaxprt.files.save wrote, got {found}")
    version, text = header.get("version"), str(header.get("content"))
    if version != VERSION:
        newer = isinstance(version, int) and version > VERSION
        cure = "update jaxprt" if newer else "load it with the version of jaxprt that saved it"
        raise ValueError(f"{path} must have format version {VERSION}, got {version}: {cure}")
    if zlib.crc32(text.encode()) != header.get("checksum"):
        raise ValueError(f"{path} is damaged: its description is not what was saved")
    content = json.loads(text)
    for name, algorithm in content["algorithm"].items():
        _check_module(path, name)
        if _algorithm(name) != algorithm:
            raise ValueError(
                f"{path} was made by version {algorithm} of the algorithm in {name}, this jaxprt has version "
                f"{_algorithm(name)}, which gives other results: compute it again"
            )
    arrays: list[Any] = [_read(path, number, each) for number, each in enumerate(content["array"])]
    return _make(path, content["tree"], arrays)


def reduced(object: Any) -> tuple:
    """The value that `__reduce__` must return for an object whose fields hold jitted functions.

    Pickle then stores the package's own functions by name, and other functions as usual.

    Args:
        object: A dataclass or Module of this package.
    """
    field = {each.name: getattr(object, each.name) for each in dataclasses.fields(object)}
    name = {key: found for key, value in field.items() if (found := _function_name(value)) is not None}
    return _restored, (type(object), {key: value for key, value in field.items() if key not in name}, name)


def _restored(kind: type, field: dict[str, Any], name: dict[str, str]) -> Any:
    return _filled(kind, field | {key: _function(each) for key, each in name.items()})


def _filled(kind: type, field: dict[str, Any]) -> Any:
    """An object with these fields. Nothing is converted, checked or called, as when JAX unflattens a pytree."""
    if not dataclasses.is_dataclass(kind):
        return tuple.__new__(kind, field.values())
    result = object.__new__(kind)
    for name, value in field.items():
        object.__setattr__(result, name, value)
    return result


def _describe(value: Any, place: str, arrays: list, modules: set[str]) -> dict[str, Any]:
    """Describes a value as JSON. Appends its arrays to the list, and adds the modules of its classes to the set."""
    if value is None or type(value) in (bool, int, float, str):
        return {"value": value}
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        return _describe_array(value, place, arrays)
    if type(value) in (tuple, list):
        parts = [_describe(each, f"{place}[{n}]", arrays, modules) for n, each in enumerate(value)]
        return {type(value).__name__: parts}
    if type(value) is dict and all(isinstance(key, str) for key in value):
        return {"dict": {key: _describe(each, f"{place}[{key!r}]", arrays, modules) for key, each in value.items()}}
    if (name := _function_name(value)) is not None:
        return {"function": name}
    kind = type(value)
    if not _is_ours(kind):
        got = f"the function {value}" if callable(value) and hasattr(value, "__name__") else f"a {kind.__name__}"
        raise TypeError(f"{place} must be an object of jaxprt, arrays or plain values to be saved, got {got}")
    modules.add(kind.__module__)
    names = _fields(kind)
    field = {each: _describe(getattr(value, each), f"{place}.{each}", arrays, modules) for each in names}
    return {"class": f"{kind.__module__}:{kind.__qualname__}", "field": field}


def _describe_array(value: Any, place: str, arrays: list) -> dict[str, Any]:
    if isinstance(value, Tracer):
        raise TypeError(f"{place} must have values to be saved, got one that JAX is tracing")
    if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.extended):
        raise TypeError(f"{place} must be an array of numbers to be saved, got {value.dtype}")
    kind = "jax" if isinstance(value, jax.Array) else "numpy" if isinstance(value, np.ndarray) else "scalar"
    for number, (known, _) in enumerate(arrays):
        if known is value:
            return {"array": number, "kind": kind}
    plain = np.asarray(value)
    if plain.dtype.kind not in "biufc" and not _is_extended(plain.dtype):
        raise TypeError(f"{place} must be an array of numbers to be saved, got {plain.dtype}")
    arrays.append((value, np.ascontiguousarray(plain, plain.dtype.newbyteorder("=")).reshape(plain.shape)))
    return {"array": len(arrays) - 1, "kind": kind}


def _make(path: Path, node: dict[str, Any], arrays: list[Any]) -> Any:
    """The value that a node of the description represents."""
    if "value" in node:
        return node["value"]
    if "array" in node:
        return _array(path, arrays, node["array"], node["kind"])
    for kind in (tuple, list):
        if kind.__name__ in node:
            return kind(_make(path, each, arrays) for each in node[kind.__name__])
    if "dict" in node:
        return {key: _make(path, each, arrays) for key, each in node["dict"].items()}
    if "function" in node:
        if node["function"] not in _FUNCTIONS:
            raise ValueError(
                f"{path} names the function {node['function']!r}, which this version of jaxprt does not save"
            )
        return _function(node["function"])
    kind = _class(path, node["class"])
    if list(node["field"]) != _fields(kind):
        raise ValueError(
            f"{path} holds a {node['class']} with the fields {', '.join(node['field'])}, this jaxprt's has "
            f"{', '.join(_fields(kind))}: load it with the version of jaxprt that saved it"
        )
    return _filled(kind, {name: _make(path, each, arrays) for name, each in node["field"].items()})


def _array(path: Path, arrays: list[Any], number: int, kind: str) -> Any:
    """An array of its original kind. Fields that share an array share the loaded one."""
    value = arrays[number]
    if kind == "scalar":
        return value[()]
    if kind == "numpy" and isinstance(value, np.ndarray) and not value.flags.writeable:
        arrays[number] = value = np.array(value)
    if kind == "jax" and isinstance(value, np.ndarray):
        if jax.dtypes.canonicalize_dtype(value.dtype) != value.dtype:
            raise ValueError(
                f"{path} holds arrays of {value.dtype}, which JAX has only with jax_enable_x64: enable it to load them"
            )
        arrays[number] = value = jax.device_put(value)
    return value


def _header(path: Path) -> dict[str, Any]:
    """The header of a saved object, of the current version or of version 1, which zarr wrote."""
    if (path / _HEADER).exists():
        return dict(json.loads((path / _HEADER).read_text()))
    if (path / "zarr.json").exists():
        return dict(json.loads((path / "zarr.json").read_text()).get("attributes", {}))
    return {}


def _read(path: Path, number: int, entry: dict[str, Any]) -> np.ndarray:
    """Maps an array and verifies its checksum."""
    dtype, shape = jnp.dtype(entry["dtype"]), tuple(entry["shape"])
    kind = _storable(np.empty(0, dtype)).dtype.str
    file = path / f"{number}.npy"
    try:
        value = mapped.open_array(file, mapped.read_header(file, shape, kind), shape, kind).view(dtype)
        if _checksum(value) == entry["checksum"]:
            return value
    except Exception as error:
        raise ValueError(f"{path} is damaged: array {number} of {dtype} {list(shape)} cannot be read") from error
    raise ValueError(f"{path} is damaged: array {number} of {dtype} {list(shape)} is not what was saved")


def _class(path: Path, name: str) -> type:
    """A data class of this package, by name. Nothing else is ever looked up."""
    module, _, kind = name.partition(":")
    _check_module(path, module)
    found = getattr(sys.modules[module], kind, None)
    if not isinstance(found, type) or found.__module__ != module or not _is_ours(found):
        raise ValueError(f"{path} names the class {name!r}, which this jaxprt does not have")
    return found


def _check_module(path: Path, name: str) -> None:
    """Imports a module of this package. Refuses all other modules."""
    try:
        if not re.fullmatch(r"jaxprt(\.[a-z][a-z_]*)+", name):
            raise ImportError(name)
        importlib.import_module(name)
    except ImportError:
        raise ValueError(f"{path} names the module {name!r}, which this jaxprt does not have") from None


def _is_ours(kind: type) -> bool:
    named = issubclass(kind, tuple) and hasattr(kind, "_fields")
    return kind.__module__.startswith("jaxprt.") and (dataclasses.is_dataclass(kind) or named)


def _fields(kind: Any) -> list[str]:
    return [each.name for each in dataclasses.fields(kind)] if dataclasses.is_dataclass(kind) else list(kind._fields)


def _algorithm(module: str) -> Any:
    """Versions of the algorithms that compute the objects of a module."""
    return getattr(sys.modules[module], "ALGORITHM", 1)


def _function_name(value: Any) -> str | None:
    name = f"{getattr(value, '__module__', None)}:{getattr(value, '__qualname__', None)}"
    return name if name in _FUNCTIONS else None


def _function(name: str) -> Any:
    module, _, function = name.partition(":")
    return getattr(importlib.import_module(module), function)


def _is_extended(dtype: np.dtype) -> bool:
    """Whether a type is one that JAX adds to NumPy's, such as bfloat16."""
    return dtype.type.__module__ == "ml_dtypes"


def _storable(value: np.ndarray) -> np.ndarray:
    """The array in a type of NumPy's own. Arrays of other types are reinterpreted as integers of equal size."""
    return value.view(f"uint{8 * value.dtype.itemsize}") if _is_extended(value.dtype) else value


def _checksum(value: np.ndarray) -> int:
    return zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
