"""Shading normals of meshes that bring none."""

import numpy as np
from jaxtyping import Float, Integer

_CREASE = np.cos(np.radians(40))  # smallest cosine between a shared normal and that of each split vertex


def vertex_normals(
    position: Float[np.ndarray, "v 3"], face: Integer[np.ndarray, "f 3"], welded: bool
) -> Float[np.ndarray, "v 3"]:
    """Unit normals: means of face normals, weighted by their angles at the vertex.

    Args:
        position: Positions of the vertices, in float64.
        face: Vertex indices of each triangle.
        welded: Whether vertices at one position share such a mean, unless they form a crease.
    """
    corner = position[face]
    edge = np.roll(corner, -1, 1) - corner
    cross = np.cross(edge[:, 0], edge[:, 1])
    area = np.linalg.norm(cross, axis=1)
    # The normal of a face thinner than the resolution of float32 is only rounding error.
    thickness = 2 * np.spacing(np.abs(corner).max((1, 2)).astype(np.float32)).astype(np.float64)
    thin = area <= thickness * np.linalg.norm(edge, axis=2).max(1)
    unit = cross / np.where(area > 0, area, 1)[:, None]
    angle = np.arctan2(area[:, None], -(edge * np.roll(edge, 1, 1)).sum(2))
    weighted = (np.where(thin[:, None], 0, angle)[:, :, None] * unit[:, None]).reshape(-1, 3)

    def mean(index, count):
        total = np.stack([np.bincount(index, weighted[:, axis], count) for axis in range(3)], -1)
        length = np.linalg.norm(total, axis=1, keepdims=True)
        return np.where(length > 1e-6, total / np.maximum(length, 1e-6), 0)

    vertex = face.ravel()
    normal = mean(vertex, len(position))
    if welded:
        _, place = np.unique(position, axis=0, return_inverse=True)
        shared = mean(place.reshape(-1)[vertex], place.max() + 1)[place.reshape(-1)]
        smooth = (shared * normal).sum(1, keepdims=True) > _CREASE
        normal = np.where(smooth, shared, normal)
    # Where face normals cancel, any of them is used, thin faces last.
    order = np.argsort(~thin, kind="stable")
    some = np.tile([0.0, 1.0, 0.0], (len(position), 1))
    order = order[area[order] > 0]
    some[face[order]] = unit[order, None]
    return np.where((normal == 0).all(1, keepdims=True), some, normal)
