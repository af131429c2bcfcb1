"""Axes of arrays, named by the type annotations of their fields, to pad and cut what has vertices."""

import dataclasses
import typing
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

Value = TypeVar("Value", bound=PyTree)


def leaves(value: PyTree) -> Iterator[tuple[list[str], Any]]:
    """Iterates over the leaves of a pytree of jaxprt, in the order of `jax.tree.leaves`, with the names of their axes.

    Names are those of the field's annotation: `v` for vertices, `block` for blocks of stored visibility, `p` and `g`
    for clusters of vertices. The list of names is empty if no annotation fits.

    Args:
        value: Transport, a system or a scene.
    """
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        hint: Any = None
        node: Any = value
        for key in path:
            if isinstance(key, jax.tree_util.GetAttrKey) and dataclasses.is_dataclass(node):
                hint = {field.name: field.type for field in dataclasses.fields(node)}[key.name]
                node = getattr(node, key.name)
            elif isinstance(key, jax.tree_util.SequenceKey):
                node = node[key.idx]
            elif isinstance(key, jax.tree_util.DictKey):
                node = node[key.key]
            else:  # a class that does not belong to jaxprt
                hint = None
                break
        yield _names(hint, leaf), leaf


def pad(value: Value, size: int | None) -> Value:  # pyright: ignore[reportInvalidTypeForm]
    """Transport with `size` vertices, of which those after its own repeat the last one; None returns it as it is."""
    if size is None:
        return value

    def longer(axes, leaf):
        if "v" not in axes:
            return leaf
        after = [size - length if name == "v" else 0 for name, length in zip(axes, leaf.shape, strict=True)]
        return jax.device_put(np.pad(np.asarray(leaf), [(0, count) for count in after], mode="edge"))

    return map_leaves(value, longer)


def take(value: Value, vertex: slice) -> Value:  # pyright: ignore[reportInvalidTypeForm]
    """Transport or a system at some of its vertices, in NumPy."""
    return map_leaves(value, lambda axes, leaf: np.asarray(leaf)[_at(axes, vertex)] if "v" in axes else leaf)


def map_leaves(value: Value, change: Callable[[list[str], Any], Any]) -> Value:  # pyright: ignore[reportInvalidTypeForm]
    """The value with each array changed by a function of the names of its axes and the array."""
    rows = list(leaves(value))
    changed: dict[int, Any] = {}  # An array that occurs twice stays one array.
    for axes, leaf in rows:
        if id(leaf) not in changed:
            changed[id(leaf)] = change(axes, leaf)
    return jax.tree.unflatten(jax.tree.structure(value), [changed[id(leaf)] for _, leaf in rows])


def _at(axes: list[str], vertex: slice) -> tuple[slice, ...]:
    return tuple(vertex if name == "v" else slice(None) for name in axes)


def _names(hint: Any, leaf: Any) -> list[str]:
    """Names of the axes of an array by an annotation; an empty list if the annotation does not fit."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return []
    names = getattr(hint, "dim_str", "").split()
    if names and len(names) == leaf.ndim:
        return names
    return next(filter(None, (_names(part, leaf) for part in typing.get_args(hint))), [])
