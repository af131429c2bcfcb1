"""BRDFs along light paths: the functions with which the parts of a scene send light to each other.

A part whose BRDF cannot change sends light with that BRDF, factored. The material of other parts may get other colors,
and possibly another roughness. Such a part uses a few functions that are fitted to its whole range of roughness, and a
table of their weights over roughness.
"""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.varying import Channels
from jaxprt.relit.channels import Shading
from jaxprt.systems import bounces, harmonic, separable, standard
from jaxprt.systems.bounces.functions import FunctionWeights
from jaxprt.systems.standard import StandardTable

_TERMS, _RESOLUTION = 24, 32  # number of terms, and edge of the maps, of BRDFs along light paths
_FUNCTIONS = 2  # number of functions that represent lobes of any roughness
_STEP = 1.2  # largest ratio of neighboring roughnesses between which weights are interpolated linearly
_WIDTH = 0.09  # smallest width of lobes along light paths: alpha of GGX, or m of Beckmann's distribution
_SAME = 1e-5  # relative tolerance for equal parameters, which may be means with different rounding
_DARK = 1e-6  # smaller albedo counts as zero
_VIEWS = 16  # number of view angles over which albedo is averaged
_RINGS, _SECTORS = 48, 320  # quadrature of each view: accurate to a few percent for roughness of 0.1 and more


class Path(NamedTuple):
    """The factored BRDF with which a part sends light to others.

    Attributes:
        brdf: The factored BRDF. Its channels are those of the part's BRDF, or fitted functions.
        sent: Weights of the fitted functions over roughness; None if the channels are those of the part's BRDF.
    """

    brdf: separable.SeparableBrdf
    sent: FunctionWeights | None


def factor(shading: Shading) -> Path:
    """The factored BRDF with which a part sends reflected light to other parts.

    Lobes too narrow for the resolution of the maps are widened: otherwise a smooth metal would send many
    times the light that it receives. Each channel is scaled to its true albedo. Widening is acceptable because the
    light that arrives elsewhere is represented by low-order harmonics, which are wider still.

    Parts with the standard tables share one result, for any roughness.
    """
    if shading.table is not None:
        return _standard(shading.table)
    return _factor_family(still(shading), shading.brdf, shading.knot if shading.blend is not None else ())


@functools.cache
def _standard(table: StandardTable) -> Path:
    if table != standard.BLINN_PHONG:
        return Path(*table.paths())
    return _factor_family(table.family, table.family, table.knots)


def _factor_family(alone: Callable, brdf: Callable, knot: tuple[np.ndarray, ...]) -> Path:
    """The factored BRDF of a family over roughness, or of one BRDF; `alone` is it at one roughness."""
    knot = _finer(knot)
    members = [brdf(jnp.asarray(value)) for value in knot[0]] if knot else [alone]
    matte = _matte(members[0])
    if matte is None or matte.all():
        return Path(_factor_channels(alone), None)
    wide = [_lobes(member, ~matte) for member in members]
    # Lobes that are widened to the same width become one member of the set.
    first = [0] + [n for n in range(1, len(wide)) if not _equal(wide[n - 1], wide[n])]
    lobes = [wide[n] for n in first]
    shared, weight = bounces.functions.shared(lobes, functions=_FUNCTIONS, terms=_TERMS, resolution=_RESOLUTION)
    index = np.searchsorted(first, np.arange(len(wide)), side="right") - 1
    factor = np.zeros((len(members), len(matte), shared.view_map.shape[-1]), np.asarray(weight).dtype)
    factor[:, ~matte] = np.asarray(weight)[index]
    factor[:, matte, -1] = 1
    exact = np.stack([channels(member) for member in members])
    factor *= _ratio(exact, factor @ np.asarray(bounces.functions.albedo(shared)))[..., None]
    dtype = shared.view_map.dtype
    return Path(shared, FunctionWeights(tuple(jnp.asarray(row, dtype) for row in knot), jnp.asarray(factor, dtype)))


def typical(shading: Shading, path: Path) -> Float[Array, "p c"] | None:
    """Mean weights, over the part's vertices, of the channels with which it sends light; None without a blend."""
    if shading.blend is None:
        return None
    weight = shading.blend.weight if path.sent is None else path.sent.weights(shading.blend)
    return jax.device_put(np.mean(np.asarray(weight), 0))


def albedo(shading: Shading) -> Float[np.ndarray, "3"]:
    """Mean albedo of a part, over its vertices and over views from above."""
    channel = channels(still(shading))
    color = channel if shading.blend is None else channel @ np.mean(shading.blend.weight, 0)
    return np.clip(np.broadcast_to(color, 3), 0, 1)


def channels(brdf: Callable) -> Float[np.ndarray, " k"]:
    """Mean albedo of each channel of a BRDF, over views from above."""
    cosine = np.sqrt((np.arange(_VIEWS) + 0.5) / _VIEWS)  # Uniform in projected solid angle.
    wo = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1).astype(np.float32)
    sent = harmonic.table.project(brdf, jnp.asarray(wo), degree=0, rings=_RINGS, sectors=_SECTORS)
    return np.asarray(np.sqrt(4 * np.pi) * np.mean(sent[0], -1))


def still(shading: Shading) -> Callable:
    """The BRDF of a part; at the mean roughness if roughness varies."""
    if not shading.knot:
        return shading.brdf
    return shading.brdf(*(jnp.asarray(np.mean(row)) for row in shading.weighted.parameter))


def widened(brdf: Callable) -> Callable:
    """The BRDF with lobes wide enough for the maps of light paths.

    Models, and BRDFs of users, have a method `widened(width)` that returns them with wider lobes. Others stay as they
    are.
    """
    return jax.tree.map(lambda part: part.widened(_WIDTH) if _widens(part) else part, brdf, is_leaf=_widens)


def _widens(part: Any) -> bool:
    return hasattr(part, "widened")


def _factor_channels(brdf: Callable) -> separable.SeparableBrdf:
    """The factored BRDF of a part whose BRDF has its own channels."""
    terms = 1 if getattr(brdf, "matte", False) else _TERMS
    result = separable.factor(widened(brdf), terms=terms, resolution=_RESOLUTION)
    scale = _ratio(channels(brdf), np.atleast_1d(bounces.functions.albedo(result)))
    view_map = result.view_map * jnp.asarray(scale, result.view_map.dtype)
    return eqx.tree_at(lambda brdf: brdf.view_map, result, view_map)


def _ratio(exact: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Factor that gives functions their exact albedo; 1 for dark ones."""
    return np.where(albedo > _DARK, exact / np.maximum(albedo, _DARK), 1)


def _finer(knot: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Knots over the same range, close enough for linear interpolation of the functions' weights."""
    if not knot:
        return ()
    low, high = knot[0][0], knot[0][-1]
    return (np.linspace(low, high, 1 + max(1, int(np.ceil((high - low) / np.log(_STEP))))),)


def _matte(brdf: Callable) -> np.ndarray | None:
    """Which channels of a BRDF are diffuse; None if the BRDF has no channels."""
    if not isinstance(brdf, Channels):
        return None
    return np.array([not model.lobe_width for model in brdf.model])


def _lobes(brdf: Callable, which: np.ndarray) -> Callable:
    """The selected channels, widened and without their scales."""
    brdf = require.kind("the BRDF", brdf, Channels, source="a material that may change")
    models = tuple(itertools.compress(brdf.model, which))
    return widened(Channels(models, jnp.ones(len(models), brdf.scale.dtype)))


def _equal(one: Callable, other: Callable) -> bool:
    """Whether two BRDFs of the same class have equal parameters."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)
