"""Geometry of PLY files: the header, tables of elements in text or in bytes, and the mesh in them."""

import pathlib
import re
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.scene.formats import geometry, text
from jaxprt.scene.formats.geometry import MeshContent, Polygons, first_appearance

# Types of numbers, by the names of the first version of the format and by those of the second.
_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"double": "f8", "float32": "f4", "float64": "f8"}
_TYPES |= {f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "i8": "q", "u8": "Q"}  # of struct
_BLOCK, _BYTES = 1 << 16, 1 << 24  # most rows with lists, and bytes of them, that are read at once
_UTF8_MARK = b"\xef\xbb\xbf"
_CORNERS = ("vertex_indices", "vertex_index")
_STRIPS = ("tristrips", "tristrip")
_WEDGES = "texcoord"
_TEXTURE = (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_ALPHA = ("alpha", "diffuse_alpha", "a")
# What is read of vertices and faces, and what tells nothing of the picture: scanners and their programs write it.
_READ = {*"xyz", "nx", "ny", "nz", "texnumber", *_CORNERS, _WEDGES}
_READ |= {name for names in (*_TEXTURE, *_COLORS, _ALPHA) for name in names}
_LISTED = 8  # names in a warning
_HARMLESS = {"quality", "confidence", "intensity", "flags", "radius", "label", "id", "index", "object_id", "timestamp"}
_HARMLESS |= {"curvature", "camera", "edge", "range_grid", "user"}
_IMAGE = re.compile(r"texture\s*file\s+(.+)", re.IGNORECASE)


class Lists(NamedTuple):
    """The lists of one property: all items one after the other, and the length of each list."""

    value: np.ndarray
    length: np.ndarray


class Property(NamedTuple):
    """A property of an element. `length` is the type of the lengths of lists; None for single numbers."""

    name: str
    dtype: np.dtype
    length: np.dtype | None


class Element(NamedTuple):
    """A table of a PLY file, without its rows."""

    name: str
    rows: int
    properties: list[Property]

    @property
    def row_size(self) -> int:
        """Fewest bytes of a row in a binary file."""
        return sum((item.length or item.dtype).itemsize for item in self.properties)


class PlyHeader(NamedTuple):
    """The header of a PLY file."""

    order: str  # of bytes, "<" or ">"; "" for text
    elements: list[Element]  # in the order of their tables
    comments: list[str]  # without their keyword
    unknown: set[str]  # keywords that the format does not have
    end: int  # position of the first byte after the header


Columns = dict[str, np.ndarray | Lists]


def read_header(content: bytes) -> PlyHeader:
    """Reads the header."""
    start = re.match(rb"ply[ \t]*(\r\n|\n|\r)", content)
    if not start:
        raise ValueError(f"it must start with a line 'ply', got {content[:8]!r}")
    line_end = rb"\r" if start[1] == b"\r" else rb"\r?\n"
    end = re.compile(rb"[\r\n]end_header[ \t]*(?:" + line_end + rb"|\Z)").search(content)
    if not end:
        raise ValueError("its header must end with a line 'end_header'")
    order, comments, unknown = None, [], set()
    elements: list[Element] = []
    for line in re.split(rb"[\r\n]+", content[start.end() : end.start()]):
        keyword, rest = [*text.name(line).split(None, 1), "", ""][:2]
        words = rest.split()
        try:
            if keyword == "format":
                order = _ORDERS[words[0]]
            elif keyword == "element":
                elements.append(Element(words[0], int(words[1]), []))
            elif keyword == "property":
                elements[-1].properties.append(_property(words, order or ""))
            elif keyword == "comment":
                comments.append(rest.strip())
            elif keyword and keyword != "obj_info":
                unknown.add(f"header lines {keyword}")
        except (KeyError, IndexError, ValueError):
            raise ValueError(f"its header has a line that is not known, {text.name(line)[:80]!r}") from None
    if order is None:
        raise ValueError(f"its header must state a format, one of {', '.join(_ORDERS)}")
    header = PlyHeader(order, elements, comments, unknown, end.end())
    _check_counts(header, len(content) - header.end)
    return header


def _property(words: list[str], order: str) -> Property:
    types = [np.dtype(order + _TYPES[word]) for word in words[:-1] if word != "list"]
    if (words[0] == "list") != (len(types) == 2) or (len(types) == 2 and types[0].kind == "f"):
        raise ValueError
    return Property(words[-1].lower(), types[-1], types[0] if len(types) == 2 else None)


def _check_counts(header: PlyHeader, size: int) -> None:
    """Refuses headers that count more rows than the file can hold, before memory is allocated for them."""
    names: set[str] = set()
    for element in header.elements:
        if element.rows < 0 or element.name in names:
            raise ValueError(f"its header must have one element {element.name!r} with 0 or more rows")
        names.add(element.name)
    # In text a number takes a digit and a space or line end, and the last line end may be missing.
    needed = sum(e.rows * (e.row_size if header.order else 2 * len(e.properties)) for e in header.elements)
    needed -= 0 if header.order else 1
    if needed > size:
        rows = ", ".join(f"{element.rows} {element.name}" for element in header.elements)
        raise ValueError(
            f"its header counts the rows {rows}, which take {needed} bytes or more, but {size} bytes follow"
        )


def table_memory(header: PlyHeader, size: int) -> int:
    """Most bytes that `read_elements` needs, as measured, for a file of `size` bytes."""
    rows = sum(element.rows for element in header.elements if any(item.length for item in element.properties))
    return 3 * size + 20 * rows + 4 * min(_BYTES, size) if header.order else 16 * size


def read_elements(content: bytes, header: PlyHeader, names: set[str], lists: set[str]) -> dict[str, Columns]:
    """Reads the tables of the named elements: the columns by the names of their properties.

    Numbers of text files are float64, and others have the type of the header.

    Args:
        content: The file.
        header: The header of the file.
        names: Names of the elements.
        lists: Names of the properties whose lists are read. Other lists have their lengths, but no items.
    """
    tables: dict[str, Columns] = {}
    rows = text.rows(content[header.end :].replace(b"\r\n", b"\n").replace(b"\r", b"\n")) if not header.order else None
    at = header.end
    for element in header.elements:
        if not element.properties:
            continue
        read = element.name in names
        used = lists if read else set()
        if rows is None:
            blocks, at = _binary(content, at, element, used)
        else:
            columns = (_columns(table, element, used) for table in text.tables(rows, element.rows, element.name))
            blocks = [block for block in columns if read]  # other rows are read too, because the next ones follow
        if read:
            tables[element.name] = _join_blocks(blocks, element)
    return tables


def _columns(table: text.Table, element: Element, lists: set[str]) -> Columns:
    """The columns of a block of rows of text."""
    columns: Columns = {}
    for index, item in enumerate(element.properties, 1):
        rest = len(element.properties) - index
        if item.length is None:
            columns[item.name] = _cast(table.column(rest), item.dtype)
        else:
            value, length = table.lists(rest)
            columns[item.name] = Lists(value if item.name in lists else value[:0].copy(), length)
    return columns


def _cast(value: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Numbers of text in the type of the header, which states the largest value of colors. Fractions stay floats."""
    if dtype.kind == "f" or (value != np.round(value)).any():
        return value
    limit = np.iinfo(dtype)
    return np.clip(value, limit.min, limit.max).astype(dtype) if limit.bits < 64 else value


def _binary(content: bytes, at: int, element: Element, lists: set[str]) -> tuple[list[Columns], int]:
    """The columns of rows in bytes, in blocks, and the position after the last row."""
    if not element.rows:
        return [], at
    equal = _equal_rows(content, at, element)
    if equal is not None:
        return [_equal_columns(equal, element, lists)], at + equal.nbytes
    start = np.fromiter(_row_starts(content, at, element), np.int64, element.rows + 1)
    byte = np.frombuffer(content, np.uint8)
    blocks, first = [], 0
    while first < element.rows:
        end = int(np.searchsorted(start, start[first] + _BYTES, side="right")) - 1
        end = max(first + 1, min(end, first + _BLOCK))
        part = byte[start[first] : start[end]]
        blocks.append(_block_columns(part, start[first:end] - start[first], element, lists))
        first = end
    return blocks, int(start[-1])


def _block_columns(byte: np.ndarray, start: np.ndarray, element: Element, lists: set[str]) -> Columns:
    """The columns of the bytes of some rows, which start at the positions `start` in them."""

    def gather(dtype: np.dtype) -> np.ndarray:
        return byte[start[:, None] + np.arange(dtype.itemsize)].reshape(-1).view(dtype)

    columns: Columns = {}
    for item in element.properties:
        if item.length is None:
            columns[item.name] = gather(item.dtype)
            start = start + item.dtype.itemsize
            continue
        count = gather(item.length).astype(np.int64)
        start = start + item.length.itemsize
        end = start + item.dtype.itemsize * count
        items = byte[_within(start, end, len(byte))] if item.name in lists else byte[:0]
        columns[item.name] = Lists(items.view(item.dtype), count)
        start = end
    return columns


def _within(start: np.ndarray, end: np.ndarray, size: int) -> np.ndarray:
    """Whether each of `size` places is in one of several spans, which do not overlap."""
    step = np.zeros(size + 1, np.int8)
    np.add.at(step, start, 1)  # empty spans start and end at one place
    np.add.at(step, end, -1)
    return np.cumsum(step[:-1], dtype=np.int8).view(bool)


def _equal_rows(content: bytes, at: int, element: Element) -> np.ndarray | None:
    """A view of rows whose lists, if any, are all as long as those of the first row; None if they are not."""
    fields, offset = [], at
    for index, item in enumerate(element.properties):
        size = 1
        if item.length is not None:
            fields.append((f"length {index}", item.length))
            size = int(np.frombuffer(content, item.length, 1, offset)[0]) if offset < len(content) - 8 else -1
            offset += item.length.itemsize
        if size < 0 or offset + size * item.dtype.itemsize > len(content):
            return None
        fields.append((f"{index}", item.dtype, (size,)))
        offset += size * item.dtype.itemsize
    if at + element.rows * (offset - at) > len(content):
        return None
    row = np.frombuffer(content, np.dtype(fields), element.rows, at)
    counts = (row[f"length {index}"] for index, item in enumerate(element.properties) if item.length is not None)
    return None if any((count != count[0]).any() for count in counts) else row


def _equal_columns(row: np.ndarray, element: Element, lists: set[str]) -> Columns:
    """The columns of the rows of `_equal_rows`."""
    columns: Columns = {}
    for index, item in enumerate(element.properties):
        value = row[f"{index}"]
        if item.length is None:
            columns[item.name] = value[:, 0]
        else:
            items = value.reshape(-1) if item.name in lists else np.zeros(0, item.dtype)
            columns[item.name] = Lists(items, row[f"length {index}"].astype(np.int64))
    return columns


def _row_starts(content: bytes, at: int, element: Element) -> Iterator[int]:
    """The position of each row with lists, and of the end of the last one."""
    steps, skip = [], 0  # before each list: bytes to skip, reader of the length, bytes of the length and of an item
    for item in element.properties:
        if item.length is None:
            skip += item.dtype.itemsize
        else:
            length = struct.Struct(item.length.str[:-2].replace("|", "<") + _CODES[item.length.str[-2:]])
            steps.append((skip, length.unpack_from, length.size, item.dtype.itemsize))
            skip = 0
    for row in range(element.rows):
        yield at
        try:
            for before, unpack, size, step in steps:
                at += before
                (count,) = unpack(content, at)
                at += size + int(count) * step
                if count < 0:
                    raise ValueError(f"row {row + 1} of the {element.name} rows has a list of {count} items")
        except struct.error:
            at = len(content) + 1
        at += skip
        if at > len(content):
            raise ValueError(f"its header counts {element.rows} {element.name} rows, but it ends in row {row + 1}")
    yield at


def _join_blocks(blocks: list[Columns], element: Element) -> Columns:
    """Joins the columns of blocks."""
    if len(blocks) == 1:
        return blocks[0]
    columns: Columns = {}
    for item in element.properties:
        parts = [block[item.name] for block in blocks]
        if item.length is None:
            columns[item.name] = np.concatenate(parts) if parts else np.zeros(0, item.dtype)
        else:
            empty = Lists(np.zeros(0, item.dtype), np.zeros(0, np.int64))
            columns[item.name] = Lists(*map(np.concatenate, zip(*parts, strict=True))) if parts else empty
    return columns


def read(path: pathlib.Path) -> MeshContent:
    """Reads the geometry of a PLY file, in the precision of the file.

    Faces are those of the elements `face` and `tristrips`. Texture coordinates and colors belong to vertices or, where
    vertices have none, to faces. Vertices are then split where these differ. Regions are the images of MeshLab's
    `texnumber`, by first appearance.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged.
    """
    content = inputs.content(path, "a mesh file").removeprefix(_UTF8_MARK)
    header = read_header(content)
    advice = "free some memory, or write the file in parts"
    require.memory(f"the elements of {path}", table_memory(header, len(content)), advice)
    table = read_elements(content, header, {"vertex", "face", *_STRIPS}, {*_CORNERS, _WEDGES})
    vertex, face = table.get("vertex", {}), table.get("face", {})
    if not all(isinstance(vertex.get(axis), np.ndarray) for axis in "xyz"):
        raise ValueError("its vertices must have the properties x, y and z")
    faces, corners = _faces(face, table)
    position = np.stack([vertex[axis] for axis in "xyz"], -1).astype(np.float64)
    geometry.check_polygons(faces, len(position), str(path))
    images = [match[1].strip() for comment in header.comments if (match := _IMAGE.match(comment))]
    mesh = _ply_content(position, vertex, face, faces, corners, images, str(path))
    return mesh._replace(ignored=mesh.ignored | _unread(header))


def _unread(header: PlyHeader) -> set[str]:
    """Names of elements and properties that are not read and may matter to the picture."""
    unread = set(header.unknown)
    for element in header.elements:
        if element.name in ("vertex", "face"):
            names = {item.name for item in element.properties} - _READ - _HARMLESS
            unread |= {f"{name} of {element.name}" for name in names if not name.startswith("scalar_")}
        elif element.name not in {*_STRIPS, *_HARMLESS}:
            unread.add(f"elements {element.name}")
    return {*sorted(unread)[:_LISTED], f"{len(unread) - _LISTED} more"} if len(unread) > _LISTED else unread


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
                parts.append(geometry.polygons_of_rows(_strip_triangles(vertex, strips.length)))
    parts = parts or [Polygons(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    return Polygons(*map(np.concatenate, zip(*parts, strict=True))), corners


def _strip_triangles(vertex: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Triangles [t 3] of strips, which start again after each -1. Every second triangle of a strip is reversed."""
    vertex = np.insert(vertex, np.cumsum(length)[:-1], -1)
    place = np.arange(len(vertex))
    start = np.maximum.accumulate(np.where(vertex < 0, place + 1, 0))
    window = np.lib.stride_tricks.sliding_window_view(vertex, 3) if len(vertex) >= 3 else np.zeros((0, 3), np.int64)
    first = (place - start)[: len(window)]
    triangle = np.where(first[:, None] % 2 == 0, window, window[:, [1, 0, 2]])
    different = (triangle != np.roll(triangle, 1, 1)).all(1)  # strips are turned by triangles without area
    return triangle[different & (window >= 0).all(1)]


def _ply_content(
    position: np.ndarray, vertex: Columns, face: Columns, faces: Polygons, corners: int, images: list[str], name: str
) -> MeshContent:
    """The geometry, images and what is ignored; the faces of strips come last, after `corners` corners of others."""
    of_vertex = {"normal": _side_by_side(vertex, ("nx", "ny", "nz"))}
    of_vertex["texture"] = next(
        (value for names in _TEXTURE if (value := _side_by_side(vertex, names)) is not None), None
    )
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
        ignored |= {f"texnumber {label:g} (there is no such TextureFile)" for label in labels if label >= len(images)}
    elif images:
        regions = [images[0]]
        ignored |= {f"TextureFile {image} (no face has its texnumber)" for image in images[1:]}
    rows = {key: _pad_to_strips(value, len(faces.size)) for key, value in of_face.items()}
    return MeshContent(geometry.from_polygons(position, faces, of_vertex, of_corner, rows, name), regions, ignored)


def _side_by_side(table: Columns, names: tuple[str, ...]) -> np.ndarray | None:
    """Columns of single numbers side by side; None if one is missing."""
    columns = [column for name in names if isinstance(column := table.get(name), np.ndarray)]
    return np.stack(columns, -1) if len(columns) == len(names) else None


def _color(table: Columns) -> tuple[np.ndarray | None, set[str]]:
    """Linear colors of vertices or faces, and what is ignored of them."""
    value = next((value for names in _COLORS if (value := _side_by_side(table, names)) is not None), None)
    if value is None or not len(value):
        return None, set()
    alpha = next((column for name in _ALPHA if isinstance(column := table.get(name), np.ndarray)), None)
    ignored = geometry.beyond_range(value)
    if alpha is not None and geometry.translucent(alpha):
        ignored |= {"alpha of colors"}
    return geometry.linear_color(value), ignored


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


def _pad_to_strips(value: np.ndarray | None, count: int) -> np.ndarray | None:
    """Rows of faces, with rows for triangles of strips, which have the values of the first face."""
    return value if value is None else np.concatenate([value, np.repeat(value[:1], count - len(value), axis=0)])
