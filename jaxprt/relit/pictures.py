"""Pictures of scenes. Radiance is computed at the points that a picture shows, in rows of points of one group."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import require
from jaxprt.compile import Between, compile_time, finished, jit, known, promoted, put
from jaxprt.files import outputs
from jaxprt.image import raster
from jaxprt.image.pixels import Pixels, visible_points
from jaxprt.programs.executables import make_room
from jaxprt.relit import canvas, curvature, lamplight, shadows, tracing
from jaxprt.relit.casting import caster
from jaxprt.relit.groups import Arriving, Stage, Surface, sampled, surface_of
from jaxprt.relit.lamplight import LampLight
from jaxprt.relit.picture_layers import LIGHT
from jaxprt.relit.picture_layers import check as check_layers
from jaxprt.relit.picture_layers import of_points as geometry_layers
from jaxprt.relit.shadows import CellLight, TexelShares, TracedLight
from jaxprt.relit.surface import TexelLight, Viewed, radiance, view
from jaxprt.relit.tracing import Reflections
from jaxprt.scene import Camera, Environment
from jaxprt.scene.points import Points
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.protocol import light_for

_TAKEN = ("rest", "background", *outputs.LAYERS)  # names that regions cannot have
_ROUNDED = 1e-4  # of sums of shares
# Samples that are drawn in each drawn pixel, and edge in drawn pixels of a pixel, by samples of a pixel.
SAMPLES = {1: (1, 1), 4: (4, 1), 16: (4, 2)}
_LITTLE = 1 / 8  # coverage below which a point casts a quarter of the reflection rays


class Row(eqx.Module):
    """Points of a picture on one group that are shaded together.

    Attributes:
        group: Index of the group.
        samples: Number of sample points along the edge of each bright texel.
        index: Indices of the points among all points of the picture; -1 is padding. Inside of `jax.jit` these are all
            rows of the group.
        viewed: What does not depend on the light; None if it is computed anew for each light.
        missed: Share of the reflection rays of narrow lobes that hit nothing; None without rays.
    """

    group: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    index: Int[Array | np.ndarray, "*m p"]
    viewed: Viewed | None
    missed: Float[Array, " p"] | None = None


class PictureView(eqx.Module):
    """All of a picture that does not depend on the light; `RelitScene.picture_view` makes it.

    Attributes:
        stage: The scene and its materials.
        arriving: Function from an environment to the light that arrives at the scene. Its second argument, if it is not
            None, takes the place of the environment in direct light, and its third is the share of each lamp.
        camera: The camera of the drawn pixels.
        pixels: The points of the picture.
        ray: Unit direction in world space from the eye through the center of each drawn pixel.
        rows: The points in rows that are shaded together.
        reflected: Traced reflections of the points of sharp groups, in the order of their rows; None without.
        fold: Edge in drawn pixels of the squares that are averaged to one pixel of the picture.
        shadows: "rays" to trace the brightest texels and cells of each light; "vertices" to interpolate them.
        keep: Whether what does not depend on the light is kept.
        shares: The texels that were traced when the view was made; None to choose them by each light.
        lamp_rays: Whether rays from the points are traced to lamps; otherwise their light is interpolated.
        lamps: Names of the lamps.
        light_size: As of the scene; see `System.light_size`.
        light_step: As of the scene; see `System.light_step`.
    """

    stage: Stage
    arriving: Callable[..., Arriving]
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
    lamps: tuple[str, ...] = eqx.field(static=True, default=())
    light_size: int | None = eqx.field(static=True, default=None)
    light_step: int = eqx.field(static=True, default=1)

    @promoted
    def picture(
        self,
        environment: Environment,
        *,
        background: str | Environment | None = "light",
        layers: Sequence[str] | None = None,
        between: Between = None,
    ) -> Any:
        """Renders the picture under an environment, in linear radiance. `RelitScene.picture` explains the options."""
        return self.pictures([environment], background=background, layers=layers, between=between)[0]

    @promoted
    def pictures(
        self,
        environments: Sequence[Environment],
        *,
        background: str | Environment | None = "light",
        layers: Sequence[str] | None = None,
        between: Between = None,
    ) -> list[Any]:
        """What `picture` returns for each of several lights. All that depends on the view is computed once for all."""
        check(self, environments)
        _check_background(background)
        names = ("color",) if layers is None else check_layers(layers)
        shown = [name for name in LIGHT if name in names]
        lights = [self._light(environment, between) for environment in environments if shown]
        colors = self._colors(lights, "direct" in shown or "reflected" in shown, between) if shown else []
        rest = {} if layers is None else self._layers([name for name in names if name not in LIGHT])
        result = []
        for number, environment in enumerate(environments):
            behind = environment if isinstance(background, str) else background
            of_light = [(index, rows[number]) for index, rows in colors]
            images = {name: self._image(name, of_light, environment, behind) for name in shown}
            if layers is not None:
                result.append({name: images[name] if name in images else rest[name] for name in names})
            elif background is None:
                result.append(jnp.concatenate([images["color"], self._alpha()], -1))
            else:
                result.append(images["color"])
        return result

    @promoted
    def mix(
        self, environment: Environment, *, regions: Mapping[str, Float[Array | np.ndarray, "6 n n"]] | None = None
    ) -> dict[str, Float[Array, "h w c"]]:
        """Layers of the picture by the light that they come from, with which a compositor mixes lights anew.

        Layers are linear in their lights: to change the color or the strength of a light, multiply its layer.

        Args:
            environment: The light.
            regions: Named parts of the environment: the share of each texel that belongs to the part, such as
                `jaxprt.scene.environment.disk_share` makes it for a sun.

        Returns:
            A dictionary of pictures: one for each region and for each lamp of the scene, by their names, "rest" for the
            rest of the environment, and "background" for what is seen of it. Their sum is `picture` exactly: the rest
            is what the others leave of it.
        """
        check(self, [environment])
        parts = _regions(environment, {} if regions is None else regions, (*self.lamps, *_TAKEN))
        black = Environment(jnp.zeros_like(environment.radiance))
        none, alone = np.zeros(len(self.lamps)), np.eye(len(self.lamps))
        whole = self._light(environment, None)  # the first one, which rays are traced for
        lights = {name: self._light(part, None, share=none) for name, part in parts.items()}
        lights |= {name: self._light(black, None, share=share) for name, share in zip(self.lamps, alone, strict=True)}
        lights["rest"] = whole
        colors = self._colors(list(lights.values()), False, None)
        result = {}
        for number, name in enumerate(lights):
            of_light = [(index, rows[number]) for index, rows in colors]
            result[name] = self._image("color", of_light, environment, None)
        result["rest"] = result["rest"] - sum(image for name, image in result.items() if name != "rest")
        empty = canvas.sky(environment, self.camera, self.ray, self.pixels.background, colors=result["rest"].shape[-1])
        return result | {"background": folded(empty, fold=self.fold)}

    def remembering(self, arriving: dict[tuple[int, bool], Arriving]) -> "PictureView":
        """The view with what other views of the scene computed of lights, by environment; these must stay in memory."""

        def known_or_new(environment: Environment, direct: Environment | None, share: Any) -> Arriving:
            if share is not None:
                return self.arriving(environment, direct, share)
            key = id(environment), direct is None
            if key not in arriving:
                arriving[key] = self.arriving(environment, direct, None)
            return arriving[key]

        return dataclasses.replace(self, arriving=known_or_new)

    def _light(
        self, environment: Environment, between: Between, *, share: Float[np.ndarray, " n"] | None = None
    ) -> "PictureLight":
        """What arrives under an environment and a share of each lamp."""
        traced = _traced_light(self, environment)
        arriving = self.arriving(environment, None if traced is None else traced.rest, share)
        arriving = arriving._replace(direct=shadows.sharpened(self.stage, arriving.direct, environment))
        arriving = finished(arriving, between)
        reflections = ()
        if self.reflected is not None:
            # What rays hit is shaded with interpolated visibility, in the whole light.
            whole = arriving if traced is None else self.arriving(environment, None, share)
            reflections = tuple(self.reflected.radiance(self.stage, whole))
        cells: tuple[CellLight | None, ...] = (None,) * len(arriving.direct)
        if self.shadows == "rays":
            cells = tuple(shadows.cells(self.stage, self.pixels, self.camera.width, arriving.direct))
        return PictureLight(arriving, traced, cells, reflections, share)

    def _colors(
        self, lights: Sequence["PictureLight"], apart: bool, between: Between
    ) -> list[tuple[Any, list[tuple[Array, ...]]]]:
        """Indices of the points of each row, and their colors under each light; if `apart`, also of direct light."""
        lamps = lamplight.of(self.stage, self.pixels, self.camera.width) if self.lamp_rays else None
        recompute = not known([light.arriving for light in lights], self.stage, self.camera)
        traced, rows = 0, []
        for row in self.rows:
            sharp = row.group in self.stage.sharp_groups
            of_row = [light.of_row(row, traced if sharp else None, _glow(self, row, light.share)) for light in lights]
            traced += sharp
            colors = _colors_of_row(self, row, of_row, lamps, apart=apart, recompute=recompute)
            rows.append((row.index, finished(colors, between)))
        return rows

    def _image(
        self, name: str, rows: Sequence[tuple[Any, tuple[Array, ...]]], light: Environment, behind: Environment | None
    ) -> Float[Array, "h w c"]:
        """The picture, or its direct or reflected light, from the colors of all points."""
        colors = max([light.radiance.shape[-1], *(part.shape[-1] for _, row in rows for part in row)])
        if name == "color" and behind is not None:
            image = canvas.sky(behind, self.camera, self.ray, self.pixels.background, colors=colors)
        else:
            image = jnp.zeros((*self.ray.shape[:2], colors), light.radiance.dtype)
        for index, (whole, *apart) in rows:
            part = whole if name == "color" else apart[0] if name == "direct" else whole - apart[0]
            image = canvas.draw(image, self.pixels, index, part)
        return folded(image, fold=self.fold)

    def _alpha(self) -> Float[Array, "h w 1"]:
        """Fraction of each pixel that surfaces hide of the background."""
        share = jnp.asarray(self.pixels.background)
        alpha = 1 - (share if share.ndim == 2 else jnp.mean(share, -1))[..., None]
        return folded(alpha, fold=self.fold)

    def _layers(self, names: Sequence[str]) -> dict[str, Array]:
        """The layers that do not depend on the light."""
        result = {"alpha": self._alpha()[..., 0]} if "alpha" in names else {}
        others = [name for name in names if name != "alpha"]
        if others:
            rows = [(row.group, row.index) for row in self.rows]
            result |= geometry_layers(self.stage, self.pixels, rows, self.camera, others, fold=self.fold)
        return result


class RowLight(NamedTuple):
    """The light that arrives at the points of a row.

    Attributes:
        arriving: The light that arrives at the scene, without what is taken out of traced texels.
        traced: The light with its traced texels; None without.
        cells: Visible shares of texels and cells of the arriving light by rays; None to interpolate them.
        reflections: What reflection rays add; None without.
        glow: Share of what the points emit; None for all of it.
    """

    arriving: Arriving
    traced: TracedLight | None
    cells: UInt8[Array, "t p"] | None
    reflections: Float[Array, "p c"] | None
    glow: Float[Array, " p"] | None


class PictureLight(NamedTuple):
    """The light that arrives at a picture.

    Attributes:
        arriving: The light that arrives at the scene, without what is taken out of traced texels.
        traced: The light with its traced texels; None without.
        cells: For each group, cells of the arriving light, to which rays are traced; None without.
        reflections: What reflection rays add, for each row of sharp groups.
        share: Share of each lamp; None for all of it.
    """

    arriving: Arriving
    traced: TracedLight | None
    cells: tuple[CellLight | None, ...]
    reflections: tuple[Float[Array, "_ c"], ...]
    share: Float[np.ndarray, " n"] | None

    def of_row(self, row: Row, number: int | None, glow: Float[Array, " p"] | None) -> RowLight:
        """The light of a row; `number` is its index among the rows of sharp groups, None for others."""
        reflections, cells = None if number is None else self.reflections[number], self.cells[row.group]
        shares = None if cells is None else cells.row(np.asarray(row.index))
        return RowLight(self.arriving, self.traced, shares, reflections, glow)


def check(taker: Any, environments: Sequence[Any], *, shadows: Any = "rays") -> None:
    """Refuses what is not one light of a size that a scene, or a view of it, takes, and shadows that are not text."""
    if not isinstance(shadows, str):
        raise TypeError(f'shadows must be "rays" or "vertices", got {require.shown(shadows)}')
    for environment in environments:
        _check_light("the light", environment)
        light_for(taker, environment)


def _check_light(what: str, environment: Any) -> None:
    require.kind(what, environment, Environment, source="jaxprt.scene.load_environment")
    require.colors(what, environment.radiance)
    if environment.radiance.ndim != 4:
        raise ValueError(f"a picture needs one light [6, n, n, c], got {list(environment.radiance.shape)}")


def _regions(environment: Environment, regions: Any, taken: Sequence[str]) -> dict[str, Environment]:
    """The named parts of an environment."""
    require.kind("the regions", regions, Mapping, source="a dictionary from names to shares of texels")
    shape, result = list(environment.radiance.shape[:3]), {}
    for name, share in regions.items():
        if not isinstance(name, str) or not outputs.is_layer_name(name) or name in taken:
            raise ValueError(
                f"a region must have a name of letters, digits, spaces, - and _, other than {', '.join(taken)}, "
                f"got {name!r}"
            )
        what = f"the share of the region {name!r}"
        require.array(what, share, "6 n n")
        if list(share.shape) != shape:
            raise ValueError(f"{what} must have the {shape} texels of the light, got {list(share.shape)}")
        require.finite(what, share)
        if not (float(jnp.min(share)) >= 0 and float(jnp.max(share)) <= 1):
            raise ValueError(f"{what} must be from 0 to 1, got {float(jnp.min(share)):g} to {float(jnp.max(share)):g}")
        result[name] = Environment(environment.radiance * jnp.asarray(share, environment.radiance.dtype)[..., None])
    whole = sum(np.asarray(share) for share in regions.values())
    if np.max(whole) > 1 + _ROUNDED:
        raise ValueError(f"the shares of regions must add up to at most 1 in each texel, got {np.max(whole):g}")
    return result


def _check_background(background: Any) -> None:
    if isinstance(background, Environment):
        _check_light("the background", background)
    elif background is not None and (not isinstance(background, str) or background != "light"):
        raise ValueError(f'background must be "light", an Environment or None, got {require.shown(background)}')


def _traced_light(picture: PictureView, environment: Environment) -> TracedLight | None:
    """The light with traced texels; None if visibility of all texels is interpolated."""
    if picture.shares is not None:
        return shadows.fixed(environment, picture.shares)
    if picture.shadows == "vertices":
        return None
    return shadows.trace(picture.stage.whole, picture.pixels, picture.camera.width, environment, keep=picture.keep)


def _glow(picture: PictureView, row: Row, share: Float[np.ndarray, " n"] | None) -> Float[Array, " p"] | None:
    """Share of what each point of a row emits; None for all of it."""
    if share is None:
        return None
    stage = picture.stage
    triangle = np.asarray(picture.pixels.triangle)[np.maximum(row.index, 0)]
    lamp = np.asarray(stage.lamp)[stage.part[stage.face[np.maximum(triangle, 0), 0]]]
    return put(np.append(share, 0)[lamp].astype(picture.ray.dtype))


def _colors_of_row(
    picture: PictureView,
    row: Row,
    lights: Sequence[RowLight],
    lamps: LampLight | None,
    *,
    apart: bool,
    recompute: bool,
) -> list[tuple[Float[Array, "*m p c"], ...]]:
    """Colors of the points of a row under each light; also of direct light if `apart`."""
    surface = sampled(surface_of(picture.stage, row.group), row.samples)
    if row.index.ndim == 2:  # of a view that was made inside of `jax.jit`
        return [_colors_of_some(picture, row, light, apart=apart) for light in lights]
    if isinstance(row.viewed, Viewed):
        return [_lit(surface, row, row.index, row.viewed, light, apart=apart) for light in lights]
    # With `recompute`, derivatives compute again what depends on the view, which needs less memory.
    shade = partial(_shaded, picture, surface, row, row.index, lamps, apart)
    return (jax.checkpoint(shade) if recompute else shade)(lights)


def _shaded(
    picture: PictureView,
    surface: Surface,
    row: Row,
    index: Any,
    lamps: LampLight | None,
    apart: bool,
    lights: Sequence[RowLight],
) -> list[tuple[Float[Array, "p c"], ...]]:
    """Colors of some points of a row under each light, with a view that is not stored."""
    points, on_group = canvas.points_of(picture.stage, picture.pixels, index)
    transport = None if lamps is None else lamps.row(row.group, index, on_group)
    seen = _seen(picture.stage, row, points, on_group, picture.camera, lamps=transport)
    return [_lit(surface, row, index, seen, light, apart=apart) for light in lights]


def _lit(
    surface: Surface, row: Row, index: Any, seen: Viewed, light: RowLight, *, apart: bool
) -> tuple[Float[Array, "p c"], ...]:
    """Colors of points; if `apart`, also those without reflected light."""
    texels = None
    if light.glow is not None and seen.emitted is not None:
        seen = dataclasses.replace(seen, emitted=seen.emitted * light.glow[:, None])
    if light.traced is not None:
        texels = TexelLight(*shadows.of_points(light.traced, index), light.traced.rest.radiance.shape[-2], row.samples)
    direct, reflected, lamp = light.arriving.at(row.group)
    if light.cells is not None:
        direct = dataclasses.replace(direct, here=light.cells)
    color = radiance(surface, (direct, reflected, lamp), seen, texels=texels, reflections=light.reflections)
    if not apart:
        return (color,)
    if reflected is None:
        return color, color
    none = jax.tree.map(jnp.zeros_like, reflected)
    return color, radiance(surface, (direct, none, lamp), seen, texels=texels)


def _colors_of_some(
    picture: PictureView, row: Row, light: RowLight, *, apart: bool
) -> tuple[Float[Array, "m p c"], ...]:
    """`_shaded` under one light inside of `jax.jit`, where most rows may be padding alone."""
    surface = sampled(surface_of(picture.stage, row.group), row.samples)

    def shade(index: Array, light: RowLight) -> tuple[Array, ...]:
        return _shaded(picture, surface, row, index, None, apart, [light])[0]

    shapes = jax.eval_shape(shade, row.index[0], light)
    none = tuple(jnp.zeros(shape.shape, shape.dtype) for shape in shapes)

    def some(index: Array) -> tuple[Array, ...]:
        shaded = jax.checkpoint(partial(shade, index))
        return jax.lax.cond(jnp.any(index >= 0), shaded, lambda _: none, light)

    return jax.lax.map(some, row.index)


def make(
    scene: Any,
    stage: Stage,
    camera: Camera,
    *,
    samples: int,
    keep: bool,
    shadow: str | Environment,
    between: Between,
) -> PictureView:
    """Finds the shaded points of a picture, and computes what depends on the camera and the materials.

    Args:
        scene: The relit scene.
        stage: The scene and its materials.
        camera: The camera, relative to the origin of the scene.
        samples: Number of coverage samples of each pixel: 1, 4 or 16.
        keep: Whether to store what depends on the view, for many lights: about a kilobyte for each point.
        shadow: "rays" or "vertices", or the light whose brightest texels are traced for all lights.
        between: Function that is called between steps of the work, as in `RelitScene.picture`.

    Raises:
        ValueError: `samples` is not 1, 4 or 16, or `shadow` is another word.
    """
    if isinstance(shadow, Environment):
        check(scene, [shadow])
    elif shadow not in ("rays", "vertices"):
        raise ValueError(f'shadows must be "rays", "vertices" or an Environment, got {require.shown(shadow)}')
    samples, camera, fold = drawn(camera, samples)
    make_room()
    with compile_time(stage.mesh, camera, stage.curvature) if stage.sharp_groups else contextlib.nullcontext():
        pixels, rows = _placed(stage, camera, samples, between)
    rays = isinstance(shadow, Environment) or shadow == "rays"
    lit = lamplight.of(stage, pixels, camera.width) if rays else None
    eye, sharp = jnp.asarray(camera.eye), stage.sharp_groups
    complete, places, origins, narrow = [], [], [], []
    for row in rows:
        index = row.index if row.index.ndim == 1 else row.index[0]
        stores = keep and not isinstance(index, Tracer)
        casts = row.group in sharp or (rays and stage.rays > 0 and stage.finer(row.group) and known(index))
        if not stores and not casts:
            places.append(None)
            continue
        points, on_group = canvas.points_of(stage, pixels, index)
        transport = None if lit is None else lit.row(row.group, index, on_group)
        places.append((points, on_group, transport) if stores else None)
        if casts:
            origin = _origins(stage, row.group, (points, on_group, transport), _turn(pixels, index))
            (origins if row.group in sharp else narrow).append(origin)
    reflected = tracing.trace(stage, origins, eye, keep=keep) if origins else None
    paths = iter(() if reflected is None else reflected.paths)
    missed = iter(tracing.missed_shares(stage, narrow, eye) if narrow else ())
    alone = {origin.group for origin in narrow}
    for row, place in zip(rows, places, strict=True):
        if row.group in sharp:
            row = dataclasses.replace(row, missed=next(paths).missed)
        elif row.group in alone:
            row = dataclasses.replace(row, missed=next(missed))
        if place is not None:
            row = dataclasses.replace(row, viewed=_seen(stage, row, place[0], place[1], camera, lamps=place[2]))
        complete.append(row)
    ray = raster.ray_direction(camera)
    shares, way = None, "vertices"
    if isinstance(shadow, Environment):
        traced = shadows.trace(stage.whole, pixels, camera.width, shadow, keep=False)
        shares = None if traced is None else put(traced.shares)
    else:
        way = shadow
    lamps = () if scene.lamps is None else scene.lamps.names(scene.scene.names)
    more = {"shares": shares, "lamp_rays": rays, "lamps": lamps}
    more |= {"light_size": scene.light_size, "light_step": scene.light_step}
    arriving = eqx.Partial(scene.arriving, stage)
    return PictureView(stage, arriving, camera, pixels, ray, tuple(complete), reflected, fold, way, keep, **more)


def _origins(
    stage: Stage,
    group: int,
    place: tuple[Points, Points, LampTransport | None],
    turn: Int[np.ndarray, " p"] | None,
) -> tracing.RayOrigins:
    """Points of a group from which reflection rays start."""
    points, on_group, transport = place
    blend, tilted = stage.blend(group, points, on_group)
    return tracing.RayOrigins(group, points, tilted, blend, stage.sharp_at(group, points), transport, turn)


def _turn(pixels: Pixels, index: Any) -> Int[np.ndarray, " p"] | None:
    """Which of each four reflection rays points cast that cover little of a pixel, -1 for others; None without such."""
    if not known(pixels, index):
        return None
    coverage = np.asarray(pixels.coverage)[index].reshape(len(index), -1).max(1)
    few = (coverage < _LITTLE) & (index >= 0)
    return np.where(few, np.cumsum(few) % 4, -1) if few.any() else None


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
    stage: Stage, row: Row, points: Points, on_group: Points, camera: Camera, lamps: LampTransport | None = None
) -> Viewed:
    """What does not depend on the light, for a row of points with their materials."""
    surface = sampled(surface_of(stage, row.group), 1)  # The view does not depend on the samples of bright texels.
    options = {"fixed": stage.fixed[row.group], "sharp": stage.sharp_at(row.group, points)}
    options |= {"lamps": lamps, "missed": row.missed, "finer": stage.finer(row.group)}
    return view(surface, on_group, stage.table.at(points), jnp.asarray(camera.eye), **options)


def folded(picture: Float[Array, "h w c"], *, fold: int) -> Float[Array, "_ _ c"]:
    """The picture with squares of `fold` x `fold` pixels averaged to one."""
    return picture if fold == 1 else _folded(picture, fold=fold)


@partial(jit, static_argnames="fold")
def _folded(picture: Float[Array, "h w c"], *, fold: int) -> Float[Array, "_ _ c"]:
    height, width, colors = picture.shape
    return jnp.mean(picture.reshape(height // fold, fold, width // fold, fold, colors), (1, 3))


def _placed(stage: Stage, camera: Camera, samples: int, between: Between) -> tuple[Pixels, list[Row]]:
    """The points of a picture in rows that are shaded alike."""
    detail = curvature.detail(stage.mesh, camera, stage.bend)
    rays = stage.whole.opacity is not None or (samples > 1 and known(detail) and np.any(np.asarray(detail) > 1))
    occluder = caster(stage.whole).occluder if rays else None
    shown = {"hidden": stage.hidden_faces, "occluder": occluder, "detail": detail, "between": between}
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
    for group, parts in enumerate(stage.layout.parts):
        samples = max(stage.layout.of_group(group, stage.samples))
        yield Row(group, samples, canvas.rows_of(jnp.isin(owner, jnp.asarray(parts))), None)


def _rows(stage: Stage, owner: np.ndarray) -> Iterator[Row]:
    """The points in rows by group and number of samples."""
    for group, parts in enumerate(stage.layout.parts):
        for samples in sorted(set(stage.layout.of_group(group, stage.samples))):
            same = [part for part in parts if stage.samples[part] == samples]
            for index in canvas.rows_of(np.isin(owner, same), owner=owner):
                yield Row(group, samples, index, None)
