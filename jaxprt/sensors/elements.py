"""Elements of surfaces that send light to points: pieces of triangles, with a radiance for each of their sides."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from jaxprt.scene.mesh import Mesh

_COUNT = 6000  # elements of a scene, about
_TURN = 0.1  # distance that normals of opposite directions count as, in diagonals of the scene


class Elements(NamedTuple):
    """Elements of a mesh.

    Attributes:
        place: A point in the middle of each.
        normal: Unit normal of its front, by the order of the corners.
        triangle: The triangle that it is part of.
        weight: Barycentric coordinates of the point in it.
        parts: Number of pieces along an edge of each triangle.
        first: Index in `piece` of the first piece of each triangle.
        piece: Element of each piece; several pieces may belong to one.
    """

    place: Float32[np.ndarray, "e 3"]
    normal: Float32[np.ndarray, "e 3"]
    triangle: Int[np.ndarray, " e"]
    weight: Float[np.ndarray, "e 3"]
    parts: Int[np.ndarray, " f"]
    first: Int[np.ndarray, " f"]
    piece: Int[np.ndarray, " n"]

    def at(
        self, triangle: Int[np.ndarray, " h"], weight: Float[np.ndarray, "h 3"], behind: Bool[np.ndarray, " h"]
    ) -> Int[np.ndarray, " h"]:
        """Index among the sides of all elements, first the fronts, of points on triangles."""
        count = self.parts[triangle]
        right, up = (np.clip(weight[:, axis], 0, 1) * count for axis in (1, 2))
        column, row = (np.minimum(np.floor(value).astype(np.int64), count - 1) for value in (right, up))
        row = np.minimum(row, count - 1 - column)
        over = ((right - column) + (up - row) > 1) & (column + row < count - 1)
        element = self.piece[self.first[triangle] + 2 * (column * count + row) + over]
        return element + len(self.place) * behind


def divide(mesh: Mesh) -> Elements:
    """Divides the triangles of a mesh into about as many elements as reflections need.

    Large triangles are cut into pieces of about one size. If there are more small ones than elements, each belongs to
    the nearest of some that are chosen by area, among those of a similar normal.

    Args:
        mesh: The mesh, in NumPy.
    """
    position, face = np.asarray(mesh.position, np.float64), np.asarray(mesh.face)
    a, b, c = (position[face[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    double = np.linalg.norm(across, axis=1)
    edge = np.max([np.linalg.norm(side, axis=1) for side in (b - a, c - b, a - c)], 0)
    step = np.sqrt(double.sum() / _COUNT)
    parts = np.clip(np.ceil(edge / max(step, 1e-30)).astype(np.int64), 1, 64)
    while np.sum(parts**2) > 2 * _COUNT and parts.max() > 1:
        step *= 1.2
        parts = np.clip(np.ceil(edge / step).astype(np.int64), 1, 64)
    first = np.cumsum(2 * parts**2) - 2 * parts**2
    triangle, weight, key = _pieces(parts, first)
    place = np.einsum("ek,ekj->ej", weight, position[face[triangle]])
    normal = (across / np.maximum(double, 1e-30)[:, None])[triangle]
    piece = np.zeros(int((2 * parts**2).sum()), np.int64)
    piece[key] = np.arange(len(key))
    if len(place) > 3 * _COUNT:
        share = double[triangle] / parts[triangle] ** 2
        chosen = np.random.default_rng(0).choice(len(place), _COUNT, replace=False, p=share / share.sum())
        diagonal = np.linalg.norm(np.ptp(place, axis=0))
        around = np.concatenate([place, _TURN / 2 * diagonal * normal], 1)
        nearest = cKDTree(around[chosen]).query(around)[1]
        piece[key] = nearest
        place, normal, triangle, weight = place[chosen], normal[chosen], triangle[chosen], weight[chosen]
    return Elements(place.astype(np.float32), normal.astype(np.float32), triangle, weight, parts, first, piece)


def _pieces(
    parts: Int[np.ndarray, " f"], first: Int[np.ndarray, " f"]
) -> tuple[Int[np.ndarray, " e"], Float[np.ndarray, "e 3"], Int[np.ndarray, " e"]]:
    """The triangle of each piece, barycentric coordinates of its middle, and its index as `Elements.at` counts."""
    triangle, weight, key = [], [], []
    for count in np.unique(parts):
        column, row = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
        inside = column + row < count
        below, above = inside.ravel(), (column + row < count - 1).ravel()
        column, row = column.ravel(), row.ravel()
        right = np.concatenate([column[below] + 1 / 3, column[above] + 2 / 3]) / count
        up = np.concatenate([row[below] + 1 / 3, row[above] + 2 / 3]) / count
        number = 2 * (column * count + row)
        local = np.concatenate([number[below], number[above] + 1])
        same = np.flatnonzero(parts == count)
        triangle.append(same.repeat(len(local)))
        weight.append(np.tile(np.stack([1 - right - up, right, up], -1), (len(same), 1)))
        key.append((first[same][:, None] + local).ravel())
    return np.concatenate(triangle), np.concatenate(weight), np.concatenate(key)
