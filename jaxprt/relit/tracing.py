"""Traced reflections: what sharp parts of a scene reflect of their neighbors, under any light and with any colors.

Rays start from vertices or points and follow the narrow lobes of `jaxprt.systems.bounces.traced`. Each ray reads the
radiance of the front face that it hits: direct light, and light that was reflected before, represented by 16 harmonics.
Back faces are black. Rays that hit nothing read nothing, because light of the environment is already part of direct
light; direct light takes the share of such rays for the visibility of very narrow lobes. Rays that hit a lamp determine
how much of it is visible in the reflection.

Embree casts the rays on the host, once for each eye position and roughness. The hit points are constants. Radiance is
therefore differentiable in the light and in the colors of all materials. Derivatives with respect to the eye or to
roughness raise an error.
"""

import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
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
from jaxprt.relit.groups import Arriving, Stage, Surface, surface_of
from jaxprt.relit.surface import Viewed, radiance, view
from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces import ReflectingPart, traced
from jaxprt.systems.bounces.traced import ReflectionRays
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.lamps.relight import ray_share
from jaxprt.systems.lobe.table import traced_visibility
from jaxprt.systems.protocol import Blend
from jaxprt.visibility import blocks

_MOST_RAYS = 1 << 12  # of each vertex or point


class RayOrigins(eqx.Module):
    """Vertices or points of a group from which reflection rays start.

    Attributes:
        group: Index of the group.
        points: The points in the scene.
        on_group: The points on the group.
        blend: Material weights of the vertices or points.
        share: 1 where narrow lobes are traced, 0 elsewhere; None for 1 everywhere.
        lamps: The transport of the lamps to the points; None to interpolate it between vertices.
        turn: Which of each four rays a point casts; -1 for all of them. None if all points cast all.
    """

    group: int = eqx.field(static=True)
    points: Points
    on_group: Points
    blend: Blend | None
    share: Float[Array, " v"] | None
    lamps: LampTransport | None = None
    turn: Int[np.ndarray, " v"] | None = None

    @property
    def parameter(self) -> tuple[Float[Array, " v"], ...]:
        """Parameters of the BRDF at the vertices or points."""
        return () if self.blend is None else self.blend.parameter


class PathWeights(eqx.Module):
    """What the rays of some origins bring to the eye.

    Attributes:
        slot: Index of each ray's hit among all hits; the number of hits if there is none.
        weight: Factor of the radiance that each ray reads.
        lamp: Factor of the radiance of each lamp; None without lamps.
        missed: Share of the rays of narrow lobes that hit nothing; -1 where there are none.
    """

    slot: Int[Array | np.ndarray, "j v"]
    weight: Float[Array, "j v c"]
    lamp: Float[Array, "n v c"] | None
    missed: Float[Array, " v"]


class HitRow(eqx.Module):
    """Hits on one group that are shaded together.

    Attributes:
        group: Index of the group.
        points: The hits as points of the scene.
        on_group: The hits as points on the group.
        eye: Origin of the ray of each hit.
        variance: Variance of the directions into which a cone around each ray is reflected, in squared radians.
        viewed: What does not depend on the light; None if it is computed anew for each light.
    """

    group: int = eqx.field(static=True)
    points: Points
    on_group: Points
    eye: Float[Array, "h 3"]
    variance: Float[Array, " h"]
    viewed: Viewed | None


class Reflections(eqx.Module):
    """The traced reflections of a view.

    Attributes:
        paths: The rays of each `RayOrigins`, in the given order.
        hits: The surfaces that they hit.
    """

    paths: tuple[PathWeights, ...]
    hits: tuple[HitRow, ...]

    def radiance(self, stage: Stage, arriving: Arriving) -> list[Float[Array, "_ c"]]:
        """The reflected radiance that rays add at each vertex or point, one array for each `RayOrigins`.

        Args:
            stage: The scene and its materials.
            arriving: The light that arrives at it.
        """
        colors = []
        for row in self.hits:
            viewed = _viewed(stage, row) if row.viewed is None else row.viewed
            colors.append(radiance(stage.surfaces[row.group].without_rays, arriving.at(row.group), viewed))
        return _read(self.paths, colors, arriving.lamp)


def _viewed(stage: Stage, row: HitRow) -> Viewed:
    """What does not depend on the light, at the hits of a row."""
    surface, look = stage.surfaces[row.group].without_rays, stage.table.at(row.points)
    options = {"fixed": stage.fixed[row.group], "variance": row.variance, "glows": False}
    return view(surface, row.on_group, look, row.eye, **options)


def trace(stage: Stage, origins: Sequence[RayOrigins], eye: Float[Array, "3"], *, keep: bool) -> Reflections:
    """Casts the reflection rays of some vertices or points.

    Args:
        stage: The scene and its materials.
        origins: Vertices or points from which rays start, of groups with rays.
        eye: Position of the viewer.
        keep: Whether to store what depends on the view of the hits, for many lights.

    Raises:
        ValueError: The eye, the roughness, the points or the scene is traced by JAX.
    """
    for origin in origins:
        _check(stage.whole, origin, stage.surfaces[origin.group].reflecting, eye)
    cast, hits, rays = caster(stage.whole), [], []
    for origin in origins:
        with jax.ensure_compile_time_eval():
            bundle = _reflecting(stage, origin).rays(eye, origin.parameter, origin.on_group, origin.share)
            bundle = bundle if origin.turn is None else _shared(bundle, origin.turn)
            hit = cast.cast(bundle, origin.points, at_vertices=origin.on_group.all_vertices)
            hits.append((*hit, cast.spread(bundle, *hit)))
            rays.append((bundle, _missed(bundle, hit[0])))
    slots, rows = _rows(stage, cast, hits, keep=keep)
    paths = []
    for origin, (bundle, missed), slot, (triangle, *_) in zip(origins, rays, slots, hits, strict=True):
        weight = _reflecting(stage, origin).weights(bundle, eye, origin.blend, origin.on_group, origin.share)
        part = _parts(stage, cast, triangle)
        lamp = _lamps(stage, origin, part, weight, bundle.concentration)
        paths.append(PathWeights(slot, weight, lamp, missed))
    return Reflections(tuple(paths), rows)


def _shared(rays: ReflectionRays, turn: Int[np.ndarray, " v"]) -> ReflectionRays:
    """The rays without those that other points cast."""
    several = min(4, len(rays.chance))
    other = (turn >= 0) & (np.arange(len(rays.chance))[:, None] % several != turn % several)
    return dataclasses.replace(rays, chance=put(np.where(other, 0, np.asarray(rays.chance))))


def missed_shares(
    stage: Stage, origins: Sequence[RayOrigins], eye: Float[Array, "3"]
) -> list[Float[Array, " v"] | None]:
    """Share of the rays of very narrow lobes that hit nothing, for points of groups that reflect no other surfaces.

    The rays are those of lobes of direct light. Each result is as in `PathWeights`; None for all if JAX traces any of
    the arguments.
    """
    tables = [stage.surfaces[origin.group].system.lobe_part.brdf for origin in origins]
    arguments = [(origin.points, origin.on_group, origin.parameter) for origin in origins]
    if not known(stage.whole, eye, tables, arguments):
        return [None] * len(origins)
    cast, bundles = caster(stage.whole), []
    with jax.ensure_compile_time_eval():
        for origin, table in zip(origins, tables, strict=True):
            surface = stage.surfaces[origin.group]
            place = surface.position, surface.frame, origin.on_group
            bundles.append(traced.very_narrow(table, *place, eye, origin.parameter, count=stage.rays))

    def missed(origin: RayOrigins, rays: ReflectionRays) -> Float[Array, " v"]:
        rays = rays if origin.turn is None else _shared(rays, origin.turn)
        return _missed(rays, cast.blocked(rays, origin.points))

    with ThreadPoolExecutor(blocks.cores()) as pool:
        return list(pool.map(missed, origins, bundles))


def _missed(rays: ReflectionRays, triangle: Int[np.ndarray, "j v"]) -> Float[Array, " v"]:
    """Share of the rays of narrow lobes that hit nothing, at each vertex or point; -1 where there are none."""
    narrow = np.asarray(traced_visibility(rays.concentration) * (rays.chance > 0))
    # Rays that hit a triangle around their own vertex do not tell what is behind it.
    total, free = ((narrow * counts).sum(0) for counts in (triangle > -3, triangle == -1))
    return put(np.where(total > 0, free / np.where(total > 0, total, 1), -1).astype(narrow.dtype))


def _parts(stage: Stage, cast: Caster, triangle: Int[np.ndarray, "*b"]) -> Int[np.ndarray, "*b"]:
    """Indices of the parts that rays hit; -1 for none."""
    return np.where(triangle >= 0, stage.part[cast.face[np.maximum(triangle, 0), 0]], -1)


def _reflecting(stage: Stage, origin: RayOrigins) -> ReflectingPart:
    """How the group of some origins reflects."""
    reflecting = surface_of(stage, origin.group).reflecting
    return require.kind("what reflects", reflecting, ReflectingPart, source="a precomputation with bounces")


def _lamps(
    stage: Stage, origin: RayOrigins, part: Int[np.ndarray, "j v"], weight: Array, concentration: Array
) -> Float[Array, "n v c"] | None:
    """Factor of the radiance of each lamp at each vertex or point, given the part that each ray hits (-1 for none)."""
    lit = stage.surfaces[origin.group].lit
    if lit is None:
        return None
    lamp = np.where(part >= 0, np.asarray(stage.lamp)[part], -1)
    hits_lamp = lamp == np.arange(lit.transport.lamps)[:, None, None]
    chord = lit.chord(origin.on_group) if origin.lamps is None else lit.at(origin.lamps).chord()
    return _seen_lamps(chord, put(hits_lamp), weight, concentration)


@jit
def _seen_lamps(chord: Array, hits_lamp: Array, weight: Array, concentration: Array) -> Float[Array, "n v c"]:
    share = ray_share(concentration, chord[:, None]) * hits_lamp
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


def _check(mesh: Mesh, origin: RayOrigins, part: Any, eye: Any) -> None:
    names = {"the eye": eye, "the roughness": origin.parameter, "the scene": (mesh, part), "the points": origin.points}
    wrong = [name for name, value in names.items() if not known(value)]
    if wrong:
        raise ValueError(
            f"rays for sharp reflections need concrete values, but {wrong[0]} is traced by JAX: call RelitScene.view "
            "or picture_view outside of jax.jit and jax.grad, or use RelitScene.with_rays(0), which computes all "
            "reflections from harmonics"
        )


def _rows(stage: Stage, cast: Caster, hits: Sequence[tuple], *, keep: bool) -> tuple[list[Any], tuple[HitRow, ...]]:
    """Slots of all rays, and the hits of each group in rows of one length."""
    triangle = np.concatenate([np.zeros(0, int), *(hit[0].ravel() for hit in hits)])
    weight = np.concatenate([np.zeros((0, 3), np.float32), *(hit[1].reshape(-1, 3) for hit in hits)])
    start = np.concatenate([np.zeros((0, 3), np.float32), *(np.tile(hit[2], (len(hit[0]), 1)) for hit in hits)])
    variance = np.concatenate([np.zeros(0, np.float32), *(hit[3].ravel() for hit in hits)])
    part = _parts(stage, cast, triangle)
    owner = np.where(part >= 0, stage.layout.group[part], -1)
    slot, rows, total = np.full(len(triangle), -1, np.int32), [], 0
    for group in range(len(stage.surfaces)):
        index = np.flatnonzero(owner == group)
        if not len(index):
            continue
        slot[index] = total + np.arange(len(index))
        count = -(-len(index) // canvas.ROW)
        total += count * canvas.ROW
        # Padding repeats the last hit.
        index = np.pad(index, (0, count * canvas.ROW - len(index)), mode="edge").reshape(count, canvas.ROW)
        for hit in index:
            corner = cast.face[triangle[hit]].T.astype(np.int32)
            places = corner, corner - stage.shift[corner[0]]
            still = np.zeros((2, 3, canvas.ROW), weight.dtype)
            points, on_group = (put(Points(place, weight[hit].T.copy(), still)) for place in places)
            eye, spread = put((start[hit], variance[hit]))
            row = HitRow(group, points, on_group, eye, spread, None)
            rows.append(dataclasses.replace(row, viewed=_viewed(stage, row)) if keep else row)
    slot = np.where(slot < 0, total, slot)
    shape = [hit[0].shape for hit in hits]
    ends = np.cumsum([np.prod(size) for size in shape])[:-1] if shape else []
    return [of_origin.reshape(size) for of_origin, size in zip(np.split(slot, ends), shape, strict=True)], tuple(rows)


def _read(paths: Sequence[PathWeights], rows: Sequence[Array], lamp: Array | None) -> list[Array]:
    """The weighted sum over rays of the radiance that they read."""
    colors = max([1, *(row.shape[1] for row in rows)])
    xp = np if known(rows, paths) else jnp  # The number of hits depends on the view.
    dtype = jnp.result_type(float) if not rows else rows[0].dtype
    flat = [xp.broadcast_to(xp.asarray(row), (len(row), colors)) for row in rows]
    color = xp.concatenate([*flat, xp.zeros((1, colors), dtype)])
    return [_weighed(color[xp.asarray(path.slot)], path.weight, lamp, path.lamp) for path in paths]


@jit
def _weighed(read: Array, weight: Array, lamp: Array | None, share: Array | None) -> Float[Array, "v c"]:
    result = reduce(jnp.add, (color * factor for color, factor in zip(read, weight, strict=True)))
    if lamp is None or share is None:
        return result
    return result + jnp.einsum("nc,nvc->vc", lamp, share, precision="highest")


def check_rays(rays: Any) -> None:
    """Refuses anything but a number of rays for each vertex or point."""
    if type(rays) is not int or not 0 <= rays <= _MOST_RAYS:
        raise ValueError(f"rays must be a whole number of at least 0, at most {_MOST_RAYS}, got {require.shown(rays)}")


def check_more_rays(rays: Any, before: int, surfaces: Sequence[Surface]) -> None:
    """`check_rays`, for a scene with a number of rays before; without the lobes that rays are for, it gets none."""
    check_rays(rays)
    reflecting = [surface for surface in surfaces if surface.reflecting is not None]
    if rays and not before and reflecting and not any(surface.has_rays for surface in reflecting):
        raise ValueError(f"rays must be 0 for a scene that was precomputed with rays=0, got {rays}: precompute it anew")
