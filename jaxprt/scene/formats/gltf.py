"""Scenes from glTF files: parts with their materials, cameras, and lights."""

import math
import pathlib
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxprt.scene.camera import Camera
from jaxprt.scene.formats import gltf_animation, gltf_geometry, gltf_lights, gltf_nodes
from jaxprt.scene.formats.file_parts import split_parts
from jaxprt.scene.formats.gltf_extensions import HONORED, check_required, unread
from jaxprt.scene.formats.gltf_file import Document, damage_named
from jaxprt.scene.formats.gltf_header import excerpt
from jaxprt.scene.formats.gltf_material import MaterialReader
from jaxprt.scene.formats.gltf_nodes import Node
from jaxprt.scene.scene import Scene

_HEIGHT = 512  # height of cameras' pictures in pixels
_WIDEST = 64  # a larger aspect ratio is taken for damage


def read(
    path: pathlib.Path,
    *,
    outside: bool = False,
    time: float | None = None,
    animation: str | int | None = None,
    lights: float = 1.0,
) -> Scene:
    """Reads the default scene of a glTF file, as `load_scene` documents."""
    with damage_named(path):
        document = Document(path, outside=outside)
        check_required(document, geometry=False)
        ignored = set() if time is None else gltf_animation.pose(document, time, animation)
        nodes = gltf_nodes.nodes(document)
        contents = gltf_geometry.read(document, scene=nodes)
        reader = MaterialReader(document)
        materials = [reader.material(index) for index in contents.material]
        names = [_name(document, index) for index in contents.material]
        parts = split_parts(contents.geometry, names, materials, path)
        ignored |= contents.ignored | reader.ignored | unread(document)
        for index, material in zip(contents.material, materials, strict=True):
            if any((index, texture.set) in contents.lacking for texture in material.textures):
                ignored |= {"textures of primitives without texture coordinates"}
        used = contents.geometry.position
        cameras, skipped = _cameras(document, nodes, (used.min(0) + used.max(0)) / 2)
        point_lights, suns, unread_lights = gltf_lights.lights(document, nodes, [part.name for part in parts], lights)
    ignored = (ignored | skipped | unread_lights) - HONORED
    if ignored:
        warnings.warn(f"{path}: not supported and ignored are {', '.join(sorted(ignored))}", stacklevel=3)
    if suns:
        advice = "jaxprt.scene.with_suns(light, scene.suns) adds them to an environment"
        warnings.warn(f"{path}: its directional lights ({len(suns)}) are in scene.suns: {advice}", stacklevel=3)
    return Scene(parts, cameras, point_lights=point_lights, suns=suns)


def _name(document: Document, index: int | None) -> str:
    """The name of a material, as text that can be written to files."""
    if index is None:
        return "default"
    name = document.items("materials")[index].get("name")
    return str(name).encode(errors="replace").decode() if name else f"material {index}"


def _cameras(document: Document, nodes: Sequence[Node], center: np.ndarray) -> tuple[list[Camera], set[str]]:
    """The perspective cameras of all nodes, and the names of unsupported cameras."""
    cameras, skipped = [], set()
    for node in nodes:
        if "camera" not in node.item:
            continue
        index = document.index("cameras", node.item["camera"], f"node {node.number}")
        item, owner = document.items("cameras")[index], f"camera {index}"
        kind = document.string(item, "type", owner)
        if kind == "perspective":
            perspective = document.object(item, "perspective", owner)
            cameras.append(_camera(document, perspective, owner, node.matrix, center))
        else:
            skipped.add(f"{kind} cameras" if kind == "orthographic" else f"cameras of type {excerpt(kind)}")
    return cameras, skipped


def _camera(document: Document, item: dict[str, Any], owner: str, matrix: np.ndarray, center: np.ndarray) -> Camera:
    """A camera, transformed by its node. Its target is as far away as the center of the scene."""
    angle = document.numbers(item.get("yfov"), (), f"yfov of {owner}")
    aspect = document.numbers(item.get("aspectRatio", 1.0), (), f"aspectRatio of {owner}")
    if not 0 < angle < math.pi or not 0 < aspect < _WIDEST:
        required = f"must have yfov from 0 to pi and aspectRatio from 0 to {_WIDEST} in {owner}"
        raise document.error(required, f"{angle} and {aspect}")
    eye, back, up = matrix[:3, 3], matrix[:3, 2], matrix[:3, 1]
    length = np.linalg.norm(back)
    if not length > 0:
        raise document.error(f"must have invertible transforms for {owner}", "a scale of zero")
    target = eye - back / length * (np.linalg.norm(center - eye) or 1.0)
    with np.errstate(over="ignore"):  # cameras refuse what is not finite
        up, angle = (np.asarray(value, np.float32) for value in (up, angle))  # eye and target keep their digits
    return Camera(eye, target, up, angle, max(1, round(_HEIGHT * float(aspect))), _HEIGHT)
