"""The container format of glTF 2.0: header, extensions, buffers, accessors and images, in GLB or separate files.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import base64
import contextlib
import functools
import json
import math
import pathlib
import re
import struct
import urllib.parse
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeGuard

import numpy as np

from jaxprt import require
from jaxprt.files import inputs
from jaxprt.files.inputs import JsonObject

_SLACK = 64  # bytes of compressed data besides which a header can be short
_SHOWN = 80  # characters of a wrong value in messages
_LARGEST = 2**53  # JSON numbers are exact up to here
LARGEST_FLOAT = float(np.finfo(np.float32).max)
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_MODES = ("ATTRIBUTES", "TRIANGLES", "INDICES")
_FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR")
_WIDEST_ELEMENT = 256  # bytes of an element
# Decoded bytes of one compressed byte: the vertex codec packs 256 bytes of equal values into 2 bits.
_MOST_DECODED = 1024
DRACO = "KHR_draco_mesh_compression"
INSTANCING = "EXT_mesh_gpu_instancing"
QUANTIZATION = "KHR_mesh_quantization"
# Compressed data are decoded where they have no uncompressed fallback.
_COMPRESSION = {DRACO, *MESHOPT, "KHR_texture_basisu", "EXT_texture_webp"}
HONORED = {
    *(
        f"KHR_materials_{name}"
        for name in ("ior", "specular", "anisotropy", "emissive_strength", "clearcoat", "sheen", "transmission")
    ),
    "KHR_texture_transform",
    QUANTIZATION,
    INSTANCING,
    "KHR_lights_punctual",
    *_COMPRESSION,
}
# What jaxprt draws is right without these: the default variant, the finest level of detail, and no metadata.
_HARMLESS = {"KHR_materials_variants", "MSFT_lod", "KHR_xmp", "KHR_xmp_json_ld"}
_LOOK = "KHR_materials_"  # what a file looks like without these is named in a warning
_NOT_GEOMETRY = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_")
_COMPONENT = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# What fields of each type must be, and their value if they are missing; None refuses what is missing.
_KINDS: dict[type, tuple[str, Any]] = {
    dict: ("an object", {}),
    list: ("a list", []),
    bool: ("true or false", False),
    str: ("a string", None),
    int: ("a whole number of at least 0", None),
}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # types of GLB chunks
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")  # of a URI that is not relative


class Header:
    """The header of a glTF file. Errors name the file, the object and the field.

    Only what is used is checked, so that damage elsewhere does no harm. Each list is checked once.

    Attributes:
        path: The file.
        header: The JSON object.
    """

    def __init__(self, path: pathlib.Path, text: bytes):
        """Parses the JSON text of the header, which may start with a byte order mark."""
        self.path = path
        self._items: dict[str, list[JsonObject]] = {}
        self._decoded = 0  # bytes
        try:
            header = json.loads(text, object_pairs_hook=inputs.unique_names)  # section 2.6
        except (ValueError, RecursionError) as error:
            raise self.error("must be an undamaged glTF file", f"a header that is not JSON: {error}") from error
        if not isinstance(header, dict):
            raise self.error("must be an undamaged glTF file with an object as its header", excerpt(header))
        self.header: JsonObject = header
        asset = self.field(header, "asset", "the file", dict)
        version = str(asset.get("version", "none"))
        if not version.startswith("2."):
            raise self.error("must be an undamaged glTF file of version 2", f"version {version[:_SHOWN]}")
        least = str(asset.get("minVersion", "2.0"))
        if least != "2.0":
            raise self.error("must be a glTF file that needs no more than version 2.0", f"minVersion {least[:_SHOWN]}")

    def error(self, required: str, got: object) -> ValueError:
        """An error that names the file."""
        return ValueError(f"{self.path} {required}, got {got}")

    def items(self, kind: str) -> list[JsonObject]:
        """All objects of a kind, such as "meshes"; may be empty."""
        if kind not in self._items:
            items = self.header.get(kind, [])
            must = f"must be an undamaged glTF file with a list of {kind}"
            if not isinstance(items, list):
                raise self.error(must, type(items).__name__)
            for index, item in enumerate(items):
                if not isinstance(item, dict):
                    raise self.error(f"{must}, all of them objects", f"{excerpt(item)} at {index}")
            self._items[kind] = items
        return self._items[kind]

    def change(self, kind: str, fields: Mapping[int, JsonObject]) -> None:
        """Replaces fields of some objects of a kind, by their indices. The header itself keeps its fields."""
        self._items[kind] = [{**item, **fields.get(index, {})} for index, item in enumerate(self.items(kind))]

    def index(self, kind: str, value: Any, owner: str, items: list | None = None) -> int:
        """Checks the index of an object of a kind, such as "meshes", or of other `items`, to which `owner` refers."""
        items = self.items(kind) if items is None else items
        if not _is_whole(value) or not 0 <= value < len(items) or not isinstance(items[int(value)], dict):
            raise self.error(f"must refer to one of its {len(items)} {kind} in {owner}", excerpt(value))
        return int(value)

    def item(self, kind: str, value: object, owner: str) -> JsonObject:
        """The object of a kind that has an index; arguments and errors are those of `index`."""
        return self.items(kind)[self.index(kind, value, owner)]

    def field(self, item: Mapping[str, Any], key: str, owner: str, kind: type, default: Any = None) -> Any:
        """A field of an object. A missing one has the default, or is empty or false, or is refused: see `_KINDS`.

        Args:
            item: The object.
            key: Name of the field.
            owner: Name of the object, for messages.
            kind: dict, list, bool, str or int. Whole numbers must not be negative.
            default: Value of a missing field; None for that of its kind.
        """
        must, missing = _KINDS[kind]
        if default is None and missing is None and key not in item:
            raise self.error("must be an undamaged glTF file", f"one that lacks {key!r} in {owner}")
        value = item.get(key, missing if default is None else default)
        if not (_is_whole(value) and 0 <= value <= _LARGEST if kind is int else isinstance(value, kind)):
            raise self.error(f"must have {must} for {key} of {owner}", excerpt(value))
        return int(value) if kind is int else value

    def objects(self, item: JsonObject, key: str, owner: str, what: str) -> Iterator[tuple[str, JsonObject]]:
        """The objects of a field that is a list of them, each with its name, such as "channel 0 of animation 2"."""
        for index, value in enumerate(self.field(item, key, owner, list)):
            name = f"{what} {index} of {owner}"
            if not isinstance(value, dict):
                raise self.error(f"must have an object for {name}", excerpt(value))
            yield name, value

    def extension(self, item: JsonObject, key: str, owner: str) -> JsonObject:
        """An extension of an object; empty if it is missing."""
        return self.field(self.field(item, "extensions", owner, dict), key, owner, dict)

    def strings(self, key: str) -> list[str]:
        """A field of the file that is a list of strings; empty if it is missing."""
        values = self.field(self.header, key, "the file", list)
        for value in values:
            if not isinstance(value, str):
                raise self.error(f"must have a list of strings for {key} of the file", f"{excerpt(value)} in it")
        return values

    def number(self, item: JsonObject, key: str, owner: str, default: float | Sequence[float] | None) -> Any:
        """A field that is a number, or a list of as many numbers as its default; None requires the field."""
        return self.numbers(item.get(key, default), np.shape(0 if default is None else default), f"{key} of {owner}")

    def numbers(self, value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
        """Checks one number, or a list of numbers, and converts it to float64."""
        listed = value if shape else [value]
        right = isinstance(listed, list | tuple) and len(listed) == math.prod(shape)
        if not right or not all(type(number) in (int, float) and abs(number) <= LARGEST_FLOAT for number in listed):
            must = f"{math.prod(shape)} finite numbers" if shape else "a finite number"
            raise self.error(f"must have {must} for {what}", excerpt(value))
        return np.array(value, np.float64)

    def decoding(self, size: int, length: int, name: str, *, most: int) -> None:
        """Refuses compressed data that would become larger than they can, or than memory. Counts what is decoded.

        Args:
            size: Bytes that the header states for the decoded data.
            length: Bytes of the compressed data.
            name: The compressed data, for messages.
            most: Decoded bytes that one compressed byte can hold at most.
        """
        if size > most * (length + _SLACK):
            raise self.error(f"must have at most {most} decoded bytes for each byte of {name}", f"{size} for {length}")
        self._decoded += size
        require.memory(f"the decoded data of {self.path}", self._decoded, "load a smaller scene")


def excerpt(value: object) -> str:
    """A value of a header for an error message, cut where it is long."""
    text = repr(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def _is_whole(value: object) -> bool:
    """Whether a JSON number is whole, as 3 and 3.0 are. Booleans are no numbers."""
    return type(value) is int or (type(value) is float and value.is_integer())


def _is_fallback(header: Header, buffer: JsonObject, name: str) -> bool:
    """Whether a buffer only stands in for compressed data and has no bytes."""
    stated = any(header.extension(buffer, key, name).get("fallback") is True for key in MESHOPT)
    return stated and "uri" not in buffer


def _decode_meshopt(document: Header, view: JsonObject, extension: JsonObject, content: memoryview, name: str) -> bytes:
    """The bytes of the compressed buffer view `name`, whose extension is EXT_meshopt_compression."""
    owner = f"{MESHOPT[0]} of {name}" if MESHOPT[0] in view["extensions"] else f"{MESHOPT[1]} of {name}"
    count, stride = (document.field(extension, key, owner, int) for key in ("count", "byteStride"))
    mode, words = extension.get("mode"), extension.get("filter", "NONE")
    if mode not in _MODES or words not in _FILTERS:
        must = f"must have one of the modes {', '.join(_MODES)} and of the filters {', '.join(_FILTERS)} in {owner}"
        raise document.error(must, f"{excerpt(mode)} and {excerpt(words)}")
    right = 0 < stride <= _WIDEST_ELEMENT and stride % 4 == 0 if mode == "ATTRIBUTES" else stride in (2, 4)
    if not right:
        must = "multiples of 4 up to 256 bytes" if mode == "ATTRIBUTES" else "2 or 4 bytes"
        raise document.error(f"must have elements of {must} in {owner}", f"{stride} bytes")
    size = document.field(view, "byteLength", name, int)
    if count * stride != size:
        got = f"{count} elements of {stride} bytes"
        raise document.error(f"must have {size} decoded bytes in {owner}, as in the buffer view", got)
    document.decoding(size, len(content), owner, most=_MOST_DECODED)
    with needs_package("meshopt", document.path, owner):
        import meshopt
    try:
        return meshopt.decode_gltf_buffer(bytes(content), count, stride, mode, words).tobytes()
    except (ValueError, RuntimeError) as error:
        raise document.error(f"must have undamaged data of meshoptimizer in {owner}", error) from error


@contextlib.contextmanager
def needs_package(package: str, path: pathlib.Path, owner: str) -> Iterator[None]:
    """Says in the error of a missing package which compressed geometry needs it."""
    try:
        yield
    except ImportError as error:
        raise ImportError(
            f"{path} has compressed geometry ({owner}), which needs the package {package}: pip install 'jaxprt[web]'"
        ) from error


def unread_extensions(header: Header) -> set[str]:
    """Names of the extensions that a file uses or requires, except those that are read.

    Extensions of materials are left out: the reader of materials names those that a material of the scene has.
    """
    return {name for name in stated_extensions(header) if not name.startswith(_LOOK)} - HONORED


def stated_extensions(header: Header) -> set[str]:
    """Names of the extensions that a file says it uses or requires."""
    return {name for key in ("extensionsUsed", "extensionsRequired") for name in header.strings(key)}


def check_required(header: Header, *, geometry: bool) -> None:
    """Refuses a file that requires extensions that are not read; for `geometry`, only those of geometry."""
    required = set(header.strings("extensionsRequired"))
    unknown = sorted(name for name in required - HONORED - _HARMLESS if not name.startswith(_LOOK))
    if geometry:
        unknown = [name for name in unknown if not name.startswith(_NOT_GEOMETRY)]
    if unknown:
        known = ", ".join(sorted(HONORED))
        raise header.error(f"must not require extensions other than {known}", inputs.shortened(", ".join(unknown)))


class Elements(NamedTuple):
    """The elements of an accessor, as they lie in the buffer. They are copied only where they are used."""

    value: np.ndarray  # in their own type [count width]
    place: np.ndarray  # indices of elements that a sparse accessor replaces, in ascending order; may be empty
    replacement: np.ndarray  # what replaces them
    most: int  # largest value of normalized integers, which stands for 1; 0 for other numbers

    def rows(self, index: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Elements in their own type."""
        value = self.value[index]
        if len(self.place):
            row = np.arange(len(self.value))[index] if isinstance(index, slice) else index
            rank = np.maximum(np.searchsorted(self.place, row, side="right") - 1, 0)
            value = np.where((self.place[rank] == row)[:, None], self.replacement[rank], value)
        return value

    def numbers(self, index: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Elements in float64. Normalized integers are mapped to [0, 1] or [-1, 1]."""
        with np.errstate(invalid="ignore"):  # a damaged file may hold signaling NaNs
            value = self.rows(index).astype(np.float64)
        return np.maximum(value / self.most, -1) if self.most else value


class Form(NamedTuple):
    """The header of an accessor."""

    item: JsonObject  # the JSON object
    name: str  # for messages
    dtype: np.dtype
    rows: int  # number of elements
    width: int  # numbers of an element
    most: int  # that of `Elements`


class Document(Header):
    """A glTF file with its data. Errors name the file and the object."""

    def __init__(self, path: pathlib.Path, *, outside: bool = False):
        """Reads the header and the binary chunk of a GLB. Other files are read when they are needed.

        Args:
            path: The file.
            outside: Whether buffers and images may be files outside of the folder of the file.
        """
        self.path = path
        self._outside = outside
        self._buffer: dict[int, bytes] = {}
        self._view: dict[int, tuple[memoryview, int]] = {}
        text = content = inputs.content(path, "a glTF file")
        self._length = len(content)
        self._chunk: bytes | None = None
        if path.suffix.lower() == ".glb" or content.startswith(b"glTF"):
            text, self._chunk = self._chunks(content)
        super().__init__(path, text)

    def view(self, value: object, owner: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 if elements are contiguous."""
        index = self.index("bufferViews", value, owner)
        if index not in self._view:
            item, name = self.items("bufferViews")[index], f"buffer view {index}"
            self._view[index] = self._decompressed(item, name), self.field(item, "byteStride", name, int, 0)
        return self._view[index]

    def accessor(self, value: object, owner: str, *widths: int, whole: bool = False) -> Elements:
        """The elements of an accessor (section 3.6.2).

        Args:
            value: Index of the accessor, read from the file and not checked yet.
            owner: The object that refers to it, for error messages.
            widths: Allowed numbers of components of an element.
            whole: Whether the elements must be integers, such as indices.
        """
        item, name, dtype, count, width, most = self.form(value, owner, *widths, whole=whole)
        if "bufferView" in item:
            array = self._strided(item, name, dtype, (count, width))
        else:
            # Zeros need no memory here, but a geometry of them does. Another attribute of the same vertices takes at
            # least one byte of the file for each vertex.
            if count > self._size:
                must = f"must have a buffer view for {name}, or at most {self._size} elements, one for each byte of"
                raise self.error(f"{must} the file and its buffers", f"{count} elements without one")
            array = np.broadcast_to(np.zeros((1, width), dtype), (count, width))
        place, replacement = np.zeros(0, np.int64), array[:0]
        if "sparse" in item:
            place, replacement = self._sparse(self.field(item, "sparse", name, dict), name, array)
        return Elements(array, place, replacement, most)

    def form(self, value: object, owner: str, *widths: int, whole: bool = False) -> Form:
        """The header of an accessor; arguments and errors are those of `accessor`. No data are read."""
        index = self.index("accessors", value, owner)
        item, name = self.items("accessors")[index], f"accessor {index} ({owner})"
        kind, form = self.field(item, "componentType", name, int), self.field(item, "type", name, str)
        count, width = self.field(item, "count", name, int), _WIDTH.get(form, 0)
        if width not in widths or kind not in _COMPONENT or (whole and kind == 5126):
            must = f"must have {' or '.join(map(str, widths))} {'whole ' if whole else ''}numbers per element"
            raise self.error(f"{must} in {name}", f"type {excerpt(form)} of component type {kind}")
        if count < 1:
            raise self.error(f"must have 1 or more elements in {name}", count)
        dtype = np.dtype(_COMPONENT[kind])
        normalized = self.field(item, "normalized", name, bool) and dtype.kind in "iu"
        return Form(item, name, dtype, count, width, int(np.iinfo(dtype).max) if normalized else 0)

    def image(self, index: int) -> bytes:
        """The bytes of an image, embedded or in a separate file."""
        item, name = self.items("images")[index], f"image {index}"
        if "bufferView" in item:
            return bytes(self.view(item["bufferView"], name)[0])
        uri = item.get("uri")
        if _names_file(uri) and (absence := inputs.absence(path := self._file(uri, name))):
            raise FileNotFoundError(f"{name}, {path}, {absence}")
        return self._resource(uri, name)

    @functools.cached_property
    def _size(self) -> int:
        """Bytes of the file and of the files of its buffers, which are not read. Missing ones count as empty."""
        sizes: dict[pathlib.Path, int] = {}
        for number, item in enumerate(self.items("buffers")):
            if _names_file(uri := item.get("uri")):
                with contextlib.suppress(OSError, ValueError):  # raised where the buffer is used
                    path = self._file(uri, f"buffer {number}")
                    inputs.check(path, "a buffer")
                    sizes[path] = path.stat().st_size
        return self._length + sum(sizes.values())

    def _chunks(self, content: bytes) -> tuple[bytes, bytes | None]:
        """The header and the binary chunk of a GLB (section 4)."""
        must = "must be an undamaged GLB file"
        if content[:4] != b"glTF":
            got = f"the bytes {content[:4].hex(' ')}" if content else "an empty file"
            raise self.error(f"{must}, which starts with the text glTF", got)
        if len(content) < 20:
            raise self.error(f"{must} of at least 20 bytes, its two headers", len(content))
        version, length, size, kind = struct.unpack_from("<4I", content, 4)
        if version != 2:
            raise self.error(f"{must} of version 2", f"version {version}")
        if length > len(content) or 20 + size > length or kind != _JSON:
            raise self.error(f"{must} of {length} bytes, a header of {size} first", f"{len(content)} bytes")
        place, binary = 20 + size, None
        while binary is None and place + 8 <= length:
            extent, kind = struct.unpack_from("<2I", content, place)
            if place + 8 + extent > length:
                raise self.error(f"{must} with a chunk of {extent} bytes", f"{length - place - 8} bytes")
            binary = content[place + 8 : place + 8 + extent] if kind == _BINARY else None
            place += 8 + extent
        return content[20 : 20 + size], binary

    def _decompressed(self, view: JsonObject, name: str) -> memoryview:
        """The bytes of a buffer view. Compressed views are decoded where they have no uncompressed fallback."""
        index = self.index("buffers", view.get("buffer"), name)
        buffer, used = self.items("buffers")[index], self.field(view, "extensions", name, dict)
        extension = next((self.field(used, key, name, dict) for key in MESHOPT if key in used), None)
        here = "uri" in buffer or (index == 0 and self._chunk is not None)
        if extension is None or (here and not _is_fallback(self, buffer, f"buffer {index}")):
            return self._cut(view, name)
        content = self._cut(extension, f"the compressed data of {name}")
        return memoryview(_decode_meshopt(self, view, extension, content, name))

    def _cut(self, item: JsonObject, name: str) -> memoryview:
        """The bytes of a buffer that an object names."""
        content = self._bytes(self.index("buffers", item.get("buffer"), name))
        start = self.field(item, "byteOffset", name, int, 0)
        end = start + self.field(item, "byteLength", name, int)
        if end > len(content):
            got = f"{len(content)} bytes in buffer {item['buffer']}"
            raise self.error(f"must have buffers of at least {end} bytes for {name}", got)
        return memoryview(content)[start:end]

    def _bytes(self, index: int) -> bytes:
        """The bytes of a buffer."""
        if index not in self._buffer:
            item, name = self.items("buffers")[index], f"buffer {index}"
            if "uri" in item:
                content = self._resource(item["uri"], name)
            elif index == 0 and self._chunk is not None:
                content = self._chunk
            else:
                raise self.error(f"must have the bytes of {name}", "neither a file nor a binary chunk")
            length = self.field(item, "byteLength", name, int)
            if len(content) < length:
                raise self.error(f"must have {length} bytes in {name}", f"{len(content)} bytes")
            self._buffer[index] = content
        return self._buffer[index]

    def _resource(self, uri: Any, owner: str) -> bytes:
        """The data of a URI: embedded in it, or in a file relative to the glTF file."""
        if not isinstance(uri, str) or not uri:
            raise self.error(f"must name a file or hold data in {owner}", excerpt(uri))
        if not _names_file(uri):
            kind, _, data = uri.partition(",")
            plain = urllib.parse.unquote_to_bytes(data)
            try:
                return base64.b64decode(plain, validate=True) if kind.lower().endswith(";base64") else plain
            except ValueError as error:
                raise self.error(f"must have undamaged base64 data in {owner}", str(error)) from error
        return inputs.content(self._file(uri, owner), f"the file that {self.path} needs for {owner}")

    def _file(self, uri: str, owner: str) -> pathlib.Path:
        """The path of the file that a URI names."""
        if _SCHEME.match(uri):
            raise self.error(f"must name a file beside it in {owner}", excerpt(uri))
        name, folder, owner = urllib.parse.unquote(uri), self.path.parent, f"{self.path}, {owner}"
        return inputs.reference(name, folder, folder=folder, owner=owner, outside=self._outside)

    def _strided(self, item: JsonObject, name: str, dtype: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """The elements of a buffer view, without a copy."""
        content, stride = self.view(item.get("bufferView"), name)
        offset, size = self.field(item, "byteOffset", name, int, 0), dtype.itemsize * shape[1]
        stride = stride or size
        end = offset + stride * (shape[0] - 1) + size
        if stride < size or end > len(content):
            raise self.error(
                f"must keep {name} inside buffer view {item['bufferView']} of {len(content)} bytes",
                f"{shape[0]} elements of {size} bytes each {stride} bytes from byte {offset} on, which end at {end}",
            )
        return np.ndarray(shape, dtype, content, offset, (stride, dtype.itemsize))

    def _sparse(self, item: JsonObject, name: str, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the elements that a sparse accessor replaces, and what replaces them (section 3.6.2.3)."""
        indices, values = self.field(item, "indices", name, dict), self.field(item, "values", name, dict)
        count, kind = self.field(item, "count", name, int), self.field(indices, "componentType", name, int)
        if not 0 < count <= len(value) or kind not in (5121, 5123, 5125):
            got = f"{count} of component type {kind}"
            raise self.error(f"must replace 1 to {len(value)} elements, numbered by unsigned integers, in {name}", got)
        place = self._strided(indices, name, np.dtype(_COMPONENT[kind]), (count, 1))[:, 0].astype(np.int64)
        if place.max() >= len(value):
            raise self.error(f"must replace elements 0 to {len(value) - 1} in {name}", f"element {place.max()}")
        order = np.argsort(place, kind="stable")
        return place[order], self._strided(values, name, value.dtype, (count, value.shape[1]))[order]


def _names_file(uri: object) -> TypeGuard[str]:
    """Whether a URI names a file. Others hold the data, or are none."""
    return isinstance(uri, str) and bool(uri) and uri[:5].lower() != "data:"
