"""Loading of scenes from files of all supported formats."""

import pathlib
from collections.abc import Mapping
from typing import Any

from jaxprt import require
from jaxprt.scene.formats import gltf, mesh_file, mitsuba_dict, mtl
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.scene import Scene


def _path(value: Any) -> None:
    if not isinstance(value, Mapping):
        require.path("path", value)


@require.arguments(path=_path)
def load_scene(path: str | pathlib.Path | Mapping[str, Any]) -> Scene:
    """Loads a scene with its materials from a glTF, GLB, PLY, OBJ, STL or OFF file, or a dictionary of Mitsuba 3.

    Geometry is read like `load_mesh` reads it. Each material in use becomes one part, named after the material; equal
    names are numbered. Textures that materials share are stored only once.

    Of a glTF file, this reads metallic-roughness materials with textures, normal maps, vertex colors, two sets of
    texture coordinates, and perspective cameras, whose pictures are 512 pixels high. It supports the extensions
    KHR_materials_ior, _specular, _anisotropy and _emissive_strength, KHR_texture_transform and KHR_mesh_quantization. A
    single warning names all other features of the file (alpha modes, transmission, skins, animations, lights,
    orthographic cameras, and so on). Primitives without material get the default material of the specification, a white
    rough metal.

    Of an OBJ file, this reads the materials of its MTL files: Kd, Ks, Ns, Ke, map_Kd, map_Ke, norm, and the
    metallic-roughness statements Pr, Pm, map_Pr, map_Pm and Ni. `mtl.read` explains how Phong materials and those of
    Blender are converted. A single warning names missing MTL files, materials and images and unsupported statements.

    Files of other formats, and OBJ files without materials, become one matte gray part that is named after the file.

    A dictionary has the form of `mitsuba.load_dict`. Transforms are arrays [4 4] or objects with a `matrix`. Supported
    are the shapes obj, ply, rectangle, cube and sphere (the last three are finely subdivided); the BSDFs that
    `mitsuba_material` lists, nested or by `ref`, with bitmaps; area emitters; envmap and constant; and perspective
    sensors.

    Args:
        path: The file, or the dictionary.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: The file, or a file that it refers to, does not exist.
        ValueError: The file is of an unknown kind, damaged, or has no triangles; an image cannot be read; a factor is
            not finite or out of range; or a BSDF of a dictionary is not supported.
    """
    if isinstance(path, Mapping):
        return mitsuba_dict.read(path)
    path = pathlib.Path(path)
    if path.suffix.lower() in (".glb", ".gltf") and path.is_file():
        return gltf.read(path)
    geometry = mesh_file.read(path, groups=False)
    names, materials = [path.stem], [mtl.matte()]
    if path.suffix.lower() == ".obj":
        names, materials = mtl.of_regions(path)
        if names == ["default"]:
            names = [path.stem]
    return Scene(split_parts(geometry, names, materials, path))
