"""Pictures of scenes: radiance at pixels where it pays, at vertices where it does not, and textures at pixels."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.compile import jit
from jaxprt.image import raster, rasterize, resolve, shading_points
from jaxprt.image.pixels import Pixels
from jaxprt.relit import interpolation, tracing
from jaxprt.relit.channels import at_points
from jaxprt.relit.surface import Surface, at_vertices, lit, look, shaded
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.scene.environment import background
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.protocol import System

CHUNK = 1 << 13  # points that are shaded at once
_FEWEST = 1 << 10
_ERROR = 0.01  # of radiance interpolated between vertices, from where it is made at the pixels


class PartPixels(eqx.Module):
    """The points of one part.

    Attributes:
        number: Of the part.
        at_pixels: Whether radiance is made at the points; else it is made at the vertices and interpolated.
        index: Numbers of the points among all of the picture, in rows that are shaded at once; -1 in padding.
        kept: Of each row what `look` makes; None where that is made anew for each light.
    """

    number: int = eqx.field(static=True)
    at_pixels: bool = eqx.field(static=True)
    index: Int[Array, "m p"]
    kept: tuple[PyTree, ...] | None


class Canvas(eqx.Module):
    """What is shaded in a picture, and where it goes.

    Attributes:
        pixels: The points that are shaded.
        order: Number of each point's color in the list of all colors, row after row.
        ray: Unit directions in the world from the eye through the centers of the pixels; the light behind the scene is
            read along them.
    """

    pixels: Pixels
    order: Int[Array, " p"]
    ray: Float[Array, "h w 3"]


class PictureView(eqx.Module):
    """All of a picture but its light: what `RelitScene.picture_view` makes of a scene, a camera and materials.

    Attributes:
        mesh: The mesh of all parts.
        system: The system of all parts.
        camera: From where.
        surface: The parts.
        canvas: What is shaded, and where it goes.
        part: What is shaded, by parts.
        reflected: What sharp parts show of others, by rays, row after row; None without.
    """

    mesh: Mesh
    system: System
    camera: Camera
    surface: tuple[Surface, ...]
    canvas: Canvas
    part: tuple[PartPixels, ...]
    reflected: tracing.Reflections | None = None

    def picture(self, environment: Environment) -> Float[Array, "h w c"]:
        """The picture in a light, in linear radiance.

        Raises:
            TypeError: The light is no Environment.
            ValueError: The light is a batch, or of another size.
        """
        require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
        if environment.radiance.ndim != 4:
            raise ValueError(f"a picture has one light [6, n, n, c], got {list(environment.radiance.shape)}")
        blends = [each.appearance.blend for each in self.surface]
        arriving = self.system.shade(self.system.light(environment), blends)
        if self.surface[0].reflecting is None:
            arriving = arriving, [None] * len(self.surface)
        direct, reflected = arriving
        rows = [self._rows(own, (direct[own.number], reflected[own.number])) for own in self.part]
        if self.reflected is not None:
            plain = [tracing.flattened(each) for each in self.surface]
            more = iter(self.reflected.radiance(plain, (direct, reflected)))
            sharp = [isinstance(self.surface[own.number].reflecting, SharpPart) for own in self.part]
            rows = [
                each + jnp.stack([next(more) for _ in each]) if traced else each
                for each, traced in zip(rows, sharp, strict=True)
            ]
        return _drawn(self.canvas, rows, environment)

    def _rows(self, own: PartPixels, arriving: tuple[PyTree, PyTree]) -> Float[Array, "m p c"]:
        """Colors of the points of a part."""
        surface, eye = self.surface[own.number], self.camera.eye
        vertices = None if own.at_pixels else at_vertices(surface, arriving, eye)
        if own.kept is not None:
            return jnp.stack([lit(surface, arriving, vertices, view) for view in own.kept])

        def row(index):
            points = _points_of(self.canvas.pixels, self.mesh.face, surface.first, index)
            return shaded(surface, arriving, vertices, points, eye, at_pixels=own.at_pixels)

        if not isinstance(own.index, Tracer):
            return jnp.stack([row(index) for index in own.index])
        shape = jax.eval_shape(row, own.index[0])

        def some(index):
            none = jnp.zeros(shape.shape, shape.dtype)
            return jax.lax.cond(jnp.any(index >= 0), lambda: row(index), lambda: none)

        return jax.lax.map(some, own.index)


class RegionsView(eqx.Module):
    """All of a picture but its light, of a system whose parts are the regions of a mesh: `of_regions` makes it.

    Attributes:
        system: The system.
        materials: The materials of the regions, as `System.view` takes them.
        camera: From where.
        canvas: What is shaded, and where it goes.
        points: The points of each row that is shaded at once, of each region.
        kept: What the system makes of the view of each row; None where that is made anew for each light.
    """

    system: System
    materials: PyTree
    camera: Camera
    canvas: Canvas
    points: tuple[tuple[Points, ...], ...]
    kept: tuple[PyTree, ...] | None

    def picture(self, environment: Environment) -> Float[Array, "h w c"]:
        """The picture in a light, in linear radiance.

        Raises:
            TypeError: The light is no Environment.
            ValueError: The light is a batch, or of another size.
        """
        arriving, rows = self.system.shade(self.system.light(environment), self.materials), []
        for number, points in enumerate(self.points):
            system = self.system.at(points)
            view = system.view(self.camera.eye, self.materials) if self.kept is None else self.kept[number]
            rows.append(system.combine(arriving, view))
        return _drawn(self.canvas, rows, environment)


def make(
    mesh: Mesh, system: System, surfaces: Sequence[Surface], camera: Camera, *, samples: int, keep: bool
) -> PictureView:
    """The view of a scene at the pixels of a camera.

    Args:
        mesh: The mesh of all parts; its regions are their numbers.
        system: The system of all parts.
        surfaces: The parts.
        camera: From where.
        samples: How many places in each pixel tell which surfaces it shows: 4 or 1.
        keep: Whether what systems make of the view is kept for other lights: about a kilobyte for each point.
    """
    if not any(isinstance(each.reflecting, SharpPart) for each in surfaces):
        pixels, rows = _placed(mesh, surfaces, camera, samples)
    else:
        with tracing.now(mesh, camera, [each.curvature for each in surfaces]):
            pixels, rows = _placed(mesh, surfaces, camera, samples)
    parts, asked = [], []
    for number, at_pixels, index in rows:
        surface, kept = surfaces[number], None
        with tracing.now(pixels, mesh.face, index):
            points = [_points_of(pixels, mesh.face, surface.first, each) for each in index]
        if keep and not isinstance(index, Tracer):
            kept = tuple(look(surface, each, camera.eye, at_pixels=at_pixels) for each in points)
        parts.append(PartPixels(number, at_pixels, index, kept))
        if isinstance(surface.reflecting, SharpPart):
            looks = (at_points(surface.part, surface.shading, surface.material, each) for each in points)
            asked += [tracing.Asked(number, *each) for each in zip((look.blend for look in looks), points, strict=True)]
    canvas = _canvas(pixels, [each.index for each in parts], camera)
    reflected = tracing.trace(mesh, surfaces, asked, camera.eye, keep=keep) if asked else None
    return PictureView(mesh, system, camera, tuple(surfaces), canvas, tuple(parts), reflected)


def _placed(
    mesh: Mesh, surfaces: Sequence[Surface], camera: Camera, samples: int
) -> tuple[Pixels, list[tuple[int, bool, Array]]]:
    """The points of a picture; and of each part that it shows whether radiance is made at them, and their numbers."""
    bend = _bends([each.curvature for each in surfaces], mesh.region)
    fragments = rasterize(mesh, camera, samples=samples)
    pixels = shading_points(fragments, mesh, camera, uneven=interpolation.uneven(mesh, camera, bend))
    owner, wrong = _judged(mesh, bend, pixels, camera)
    rows = []
    for number, surface in enumerate(surfaces):
        index = _rows_of(owner == number)
        if index.size:
            rows.append((number, _pays(surface, wrong, index), index))
    return pixels, rows


def of_regions(
    system: System, mesh: Mesh, camera: Camera, *, materials: PyTree = None, samples: int = 4, keep: bool = False
) -> RegionsView:
    """The view of a mesh by a system that takes points of its regions: the dynamic system, alone or with bounces.

    Radiance is made at all pixels. Not for `jax.jit`.

    Args:
        system: The system of the mesh.
        mesh: The mesh.
        camera: From where.
        materials: As the system takes them.
        samples: How many places in each pixel tell which surfaces it shows: 4 or 1.
        keep: Whether what the system makes of the view is kept for other lights: about a kilobyte for each point.
    """
    pixels = shading_points(rasterize(mesh, camera, samples=samples), mesh, camera)
    region, face, triangle = (np.asarray(each) for each in (mesh.region, mesh.face, pixels.triangle))
    owner = np.where(triangle >= 0, region[face[triangle, 0]], -1)
    every = [np.flatnonzero(owner == number) for number in range(region.max() + 1)]
    rows, width = _rows_of(owner == np.argmax([len(each) for each in every])).shape
    index = np.stack([np.pad(each, (0, rows * width - len(each)), constant_values=-1) for each in every])
    index = jnp.asarray(index.reshape(len(every), rows, width).swapaxes(0, 1))
    # Numbers of the vertices in their regions.
    place = np.zeros(len(region), np.int32)
    for number in range(len(every)):
        own = np.flatnonzero(region == number)
        place[own] = np.arange(len(own))
    corner = jnp.asarray(place[face])
    points = tuple(tuple(_points_of(pixels, corner, 0, each) for each in row) for row in index)
    kept = tuple(system.at(each).view(camera.eye, materials) for each in points) if keep else None
    return RegionsView(system, materials, camera, _canvas(pixels, list(index), camera), points, kept)


def _canvas(pixels: Pixels, index: Sequence[Array], camera: Camera) -> Canvas:
    """The canvas of some points. `index` has their numbers in the order in which they are shaded, -1 in padding."""
    every = [each.ravel() for each in index]
    count = len(pixels.triangle)
    if any(isinstance(each, Tracer) for each in every):
        row = jnp.concatenate(every)
        place = jnp.where(row < 0, count, row)
        order = jnp.zeros(count, jnp.int32).at[place].set(jnp.arange(len(row), dtype=jnp.int32), mode="drop")
    else:
        row = np.concatenate([np.zeros(0, np.int32), *every])
        order = np.zeros(count, np.int32)
        order[row[row >= 0]] = np.flatnonzero(row >= 0)
    return Canvas(pixels, jnp.asarray(order), raster.ray_direction(camera))


@jit
def _drawn(canvas: Canvas, rows: Sequence[Array], environment: Environment) -> Float[Array, "h w c"]:
    """The picture of the points with these colors, in rows as they were shaded, in front of the light."""
    sky = background(environment, canvas.ray)
    colors = max([sky.shape[-1], *(each.shape[-1] for each in rows)])
    flat = [jnp.broadcast_to(each, (*each.shape[:-1], colors)).reshape(-1, colors) for each in rows]
    color = jnp.concatenate([*flat, jnp.zeros((1, colors), sky.dtype)])  # Not empty where nothing is seen.
    return resolve(canvas.pixels, color.at[canvas.order].get(mode="promise_in_bounds"), background=sky)


@jit
def _bends(curvature: Sequence[Array], region: Int[Array, " v"]) -> Float[Array, " v"]:
    """Curvature of the BRDF of each vertex."""
    return jnp.stack(curvature)[region]


@jit
def _judged(
    mesh: Mesh, bend: Float[Array, " v"], pixels: Pixels, camera: Camera
) -> tuple[Int[Array, " p"], Float[Array, " p"]]:
    """The part of each point, -1 in padding, and the error that interpolating radiance makes there."""
    wrong = interpolation.error(mesh.position, mesh.normal, mesh.face, camera.eye, bend)
    own = jnp.maximum(pixels.triangle, 0)
    return jnp.where(pixels.triangle >= 0, mesh.region[mesh.face[:, 0]][own], -1), wrong[own]


def _rows_of(chosen: Array | np.ndarray) -> Int[Array, "m p"]:
    """Numbers of the points that are chosen, in rows of few lengths, so that programs serve many pictures."""
    if isinstance(chosen, Tracer):
        count = len(chosen)
        index = jnp.nonzero(chosen, size=count, fill_value=-1)[0]
    else:
        index = np.flatnonzero(np.asarray(chosen))
        count = len(index)
    row = CHUNK if count > CHUNK else max(_FEWEST, 1 << max(count - 1, 0).bit_length())
    rows = -(-count // row)
    # Not by JAX where the number of points is known: that would compile for each number.
    pad = jnp.pad if isinstance(index, Tracer) else np.pad
    return jnp.asarray(pad(index, (0, rows * row - count), constant_values=-1).reshape(rows, row))


def _pays(surface: Surface, wrong: Array, index: Array) -> bool:
    """Whether the radiance of a part is made at its points: it is too far off interpolated, or vertices are more.

    The radiance of what is ideally diffuse is linear in the transfer of the vertices.
    """
    if isinstance(surface.shading.brdf, Lambert):
        return False
    if isinstance(index, Tracer) or isinstance(wrong, Tracer):
        return True
    used = np.asarray(index)
    used = used[used >= 0]
    return len(used) < surface.system.vertices or bool(np.mean(np.asarray(wrong)[used] ** 2) > _ERROR**2)


@jit
def _points_of(pixels: Pixels, face: Int[Array, "f 3"], first: int | Array, index: Int[Array, " p"]) -> Points:
    """Some points of a part of a picture, whose first vertex has a number in the mesh; padding lies on that vertex.

    A program by itself, so that those that shade do not know how many points the picture has, and serve all pictures.
    """
    own = jnp.maximum(index, 0)
    padding = index < 0
    corner = face[jnp.maximum(pixels.triangle[own], 0)].T - first
    # On a vertex, so that its colors are finite.
    weight = jnp.where(padding, jnp.asarray([[1.0], [0], [0]], pixels.barycentric.dtype), pixels.barycentric[own].T)
    slope = jnp.where(padding, 0, jnp.moveaxis(pixels.slope[own], 0, -1))
    return Points(jnp.where(padding, 0, corner), weight, slope)
