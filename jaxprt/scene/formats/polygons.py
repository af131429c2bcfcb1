"""Division of polygons into triangles."""

import warnings
from collections.abc import Mapping
from typing import NamedTuple

import mapbox_earcut
import numpy as np

from jaxprt.scene.formats.geometry import Geometry, split_corners

_BLOCK = 1 << 18  # corners that are tested at once, to bound the memory
_CLIPPED = 2000  # corners of a polygon up to which ear clipping ends within .1 s, whatever crosses
_LINES = 32  # along which edges of larger polygons are tested, for each of two directions
_REVERSED = 1e-9  # area of a triangle of the other orientation, relative to the squared size, that is rounding error


class Polygons(NamedTuple):
    """Polygons of a file.

    Attributes:
        corner: Vertex indices of all polygons, one polygon after the other [c].
        size: Number of corners of each polygon [p].
    """

    corner: np.ndarray
    size: np.ndarray


class Triangles(NamedTuple):
    """Triangles of polygons.

    Attributes:
        corner: Positions of the corners of each triangle in `Polygons.corner` [t 3].
        polygon: Index of each triangle's polygon [t].
    """

    corner: np.ndarray
    polygon: np.ndarray


def of_rows(row: np.ndarray) -> Polygons:
    """Polygons that all have the same number of corners, from their vertex indices [p n]."""
    return Polygons(row.reshape(-1), np.full(len(row), row.shape[1]))


def check(polygons: Polygons, vertices: int, name: str) -> None:
    """Refuses polygons that refer to vertices that do not exist.

    Args:
        polygons: The polygons.
        vertices: Number of vertices.
        name: Name of the file.

    Raises:
        ValueError: A vertex does not exist. The message states how many polygons are wrong, and the first one.
    """
    wrong = (polygons.corner < 0) | (polygons.corner >= vertices)
    if wrong.any():
        end = np.cumsum(polygons.size)
        face = np.unique(np.searchsorted(end, np.flatnonzero(wrong), side="right"))
        first = polygons.corner[end[face[0]] - polygons.size[face[0]] : end[face[0]]].tolist()
        text = str(first) if len(first) <= 12 else f"{str(first[:12])[:-1]}, ...]"
        raise ValueError(
            f"{name}: faces must refer to vertices 0 to {vertices - 1}, got {len(face)} of {len(polygons.size)} faces "
            f"that refer to others, the first is {text} at face {face[0]}"
        )


def triangulate(position: np.ndarray, polygons: Polygons, name: str) -> Triangles:
    """Divides polygons into triangles of the same orientation, in the order of the polygons.

    A polygon becomes the fan of its first corner where all triangles of the fan face its front. Otherwise a
    quadrilateral is cut at the other diagonal, and a polygon with more corners is projected along its normal (Newell's)
    and divided by ear clipping. Polygons without area stay fans. Polygons with fewer than three corners have no
    triangles.

    Ear clipping takes hours where thousands of edges cross each other. Such polygons stay fans too, with a warning.

    Args:
        position: Vertex positions [v 3].
        polygons: The polygons. All vertices must exist.
        name: Name of the file.
    """
    slots = np.maximum(polygons.size - 2, 0)
    first_slot, first_corner = np.cumsum(slots) - slots, np.cumsum(polygons.size) - polygons.size
    triangle = np.empty((slots.sum(), 3), np.int64)
    crossed: list[int] = []
    for size in np.unique(polygons.size[slots > 0]):
        same = np.flatnonzero(polygons.size == size)
        step = max(1, _BLOCK // size)
        for start in range(0, len(same), step):
            polygon = same[start : start + step]
            local, left = _divide(position, polygons.corner[first_corner[polygon, None] + np.arange(size)])
            crossed += polygon[left].tolist()
            place = first_slot[polygon, None] + np.arange(size - 2)
            triangle[place] = np.where(local < 0, -1, local + first_corner[polygon, None, None])
    if crossed:
        first = min(crossed)
        warnings.warn(
            f"{name}: faces should not cross themselves, got {len(crossed)} of {len(slots)} large ones that do, the "
            f"first is face {first} of {polygons.size[first]} corners: they are divided into the fans of their first "
            "corners",
            stacklevel=7,
        )
    used = triangle[:, 0] >= 0
    return Triangles(triangle[used], np.repeat(np.arange(len(slots)), slots)[used])


def geometry(
    position: np.ndarray,
    polygons: Polygons,
    of_vertex: Mapping[str, np.ndarray | None],
    of_corner: Mapping[str, np.ndarray | None],
    of_face: Mapping[str, np.ndarray | None],
    name: str,
) -> Geometry:
    """The triangles of polygons. Vertices are split where corners differ in attributes of corners or faces.

    If there are such attributes, vertices without faces are dropped. Texture coordinates that are not finite become 0.

    Args:
        position: Vertex positions [v 3].
        polygons: The polygons.
        of_vertex: Fields of `Geometry` for each vertex, with v rows; None where there are none.
        of_corner: Fields for each corner of `Polygons.corner`.
        of_face: Fields for each polygon.
        name: Name of the file.
    """
    triangle = triangulate(position, polygons, name)
    face = np.repeat(np.arange(len(polygons.size)), polygons.size)
    used = polygons.size[face] > 2
    field = {key: value for key, value in of_vertex.items() if value is not None}
    split = {key: value[used] for key, value in of_corner.items() if value is not None}
    split |= {key: value[face[used]] for key, value in of_face.items() if value is not None}
    corner = polygons.corner[triangle.corner]
    if split:
        columns = [column for value in split.values() for column in value.reshape(len(value), -1).T]
        first, number = split_corners([polygons.corner[used], *columns])
        vertex = polygons.corner[used][first]
        position = position[vertex]
        field = {key: value[vertex] for key, value in field.items()}
        field |= {key: value[first] for key, value in split.items()}
        corner = number[(np.cumsum(used) - 1)[triangle.corner]]
    if "texture" in field:
        field["texture"] = np.where(np.isfinite(field["texture"]), field["texture"], 0).astype(np.float64)
    if "color" in field and not np.isfinite(field["color"]).any():
        del field["color"]
    return Geometry(position, corner, **field)


def _divide(position: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of polygons with n corners [p n], and polygons that stay fans because too many of their edges cross.

    Returns:
        The triangles [p n-2 3] as numbers 0 to n-1 of corners, -1 where there are less; and indices of the polygons.
    """
    size, crossed = corner.shape[1], np.zeros(0, int)
    fan = np.stack([np.zeros(size - 2, int), np.arange(1, size - 1), np.arange(2, size)], -1)
    triangle = np.tile(fan, (len(corner), 1, 1))
    if size == 3:
        return triangle, crossed
    with np.errstate(invalid="ignore", over="ignore"):  # positions that are not finite are refused later
        point = position[corner] - position[corner[:, :1]]
        extent = np.abs(point).max((1, 2), keepdims=True)
        point /= np.where(np.isfinite(extent) & (extent > 0), extent, 1)
        # Newell's normal is the sum of the cross products of a fan, whether or not the polygon is planar.
        cross = np.cross(point[:, 1:-1], point[:, 2:])
        normal = cross.sum(1)
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal /= np.where(length > 0, length, 1)
        area = (cross @ normal[:, :, None])[..., 0]  # of the fan's triangles, doubled, negative where they are reversed
    concave = np.flatnonzero((area.min(1) < -_REVERSED) & (length[:, 0] > _REVERSED))
    if size == 4:
        other = np.array([[1, 2, 3], [1, 3, 0]])
        turned = _areas(point[concave], np.tile(other, (len(concave), 1, 1)), normal[concave])
        triangle[concave[turned.min(1) > area[concave].min(1)]] = other
        return triangle, crossed
    plane = _projected(point[concave], normal[concave])
    if size > _CLIPPED:
        crosses = np.array([_crosses_itself(corners) for corners in plane], bool)
        concave, crossed, plane = concave[~crosses], concave[crosses], plane[~crosses]
    ears = _clip_ears(plane, point[concave], normal[concave])
    covered = np.abs(_areas(point[concave], ears, normal[concave])).sum(1)
    better = np.abs(covered - length[concave, 0]) <= np.abs(np.abs(area[concave]).sum(1) - length[concave, 0])
    triangle[concave[better & (covered > 0)]] = ears[better & (covered > 0)]
    return triangle, crossed


def _projected(point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Polygons [p n 3] projected along their unit normals [p n 2]."""
    axis = np.eye(3)[np.abs(normal).argmin(1)]
    across = np.cross(axis, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return point @ np.stack([across, np.cross(normal, across)], -1)


def _crosses_itself(plane: np.ndarray) -> bool:
    """Whether many edges of a polygon [n 2] cross each other.

    Edges of a simple polygon cross a line upward and downward in turn, so the winding number beside the line is 0 or 1,
    or 0 or -1. The lines lie in the widest gap of each 32nd of the corners, along both axes, so they always meet a knot
    of a sixteenth of the corners.
    """
    for across, along in (plane.T, plane.T[::-1]):
        value = np.sort(across)
        for span in np.array_split(np.arange(len(value) - 1), _LINES):
            gap = value[span + 1] - value[span]
            widest = gap.argmax()
            if gap[widest] < _REVERSED:  # corners on a line, but for rounding errors
                continue
            level = value[span[widest]] + gap[widest] / 2
            below = across <= level
            start = np.flatnonzero(below != np.roll(below, -1))
            end = (start + 1) % len(plane)
            low, high = np.where(below[start], start, end), np.where(below[start], end, start)
            share = (level - across[low]) / (across[high] - across[low])
            place = along[low] + share * (along[high] - along[low])
            order = np.argsort(place)
            winding = np.cumsum(np.where(below[start], 1, -1)[order])
            apart = np.diff(place[order], append=np.inf) > _REVERSED + 1e-15 / gap[widest]  # or on top of each other
            if np.ptp(winding[apart]) > 1:
                return True
    return False


def _clip_ears(plane: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles [p n-2 3] of polygons [p n 3], as numbers of corners; -1 where there are less.

    Args:
        plane: The polygons, projected along their normals [p n 2].
        point: The polygons [p n 3].
        normal: Their unit normals [p 3].
    """
    size = point.shape[1]
    triangle = np.full((len(point), size - 2, 3), -1, np.int64)
    for polygon, corners in enumerate(plane):
        ears = mapbox_earcut.triangulate_float64(corners, np.array([size], np.uint32)).reshape(-1, 3)[: size - 2]
        triangle[polygon, : len(ears)] = ears
    backward = _areas(point, triangle, normal).sum(1) < 0
    triangle[backward] = triangle[backward, :, ::-1]
    for polygon in np.flatnonzero(triangle[:, -1, 0] < 0):
        _add_skipped(triangle[polygon : polygon + 1], point[polygon : polygon + 1], normal[polygon : polygon + 1])
    return triangle


def _add_skipped(triangle: np.ndarray, point: np.ndarray, normal: np.ndarray) -> None:
    """Adds triangles for corners that ear clipping left out, on a line or at one place, to those of one polygon.

    They have no area in the projection. Without them, polygons on the other side of the edge could show a gap.
    """
    size, free = point.shape[1], np.flatnonzero(triangle[0, :, 0] < 0)
    corner = np.unique(triangle[triangle >= 0])
    following = np.append(corner[1:], corner[:1] + size)
    skipped = [
        [start, start + step, start + step + 1]
        for start, end in zip(corner, following, strict=True)
        for step in range(1, end - start)
    ]
    added = np.array(skipped, np.int64).reshape(1, -1, 3) % size
    added = added[:, np.abs(_areas(point, added, normal))[0] <= _REVERSED][:, : len(free)]
    triangle[:, free[: added.shape[1]]] = added


def _areas(point: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Twice the areas [p t] of triangles [p t 3], projected along normals; negative where they are reversed."""
    first, second, third = np.moveaxis(point[np.arange(len(point))[:, None, None], triangle], 2, 0)
    area = (np.cross(second - first, third - first) @ normal[:, :, None])[..., 0]
    return np.where(triangle[..., 0] < 0, 0, area)
