"""Scenes from glTF files: parts with their materials, cameras, and lights.

The extension KHR_lights_punctual gives point lights and spots in candela and directional lights in lux. One candela is
taken as one unit of radiance times squared world units, and one lux as one unit of radiance times steradian, as
three.js takes them: the numbers of the file are those of the scene, times one factor. Programs that convert from watts
multiply by 683 lm/W or another luminous efficacy, which a factor of 1 / 683 takes back.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

import math
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxprt.files import images
from jaxprt.scene.camera import Camera
from jaxprt.scene.environment import Sun
from jaxprt.scene.formats import gltf_geometry, gltf_nodes
from jaxprt.scene.formats.file_parts import split_parts, store_channels, warn_of_ignored
from jaxprt.scene.formats.gltf_file import (
    HONORED,
    Document,
    check_required,
    excerpt,
    name_file_in_errors,
    unread_extensions,
)
from jaxprt.scene.formats.gltf_nodes import Node
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.scene import PointLight, Scene, unique_names

_HEIGHT = 512  # height of cameras' pictures in pixels
_WIDEST = 64  # a larger aspect ratio is taken for damage
_WRAP = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728
_ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
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
    with name_file_in_errors(path):
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
        ignored |= {name for node in nodes for name in document.object(node.item, "extensions", f"node {node.number}")}
        for index, material in zip(contents.material, materials, strict=True):
            if any((index, texture.set) in contents.lacking for texture in material.textures):
                ignored |= {"textures of primitives without texture coordinates"}
        used = contents.geometry.position
        cameras, skipped = _cameras(document, nodes, (used.min(0) + used.max(0)) / 2)
        point_lights, suns, unread_lights = read_lights(document, nodes, [part.name for part in parts], lights)
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
        kind = document.string(item, "type", owner)
        if kind == "perspective":
            perspective = document.object(item, "perspective", owner)
            cameras.append(_camera(document, perspective, owner, node.matrix, center))
        else:
            skipped.add(f"{kind} cameras" if kind == "orthographic" else f"cameras of type {excerpt(kind)}")
    return cameras, skipped


def _camera(document: Document, item: dict[str, Any], owner: str, matrix: np.ndarray, center: np.ndarray) -> Camera:
    """A camera, transformed by its node. Its target is as far away as the center of the scene."""
    angle = document.numbers(item.get("yfov"), (), f"yfov of {owner}")
    aspect = document.numbers(item.get("aspectRatio", 1.0), (), f"aspectRatio of {owner}")
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
        self._decoded: tuple[tuple[int, bool], np.ndarray] | None = None  # the last image, for its other channels
        self._damaged: set[tuple[int, bool]] = set()
        self._channels: dict[tuple[int, bool, tuple[int, ...]], jax.Array] = {}

    def material(self, index: int | None) -> TexturedMaterial:
        """The material with an index; for None the default material of the specification."""
        if index is None:
            return TexturedMaterial(back="hidden")
        owner = f"material {index}"
        item = self._document.item("materials", index, owner)
        extensions = self._document.object(item, "extensions", owner)
        ior, specular, brushed, emissive = (
            self._document.object(extensions, f"KHR_materials_{name}", owner)
            for name in ("ior", "specular", "anisotropy", "emissive_strength")
        )
        pbr = self._document.object(item, "pbrMetallicRoughness", owner)
        glow = self._number(item, "emissiveFactor", (0.0, 0.0, 0.0), owner)
        glow = glow * self._number(emissive, "emissiveStrength", 1.0, owner)
        normal = self._document.object(item, "normalTexture", owner)
        self._note(item, owner)
        field: dict[str, Any] = {
            "base_color": self._number(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), owner)[:3],
            "metallic": self._number(pbr, "metallicFactor", 1.0, owner),
            "roughness": self._number(pbr, "roughnessFactor", 1.0, owner),
            "emissive": self._document.numbers(
                glow.tolist(), (3,), f"emissiveFactor times emissiveStrength of {owner}"
            ),
            "ior": self._number(ior, "ior", 1.5, owner),
            "specular": self._number(specular, "specularFactor", 1.0, owner),
            "specular_color": self._number(specular, "specularColorFactor", (1.0, 1.0, 1.0), owner),
            "anisotropy": self._number(brushed, "anisotropyStrength", 0.0, owner),
            "rotation": self._number(brushed, "anisotropyRotation", 0.0, owner),
            "normal_scale": self._number(normal, "scale", 1.0, owner),
        }
        colors = (0, 1, 2)
        field |= {
            "base_color_texture": self._texture(pbr, "baseColorTexture", colors, owner, decoded=True),
            "metallic_texture": self._texture(pbr, "metallicRoughnessTexture", (2,), owner),
            "roughness_texture": self._texture(pbr, "metallicRoughnessTexture", (1,), owner),
            "emissive_texture": self._texture(item, "emissiveTexture", colors, owner, decoded=True),
            "specular_texture": self._texture(specular, "specularTexture", (3,), owner),
            "specular_color_texture": self._texture(specular, "specularColorTexture", colors, owner, decoded=True),
            "anisotropy_texture": self._texture(brushed, "anisotropyTexture", colors, owner),
            "normal_texture": self._texture(item, "normalTexture", colors, owner),
        }
        field |= self._layers(extensions, owner)
        field |= self._cover(item, pbr, owner)
        try:
            return TexturedMaterial(**field)
        except ValueError as error:
            raise ValueError(f"{self._document.path}, {owner}: {error}") from error

    def _number(self, item: dict[str, Any], key: str, default: float | tuple[float, ...], owner: str) -> np.ndarray:
        return self._document.numbers(item.get(key, default), np.shape(default), f"{key} of {owner}")

    def _layers(self, extensions: dict[str, Any], owner: str) -> dict[str, Any]:
        """The clear coat and the sheen of a material, and what passes through it."""
        coat, fibers, passing = (
            self._document.object(extensions, f"KHR_materials_{name}", owner)
            for name in ("clearcoat", "sheen", "transmission")
        )
        if "clearcoatNormalTexture" in coat:
            self.ignored.add("normal maps of clearcoats (a coat has the normals of its base)")
        if passing.get("transmissionFactor", 0) != 0:
            self.ignored.add(
                "refraction and blur of what is seen through transmitting surfaces (they are thin and clear)"
            )
        field = {
            "clearcoat": self._number(coat, "clearcoatFactor", 0.0, owner),
            "clearcoat_roughness": self._number(coat, "clearcoatRoughnessFactor", 0.0, owner),
            "sheen_color": self._number(fibers, "sheenColorFactor", (0.0, 0.0, 0.0), owner),
            "sheen_roughness": self._number(fibers, "sheenRoughnessFactor", 0.0, owner),
            "transmission": self._number(passing, "transmissionFactor", 0.0, owner),
        }
        if field["clearcoat"] and np.any(field["sheen_color"]):
            self.ignored.add("sheens under clearcoats")
            field["sheen_color"] = np.zeros(3, np.float32)
        return field | {
            "clearcoat_texture": self._texture(coat, "clearcoatTexture", (0,), owner),
            "clearcoat_roughness_texture": self._texture(coat, "clearcoatRoughnessTexture", (1,), owner),
            "sheen_color_texture": self._texture(fibers, "sheenColorTexture", (0, 1, 2), owner, decoded=True),
            "sheen_roughness_texture": self._texture(fibers, "sheenRoughnessTexture", (3,), owner),
            "transmission_texture": self._texture(passing, "transmissionTexture", (0,), owner),
        }

    def _cover(self, item: dict[str, Any], pbr: dict[str, Any], owner: str) -> dict[str, Any]:
        """What a material hides: its alpha, and its back (sections 3.9.4 and 3.9.5)."""
        field: dict[str, Any] = {"back": "lit" if self._document.boolean(item, "doubleSided", owner) else "hidden"}
        mode = item.get("alphaMode", "OPAQUE")
        # An alpha mode that the specification does not have counts as opaque.
        if not isinstance(mode, str) or mode not in _ALPHA_MODES:
            self.ignored.add(f"alpha mode {excerpt(mode)}")
            return field
        if mode == "OPAQUE":
            return field
        return field | {
            "alpha_mode": _ALPHA_MODES[mode],
            "alpha": self._number(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), owner)[3],
            "alpha_cutoff": self._number(item, "alphaCutoff", 0.5, owner) if mode == "MASK" else 0.5,
            "alpha_texture": self._texture(pbr, "baseColorTexture", (3,), owner, decoded=True),
        }

    def _note(self, item: dict[str, Any], owner: str) -> None:
        """Records unsupported features of a material."""
        if "occlusionTexture" in item:
            self.ignored.add("occlusion textures (occlusion is computed)")
        self.ignored |= set(item.get("extensions", {}))

    def _texture(
        self, item: dict[str, Any], key: str, channels: tuple[int, ...], owner: str, *, decoded: bool = False
    ) -> Texture | None:
        """Some channels of a texture; None if there is no texture that can be read."""
        if key not in item:
            return None
        document = self._document
        info, owner = document.object(item, key, owner), f"{key} of {owner}"
        index = document.index("textures", info.get("index"), owner)
        texture, name = document.items("textures")[index], f"texture {index}"
        extensions = document.object(info, "extensions", owner)
        moved = document.object(extensions, "KHR_texture_transform", owner)
        self.ignored |= extensions.keys()
        number = document.integer({**info, **moved}, "texCoord", owner, 0)
        source = self._source(texture, name)
        if source is None or number > 1:
            self.ignored.add("textures without an image" if source is None else "third texture coordinates")
            return None
        sampler = {}
        if "sampler" in texture:
            sampler = document.item("samplers", texture["sampler"], name)
        if _NEAREST in (sampler.get("magFilter"), sampler.get("minFilter")):
            self.ignored.add("nearest filters (textures are interpolated)")
        modes = [document.integer(sampler, side, name, 10497) for side in ("wrapS", "wrapT")]
        self.ignored |= {f"wrap mode {mode}" for mode in modes if mode not in _WRAP}
        across, up = (_WRAP.get(mode, "repeat") for mode in modes)
        image = self._pixels(source, channels, name, decoded)
        return None if image is None else Texture(image, self._transform(moved, owner), number, (across, up))

    def _source(self, texture: dict[str, Any], name: str) -> Any:
        """The image of a texture: PNG or JPEG, or else that of an extension; None if there is none."""
        if "source" in texture:
            return texture["source"]
        extensions = self._document.object(texture, "extensions", name)
        used = (self._document.object(extensions, key, name).get("source") for key in _SOURCES if key in extensions)
        return next((source for source in used if source is not None), None)

    def _pixels(self, source: Any, channels: tuple[int, ...], owner: str, decoded: bool) -> jax.Array | None:
        """Channels of an image; None, with a record of the reason, if it cannot be decoded."""
        index = self._document.index("images", source, owner)
        key = (index, decoded, channels)
        if key not in self._channels:
            image = self._decode(index, owner, decoded)
            if image is None:
                return None
            self._channels[key] = store_channels(image, channels, f"image {index}")
        return self._channels[key]

    def _decode(self, index: int, owner: str, decoded: bool) -> np.ndarray | None:
        """The pixels of an image; None, with a record of the reason, if it cannot be decoded."""
        key = index, decoded
        if self._decoded is not None and self._decoded[0] == key:
            return self._decoded[1]
        if key in self._damaged:
            return None
        self._decoded = None
        item = self._document.items("images")[index]
        name = f"image {index}" if "bufferView" in item else f"image {index}, {str(item.get('uri'))[:_SHOWN]}"
        try:
            content = self._document.image(index, owner)
        except FileNotFoundError as error:
            return self._skip(key, error)
        try:
            image = images.decode_image(content, name=name, decoded=decoded)
        except ValueError as error:
            return self._skip(key, error)
        self._decoded = key, image
        return image

    def _skip(self, key: tuple[int, bool], reason: Exception) -> None:
        """Records why an image cannot be read."""
        self.ignored.add(f"textures that cannot be read ({reason})")
        self._damaged.add(key)

    def _transform(self, moved: dict[str, Any], owner: str) -> np.ndarray:
        """The affine transform of KHR_texture_transform, for texture coordinates with v up."""
        (x, y), (across, down) = (
            self._number(moved, key, default, owner) for key, default in (("offset", (0.0, 0.0)), ("scale", (1.0, 1.0)))
        )
        angle = self._number(moved, "rotation", 0.0, owner)
        cosine, sine = np.cos(angle), np.sin(angle)
        # For v down. "Counter-clockwise" holds as seen on the image; three.js and Blender's importer agree. The GLSL
        # code in the extension's text, read by columns, rotates the other way.
        matrix = np.array([[cosine * across, sine * down, x], [-sine * across, cosine * down, y], [0, 0, 1]])
        flip = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
        with np.errstate(over="ignore"):  # textures refuse transforms that are not finite
            return (flip @ matrix @ flip)[:2].astype(np.float32)


def read_lights(
    document: Document, nodes: Sequence[Node], names: Sequence[str], scale: float
) -> tuple[list[PointLight], list[Sun], set[str]]:
    """The lights of all nodes; none for a scale of 0.

    Args:
        document: The file.
        nodes: The nodes of the default scene.
        names: Names of the parts, which lights must not have.
        scale: Units of radiance for one candela per square world unit.

    Returns:
        Point lights and spots, suns, and the names of what is not read.
    """
    if scale == 0:
        return [], [], set()
    placed: list[tuple[dict[str, Any], str, Node]] = []
    ignored: set[str] = set()
    items = document.array(_lights_extension(document, document.header, "the file"), "lights", LIGHTS)
    for node in nodes:
        extension = _lights_extension(document, node.item, f"node {node.number}")
        if "light" not in extension:
            continue
        number = extension["light"]
        if type(number) is not int or not 0 <= number < len(items) or not isinstance(items[number], dict):
            raise document.error(f"must refer to one of its {len(items)} lights in node {node.number}", excerpt(number))
        item, owner = items[number], f"light {number}"
        kind = document.string(item, "type", owner)
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
        color = document.numbers(item.get("color", [1.0] * 3), (3,), f"the color of {owner}")
        strength = scale * color * document.numbers(item.get("intensity", 1.0), (), f"the intensity of {owner}")
        if not (strength >= 0).all():
            raise document.error(f"must have an intensity and a color of at least 0 in {owner}", str(strength.tolist()))
        if item["type"] == "directional":
            suns.append(Sun(name, -_light_axis(document, node, owner), np.float32(strength)))
        else:
            shape = _cone(document, item, node, owner) if item["type"] == "spot" else {}
            points.append(PointLight(name, node.matrix[:3, 3], np.float32(strength), **shape))
    return points, suns, ignored


def _lights_extension(document: Document, item: dict[str, Any], owner: str) -> dict[str, Any]:
    return document.object(document.object(item, "extensions", owner), LIGHTS, owner)


def _light_axis(document: Document, node: Node, owner: str) -> np.ndarray:
    """Unit direction into which a light shines: the axis -z of its node."""
    axis = -node.matrix[:3, 2]
    length = np.linalg.norm(axis)
    if not length > 0:
        raise document.error(f"must have a scale above 0 in node {node.number} of {owner}", "zero")
    return axis / length


def _cone(document: Document, item: dict[str, Any], node: Node, owner: str) -> dict[str, Any]:
    """The axis and the angles of a spot."""
    spot = document.object(item, "spot", owner)
    inner = float(document.numbers(spot.get("innerConeAngle", 0.0), (), f"innerConeAngle of {owner}"))
    outer = float(document.numbers(spot.get("outerConeAngle", np.pi / 4), (), f"outerConeAngle of {owner}"))
    if not 0 <= inner <= outer <= np.pi / 2 + 1e-6 or not outer > 0:  # float32 rounds pi / 2 upward
        must = f"must have innerConeAngle and outerConeAngle in ascending order from 0 to pi / 2 in {owner}"
        raise document.error(must, f"{inner:g} and {outer:g}")
    return {"axis": _light_axis(document, node, owner), "cone": (inner, outer)}
