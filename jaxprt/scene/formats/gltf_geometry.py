"""Geometry of glTF files: the triangles of the meshes of all nodes, with skins and morph targets, in world coordinates.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxprt import require
from jaxprt.files.inputs import JsonObject
from jaxprt.scene.formats.geometry import Geometry, cofactors, flat, instances, join_geometries, with_area
from jaxprt.scene.formats.gltf_file import (
    DRACO,
    QUANTIZATION,
    Document,
    Elements,
    check_required,
    needs_package,
    stated_extensions,
)
from jaxprt.scene.formats.gltf_nodes import Node, instance_count, joint_transforms, nodes
from jaxprt.scene.formats.gltf_nodes import instances as instance_matrices

# Attributes that targets change, and their numbers of components. The sign of a tangent stays (section 3.7.2.2).
_MORPHS = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (3,), "COLOR_0": (3, 4)}
_MORPHS |= {"TEXCOORD_0": (2,), "TEXCOORD_1": (2,)}
_MESH, _SEQUENTIAL, _EDGEBREAKER = 1, 0, 1
_METADATA = 0x8000  # flag of a header that metadata follow
_DEEPEST = 16  # of metadata in metadata
_CORNER = 16  # bytes of a decoded corner of a triangle and of a component of a vertex, with what the decoder keeps
# Triangles of one compressed byte: entropy coding packs equal symbols of regular meshes without a limit in theory.
_MOST_DECODED = 4096
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
# Attributes that are read, and their numbers of components.
_ATTRIBUTES = {"POSITION": (3,), "NORMAL": (3,), "TANGENT": (4,), "COLOR_0": (3, 4)}
_ATTRIBUTES |= {"TEXCOORD_0": (2,), "TEXCOORD_1": (2,)}
_FRACTIONS = ("TEXCOORD_", "COLOR_", "WEIGHTS_")  # attributes whose integers are normalized (section 3.7.2.1)
_ABOVE_1 = 1.01  # colors up to here are 1 and rounding
# Bytes for each vertex, its joints, each triangle, and each primitive of a node, while a scene is loaded, as measured.
_VERTEX, _JOINTS, _FACE, _PART = 300, 350, 70, 3000


class _Binding(NamedTuple):
    """The joints of vertices: their indices in the skin [v k], and their weights [v k]."""

    joint: np.ndarray
    weight: np.ndarray


def _skin_binding(
    document: Document, attribute: dict[str, Elements], sets: int, used: np.ndarray, name: str
) -> _Binding | None:
    """The joints of the used vertices of a primitive (section 3.7.3.3), by weights that sum to 1; None without sets."""
    if not sets:
        return None
    joint = np.concatenate([attribute[f"JOINTS_{number}"].rows(used) for number in range(sets)], 1).astype(np.int64)
    weight = np.concatenate([attribute[f"WEIGHTS_{number}"].numbers(used) for number in range(sets)], 1)
    wrong = np.flatnonzero(~(np.isfinite(weight) & (weight >= 0)).all(1))
    if wrong.size:
        got = f"{len(wrong)} of {len(weight)} vertices without, the first has {weight[wrong[0]].tolist()}"
        raise document.error(f"must have weights of joints of at least 0 in {name}", got)
    total = weight.sum(1, keepdims=True)
    first = np.eye(1, weight.shape[1])  # a vertex without weights follows its first joint
    return _Binding(joint, np.where(total > 0, weight / np.where(total > 0, total, 1), first))


def _skin_joints(document: Document, skin: int) -> list[int]:
    """Indices of the nodes that are the joints of a skin."""
    item, owner = document.items("skins")[skin], f"skin {skin}"
    joints = [document.index("nodes", joint, owner) for joint in document.field(item, "joints", owner, list)]
    if not joints:
        raise document.error(f"must have one or more joints in {owner}", "none")
    return joints


def _joint_matrices(document: Document, skin: int, world: dict[int, np.ndarray]) -> np.ndarray:
    """Transforms from a mesh to world coordinates, one for each joint of a skin [j 4 4] (section 3.7.3)."""
    item, owner, named = document.items("skins")[skin], f"skin {skin}", _skin_joints(document, skin)
    for joint in named:
        if joint not in world:
            raise document.error(f"must have joints of {owner} that belong to trees of nodes", f"node {joint}")
    matrix = np.array([world[joint] for joint in named])
    if "inverseBindMatrices" not in item:
        return matrix
    inverse = document.accessor(item["inverseBindMatrices"], f"inverseBindMatrices of {owner}", 16)
    if len(inverse.value) < len(named):
        must = f"must have an inverse bind matrix for each of the {len(named)} joints of {owner}"
        raise document.error(must, len(inverse.value))
    columns = inverse.numbers(slice(len(named))).reshape(-1, 4, 4)
    if not np.isfinite(columns).all():
        raise document.error(f"must have finite inverse bind matrices in {owner}", "others")
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        return matrix @ columns.transpose(0, 2, 1)


def _apply_skin(document: Document, geometry: Geometry, bound: _Binding, matrices: np.ndarray, name: str) -> Geometry:
    """A geometry in world coordinates: vertices are moved by the weighted means of transforms of joints [j 4 4]."""
    joint, weight = bound
    far = np.flatnonzero((((joint < 0) | (joint >= len(matrices))) & (weight > 0)).any(1))
    if far.size:
        got = f"{len(far)} of {len(joint)} vertices that refer to others, the first to {joint[far[0]].tolist()}"
        raise document.error(f"must refer to joints 0 to {len(matrices) - 1} in {name}", got)
    joint = np.clip(joint, 0, len(matrices) - 1)
    with np.errstate(over="ignore", invalid="ignore"):  # meshes refuse positions that are not finite
        mean = np.zeros((len(joint), 3, 4))
        for column in range(joint.shape[1]):
            mean += weight[:, column, None, None] * matrices[joint[:, column], :3]
        linear = mean[:, :, :3]
        cofactor = cofactors(linear)  # which transforms normals; where it mirrors, faces are flipped
        side = np.where((linear[:, 0] * cofactor[:, 0]).sum(1) < 0, -1.0, 1.0)
        turned = geometry._replace(position=_transform(linear, geometry.position) + mean[:, :, 3])
        if geometry.normal is not None:
            turned = turned._replace(normal=_transform(cofactor, geometry.normal) * side[:, None])
        if geometry.tangent is not None:
            plain = np.ones(len(joint)) if geometry.handedness is None else geometry.handedness
            turned = turned._replace(tangent=_transform(linear, geometry.tangent), handedness=plain * side)
    face = geometry.face
    mirrored = side[face].sum(1, keepdims=True) < 0
    return turned._replace(face=np.where(mirrored, face[:, ::-1], face))


def _transform(linear: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Each vector [v 3] transformed by the linear map of its vertex [v 3 3]."""
    return np.einsum("vij,vj->vi", linear, vector)


def _morph_weights(document: Document, node: Node, mesh: int, count: int) -> tuple[float, ...]:
    """The weights of the `count` morph targets of a node's mesh: those of the node, or else of the mesh, or else 0."""
    if not count:
        return ()
    for item, owner in ((node.item, f"node {node.number}"), (document.items("meshes")[mesh], f"mesh {mesh}")):
        if "weights" in item:
            what = f"the weights of {owner}, one for each morph target of mesh {mesh}"
            return tuple(document.numbers(item["weights"], (count,), what).tolist())
    return (0.0,) * count


def _morph_change(
    document: Document, primitive: "Primitive", weight: Sequence[float], key: str, used: np.ndarray
) -> np.ndarray | float:
    """What the morph targets of a primitive add to one attribute of used vertices. Those of weight 0 are not read."""
    targets, name, count = primitive.targets, primitive.name, len(primitive.attribute["POSITION"].value)
    if not targets:
        return 0.0
    if len(targets) != len(weight):
        raise document.error(f"must have {len(weight)} morph targets in {name}, as in its mesh", str(len(targets)))
    total: np.ndarray | float = 0.0
    named = document.objects({"targets": targets}, "targets", name, "morph target")
    for (owner, target), share in zip(named, weight, strict=True):
        if not share or key not in target:
            continue
        elements = document.accessor(target[key], f"{key} of {owner}", *_MORPHS[key])
        if len(elements.value) != count:
            must = f"must have {count} elements in {key} of {owner}, as in POSITION"
            raise document.error(must, len(elements.value))
        difference = _normalized(document, elements, key).numbers(used)
        wrong = np.flatnonzero(~np.isfinite(difference).all(1))
        if wrong.size:
            got = f"{len(wrong)} of {len(used)} that are not, the first at vertex {used[wrong[0]]}"
            raise document.error(f"must have finite numbers in {key} of {owner}", got)
        total = total + share * difference
    return total


class _DracoReader:
    """Decodes the compressed primitives of a file. Primitives that share a buffer view are decoded once."""

    def __init__(self, document: Document):
        self._document = document
        self._mesh: dict[int, Any] = {}

    def primitive(self, item: JsonObject, name: str) -> dict[str, Elements]:
        """The compressed attributes of a primitive, and its "indices"; empty if all its accessors have data."""
        document = self._document
        extensions = document.field(item, "extensions", name, dict)
        if DRACO not in extensions:
            return {}
        attribute = document.field(item, "attributes", name, dict)
        accessors = [*attribute.values(), *([item["indices"]] if "indices" in item else [])]
        if all("bufferView" in document.item("accessors", value, name) for value in accessors):
            return {}
        owner = f"{DRACO} of {name}"
        extension = document.field(extensions, DRACO, name, dict)
        numbers = document.field(extension, "attributes", owner, dict)
        if "POSITION" not in numbers or "indices" not in item or "POSITION" not in attribute:
            raise document.error(f"must have POSITION and indices in {owner}", f"{sorted(numbers)}")
        corners = document.form(item["indices"], f"indices of {name}", 1, whole=True)
        vertices = document.form(attribute["POSITION"], f"POSITION of {name}", 3)
        mesh = self._decoded(extension, owner, corners.rows, vertices.rows)
        face = np.asarray(mesh.faces)
        if face.size != corners.rows:
            raise document.error(f"must have {corners.rows} corners of triangles in {owner}", face.size)
        by_number = {one["unique_id"]: one["data"] for one in mesh.attributes}
        result = {"indices": Elements(face.reshape(-1, 1), np.zeros(0, np.int64), face[:0], 0)}
        for key, number in numbers.items():
            if key not in attribute:
                continue
            form = document.form(attribute[key], f"{key} of {name}", 1, 2, 3, 4)
            value = by_number.get(number) if type(number) is int else None
            if value is None or value.shape != (form.rows, form.width):
                got = "none" if value is None else f"{value.shape[0]} of {value.shape[1]}"
                raise document.error(f"must have {form.rows} elements of {form.width} in {key} of {owner}", got)
            value = np.asarray(value).astype(form.dtype)
            result[key] = Elements(value, np.zeros(0, np.int64), value[:0], form.most)
        return result

    def _decoded(self, extension: JsonObject, owner: str, corners: int, vertices: int) -> Any:
        """The decoded mesh of a buffer view, whose header must state as many triangles as the primitive has."""
        document = self._document
        index = document.index("bufferViews", extension.get("bufferView"), owner)
        if index in self._mesh:
            return self._mesh[index]
        content = bytes(document.view(index, owner)[0])
        size = _CORNER * (corners + vertices * len(extension["attributes"]))
        document.decoding(size, len(content), owner, most=_MOST_DECODED * _CORNER)
        with needs_package("DracoPy", document.path, owner):
            import DracoPy
        must = f"must have an undamaged mesh of Draco in {owner}"
        try:
            faces, points = mesh_counts(content)
        except (ValueError, IndexError, struct.error) as error:
            raise document.error(must, str(error) or "other data") from error
        if 3 * faces != corners or points > vertices:
            got = f"{faces} triangles and {points} vertices in the header of the compressed data"
            raise document.error(f"must have {corners // 3} triangles and {vertices} vertices in {owner}", got)
        try:
            mesh = DracoPy.decode(content)
        except (DracoPy.FileTypeException, ValueError, RuntimeError, MemoryError) as error:
            raise document.error(must, f"{type(error).__name__}: {error}") from error
        self._mesh[index] = mesh
        return mesh


def mesh_counts(content: bytes) -> tuple[int, int]:
    """The numbers of triangles and of vertices that the header of a Draco mesh states.

    Vertices on seams count once, so that a mesh may have more than the header states. The decoder allocates memory by
    these numbers before it can find out that the data are shorter.
    Reference: Draco bitstream specification, sections 3 and 4.
    """
    magic, major, minor, kind, method, flags = struct.unpack_from("<5s4BH", content)
    if (magic, major, minor, kind) != (b"DRACO", 2, 2, _MESH) or method not in (_SEQUENTIAL, _EDGEBREAKER):
        raise ValueError(f"data that start {content[:10]!r}")
    place = 11
    if flags & _METADATA:
        count, place = _varint(content, place)
        for _ in range(count):
            _, place = _varint(content, place)
            place = _after_metadata(content, place, 0)
        place = _after_metadata(content, place, 0)
    if method == _SEQUENTIAL:
        faces, place = _varint(content, place)
        return faces, _varint(content, place)[0]
    points, place = _varint(content, place + 1)  # after the kind of the traversal
    return _varint(content, place)[0], points


def _varint(content: bytes, place: int) -> tuple[int, int]:
    """A number of seven bits in each byte, lowest first, and the place after it."""
    value = shift = 0
    while content[place] & 128:
        value |= (content[place] & 127) << shift
        place, shift = place + 1, shift + 7
        if shift > 28:
            raise ValueError("a number of more than 32 bits")
    return value | content[place] << shift, place + 1


def _after_metadata(content: bytes, place: int, depth: int) -> int:
    """The place after a tree of metadata."""
    if depth > _DEEPEST:
        raise ValueError("metadata that are nested too deeply")
    count, place = _varint(content, place)
    for _ in range(count):
        place += 1 + content[place]
        size, place = _varint(content, place)
        place += size
    count, place = _varint(content, place)
    for _ in range(count):
        place += 1 + content[place]
        place = _after_metadata(content, place, depth + 1)
    return place


class Primitive(NamedTuple):
    """Triangles of a mesh with one material, not yet read."""

    name: str  # for messages
    material: int | None  # its index; None for the default one
    mode: int  # how corners form triangles
    corner: Elements | None  # vertices of the corners; None if they are the vertices in order
    attribute: dict[str, Elements]  # attributes of the vertices by their names in the file
    joints: int  # number of sets of joints; 0 where no skin is used
    targets: list  # morph targets, as they stand in the file

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


Drawn = Sequence[tuple[Node, int]]  # nodes that draw a mesh, and the index of the mesh
Primitives = dict[int, list[Primitive]]  # those of each mesh


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
        ValueError: The file is damaged, has no triangles, or requires an unknown extension.
        MemoryError: The triangles do not fit into memory.
    """
    check_required(document, geometry=True)
    scene = nodes(document) if scene is None else scene
    ignored: set[str] = set()
    drawn = [
        (node, document.index("meshes", node.item["mesh"], f"node {node.number}"))
        for node in scene
        if "mesh" in node.item
    ]
    skinned = {mesh for node, mesh in drawn if "skin" in node.item}
    draco = _DracoReader(document)
    meshes = dict.fromkeys(mesh for _, mesh in drawn)
    primitives = {mesh: _primitives(document, mesh, mesh in skinned, draco, ignored) for mesh in meshes}
    # Meshes without triangles have no instances: these would take memory that `_check_memory` does not count.
    drawn = [(node, mesh) for node, mesh in drawn if primitives[mesh]]
    _check_memory(document, drawn, primitives)
    parts, labels = [], []
    vanished = 0
    for node, primitive, geometry in _placements(document, scene, drawn, primitives):
        vanished += primitive.face_count - len(geometry.face)
        if len(geometry.face):
            parts.append(geometry)
            labels.append(node.number if groups else primitive.material)
    if not parts and vanished:
        got = f"{vanished} that nodes or joints scale to nothing"
        raise document.error("must hold faces with an area", got)
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
    geometry = join_geometries(parts)._replace(region=region)
    return Contents(geometry, () if groups else tuple(order), frozenset(lacking), frozenset(ignored))


def _primitives(
    document: Document, mesh: int, skinned: bool, draco: _DracoReader, ignored: set[str]
) -> list[Primitive]:
    """The primitives of a mesh that consist of triangles. Adds the names of what is not read to `ignored`."""
    primitives = []
    for name, item in document.objects(document.items("meshes")[mesh], "primitives", f"mesh {mesh}", "primitive"):
        mode = document.field(item, "mode", name, int, _TRIANGLES)
        if mode > _FAN:
            raise document.error(f"must have a mode from 0 to {_FAN} in {name}", mode)
        if mode < _TRIANGLES:
            ignored.add("points and lines")
            continue
        material = item.get("material")
        if material is not None:
            material = document.index("materials", material, name)
        attribute = document.field(item, "attributes", name, dict)
        decoded = draco.primitive(item, name)
        elements = _elements(document, attribute, skinned, decoded, name, ignored)
        index = decoded.get("indices")
        mode = mode if index is None else _TRIANGLES
        if "indices" in item and index is None:
            index = document.accessor(item["indices"], f"indices of {name}", 1, whole=True)
        corners = len((index or elements["POSITION"]).value)
        if corners < 3 or (mode == _TRIANGLES and corners % 3):
            must = "a multiple of three" if mode == _TRIANGLES else "three or more"
            raise document.error(f"must have {must} corners of triangles in {name}", corners)
        sets = sum(key.startswith("JOINTS_") for key in elements)
        targets = document.field(item, "targets", name, list)
        changed = {key for target in targets if isinstance(target, dict) for key in target}
        unchanged = changed - (elements.keys() & _MORPHS.keys()) - {"NORMAL", "TANGENT"}
        ignored |= {f"{key} of morph targets" for key in unchanged if not key.startswith("_")}
        primitives.append(Primitive(name, material, mode, index, elements, sets, targets))
    return primitives


def _elements(
    document: Document,
    attribute: JsonObject,
    skinned: bool,
    decoded: dict[str, Elements],
    name: str,
    ignored: set[str],
) -> dict[str, Elements]:
    """The attributes of a primitive that are read; some may be decoded already. Adds what is not to `ignored`."""
    if "POSITION" not in attribute:
        raise document.error("must be an undamaged glTF file", f"one that lacks 'POSITION' in {name}")
    widths: dict[str, tuple[int, ...]] = dict(_ATTRIBUTES)
    sets = 0
    while skinned and f"JOINTS_{sets}" in attribute and f"WEIGHTS_{sets}" in attribute:
        widths |= {f"JOINTS_{sets}": (4,), f"WEIGHTS_{sets}": (4,)}
        sets += 1
    if skinned and not sets:
        ignored.add("skins of primitives without JOINTS_0 and WEIGHTS_0")
    bindings = () if skinned else ("JOINTS_", "WEIGHTS_")
    ignored |= {key for key in attribute.keys() - widths.keys() if not key.startswith(("_", *bindings))}
    elements = {}
    for key, width in widths.items():
        if key in attribute:
            whole = key.startswith("JOINTS_")
            owner = f"{key} of {name}"
            document.form(attribute[key], owner, *width, whole=whole)
            elements[key] = decoded.get(key) or document.accessor(attribute[key], owner, *width, whole=whole)
            got, count = len(elements[key].value), len(elements["POSITION"].value)
            if got != count:
                raise document.error(f"must have {count} elements in {key} of {name}, as in POSITION", got)
            fraction = _normalized(document, elements[key], key)
            if fraction is not elements[key]:
                ignored.add(f"{key} of integers without normalized (they are read as normalized)")
            elements[key] = fraction
    color = elements["COLOR_0"].numbers() if "COLOR_0" in elements else np.zeros(0)
    if not (np.abs(color - 0.5) <= _ABOVE_1 - 0.5).all():
        ignored.add("COLOR_0 beyond 0 to 1 (colors are clipped)")
    return elements


def _normalized(document: Document, elements: Elements, key: str) -> Elements:
    """Integers as normalized ones where an attribute has no others. Quantized texture coordinates may have any."""
    plain = elements.value.dtype.kind == "f" or elements.most or not key.startswith(_FRACTIONS)
    if plain or (key.startswith("TEXCOORD_") and QUANTIZATION in stated_extensions(document)):
        return elements
    return elements._replace(most=int(np.iinfo(elements.value.dtype).max))


def _check_memory(document: Document, drawn: Drawn, primitives: Primitives) -> None:
    """Refuses geometry that does not fit into memory, before it is read."""
    size: dict[int, np.ndarray] = {}
    for mesh, listed in primitives.items():
        vertices, faces = (
            sum(getattr(primitive, name) for primitive in listed) for name in ("most_vertices", "face_count")
        )
        joints = sum(primitive.most_vertices for primitive in listed if primitive.joints)
        need = vertices * _VERTEX + joints * _JOINTS + faces * _FACE + len(listed) * _PART
        size[mesh] = np.array([vertices, faces, need], object)  # Python's integers, which do not overflow
    times = [instance_count(document, node) for node, _ in drawn]
    total = sum((count * size[mesh] for count, (_, mesh) in zip(times, drawn, strict=True)), np.zeros(3, object))
    vertices, faces, need = total.tolist()
    require.memory(
        f"up to {vertices:,} vertices and {faces:,} triangles in {sum(times):,} meshes of {document.path}",
        need,
        "load a smaller part of the scene, or simplify its meshes",
    )


def _placements(
    document: Document, scene: Sequence[Node], drawn: Drawn, primitives: Primitives
) -> Iterator[tuple[Node, Primitive, Geometry]]:
    """The primitives of all nodes in world coordinates, in the order of the nodes. Equal meshes are placed at once."""
    matrices = [instance_matrices(document, node) for node, _ in drawn]
    most = {mesh: max(len(primitive.targets) for primitive in listed) for mesh, listed in primitives.items() if listed}
    # Meshes are equal if their morph targets have the same weights.
    shapes = [(mesh, _morph_weights(document, node, mesh, most[mesh])) for node, mesh in drawn]
    together: dict[tuple, list[np.ndarray]] = {}
    for shape, matrix in zip(shapes, matrices, strict=True):
        together.setdefault(shape, []).append(matrix)
    bound, placed = {}, {}
    for shape, transforms in together.items():
        pairs = [_geometry(document, primitive, shape[1]) for primitive in primitives[shape[0]]]
        bound[shape] = pairs
        placed[shape] = [iter(instances(geometry, np.concatenate(transforms))) for geometry, _ in pairs]
    skins = _skins(document, scene, drawn, primitives)
    for (node, _), shape, matrix in zip(drawn, shapes, matrices, strict=True):
        skin, listed = skins.get(node.number), primitives[shape[0]]
        flattens = flat(matrix) if skin is None else np.repeat(flat(skin).any(), len(matrix))
        for flattened in flattens:
            for primitive, (geometry, binding), rest in zip(listed, bound[shape], placed[shape], strict=True):
                here = next(rest)
                if skin is not None and binding is not None:
                    here = _apply_skin(document, geometry, binding, skin, primitive.name)
                    here = here._replace(normal=_face_normals(here.position[here.face])) if primitive.flat else here
                yield node, primitive, with_area(here) if flattened else here


def _skins(document: Document, scene: Sequence[Node], drawn: Drawn, primitives: Primitives) -> dict[int, np.ndarray]:
    """Transforms of the joints of all nodes that draw a mesh with a skin, by the index of the node."""
    skin = {
        node.number: document.index("skins", node.item["skin"], f"node {node.number}")
        for node, mesh in drawn
        if "skin" in node.item and any(primitive.joints for primitive in primitives[mesh])
    }
    if not skin:
        return {}
    joints = [joint for number in set(skin.values()) for joint in _skin_joints(document, number)]
    world = joint_transforms(document, scene, joints)
    matrices = {number: _joint_matrices(document, number, world) for number in set(skin.values())}
    return {node: matrices[number] for node, number in skin.items()}


def _geometry(document: Document, primitive: Primitive, weight: Sequence[float]) -> tuple[Geometry, _Binding | None]:
    """The triangles of a primitive (section 3.7.2) at weights of its morph targets, and the joints of its vertices."""
    face = _faces(document, primitive)
    if primitive.flat:
        used, face = face.ravel(), np.arange(face.size).reshape(-1, 3)
    else:
        used, face = _compact_vertices(face, len(primitive.attribute["POSITION"].value))

    value: dict[str, np.ndarray] = {}
    for key in [key for key in _ATTRIBUTES if key in primitive.attribute]:
        if key == "TANGENT" and primitive.flat:
            continue  # section 3.7.2.1: ignored without normals
        value[key] = primitive.attribute[key].numbers(used)
        change = _morph_change(document, primitive, weight, key, used)
        if isinstance(change, np.ndarray):
            width = min(value[key].shape[1], change.shape[1])
            value[key][:, :width] += change[:, :width]
    position, tangent, color = value["POSITION"], value.get("TANGENT"), value.get("COLOR_0")
    normal = _face_normals(position) if primitive.flat else value["NORMAL"]
    # In glTF v points down. Coordinates that are not finite count as missing.
    texture, second = (
        None if place is None else np.where(np.isfinite(place), [[0, 1]] + place * [[1, -1]], 0)
        for place in (value.get("TEXCOORD_0"), value.get("TEXCOORD_1"))
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
    return geometry, _skin_binding(document, primitive.attribute, primitive.joints, used, primitive.name)


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


def _compact_vertices(face: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that triangles use, in ascending order, and the triangles as indices to these."""
    # Thousands of primitives may share one array of vertices, so the work is in proportion to the triangles.
    if count > 4 * face.size:
        used, dense = np.unique(face, return_inverse=True)
        return used, dense.reshape(-1, 3)
    mask = np.zeros(count, bool)
    mask[face] = True
    return np.flatnonzero(mask), (np.cumsum(mask) - 1)[face]
