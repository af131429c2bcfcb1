"""Scenes from glTF files: parts with their materials, and cameras."""

import math
import pathlib
import warnings
from typing import Any

import numpy as np

from jaxprt.scene.camera import Camera
from jaxprt.scene.formats import gltf_geometry
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.formats.gltf_file import Document, damage_named
from jaxprt.scene.formats.gltf_material import MaterialReader
from jaxprt.scene.scene import Scene

_HONORED = {
    *(f"KHR_materials_{name}" for name in ("ior", "specular", "anisotropy", "emissive_strength")),
    "KHR_texture_transform",
    "KHR_mesh_quantization",
}
_HEIGHT = 512  # height of cameras' pictures in pixels
_WIDEST = 64  # a larger aspect ratio is taken for damage


def read(path: pathlib.Path) -> Scene:
    """Reads the default scene of a glTF file, as `load_scene` documents."""
    with damage_named(path):
        document = Document(path)
        contents = gltf_geometry.read(document)
        reader = MaterialReader(document)
        materials = [reader.material(index) for index in contents.material]
        names = [_name(document, index) for index in contents.material]
        parts = split_parts(contents.geometry, names, materials, path)
        ignored = contents.ignored | reader.ignored | _declared(document)
        for index, material in zip(contents.material, materials, strict=True):
            if any((index, each.set) in contents.lacking for each in material.textures):
                ignored |= {"textures of primitives without texture coordinates"}
        used = contents.geometry.position
        cameras, skipped = _cameras(document, (used.min(0) + used.max(0)) / 2)
    ignored = (ignored | skipped) - _HONORED
    if ignored:
        warnings.warn(f"{path}: not supported and ignored are {', '.join(sorted(ignored))}", stacklevel=3)
    return Scene(parts, cameras)


def _name(document: Document, index: int | None) -> str:
    """The name of a material."""
    if index is None:
        return "default"
    return str(document.items("materials")[index].get("name") or f"material {index}")


def _declared(document: Document) -> set[str]:
    """Extensions and features that the file declares."""
    declared = {key for key in ("animations", "skins") if document.items(key)}
    for key in ("extensionsUsed", "extensionsRequired"):
        declared |= set(document.header.get(key, []))
    return declared


def _cameras(document: Document, center: np.ndarray) -> tuple[list[Camera], set[str]]:
    """The perspective cameras of all nodes, and the names of unsupported cameras."""
    found, skipped = [], set()
    for node, item, matrix in gltf_geometry.nodes(document):
        if "camera" not in item:
            continue
        camera: dict[str, Any] = document.item("cameras", item["camera"], f"node {node}")
        if camera["type"] == "perspective":
            found.append(_camera(document, camera["perspective"], f"camera {item['camera']}", matrix, center))
        else:
            skipped.add(f"{camera['type']} cameras")
    return found, skipped


def _camera(document: Document, item: dict[str, Any], owner: str, matrix: np.ndarray, center: np.ndarray) -> Camera:
    """A camera, transformed by its node. Its target is as far away as the center of the scene."""
    angle = document.numbers(item["yfov"], (), f"yfov of {owner}")
    aspect = document.numbers(item.get("aspectRatio", 1.0), (), f"aspectRatio of {owner}")
    if not 0 < angle < math.pi or not 0 < aspect < _WIDEST:
        required = f"must have yfov from 0 to pi and aspectRatio from 0 to {_WIDEST} in {owner}"
        raise document.error(required, f"{angle} and {aspect}")
    eye, back, up = matrix[:3, 3], matrix[:3, 2], matrix[:3, 1]
    length = np.linalg.norm(back)
    if not length > 0:
        raise document.error(f"must have invertible transforms for {owner}", "a scale of zero")
    target = eye - back / length * (np.linalg.norm(center - eye) or 1.0)
    eye, target, up, angle = (np.asarray(each, np.float32) for each in (eye, target, up, angle))
    return Camera(eye, target, up, angle, max(1, round(_HEIGHT * float(aspect))), _HEIGHT)
