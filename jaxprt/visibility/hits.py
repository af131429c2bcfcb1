"""Intersections of rays from surface points with the scene, and whether rays hit the front of a surface."""

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxprt.sphere import cubemap
from jaxprt.visibility.occluder import Occluder


def hits(
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
    """The first triangle on each ray and its barycentric coordinates; -1 if the ray hits nothing or a back.

    Args:
        occluder: The scene.
        normal: Normals of the scene's vertices.
        start: Origins of the rays.
        direction: Unit directions.
    """
    triangle, _, barycentric = occluder.hit(start, direction)
    met = np.flatnonzero(triangle >= 0)
    triangle[met], barycentric[met] = occluder.toward(triangle[met], direction[met], barycentric[met])
    triangle[met[~front(occluder, normal, occluder.face[triangle[met]], direction[met])]] = -1
    weight = np.clip(barycentric, 0, 1)
    return triangle, weight / np.maximum(weight.sum(1, keepdims=True), 1e-6)
