"""Metallic-roughness materials with textures, and their parameters at points of a surface."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene import mipmap, texture
from jaxprt.scene.mipmap import Mipmap


def _scalar(value) -> Array:
    return jnp.asarray(value, jnp.result_type(float))


def _color(value) -> Array:
    """A number or a color as an array [3]."""
    value = jnp.asarray(value, jnp.result_type(float))
    return jnp.broadcast_to(value, (3,)) if value.ndim == 0 else value


class Texture(eqx.Module):
    """An image on a surface.

    Attributes:
        image: Linear values, first row on top.
        transform: Affine transform from texture coordinates (u, v, 1), v up, to places in the image.
        set: Which of the mesh's two sets of texture coordinates it takes, 0 or 1.
        wrap: What lies beyond the image's edges along u and along v: see ``texture.WRAPS``.
        mipmap: The image's mip map, from `mipmapped`; None where it is made anew for each picture.

    Raises:
        ValueError: The image or the transform is not finite, or there is no such set or wrap mode.
    """

    image: Float[Array, "h w c"] = eqx.field(converter=jnp.asarray)
    transform: Float[Array, "2 3"] = eqx.field(
        converter=jnp.asarray, default_factory=lambda: jnp.eye(2, 3, dtype=jnp.result_type(float))
    )
    set: int = eqx.field(static=True, default=0)
    wrap: tuple[str, str] = eqx.field(static=True, default=("repeat", "repeat"))
    mipmap: Mipmap | None = None

    def __check_init__(self):
        """Refuses values that are not finite, and unknown sets and wrap modes."""
        require.finite("the texture's image", self.image)
        require.finite("the texture's transform", self.transform)
        require.between("set", self.set, 0, 1)
        if not set(self.wrap) <= set(texture.WRAPS):
            raise ValueError(f"wrap must be two of {', '.join(texture.WRAPS)}, got {self.wrap}")

    def at(
        self, *coordinates: Float[Array, "*b 2"], slopes: tuple[Float[Array, "2 *b 2"], ...] | None = None
    ) -> Float[Array, "*b c"]:
        """Values of the image, given all sets of texture coordinates.

        Args:
            coordinates: Places in each set.
            slopes: Change of each from one pixel to the next, to the right and down: the image is then averaged over
                the pixels.
        """
        turn = self.transform[:, :2]
        moved = jnp.einsum("ij,...j->...i", turn, coordinates[self.set], precision="highest") + self.transform[:, 2]
        if slopes is None:
            return texture.lookup(self.image, moved, wrap=self.wrap)
        slope = jnp.einsum("ij,...j->...i", turn, slopes[self.set], precision="highest")
        return mipmap.lookup(self.mipmapped().mipmap, moved, slope, wrap=self.wrap)

    def mipmapped(self) -> "Texture":
        """The same with its mip map."""
        if self.mipmap is not None:
            return self
        return eqx.tree_at(lambda each: each.mipmap, self, mipmap.make(self.image), is_leaf=lambda each: each is None)


class Surface(eqx.Module):
    """Parameters of a material at points, in the local frame (tangent, bitangent, normal) of each.

    Attributes:
        base_color: Linear color: the albedo of a dielectric, the reflectance at normal incidence of a metal.
        metallic: 0 for a dielectric to 1 for a metal.
        roughness: Perceptual roughness; its square is the microfacet distribution's alpha.
        emissive: Radiance that the surface emits.
        ior: Index of refraction of the dielectric; 0 stands for a reflectance of 1 at normal incidence.
        specular: Weight of the dielectric's specular reflection.
        specular_color: Color of the dielectric's reflectance at normal incidence.
        anisotropy: Strength, from 0 to 1.
        direction: Unit vector (along tangent, along bitangent) in which highlights are stretched.
        normal: Unit normal of the normal map.
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

    Factors are leaves with the defaults of the specification: a white, rough metal. Gray factors may be numbers where
    colors are wanted. A texture that the material does not have is None. Parameters mean what `Surface` says.

    Attributes:
        base_color: Linear color, from 0 to 1.
        metallic: From 0 to 1.
        roughness: From 0 to 1.
        emissive: Radiance; KHR_materials_emissive_strength is multiplied in.
        ior: Index of refraction, at least 1, or 0; KHR_materials_ior.
        specular: From 0 to 1; KHR_materials_specular.
        specular_color: Linear color.
        anisotropy: Strength, from 0 to 1; KHR_materials_anisotropy.
        rotation: Angle of the anisotropy's direction from the tangent to the bitangent, in radians.
        normal_scale: Factor on the slopes of the normal map.
        base_color_texture: [h w 3].
        metallic_texture: [h w 1].
        roughness_texture: [h w 1].
        emissive_texture: [h w 3].
        specular_texture: [h w 1].
        specular_color_texture: [h w 3].
        anisotropy_texture: [h w 3]: direction in the first two channels, as (direction + 1) / 2, and strength.
        normal_texture: [h w 3]: (normal + 1) / 2 in the frame of tangent, bitangent and normal.

    Raises:
        TypeError: A texture is an array, not a `Texture`.
        ValueError: A factor is not finite or out of its range.

    Reference: Khronos glTF 2.0 specification, section 3.9 and appendix B; its extensions KHR_materials_ior,
    KHR_materials_specular, KHR_materials_anisotropy and KHR_materials_emissive_strength.
    """

    base_color: Float[Array, "3"] = eqx.field(converter=_color, default=1.0)
    metallic: Float[Array, ""] = eqx.field(converter=_scalar, default=1.0)
    roughness: Float[Array, ""] = eqx.field(converter=_scalar, default=1.0)
    emissive: Float[Array, "3"] = eqx.field(converter=_color, default=0.0)
    ior: Float[Array, ""] = eqx.field(converter=_scalar, default=1.5)
    specular: Float[Array, ""] = eqx.field(converter=_scalar, default=1.0)
    specular_color: Float[Array, "3"] = eqx.field(converter=_color, default=1.0)
    anisotropy: Float[Array, ""] = eqx.field(converter=_scalar, default=0.0)
    rotation: Float[Array, ""] = eqx.field(converter=_scalar, default=0.0)
    normal_scale: Float[Array, ""] = eqx.field(converter=_scalar, default=1.0)
    base_color_texture: Texture | None = None
    metallic_texture: Texture | None = None
    roughness_texture: Texture | None = None
    emissive_texture: Texture | None = None
    specular_texture: Texture | None = None
    specular_color_texture: Texture | None = None
    anisotropy_texture: Texture | None = None
    normal_texture: Texture | None = None

    def __check_init__(self):
        """Refuses factors that are not finite or out of their range."""
        for name in ("base_color", "metallic", "roughness", "specular", "anisotropy"):
            require.within(f"{name} of TexturedMaterial", getattr(self, name), 0, 1)
        for name in ("emissive", "specular_color", "ior"):
            require.at_least(f"{name} of TexturedMaterial", getattr(self, name), 0.0)
        for name in ("rotation", "normal_scale"):
            require.finite(f"{name} of TexturedMaterial", getattr(self, name))
        for name, value in vars(self).items():
            if name.endswith("_texture") and isinstance(value, np.ndarray | jax.Array):
                raise TypeError(f"{name} of TexturedMaterial must be a Texture: jaxprt.scene.Texture(image)")
        if not isinstance(self.ior, Tracer) and 0 < np.asarray(self.ior) < 1:
            raise ValueError(f"ior of TexturedMaterial must be 0 or at least 1, got {self.ior}")

    def mipmapped(self) -> "TexturedMaterial":
        """The same with mip maps of all its textures: what pictures would else make anew each time."""
        is_texture = lambda each: isinstance(each, Texture)  # noqa: E731
        return jax.tree.map(lambda each: each.mipmapped() if is_texture(each) else each, self, is_leaf=is_texture)

    @property
    def textures(self) -> tuple[Texture, ...]:
        """The textures that it has."""
        return tuple(each for each in vars(self).values() if isinstance(each, Texture))

    @jit
    def at(
        self,
        coordinate: Float[Array, "*b 2"],
        second: Float[Array, "*b 2"] | None = None,
        *,
        color: Float[Array, "*b 3"] | None = None,
        handedness: Float[Array, "*b"] | None = None,
        slopes: tuple[Float[Array, "2 *b 2"], ...] | None = None,
    ) -> Surface:
        """Parameters at points: vertices of a mesh, or points of a picture.

        Differentiable in the factors, the images and, within texels, the coordinates. Gradients are finite where a
        normal map or a direction of anisotropy is zero; the normal is then that of the surface, the direction the
        tangent.

        Args:
            coordinate: Texture coordinates, v up: `Mesh.texture`.
            second: Second texture coordinates, for textures that take these; the first ones where it is None.
            color: Colors that multiply the base color.
            handedness: 1 where the bitangent of the textures is cross(normal, tangent), and -1 where it is opposite;
                1 everywhere where it is None. Results are in the right-handed frame.
            slopes: Change of both coordinates from one pixel to the next, over which textures are then averaged: see
                `Texture.at`.

        Returns:
            The parameters.
        """
        places = (coordinate, coordinate if second is None else second)
        batch = coordinate.shape[:-1]

        def value(factor: Array, each: Texture | None) -> Array:
            wide = jnp.broadcast_to(factor, (*batch, *(factor.shape or (1,))))
            return wide if each is None else wide * each.at(*places, slopes=slopes)

        base = value(self.base_color, self.base_color_texture)
        anisotropy, direction = self._anisotropy(places, slopes)
        normal = self._normal(places, slopes)
        if handedness is not None:
            direction = direction * jnp.stack([jnp.ones_like(handedness), handedness], -1)
            normal = normal * jnp.stack([jnp.ones_like(handedness), handedness, jnp.ones_like(handedness)], -1)
        return Surface(
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

    def _anisotropy(self, places: tuple[Array, ...], slopes: tuple[Array, ...] | None) -> tuple[Array, Array]:
        """Strength and direction of the anisotropy."""
        batch = places[0].shape[:-1]
        cosine, sine = jnp.cos(self.rotation), jnp.sin(self.rotation)
        if self.anisotropy_texture is None:
            direction = jnp.stack([cosine, sine])
            return jnp.broadcast_to(self.anisotropy, batch), jnp.broadcast_to(direction, (*batch, 2))
        texel = self.anisotropy_texture.at(*places, slopes=slopes)
        x, y = jnp.moveaxis(_unit(2 * texel[..., :2] - 1), -1, 0)
        direction = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], -1)
        return self.anisotropy * texel[..., 2], direction

    def _normal(self, places: tuple[Array, ...], slopes: tuple[Array, ...] | None) -> Array:
        """Unit normals of the normal map."""
        if self.normal_texture is None:
            up = jnp.asarray([0, 0, 1], self.normal_scale.dtype)
            return jnp.broadcast_to(up, (*places[0].shape[:-1], 3))
        slope = 2 * self.normal_texture.at(*places, slopes=slopes) - 1
        # Last axis first, since the normal is what takes the place of zero.
        scaled = jnp.stack([slope[..., 2], slope[..., 0] * self.normal_scale, slope[..., 1] * self.normal_scale], -1)
        return jnp.roll(_unit(scaled), -1, -1)


def _unit(vector: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """Vectors at unit length; the first axis, with zero gradient, for those that are zero."""
    square = jnp.sum(vector**2, -1, keepdims=True)
    zero = square < jnp.finfo(vector.dtype).tiny
    first = jnp.zeros_like(vector).at[..., 0].set(1)
    safe = jnp.where(zero, first, vector)
    return safe / jnp.sqrt(jnp.sum(safe**2, -1, keepdims=True))
