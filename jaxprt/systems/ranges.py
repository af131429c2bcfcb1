"""Ranges of vertices: transport or systems that are larger than the memory, relit piece by piece."""

from typing import Any, TypeVar

import jax
from jaxtyping import PyTree

from jaxprt.systems.axes import leaves
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
    every = list(leaves(value))
    counts = {leaf.shape[axes.index("v")] for axes, leaf in every if "v" in axes}
    if len(counts) != 1 or any("p" in axes or "g" in axes for axes, _ in every):
        raise TypeError(f"ranges are of transport that has vertices and no clusters, got {type(value).__name__}")
    if not 0 <= start < stop <= max(counts):
        raise ValueError(f"the range must be within {max(counts)} vertices, got {start} to {stop}")
    if start % BLOCK and any("block" in axes for axes, _ in every):
        raise ValueError(f"the range must begin at a multiple of {BLOCK} vertices, got {start}")
    made = [_part(axes, leaf, start, stop) for axes, leaf in every]
    return jax.tree.unflatten(jax.tree.structure(value), made)


def _part(axes: list[str], leaf: Any, start: int, stop: int) -> Any:
    """The range of one array, copied, so that what is mapped is read once."""
    if "v" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start, stop - start, axes.index("v"))
    if "block" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start // BLOCK, -(-(stop - start) // BLOCK), axes.index("block"))
    return leaf
