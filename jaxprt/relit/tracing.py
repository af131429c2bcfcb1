"""Reflections by rays: what the sharp parts of a scene show of their neighbors, in any light and in any colors.

Rays go from vertices or points along the narrow lobes of `jaxprt.systems.bounces.traced`, and read the radiance of the
fronts that they meet: direct light, and what is reflected as far as 16 harmonics tell it. Rays that meet nothing, or a
back, bring nothing, since the light of the sky is direct light. Those that meet a lamp tell how much of it is seen.

Embree casts the rays on the host, once for each eye and roughness. Where they hit is a constant: radiance is
differentiable in the light and in the colors of all materials, and its derivative by the eye or by roughness is
refused.
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

from jaxprt.brdf import Lambert
from jaxprt.compile import jit
from jaxprt.relit.casting import caster
from jaxprt.relit.surface import Surface, at_vertices, lit, look, shaded
from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lamps.relight import beside
from jaxprt.systems.protocol import Blend

CHUNK = 1 << 13  # hits that are shaded at once
_FEWEST = 1 << 10


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
        lamp: What the radiance of each lamp is multiplied by; None without lamps.
    """

    slot: Int[Array, "j v"]
    weight: Float[Array, "j v c"]
    lamp: Float[Array, "n v c"] | None


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
        return _read(self.own, rows, lamp)


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
    for each, ray, slot, triangle in zip(asked, rays, slots, found, strict=True):
        part = surfaces[each.number].reflecting
        assert isinstance(part, SharpPart)
        weight = part.weights(ray, eye, each.blend, each.points, each.seen)
        sharpness = part.concentrations(ray, eye, each.blend, each.points)
        met = caster(mesh).part[triangle[0]] if (triangle[0] >= 0).any() else np.zeros_like(triangle[0])
        lamp = _lamps(surfaces, each, np.where(triangle[0] >= 0, met, -1), weight, sharpness)
        own.append(Carried(jnp.asarray(slot), weight, lamp))
    return Reflections(tuple(own), hit)


def _lamps(
    surfaces: Sequence[Surface], asked: Asked, met: Int[np.ndarray, "j v"], weight: Array, concentration: Array
) -> Float[Array, "n v c"] | None:
    """What rays read of each lamp of radiance 1, given the part that each meets, -1 for none."""
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
    """How much of narrow lobes rays carry at the vertices or points of each part; None for nothing.

    Arguments are those of `split`.
    """
    sharp = _sharp(surfaces)
    if not sharp:
        return [None] * len(surfaces)
    faces = [jnp.ones(len(each)) for each in points] if points else _faces(mesh, surfaces, eye, points)
    return [each if number in sharp else None for number, each in enumerate(faces)]


def _faces(mesh: Mesh, surfaces: Sequence[Surface], eye: Array, points: Sequence[Points] | None) -> list[Any]:
    """Whether the eye may see each vertex of each part; None where points tell."""
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
def _read(own: Sequence[Carried], rows: Sequence[Array], lamp: Array | None) -> list[Array]:
    """The sums over rays of the radiance that they read."""
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
