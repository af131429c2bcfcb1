"""Scenes from glTF files: parts with their materials, cameras, and lights.

The extension KHR_lights_punctual gives point lights and spots in candela and directional lights in lux. One candela is
taken as one unit of radiance times squared world units, and one lux as one unit of radiance times steradian, as
three.js takes them: the numbers of the file are those of the scene, times one factor. Programs that convert from watts
multiply by 683 lm/W or another luminous efficacy, which a factor of 1 / 683 takes back.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import functools
import math
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxprt.files.inputs import JsonObject
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Sun
from jaxprt.scene.formats import gltf_geometry, gltf_nodes, text
from jaxprt.scene.formats.file_parts import FLIP, ImageError, TextureImages, split_parts, warn_of_ignored
from jaxprt.scene.formats.gltf_file import (
    HONORED,
    Document,
    check_required,
    excerpt,
    unread_extensions,
)
from jaxprt.scene.formats.gltf_nodes import Node
from jaxprt.scene.material import Fields, Texture, TexturedMaterial
from jaxprt.scene.scene import PointLight, Scene, unique_names

_HEIGHT = 512  # height of cameras' pictures in pixels
_WIDEST = 64  # a larger aspect ratio is taken for damage
_WRAP = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728
_ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_COLORS = (0, 1, 2)
_PBR = "pbrMetallicRoughness"
# Factors of materials: the object that has each ("" for the material, or an extension), its name, and its default.
_FACTORS: dict[str, tuple[str, str, float | tuple[float, ...]]] = {
    "base_color": (_PBR, "baseColorFactor", (1.0, 1.0, 1.0, 1.0)),
    "metallic": (_PBR, "metallicFactor", 1.0),
    "roughness": (_PBR, "roughnessFactor", 1.0),
    "emissive": ("", "emissiveFactor", (0.0, 0.0, 0.0)),
    "normal_scale": ("normalTexture", "scale", 1.0),
    "ior": ("ior", "ior", 1.5),
    "specular": ("specular", "specularFactor", 1.0),
    "specular_color": ("specular", "specularColorFactor", (1.0, 1.0, 1.0)),
    "anisotropy": ("anisotropy", "anisotropyStrength", 0.0),
    "rotation": ("anisotropy", "anisotropyRotation", 0.0),
    "clearcoat": ("clearcoat", "clearcoatFactor", 0.0),
    "clearcoat_roughness": ("clearcoat", "clearcoatRoughnessFactor", 0.0),
    "sheen_color": ("sheen", "sheenColorFactor", (0.0, 0.0, 0.0)),
    "sheen_roughness": ("sheen", "sheenRoughnessFactor", 0.0),
    "transmission": ("transmission", "transmissionFactor", 0.0),
}
# Textures of materials: the object that has each, its name, its channels, and whether they are decoded from sRGB.
_TEXTURES = {
    "base_color_texture": (_PBR, "baseColorTexture", _COLORS, True),
    "metallic_texture": (_PBR, "metallicRoughnessTexture", (2,), False),
    "roughness_texture": (_PBR, "metallicRoughnessTexture", (1,), False),
    "emissive_texture": ("", "emissiveTexture", _COLORS, True),
    "specular_texture": ("specular", "specularTexture", (3,), False),
    "specular_color_texture": ("specular", "specularColorTexture", _COLORS, True),
    "anisotropy_texture": ("anisotropy", "anisotropyTexture", _COLORS, False),
    "normal_texture": ("", "normalTexture", _COLORS, False),
    "clearcoat_texture": ("clearcoat", "clearcoatTexture", (0,), False),
    "clearcoat_roughness_texture": ("clearcoat", "clearcoatRoughnessTexture", (1,), False),
    "sheen_color_texture": ("sheen", "sheenColorTexture", _COLORS, True),
    "sheen_roughness_texture": ("sheen", "sheenRoughnessTexture", (3,), False),
    "transmission_texture": ("transmission", "transmissionTexture", (0,), False),
    "alpha_texture": (_PBR, "baseColorTexture", (3,), True),
}
_EXTENSIONS = ("ior", "specular", "anisotropy", "emissive_strength", "clearcoat", "sheen", "transmission")
_SOURCES = ("KHR_texture_basisu", "EXT_texture_webp")
_SHOWN = 80  # characters of a URI in warnings
LIGHTS = "KHR_lights_punctual"
_RANGE = "ranges of lights (their light decreases with the squared distance alone)"


def read(
    path: pathlib.Path,
    *,
    outside: bool = False,
    time: float | None = None,
    animation: str | int | None = None,
    lights: float = 1.0,
) -> Scene:
    """Reads the default scene of a glTF file, as `load_scene` documents."""
    with text.name_file_in_errors(path, "glTF"):
        document = Document(path, outside=outside)
        check_required(document, geometry=False)
        ignored = set() if time is None else gltf_nodes.pose(document, time, animation)
        nodes = gltf_nodes.nodes(document)
        contents = gltf_geometry.read(document, scene=nodes)
        reader = MaterialReader(document)
        materials = [reader.material(index) for index in contents.material]
        names = [_name(document, index) for index in contents.material]
        parts = split_parts(contents.geometry, names, materials, path)
        ignored |= contents.ignored | reader.ignored | unread_extensions(document)
        ignored |= {
            name for node in nodes for name in document.field(node.item, "extensions", f"node {node.number}", dict)
        }
        for index, material in zip(contents.material, materials, strict=True):
            if any((index, texture.set) in contents.lacking for texture in material.textures):
                ignored |= {"textures of primitives without texture coordinates"}
        used = contents.geometry.position
        cameras, skipped = _cameras(document, nodes, (used.min(0) + used.max(0)) / 2)
        point_lights, suns, unread_lights = _lights(document, nodes, [part.name for part in parts], lights)
    ignored = (ignored | skipped | unread_lights) - HONORED
    warn_of_ignored(path, ignored, stacklevel=3)
    if suns:
        advice = "jaxprt.scene.with_suns(light, scene.suns) adds them to an environment"
        warnings.warn(f"{path}: its directional lights ({len(suns)}) are in scene.suns: {advice}", stacklevel=3)
    return Scene(parts, cameras, point_lights=point_lights, suns=suns)


def _name(document: Document, index: int | None) -> str:
    """The name of a material, as text that can be written to files."""
    if index is None:
        return "default"
    name = document.items("materials")[index].get("name")
    return str(name).encode(errors="replace").decode() if name else f"material {index}"


def _cameras(document: Document, nodes: Sequence[Node], center: np.ndarray) -> tuple[list[Camera], set[str]]:
    """The perspective cameras of all nodes, and the names of unsupported cameras."""
    cameras, skipped = [], set()
    for node in nodes:
        if "camera" not in node.item:
            continue
        index = document.index("cameras", node.item["camera"], f"node {node.number}")
        item, owner = document.items("cameras")[index], f"camera {index}"
        kind = document.field(item, "type", owner, str)
        if kind == "perspective":
            perspective = document.field(item, "perspective", owner, dict)
            cameras.append(_camera(document, perspective, owner, node.matrix, center))
        else:
            skipped.add(f"{kind} cameras" if kind == "orthographic" else f"cameras of type {excerpt(kind)}")
    return cameras, skipped


def _camera(document: Document, item: JsonObject, owner: str, matrix: np.ndarray, center: np.ndarray) -> Camera:
    """A camera, transformed by its node. Its target is as far away as the center of the scene."""
    angle, aspect = (document.number(item, *field) for field in (("yfov", owner, None), ("aspectRatio", owner, 1.0)))
    if not 0 < angle < math.pi or not 0 < aspect < _WIDEST:
        required = f"must have yfov from 0 to pi and aspectRatio from 0 to {_WIDEST} in {owner}"
        raise document.error(required, f"{angle} and {aspect}")
    eye, back, up = matrix[:3, 3], matrix[:3, 2], matrix[:3, 1]
    length = np.linalg.norm(back)
    if not length > 0:
        raise document.error(f"must have invertible transforms for {owner}", "a scale of zero")
    target = eye - back / length * (np.linalg.norm(center - eye) or 1.0)
    with np.errstate(over="ignore"):  # cameras refuse what is not finite
        up, angle = (np.asarray(value, np.float32) for value in (up, angle))  # eye and target keep their digits
    return Camera(eye, target, up, angle, max(1, round(_HEIGHT * float(aspect))), _HEIGHT)


class MaterialReader:
    """Reads the materials of a file. Shared textures are stored only once.

    Attributes:
        ignored: Names of unsupported features of the materials that have been read, and of images that cannot be read.
    """

    def __init__(self, document: Document):
        self.ignored: set[str] = set()
        self._document = document
        self._images = TextureImages()

    def material(self, index: int | None) -> TexturedMaterial:
        """The material with an index; for None the default material of the specification."""
        if index is None:
            return TexturedMaterial(back="hidden")
        document, owner = self._document, f"material {index}"
        item = document.item("materials", index, owner)
        holder = {"": item} | {key: document.field(item, key, owner, dict) for key in (_PBR, "normalTexture")}
        holder |= {name: document.extension(item, f"KHR_materials_{name}", owner) for name in _EXTENSIONS}
        field: Fields = {
            key: document.number(holder[name], factor, owner, default)
            for key, (name, factor, default) in _FACTORS.items()
        }
        glow = field["emissive"] * document.number(holder["emissive_strength"], "emissiveStrength", owner, 1.0)
        field["emissive"] = document.numbers(glow.tolist(), (3,), f"emissiveFactor times emissiveStrength of {owner}")
        field["base_color"], alpha = field["base_color"][:3], field["base_color"][3]
        self._note(item, holder["clearcoat"], field)
        cover = self._cover(item, alpha, owner)
        field |= cover | {
            key: self._texture(holder[name], texture, channels, owner, decoded=decoded)
            for key, (name, texture, channels, decoded) in _TEXTURES.items()
            if key != "alpha_texture" or "alpha_mode" in cover
        }
        try:
            return TexturedMaterial(**field)
        except ValueError as error:
            raise ValueError(f"{document.path}, {owner}: {error}") from error

    def _note(self, item: JsonObject, coat: JsonObject, field: Fields) -> None:
        """Records unsupported features of a material, and removes its sheen under a clear coat."""
        if "occlusionTexture" in item:
            self.ignored.add("occlusion textures (occlusion is computed)")
        if "clearcoatNormalTexture" in coat:
            self.ignored.add("normal maps of clearcoats (a coat has the normals of its base)")
        if field["transmission"]:
            self.ignored.add(
                "refraction and blur of what is seen through transmitting surfaces (they are thin and clear)"
            )
        if field["clearcoat"] and field["sheen_color"].any():
            self.ignored.add("sheens under clearcoats")
            field["sheen_color"] = np.zeros(3, np.float32)
        self.ignored |= set(item.get("extensions", {}))

    def _cover(self, item: JsonObject, alpha: float, owner: str) -> Fields:
        """What a material hides: its alpha, and its back (sections 3.9.4 and 3.9.5)."""
        back = "lit" if self._document.field(item, "doubleSided", owner, bool) else "hidden"
        mode = item.get("alphaMode", "OPAQUE")
        # An alpha mode that the specification does not have counts as opaque.
        if not isinstance(mode, str) or mode not in _ALPHA_MODES:
            self.ignored.add(f"alpha mode {excerpt(mode)}")
        elif mode != "OPAQUE":
            cutoff = self._document.number(item, "alphaCutoff", owner, 0.5) if mode == "MASK" else 0.5
            return {"back": back, "alpha_mode": _ALPHA_MODES[mode], "alpha": alpha, "alpha_cutoff": cutoff}
        return {"back": back}

    def _texture(
        self, item: JsonObject, key: str, channels: tuple[int, ...], owner: str, *, decoded: bool
    ) -> Texture | None:
        """Some channels of a texture; None if there is no texture that can be read."""
        if key not in item:
            return None
        document = self._document
        info, owner = document.field(item, key, owner, dict), f"{key} of {owner}"
        index = document.index("textures", info.get("index"), owner)
        texture, name = document.items("textures")[index], f"texture {index}"
        moved = document.extension(info, "KHR_texture_transform", owner)
        self.ignored |= info.get("extensions", {}).keys()
        number = document.field({**info, **moved}, "texCoord", owner, int, 0)
        source = self._source(texture, name)
        if source is None or number > 1:
            self.ignored.add("textures without an image" if source is None else "third texture coordinates")
            return None
        sampler = document.item("samplers", texture["sampler"], name) if "sampler" in texture else {}
        if _NEAREST in (sampler.get("magFilter"), sampler.get("minFilter")):
            self.ignored.add("nearest filters (textures are interpolated)")
        modes = [document.field(sampler, side, name, int, 10497) for side in ("wrapS", "wrapT")]
        self.ignored |= {f"wrap mode {mode}" for mode in modes if mode not in _WRAP}
        across, up = (_WRAP.get(mode, "repeat") for mode in modes)
        index = document.index("images", source, name)
        image = document.items("images")[index]
        label = f"image {index}" if "bufferView" in image else f"image {index}, {str(image.get('uri'))[:_SHOWN]}"
        try:
            pixels = self._images.channels(
                index, functools.partial(document.image, index), label, channels, decoded=decoded
            )
        except (FileNotFoundError, ImageError) as error:
            self.ignored.add(f"textures that cannot be read ({error})")
            return None
        return Texture(pixels, self._transform(moved, owner), number, (across, up))

    def _source(self, texture: JsonObject, name: str) -> Any:
        """The image of a texture: PNG or JPEG, or else that of an extension; None if there is none."""
        if "source" in texture:
            return texture["source"]
        used = (self._document.extension(texture, key, name).get("source") for key in _SOURCES)
        return next((source for source in used if source is not None), None)

    def _transform(self, moved: JsonObject, owner: str) -> np.ndarray:
        """The affine transform of KHR_texture_transform, for texture coordinates with v up."""
        (x, y), (across, down), angle = (
            self._document.number(moved, key, owner, default)
            for key, default in (("offset", (0.0, 0.0)), ("scale", (1.0, 1.0)), ("rotation", 0.0))
        )
        cosine, sine = np.cos(angle), np.sin(angle)
        # For v down. "Counter-clockwise" holds as seen on the image; three.js and Blender's importer agree. The GLSL
        # code in the extension's text, read by columns, rotates the other way.
        matrix = np.array([[cosine * across, sine * down, x], [-sine * across, cosine * down, y], [0, 0, 1]])
        with np.errstate(over="ignore"):  # textures refuse transforms that are not finite
            return (FLIP @ matrix @ FLIP)[:2].astype(np.float32)


def _lights(
    document: Document, nodes: Sequence[Node], names: Sequence[str], scale: float
) -> tuple[list[PointLight], list[Sun], set[str]]:
    """Point lights and spots, suns, and what is not read; none for a scale of 0. Parts have the `names`."""
    if scale == 0:
        return [], [], set()
    placed: list[tuple[JsonObject, str, Node]] = []
    ignored: set[str] = set()
    items = document.field(document.extension(document.header, LIGHTS, "the file"), "lights", LIGHTS, list)
    for node in nodes:
        extension = document.extension(node.item, LIGHTS, f"node {node.number}")
        if "light" not in extension:
            continue
        number = document.index("lights", extension["light"], f"node {node.number}", items)
        item, owner = items[number], f"light {number}"
        kind = document.field(item, "type", owner, str)
        if kind in ("point", "spot", "directional"):
            placed.append((item, owner, node))
        else:
            ignored.add(f"lights of type {excerpt(kind)}")
        if "range" in item and kind != "directional":
            ignored.add(_RANGE)
    labels = [str(item.get("name") or owner).encode(errors="replace").decode() for item, owner, _ in placed]
    unique = unique_names([*names, *labels])[len(names) :]
    points, suns = [], []
    for (item, owner, node), name in zip(placed, unique, strict=True):
        color, intensity = (
            document.number(item, "color", owner, (1.0,) * 3),
            document.number(item, "intensity", owner, 1.0),
        )
        strength = scale * color * intensity
        if not (strength >= 0).all():
            raise document.error(f"must have an intensity and a color of at least 0 in {owner}", str(strength.tolist()))
        if item["type"] == "directional":
            suns.append(Sun(name, -_light_axis(document, node, owner), np.float32(strength)))
        else:
            shape = _cone(document, item, node, owner) if item["type"] == "spot" else {}
            points.append(PointLight(name, node.matrix[:3, 3], np.float32(strength), **shape))
    return points, suns, ignored


def _light_axis(document: Document, node: Node, owner: str) -> np.ndarray:
    """Unit direction into which a light shines: the axis -z of its node."""
    axis = -node.matrix[:3, 2]
    length = np.linalg.norm(axis)
    if not length > 0:
        raise document.error(f"must have a scale above 0 in node {node.number} of {owner}", "zero")
    return axis / length


def _cone(document: Document, item: JsonObject, node: Node, owner: str) -> JsonObject:
    """The axis and the angles of a spot."""
    spot = document.field(item, "spot", owner, dict)
    inner, outer = (
        float(document.number(spot, f"{side}ConeAngle", owner, angle))
        for side, angle in (("inner", 0.0), ("outer", np.pi / 4))
    )
    if not 0 <= inner <= outer <= np.pi / 2 + 1e-6 or not outer > 0:  # float32 rounds pi / 2 upward
        must = f"must have innerConeAngle and outerConeAngle in ascending order from 0 to pi / 2 in {owner}"
        raise document.error(must, f"{inner:g} and {outer:g}")
    return {"axis": _light_axis(document, node, owner), "cone": (inner, outer)}
