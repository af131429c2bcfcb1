"""Light probes: samples the light that arrives at points of a scene into environments, for objects that move in it."""

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
    """Renders what is seen from points of a scene in all directions, as one environment for each point.

    Each environment consists of six pictures and lights objects near its point. `jaxprt.harmonic.project` makes SH
    coefficients of it, and `jaxprt.harmonic.probe_light` interpolates these between the points.

    Args:
        scene: The precomputed scene, without the object that is to be lit.
        environment: The light around the scene.
        positions: Positions of the points in world units, [p, 3].
        materials: Dictionary from names of parts to new materials, in the form that `RelitScene` describes.
        size: Edge of the environments' cubemap faces in texels.

    Raises:
        TypeError: `scene` is not a `RelitScene`, `positions` are not real numbers, or `size` is not a whole number.
        ValueError: `positions` is not [p, 3] or not finite, `size` is below 1, or for the reasons that
            `RelitScene.picture` gives.

    Reference: Kautz, Sloan, Snyder 2002, section 4 (finite lighting).
    """
    require.kind("the scene", scene, RelitScene, source="jaxprt.precompute")
    require.real("the positions", positions)
    require.count("size", size, least=1)
    place = np.asarray(positions, np.float64)
    if place.ndim != 2 or place.shape[1] != 3:
        raise ValueError(f"positions must be [p, 3], got {list(place.shape)}")
    require.finite("the positions", place)
    return [Environment(jnp.stack(_faces(scene, environment, point, materials, size))) for point in place]


def _faces(scene: RelitScene, environment: Environment, place: np.ndarray, materials: Any, size: int) -> Sequence:
    """Renders the six cubemap faces around a point."""
    faces = []
    for right, down, forward in cubemap.axes():
        camera = Camera(place, place + forward, -down, np.pi / 2, size, size)
        face = scene.picture(environment, camera, materials=materials)
        # Seen from inside, the columns of some faces run in the opposite direction to the camera's.
        faces.append(face if np.dot(np.cross(forward, -down), right) > 0 else face[:, ::-1])
    return faces
