"""Arrays of meshes: conversion, and checks of their types, shapes and values."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxprt import require

# Axes after the first of each field of a mesh, and whether it holds integers.
_FIELDS = {
    "position": ((3,), False),
    "face": ((3,), True),
    "normal": ((3,), False),
    "tangent": ((3,), False),
    "region": ((), True),
    "texture": ((2,), False),
}
_WRONG = float, complex, str, bytes, list, tuple, dict, set


def as_array(value: Any) -> Any:
    """NumPy arrays and lists of real numbers as JAX arrays, in float32 and int32 unless float64 is enabled."""
    if isinstance(value, jax.Array) or not isinstance(value, np.ndarray | list | tuple):
        return value
    if require.unreal(value):
        return value
    known = np.asarray(value)
    if jnp.issubdtype(known.dtype, jnp.floating):
        return require.floating(value)
    return jax.device_put(known.astype(np.int32)) if np.all(np.abs(known) < 2**31) else value


def check_shapes(mesh: Any) -> None:
    """Refuses a mesh whose arrays have other types than its fields, or other lengths than its positions.

    Placeholders such as the axes of `jax.vmap` pass. Values are not looked at.

    Raises:
        TypeError: An array has a wrong type.
        ValueError: An array has a wrong shape.
    """
    origin = mesh.origin
    if (
        not isinstance(origin, tuple)
        or len(origin) != 3
        or not all(type(x) is float and math.isfinite(x) for x in origin)
    ):
        got = require.shown(origin)
        raise ValueError(f"origin of a mesh must be a tuple of three finite numbers of class float, got {got}")
    for name, (width, whole) in _FIELDS.items():
        value = getattr(mesh, name)
        if not isinstance(value, jax.Array | np.ndarray):
            if isinstance(value, _WRONG):
                raise TypeError(
                    f"{name} of a mesh must be an array of numbers, got one of class {type(value).__name__}"
                )
            continue
        require.real(f"{name} of a mesh", value)
        if not jnp.issubdtype(value.dtype, jnp.integer if whole else jnp.floating):
            kind = "integers" if whole else "real numbers"
            raise TypeError(f"{name} of a mesh must be {kind}, got {value.dtype}: `make_mesh` converts lists")
        rows = None if name in ("face", "position") else np.shape(mesh.position)[:1]
        shape = value.shape
        if shape[1:] != width or not shape or (rows and shape[:1] != rows):
            count = "any" if not rows else rows[0]
            required = ", ".join(map(str, (count, *width)))
            raise ValueError(f"{name} of a mesh must be [{required}], got {list(shape)}")


def check_mesh(value: Any) -> None:
    """Refuses anything but a mesh.

    Raises:
        TypeError: The value has not the fields of a mesh.
    """
    if not all(hasattr(value, field) for field in _FIELDS):
        source = "jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh"
        raise TypeError(f"the mesh must be of class Mesh, which {source} makes, got {require.shown(value)}")


def check_meshes(value: Any) -> None:
    """Refuses anything but a list of meshes, by TypeError."""
    if not isinstance(value, list | tuple):
        raise TypeError(f"meshes must be a list of meshes, got {require.shown(value)}")
    for mesh in value:
        check_mesh(mesh)


def check_kinds(mesh: Any, name: str) -> None:
    """Refuses a mesh with fields that are not arrays, which only placeholders are.

    Raises:
        TypeError: There is such a field.
    """
    for field in _FIELDS:
        value = getattr(mesh, field)
        if value is not None or field != "texture":
            require.array(f"{field} of {name}", value, "v", "v _")


def check_values(mesh: Any, name: str) -> None:
    """Refuses a mesh with values that are not finite, or faces that refer to missing vertices.

    Raises:
        ValueError: There are such values. Inside `jax.jit` they are not known and not checked.
    """
    check_kinds(mesh, name)
    for field in _FIELDS:
        value = getattr(mesh, field)
        if value is not None:
            require.finite(f"{field} of {name}", value)
    if len(mesh.face) and len(mesh.position):
        require.within(f"faces of {name}", mesh.face, 0, len(mesh.position) - 1)
    if len(mesh.region):
        require.within(f"regions of {name}", mesh.region, 0, 2**31 - 1)
