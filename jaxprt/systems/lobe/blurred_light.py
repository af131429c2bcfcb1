"""The light blurred by lobes of about a dozen widths, for lobes of any width to read. Wider blurs have fewer texels."""

import dataclasses
import math
from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import jit, kept, known, linear
from jaxprt.decompose import mixture
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap
from jaxprt.systems import protocol
from jaxprt.systems.lobe import diffuse
from jaxprt.systems.lobe.pyramid import Scales

_FIRST = 0.8  # width of the finest blur, in texels of the environment
_RATIO = 1.5  # ratio of successive widths
_WIDEST = 1.3  # upper limit of widths, in radians
_COARSE = 0.75  # largest edge of a texel, relative to the width
REACH = 3.0  # radius of the blur kernel, in widths
_BLOCK = 6 * 8**2  # directions that are projected at once
FINER = 4  # times as many texels along an edge as the environment, for very narrow lobes
_TILE = 4  # edge of the tiles in which blurred faces are computed, in texels


class LobeLight(eqx.Module):
    """A light blurred by von Mises-Fisher lobes of about a dozen widths. Wider blurs are stored at lower resolution.

    Attributes:
        pyramid: Texels of all widths, one after another, in units of radiance; each face has a border of its neighbors'
            texels. Those of wide lobes follow if these read a light of their own, and then those of `sharpened`.
        coefficient: Coefficients of the unblurred light, for the diffuse part; see `jaxprt.systems.lobe.diffuse`.
        size: Edge of the environment's cubemap faces in texels.
        irradiance: Irradiance / pi of the vertices; None before `LobeSystem.shade`.
        flux: Vector irradiance / pi of the vertices, for normals that normal maps tilt; None before
            `LobeSystem.tilted`.
        finer: Whether there are texels that are finer than those of the environment; see `sharpened`.
    """

    pyramid: Float[Array, "c t"]
    coefficient: Float[Array, "h c"]
    size: int = eqx.field(static=True)
    irradiance: Float[Array, "c v"] | None = None
    flux: Float[Array, "c 3 v"] | None = None
    finer: bool = eqx.field(static=True, default=False)


@require.arguments(light=protocol.one_light)
def prefilter(light: Environment) -> LobeLight:
    """Blurs a light by lobes of all widths. The result is linear in the light.

    Args:
        light: One environment.
    """
    if light.radiance.shape[1] < 8:
        raise ValueError(
            f"the light must be one environment [6, n, n, c] with n of at least 8, got {list(light.radiance.shape)}"
        )
    blurs = _blurs(light.radiance)
    # Batches are blurred in turn: all at once, what they read would leave the processor's cache.
    pyramid = (
        _prefilter(blurs, light.radiance)
        if known(light)
        else linear(_blurred, None, blurs, light.radiance, in_turn=True)
    )
    return LobeLight(pyramid, diffuse.coefficients(light.radiance), light.radiance.shape[1])


@jit
def sharpened(light: LobeLight, texels: Float[Array | np.ndarray, "6 m m c"] | None) -> LobeLight:
    """The light with scales that are finer than its texels, for very narrow lobes.

    What was taken out of a texel of the light is missing in its finer ones in the same share.

    Args:
        light: The blurred light of an environment, or of what is left of it.
        texels: The environment in `FINER` times as many texels along an edge; None interpolates those of the light.
    """
    size, colors = light.size, len(light.pyramid)
    rest = light.pyramid[:, : 6 * (size + 2) ** 2].T.reshape(6, size + 2, size + 2, colors)[:, 1:-1, 1:-1]
    edge = FINER * size
    if texels is None:
        value = cubemap.lookup(rest, cubemap.direction(size=edge).astype(rest.dtype))
    else:
        mean = cubemap.reduced(texels, size=size)
        share = jnp.where(mean != 0, rest / jnp.where(mean != 0, mean, 1), 0)
        value = jnp.asarray(texels) * jnp.repeat(jnp.repeat(share, FINER, 1), FINER, 2)
    levels = [light.pyramid]
    while edge > size:
        levels.append(cubemap.pad(value).reshape(-1, colors).T)
        edge //= 2
        value = cubemap.reduced(value, size=edge)
    return dataclasses.replace(light, pyramid=jnp.concatenate(levels, 1), finer=True)


@lru_cache(maxsize=8)
def finer_scales(size: int, *, before: int) -> Scales:
    """Scales of `sharpened` light, the finest first. `before` is the number of texels of the light before that."""
    scale = scales(size)
    edge = np.array([FINER * size >> step for step in range(FINER.bit_length() - 1)], np.int32)
    texels = 6 * (edge + 2) ** 2
    start = before + np.cumsum(texels) - texels
    spread = np.concatenate([_spread(np.sqrt(4 * np.pi / 6) / edge / 2), scale.spread])
    edge, start = np.concatenate([edge, scale.edge]), np.concatenate([start.astype(np.int32), scale.start])
    return Scales(edge, spread, start, before + int(texels.sum()))


@lru_cache(maxsize=8)
def scales(size: int) -> Scales:
    """Scales of the blurred light: the environment itself, whose faces have edge `size`, and then every width."""
    texel = np.sqrt(4 * np.pi / 6) / size
    width = [texel / 2]
    while len(width) < 2 or width[-1] * _RATIO < _WIDEST:
        width.append(_FIRST * texel * _RATIO ** (len(width) - 1))
    edge = [size] + [_edge(w, size, least=4) for w in width[1:]]
    edge = np.array(edge, np.int32)
    count = 6 * (edge + 2) ** 2
    return Scales(edge, _spread(np.array(width)), (np.cumsum(count) - count).astype(np.int32), int(count.sum()))


def _spread(width: np.ndarray) -> np.ndarray:
    """Mean of 1 - cos over lobes of some widths. The mean cosine is coth k - 1/k, where coth k is 1 to rounding."""
    sharpness = width**-2
    return 1 - 1 / np.tanh(np.minimum(sharpness, 50)) + 1 / sharpness


@partial(kept, quick=True)
def _prefilter(blurs: Sequence[tuple[Any, Any]], radiance: Float[Array, "6 n n c"]) -> Float[Array, "c t"]:
    """The light, blurred by lobes of all widths."""
    return _blurred(blurs, radiance)


def _blurred(blurs: Sequence[tuple[Any, Any]], radiance: Float[Array, "6 n n c"]) -> Float[Array, "c t"]:
    _, size, _, colors = radiance.shape
    scale = scales(size)
    mips = {size: radiance}
    edge = size
    while edge > 4:
        edge //= 2
        area = cubemap.solid_angle(size=2 * edge)[..., None]
        value, whole = (x.reshape(6, edge, 2, edge, 2, -1).sum((2, 4)) for x in (mips[2 * edge] * area, area))
        mips[edge] = value / whole
    levels = []
    for number, edge in enumerate(scale.edge.tolist()):
        value = radiance
        if number:
            index, weight = blurs[number - 1]
            source = mips[_edge(np.sqrt(scale.spread[number]), size, least=8)].reshape(-1, colors)
            value = weight @ source[index].reshape(*index.shape[:2], 6 * colors)
            tile = math.isqrt(weight.shape[1])
            value = value.reshape(edge // tile, edge // tile, tile, tile, 6, colors).transpose(4, 0, 2, 1, 3, 5)
        levels.append(cubemap.pad(value.reshape(6, edge, edge, colors)).reshape(-1, colors).T)
    return jnp.concatenate(levels, 1)


def blur(edge: int, spread: float, *, size: int) -> tuple[int, float, float]:
    """Resolution from which a blurred scale is computed, and the lobe that blurs it.

    Args:
        edge: Edge of the blurred faces in texels.
        spread: Spread of the scale (mean of 1 - cos), from `scales`.
        size: Edge of the light's faces in texels.

    Returns:
        Edge of the source faces in texels; spread and concentration of the blurring lobe.
    """
    source = _edge(np.sqrt(spread), size, least=8)
    # Source texels (boxes) and bilinear lookup (tents) blur too; their variance is subtracted.
    texel = np.sqrt(4 * np.pi / 6) / np.array([edge, source])
    variance = max(spread - texel[0] ** 2 / 6 - texel[1] ** 2 / 12, 0.2 * texel[1] ** 2)
    return source, variance, float(mixture.concentration_of(jnp.asarray(variance)))


def _edge(width: float, size: int, *, least: int) -> int:
    """Edge of the coarsest faces whose texels are fine enough for a width."""
    edge = size
    while edge > least and np.sqrt(4 * np.pi / 6) / (edge // 2) <= _COARSE * width:
        edge //= 2
    return edge


def _blurs(radiance: Float[Array | np.ndarray, "6 n n c"]) -> Sequence[tuple[Array | np.ndarray, Array | np.ndarray]]:
    """For each width, source texels [tile, m, face] of tiles of the blurred faces, and their weights [tile, o, m]."""
    with jax.ensure_compile_time_eval():  # Traced arrays could not be cached.
        # Each tile of blurred texels o is one small dense product with m source texels. All faces have equal weights.
        size, dtype = radiance.shape[1], str(radiance.dtype)
        if isinstance(radiance, np.ndarray | Tracer):
            return _host_blurs(size, dtype)  # inside a compiled program they are constants
        return _device_blurs(size, dtype, min(radiance.devices(), key=lambda device: device.id))


@lru_cache(maxsize=4)
def _device_blurs(size: int, dtype: str, device: Any) -> list[tuple[Array, Array]]:
    """Weights placed on a device but not committed to it, so that lights sharded over several devices can use them."""
    with jax.default_device(device):
        return jax.device_put(_host_blurs(size, dtype))


@lru_cache(maxsize=4)
def _host_blurs(size: int, dtype: str) -> list[tuple[np.ndarray, np.ndarray]]:
    scale = scales(size)
    result = []
    for edge, spread in zip(scale.edge.tolist()[1:], scale.spread.tolist()[1:], strict=True):
        source, variance, concentration = blur(edge, spread, size=size)
        center = np.asarray(cubemap.direction(size=source), np.float64).reshape(-1, 3)
        area = np.asarray(cubemap.solid_angle(size=source), np.float64).reshape(-1)
        tile = min(_TILE, edge)
        place = np.asarray(cubemap.direction(size=edge), np.float64)[0]
        place = place.reshape(edge // tile, tile, edge // tile, tile, 3).swapaxes(1, 2).reshape(-1, tile * tile, 3)
        reach = 2 * np.sin(min(np.pi, REACH * np.sqrt(variance)) / 2)
        near = [
            np.unique(np.concatenate(texels)) for texels in scipy.spatial.KDTree(center).query_ball_point(place, reach)
        ]
        index = np.zeros((len(place), max(map(len, near))), np.int32)
        known = np.zeros(index.shape)
        for row, texels in enumerate(near):
            index[row, : len(texels)], known[row, : len(texels)] = texels, area[texels]
        away = 1 - np.einsum("toi,tmi->tom", place, center[index])
        weight = known[:, None] * np.exp(-concentration * away)
        weight /= weight.sum(-1, keepdims=True)
        result.append((_on_faces(source)[index], np.asarray(weight, dtype)))
    return result


@lru_cache(maxsize=8)
def _on_faces(size: int) -> Int[np.ndarray, "t 6"]:
    """For each texel, the six texels at the same place relative to each of the six faces as it has to the first."""
    place = np.asarray(cubemap.point(size=2), np.float64)
    axes = np.stack([place[:, 0, 1] - place[:, 0, 0], place[:, 1, 0] - place[:, 0, 0], place.mean((1, 2))], 1)
    turn = np.einsum("ji,fjk->fik", axes[0], axes)
    moved = np.swapaxes(np.asarray(cubemap.direction(size=size)).reshape(-1, 3) @ turn, 0, 1)
    count = len(moved)
    padded = np.pad(moved, ((0, -(-count // _BLOCK) * _BLOCK - count), (0, 0), (0, 0)), mode="edge")
    blocks = [cubemap.project(*np.moveaxis(block, -1, 0)) for block in padded.reshape(-1, _BLOCK, 6, 3)]
    face, s, t = (np.concatenate([np.asarray(part) for part in rows])[:count] for rows in zip(*blocks, strict=True))
    column, row = (np.clip((np.asarray(x) + 1) / 2 * size, 0, size - 1).astype(np.int32) for x in (s, t))
    return np.asarray(face, np.int32) * size * size + row * size + column
