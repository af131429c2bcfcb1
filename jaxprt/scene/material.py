"""Materials of surfaces, their textures, and the opacity that they give to parts."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import scalar
from jaxprt.compile import jit, known
from jaxprt.scene import texture
from jaxprt.scene.mesh import BLEND, CLEAR, Opacity

Fields = dict[str, Any]  # of a `TexturedMaterial`, by name

_COLORS = "base_color", "emissive", "specular_color", "sheen_color"
ALPHA_MODES = "opaque", "mask", "blend"
BACKS = "black", "hidden", "lit"
# Cutoff, wrap modes, place and shape of an image, color of what passes, and whether it is glass.
_OPAQUE: tuple[Any, ...] = 0.0, (0, 0), -1, (1, 1), (1.0, 1.0, 1.0), False
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of Rec. 709


def _color(value: object) -> Any:
    """A number or a color as an array of shape [3]. What is known stays known while JAX traces."""
    value = scalar(value)
    if not isinstance(value, jax.Array) or value.ndim:
        return value
    if isinstance(value, Tracer):
        return jnp.broadcast_to(value, (3,))
    with jax.ensure_compile_time_eval():
        return jnp.broadcast_to(value, (3,))


class Texture(eqx.Module):
    """A texture: an image, and how texture coordinates map to it.

    Attributes:
        image: Linear values, first row on top.
        transform: Affine transform from texture coordinates (u, v, 1), v up, to coordinates in the image.
        set: Index of the mesh's set of texture coordinates that it uses, 0 or 1.
        wrap: Wrap mode along u and along v, each one of ``texture.WRAPS``.

    Raises:
        ValueError: The image or the transform is not finite, or the set or wrap mode does not exist.
    """

    image: Float[Array, "h w c"] = eqx.field(converter=require.floating)
    transform: Float[Array, "2 3"] = eqx.field(
        converter=require.floating, default_factory=lambda: jnp.eye(2, 3, dtype=jnp.result_type(float))
    )
    set: int = eqx.field(static=True, default=0)
    wrap: tuple[str, str] = eqx.field(static=True, default=("repeat", "repeat"))

    def __check_init__(self):
        """Refuses values that are not finite, and unknown sets and wrap modes."""
        require.finite("the texture's image", self.image)
        require.finite("the texture's transform", self.transform)
        shape = jnp.shape(self.image)
        if len(shape) != 3 or 0 in shape:
            raise ValueError(f"the texture's image must be [h, w, c] without empty axes, got {list(shape)}")
        if jnp.shape(self.transform) != (2, 3):
            raise ValueError(f"the texture's transform must be [2, 3], got {list(jnp.shape(self.transform))}")
        require.count("set", self.set, least=0, most=1)
        words = isinstance(self.wrap, tuple | list) and all(isinstance(word, str) for word in self.wrap)
        if not words or len(self.wrap) != 2 or not set(self.wrap) <= set(texture.WRAPS):
            raise ValueError(f"wrap must be two of {', '.join(texture.WRAPS)}, got {self.wrap}")

    def at(self, *coordinates: Float[Array, "*b 2"]) -> Float[Array, "*b c"]:
        """Looks up the image, given all sets of texture coordinates. Pictures average it; see `material_table`."""
        turn = self.transform[:, :2]
        moved = jnp.einsum("ij,...j->...i", turn, coordinates[self.set], precision="highest") + self.transform[:, 2]
        return texture.lookup(self.image, moved, wrap=self.wrap)


class MaterialValues(eqx.Module):
    """Material parameters at surface points, in the local frame (tangent, bitangent, normal) of each point.

    Attributes:
        base_color: Linear color: the albedo of a dielectric, or the reflectance of a metal at normal incidence.
        metallic: From 0 for a dielectric to 1 for a metal.
        roughness: Perceptual roughness; its square is alpha of the microfacet distribution.
        emissive: Radiance that the surface emits.
        ior: Index of refraction of the dielectric; 0 stands for a reflectance of 1 at normal incidence.
        specular: Weight of the dielectric's specular reflection.
        specular_color: Color of the dielectric's reflectance at normal incidence.
        anisotropy: Strength of the anisotropy, from 0 to 1.
        direction: Unit vector (tangent, bitangent component) along which highlights are stretched.
        normal: Unit normal from the normal map.
    """

    base_color: Float[Array, "*b 3"]
    metallic: Float[Array, "*b"]
    roughness: Float[Array, "*b"]
    emissive: Float[Array, "*b 3"]
    ior: Float[Array, "*b"]
    specular: Float[Array, "*b"]
    specular_color: Float[Array, "*b 3"]
    anisotropy: Float[Array, "*b"]
    direction: Float[Array, "*b 2"]
    normal: Float[Array, "*b 3"]


class TexturedMaterial(eqx.Module):
    """The metallic-roughness material of glTF 2.0: factors, and textures that multiply them.

    Factors are pytree leaves with the defaults of the specification: a white, rough metal. A gray color may be given as
    one number. Missing textures are None. `MaterialValues` explains the parameters.

    Attributes:
        base_color: Linear color, from 0 to 1.
        metallic: Fraction of metal, from 0 to 1.
        roughness: Perceptual roughness, from 0 to 1.
        emissive: Emitted radiance, including the factor of KHR_materials_emissive_strength.
        ior: Index of refraction, at least 1, or 0; see KHR_materials_ior.
        specular: Weight of the specular reflection, from 0 to 1; see KHR_materials_specular.
        specular_color: Linear color of the specular reflection.
        anisotropy: Strength of the anisotropy, from 0 to 1; see KHR_materials_anisotropy.
        rotation: Angle from the tangent towards the bitangent of the anisotropy's direction, in radians.
        normal_scale: Factor on the slopes of the normal map.
        base_color_texture: Texture [h w 3] that multiplies the base color.
        metallic_texture: Texture [h w 1] that multiplies `metallic`.
        roughness_texture: Texture [h w 1] that multiplies `roughness`.
        emissive_texture: Texture [h w 3] that multiplies `emissive`.
        specular_texture: Texture [h w 1] that multiplies `specular`.
        specular_color_texture: Texture [h w 3] that multiplies the specular color.
        anisotropy_texture: Texture [h w 3] with the direction, as (direction + 1) / 2, in the first two channels, and
            a factor on the strength in the third.
        normal_texture: Normal map [h w 3], as (normal + 1) / 2 in the frame of tangent, bitangent and normal.
        clearcoat: Weight of a clear coat, from 0 to 1; see KHR_materials_clearcoat and `jaxprt.brdf.ClearCoat`.
        clearcoat_roughness: Perceptual roughness of the coat, from 0 to 1.
        sheen_color: Linear color of a sheen, from 0 to 1; see KHR_materials_sheen and `jaxprt.brdf.Sheen`. A material
            with a clear coat has no sheen.
        sheen_roughness: Perceptual roughness of the sheen, from 0 to 1; smaller ones count as 0.1.
        transmission: Fraction of the light under the surface that passes through in place of being reflected
            diffusely, from 0 to 1; see KHR_materials_transmission. Surfaces are thin: light and views pass straight
            through, less what is reflected at normal incidence. Views are tinted by the mean base color, light is
            dimmed by its luminance. It is part of the shape of a scene: see `alpha_mode`.
        clearcoat_texture: Texture [h w 1] that multiplies `clearcoat`.
        clearcoat_roughness_texture: Texture [h w 1] that multiplies `clearcoat_roughness`.
        transmission_texture: Texture [h w 1] that multiplies `transmission`.
        sheen_color_texture: Texture [h w 3] that multiplies the color of the sheen.
        sheen_roughness_texture: Texture [h w 1] that multiplies `sheen_roughness`.
        alpha: Opacity, from 0 for a surface that is not there to 1. Ignored if `alpha_mode` is "opaque".
        alpha_texture: Texture [h w 1] that multiplies `alpha`.
        alpha_cutoff: Opacity from which on a surface is there, for "mask"; at least 0. It is absent below.
        alpha_mode: "opaque"; "mask" for a surface with holes; or "blend" for one that hides the share `alpha` of
            what is behind it, and stops that share of light.
        back: What cameras see of the back of the surface: "black"; "hidden" for nothing, so that they see what is
            behind it; or "lit" for the same material. Backs cast shadows in all cases.

    Raises:
        TypeError: A texture is an array, not a `Texture`.
        ValueError: A factor is not finite or out of its range, or `alpha_mode` or `back` is another word.

    Reference: Khronos glTF 2.0 specification, section 3.9 and appendix B; its extensions KHR_materials_ior,
    KHR_materials_specular, KHR_materials_anisotropy, KHR_materials_emissive_strength, KHR_materials_clearcoat,
    KHR_materials_sheen and KHR_materials_transmission.
    """

    base_color: Float[Array, "3"] = eqx.field(converter=_color, default=1.0)
    metallic: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)
    roughness: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)
    emissive: Float[Array, "3"] = eqx.field(converter=_color, default=0.0)
    ior: Float[Array, ""] = eqx.field(converter=scalar, default=1.5)
    specular: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)
    specular_color: Float[Array, "3"] = eqx.field(converter=_color, default=1.0)
    anisotropy: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    rotation: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    normal_scale: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)
    base_color_texture: Texture | None = None
    metallic_texture: Texture | None = None
    roughness_texture: Texture | None = None
    emissive_texture: Texture | None = None
    specular_texture: Texture | None = None
    specular_color_texture: Texture | None = None
    anisotropy_texture: Texture | None = None
    normal_texture: Texture | None = None
    clearcoat: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    clearcoat_roughness: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    transmission: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    clearcoat_texture: Texture | None = None
    clearcoat_roughness_texture: Texture | None = None
    transmission_texture: Texture | None = None
    sheen_color: Float[Array, "3"] = eqx.field(converter=_color, default=0.0)
    sheen_roughness: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    sheen_color_texture: Texture | None = None
    sheen_roughness_texture: Texture | None = None
    alpha: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)
    alpha_texture: Texture | None = None
    alpha_cutoff: Float[Array, ""] = eqx.field(converter=scalar, default=0.5)
    alpha_mode: str = eqx.field(static=True, default="opaque")
    back: str = eqx.field(static=True, default="black")

    def __check_init__(self):
        """Refuses factors that are not finite or out of their range."""
        for name, words in (("alpha_mode", ALPHA_MODES), ("back", BACKS)):
            if getattr(self, name) not in words:
                raise ValueError(
                    f"{name} of TexturedMaterial must be one of {', '.join(words)}, got {getattr(self, name)!r}"
                )
        layers = "clearcoat", "clearcoat_roughness", "transmission", "sheen_color", "sheen_roughness"
        for name in ("base_color", "metallic", "roughness", "specular", "anisotropy", "alpha", *layers):
            require.within(f"{name} of TexturedMaterial", getattr(self, name), 0, 1)
        for name in ("emissive", "specular_color", "ior", "alpha_cutoff"):
            require.at_least(f"{name} of TexturedMaterial", getattr(self, name), 0.0)
        for name in ("rotation", "normal_scale"):
            require.finite(f"{name} of TexturedMaterial", getattr(self, name))
        for name, value in vars(self).items():
            if name in ("alpha_mode", "back"):
                continue
            if not name.endswith("_texture"):
                shape = (3,) if name in _COLORS else ()
                if jnp.shape(value) != shape:
                    required = "one number or a color [3]" if shape else "one number"
                    raise ValueError(f"{name} of TexturedMaterial must be {required}, got {list(jnp.shape(value))}")
            elif isinstance(value, np.ndarray | jax.Array):
                raise TypeError(
                    f"{name} of TexturedMaterial must be a Texture, got an array: use jaxprt.scene.Texture(image)"
                )
            elif value is not None:
                require.kind(f"{name} of TexturedMaterial", value, Texture, source="jaxprt.scene.Texture")
                _check_channels(name, value)
        if not isinstance(self.ior, Tracer) and 0 < np.asarray(self.ior) < 1:
            raise ValueError(f"ior of TexturedMaterial must be 0 or at least 1, got {self.ior}")

    @property
    def textures(self) -> tuple[Texture, ...]:
        """All textures of the material."""
        return tuple(value for value in vars(self).values() if isinstance(value, Texture))

    @property
    def oriented(self) -> Texture | None:
        """The texture whose values have directions: the normal map, or that of the anisotropy."""
        return self.normal_texture or self.anisotropy_texture

    @jit
    def at(
        self,
        coordinate: Float[Array, "*b 2"],
        second: Float[Array, "*b 2"] | None = None,
        *,
        color: Float[Array, "*b 3"] | None = None,
        handedness: Float[Array, "*b"] | None = None,
    ) -> MaterialValues:
        """Evaluates the material at vertices of a mesh or other points. Textures are read sharply.

        The result is differentiable in the factors, the images and, within texels, the coordinates. If a normal map or
        a direction of anisotropy is zero, the normal of the surface or the tangent is used, and gradients are finite.

        Args:
            coordinate: Texture coordinates with v up, as in `Mesh.texture`.
            second: Second set of texture coordinates; the first set if None.
            color: Colors that multiply the base color.
            handedness: 1 where the bitangent of the textures is cross(normal, tangent), and -1 where it is opposite; 1
                everywhere if None. Results are in the right-handed frame.

        Returns:
            The material parameters at the points.
        """
        places = (coordinate, coordinate if second is None else second)
        batch = coordinate.shape[:-1]

        def value(factor: Array, source: Texture | None) -> Array:
            wide = jnp.broadcast_to(factor, (*batch, *(factor.shape or (1,))))
            return wide if source is None else wide * source.at(*places)

        base = value(self.base_color, self.base_color_texture)
        anisotropy, direction = self._anisotropy(places)
        normal = self._normal(places)
        if handedness is not None:
            direction = direction * jnp.stack([jnp.ones_like(handedness), handedness], -1)
            normal = normal * jnp.stack([jnp.ones_like(handedness), handedness, jnp.ones_like(handedness)], -1)
        return MaterialValues(
            base if color is None else base * color,
            value(self.metallic, self.metallic_texture)[..., 0],
            value(self.roughness, self.roughness_texture)[..., 0],
            value(self.emissive, self.emissive_texture),
            value(self.ior, None)[..., 0],
            value(self.specular, self.specular_texture)[..., 0],
            value(self.specular_color, self.specular_color_texture),
            anisotropy,
            direction,
            normal,
        )

    def _anisotropy(self, places: tuple[Array, ...]) -> tuple[Array, Array]:
        """Strength and direction of the anisotropy."""
        batch = places[0].shape[:-1]
        cosine, sine = jnp.cos(self.rotation), jnp.sin(self.rotation)
        if self.anisotropy_texture is None:
            direction = jnp.stack([cosine, sine])
            return jnp.broadcast_to(self.anisotropy, batch), jnp.broadcast_to(direction, (*batch, 2))
        texel = self.anisotropy_texture.at(*places)
        x, y = jnp.moveaxis(_unit(2 * texel[..., :2] - 1), -1, 0)
        direction = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
        return self.anisotropy * texel[..., 2], direction

    def _normal(self, places: tuple[Array, ...]) -> Array:
        """Unit normals of the normal map."""
        if self.normal_texture is None:
            up = jnp.asarray([0, 0, 1], self.normal_scale.dtype)
            return jnp.broadcast_to(up, (*places[0].shape[:-1], 3))
        slope = 2 * self.normal_texture.at(*places) - 1
        # The last axis comes first, because `_unit` replaces zero by the first axis, here the normal.
        scaled = jnp.stack([slope[..., 2], slope[..., 0] * self.normal_scale, slope[..., 1] * self.normal_scale], -1)
        return jnp.roll(_unit(scaled), -1, -1)


def _check_channels(name: str, source: Texture) -> None:
    """Refuses a texture of another number of channels than it is read for. Colors may be gray."""
    factor, channels = name.removesuffix("_texture"), jnp.shape(source.image)[-1]
    allowed = (1, 3) if factor in _COLORS else (3,) if factor in ("normal", "anisotropy") else (1,)
    if channels not in allowed:
        required = " or ".join(map(str, allowed))
        raise ValueError(f"{name} of TexturedMaterial must have an image of {required} channels, got {channels}")


def _unit(vector: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """Vectors scaled to unit length. Zero vectors become the first axis, with zero gradient."""
    square = jnp.sum(vector**2, -1, keepdims=True)
    zero = square < jnp.finfo(vector.dtype).tiny
    first = jnp.zeros_like(vector).at[..., 0].set(1)
    safe = jnp.where(zero, first, vector)
    return safe / jnp.sqrt(jnp.sum(safe**2, -1, keepdims=True))


class _Glass(NamedTuple):
    """Light that passes a thin transmitting surface: its luminance without the texture, and its color."""

    luminance: float
    color: Float[np.ndarray, " 3"]


def opacity_of_parts(parts: Sequence[Any]) -> Opacity | None:
    """The opacity of the vertices of some parts, one after another; None if all of them are opaque.

    Parts that transmit light are thin glass: light and views pass straight through, in the mean base color, less what
    is reflected at normal incidence. Alpha comes first: a material whose alpha counts is not glass.

    Args:
        parts: Parts of a scene.
    """
    glasses = [_glass(part) for part in parts]
    clear = [glass is not None or _lets_light_through(part) for part, glass in zip(parts, glasses, strict=True)]
    if not any(clear):
        return None
    total = sum(len(part.mesh.position) for part in parts)
    coordinate, factor = np.zeros((total, 2), np.float32), np.ones(total, np.float32)
    layer, rows, texels, first = np.zeros(total, np.int32), [_OPAQUE], [np.ones(1, np.float32)], 0
    place: dict[tuple, int] = {}
    for part, glass, through in zip(parts, glasses, clear, strict=True):
        span = slice(first, first + len(part.mesh.position))
        first = span.stop
        if not through:
            continue
        material, wrap, start, shape = part.material, (0, 0), -1, (1, 1)
        layer[span] = len(rows)
        source = material.alpha_texture if glass is None else material.transmission_texture
        factor[span] = _factor(part) if glass is None else 1 - glass.luminance if source is None else 1
        if source is not None:
            key = id(source.image), glass and glass.luminance
            image = np.asarray(source.image, np.float32)[..., 0]
            if key not in place:
                place[key] = sum(map(len, texels))
                texels.append((image if glass is None else 1 - np.float32(glass.luminance) * image).ravel())
            start, shape = place[key], image.shape
            wrap = tuple(texture.WRAPS.index(mode) for mode in source.wrap)
            sets = part.mesh.texture, part.mesh.texture if part.second is None else part.second
            move = np.asarray(source.transform, np.float64)
            coordinate[span] = np.asarray(sets[source.set], np.float64) @ move[:, :2].T + move[:, 2]
        cutoff = BLEND if glass is not None or material.alpha_mode == "blend" else float(material.alpha_cutoff)
        rows.append((cutoff, wrap, start, shape, (1, 1, 1) if glass is None else tuple(glass.color), glass is not None))
    cutoff, wrap, start, shape, passing, clean = (np.array(column) for column in zip(*rows, strict=True))
    columns = cutoff.astype(np.float32), wrap.astype(np.int32), start.astype(np.int64), shape.astype(np.int32)
    return Opacity(coordinate, factor, layer, *columns, np.concatenate(texels), passing.astype(np.float32), clean)


def _glass(part: Any) -> _Glass | None:
    """Light that passes the material of a part; None where it transmits none that pictures show, or has an alpha."""
    material = part.material
    if not isinstance(material, TexturedMaterial) or _lets_light_through(part) or not known(material.transmission):
        return None
    if float(material.transmission) < CLEAR:
        return None
    color = _mean(material.base_color, material.base_color_texture)
    ior = float(material.ior)
    reflected = np.clip(((ior - 1) / (ior + 1)) ** 2 * _mean(material.specular, material.specular_texture), 0, 1)
    metallic = _mean(material.metallic, material.metallic_texture)
    share = float(material.transmission) * float(1 - reflected[0]) * float(1 - metallic[0])
    luminance = float(color @ _LUMINANCE)
    return _Glass(share * luminance, color / luminance) if share * luminance > CLEAR else None


def _mean(factor: Array | np.ndarray | float, image: Texture | None) -> Float[np.ndarray, " _"]:
    value = np.atleast_1d(np.asarray(factor, np.float64))
    return value if image is None else value * np.asarray(image.image, np.float64).mean((0, 1))


def _factor(part: Any) -> Float[np.ndarray, " v"]:
    """Opacity of the vertices of a part, without its image."""
    color = 1.0 if part.alpha is None else np.asarray(part.alpha, np.float32)
    return np.full(len(part.mesh.position), float(part.material.alpha), np.float32) * color


def _lets_light_through(part: Any) -> bool:
    """Whether a part stops less than all light somewhere. Many files name a mode for opaque materials too."""
    material = part.material
    if not isinstance(material, TexturedMaterial) or material.alpha_mode == "opaque":
        return False
    least = float(np.min(_factor(part)))
    if material.alpha_texture is not None:
        least *= float(np.min(np.asarray(material.alpha_texture.image)))
    return least < (1 - CLEAR if material.alpha_mode == "blend" else float(material.alpha_cutoff))
