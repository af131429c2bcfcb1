"""Relights scenes with changing materials by the dynamic system, and writes animations of light, view and materials."""

import itertools
import timeit
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import tqdm

from jaxprt import files, image
from jaxprt.brdf import CookTorrance, Lambert, navigation
from jaxprt.brdf.navigation import Family
from jaxprt.cli.inputs import about
from jaxprt.cli.report import SystemScene, View
from jaxprt.relit import regions, warn
from jaxprt.scene import Camera, TexturedMaterial
from jaxprt.scene.environment import rotate
from jaxprt.systems import bounces, dynamic, protocol, separable
from jaxprt.systems.bounces import BouncesSystem
from jaxprt.systems.dynamic import DynamicSystem, Material

LOBES = 4
# Roughnesses of the family, in addition to those of the scene. Lobes interpolated between them have at most twice the
# error that lobes have at them.
ROUGHNESS = (0.05, 0.075, 0.11, 0.16, 0.23, 0.34, 0.5)
_MIDDLE = 0.25  # in animations smoother materials become rougher, and rougher ones smoother
_ORBIT = np.radians(40)  # angle by which the camera moves in an animation


class Ready(NamedTuple):
    """A scene precomputed for the dynamic system.

    Attributes:
        direct: System for direct light.
        reflected: System for interreflected light; None without bounces.
        family: The family of BRDFs that adjustable regions share.
        cost: Time and memory of the precomputation.
    """

    direct: DynamicSystem
    reflected: BouncesSystem | None
    family: Family
    cost: dict[str, Any]

    @property
    def system(self) -> protocol.System:
        """System for direct and interreflected light together."""
        return self.direct if self.reflected is None else protocol.total(self.direct, self.reflected)


def prepare(view: View, output: Path, *, terms: int, reflections: int | str) -> Ready:
    """Precomputes a scene. Parts with the Cook-Torrance model can change; the BRDFs of other parts are fixed.

    Raises:
        ValueError: No part has the Cook-Torrance model, or one has textures.
    """
    materials = []
    for part in view.scene.parts:
        if isinstance(part.material, TexturedMaterial):
            raise ValueError(
                f"the dynamic system needs BRDFs, got a TexturedMaterial for part {part.name!r}: give --brdf"
            )
        materials.append(part.material)
    changing = [each for each in materials if isinstance(each, CookTorrance)]
    if not changing:
        raise ValueError("the dynamic system needs a part that can change: give --brdf or --material cook-torrance")
    start, mesh = timeit.default_timer(), view.scene.mesh
    warn.of_backs(view.scene, mesh, view.camera)
    rough = sorted({*ROUGHNESS, *(float(each.roughness) for each in changing)})
    # The model is linear in F0, and so is interpolation between columns, so two values of F0 are enough.
    family = navigation.cook_torrance(point=np.array(list(itertools.product((0.0, 1.0), rough))))
    members = dynamic.factor(family.brdf, dynamic.separate(family.brdf, lobes=LOBES))
    fixed = {
        number: separable.factor(each, terms=1 if isinstance(each, Lambert) else terms)
        for number, each in enumerate(materials)
        if not isinstance(each, CookTorrance)
    }
    cost: dict[str, Any] = {"fit_seconds": timeit.default_timer() - start}
    start, store = timeit.default_timer(), output / "dynamic"
    size = next(iter(view.lights.values())).radiance.shape[-2]
    brdfs = [fixed.get(number, members) for number in range(len(materials))]
    transport = dynamic.precompute(mesh, brdfs, size=size, path=store / "direct")
    direct = DynamicSystem(transport, brdfs)
    cost |= {"seconds": timeit.default_timer() - start, "bytes": transport.nbytes}
    reflected = None
    if reflections:
        start = timeit.default_timer()
        bases = bounces.factor(family.brdf, navigation=family.navigation)
        paths = [fixed.get(number, bases) for number in range(len(materials))]
        tensor = bounces.precompute(mesh, paths, bounces=reflections, path=store / f"bounces_{reflections}")
        cost |= {"bounces_seconds": timeit.default_timer() - start, "bounces_bytes": tensor.nbytes}
        cost |= {"bounces_worth": np.asarray(tensor.worth).tolist()}
        reflected = BouncesSystem(tensor, direct)
    return Ready(direct, reflected, family, cost)


def materials(ready: Ready, view: View, *, turn: float = 0.0) -> list[Material | None]:
    """Materials of a scene. As `turn` goes from 0 to 1, they cycle through roughnesses and colors."""
    result: list[Material | None] = []
    for number, part in enumerate(view.scene.parts):
        model = part.material
        if not isinstance(model, CookTorrance):
            result.append(None)
            continue
        away = np.sin(np.pi * turn) ** 2
        m, f0 = float(model.roughness), jnp.mean(model.f0)
        rough = m ** (1 - away) * ROUGHNESS[-1 if m < _MIDDLE else 0] ** away
        weight = ready.family.navigation.weight(jnp.stack([f0, jnp.asarray(rough, f0.dtype)]))
        hue = 1 + away * np.cos(2 * np.pi * (number / 3 + np.arange(3) / 3))
        tint = jnp.asarray(hue / hue.max(), f0.dtype)
        result.append(Material(weight, model.diffuse * tint, model.specular))
    return result


def made(ready: Ready, view: View) -> SystemScene:
    """The scene in the form that the report needs."""
    return SystemScene(ready.direct, ready.system, view.scene.mesh, materials(ready, view), {"scene": ready.cost})


def animate(ready: Ready, view: View, output: Path, *, frames: int, progress: bool = True) -> list[Path]:
    """Writes pictures in which the first light rotates once, the camera swings, and materials change.

    Returns:
        The files, one for each frame.
    """
    light, mesh, system = next(iter(view.lights.values())), view.scene.mesh, ready.system
    folder, result, stops = output / "animation", [], None
    folder.mkdir(parents=True, exist_ok=True)
    for number in tqdm.trange(frames, desc="animate", unit="frame", disable=not progress):
        turn = number / frames
        camera = _swung(view.camera, _ORBIT * np.sin(2 * np.pi * turn))
        lamp = rotate(light, about(2 * np.pi * turn))
        now = materials(ready, view, turn=turn)
        drawn = regions.of_regions(system, mesh, camera, materials=now)
        picture = drawn.picture(lamp)
        if stops is None:
            stops = image.automatic_exposure(picture, coverage=1 - drawn.pixels.background)
        result.append(folder / f"frame_{number:04d}.png")
        files.write_png(result[-1], np.asarray(image.display(picture, tone=view.tone, stops=stops)))
    return result


def _swung(camera: Camera, angle: float) -> Camera:
    """A camera that is rotated around its target, about the vertical."""
    offset = jnp.matmul(about(angle), camera.eye - camera.target, precision="highest")
    return Camera(camera.target + offset, camera.target, camera.up, camera.field_of_view, camera.width, camera.height)
