"""Saving, loading and pickling of the package's objects: transports, BRDFs, plans, lights, meshes.

A saved object is a folder with a NumPy file for each array and a JSON description of the object's classes and fields.
It contains no pickle. Loading creates only objects of this package's classes and fills their fields; it never calls a
function that a file names.
"""

import dataclasses
import json
import os
import shutil
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxprt import require
from jaxprt.files import fields, loading, mapped


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
            this package, an object of another package, values that JAX is tracing, or fields that the object's class
            does not allow, such as gradients in place of parameters.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(f"{path} exists; remove it or name another path")
    arrays: list[tuple[Any, np.ndarray]] = []
    modules: set[str] = set()
    tree = _describe(object, type(object).__name__, arrays, modules)
    table = [
        {"dtype": array.dtype.name, "shape": array.shape, "checksum": loading.checksum(array)} for _, array in arrays
    ]
    algorithm = {name: loading.algorithm(name) for name in modules}
    content = json.dumps({"tree": tree, "array": table, "algorithm": algorithm})
    header = {"format": loading.FORMAT, "version": loading.VERSION}
    header |= {"content": content, "checksum": zlib.crc32(content.encode())}
    aside = path.with_name(f"{path.name}.{os.getpid()}.new")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        aside.mkdir(parents=True)
        for number, (_, each) in enumerate(arrays):
            stored = loading.storable(each)
            with (aside / f"{number}.npy").open("xb") as file:
                mapped.write_header(file, stored.shape, stored.dtype.str)
                file.write(stored.reshape(-1).view(np.uint8).data)
        (aside / loading.HEADER).write_text(json.dumps(header))
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
    return loading.load(Path(path))


def reduced(object: Any) -> tuple:
    """The value that `__reduce__` must return for an object whose fields hold jitted functions.

    Pickle then stores the package's own functions by name, and other functions as usual.

    Args:
        object: A dataclass or Module of this package.
    """
    field = {each.name: getattr(object, each.name) for each in dataclasses.fields(object)}
    name = {key: found for key, value in field.items() if (found := loading.function_name(value)) is not None}
    return _restored, (type(object), {key: value for key, value in field.items() if key not in name}, name)


def _restored(kind: type, field: dict[str, Any], name: dict[str, str]) -> Any:
    return loading.construct(kind, field | {key: loading.function(path) for key, path in name.items()})


def _describe(value: Any, place: str, arrays: list, modules: set[str], batched: bool = False) -> dict[str, Any]:
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
    if (name := loading.function_name(value)) is not None:
        return {"function": name}
    kind = type(value)
    if not loading.is_ours(kind):
        got = f"the function {value}" if callable(value) and hasattr(value, "__name__") else f"a {kind.__name__}"
        raise TypeError(f"{place} must be an object of jaxprt, arrays or plain values to be saved, got {got}")
    modules.add(kind.__module__)
    field = {
        name: _describe(
            getattr(value, name), f"{place}.{name}", arrays, modules, batched or fields.holds_models(kind, name)
        )
        for name in fields.names(kind)
    }
    try:
        fields.check(value, batched=batched)
    except ValueError as error:
        raise TypeError(f"{place} must be a valid {kind.__name__} to be saved and loaded again: {error}") from error
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
    if plain.dtype.kind not in "biufc" and not loading.is_extended(plain.dtype):
        raise TypeError(f"{place} must be an array of numbers to be saved, got {plain.dtype}")
    arrays.append((value, np.ascontiguousarray(plain, plain.dtype.newbyteorder("=")).reshape(plain.shape)))
    return {"array": len(arrays) - 1, "kind": kind}
