"""Writes small glTF files for tests."""

import base64
import json
import pathlib
import struct
from typing import Any

import numpy as np

from jaxprt.files import write_png

KIND = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPE = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
# A unit square in the plane z = 0 that looks to +z, with an upright image on it (v down).
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACE = np.array([0, 1, 2, 0, 2, 3], np.uint16)
PLACE = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


class Writer:
    """A glTF file with one scene of one node, to which objects are added; tests change its header."""

    def __init__(self):
        self.data = b""
        self.header: dict[str, Any] = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
        self.header |= {"nodes": [{"mesh": 0}], "bufferViews": [], "accessors": [], "images": [], "materials": []}

    def add(self, kind: str, item: dict) -> int:
        self.header.setdefault(kind, []).append(item)
        return len(self.header[kind]) - 1

    def view(self, content: bytes, **field) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        index = self.add(
            "bufferViews", {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content), **field}
        )
        self.data += content
        return index

    def accessor(self, value: np.ndarray, **field) -> int:
        value = np.asarray(value)
        value = value[:, None] if value.ndim == 1 else value
        value = value.astype(np.float32) if value.dtype == float else value
        kind, view = KIND[value.dtype.str[1:]], self.view(value.tobytes())
        item = {"bufferView": view, "componentType": kind, "count": len(value), "type": TYPE[value.shape[1]]}
        return self.add("accessors", item | field)

    def square(
        self, *, face: np.ndarray | None = FACE, material: int | None = None, mode: int = 4, **attribute
    ) -> dict:
        """A primitive; attributes are arrays, or numbers of accessors. Normals are +z, or missing if NORMAL is None."""
        value = {"POSITION": SQUARE} | attribute
        item: dict[str, Any] = {"mode": mode}
        number = {k: v if isinstance(v, int) else self.accessor(v) for k, v in value.items() if v is not None}
        if "NORMAL" not in value:
            count = self.header["accessors"][number["POSITION"]]["count"]
            number["NORMAL"] = self.accessor(np.tile(np.float32([0, 0, 1]), (count, 1)))
        item["attributes"] = number
        return (
            item
            | ({} if face is None else {"indices": self.accessor(face)})
            | ({} if material is None else {"material": material})
        )

    def texture(self, folder: pathlib.Path, image: np.ndarray, **field) -> dict:
        """What refers to a texture, of an image with display values."""
        write_png(folder / "image.png", np.asarray(image, np.float32))
        view = self.view((folder / "image.png").read_bytes())
        source = self.add("images", {"bufferView": view, "mimeType": "image/png"})
        return {"index": self.add("textures", {"source": source})} | field

    def write(self, path: pathlib.Path) -> pathlib.Path:
        data = self.data + b"\0" * (-len(self.data) % 4)
        more = self.header.get("buffers", [])
        header = self.header | {"buffers": [{"byteLength": len(data)}, *more]}
        if path.suffix == ".gltf":
            uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
            path.write_text(json.dumps(header | {"buffers": [{"byteLength": len(data), "uri": uri}, *more]}))
            return path
        text = json.dumps(self.header.get("whole", header)).encode()
        text += b" " * (-len(text) % 4)
        content = struct.pack("<4s4I", b"glTF", 2, 28 + len(text) + len(data), len(text), 0x4E4F534A) + text
        path.write_bytes(content + struct.pack("<2I", len(data), 0x004E4942) + data)
        return path


def one(*primitives, writer: Writer) -> Writer:
    """The writer with these primitives in one more mesh."""
    writer.add("meshes", {"primitives": list(primitives)})
    return writer
