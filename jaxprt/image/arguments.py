"""Checks of the arguments of this folder's functions, for `require.arguments`."""

from collections.abc import Callable

import jax
import numpy as np
from jax.core import Tracer

from jaxprt import require
from jaxprt.scene.camera import Camera
from jaxprt.scene.mesh import Mesh

STOPS = 100.0  # largest exposure: 2^100 times the largest radiance fits into float32


def a_mesh(value: object) -> None:
    """Refuses anything but a mesh."""
    require.kind("the mesh", value, Mesh, source="jaxprt.scene.mesh.make_mesh or jaxprt.load_mesh")


def a_camera(value: object) -> None:
    """Refuses anything but a camera."""
    require.kind("the camera", value, Camera, source="jaxprt.scene.camera.orbit")


def numbers(name: str, *axes: str) -> Callable[[object], jax.Array]:
    """A check for arrays of real numbers without NaN. It converts lists, integers and half precision.

    Infinite values pass, because display clamps them.

    Args:
        name: Description of the array for the message, such as "the image".
        axes: Allowed shapes, as `require.array` takes them; any if none are given.
    """

    def check(value: object) -> jax.Array:
        require.real(name, value)
        converted = require.floating(value)
        if axes:
            require.array(name, converted, *axes)
        if not isinstance(converted, Tracer):
            known = np.asarray(converted)
            if known.size and np.isnan(known.min()):  # a fifth of the time of looking at each
                broken = int(np.isnan(known).sum())
                raise ValueError(f"{name} must not hold NaN, got {broken} of {converted.size} values that are NaN")
        return converted

    return check


def samples(value: object) -> None:
    """Refuses anything but a whole number."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"samples must be 1 or 4, got {require.shown(value)}")


def color(value: object) -> jax.Array:
    """Refuses colors that are not of real numbers. NaN passes: vertices that no pixel shows may have it."""
    require.real("color", value)
    return require.floating(value)


def background(value: object) -> jax.Array | None:
    """Refuses a background that is neither None nor of numbers without NaN."""
    return None if value is None else numbers("the background")(value)


def check_background(background: jax.Array | None, camera: Camera, colors: int) -> None:
    """Refuses a background of another size than the picture."""
    if background is None:
        return
    shape = (camera.height, camera.width, colors)
    try:
        fits = np.broadcast_shapes(background.shape, shape) == shape
    except ValueError:
        fits = False
    if not fits:
        raise ValueError(f"the background must be {list(shape)}, as the picture, got {list(background.shape)}")
