"""Traces what points of a scene receive of each function of a basis of distant light."""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
from jaxtyping import Array, Float, Float32

from jaxprt import require
from jaxprt.brdf import Lambert
from jaxprt.compile import jit
from jaxprt.files.arrays import Header, Layout, sketch
from jaxprt.scene import Part, Scene, TexturedMaterial, material_table
from jaxprt.scene.mesh import Mesh, frames
from jaxprt.scene.scene import centered
from jaxprt.sensors.bases import Basis, Patches
from jaxprt.sensors.elements import Elements, divide
from jaxprt.sensors.matrix import PointTransport
from jaxprt.sphere import cubemap, directions
from jaxprt.visibility import Run, blocks, rays
from jaxprt.visibility.blocks import Progress, Shard
from jaxprt.visibility.occluder import Occluder, offsets
from jaxprt.visibility.rays import LEVELS

ALGORITHM = {"visibility": rays.ALGORITHM, "sensors": 1}
_BETWEEN, _GATHERED = 16, 32  # texels along an edge, to whose middles rays look for what reflects: vertices and points
_COARSE = 32  # texels along an edge for light that is reflected before it arrives
_SAMPLE = 64  # points of which the error is measured
_PANES = 8  # surfaces of glass that a ray passes at most
_GLASS = 1.52  # index of refraction
_CLEAREST = 1.09  # transmissivity of a pane that lets all light pass, as Radiance counts it
_KINDS = ("irradiance", "scalar")
_SKY = Patches()
_SIZES = 32, 64, 128, 256, 512


def transport(
    scene: Scene,
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"] | None,
    *,
    basis: Basis = _SKY,
    kind: str = "irradiance",
    brdf: Callable | None = None,
    view: Float[np.ndarray, "p 3"] | None = None,
    bounces: int = 0,
    glass: Mapping[str, float] | None = None,
    size: int = 64,
    error: float | None = None,
    path: str | None = None,
    executor: Executor | None = None,
    progress: Progress = True,
) -> PointTransport:
    """What any points of a scene receive of distant light, as a matrix from the coefficients of a basis of it.

    Args:
        scene: What casts shadows and reflects.
        points: Positions in the coordinates of the scene's file: sensors, texels of a lightmap, centers of splats.
        normals: Directions that the points face, of any length above zero. `kind="scalar"` needs none.
        basis: `jaxprt.sensors.Patches` of the sky, `Harmonics` or `Texels`.
        kind: "irradiance", or "scalar" for the integral of radiance over all directions without a cosine.
        brdf: Material of the points, which makes the result the radiance that they send along `view`.
        view: Directions from the points to the viewer, in the world.
        bounces: How often surfaces reflect light before it arrives. They count as diffuse: textured materials by their
            base color, other BRDFs by their mean reflectance. They are cut into some 6,000 elements for it.
        glass: Transmissivity at normal incidence of one pass, by the name of a part: light passes straight through it,
            less what Fresnel's equations reflect, and what a longer way absorbs.
        size: Texels along the edge of a cube through whose middles rays go; those at edges of shadows get sixteen more.
        error: Relative L2 error of the direct part, for which the size is chosen from 32 to 512, by some of the points;
            None for the given size. Coefficients of a finer basis need more rays for the same error.
        path: Folder of finished blocks, with which a call goes on where an earlier one stopped.
        executor: Where blocks are computed: threads if None, dask, or a `jaxprt.visibility.Shard` of a job array.
        progress: Whether to show progress bars, or a function; see `jaxprt.Run`.

    Returns:
        The transport. Points that no light reaches, such as those inside of solids, get zero, with a warning that
        counts them.

    Raises:
        TypeError: The scene or the basis is something else.
        ValueError: Positions are not finite; normals have no length or another count; a part of glass does not exist;
            the kind is unknown; a BRDF lacks a view; or the folder holds results of other inputs.
    """
    require.count("bounces", bounces)
    options = {"basis": basis, "kind": kind, "brdf": brdf, "view": view, "glass": glass, "size": size}
    job, solid = prepared(scene, points, normals, **options)
    run = Run(path, executor, progress)
    job, reached = _sized(job, error)
    if bounces:
        # Each part of a job array computes what all of them need: they would wait for each other three times.
        job = _with_reflections(job, solid, bounces, Run(progress=progress) if isinstance(executor, Shard) else run)
    result = blocks.compute(job, run.within("points"), label="points")
    parts = [_matrix(result[name], job) for name in ("direct", "reflected") if name in result]
    dark = np.flatnonzero(~np.any([np.asarray(part).any(tuple(range(1, part.ndim))) for part in parts], 0))
    if len(dark):
        where = f"{len(dark)} of {job.vertices} points get no light, first point {dark[0]}"
        warnings.warn(f"{where}: they are inside of solids, or in rooms without openings", stacklevel=2)
    return PointTransport(parts[0], parts[1] if bounces else None, basis, reached, tuple(map(int, dark)))


def prepared(
    scene: Scene,
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"] | None,
    *,
    basis: Basis,
    kind: str = "irradiance",
    brdf: Callable | None = None,
    view: Float[np.ndarray, "p 3"] | None = None,
    glass: Mapping[str, float] | None = None,
    size: int = 64,
) -> tuple["PointJob", Scene]:
    """The job of some points without reflected light, and what reflects; `transport` explains the arguments."""
    require.kind("the scene", scene, Scene, source="jaxprt.load_scene")
    require.kind("the basis", basis, Basis, source="jaxprt.sensors.Patches, Harmonics or Texels")
    require.count("size", size, least=1)
    _check_kind(kind, brdf, view)
    origin = scene.parts[0].mesh.origin
    solid, panes = _apart(centered(scene), {} if glass is None else glass)
    require.finite("the points", points)
    place = (np.asarray(points, np.float64) - np.asarray(origin)).astype(np.float32)
    out = _normals(normals, place, required=kind != "scalar" or brdf is not None)
    more: dict[str, Any] = {"panes": panes, "size": size, "basis": basis, "kind": kind, "brdf": brdf}
    more["view"] = None if view is None else _directions("the views", view, len(place))
    return PointJob.of(jax.tree.map(np.asarray, solid.mesh), place, out, **more), solid


def _check_kind(kind: str, brdf: Any, view: Any) -> None:
    if kind not in _KINDS:
        raise ValueError(f"kind must be {' or '.join(map(repr, _KINDS))}, got {require.shown(kind)}")
    if (brdf is None) != (view is None):
        raise ValueError("a BRDF needs the directions of view of the points, and these a BRDF: give both or none")


def _normals(value: Any, place: np.ndarray, *, required: bool) -> Float32[np.ndarray, "p 3"]:
    """Unit normals; up where none are needed."""
    if place.ndim != 2 or place.shape[1] != 3 or not len(place):
        raise ValueError(f"the points must be rows of three coordinates, got {list(place.shape)}")
    if value is None:
        if required:
            raise ValueError("the normals must be given, one for each point, got None")
        return np.broadcast_to(np.array([0, 1, 0], np.float32), place.shape)
    return _directions("the normals", value, len(place))


def _directions(name: str, value: Any, count: int) -> Float32[np.ndarray, "p 3"]:
    vector = np.asarray(value, np.float64)
    if vector.shape != (count, 3):
        raise ValueError(f"{name} must be {count} rows of three numbers, got {list(vector.shape)}")
    length = np.linalg.norm(vector, axis=1)
    wrong = np.flatnonzero(~((length > 0) & np.isfinite(length)))
    if wrong.size:
        raise ValueError(
            f"{name} must have a length, got {wrong.size} without one, first {vector[wrong[0]]} of point {wrong[0]}"
        )
    return (vector / length[:, None]).astype(np.float32)


def _apart(scene: Scene, glass: Mapping[str, float]) -> tuple[Scene, list[tuple[Mesh, float]]]:
    """The scene without glass, and the panes with their transmissivities."""
    names = [part.name for part in scene.parts]
    unknown = sorted(set(glass) - set(names))
    if unknown:
        raise ValueError(f"glass must name parts of the scene, got {unknown[0]!r}; parts are {', '.join(names)}")
    for name, share in glass.items():
        require.number(f"the transmissivity of {name!r}", share, 0.0, high=_CLEAREST)
    solid = [part for part in scene.parts if part.name not in glass]
    if not solid:
        raise ValueError("the scene must have parts that are not of glass, got none")
    panes = [(jax.tree.map(np.asarray, p.mesh), float(glass[p.name])) for p in scene.parts if p.name in glass]
    return Scene(solid), panes


@dataclass(frozen=True)
class PointJob(rays.VisibilityJob):
    """Job that computes rows of the matrix for blocks of points.

    Attributes:
        panes: Meshes of glass, with their transmissivities.
        basis: The functions of light.
        kind: Whether a cosine counts.
        brdf: Material of the points; None for irradiance.
        view: Directions to the viewer.
        sent: Elements of the scene, and the radiance of their fronts, then of their backs, for each function of light;
            None without reflections.
        gathered: Texels along an edge whose middles rays go through, to what reflects.
    """

    panes: list[tuple[Mesh, float]] = dataclasses.field(default_factory=list, kw_only=True)
    basis: Basis = dataclasses.field(kw_only=True)
    kind: str = dataclasses.field(default="irradiance", kw_only=True)
    brdf: Any = dataclasses.field(default=None, kw_only=True)
    view: Any = dataclasses.field(default=None, kw_only=True)
    sent: tuple[Elements, np.ndarray] | None = dataclasses.field(default=None, kw_only=True)
    gathered: int = dataclasses.field(default=_GATHERED, kw_only=True)

    @classmethod
    def of(cls, mesh: Mesh, place: np.ndarray, out: np.ndarray, **more: Any) -> "PointJob":
        """The job for some points; rays start off surfaces by what rounding needs."""
        start = place + offsets(place, np.arange(len(place))[:, None])[:, None] * out
        frame = frames(out, np.asarray(directions.tangent(jnp.asarray(out)))).astype(np.float32)
        index = (mesh.face, *(pane.face for pane, _ in more["panes"]))
        opacity = () if mesh.opacity is None else jax.tree.leaves(mesh.opacity)
        key = blocks.fingerprint(*(np.asarray(array, np.int64) for array in index), *opacity)
        rows = {"mesh": (mesh.position, *(pane.position for pane, _ in more["panes"])), "points": (place, out)}
        rows["views"] = (np.zeros(1) if more["view"] is None else more["view"],)
        near = {
            name: sketch(np.concatenate([np.ravel(array) for array in both]), tolerance=rays.ROUNDING)
            for name, both in rows.items()
        }
        return cls(start.astype(np.float32), frame, mesh, more.pop("size"), key, near, **more)

    @property
    def header(self) -> Header:
        """The inputs; see `blocks.Job`."""
        light = {"basis": repr(self.basis), "kind": self.kind, "brdf": repr(self.brdf)}
        glass = [share for _, share in self.panes]
        bounced = None if self.sent is None else blocks.fingerprint(self.sent[1])
        return self.made_by("sensors", ALGORITHM, **light, glass=glass, sent=bounced, gathered=self.gathered)

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Rows of direct light, and of reflected light with bounces."""
        colors = () if self.brdf is None else (self._colors,)
        result = {"direct": Layout((rays.BLOCK, self.basis.count, *colors), 0, "float32")}
        if self.sent is not None:
            result["reflected"] = Layout((rays.BLOCK, self.basis.count, *self.sent[1].shape[2:]), 0, "float32")
        return result

    @cached_property
    def _colors(self) -> int:
        up = jnp.array([0.0, 0.0, 1.0])
        return int(np.shape(self.brdf(up, up))[-1])

    @cached_property
    def _means(self) -> Any:
        return self.basis.means(self.size)

    @cached_property
    def _glass(self) -> list[tuple[Occluder, float]]:
        return [(Occluder(mesh), share) for mesh, share in self.panes]

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """Computes the rows of a block of points."""
        part = self.part(block)
        sides = (self.frame[part, 2], -self.frame[part, 2]) if self.kind == "scalar" else (self.frame[part, 2],)
        seen, count = self._seen(part, sides)
        share = seen.astype(np.float32) / LEVELS
        share *= self._passed(part, share)
        weight = self.weights(part, self.size)
        result = {"direct": self._integrals(share[..., None] * weight if weight.ndim == 3 else share * weight)}
        if self.sent is not None:
            result["reflected"], more = self._reflected(part)
            return result, count.rays + more
        return result, count.rays

    def _seen(self, part: np.ndarray, sides: tuple[np.ndarray, ...]) -> tuple[np.ndarray, rays.RayCount]:
        """Visibility in sixteenths, above the horizon of each side."""
        seen, count = np.uint8(0), rays.RayCount(0, 0, 0)
        for out in sides:
            one, more = rays.fractional(self.rays, self.start[part], out, size=self.size, spread=True)
            seen, count = np.maximum(seen, one), count + more
        return np.asarray(seen), count

    def _integrals(self, value: np.ndarray) -> np.ndarray:
        """Products with the functions of light, summed over texels."""
        if value.ndim == 2:
            return np.asarray((self._means @ value.T).T, np.float32)
        return np.stack([self._integrals(value[..., color]) for color in range(value.shape[-1])], -1)

    def weights(self, part: np.ndarray, size: int) -> Float32[np.ndarray, "b d *c"]:
        """Integral over each texel of the cosine, times the BRDF if there is one; or its solid angle."""
        if self.kind == "scalar" and self.brdf is None:
            area = np.asarray(cubemap.solid_angle(size=size), np.float32).reshape(1, -1)
            return np.broadcast_to(area, (len(part), area.shape[1]))
        area = np.asarray(cubemap.vector_area(size=size), np.float32).reshape(-1, 3)
        cosine = np.maximum(self.frame[part, 2] @ area.T, 0)
        if self.brdf is None:
            return cosine
        return np.asarray(_reflectance(self.brdf, self.frame[part], self.view[part], size)) * cosine[..., None]

    def _passed(self, part: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Share of light that passes glass on the way from the middle of each texel to each point."""
        result = np.ones_like(share)
        if not self._glass:
            return result
        point, texel = np.nonzero(share)
        way = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)[texel]
        result[point, texel] = self.through(self.start[part[point]], way)
        return result

    def passed(self, start: np.ndarray, direction: np.ndarray, point: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Share of light that opaque and translucent surfaces let pass along rays; see `Occluder.blocked`."""
        return rays.shares(self.rays, start, direction, point, way)

    def through(self, start: Float32[np.ndarray, "n 3"], way: Float32[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Share of light that passes all glass along rays."""
        result = np.ones(len(start), np.float32)
        for occluder, share in self._glass:
            here, left = start.copy(), np.arange(len(start))
            for _ in range(_PANES):
                triangle, distance, _ = occluder.hit(here[left], way[left])
                left, distance, triangle = left[triangle >= 0], distance[triangle >= 0], triangle[triangle >= 0]
                if not left.size:
                    break
                a, b, c = (occluder.position[occluder.face[triangle, corner]] for corner in range(3))
                across = np.cross(b - a, c - a)
                cosine = np.abs(np.sum(across * way[left], 1)) / np.maximum(np.linalg.norm(across, axis=1), 1e-30)
                result[left] *= transmittance(cosine, share)
                here[left] += (distance + 2 * occluder.offset[triangle])[:, None] * way[left]
        return result

    def _reflected(self, part: np.ndarray) -> tuple[np.ndarray, int]:
        """What surfaces send to a block of points, through the middles of texels; and the number of rays."""
        assert self.sent is not None
        elements, radiance = self.sent
        weight = self.weights(part, self.gathered)
        weight = weight.mean(-1) if weight.ndim == 3 else weight
        direction = np.asarray(cubemap.direction(size=self.gathered), np.float32).reshape(-1, 3)
        point, texel = np.nonzero(weight)
        triangle, _, share = self.rays.hit(self.start[part[point]], direction[texel])
        hit = np.flatnonzero(triangle >= 0)
        behind = self.rays.hits_back(triangle[hit], direction[texel[hit]])
        side = elements.at(triangle[hit], share[hit], behind)
        shape = len(part), len(radiance)
        gather = scipy.sparse.csr_matrix((weight[point[hit], texel[hit]], (point[hit], side)), shape=shape)
        total, count = gather @ radiance.reshape(len(radiance), -1), len(point)
        return np.asarray(total, np.float32).reshape(len(part), *radiance.shape[1:]), count


def transmittance(cosine: Float[np.ndarray, " n"], passes: float) -> Float32[np.ndarray, " n"]:
    """Share of light that a pane of glass lets pass, both polarizations averaged, with all reflections inside.

    Args:
        cosine: Cosine of the angle of incidence.
        passes: Transmissivity of one pass at normal incidence.

    Reference: Fresnel's equations; the form with the transmissivity of one pass is that of Radiance's `glass`.
    """
    cosine = np.clip(cosine, 0, 1)
    inner = np.sqrt(1 - (1 - cosine**2) / _GLASS**2)
    passed = passes ** (1 / inner)
    result = np.zeros_like(cosine)
    for over, under in ((_GLASS * inner, cosine), (inner, _GLASS * cosine)):
        back = ((over - under) / np.maximum(over + under, 1e-30)) ** 2
        result += (1 - back) ** 2 * passed / (1 - (back * passed) ** 2) / 2
    return result.astype(np.float32)


@jit
def _reflect(brdf: Any, frame: Float[Array, "b 3 3"], wo: Float[Array, "b 3"], way: Float[Array, "d 3"]) -> Array:
    wi = directions.to_local(frame, way)
    local = jnp.einsum("bij,bj->bi", frame, wo)
    return brdf(wi, jnp.broadcast_to(local[:, None], wi.shape))


def _reflectance(brdf: Any, frame: np.ndarray, wo: np.ndarray, size: int) -> Array:
    """BRDF toward the middle of each texel; 0 below the horizon."""
    way = cubemap.direction(size=size).reshape(-1, 3)
    return _reflect(brdf, jnp.asarray(frame), jnp.asarray(wo), way.astype(jnp.float32))


def _with_reflections(job: PointJob, scene: Scene, bounces: int, run: Run) -> PointJob:
    """The job with what both sides of the scene's elements send after some bounces."""
    elements = divide(job.occluder)
    corner = np.asarray(job.occluder.face)[elements.triangle]
    albedo = np.concatenate([_albedo(part) for part in scene.parts])
    albedo = np.einsum("ek,ekc->ec", elements.weight, albedo[corner])
    albedo = albedo[:, 0] if np.ptp(albedo, 1).max() < 1e-6 else albedo
    albedo = np.concatenate([albedo, albedo])
    place, out = np.tile(elements.place, (2, 1)), np.concatenate([elements.normal, -elements.normal])
    more: dict[str, Any] = {"panes": job.panes, "size": min(job.size, _COARSE), "basis": job.basis, "view": None}
    at = PointJob.of(job.occluder, place, out, gathered=_BETWEEN, **more)
    arrived = blocks.compute(at, run.within("elements"), label="elements")["direct"]
    factor = (albedo / np.pi).reshape(len(albedo), 1, *albedo.shape[1:]).astype(np.float32)
    first = np.asarray(arrived).reshape(*arrived.shape, *(1,) * (factor.ndim - 2)) * factor
    total = first
    for number in range(1, bounces):
        again = dataclasses.replace(at, sent=(elements, total))
        label = f"bounce {number}"
        total = first + blocks.compute(again, run.within(label), label=label)["reflected"] * factor
    return dataclasses.replace(job, sent=(elements, np.asarray(total, np.float32)))


def _albedo(part: Part) -> Float[np.ndarray, "v 3"]:
    """Diffuse reflectance of the vertices of a part."""
    shape, material = (len(part.mesh.position), 3), part.material
    if isinstance(material, TexturedMaterial):
        return np.asarray(material_table.of_parts([part]).at_vertices().values.base_color)[: shape[0]]
    if isinstance(material, Lambert):
        return np.broadcast_to(np.asarray(material.albedo), shape)
    way = cubemap.direction(size=8).reshape(-1, 3)
    flux = jnp.maximum(way[:, 2], 0) * cubemap.solid_angle(size=8).reshape(-1)
    both: Any = material
    value = both(way[None], way[:, None]) * (flux[:, None, None] * flux[:, None] / np.pi)
    return np.broadcast_to(np.asarray(jnp.clip(value.sum((0, 1)), 0, 1)), shape)


def _matrix(rows: np.ndarray, job: PointJob) -> Array:
    """The rows of the points; a single color has no axis."""
    rows = np.asarray(rows[: job.vertices])
    return jnp.asarray(rows[..., 0] if rows.shape[2:] == (1,) else rows)


def _sized(job: PointJob, wanted: float | None) -> tuple[PointJob, float]:
    """The job of the smallest size that has the wanted error, and its error."""
    if wanted is None:
        return job, _error(job)
    require.number("error", wanted, 0.0, above=True)
    reached = np.inf
    for size in _SIZES:
        job = dataclasses.replace(job, size=size)
        reached = _error(job)
        if reached <= wanted:
            return job, reached
    warnings.warn(f"the error is {reached:.2g} with the most rays, above the wanted {wanted:g}", stacklevel=3)
    return job, reached


def _error(job: PointJob) -> float:
    """Relative L2 difference of some rows from those of four times the rays."""
    chosen = np.random.default_rng(0).choice(job.vertices, min(_SAMPLE, job.vertices), replace=False)
    view = None if job.view is None else job.view[chosen]
    some = dataclasses.replace(job, start=job.start[chosen], frame=job.frame[chosen], view=view, sent=None)
    rows = [
        blocks.compute(dataclasses.replace(some, size=size), Run(progress=False))["direct"]
        for size in (job.size, 2 * job.size)
    ]
    return float(np.linalg.norm(rows[0] - rows[1]) / max(float(np.linalg.norm(rows[1])), 1e-30))
