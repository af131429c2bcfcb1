"""Light of lamps at the points of a picture, by shadow rays from the points.

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

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int64

from jaxprt.scene.mesh import Mesh
from jaxprt.visibility import blocks, texel_rays
from jaxprt.visibility.occluder import Occluder

_PART = 1 << 10  # points that a thread traces at a time


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
    occluder: Occluder,
    mesh: Mesh,
    points: texel_rays.PicturePoints,
    position: Float[np.ndarray, "p 3"],
    normal: Float[np.ndarray, "p 3"],
    lamps: LampPlaces,
) -> tuple[Float32[np.ndarray, "m p"], Float32[np.ndarray, "m p"], Float32[np.ndarray, "m 3 p"]]:
    """Integrals of 1, of the cosine and of the direction over what each point sees of each piece of a lamp.

    Only directions above the horizons of the shading normal and of the triangle count. Padding, and triangles without
    an area, see nothing.

    Args:
        occluder: Geometry that casts shadows: all of the mesh.
        mesh: The mesh of the points.
        points: The points.
        position: Their positions.
        normal: Their shading normals.
        lamps: Places on the lamps.
    """
    from jaxprt.visibility import lamp_packets  # numba takes half a second to import

    surface = occluder.position, np.asarray(mesh.normal, np.float32), occluder.face, occluder.offset
    drawn = *texel_rays.fields(points), texel_rays.pattern(points)
    fields = tuple(np.ascontiguousarray(each, np.float32) for each in (position, normal))
    size = int(lamps.pieces.sum()), len(position)
    result = np.empty(size, np.float32), np.empty(size, np.float32), np.empty((size[0], 3, size[1]), np.float32)
    parts = [slice(i, min(i + _PART, len(position))) for i in range(0, len(position), _PART)]
    packed = occluder.from_pixels()

    def trace(part: slice) -> None:
        lamp_packets.trace(packed.query, surface, drawn, fields, tuple(lamps), part.start, part.stop, result)

    with ThreadPoolExecutor(blocks.cores()) as pool:
        list(pool.map(trace, parts))
    return result
