"""Visibility of the distant sphere from mesh vertices.

Everything here runs in NumPy on the host and returns arrays, so tests of other modules can use visibility that they
construct themselves.
"""

import functools
import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int, UInt8

from jaxprt import require
from jaxprt.files.arrays import sketch
from jaxprt.scene import origin as origins
from jaxprt.scene.mesh import Mesh, check_kinds, frames, relative
from jaxprt.sphere import cubemap
from jaxprt.visibility import blocks
from jaxprt.visibility.occluder import Occluder
from jaxprt.visibility.starts import start_points

_MOST = 1 << 15  # texels along the edge of a face: 80 GB for one vertex
_SOURCE = "jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh"
ALGORITHM = 4  # version of the ray casting; raised by a release whose rays give other results
ROUNDING = 3e-6  # relative to the norm: larger than the rounding error of single precision
BLOCK = 64  # vertices in a block: a fraction of a second of work
LEVELS = 16  # visibility is stored in sixteenths: 4 x 4 rays per texel
_SIDE = 4
_KRONECKER = 0.6180339887498949, 0.7548776662466927  # of texels and vertices
_RAYS = 1 << 17  # rays per call, so that they fit in a core's cache


def _mesh(value: object) -> None:
    require.kind("the mesh", value, Mesh, source=_SOURCE)
    check_kinds(value, "the mesh")


def _occluder(value: object) -> None:
    if value is not None:
        require.kind("the occluder", value, Mesh, source=_SOURCE)
        check_kinds(value, "the occluder")


def _vertex(value: object) -> None:
    if value is not None:
        wrong = require.unreal(value)
        if wrong and wrong != "booleans":
            raise TypeError(f"vertex must be a mask or indices, got {wrong}")


def _run(value: object) -> None:
    require.kind("run", value, blocks.Run, source="jaxprt.Run")


def _size(value: object) -> None:
    if require.whole("size", value) > _MOST:  # Systems say which smaller sizes they take.
        raise ValueError(f"size must be at most {_MOST}, got {value}")


PRECOMPUTE = {
    "mesh": _mesh,
    "occluder": _occluder,
    "vertex": _vertex,
    "run": _run,
    "size": _size,
}


@dataclass(frozen=True)
class RayCount:
    """Numbers of rays that were traced.

    Attributes:
        rays: All rays.
        texels: Texels above the horizons of vertices. Each took one ray.
        supersampled: Texels on a visibility boundary. Each took 16 more rays.
    """

    rays: int
    texels: int
    supersampled: int

    def __add__(self, other: "RayCount") -> "RayCount":
        """Sum of two counts."""
        return RayCount(self.rays + other.rays, self.texels + other.texels, self.supersampled + other.supersampled)


def fractional(
    occluder: Occluder,
    start: Float32[np.ndarray, "v 3"],
    normal: Float32[np.ndarray, "v 3"],
    *,
    size: int,
    supersample: bool | Bool[np.ndarray, "v d"] = True,
    spread: bool = False,
) -> tuple[UInt8[np.ndarray, "v d"], RayCount]:
    """Visible fraction of each cubemap texel from each point, in sixteenths; 0 below the horizon.

    One ray goes through the center of every texel above the horizon, that is, every texel whose integral of the cosine
    is positive. If a texel and its eight neighbors (also across cube edges and the horizon) disagree, the texel is
    supersampled with 4 x 4 rays. That equals box-filtering a cubemap of four times the resolution. Of rays through
    translucent surfaces the share of light counts that passes; neighbors that differ by more than an eighth disagree.

    Args:
        occluder: Geometry that casts shadows.
        start: Origins of the rays, from `start_points`.
        normal: Unit normals.
        size: Edge of the cubemap's faces in texels.
        supersample: Whether texels on a visibility boundary are supersampled: all, none, or some for each point.
        spread: Whether the first ray goes through another place of each texel, and its neighbors alone decide if more
            do. Sums over many texels are then unbiased, where slits are narrower than texels.

    Returns:
        Visibility times 16 of the 6 size^2 texels, and the number of rays.

    Reference: Wang, Tran, Luebke 2004, section 3.3 (there all texels at 6 x 256 x 256).
    """
    table, above = _tables(size), _above_horizon(normal, size)
    seen = np.zeros(above.shape, np.uint8)
    step = max(1, _RAYS // (3 * size * size))
    count = RayCount(0, 0, 0)
    for first in range(0, len(start), step):
        part = slice(first, first + step)
        fine = supersample if isinstance(supersample, bool) else supersample[part]
        count += _trace(occluder, start[part], above[part], seen[part], table, fine, first if spread else None)
    return seen, count


def exhaustive(
    occluder: Occluder, start: Float32[np.ndarray, "v 3"], normal: Float32[np.ndarray, "v 3"], *, size: int
) -> UInt8[np.ndarray, "v d"]:
    """The result of `fractional`, but with 16 rays in every texel above the horizon: a slow reference for tests."""
    table, above = _tables(size), _above_horizon(normal, size)
    seen = np.zeros(above.shape, np.uint8)
    for vertex in range(len(start)):
        texel = np.flatnonzero(above[vertex])
        seen[vertex, texel] = _supersample(occluder, start, np.full(texel.size, vertex), texel, table)
    return seen


def vertex_indices(mesh: Mesh, vertex: np.ndarray | None) -> np.ndarray:
    """Indices of the vertices to light: all for None, the set entries of a mask, or the given indices."""
    count = len(mesh.position)
    number = np.arange(count)
    if vertex is None:
        return number
    vertex = np.asarray(vertex)
    mask = vertex.dtype == bool and vertex.shape == (count,)
    named = vertex.ndim == 1 and vertex.dtype.kind in "iu" and np.all((vertex >= -count) & (vertex < count))
    if not mask and not named:
        raise ValueError(
            f"vertex must be a mask [{count}] or a 1-D array of indices below {count}, got {vertex.dtype} "
            f"{vertex.shape}: {np.array2string(vertex, threshold=4)}"
        )
    return number[vertex]


def place(mesh: Mesh, vertex: np.ndarray | None) -> Float[Array, "v 3"]:
    """Positions of the vertices to light; see `vertex_indices`."""
    return jax.device_put(np.asarray(mesh.position)[vertex_indices(mesh, vertex)])


@dataclass(frozen=True)
class VisibilityJob(blocks.Job):
    """Job that computes transport from the visibility of blocks of vertices. Each system defines its own subclass.

    Attributes:
        start: Origins of the rays of each vertex.
        frame: Rows are tangent, bitangent, normal.
        occluder: Geometry that casts shadows, in NumPy arrays.
        size: Edge of the cubemap's faces in texels.
        mesh_key: Fingerprint of the faces and of the chosen vertices.
        mesh_near: Sketches (see `jaxprt.files.arrays.sketch`) of positions, normals and tangents.
        ray_edge: Largest number of texels along an edge that are traced; None for all. See `jaxprt.Run`.
    """

    start: np.ndarray
    frame: np.ndarray
    occluder: Mesh
    size: int
    mesh_key: str
    mesh_near: Mapping[str, list[float]]
    ray_edge: int | None = field(default=None, kw_only=True)

    @classmethod
    def make(
        cls,
        mesh: Mesh,
        occluder: Mesh | None,
        vertex: np.ndarray | None,
        size: int,
        *,
        apart: bool = False,
        **more: Any,
    ):
        """Makes a job for some vertices of a mesh, or all for None. If `occluder` is None, the mesh shadows itself.

        With `apart`, rays start as `start_points` says.
        """
        shadowing: Mesh = jax.tree.map(np.asarray, mesh if occluder is None else relative(occluder, mesh.origin))
        if mesh.origin != origins.ZERO:
            warnings.warn(
                f"the mesh is far from zero, and its positions are relative to mesh.origin, {mesh.origin}: give its "
                "systems eyes and points relative to it, such as camera.local(mesh.origin).eye; jaxprt.precompute "
                "takes scenes and the coordinates of their files",
                stacklevel=4,
            )
        vertex = vertex_indices(mesh, vertex)
        occluder_rays = Occluder(shadowing)
        start = start_points(mesh, occluder_rays, apart=apart)[vertex]
        normal, tangent = (np.asarray(vector)[vertex] for vector in (mesh.normal, mesh.tangent))
        frame = frames(normal, tangent).astype(np.float32)
        # The key depends on the inputs only: computed values are rounded differently on other processors.
        region = (mesh.region,) if apart and np.ptp(mesh.region) else ()
        index = mesh.face, vertex, shadowing.face, *region
        opacity = () if shadowing.opacity is None else jax.tree.leaves(shadowing.opacity)
        key = blocks.fingerprint(*(np.asarray(array, np.int64) for array in index), *opacity)
        arrays = {"mesh": (mesh.position, shadowing.position), "normals": (mesh.normal, mesh.tangent)}
        rows = {name: np.concatenate([np.ravel(array) for array in both]) for name, both in arrays.items()}
        near = {name: sketch(value, tolerance=ROUNDING) for name, value in rows.items()}
        job = cls(start=start, frame=frame, occluder=shadowing, size=size, mesh_key=key, mesh_near=near, **more)
        vars(job)["rays"] = occluder_rays  # the cached property, so that Embree builds its tree once
        return job

    def made_by(self, system: str, algorithm: Mapping[str, int], **more: object) -> dict[str, object]:
        """The header of a system's job: the inputs, and the versions of the algorithms."""
        return {"system": system, "algorithm": dict(algorithm), "mesh": self.mesh_key, "size": self.size, **more}

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches of the arrays that the result depends on."""
        return self.mesh_near

    @cached_property
    def rays(self) -> Occluder:
        """The occluder as an Embree scene, built once in each worker process."""
        return Occluder(self.occluder)

    def __getstate__(self) -> dict[str, object]:
        """The fields only, because an Embree scene cannot be pickled."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return len(self.start)

    def part(self, block: int) -> np.ndarray:
        """Indices of the vertices of a block; the last block is padded by repeating its last vertex."""
        return np.minimum(np.arange(block * BLOCK, (block + 1) * BLOCK), self.vertices - 1)

    def seen(self, block: int) -> tuple[UInt8[np.ndarray, "v d"], RayCount]:
        """Visibility of a block of vertices, from `fractional`."""
        part = self.part(block)
        start, normal = self.start[part], self.frame[part, 2]
        if self.ray_edge is None or self.ray_edge >= self.size or self.size % self.ray_edge:
            return fractional(self.rays, start, normal, size=self.size)
        seen, count = fractional(self.rays, start, normal, size=self.ray_edge, supersample=False)
        return _finer(seen, normal, size=self.size), count

    def with_texels(self, texels: int) -> "VisibilityJob":
        """The job with rays through larger texels, as `Run.texels` says."""
        job = replace(self, ray_edge=texels)
        vars(job)["rays"] = self.rays
        return job


class _Tables(NamedTuple):
    area: np.ndarray  # [d, 3] integral of direction over each texel
    center: np.ndarray  # [d, 3]
    fine: np.ndarray  # [d 16, 3]
    border: np.ndarray  # [6, n + 2, n + 2] texel indices of faces, with a border from the neighboring faces
    order: np.ndarray  # [d] texel indices, tile by tile


@lru_cache(maxsize=4)
def _tables(size: int) -> _Tables:
    fine = np.asarray(cubemap.direction(size=size * _SIDE), np.float32)
    fine = fine.reshape(6, size, _SIDE, size, _SIDE, 3).swapaxes(2, 3).reshape(-1, 3)
    tile = math.gcd(size, _SIDE)
    order = np.arange(6 * size * size).reshape(6, size // tile, tile, size // tile, tile).swapaxes(2, 3).ravel()
    return _Tables(
        np.asarray(cubemap.vector_area(size=size), np.float32).reshape(-1, 3),
        np.asarray(cubemap.direction(size=size), np.float32).reshape(-1, 3),
        np.ascontiguousarray(fine),
        np.asarray(cubemap.border_index(size=size)),
        order,
    )


def _trace(
    occluder: Occluder,
    start: np.ndarray,
    above: np.ndarray,
    seen: np.ndarray,
    table: _Tables,
    supersample: bool | np.ndarray,
    spread: int | None,
) -> RayCount:
    """Fills `seen` for some of the points; `spread` is the index of the first one, None for rays through middles."""
    vertex, rank = np.nonzero(above.take(table.order, axis=1))
    texel = table.order.take(rank)
    flat, index = seen.reshape(-1), vertex * above.shape[1] + texel
    ways = (table.center, texel) if spread is None else (table.fine, _places(vertex + spread, texel))
    flat[index] = _dither(LEVELS * shares(occluder, start, ways[0], vertex, ways[1]), vertex, texel)
    mixed = index[:0]
    if supersample is not False:
        varies = _varies if spread is None else _varies_around
        mixed = np.flatnonzero((varies(seen, table.border) & supersample).reshape(-1)[index])
        flat[index[mixed]] = _supersample(occluder, start, vertex[mixed], texel[mixed], table)
    return RayCount(len(index) + LEVELS * len(mixed), len(index), len(mixed))


def _above_horizon(normal: Float32[np.ndarray, "v 3"], size: int) -> Bool[np.ndarray, "v d"]:
    """Texels whose integral of the cosine is positive."""
    return normal.astype(np.float32) @ _tables(size).area.T > 0


def _finer(
    coarse: UInt8[np.ndarray, "v _"], normal: Float32[np.ndarray, "v 3"], *, size: int
) -> UInt8[np.ndarray, "v d"]:
    """Visibility of the texels inside of larger ones; 0 below the horizon."""
    edge = math.isqrt(coarse.shape[1] // 6)
    wide = coarse.reshape(-1, 6, edge, edge).repeat(size // edge, 2).repeat(size // edge, 3)
    return wide.reshape(len(coarse), -1) * _above_horizon(normal, size)


def shares(occluder: Occluder, *rays: np.ndarray) -> UInt8[np.ndarray, " n"] | Float32[np.ndarray, " n"]:
    """Share of light that passes along each ray; whole numbers for an occluder that does not blend."""
    return occluder.passed(*rays) if occluder.blends else (~occluder.blocked(*rays)).view(np.uint8)


def _dither(value: np.ndarray, vertex: np.ndarray, texel: np.ndarray) -> np.ndarray:
    """Whole numbers whose mean over neighboring texels is that of the values, by ordered dithering."""
    # Rounding to the nearest would change the share that all texels behind a translucent surface have, by up to 1/32.
    exact = value.dtype == np.uint8
    return value if exact else np.floor(value + (_KRONECKER[0] * texel + _KRONECKER[1] * vertex) % 1)


def _varies(seen: UInt8[np.ndarray, "v d"], border: np.ndarray) -> Bool[np.ndarray, "v d"]:
    """Texels in whose 3 x 3 neighborhood visibility, in sixteenths, differs by more than an eighth."""
    padded = seen.take(border.reshape(-1), axis=1).reshape(-1, *border.shape)
    return (_around(np.maximum, padded) - _around(np.minimum, padded) > LEVELS // 8).reshape(seen.shape)


def _varies_around(seen: UInt8[np.ndarray, "v d"], border: np.ndarray) -> Bool[np.ndarray, "v d"]:
    """The same of the eight neighbors, without the texel itself."""
    padded = seen.take(border.reshape(-1), axis=1).reshape(-1, *border.shape)
    edge = padded.shape[-1] - 2
    around = [
        padded[..., row : row + edge, column : column + edge]
        for row, column in np.ndindex(3, 3)
        if (row, column) != (1, 1)
    ]
    most, least = (functools.reduce(extreme, around) for extreme in (np.maximum, np.minimum))
    return (most - least > LEVELS // 8).reshape(seen.shape)


def _places(vertex: np.ndarray, texel: np.ndarray) -> np.ndarray:
    """Indices of directions within texels, by a hash of both."""
    mixed = (vertex.astype(np.uint32) * np.uint32(2654435761)) ^ (texel.astype(np.uint32) * np.uint32(2246822519))
    mixed = (mixed ^ (mixed >> 15)) * np.uint32(3266489917)
    return LEVELS * texel + (mixed >> np.uint32(28)).astype(texel.dtype)


def _around(extreme: np.ufunc, padded: np.ndarray) -> np.ndarray:
    """Maximum or minimum over 3 x 3 neighborhoods of images with a border of one texel."""
    rows = extreme(extreme(padded[..., :-2, :], padded[..., 1:-1, :]), padded[..., 2:, :])
    return extreme(extreme(rows[..., :-2], rows[..., 1:-1]), rows[..., 2:])


def _supersample(occluder, start, vertex, texel, table) -> np.ndarray:
    """Visible sixteenths of texels, from 16 rays for each (vertex, texel) pair."""
    out = np.empty(len(vertex), np.uint8)
    step = _RAYS // LEVELS
    for first in range(0, len(vertex), step):
        part = slice(first, first + step)
        way = (LEVELS * texel[part, None] + np.arange(LEVELS)).reshape(-1)
        share = shares(occluder, start, table.fine, np.repeat(vertex[part], LEVELS), way).reshape(-1, LEVELS)
        out[part] = _dither(share.sum(1, dtype=share.dtype), vertex[part], texel[part])
    return out


def hemisphere_hits(
    occluder: Occluder, start: Float[np.ndarray, "b 3"], normal: Float[np.ndarray, "b 3"], *, size: int
) -> tuple[Int[np.ndarray, " h"], Int[np.ndarray, " h"], Int[np.ndarray, "h 3"], Float[np.ndarray, "h 3"], int]:
    """Intersections of a scene with rays from some points through all cubemap texels above their horizons.

    Args:
        occluder: The scene.
        start: Origins of the rays.
        normal: Unit normals at these points.
        size: Edge of the cubemap's faces in texels.

    Returns:
        For each hit the index of the point, the index of the texel, the vertices of the triangle and its barycentric
        coordinates; and the total number of rays.
    """
    direction = _tables(size).center
    point, texel = np.nonzero(normal @ _tables(size).area.T > 0)
    triangle, _, barycentric = occluder.hit(start[point], direction[texel])
    hit = np.flatnonzero(triangle >= 0)
    corner = occluder.facing(triangle[hit], direction[texel[hit]])
    return point[hit], texel[hit], corner, barycentric[hit], len(point)


def hits_front(
    occluder: Occluder,
    normal: Float[np.ndarray, "v 3"],
    corner: Int[np.ndarray, "h 3"],
    direction: Float[np.ndarray, "h 3"],
) -> Bool[np.ndarray, " h"]:
    """Whether each ray hits the front of a triangle. Only fronts reflect light.

    The front is the side to which the sum of the corners' normals points, because a single normal may face away from a
    ray that hits the front.
    """
    at = occluder.position[corner]
    across = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    across = across / np.maximum(np.abs(across).max(-1, keepdims=True), np.finfo(np.float32).tiny)
    side = np.sum(across * np.sum(normal[corner], 1), -1)
    return side * np.sum(across * direction, -1) < 0


def first_fronts(
    occluder: Occluder,
    normal: Float[np.ndarray, "v 3"],
    start: Float32[np.ndarray, "b 3"],
    direction: Float32[np.ndarray, "b 3"],
) -> tuple[Int[np.ndarray, " b"], Float[np.ndarray, "b 3"]]:
    """The first triangle on each ray and its barycentric coordinates; -1 if the ray hits nothing, -2 if it hits a back.

    Args:
        occluder: The scene.
        normal: Normals of the scene's vertices.
        start: Origins of the rays.
        direction: Unit directions.
    """
    triangle, _, barycentric = occluder.facing_hit(start, direction)
    hit = np.flatnonzero(triangle >= 0)
    triangle[hit[~hits_front(occluder, normal, occluder.face[triangle[hit]], direction[hit])]] = -2
    weight = np.clip(barycentric, 0, 1)
    return triangle, weight / np.maximum(weight.sum(1, keepdims=True), 1e-6)
