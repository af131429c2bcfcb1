"""The points of a picture that are shaded, in rows of few lengths, and the picture that their colors make."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt.compile import jit
from jaxprt.image import raster, resolve
from jaxprt.image.pixels import Pixels
from jaxprt.scene import Camera, Environment
from jaxprt.scene.environment import background
from jaxprt.scene.points import Points

CHUNK = 1 << 13  # number of points that are shaded together
_FEWEST = 1 << 10


class Canvas(eqx.Module):
    """The points of a picture that are shaded, and where their colors go.

    Attributes:
        pixels: The points that are shaded.
        order: Index of each point's color in the list of all colors, row after row.
        ray: Unit direction in world space from the eye through the center of each pixel, to look up the background.
    """

    pixels: Pixels
    order: Int[Array, " p"]
    ray: Float[Array, "h w 3"]


def rows_of(chosen: Array | np.ndarray) -> Int[Array, "m p"]:
    """Indices of the chosen points, in rows of few different lengths, so that pictures share compiled programs."""
    if isinstance(chosen, Tracer):
        count = len(chosen)
        index = jnp.nonzero(chosen, size=count, fill_value=-1)[0]
    else:
        index = np.flatnonzero(np.asarray(chosen))
        count = len(index)
    row = CHUNK if count > CHUNK else max(_FEWEST, 1 << max(count - 1, 0).bit_length())
    rows = -(-count // row)
    # NumPy, if the number of points is known: JAX would compile for each number.
    pad = jnp.pad if isinstance(index, Tracer) else np.pad
    return jnp.asarray(pad(index, (0, rows * row - count), constant_values=-1).reshape(rows, row))


@jit
def points_of(pixels: Pixels, face: Int[Array, "f 3"], first: int | Array, index: Int[Array, " p"]) -> Points:
    """Some points of a picture that lie on one part. Padding (index -1) lies on the first vertex of the part.

    This is a compiled program by itself, so that the programs that shade do not depend on the picture's number of
    points.

    Args:
        pixels: The points of the picture.
        face: Triangles of the mesh of all parts.
        first: Index of the part's first vertex in that mesh.
        index: Indices of the points; -1 in padding.
    """
    own = jnp.maximum(index, 0)
    padding = index < 0
    corner = face[jnp.maximum(pixels.triangle[own], 0)].T - first
    # Padding lies on a vertex, so that its colors are finite.
    weight = jnp.where(padding, jnp.asarray([[1.0], [0], [0]], pixels.barycentric.dtype), pixels.barycentric[own].T)
    slope = jnp.where(padding, 0, jnp.moveaxis(pixels.slope[own], 0, -1))
    return Points(jnp.where(padding, 0, corner), weight, slope)


def lay_out(pixels: Pixels, index: Sequence[Array], camera: Camera) -> Canvas:
    """The canvas of some points. `index` holds their indices in the order in which they are shaded, -1 in padding."""
    every = [each.ravel() for each in index]
    count = len(pixels.triangle)
    if any(isinstance(each, Tracer) for each in every):
        row = jnp.concatenate(every)
        place = jnp.where(row < 0, count, row)
        order = jnp.zeros(count, jnp.int32).at[place].set(jnp.arange(len(row), dtype=jnp.int32), mode="drop")
    else:
        row = np.concatenate([np.zeros(0, np.int32), *every])
        order = np.zeros(count, np.int32)
        order[row[row >= 0]] = np.flatnonzero(row >= 0)
    return Canvas(pixels, jnp.asarray(order), raster.ray_direction(camera))


@jit
def drawn(canvas: Canvas, rows: Sequence[Array], environment: Environment) -> Float[Array, "h w c"]:
    """The picture of points with the given colors, in rows as they were shaded, in front of the environment."""
    sky = background(environment, canvas.ray)
    colors = max([sky.shape[-1], *(each.shape[-1] for each in rows)])
    flat = [jnp.broadcast_to(each, (*each.shape[:-1], colors)).reshape(-1, colors) for each in rows]
    # One more color, so that the list is not empty if nothing is seen.
    color = jnp.concatenate([*flat, jnp.zeros((1, colors), sky.dtype)])
    return resolve(canvas.pixels, color.at[canvas.order].get(mode="promise_in_bounds"), background=sky)
