"""Ranges of vertices: transport or systems that are larger than the memory, relit piece by piece."""

import operator
from typing import Any, TypeVar

import equinox as eqx
import jax
from jaxtyping import PyTree

from jaxprt.scene.mesh import Mesh
from jaxprt.systems.axes import leaves
from jaxprt.systems.protocol import System, VertexSystem
from jaxprt.systems.separable import SparseTransport
from jaxprt.visibility.rays import BLOCK

Piece = TypeVar("Piece", bound=PyTree)


def take(value: Piece, start: int, stop: int) -> Piece:
    """A range of the vertices of a transport or a system, as one of its own.

    The same functions run on it, and what they return are the rows of the range. Of transport that is mapped from a
    file, as `jaxprt.files.load` makes it, only the range is read and held:

        for start in range(0, vertices, 1 << 16):
            rows = take(system, start, min(start + (1 << 16), vertices)).combine(light, view)

    Args:
        value: A transport, or a system of one mesh.
        start: First vertex; a multiple of 64 where visibility is stored.
        stop: The vertex after the last.

    Returns:
        The same of fewer vertices, without what gradients by the light would take beside it
        (`SparseTransport.with_transpose`). Ranges of one length share their compiled functions.

    Raises:
        TypeError: It has no vertices, or clusters of them, which a range would cut; it is a scene, a sum of parts, or a
            system at points; or the ends are no whole numbers.
        ValueError: The range is empty or beyond the vertices, or does not begin with a block of stored visibility.
    """
    start, stop = operator.index(start), operator.index(stop)
    if isinstance(value, System) and not isinstance(value, VertexSystem):
        raise TypeError(f"ranges are of systems of one mesh, as the parts of RelitScene.system, got {_kind(value)}")
    if isinstance(value, VertexSystem) and value.points is not None:
        raise TypeError(f"ranges are of systems at vertices, got {_kind(value)} at points")
    value = jax.tree.map(_bare, value, is_leaf=lambda each: isinstance(each, SparseTransport))
    every = list(leaves(value))
    counts = {leaf.shape[axes.index("v")] for axes, leaf in every if "v" in axes}
    if isinstance(value, Mesh) or len(counts) != 1:
        raise TypeError(f"ranges are of transports and systems that have vertices, got {_kind(value)}")
    if any("p" in axes or "g" in axes for axes, _ in every):
        raise TypeError(f"ranges are of transport without clusters, which a range would cut, got {_kind(value)}")
    if not 0 <= start < stop <= max(counts):
        raise ValueError(f"the range must be within {max(counts)} vertices, got {start} to {stop}")
    if start % BLOCK and any("block" in axes for axes, _ in every):
        raise ValueError(f"the range must begin at a multiple of {BLOCK} vertices, got {start}")
    made = [_cut(axes, leaf, start, stop) for axes, leaf in every]
    return jax.tree.unflatten(jax.tree.structure(value), made)


def _kind(value: Any) -> str:
    return type(value).__name__


def _bare(value: Any) -> Any:
    """Sparse transport without its transpose, which has numbers of all rows."""
    if not isinstance(value, SparseTransport):
        return value
    return eqx.tree_at(lambda each: each.transpose, value, None, is_leaf=lambda each: each is None)


def _cut(axes: list[str], leaf: Any, start: int, stop: int) -> Any:
    """The range of one array, copied, so that what is mapped is read once."""
    if "v" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start, stop - start, axes.index("v"))
    if "block" in axes:
        return jax.lax.dynamic_slice_in_dim(leaf, start // BLOCK, -(-(stop - start) // BLOCK), axes.index("block"))
    return leaf
