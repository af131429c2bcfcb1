"""Geometry of OBJ files (Wavefront)."""

import io
import itertools
import pathlib
import re
import warnings
from typing import NamedTuple

import numpy as np

from jaxprt.scene.formats import colors, polygons, text
from jaxprt.scene.formats.geometry import Geometry, split_corners

KIND = "an undamaged OBJ file"
_COMMENT = re.compile(r"^#.*|\s#(\s.*)?$")  # names may contain a #, such as Blender's "Material_#25"
_NAMING = re.compile(rb"^[^\S\n]*(usemtl|mtllib)(?!\S)([^\n]*)", re.MULTILINE)
_FACE = re.compile(rb"^[^\S\n]*f\s", re.MULTILINE)
_COMMENT_PATH = re.compile(rb"^[^\S\n]*#[^\n]*\\$", re.MULTILINE)
_WHOLE = re.compile(rb"[+-]?\d{1,40}")  # of words with more digits, Python would refuse some
_CONTINUED = b" \v"  # replaces the line end after a backslash; \v is white space, and counts such lines for messages
_BLOCK = 1 << 16  # lines whose words are in memory at once
_LEAST = {b"v": 3, b"vt": 1, b"vn": 3}  # fewest numbers of a statement
_MOST = 7  # numbers of a statement that are read
_NONE = -1 << 62  # index that a corner does not have
_WRONG = -1 << 61  # index that is no number or refers to nothing


class _Rows(NamedTuple):
    """The numbers of all statements of one kind.

    Attributes:
        value: The numbers [n k]; NaN where a row has fewer than others.
        line: Index of the line of each row [n].
    """

    value: np.ndarray
    line: np.ndarray


class _Faces(NamedTuple):
    """Faces.

    Attributes:
        corner: Indices of the vertex, texture coordinates and normal of each corner [c 3].
        size: Number of corners of each face [f].
        line: Index of the line of each face [f].
        region: Region of each face [f].
    """

    corner: np.ndarray
    size: np.ndarray
    line: np.ndarray
    region: np.ndarray


class _Source(NamedTuple):
    """The text of a file, and its path for messages."""

    path: pathlib.Path
    content: bytes

    def place(self, line: int) -> str:
        """The statement in a line and the number of the line in the file."""
        lines = self.content.split(b"\n")
        number = line + 1 + sum(before.count(b"\v") for before in lines[:line])
        return f"{text.name(lines[line].strip().replace(_CONTINUED, b' '))[:80]!r} in line {number}"


def statement(line: str) -> str:
    """A line of an OBJ or MTL file without its comment. A comment starts with a # that stands alone or first."""
    return _COMMENT.sub("", line.strip()).strip()


def content(path: pathlib.Path) -> bytes:
    """The text of an OBJ file with continued lines joined."""
    source = text.read(path, KIND)
    if b"\\\n" not in source:
        return source
    # Comments do not continue. They may end in a path of Windows.
    return _COMMENT_PATH.sub(lambda line: line[0] + b" ", source).replace(b"\\\n", _CONTINUED)


def used_materials(source: bytes) -> tuple[list[str | None], list[str]]:
    """Names of the materials of an OBJ file in the order of their first faces, and names of its MTL files.

    None stands for faces without a material.
    """
    order: dict[str | None, None] = {}
    files = []
    material, start = None, 0
    for match in _NAMING.finditer(source):
        if match[1] == b"mtllib":
            files.append(_name(match[2]))
            continue
        if material not in order and _FACE.search(source, start, match.start()):
            order[material] = None
        material, start = _name(match[2]) or None, match.end()
    if material not in order and _FACE.search(source, start):
        order[material] = None
    return list(order), files


def read(path: pathlib.Path, *, groups: bool) -> Geometry:
    """Reads the geometry of an OBJ file. Colors are NaN where vertices have none.

    Args:
        path: The file.
        groups: Whether regions are objects and groups, instead of materials.

    Raises:
        ValueError: A statement is damaged. The message names the file and the line.
    """
    source = _Source(path, content(path))
    rows, faces = _statements(source, groups=groups)
    if not len(faces.size):
        raise ValueError(f"{path} must hold vertices and faces, got no faces")
    return _geometry(rows, _sound(faces, rows, source), source)


def _statements(source: _Source, *, groups: bool) -> tuple[list[_Rows], _Faces]:
    """Reads all statements in blocks of lines, so that not all words are in memory at once."""
    rows: dict[bytes, list[_Rows]] = {kind: [] for kind in _LEAST}
    faces: list[_Faces] = []
    regions: dict[tuple[str, ...], int] = {}
    names = {b"o": "", b"g": ""} if groups else {b"usemtl": ""}
    region, start = -1, 0
    stream = io.BytesIO(source.content)
    while lines := list(itertools.islice(stream, _BLOCK)):
        tails: dict[bytes, list[bytes]] = {kind: [] for kind in (*_LEAST, b"f")}
        places: dict[bytes, list[int]] = {kind: [] for kind in tails}
        region_of = []
        for place, line in enumerate(lines, start):
            kind, _, tail = line.partition(b" ")
            if kind not in tails:
                kind, tail = [*line.split(None, 1), b"", b""][:2]
            if kind in tails:
                tails[kind].append(tail.partition(b"#")[0])
                places[kind].append(place)
                if kind == b"f":
                    region = regions.setdefault(tuple(names.values()), len(regions)) if region < 0 else region
                    region_of.append(region)
            elif kind in names:
                names[kind], region = _name(tail), -1
        for kind, parts in rows.items():
            if tails[kind]:
                parts.append(_Rows(_numbers(tails[kind], kind, places[kind], source), np.array(places[kind])))
        if region_of:
            faces.append(_Faces(*_indices(tails[b"f"]), np.array(places[b"f"]), np.array(region_of)))
        start += len(lines)
    empty = _Faces(np.zeros((0, 3), np.int64), *np.zeros((3, 0), np.int64))
    return [_rows(parts) for parts in rows.values()], _Faces(*map(np.concatenate, zip(empty, *faces, strict=True)))


def _name(tail: bytes) -> str:
    return statement(text.name(tail.replace(b"\t", b" ")))


def _numbers(tails: list[bytes], kind: bytes, places: list[int], source: _Source) -> np.ndarray:
    """The numbers of statements of one kind [n k]; NaN where a statement has fewer than others."""
    words = text.words(tails)
    try:
        short = np.flatnonzero(words.per_row < _LEAST[kind])
        if short.size:
            raise text.RowError(int(short[0]))
        number = text.numbers(words)
    except text.RowError as error:
        raise ValueError(
            f"{source.path} must be an undamaged OBJ file, in which {kind.decode()} has {_LEAST[kind]} or more "
            f"numbers, got {source.place(places[error.row])}"
        ) from None
    width = min(words.per_row.max(), _MOST)
    value = np.full((len(tails), width), np.nan)
    column = np.arange(len(number)) - np.repeat(np.cumsum(words.per_row) - words.per_row, words.per_row)
    read = column < width
    value[np.repeat(np.arange(len(tails)), words.per_row)[read], column[read]] = number[read]
    return value


def _rows(parts: list[_Rows]) -> _Rows:
    """Joins blocks of rows. Shorter rows end with NaN."""
    if not parts:
        return _Rows(np.zeros((0, 3)), np.zeros(0, np.int64))
    width = max(part.value.shape[1] for part in parts)
    value = [np.pad(part.value, ((0, 0), (0, width - part.value.shape[1])), constant_values=np.nan) for part in parts]
    return _Rows(np.concatenate(value), np.concatenate([part.line for part in parts]))


def _indices(tails: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """The indices of the corners of faces as they are in the file [c 3], and the number of corners of each face."""
    words = text.words(tails)
    index = np.full((len(words.start), 3), _NONE)
    slash = np.frombuffer(words.text, np.uint8) == ord("/")
    slashes = np.add.reduceat(slash, words.start, dtype=int) if len(words.start) else np.zeros(1, int)
    columns = slashes[0] + 1
    if columns <= 3 and (slashes == slashes[0]).all():
        separate = text.words(words.text.replace(b"//", b"/%d/" % _NONE).replace(b"/", b" ").split(b"\n"))
        if (separate.per_row == columns * words.per_row).all():
            try:
                index[:, :columns] = text.numbers(separate, kind=int).reshape(-1, columns)
            except text.RowError:
                pass
            else:
                return index, words.per_row
    return np.array([_corner(word) for word in words.text.split()], np.int64).reshape(-1, 3), words.per_row


def _corner(word: bytes) -> list[int]:
    """The indices of a corner; `_WRONG` if there are more than three."""
    numbers = word.split(b"/")
    if len(numbers) > 3:
        return [_WRONG] * 3
    return [_whole(number) if number else _NONE for number in [*numbers, b"", b""][:3]]


def _whole(word: bytes) -> int:
    """An index; `_WRONG` if it is not a whole number that a file could count."""
    if not _WHOLE.fullmatch(word):  # Python would take "1_0" too
        return _WRONG
    return number if abs(number := int(word)) < -_WRONG else _WRONG


def _sound(faces: _Faces, rows: list[_Rows], source: _Source) -> _Faces:
    """Faces with indices from 0. Indices are -1 where a face has none or refers to something that does not exist.

    Raises:
        ValueError: A face has fewer than three corners or refers to a vertex that does not exist.
    """
    index = faces.corner
    for column, row in enumerate(rows):
        number = index[:, column]
        before = np.repeat(np.searchsorted(row.line, faces.line), faces.size)  # relative indices count back from here
        number = np.where(number < 0, np.where(number > _WRONG, number + before, number), number - 1)
        missing = (faces.corner[:, column] <= _NONE) & (column > 0)
        index[:, column] = np.where(missing, -1, np.where((number < 0) | (number >= len(row.line)), _WRONG, number))
    face = np.repeat(np.arange(len(faces.size)), faces.size)

    def wrong_faces(column: int) -> np.ndarray:
        return np.unique(face[index[:, column] == _WRONG])

    def described(wrong: np.ndarray) -> str:
        first = source.place(int(faces.line[wrong[0]]))
        return f"got {len(wrong)} of {len(faces.size)} faces that do not, the first is {first}"

    wrong = np.union1d(wrong_faces(0), np.flatnonzero(faces.size < 3)).astype(int)
    if wrong.size:
        raise ValueError(
            f"{source.path}: faces must refer to three or more of the vertices 1 to {len(rows[0].line)}, "
            f"{described(wrong)}"
        )
    for column, what in ((1, "texture coordinates"), (2, "normals")):
        wrong = wrong_faces(column)
        if wrong.size:
            warnings.warn(
                f"{source.path}: faces should refer to {what} 1 to {len(rows[column].line)} or none, "
                f"{described(wrong)}: these faces are loaded without {what}",
                stacklevel=6,
            )
            index[np.isin(face, wrong), column] = -1
    return faces


def _geometry(rows: list[_Rows], faces: _Faces, source: _Source) -> Geometry:
    """The triangles. Vertices are split where corners differ in region, texture coordinates or normal."""
    vertex, place, direction = (row.value for row in rows)
    index = faces.corner
    triangle = polygons.triangulate(vertex[:, :3], polygons.Polygons(index[:, 0], faces.size), str(source.path))
    region = np.repeat(faces.region, faces.size)
    columns = [column for column in (region, *index.T) if column.any()]
    first, corner = split_corners(columns or [index[:, 0]])
    at, at_texture, at_normal = index[first].T
    position = vertex[at, :3]
    wrong = np.flatnonzero(~np.isfinite(position).all(1))
    if wrong.size:
        raise ValueError(
            f"{source.path}: positions must be finite, got {wrong.size} of {len(position)} that are not, the first is "
            f"{source.place(int(rows[0].line[at[wrong[0]]]))}, at vertex {wrong[0]}"
        )
    normal = texture = color = None
    if (at_normal >= 0).any():
        normal = np.where(at_normal[:, None] >= 0, direction[at_normal, :3], np.nan)
    if (at_texture >= 0).any():
        # There may be one coordinate, with v = 0, or a third, which is not used.
        texture = np.zeros((len(position), 2))
        texture[:, : place.shape[1]] = np.where(at_texture[:, None] >= 0, place[at_texture, :2], 0)
        texture[~np.isfinite(texture)] = 0
    if vertex.shape[1] >= 6 and np.isfinite(vertex[:, 3:6]).all(1).any():
        color = colors.linear(vertex[at, 3:6])
    return Geometry(position, corner[triangle.corner], normal, None, None, texture, None, color, region[first])
