"""Geometry of glTF files: nodes with their transforms, and the triangles of their meshes.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxprt.scene.formats.geometry import Geometry, joined, placed
from jaxprt.scene.formats.gltf_file import Document

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_COMPRESSED = {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression"}


class Placed(NamedTuple):
    """A node with its transform to world coordinates.

    Attributes:
        node: Index of the node.
        item: The JSON object of the node.
        matrix: Transform from the node to world coordinates [4 4].
    """

    node: int
    item: dict[str, Any]
    matrix: np.ndarray


class Contents(NamedTuple):
    """The triangles of a file's default scene.

    Attributes:
        geometry: All triangles, with regions numbered from 0.
        material: Index of each region's material, None for primitives without one; empty if regions are nodes.
        lacking: Pairs of a material's index and a set of texture coordinates that some of its primitives lack.
        ignored: Names of features of the scene that are not read.
    """

    geometry: Geometry
    material: tuple[int | None, ...]
    lacking: frozenset[tuple[int | None, int]]
    ignored: frozenset[str]


def read(document: Document, *, groups: bool = False) -> Contents:
    """Reads all triangles of the default scene in world coordinates. Instances of a mesh are repeated.

    Vertices that no triangle of their primitive uses are removed. The others keep the order of the file.

    Args:
        document: The file.
        groups: Whether regions are nodes, in order of occurrence. Otherwise they are the used materials in ascending
            order, with primitives without material last.

    Raises:
        ValueError: The file is damaged, its geometry is compressed, or it has no triangles.
    """
    _check_readable(document)
    ignored: set[str] = set()
    mesh: dict[int, list[tuple[int | None, Geometry]]] = {}
    part, label = [], []
    for node, item, matrix in nodes(document):
        if "mesh" not in item:
            continue
        index, owner = item["mesh"], f"node {node}"
        if index not in mesh:
            found = document.item("meshes", index, owner)
            mesh[index] = _primitives(document, found, f"mesh {index}", ignored)
        if "skin" in item:
            ignored.add("skins")
        for material, geometry in mesh[index]:
            part.append(placed(geometry, matrix))
            label.append(node if groups else material)
    if not part:
        extra = f" ({', '.join(sorted(ignored))} are not read)" if ignored else ""
        raise document.error("must hold vertices and faces", f"no faces{extra}")
    order = list(dict.fromkeys(label))
    if not groups:
        order.sort(key=lambda each: len(document.items("materials")) if each is None else each)
    rank = {each: number for number, each in enumerate(order)}
    part = [
        each._replace(region=np.full(len(each.position), rank[name])) for each, name in zip(part, label, strict=True)
    ]
    lacking = {
        (material, number)
        for primitives in mesh.values()
        for material, each in primitives
        for number, place in enumerate((each.texture, each.second))
        if place is None
    }
    return Contents(joined(part), () if groups else tuple(order), frozenset(lacking), frozenset(ignored))


def nodes(document: Document) -> list[Placed]:
    """All nodes of the default scene, parents before their children.

    Raises:
        ValueError: A node is missing, is reached twice, or has a transform that is not finite.
    """
    found = []
    waiting = [(index, np.eye(4), owner) for index, owner in reversed(_roots(document))]
    seen = set()
    while waiting:
        index, above, owner = waiting.pop()
        item = document.item("nodes", index, owner)
        if index in seen:
            raise document.error("must have nodes that form trees", f"node {index} twice, the second time in {owner}")
        seen.add(index)
        matrix = above @ _transform(document, item, f"node {index}")
        found.append(Placed(index, item, matrix))
        waiting += [(child, matrix, f"node {index}") for child in reversed(item.get("children", []))]
    return found


def _roots(document: Document) -> list[tuple[Any, str]]:
    """Root nodes of the default scene, or else of the first scene; without scenes, of all nodes."""
    if document.items("scenes"):
        index = document.header.get("scene", 0)
        scene = document.item("scenes", index, "the default scene")
        return [(node, f"scene {index}") for node in scene.get("nodes", [])]
    child = {child for node in document.items("nodes") for child in node.get("children", [])}
    return [(node, "the file") for node in range(len(document.items("nodes"))) if node not in child]


def _transform(document: Document, item: dict[str, Any], name: str) -> np.ndarray:
    """A node's transform, from its matrix or its translation, rotation and scale (section 3.5.2)."""
    if "matrix" in item:
        return document.numbers(item["matrix"], (16,), f"the matrix of {name}").reshape(4, 4).T
    rotation, scale, translation = (
        document.numbers(item.get(key, default), (len(default),), f"the {key} of {name}")
        for key, default in (("rotation", (0, 0, 0, 1)), ("scale", (1, 1, 1)), ("translation", (0, 0, 0)))
    )
    length = np.linalg.norm(rotation)
    if not length > 0:
        raise document.error(f"must have a nonzero quaternion for the rotation of {name}", "zero")
    x, y, z, w = rotation / length
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= scale
    matrix[:3, 3] = translation
    return matrix


def _check_readable(document: Document) -> None:
    compressed = _COMPRESSED & set(document.header.get("extensionsRequired", []))
    if compressed:
        raise document.error("must have uncompressed geometry", ", ".join(sorted(compressed)))


def _primitives(
    document: Document, mesh: dict[str, Any], owner: str, ignored: set[str]
) -> list[tuple[int | None, Geometry]]:
    """Material and geometry of each primitive of a mesh, as far as it consists of triangles."""
    found = []
    for number, item in enumerate(mesh["primitives"]):
        name = f"primitive {number} of {owner}"
        if item.get("mode", _TRIANGLES) not in (_TRIANGLES, _STRIP, _FAN):
            ignored.add("points and lines")
            continue
        if "targets" in item:
            ignored.add("morph targets")
        material = item.get("material")
        if material is not None:
            document.item("materials", material, name)
        found.append((material, _geometry(document, item, name, ignored)))
    return found


def _geometry(document: Document, item: dict[str, Any], name: str, ignored: set[str]) -> Geometry:
    """The triangles of a primitive (section 3.7.2)."""
    attribute = item["attributes"]
    ignored |= {key for key in attribute if key.startswith(("TEXCOORD_", "COLOR_")) and key[-2:] not in ("_0", "_1")}
    ignored |= {"COLOR_1"} & set(attribute)

    def read_attribute(key: str, *widths: int) -> np.ndarray | None:
        if key not in attribute:
            return None
        value = document.accessor(attribute[key], f"{key} of {name}", *widths)
        if len(value) != count:
            raise document.error(f"must have {count} elements in {key} of {name}, as in POSITION", str(len(value)))
        return value

    position = document.accessor(attribute["POSITION"], f"POSITION of {name}", 3)
    count = len(position)
    normal, tangent = read_attribute("NORMAL", 3), read_attribute("TANGENT", 4)
    color = read_attribute("COLOR_0", 3, 4)
    place = [read_attribute(f"TEXCOORD_{number}", 2) for number in (0, 1)]
    # In glTF v points down. Coordinates that are not finite count as missing.
    texture, second = (
        None if each is None else np.where(np.isfinite(each), [[0, 1]] + each * [[1, -1]], 0) for each in place
    )
    if normal is None:
        tangent = None  # section 3.7.2.1: ignored without normals
    whole = Geometry(
        position,
        _faces(document, item, count, name),
        normal,
        None if tangent is None else tangent[:, :3],
        None if tangent is None else np.where(tangent[:, 3] < 0, -1.0, 1.0),
        texture,
        second,
        None if color is None else np.clip(np.nan_to_num(color[:, :3]), 0, 1),
    )
    return _used(whole)


def _faces(document: Document, item: dict[str, Any], count: int, name: str) -> np.ndarray:
    """Vertex indices of the triangles of a primitive."""
    index = np.arange(count)
    if "indices" in item:
        index = document.accessor(item["indices"], f"indices of {name}", 1, whole=True)[:, 0].astype(np.int64)
        if index.min() < 0 or index.max() >= count:
            wrong = np.flatnonzero((index < 0) | (index >= count))
            got = f"{len(wrong)} of {len(index)} that refer to others, the first is {index[wrong[0]]} at {wrong[0]}"
            raise document.error(f"must refer to vertices 0 to {count - 1} in indices of {name}", got)
    mode = item.get("mode", _TRIANGLES)
    if len(index) < 3 or (mode == _TRIANGLES and len(index) % 3):
        must = "a multiple of three" if mode == _TRIANGLES else "three or more"
        raise document.error(f"must have {must} corners of triangles in {name}", str(len(index)))
    if mode == _TRIANGLES:
        return index.reshape(-1, 3)
    step = np.arange(len(index) - 2)
    if mode == _FAN:
        return np.stack([index[step + 1], index[step + 2], np.full(len(step), index[0])], 1)
    odd = step % 2
    return np.stack([index[step], index[step + 1 + odd], index[step + 2 - odd]], 1)


def _used(geometry: Geometry) -> Geometry:
    """A geometry without unused vertices, because primitives may share one array of vertices."""
    used = np.zeros(len(geometry.position), bool)
    used[geometry.face] = True
    if used.all():
        return geometry
    rest: dict[str, Any] = geometry._asdict()
    rest = {name: value[used] for name, value in rest.items() if value is not None and name != "face"}
    return geometry._replace(face=(np.cumsum(used) - 1)[geometry.face], **rest)
