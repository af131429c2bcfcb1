"""BRDFs along light paths: a few functions of which all BRDFs that a region can have are sums.

    f_h(wi, wo) ~ sum_p H(h, p) f_p(wi, wo),    f_p(wi, wo) = sum_k g_kp(wo) u_k(wi)

Light that has been reflected is linear in the weights H of every surface that it met, so that transport along paths of
functions p serves all BRDFs. Each function is factored over the two directions: a bounce is then gathers and products.
A point receives what surfaces send it from many directions, as a few harmonics. So what they send is judged smoothed
over directions too: 24 factors then lose .107 of what arrives, where 24 that are chosen for pictures lose .147; 32
lose .096.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.brdf.places import Columns, Line, Plane
from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems import dynamic
from jaxprt.systems.bounces import between
from jaxprt.systems.dynamic import DynamicBrdf
from jaxprt.systems.dynamic.reflected import Reflected
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.separable import SeparableBrdf

_RINGS, _SECTORS = 32, 64  # of a quadrature of what is bilinear on a map times a few harmonics
_SMOOTH = 5  # degree of harmonics of what is sent; with 4 more is lost of light from the horizon, with 6 of all
_FUNCTIONS = 4  # that stand for a set if it has as many BRDFs
_TOGETHER = 64  # BRDFs and middles of pairs for which functions are chosen, and that are integrated at once
_RANK = 1e-3  # of the largest singular value, below which float32 has no more
_NOTHING = 1e-3  # of the largest singular value: a color that is a multiple of another


def factor(
    brdfs: Sequence[Callable],
    *,
    lobe: LobeBrdf | None = None,
    navigation: Line | Plane | Columns | None = None,
    functions: int | None = None,
    terms: int = 32,
    resolution: int = 32,
) -> DynamicBrdf:
    """A set of BRDFs for light paths, decomposed whole: principal components of the set, and factors of the light.

    Least squares of what the BRDFs reflect of light of natural spectrum into directions, smoothed over these to degree
    5. Views are not compressed, since transport holds none of them. Between BRDFs of the set, the functions have the
    weights that are the best for the BRDF that is really there, see `jaxprt.bounces.between`: a model whose parameters
    are between, or moved lobes.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, without diffuse parts.
        lobe: Their lobes, from `jaxprt.dynamic.separate`, by which BRDFs that are of no one model move. Without these,
            such BRDFs are mixed linearly.
        navigation: The way through the set, which tells what can be mixed with what. If None, all pairs count, or for
            more than 64 BRDFs none: these are then mixed linearly.
        functions: How many stand for the set. If None, four, or as many as there are BRDFs and middles of pairs, times
            colors.
        terms: Light factors that they share. Precomputed bounces cost in proportion.
        resolution: Edge of the square maps in texels.

    Returns:
        The set, without lobes. Its error is that of what its BRDFs reflect, smoothed.

    Raises:
        ValueError: As of `jaxprt.dynamic.factor`, functions or terms out of range, or a navigation of another number of
            BRDFs.

    Reference: Sun et al. 2007, section 3.1, in the norm of natural light in place of Frobenius'.
    """
    colors = dynamic.brdf_set.check(brdfs, lobe, resolution=resolution)
    pair = between.pairs(len(brdfs), navigation)
    middle, moved = between.middles(brdfs, lobe, pair)
    pair = jnp.asarray(pair[: len(middle)], jnp.int32)
    # Few BRDFs leave gaps, so that functions are chosen for the middles too; many are dense enough.
    dense = len(brdfs) + len(middle) > _TOGETHER
    found, rest = _members(brdfs, [] if dense else middle, moved, pair, resolution)
    members = len(found.tensor) * colors
    functions = min(_FUNCTIONS, members) if functions is None else functions
    _check_count("functions", functions, members)
    _check_count("terms", terms, found.tensor.shape[3])
    smooth = _smoothed(found)
    kinds = min(smooth.shape[1], len(found.area))
    least = tucker.oriented(tucker.truncated(smooth, ranks=(functions, kinds, terms)))
    view, light = _maps(found, least)
    rows = [_projected(smooth, least)]
    for first in range(0, len(middle) if dense else 0, _TOGETHER):
        part = slice(first, first + _TOGETHER)
        each = _middles(dynamic.reflected.reflect(middle[part], None, resolution=resolution), rest, pair[part])
        rows.append(_projected(_smoothed(each), least))
    along = jnp.concatenate(rows)
    count = len(brdfs) * colors
    error = _missed(smooth[:count], along[:count], least)
    pairs = np.eye(functions * terms, dtype=error.dtype).reshape(functions, terms, -1).swapaxes(1, 2)
    along = between.quadratic(along.reshape(-1, colors, functions), pair, count=len(brdfs))
    return DynamicBrdf(jnp.asarray(pairs), along, view, light, None, dynamic.reflected.stacked(brdfs), error)


def shared(
    brdfs: Sequence[Callable], *, functions: int, terms: int = 32, resolution: int = 32
) -> tuple[SeparableBrdf, Float[Array, "m c p"]]:
    """Functions of which each of some BRDFs and its colors is a sum, chosen as in `factor` but with all BRDFs alike.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, all of as many colors, without diffuse parts.
        functions: How many there are for all of them; as many as BRDFs times colors at most.
        terms: Light factors that they share, or as many as the maps hold.
        resolution: Edge of the square maps in texels.

    Returns:
        The functions as colors of one factored BRDF, a diffuse one of albedo 1 last. Their weights for each BRDF and
        color, those of the diffuse one zero; the largest weight of each of the others is 1.

    Raises:
        ValueError: A BRDF is negative or not finite.
    """
    found, size = _evened(dynamic.reflected.reflect(brdfs, None, resolution=resolution))
    smooth, colors = _smoothed(found), found.tensor.shape[1]
    kinds = min(smooth.shape[1], len(found.area))
    ranks = (min(functions, len(smooth)), kinds, min(terms, found.tensor.shape[3]))
    least = tucker.oriented(tucker.truncated(smooth, ranks=ranks))
    view, light = _maps(found, least)
    along = _projected(smooth, least)
    error = _missed(smooth, along, least)
    weight = along.reshape(len(brdfs), colors, -1) * size[:, None, None]
    most = jnp.max(jnp.abs(weight), (0, 1))
    most = jnp.where(most > 0, most, 1)
    core = jnp.eye(len(most) * ranks[2], dtype=view.dtype).reshape(len(most), ranks[2], -1).swapaxes(1, 2)
    light_map, view_map = _functions(core * most[:, None, None], view, light)
    weight = jnp.pad(weight / most, ((0, 0), (0, 0), (0, 1)))
    return SeparableBrdf(light_map, view_map, error, hemisphere.parabolic_coordinates), weight


@jit
def _evened(found: Reflected) -> tuple[Reflected, Float[Array, " m"]]:
    """What BRDFs reflect, each divided by the size of what it sends, and that size."""
    sent = _smoothed(found).reshape(len(found.tensor), -1)
    size = jnp.sqrt(jnp.sum(sent**2, 1))
    size = jnp.where(size > 0, size, 1)
    return found._replace(tensor=found.tensor / size[:, None, None, None]), size


def _check_count(name: str, value: int, most: int) -> None:
    """Refuses what is no whole number from 1 to the tensor's size."""
    if not isinstance(value, int | np.integer) or not 1 <= value <= most:
        raise ValueError(f"{name} must be a whole number from 1 to {most} for these BRDFs, got {value}")


def _members(
    brdfs: Sequence[Callable], middle: Sequence[Callable], moved: Sequence[Callable], pair: Array, resolution: int
) -> tuple[Reflected, Array | None]:
    """What BRDFs and some in the middle of pairs reflect, and what lobes leave of the BRDFs where lobes move."""
    if not moved:
        return dynamic.reflected.reflect([*brdfs, *middle], None, resolution=resolution), None
    found = dynamic.reflected.reflect(brdfs, None, resolution=resolution)
    lobes = dynamic.reflected.reflect([*moved, *middle], None, resolution=resolution)
    rest = found.tensor - lobes.tensor[: len(brdfs)]
    if not middle:
        return found, rest
    each = _middles(lobes._replace(tensor=lobes.tensor[len(brdfs) :]), rest, pair)
    return found._replace(tensor=jnp.concatenate([found.tensor, each.tensor])), rest


def _middles(found: Reflected, rest: Array | None, pair: Array) -> Reflected:
    """What BRDFs in the middle of pairs reflect: moved lobes, and the mean of what these leave."""
    if rest is None:
        return found
    return found._replace(tensor=found.tensor + jnp.mean(rest[pair], 1))


@jit
def _smoothed(found: Reflected) -> Float[Array, "m s b"]:
    """What each BRDF and color sends, as harmonics of the view."""
    seen = harmonics.evaluate(found.direction, degree=_SMOOTH) * found.area[:, None]
    return tucker.multiply(found.tensor.reshape(-1, *found.tensor.shape[2:]), seen, mode=1)


@jit
def _maps(found: Reflected, least: tucker.Tucker) -> tuple[Array, Array]:
    """View maps of each function and term, and light maps, of a decomposition."""
    along, _, across = least.factor
    flat = found.tensor.reshape(-1, *found.tensor.shape[2:])
    view = tucker.multiply(tucker.multiply(flat, across, mode=2), along, mode=0)  # [h, d, k]
    # Light maps carry the size, so that view factors have a mean square of about one.
    square = jnp.einsum("hdk,d->k", view**2, found.area) / (jnp.sum(found.area) * len(flat))
    size = jnp.where(square > 0, jnp.sqrt(square), 1)
    edge = math.isqrt(len(found.area))
    return (
        jnp.moveaxis(view / size, 1, 2).reshape(-1, edge, edge),
        (size[:, None] * (across.T @ found.to_map)).reshape(-1, edge, edge),
    )


@jit
def _projected(smooth: Float[Array, "n s b"], least: tucker.Tucker) -> Float[Array, "n h"]:
    """The weights of functions that make the least error of what BRDFs send."""
    core = least.core.reshape(len(least.core), -1)
    met = tucker.multiply(tucker.multiply(smooth, least.factor[2], mode=2), least.factor[1], mode=1)
    square = jnp.linalg.pinv(core @ core.T, rtol=_RANK**2, hermitian=True)
    return met.reshape(len(smooth), -1) @ core.T @ square


@jit
def _missed(smooth: Float[Array, "n s b"], along: Float[Array, "n h"], least: tucker.Tucker) -> Float[Array, ""]:
    """Relative error of what functions with some weights send."""
    sent = tucker.Tucker(least.core, (along, *least.factor[1:])).full()
    whole = jnp.vdot(smooth, smooth)
    return jnp.sqrt(jnp.vdot(sent - smooth, sent - smooth) / jnp.where(whole > 0, whole, 1))


def basis(brdf: DynamicBrdf | SeparableBrdf) -> SeparableBrdf:
    """The functions f_p, in place of the colors of a factored BRDF.

    Args:
        brdf: A set with terms, of which each rank of the set makes a function, and a constant one for the diffuse part
            follows; or one BRDF, of which one function is made if all its colors are multiples of one.

    Returns:
        View factors of all functions on light factors that they share.

    Raises:
        ValueError: The set has no terms, or lobes, or the BRDF's light maps are per color.

    Reference: Sun et al. 2007, section 3.1.
    """
    if isinstance(brdf, SeparableBrdf):
        view = jnp.matmul(brdf.view_map, fixed_weights(brdf).T, precision="highest")
        return SeparableBrdf(brdf.light_map, view, brdf.error, brdf.coordinates)
    if brdf.lobe is not None or not brdf.core.size:
        found = "those of what its lobes leave" if brdf.core.size else "none"
        raise ValueError(f"light paths need terms of whole BRDFs, from ranks and without lobes, got {found}")
    light, view = _functions(brdf.core, brdf.view_map, brdf.light_map)
    return SeparableBrdf(light, view, brdf.error, brdf.coordinates)


@jit
def _functions(core: Array, view_map: Array, light_map: Array) -> tuple[Array, Array]:
    """Light and view maps of the functions of a set, and of a constant one."""
    view = jnp.einsum("hoi,oyx->iyxh", core, view_map)
    light = jnp.concatenate([light_map, jnp.ones_like(light_map[:1])])[..., None]
    return light, jnp.pad(view, ((0, 1), (0, 0), (0, 0), (0, 1))).at[-1, ..., -1].set(1 / np.pi)


@partial(jit, static_argnames=("degree",))
def project(basis: SeparableBrdf, *, degree: int) -> Float[Array, "s k"]:
    """What light factors make of harmonics in the local frame: integrals over the hemisphere with the cosine.

    Reference: Sun et al. 2007, section 3.3, the matrix C of one-bounce interreflection.
    """
    up = jnp.zeros(3, basis.light_map.dtype).at[2].set(1)
    direction, area = hemisphere.arcs(up, rings=_RINGS, sectors=_SECTORS)
    met = basis.light(direction)[..., 0] * (direction[:, 2] * area)[:, None]
    return harmonics.evaluate(direction, degree=degree).T @ met


@jit
def albedo(basis: SeparableBrdf) -> Float[Array, " p"]:
    """Share of constant light that each function reflects, into all directions: its hemispherical albedo."""
    up = jnp.zeros(3, basis.light_map.dtype).at[2].set(1)
    direction, area = hemisphere.arcs(up, rings=_RINGS, sectors=_SECTORS)
    flux = direction[:, 2] * area
    met = flux @ basis.light(direction)[..., 0]
    return jnp.einsum("d,dkp,k->p", flux / np.pi, basis.view(direction), met)


@jit
def weights(
    factor: Float[Array, "m *n f h"],
    weight: Float[Array, " m"],
    diffuse: Float[Array, " c"],
    specular: Float[Array, " d"],
) -> Float[Array, "p e"]:
    """Weights H of a set's functions for one of its BRDFs; per color if any of the arguments is.

    Between BRDFs of the set the weights are those of the BRDF that is really there, see `jaxprt.bounces.between`.

    Args:
        factor: The set's `jaxprt.dynamic.DynamicBrdf.factor`.
        weight: The weight of each BRDF in the set, as `jaxprt.brdf.navigation` makes them.
        diffuse: Albedo of the diffuse part.
        specular: What the BRDF of the set is multiplied by.

    Returns:
        The weights, the diffuse part's last. Differentiable in all but the set.

    Raises:
        ValueError: The weights are not one for each BRDF of the set.
    """
    if weight.shape != factor.shape[:1]:
        raise ValueError(f"weights must be one for each of {len(factor)} BRDFs, got {list(weight.shape)}")
    sharp = dynamic.brdf_set.combined(factor, weight).T * specular
    colors = max(sharp.shape[1], len(diffuse))
    rows = [jnp.broadcast_to(each, (len(each), colors)) for each in (sharp, diffuse[None])]
    return jnp.concatenate(rows)


def fixed_weights(brdf: SeparableBrdf) -> Float[Array, "p c"]:
    """Weights of the functions of one BRDF, which does not change: as few as its colors need, and orthonormal.

    Raises:
        ValueError: Light maps per color.
    """
    if brdf.light_map.shape[-1] != 1:
        raise ValueError(f"light maps must be shared by all colors, got {brdf.light_map.shape[-1]} channels")
    light, view = (np.asarray(each, np.float64) for each in (brdf.light_map, brdf.view_map))
    rows = view * np.sqrt(np.mean(light**2, (1, 2, 3), keepdims=True))
    _, value, axis = np.linalg.svd(rows.reshape(-1, brdf.view_map.shape[-1]), full_matrices=False)
    axis = axis * np.where(axis.sum(1, keepdims=True) < 0, -1, 1)  # Signs are otherwise as rounding has them.
    return jnp.asarray(axis[value > _NOTHING * max(value[0], np.finfo(np.float32).tiny)], brdf.view_map.dtype)
