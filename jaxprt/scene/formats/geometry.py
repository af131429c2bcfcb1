"""Geometry as mesh files hold it: vertices with attributes, polygons of any number of corners, and colors."""

import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mapbox_earcut
import numpy as np

from jaxprt.files import pixels

_BLOCK = 1 << 18  # corners that are tested at once, to bound the memory
_CLIPPED = 2000  # corners of a polygon up to which ear clipping ends within .1 s, whatever crosses
_LINES = 32  # along which edges of larger polygons are tested, for each of two directions
_REVERSED = 1e-9  # area of a triangle of the other orientation, relative to the squared size, that is rounding error
_ROUNDED = 64 * np.finfo(np.float64).eps  # height of a triangle that is rounding error, relative to its coordinates
_FLAT = 1e-12  # volume of a unit cube below which a transform has flattened it
_DISPLAY_MOST = 255.0  # largest value in files that write the whole numbers of 8-bit colors as other types
_BEYOND = 0.01  # by which colors may leave 0 to 1
_PAINTED_MOST = 2.0  # largest float that counts as a color above white, such as 1 and rounding


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
        names: Name of the image file of each region's base color, or of each region's material in OBJ files; None where
            there is none.
        ignored: What the file holds and cannot be read, for a warning.
        libraries: Names of the MTL files of an OBJ file.
        comment: The first line of an OBJ file, which may name the program that wrote it.
    """

    geometry: Geometry
    names: list[str | None]
    ignored: set[str]
    libraries: Sequence[str] = ()
    comment: str = ""


# Shape per vertex and value of attributes where only some geometries have them.
_MISSING = {"normal": ((3,), np.nan), "tangent": ((3,), 0.0), "handedness": ((), 1.0), "texture": ((2,), 0.0)}
_MISSING |= {"second": ((2,), 0.0), "color": ((3,), 1.0), "region": ((), 0.0), "alpha": ((), 1.0)}


def place(geometry: Geometry, matrix: np.ndarray) -> Geometry:
    """Applies an affine transform [4 4] to a geometry. If it mirrors, faces are flipped so that fronts stay outside.

    Normals are transformed by the cofactor matrix, which is also defined for singular transforms.
    """
    if np.array_equal(matrix, np.eye(4)):
        return geometry
    return instances(geometry, np.asarray(matrix, np.float64)[None])[0]


def instances(geometry: Geometry, matrices: np.ndarray) -> list[Geometry]:
    """Applies each of several affine transforms [n 4 4] to a geometry, as `place` does."""
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


def flat(matrices: np.ndarray) -> np.ndarray:
    """Whether affine transforms [n 4 4] map space to a plane, a line or a point [n]."""
    linear = matrices[:, :3, :3]
    size = np.abs(linear).max((1, 2), keepdims=True)
    with np.errstate(invalid="ignore"):  # meshes refuse positions that are not finite
        return ~(np.abs(np.linalg.det(linear / np.where(size > 0, size, 1))) > _FLAT)


def has_area(position: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Whether triangles [f 3] have more area than rounding errors in float64 give them [f]."""
    corner = position[face]
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        edge = np.roll(corner, -1, 1) - corner
        area = np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1)
        length = np.linalg.norm(edge, axis=2).max(1)
        return ~(area <= _ROUNDED * np.abs(corner).max((1, 2)) * length)


def with_area(geometry: Geometry) -> Geometry:
    """A geometry without triangles that have no area, and without vertices that no other triangle has."""
    used, face = np.unique(geometry.face[has_area(geometry.position, geometry.face)], return_inverse=True)
    fields = {name: value for name, value in geometry._asdict().items() if value is not None and name != "face"}
    return Geometry(face=face.reshape(-1, 3), **{name: value[used] for name, value in fields.items()})


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


def join_geometries(geometries: Sequence[Geometry]) -> Geometry:
    """Joins one or more geometries into one, in order."""
    if len(geometries) == 1:
        return geometries[0]
    start = np.cumsum([0, *(len(geometry.position) for geometry in geometries)])
    face = np.concatenate([geometry.face + first for geometry, first in zip(geometries, start[:-1], strict=True)])
    field = {name: _column(geometries, name, *missing) for name, missing in _MISSING.items()}
    return Geometry(np.concatenate([geometry.position for geometry in geometries]), face, **field)


def rows_of(region: np.ndarray, numbers: np.ndarray) -> list[np.ndarray]:
    """Indices of the rows of each of `numbers`, regions in ascending order. Rows are sorted once for all regions."""
    order = np.argsort(region, kind="stable")
    return np.split(order, np.searchsorted(region[order], numbers[1:]))


def _column(geometries: Sequence[Geometry], name: str, shape: tuple[int, ...], value: float) -> np.ndarray | None:
    columns = [getattr(geometry, name) for geometry in geometries]
    if all(array is None for array in columns):
        return None
    return np.concatenate(
        [
            np.full((len(geometry.position), *shape), value) if array is None else array
            for array, geometry in zip(columns, geometries, strict=True)
        ]
    )


class Polygons(NamedTuple):
    """Polygons of a file."""

    corner: np.ndarray  # vertex indices of all polygons, one polygon after the other [c]
    size: np.ndarray  # number of corners of each polygon [p]


class Triangles(NamedTuple):
    """Triangles of polygons."""

    corner: np.ndarray  # positions of the corners of each triangle in `Polygons.corner` [t 3]
    polygon: np.ndarray  # index of the polygon of each triangle [t]


def polygons_of_rows(row: np.ndarray) -> Polygons:
    """Polygons that all have the same number of corners, from their vertex indices [p n]."""
    return Polygons(row.reshape(-1), np.full(len(row), row.shape[1]))


def check_polygons(polygons: Polygons, vertices: int, name: str) -> None:
    """Refuses polygons of the file `name` without a face, and those that refer to vertices that do not exist."""
    if polygons.size.max(initial=0) < 3:
        raise ValueError(f"{name} must hold vertices and faces, got no faces")
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


def from_polygons(
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
    """Triangles [p n-2 3] of polygons [p n] by corner, -1 for none; and those that stay fans: too many edges cross."""
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
    plane = _project(point[concave], normal[concave])
    if size > _CLIPPED:
        crosses = np.array([_crosses_itself(corners) for corners in plane], bool)
        concave, crossed, plane = concave[~crosses], concave[crosses], plane[~crosses]
    ears = _clip_ears(plane, point[concave], normal[concave])
    covered = np.abs(_areas(point[concave], ears, normal[concave])).sum(1)
    better = np.abs(covered - length[concave, 0]) <= np.abs(np.abs(area[concave]).sum(1) - length[concave, 0])
    triangle[concave[better & (covered > 0)]] = ears[better & (covered > 0)]
    return triangle, crossed


def _project(point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Polygons [p n 3] projected along their unit normals [p n 2]."""
    axis = np.eye(3)[np.abs(normal).argmin(1)]
    across = np.cross(axis, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return point @ np.stack([across, np.cross(normal, across)], -1)


def _crosses_itself(plane: np.ndarray) -> bool:
    """Whether many edges of a polygon [n 2] cross each other."""
    for across, along in (plane.T, plane.T[::-1]):
        value = np.sort(across)
        # The lines, in the widest gap of each 32nd of the corners, always meet a knot of a sixteenth of the corners.
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
            # Edges of a simple polygon cross a line upward and downward in turn, so the winding number beside the line
            # is 0 or 1, or 0 or -1.
            winding = np.cumsum(np.where(below[start], 1, -1)[order])
            apart = np.diff(place[order], append=np.inf) > _REVERSED + 1e-15 / gap[widest]  # or on top of each other
            if np.ptp(winding[apart]) > 1:
                return True
    return False


def _clip_ears(plane: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Triangles [p n-2 3] by corner, -1 for none, of polygons [p n 3], whose projections along normals are `plane`."""
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
    """Adds triangles for corners that ear clipping left out, on a line or at one place, to those of one polygon."""
    size, free = point.shape[1], np.flatnonzero(triangle[0, :, 0] < 0)
    corner = np.unique(triangle[triangle >= 0])
    following = np.append(corner[1:], corner[:1] + size)
    skipped = [
        [start, start + step, start + step + 1]
        for start, end in zip(corner, following, strict=True)
        for step in range(1, end - start)
    ]
    added = np.array(skipped, np.int64).reshape(1, -1, 3) % size
    # They have no area in the projection. Without them, polygons on the other side of the edge could show a gap.
    added = added[:, np.abs(_areas(point, added, normal))[0] <= _REVERSED][:, : len(free)]
    triangle[:, free[: added.shape[1]]] = added


def _areas(point: np.ndarray, triangle: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Twice the areas [p t] of triangles [p t 3], projected along normals; negative where they are reversed."""
    first, second, third = np.moveaxis(point[np.arange(len(point))[:, None, None], triangle], 2, 0)
    area = (np.cross(second - first, third - first) @ normal[:, :, None])[..., 0]
    return np.where(triangle[..., 0] < 0, 0, area)


def _are_bytes(value: np.ndarray) -> bool:
    """Whether floats are colors between 0 and 255."""
    finite = value[np.isfinite(value)]
    if not _PAINTED_MOST < finite.max(initial=0) <= _DISPLAY_MOST:
        return False
    return bool((finite == np.round(finite)).all() or np.median(finite[finite > 0]) > _PAINTED_MOST)


def translucent(alpha: np.ndarray) -> bool:
    """Whether opacities of a mesh file are to be seen. Programs that have none write 0 or the largest everywhere."""
    plain = (0, 1, _DISPLAY_MOST) if alpha.dtype.kind == "f" else (0, -1, _DISPLAY_MOST, np.iinfo(np.uint16).max)
    return bool(len(alpha) and not ((alpha == alpha[0]).all() and alpha[0] in plain))


def beyond_range(value: np.ndarray) -> set[str]:
    """What is ignored of colors that `linear_color` clamps."""
    finite = value[np.isfinite(value)].astype(np.float64)
    most = _DISPLAY_MOST if _are_bytes(finite) else _PAINTED_MOST
    wrong = value.dtype.kind == "f" and (finite.min(initial=0) < -_BEYOND or finite.max(initial=0) > most)
    return {"colors below 0 or above 1"} if wrong else set()


def linear_color(value: np.ndarray) -> np.ndarray:
    """Converts colors of a mesh file to linear values.

    Integers of 16 bits without a sign are divided by 65535, other integers by 255. Floats are between 0 and 1, or
    bytes if the largest is between 2 and 255 and all are whole numbers or most are above 2. Others above 1 are white.
    The result is decoded from sRGB: the formats do not state what colors mean, and MeshLab, CloudCompare and Blender
    write what they display.

    Args:
        value: Colors of any numeric type [n 3].

    Returns:
        Linear colors between 0 and 1; NaN for colors that are not finite.
    """
    scaled = value.astype(np.float64)
    if value.dtype == np.int8:  # bytes of a color that a header calls signed
        scaled = value.view(np.uint8).astype(np.float64)
    if value.dtype == np.uint16:
        scaled /= np.iinfo(np.uint16).max
    elif value.dtype.kind in "iu" or _are_bytes(scaled):
        scaled /= _DISPLAY_MOST
    scaled = np.where(np.isfinite(scaled).all(1, keepdims=True), np.clip(scaled, 0, 1), np.nan)
    return pixels.srgb_to_linear(scaled)
