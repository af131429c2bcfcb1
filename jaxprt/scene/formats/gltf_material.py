"""Materials of glTF files: metallic-roughness with its extensions, and textures.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from typing import Any

import jax
import numpy as np

from jaxprt.files import images
from jaxprt.scene.formats.gltf_file import Document
from jaxprt.scene.formats.gltf_header import excerpt
from jaxprt.scene.formats.texture_images import stored
from jaxprt.scene.material import Texture, TexturedMaterial

_WRAP = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728
_ALPHA_MODES = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_SOURCES = ("KHR_texture_basisu", "EXT_texture_webp")
_SHOWN = 80  # characters of a URI in warnings


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
        """The material with an index; for None the default material of the specification.

        Raises:
            ValueError: A number is not finite or out of range, or an image is outside of the folder of the file.
            FileNotFoundError: The file of an image does not exist.
            MemoryError: An image does not fit into memory.
        """
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
        """What a material hides: its alpha, and its back (sections 3.9.4 and 3.9.5).

        An alpha mode that the specification does not have counts as opaque, and is recorded.
        """
        field: dict[str, Any] = {"back": "lit" if self._document.boolean(item, "doubleSided", owner) else "hidden"}
        mode = item.get("alphaMode", "OPAQUE")
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
        moved = document.object(document.object(info, "extensions", owner), "KHR_texture_transform", owner)
        number = document.integer({**info, **moved}, "texCoord", owner, 0)
        source = self._source(texture, name)
        if source is None or number > 1:
            self.ignored.add("textures without an image" if source is None else "third texture coordinates")
            return None
        sampler = {}
        if "sampler" in texture:
            sampler = document.item("samplers", texture["sampler"], name)
        if sampler.get("magFilter") == _NEAREST:
            self.ignored.add("nearest filters (textures are interpolated)")
        across, up = (_WRAP.get(document.integer(sampler, side, name, 0), "repeat") for side in ("wrapS", "wrapT"))
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
            self._channels[key] = stored(image, channels, f"image {index}")
        return self._channels[key]

    def _decode(self, index: int, owner: str, decoded: bool) -> np.ndarray | None:
        """The pixels of an image; None, with a record of the reason, if it cannot be decoded."""
        key = index, decoded
        if self._decoded is not None and self._decoded[0] == key:
            return self._decoded[1]
        if key in self._damaged:
            return None
        self._decoded = None
        content = self._document.image(index, owner)
        item = self._document.items("images")[index]
        name = f"image {index}" if "bufferView" in item else f"image {index}, {item['uri'][:_SHOWN]}"
        try:
            image = images.decode_image(content, name=name, decoded=decoded)
        except ValueError as error:
            self.ignored.add(f"textures that cannot be read ({error})")
            self._damaged.add(key)
            return None
        self._decoded = key, image
        return image

    def _transform(self, moved: dict[str, Any], owner: str) -> np.ndarray:
        """The affine transform of KHR_texture_transform, for texture coordinates with v up.

        For v down, the matrix is [cos sin; -sin cos] times the scale, so that "counter-clockwise" holds as seen on the
        image. three.js and Blender's importer agree. The GLSL code in the extension's text, read by columns, rotates
        the other way.
        """
        (x, y), (across, down) = (
            self._number(moved, key, default, owner) for key, default in (("offset", (0.0, 0.0)), ("scale", (1.0, 1.0)))
        )
        angle = self._number(moved, "rotation", 0.0, owner)
        cosine, sine = np.cos(angle), np.sin(angle)
        matrix = np.array([[cosine * across, sine * down, x], [-sine * across, cosine * down, y], [0, 0, 1]])
        flip = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
        with np.errstate(over="ignore"):  # textures refuse transforms that are not finite
            return (flip @ matrix @ flip)[:2].astype(np.float32)
