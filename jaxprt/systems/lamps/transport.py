"""Transport of light from lamps: which part of each lamp a vertex sees, and in which direction.

A lamp of radiance 1 is to a vertex the integrals, over the directions in which the lamp is seen, of 1, of the cosine
and of the direction. They are sums over points that lie evenly on the lamp's surface, each the middle of a disk of
area a = A / n, by rays from the vertex:

    ∫ V dw ~ sum_j V_j a (-w_j · n_j) / (r_j^2 + a / pi)

where the second term of the denominator makes a disk on its axis exact at any distance. The front of a lamp sends
light, the side to which its normals point; its back sends none. Lamps are cut into pieces, each with integrals of its
own, so that highlights of smooth surfaces have the lamp's shape.
"""

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.files.arrays import Layout, sketch
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.scene import PointLight

# Versions of what makes the results; a release that changes them raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "lamps": 1}
_NEAR = 1e-3  # share of the distance to a lamp within which a ray that is met has met the lamp itself
_PLASTIC = 1.324717957244746  # of which powers make Roberts' sequence in the plane
_MOMENTS = 5
_CLOSE = 6.0  # radii of a sample within which lamps have more of them
_FINER = 16  # times as many


class LampTransport(eqx.Module):
    """What vertices see of lamps of radiance 1, or of point lights of intensity 1.

    Attributes:
        solid_angle: Solid angle of each piece m of a lamp that a vertex sees above its horizon.
        cosine: Integral of the cosine over it: the irradiance.
        direction: Integral of the direction over it, in the world.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
        lamp: Number of the lamp that each piece belongs to.
    """

    solid_angle: Float[Array, "m v"]
    cosine: Float[Array, "m v"]
    direction: Float[Array, "m 3 v"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    lamp: tuple[int, ...] = eqx.field(static=True)

    @property
    def lamps(self) -> int:
        """Number of lamps."""
        return self.lamp[-1] + 1

    @property
    def nbytes(self) -> int:
        """Bytes of the integrals."""
        return self.solid_angle.nbytes + self.cosine.nbytes + self.direction.nbytes


def precompute(
    mesh: Mesh,
    lamps: Sequence[Mesh | PointLight],
    *,
    samples: int = 256,
    pieces: int = 4,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> LampTransport:
    """Traces which part of each lamp the vertices of a mesh see.

    Args:
        mesh: The vertices to light.
        lamps: Surfaces that emit, each with one color and strength, and point lights.
        samples: Points on each surface; a point light has one. Shadows have as many steps. Vertices near a lamp take
            16 times as many; light is lost where they are nearer than about a hundredth of its width.
        pieces: Into how many pieces each surface is cut, a power of two. More are for lamps that are large beside the
            lobes of the BRDF: one of 35 degrees in a metal of GGX roughness .3 is 9 % off by one piece, 3 % by four
            and .8 % by sixteen.
        occluder: What casts shadows: the whole scene, lamps included or not; the mesh itself if None.
        vertex: Numbers of the vertices to light, or a mask; the rest of the mesh still casts shadows.
        path: Folder that keeps finished blocks; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show a progress bar.

    Raises:
        TypeError: A lamp is neither a mesh nor a point light.
        ValueError: There are no lamps, one has no area, pieces are no power of two or more than samples, positions or
            normals are not finite, or the store was made from something else.
    """
    if not lamps:
        raise ValueError("lamps must be at least one, got none")
    if pieces < 1 or pieces & (pieces - 1) or pieces > samples:
        raise ValueError(f"pieces must be a power of two, and at most the {samples} samples, got {pieces}")
    for number, each in enumerate(lamps):
        require.kind(f"lamp {number}", each, Mesh, PointLight, source="jaxprt.load_mesh")
    coarse, fine = (_Samples.of(lamps, count, pieces) for count in (samples, _FINER * samples))
    lamp = [number for number, each in enumerate(lamps) for _ in range(pieces if isinstance(each, Mesh) else 1)]
    job = _Job.make(mesh, occluder, vertex, 1, coarse=coarse, fine=fine)
    found = visibility.blocks.compute(job, path=path, executor=executor, progress=progress, label="lamps")["moment"]
    solid, cosine, *direction = (jax.device_put(np.ascontiguousarray(each.T)) for each in np.moveaxis(found, 2, 0))
    position, frame = visibility.rays.place(mesh, vertex), jax.device_put(job.frame)
    return LampTransport(solid, cosine, jnp.stack(direction, 1), position, frame, tuple(lamp))


class _Samples(NamedTuple):
    """Points on all lamps, the area of each times the normal there, and how many points each piece has."""

    place: np.ndarray
    area: np.ndarray
    piece: np.ndarray

    @classmethod
    def of(cls, lamps: Sequence[Mesh | PointLight], count: int, pieces: int) -> "_Samples":
        points, sizes = [], []
        for each in lamps:
            place, area = sampled(each, count=count) if isinstance(each, Mesh) else _alone(each)
            order = _halved(place, pieces if isinstance(each, Mesh) else 1)
            points.append((place[np.concatenate(order)], area[np.concatenate(order)]))
            sizes += [len(own) for own in order]
        place, area = (np.concatenate(each).astype(np.float32) for each in zip(*points, strict=True))
        return cls(place, area, np.asarray(sizes))


def sampled(lamp: Mesh, *, count: int) -> tuple[Float[np.ndarray, "s 3"], Float[np.ndarray, "s 3"]]:
    """Points that lie evenly on a surface, and the area of each times the surface's normal there.

    Args:
        lamp: The surface. Its front is on the side of the vertices' normals.
        count: Number of points.

    Raises:
        ValueError: The surface has no area, or is not finite.
    """
    visibility.occluder.check(lamp, "lamp")
    corner, normal = (np.asarray(each, np.float64)[np.asarray(lamp.face)] for each in (lamp.position, lamp.normal))
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    across *= np.where(np.sum(across * normal.sum(1), 1) < 0, -1, 1)[:, None]
    area = np.linalg.norm(across, axis=1)
    if not area.sum() > 0:
        raise ValueError(f"a lamp must have an area, got one of {len(area)} triangles without any")
    total = np.cumsum(area)
    # One point in each of so many equal shares of the area; inside of their triangles by a sequence that fills it.
    triangle = np.searchsorted(total, (np.arange(count) + 0.5) / count * total[-1])
    step = 1 / _PLASTIC ** np.arange(1, 3)
    first, second = np.mod(0.5 + step[:, None] * np.arange(1, count + 1), 1)
    root = np.sqrt(first)
    weight = np.stack([1 - root, root * (1 - second), root * second], 1)
    place = np.einsum("sk,skc->sc", weight, corner[triangle])
    return place, across[triangle] / area[triangle, None] * (total[-1] / count)


def _alone(light: PointLight) -> tuple[np.ndarray, np.ndarray]:
    """A point light as one sample, whose area is zero."""
    return np.asarray(light.position, np.float64)[None], np.zeros((1, 3))


def _halved(place: np.ndarray, pieces: int) -> list[np.ndarray]:
    """Numbers of points in each of some pieces, by cutting across the longest extent into halves."""
    parts = [np.arange(len(place))]
    while len(parts) < pieces:
        halves = []
        for own in parts:
            axis = np.argmax(np.ptp(place[own], axis=0))
            order = own[np.argsort(place[own, axis], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        parts = halves
    return parts


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Blocks of what vertices see of lamps; see `blocks.Job`."""

    coarse: _Samples
    fine: _Samples

    @property
    def header(self) -> Mapping[str, Any]:
        """What the result depends on."""
        return self.made_by("lamps", ALGORITHM, pieces=self.coarse.piece.tolist())

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches of the lamps' places and sizes."""
        return {**super().near, "lamps": sketch(np.concatenate(self.coarse[:2]))}

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Shapes of one block."""
        return {"moment": Layout((visibility.rays.BLOCK, len(self.coarse.piece), _MOMENTS), 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """One block."""
        part = self.part(block)
        start, normal = self.start[part], self.frame[part, 2]
        moment, rays = self._seen(start, normal, self.coarse)
        near = np.flatnonzero(self._is_near(start))
        if near.size:
            moment[near], more = self._seen(start[near], normal[near], self.fine)
            rays += more
        return {"moment": moment}, rays

    def _is_near(self, start: np.ndarray) -> np.ndarray:
        """Whether a sample of a lamp is so near that it should be smaller."""
        square = np.sum((self.coarse.place - start[:, None]) ** 2, -1)
        return np.any(square < _CLOSE**2 / np.pi * np.linalg.norm(self.coarse.area, axis=1), 1)

    def _seen(self, start: np.ndarray, normal: np.ndarray, samples: _Samples) -> tuple[np.ndarray, int]:
        """The integrals for some points, and the number of rays that they took."""
        way = samples.place - start[:, None]
        square = np.maximum(np.sum(way**2, -1), np.float32(self.rays.nudge) ** 2)
        unit = way / np.sqrt(square)[..., None]
        size = np.linalg.norm(samples.area, axis=1)
        facing = np.where(size > 0, np.maximum(-np.einsum("vsc,sc->vs", unit, samples.area), 0), 1)
        solid = facing / (square + size / np.float32(np.pi))
        height = np.einsum("vsc,vc->vs", unit, normal)
        point, sample = np.nonzero((solid > 0) & (height > 0))
        triangle, distance, _ = self.rays.hit(start[point], way[point, sample])
        clear = (triangle < 0) | (distance > 1 - _NEAR)
        seen = np.zeros_like(solid)
        seen[point[clear], sample[clear]] = solid[point[clear], sample[clear]]
        moment = np.concatenate([seen[..., None], (seen * height)[..., None], seen[..., None] * unit], -1)
        first = np.cumsum(samples.piece) - samples.piece
        return np.add.reduceat(moment, first, 1).astype(np.float32), len(point)
