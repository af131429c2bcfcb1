"""Sampling of distant light by a small number of directions."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, harmonics

_LEVELS = 12  # levels of the space-filling curve inside of a texel


class LightSamples(NamedTuple):
    """Directions that sample lights, and their weights.

    The sum over directions of weight times visibility times cosine is the radiance of a white diffuse surface.

    Attributes:
        direction: Unit directions in world coordinates.
        weight: Radiance times solid angle over pi, for each light and color; 0 for directions that sample other lights.
    """

    direction: Float32[np.ndarray, "d 3"]
    weight: Float32[np.ndarray, "d l c"]


def importance(environments: Sequence[Environment], *, count: int) -> LightSamples:
    """Samples lights in proportion to the power of their texels, with the same number of directions for each light.

    Directions are at equal steps of power along a space-filling curve through all texels. The curve continues inside of
    each texel, so the many directions of a texel with a sun are spread over its area.

    Args:
        environments: One or more lights, each with any size and number of colors.
        count: Number of directions for each light.

    Returns:
        The samples. If a light has fewer colors than another, its weights for the missing colors are 0.
    """
    if not isinstance(environments, Sequence):
        raise TypeError(f"environments must be a list of lights, got one {type(environments).__name__}")
    if not environments:
        raise ValueError("environments must be at least one, got none")
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    for number, light in enumerate(environments):
        require.kind(f"environment {number}", light, Environment, source="jaxprt.load_environment")
        require.array(f"the radiance of environment {number}", light.radiance, "6 n n c")
    colors = max(light.radiance.shape[-1] for light in environments)
    samples = [_sample(np.asarray(light.radiance, np.float64), count) for light in environments]
    weight = np.zeros((len(samples), count, len(samples), colors), np.float32)
    for number, (_, weights) in enumerate(samples):
        weight[number, :, number, : weights.shape[-1]] = weights
    direction = np.concatenate([direction for direction, _ in samples]).astype(np.float32)
    return LightSamples(direction, weight.reshape(-1, *weight.shape[2:]))


def natural(*, size: int, degree: int) -> LightSamples:
    """Samples that represent the average over lights with a natural spectrum and unknown orientation.

    There is one direction per cubemap texel, and one light whose colors are weighted spherical harmonics. The sum over
    colors of a surface's squared radiance equals the mean of its squared radiance over all such lights.

    Args:
        size: Texels along the edge of a face.
        degree: Highest degree of the harmonics.
    """
    direction = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1, 1)
    value = np.asarray(harmonics.evaluate(direction, degree=degree), np.float64)
    band = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    weight = value * np.asarray(harmonics.natural(degree=degree), np.float64)[band] * area / np.pi
    return LightSamples(direction.astype(np.float32), weight[:, None].astype(np.float32))


def _sample(radiance: np.ndarray, count: int) -> tuple[Float[np.ndarray, "d 3"], Float[np.ndarray, "d c"]]:
    """Directions that sample one light, and their weights."""
    size = radiance.shape[1]
    order = _curve(size)
    texel = radiance.reshape(-1, radiance.shape[-1])[order]
    area = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1)[order]
    power = np.maximum(texel.mean(-1), 0) * area
    if not power.any():
        return np.tile([0.0, 1.0, 0.0], (count, 1)), np.zeros((count, radiance.shape[-1]))
    total = np.cumsum(power)
    reached = (np.arange(count) + 0.5) / count * total[-1]
    at = np.searchsorted(total, reached)
    inside = _on_curve(1 - (total[at] - reached) / power[at])
    face, place = np.divmod(order[at], size**2)
    row, column = np.divmod(place, size)
    s, t = 2 * (np.stack([column, row]) + inside) / size - 1
    point = np.einsum("da,dac->dc", np.stack([s, t, np.ones(count)], -1), cubemap.axes()[face])
    length = np.linalg.norm(point, axis=1, keepdims=True)
    # Points are uniform in texel coordinates; the solid angle around each point is not.
    solid = (2 / size) ** 2 / length**3
    weight = texel[at] * solid * (total[-1] / count / power[at] / np.pi)[:, None]
    return point / length, weight


def _curve(size: int) -> Int[np.ndarray, " d"]:
    """Texel indices along the Lebesgue (Z-order) curve on each face, which keeps neighbors close to each other."""
    row, column = np.divmod(np.arange(size**2), size)
    bits = range(size.bit_length())
    code = sum(((row >> bit & 1) << 2 * bit + 1) | ((column >> bit & 1) << 2 * bit) for bit in bits)
    order = np.argsort(code, kind="stable")
    return (np.arange(6)[:, None] * size**2 + order).ravel()


def _on_curve(fraction: Float[np.ndarray, " d"]) -> Float[np.ndarray, "2 d"]:
    """Column and row within a texel, from 0 to 1, at a fraction of the curve's length inside of the texel."""
    place = np.full((2, len(fraction)), 0.5**_LEVELS / 2)
    for level in range(1, _LEVELS + 1):
        quarter = np.clip(np.floor(4 * fraction), 0, 3)
        fraction = 4 * fraction - quarter
        place += np.stack([quarter % 2, quarter // 2]) / 2**level
    return place


def spots_in_texels(
    texel: Int[np.ndarray, " t"], radiance: Float[np.ndarray, "6 m m c"], *, size: int
) -> Float[np.ndarray, "t 4"]:
    """Where in some texels of a light its flux comes from, by the same light at a finer resolution.

    Args:
        texel: Indices of the texels.
        radiance: The light at the finer resolution, whose edge is a multiple of `size`.
        size: Edge of the cubemap faces in texels.

    Returns:
        For each texel the mean place along rows and down columns, from -1 to 1, and its standard deviation along both,
        relative to that of even light: 0, 0, 1, 1 for light from everywhere, and for texels without flux.
    """
    factor = radiance.shape[1] // size
    face, row, column = texel // size**2, texel // size % size, texel % size
    down, across = (factor * index[:, None] + np.arange(factor) for index in (row, column))
    fine = np.maximum(radiance[face[:, None, None], down[:, :, None], across[:, None]].astype(np.float64).sum(-1), 0)
    fine = np.where(fine.sum((1, 2), keepdims=True) > 0, fine, 1)
    share = fine / fine.sum((1, 2), keepdims=True)
    place = (2 * np.arange(factor) + 1) / factor - 1
    texel_variance = 1 / (3 * factor**2)  # variance of a fine texel
    mean, spread = [], []
    for weight in (share.sum(1), share.sum(2)):
        mean.append(weight @ place)
        spread.append(np.sqrt(3 * (weight @ place**2 - mean[-1] ** 2 + texel_variance)))
    return np.stack([*mean, *spread], -1)


def in_texels(
    texel: Int[np.ndarray, " t"], radiance: Float[np.ndarray, "6 m m c"], *, size: int, count: int
) -> Float32[np.ndarray, "t n 3"]:
    """Directions within some texels of a light, drawn by the flux of the same light at a finer resolution.

    Each direction stands for the same flux. They follow a space-filling curve, so that consecutive ones are neighbors.

    Args:
        texel: Indices of the texels.
        radiance: The light at the finer resolution, whose edge is a multiple of `size`. In a texel without flux,
            directions are even.
        size: Edge of the cubemap faces in texels.
        count: Number of directions in each texel.
    """
    factor = radiance.shape[1] // size
    order = _curve(factor)[: factor * factor]
    down, across = np.divmod(order, factor)
    face, row, column = texel // size**2, texel // size % size, texel % size
    here = face[:, None], factor * row[:, None] + down, factor * column[:, None] + across
    area = np.asarray(cubemap.solid_angle(size=factor * size), np.float64)[here]
    flux = np.maximum(radiance[here].astype(np.float64).sum(-1), 0) * area
    flux = np.where(flux.sum(1, keepdims=True) > 0, flux, area)
    total = np.cumsum(flux, 1)
    reached = (np.arange(count) + 0.5) / count * total[:, -1:]
    cell = np.stack([np.searchsorted(*pair) for pair in zip(total, reached, strict=True)])
    cell = np.minimum(cell, factor * factor - 1)
    which = np.arange(len(texel))[:, None]
    inside = _on_curve(np.clip(1 - (total[which, cell] - reached) / flux[which, cell], 0, 1).ravel()).reshape(
        2, *cell.shape
    )
    start = np.stack([factor * column[:, None] + across[cell], factor * row[:, None] + down[cell]])
    s, t = 2 * (start + inside) / (factor * size) - 1
    axis = cubemap.axes()[face][:, None]
    way = s[..., None] * axis[:, :, 0] + t[..., None] * axis[:, :, 1] + axis[:, :, 2]
    return (way / np.linalg.norm(way, axis=-1, keepdims=True)).astype(np.float32)
