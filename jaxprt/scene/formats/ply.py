"""Geometry of PLY files."""

import pathlib
import re

import numpy as np

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.scene.formats import colors, polygons, text
from jaxprt.scene.formats.geometry import MeshContent, first_appearance
from jaxprt.scene.formats.ply_table import Columns, Lists, memory, read_elements, read_header
from jaxprt.scene.formats.polygons import Polygons

_UTF8_MARK = b"\xef\xbb\xbf"
_CORNERS = ("vertex_indices", "vertex_index")
_STRIPS = ("tristrips", "tristrip")
_WEDGES = "texcoord"
_TEXTURE = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_ALPHA = ("alpha", "diffuse_alpha", "a")
_IMAGE = re.compile(r"texture\s*file\s+(.+)", re.IGNORECASE)


def read(path: pathlib.Path) -> MeshContent:
    """Reads the geometry of a PLY file, in the precision of the file.

    Faces are those of the elements `face` and `tristrips`. Texture coordinates and colors belong to vertices or, where
    vertices have none, to faces. Vertices are then split where these differ. Regions are the images of MeshLab's
    `texnumber`, by first appearance.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged. The message names the file.
    """
    content = inputs.content(path, "a mesh file").removeprefix(_UTF8_MARK)
    try:
        header = read_header(content)
        advice = "free some memory, or write the file in parts"
        require.memory(f"the elements of {path}", memory(header, len(content)), advice)
        table = read_elements(content, header, {"vertex", "face", *_STRIPS}, {*_CORNERS, _WEDGES})
        vertex, face = table.get("vertex", {}), table.get("face", {})
        if not all(isinstance(vertex.get(axis), np.ndarray) for axis in "xyz"):
            raise ValueError("its vertices must have the properties x, y and z")
        faces, corners = _faces(face, table)
        position = np.stack([vertex[axis] for axis in "xyz"], -1).astype(np.float64)
        if not faces.size.size or faces.size.max() < 3:
            raise ValueError(f"{path} must hold vertices and faces, got no faces")
        polygons.check(faces, len(position), str(path))
        images = [match[1].strip() for comment in header.comments if (match := _IMAGE.match(comment))]
        return _content(position, vertex, face, faces, corners, images, str(path))
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise text.unreadable(path, "PLY", error) from error


def _faces(face: Columns, table: dict[str, Columns]) -> tuple[Polygons, int]:
    """The polygons of faces, then the triangles of strips; and the number of corners of the former."""
    parts = []
    lists = [column for name in _CORNERS if isinstance(column := face.get(name), Lists)]
    if lists:
        parts.append(Polygons(text.whole_lists(*lists[0], "face"), lists[0].length))
    elif any(len(column.length if isinstance(column, Lists) else column) for column in face.values()):
        raise ValueError(f"its faces must have a list of the name {' or '.join(_CORNERS)}")
    corners = sum(len(part.corner) for part in parts)
    for element in _STRIPS:
        for name in _CORNERS:
            strips = table.get(element, {}).get(name)
            if isinstance(strips, Lists):
                vertex = text.whole_lists(*strips, element)
                parts.append(polygons.of_rows(_strip_triangles(vertex, strips.length)))
    if not parts:
        return Polygons(np.zeros(0, np.int64), np.zeros(0, np.int64)), 0
    return Polygons(*map(np.concatenate, zip(*parts, strict=True))), corners


def _strip_triangles(vertex: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Triangles [t 3] of strips, which start again after each -1. Every second triangle of a strip is reversed.

    Args:
        vertex: Vertex indices of all strips, one strip after the other.
        length: Number of indices of each strip.
    """
    vertex = np.insert(vertex, np.cumsum(length)[:-1], -1)
    place = np.arange(len(vertex))
    start = np.maximum.accumulate(np.where(vertex < 0, place + 1, 0))
    window = np.lib.stride_tricks.sliding_window_view(vertex, 3) if len(vertex) >= 3 else np.zeros((0, 3), np.int64)
    first = (place - start)[: len(window)]
    triangle = np.where(first[:, None] % 2 == 0, window, window[:, [1, 0, 2]])
    different = (triangle != np.roll(triangle, 1, 1)).all(1)  # strips are turned by triangles without area
    return triangle[different & (window >= 0).all(1)]


def _content(
    position: np.ndarray, vertex: Columns, face: Columns, faces: Polygons, corners: int, images: list[str], name: str
) -> MeshContent:
    """The geometry, images and what is ignored.

    Args:
        position: Vertex positions [v 3].
        vertex: The table of vertices.
        face: The table of faces.
        faces: All faces, those of strips last.
        corners: Number of corners of faces that are not of strips.
        images: Names of the image files.
        name: Name of the file.
    """
    of_vertex = {"normal": _columns(vertex, ("nx", "ny", "nz"))}
    of_vertex["texture"] = next((value for names in _TEXTURE if (value := _columns(vertex, names)) is not None), None)
    of_vertex["color"], ignored = _color(vertex)
    of_corner, of_face = {}, {}
    if of_vertex["texture"] is None:
        of_corner["texture"] = _wedges(face, faces, corners)
    if of_vertex["color"] is None:
        of_face["color"], ignored = _color(face)
    textured = of_vertex["texture"] is not None or of_corner["texture"] is not None
    number = face.get("texnumber")
    regions: list[str | None] = [None]
    if images and not textured:
        ignored |= {f"TextureFile {image} (there are no texture coordinates)" for image in images}
    elif images and isinstance(number, np.ndarray) and (drawn := faces.size[: len(number)] > 2).any():
        labels, region = first_appearance(number[drawn])
        of_face["region"] = np.zeros(len(number), int)
        of_face["region"][drawn] = region
        regions = [images[int(label)] if 0 <= label < len(images) else None for label in labels]
    elif images:
        regions = [images[0]]
        ignored |= {f"TextureFile {image} (no face has its texnumber)" for image in images[1:]}
    rows = {key: _padded(value, len(faces.size)) for key, value in of_face.items()}
    return MeshContent(polygons.geometry(position, faces, of_vertex, of_corner, rows, name), regions, ignored)


def _columns(table: Columns, names: tuple[str, ...]) -> np.ndarray | None:
    """Columns of single numbers side by side; None if one is missing."""
    columns = [column for name in names if isinstance(column := table.get(name), np.ndarray)]
    return np.stack(columns, -1) if len(columns) == len(names) else None


def _color(table: Columns) -> tuple[np.ndarray | None, set[str]]:
    """Linear colors of vertices or faces, and what is ignored of them."""
    value = next((value for names in _COLORS if (value := _columns(table, names)) is not None), None)
    if value is None or not len(value):
        return None, set()
    alpha = next((column for name in _ALPHA if isinstance(column := table.get(name), np.ndarray)), None)
    translucent = alpha is not None and len(np.unique(alpha)) > 1
    return colors.linear(value), {"alpha of colors"} if translucent else set()


def _wedges(face: Columns, faces: Polygons, corners: int) -> np.ndarray | None:
    """Texture coordinates of the corners of faces, as MeshLab writes them; 0 where a face has none."""
    wedge = face.get(_WEDGES)
    if not isinstance(wedge, Lists) or not len(wedge.value):
        return None
    count = faces.size[: len(wedge.length)]
    complete = wedge.length == 2 * count
    texture = np.zeros((len(faces.corner), 2))
    texture[:corners][np.repeat(complete, count)] = wedge.value[np.repeat(complete, wedge.length)].reshape(-1, 2)
    return texture


def _padded(value: np.ndarray | None, count: int) -> np.ndarray | None:
    """Rows of faces, with rows for triangles of strips, which have the values of the first face."""
    return value if value is None else np.concatenate([value, np.repeat(value[:1], count - len(value), axis=0)])
