"""Where rays start at points between the vertices."""

import numpy as np
from jaxtyping import Float32

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.points import Points
from jaxprt.visibility.rays import Occluder


def point_starts(mesh: Mesh, points: Points, occluder: Occluder) -> Float32[np.ndarray, "p 3"]:
    """Points just off the triangles on which points lie, on the side of their shading normals.

    Args:
        mesh: The mesh.
        points: On its triangles.
        occluder: What casts shadows.

    Raises:
        ValueError: The points are no points of triangles.
    """
    if len(points.corner) != 3:
        raise ValueError(f"points must have three corners, got {len(points.corner)}")
    a, b, c = np.asarray(mesh.position, np.float64)[np.asarray(points.corner)]
    normal = np.asarray(points.carry(mesh.normal), np.float64)
    facing = np.cross(b - a, c - a)
    length = np.linalg.norm(facing, axis=1, keepdims=True)
    facing = np.where(length > 0, facing / np.where(length > 0, length, 1), normal)
    side = np.where(np.sum(facing * normal, 1, keepdims=True) < 0, -1.0, 1.0)
    return np.asarray(points.carry(mesh.position) + occluder.nudge * side * facing, np.float32)
