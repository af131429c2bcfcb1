"""Arrays of meshes in files, before they become a `Mesh`: put in their places and joined."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Geometry(NamedTuple):
    """Vertices and triangles in NumPy arrays. None stands for what a file does not have.

    Attributes:
        position: [v 3].
        face: Vertex numbers [f 3].
        normal: [v 3] of any length; NaN or zero where there is none.
        tangent: [v 3] of any length; zero where there is none.
        handedness: [v], 1 where the bitangent of normal maps is cross(normal, tangent), and -1 where it is opposite.
        texture: Texture coordinates [v 2], v up.
        second: A second set of texture coordinates.
        color: Linear colors [v 3], which multiply the base color.
        region: Number of the region of each vertex [v].
    """

    position: np.ndarray
    face: np.ndarray
    normal: np.ndarray | None = None
    tangent: np.ndarray | None = None
    handedness: np.ndarray | None = None
    texture: np.ndarray | None = None
    second: np.ndarray | None = None
    color: np.ndarray | None = None
    region: np.ndarray | None = None


# What takes the place of what only some geometries have: shape per vertex, and value.
_MISSING = {
    "normal": ((3,), np.nan),
    "tangent": ((3,), 0.0),
    "handedness": ((), 1.0),
    "texture": ((2,), 0.0),
    "second": ((2,), 0.0),
    "color": ((3,), 1.0),
    "region": ((), 0.0),
}


def placed(geometry: Geometry, matrix: np.ndarray) -> Geometry:
    """A geometry under an affine transform [4 4]; one that mirrors turns faces over, so that fronts stay outside.

    Normals are transformed by the cofactor matrix, which is defined for transforms that flatten or collapse too.
    """
    if np.array_equal(matrix, np.eye(4)):
        return geometry
    linear = np.asarray(matrix, np.float64)[:3, :3]
    cofactor = np.stack([np.cross(linear[i - 2], linear[i - 1]) for i in range(3)])
    sign = -1 if np.linalg.det(linear) < 0 else 1
    handedness = geometry.handedness
    if sign < 0 and geometry.tangent is not None:
        handedness = -(np.ones(len(geometry.position)) if handedness is None else handedness)
    return geometry._replace(
        position=geometry.position @ linear.T + matrix[:3, 3],
        face=geometry.face[:, ::sign],
        normal=None if geometry.normal is None else sign * geometry.normal @ cofactor.T,
        tangent=None if geometry.tangent is None else geometry.tangent @ linear.T,
        handedness=handedness,
    )


def joined(geometries: Sequence[Geometry]) -> Geometry:
    """One geometry of one or more, in their order."""
    if len(geometries) == 1:
        return geometries[0]
    start = np.cumsum([0, *(len(each.position) for each in geometries)])
    face = np.concatenate([each.face + first for each, first in zip(geometries, start[:-1], strict=True)])
    field = {name: _column(geometries, name, *missing) for name, missing in _MISSING.items()}
    return Geometry(np.concatenate([each.position for each in geometries]), face, **field)


def _column(geometries: Sequence[Geometry], name: str, shape: tuple[int, ...], value: float) -> np.ndarray | None:
    each = [getattr(geometry, name) for geometry in geometries]
    if all(array is None for array in each):
        return None
    return np.concatenate(
        [
            np.full((len(geometry.position), *shape), value) if array is None else array
            for array, geometry in zip(each, geometries, strict=True)
        ]
    )
