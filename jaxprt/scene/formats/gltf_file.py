"""The container format of glTF 2.0: buffers, accessors and images, in GLB files or separate files.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import base64
import contextlib
import functools
import pathlib
import re
import struct
import urllib.parse
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import gltf_meshopt
from jaxprt.scene.formats.gltf_header import Header, excerpt

_COMPONENT = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # types of GLB chunks
_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*:")  # of a URI that is not relative


class Elements(NamedTuple):
    """The elements of an accessor, as they lie in the buffer. They are copied only where they are used.

    Attributes:
        value: The elements in their own type [count width].
        place: Numbers of the elements that a sparse accessor replaces, in ascending order; may be empty.
        replacement: What replaces them.
        most: Largest value of normalized integers, which stands for 1; 0 for other numbers.
    """

    value: np.ndarray
    place: np.ndarray
    replacement: np.ndarray
    most: int

    def rows(self, index: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Elements in their own type."""
        value = self.value[index]
        if len(self.place):
            number = np.arange(len(self.value))[index] if isinstance(index, slice) else index
            rank = np.searchsorted(self.place, number, side="right") - 1
            replaced = (rank >= 0) & (self.place[np.maximum(rank, 0)] == number)
            value = np.where(replaced[:, None], self.replacement[np.maximum(rank, 0)], value)
        return value

    def numbers(self, index: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Elements in float64. Normalized integers are mapped to [0, 1] or [-1, 1]."""
        with np.errstate(invalid="ignore"):  # a damaged file may hold signaling NaNs
            value = self.rows(index).astype(np.float64)
        return np.maximum(value / self.most, -1) if self.most else value


class Form(NamedTuple):
    """The header of an accessor.

    Attributes:
        item: The JSON object.
        name: Name for messages.
        dtype: Type of the numbers.
        rows: Number of elements.
        width: Numbers of an element.
        most: Largest value of normalized integers, which stands for 1; 0 for other numbers.
    """

    item: dict[str, Any]
    name: str
    dtype: np.dtype
    rows: int
    width: int
    most: int


class Document(Header):
    """A glTF file. Its objects are looked up by index; errors name the file and the object."""

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

    def view(self, value: Any, owner: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 if elements are contiguous."""
        index = self.index("bufferViews", value, owner)
        if index not in self._view:
            item, name = self.items("bufferViews")[index], f"buffer view {index}"
            self._view[index] = self._part(item, name), self.integer(item, "byteStride", name, 0)
        return self._view[index]

    def accessor(self, value: Any, owner: str, *widths: int, whole: bool = False) -> Elements:
        """The elements of an accessor (section 3.6.2).

        Args:
            value: Index of the accessor, read from the file and not checked yet.
            owner: The object that refers to it, for error messages.
            widths: Allowed numbers of components of an element.
            whole: Whether the elements must be integers, such as indices.

        Raises:
            ValueError: The accessor is missing, damaged, reaches beyond its buffer view, or is of another type; or it
                has no buffer view and more elements than the file and its buffers have bytes.
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
            place, replacement = self._sparse(self.object(item, "sparse", name), name, array)
        return Elements(array, place, replacement, most)

    def form(self, value: Any, owner: str, *widths: int, whole: bool = False) -> Form:
        """The header of an accessor; arguments and errors are those of `accessor`. No data are read."""
        index = self.index("accessors", value, owner)
        item, name = self.items("accessors")[index], f"accessor {index} ({owner})"
        kind, form = self.integer(item, "componentType", name), self.string(item, "type", name)
        count, width = self.integer(item, "count", name), _WIDTH.get(form, 0)
        if width not in widths or kind not in _COMPONENT or (whole and kind == 5126):
            must = f"must have {' or '.join(map(str, widths))} {'whole ' if whole else ''}numbers per element"
            raise self.error(f"{must} in {name}", f"type {excerpt(form)} of component type {kind}")
        if count < 1:
            raise self.error(f"must have 1 or more elements in {name}", str(count))
        dtype = np.dtype(_COMPONENT[kind])
        normalized = self.boolean(item, "normalized", name) and dtype.kind in "iu"
        return Form(item, name, dtype, count, width, int(np.iinfo(dtype).max) if normalized else 0)

    def image(self, value: Any, owner: str) -> bytes:
        """The bytes of an image, embedded or in a separate file."""
        index = self.index("images", value, owner)
        item = self.items("images")[index]
        if "bufferView" in item:
            return bytes(self.view(item["bufferView"], f"image {index}")[0])
        return self._resource(item.get("uri"), f"image {index}")

    @functools.cached_property
    def _size(self) -> int:
        """Bytes of the file and of the files of its buffers, which are not read. Missing ones count as empty."""
        sizes: dict[pathlib.Path, int] = {}
        for number, item in enumerate(self.items("buffers")):
            uri = item.get("uri")
            if isinstance(uri, str) and uri and not _is_embedded(uri):
                with contextlib.suppress(OSError, ValueError):  # raised where the buffer is used
                    path = self._file(uri, f"buffer {number}")
                    inputs.check(path, "a buffer")
                    sizes[path] = path.stat().st_size
        return self._length + sum(sizes.values())

    def _chunks(self, content: bytes) -> tuple[bytes, bytes | None]:
        """The header and the binary chunk of a GLB (section 4)."""
        must = "must be an undamaged GLB file"
        if len(content) < 20 or content[:4] != b"glTF":
            raise self.error(f"{must}, which starts with b'glTF'", f"{len(content)} bytes that start {content[:4]!r}")
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

    def _part(self, view: dict[str, Any], name: str) -> memoryview:
        """The bytes of a buffer view. Compressed views are decoded where they have no uncompressed fallback."""
        index = self.index("buffers", view.get("buffer"), name)
        extension = gltf_meshopt.extension(self, view, name)
        if extension is None:
            return self._cut(view, name)
        here = "uri" in self.items("buffers")[index] or (index == 0 and self._chunk is not None)
        if here and not gltf_meshopt.is_fallback(self, self.items("buffers")[index], f"buffer {index}"):
            return self._cut(view, name)
        content = self._cut(extension, f"the compressed data of {name}")
        return memoryview(gltf_meshopt.decoded(self, view, extension, content, name))

    def _cut(self, item: dict[str, Any], name: str) -> memoryview:
        """The bytes of a buffer that an object names."""
        content = self._bytes(self.index("buffers", item.get("buffer"), name))
        start = self.integer(item, "byteOffset", name, 0)
        end = start + self.integer(item, "byteLength", name)
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
            length = self.integer(item, "byteLength", name)
            if len(content) < length:
                raise self.error(f"must have {length} bytes in {name}", f"{len(content)} bytes")
            self._buffer[index] = content
        return self._buffer[index]

    def _resource(self, uri: Any, owner: str) -> bytes:
        """The data of a URI: embedded in it, or in a file relative to the glTF file."""
        if not isinstance(uri, str) or not uri:
            raise self.error(f"must name a file or hold data in {owner}", excerpt(uri))
        if _is_embedded(uri):
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
        name, folder = urllib.parse.unquote(uri), self.path.parent
        owner_name = f"{self.path}, {owner}"
        return inputs.reference(name, folder, folder=folder, owner=owner_name, outside=self._outside)

    def _strided(self, item: dict[str, Any], name: str, dtype: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """The elements of a buffer view, without a copy."""
        content, stride = self.view(item.get("bufferView"), name)
        offset, size = self.integer(item, "byteOffset", name, 0), dtype.itemsize * shape[1]
        stride = stride or size
        end = offset + stride * (shape[0] - 1) + size
        if stride < size or end > len(content):
            raise self.error(
                f"must keep {name} inside buffer view {item['bufferView']} of {len(content)} bytes",
                f"{shape[0]} elements of {size} bytes each {stride} bytes from byte {offset} on, which end at {end}",
            )
        return np.ndarray(shape, dtype, content, offset, (stride, dtype.itemsize))

    def _sparse(self, item: dict[str, Any], name: str, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of the elements that a sparse accessor replaces, and what replaces them (section 3.6.2.3)."""
        indices, values = self.object(item, "indices", name), self.object(item, "values", name)
        count, kind = self.integer(item, "count", name), self.integer(indices, "componentType", name)
        if not 0 < count <= len(value) or kind not in (5121, 5123, 5125):
            got = f"{count} of component type {kind}"
            raise self.error(f"must replace 1 to {len(value)} elements, numbered by unsigned integers, in {name}", got)
        place = self._strided(indices, name, np.dtype(_COMPONENT[kind]), (count, 1))[:, 0].astype(np.int64)
        if place.max() >= len(value):
            raise self.error(f"must replace elements 0 to {len(value) - 1} in {name}", f"element {place.max()}")
        order = np.argsort(place, kind="stable")
        return place[order], self._strided(values, name, value.dtype, (count, value.shape[1]))[order]


def _is_embedded(uri: str) -> bool:
    """Whether a URI holds the data itself."""
    return uri[:5].lower() == "data:"


@contextlib.contextmanager
def damage_named(path: pathlib.Path) -> Iterator[None]:
    """Makes all errors that a damaged file causes name the file."""
    must = f"{path} must be an undamaged glTF file"
    try:
        yield
    except KeyError as error:
        raise ValueError(f"{must}, got one that lacks {error} where it is needed") from error
    except (IndexError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{must}, got one that cannot be read: {type(error).__name__}: {error}") from error
    except (ValueError, MemoryError) as error:
        if str(path) in str(error):
            raise
        if isinstance(error, MemoryError):
            raise MemoryError(f"{path}: {error}") from error
        raise ValueError(f"{must}, got one that cannot be read: {error}") from error
