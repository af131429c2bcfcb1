"""Materials of meshes without material files: colors of vertices, and images that PLY files name."""

import pathlib
from collections.abc import Sequence

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats.geometry import Geometry, MeshContent
from jaxprt.scene.formats.texture_images import TextureImages
from jaxprt.scene.material import Texture, TexturedMaterial

_GRAY = 0.5  # base color of surfaces without material and color


def matte(*, geometry: Geometry | None = None) -> TexturedMaterial:
    """The material of faces without one: a matte gray, or white where vertex colors multiply it."""
    white = geometry is not None and geometry.color is not None
    return TexturedMaterial(base_color=1.0 if white else _GRAY, metallic=0.0, specular=0.0)


def of_images(
    content: MeshContent, plain: TexturedMaterial, path: pathlib.Path, *, outside: bool
) -> tuple[list[TexturedMaterial], set[str]]:
    """The material of each region, and what cannot be read.

    Args:
        content: What the file holds.
        plain: The material of regions without an image.
        path: The file, in whose folder the images are.
        outside: Whether images outside of the folder are read.

    Raises:
        ValueError: An image is outside of the folder.
    """
    materials, ignored, pictures = [], set(content.ignored), TextureImages()
    for name in content.images:
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
