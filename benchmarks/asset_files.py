"""Reads glTF and OBJ files for `benchmarks.assets` with none of jaxprt's code, by the texts of the formats.

A file becomes surfaces: triangles in world space with the material that the file gives them. Skins have the pose of the
file's nodes, and morph targets their default weights. Images are decoded by Pillow. Section numbers are those of the
glTF 2.0 specification. What a reader does not understand it raises as `UnreadableError` if the geometry needs it; of a
material it is named in `Material.unjudged`.
"""

import base64
import dataclasses
import io
import json
import pathlib
import struct
import urllib.parse
from collections.abc import Iterator
from typing import Any

import numpy as np
import PIL.Image

_KINDS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_WRAPS = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728
_JUDGED = ("ior", "specular", "emissive_strength")  # extensions KHR_materials_ that are understood
_HARMLESS = ("KHR_materials_variants",)


class UnreadableError(ValueError):
    """The judge does not understand a file."""


@dataclasses.dataclass(frozen=True)
class Map:
    """A texture.

    Attributes:
        image: Linear values [h w c], the first row on top.
        transform: Affine map [3 3] from texture coordinates with v down to those of the image.
        coordinates: Which set of texture coordinates it takes.
        wrap: "repeat", "mirror" or "clamp".
        nearest: Whether texels are boxes.
    """

    image: np.ndarray
    transform: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    coordinates: int = 0
    wrap: str = "repeat"
    nearest: bool = False

    def channels(self, *index: int) -> "Map":
        """Some channels of the image."""
        return dataclasses.replace(self, image=self.image[..., list(index)])


@dataclasses.dataclass(frozen=True)
class Material:
    """What a file says about a surface. Factors multiply maps; colors are linear.

    Alpha covers by itself, or where it reaches `cutoff`. A `brdf` that `benchmarks.plugins` has replaces the formula.
    """

    base_color: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(3))
    alpha: float = 1.0
    metallic: float = 1.0
    roughness: float = 1.0
    f0: np.ndarray = dataclasses.field(default_factory=lambda: np.full(3, 0.04))
    specular: float = 1.0
    emissive: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    normal_scale: float = 1.0
    cutoff: float | None = None
    opaque: bool = True
    double_sided: bool = False
    base_map: Map | None = None
    alpha_map: Map | None = None
    metallic_map: Map | None = None
    roughness_map: Map | None = None
    f0_map: Map | None = None
    specular_map: Map | None = None
    emissive_map: Map | None = None
    normal_map: Map | None = None
    unjudged: tuple[str, ...] = ()
    brdf: Any = None

    def maps(self) -> list[Map]:
        """All maps that it has."""
        return [value for value in vars(self).values() if isinstance(value, Map)]


@dataclasses.dataclass(frozen=True)
class Surface:
    """Triangles of one material.

    Attributes:
        position: Corners [v 3] in world space.
        face: Indices [f 3], counterclockwise seen from the front.
        normal: Unit normals [v 3], or None for flat triangles.
        texture: Texture coordinates [v 2] with v down, by the number of their set.
        tangent: Unit tangents with the side of the bitangent [v 4] for normal maps; None for those of the texture.
        color: Linear colors and alpha [v 4] that multiply the base color, or None.
        material: The material.
    """

    position: np.ndarray
    face: np.ndarray
    normal: np.ndarray | None
    texture: dict[int, np.ndarray]
    color: np.ndarray | None
    material: Material
    tangent: np.ndarray | None = None


def read(path: pathlib.Path) -> list[Surface]:
    """Surfaces of a glTF, GLB or OBJ file.

    Raises:
        UnreadableError: It has no triangles, or geometry that the judge does not understand.
    """
    surfaces = _obj(path) if path.suffix.lower() == ".obj" else list(GltfFile(path).surfaces())
    surfaces = [surface for surface in surfaces if len(surface.face)]
    if not surfaces:
        raise UnreadableError(f"{path.name} has no triangles")
    return surfaces


class GltfFile:
    """A glTF file with its buffers."""

    def __init__(self, path: pathlib.Path):
        self._folder = path.parent
        content, self._chunk = path.read_bytes(), b""
        if content[:4] == b"glTF":
            content, self._chunk = _chunks(content)
        self.json: dict[str, Any] = json.loads(content.decode("utf-8-sig"))
        compressed = {"EXT_meshopt_compression", "KHR_meshopt_compression"} & set(self.json.get("extensionsUsed", ()))
        if compressed:
            raise UnreadableError(f"{path.name} is compressed by {', '.join(compressed)}")
        self._buffers: dict[int, bytes] = {}
        self._images: dict[int, np.ndarray] = {}
        self._worlds: dict[int, np.ndarray] = {}
        self._materials: dict[int | None, Material] = {}

    def surfaces(self) -> Iterator[Surface]:
        """Primitives of all nodes of the scene."""
        scenes, nodes = self.json.get("scenes", ()), self.json.get("nodes", ())
        child = {index for node in nodes for index in node.get("children", ())}
        roots = [index for index in range(len(nodes)) if index not in child]
        shown = scenes[self.json.get("scene", 0)].get("nodes", ()) if scenes else roots
        for root in roots:
            self._place(root, np.eye(4))
        pending = list(shown)
        while pending:
            index = pending.pop()
            node = nodes[index]
            pending.extend(node.get("children", ()))
            if "mesh" in node:
                for world in self._instances(node, self._worlds[index]):
                    yield from self._mesh(node, world)

    def _place(self, root: int, world: np.ndarray) -> None:
        """World matrices of a node and of all below it."""
        pending = [(root, world)]
        while pending:
            index, above = pending.pop()
            node = self.json["nodes"][index]
            self._worlds[index] = above @ _matrix(node)
            pending.extend((child, self._worlds[index]) for child in node.get("children", ()))

    def _instances(self, node: dict[str, Any], world: np.ndarray) -> list[np.ndarray]:
        """Matrices of the copies of a node's mesh: one, or those of EXT_mesh_gpu_instancing."""
        copies = node.get("extensions", {}).get("EXT_mesh_gpu_instancing", {}).get("attributes")
        if not copies:
            return [world]
        column = {name.lower(): self.accessor(index) for name, index in copies.items() if not name.startswith("_")}
        count = len(next(iter(column.values())))
        return [world @ _matrix({name: value[n] for name, value in column.items()}) for n in range(count)]

    def _mesh(self, node: dict[str, Any], world: np.ndarray) -> Iterator[Surface]:
        mesh = self.json["meshes"][node["mesh"]]
        weights = node.get("weights", mesh.get("weights", ()))
        for primitive in mesh["primitives"]:
            if primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                continue  # points and lines
            values, face = self._attributes(primitive)
            for weight, target in zip(weights, primitive.get("targets", ()), strict=False):
                for name in target.keys() & values.keys() & {"POSITION", "NORMAL", "COLOR_0", "TEXCOORD_0"}:
                    values[name] = values[name] + weight * self.accessor(target[name])
            matrix = self._pose(node["skin"], values) if "skin" in node else world[None]
            yield self._surface(values, face, matrix, primitive.get("material"))

    def _attributes(self, primitive: dict[str, Any]) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Attributes by name, and triangles."""
        if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
            raise UnreadableError("the geometry is compressed by KHR_draco_mesh_compression")
        values = {name: self.accessor(index) for name, index in primitive["attributes"].items()}
        count = len(values["POSITION"])
        index = self.accessor(primitive["indices"]).ravel() if "indices" in primitive else np.arange(count)
        return values, _triangles(index.astype(np.int64), primitive.get("mode", _TRIANGLES))

    def _pose(self, number: int, values: dict[str, np.ndarray]) -> np.ndarray:
        """Matrix [v 4 4] of each vertex by the joints of a skin."""
        skin = self.json["skins"][number]
        joint = np.stack([self._worlds[index] for index in skin["joints"]])
        if "inverseBindMatrices" in skin:
            inverse = self.accessor(skin["inverseBindMatrices"])[: len(joint)]
            joint = joint @ inverse.reshape(-1, 4, 4).transpose(0, 2, 1)
        total, result = 0.0, np.zeros((len(values["POSITION"]), 4, 4))
        for group in (name[7:] for name in values if name.startswith("JOINTS_")):
            weight = values[f"WEIGHTS_{group}"].astype(float)
            for corner in range(4):
                result += weight[:, corner, None, None] * joint[values[f"JOINTS_{group}"][:, corner].astype(int)]
            total = total + weight.sum(1)
        return result / np.where(total > 0, total, 1)[:, None, None]

    def _surface(self, values, face: np.ndarray, matrix: np.ndarray, material: int | None) -> Surface:
        position = values["POSITION"].astype(float)
        linear = matrix[:, :3, :3]
        placed = np.einsum("vij,vj->vi", np.broadcast_to(linear, (len(position), 3, 3)), position) + matrix[:, :3, 3]
        if len(matrix) == 1 and np.linalg.det(linear[0]) < 0:
            face = face[:, ::-1]  # section 3.7.4: the winding turns with the determinant
        normal = None
        if "NORMAL" in values:
            cofactor = np.linalg.det(linear)[:, None, None] * np.linalg.pinv(linear).transpose(0, 2, 1)
            sign = np.where(np.linalg.det(linear) < 0, -1.0, 1.0)[:, None, None]
            turned = np.broadcast_to(sign * cofactor, (len(position), 3, 3))
            normal = _unit(np.einsum("vij,vj->vi", turned, values["NORMAL"].astype(float)))
        color = tangent = None
        if "TANGENT" in values:
            given = values["TANGENT"].astype(float)
            way = np.einsum("vij,vj->vi", np.broadcast_to(linear, (len(position), 3, 3)), given[:, :3])
            side = np.broadcast_to(np.sign(np.linalg.det(linear)), len(position)) * given[:, 3]
            tangent = np.concatenate([_unit(way), side[:, None]], 1)
        if "COLOR_0" in values:
            given = values["COLOR_0"].astype(float)
            color = np.ones((len(given), 4))
            color[:, : given.shape[1]] = given
        texture = {int(name[9:]): value for name, value in values.items() if name.startswith("TEXCOORD_")}
        if material not in self._materials:
            self._materials[material] = self._material(material)
        return Surface(placed, face, normal, texture, color, self._materials[material], tangent)

    def _material(self, index: int | None) -> Material:
        if index is None:
            return Material()
        item = self.json["materials"][index]
        pbr, more = item.get("pbrMetallicRoughness", {}), item.get("extensions", {})
        given = {name[14:]: value for name, value in more.items() if name.startswith("KHR_materials_")}
        specular = given.get("specular", {})
        ior = given.get("ior", {}).get("ior", 1.5)
        color = np.array(pbr.get("baseColorFactor", (1, 1, 1, 1)), float)
        glow = np.array(item.get("emissiveFactor", (0, 0, 0)), float)
        f0 = ((1 - ior) / (1 + ior)) ** 2 * np.array(specular.get("specularColorFactor", (1, 1, 1)), float)
        normal, mode = item.get("normalTexture", {}), item.get("alphaMode", "OPAQUE")
        base, rough = self._map(pbr, "baseColorTexture", srgb=True), self._map(pbr, "metallicRoughnessTexture")
        see_through = base is not None and base.image.shape[-1] == 4
        strength = self._map(specular, "specularTexture")
        unknown = {name for name in more if name[14:] not in _JUDGED and name not in _HARMLESS}
        return Material(
            base_color=color[:3],
            alpha=float(color[3]),
            metallic=pbr.get("metallicFactor", 1.0),
            roughness=pbr.get("roughnessFactor", 1.0),
            f0=np.minimum(f0, 1),
            specular=specular.get("specularFactor", 1.0),
            emissive=glow * given.get("emissive_strength", {}).get("emissiveStrength", 1.0),
            normal_scale=normal.get("scale", 1.0),
            cutoff=item.get("alphaCutoff", 0.5) if mode == "MASK" else None,
            opaque=mode == "OPAQUE",
            double_sided=item.get("doubleSided", False),
            base_map=base and base.channels(0, 1, 2),
            alpha_map=base.channels(3) if base is not None and see_through else None,
            metallic_map=rough and rough.channels(2),
            roughness_map=rough and rough.channels(1),
            f0_map=self._map(specular, "specularColorTexture", srgb=True),
            specular_map=strength.channels(3) if strength is not None else None,
            emissive_map=self._map(item, "emissiveTexture", srgb=True),
            normal_map=self._map(item, "normalTexture"),
            unjudged=tuple(sorted(unknown)),
        )

    def _map(self, item: dict[str, Any], key: str, *, srgb: bool = False) -> Map | None:
        if key not in item:
            return None
        info = item[key]
        texture = self.json["textures"][info["index"]]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            raise UnreadableError("a texture has neither PNG, JPEG nor WebP")
        sampler = self.json["samplers"][texture["sampler"]] if "sampler" in texture else {}
        image = self._image(source)
        if srgb:
            image = np.concatenate([_linear(image[..., :3]), image[..., 3:]], -1)
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        (across, down), (x, y) = moved.get("scale", (1, 1)), moved.get("offset", (0, 0))
        cosine, sine = np.cos(moved.get("rotation", 0)), np.sin(moved.get("rotation", 0))
        transform = np.array([[cosine * across, sine * down, x], [-sine * across, cosine * down, y], [0, 0, 1.0]])
        coordinates = moved.get("texCoord", info.get("texCoord", 0))
        wrap = _WRAPS[sampler.get("wrapS", 10497)]
        return Map(image, transform, coordinates, wrap, sampler.get("magFilter") == _NEAREST)

    def _image(self, index: int) -> np.ndarray:
        if index not in self._images:
            item = self.json["images"][index]
            content = self._view(item["bufferView"]) if "bufferView" in item else self._resource(item["uri"])
            self._images[index] = _pixels(content)
        return self._images[index]

    def accessor(self, index: int) -> np.ndarray:
        """Values [n c] of an accessor; normalized integers as floats (section 3.6.2)."""
        item = self.json["accessors"][index]
        kind, width, count = np.dtype(_KINDS[item["componentType"]]), _WIDTHS[item["type"]], item["count"]
        if "bufferView" in item:
            view = self.json["bufferViews"][item["bufferView"]]
            stride = view.get("byteStride", kind.itemsize * width)
            content = self._view(item["bufferView"])[item.get("byteOffset", 0) :]
            values = np.ndarray((count, width), kind, content, 0, (stride, kind.itemsize)).copy()
        else:
            values = np.zeros((count, width), kind)
        if "sparse" in item:
            sparse = item["sparse"]
            where, value = sparse["indices"], sparse["values"]
            offset, place = where.get("byteOffset", 0), self._view(where["bufferView"])
            rows = np.frombuffer(place, _KINDS[where["componentType"]], sparse["count"], offset)
            content, offset = self._view(value["bufferView"]), value.get("byteOffset", 0)
            values[rows] = np.frombuffer(content, kind, sparse["count"] * width, offset).reshape(-1, width)
        if item.get("normalized"):
            values = np.maximum(values / float(np.iinfo(kind).max), -1.0)
        return values

    def _view(self, index: int) -> bytes:
        view = self.json["bufferViews"][index]
        start = view.get("byteOffset", 0)
        return self._buffer(view["buffer"])[start : start + view["byteLength"]]

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            item = self.json["buffers"][index]
            self._buffers[index] = self._resource(item["uri"]) if "uri" in item else self._chunk
        return self._buffers[index]

    def _resource(self, uri: str) -> bytes:
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2] + "==")
        return (self._folder / urllib.parse.unquote(uri)).read_bytes()


def _chunks(content: bytes) -> tuple[bytes, bytes]:
    """The JSON and the binary chunk of a GLB file."""
    found, start = {}, 12
    while start + 8 <= len(content):
        length, kind = struct.unpack_from("<I4s", content, start)
        found.setdefault(kind, content[start + 8 : start + 8 + length])
        start += 8 + length
    return found[b"JSON"], found.get(b"BIN\0", b"")


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """The local matrix of a node."""
    if "matrix" in node:
        return np.array(node["matrix"], float).reshape(4, 4).T
    x, y, z, w = _unit(np.array(node.get("rotation", (0, 0, 0, 1)), float)[None])[0]
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    result = np.eye(4)
    result[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float)
    result[:3, 3] = node.get("translation", (0, 0, 0))
    return result


def _triangles(index: np.ndarray, mode: int) -> np.ndarray:
    """Triangles of a list, a strip or a fan (section 3.7.2.1)."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    number = np.arange(max(len(index) - 2, 0))
    if mode == _STRIP:
        corner = np.stack([number, number + 1 + number % 2, number + 2 - number % 2], 1)
    else:
        corner = np.stack([number + 1, number + 2, np.zeros_like(number)], 1)
    return index[corner]


def _unit(vector: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return vector / np.where(length > 0, length, 1)


def _pixels(content: bytes) -> np.ndarray:
    """An image [h w 3 or 4] from 0 to 1, as it is stored."""
    image = PIL.Image.open(io.BytesIO(content))
    if image.mode.startswith("I"):
        gray = np.asarray(image, np.float32)[..., None] / 65535
        return np.repeat(gray, 3, -1)
    see_through = "A" in image.getbands() or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if see_through else "RGB"), np.float32) / 255


def _linear(encoded: np.ndarray) -> np.ndarray:
    """Decodes sRGB (IEC 61966-2-1)."""
    low = encoded <= 0.04045
    return np.where(low, encoded / 12.92, ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _obj(path: pathlib.Path) -> list[Surface]:
    """Surfaces of an OBJ file, one for each material."""
    column: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    polygons: dict[str, list[list[tuple[int, int, int]]]] = {}
    materials, name = {}, ""
    text = path.read_text(encoding="utf-8-sig", errors="replace").replace("\\\n", " ")
    for line in text.splitlines():
        key, _, rest = line.partition("#")[0].strip().partition(" ")
        words = rest.split()
        if key in column:
            column[key].append([float(word) for word in words])
        elif key == "usemtl":
            name = rest.strip()
        elif key == "mtllib":
            materials |= _mtl(path.parent / rest.strip())
        elif key == "f":
            count = tuple(len(column[kind]) for kind in ("v", "vt", "vn"))
            polygons.setdefault(name, []).append([_corner(word, count) for word in words])
    position = np.array([row[:3] for row in column["v"]], float).reshape(-1, 3)
    color = np.array([row[3:6] if len(row) >= 6 else [1, 1, 1] for row in column["v"]], float)
    colored = any(len(row) >= 6 for row in column["v"])
    arrays = position, np.array([row[:2] for row in column["vt"]]).reshape(-1, 2), np.array(column["vn"]).reshape(-1, 3)
    smooth = _smooth(position, [corner for faces in polygons.values() for corner in faces])
    gray = Material(base_color=np.full(3, 1.0 if colored else 0.5), metallic=0.0, specular=0.0)
    return [
        _group(arrays, smooth, _linear(color) if colored else None, faces, materials.get(label, gray))
        for label, faces in polygons.items()
    ]


def _corner(word: str, count: tuple[int, ...]) -> tuple[int, int, int]:
    """Indices of position, texture coordinates and normal, from zero; -1 for none."""
    index = [int(part) if part else 0 for part in word.split("/")] + [0, 0]
    place = [
        value - 1 if value > 0 else size + value if value else -1 for value, size in zip(index, count, strict=False)
    ]
    return place[0], place[1], place[2]


def _smooth(position: np.ndarray, polygons: list[list[tuple[int, int, int]]]) -> np.ndarray:
    """Normals of positions, the mean of those of their triangles by area."""
    face = np.array([[p[0][0], p[n][0], p[n + 1][0]] for p in polygons for n in range(1, len(p) - 1)], int).reshape(
        -1, 3
    )
    a, b, c = (position[face[:, corner]] for corner in range(3))
    total = np.zeros_like(position)
    for corner in range(3):
        np.add.at(total, face[:, corner], np.cross(b - a, c - a))
    return _unit(total)


def _group(arrays, smooth: np.ndarray, color: np.ndarray | None, polygons, material: Material) -> Surface:
    """The polygons of one material, convex ones as fans."""
    position, texture, normal = arrays
    corner = np.array([p[k] for p in polygons for n in range(1, len(p) - 1) for k in (0, n, n + 1)], int).reshape(-1, 3)
    unique, face = np.unique(corner, axis=0, return_inverse=True)
    at, on, way = unique.T
    place = {}
    if len(texture) and (on >= 0).any():
        place = {0: np.where(on[:, None] >= 0, texture[on] * [1, -1] + [0, 1], 0)}
    shading = np.where(way[:, None] >= 0, normal[way], smooth[at]) if len(normal) else smooth[at]
    tint = None if color is None or material.base_map else np.concatenate([color[at], np.ones((len(at), 1))], 1)
    return Surface(position[at], face.reshape(-1, 3), _unit(shading), place, tint, material)


def _mtl(path: pathlib.Path) -> dict[str, Material]:
    """Materials of an MTL file; empty if there is none."""
    if not path.is_file():
        return {}
    statements: dict[str, dict[str, str]] = {}
    name = ""
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        key, _, rest = line.partition("#")[0].strip().partition(" ")
        if key == "newmtl":
            name = rest.strip()
            statements[name] = {}
        elif key and name:
            statements[name][key] = rest.strip()
    return {label: _phong(value, path.parent) for label, value in statements.items()}


def _phong(value: dict[str, str], folder: pathlib.Path) -> Material:
    """Kd and Ks with the exponent Ns, as the microfacet lobe of that width; or the statements Pr and Pm."""

    def numbers(key: str, default: float, count: int = 3) -> np.ndarray:
        given = [float(word) for word in value.get(key, str(default)).split()]
        return np.array((given * count)[:count] if len(given) < count else given[:count])

    def image(key: str, *, srgb: bool) -> Map | None:
        file = folder / value.get(key, "").split(" ")[-1].replace("\\", "/")
        if key not in value or not file.is_file():
            return None
        pixels = _pixels(file.read_bytes())
        return Map(_linear(pixels[..., :3]) if srgb else pixels)

    physical = not {"Pr", "Pm", "map_Pr", "map_Pm"}.isdisjoint(value)
    matte = "Ks" not in value or int(numbers("illum", 2, 1)[0]) < 2
    roughness = float((2 / (max(numbers("Ns", 0, 1)[0], 0) + 2)) ** 0.25)
    alpha = float(numbers("d", 1, 1)[0]) if "d" in value else 1 - float(numbers("Tr", 0, 1)[0])
    rough, metal = image("map_Pr", srgb=False), image("map_Pm", srgb=False)
    return Material(
        base_color=numbers("Kd", 1.0),
        alpha=alpha,
        opaque=alpha >= 1,
        metallic=float(numbers("Pm", 1.0 if metal else 0.0, 1)[0]),
        roughness=float(numbers("Pr", 1.0 if rough else roughness, 1)[0]),
        f0=np.full(3, 0.04) if physical else np.minimum(numbers("Ks", 0), 1),
        specular=1.0 if physical or not matte else 0.0,
        emissive=numbers("Ke", 0.0),
        base_map=image("map_Kd", srgb=True),
        emissive_map=image("map_Ke", srgb=True),
        metallic_map=metal and metal.channels(0),
        roughness_map=rough and rough.channels(0),
        normal_map=image("norm", srgb=False),
        unjudged=tuple(sorted({"map_d", "map_Bump", "bump"} & value.keys())),
    )


def write_small(path: pathlib.Path) -> None:
    """Writes a small glTF file: a checkered ball on a ground with two sides and colors of vertices."""
    rings, sectors = 8, 12
    v, u = np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, sectors + 1), indexing="ij")
    across, turn = np.sin(np.pi * v), 2 * np.pi * u
    ball = np.stack([across * np.sin(turn), np.cos(np.pi * v), across * np.cos(turn)], -1).reshape(-1, 3)
    first = (np.arange(rings)[:, None] * (sectors + 1) + np.arange(sectors)).ravel()
    below = first + sectors + 1
    face = np.stack([first, below, below + 1, first, below + 1, first + 1], 1).ravel()
    ground = np.array([[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]])
    arrays = [
        *((ball, "VEC3", 5126), (np.stack([u, v], -1).reshape(-1, 2), "VEC2", 5126), (face, "SCALAR", 5123)),
        *((ground, "VEC3", 5126), (np.array([[0.8, 0.2, 0.2]] * 2 + [[0.2, 0.2, 0.8]] * 2), "VEC3", 5126)),
        (np.array([0, 1, 2, 0, 2, 3]), "SCALAR", 5123),
    ]
    light, dark = [230, 230, 230], [90, 60, 30]
    check = PIL.Image.fromarray(np.array([[light, dark], [dark, light]], np.uint8))
    stream = io.BytesIO()
    check.resize((64, 32), PIL.Image.Resampling.NEAREST).save(stream, "PNG")
    content, views, accessors = b"", [], []
    for values, kind, component in arrays:
        data = np.ascontiguousarray(values, _KINDS[component]).tobytes()
        views.append({"buffer": 0, "byteOffset": len(content), "byteLength": len(data)})
        accessor = {"bufferView": len(accessors), "componentType": component, "type": kind}
        limits = {"min": np.min(values, 0).tolist(), "max": np.max(values, 0).tolist()} if kind == "VEC3" else {}
        accessors.append({**accessor, "count": len(values), **limits})
        content += data + bytes(-len(data) % 4)

    def address(kind: str, data: bytes) -> str:
        return f"data:{kind};base64,{base64.b64encode(data).decode()}"

    ball_of = {"attributes": {"POSITION": 0, "NORMAL": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
    ground_of = {"attributes": {"POSITION": 3, "COLOR_0": 4}, "indices": 5, "material": 1}
    rough = {"metallicFactor": 0, "roughnessFactor": 0.6}
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0, "translation": [0, 1, 0]}, {"mesh": 1, "scale": [1, 1, -1]}],
        "meshes": [{"primitives": [ball_of]}, {"primitives": [ground_of]}],
        "materials": [
            {"pbrMetallicRoughness": {**rough, "baseColorTexture": {"index": 0}}},
            {"pbrMetallicRoughness": rough, "doubleSided": True},
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": address("image/png", stream.getvalue())}],
        "buffers": [{"byteLength": len(content), "uri": address("application/octet-stream", content)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    path.write_text(json.dumps(document))
