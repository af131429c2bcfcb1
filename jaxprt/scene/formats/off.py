"""Geometry of OFF files (Geomview)."""

import pathlib
import re

import numpy as np

from jaxprt.scene.formats import colors, polygons, text
from jaxprt.scene.formats.geometry import MeshContent
from jaxprt.scene.formats.polygons import Polygons

# Texture coordinates, colors, normals, a fourth coordinate, and another dimension.
_KEYWORD = re.compile(rb"\s*(ST)?(C)?(N)?(4)?(n)?(?i:OFF)(?:[ \t]+(BINARY))?")


def read(path: pathlib.Path) -> MeshContent:
    """Reads the geometry of an OFF file in text form.

    Colors belong to vertices (COFF) or to faces. Faces of one or two corners, which are points and segments, are
    dropped.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged, binary, or not of three dimensions. The message names the file.
    """
    content = re.sub(rb"#[^\n]*", b"", text.read(path, "an undamaged OFF file"))
    try:
        return _content(content, path)
    except ValueError as error:
        if str(error).startswith(str(path)):
            raise
        raise text.unreadable(path, "OFF", error) from error


def _content(content: bytes, path: pathlib.Path) -> MeshContent:
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
    parts = [(*table.lists(), *table.remaining()) for table in text.tables(rows, faces, "face")]
    if not parts or max(part[1].max() for part in parts) < 3:
        raise ValueError(f"{path} must hold vertices and faces, got no faces")
    corner, count, rest, rest_count = map(np.concatenate, zip(*parts, strict=True))
    shape = Polygons(text.whole_lists(corner, count, "face"), count)
    polygons.check(shape, vertices, str(path))
    if of_vertex.get("color") is None and (rest_count == 1).any():
        ignored.add("indices of colors of faces")
    of_face = {} if "color" in of_vertex else {"color": _color(rest, rest_count, 3)}
    return MeshContent(polygons.geometry(position, shape, of_vertex, {}, of_face, str(path)), [None], ignored)


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
    of_vertex: dict[str, np.ndarray | None] = {"normal": value[:, width:] if normals else None}
    rests = [table.remaining() for table in tables]
    rest, count = map(np.concatenate, zip(*rests, strict=True)) if rests else (np.zeros(0), np.zeros(0, int))
    if textured and len(count) and (count >= 2).all():
        end = np.cumsum(count)
        of_vertex["texture"] = np.stack([rest[end - 2], rest[end - 1]], -1)
    color = _color(rest, count, 5 if textured else 3) if colored else None
    if color is not None:
        of_vertex["color"] = color
    extra = not textured and not colored and count.any()
    return position, of_vertex, {"numbers after the coordinates of vertices"} if extra else set()


def _color(rest: np.ndarray, count: np.ndarray, least: int) -> np.ndarray | None:
    """Linear colors from the first three numbers of rows with `least` or more; NaN for others, None if all are."""
    complete = count >= least
    if not complete.any():
        return None
    value = np.full((len(count), 3), np.nan)
    value[complete] = rest[(np.cumsum(count) - count)[complete, None] + np.arange(3)]
    return colors.linear(value)
