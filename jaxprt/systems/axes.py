"""Names of array axes, from the type annotations of the fields that hold the arrays."""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree


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


def _names(hint: Any, leaf: Any) -> list[str]:
    """Names of the axes of an array by an annotation; an empty list if the annotation does not fit."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return []
    names = getattr(hint, "dim_str", "").split()
    if names and len(names) == leaf.ndim:
        return names
    return next((found for each in typing.get_args(hint) if (found := _names(each, leaf))), [])
