"""Animations of precomputed scenes: the light turns, the camera swings, and materials change."""

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tqdm

from jaxprt import files, image
from jaxprt.brdf import BlinnPhong, CookTorrance
from jaxprt.cli.report import View
from jaxprt.relit import RelitScene
from jaxprt.relit.channels import Changeable, Shading, roughness_range
from jaxprt.scene import Camera
from jaxprt.scene.environment import rotate
from jaxprt.systems import standard
from jaxprt.view.stages import about

ROUGHNESS = (0.05, 0.5)  # between which materials move: smooth ones become rougher, and rough ones smoother
_MIDDLE = 0.25  # roughness from which on a material is rough
_ORBIT = np.radians(40)  # angle by which the camera moves in an animation


def animate(scene: RelitScene, view: View, folder: Path, *, frames: int, progress: bool = True) -> list[Path]:
    """Writes pictures in which the first light rotates once, the camera swings, and materials change.

    Returns:
        The files, one for each frame.
    """
    light, result, stops = next(iter(view.lights.values())), [], view.stops
    folder.mkdir(parents=True, exist_ok=True)
    for number in tqdm.trange(frames, desc="animate", unit="frame", disable=not progress):
        turn = number / frames
        camera = _swung(view.camera, _ORBIT * np.sin(2 * np.pi * turn))
        picture = scene.picture(rotate(light, about(2 * np.pi * turn)), camera, materials=materials(scene, turn=turn))
        if stops is None:
            stops = scene.exposure(picture, camera)
        result.append(folder / f"frame_{number:04d}.png")
        files.write_png(result[-1], np.asarray(image.display(picture, tone=view.tone, stops=stops)))
    return result


def materials(scene: RelitScene, *, turn: float) -> dict[str, Any]:
    """Materials of the parts that can change. As `turn` goes from 0 to 1, they cycle through roughnesses and colors."""
    parts = enumerate(zip(scene.scene.parts, scene.shading, strict=True))
    away = float(np.sin(np.pi * turn) ** 2)
    return {
        part.name: _moved(part.material, shading, number / 3, away)
        for number, (part, shading) in parts
        if shading.blend is not None and isinstance(part.material, Changeable)
    }


def _moved(material: Changeable, shading: Shading, hue: float, away: float) -> Changeable:
    """A material with another roughness and color; `away` is 0 for its own and 1 for the farthest."""
    rainbow = 1 + away * np.cos(2 * np.pi * (hue + np.arange(3) / 3))
    tint = jnp.asarray(rainbow / rainbow.max(), jnp.result_type(float))
    if isinstance(material, BlinnPhong):
        low = (2 / (standard.BLINN_PHONG.most_exponent + 2)) ** 0.5
        slope = _away(float(2 / (material.exponent + 2)) ** 0.5, away, low, 1.0)
        return dataclasses.replace(material, diffuse=material.diffuse * tint, exponent=jnp.asarray(2 / slope**2 - 2))
    if isinstance(material, CookTorrance):
        changed, limits = {"diffuse": material.diffuse * tint}, np.exp(standard.COOK_TORRANCE.range)
    else:
        changed = {"base_color": material.base_color * tint}
        limits = None if shading.matte else roughness_range(shading)
    if limits is not None:
        changed["roughness"] = jnp.asarray(_away(float(material.roughness), away, *limits))
    return dataclasses.replace(material, **changed)


def _away(roughness: float, away: float, low: float, high: float) -> float:
    """A roughness on its way to the other end of the range of animations."""
    if roughness <= 0:
        return roughness
    moved = roughness ** (1 - away) * ROUGHNESS[roughness < _MIDDLE] ** away
    return float(np.clip(moved, low, high))


def _swung(camera: Camera, angle: float) -> Camera:
    """A camera that is rotated around its target, about the vertical."""
    offset = jnp.matmul(about(angle), camera.eye - camera.target, precision="highest")
    return dataclasses.replace(camera, eye=camera.target + offset)
