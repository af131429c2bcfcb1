"""The local origin of a mesh: what float32 loses far away from zero is taken off in float64 first.

At map coordinates, such as (512345, 4987654), the spacing of float32 is up to half a meter. Meshes therefore store
positions relative to an origin near them. Cameras, eyes, lamps and points are given in the coordinates of the file and
come in through `local`.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float

from jaxprt import require

Origin = tuple[float, float, float]
ZERO: Origin = (0.0, 0.0, 0.0)
_FAR = 64  # distance from zero, in diagonals of the bounding box, from which on a mesh gets an origin of its own
_LARGE = 64.0  # coordinates above this are kept in float64 where float32 would round them


def of(position: Float[np.ndarray, "v 3"]) -> Origin:
    """The origin of a mesh: zero unless the mesh is farther from it than 64 times its size.

    The origin is the middle of the bounding box, rounded to a multiple of a power of two that is about the size of the
    mesh. Subtracting it is exact in float64 for coordinates that have at most 53 bits.

    Args:
        position: Positions of the vertices that faces use, finite.
    """
    low, high = np.min(position, 0).astype(np.float64), np.max(position, 0).astype(np.float64)
    size = float(np.linalg.norm(high - low))
    if not np.maximum(np.abs(low), np.abs(high)).max() > _FAR * size:
        return ZERO
    middle = low + (high - low) / 2
    step = 2.0 ** np.ceil(np.log2(size)) if size > 0 else 0.0
    x, y, z = (np.round(middle / step) * step if step > 0 else middle).tolist()
    return (x, y, z)


def local(name: str, position: Any, origin: Origin) -> Any:
    """A position relative to an origin, subtracted in float64.

    Args:
        name: Description of the position for the message, such as "the eye".
        position: The position in the coordinates of the file.
        origin: The origin of the mesh.

    Returns:
        The same position if the origin is zero; otherwise a JAX array, in float32 unless float64 is enabled.

    Raises:
        ValueError: The origin is not zero and the position is inside of `jax.jit`, `jax.vmap` or `jax.grad`, where it
            has been rounded to float32.
    """
    if origin == ZERO:
        return position
    if isinstance(position, Tracer):
        if position.dtype == jnp.float64:
            return position - jnp.asarray(origin, position.dtype)
        raise ValueError(
            f"{name} must be relative to the scene inside of jax.jit, jax.vmap and jax.grad, because {position.dtype} "
            f"rounds coordinates near the scene's origin {origin}: use relit.centered() with camera.local(mesh.origin)"
        )
    require.position(name, position)
    return jnp.asarray(np.asarray(position, np.float64) - np.asarray(origin), jnp.result_type(float))


def coordinates(value: Any) -> Any:
    """Real numbers as an array: of NumPy in float64 where float32 would round large coordinates, otherwise of JAX.

    Anything but real numbers is returned unchanged, for the check of the class to refuse.
    """
    if isinstance(value, jax.Array) or require.unreal(value):
        return require.floating(value)
    try:
        exact = np.asarray(value, np.float64)
    except TypeError:  # a list of values inside of `jax.jit`
        return require.floating(value)
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = exact.astype(jnp.result_type(float)).astype(np.float64)
    large = exact.size and np.isfinite(exact).all() and np.abs(exact).max() > _LARGE
    return exact if large and np.any(rounded != exact) else require.floating(value)
