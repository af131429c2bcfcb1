"""Mesh files of all formats. OFF and STL files, which hold geometry alone, are read here."""

import pathlib
import re

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import geometry, gltf_file, gltf_geometry, obj, ply, text
from jaxprt.scene.formats.geometry import Geometry, MeshContent, Polygons

# Texture coordinates, colors, normals, a fourth coordinate, and another dimension.
_KEYWORD = re.compile(rb"\s*(ST)?(C)?(N)?(4)?(n)?(?i:OFF)(?:[ \t]+(BINARY))?")
_NO_LISTS = (np.zeros(0), np.zeros(0, np.int64))
_HEADER = 80
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertex", "<f4", (3, 3)), ("attribute", "<u2")])
_COLORED = 1 << 15  # bit of the attribute that VisCAM sets where it holds a color
_FACET = re.compile(rb"^[ \t]*facet\b", re.IGNORECASE | re.MULTILINE)
_VERTEX = re.compile(rb"^[ \t]*vertex\b([^\n]*)", re.IGNORECASE | re.MULTILINE)
_END = re.compile(rb"^[ \t]*endsolid\b", re.IGNORECASE | re.MULTILINE)
SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")


def read_off(path: pathlib.Path) -> MeshContent:
    """Reads the geometry of an OFF file in text form.

    Colors belong to vertices (COFF) or to faces. Faces of one or two corners, which are points and segments, are
    dropped.

    Args:
        path: The file.
    """
    content = re.sub(rb"#[^\n]*", b"", text.read(path, "an undamaged OFF file"))
    keyword = _KEYWORD.match(content)
    textured, colored, normals, fourth, dimension, binary = keyword.groups() if keyword else [None] * 6
    if keyword and (dimension or binary):
        raise ValueError(f"it must be text of three dimensions, got {text.name(keyword[0].strip())}")
    body = content[keyword.end() :] if keyword else content  # the keyword may be missing
    rows = text.rows(body)
    counts = next(rows, b"").split()
    if len(counts) < 2 or not all(re.fullmatch(rb"\d{1,18}", word) for word in counts[:2]):
        raise ValueError(f"it must start with OFF and the numbers of vertices and faces, got {content[:20]!r}")
    vertices, faces = int(counts[0]), int(counts[1])
    if 6 * vertices + 2 * faces - 1 > len(body):  # a number takes a digit and a space or line end
        raise ValueError(f"its header counts {vertices} vertices and {faces} faces, but it has {len(content)} bytes")
    position, of_vertex, ignored = _vertices(
        list(text.tables(rows, vertices, "vertex")), bool(textured), bool(colored), bool(normals), bool(fourth)
    )
    parts = [(*table.lists(), *table.remaining()) for table in text.tables(rows, faces, "face")] or [_NO_LISTS * 2]
    corner, count, rest, rest_count = map(np.concatenate, zip(*parts, strict=True))
    shape = Polygons(text.whole_lists(corner, count, "face"), count)
    geometry.check_polygons(shape, vertices, str(path))
    if "color" in of_vertex:
        of_face = {}
        ignored |= {"colors of faces, beside those of vertices"} if rest_count.any() else set()
    else:
        of_face = {"color": _color(rest, rest_count, 3, ignored)}
        ignored |= {"indices of colors of faces"} if (rest_count == 1).any() else set()
    return MeshContent(geometry.from_polygons(position, shape, of_vertex, {}, of_face, str(path)), [None], ignored)


def _vertices(
    tables: list[text.Table], textured: bool, colored: bool, normals: bool, fourth: bool
) -> tuple[np.ndarray, dict[str, np.ndarray | None], set[str]]:
    """Positions, attributes of vertices, and what is ignored."""
    width = 3 + fourth
    columns = [[table.column() for _ in range(width + 3 * normals)] for table in tables]
    value = np.concatenate([np.stack(column, -1) for column in columns]) if tables else np.zeros((0, width))
    position = value[:, :3]
    if fourth:
        with np.errstate(divide="ignore", invalid="ignore"):  # positions that are not finite are refused later
            position = position / value[:, 3:4]
    ignored: set[str] = set()
    of_vertex: dict[str, np.ndarray | None] = {"normal": value[:, width:] if normals else None}
    rest, count = map(np.concatenate, zip(*([table.remaining() for table in tables] or [_NO_LISTS]), strict=True))
    if textured and len(count) and (count >= 2).all():
        end = np.cumsum(count)
        of_vertex["texture"] = np.stack([rest[end - 2], rest[end - 1]], -1)
    color = _color(rest, count, 5 if textured else 3, ignored) if colored else None
    if color is not None:
        of_vertex["color"] = color
    if not textured and not colored and count.any():
        ignored.add("numbers after the coordinates of vertices")
    if colored and (count == (3 if textured else 1)).any():
        ignored.add("indices of colors of vertices")
    return position, of_vertex, ignored


def _color(rest: np.ndarray, count: np.ndarray, least: int, ignored: set[str]) -> np.ndarray | None:
    """Linear colors from the first three numbers of rows with `least` or more; NaN for others, None if all are."""
    complete = count >= least
    first = np.cumsum(count) - count
    if geometry.translucent(rest[(first + 3)[count > least]]):
        ignored.add("alpha of colors")
    if not complete.any():
        return None
    value = np.full((len(count), 3), np.nan)
    value[complete] = rest[first[complete, None] + np.arange(3)]
    ignored |= geometry.beyond_range(value)
    return geometry.linear_color(value)


def read_stl(path: pathlib.Path) -> MeshContent:
    """Reads the triangles of a binary or text STL file, with three vertices for each. Normals are not read.

    Args:
        path: The file.
    """
    position, ignored = _triangles(inputs.content(path, "a mesh file"))
    if not len(position):
        raise ValueError(f"{path} must hold vertices and faces, got no faces")
    face = np.arange(3 * len(position)).reshape(-1, 3)
    return MeshContent(Geometry(position.reshape(-1, 3).astype(np.float64), face), [None], ignored)


def _triangles(content: bytes) -> tuple[np.ndarray, set[str]]:
    """Corners of all triangles [t 3 3], and what is ignored."""
    start = _HEADER + 4
    count = int.from_bytes(content[_HEADER:start], "little")
    needed = start + count * _TRIANGLE.itemsize
    # Some binary files start with "solid", too.
    if len(content) >= start and len(content) == needed:
        triangle = np.frombuffer(content, _TRIANGLE, count, start)
        colored = b"COLOR=" in content[:_HEADER] or (triangle["attribute"] & _COLORED).any()
        return triangle["vertex"], {"colors of STL triangles"} if colored else set()
    plain = text.plain(content)
    if re.match(rb"\s*solid\b", plain, re.IGNORECASE) and b"\0" not in plain:
        return _text_triangles(plain), set()
    if len(content) < start:
        raise ValueError(f"it must start with 'solid' or have {start} bytes or more, got {len(content)} bytes")
    raise ValueError(f"its header counts {count} triangles, which take {needed} bytes, but it has {len(content)}")


def _text_triangles(content: bytes) -> np.ndarray:
    rows = _VERTEX.findall(content)
    facets = len(_FACET.findall(content))
    if len(rows) != 3 * facets or not _END.search(content):
        raise ValueError(
            f"its {facets} facets must have three vertices and end with 'endsolid', got {len(rows)} vertices"
        )
    tables = text.tables(iter(rows), len(rows), "vertex")
    return np.concatenate(
        [np.zeros((0, 3)), *(np.stack([table.column(2 - axis) for axis in range(3)], -1) for table in tables)]
    ).reshape(-1, 3, 3)


def check(path: pathlib.Path) -> None:
    """Refuses files of other formats and files that do not exist."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} must end in one of {', '.join(SUFFIXES)}, got {path.suffix.lower()!r}")
    inputs.check(path, "a mesh file")


def read(path: pathlib.Path, *, groups: bool) -> Geometry:
    """Reads the triangles of a file in world coordinates, with regions. Only those of glTF files have colors."""
    check(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        with text.name_file_in_errors(path, "glTF"):
            return gltf_geometry.read(gltf_file.Document(path), groups=groups).geometry
    return content(path, groups=groups).geometry._replace(color=None)


_READERS = {".ply": ply.read, ".stl": read_stl, ".off": read_off}


def content(path: pathlib.Path, *, groups: bool) -> MeshContent:
    """Reads a PLY, OBJ, STL or OFF file with its colors and the names of its images."""
    suffix = path.suffix.lower()
    with text.name_file_in_errors(path, suffix[1:].upper()):
        read_content = obj.read(path, groups=groups) if suffix == ".obj" else _READERS[suffix](path)
    shape = read_content.geometry
    region = np.zeros(len(shape.position), int) if shape.region is None else shape.region
    return read_content._replace(geometry=shape._replace(region=region))
