"""The points of a picture in rows of one length, and the picture that their colors make.

How many points a picture has depends on the view. What depends on that number stays in NumPy on the host, so that a new
view runs the programs of the last one.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt.compile import jit, known, put
from jaxprt.image.pixels import Pixels, by_color, pixel_angle
from jaxprt.relit.groups import Stage
from jaxprt.scene import Camera, Environment
from jaxprt.scene.environment import background
from jaxprt.scene.points import Points
from jaxprt.visibility.picture_rays import PicturePoints

ROW = 1 << 12  # number of points that are shaded together


def rows_of(
    chosen: Array | np.ndarray, *, owner: Int[np.ndarray, " n"] | None = None
) -> Int[Array | np.ndarray, "m p"]:
    """Indices of the chosen points in rows of one length; -1 is padding.

    Args:
        chosen: Whether each point is chosen.
        owner: Part of each point. Points of one part then stand together, and a row reads fewer vertices and texels.
    """
    if isinstance(chosen, Tracer):
        count = len(chosen)
        index: Any = jnp.nonzero(chosen, size=count, fill_value=-1)[0]
    else:
        index = np.flatnonzero(np.asarray(chosen))
        index = index if owner is None else index[np.argsort(owner[index], kind="stable")]
        count = len(index)
    rows = -(-count // ROW)
    pad = jnp.pad if isinstance(index, Tracer) else np.pad
    return pad(index, (0, rows * ROW - count), constant_values=-1).reshape(rows, ROW).astype(np.int32)


def points_of(stage: Stage, pixels: Pixels, index: Any) -> tuple[Points, Points]:
    """Some points of a picture that lie on one group: on the mesh of all parts, and on the group.

    Args:
        stage: The scene.
        pixels: The points of the picture.
        index: Indices of the points; -1 in padding, which repeats the first point.
    """
    face, shift = stage.face, stage.shift
    xp: Any = np if known(pixels, face, shift, index) else jnp
    index = xp.where(index < 0, xp.maximum(index[0], 0), index)
    corner = xp.asarray(face)[xp.maximum(xp.asarray(pixels.triangle)[index], 0)].T
    weight, slope = (xp.asarray(column)[index] for column in (pixels.barycentric, pixels.slope))
    # Padding of the picture itself has weights of zero. It lies on a vertex, so that its colors are finite.
    weight = xp.where(xp.sum(weight, 1, keepdims=True) > 0, weight, xp.asarray([1.0, 0.0, 0.0], weight.dtype)).T
    slope = xp.moveaxis(slope, 0, -1)
    of_group = corner - xp.asarray(shift)[corner]
    corner, of_group, weight, slope = put((corner, of_group, weight, slope))
    return Points(corner, weight, slope), Points(of_group, weight, slope)


def traced(pixels: Pixels, width: int, index: Int[np.ndarray, " p"]) -> PicturePoints:
    """Points of a picture for rays that start from them.

    Args:
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
        index: Indices of the points; -1 in padding.
    """
    fields = pixels.triangle, pixels.barycentric, pixels.slope, pixels.pixel
    triangle, barycentric, slope, pixel = (np.asarray(field)[index] for field in fields)
    return PicturePoints(np.where(index < 0, -1, triangle), barycentric, slope, pixel // width, pixel % width)


def sky(
    environment: Environment, camera: Camera, ray: Float[Array, "h w 3"], share: Float[Array, "h w *c"], *, colors: int
) -> Float[Array, "h w _"]:
    """The environment where nothing hides it, in a number of colors.

    Args:
        environment: The light.
        camera: The camera of the pixels.
        ray: Unit direction in world space from the eye through the center of each pixel.
        share: Fraction of each pixel that sees nothing else, for each color if it looks through glass.
        colors: Number of colors of the picture.
    """
    if environment.panorama is None or not known(environment, camera, ray, share):
        return _texels_behind(environment, ray, share, colors=colors)
    cover = by_color(np.asarray(share), colors, axes=2).reshape(share.shape[0] * share.shape[1], -1)
    seen = np.flatnonzero(cover.max(1) > 0)
    color = environment.panorama.sampled(np.asarray(ray).reshape(-1, 3)[seen], pixel_angle(camera).reshape(-1)[seen])
    picture = np.zeros((len(cover), colors), environment.radiance.dtype)
    picture[seen] = cover[seen] * color
    return put(picture.reshape(*share.shape[:2], colors))


@partial(jit, static_argnames="colors")
def _texels_behind(
    environment: Environment, ray: Float[Array, "h w 3"], share: Float[Array, "h w *c"], *, colors: int
) -> Float[Array, "h w _"]:
    behind = background(environment, ray)
    part = by_color(share, colors, axes=2).astype(behind.dtype)
    picture = jnp.where(part > 0, part * behind, 0)
    return jnp.broadcast_to(picture, (*picture.shape[:2], colors))


def draw(
    picture: Float[Array, "h w c"], pixels: Pixels, index: Int[Array | np.ndarray, "*m"], color: Float[Array, "*m d"]
) -> Float[Array, "h w c"]:
    """The picture with the colors of some points added, each to its pixel. The picture before is used up.

    Args:
        picture: The picture so far.
        pixels: The points of the picture.
        index: Indices of the points; -1 in padding.
        color: Their colors.
    """
    xp = np if known(pixels, index) else jnp
    index = index.reshape(-1)
    point = xp.maximum(index, 0)
    pixel, coverage = (xp.asarray(column)[point] for column in (pixels.pixel, pixels.coverage))
    coverage = by_color(coverage, picture.shape[2])
    coverage = xp.where((index < 0)[:, None], xp.zeros((), coverage.dtype), coverage)
    return _add(picture, pixel, coverage, color.reshape(-1, color.shape[-1]))


@partial(jit, donate_argnames="picture")
def _add(
    picture: Float[Array, "h w c"], pixel: Int[Array, " p"], coverage: Float[Array, "p _"], color: Float[Array, "p d"]
) -> Float[Array, "h w c"]:
    height, width, colors = picture.shape
    share = coverage.astype(picture.dtype)
    part = jnp.where(share > 0, share * jnp.broadcast_to(color, (len(color), colors)), 0)
    flat = picture.reshape(-1, colors)
    return flat.at[pixel].add(part, mode="promise_in_bounds").reshape(height, width, colors)
