"""Visibility of points between the vertices: interpolated, or by rays of their own."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.points import Points
from jaxprt.visibility.occluder import Occluder


class PointVisibility(eqx.Module):
    """Visibility of single texels at points: the mean of what the corners of their triangles see.

    Attributes:
        vertices: Visibility of the vertices.
        points: The points.
    """

    vertices: Any
    points: Points

    @property
    def position(self) -> Float[Array, "p 3"]:
        """Positions in world units."""
        return self.points.carry(self.vertices.position)

    @property
    def frame(self) -> Float[Array, "p 3 3"]:
        """Rows are tangent, bitangent, normal."""
        return self.points.frame(self.vertices.frame)

    @property
    def size(self) -> int:
        """Edge of the cubemap's faces in texels."""
        return self.vertices.size

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t p"]:
        """Share of some texels that is seen."""
        return self.points.carry(self.vertices.visible(texel), axis=1)


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
