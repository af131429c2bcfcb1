"""Transport of light from lamps: the visible solid angle, irradiance and mean direction of each lamp at each vertex.

The transport of a lamp of radiance 1 to a vertex consists of three integrals over the directions in which the lamp is
visible: of 1, of the cosine and of the direction. They are computed by rays from the vertex to n points that are spread
evenly over the lamp's area A. Each point stands for a disk of area a = A / n:

    ∫ V dw ~ sum_j V_j a (-w_j · n_j) / (r_j^2 + a / pi)

The term a / pi makes the result exact on the axis of a disk at any distance. A lamp emits on the side to which its
normals point, and not on the other. Lamps are cut into pieces with separate integrals, so that highlights on smooth
surfaces show what hides a part of the lamp, and the shape of lamps that are no polygons.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.files.arrays import Header, Layout, sketch
from jaxprt.scene import origin as origins
from jaxprt.scene.mesh import Mesh, relative
from jaxprt.scene.scene import PointLight
from jaxprt.systems.lamps import outline
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.occluder import offsets
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "lamps": 1}
_NEAR = 1e-3  # a hit within this share of the distance to the lamp's point counts as a hit on the lamp itself
_PLASTIC = 1.324717957244746  # the plastic number, whose powers give Roberts' sequence in the plane
_MOMENTS = 5
_CLOSE = 6.0  # distance to a lamp, in radii of a sample's disk, below which more samples are used
_FINER = 16  # factor by which there are more samples then


class LampTransport(eqx.Module):
    """Visible parts of lamps of radiance 1, or of point lights of intensity 1, at each vertex.

    Attributes:
        solid_angle: Visible solid angle of each piece m of a lamp above the vertex's horizon, in sr. For a point light,
            1 / distance^2 if it is visible.
        cosine: Integral of the cosine over this solid angle: the irradiance.
        direction: Integral of the unit direction over this solid angle, in the world.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        lamp: Index of the lamp that each piece belongs to.
        outline: Corners of flat and convex lamps f, and then of the pieces of each, in world units; None without.
        flat: Indices of these lamps.
    """

    solid_angle: Float[Array, "m v"]
    cosine: Float[Array, "m v"]
    direction: Float[Array, "m 3 v"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    lamp: tuple[int, ...] = eqx.field(static=True)
    outline: Float[Array | np.ndarray, "f q k 3"] | None = None
    flat: tuple[int, ...] = eqx.field(static=True, default=())

    @property
    def lamps(self) -> int:
        """Number of lamps."""
        return self.lamp[-1] + 1

    @property
    def nbytes(self) -> int:
        """Bytes of the integrals."""
        return self.solid_angle.nbytes + self.cosine.nbytes + self.direction.nbytes

    def tilted(self, frame: Float[Array, "v 3 3"]) -> "LampTransport":
        """The transport to the same vertices with other shading frames, as of normal maps.

        Only light above the horizons of both normals counts, and of a piece on the horizon all or nothing.

        Args:
            frame: The frames; rows are tangent, bitangent, normal.
        """
        cosine = jnp.maximum(jnp.einsum("mcv,vc->mv", self.direction, frame[:, 2], precision="highest"), 0)
        return dataclasses.replace(self, cosine=cosine, frame=frame)


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    lamps: Sequence[Mesh | PointLight],
    *,
    samples: int = 256,
    pieces: int = 4,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    apart: bool = False,
    run: Run = Run(),
) -> LampTransport:
    """Precomputes the visible part of each lamp at each vertex of a mesh, by ray tracing.

    Args:
        mesh: The mesh to light.
        lamps: Emitting surfaces, each with one color and intensity, and point lights.
        samples: Number of points on each surface; soft shadows have as many levels. A point light has one. For vertices
            near a lamp there are 16 times as many. Light is underestimated at vertices nearer to a lamp than about a
            hundredth of its width.
        pieces: Number of pieces into which each surface is cut, a power of two. Use more for lamps that look large
            relative to the lobes of the BRDF and are partly hidden, or neither flat nor convex.
        occluder: Mesh that casts shadows, such as the whole scene with or without the lamps; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        apart: Whether the regions of the mesh are separate surfaces: rays start off the faces of their own region.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Raises:
        TypeError: A lamp is neither a `Mesh` nor a `PointLight`.
        ValueError: There are no lamps, a lamp has no area, `pieces` is not a power of two or exceeds `samples`,
            positions or normals are not finite, or the folder holds results of other inputs.
    """
    if not isinstance(lamps, Sequence) or isinstance(lamps, str | bytes):
        raise TypeError(f"lamps must be a list of meshes and point lights, got {require.shown(lamps)}")
    if not lamps:
        raise ValueError("lamps must be at least one, got none")
    require.count("samples", samples, least=1)
    require.whole("pieces", pieces)
    if pieces < 1 or pieces & (pieces - 1) or pieces > samples:
        raise ValueError(f"pieces must be a power of two, and at most the {samples} samples, got {pieces}")
    for number, lamp in enumerate(lamps):
        require.kind(f"lamp {number}", lamp, Mesh, PointLight, source="jaxprt.load_mesh")
    lamps = [_relative(lamp, mesh.origin) for lamp in lamps]
    coarse, fine = (_Samples.of(lamps, count, pieces) for count in (samples, _FINER * samples))
    owner = np.repeat(np.arange(len(lamps)), [pieces if isinstance(lamp, Mesh) else 1 for lamp in lamps])
    job = _Job.make(mesh, occluder, vertex, 1, apart=apart, coarse=coarse, fine=fine)
    moment = visibility.blocks.compute(job, run, label="lamps")["moment"]
    solid, cosine, *direction = (jax.device_put(np.ascontiguousarray(row.T)) for row in np.moveaxis(moment, 2, 0))
    position, frame = visibility.rays.place(mesh, vertex), jax.device_put(job.frame)
    places = np.split(coarse.place, np.cumsum(np.bincount(owner, coarse.piece).astype(int))[:-1])
    flat = outline.of_lamps(lamps, places, [pieces] * len(lamps))
    return LampTransport(solid, cosine, jnp.stack(direction, 1), position, frame, tuple(owner.tolist()), *flat)


def _relative(lamp: Mesh | PointLight, origin: origins.Origin) -> Mesh | PointLight:
    """A lamp with positions relative to the origin of the mesh that it lights."""
    if isinstance(lamp, Mesh):
        return relative(lamp, origin)
    return dataclasses.replace(lamp, position=origins.local(f"point light {lamp.name!r}", lamp.position, origin))


class _Samples(NamedTuple):
    """Sample points on all lamps, the area of each times the normal there, and the number of points of each piece."""

    place: np.ndarray
    area: np.ndarray
    piece: np.ndarray
    spot: Sequence[tuple[int, PointLight]]  # the spots among the lamps, with the index of their one sample

    @classmethod
    def of(cls, lamps: Sequence[Mesh | PointLight], count: int, pieces: int) -> "_Samples":
        points, sizes, spots = [], [], []
        for lamp in lamps:
            if isinstance(lamp, PointLight) and lamp.axis is not None:
                spots.append((sum(sizes), lamp))
            place, area = sample_surface(lamp, count=count) if isinstance(lamp, Mesh) else _point_sample(lamp)
            parts = _cut(place, pieces if isinstance(lamp, Mesh) else 1)
            points.append((place[np.concatenate(parts)], area[np.concatenate(parts)]))
            sizes += [len(part) for part in parts]
        place, area = (np.concatenate(column).astype(np.float32) for column in zip(*points, strict=True))
        return cls(place, area, np.asarray(sizes), spots)


def sample_surface(lamp: Mesh, *, count: int) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Points spread evenly over a surface, and the area of each times the surface normal there.

    Args:
        lamp: The surface. It emits on the side to which its vertex normals point.
        count: Number of points.
    """
    visibility.occluder.check(lamp, "lamp")
    corner, across = outline.triangles(lamp)
    area = np.linalg.norm(across, axis=1)
    if not area.sum() > 0:
        raise ValueError(f"a lamp must have an area above 0, got one whose {len(area)} triangles have none")
    total = np.cumsum(area)
    # The area is divided into `count` equal shares with one point each. Places inside triangles follow a
    # low-discrepancy sequence.
    triangle = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    step = 1 / _PLASTIC ** np.arange(1, 3)
    first, second = np.mod(0.5 + step[:, None] * np.arange(1, count + 1), 1)
    root = np.sqrt(first)
    weight = np.stack([1 - root, root * (1 - second), root * second], 1)
    place = np.einsum("sk,skc->sc", weight, corner[triangle])
    return place, across[triangle] / area[triangle, None] * (total[-1] / count)


def _point_sample(light: PointLight) -> tuple[np.ndarray, np.ndarray]:
    """A point light as one sample of zero area."""
    return np.asarray(light.position, np.float64)[None], np.zeros((1, 3))


def _cut(place: np.ndarray, pieces: int) -> list[np.ndarray]:
    """Indices of the points of each piece, by repeated halving across the longest extent."""
    parts = [np.arange(len(place))]
    while len(parts) < pieces:
        halves = []
        for part in parts:
            axis = np.argmax(np.ptp(place[part], axis=0))
            order = part[np.argsort(place[part, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves
    return parts


@dataclasses.dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Job that computes the visible parts of lamps for blocks of vertices; see `blocks.Job`."""

    coarse: _Samples
    fine: _Samples

    @property
    def header(self) -> Header:
        """Settings that the result depends on."""
        return self.made_by("lamps", ALGORITHM, pieces=self.coarse.piece.tolist())

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches of the positions and areas of the lamps' samples, compared up to rounding."""
        spots = [
            [number, *np.asarray(spot.axis), *spot.cone] for number, spot in self.coarse.spot if spot.axis is not None
        ]
        cones = {"spots": sketch(np.array(spots))} if spots else {}
        return {**super().near, "lamps": sketch(np.concatenate(self.coarse[:2])), **cones}

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Arrays of one block."""
        return {"moment": Layout((visibility.rays.BLOCK, len(self.coarse.piece), _MOMENTS), 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """Computes one block."""
        part = self.part(block)
        start, normal = self.start[part], self.frame[part, 2]
        moment, rays = self._moments(start, normal, self.coarse)
        near = np.flatnonzero(self._is_near(start))
        if near.size:
            moment[near], more = self._moments(start[near], normal[near], self.fine)
            rays += more
        return {"moment": moment}, rays

    def _is_near(self, start: np.ndarray) -> np.ndarray:
        """Whether each vertex is so near to a sample of a lamp that finer samples are needed."""
        square = np.sum((self.coarse.place - start[:, None]) ** 2, -1)
        return np.any(square < _CLOSE**2 / np.pi * np.linalg.norm(self.coarse.area, axis=1), 1)

    def _moments(self, start: np.ndarray, normal: np.ndarray, samples: _Samples) -> tuple[np.ndarray, int]:
        """The integrals at the given points, and the number of rays traced."""
        way = samples.place - start[:, None]
        # The distance to a point light is at least the offset of ray origins, so that lamps on a surface stay finite.
        square = np.maximum(np.sum(way**2, -1), offsets(start, np.arange(len(start))[:, None])[:, None] ** 2)
        unit = way / np.sqrt(square)[..., None]
        size = np.linalg.norm(samples.area, axis=1)
        facing = np.where(size > 0, np.maximum(-np.einsum("vsc,sc->vs", unit, samples.area), 0), 1)
        solid = facing / (square + size / np.float32(np.pi))
        for sample, spot in samples.spot:
            solid[:, sample] *= spot.share(-unit[:, sample])
        height = np.einsum("vsc,vc->vs", unit, normal)
        point, sample = np.nonzero((solid > 0) & (height > 0))
        triangle, distance, _ = self.rays.hit(start[point], way[point, sample])
        clear = (triangle < 0) | (distance > 1 - _NEAR)
        seen = np.zeros_like(solid)
        seen[point[clear], sample[clear]] = solid[point[clear], sample[clear]]
        moment = np.concatenate([seen[..., None], (seen * height)[..., None], seen[..., None] * unit], -1)
        first = np.cumsum(samples.piece) - samples.piece
        return np.add.reduceat(moment, first, 1).astype(np.float32), len(point)
