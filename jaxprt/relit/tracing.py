"""Traced reflections: what sharp parts of a scene reflect of their neighbors, under any light and with any colors.

Rays start from vertices or points and follow the narrow lobes of `jaxprt.systems.bounces.traced`. Each ray reads the
radiance of the front face that it hits: direct light, and light that was reflected before, represented by 16 harmonics.
Rays that hit nothing or a back face contribute nothing, because light of the environment is already part of direct
light. Rays that hit a lamp determine how much of it is visible in the reflection.

Embree casts the rays on the host, once for each eye position and roughness. The hit points are constants. Radiance is
therefore differentiable in the light and in the colors of all materials. Derivatives with respect to the eye or to
roughness raise an error.
"""

import dataclasses
from collections.abc import Sequence
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import jit, known, put
from jaxprt.relit import canvas
from jaxprt.relit.casting import Caster, caster
from jaxprt.relit.groups import Arriving, Stage, Surface, look_at
from jaxprt.relit.surface import Viewed, lit, view
from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.lamps.relight import beside
from jaxprt.systems.protocol import Blend

_MOST_RAYS = 1 << 12  # of each vertex or point


class Asked(eqx.Module):
    """Vertices or points of a group from which rays start.

    Attributes:
        number: Index of the group.
        points: The points in the scene.
        own: The points on the group; None for all its vertices.
        blend: Material weights of the vertices or points.
        seen: 1 where narrow lobes are traced, 0 elsewhere; None for 1 everywhere.
        lamps: The transport of the lamps to the points; None to interpolate it between vertices.
        at_vertices: Whether the points are vertices, from which rays start elsewhere than from points of triangles.
    """

    number: int = eqx.field(static=True)
    points: Points
    own: Points | None
    blend: Blend | None
    seen: Float[Array, " v"] | None
    lamps: LampTransport | None = None
    at_vertices: bool = eqx.field(static=True, default=False)


class Carried(eqx.Module):
    """The rays of one `Asked`.

    Attributes:
        slot: Index of each ray's hit among all hits; the number of hits if there is none.
        weight: Factor of the radiance that each ray reads.
        lamp: Factor of the radiance of each lamp; None without lamps.
    """

    slot: Int[Array | np.ndarray, "j v"]
    weight: Float[Array, "j v c"]
    lamp: Float[Array, "n v c"] | None


class HitRow(eqx.Module):
    """Hits on one group that are shaded together.

    Attributes:
        number: Index of the group.
        points: The hits as points of the scene.
        own: The hits as points on the group.
        eye: Origin of the ray of each hit.
        variance: Variance of the directions into which a cone around each ray is reflected, in squared radians.
        kept: What does not depend on the light; None if it is computed anew for each light.
    """

    number: int = eqx.field(static=True)
    points: Points
    own: Points
    eye: Float[Array, "h 3"]
    variance: Float[Array, " h"]
    kept: Viewed | None


class Reflections(eqx.Module):
    """The traced reflections of a view.

    Attributes:
        own: The rays of each `Asked`, in the given order.
        hit: The surfaces that they hit.
    """

    own: tuple[Carried, ...]
    hit: tuple[HitRow, ...]

    def radiance(self, stage: Stage, arriving: Arriving) -> list[Float[Array, "_ c"]]:
        """The reflected radiance that rays add at each vertex or point, one array for each `Asked`.

        Args:
            stage: The scene and its materials.
            arriving: The light that arrives at it.
        """
        rows = []
        for row in self.hit:
            seen = _viewed(stage, row) if row.kept is None else row.kept
            rows.append(lit(plain(stage.surfaces[row.number]), arriving.at(row.number), seen))
        return _read(self.own, rows, arriving.lamp)


def plain(surface: Surface) -> Surface:
    """The surface as rays see it: it reflects by harmonics alone."""
    part = surface.reflecting
    return dataclasses.replace(surface, reflecting=part.plain) if isinstance(part, SharpPart) else surface


def _viewed(stage: Stage, row: HitRow) -> Viewed:
    """What does not depend on the light, at the hits of a row."""
    look, given = look_at(stage.table, stage.rough, row.points), stage.given[row.number]
    options = {"given": given, "variance": row.variance, "glows": False}
    return view(plain(stage.surfaces[row.number]), row.own, look, row.eye, **options)


def trace(stage: Stage, asked: Sequence[Asked], eye: Float[Array, "3"], *, keep: bool) -> Reflections:
    """Casts the reflection rays of some vertices or points.

    Args:
        stage: The scene and its materials.
        asked: Vertices or points from which rays start, of groups with a `SharpPart`.
        eye: Position of the viewer.
        keep: Whether to store what depends on the view of the hits, for many lights.

    Raises:
        ValueError: The eye, the roughness, the points or the scene is traced by JAX.
    """
    _check(stage.whole, asked[0], stage.surfaces[asked[0].number].reflecting, eye)
    cast = caster(stage.whole)
    found, rays = [], []
    for each in asked:
        sharp = stage.surfaces[each.number].reflecting
        assert isinstance(sharp, SharpPart)
        parameter = () if each.blend is None else each.blend.parameter
        _check(stage.whole, each, sharp, eye)
        with jax.ensure_compile_time_eval():
            rays.append(sharp.rays(eye, parameter, each.own, each.seen))
            met = cast.cast(rays[-1], each.points, at_vertices=each.at_vertices)
            found.append((*met, cast.spread(rays[-1], *met)))
    slots, hit = _rows(stage, cast, found, keep=keep)
    own = []
    for each, ray, slot, (triangle, *_) in zip(asked, rays, slots, found, strict=True):
        sharp = stage.surfaces[each.number].reflecting
        assert isinstance(sharp, SharpPart)
        weight = sharp.weights(ray, eye, each.blend, each.own, each.seen)
        part = np.where(triangle >= 0, stage.part[cast.face[triangle, 0]], -1)
        own.append(Carried(slot, weight, _lamps(stage, each, part, weight, ray.concentration)))
    return Reflections(tuple(own), hit)


def _lamps(
    stage: Stage, asked: Asked, part: Int[np.ndarray, "j v"], weight: Array, concentration: Array
) -> Float[Array, "n v c"] | None:
    """Factor of the radiance of each lamp at each vertex or point, given the part that each ray hits (-1 for none)."""
    lit = stage.surfaces[asked.number].lit
    if lit is None:
        return None
    lamp = np.where(part >= 0, np.asarray(stage.lamp)[part], -1)
    met = lamp == np.arange(lit.transport.lamps)[:, None, None]
    chord = lit.chord(asked.own) if asked.lamps is None else lit.at(asked.lamps).chord()
    return _seen_lamps(chord, put(met), weight, concentration)


@jit
def _seen_lamps(chord: Array, met: Array, weight: Array, concentration: Array) -> Float[Array, "n v c"]:
    share = beside(concentration, chord[:, None]) * met
    return jnp.einsum("njv,jvc->nvc", share, weight, precision="highest")


def facing(mesh: Mesh, eye: Float[Array, "3"]) -> Float[Array, " v"]:
    """1 for vertices of a triangle whose front faces the eye, 0 for others."""
    return _facing(mesh if mesh.opacity is None else dataclasses.replace(mesh, opacity=None), eye)


@jit
def _facing(mesh: Mesh, eye: Float[Array, "3"]) -> Float[Array, " v"]:
    a, b, c = (mesh.position[mesh.face[:, k]] for k in range(3))
    across = jnp.cross(b - a, c - a)
    side = jnp.sum(across * jnp.sum(mesh.normal[mesh.face], 1), -1)
    seen = (jnp.sum(across * (eye - a), -1) * side > 0).astype(mesh.position.dtype)
    return jnp.zeros_like(mesh.position[:, 0]).at[mesh.face].max(seen[:, None])


def _check(mesh: Mesh, asked: Asked, part: Any, eye: Any) -> None:
    parameter = () if asked.blend is None else asked.blend.parameter
    names = {"the eye": eye, "the roughness": parameter, "the scene": (mesh, part), "the points": asked.points}
    wrong = [name for name, value in names.items() if not known(value)]
    if wrong:
        raise ValueError(
            f"rays for sharp reflections need concrete values, but {wrong[0]} is traced by JAX: call RelitScene.view "
            "or picture_view outside of jax.jit and jax.grad, or use RelitScene.with_rays(0), which computes all "
            "reflections from harmonics"
        )


def _rows(stage: Stage, cast: Caster, found: Sequence[tuple], *, keep: bool) -> tuple[list[Any], tuple[HitRow, ...]]:
    """Slots of all rays, and the hits of each group in rows of one length."""
    shape = [each[0].shape for each in found]
    triangle = np.concatenate([np.zeros(0, int), *(each[0].ravel() for each in found)])
    weight = np.concatenate([np.zeros((0, 3), np.float32), *(each[1].reshape(-1, 3) for each in found)])
    start = np.concatenate([np.zeros((0, 3), np.float32), *(np.tile(each[2], (len(each[0]), 1)) for each in found)])
    variance = np.concatenate([np.zeros(0, np.float32), *(each[3].ravel() for each in found)])
    part = np.where(triangle >= 0, stage.part[cast.face[triangle, 0]], -1)
    group = np.where(part >= 0, stage.place.group[part], -1)
    slot, rows, total = np.full(len(triangle), -1, np.int32), [], 0
    for number in range(len(stage.surfaces)):
        index = np.flatnonzero(group == number)
        if not len(index):
            continue
        slot[index] = total + np.arange(len(index))
        count = -(-len(index) // canvas.ROW)
        total += count * canvas.ROW
        # Padding repeats the last hit.
        index = np.pad(index, (0, count * canvas.ROW - len(index)), mode="edge").reshape(count, canvas.ROW)
        for each in index:
            corner = cast.face[triangle[each]].T.astype(np.int32)
            places = corner, corner - stage.shift[corner[0]]
            still = np.zeros((2, 3, canvas.ROW), weight.dtype)
            points, own = (put(Points(place, weight[each].T.copy(), still)) for place in places)
            eye, wide = put((start[each], variance[each]))
            row = HitRow(number, points, own, eye, wide, None)
            rows.append(dataclasses.replace(row, kept=_viewed(stage, row)) if keep else row)
    slot = np.where(slot < 0, total, slot)
    ends = np.cumsum([np.prod(each) for each in shape])[:-1] if shape else []
    return [each.reshape(size) for each, size in zip(np.split(slot, ends), shape, strict=True)], tuple(rows)


def _read(own: Sequence[Carried], rows: Sequence[Array], lamp: Array | None) -> list[Array]:
    """The weighted sum over rays of the radiance that they read."""
    colors = max([1, *(each.shape[1] for each in rows)])
    host = known(rows, own)
    xp = np if host else jnp  # The number of hits depends on the view.
    dtype = jnp.result_type(float) if not rows else rows[0].dtype
    flat = [xp.broadcast_to(xp.asarray(each), (len(each), colors)) for each in rows]
    color = xp.concatenate([*flat, xp.zeros((1, colors), dtype)])
    return [_weighed(color[xp.asarray(each.slot)], each.weight, lamp, each.lamp) for each in own]


@jit
def _weighed(read: Array, weight: Array, lamp: Array | None, share: Array | None) -> Float[Array, "v c"]:
    result = reduce(jnp.add, (color * each for color, each in zip(read, weight, strict=True)))
    if lamp is None or share is None:
        return result
    return result + jnp.einsum("nc,nvc->vc", lamp, share, precision="highest")


def check_rays(rays: Any) -> None:
    """Refuses anything but a number of rays for each vertex or point."""
    if type(rays) is not int or not 0 <= rays <= _MOST_RAYS:
        raise ValueError(f"rays must be a whole number of at least 0, at most {_MOST_RAYS}, got {require.shown(rays)}")
