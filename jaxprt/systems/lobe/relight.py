"""Relighting by lobes. Light, view and BRDF may all change; each change recomputes only its own part.

`prefilter` blurs the light by lobes of about a dozen widths; call it again when the light changes. `view_lobes` finds,
for each vertex and lobe, the texels of the blurred light to read and their visibility; call it again when the view or
the BRDF changes. `combine` reads the light and sums.

Light L and visibility V are correlated over a lobe. The visible part of a lobe is treated as a narrower lobe around
another direction. For a normal distribution of variance k, the mean of the visible part is shifted by k grad E[V] /
E[V] (Stein's lemma); the gradient comes from the bilinear lookup of visibility. Assuming that the occluder is a
straight edge, the shift also determines the variance that remains across the edge. E[L V] is then E[V] times the light
blurred to that width, read at the shifted mean. This is exact for light that is linear over the lobe, and never
negative.
"""

import math
from collections.abc import Sequence
from functools import lru_cache, partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.core import Tracer
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import require
from jaxprt.compile import isolated, jit, kept, total
from jaxprt.decompose import mixture
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import cubemap, directions
from jaxprt.systems import protocol
from jaxprt.systems.lobe import diffuse
from jaxprt.systems.lobe.pyramid import LobeTransport, Scales, between, corners
from jaxprt.systems.lobe.table import LobeBrdf, Lobes

_FIRST = 0.8  # width of the finest blur, in texels of the environment
_RATIO = 1.5  # ratio of successive widths
_WIDEST = 1.3  # upper limit of widths, in radians
_COARSE = 0.75  # largest edge of a texel, relative to the width
REACH = 3.0  # radius of the blur kernel, in widths
_BLOCK = 6 * 8**2  # directions that are projected at once
_TILE = 4  # edge of the tiles in which blurred faces are computed, in texels
_LEAST = 1e-3  # smallest visibility by which the shift of a lobe is divided
_FARTHEST = 2.5  # largest shift of the mean of the visible part, in standard deviations
_TINY = 1e-12


class LobeLight(eqx.Module):
    """A light blurred by von Mises-Fisher lobes of about a dozen widths. Wider blurs are stored at lower resolution.

    Attributes:
        pyramid: Texels of all widths, one after another, in units of radiance; each face has a border of its neighbors'
            texels.
        coefficient: Coefficients of the unblurred light, for the diffuse part; see `jaxprt.systems.lobe.diffuse`.
        size: Edge of the environment's cubemap faces in texels.
        irradiance: Irradiance / pi of the vertices; None before `LobeSystem.shade`.
        flux: Vector irradiance / pi of the vertices, for normals that normal maps tilt; None before
            `LobeSystem.tilted`.
    """

    pyramid: Float[Array, "c t"]
    coefficient: Float[Array, "h c"]
    size: int = eqx.field(static=True)
    irradiance: Float[Array, "c v"] | None = None
    flux: Float[Array, "c 3 v"] | None = None


class LobeView(eqx.Module):
    """A view: the texels of the blurred light that each vertex reads, and their weights.

    Attributes:
        place: Indices of texels of the blurred light, eight arrays with one texel for each lobe l.
        visible: Weights of these texels: interpolation weight times visibility.
        weight: Weight of each lobe, gray or per color.
        diffuse: Albedo of the diffuse part, gray or per color.
        vector: Transfer vectors of the vertices, for the diffuse part; no rows if the light holds the irradiance.
        points: Points that the view belongs to; None for the vertices.
        size: Edge of the environment's cubemap faces in texels.
    """

    place: tuple[Int[Array, "l v"], ...]
    visible: tuple[Float[Array, "l v"], ...]
    weight: Float[Array, "c l v"]
    diffuse: Float[Array, "c v"]
    vector: UInt8[Array, "h _"] | Float[Array, "h _"]
    points: Points | None
    size: int = eqx.field(static=True)


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, LobeBrdf, source="jaxprt.lobe.tabulate")


@require.arguments(brdf=_brdf, light=protocol.one_light)
def radiance(
    transport: LobeTransport, brdf: LobeBrdf, light: Environment, *, eye: Float[Array, "3"]
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    Shadows of a small sun are lost where lobes are wider than the occluders. To keep them, take the brightest texels
    out of the light with `jaxprt.bright_texels.split`, and add `jaxprt.bright_texels.radiance` for them.

    Args:
        transport: Visibility pyramids, from `precompute`.
        brdf: Table of lobes without parameters, from `tabulate`; `jaxprt.lobe.LobeBrdf.at` sets parameters.
        light: The environment. Its cubemap must have the size of the transport's.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance per vertex, in units of the light's radiance. Next to bright texels, hat functions can make the
        diffuse part slightly negative. Differentiable in the light, the eye and the table.

    Raises:
        TypeError: The BRDF is not a `LobeBrdf`, or the light is not an `Environment`.
        ValueError: The light has another size than the transport, the table has parameters, or the light or the eye is
            not finite. Values cannot be checked inside `jax.jit`, where NaN reaches the vertices that read it.

    Reference: Sun et al. 2007, section 4.1, with free lobes and the second term.
    """
    return combine(prefilter(light), view_lobes(transport, brdf, eye=eye))


@require.arguments(light=protocol.one_light)
def prefilter(light: Environment) -> LobeLight:
    """Blurs a light by lobes of all widths. The result is linear in the light.

    Args:
        light: One environment.

    Raises:
        ValueError: The light is a batch, its faces have an edge of less than 8 texels, or it is not finite.
    """
    if light.radiance.shape[1] < 8:
        raise ValueError(
            f"the light must be one environment [6, n, n, c] with n of at least 8, got {list(light.radiance.shape)}"
        )
    pyramid = _prefilter(light, _blurs(light.radiance))
    return LobeLight(pyramid, diffuse.coefficients(light.radiance), light.radiance.shape[1])


@require.arguments(brdf=_brdf)
def view_lobes(
    transport: LobeTransport,
    brdf: LobeBrdf,
    *parameter: Float[Array, " v"],
    eye: Float[Array, "*p 3"],
    points: Points | None = None,
    variance: Float[Array, " v"] | None = None,
) -> LobeView:
    """Finds the texels of the blurred light that each vertex or point reads for a view, and their visibility.

    Args:
        transport: Visibility pyramids, from `precompute`.
        brdf: Table of lobes, from `tabulate`.
        parameter: Values of each BRDF parameter at the vertices or points, if the table has parameters.
        eye: Position of the viewer in world units: one, or one for each vertex or point.
        points: Points at which radiance is evaluated; None for the vertices.
        variance: Variance in squared radians, along one axis, by which the lobes of each vertex or point are widened;
            None for zero.

    Raises:
        TypeError: The BRDF is not a `LobeBrdf`.
        ValueError: The number of parameters differs from the table's, or the eye is not finite, or is neither one
            position nor one for each vertex or point.
    """
    eye = require.position("the eye", eye, each=len(transport.position if points is None else points))
    return _view_lobes(transport, brdf, parameter, eye, points, variance)


@jit
def _view_lobes(
    transport: LobeTransport,
    brdf: LobeBrdf,
    parameter: tuple[Array, ...],
    eye: Array,
    points: Points | None,
    variance: Array | None,
) -> LobeView:
    placing = *placed(transport.position, transport.frame, points), brdf, eye, variance
    lobe, (face, s, t, spread) = _places(*placing, *parameter)
    seen = transport.lobe_visibility(face, s, t, spread, points)
    place, visible = _taps(face, s, t, spread, lobe.concentration, seen, size=transport.size)
    return LobeView(place, visible, lobe.weight, lobe.diffuse, transport.vector, points, transport.size)


@isolated
def _places(
    position: Array, frame: Array, brdf: LobeBrdf, eye: Array, variance: Array | None, *parameter: Array
) -> tuple[Lobes, tuple[Array, ...]]:
    """Lobes of each vertex; and cubemap face, coordinates s and t on it, and spread of each lobe."""
    lobe = brdf.lookup(directions.view(frame, position, eye), *parameter)
    lobe = lobe if variance is None else lobe.widened(variance)
    world = [sum(lobe.mean[j] * frame[:, j, i] for j in range(3)) for i in range(3)]
    return lobe, (*cubemap.project(*world), mixture.drop(lobe.concentration))


@partial(isolated, static=("size",))
def _taps(face, s, t, spread, concentration, visible, *, size: int) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Texels of the blurred light that each lobe reads, and their weights."""
    seen, face, s, t, spread = _seen_part(visible, face, s, t, spread, concentration)
    scale = scales(size)
    number, upper = between(scale, spread)
    place, result = [], []
    for step, part in ((0, 1 - upper), (1, upper)):
        edge, start = (jnp.asarray(x)[number + step] for x in (scale.edge, scale.start))
        row, column, weights = corners(edge, s, t)
        for (down, right), (value, _, _) in weights:
            place.append(start + (face * (edge + 2) + row + down) * (edge + 2) + column + right)
            result.append(seen * value * part)
    return tuple(place), tuple(result)


def _seen_part(visible, face, s, t, spread, concentration) -> tuple[Array, Array, Array, Array, Array]:
    """Visibility of each lobe; and face, coordinates and spread of its visible part."""
    seen, by_s, by_t = visible
    # Derivatives on the face become a gradient on the sphere, times the variance of the lobe, 1 / (k (1 - spread)).
    variance = (1 + s**2 + t**2) / (concentration * (1 - spread))
    along_s = variance * (by_s * (1 + s**2) + by_t * s * t)
    along_t = variance * (by_t * (1 + t**2) + by_s * s * t)
    part = jnp.maximum(seen, _LEAST)
    # Shift in standard deviations of the lobe, limited where almost nothing is visible.
    shift = jnp.sqrt((along_s * by_s + along_t * by_t) / part**2 + _TINY)
    reach = 1 / (part * jnp.maximum(shift / _FARTHEST, 1))
    shift = jnp.minimum(shift, _FARTHEST)
    # Variance across an edge at a: 1 - m (m + a) with mean m = phi(a) / Phi(a), here as a fit over m.
    across = 1 / (1 + shift * (2 + 0.42 * shift))
    # In the tangent plane of the lobe's direction: on the plane of the face, long steps would depend on the face.
    by_s, by_t = along_s * reach, along_t * reach
    inward = (s * by_s + t * by_t) / (1 + s**2 + t**2)
    own, moved = cubemap.unproject(face, s, t), cubemap.unproject(face, s + by_s, t + by_t)
    face, s, t = cubemap.project(*(x - inward * y for x, y in zip(moved, own, strict=True)))
    return seen, face, s, t, spread * (1 + across) / 2


@isolated
def combine(light: LobeLight, view: LobeView) -> Float[Array, "v e"]:
    """Radiance of a view under a light.

    Args:
        light: The result of `prefilter`.
        view: The result of `view_lobes`.

    Returns:
        Linear radiance of each vertex or point, in units of the light's radiance.

    Raises:
        ValueError: The light has another size than the transport of the view.
    """
    if light.size != view.size:
        raise ValueError(
            f"the light's faces must have as many texels along an edge as the transport's, {view.size}, "
            f"got {light.size}"
        )
    protocol.check_colors(len(light.pyramid), view.weight.shape[0])
    irradiance = light.irradiance
    if irradiance is None:
        irradiance = diffuse.irradiance(light.coefficient, view.vector)
    irradiance = diffuse.at_points(irradiance, light.flux, view.points)
    # Colors are contiguous, so that one read gets all. Lobes are summed one by one, so that sums stay in the cache.
    rows = light.pyramid.T

    def lit(lobe):
        place, visible, weight = lobe
        taps = zip(place, visible, strict=True)
        read = reduce(jnp.add, (rows.at[texel].get(mode="promise_in_bounds") * part[:, None] for texel, part in taps))
        return read * weight.T

    glossy = total(lit, (view.place, view.visible, jnp.swapaxes(view.weight, 0, 1)))
    return glossy + (irradiance * view.diffuse).T


@lru_cache(maxsize=8)
def scales(size: int) -> Scales:
    """Scales of the blurred light: the environment itself, whose faces have edge `size`, and then every width."""
    texel = np.sqrt(4 * np.pi / 6) / size
    width = [texel / 2]
    while len(width) < 2 or width[-1] * _RATIO < _WIDEST:
        width.append(_FIRST * texel * _RATIO ** (len(width) - 1))
    edge = [size] + [_edge(each, size, least=4) for each in width[1:]]
    edge = np.array(edge, np.int32)
    count = 6 * (edge + 2) ** 2
    # The mean cosine is coth k - 1/k. For sharp lobes coth k is 1 to rounding.
    sharpness = np.array(width) ** -2
    spread = 1 - 1 / np.tanh(np.minimum(sharpness, 50)) + 1 / sharpness
    return Scales(edge, spread, (np.cumsum(count) - count).astype(np.int32), int(count.sum()))


@kept
def _prefilter(light: Environment, blurs: list[tuple[Array, Array]]) -> Float[Array, "c t"]:
    """The light, blurred by lobes of all widths."""
    _, size, _, colors = light.radiance.shape
    scale = scales(size)
    mips = {size: light.radiance}
    edge = size
    while edge > 4:
        edge //= 2
        area = cubemap.solid_angle(size=2 * edge)[..., None]
        value, whole = (x.reshape(6, edge, 2, edge, 2, -1).sum((2, 4)) for x in (mips[2 * edge] * area, area))
        mips[edge] = value / whole
    levels = []
    for number, edge in enumerate(scale.edge.tolist()):
        value = light.radiance
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
    own = max(spread - texel[0] ** 2 / 6 - texel[1] ** 2 / 12, 0.2 * texel[1] ** 2)
    return source, own, float(mixture.concentration_of(jnp.asarray(own)))


def _edge(width: float, size: int, *, least: int) -> int:
    """Edge of the coarsest faces whose texels are fine enough for a width."""
    edge = size
    while edge > least and np.sqrt(4 * np.pi / 6) / (edge // 2) <= _COARSE * width:
        edge //= 2
    return edge


def _blurs(radiance: Float[Array | np.ndarray, "6 n n c"]) -> Sequence[tuple[Array | np.ndarray, Array | np.ndarray]]:
    """For each width, source texels [tile, m, face] of each tile of the blurred faces, and their weights [tile, o, m].

    Each tile of blurred texels o is one small dense product with its m source texels. Weights are the same on all
    faces. They are cached on the light's device; inside a compiled program they are constants.
    """
    with jax.ensure_compile_time_eval():  # Traced arrays could not be cached.
        size, dtype = radiance.shape[1], str(radiance.dtype)
        if isinstance(radiance, np.ndarray | Tracer):
            return _made_blurs(size, dtype)
        return _placed_blurs(size, dtype, min(radiance.devices(), key=lambda each: each.id))


@lru_cache(maxsize=4)
def _placed_blurs(size: int, dtype: str, device: Any) -> list[tuple[Array, Array]]:
    """Weights placed on a device but not committed to it, so that lights sharded over several devices can use them."""
    with jax.default_device(device):
        return jax.device_put(_made_blurs(size, dtype))


@lru_cache(maxsize=4)
def _made_blurs(size: int, dtype: str) -> list[tuple[np.ndarray, np.ndarray]]:
    scale = scales(size)
    result = []
    for edge, spread in zip(scale.edge.tolist()[1:], scale.spread.tolist()[1:], strict=True):
        source, own, concentration = blur(edge, spread, size=size)
        center = np.asarray(cubemap.direction(size=source), np.float64).reshape(-1, 3)
        area = np.asarray(cubemap.solid_angle(size=source), np.float64).reshape(-1)
        tile = min(_TILE, edge)
        place = np.asarray(cubemap.direction(size=edge), np.float64)[0]
        place = place.reshape(edge // tile, tile, edge // tile, tile, 3).swapaxes(1, 2).reshape(-1, tile * tile, 3)
        reach = 2 * np.sin(min(np.pi, REACH * np.sqrt(own)) / 2)
        near = [np.unique(np.concatenate(each)) for each in scipy.spatial.KDTree(center).query_ball_point(place, reach)]
        index = np.zeros((len(place), max(map(len, near))), np.int32)
        known = np.zeros(index.shape)
        for row, each in enumerate(near):
            index[row, : len(each)], known[row, : len(each)] = each, area[each]
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
    blocks = [cubemap.project(*np.moveaxis(each, -1, 0)) for each in padded.reshape(-1, _BLOCK, 6, 3)]
    face, s, t = (np.concatenate([np.asarray(each) for each in rows])[:count] for rows in zip(*blocks, strict=True))
    column, row = (np.clip((np.asarray(x) + 1) / 2 * size, 0, size - 1).astype(np.int32) for x in (s, t))
    return np.asarray(face, np.int32) * size * size + row * size + column
