"""Geometry of STL files."""

import pathlib
import re

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import text
from jaxprt.scene.formats.geometry import Geometry, MeshContent

_HEADER = 80
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("vertex", "<f4", (3, 3)), ("attribute", "<u2")])
_COLORED = 1 << 15  # bit of the attribute that VisCAM sets where it holds a color
_FACET = re.compile(rb"^[ \t]*facet\b", re.IGNORECASE | re.MULTILINE)
_VERTEX = re.compile(rb"^[ \t]*vertex\b([^\n]*)", re.IGNORECASE | re.MULTILINE)
_END = re.compile(rb"^[ \t]*endsolid\b", re.IGNORECASE | re.MULTILINE)


def read(path: pathlib.Path) -> MeshContent:
    """Reads the triangles of a binary or text STL file, with three vertices for each. Normals are not read.

    Args:
        path: The file.

    Raises:
        ValueError: The file is damaged. The message names the file.
    """
    content = inputs.content(path, "a mesh file")
    try:
        position, ignored = _triangles(content)
    except ValueError as error:
        raise text.unreadable(path, "STL", error) from error
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
