"""Materials of glTF files: metallic-roughness with its extensions, and textures.

References in comments are to sections of the glTF 2.0 specification, https://registry.khronos.org/glTF/specs/2.0.
"""

from typing import Any

import jax
import numpy as np

from jaxprt.files import images
from jaxprt.scene.formats.gltf_file import Document
from jaxprt.scene.material import Texture, TexturedMaterial

_WRAP = {10497: "repeat", 33648: "mirror", 33071: "clamp"}
_NEAREST = 9728


class MaterialReader:
    """Reads the materials of a file. Shared textures are decoded and stored only once.

    Attributes:
        ignored: Names of unsupported features of the materials that have been read.
    """

    def __init__(self, document: Document):
        self.ignored: set[str] = set()
        self._document = document
        self._image: dict[tuple[Any, bool], np.ndarray] = {}
        self._channels: dict[tuple[Any, bool, tuple[int, ...]], jax.Array] = {}

    def material(self, index: int | None) -> TexturedMaterial:
        """The material with an index; for None the default material of the specification.

        Raises:
            ValueError: A number is not finite or out of range, or a texture is not an image.
            FileNotFoundError: The file of an image does not exist.
        """
        if index is None:
            return TexturedMaterial()
        owner = f"material {index}"
        item = self._document.item("materials", index, owner)
        extension = item.get("extensions", {})
        pbr = item.get("pbrMetallicRoughness", {})
        specular, brushed = (extension.get(f"KHR_materials_{name}", {}) for name in ("specular", "anisotropy"))
        strength = self._number(extension.get("KHR_materials_emissive_strength", {}), "emissiveStrength", 1.0, owner)
        normal = item.get("normalTexture", {})
        self._note(item)
        field: dict[str, Any] = {
            "base_color": self._number(pbr, "baseColorFactor", (1.0, 1.0, 1.0, 1.0), owner)[:3],
            "metallic": self._number(pbr, "metallicFactor", 1.0, owner),
            "roughness": self._number(pbr, "roughnessFactor", 1.0, owner),
            "emissive": self._number(item, "emissiveFactor", (0.0, 0.0, 0.0), owner) * strength,
            "ior": self._number(extension.get("KHR_materials_ior", {}), "ior", 1.5, owner),
            "specular": self._number(specular, "specularFactor", 1.0, owner),
            "specular_color": self._number(specular, "specularColorFactor", (1.0, 1.0, 1.0), owner),
            "anisotropy": self._number(brushed, "anisotropyStrength", 0.0, owner),
            "rotation": self._number(brushed, "anisotropyRotation", 0.0, owner),
            "normal_scale": self._number(normal, "scale", 1.0, owner),
        }
        colors, both = (0, 1, 2), pbr.get("metallicRoughnessTexture")
        field |= {
            "base_color_texture": self._texture(pbr.get("baseColorTexture"), colors, owner, decoded=True),
            "metallic_texture": self._texture(both, (2,), owner),
            "roughness_texture": self._texture(both, (1,), owner),
            "emissive_texture": self._texture(item.get("emissiveTexture"), colors, owner, decoded=True),
            "specular_texture": self._texture(specular.get("specularTexture"), (3,), owner),
            "specular_color_texture": self._texture(specular.get("specularColorTexture"), colors, owner, decoded=True),
            "anisotropy_texture": self._texture(brushed.get("anisotropyTexture"), colors, owner),
            "normal_texture": self._texture(item.get("normalTexture"), colors, owner),
        }
        try:
            return TexturedMaterial(**field)
        except ValueError as error:
            raise ValueError(f"{self._document.path}, {owner}: {error}") from error

    def _number(self, item: dict[str, Any], key: str, default: float | tuple[float, ...], owner: str) -> np.ndarray:
        return self._document.numbers(item.get(key, default), np.shape(default), f"{key} of {owner}")

    def _note(self, item: dict[str, Any]) -> None:
        """Records unsupported features of a material."""
        if item.get("alphaMode", "OPAQUE") != "OPAQUE":
            self.ignored.add(f"alpha mode {item['alphaMode']}")
        if item.get("doubleSided", False):
            self.ignored.add("doubleSided (backs of surfaces are black)")
        if "occlusionTexture" in item:
            self.ignored.add("occlusion textures (occlusion is computed)")
        self.ignored |= set(item.get("extensions", {}))

    def _texture(
        self, info: dict[str, Any] | None, channels: tuple[int, ...], owner: str, *, decoded: bool = False
    ) -> Texture | None:
        """Some channels of a texture; None if there is no texture that can be read."""
        if info is None:
            return None
        item = self._document.item("textures", info["index"], owner)
        moved = info.get("extensions", {}).get("KHR_texture_transform", {})
        number = moved.get("texCoord", info.get("texCoord", 0))
        if "source" not in item or number not in (0, 1):
            self.ignored.add("textures without PNG or JPEG" if "source" not in item else "third texture coordinates")
            return None
        sampler = {}
        if "sampler" in item:
            sampler = self._document.item("samplers", item["sampler"], f"texture {info['index']}")
        if sampler.get("magFilter") == _NEAREST:
            self.ignored.add("nearest filters (textures are interpolated)")
        across, up = (_WRAP.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT"))
        image = self._pixels(item["source"], channels, f"texture {info['index']}", decoded)
        return Texture(image, self._transform(moved, owner), number, (across, up))

    def _pixels(self, source: Any, channels: tuple[int, ...], owner: str, decoded: bool) -> jax.Array:
        key = (source, decoded, channels)
        if key not in self._channels:
            if key[:2] not in self._image:
                name = f"{self._document.path}: image {source}"
                content = self._document.image(source, owner)
                self._image[key[:2]] = colored(images.decode_image(content, name=name, decoded=decoded))
            self._channels[key] = jax.device_put(np.ascontiguousarray(self._image[key[:2]][..., channels]))
        return self._channels[key]

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
        return (flip @ matrix @ flip)[:2].astype(np.float32)


def colored(image: np.ndarray) -> np.ndarray:
    """Converts an image with 1 (gray), 2 (gray, alpha), 3 or 4 channels to four channels."""
    gray = image.shape[-1] < 3
    colors = np.broadcast_to(image[..., :1], (*image.shape[:2], 3)) if gray else image[..., :3]
    alpha = image[..., -1:] if image.shape[-1] % 2 == 0 else np.ones_like(image[..., :1])
    return np.concatenate([colors, alpha], -1)
