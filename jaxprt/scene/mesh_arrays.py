"""Arrays of meshes: conversion, and checks of their types, shapes and values."""

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


def as_array(value: Any) -> Any:
    """NumPy arrays and lists of real numbers as JAX arrays, in float32 and int32 unless float64 is enabled."""
    if isinstance(value, jax.Array) or not isinstance(value, np.ndarray | list | tuple):
        return value
    known = np.asarray(value)
    if jnp.issubdtype(known.dtype, jnp.integer) and np.all(np.abs(known) < 2**31):
        return jax.device_put(known.astype(np.int32))
    return require.floating(value) if jnp.issubdtype(known.dtype, jnp.floating) else value


def check_shapes(mesh: Any) -> None:
    """Refuses a mesh whose arrays have other types than its fields, or other lengths than its positions.

    Fields that are not arrays pass, such as the axes of `jax.vmap`. Values are not looked at.

    Raises:
        TypeError: An array has a wrong type.
        ValueError: An array has a wrong shape.
    """
    for name, (width, whole) in _FIELDS.items():
        value = getattr(mesh, name)
        if not isinstance(value, jax.Array | np.ndarray):  # such as the axes of `jax.vmap`
            continue
        if not jnp.issubdtype(value.dtype, jnp.integer if whole else jnp.floating):
            kind = "integers" if whole else "real numbers"
            raise TypeError(f"{name} of a mesh must be {kind}, got {value.dtype}: `make_mesh` converts lists")
        rows = None if name in ("face", "position") else np.shape(mesh.position)[:1]
        shape = value.shape
        if shape[1:] != width or not shape or (rows and shape[:1] != rows):
            count = "any" if not rows else rows[0]
            required = ", ".join(map(str, (count, *width)))
            raise ValueError(f"{name} of a mesh must be [{required}], got {list(shape)}")


def check_values(mesh: Any, name: str) -> None:
    """Refuses a mesh with values that are not finite, or faces that refer to missing vertices.

    Raises:
        ValueError: There are such values. Inside `jax.jit` they are not known and not checked.
    """
    for field in ("position", "normal", "tangent", "texture"):
        value = getattr(mesh, field)
        if value is not None:
            require.finite(f"{field} of {name}", value)
    if len(mesh.face) and len(mesh.position):
        require.within(f"faces of {name}", mesh.face, 0, len(mesh.position) - 1)
    if len(mesh.region):
        require.within(f"regions of {name}", mesh.region, 0, 2**31 - 1)
