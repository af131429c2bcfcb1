"""The error of an exported page: its pictures against those of the scene, and what causes the difference."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxprt.image.pixels import nearest_fragments
from jaxprt.relit.casting import caster
from jaxprt.relit.groups import faces_of
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, sides
from jaxprt.scene.environment import resized
from jaxprt.view import stages
from jaxprt.view.reduced import PageScene

NOTABLE = 0.05  # relative L2 error above which causes are measured
_VIEWS = 4  # views around the scene
_EDGE = 96  # edge of the pictures in pixels
_SMALL = 0.2  # of the error: causes below it are not named
_REMEDIES = {
    "shadows": "edges of shadows that lie between vertices: divide the meshes finer (refine)",
    "bounces": "light that parts reflect onto each other, which the page reflects on diffusely and by few harmonics: "
    "precompute without bounces, or show the scene in the viewer",
    "lamps": "light of lamps, which the page interpolates between vertices and reflects diffusely: show the scene in "
    "the viewer",
    "layers": "clear coats and sheens, which the page leaves out: give the parts materials without them",
    "visibility": "coarse visibility and tables: allow the page more bytes (most), or take more lobes (lobes)",
}


class Cause(NamedTuple):
    """Something that a page lacks or has coarser than the scene.

    Attributes:
        name: "shadows", "bounces", "lamps", "layers" or "visibility".
        error: Relative L2 error of pictures that it causes alone.
        part: Name of the part that shows most of it.
    """

    name: str
    error: float
    part: str

    def __str__(self) -> str:
        """The cause with its error and its remedy."""
        return f"{100 * self.error:.1f} % by {_REMEDIES[self.name]}; most of it on part {self.part!r}"


class PageError(NamedTuple):
    """Error of a page.

    Attributes:
        error: Relative L2 error of its pictures under the light with the largest error, at pixels that show surfaces.
        light: Name of this light.
        causes: The causes, largest first. They are measured if the error is above 5 %, else there are none.
    """

    error: float
    light: str
    causes: tuple[Cause, ...]

    def refusal(self, largest: float) -> str:
        """The message for a page whose error is larger than the accepted one."""
        rows = "".join(f"\n  {cause}" for cause in self.causes if cause.error > _SMALL * self.error)
        return (
            f"error must be at least {np.ceil(1000 * self.error) / 1000:.3f} for this page, got {largest:g}: its "
            f"pictures are {100 * self.error:.1f} % off those of the scene in the light {self.light!r}{rows}"
        )


class _Views(NamedTuple):
    """Small pictures around a scene, at the pixels that show surfaces."""

    cameras: Sequence[Camera]
    pixel: Sequence[Int[np.ndarray, " _"]]
    part: Int[np.ndarray, " n"]  # that each of these pixels shows, of all pictures one after another

    @classmethod
    def around(cls, scene: RelitScene) -> "_Views":
        """Views in equal turns around the target of the scene's camera."""
        cameras, pixels, parts = [], [], []
        hidden = faces_of(scene.mesh, np.repeat(sides.hidden_backs(scene.scene), scene.layout.counts))
        occluder = None if scene.mesh.opacity is None else caster(scene.mesh).occluder
        owner = np.repeat(np.arange(len(scene.layout.counts)), scene.layout.counts)[np.asarray(scene.mesh.face)[:, 0]]
        target = jnp.asarray(scene.camera.target)
        for number in range(_VIEWS):
            eye = target + stages.about(2 * np.pi * number / _VIEWS) @ (jnp.asarray(scene.camera.eye) - target)
            camera = dataclasses.replace(scene.camera, eye=eye, width=_EDGE, height=_EDGE)
            shown = nearest_fragments(scene.stage.mesh, camera, hidden=np.asarray(hidden), occluder=occluder)
            triangle = np.asarray(shown.triangle).reshape(-1)
            pixel = np.flatnonzero(triangle >= 0)
            cameras.append(camera)
            pixels.append(pixel)
            parts.append(owner[triangle[pixel]])
        return cls(cameras, pixels, np.concatenate(parts))

    def pictures(self, scene: RelitScene, light: Environment, shadows: str) -> Float[np.ndarray, "n 3"]:
        """Radiance at the pixels that show surfaces; pages may read the light in fewer texels."""
        light = resized(light, size=scene.light_size or light.radiance.shape[-2])
        rows = []
        for camera, pixel in zip(self.cameras, self.pixel, strict=True):
            picture = np.asarray(scene.picture(light, camera, samples=1, shadows=shadows), np.float64)
            rows.append(np.broadcast_to(picture, (*picture.shape[:2], 3)).reshape(-1, 3)[pixel])
        return np.concatenate(rows)


def measure(scene: RelitScene, page: PageScene, lights: Mapping[str, Environment]) -> PageError:
    """Measures the pictures of a page against those of the scene, over four views around it.

    Pictures of the scene trace the shadows of bright texels and reflections from each pixel. Pixels of the page
    interpolate what its vertices store.

    Args:
        scene: The scene, with its origin at zero.
        page: The scene as the page holds it.
        lights: The lights of the page.
    """
    views = _Views.around(scene)
    error, name, whole, shown = -1.0, "", np.zeros((1, 3)), np.zeros((1, 3))
    reduced = page.relit()
    for key, light in lights.items():
        right, approximate = views.pictures(scene, light, "rays"), views.pictures(reduced, light, "vertices")
        now = _relative(approximate - right, right)
        if now > error:
            error, name, whole, shown = now, key, right, approximate
    causes = _causes(views, scene, page, lights[name], whole, shown) if error > NOTABLE else ()
    return PageError(error, name, causes)


def _without_lamps(scene: RelitScene) -> RelitScene:
    """The scene without the light of its lamps. Parts that emit still show their emission."""
    surfaces = tuple(dataclasses.replace(surface, lit=None) for surface in scene.surfaces)
    stage = dataclasses.replace(scene.stage, surfaces=surfaces, point_lights=(), power=None, radiance=None)
    return eqx.tree_at(lambda relit: (relit.stage, relit.lamps), scene, (stage, None))


def _relative(off: Float[np.ndarray, "n 3"], whole: Float[np.ndarray, "n 3"]) -> float:
    size = float(np.linalg.norm(whole))
    return float(np.linalg.norm(off)) / size if size else 0.0


def _causes(
    views: _Views,
    scene: RelitScene,
    page: PageScene,
    light: Environment,
    whole: Float[np.ndarray, "n 3"],  # pictures of the scene
    shown: Float[np.ndarray, "n 3"],  # pictures of the page
) -> tuple[Cause, ...]:
    """What each step from the scene to the page changes: shadows of vertices, then less and less light in both."""
    now = views.pictures(scene, light, "vertices")
    steps = {"shadows": whole - now}
    if scene.lamps is not None:
        scene, page = _without_lamps(scene), page.with_reflected(bounces=True, lamps=False)
        before, had = now, shown
        now, shown = views.pictures(scene, light, "vertices"), views.pictures(page.relit(), light, "vertices")
        steps["lamps"] = (before - now) - (had - shown)
    if scene.bounces is not None:
        scene, page = scene.without_bounces(), page.with_reflected(bounces=False, lamps=False)
        before, had = now, shown
        now, shown = views.pictures(scene, light, "vertices"), views.pictures(page.relit(), light, "vertices")
        steps["bounces"] = (before - now) - (had - shown)
    rest = now - shown
    layered = np.asarray([shading.layered for shading in scene.shading])[views.part][:, None]
    if layered.any():
        steps["layers"] = rest * layered
    steps["visibility"] = rest * ~layered
    names, size = scene.scene.names, max(float(np.linalg.norm(whole)), 1e-30)
    causes = []
    for name, step in steps.items():
        of_part = np.bincount(views.part, np.sum(step**2, 1), len(names))
        causes.append(Cause(name, float(np.sqrt(of_part.sum())) / size, names[int(np.argmax(of_part))]))
    return tuple(sorted(causes, key=lambda cause: -cause.error))
