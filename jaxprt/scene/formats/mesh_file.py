"""Mesh files of all formats."""

import pathlib

import numpy as np

from jaxprt.files import inputs
from jaxprt.scene.formats import gltf_file, gltf_geometry, obj, off, ply, stl
from jaxprt.scene.formats.geometry import Geometry, MeshContent

SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb", ".gltf")
_READERS = {".ply": ply.read, ".stl": stl.read, ".off": off.read}


def check(path: pathlib.Path) -> None:
    """Refuses files of other formats and files that do not exist."""
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path} must end in one of {', '.join(SUFFIXES)}, got {path.suffix.lower()!r}")
    inputs.check(path, "a mesh file")


def read(path: pathlib.Path, *, groups: bool) -> Geometry:
    """Reads the triangles of a file in world coordinates, with regions. Only those of glTF files have colors."""
    check(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        with gltf_file.damage_named(path):
            return gltf_geometry.read(gltf_file.Document(path), groups=groups).geometry
    return content(path, groups=groups).geometry._replace(color=None)


def content(path: pathlib.Path, *, groups: bool) -> MeshContent:
    """Reads a PLY, OBJ, STL or OFF file with its colors and the names of its images."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return MeshContent(obj.read(path, groups=groups), [], set())
    read_content = _READERS[suffix](path)
    geometry = read_content.geometry
    region = np.zeros(len(geometry.position), int) if geometry.region is None else geometry.region
    return read_content._replace(geometry=geometry._replace(region=region))
