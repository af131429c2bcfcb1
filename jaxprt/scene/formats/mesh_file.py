"""Mesh files: glTF, and other formats by trimesh, with checks for damage that trimesh does not report."""

import io
import pathlib
import re
import warnings
from typing import Any

import numpy as np

from jaxprt.scene.formats import gltf_file, gltf_geometry
from jaxprt.scene.formats.geometry import Geometry, joined

SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
_COMMENT = re.compile(r"^#.*|\s#(\s.*)?$")  # names may contain a #, such as Blender's "Material_#25"


def read(path: pathlib.Path, *, groups: bool) -> Geometry:
    """Reads the triangles of a file in world coordinates, with regions."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path} must end in one of {', '.join(SUFFIXES)}, got {suffix!r}")
    if not path.is_file():
        raise FileNotFoundError(f"there is no mesh file {path}")
    if suffix in (".glb", ".gltf"):
        with gltf_file.damage_named(path):
            return gltf_geometry.read(gltf_file.Document(path), groups=groups).geometry
    return _concatenate(_load(path, suffix, groups), suffix, str(path))


def _load(path: pathlib.Path, suffix: str, groups: bool) -> Any:
    """Loads a file by trimesh. Errors name the file."""
    import trimesh  # imported here, because it takes a second, with most of SciPy

    options: dict[str, Any] = {}
    source = path
    if suffix == ".obj":
        source = io.BytesIO(_obj_text(path).encode())
        options = {
            "skip_materials": True,
            "group_material": not groups,
            "split_objects": groups,
            "split_groups": groups,
        }
    try:
        if suffix in (".ply", ".off"):
            _check_rows(path.read_bytes(), suffix)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(source, file_type=suffix[1:], process=False, **options)
    except Exception as error:  # trimesh's parsers raise errors of any kind
        text = isinstance(error, ModuleNotFoundError)  # trimesh guesses encodings with an optional package
        detail = "it is not text" if text else f"{type(error).__name__}: {error}"
        raise ValueError(
            f"{path} must be an undamaged {suffix[1:].upper()} file, got one that cannot be read: {detail}"
        ) from error


def _check_rows(content: bytes, suffix: str) -> None:
    """Refuses PLY and OFF text files with fewer rows than their header states."""
    if suffix == ".ply":
        header, _, body = content.partition(b"end_header")
        element = re.findall(rb"^element\s+\S+\s+(\d+)([^\0]*?)(?=^element|\Z)", header, re.MULTILINE)
        known = b"format ascii" in header and element
    else:
        text = re.sub(rb"#.*", b"", content)
        known = re.match(rb"\s*\w*OFF\s+(\d+)\s+(\d+).*", text)
        body = text[known.end() :] if known else b""
        element = [(known[1], b""), (known[2], b"property list")] if known else []
    expected = sum(int(count) for count, _ in element)
    if not known or not expected:
        return
    rows = [row for row in body.splitlines() if row.strip()]
    if len(rows) < expected:
        raise ValueError(f"its header counts {expected} rows, but it has {len(rows)}")
    last, length = rows[expected - 1].split(), 0
    for is_list in re.findall(rb"^property\s+(list\b)?", [p for n, p in element if int(n)][-1], re.MULTILINE):
        length += 1 + (int(last[length]) if is_list and length < len(last) else 0)
    if len(last) < length:
        raise ValueError(f"its last row must have {length} numbers, but has {len(last)}")


def _obj_text(path: pathlib.Path) -> str:
    """The text of an OBJ file with absolute indices, because trimesh resolves relative ones at the end of the file."""
    content = path.read_bytes()
    if b"\0" in content:
        raise ValueError(f"{path} must be an undamaged OBJ file, got one that is not text")
    text = content.decode(errors="replace").replace("\t", " ").replace("\r\n", "\n").replace("\\\n", " ")
    lines = [statement(line) for line in text.splitlines()]
    count = {"v": 0, "vt": 0, "vn": 0}
    absolute = lines.copy()
    faces = []  # line, corners, lowest and highest vertex and texture coordinate
    for number, line in enumerate(lines):
        kind, _, rest = line.partition(" ")
        if kind in count:
            count[kind] += 1
            absolute[number] = line.partition("#")[0]
        elif kind == "f":
            corners = rest.partition("#")[0].split()
            if "-" in rest or "#" in rest:
                corners = ["/".join(map(_absolute, corner.split("/"), count.values())) for corner in corners]
                absolute[number] = "f " + " ".join(corners)
            index = [corner.split("/") for corner in corners]
            vertex = [_whole(each[0]) for each in index]
            place = [_whole(each[1]) for each in index if len(each) > 1 and each[1]]
            ends = [min(vertex, default=0), max(vertex, default=0), min(place, default=1), max(place, default=0)]
            faces.append((number, len(vertex), *ends))
    wrong = [line for line, corners, low, high, *_ in faces if corners < 3 or low < 1 or high > count["v"]]
    if wrong:
        raise ValueError(
            f"{path}: faces must refer to three or more of the vertices 1 to {count['v']}, got {len(wrong)} of "
            f"{len(faces)} faces that do not, the first is {lines[wrong[0]]!r} in line {wrong[0] + 1}"
        )
    wrong = [line for line, *_, low, high in faces if low < 1 or high > count["vt"]]
    if wrong:
        warnings.warn(
            f"{path}: faces should refer to texture coordinates 1 to {count['vt']} or none, got {len(wrong)} of "
            f"{len(faces)} faces that do not, the first is {lines[wrong[0]]!r} in line {wrong[0] + 1}: their materials "
            "are loaded without texture coordinates",
            stacklevel=5,
        )
    for number in wrong:
        corners = [corner.split("/") for corner in absolute[number].partition("#")[0].split()[1:]]
        absolute[number] = "f " + " ".join("//".join([each[0], *each[2:]]) for each in corners)
    return "\n".join(absolute)


def statement(line: str) -> str:
    """A line of an OBJ or MTL file without its comment. A comment starts with a # that stands alone or first."""
    return _COMMENT.sub("", line.strip()).strip()


def _whole(index: str) -> int:
    return int(index) if index.isdecimal() else 0


def _absolute(index: str, count: int) -> str:
    """Converts an index relative to the latest element to an absolute index."""
    return str(count + 1 + int(index)) if re.fullmatch(r"-\d+", index) else index


def _concatenate(scene: Any, suffix: str, name: str) -> Geometry:
    """Joins all geometries of a trimesh scene, with one region each."""
    import trimesh

    parts = []
    nodes = list(scene.graph.nodes_geometry)
    for node in reversed(nodes) if suffix == ".obj" else nodes:  # trimesh reverses the materials of an OBJ file
        geometry = scene.geometry[scene.graph[node][1]]
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        position, face = np.asarray(geometry.vertices, np.float64), np.asarray(geometry.faces, np.int64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"{name} must have three coordinates per vertex, got the shape {position.shape}")
        # Accessing missing normals by attribute would compute them.
        normal = geometry._cache.cache.get("vertex_normals", np.full(position.shape, np.nan))
        texture, given = None, getattr(geometry.visual, "uv", None)
        if given is not None and len(given) == len(position):
            # OBJ files may have one coordinate, with v = 0, or a third, which is not used.
            own = np.asarray(given, np.float64)[:, :2]
            texture = np.zeros((len(position), 2))
            texture[:, : own.shape[1]] = np.where(np.isfinite(own), own, 0)
        region = np.full(len(position), len(parts))
        parts.append(Geometry(position, face, normal, texture=texture, region=region))
    if not parts:
        raise ValueError(f"{name} must hold vertices and faces, got no faces")
    return joined(parts)
