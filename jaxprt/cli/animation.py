"""Relights a scene whose materials change, by the dynamic system, and draws light, view and materials in motion."""

import itertools
import timeit
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array

from jaxprt import brdf, files, image, scene
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.navigation import Family
from jaxprt.cli.report import Relit, Scene
from jaxprt.scene import Camera, Environment
from jaxprt.systems import bounces as bounces_system
from jaxprt.systems import dynamic, separable
from jaxprt.systems.dynamic import DynamicBrdf, Material
from jaxprt.systems.separable import SeparableBrdf

LOBES = 4
ROUGHNESS = (0.05, 0.12, 0.25, 0.5)  # of the set, beside those of the scene
_ORBIT = np.radians(40)  # what the camera goes around in an animation
_TEXELS = 16


class Ready(NamedTuple):
    """A scene made ready for the dynamic system.

    Attributes:
        direct: Transport of direct light.
        tensor: Of reflected light; None without bounces.
        brdfs: Of each region.
        family: The set that adjustable regions share.
        told: What it took.
    """

    direct: dynamic.DynamicTransport
    tensor: bounces_system.TransferTensor | None
    brdfs: list[DynamicBrdf | SeparableBrdf]
    family: Family
    told: dict[str, Any]

    def radiance(self, materials: Sequence[Material | None], light: Environment, *, eye: Array) -> Array:
        """Radiance of every vertex."""
        if self.tensor is None:
            return dynamic.radiance(self.direct, self.brdfs, materials, light, eye=eye, texels=_TEXELS)
        arguments = (self.direct, self.tensor, self.brdfs, materials, light)
        return bounces_system.radiance(*arguments, eye=eye, texels=_TEXELS)


def prepare(whole: Scene, output: Path, *, bounces: int) -> Ready:
    """Makes a scene ready: parts of Cook-Torrance's model can change, all others have their BRDF for good.

    Raises:
        ValueError: No part has Cook-Torrance's model.
    """
    changing = [part.brdf for part in whole.parts if isinstance(part.brdf, CookTorrance)]
    if not changing:
        raise ValueError("the dynamic system needs a part that can change: give --brdf cook-torrance or --material")
    start = timeit.default_timer()
    rough = sorted({*ROUGHNESS, *(float(each.roughness) for each in changing)})
    # The model is linear in F0, so that two values of it are enough.
    family = brdf.navigation.cook_torrance(point=np.array(list(itertools.product((0.0, 1.0), rough))))
    members = dynamic.factor(family.brdf, dynamic.separate(family.brdf, lobes=LOBES))
    fixed = {
        number: separable.factor(part.brdf, terms=1 if isinstance(part.brdf, Lambert) else part.terms)
        for number, part in enumerate(whole.parts)
        if not isinstance(part.brdf, CookTorrance)
    }
    count = range(len(whole.parts))
    told: dict[str, Any] = {"fit_seconds": timeit.default_timer() - start}
    start, mesh, store = timeit.default_timer(), whole.mesh, output / "dynamic"
    brdfs = [fixed.get(number, members) for number in count]
    direct = dynamic.precompute(mesh, brdfs, path=store / "direct")
    told |= {"transport_seconds": timeit.default_timer() - start, "transport_bytes": direct.nbytes}
    tensor = None
    if bounces:
        start = timeit.default_timer()
        bases = bounces_system.factor(family.brdf)
        paths = [fixed.get(number, bases) for number in count]
        tensor = bounces_system.precompute(mesh, paths, bounces=bounces, path=store / f"bounces_{bounces}")
        told |= {"bounces_seconds": timeit.default_timer() - start, "bounces_bytes": tensor.nbytes}
        told |= {"bounces_worth": np.asarray(tensor.worth).tolist()}
    return Ready(direct, tensor, brdfs, family, told)


def materials(ready: Ready, whole: Scene, *, turn: float = 0.0) -> list[Material | None]:
    """Materials of a scene; as the turn goes from 0 to 1 they go through roughnesses and colors, and back."""
    result: list[Material | None] = []
    for number, part in enumerate(whole.parts):
        if not isinstance(part.brdf, CookTorrance):
            result.append(None)
            continue
        away = np.sin(np.pi * turn) ** 2
        m, f0 = float(part.brdf.roughness), jnp.mean(part.brdf.f0)
        rough = m ** (1 - away) * ROUGHNESS[-1 if m < ROUGHNESS[2] else 0] ** away
        share = ready.family.navigation.share(jnp.stack([f0, jnp.asarray(rough, f0.dtype)]))
        hue = 1 + away * np.cos(2 * np.pi * (number / 3 + np.arange(3) / 3))
        tint = jnp.asarray(hue / hue.max(), f0.dtype)
        result.append(Material(share, part.brdf.diffuse * tint, part.brdf.specular))
    return result


def relit(ready: Ready, whole: Scene) -> Relit:
    """The scene as the report takes it."""
    now, eye, direct, tensor = materials(ready, whole), whole.camera.eye, ready.direct, ready.tensor

    def light_side(light):
        lit = dynamic.light_side(direct, light, texels=_TEXELS)
        if tensor is None:
            return [(lit, None)]
        return [(lit, bounces_system.arriving(direct, tensor, bounces_system.light_side(tensor, light), now))]

    def view_side():
        view = dynamic.view_side(direct, ready.brdfs, now, eye=eye)
        return [(view, None if tensor is None else bounces_system.view_side(direct, view))]

    def combine(light, view):
        color = dynamic.combine(direct, light[0], view[0])
        return color if tensor is None else color + bounces_system.combine(direct, light[1], view[1])

    return Relit(light_side, view_side, combine, {"scene": ready.told})


def reflect(ready: Ready, whole: Scene, name: str, stops: float, output: Path) -> float:
    """Writes the picture of one light with reflected light too; returns what share of the light that is."""
    light, mesh = whole.lights[name], whole.mesh
    now, eye = materials(ready, whole), whole.camera.eye
    color, direct = (each.radiance(now, light, eye=eye) for each in (ready, ready._replace(tensor=None)))
    sky = scene.environment.background(light, image.ray_direction(whole.camera))
    picture = image.render(mesh, color, whole.camera, background=sky)
    files.write_exr(output / f"{name}_dynamic_bounces.exr", np.asarray(picture))
    shown = image.display(image.expose(picture, stops=jnp.asarray(stops, picture.dtype)))
    files.write_png(output / f"{name}_dynamic_bounces.png", np.asarray(shown))
    first, both = (image.render(mesh, each, whole.camera, background=None) for each in (direct, color))
    total = float(jnp.sum(both))
    return float(jnp.sum(both - first)) / total if total > 0 else 0.0


def animate(ready: Ready, whole: Scene, output: Path, *, frames: int, progress: bool = True) -> list[Path]:
    """Writes pictures in which the first light turns once about, the camera swings, and materials change.

    Returns:
        The files, one for each frame.
    """
    light, mesh = next(iter(whole.lights.values())), whole.mesh
    folder, result, stops = output / "animation", [], None
    folder.mkdir(parents=True, exist_ok=True)
    for number in tqdm.trange(frames, desc="animate", unit="frame", disable=not progress):
        turn = number / frames
        around = _about(2 * np.pi * turn)
        view = _swung(whole.camera, _ORBIT * np.sin(2 * np.pi * turn))
        lamp = scene.environment.rotate(light, around)
        color = ready.radiance(materials(ready, whole, turn=turn), lamp, eye=view.eye)
        sky = scene.environment.background(lamp, image.ray_direction(view))
        picture = image.render(mesh, color, view, background=sky)
        stops = image.automatic_exposure(picture) if stops is None else stops
        result.append(folder / f"frame_{number:04d}.png")
        files.write_png(result[-1], np.asarray(image.display(image.expose(picture, stops=stops))))
    return result


def _about(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return jnp.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]], jnp.result_type(float))


def _swung(camera: Camera, angle: float) -> Camera:
    """A camera moved around what it looks at, about the vertical."""
    offset = jnp.asarray(_about(angle)) @ (camera.eye - camera.target)
    return Camera(camera.target + offset, camera.target, camera.up, camera.field_of_view, camera.width, camera.height)
