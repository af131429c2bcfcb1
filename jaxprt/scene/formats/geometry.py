"""Geometry as read from files, before it becomes a `Mesh`: transformed and joined."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Geometry(NamedTuple):
    """Vertices and triangles in NumPy arrays. Attributes that a file does not have are None.

    Attributes:
        position: Vertex positions [v 3].
        face: Vertex indices [f 3].
        normal: Normals [v 3] of any length; NaN or zero where missing.
        tangent: Tangents [v 3] of any length; zero where missing.
        handedness: 1 where the bitangent of normal maps is cross(normal, tangent), and -1 where it is opposite [v].
        texture: Texture coordinates [v 2], v up.
        second: Second set of texture coordinates [v 2].
        color: Linear vertex colors [v 3], which multiply the base color.
        alpha: Opacity of vertices [v], which multiplies that of the material.
        region: Index of the region of each vertex [v].
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
    alpha: np.ndarray | None = None


class MeshContent(NamedTuple):
    """What a mesh file holds.

    Attributes:
        geometry: The geometry. Colors are NaN where vertices have none.
        images: Name of the image file of each region's base color; None where there is none.
        ignored: What the file holds and cannot be read, for a warning.
    """

    geometry: Geometry
    images: list[str | None]
    ignored: set[str]


# Defaults for attributes that only some geometries have: shape per vertex, and value.
_MISSING = {
    "normal": ((3,), np.nan),
    "tangent": ((3,), 0.0),
    "handedness": ((), 1.0),
    "texture": ((2,), 0.0),
    "second": ((2,), 0.0),
    "color": ((3,), 1.0),
    "region": ((), 0.0),
    "alpha": ((), 1.0),
}


def placed(geometry: Geometry, matrix: np.ndarray) -> Geometry:
    """Applies an affine transform [4 4] to a geometry. If it mirrors, faces are flipped so that fronts stay outside.

    Normals are transformed by the cofactor matrix, which is also defined for singular transforms.
    """
    if np.array_equal(matrix, np.eye(4)):
        return geometry
    return instances(geometry, np.asarray(matrix, np.float64)[None])[0]


def instances(geometry: Geometry, matrices: np.ndarray) -> list[Geometry]:
    """Applies each of several affine transforms [n 4 4] to a geometry, as `placed` does."""
    linear, shift = matrices[:, :3, :3], matrices[:, None, :3, 3]
    columns = linear.transpose(0, 2, 1)
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        mirrored = np.linalg.det(linear) < 0
        position = geometry.position @ columns + shift
        normal = tangent = [None] * len(matrices)
        if geometry.normal is not None:
            cofactor = cofactors(linear) * np.where(mirrored, -1, 1)[:, None, None]
            normal = geometry.normal @ cofactor.transpose(0, 2, 1)
        if geometry.tangent is not None:
            tangent = geometry.tangent @ columns
    face = (geometry.face, geometry.face[:, ::-1])
    handedness = (geometry.handedness, geometry.handedness)
    if geometry.tangent is not None:
        plain = np.ones(len(geometry.position)) if geometry.handedness is None else geometry.handedness
        handedness = (geometry.handedness, -plain)
    return [
        geometry._replace(
            position=position[row],
            face=face[flip],
            normal=normal[row],
            tangent=tangent[row],
            handedness=handedness[flip],
        )
        for row, flip in enumerate(mirrored.astype(int).tolist())
    ]


def cofactors(linear: np.ndarray) -> np.ndarray:
    """Cofactor matrices of linear maps [n 3 3], which transform normals, also where a map is singular."""
    return np.cross(linear[:, [1, 2, 0]], linear[:, [2, 0, 1]])


def split_corners(columns: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices for corners that differ in one of several columns, in ascending order of the columns.

    Args:
        columns: Numbers without NaN, one for each corner [c].

    Returns:
        Index of a corner of each vertex [v], and the vertex of each corner [c].
    """
    key = np.zeros(len(columns[0]), np.int64)
    for column in columns:
        value, number = np.unique(column, return_inverse=True)
        _, key = np.unique(key * len(value) + number.reshape(-1), return_inverse=True)
        key = key.reshape(-1)
    _, first = np.unique(key, return_index=True)
    return first, key


def first_appearance(label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The different labels in the order of their first appearance, and for each row its index in them."""
    value, first, number = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return value[order], np.argsort(order)[number.reshape(-1)]


def joined(geometries: Sequence[Geometry]) -> Geometry:
    """Joins one or more geometries into one, in order."""
    if len(geometries) == 1:
        return geometries[0]
    start = np.cumsum([0, *(len(each.position) for each in geometries)])
    face = np.concatenate([each.face + first for each, first in zip(geometries, start[:-1], strict=True)])
    field = {name: _column(geometries, name, *missing) for name, missing in _MISSING.items()}
    return Geometry(np.concatenate([each.position for each in geometries]), face, **field)


def rows_of(region: np.ndarray, numbers: np.ndarray) -> list[np.ndarray]:
    """Indices of the rows of each region, in ascending order. They are sorted once, whatever the number of regions.

    Args:
        region: Number of the region of each row.
        numbers: The regions, in ascending order.
    """
    order = np.argsort(region, kind="stable")
    return np.split(order, np.searchsorted(region[order], numbers[1:]))


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
