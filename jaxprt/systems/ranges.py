"""Ranges of vertices: transport or systems that are larger than the memory, relit piece by piece."""

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import PyTree

from jaxprt.visibility.rays import BLOCK

Piece = TypeVar("Piece", bound=PyTree)


def take(value: Piece, start: int, stop: int) -> Piece:
    """A range of the vertices of a transport or a system, as one of its own.

    The same functions run on it, and what they return are the rows of the range. Of transport that is mapped from a
    file, as `jaxprt.files.load` makes it, only the range is read and held:

        for start in range(0, vertices, 1 << 16):
            rows = take(system, start, min(start + (1 << 16), vertices)).combine(light, view)

    Args:
        value: What the range is taken of.
        start: First vertex; a multiple of 64 where visibility is stored.
        stop: The vertex after the last.

    Returns:
        The same of fewer vertices. Ranges of one length share their compiled functions.

    Raises:
        TypeError: It has no vertices, or clusters of them, which a range would cut.
        ValueError: The range is empty or beyond the vertices, or does not begin with a block of stored visibility.
    """
    leaves = list(_leaves(value))
    counts = {leaf.shape[axes.index("v")] for axes, leaf in leaves if "v" in axes}
    if len(counts) != 1 or any("p" in axes for axes, _ in leaves):
        raise TypeError(f"ranges are of transport that has vertices and no clusters, got {type(value).__name__}")
    if not 0 <= start < stop <= max(counts):
        raise ValueError(f"the range must be within {max(counts)} vertices, got {start} to {stop}")
    if start % BLOCK and any("g" in axes for axes, _ in leaves):
        raise ValueError(f"the range must begin at a multiple of {BLOCK} vertices, got {start}")
    made = [_part(axes, leaf, start, stop) for axes, leaf in leaves]
    return jax.tree.unflatten(jax.tree.structure(value), made)


def _part(axes: list[str], leaf: Any, start: int, stop: int) -> Any:
    """The range of one array, copied, so that what is mapped is read once."""
    if "v" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start, stop - start, axes.index("v"))
    if "g" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start // BLOCK, -(-(stop - start) // BLOCK), axes.index("g"))
    return leaf


def _leaves(value: PyTree) -> Iterator[tuple[list[str], Any]]:
    """The leaves, in order, each with the names of its axes by the annotation of the field that holds it."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(value):
        hint: Any = None
        node: Any = value
        for key in path:
            if isinstance(key, jax.tree_util.GetAttrKey) and dataclasses.is_dataclass(node):
                hint = {each.name: each.type for each in dataclasses.fields(node)}[key.name]
                node = getattr(node, key.name)
            elif isinstance(key, jax.tree_util.SequenceKey | jax.tree_util.DictKey):
                node = node[key.idx if isinstance(key, jax.tree_util.SequenceKey) else key.key]
        yield _axes(hint, leaf), leaf


def _axes(hint: Any, leaf: Any) -> list[str]:
    """Names of the axes of an array; none where the annotation does not fit it."""
    if not isinstance(leaf, jax.Array | np.ndarray):
        return []
    for each in (hint, *typing.get_args(hint)):
        axes = getattr(each, "dim_str", "").split()
        if axes and len(axes) == leaf.ndim:
            return axes
    return []
