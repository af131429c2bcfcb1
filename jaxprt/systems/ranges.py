"""Ranges of vertices, for relighting piece by piece when a transport or system is larger than memory."""

import operator
from typing import Any, TypeVar

import equinox as eqx
import jax
from jaxtyping import PyTree

from jaxprt.scene.mesh import Mesh
from jaxprt.systems.axes import leaves, map_leaves
from jaxprt.systems.protocol import System, VertexSystem
from jaxprt.systems.separable import SparseTransport
from jaxprt.visibility.rays import BLOCK

Piece = TypeVar("Piece", bound=PyTree)


def take(value: Piece, start: int, stop: int) -> Piece:
    """A transport or a system restricted to a range of its vertices.

    The same functions run on the result and return rows for the vertices of the range. If the transport is
    memory-mapped, as `jaxprt.files.load` returns it, only the range is read into memory:

        for start in range(0, vertices, 1 << 16):
            rows = take(system, start, min(start + (1 << 16), vertices)).combine(light, view)

    Args:
        value: A transport, or a system of one mesh.
        start: Index of the first vertex. With stored visibility it must be a multiple of 64.
        stop: Index after the last vertex.

    Returns:
        The restricted transport or system. The copy that `SparseTransport.with_transpose` adds is dropped. Ranges of
        equal length share compiled programs.

    Raises:
        TypeError: `value` has no vertices, has clusters of vertices (which a range would cut), or is a scene or a sum
            of parts; or `start` or `stop` is not a whole number.
        ValueError: The range is empty or exceeds the vertices, or `start` is not a multiple of 64 with stored
            visibility.
    """
    start, stop = operator.index(start), operator.index(stop)
    if isinstance(value, System) and not isinstance(value, VertexSystem):
        raise TypeError(f"value must be a system of one mesh, such as RelitScene.part_system(0), got {_kind(value)}")
    value = jax.tree.map(_bare, value, is_leaf=lambda part: isinstance(part, SparseTransport))
    rows = list(leaves(value))
    counts = {leaf.shape[axes.index("v")] for axes, leaf in rows if "v" in axes}
    if isinstance(value, Mesh) or len(counts) != 1:
        raise TypeError(f"value must be a transport or a system with vertices, got {_kind(value)}")
    if any("p" in axes or "g" in axes for axes, _ in rows):
        raise TypeError(f"value must have no clusters, because a range would cut them, got a {_kind(value)}")
    if not 0 <= start < stop <= max(counts):
        raise ValueError(f"the range must be within {max(counts)} vertices, got {start} to {stop}")
    if start % BLOCK and any("block" in axes for axes, _ in rows):
        raise ValueError(f"the range must begin at a multiple of {BLOCK} vertices, got {start}")
    return map_leaves(value, lambda axes, leaf: _cut(axes, leaf, start, stop))


def _kind(value: object) -> str:
    return type(value).__name__


def _bare(value: Any) -> Any:
    """Drops the transpose of sparse transport, which refers to all vertices."""
    if not isinstance(value, SparseTransport):
        return value
    return eqx.tree_at(lambda transport: transport.transpose, value, None, is_leaf=lambda leaf: leaf is None)


def _cut(axes: list[str], leaf: Any, start: int, stop: int) -> Any:
    """Copies the range of one array, so that memory-mapped arrays are read once."""
    if "v" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start, stop - start, axes.index("v"))
    if "block" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start // BLOCK, -(-(stop - start) // BLOCK), axes.index("block"))
    return leaf
