"""Pictures of scenes: radiance at pixels where it pays, at vertices where it does not, and textures at pixels."""

from collections.abc import Sequence
from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.compile import Between, finished, jit
from jaxprt.image import rasterize, shading_points
from jaxprt.image.pixels import Pixels
from jaxprt.relit import interpolation
from jaxprt.relit.canvas import Canvas, drawn, lay_out, points_of, rows_of
from jaxprt.relit.channels import Appearance, Shading, at_points
from jaxprt.scene import Camera, Environment, Mesh, Part
from jaxprt.scene.points import Points
from jaxprt.systems.bounces import ReflectingPart
from jaxprt.systems.lamps import LitByLamps
from jaxprt.systems.protocol import Blend, System

_ERROR = 0.01  # of radiance interpolated between vertices, from where it is made at the pixels


class Surface(eqx.Module):
    """A part of a scene as pictures shade it.

    Attributes:
        part: The part.
        first: Number of its first vertex in the mesh of all parts.
        shading: What it is to systems.
        system: The system of its direct light.
        reflecting: What it makes of light that arrives from other surfaces; None without.
        lit: What it makes of the light of lamps; None without.
        appearance: Its material at the vertices.
        material: What has its material at points: a `TexturedMaterial`, an `Appearance` at the vertices, or None for
            the part's own.
        curvature: How sharp its radiance is, from `interpolation.curvature`.
    """

    part: Part
    first: int = eqx.field(static=True)
    shading: Shading
    system: System
    reflecting: ReflectingPart | None
    lit: LitByLamps | None
    appearance: Appearance
    material: Any
    curvature: Float[Array, ""]


class PartPixels(eqx.Module):
    """The points of one part.

    Attributes:
        number: Of the part.
        at_pixels: Whether radiance is made at the points; else it is made at the vertices and interpolated.
        index: Numbers of the points among all of the picture, in rows that are shaded at once; -1 in padding.
        kept: Of each row what `_viewed` makes; None where that is made anew for each light.
    """

    number: int = eqx.field(static=True)
    at_pixels: bool = eqx.field(static=True)
    index: Int[Array, "m p"]
    kept: tuple[PyTree, ...] | None


class PictureView(eqx.Module):
    """All of a picture but its light: what `RelitScene.picture_view` makes of a scene, a camera and materials.

    Attributes:
        mesh: The mesh of all parts.
        system: The system of all parts.
        camera: From where.
        surface: The parts.
        canvas: What is shaded, and where it goes.
        part: What is shaded, by parts.
        lamp: Radiance of each lamp; None without.
    """

    mesh: Mesh
    system: System
    camera: Camera
    surface: tuple[Surface, ...]
    canvas: Canvas
    part: tuple[PartPixels, ...]
    lamp: Float[Array, "n 3"] | None

    def picture(self, environment: Environment, *, between: Between = None) -> Float[Array, "h w c"]:
        """The picture in a light, in linear radiance. `between` is that of `RelitScene.picture`.

        Raises:
            TypeError: The light is no Environment.
            ValueError: The light is a batch, or of another size.
        """
        require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
        if environment.radiance.ndim != 4:
            raise ValueError(f"a picture has one light [6, n, n, c], got {list(environment.radiance.shape)}")
        blends = [each.appearance.blend for each in self.surface]
        arriving = finished(self.system.shade(self.system.light(environment), blends), between)
        if self.surface[0].reflecting is None:
            arriving = arriving, [None] * len(self.surface)
        direct, reflected = arriving
        arrived = ((own, (direct[own.number], reflected[own.number], self.lamp)) for own in self.part)
        rows = [self._rows(*each, between) for each in arrived]
        return drawn(self.canvas, rows, environment)

    def _rows(
        self, own: PartPixels, arriving: tuple[PyTree, PyTree, PyTree], between: Between
    ) -> Float[Array, "m p c"]:
        """Colors of the points of a part."""
        surface, eye = self.surface[own.number], self.camera.eye
        vertices = None if own.at_pixels else finished(_at_vertices(surface, arriving, eye), between)
        if own.kept is not None:
            return jnp.stack([finished(_lit(surface, arriving, vertices, view), between) for view in own.kept])

        def shaded(index):
            points = points_of(self.canvas.pixels, self.mesh.face, surface.first, index)
            return finished(_shaded(surface, arriving, vertices, points, eye, at_pixels=own.at_pixels), between)

        if not isinstance(own.index, Tracer):
            return jnp.stack([shaded(index) for index in own.index])
        shape = jax.eval_shape(shaded, own.index[0])

        def some(index):
            none = jnp.zeros(shape.shape, shape.dtype)
            return jax.lax.cond(jnp.any(index >= 0), lambda: shaded(index), lambda: none)

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
    """The view of a scene at the pixels of a camera.

    Args:
        mesh: The mesh of all parts; its regions are their numbers.
        system: The system of all parts.
        surfaces: The parts.
        camera: From where.
        lamp: Radiance of each lamp; None without.
        samples: How many places in each pixel tell which surfaces it shows: 4 or 1.
        keep: Whether what systems make of the view is kept for other lights: about a kilobyte for each point.
        between: As in `RelitScene.picture`.
    """
    bend = _bends([each.curvature for each in surfaces], mesh.region)
    fragments = finished(rasterize(mesh, camera, samples=samples), between)
    pixels = shading_points(fragments, mesh, camera, uneven=interpolation.uneven(mesh, camera, bend))
    finished(pixels, between)
    owner, wrong = _judged(mesh, bend, pixels, camera)
    parts = []
    for number, surface in enumerate(surfaces):
        index = rows_of(owner == number)
        if not index.size:
            continue
        at_pixels = _pays(surface, wrong, index)
        kept = None
        if keep and not isinstance(index, Tracer):
            points = (points_of(pixels, mesh.face, surface.first, each) for each in index)
            kept = tuple(_viewed(surface, each, camera.eye, at_pixels=at_pixels) for each in points)
        parts.append(PartPixels(number, at_pixels, index, kept))
    canvas = lay_out(pixels, [each.index for each in parts], camera)
    return PictureView(mesh, system, camera, tuple(surfaces), canvas, tuple(parts), lamp)


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


@partial(jit, static_argnames="at_pixels")
def _viewed(surface: Surface, points: Points, eye: Array, *, at_pixels: bool) -> tuple[Points, Appearance, PyTree]:
    """Some points of a part, the material there, and what systems make of the view of them."""
    appearance = at_points(surface.part, surface.shading, surface.material, points)
    return points, appearance, _view(surface, eye, points, appearance.blend) if at_pixels else None


@jit
def _lit(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    vertices: Float[Array, "k v c"] | None,
    viewed: tuple[Points, Appearance, PyTree],
) -> Float[Array, "p c"]:
    """Colors of some points of a part: of the light that arrives, or of radiance at the vertices."""
    points, appearance, view = viewed
    if vertices is None:
        color = _combine(surface, arriving, view, points)
    elif appearance.blend is None:
        color = points.carry(vertices[0])
    else:
        weight = jnp.moveaxis(appearance.blend.weight, 1, 0)
        color = reduce(jnp.add, (points.carry(own) * each for own, each in zip(vertices, weight, strict=True)))
    return color if appearance.emitted is None else color + appearance.emitted


@partial(jit, static_argnames="at_pixels")
def _shaded(surface, arriving, vertices, points: Points, eye, *, at_pixels: bool) -> Array:
    """Colors of some points of a part. For derivatives what is between is made again, not kept."""

    def both(surface, arriving, vertices, eye):
        viewed = _viewed(surface, points, eye, at_pixels=at_pixels)
        return _lit(surface, arriving, vertices, viewed)

    return jax.checkpoint(both)(surface, arriving, vertices, eye)


@jit
def _at_vertices(surface: Surface, arriving: tuple[PyTree, PyTree, PyTree], eye: Array) -> Float[Array, "k v c"]:
    """Radiance of the vertices of a part, of each channel of its BRDF by itself."""
    blend = surface.appearance.blend
    if blend is None:
        return _combine(surface, arriving, _view(surface, eye, None, None), None)[None]
    rows = []
    for channel in range(blend.weight.shape[1]):
        one = jnp.zeros_like(blend.weight[..., :1]).at[:, channel].set(1)
        rows.append(_combine(surface, arriving, _view(surface, eye, None, Blend(one, blend.parameter)), None))
    return jnp.stack(rows)


def _view(surface: Surface, eye: Array, points: Points | None, blend: Blend | None) -> tuple[PyTree, PyTree, PyTree]:
    """What the systems of a part make of a view, at points or at the vertices."""
    system = surface.system if points is None else surface.system.at(points)
    reflected, lit = (
        None if each is None else each.view(eye, blend, points) for each in (surface.reflecting, surface.lit)
    )
    return system.view(eye, blend), reflected, lit


def _combine(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    view: tuple[PyTree, PyTree, PyTree],
    points: Points | None,
) -> Array:
    """Radiance of the systems of a part."""
    system = surface.system if points is None else surface.system.at(points)
    color = system.combine(arriving[0], view[0])
    if surface.reflecting is not None:
        color = color + surface.reflecting.combine(arriving[1], view[1], points)
    return color if surface.lit is None else color + surface.lit.combine(arriving[2], view[2])
