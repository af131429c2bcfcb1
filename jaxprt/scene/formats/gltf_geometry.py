"""Geometry of glTF files: the triangles of the meshes of all nodes, in world coordinates.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxprt import require
from jaxprt.scene.formats import gltf_morph, gltf_skin
from jaxprt.scene.formats.geometry import Geometry, instances, joined
from jaxprt.scene.formats.gltf_draco import DracoReader
from jaxprt.scene.formats.gltf_extensions import check_required
from jaxprt.scene.formats.gltf_file import Document, Elements
from jaxprt.scene.formats.gltf_nodes import Node, instance_count, joint_transforms, nodes
from jaxprt.scene.formats.gltf_nodes import instances as instance_matrices

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Attributes that are read, and their numbers of components.
_ATTRIBUTES = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (4,), "COLOR_0": (3, 4)}
_ATTRIBUTES |= {"TEXCOORD_0": (2,), "TEXCOORD_1": (2,)}
# Bytes for each vertex, its joints, each triangle, and each primitive of a node, while a scene is loaded, as measured.
_VERTEX, _JOINTS, _FACE, _PART = 300, 350, 70, 3000


class Primitive(NamedTuple):
    """Triangles of a mesh with one material, not yet read.

    Attributes:
        name: Name for messages.
        material: Index of the material; None for the default one.
        mode: How corners form triangles.
        corner: Vertices of the corners; None if they are the vertices in order.
        attribute: Attributes of the vertices by their names in the file.
        joints: Number of sets of joints; 0 where no skin is used.
        targets: Morph targets, as they stand in the file.
    """

    name: str
    material: int | None
    mode: int
    corner: Elements | None
    attribute: dict[str, Elements]
    joints: int
    targets: list

    @property
    def flat(self) -> bool:
        """Whether each triangle has vertices and a normal of its own, because the file has no normals."""
        return "NORMAL" not in self.attribute

    @property
    def face_count(self) -> int:
        """Number of triangles."""
        corners = len((self.corner or self.attribute["POSITION"]).value)
        return corners // 3 if self.mode == _TRIANGLES else corners - 2

    @property
    def most_vertices(self) -> int:
        """Upper bound of the number of used vertices."""
        corners = 3 * self.face_count
        return corners if self.flat else min(corners, len(self.attribute["POSITION"].value))


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


def read(document: Document, *, groups: bool = False, scene: Sequence[Node] | None = None) -> Contents:
    """Reads all triangles of the default scene in world coordinates. Instances of a mesh are repeated.

    Vertices that no triangle of their primitive uses are removed. The others keep the order of the file. Without
    normals, each triangle has vertices and a flat normal of its own (section 3.7.2.1). Meshes with a skin are in the
    pose of the file's joints. Morph targets have the weights of the node, or else of the mesh.

    Args:
        document: The file.
        groups: Whether regions are nodes, in order of occurrence. Otherwise they are the used materials in ascending
            order, with primitives without material last.
        scene: The nodes of the default scene; None reads them.

    Raises:
        ValueError: The file is damaged, has no triangles, requires an unknown extension, or has compressed geometry.
        MemoryError: The triangles do not fit into memory.
    """
    check_required(document, geometry=True)
    scene = nodes(document) if scene is None else scene
    drawn = [node for node in scene if "mesh" in node.item]
    ignored: set[str] = set()
    mesh_of = [document.index("meshes", node.item["mesh"], f"node {node.number}") for node in drawn]
    skinned = {mesh for node, mesh in zip(drawn, mesh_of, strict=True) if "skin" in node.item}
    draco = DracoReader(document)
    primitives = {mesh: _primitives(document, mesh, mesh in skinned, draco, ignored) for mesh in dict.fromkeys(mesh_of)}
    # Meshes without triangles have no instances: these would take memory that `_check_memory` does not count.
    drawn = [node for node, mesh in zip(drawn, mesh_of, strict=True) if primitives[mesh]]
    mesh_of = [mesh for mesh in mesh_of if primitives[mesh]]
    _check_memory(document, drawn, mesh_of, primitives)
    parts, labels = [], []
    for node, primitive, geometry in _placements(document, scene, drawn, mesh_of, primitives):
        parts.append(geometry)
        labels.append(node.number if groups else primitive.material)
    if not parts:
        extra = f" ({', '.join(sorted(ignored))} are not read)" if ignored else ""
        raise document.error("must hold vertices and faces", f"no faces{extra}")
    order = list(dict.fromkeys(labels))
    if not groups:
        order.sort(key=lambda material: len(document.items("materials")) if material is None else material)
    rank = {label: number for number, label in enumerate(order)}
    region = np.repeat([rank[label] for label in labels], [len(part.position) for part in parts])
    lacking = {
        (primitive.material, number)
        for listed in primitives.values()
        for primitive in listed
        for number in (0, 1)
        if f"TEXCOORD_{number}" not in primitive.attribute
    }
    geometry = joined(parts)._replace(region=region)
    return Contents(geometry, () if groups else tuple(order), frozenset(lacking), frozenset(ignored))


def _primitives(document: Document, mesh: int, skinned: bool, draco: DracoReader, ignored: set[str]) -> list[Primitive]:
    """The primitives of a mesh that consist of triangles. Adds the names of what is not read to `ignored`."""
    owner = f"mesh {mesh}"
    primitives = []
    for number, item in enumerate(document.array(document.items("meshes")[mesh], "primitives", owner)):
        name = f"primitive {number} of {owner}"
        if not isinstance(item, dict):
            raise document.error(f"must have an object for {name}", repr(item)[:80])
        mode = document.integer(item, "mode", name, _TRIANGLES)
        if mode > _FAN:
            raise document.error(f"must have a mode from 0 to {_FAN} in {name}", str(mode))
        if mode < _TRIANGLES:
            ignored.add("points and lines")
            continue
        material = item.get("material")
        if material is not None:
            material = document.index("materials", material, name)
        attribute = document.object(item, "attributes", name)
        ignored |= {
            key for key in attribute if key.startswith(("TEXCOORD_", "COLOR_")) and key[-2:] not in ("_0", "_1")
        }
        ignored |= {"COLOR_1"} & set(attribute)
        decoded = draco.primitive(item, name) or {}
        elements = _elements(document, attribute, skinned, decoded, name)
        index = decoded.get("indices")
        mode = mode if index is None else _TRIANGLES
        if "indices" in item and index is None:
            index = document.accessor(item["indices"], f"indices of {name}", 1, whole=True)
        corners = len((index or elements["POSITION"]).value)
        if corners < 3 or (mode == _TRIANGLES and corners % 3):
            must = "a multiple of three" if mode == _TRIANGLES else "three or more"
            raise document.error(f"must have {must} corners of triangles in {name}", str(corners))
        sets = sum(key.startswith("JOINTS_") for key in elements)
        targets = document.array(item, "targets", name)
        primitives.append(Primitive(name, material, mode, index, elements, sets, targets))
    return primitives


def _elements(
    document: Document, attribute: dict[str, Any], skinned: bool, decoded: dict[str, Elements], name: str
) -> dict[str, Elements]:
    """The attributes of a primitive that are read; some may be decoded already."""
    if "POSITION" not in attribute:
        raise document.error("must be an undamaged glTF file", f"one that lacks 'POSITION' in {name}")
    widths = dict(_ATTRIBUTES)
    sets = 0
    while skinned and f"JOINTS_{sets}" in attribute and f"WEIGHTS_{sets}" in attribute:
        widths |= {f"JOINTS_{sets}": (4,), f"WEIGHTS_{sets}": (4,)}
        sets += 1
    elements = {}
    for key, width in widths.items():
        if key in attribute:
            whole = key.startswith("JOINTS_")
            owner = f"{key} of {name}"
            document.form(attribute[key], owner, *width, whole=whole)
            elements[key] = decoded.get(key) or document.accessor(attribute[key], owner, *width, whole=whole)
            got, count = len(elements[key].value), len(elements["POSITION"].value)
            if got != count:
                raise document.error(f"must have {count} elements in {key} of {name}, as in POSITION", str(got))
    return elements


def _check_memory(
    document: Document, drawn: Sequence[Node], mesh_of: Sequence[int], primitives: dict[int, list[Primitive]]
) -> None:
    """Refuses geometry that does not fit into memory, before it is read."""
    size: dict[int, np.ndarray] = {}
    for mesh, listed in primitives.items():
        vertices, faces = (
            sum(getattr(primitive, name) for primitive in listed) for name in ("most_vertices", "face_count")
        )
        joints = sum(primitive.most_vertices for primitive in listed if primitive.joints)
        need = vertices * _VERTEX + joints * _JOINTS + faces * _FACE + len(listed) * _PART
        size[mesh] = np.array([vertices, faces, need], object)  # Python's integers, which do not overflow
    times = [instance_count(document, node) for node in drawn]
    total = sum((count * size[mesh] for count, mesh in zip(times, mesh_of, strict=True)), np.zeros(3, object))
    vertices, faces, need = total.tolist()
    require.memory(
        f"up to {vertices:,} vertices and {faces:,} triangles in {sum(times):,} meshes of {document.path}",
        need,
        "load a smaller part of the scene, or simplify its meshes",
    )


def _placements(
    document: Document,
    scene: Sequence[Node],
    drawn: Sequence[Node],
    mesh_of: Sequence[int],
    primitives: dict[int, list[Primitive]],
) -> Iterator[tuple[Node, Primitive, Geometry]]:
    """The primitives of all nodes in world coordinates, in the order of the nodes. Equal meshes are placed at once.

    Meshes are equal if their morph targets have the same weights.
    """
    matrices = [instance_matrices(document, node) for node in drawn]
    most = {mesh: max(len(primitive.targets) for primitive in listed) for mesh, listed in primitives.items() if listed}
    shapes = [
        (mesh, gltf_morph.weights(document, node, mesh, most[mesh])) for node, mesh in zip(drawn, mesh_of, strict=True)
    ]
    together: dict[tuple, list[np.ndarray]] = {}
    for shape, matrix in zip(shapes, matrices, strict=True):
        together.setdefault(shape, []).append(matrix)
    bound, placed = {}, {}
    for shape, transforms in together.items():
        pairs = [_geometry(document, primitive, shape[1]) for primitive in primitives[shape[0]]]
        bound[shape] = pairs
        placed[shape] = [iter(instances(geometry, np.concatenate(transforms))) for geometry, _ in pairs]
    skins = _joint_matrices(document, scene, drawn, mesh_of, primitives)
    for node, shape, matrix in zip(drawn, shapes, matrices, strict=True):
        skin, listed = skins.get(node.number), primitives[shape[0]]
        for _ in matrix:
            for primitive, (geometry, binding), rest in zip(listed, bound[shape], placed[shape], strict=True):
                here = next(rest)
                if skin is not None and binding is not None:
                    here = gltf_skin.pose(document, geometry, binding, skin, primitive.name)
                    here = here._replace(normal=_face_normals(here.position[here.face])) if primitive.flat else here
                yield node, primitive, here


def _joint_matrices(
    document: Document,
    scene: Sequence[Node],
    drawn: Sequence[Node],
    mesh_of: Sequence[int],
    primitives: dict[int, list[Primitive]],
) -> dict[int, np.ndarray]:
    """Transforms of the joints of all nodes that draw a mesh with a skin, by the index of the node."""
    skin = {
        node.number: document.index("skins", node.item["skin"], f"node {node.number}")
        for node, mesh in zip(drawn, mesh_of, strict=True)
        if "skin" in node.item and any(primitive.joints for primitive in primitives[mesh])
    }
    if not skin:
        return {}
    named = [joint for number in set(skin.values()) for joint in gltf_skin.joints(document, number)]
    world = joint_transforms(document, scene, named)
    matrices = {number: gltf_skin.joint_matrices(document, number, world) for number in set(skin.values())}
    return {node: matrices[number] for node, number in skin.items()}


def _geometry(
    document: Document, primitive: Primitive, weight: tuple[float, ...]
) -> tuple[Geometry, gltf_skin.Binding | None]:
    """The triangles of a primitive (section 3.7.2), and the joints of its vertices.

    Args:
        document: The file.
        primitive: The primitive.
        weight: Weights of its morph targets.
    """
    face = _faces(document, primitive)
    if primitive.flat:
        used, face = face.ravel(), np.arange(face.size).reshape(-1, 3)
    else:
        used, face = _used(face, len(primitive.attribute["POSITION"].value))

    count = len(primitive.attribute["POSITION"].value)

    def values(key: str) -> np.ndarray | None:
        if key not in primitive.attribute:
            return None
        value, targets = primitive.attribute[key].numbers(used), primitive.targets
        change = gltf_morph.change(document, targets, weight, key=key, used=used, count=count, name=primitive.name)
        if isinstance(change, np.ndarray):
            width = min(value.shape[1], change.shape[1])
            value[:, :width] += change[:, :width]
        return value

    position = values("POSITION")
    assert position is not None
    normal = _face_normals(position) if primitive.flat else values("NORMAL")
    tangent = None if primitive.flat else values("TANGENT")  # section 3.7.2.1: ignored without normals
    color = values("COLOR_0")
    # In glTF v points down. Coordinates that are not finite count as missing.
    texture, second = (
        None if place is None else np.where(np.isfinite(place), [[0, 1]] + place * [[1, -1]], 0)
        for place in (values("TEXCOORD_0"), values("TEXCOORD_1"))
    )
    geometry = Geometry(
        position,
        face,
        normal,
        None if tangent is None else tangent[:, :3],
        None if tangent is None else np.where(tangent[:, 3] < 0, -1.0, 1.0),
        texture,
        second,
        None if color is None else np.clip(np.nan_to_num(color[:, :3]), 0, 1),
        alpha=None if color is None or color.shape[1] < 4 else np.clip(np.nan_to_num(color[:, 3], nan=1.0), 0, 1),
    )
    bound = gltf_skin.binding(document, primitive.attribute, primitive.joints, used, primitive.name)
    return geometry, bound


def _face_normals(position: np.ndarray) -> np.ndarray:
    """Unit normals [3f 3] of separate triangles with positions [3f 3]. A triangle without area gets +y."""
    corner = position.reshape(-1, 3, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(cross, axis=1, keepdims=True)
    flat = np.where(length > 0, cross / np.where(length > 0, length, 1), [0.0, 1.0, 0.0])
    return np.repeat(flat, 3, 0)


def _faces(document: Document, primitive: Primitive) -> np.ndarray:
    """Vertex indices of the triangles of a primitive."""
    count = len(primitive.attribute["POSITION"].value)
    index = np.arange(count)
    if primitive.corner is not None:
        index = primitive.corner.rows()[:, 0].astype(np.int64)
        if index.min() < 0 or index.max() >= count:
            wrong = np.flatnonzero((index < 0) | (index >= count))
            got = f"{len(wrong)} of {len(index)} that refer to others, the first is {index[wrong[0]]} at {wrong[0]}"
            raise document.error(f"must refer to vertices 0 to {count - 1} in indices of {primitive.name}", got)
    if primitive.mode == _TRIANGLES:
        return index.reshape(-1, 3)
    step = np.arange(len(index) - 2)
    if primitive.mode == _FAN:
        return np.stack([index[step + 1], index[step + 2], np.full(len(step), index[0])], 1)
    odd = step % 2
    return np.stack([index[step], index[step + 1 + odd], index[step + 2 - odd]], 1)


def _used(face: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that triangles use, in ascending order, and the triangles as indices to these.

    Thousands of primitives may share one array of vertices, so the work is in proportion to the triangles.
    """
    if count > 4 * face.size:
        used, dense = np.unique(face, return_inverse=True)
        return used, dense.reshape(-1, 3)
    mask = np.zeros(count, bool)
    mask[face] = True
    return np.flatnonzero(mask), (np.cumsum(mask) - 1)[face]
