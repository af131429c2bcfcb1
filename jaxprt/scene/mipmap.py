"""Mip maps: texture lookups that average over the footprints of pixels."""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.scene import texture

_PROBES = 4  # probes along an elongated footprint
_LONG = 1.5  # ratio of length to width above which one probe is not enough


class Mipmap(eqx.Module):
    """A pyramid of an image: its full resolution, half of that, and so on down to one texel.

    Attributes:
        texel: Texels of all levels, row by row, the finest level first.
        shape: Height and width of each level.
    """

    texel: Float[Array, "t c"]
    shape: tuple[tuple[int, int], ...] = eqx.field(static=True)


@jit
def make(image: Float[Array, "h w c"]) -> Mipmap:
    """Computes the mip map of an image. Each level averages the level before over texels of twice the edge.

    Odd sizes are halved and rounded up. Texels at the border are then weighted by the area that they cover.
    """
    levels = [image]
    while max(levels[-1].shape[:2]) > 1:
        levels.append(_halved(_halved(levels[-1], 0), 1))
    shape = tuple((each.shape[0], each.shape[1]) for each in levels)
    return Mipmap(jnp.concatenate([each.reshape(-1, image.shape[2]) for each in levels]), shape)


def _halved(image: Array, axis: int) -> Array:
    size = image.shape[axis]
    count = -(-size // 2)
    if size == 2 * count:
        pairs = image.reshape(*image.shape[:axis], count, 2, *image.shape[axis + 1 :])
        return jnp.mean(pairs, axis + 1)
    step = size / count
    edge = np.arange(count + 1) * step
    first = np.floor(edge[:-1] + 1e-9).astype(np.int64)
    total: Array | float = 0.0
    for tap in range(3):
        texel = np.minimum(first + tap, size - 1)
        covered = np.minimum(first + tap + 1, edge[1:]) - np.maximum(first + tap, edge[:-1])
        weight = np.maximum(covered, 0) / step
        wide = [-1 if each == axis else 1 for each in range(image.ndim)]
        total = total + jnp.take(image, texel, axis) * weight.reshape(wide).astype(image.dtype)
    return jnp.asarray(total)


@functools.partial(jit, static_argnames="wrap")
def lookup(
    mipmap: Mipmap, coordinate: Float[Array, "p 2"], slope: Float[Array, "2 p 2"], *, wrap: tuple[str, str]
) -> Float[Array, "p c"]:
    """Looks up a texture, averaged over the footprint of each point's pixel.

    Interpolation is trilinear. If a pixel sees the surface at a grazing angle, four lookups along its footprint are
    averaged.

    Args:
        mipmap: The texture.
        coordinate: Texture coordinates, in the convention of `jaxprt.scene.texture.lookup`.
        slope: Change of the coordinates from one pixel to the next, to the right and down.
        wrap: Wrap modes along u and v.

    Reference: Williams 1983, "Pyramidal parametrics"; Heckbert 1986, "Survey of texture mapping", section 4.
    """
    height, width = mipmap.shape[0]
    scaled = jax.lax.stop_gradient(slope) * jnp.asarray([width, height], slope.dtype)
    length = jnp.sqrt(jnp.sum(scaled**2, -1))
    across = length[0] > length[1]
    long, short = jnp.maximum(length[0], length[1]), jnp.minimum(length[0], length[1])
    along = jnp.where(across[:, None], slope[0], slope[1])

    def probes(count: int) -> Array:
        level = jnp.log2(jnp.maximum(jnp.maximum(short, long / count), 1.0))
        offset = (np.arange(count) + 0.5) / count - 0.5
        rows = [_trilinear(mipmap, coordinate + each * along, level, wrap) for each in offset.tolist()]
        return sum(rows[1:], start=rows[0]) / count

    if not len(coordinate):
        return probes(1)
    flat = jnp.any((long > _LONG * short) & (long > _LONG))
    return jax.lax.cond(flat, lambda: probes(_PROBES), lambda: probes(1))


def _trilinear(mipmap: Mipmap, coordinate: Array, level: Array, wrap: tuple[str, str]) -> Array:
    most = len(mipmap.shape) - 1
    low = jnp.minimum(jnp.floor(level), max(most - 1, 0)).astype(jnp.int32)
    upper = jnp.clip(level - low, 0, 1)
    height, width = (jnp.asarray(each, jnp.int32) for each in zip(*mipmap.shape, strict=True))
    start = jnp.asarray(np.cumsum([0, *(math.prod(each) for each in mipmap.shape[:-1])]), jnp.int32)
    total = jnp.zeros((len(coordinate), mipmap.texel.shape[1]), mipmap.texel.dtype)
    for step, part in ((0, 1 - upper), (1, upper)) if most else ((0, jnp.ones_like(upper)),):
        number = low + step
        own = height[number], width[number]
        for (row, column), weight in texture.bilinear(coordinate, own, wrap):
            total = total + mipmap.texel[start[number] + row * own[1] + column] * (weight * part)[:, None]
    return total
