"""Export of binary glTF with baked lighting: vertex colors hold the radiance for one light and one view."""

import json
import os
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.files import outputs
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment, Mesh
from jaxprt.view.stages import counterclockwise

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT = 5126, 5125
_ARRAY, _ELEMENT = 34962, 34963


def export_baked(
    scene: RelitScene,
    path: str | os.PathLike,
    environment: Environment,
    *,
    eye: Float[Array | np.ndarray, "3"] | None = None,
    materials: Mapping[str, Any] | None = None,
) -> float:
    """Writes a scene as binary glTF with baked lighting: radiance under one light towards one eye position.

    Each part becomes a mesh with radiance in COLOR_0 and an unlit material (KHR_materials_unlit). From other eye
    positions the file shows the same radiance. Colors in glTF are linear and at most 1, so all are divided by the
    largest radiance, which is stored as `exposure` in `extras`. Negative radiance becomes 0. Names in the file state
    that it is baked.

    Args:
        scene: The result of `jaxprt.precompute`.
        path: The file, `*.glb`.
        environment: The light.
        eye: Position of the viewer in world units; that of the scene's camera if None.
        materials: Dictionary from names of parts to materials that replace their own.

    Returns:
        The factor by which the colors in the file must be multiplied to give radiance.

    Raises:
        TypeError: `scene` is not a relit scene, or `environment` is not an `Environment`.
        ValueError: The suffix of the file is not .glb, or `RelitScene.radiance` refuses the light, eye or materials.
        OSError: The file cannot be written, found before the radiance is computed where possible.

    Reference: Khronos, glTF 2.0 specification, sections 3.7.2 and 4.4; KHR_materials_unlit.
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    require.kind("the light", environment, Environment, source="jaxprt.load_environment")
    path = outputs.target(path, ".glb")
    eye = scene.camera.eye if eye is None else eye
    color = np.asarray(scene.radiance(environment, eye=eye, materials=materials), np.float32)
    if color.ndim != 2:
        raise ValueError(f"the light must be one environment, got a batch of {len(color)}")
    color = np.maximum(np.broadcast_to(color, (len(color), 3)), 0)
    exposure = max(float(color.max(initial=0)), 1e-30)
    outputs.write(path, _file(scene, color / np.float32(exposure), np.asarray(eye, float).tolist(), exposure))
    return exposure


def _file(scene: RelitScene, color: Float[np.ndarray, "v 3"], eye: list[float], exposure: float) -> bytes:
    views, accessors, meshes, nodes, data = [], [], [], [], b""

    def add(array: np.ndarray, kind: str, component: int, target: int, **more: Any) -> int:
        nonlocal data
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes, "target": target})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": component, "count": len(array), "type": kind, **more}
        )
        data += array.tobytes()
        return len(accessors) - 1

    first = 0
    for part in scene.scene.parts:
        mesh: Mesh = part.mesh
        part_color = color[first : first + len(mesh.position)]
        first += len(part_color)
        position = np.asarray(mesh.position, "<f4")
        span = {"min": position.min(0).tolist(), "max": position.max(0).tolist()}
        primitive = {
            "attributes": {
                "POSITION": add(position, "VEC3", _FLOAT, _ARRAY, **span),
                "COLOR_0": add(np.clip(part_color, 0, 1).astype("<f4"), "VEC3", _FLOAT, _ARRAY),
            },
            "indices": add(counterclockwise(mesh).reshape(-1), "SCALAR", _UINT, _ELEMENT),
            "material": 0,
        }
        name = f"{part.name}, baked for one light and one view"
        meshes.append({"name": name, "primitives": [primitive]})
        place = {"translation": list(mesh.origin)} if any(mesh.origin) else {}
        nodes.append({"name": name, "mesh": len(meshes) - 1, **place})
    unlit = {"baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0}
    head = {
        "asset": {"version": "2.0", "generator": "jaxprt", "extras": {"baked": True, "eye": eye, "exposure": exposure}},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"name": "baked for one light and one view", "nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": meshes,
        "materials": [{"name": "baked", "pbrMetallicRoughness": unlit, "extensions": {"KHR_materials_unlit": {}}}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    text = json.dumps(head, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + len(data)
    return b"".join(
        [
            struct.pack("<III", _MAGIC, 2, size),
            struct.pack("<II", len(text), _JSON),
            text,
            struct.pack("<II", len(data), _BIN),
            data,
        ]
    )
