"""Mip maps: an image at its full resolution, half of that, and so on down to one texel."""

from typing import Any

import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float


def levels(image: Float[Array | np.ndarray, "h w c"]) -> list[Any]:
    """The levels of an image's mip map, finest first; in NumPy unless JAX traces the image.

    Each level averages the level before over texels of twice the edge. Odd sizes are halved and rounded up. Texels at
    the border are then weighted by the area that they cover.
    """
    result: list[Any] = [image if isinstance(image, Tracer) else np.asarray(image)]
    while max(result[-1].shape[:2]) > 1:
        result.append(_halved(_halved(result[-1], 0), 1))
    return result


def _halved(image: Any, axis: int) -> Any:
    size = image.shape[axis]
    count = -(-size // 2)
    if size == 2 * count:
        pairs = image.reshape(*image.shape[:axis], count, 2, *image.shape[axis + 1 :])
        return pairs.mean(axis + 1)
    step = size / count
    edge = np.arange(count + 1) * step
    first = np.floor(edge[:-1] + 1e-9).astype(np.int64)
    total: Any = 0.0
    for tap in range(3):
        texel = np.minimum(first + tap, size - 1)
        covered = np.minimum(first + tap + 1, edge[1:]) - np.maximum(first + tap, edge[:-1])
        weight = np.maximum(covered, 0) / step
        wide = [-1 if each == axis else 1 for each in range(image.ndim)]
        total = total + image.take(texel, axis) * weight.reshape(wide).astype(image.dtype)
    return total
