"""The local origin of a mesh: subtracted from positions in float64, because float32 loses digits far from zero.

At map coordinates, such as (512345, 4987654), the spacing of float32 is up to half a meter. Meshes therefore store
positions relative to an origin near them. Cameras, eyes, lamps and points are given in the coordinates of the file and
come in through `local`.
"""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Float, Integer

from jaxprt import require

Origin = tuple[float, float, float]
ZERO: Origin = (0.0, 0.0, 0.0)
_FAR = 64  # distance from zero, in diagonals of the bounding box, from which on a mesh gets an origin of its own
_OUTLIERS = 0.01  # share of the vertices at each end of an axis that do not count: stray ones are common in surveys
_FINE = 64  # steps of float32 that the extent of a triangle should have: corners are then right to a hundredth of it
_BLOCK = 1 << 18  # triangles
_LARGE = 64.0  # coordinates above this are kept in float64 where float32 would round them


def mesh_origin(position: Float[np.ndarray, "v 3"]) -> Origin:
    """The origin of a mesh: zero unless the mesh is farther from it than 64 times its size.

    The origin is the middle of the bounding box, without the outermost hundredth of the vertices, rounded to a multiple
    of a power of two that is about the size of the mesh. Subtracting it is exact in float64 for coordinates that have
    at most 53 bits.

    Args:
        position: Positions of the vertices that faces use, finite.
    """
    low, high = np.quantile(np.asarray(position, np.float64), [_OUTLIERS, 1 - _OUTLIERS], axis=0, method="nearest")
    size = float(np.linalg.norm(high - low))
    if not np.maximum(np.abs(low), np.abs(high)).max() > _FAR * size:
        return ZERO
    middle = low + (high - low) / 2
    step = 2.0 ** np.ceil(np.log2(size)) if size > 0 else 0.0
    x, y, z = (np.round(middle / step) * step if step > 0 else middle).tolist()
    return (x, y, z)


def warn_of_rounding(position: Float[np.ndarray, "v 3"], face: Integer[np.ndarray, "f 3"], name: str) -> None:
    """Warns if float32 cannot hold the triangles of a mesh, because it has parts that are too far apart.

    Args:
        position: Positions relative to the origin, in float64.
        face: Vertices of each triangle.
        name: Description of the mesh for the message.
    """
    rounded, first = 0, None
    for start in range(0, len(face), _BLOCK):
        corner = position[face[start : start + _BLOCK]]
        size = np.ptp(corner, axis=1).max(1)
        coarse = np.flatnonzero((size > 0) & (size < _FINE * np.spacing(np.abs(corner).max((1, 2)).astype(np.float32))))
        if first is None and coarse.size:
            first = start + coarse[0], corner[coarse[0]].mean(0)
        rounded += coarse.size
    if first is not None and rounded > _OUTLIERS * len(face):
        step = float(np.spacing(np.float32(np.abs(first[1]).max())))
        warnings.warn(
            f"{name}: {rounded} of {len(face)} triangles lose their shape in float32, because parts of the mesh are "
            f"too far apart: the corners of triangle {first[0]} are rounded to steps of {step:.2g} units. Remove stray "
            "vertices, or load distant parts as separate scenes",
            stacklevel=5,
        )


def local(name: str, position: Any, origin: Origin) -> Any:
    """A position relative to an origin, subtracted in float64.

    Args:
        name: Description of the position for the message, such as "the eye".
        position: The position in the coordinates of the file.
        origin: The origin of the mesh.

    Returns:
        The same position if the origin is zero; otherwise a JAX array, in float32 unless float64 is enabled.

    Raises:
        ValueError: The origin is not zero, and the position is inside of `jax.jit`, `jax.vmap` or `jax.grad`, where
            float32 has rounded it. Outside, float32 is taken as it is: it may be exact.
    """
    if origin == ZERO:
        return position
    if isinstance(position, Tracer):
        raise ValueError(
            f"{name} must be relative to the scene inside of jax.jit, jax.vmap and jax.grad, because float32 rounds "
            f"coordinates near the scene's origin {origin}: use relit.centered() with camera.local(mesh.origin)"
        )
    require.position(name, position)
    return jnp.asarray(np.asarray(position, np.float64) - np.asarray(origin), jnp.result_type(float))


def coordinates(value: object) -> Any:
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
