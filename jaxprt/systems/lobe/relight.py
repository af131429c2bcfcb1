"""Relighting by lobes: light, view and BRDF are all free, and each change redoes only its part.

`prefilter` blurs the light to a scale of widths, once per change of light. `view_lobes` turns a view and a table of
lobes into places in the blurred light and what is seen there, once per change of view or BRDF. `combine` reads the
light.

Light and visibility vary together over a lobe: what is seen of it is a narrower lobe beside its middle. For a normal
distribution of variance k about a direction the mean of what is seen lies off by k grad E[V] / E[V] (Stein's lemma),
and the slope comes with the bilinear lookups. Where a straight edge cuts the lobe, that shift tells the variance that
is left across the edge too. So E[L V] is E[V] times the light blurred about the mean of what is seen, to that width:
exact for light that is linear over the lobe, and never negative.
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
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import isolated, jit, total
from jaxprt.decompose import mixture
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import cubemap, directions, harmonics
from jaxprt.systems.lobe.pyramid import DEGREE, LobeTransport, Scales, between, corners
from jaxprt.systems.lobe.table import LobeBrdf, Lobes

_FIRST = 0.8  # width of the finest blur in texels of the environment
_RATIO = 1.5  # from one width to the next
_WIDEST = 1.3  # radians
_COARSE = 0.75  # largest texel in widths
REACH = 3.0  # widths that a blur sums over
_TILE = 4  # edge of what is blurred at once, in texels
_LEAST = 1e-3  # part of a lobe that counts as seen
_FARTHEST = 2.5  # standard deviations by which the middle of what is seen may be off
_TINY = 1e-12


class LobeLight(eqx.Module):
    """A light, blurred by von Mises-Fisher lobes of a dozen widths, each with as many texels as it needs.

    Attributes:
        pyramid: Radiance of all widths, each face with a rim of its neighbors' texels.
        coefficient: SH coefficients of the light itself, for the diffuse part.
        size: Edge of the environment's faces in texels.
    """

    pyramid: Float[Array, "c t"]
    coefficient: Float[Array, "lm c"]
    size: int = eqx.field(static=True)


class LobeView(eqx.Module):
    """A view: where each vertex reads the light.

    Attributes:
        place: Texels of the blurred light, eight for each lobe.
        visible: Weight of each texel, visibility included; may be negative.
        weight: Of each lobe, gray or per color.
        diffuse: Albedo of the diffuse part.
        vector: Its transfer vectors, of the vertices.
        points: Whose view it is; None for the vertices.
        size: Edge of the environment's faces in texels.
    """

    place: tuple[Int[Array, "l v"], ...]
    visible: tuple[Float[Array, "l v"], ...]
    weight: Float[Array, "c l v"]
    diffuse: Float[Array, "c v"]
    vector: Float[Array, "lm _"]
    points: Points | None
    size: int = eqx.field(static=True)


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, LobeBrdf, source="jaxprt.lobe.tabulate")


def _environment(value: Any) -> None:
    require.kind("the light", value, Environment, source="jaxprt.scene.load_environment")


@require.arguments(brdf=_brdf, light=_environment)
def radiance(
    transport: LobeTransport, brdf: LobeBrdf, light: Environment, *, eye: Float[Array, "3"]
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    A small sun shines past occluders that are finer than the lobes: take the brightest texels out by
    `jaxprt.bright_texels.split` and add `jaxprt.bright_texels.radiance` of the same transport.

    Args:
        transport: Visibility pyramids.
        brdf: A table of lobes, without parameters: see `jaxprt.lobe.LobeBrdf.at`.
        light: The environment.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance per vertex, in the light's units; slightly negative values occur at shadow boundaries.
        Differentiable in the light, the eye and the table.

    Raises:
        TypeError: The BRDF is no table of lobes, or the light no Environment.
        ValueError: The light has another size than the transport, the table has parameters, or the light or the eye is
            not finite. Inside `jax.jit` values are not known: NaN then reaches the vertices that read it.

    Reference: Sun et al. 2007, section 4.1, with free lobes and the second term.
    """
    return combine(prefilter(light), view_lobes(transport, brdf, eye=eye))


@require.arguments(light=_environment)
def prefilter(light: Environment) -> LobeLight:
    """Blurs a light to all widths; linear in it.

    Args:
        light: One environment.

    Raises:
        ValueError: A batch of lights, faces of less than 8 texels, or a light that is not finite.
    """
    require.finite("the light", light.radiance)
    if light.radiance.ndim != 4 or light.radiance.shape[1] < 8:
        raise ValueError(
            f"the light must be one environment [6, n, n, c] with n of at least 8, got {list(light.radiance.shape)}"
        )
    return _prefilter(light, _blurs(light.radiance))


@require.arguments(brdf=_brdf)
def view_lobes(
    transport: LobeTransport,
    brdf: LobeBrdf,
    *parameter: Float[Array, " v"],
    eye: Float[Array, "*p 3"],
    points: Points | None = None,
) -> LobeView:
    """Where each vertex, or point, reads the light for a view, and what it sees there.

    Args:
        transport: Visibility pyramids.
        brdf: A table of lobes.
        parameter: Those of each vertex or point, for a table over some.
        eye: Position of the viewer in world units, or one for each vertex or point.
        points: Where; None for the vertices.

    Raises:
        TypeError: The BRDF is no table of lobes.
        ValueError: The number of parameters is not that of the table, or the eye is not one finite position, nor
            one for each.
    """
    require.position("the eye", eye, each=len(transport.position if points is None else points))
    return _view_lobes(transport, brdf, parameter, eye, points)


@jit
def _view_lobes(
    transport: LobeTransport, brdf: LobeBrdf, parameter: tuple[Array, ...], eye: Array, points: Points | None
) -> LobeView:
    lobe, (face, s, t, spread) = _places(*placed(transport.position, transport.frame, points), brdf, eye, *parameter)
    seen = transport.lobe_visibility(face, s, t, spread, points)
    place, visible = _taps(face, s, t, spread, lobe.concentration, seen, size=transport.size)
    return LobeView(place, visible, lobe.weight, lobe.diffuse, transport.vector, points, transport.size)


@isolated
def _places(
    position: Array, frame: Array, brdf: LobeBrdf, eye: Array, *parameter: Array
) -> tuple[Lobes, tuple[Array, ...]]:
    """Lobes of each vertex, and face, place on it and spread of each."""
    lobe = brdf.lookup(directions.view(frame, position, eye), *parameter)
    world = [sum(lobe.mean[j] * frame[:, j, i] for j in range(3)) for i in range(3)]
    return lobe, (*cubemap.project(*world), mixture.drop(lobe.concentration))


@partial(isolated, static=("size",))
def _taps(face, s, t, spread, concentration, visible, *, size: int) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Texels of the blurred light, and what each counts."""
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
    """How much of each lobe is seen, and face, place and spread of that part."""
    seen, by_s, by_t = visible
    # Slopes on the face as a gradient on the sphere, times the variance of the lobe, 1 / (k (1 - spread)).
    variance = (1 + s**2 + t**2) / (concentration * (1 - spread))
    along_s = variance * (by_s * (1 + s**2) + by_t * s * t)
    along_t = variance * (by_t * (1 + t**2) + by_s * s * t)
    part = jnp.maximum(seen, _LEAST)
    # In standard deviations of the lobe; hardly more where next to nothing is seen.
    shift = jnp.sqrt((along_s * by_s + along_t * by_t) / part**2 + _TINY)
    reach = 1 / (part * jnp.maximum(shift / _FARTHEST, 1))
    shift = jnp.minimum(shift, _FARTHEST)
    # Beyond an edge at a, the variance is 1 - m (m + a) with the mean m = phi(a) / Phi(a); fitted over m.
    across = 1 / (1 + shift * (2 + 0.42 * shift))
    face, s, t = cubemap.project(*cubemap.unproject(face, s + along_s * reach, t + along_t * reach))
    return seen, face, s, t, spread * (1 + across) / 2


@isolated
def combine(light: LobeLight, view: LobeView) -> Float[Array, "v e"]:
    """Radiance of a view under a light.

    Raises:
        ValueError: The light has another size than the transport.
    """
    if light.size != view.size:
        raise ValueError(f"the light's faces must have the transport's {view.size} texels, got {light.size}")
    irradiance = light.coefficient.T @ view.vector
    if view.points is not None:
        irradiance = view.points.carry(irradiance, axis=1)
    # Colors side by side, so that a tap reads them at once; lobes one after another, so that sums stay in the cache.
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
    """Scales of the blurred light: the environment itself, and every width."""
    texel = np.sqrt(4 * np.pi / 6) / size
    width = [texel / 2]
    while len(width) < 2 or width[-1] * _RATIO < _WIDEST:
        width.append(_FIRST * texel * _RATIO ** (len(width) - 1))
    edge = [size] + [_edge(each, size, least=4) for each in width[1:]]
    edge = np.array(edge, np.int32)
    count = 6 * (edge + 2) ** 2
    # coth k - 1/k is as good as 1 - 1/k for the sharp ones, whose hyperbolic cotangent is 1.
    sharpness = np.array(width) ** -2
    spread = 1 - 1 / np.tanh(np.minimum(sharpness, 50)) + 1 / sharpness
    return Scales(edge, spread, (np.cumsum(count) - count).astype(np.int32), int(count.sum()))


@jit
def _prefilter(light: Environment, blurs: list[tuple[Array, Array]]) -> LobeLight:
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
    coefficient = harmonics.project(light.radiance, degree=DEGREE)
    return LobeLight(jnp.concatenate(levels, 1), coefficient, size)


def blur(edge: int, spread: float, *, size: int) -> tuple[int, float, float]:
    """What faces of an edge are blurred from: the edge of the source's faces, and drop and concentration of the lobe.

    Args:
        edge: Of the blurred faces, in texels.
        spread: The drop of the scale, as `scales` has it.
        size: Edge of the light's faces.
    """
    source = _edge(np.sqrt(spread), size, least=8)
    # The source's boxes and the tents of the lookup blur too.
    texel = np.sqrt(4 * np.pi / 6) / np.array([edge, source])
    own = max(spread - texel[0] ** 2 / 6 - texel[1] ** 2 / 12, 0.2 * texel[1] ** 2)
    return source, own, float(mixture.concentration_of(jnp.asarray(own)))


def _edge(width: float, size: int, *, least: int) -> int:
    """Coarsest faces whose texels are fine enough for a width."""
    edge = size
    while edge > least and np.sqrt(4 * np.pi / 6) / (edge // 2) <= _COARSE * width:
        edge //= 2
    return edge


def _blurs(radiance: Float[Array | np.ndarray, "6 n n c"]) -> Sequence[tuple[Array | np.ndarray, Array | np.ndarray]]:
    """For each width the texels [tile, m, face] that make a tile of the blurred faces, and their weights [tile, o, m].

    What is blurred is made in tiles, so that a small dense product makes each, and weights are the same on all faces.
    They are kept on the light's device; in a program they are constants.
    """
    with jax.ensure_compile_time_eval():  # What a trace made could not be kept.
        size, dtype = radiance.shape[1], str(radiance.dtype)
        if isinstance(radiance, np.ndarray | Tracer):
            return _made_blurs(size, dtype)
        return _placed_blurs(size, dtype, min(radiance.devices(), key=lambda each: each.id))


@lru_cache(maxsize=4)
def _placed_blurs(size: int, dtype: str, device: Any) -> list[tuple[Array, Array]]:
    """On a device, but not bound to it: lights that lie on several devices are blurred there."""
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
    """For each texel those that lie to the six faces as it lies to the first."""
    place = np.asarray(cubemap.point(size=2), np.float64)
    axes = np.stack([place[:, 0, 1] - place[:, 0, 0], place[:, 1, 0] - place[:, 0, 0], place.mean((1, 2))], 1)
    turn = np.einsum("ji,fjk->fik", axes[0], axes)
    moved = np.swapaxes(np.asarray(cubemap.direction(size=size)).reshape(-1, 3) @ turn, 0, 1)
    face, s, t = cubemap.project(*np.moveaxis(moved, -1, 0))
    column, row = (np.clip((np.asarray(x) + 1) / 2 * size, 0, size - 1).astype(np.int32) for x in (s, t))
    return np.asarray(face, np.int32) * size * size + row * size + column
