"""Shadow rays from the points of a picture to single texels of the light.

Visibility that is interpolated between vertices has the shadow of a sun wrong where triangles are larger than the edges
of the shadow. Rays from the points themselves have it right on every mesh. They start at four places of each pixel, so
that edges are anti-aliased, and go to places within the texel that are drawn by the flux of the light at a finer
resolution, so that a sun that is smaller than a texel keeps its size. The places of neighboring pixels differ by a
dither pattern.
"""

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, Integer, UInt8

from jaxprt.scene.mesh import Mesh
from jaxprt.visibility import blocks
from jaxprt.visibility.occluder import Occluder, offsets

FULL = 255  # share of a texel that is visible completely
PLACES = 64  # places in each texel
_PART = 1 << 12  # points that a thread traces at a time
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
        per_texel: Number of rays of each point to each texel, at most the number of places.
    """

    direction: Float32[np.ndarray, "t n 3"]
    per_texel: Integer[np.ndarray, " t"]


def shares(mesh: Mesh, occluder: Occluder, points: PicturePoints, rays: TexelRays) -> UInt8[np.ndarray, "t p"]:
    """Visible share of each texel at each point, in 255ths.

    Directions below the triangle of a point are blocked. Padding, and triangles without an area, see nothing.

    Args:
        mesh: The mesh of the points.
        occluder: Geometry that casts shadows.
        points: The points.
        rays: Rays to the texels.
    """
    from jaxprt.visibility import packets  # numba takes half a second to import

    position = np.asarray(mesh.position, np.float32)
    face = np.ascontiguousarray(mesh.face, np.int32)
    surface = position, np.asarray(mesh.normal, np.float32), face, offsets(position, face)
    drawn = *fields(points), pattern(points)
    middle = rays.direction.mean(1)
    # Texels start at different places, so that their dither patterns do not add up.
    first = (np.arange(len(rays.per_texel)) * 37) % PLACES
    texels = rays.direction, middle, np.asarray(rays.per_texel, np.int64), first
    share = np.empty((len(rays.per_texel), len(points.triangle)), np.uint8)
    parts = [slice(i, min(i + _PART, share.shape[1])) for i in range(0, share.shape[1], _PART)]
    packed = occluder.from_pixels()

    def trace(part: slice) -> None:
        packets.trace_shares(packed.query, surface, drawn, texels, part.start, part.stop, share)

    with ThreadPoolExecutor(blocks.cores()) as pool:
        list(pool.map(trace, parts))
    return share


def fields(points: PicturePoints) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, barycentric coordinates and slopes of points, as the loops over packets take them."""
    barycentric, slope = (np.ascontiguousarray(each, np.float32) for each in points[1:3])
    return np.ascontiguousarray(points.triangle, np.int64), barycentric, slope


def pattern(points: PicturePoints) -> Int[np.ndarray, " p"]:
    """Number in the dither pattern of each point's pixel, from 0 to 63."""
    return _BAYER[points.row % 8, points.column % 8]
