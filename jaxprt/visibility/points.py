"""Visibility of surface points between vertices: interpolated from the vertices, or traced with rays of their own."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.points import Points
from jaxprt.visibility.occluder import offsets


class PointVisibility(eqx.Module):
    """Visibility of single texels at surface points, interpolated from the vertices of their triangles.

    Attributes:
        vertices: Visibility of the vertices.
        points: The surface points.
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
        """Visible fraction of some texels, from 0 to 1."""
        return self.points.carry(self.vertices.visible(texel), axis=1)


def point_starts(mesh: Mesh, points: Points) -> Float32[np.ndarray, "p 3"]:
    """Origins of rays from surface points, off the triangle by what rounding needs, on the side of the shading normal.

    Args:
        mesh: The mesh.
        points: Points on the mesh's triangles.

    Raises:
        ValueError: The points do not have three corners.
    """
    if len(points.corner) != 3:
        raise ValueError(f"points must have three corners, got {len(points.corner)}")
    corner = np.asarray(points.corner)
    position = np.asarray(mesh.position, np.float32)
    a, b, c = position[corner].astype(np.float64)
    normal = np.asarray(points.carry(mesh.normal), np.float64)
    facing = np.cross(b - a, c - a)
    length = np.linalg.norm(facing, axis=1, keepdims=True)
    facing = np.where(length > 0, facing / np.where(length > 0, length, 1), normal)
    side = np.where(np.sum(facing * normal, 1, keepdims=True) < 0, -1.0, 1.0)
    weight = np.asarray(points.weight, np.float64)  # a rounded sum would move points out of the plane
    place = np.einsum("kp,kpi->pi", weight / weight.sum(0), np.stack([a, b, c]))
    return (place + offsets(position, corner.T)[:, None] * side * facing).astype(np.float32)
