"""Places on a surface that pictures of it show, by rays from cameras."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from jaxprt.scene.camera import Camera, orbit
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.subdivision import Points
from jaxprt.visibility.hits import first_fronts
from jaxprt.visibility.occluder import Occluder

EDGE = 64  # rays along an edge of a picture
_MOST = 16  # largest number of cameras
_TURNS = ((0.5, 0.3), (2.6, 0.6), (4.7, 0.15))  # azimuth and elevation of the cameras around the scene
_CLOSER = ((0.9, 0.4), (3.6, 0.25))  # and around parts


def cameras(mesh: Mesh, given: Sequence[Camera], parts: Sequence[Mesh]) -> list[Camera]:
    """Cameras from which a scene is likely to be seen: its own, some around it, and some around its parts.

    Args:
        mesh: The mesh of all parts.
        given: The cameras of the scene.
        parts: The meshes of the parts.
    """
    size = {"width": EDGE, "height": EDGE}
    around = [orbit(mesh, azimuth=azimuth, elevation=elevation, **size) for azimuth, elevation in _TURNS]
    chosen = [*given[: _MOST // 2], *around]
    # Parts with many triangles are what scenes are about.
    solid = [part for part in parts if len(part.face)] if len(parts) > 1 else []
    order = sorted(solid, key=lambda part: -len(part.face))
    for part in order[: (_MOST - len(chosen)) // len(_CLOSER)]:
        chosen += [orbit(part, azimuth=azimuth, elevation=elevation, **size) for azimuth, elevation in _CLOSER]
    return chosen


def places(mesh: Mesh, occluder: Occluder, views: Sequence[Camera]) -> tuple[Points, Float[np.ndarray, " p"]]:
    """Points of a mesh that cameras see from the front, and the share of all pictures that each stands for.

    Args:
        mesh: The mesh, whose triangles are those of the occluder.
        occluder: The triangles.
        views: The cameras, in the coordinates of the mesh's file.
    """
    normal = np.asarray(mesh.normal)
    triangles: list[Int[np.ndarray, " _"]] = []
    weights, shares = [], []
    for camera in views:
        eye, direction = _rays(camera.local(mesh.origin))
        triangle, weight = first_fronts(occluder, normal, np.repeat(eye[None], len(direction), 0), direction)
        seen = triangle >= 0
        if seen.any():
            triangles.append(triangle[seen])
            weights.append(weight[seen])
            shares.append(np.full(np.count_nonzero(seen), 1 / np.count_nonzero(seen)))
    if not triangles:
        return Points(np.zeros(0, np.int64), np.zeros((0, 3))), np.zeros(0)
    share = np.concatenate(shares) / len(shares)
    return Points(np.concatenate(triangles), np.concatenate(weights).astype(np.float64)), share


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The eye, and unit directions through the pixels of a small picture of the camera's shape."""
    eye, target, up = (np.asarray(each, np.float64) for each in (camera.eye, camera.target, camera.up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * max(np.linalg.norm(up), 1e-30):
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    height = np.tan(float(camera.field_of_view) / 2)
    across = height * camera.width / camera.height
    x, y = np.meshgrid(*[(np.arange(EDGE) + 0.5) / EDGE * 2 - 1] * 2)
    way = forward + across * x[..., None] * right - height * y[..., None] * np.cross(right, forward)
    way = (way / np.linalg.norm(way, axis=-1, keepdims=True)).reshape(-1, 3)
    return eye.astype(np.float32), way.astype(np.float32)
