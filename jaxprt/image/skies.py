"""The environment behind the objects of a picture."""

import functools

import numpy as np
from jaxtyping import Array, Float, Float32

from jaxprt.compile import known
from jaxprt.image.raster import ray_direction
from jaxprt.scene import Camera, Environment
from jaxprt.scene import environment as environments


def sky(environment: Environment, camera: Camera) -> Float[Array, "h w c"]:
    """What the pixels of a camera show of an environment where nothing hides it.

    It comes from the pixels of the environment's file, averaged over the pixels of the picture, as
    `jaxprt.scene.environment.sky` says.

    Args:
        environment: One light, not a batch.
        camera: The camera.

    Returns:
        Linear radiance.
    """
    ray = ray_direction(camera)
    return environments.sky(environment, ray, angle=pixel_angle(camera) if known(camera) else 0.0)


def pixel_angle(camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Width of each pixel in radians: the square root of the solid angle that it covers around its center.

    Args:
        camera: A camera with known values.
    """
    return _pixel_angle(camera.width, camera.height, float(camera.field_of_view))


@functools.lru_cache(maxsize=4)
def _pixel_angle(width: int, height: int, field_of_view: float) -> Float32[np.ndarray, "h w"]:
    focal = height / (2 * np.tan(field_of_view / 2))
    column = (np.arange(width) + (1 - width) / 2) / focal
    row = (np.arange(height)[:, None] + (1 - height) / 2) / focal
    angle = ((1 + column**2 + row**2) ** -0.75 / focal).astype(np.float32)
    angle.flags.writeable = False
    return angle
