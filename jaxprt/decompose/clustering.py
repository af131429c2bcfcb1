"""Clustering of points into groups of equal size."""

import numpy as np
from jaxtyping import Float, Int

from jaxprt.decompose import eigen

_TIE = 1e-5  # coordinates that differ by less than this share of the width count as equal


def bisect(point: Float[np.ndarray, "v f"], *, clusters: int) -> Int[np.ndarray, "p m"]:
    """Divides points into clusters of equal size, by repeatedly halving across the direction of largest variance.

    With equal sizes, products over the members of all clusters form one dense batch. No cluster is empty.

    Args:
        point: Points, with coordinates in comparable units.
        clusters: Number of clusters.

    Returns:
        Indices of the m = ceil(v / clusters) points of each cluster. A cluster with one point fewer repeats its last.
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
        order = member[_order(offset @ axis[:, 0])]
        # Each side gets points for a whole number of clusters, so that final sizes differ by at most one.
        first = parts // 2
        cut = len(member) // parts * first + min(len(member) % parts, first)
        todo += [(order[cut:], parts - first), (order[:cut], first)]
    return np.stack(done)


def _order(along: Float[np.ndarray, " v"]) -> Int[np.ndarray, " v"]:
    """Indices of points in ascending order. Points with equal coordinates are ordered by index."""
    order = np.argsort(along, kind="stable")
    # Symmetric meshes have many equal coordinates, whose order must not depend on rounding: processors differ in it.
    rises = np.diff(along[order], prepend=along[order[0]]) > _TIE * np.ptp(along)
    return order[np.lexsort((order, np.cumsum(rises)))]
