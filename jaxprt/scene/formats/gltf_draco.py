"""Primitives of glTF files that Draco compressed: KHR_draco_mesh_compression."""

import struct
from typing import Any

import numpy as np

from jaxprt.scene.formats.gltf_file import Document, Elements

DRACO = "KHR_draco_mesh_compression"
_MESH, _SEQUENTIAL, _EDGEBREAKER = 1, 0, 1
_METADATA = 0x8000  # flag of a header that metadata follow
_DEEPEST = 16  # of metadata in metadata
_CORNER = 16  # bytes of a decoded corner of a triangle and of a component of a vertex, with what the decoder keeps
# Triangles of one compressed byte: entropy coding packs equal symbols of regular meshes without a limit in theory.
_MOST = 4096


class DracoReader:
    """Decodes the compressed primitives of a file. Primitives that share a buffer view are decoded once."""

    def __init__(self, document: Document):
        self._document = document
        self._mesh: dict[int, Any] = {}

    def primitive(self, item: dict[str, Any], name: str) -> dict[str, Elements] | None:
        """The compressed attributes of a primitive, and its "indices"; None if all its accessors have data.

        Args:
            item: The primitive.
            name: Name of the primitive, for messages.

        Raises:
            ImportError: The package DracoPy is missing.
            ValueError: The data are damaged, or have other counts than the accessors of the primitive.
            MemoryError: The decoded data do not fit into memory.
        """
        document = self._document
        extensions = document.object(item, "extensions", name)
        if DRACO not in extensions:
            return None
        attribute = document.object(item, "attributes", name)
        accessors = [*attribute.values(), *([item["indices"]] if "indices" in item else [])]
        if all("bufferView" in document.item("accessors", value, name) for value in accessors):
            return None
        owner = f"{DRACO} of {name}"
        extension = document.object(extensions, DRACO, name)
        numbers = document.object(extension, "attributes", owner)
        if "POSITION" not in numbers or "indices" not in item or "POSITION" not in attribute:
            raise document.error(f"must have POSITION and indices in {owner}", f"{sorted(numbers)}")
        corners = document.form(item["indices"], f"indices of {name}", 1, whole=True)
        vertices = document.form(attribute["POSITION"], f"POSITION of {name}", 3)
        mesh = self._decoded(extension, owner, corners.rows, vertices.rows)
        face = np.asarray(mesh.faces)
        if face.size != corners.rows:
            raise document.error(f"must have {corners.rows} corners of triangles in {owner}", str(face.size))
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

    def _decoded(self, extension: dict[str, Any], owner: str, corners: int, vertices: int) -> Any:
        """The decoded mesh of a buffer view, whose header must state as many triangles as the primitive has."""
        document = self._document
        index = document.index("bufferViews", extension.get("bufferView"), owner)
        if index in self._mesh:
            return self._mesh[index]
        content = bytes(document.view(index, owner)[0])
        size = _CORNER * (corners + vertices * len(extension["attributes"]))
        document.decoding(size, len(content), owner, most=_MOST * _CORNER)
        try:
            import DracoPy
        except ImportError as error:
            raise ImportError(
                f"{document.path} has compressed geometry ({owner}), which needs the package DracoPy: "
                "pip install 'jaxprt[web]'"
            ) from error
        must = f"must have an undamaged mesh of Draco in {owner}"
        try:
            faces, points = stated_counts(content)
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


def stated_counts(content: bytes) -> tuple[int, int]:
    """The numbers of triangles and of vertices that the header of a Draco mesh states.

    Vertices on seams count once, so that a mesh may have more than the header states. The decoder allocates memory by
    these numbers before it can find out that the data are shorter.

    Raises:
        ValueError: It is not a mesh of version 2.2.
        IndexError: The data end too early.

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
