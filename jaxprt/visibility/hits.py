"""Where rays from points on surfaces meet other surfaces, and whether they meet these from the front."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxprt.sphere import cubemap
from jaxprt.visibility.occluder import Occluder


def hits(
    occluder: Occluder, start: Float[np.ndarray, "b 3"], normal: Float[np.ndarray, "b 3"], *, size: int
) -> tuple[Int[np.ndarray, " h"], Int[np.ndarray, " h"], Int[np.ndarray, "h 3"], Float[np.ndarray, "h 3"], int]:
    """Where rays through the texels above some points' horizons meet a scene.

    Args:
        occluder: The scene.
        start: Points where rays start.
        normal: Normals there.
        size: Edge of the faces through whose texels rays are sent.

    Returns:
        Of each hit the point, the texel, the triangle's corners and the weights of these; and the number of rays.
    """
    area = np.asarray(cubemap.vector_area(size=size), np.float32).reshape(-1, 3)
    direction = np.asarray(cubemap.direction(size=size), np.float32).reshape(-1, 3)
    point, texel = np.nonzero(normal @ area.T > 0)
    triangle, _, barycentric = occluder.hit(start[point], direction[texel])
    met = np.flatnonzero(triangle >= 0)
    corner = occluder.facing(triangle[met], direction[texel[met]])
    return point[met], texel[met], corner, barycentric[met], len(point)


def front(
    occluder: Occluder,
    normal: Float[np.ndarray, "v 3"],
    corner: Int[np.ndarray, "h 3"],
    direction: Float[np.ndarray, "h 3"],
) -> Bool[np.ndarray, " h"]:
    """Whether rays meet the fronts of triangles, which alone send light.

    That is the side of the corners' normals together, since one of these may look away where the others are seen.
    """
    at = occluder.position[corner]
    across = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    side = np.sum(across * np.sum(normal[corner], 1), -1)
    return side * np.sum(across * direction, -1) < 0


def first_fronts(
    occluder: Occluder,
    normal: Float[np.ndarray, "v 3"],
    start: Float32[np.ndarray, "b 3"],
    direction: Float32[np.ndarray, "b 3"],
) -> tuple[Int[np.ndarray, " b"], Float[np.ndarray, "b 3"]]:
    """The first triangle on each ray and the weights of its corners; -1 where rays meet nothing, or a back.

    Args:
        occluder: The scene.
        normal: Normals of its vertices.
        start: Where rays start.
        direction: Unit directions.
    """
    triangle, _, barycentric = occluder.hit(start, direction)
    met = np.flatnonzero(triangle >= 0)
    triangle[met[~front(occluder, normal, occluder.face[triangle[met]], direction[met])]] = -1
    weight = np.clip(barycentric, 0, 1)
    return triangle, weight / np.maximum(weight.sum(1, keepdims=True), 1e-6)
