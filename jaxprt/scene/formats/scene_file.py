"""Loading of meshes and scenes from files of all supported formats."""

import pathlib
from collections.abc import Mapping
from functools import partial
from typing import Any

from jaxprt import require
from jaxprt.scene.formats import file_parts, gltf, mesh_file, mitsuba_dict, obj
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.mesh import Mesh, from_file
from jaxprt.scene.scene import Scene


@require.arguments(path=partial(require.path, "path"))
def load_mesh(path: str | pathlib.Path, *, groups: bool = False) -> Mesh:
    """Loads a mesh from a PLY, OBJ, STL, OFF, GLB or glTF file. `load_scene` also reads materials and images.

    Positions are read in double precision. If the mesh is far from zero, they become relative to `Mesh.origin` before
    they are rounded to float32. Vertices and faces keep the order of the file, and no vertices are merged. Polygons are
    divided into triangles of the same orientation: convex ones into fans, concave ones by ear clipping. A vertex is
    split where its corners differ in what the file states for corners or faces: normals or texture coordinates. All
    meshes of a glTF file's default scene are transformed by their nodes and joined, and its tangents are kept. Its
    buffers must be in its folder; `load_scene` can read others. Texture coordinates are 0 where only some faces of the
    file have them or they are not finite. OBJ faces that refer to texture coordinates or normals that do not exist are
    loaded without them, with a warning. Triangle strips of PLY files become triangles.

    Normals come from the file. Where they are absent, zero or NaN, they are means of the adjacent face normals,
    weighted by angle. Vertices split at a seam share such a mean unless they form a crease of more than about 80
    degrees. STL files have no shared vertices, so their vertices get the flat normals of their faces. So do primitives
    of glTF files without normals, whose triangles get vertices of their own, as the specification says.

    Args:
        path: The file.
        groups: Whether regions are the objects and groups of an OBJ file or the nodes of a glTF file, instead of
            materials.

    Returns:
        The mesh. The regions of an OBJ file are numbered by first appearance, and so are those of a PLY file, which are
        its images. Those of a glTF file are in the order of its materials, with parts without material last, or with
        `groups` in the order of its nodes.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file is of an unknown kind, damaged or empty, has positions that are not finite, faces that
            refer to missing vertices, or only faces without area. An OBJ file truncated between two faces
            cannot be detected.
    """
    path = pathlib.Path(path)
    return from_file(mesh_file.read(path, groups=groups), path)


def _path(value: object) -> None:
    if not isinstance(value, Mapping):
        require.path("path", value)


def _time(value: Any) -> float | None:
    if value is None:
        return None
    require.number("time", value, 0.0)
    return float(value)


def _animation(value: object) -> None:
    if value is not None and not isinstance(value, str):
        require.count("animation", value)


def _scale(value: Any) -> float:
    require.number("lights", value, 0.0)
    return float(value)


@require.arguments(path=_path, time=_time, animation=_animation, lights=_scale)
def load_scene(
    path: str | pathlib.Path | Mapping[str, Any],
    *,
    outside: bool = False,
    time: float | None = None,
    animation: str | int | None = None,
    lights: float = 1.0,
) -> Scene:
    """Loads a scene with its materials from a glTF, GLB, PLY, OBJ, STL or OFF file, or a dictionary of Mitsuba 3.

    Geometry is read like `load_mesh` reads it. Each material in use becomes one part, named after the material; equal
    names are numbered. Textures that materials share are stored only once.

    From a glTF file, this reads metallic-roughness materials with textures, normal maps, vertex colors, two sets of
    texture coordinates, alpha, double-sided materials, skins, morph targets, and perspective cameras, whose pictures
    are 512 pixels high. It supports the extensions KHR_materials_ior, _specular, _anisotropy, _emissive_strength,
    _clearcoat, _sheen and _transmission (thin glass), KHR_texture_transform, KHR_mesh_quantization and
    EXT_mesh_gpu_instancing. Point lights and spots of KHR_lights_punctual become point lights of the scene. Its
    directional lights become suns, which `jaxprt.scene.with_suns` adds to an environment. Triangles without normals are
    flat. Compressed geometry and textures (Draco, meshoptimizer, KTX 2) are decoded by the packages of `jaxprt[web]`
    where they have no uncompressed fallback. A file that requires another extension is refused, unless it is one of
    materials. A single warning names all other features of the file (iridescence, orthographic cameras, images that
    cannot be read, and so on). Primitives without material get the default material of the specification, a white rough
    metal.

    From an OBJ file, this reads the materials of its MTL files: Kd, Ks, Ns, Ke, d, Tr, map_Kd, map_Ke, map_d, norm,
    bumps that are normal maps, the metallic-roughness statements Pr, Pm, map_Pr, map_Pm and Ni, and Pc, Pcr and Ps.
    `obj.read_mtl` explains how Phong materials and those of Blender are converted. A single warning names missing MTL
    files, materials and images, and what is not read.

    Files of other formats, and OBJ files without materials, become one matte gray part that is named after the file.
    Colors of vertices or faces (PLY, OBJ, OFF) replace the gray, and multiply the base color of materials. They are
    decoded from sRGB, integers and floats alike. Images that a PLY file names in `comment TextureFile` become the base
    color, with the texture coordinates of its vertices or faces (MeshLab's wedges), and one part for each. Vertex
    colors are left out where the base color is an image. A single warning names what cannot be read.

    A dictionary has the form of `mitsuba.load_dict`. Transforms are arrays [4 4] or objects with a `matrix`. Supported
    are the shapes obj, ply, rectangle, cube and sphere (the last three are finely subdivided); the BSDFs that
    `mitsuba_dict` lists, nested or by `ref`, with bitmaps; area emitters; envmap and constant; and perspective
    sensors.

    A scene file from a stranger must not read other files of the user. What it refers to (buffers, images, MTL files)
    must therefore be regular files in its folder or in folders below, after links are resolved. File names in a
    dictionary are not restricted, because the caller writes the dictionary. If no file has a name, one whose name
    differs from it only in the case of letters or in its Unicode form is read.

    Args:
        path: The file, or the dictionary.
        outside: Whether the file may refer to files outside of its folder. Use it only for scenes that you trust.
        time: Time in seconds from the start of an animation of a glTF file: nodes, cameras, joints and weights of morph
            targets are where the animation has them then. Times beyond its end show the end. With None they are where
            the file's nodes have them, which is what other viewers show before they play an animation.
        animation: Name or index of the animation; None for the first one.
        lights: Factor on the lights of a glTF file (KHR_lights_punctual). One candela is taken as an intensity of 1 and
            one lux as an irradiance of 1, as three.js takes them. Blender writes watts times 683 lm/W, so `1 / 683`
            gives its watts back. With 0 they are left out.

    Returns:
        The scene.

    Raises:
        FileNotFoundError: The file, or a buffer of a glTF file, does not exist. Images that do not are warned of.
        ImportError: The file is compressed, and a package of `jaxprt[web]` is missing.
        ValueError: The file is of an unknown kind, damaged, or has no triangles with an area; it refers to a file
            outside of its folder, or requires an unknown extension; a factor is not finite or out of range; or a BSDF
            of a dictionary is not supported.
        MemoryError: The scene does not fit into memory.
    """
    if not isinstance(outside, bool):
        raise TypeError(f"outside must be True or False, got {require.shown(outside)}")
    if animation is not None and time is None:
        raise ValueError(f"time must be a number of seconds where an animation is given, got None for {animation!r}")
    if isinstance(path, Mapping):
        if time is not None:
            raise ValueError(f"the scene must be a glTF file where a time is given, got a dictionary and {time:g} s")
        return mitsuba_dict.read(path)
    path = pathlib.Path(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        return gltf.read(path, outside=outside, time=time, animation=animation, lights=lights)
    if time is not None:
        raise ValueError(f"{path} must be a glTF file where a time is given, got {path.suffix.lower()!r}")
    mesh_file.check(path)
    content = mesh_file.content(path, groups=False)
    plain = file_parts.matte(geometry=content.geometry)
    if path.suffix.lower() == ".obj":
        materials, ignored = obj.materials_of_regions(path, content, plain, outside=outside)
        names = [name or "default" for name in content.names]
        names = [path.stem] if names == ["default"] else names
    else:
        materials, ignored = file_parts.materials_of_images(content, plain, path, outside=outside)
        names = [path.stem] * len(materials)
    file_parts.warn_of_ignored(path, ignored, stacklevel=2)
    return Scene(split_parts(file_parts.with_base_color(content.geometry, materials, plain), names, materials, path))
