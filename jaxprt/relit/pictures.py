"""Pictures of scenes. Radiance is computed at pixels where interpolation between vertices would be too inaccurate."""

import dataclasses
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.compile import Between, finished, jit, make_room, promoted
from jaxprt.image import rasterize, shading_points
from jaxprt.image.pixels import Pixels
from jaxprt.relit import interpolation, tracing
from jaxprt.relit.canvas import Canvas, drawn, lay_out, points_of, rows_of
from jaxprt.relit.channels import at_points
from jaxprt.relit.surface import Surface, at_vertices, lit, look, shaded
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.scene.camera import localized
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.protocol import System

# Samples that are drawn in each drawn pixel, and edge in drawn pixels of a pixel, by samples of a pixel.
SAMPLES = {1: (1, 1), 4: (4, 1), 16: (4, 2)}
_ERROR = 0.01  # RMS error of interpolated radiance above which radiance is computed at the pixels


class PartPixels(eqx.Module):
    """The points of a picture that lie on one part.

    Attributes:
        number: Index of the part.
        at_pixels: Whether radiance is computed at the points. If not, it is computed at the vertices and interpolated.
        index: Indices of the points among all points of the picture, in rows that are shaded together; -1 is padding.
        kept: What `look` returns for each row; None if it is recomputed for each light.
    """

    number: int = eqx.field(static=True)
    at_pixels: bool = eqx.field(static=True)
    index: Int[Array, "m p"]
    kept: tuple[PyTree, ...] | None


class PictureView(eqx.Module):
    """All of a picture that does not depend on the light; `RelitScene.picture_view` makes it.

    Attributes:
        mesh: The mesh of all parts.
        system: The system of all parts.
        camera: The camera of the drawn pixels.
        surface: One `Surface` for each part.
        canvas: The points that are shaded, and their pixels.
        fold: Edge in drawn pixels of the squares that are averaged to one pixel of the picture.
        part: The points of each part that the picture shows.
        lamp: Radiance of each lamp; None without lamps.
        reflected: Traced reflections of the sharp parts, one entry for each row of points; None without.
    """

    mesh: Mesh
    system: System
    camera: Camera
    surface: tuple[Surface, ...]
    canvas: Canvas
    part: tuple[PartPixels, ...]
    lamp: Float[Array, "n 3"] | None
    reflected: tracing.Reflections | None = None
    fold: int = eqx.field(static=True, default=1)

    @promoted
    def picture(self, environment: Environment, *, between: Between = None) -> Float[Array, "h w c"]:
        """Renders the picture under an environment, in linear radiance.

        `between` is a function that is called between steps of the work, as in `RelitScene.picture`.

        Raises:
            TypeError: `environment` is not an `Environment`.
            ValueError: The environment is a batch, or has another size than the systems require.
        """
        require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
        require.colors("the light", environment.radiance)
        if environment.radiance.ndim != 4:
            raise ValueError(f"a picture needs one light [6, n, n, c], got {list(environment.radiance.shape)}")
        blends = [each.appearance.blend for each in self.surface]
        arriving = finished(self.system.shade(self.system.light(environment), blends), between)
        if self.surface[0].reflecting is None:
            arriving = arriving, [None] * len(self.surface)
        direct, reflected = arriving
        arrived = ((own, (direct[own.number], reflected[own.number], self.lamp)) for own in self.part)
        rows = [self._rows(*each, between) for each in arrived]
        if self.reflected is not None:
            plain = [tracing.flattened(each) for each in self.surface]
            more = iter(self.reflected.radiance(plain, (direct, reflected), self.lamp))
            sharp = [isinstance(self.surface[own.number].reflecting, SharpPart) for own in self.part]
            rows = [
                each + jnp.stack([next(more) for _ in each]) if traced else each
                for each, traced in zip(rows, sharp, strict=True)
            ]
        return _folded(drawn(self.canvas, rows, environment), fold=self.fold)

    def _rows(
        self, own: PartPixels, arriving: tuple[PyTree, PyTree, PyTree], between: Between
    ) -> Float[Array, "m p c"]:
        """Colors of the points of a part."""
        make_room()
        surface, eye = self.surface[own.number], self.camera.eye
        vertices = None if own.at_pixels else finished(at_vertices(surface, arriving, eye), between)
        if own.kept is not None:
            return jnp.stack([finished(lit(surface, arriving, vertices, view), between) for view in own.kept])

        def row(index):
            points = points_of(self.canvas.pixels, self.mesh.face, surface.first, index)
            return finished(shaded(surface, arriving, vertices, points, eye, at_pixels=own.at_pixels), between)

        if not isinstance(own.index, Tracer):
            return jnp.stack([row(index) for index in own.index])
        shape = jax.eval_shape(row, own.index[0])

        def some(index):
            none = jnp.zeros(shape.shape, shape.dtype)
            return jax.lax.cond(jnp.any(index >= 0), lambda: row(index), lambda: none)

        return jax.lax.map(some, own.index)


def make(
    mesh: Mesh,
    system: System,
    surfaces: Sequence[Surface],
    camera: Camera,
    *,
    lamp: Float[Array, "n 3"] | None,
    samples: int,
    keep: bool,
    between: Between,
) -> PictureView:
    """Finds the shaded points of a picture, and computes what depends on the camera and the materials.

    Args:
        mesh: The mesh of all parts; its regions are the indices of the parts.
        system: The system of all parts.
        surfaces: One `Surface` for each part.
        camera: The camera.
        lamp: Radiance of each lamp; None without lamps.
        samples: Number of coverage samples of each pixel: 1, 4 or 16.
        keep: Whether to store what depends on the view, for many lights: about a kilobyte for each point.
        between: Function that is called between steps of the work, as in `RelitScene.picture`.

    Raises:
        ValueError: `samples` is not 1, 4 or 16.
    """
    if type(samples) is not int or samples not in SAMPLES:
        raise ValueError(f"samples must be 1, 4 or 16, got {samples!r}")
    samples, fold = SAMPLES[samples]
    mesh, camera = localized(mesh, camera)
    camera = dataclasses.replace(camera, width=fold * camera.width, height=fold * camera.height)
    if not any(isinstance(each.reflecting, SharpPart) for each in surfaces):
        pixels, rows = _placed(mesh, surfaces, camera, samples, between)
    else:
        with tracing.now(mesh, camera, [each.curvature for each in surfaces]):
            pixels, rows = _placed(mesh, surfaces, camera, samples, between)
    parts, asked = [], []
    for number, at_pixels, index in rows:
        surface, kept = surfaces[number], None
        with tracing.now(pixels, mesh.face, index):
            points = [points_of(pixels, mesh.face, surface.first, each) for each in index]
        if keep and not isinstance(index, Tracer):
            kept = tuple(look(surface, each, camera.eye, at_pixels=at_pixels) for each in points)
        parts.append(PartPixels(number, at_pixels, index, kept))
        if isinstance(surface.reflecting, SharpPart):
            looks = (at_points(surface.part, surface.shading, surface.material, each) for each in points)
            asked += [tracing.Asked(number, *each) for each in zip((look.blend for look in looks), points, strict=True)]
    canvas = lay_out(pixels, [each.index for each in parts], camera)
    reflected = tracing.trace(mesh, surfaces, asked, jnp.asarray(camera.eye), keep=keep) if asked else None
    return PictureView(mesh, system, camera, tuple(surfaces), canvas, tuple(parts), lamp, reflected, fold)


@partial(jit, static_argnames="fold")
def _folded(picture: Float[Array, "h w c"], *, fold: int) -> Float[Array, "_ _ c"]:
    """The picture with squares of `fold` x `fold` pixels averaged to one."""
    height, width, colors = picture.shape
    return jnp.mean(picture.reshape(height // fold, fold, width // fold, fold, colors), (1, 3))


def _placed(
    mesh: Mesh, surfaces: Sequence[Surface], camera: Camera, samples: int, between: Between
) -> tuple[Pixels, list[tuple[int, bool, Array]]]:
    """The points of a picture. For each visible part: its index, whether to shade at its points, and their indices."""
    bend = _bends([each.curvature for each in surfaces], mesh.region)
    fragments = finished(rasterize(mesh, camera, samples=samples), between)
    pixels = shading_points(fragments, mesh, camera, uneven=interpolation.uneven(mesh, camera, bend))
    finished(pixels, between)
    owner, wrong = _judged(mesh, bend, pixels, camera)
    rows = []
    for number, surface in enumerate(surfaces):
        index = rows_of(owner == number)
        if index.size:
            rows.append((number, _pays(surface, wrong, index), index))
    return pixels, rows


@jit
def _bends(curvature: Sequence[Array], region: Int[Array, " v"]) -> Float[Array, " v"]:
    """Curvature of the radiance of each vertex's part."""
    return jnp.stack(curvature)[region]


@jit
def _judged(
    mesh: Mesh, bend: Float[Array, " v"], pixels: Pixels, camera: Camera
) -> tuple[Int[Array, " p"], Float[Array, " p"]]:
    """The part of each point (-1 in padding), and the relative error of radiance that is interpolated there."""
    wrong = interpolation.error(mesh.position, mesh.normal, mesh.face, camera.eye, bend)
    own = jnp.maximum(pixels.triangle, 0)
    return jnp.where(pixels.triangle >= 0, mesh.region[mesh.face[:, 0]][own], -1), wrong[own]


def _pays(surface: Surface, wrong: Array, index: Array) -> bool:
    """Whether to compute radiance at the points of a part.

    It is done if interpolation between vertices is too inaccurate, or if the part has more vertices than points. Not
    for Lambertian parts, because their radiance is linear in the interpolated transfer.
    """
    if isinstance(surface.shading.brdf, Lambert):
        return False
    if isinstance(index, Tracer) or isinstance(wrong, Tracer):
        return True
    used = np.asarray(index)
    used = used[used >= 0]
    return len(used) < surface.system.vertices or bool(np.mean(np.asarray(wrong)[used] ** 2) > _ERROR**2)
