"""A few directions that stand for distant light, denser where it is brighter."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap, harmonics

_LEVELS = 12  # of the curve inside of a texel


class LightSamples(NamedTuple):
    """Directions, and what light from there counts.

    The sum over directions of weight times visibility times cosine is the radiance of a white diffuse surface.

    Attributes:
        direction: Unit directions in the world.
        weight: Radiance times solid angle over pi, for each light and color; 0 in the directions of other lights.
    """

    direction: Float32[np.ndarray, "d 3"]
    weight: Float32[np.ndarray, "d l c"]


def importance(environments: Sequence[Environment], *, count: int) -> LightSamples:
    """Samples lights in proportion to the power of their texels, the same number of directions for each.

    Directions lie at equal steps of the power along a space-filling curve through all texels, which goes on inside of
    each texel: those of a sun, which get many, have them spread over their area.

    Args:
        environments: One or more lights, each with any size and number of colors.
        count: Directions for each.

    Returns:
        The samples. Where a light has fewer colors than another, its weights of the others are 0.

    Raises:
        TypeError: There is no list of lights.
        ValueError: There are no lights, one is a batch, or the count is below 1.
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
    each = [_sampled(np.asarray(light.radiance, np.float64), count) for light in environments]
    weight = np.zeros((len(each), count, len(each), colors), np.float32)
    for number, (_, own) in enumerate(each):
        weight[number, :, number, : own.shape[-1]] = own
    direction = np.concatenate([direction for direction, _ in each]).astype(np.float32)
    return LightSamples(direction, weight.reshape(-1, *weight.shape[2:]))


def natural(*, size: int, degree: int) -> LightSamples:
    """Light of natural spectrum from unknown directions, in the middle of each texel of a cubemap.

    There is one light, whose colors are spherical harmonics. The sum of the squares of what a surface makes of them
    is the mean, over all such lights, of the square of its radiance.

    Args:
        size: Texels along the edge of a face.
        degree: The highest degree of the harmonics.

    Raises:
        ValueError: The size is below 1, or the degree is negative.
    """
    direction = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1, 1)
    value = np.asarray(harmonics.evaluate(direction, degree=degree), np.float64)
    band = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    weight = value * np.asarray(harmonics.natural(degree=degree), np.float64)[band] * area / np.pi
    return LightSamples(direction.astype(np.float32), weight[:, None].astype(np.float32))


def _sampled(radiance: np.ndarray, count: int) -> tuple[Float[np.ndarray, "d 3"], Float[np.ndarray, "d c"]]:
    """Directions to one light, and their weights."""
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
    # Points are even on the texel; the solid angle around each is not.
    solid = (2 / size) ** 2 / length**3
    weight = texel[at] * solid * (total[-1] / count / power[at] / np.pi)[:, None]
    return point / length, weight


def _curve(size: int) -> Int[np.ndarray, " d"]:
    """Numbers of the texels in the order of Lebesgue's curve on each face: neighbors come close to each other."""
    row, column = np.divmod(np.arange(size**2), size)
    bits = range(size.bit_length())
    code = sum(((row >> bit & 1) << 2 * bit + 1) | ((column >> bit & 1) << 2 * bit) for bit in bits)
    order = np.argsort(code, kind="stable")
    return (np.arange(6)[:, None] * size**2 + order).ravel()


def _on_curve(fraction: Float[np.ndarray, " d"]) -> Float[np.ndarray, "2 d"]:
    """Column and row in a texel, from 0 to 1, where so much of the curve's continuation inside of it is passed."""
    place = np.full((2, len(fraction)), 0.5**_LEVELS / 2)
    for level in range(1, _LEVELS + 1):
        quarter = np.clip(np.floor(4 * fraction), 0, 3)
        fraction = 4 * fraction - quarter
        place += np.stack([quarter % 2, quarter // 2]) / 2**level
    return place
