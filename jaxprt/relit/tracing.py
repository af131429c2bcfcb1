"""Reflections by rays: what the sharp parts of a scene show of their neighbors, in any light and in any colors.

Rays go from vertices or points along the narrow lobes of `jaxprt.systems.bounces.traced`, and read the radiance of the
fronts that they meet: direct light, and what is reflected as far as 16 harmonics tell it. Rays that meet nothing, or a
back, bring nothing, since the light of the sky is direct light. They leave out what lamps emit, whose highlights are
those of `jaxprt.lamps`.

Embree casts the rays on the host, once for each eye and roughness. Where they hit is a constant: radiance is
differentiable in the light and in the colors of all materials, and its derivative by the eye or by roughness is
refused.
"""

import collections
import contextlib
import dataclasses
import threading
import weakref
from collections.abc import Sequence
from functools import cached_property, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, PyTree

from jaxprt.brdf import Lambert
from jaxprt.compile import jit
from jaxprt.relit.surface import Surface, at_vertices, lit, look, shaded
from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import Rays, SharpPart
from jaxprt.systems.protocol import Blend
from jaxprt.visibility import Occluder, point_starts, start_points
from jaxprt.visibility.hits import first_fronts

CHUNK = 1 << 13  # hits that are shaded at once
_FEWEST = 1 << 10
_KEPT = 4  # scenes whose triangles Embree holds


class Asked(eqx.Module):
    """Vertices or points of a part that rays start from.

    Attributes:
        number: Of the part.
        blend: What they are made of.
        points: The points; None for all vertices.
        seen: Whether the eye may see each; None for all.
    """

    number: int = eqx.field(static=True)
    blend: Blend | None
    points: Points | None
    seen: Float[Array, " v"] | None = None


class Carried(eqx.Module):
    """The rays of what was asked for.

    Attributes:
        slot: Number of the hit of each ray among all; one more than there are for none.
        weight: What its radiance is multiplied by.
    """

    slot: Int[Array, "j v"]
    weight: Float[Array, "j v c"]


class HitRow(eqx.Module):
    """Hits on a part that are shaded at once.

    Attributes:
        number: Of the part.
        points: Where on it.
        eye: Where the ray of each came from.
        kept: What systems make of that view; None where it is made anew for each light.
    """

    number: int = eqx.field(static=True)
    points: Points
    eye: Float[Array, "h 3"]
    kept: PyTree


class Reflections(eqx.Module):
    """A view by rays.

    Attributes:
        own: The rays, in the order in which they were asked for.
        hit: What they meet.
    """

    own: tuple[Carried, ...]
    hit: tuple[HitRow, ...]

    def radiance(
        self,
        surfaces: Sequence[Surface],
        arriving: tuple[Sequence[PyTree], Sequence[PyTree]],
        lamp: Float[Array, "n 3"] | None,
    ) -> list[Float[Array, "_ c"]]:
        """What rays add to the radiance of what was asked for.

        Args:
            surfaces: All parts, from `flattened`.
            arriving: Direct light and reflected light of each.
            lamp: Radiance of each lamp; None without.
        """
        rows, vertices = [], {}
        for each in self.hit:
            surface, number = surfaces[each.number], each.number
            light = arriving[0][number], arriving[1][number], lamp
            matte = _is_matte(surface)
            if matte and number not in vertices:
                vertices[number] = at_vertices(surface, light, each.eye[0])
            own = vertices.get(number)
            if each.kept is None:
                rows.append(shaded(surface, light, own, each.points, each.eye, at_pixels=not matte))
            else:
                rows.append(lit(surface, light, own, each.kept))
        return _read(self.own, rows)


class Caster:
    """The triangles of a scene, as rays meet them.

    Args:
        mesh: The mesh of all parts; its regions are their numbers.
    """

    def __init__(self, mesh: Mesh):
        self.mesh, self.occluder = mesh, Occluder(mesh)
        self.face, self.normal = np.asarray(mesh.face), np.asarray(mesh.normal)
        self.part = np.asarray(mesh.region)[self.face[:, 0]]

    @cached_property
    def start(self) -> Float[np.ndarray, "v 3"]:
        """Where the rays of vertices start."""
        return start_points(self.mesh, self.occluder)

    def cast(
        self, rays: Rays, first: int, points: Points | None
    ) -> tuple[Int[np.ndarray, "j v"], Float[np.ndarray, "j v 3"], Float[np.ndarray, "v 3"]]:
        """The triangle that each ray meets, -1 for none, the weights of its corners, and where the rays start.

        Args:
            rays: Of vertices or points of a part.
            first: Number of the part's first vertex.
            points: The points; None for the vertices.
        """
        way, chance = np.asarray(rays.direction, np.float32), np.asarray(rays.chance)
        if points is None:
            corner = first + np.arange(way.shape[1])[:, None]
            start = self.start[corner[:, 0]]
        else:
            corner = first + np.asarray(points.corner).T
            start = point_starts(self.mesh, Points(jnp.asarray(corner.T), points.weight), self.occluder)
        ray, own = np.nonzero(chance > 0)
        triangle, barycentric = np.full(chance.shape, -1), np.zeros((*chance.shape, 3), np.float32)
        found, weight = first_fronts(self.occluder, self.normal, start[own], np.ascontiguousarray(way[ray, own]))
        # A ray that starts below its own triangle, or below one around its own vertex, meets that.
        met = self.face[found]
        itself = np.all(met == corner[own], 1) if points is not None else np.any(met == corner[own], 1)
        triangle[ray, own], barycentric[ray, own] = np.where(itself, -1, found), weight
        return triangle, barycentric, start


_CASTERS: collections.OrderedDict[int, tuple[Any, Caster]] = collections.OrderedDict()
_LOCK = threading.Lock()


def caster(mesh: Mesh) -> Caster:
    """The triangles of a scene, in Embree's form, which is kept for the last few scenes."""
    key = id(mesh.position)
    with _LOCK:
        alive, kept = _CASTERS.get(key, (lambda: None, None))
        if kept is not None and alive() is mesh.position:
            _CASTERS.move_to_end(key)
            return kept
        made = Caster(mesh)
        _CASTERS[key] = weakref.ref(mesh.position), made
        while len(_CASTERS) > _KEPT:
            _CASTERS.popitem(last=False)
        return made


def known(*value: Any) -> bool:
    """Whether JAX traces none of the arrays."""
    return not any(isinstance(each, Tracer) for each in jax.tree.leaves(value))


def now(*value: Any) -> contextlib.AbstractContextManager:
    """A context in which what depends on known arrays alone is computed at once, inside `jax.jit` too."""
    return jax.ensure_compile_time_eval() if known(*value) else contextlib.nullcontext()


def trace(
    mesh: Mesh, surfaces: Sequence[Surface], asked: Sequence[Asked], eye: Float[Array, "3"], *, keep: bool
) -> Reflections:
    """Casts the rays of some vertices or points.

    Args:
        mesh: The mesh of all parts.
        surfaces: All parts. Those that rays start from have a `SharpPart`.
        asked: What rays start from.
        eye: Position of the viewer.
        keep: Whether what systems make of the hits is kept for other lights.

    Raises:
        ValueError: JAX traces the eye, the roughness, or the scene.
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
            found.append(caster(mesh).cast(rays[-1], surface.first, each.points))
    slots, hit = _rows(mesh, plain, found, keep=keep)
    own = []
    for each, ray, slot in zip(asked, rays, slots, strict=True):
        part = surfaces[each.number].reflecting
        assert isinstance(part, SharpPart)
        own.append(Carried(jnp.asarray(slot), part.weights(ray, eye, each.blend, each.points, each.seen)))
    return Reflections(tuple(own), hit)


def split(
    mesh: Mesh,
    surfaces: Sequence[Surface],
    view: PyTree,
    eye: Float[Array, "3"],
    blends: Sequence[Blend | None],
    points: Sequence[Points] | None,
) -> tuple[PyTree, Reflections | None]:
    """A view by systems without what rays carry, and the rays; None where no part is sharp.

    Args:
        mesh: The mesh of all parts.
        surfaces: All parts.
        view: Of direct light and of bounces, part by part.
        eye: Position of the viewer.
        blends: What the vertices, or points, of each part are made of.
        points: On each part; None for the vertices.
    """
    sharp = _sharp(surfaces)
    if not sharp:
        return view, None
    none: list[Any] = [None] * len(surfaces)
    places, faces = points or none, none
    if points is None:
        with now(mesh, eye):
            faces = jnp.split(facing(mesh, eye), [each.first for each in surfaces[1:]])
    rows, asked = list(view[1]), []
    for number in sharp:
        asked.append(Asked(number, blends[number], places[number], faces[number]))
        own = surfaces[number].reflecting
        assert isinstance(own, SharpPart)
        rows[number] = rows[number] - own.carried(eye, blends[number], places[number], faces[number])
    return (view[0], tuple(rows)), trace(mesh, surfaces, asked, eye, keep=True)


def read(
    reflected: Reflections,
    surfaces: Sequence[Surface],
    arriving: tuple[Sequence[PyTree], Sequence[PyTree]],
    lamp: Float[Array, "n 3"] | None,
    points: Sequence[Points] | None,
) -> Float[Array, "v c"]:
    """What rays add to the radiance of all vertices or points; arguments are those of `split` and `radiance`."""
    rows = reflected.radiance([flattened(each) for each in surfaces], arriving, lamp)
    counts = [len(each.part.mesh.position) for each in surfaces] if points is None else list(map(len, points))
    own = dict(zip(_sharp(surfaces), rows, strict=True))
    none = jnp.zeros((1, rows[0].shape[1]), rows[0].dtype)
    every = [own.get(number, jnp.broadcast_to(none, (count, none.shape[1]))) for number, count in enumerate(counts)]
    return jnp.concatenate(every)


def _sharp(surfaces: Sequence[Surface]) -> list[int]:
    """Numbers of the parts that rays start from."""
    return [number for number, each in enumerate(surfaces) if isinstance(each.reflecting, SharpPart)]


def flattened(surface: Surface) -> Surface:
    """A part as rays read it: it reflects by harmonics alone, and what it emits is not seen."""
    part = surface.reflecting
    return dataclasses.replace(surface, reflecting=part.plain if isinstance(part, SharpPart) else part, glows=False)


@jit
def facing(mesh: Mesh, eye: Float[Array, "3"]) -> Float[Array, " v"]:
    """1 for vertices that are corners of a triangle whose front the eye may see, 0 for others."""
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
            f"rays of sharp reflections must start from known places in known directions, but JAX traces {wrong[0]}: "
            "make the view outside of jax.jit and jax.grad, by RelitScene.view or picture_view, or take "
            "RelitScene.with_rays(0), which reflects by harmonics alone"
        )


def _rows(mesh: Mesh, surfaces: Sequence[Surface], found: Sequence[tuple], *, keep: bool):
    """Slots of all rays, and hits part by part in rows of few lengths, so that programs serve many views."""
    cast = caster(mesh)
    shape = [each[0].shape for each in found]
    triangle = np.concatenate([np.zeros(0, int), *(each[0].ravel() for each in found)])
    weight = np.concatenate([np.zeros((0, 3), np.float32), *(each[1].reshape(-1, 3) for each in found)])
    start = np.concatenate([np.zeros((0, 3), np.float32), *(np.tile(each[2], (len(each[0]), 1)) for each in found)])
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
        # Padding repeats the last.
        index = np.pad(index, (0, count * length - len(index)), mode="edge").reshape(count, length)
        for each in index:
            points = Points(jnp.asarray(cast.face[triangle[each]].T - surface.first), jnp.asarray(weight[each].T))
            eye = jnp.asarray(start[each])
            kept = look(surface, points, eye, at_pixels=not _is_matte(surface)) if keep else None
            rows.append(HitRow(number, points, eye, kept))
    slot = np.where(slot < 0, total, slot)
    ends = np.cumsum([np.prod(each) for each in shape])[:-1] if shape else []
    return [each.reshape(size) for each, size in zip(np.split(slot, ends), shape, strict=True)], tuple(rows)


def _is_matte(surface: Surface) -> bool:
    """Whether a part looks the same from everywhere, so that the radiance of its vertices serves all rays."""
    return isinstance(surface.shading.brdf, Lambert)


@jit
def _read(own: Sequence[Carried], rows: Sequence[Array]) -> list[Array]:
    """The sums over rays of the radiance that they read."""
    colors = max([1, *(each.shape[1] for each in rows)])
    dtype = jnp.result_type(float) if not rows else rows[0].dtype
    flat = [jnp.broadcast_to(each, (len(each), colors)) for each in rows]
    color = jnp.concatenate([*flat, jnp.zeros((1, colors), dtype)])
    return [
        reduce(
            jnp.add,
            (
                color.at[slot].get(mode="promise_in_bounds") * weight
                for slot, weight in zip(each.slot, each.weight, strict=True)
            ),
        )
        for each in own
    ]
