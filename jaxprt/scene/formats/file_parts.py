"""Parts of scenes from files: images of textures, materials of files that have none, and one mesh for each material."""

import functools
import pathlib
import warnings
from collections.abc import Callable, Collection, Hashable, Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from jaxprt import require
from jaxprt.files import images, inputs
from jaxprt.scene.formats.geometry import Geometry, MeshContent, rows_of
from jaxprt.scene.material import Texture, TexturedMaterial
from jaxprt.scene.mesh import Mesh, from_file, split
from jaxprt.scene.scene import Part, along_texture, unique_names

FLIP = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])  # converts between v up and v down
_GRAY = 0.5  # base color of surfaces without material and color


def warn_of_ignored(source: object, ignored: Collection[str], *, stacklevel: int) -> None:
    """Warns once of all that a file holds and that is not read, if there is anything.

    Args:
        source: The file.
        ignored: What is not read. Very long names are shortened.
        stacklevel: That of `warnings.warn`, from the caller.
    """
    if ignored:
        listed = ", ".join(sorted(map(inputs.shortened, ignored)))
        warnings.warn(f"{source}: not supported and ignored are {listed}", stacklevel=stacklevel + 1)


class ImageError(ValueError):
    """An image that cannot be decoded."""


class TextureImages:
    """Reads the images of a scene. What several textures share is stored only once; damaged images are tried once."""

    def __init__(self):
        self._damaged: dict[tuple[Hashable, bool], ImageError] = {}
        self._last: tuple[tuple[Hashable, bool] | None, np.ndarray] = None, np.zeros(0)  # for its other channels
        self._channels: dict[tuple[Hashable, bool, tuple[int, ...]], jax.Array] = {}

    def channels(
        self, key: Hashable, content: Callable[[], bytes], name: str, channels: tuple[int, ...], *, decoded: bool
    ) -> jax.Array:
        """Some channels of an image.

        Args:
            key: What images that are equal have in common.
            content: Reads the bytes of the image.
            name: Name of the image for messages.
            channels: Indices of the channels. Of gray images, each is the gray.
            decoded: Whether integers are decoded from sRGB.

        Raises:
            ImageError: The image cannot be decoded.
        """
        if (key, decoded) in self._damaged:
            raise self._damaged[key, decoded]
        if (key, decoded, channels) not in self._channels:
            if self._last[0] != (key, decoded):
                self._last = None, np.zeros(0)
                data = content()
                try:
                    self._last = (key, decoded), images.decode_image(data, name=name, decoded=decoded)
                except ValueError as error:
                    self._damaged[key, decoded] = ImageError(str(error))
                    raise self._damaged[key, decoded] from error
            self._channels[key, decoded, channels] = store_channels(self._last[1], channels, name)
        return self._channels[key, decoded, channels]

    def read(self, path: pathlib.Path, channels: tuple[int, ...], *, decoded: bool) -> jax.Array:
        """Some channels of an image file."""
        inputs.check(path, "an image file")
        content = functools.partial(inputs.content, path, "an image file")
        return self.channels(path.resolve(), content, str(path), channels, decoded=decoded)


def store_channels(image: np.ndarray, channels: tuple[int, ...], name: str) -> jax.Array:
    """Some channels of a decoded image, on the device. They are copied only where the image has others too.

    Args:
        image: Pixels with 1 (gray), 2 (gray, alpha), 3 or 4 channels.
        channels: Numbers of the channels: 0 to 2 for colors, which are equal in gray images, or 3 alone for alpha,
            which is 1 in images without it.
        name: Name of the image in error messages.
    """
    height, width, count = image.shape
    whole = channels == tuple(range(count))
    require.memory(
        f"{name}: {len(channels)} channels of {width} x {height} pixels (width x height)",
        (2 if whole else 3) * 4 * height * width * len(channels),  # one of these is for the check of the texture
        "free some memory, or reduce the size of the image in another program first",
    )
    if whole:
        return jax.device_put(image)
    if channels == (3,) and count % 2:
        return jax.device_put(np.ones((height, width, 1), image.dtype))
    place = (0, 0, 0, 1) if count < 3 else (0, 1, 2, 3)
    return jax.device_put(np.take(image, [place[channel] for channel in channels], -1))


def matte(*, geometry: Geometry | None = None) -> TexturedMaterial:
    """The material of faces without one: a matte gray, or white where vertex colors multiply it."""
    white = geometry is not None and geometry.color is not None
    return TexturedMaterial(base_color=1.0 if white else _GRAY, metallic=0.0, specular=0.0)


def materials_of_images(
    content: MeshContent, plain: TexturedMaterial, path: pathlib.Path, *, outside: bool
) -> tuple[list[TexturedMaterial], set[str]]:
    """The material of each region, and what cannot be read.

    Args:
        content: What the file holds.
        plain: The material of regions without an image.
        path: The file, in whose folder the images are.
        outside: Whether images outside of the folder are read.
    """
    materials, ignored, pictures = [], set(content.ignored), TextureImages()
    for name in content.names:
        material = plain
        if name is not None:
            owner = f"{path}, TextureFile"
            file = inputs.reference(name, path.parent, folder=path.parent, owner=owner, outside=outside)
            try:
                image = pictures.read(file, (0, 1, 2), decoded=True)
                texture = Texture(image, np.eye(2, 3, dtype=np.float32))
                material = TexturedMaterial(base_color=1.0, metallic=0.0, specular=0.0, base_color_texture=texture)
            except FileNotFoundError:
                ignored.add(f"TextureFile ({file}, which does not exist)")
            except ValueError as error:
                ignored.add(f"TextureFile ({error})")
        materials.append(material)
    return materials, ignored


def with_base_color(geometry: Geometry, materials: Sequence[TexturedMaterial], plain: TexturedMaterial) -> Geometry:
    """The geometry with a color for each vertex, if it has colors at all.

    Vertices without color are gray where their region has no material, and have the color of the material elsewhere.
    Where the base color is an image, vertex colors are left out: scanners write the colors of the image to both.

    Args:
        geometry: The geometry, with colors that are NaN where vertices have none.
        materials: Material of each region.
        plain: The material of regions that have none.
    """
    if geometry.color is None:
        return geometry
    region = np.zeros(len(geometry.position), int) if geometry.region is None else geometry.region
    missing = np.array([_GRAY if material is plain else 1.0 for material in materials])[region]
    textured = np.array([material.base_color_texture is not None for material in materials])[region]
    color = np.where(np.isfinite(geometry.color), geometry.color, missing[:, None])
    return geometry._replace(color=np.where(textured[:, None], 1, color))


def split_parts(
    geometry: Geometry, names: Sequence[str], materials: Sequence[TexturedMaterial], path: pathlib.Path
) -> list[Part]:
    """Splits the geometry of a file into parts.

    If a material needs tangents and the file has none, they point along the texture coordinate u. Missing texture
    coordinates are 0.

    Args:
        geometry: The whole geometry. Region i becomes part i.
        names: Names of the regions. Equal names are numbered.
        materials: Materials of the regions.
        path: The file.
    """
    meshes = split(from_file(geometry, path))
    if len(meshes) != len(names):
        raise ValueError(f"{path} must have {len(names)} materials, got {len(meshes)}")
    region = np.zeros(len(geometry.position), int) if geometry.region is None else geometry.region
    vertices = rows_of(region, np.arange(len(names)))
    return [
        _part(name, mesh, material, geometry, vertex)
        for name, mesh, material, vertex in zip(unique_names(names), meshes, materials, vertices, strict=True)
    ]


def _part(name: str, mesh: Mesh, material: TexturedMaterial, geometry: Geometry, vertex: np.ndarray) -> Part:
    """A part of some vertices of a file's geometry."""

    def rows(value: np.ndarray | None, plain: int) -> np.ndarray | None:
        """The part's rows of a vertex attribute; None if all have the default value."""
        return None if value is None or (value[vertex] == plain).all() else value[vertex]

    second, side = rows(geometry.second, 0), rows(geometry.handedness, 1)
    sets = {source.set for source in material.textures}
    if 1 in sets and second is None:
        second = np.zeros((len(mesh.position), 2))
    if 0 in sets and mesh.texture is None:
        zero = _array(np.zeros((len(mesh.position), 2)))
        mesh = eqx.tree_at(lambda m: m.texture, mesh, zero, is_leaf=lambda m: m is None)
    source = material.oriented
    place = second if source is not None and source.set else mesh.texture
    if place is not None and (source is not None or material.anisotropy > 0):
        stated = np.zeros(len(place), bool) if geometry.tangent is None else (geometry.tangent[vertex] != 0).any(axis=1)
        mesh, side = along_texture(mesh, place, stated=stated, side=side)
    alpha = None if material.alpha_mode == "opaque" else rows(geometry.alpha, 1)
    return Part(name, mesh, material, _array(rows(geometry.color, 1)), _array(second), _array(side), _array(alpha))


def _array(value: np.ndarray | Array | None) -> Array | None:
    """An array on the device, in the precision of meshes."""
    return None if value is None else jax.device_put(np.asarray(value, np.float32))
