"""Light that arrives at points in a scene, sampled into environments: an object moves through a room lit by these."""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from jaxprt import require
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment
from jaxprt.sphere import cubemap


def sample(
    scene: RelitScene,
    environment: Environment,
    positions: ArrayLike,
    *,
    materials: Mapping[str, Any] | None = None,
    size: int = 32,
) -> list[Environment]:
    """What is seen from points in a scene, in all directions: six pictures for each point.

    Each is an environment for objects around its point. `jaxprt.harmonic.project` makes coefficients of it, and
    `jaxprt.harmonic.probe_light` interpolates these between the points.

    Args:
        scene: The scene, without the object that is to be lit.
        environment: The light around the scene.
        positions: The points, [p, 3], in world units.
        materials: Other materials of some parts, as in `RelitScene.picture`.
        size: Edge of the environments' faces in texels.

    Raises:
        TypeError: No relit scene.
        ValueError: Points that are not [p, 3] or not finite, a size below 1, or as in `RelitScene.picture`.

    Reference: Kautz, Sloan, Snyder 2002, section 4 (finite lighting).
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    place = np.asarray(positions, np.float64)
    if place.ndim != 2 or place.shape[1] != 3:
        raise ValueError(f"positions must be [p, 3], got {list(place.shape)}")
    require.finite("the positions", place)
    if size < 1:
        raise ValueError(f"size must be at least 1, got {size}")
    return [Environment(jnp.stack(_faces(scene, environment, each, materials, size))) for each in place]


def _faces(scene: RelitScene, environment: Environment, place: np.ndarray, materials: Any, size: int) -> Sequence:
    """The faces of a cubemap around a point."""
    faces = []
    for right, down, forward in cubemap.axes():
        camera = Camera(place, place + forward, -down, np.pi / 2, size, size)
        face = scene.picture(environment, camera, materials=materials)
        # Seen from inside, the columns of a face run as the camera's do, or against them.
        faces.append(face if np.dot(np.cross(forward, -down), right) > 0 else face[:, ::-1])
    return faces
