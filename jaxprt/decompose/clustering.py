"""Groups of points that lie together."""

import numpy as np
from jaxtyping import Float, Int

from jaxprt.decompose import eigen

_TIE = 1e-5  # of the width, below which neighbors are side by side


def bisect(point: Float[np.ndarray, "v f"], *, clusters: int) -> Int[np.ndarray, "p m"]:
    """Cuts points into clusters of equal size, halving across the widest direction until there are enough.

    Equal sizes make the products over a cluster's members one dense batch. No cluster can be empty.

    Args:
        point: Points, with coordinates in comparable units.
        clusters: How many clusters.

    Returns:
        Numbers of each cluster's m = ceil(v / clusters) points; where a cluster has one fewer, its last is repeated.

    Raises:
        ValueError: Fewer points than clusters, or points that are not finite.
    """
    if not 1 <= clusters <= len(point):
        raise ValueError(f"clusters must be between 1 and the {len(point)} points, got {clusters}")
    if not np.isfinite(point).all():
        raise ValueError(f"points must be finite, got {np.count_nonzero(~np.isfinite(point).all(1))} that are not")
    size = -(-len(point) // clusters)
    todo, done = [(np.arange(len(point)), clusters)], []
    while todo:
        member, parts = todo.pop()
        if parts == 1:
            done.append(np.pad(member, (0, size - len(member)), "edge"))
            continue
        offset = point[member] - point[member].mean(0)
        value, axis = np.linalg.eigh(offset.T @ offset)
        axis = axis[:, ::-1] @ eigen.orientation(value[::-1], axis[:, ::-1])
        order = member[_ordered(offset @ axis[:, 0])]
        # Whole clusters' worth of points on either side, so that in the end all sizes differ by at most one.
        first = parts // 2
        cut = len(member) // parts * first + min(len(member) % parts, first)
        todo += [(order[cut:], parts - first), (order[:cut], first)]
    return np.stack(done)


def _ordered(along: Float[np.ndarray, " v"]) -> Int[np.ndarray, " v"]:
    """Points in rising order, those that are side by side by their numbers.

    Symmetric meshes have many of these, and rounding, which is another on other processors, must not order them.
    """
    order = np.argsort(along, kind="stable")
    rises = np.diff(along[order], prepend=along[order[0]]) > _TIE * np.ptp(along)
    return order[np.lexsort((order, np.cumsum(rises)))]
