"""Traced reflections: what sharp parts of a scene reflect of their neighbors, under any light and with any colors.

Rays start from vertices or points and follow the narrow lobes of `jaxprt.systems.bounces.traced`. Each ray reads the
radiance of the front face that it hits: direct light, and light that was reflected before, represented by 16 harmonics.
Rays that hit nothing or a back face contribute nothing, because light of the environment is already part of direct
light. Rays that hit a lamp determine how much of it is visible in the reflection.

Embree casts the rays on the host, once for each eye position and roughness. The hit points are constants. Radiance is
therefore differentiable in the light and in the colors of all materials. Derivatives with respect to the eye or to
roughness raise an error.
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.compile import jit, make_room
from jaxprt.relit.casting import caster
from jaxprt.relit.surface import Surface, at_vertices, lit, look, shaded
from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lamps.relight import beside
from jaxprt.systems.protocol import Blend

CHUNK = 1 << 13  # number of hits that are shaded together
_MOST_RAYS = 1 << 12  # of each vertex or point
_FEWEST = 1 << 10


class Asked(eqx.Module):
    """Vertices or points of a part from which rays start.

    Attributes:
        number: Index of the part.
        blend: Material weights of the vertices or points.
        points: The points; None for all vertices.
        seen: 1 where the eye may see the vertex or point, 0 elsewhere; None for 1 everywhere.
    """

    number: int = eqx.field(static=True)
    blend: Blend | None
    points: Points | None
    seen: Float[Array, " v"] | None = None


class Carried(eqx.Module):
    """The rays of one `Asked`.

    Attributes:
        slot: Index of each ray's hit among all hits; the number of hits if there is none.
        weight: Factor of the radiance that each ray reads.
        lamp: Factor of the radiance of each lamp; None without lamps.
    """

    slot: Int[Array, "j v"]
    weight: Float[Array, "j v c"]
    lamp: Float[Array, "n v c"] | None


class HitRow(eqx.Module):
    """Hits on one part that are shaded together.

    Attributes:
        number: Index of the part.
        points: The hits as points on the part.
        eye: Origin of the ray of each hit.
        variance: Variance of the directions into which a cone around each ray is reflected, in squared radians.
        kept: What `look` returns for the hits; None if it is recomputed for each light.
    """

    number: int = eqx.field(static=True)
    points: Points
    eye: Float[Array, "h 3"]
    variance: Float[Array, " h"]
    kept: PyTree


class Reflections(eqx.Module):
    """The traced reflections of a view.

    Attributes:
        own: The rays of each `Asked`, in the given order.
        hit: The surfaces that they hit.
    """

    own: tuple[Carried, ...]
    hit: tuple[HitRow, ...]

    def radiance(
        self,
        surfaces: Sequence[Surface],
        arriving: tuple[Sequence[PyTree], Sequence[PyTree]],
        lamp: Float[Array, "n 3"] | None,
    ) -> list[Float[Array, "_ c"]]:
        """The reflected radiance that rays add at each vertex or point, one array for each `Asked`.

        Args:
            surfaces: All parts, from `flattened`.
            arriving: Direct light and reflected light of each part.
            lamp: Radiance of each lamp; None without lamps.
        """
        rows, vertices = [], {}
        for each in self.hit:
            make_room()
            surface, number = surfaces[each.number], each.number
            light = arriving[0][number], arriving[1][number], lamp
            matte = _is_matte(surface)
            if matte and number not in vertices:
                vertices[number] = at_vertices(surface, light, each.eye[0])
            own = vertices.get(number)
            if each.kept is None:
                rows.append(
                    shaded(surface, light, own, each.points, each.eye, at_pixels=not matte, variance=each.variance)
                )
            else:
                rows.append(lit(surface, light, own, each.kept))
        return _read(self.own, rows, lamp)


def known(*value: Any) -> bool:
    """Whether no array is traced by JAX."""
    return not any(isinstance(each, Tracer) for each in jax.tree.leaves(value))


def now(*value: Any) -> contextlib.AbstractContextManager:
    """A context in which operations on known arrays are executed at once, even inside `jax.jit`."""
    return jax.ensure_compile_time_eval() if known(*value) else contextlib.nullcontext()


def trace(
    mesh: Mesh, surfaces: Sequence[Surface], asked: Sequence[Asked], eye: Float[Array, "3"], *, keep: bool
) -> Reflections:
    """Casts the reflection rays of some vertices or points.

    Args:
        mesh: The mesh of all parts.
        surfaces: All parts. The parts from which rays start have a `SharpPart`.
        asked: Vertices or points from which rays start.
        eye: Position of the viewer.
        keep: Whether to store what depends on the view of the hits, for many lights.

    Raises:
        ValueError: The eye, the roughness, the points or the scene is traced by JAX.
    """
    plain = [flattened(each) for each in surfaces]
    found, rays = [], []
    for each in asked:
        surface = surfaces[each.number]
        assert isinstance(surface.reflecting, SharpPart)
        parameter = () if each.blend is None else each.blend.parameter
        _check(mesh, surface.reflecting, each.points, eye, parameter)
        with jax.ensure_compile_time_eval():
            rays.append(surface.reflecting.rays(eye, parameter, each.points, each.seen))
            met = caster(mesh).cast(rays[-1], surface.first, each.points)
            found.append((*met, caster(mesh).spread(rays[-1], *met)))
    slots, hit = _rows(mesh, plain, found, keep=keep)
    own = []
    for each, ray, slot, triangle in zip(asked, rays, slots, found, strict=True):
        part = surfaces[each.number].reflecting
        assert isinstance(part, SharpPart)
        weight = part.weights(ray, eye, each.blend, each.points, each.seen)
        met = caster(mesh).part[triangle[0]] if (triangle[0] >= 0).any() else np.zeros_like(triangle[0])
        lamp = _lamps(surfaces, each, np.where(triangle[0] >= 0, met, -1), weight, ray.concentration)
        own.append(Carried(jnp.asarray(slot), weight, lamp))
    return Reflections(tuple(own), hit)


def _lamps(
    surfaces: Sequence[Surface], asked: Asked, met: Int[np.ndarray, "j v"], weight: Array, concentration: Array
) -> Float[Array, "n v c"] | None:
    """Factor of the radiance of each lamp at each vertex or point, given the part that each ray hits (-1 for none)."""
    lit = surfaces[asked.number].lit
    if lit is None:
        return None
    emitting = {each.lamp: number for number, each in enumerate(surfaces) if each.lamp is not None}
    part = np.array([emitting.get(lamp, -2) for lamp in range(lit.transport.lamps)])
    return _seen_lamps(lit.chord(asked.points), jnp.asarray(met == part[:, None, None]), weight, concentration)


@jit
def _seen_lamps(chord: Array, met: Array, weight: Array, concentration: Array) -> Float[Array, "n v c"]:
    share = beside(concentration, chord[:, None]) * met
    return jnp.einsum("njv,jvc->nvc", share, weight, precision="highest")


def split(
    mesh: Mesh,
    surfaces: Sequence[Surface],
    view: PyTree,
    eye: Float[Array, "3"],
    blends: Sequence[Blend | None],
    points: Sequence[Points] | None,
) -> tuple[PyTree, Reflections | None]:
    """Separates traced reflections from the view of the systems. The rays are None if no part is sharp.

    Args:
        mesh: The mesh of all parts.
        surfaces: All parts.
        view: Views of direct light and of bounces, part by part.
        eye: Position of the viewer.
        blends: Material weights of the vertices or points of each part.
        points: Points on each part; None for the vertices.

    Returns:
        The view without what rays represent, and the rays.
    """
    sharp = _sharp(surfaces)
    if not sharp:
        return view, None
    places = points or [None] * len(surfaces)
    faces = _faces(mesh, surfaces, eye, points)
    rows, asked = list(view[1]), []
    for number in sharp:
        asked.append(Asked(number, blends[number], places[number], faces[number]))
        own = surfaces[number].reflecting
        assert isinstance(own, SharpPart)
        rows[number] = rows[number] - own.carried(eye, blends[number], places[number], faces[number])
    return (view[0], tuple(rows)), trace(mesh, surfaces, asked, eye, keep=True)


def traced(
    mesh: Mesh, surfaces: Sequence[Surface], eye: Float[Array, "3"], points: Sequence[Points] | None
) -> list[Float[Array, " _"] | None]:
    """Fraction of narrow lobes that rays represent at the vertices or points of each part; None without rays.

    Args:
        mesh: The mesh of all parts.
        surfaces: All parts.
        eye: Position of the viewer.
        points: Points on each part; None for the vertices.
    """
    sharp = _sharp(surfaces)
    if not sharp:
        return [None] * len(surfaces)
    faces = [jnp.ones(len(each)) for each in points] if points else _faces(mesh, surfaces, eye, points)
    return [each if number in sharp else None for number, each in enumerate(faces)]


def _faces(mesh: Mesh, surfaces: Sequence[Surface], eye: Array, points: Sequence[Points] | None) -> list[Any]:
    """1 for each vertex of each part that the eye may see, 0 for others; None for each part if there are points."""
    if points is not None:
        return [None] * len(surfaces)
    with now(mesh, eye):
        return jnp.split(facing(mesh, eye), [each.first for each in surfaces[1:]])


def read(
    reflected: Reflections,
    surfaces: Sequence[Surface],
    arriving: tuple[Sequence[PyTree], Sequence[PyTree]],
    lamp: Float[Array, "n 3"] | None,
    points: Sequence[Points] | None,
) -> Float[Array, "v c"]:
    """The reflected radiance that rays add at all vertices or points.

    Args:
        reflected: The traced reflections.
        surfaces: All parts.
        arriving: Direct light and reflected light of each part.
        lamp: Radiance of each lamp; None without lamps.
        points: Points on each part; None for the vertices.
    """
    rows = reflected.radiance([flattened(each) for each in surfaces], arriving, lamp)
    counts = [len(each.part.mesh.position) for each in surfaces] if points is None else list(map(len, points))
    own = dict(zip(_sharp(surfaces), rows, strict=True))
    none = jnp.zeros((1, rows[0].shape[1]), rows[0].dtype)
    every = [own.get(number, jnp.broadcast_to(none, (count, none.shape[1]))) for number, count in enumerate(counts)]
    return jnp.concatenate(every)


def _sharp(surfaces: Sequence[Surface]) -> list[int]:
    """Indices of the parts from which rays start."""
    return [number for number, each in enumerate(surfaces) if isinstance(each.reflecting, SharpPart)]


def flattened(surface: Surface) -> Surface:
    """The part as rays see it: it reflects by harmonics alone, and its emission is hidden."""
    part = surface.reflecting
    return dataclasses.replace(surface, reflecting=part.plain if isinstance(part, SharpPart) else part, glows=False)


@jit
def facing(mesh: Mesh, eye: Float[Array, "3"]) -> Float[Array, " v"]:
    """1 for vertices of a triangle whose front faces the eye, 0 for others."""
    a, b, c = (mesh.position[mesh.face[:, k]] for k in range(3))
    across = jnp.cross(b - a, c - a)
    side = jnp.sum(across * jnp.sum(mesh.normal[mesh.face], 1), -1)
    seen = (jnp.sum(across * (eye - a), -1) * side > 0).astype(mesh.position.dtype)
    return jnp.zeros_like(mesh.position[:, 0]).at[mesh.face].max(seen[:, None])


def _check(mesh: Mesh, part: SharpPart, points: Points | None, eye: Any, parameter: Any) -> None:
    names = {"the eye": eye, "the roughness": parameter, "the scene": (mesh, part), "the points": points}
    wrong = [name for name, value in names.items() if not known(value)]
    if wrong:
        raise ValueError(
            f"rays for sharp reflections need concrete values, but {wrong[0]} is traced by JAX: call RelitScene.view "
            "or picture_view outside of jax.jit and jax.grad, or use RelitScene.with_rays(0), which computes all "
            "reflections from harmonics"
        )


def _rows(mesh: Mesh, surfaces: Sequence[Surface], found: Sequence[tuple], *, keep: bool):
    """Slots of all rays; and the hits of each part in rows of few lengths, so that views share compiled programs."""
    cast = caster(mesh)
    shape = [each[0].shape for each in found]
    triangle = np.concatenate([np.zeros(0, int), *(each[0].ravel() for each in found)])
    weight = np.concatenate([np.zeros((0, 3), np.float32), *(each[1].reshape(-1, 3) for each in found)])
    start = np.concatenate([np.zeros((0, 3), np.float32), *(np.tile(each[2], (len(each[0]), 1)) for each in found)])
    variance = np.concatenate([np.zeros(0, np.float32), *(each[3].ravel() for each in found)])
    part = np.where(triangle >= 0, cast.part[triangle], -1)
    slot, rows, total = np.full(len(triangle), -1, np.int32), [], 0
    for number, surface in enumerate(surfaces):
        index = np.flatnonzero(part == number)
        if not len(index):
            continue
        slot[index] = total + np.arange(len(index))
        length = CHUNK if len(index) > CHUNK else max(_FEWEST, 1 << (len(index) - 1).bit_length())
        count = -(-len(index) // length)
        total += count * length
        # Padding repeats the last hit.
        index = np.pad(index, (0, count * length - len(index)), mode="edge").reshape(count, length)
        for each in index:
            points = Points(jnp.asarray(cast.face[triangle[each]].T - surface.first), jnp.asarray(weight[each].T))
            eye, wide = jnp.asarray(start[each]), jnp.asarray(variance[each])
            matte = _is_matte(surface)
            kept = look(surface, points, eye, at_pixels=not matte, variance=wide) if keep else None
            rows.append(HitRow(number, points, eye, wide, kept))
    slot = np.where(slot < 0, total, slot)
    ends = np.cumsum([np.prod(each) for each in shape])[:-1] if shape else []
    return [each.reshape(size) for each, size in zip(np.split(slot, ends), shape, strict=True)], tuple(rows)


def _is_matte(surface: Surface) -> bool:
    """Whether a part looks the same from everywhere, so that the radiance of its vertices serves all rays."""
    return isinstance(surface.shading.brdf, Lambert)


@jit
def _read(own: Sequence[Carried], rows: Sequence[Array], lamp: Array | None) -> list[Array]:
    """The weighted sum over rays of the radiance that they read."""
    colors = max([1, *(each.shape[1] for each in rows)])
    dtype = jnp.result_type(float) if not rows else rows[0].dtype
    flat = [jnp.broadcast_to(each, (len(each), colors)) for each in rows]
    color = jnp.concatenate([*flat, jnp.zeros((1, colors), dtype)])
    result = []
    for each in own:
        pairs = zip(each.slot, each.weight, strict=True)
        read = reduce(jnp.add, (color.at[slot].get(mode="promise_in_bounds") * weight for slot, weight in pairs))
        if lamp is not None and each.lamp is not None:
            read = read + jnp.einsum("nc,nvc->vc", lamp, each.lamp, precision="highest")
        result.append(read)
    return result


def check_rays(rays: Any) -> None:
    """Refuses anything but a number of rays for each vertex or point."""
    if type(rays) is not int or not 0 <= rays <= _MOST_RAYS:
        raise ValueError(f"rays must be a whole number of at least 0, at most {_MOST_RAYS}, got {require.shown(rays)}")
