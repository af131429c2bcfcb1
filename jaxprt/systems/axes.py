"""Axes of arrays, named by the type annotations of their fields, to join, pad and cut what has vertices."""

import dataclasses
import typing
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

Held = TypeVar("Held", bound=PyTree)


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
                hint = {each.name: each.type for each in dataclasses.fields(node)}[key.name]
                node = getattr(node, key.name)
            elif isinstance(key, jax.tree_util.SequenceKey):
                node = node[key.idx]
            elif isinstance(key, jax.tree_util.DictKey):
                node = node[key.key]
            else:  # a class that does not belong to jaxprt
                hint = None
                break
        yield _names(hint, leaf), leaf


def joined(values: Sequence[Held], *, size: int) -> Held:  # pyright: ignore[reportInvalidTypeForm]
    """Transport of several meshes as that of one, with the vertices of one mesh after another.

    Arrays without an axis of vertices are those of the first.

    Args:
        values: Transport of each mesh, all of one kind.
        size: Number of vertices of the result. Vertices after those of all meshes repeat the last one.
    """
    every = [list(leaves(value)) for value in values]
    made: dict[int, Any] = {}  # An array that occurs twice stays one array.
    result = []
    for number, (axes, leaf) in enumerate(every[0]):
        if "v" in axes and id(leaf) not in made:
            axis = axes.index("v")
            whole = np.concatenate([np.asarray(own[number][1]) for own in every], axis)
            room = [(0, size - whole.shape[axis] if each == axis else 0) for each in range(whole.ndim)]
            made[id(leaf)] = jax.device_put(np.pad(whole, room, mode="edge"))
        result.append(made.get(id(leaf), leaf))
    return jax.tree.unflatten(jax.tree.structure(values[0]), result)


def taken(value: Held, vertex: slice) -> Held:  # pyright: ignore[reportInvalidTypeForm]
    """Transport or a system at some of its vertices, in NumPy."""
    return mapped(value, lambda axes, leaf: np.asarray(leaf)[_at(axes, vertex)] if "v" in axes else leaf)


def mapped(value: Held, change: Callable[[list[str], Any], Any]) -> Held:  # pyright: ignore[reportInvalidTypeForm]
    """The value with each array changed by a function of the names of its axes and the array."""
    made: dict[int, Any] = {}
    every = list(leaves(value))
    for axes, leaf in every:
        if id(leaf) not in made:
            made[id(leaf)] = change(axes, leaf)
    return jax.tree.unflatten(jax.tree.structure(value), [made[id(leaf)] for _, leaf in every])


def _at(axes: list[str], vertex: slice) -> tuple[slice, ...]:
    return tuple(vertex if name == "v" else slice(None) for name in axes)


def _names(hint: Any, leaf: Any) -> list[str]:
    """Names of the axes of an array by an annotation; an empty list if the annotation does not fit."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return []
    names = getattr(hint, "dim_str", "").split()
    if names and len(names) == leaf.ndim:
        return names
    return next((found for each in typing.get_args(hint) if (found := _names(each, leaf))), [])
