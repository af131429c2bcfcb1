"""The container format of glTF 2.0: JSON header, buffers, accessors and images, in GLB files or separate files.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import base64
import contextlib
import json
import math
import pathlib
import struct
import urllib.parse
from collections.abc import Iterator
from typing import Any

import numpy as np

_COMPONENT = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_JSON, _BINARY = 0x4E4F534A, 0x004E4942  # types of GLB chunks
_MOST = 2**28  # most elements of an accessor


class Document:
    """A glTF file. Its objects are looked up by index; errors name the file and the object.

    Attributes:
        path: The file.
        header: The JSON object.
    """

    def __init__(self, path: pathlib.Path):
        """Reads the header and the binary chunk of a GLB. Other files are read when they are needed."""
        self.path = path
        self._buffer: dict[int, bytes] = {}
        content = path.read_bytes()
        text: bytes = content
        self._chunk: bytes | None = None
        if path.suffix.lower() == ".glb" or content.startswith(b"glTF"):
            text, self._chunk = self._chunks(content)
        try:
            self.header = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise self.error("must be an undamaged glTF file", f"a header that is not JSON: {error}") from error
        version = str(self.header.get("asset", {}).get("version", "none")) if isinstance(self.header, dict) else "none"
        if not version.startswith("2."):
            raise self.error("must be an undamaged glTF file of version 2", f"version {version}")

    def error(self, required: str, got: str) -> ValueError:
        """An error that names the file."""
        return ValueError(f"{self.path} {required}, got {got}")

    def items(self, kind: str) -> list:
        """All objects of a kind, such as "meshes"; may be empty."""
        found = self.header.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(each, dict) for each in found):
            raise self.error(f"must be an undamaged glTF file with a list of {kind}", str(type(found).__name__))
        return found

    def item(self, kind: str, index: Any, owner: str) -> dict[str, Any]:
        """One object of a kind.

        Args:
            kind: The kind, such as "meshes".
            index: Its index, as found in the file.
            owner: The object that refers to it, for error messages.

        Raises:
            ValueError: There is no object with this index.
        """
        found = self.items(kind)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(found):
            raise self.error(f"must refer to one of its {len(found)} {kind} in {owner}", repr(index))
        return found[index]

    def numbers(self, value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
        """Checks numbers of the header and converts them to float64.

        Raises:
            ValueError: The numbers have another shape or are not finite.
        """
        try:
            array = np.asarray(value)
            right = array.dtype.kind in "iuf" and array.shape == shape and bool(np.isfinite(array).all())
        except ValueError:
            right = False
        if not right:
            must = f"{math.prod(shape)} finite numbers" if shape else "a finite number"
            raise self.error(f"must have {must} for {what}", repr(value))
        return np.asarray(value, np.float64)

    def view(self, index: Any, owner: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride; 0 if elements are contiguous."""
        item = self.item("bufferViews", index, owner)
        content = self._content(item.get("buffer"), f"buffer view {index}")
        start, length = item.get("byteOffset", 0), item["byteLength"]
        if start < 0 or length < 0 or start + length > len(content):
            need = f"must have buffers of at least {start + length} bytes for buffer view {index}"
            raise self.error(need, f"{len(content)} bytes in buffer {item.get('buffer')}")
        return memoryview(content)[start : start + length], item.get("byteStride", 0)

    def accessor(self, index: Any, owner: str, *widths: int, whole: bool = False) -> np.ndarray:
        """The elements of an accessor (section 3.6.2).

        Args:
            index: Its index.
            owner: The object that refers to it, for error messages.
            widths: Allowed numbers of components of an element.
            whole: Whether the elements must be integers, such as indices.

        Returns:
            An array [count, width], in float64 unless `whole`. Normalized integers are mapped to [0, 1] or [-1, 1].

        Raises:
            ValueError: The accessor is missing, damaged, reaches beyond its buffer view, or is of another type.
        """
        item, name = self.item("accessors", index, owner), f"accessor {index} ({owner})"
        width, count, kind = _WIDTH.get(item["type"], 0), item["count"], item["componentType"]
        if width not in widths or kind not in _COMPONENT or (whole and kind == 5126):
            must = f"must have {' or '.join(map(str, widths))} {'whole ' if whole else ''}numbers per element"
            raise self.error(f"{must} in {name}", f"type {item['type']!r} of component type {kind!r}")
        if not isinstance(count, int) or not 0 < count <= _MOST:
            raise self.error(f"must have 1 to {_MOST} elements in {name}", repr(count))
        dtype = np.dtype(_COMPONENT[kind])
        value = np.zeros((count, width), dtype)
        if "bufferView" in item:
            value = self._strided(item, name, dtype, (count, width))
        if "sparse" in item:
            value = self._sparse(item["sparse"], name, value)
        if whole:
            return value
        if item.get("normalized", False) and dtype.kind in "iu":
            return np.maximum(value.astype(np.float64) / np.iinfo(dtype).max, -1)
        return value.astype(np.float64)

    def image(self, index: Any, owner: str) -> bytes:
        """The bytes of an image, embedded or in a separate file."""
        item = self.item("images", index, owner)
        if "bufferView" in item:
            return bytes(self.view(item["bufferView"], f"image {index}")[0])
        return self._resource(item.get("uri"), f"image {index}")

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

    def _content(self, index: Any, owner: str) -> bytes:
        """The bytes of a buffer."""
        item = self.item("buffers", index, owner)
        if index not in self._buffer:
            if "uri" in item:
                content = self._resource(item["uri"], f"buffer {index}")
            elif index == 0 and self._chunk is not None:
                content = self._chunk
            else:
                raise self.error(f"must have the bytes of buffer {index}", "neither a file nor a binary chunk")
            if len(content) < item["byteLength"]:
                raise self.error(f"must have {item['byteLength']} bytes in buffer {index}", f"{len(content)} bytes")
            self._buffer[index] = content
        return self._buffer[index]

    def _resource(self, uri: Any, owner: str) -> bytes:
        """The data of a URI: embedded in it, or in a file relative to the glTF file."""
        if not isinstance(uri, str) or not uri:
            raise self.error(f"must name a file or hold data in {owner}", repr(uri))
        if uri.startswith("data:"):
            kind, _, data = uri.partition(",")
            plain = urllib.parse.unquote_to_bytes(data)
            try:
                return base64.b64decode(plain, validate=True) if kind.endswith(";base64") else plain
            except ValueError as error:
                raise self.error(f"must have undamaged base64 data in {owner}", str(error)) from error
        if "://" in uri:
            raise self.error(f"must name a file beside it in {owner}", repr(uri))
        path = self.path.parent / urllib.parse.unquote(uri)
        if not path.is_file():
            raise FileNotFoundError(f"{self.path} needs the file {path} for {owner}, which does not exist")
        return path.read_bytes()

    def _strided(self, item: dict[str, Any], name: str, dtype: np.dtype, shape: tuple[int, int]) -> np.ndarray:
        """A copy of the elements of a buffer view."""
        content, stride = self.view(item["bufferView"], name)
        offset, size = item.get("byteOffset", 0), dtype.itemsize * shape[1]
        stride = stride or size
        end = offset + stride * (shape[0] - 1) + size
        if offset < 0 or stride < size or end > len(content):
            raise self.error(
                f"must keep {name} inside buffer view {item['bufferView']} of {len(content)} bytes",
                f"{shape[0]} elements of {size} bytes each {stride} bytes from byte {offset} on, which end at {end}",
            )
        return np.ndarray(shape, dtype, content, offset, (stride, dtype.itemsize)).copy()

    def _sparse(self, item: dict[str, Any], name: str, value: np.ndarray) -> np.ndarray:
        """Elements with the replacements of a sparse accessor (section 3.6.2.3)."""
        count, kind = item["count"], item["indices"]["componentType"]
        if not isinstance(count, int) or not 0 < count <= len(value) or kind not in (5121, 5123, 5125):
            got = f"{count!r} of component type {kind!r}"
            raise self.error(f"must replace 1 to {len(value)} elements, numbered by unsigned integers, in {name}", got)
        index = self._strided(item["indices"], name, np.dtype(_COMPONENT[kind]), (count, 1))[:, 0]
        if index.max() >= len(value):
            raise self.error(f"must replace elements 0 to {len(value) - 1} in {name}", f"element {index.max()}")
        value[index] = self._strided(item["values"], name, value.dtype, (count, value.shape[1]))
        return value


@contextlib.contextmanager
def damage_named(path: pathlib.Path) -> Iterator[None]:
    """Converts errors caused by damaged headers into an error that names the file."""
    try:
        yield
    except KeyError as error:
        raise ValueError(
            f"{path} must be an undamaged glTF file, got one that lacks {error} where it is needed"
        ) from error
    except (IndexError, TypeError, AttributeError, OverflowError) as error:
        detail = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} must be an undamaged glTF file, got one that cannot be read: {detail}") from error
