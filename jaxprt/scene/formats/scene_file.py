"""Scenes in files of all formats."""

import pathlib
from collections.abc import Mapping
from typing import Any

from jaxprt.scene.formats import gltf, mesh_file, mitsuba_dict, mtl
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.scene import Scene


def load_scene(path: str | pathlib.Path | Mapping[str, Any]) -> Scene:
    """Loads a scene with its materials: a glTF, GLB, PLY, OBJ, STL or OFF file, or a dictionary of Mitsuba 3.

    Geometry is read as by `load_mesh`. There is one part for each material that is used, named after it; equal names
    are numbered. Textures repeat what several materials share only once.

    A glTF file has metallic-roughness materials with textures, normal maps, vertex colors, two sets of texture
    coordinates, and perspective cameras in their nodes' places, with pictures 512 pixels high. The extensions
    KHR_materials_ior, _specular, _anisotropy and _emissive_strength, KHR_texture_transform and KHR_mesh_quantization
    are honored. What else the file has (alpha modes, transmission, skins, animations, lights, orthographic cameras,
    and so on) is named in one warning. Primitives without material have the default one of the specification, a white
    rough metal.

    An OBJ file has the materials of its MTL files: Kd, Ks, Ns, Ke, map_Kd, map_Ke, norm, and of the metallic-roughness
    statements Pr, Pm, map_Pr, map_Pm and Ni; see `mtl.read` for how Phong's, and those of Blender, become
    metallic-roughness ones. MTL files, materials and images that are missing are named in one warning, together with
    what is not honored. Other files have no materials: one matte gray part, named after the file, as of an OBJ file
    that names none.

    A dictionary is as for `mitsuba.load_dict`, with arrays [4 4] or objects that have a `matrix` as transforms. It has
    the shapes obj, ply, rectangle, cube and sphere, the last three divided finely; the BSDFs that `mitsuba_material`
    names, nested or by `ref`, with bitmaps; area emitters; envmap and constant; and perspective sensors.

    Args:
        path: The file, or the dictionary.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: There is no such file, or it needs another one that does not exist.
        ValueError: The file is of no known kind, damaged, or has no triangles; an image is no picture; a factor is
            not finite or out of its range; a BSDF of a dictionary has no equal here.
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
