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
from jaxprt.image import raster, rasterize, resolve, shading_points
from jaxprt.image.pixels import Pixels
from jaxprt.relit import interpolation
from jaxprt.relit.channels import Appearance, Shading, at_points
from jaxprt.scene import Camera, Environment, Mesh, Part
from jaxprt.scene.environment import background
from jaxprt.scene.points import Points
from jaxprt.systems.bounces import ReflectingPart
from jaxprt.systems.protocol import Blend, System

CHUNK = 1 << 13  # points that are shaded at once
_FEWEST = 1 << 10
_ERROR = 0.01  # of radiance interpolated between vertices, from where it is made at the pixels


class Surface(eqx.Module):
    """A part of a scene as pictures shade it.

    Attributes:
        part: The part.
        first: Number of its first vertex in the mesh of all parts.
        shading: What it is to systems.
        system: The system of its direct light.
        reflecting: What it makes of light that arrives from other surfaces; None without.
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
        pixels: What is shaded.
        part: The same, by parts.
    """

    mesh: Mesh
    system: System
    camera: Camera
    surface: tuple[Surface, ...]
    pixels: Pixels
    part: tuple[PartPixels, ...]

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
        rows = [self._rows(own, (arriving[0][own.number], arriving[1][own.number])) for own in self.part]
        colors = max((each.shape[-1] for each in rows), default=environment.radiance.shape[-1])
        color = jnp.zeros((len(self.pixels.triangle), colors), self.mesh.position.dtype)
        for own, row in zip(self.part, rows, strict=True):
            place = jnp.where(own.index < 0, len(color), own.index).ravel()
            color = color.at[place].set(row.reshape(-1, row.shape[-1]), mode="drop")
        sky = background(environment, raster.ray_direction(self.camera))
        return resolve(self.pixels, color, background=sky)

    def _rows(self, own: PartPixels, arriving: tuple[PyTree, PyTree]) -> Float[Array, "m p c"]:
        """Colors of the points of a part."""
        surface, eye = self.surface[own.number], self.camera.eye
        vertices = None if own.at_pixels else _at_vertices(surface, arriving, eye)
        if own.kept is not None:
            return jnp.stack([_lit(surface, arriving, vertices, view) for view in own.kept])
        given = surface, arriving, vertices, self.pixels, self.mesh.face
        shaded = partial(_shaded, *given, eye=eye, at_pixels=own.at_pixels)
        if not isinstance(own.index, Tracer):
            return jnp.stack([shaded(index=index) for index in own.index])
        shape = jax.eval_shape(shaded, index=own.index[0])

        def some(index):
            none = jnp.zeros(shape.shape, shape.dtype)
            return jax.lax.cond(jnp.any(index >= 0), lambda: shaded(index=index), lambda: none)

        return jax.lax.map(some, own.index)


def make(
    mesh: Mesh, system: System, surfaces: Sequence[Surface], camera: Camera, *, samples: int, keep: bool
) -> PictureView:
    """The view of a scene at the pixels of a camera.

    Args:
        mesh: The mesh of all parts; its regions are their numbers.
        system: The system of all parts.
        surfaces: The parts.
        camera: From where.
        samples: Of each pixel's coverage, 4 or 1.
        keep: Whether what systems make of the view is kept for other lights: about a kilobyte for each point.
    """
    bend = jnp.stack([each.curvature for each in surfaces])[mesh.region]
    fragments = rasterize(mesh, camera, samples=samples)
    pixels = shading_points(fragments, mesh, camera, uneven=interpolation.uneven(mesh, camera, bend))
    owner, wrong = _judged(mesh, bend, pixels, camera)
    parts = []
    for number, surface in enumerate(surfaces):
        index = _rows_of(owner == number)
        if not index.size:
            continue
        at_pixels = _pays(surface, wrong, index)
        kept = None
        if keep and not isinstance(index, Tracer):
            kept = tuple(_viewed(surface, pixels, mesh.face, each, camera.eye, at_pixels=at_pixels) for each in index)
        parts.append(PartPixels(number, at_pixels, index, kept))
    return PictureView(mesh, system, camera, tuple(surfaces), pixels, tuple(parts))


@jax.jit
def _judged(
    mesh: Mesh, bend: Float[Array, " v"], pixels: Pixels, camera: Camera
) -> tuple[Int[Array, " p"], Float[Array, " p"]]:
    """The part of each point, -1 in padding, and the error that interpolating radiance makes there."""
    wrong = interpolation.error(mesh.position, mesh.normal, mesh.face, camera.eye, bend)
    own = jnp.maximum(pixels.triangle, 0)
    return jnp.where(pixels.triangle >= 0, mesh.region[mesh.face[:, 0]][own], -1), wrong[own]


def _rows_of(chosen: Array) -> Int[Array, "m p"]:
    """Numbers of the points that are chosen, in rows of few lengths, so that programs serve many pictures."""
    if isinstance(chosen, Tracer):
        count = len(chosen)
        index = jnp.nonzero(chosen, size=count, fill_value=-1)[0]
    else:
        index = np.flatnonzero(np.asarray(chosen))
        count = len(index)
    row = CHUNK if count > CHUNK else max(_FEWEST, 1 << max(count - 1, 0).bit_length())
    rows = -(-count // row)
    return jnp.pad(index, (0, rows * row - count), constant_values=-1).reshape(rows, row)


def _pays(surface: Surface, wrong: Array, index: Array) -> bool:
    """Whether the radiance of a part is made at its points: it is too far off interpolated, or vertices are more.

    The radiance of what is ideally diffuse is linear in the transfer of the vertices.
    """
    if isinstance(surface.shading.brdf, Lambert):
        return False
    if isinstance(index, Tracer) or isinstance(wrong, Tracer):
        return True
    used = np.asarray(index[index >= 0])
    return len(used) < surface.system.vertices or bool(np.mean(np.asarray(wrong)[used] ** 2) > _ERROR**2)


@partial(jax.jit, static_argnames="at_pixels")
def _viewed(
    surface: Surface, pixels: Pixels, face: Array, index: Array, eye: Array, *, at_pixels: bool
) -> tuple[Points, Appearance, PyTree]:
    """Some points of a part, the material there, and what systems make of the view of them."""
    own = jnp.maximum(index, 0)
    padding = index < 0
    corner = face[jnp.maximum(pixels.triangle[own], 0)].T - surface.first
    # Padding lies on the first vertex, so that its colors are finite.
    weight = jnp.where(padding, jnp.asarray([[1.0], [0], [0]], pixels.barycentric.dtype), pixels.barycentric[own].T)
    slope = jnp.where(padding, 0, jnp.moveaxis(pixels.slope[own], 0, -1))
    points = Points(jnp.where(padding, 0, corner), weight, slope)
    appearance = at_points(surface.part, surface.shading, surface.material, points)
    return points, appearance, _view(surface, eye, points, appearance.blend) if at_pixels else None


@jax.jit
def _lit(
    surface: Surface,
    arriving: tuple[PyTree, PyTree],
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
        rows = (points.carry(own) * appearance.blend.weight[:, k] for k, own in enumerate(vertices))
        color = reduce(jnp.add, rows)
    return color if appearance.emitted is None else color + appearance.emitted


@partial(jax.jit, static_argnames="at_pixels")
def _shaded(surface, arriving, vertices, pixels, face, index, eye, *, at_pixels: bool) -> Array:
    """Colors of some points of a part. For derivatives what is between is made again, not kept."""

    def both(surface, arriving, vertices, eye):
        viewed = _viewed(surface, pixels, face, index, eye, at_pixels=at_pixels)
        return _lit(surface, arriving, vertices, viewed)

    return jax.checkpoint(both)(surface, arriving, vertices, eye)


@jax.jit
def _at_vertices(surface: Surface, arriving: tuple[PyTree, PyTree], eye: Array) -> Float[Array, "k v c"]:
    """Radiance of the vertices of a part, of each channel of its BRDF by itself."""
    blend = surface.appearance.blend
    if blend is None:
        return _combine(surface, arriving, _view(surface, eye, None, None), None)[None]
    rows = []
    for channel in range(blend.weight.shape[1]):
        one = jnp.zeros_like(blend.weight[..., :1]).at[:, channel].set(1)
        rows.append(_combine(surface, arriving, _view(surface, eye, None, Blend(one, blend.parameter)), None))
    return jnp.stack(rows)


def _view(surface: Surface, eye: Array, points: Points | None, blend: Blend | None) -> tuple[PyTree, PyTree]:
    """What the systems of a part make of a view, at points or at the vertices."""
    system = surface.system if points is None else surface.system.at(points)
    reflecting = surface.reflecting
    return system.view(eye, blend), None if reflecting is None else reflecting.view(eye, blend, points)


def _combine(
    surface: Surface, arriving: tuple[PyTree, PyTree], view: tuple[PyTree, PyTree], points: Points | None
) -> Array:
    """Radiance of the systems of a part."""
    system = surface.system if points is None else surface.system.at(points)
    color = system.combine(arriving[0], view[0])
    return color if surface.reflecting is None else color + surface.reflecting.combine(arriving[1], view[1], points)
