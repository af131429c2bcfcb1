"""Rays from the points of pictures to the brightest texels of distant light, and to lamps.

Visibility that is interpolated between vertices has the shadow of a sun wrong where triangles are larger than the edges
of the shadow. Rays from the points themselves have it right on every mesh. They start at four places of each pixel, so
that edges are anti-aliased, and go to places within the texel that are drawn by the flux of the light at a finer
resolution, so that a sun that is smaller than a texel keeps its size. The places of neighboring pixels differ by a
dither pattern. Where the first quarter of the rays of sixteen points close to each other, 48 at least, agree, no more
are traced. None are where the corners of a triangle are known to see about the same.

What vertices see of a lamp, interpolated, has soft shadows wrong where triangles are larger than the shadows. Here each
point of a picture has its own integrals, as `jaxprt.systems.lamps.transport` defines them. They are products of two
factors, for each piece of a lamp:

* The integrals without shadows are sums over places on the lamp. There are more places where a point is close to it.
* The visible share is that of the irradiance from the places to which rays are traced. Rays start at four places of
  each pixel, and the places on the lamp differ between neighboring pixels by a dither pattern.

The first factor has no noise, so that light without shadows is smooth (Heitz, Hill and McGuire, "Combining analytic
direct illumination and stochastic shadows", 2018). Where the first rays of sixteen neighboring points all agree, no
more are traced; in half-shadows, four times as many.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Int64, Integer, UInt8

from jaxprt.scene.mesh import Mesh
from jaxprt.visibility import blocks
from jaxprt.visibility.occluder import Occluder, offsets

FULL = 240  # share of a texel that is visible completely: sixteenths are whole numbers
PLACES = 64  # places in each texel
_PIECE = 1 << 11  # points that a thread traces at a time
_GOLDEN = 0.618  # share of all rays of a texel between two that follow each other
_BAYER = np.array([[0, 2], [3, 1]])
for _ in range(2):
    _BAYER = np.block([[4 * _BAYER, 4 * _BAYER + 2], [4 * _BAYER + 3, 4 * _BAYER + 1]])


class PicturePoints(NamedTuple):
    """Points of a picture on the triangles of a mesh.

    Attributes:
        triangle: Index of the triangle of each point; -1 in padding.
        barycentric: Barycentric coordinates.
        slope: Change of the barycentric coordinates from one pixel to the next, to the right and down.
        row: Row of each point's pixel.
        column: Column of each point's pixel.
    """

    triangle: Int[np.ndarray, " p"]
    barycentric: Float[np.ndarray, "p 3"]
    slope: Float[np.ndarray, "p 2 3"]
    row: Integer[np.ndarray, " p"]
    column: Integer[np.ndarray, " p"]


class TexelRays(NamedTuple):
    """Rays of each point to some texels.

    Attributes:
        direction: Unit directions of places within each texel, in world space.
        per_texel: Number of rays of each point to each texel, at most the number of places; 0 where stored shares are
            interpolated everywhere.
    """

    direction: Float32[np.ndarray, "t n 3"]
    per_texel: Integer[np.ndarray, " t"]


def triangles(mesh: Mesh) -> tuple[np.ndarray, ...]:
    """Triangles for points of a picture: positions and normals of vertices, corners, and how far off rays start."""
    position, face = np.asarray(mesh.position, np.float32), np.ascontiguousarray(mesh.face, np.int32)
    return position, np.asarray(mesh.normal, np.float32), face, offsets(position, face)


def shares(
    surface: tuple[np.ndarray, ...],
    occluder: Occluder,
    points: PicturePoints,
    rays: TexelRays,
    *,
    stored: tuple[UInt8[np.ndarray, "v t"], Integer[np.ndarray, "3 p"]] | None = None,
) -> UInt8[np.ndarray, "t p"]:
    """Visible share of each texel at each point, in 240ths.

    Directions below the triangle of a point are blocked. Padding, and triangles without an area, see nothing.

    Args:
        surface: The triangles of the points, from `triangles`.
        occluder: Geometry that casts shadows.
        points: The points.
        rays: Rays to the texels.
        stored: Shares at vertices, and the corners of the triangle of each point among these vertices. Where the
            corners have about the same, it is interpolated, without rays; None to trace all.
    """
    from jaxprt.visibility.picture_loops import share_memory, trace_shares  # numba takes half a second to import

    # Texels start at different places, so that their dither patterns do not add up.
    count, first = np.asarray(rays.per_texel, np.int64), (np.arange(len(rays.per_texel)) * 37) % PLACES
    # Between rays, so that the first ones are spread over the texel.
    step = np.maximum(1, (_GOLDEN * count).astype(np.int64))
    while (common := np.gcd(step, count) > 1).any():
        step += common
    texels = rays.direction, rays.direction.mean(1), count, first, step
    share = np.empty((len(rays.per_texel), len(points.triangle)), np.uint8)
    if stored is None:
        stored = np.empty((0, len(share)), np.uint8), np.empty((3, 0), np.int64)
    seen, corner = (np.ascontiguousarray(*pair) for pair in zip(stored, (np.uint8, np.int64), strict=True))

    def loop(*arguments: Any) -> None:
        trace_shares(*arguments, share_memory(len(share)))

    _trace(loop, surface, occluder, points, texels, (seen, corner), share)
    return share


def _trace(
    loop: Callable,
    surface: tuple[np.ndarray, ...],
    occluder: Occluder,
    points: PicturePoints,
    *arguments: tuple | np.ndarray,
) -> None:
    """Runs a loop of `jaxprt.visibility.picture_loops` over all points, on every processor."""
    barycentric, slope = (np.ascontiguousarray(value, np.float32) for value in points[1:3])
    pattern = _BAYER[points.row % 8, points.column % 8]
    drawn = np.ascontiguousarray(points.triangle, np.int64), barycentric, slope, pattern
    packets, count = occluder.packets(), len(barycentric)

    def trace(first: int) -> None:
        query = packets.query(share=np.empty(16, np.float32))
        loop(query, surface, drawn, first, min(first + _PIECE, count), *arguments)

    list(_pool(blocks.cores()).map(trace, range(0, count, _PIECE)))


@lru_cache(maxsize=1)
def _pool(workers: int) -> ThreadPoolExecutor:
    """Threads that stay, because a picture has many rows, and to start threads takes as long as their rays."""
    return ThreadPoolExecutor(workers, thread_name_prefix="jaxprt-rays")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # threads stay behind in the parent


class LampPlaces(NamedTuple):
    """Places on lamps, at several levels of detail.

    Places of one level of a lamp stand together, piece by piece. Rays go to those of the last level, which lie on the
    surface and are ordered by repeated halving, so that any run of them covers one region.

    Attributes:
        place: Positions of the places, in world units.
        area: The area that each stands for, times the normal there; zero for a point light.
        first: Index of the first place of each level k of each lamp n.
        per_piece: Number of places of each piece at each level; 0 for a level that is not used. The last one always is.
        pieces: Number of pieces of each lamp.
        strata: Number of first rays from each point to each lamp. Four times as many are at least one a piece.
    """

    place: Float32[np.ndarray, "s 3"]
    area: Float32[np.ndarray, "s 3"]
    first: Int64[np.ndarray, "n k"]
    per_piece: Int64[np.ndarray, "n k"]
    pieces: Int64[np.ndarray, " n"]
    strata: Int64[np.ndarray, " n"]


def moments(
    surface: tuple[np.ndarray, ...],
    occluder: Occluder,
    points: PicturePoints,
    position: Float[np.ndarray, "p 3"],
    normal: Float[np.ndarray, "p 3"],
    lamps: LampPlaces,
) -> tuple[Float32[np.ndarray, "m p"], Float32[np.ndarray, "m p"], Float32[np.ndarray, "m 3 p"]]:
    """Integrals of 1, of the cosine and of the direction over what each point sees of each piece of a lamp.

    Only directions above the horizons of the shading normal and of the triangle count. Padding, and triangles without
    an area, see nothing.

    Args:
        surface: The triangles of the points, from `triangles`.
        occluder: Geometry that casts shadows: all of the mesh.
        points: The points.
        position: Their positions.
        normal: Their shading normals.
        lamps: Places on the lamps.
    """
    from jaxprt.visibility.picture_loops import trace_lamps  # numba takes half a second to import

    fields = tuple(np.ascontiguousarray(vector, np.float32) for vector in (position, normal))
    size = int(lamps.pieces.sum()), len(position)
    result = np.empty(size, np.float32), np.empty(size, np.float32), np.empty((size[0], 3, size[1]), np.float32)
    _trace(trace_lamps, surface, occluder, points, fields, tuple(lamps), result)
    return result
