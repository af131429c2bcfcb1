"""BRDFs on the way of reflected light: with what functions the parts of a scene send light to each other.

A part with one BRDF for good sends with that, factored. Other materials of a part have other colors, and another
roughness where that may change: such a part sends with a few functions that are chosen for all of its range, and
tables of their weights by roughness.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.microfacet import SchlickDiffuse
from jaxprt.brdf.varying import Channels
from jaxprt.relit.channels import Shading
from jaxprt.systems import bounces, harmonic, separable
from jaxprt.systems.bounces.varying import Sent

_TERMS, _RESOLUTION = 24, 32  # of BRDFs on the way of reflected light
_FUNCTIONS = 2  # of lobes of any roughness
_STEP = 1.2  # from one roughness to the next, at most, between which weights of functions are linear
_WIDTH = 0.09  # of lobes on the way of reflected light, at least: alpha of GGX, or m of Beckmann's distribution
_SAME = 1e-5  # difference of equal parameters: means over other numbers of vertices are rounded otherwise
_DARK = 1e-6  # albedo of what reflects nothing
_VIEWS = 16  # over whose angles albedo is averaged
_RINGS, _SECTORS = 48, 320  # of the quadrature of each: of roughness .1 and more within a few per cent


class Path(NamedTuple):
    """What a part sends light with.

    Attributes:
        brdf: Factored; its channels are those of the part's BRDF, or functions.
        sent: Weights of the functions; None where the channels are those of the part's BRDF.
    """

    brdf: separable.SeparableBrdf
    sent: Sent | None


def factored(shading: Shading) -> Path:
    """What a part reflects light with on its way to others.

    Lobes that are too narrow for the maps are widened: a mirror of roughness .05 would send 235 times the light that it
    gets. Each channel then has the albedo that it has in truth. What arrives elsewhere is a few harmonics, and wider.
    """
    knot = _finer(shading.knot)
    members = [shading.brdf(jnp.asarray(each)) for each in knot[0]] if knot else [shading.brdf]
    matte = _matte(members[0])
    if shading.blend is None or matte is None or matte.all():
        return Path(_alone(still(shading)), None)
    wide = [_lobes(each, ~matte) for each in members]
    # Lobes that are all widened to the same width are one member of the set.
    first = [0] + [n for n in range(1, len(wide)) if not _equal(wide[n - 1], wide[n])]
    lobes = [wide[n] for n in first]
    brdf, weight = bounces.functions.shared(lobes, functions=_FUNCTIONS, terms=_TERMS, resolution=_RESOLUTION)
    own = np.searchsorted(first, np.arange(len(wide)), side="right") - 1
    factor = np.zeros((len(members), len(matte), brdf.view_map.shape[-1]), np.asarray(weight).dtype)
    factor[:, ~matte] = np.asarray(weight)[own]
    factor[:, matte, -1] = 1
    kept = factor @ np.asarray(bounces.functions.albedo(brdf))
    true = np.stack([channels(each) for each in members])
    factor *= np.where(kept > _DARK, true / np.maximum(kept, _DARK), 1)[..., None]
    dtype = brdf.view_map.dtype
    return Path(brdf, Sent(tuple(jnp.asarray(each, dtype) for each in knot), jnp.asarray(factor, dtype)))


def alike(one: Shading, other: Shading) -> bool:
    """Whether two parts send light with the same: their BRDFs, and what these are made for, are equal."""
    pair = one.brdf, other.brdf
    knots = [each.knot for each in (one, other)]
    if (one.blend is None) != (other.blend is None) or len(knots[0]) != len(knots[1]):
        return False
    leaves, kinds = zip(*(jax.tree.flatten(each) for each in pair), strict=True)
    if kinds[0] != kinds[1] or not all(eqx.is_array(leaf) for leaf in (*leaves[0], *leaves[1])):
        return False
    pairs = [*zip(*leaves, strict=True), *zip(*knots, strict=True)]
    return all(np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=_SAME, atol=0) for a, b in pairs)


def typical(shading: Shading, path: Path) -> Float[Array, "p c"] | None:
    """Weights of the channels of what a part sends light with, in the mean over its vertices; None without a blend."""
    if shading.blend is None:
        return None
    if path.sent is None:
        return jnp.mean(shading.blend.weight, 0)
    return path.sent.mean(shading.blend, jnp.ones(len(shading.blend.weight)))


def albedo(shading: Shading) -> Float[np.ndarray, "3"]:
    """Mean albedo of a part, over its vertices and over views from above."""
    channel = channels(still(shading))
    color = channel if shading.blend is None else channel @ np.mean(shading.blend.weight, 0)
    return np.clip(np.broadcast_to(color, 3), 0, 1)


def channels(brdf: Callable) -> Float[np.ndarray, " k"]:
    """Mean albedo of each channel of a BRDF, over views from above."""
    cosine = np.sqrt((np.arange(_VIEWS) + 0.5) / _VIEWS)  # Evenly spread in projected solid angle.
    wo = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], -1).astype(np.float32)
    sent = harmonic.table.project(brdf, jnp.asarray(wo), degree=0, rings=_RINGS, sectors=_SECTORS)
    return np.asarray(np.sqrt(4 * np.pi) * np.mean(sent[0], -1))


def still(shading: Shading) -> Callable:
    """The BRDF of a part, at the mean roughness if that varies."""
    if not shading.knot:
        return shading.brdf
    assert shading.blend is not None
    return shading.brdf(jnp.asarray(np.mean(shading.blend.parameter[0])))


def widened(brdf: Callable) -> Callable:
    """A BRDF whose roughness is enough for maps of light paths; one without a roughness stays as it is."""

    def wider(path: tuple, leaf: Any) -> Any:
        name = getattr(path[-1], "name", None) if path else None
        if name == "roughness":
            # Cook-Torrance's is the width itself, that of metallic-roughness materials its root.
            return jnp.maximum(leaf, _WIDTH if isinstance(_owner(brdf, path), CookTorrance) else _WIDTH**0.5)
        return jnp.minimum(leaf, 2 / _WIDTH**2 - 2) if name in ("nu", "nv", "exponent") else leaf

    return jax.tree_util.tree_map_with_path(wider, brdf)


def _owner(tree: Any, path: tuple) -> Any:
    """What holds a leaf."""
    for key in path[:-1]:
        tree = getattr(tree, key.name) if hasattr(key, "name") else tree[key.idx if hasattr(key, "idx") else key.key]
    return tree


def _alone(brdf: Callable) -> separable.SeparableBrdf:
    """One BRDF with its channels."""
    made = separable.factor(widened(brdf), terms=1 if isinstance(brdf, Lambert) else _TERMS, resolution=_RESOLUTION)
    kept = np.atleast_1d(bounces.functions.albedo(made))
    scale = np.where(kept > _DARK, channels(brdf) / np.maximum(kept, _DARK), 1)
    return eqx.tree_at(lambda each: each.view_map, made, made.view_map * jnp.asarray(scale, made.view_map.dtype))


def _finer(knot: tuple[np.ndarray, ...]) -> tuple[np.ndarray, ...]:
    """Knots over the same range, as many as weights of functions need."""
    if not knot:
        return ()
    low, high = knot[0][0], knot[0][-1]
    return (np.linspace(low, high, 1 + max(1, int(np.ceil((high - low) / np.log(_STEP))))),)


def _matte(brdf: Callable) -> np.ndarray | None:
    """Which channels of a BRDF are diffuse; None for one that is not of channels."""
    if not isinstance(brdf, Channels):
        return None
    return np.array([isinstance(each, Lambert | SchlickDiffuse) for each in brdf.model])


def _lobes(brdf: Callable, which: np.ndarray) -> Callable:
    """Some of the channels, wide enough and without their scales."""
    assert isinstance(brdf, Channels)
    kept = tuple(each for each, own in zip(brdf.model, which, strict=True) if own)
    return widened(Channels(kept, jnp.ones(len(kept), brdf.scale.dtype)))


def _equal(one: Callable, other: Callable) -> bool:
    """Whether two BRDFs of one kind have the same parameters."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)
