"""Pictures of scenes. Radiance is computed at the points that a picture shows, in rows of points of one group."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import Between, compile_time, finished, jit, known, promoted, put
from jaxprt.image import raster
from jaxprt.image.pixels import Pixels, visible_points
from jaxprt.relit import canvas, curvature, lamplight, shadows, tracing
from jaxprt.relit.casting import caster
from jaxprt.relit.groups import Arriving, Stage, Surface, look_at, sampled
from jaxprt.relit.lamplight import LampLight
from jaxprt.relit.shadows import TexelShares, TracedLight
from jaxprt.relit.surface import TexelLight, Viewed, radiance, view
from jaxprt.relit.tracing import Reflections
from jaxprt.scene import Camera, Environment
from jaxprt.scene.points import Points
from jaxprt.systems.lamps import LampTransport

# Samples that are drawn in each drawn pixel, and edge in drawn pixels of a pixel, by samples of a pixel.
SAMPLES = {1: (1, 1), 4: (4, 1), 16: (4, 2)}


class Row(eqx.Module):
    """Points of a picture on one group that are shaded together.

    Attributes:
        number: Index of the group.
        samples: Number of sample points along the edge of each bright texel.
        index: Indices of the points among all points of the picture; -1 is padding. Inside of `jax.jit` these are all
            rows of the group.
        viewed: What does not depend on the light; None if it is computed anew for each light.
    """

    number: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    index: Int[Array | np.ndarray, "*m p"]
    viewed: Viewed | None


class PictureView(eqx.Module):
    """All of a picture that does not depend on the light; `RelitScene.picture_view` makes it.

    Attributes:
        stage: The scene and its materials.
        arriving: Function from an environment to the light that arrives at the scene; its second argument, if it is not
            None, takes the place of the environment in direct light.
        camera: The camera of the drawn pixels.
        pixels: The points of the picture.
        ray: Unit direction in world space from the eye through the center of each drawn pixel.
        rows: The points in rows that are shaded together.
        reflected: Traced reflections of the points of sharp groups, in the order of their rows; None without.
        fold: Edge in drawn pixels of the squares that are averaged to one pixel of the picture.
        shadows: "rays" to trace the brightest texels of each light; "vertices" to interpolate them.
        keep: Whether what does not depend on the light is kept.
        shares: The texels that were traced when the view was made; None to choose them by each light.
        lamp_rays: Whether rays from the points are traced to lamps; otherwise their light is interpolated.
    """

    stage: Stage
    arriving: Callable[[Environment, Environment | None], Arriving]
    camera: Camera
    pixels: Pixels
    ray: Float[Array, "h w 3"]
    rows: tuple[Row, ...]
    reflected: Reflections | None = None
    fold: int = eqx.field(static=True, default=1)
    shadows: str = eqx.field(static=True, default="vertices")
    keep: bool = eqx.field(static=True, default=False)
    shares: TexelShares | None = None
    lamp_rays: bool = eqx.field(static=True, default=False)

    @promoted
    def picture(
        self, environment: Environment, *, background: bool = True, between: Between = None
    ) -> Float[Array, "h w c"]:
        """Renders the picture under an environment, in linear radiance.

        `background` and `between` are those of `RelitScene.picture`.

        Raises:
            TypeError: `environment` is not an `Environment`.
            ValueError: The environment is a batch, or has another size than the systems require.
        """
        require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
        require.colors("the light", environment.radiance)
        if environment.radiance.ndim != 4:
            raise ValueError(f"a picture needs one light [6, n, n, c], got {list(environment.radiance.shape)}")
        light = _traced_light(self, environment)
        arriving = finished(self.arriving(environment, None if light is None else light.rest), between)
        lamps = lamplight.of(self.stage, self.pixels, self.camera.width) if self.lamp_rays else None
        reflected = iter(()) if self.reflected is None else iter(_reflections(self, environment, arriving, light))
        colors, sharp = environment.radiance.shape[-1], self.stage.sharp_groups
        recompute = not known(arriving, self.stage, self.camera)
        rows: list[tuple[Any, Array]] = []
        for row in self.rows:
            added = next(reflected) if row.number in sharp else None
            color = _color(self, row, arriving, light, lamps, added, recompute=recompute)
            rows.append((row.index, finished(color, between)))
            colors = max(colors, color.shape[-1])
        if background:
            picture = canvas.sky(environment, self.camera, self.ray, self.pixels.background, colors=colors)
        else:
            picture = jnp.zeros((*self.ray.shape[:2], colors), environment.radiance.dtype)
        for index, color in rows:
            picture = canvas.draw(picture, self.pixels, index, color)
        return folded(picture, fold=self.fold)


def _traced_light(picture: PictureView, environment: Environment) -> TracedLight | None:
    """The light with traced texels; None if visibility of all texels is interpolated."""
    if picture.shares is not None:
        return shadows.fixed(environment, picture.shares)
    if picture.shadows == "vertices":
        return None
    return shadows.trace(picture.stage.whole, picture.pixels, picture.camera.width, environment, keep=picture.keep)


def _reflections(
    picture: PictureView, environment: Environment, arriving: Arriving, light: TracedLight | None
) -> list[Float[Array, "_ c"]]:
    """Traced reflections, of the whole light: what rays hit is shaded with interpolated visibility."""
    assert picture.reflected is not None
    whole = arriving if light is None else picture.arriving(environment, None)
    return picture.reflected.radiance(picture.stage, whole)


def _color(
    picture: PictureView,
    row: Row,
    arriving: Arriving,
    light: TracedLight | None,
    lamps: LampLight | None,
    reflections: Float[Array, "p c"] | None,
    *,
    recompute: bool,
) -> Float[Array, "*m p c"]:
    """Colors of the points of a row.

    Args:
        picture: The picture.
        row: The points.
        arriving: The light that arrives at the scene, without what is taken out of traced texels.
        light: The light with its traced texels; None without.
        lamps: The lamps, if rays are traced to them.
        reflections: What reflection rays add; None without.
        recompute: Whether derivatives compute again what depends on the view, which needs less memory.
    """
    surface = sampled(picture.stage.surfaces[row.number], row.samples)
    if row.index.ndim == 2:  # of a view that was made inside of `jax.jit`
        return _color_of_some(picture, row, arriving, light)
    if isinstance(row.viewed, Viewed):
        texels = _texels(row, light, row.index)
        return radiance(surface, arriving.at(row.number), row.viewed, texels=texels, reflections=reflections)
    shade = partial(_shaded, picture, surface, row, row.index, lamps)
    return (jax.checkpoint(shade) if recompute else shade)(arriving, light, reflections)


def _shaded(
    picture: PictureView,
    surface: Surface,
    row: Row,
    index: Any,
    lamps: LampLight | None,
    arriving: Arriving,
    light: TracedLight | None,
    reflections: Float[Array, "p c"] | None = None,
) -> Float[Array, "p c"]:
    points, on_group = _points(picture, index)
    transport = None if lamps is None else lamps.row(row.number, index, on_group)
    seen = _seen(picture.stage, surface, row.number, points, on_group, picture.camera, lamps=transport)
    texels = _texels(row, light, index)
    return radiance(surface, arriving.at(row.number), seen, texels=texels, reflections=reflections)


def _texels(row: Row, light: TracedLight | None, index: Any) -> TexelLight | None:
    """The traced texels of the light at points of a row; None without."""
    return None if light is None else TexelLight(*light.row(index), light.rest.radiance.shape[-2], row.samples)


def _color_of_some(
    picture: PictureView, row: Row, arriving: Arriving, light: TracedLight | None
) -> Float[Array, "m p c"]:
    """`_color` inside of `jax.jit`, where most rows may be padding alone."""
    surface = sampled(picture.stage.surfaces[row.number], row.samples)
    shape = jax.eval_shape(lambda: _shaded(picture, surface, row, row.index[0], None, arriving, light))
    none = jnp.zeros(shape.shape, shape.dtype)

    def some(index: Array) -> Array:
        shade = jax.checkpoint(partial(_shaded, picture, surface, row, index, None))
        return jax.lax.cond(jnp.any(index >= 0), shade, lambda *_: none, arriving, light)

    return jax.lax.map(some, row.index)


def _points(picture: PictureView, index: Any) -> tuple[Points, Points]:
    return canvas.points_of(picture.pixels, picture.stage.face, picture.stage.shift, index)


def make(
    stage: Stage,
    arriving: Callable[[Environment, Environment | None], Arriving],
    camera: Camera,
    *,
    samples: int,
    keep: bool,
    shadow: str | Environment,
    between: Between,
) -> PictureView:
    """Finds the shaded points of a picture, and computes what depends on the camera and the materials.

    Args:
        stage: The scene and its materials.
        arriving: Function from an environment to the light that arrives at the scene; see `PictureView`.
        camera: The camera, relative to the origin of the scene.
        samples: Number of coverage samples of each pixel: 1, 4 or 16.
        keep: Whether to store what depends on the view, for many lights: about a kilobyte for each point.
        shadow: "rays" or "vertices", or the light whose brightest texels are traced for all lights.
        between: Function that is called between steps of the work, as in `RelitScene.picture`.

    Raises:
        ValueError: `samples` is not 1, 4 or 16, or `shadow` is another word.
    """
    if not isinstance(shadow, Environment) and shadow not in ("rays", "vertices"):
        raise ValueError(f'shadows must be "rays", "vertices" or an Environment, got {require.shown(shadow)}')
    samples, camera, fold = drawn(camera, samples)
    with compile_time(stage.mesh, camera, stage.bend) if stage.sharp_groups else contextlib.nullcontext():
        pixels, rows = _placed(stage, camera, samples, between)
    rays = isinstance(shadow, Environment) or shadow == "rays"
    lamps = lamplight.of(stage, pixels, camera.width) if rays else None
    complete, origins, sharp = [], [], stage.sharp_groups
    for row in rows:
        surface = sampled(stage.surfaces[row.number], row.samples)
        stores = keep and not isinstance(row.index, Tracer)
        if stores or row.number in sharp:
            index = row.index if row.index.ndim == 1 else row.index[0]
            points, on_group = canvas.points_of(pixels, stage.face, stage.shift, index)
            transport = None if lamps is None else lamps.row(row.number, index, on_group)
            if stores:
                seen = _seen(stage, surface, row.number, points, on_group, camera, lamps=transport)
                row = dataclasses.replace(row, viewed=seen)
            if row.number in sharp:
                blend, tilted = stage.blend(row.number, points, on_group)
                narrow = stage.sharp_at(row.number, points)
                origins.append(tracing.RayOrigins(row.number, points, tilted, blend, narrow, transport))
        complete.append(row)
    reflected = tracing.trace(stage, origins, jnp.asarray(camera.eye), keep=keep) if origins else None
    ray = raster.ray_direction(camera)
    shares, way = None, "vertices"
    if isinstance(shadow, Environment):
        traced = shadows.trace(stage.whole, pixels, camera.width, shadow, keep=False)
        shares = None if traced is None else put(traced.shares)
    else:
        way = shadow
    return PictureView(stage, arriving, camera, pixels, ray, tuple(complete), reflected, fold, way, keep, shares, rays)


def drawn(camera: Camera, samples: int) -> tuple[int, Camera, int]:
    """Samples of each drawn pixel, the camera of drawn pixels, and the edge of a pixel in them.

    Raises:
        ValueError: `samples` is not 1, 4 or 16.
    """
    if type(samples) is not int or samples not in SAMPLES:
        raise ValueError(f"samples must be 1, 4 or 16, got {samples!r}")
    count, fold = SAMPLES[samples]
    return count, dataclasses.replace(camera, width=fold * camera.width, height=fold * camera.height), fold


def _seen(
    stage: Stage,
    surface: Surface,
    number: int,
    points: Points,
    on_group: Points,
    camera: Camera,
    lamps: LampTransport | None = None,
) -> Viewed:
    """What does not depend on the light, for a row of points with their materials."""
    look, eye = look_at(stage.table, stage.rough, points), jnp.asarray(camera.eye)
    options = {"fixed": stage.fixed[number], "sharp": stage.sharp_at(number, points), "lamps": lamps}
    # The view does not depend on the samples of bright texels.
    return view(sampled(surface, 1), on_group, look, eye, **options)


def folded(picture: Float[Array, "h w c"], *, fold: int) -> Float[Array, "_ _ c"]:
    """The picture with squares of `fold` x `fold` pixels averaged to one."""
    return picture if fold == 1 else _folded(picture, fold=fold)


@partial(jit, static_argnames="fold")
def _folded(picture: Float[Array, "h w c"], *, fold: int) -> Float[Array, "_ _ c"]:
    height, width, colors = picture.shape
    return jnp.mean(picture.reshape(height // fold, fold, width // fold, fold, colors), (1, 3))


def _placed(stage: Stage, camera: Camera, samples: int, between: Between) -> tuple[Pixels, list[Row]]:
    """The points of a picture in rows that are shaded alike."""
    uneven = curvature.uneven(stage.mesh, camera, stage.bend)
    occluder = None if stage.whole.opacity is None else caster(stage.whole).occluder
    shown = {"hidden": stage.hidden_faces, "occluder": occluder, "uneven": uneven, "between": between}
    pixels = visible_points(stage.mesh, camera, samples=samples, **shown)
    if not known(pixels, stage.mesh):
        return pixels, list(_traced_rows(stage, pixels))
    triangle = np.asarray(pixels.triangle)
    owner = np.where(triangle >= 0, stage.part[stage.face[np.maximum(triangle, 0), 0]], -1)
    return pixels, list(_rows(stage, owner))


def _traced_rows(stage: Stage, pixels: Pixels) -> Iterator[Row]:
    """The points in rows by group, inside of `jax.jit`: as many rows for each group as if it had all points."""
    first = jnp.asarray(stage.face)[jnp.maximum(pixels.triangle, 0), 0]
    owner = jnp.where(pixels.triangle >= 0, jnp.asarray(stage.part)[first], -1)
    for number, parts in enumerate(stage.place.parts):
        samples = max(stage.place.of_group(number, stage.samples))
        yield Row(number, samples, canvas.rows_of(jnp.isin(owner, jnp.asarray(parts))), None)


def _rows(stage: Stage, owner: np.ndarray) -> Iterator[Row]:
    """The points in rows by group and number of samples."""
    for number, parts in enumerate(stage.place.parts):
        for samples in sorted(set(stage.place.of_group(number, stage.samples))):
            same = [part for part in parts if stage.samples[part] == samples]
            for index in canvas.rows_of(np.isin(owner, same), owner=owner):
                yield Row(number, samples, index, None)
