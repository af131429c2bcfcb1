"""Steps of the fit of lobes to a BRDF by expectation maximization (EM); `jaxprt.lobe.tabulate` calls them."""

import math
from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.decompose import mixture
from jaxprt.sphere import directions, hemisphere

RINGS, SECTORS = 64, 96  # of the quadrature whose nodes are the samples of EM
FINEST = 2e5  # largest concentration, a width of an eighth of a degree
_WIDEST = 2.0  # smallest concentration relative to a single lobe's; wider lobes would average light and shadow
_TAIL = 2  # One of this many lobes may be wider, each by the same factor, to fit the BRDF's tails,
_FEW = 6  # lobes below which half as many may be wider
_BROADEST = 8.0  # down to this concentration, a width of twenty degrees
_SHARP = 50.0  # concentration above which a lobe counts as a planar normal distribution
_CORE = 0.6  # share of the mass, nearest to the mirror direction, that sets the initial spread of lobes
_BATCH = 8  # number of views fitted at once
_LOWEST = 0.02  # smallest z of the initial direction of a lobe
_GRAZING = 1e-3
_TINY = 1e-12


@jit
def samples(
    brdf: Callable, wo: Float[Array, "v 3"]
) -> tuple[Float[Array, "v s 3"], Float[Array, "v s c"], Float[Array, "v s 1"], Float[Array, "v s"]]:
    """Samples of BRDF x cosine for each view, around the mirror direction.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        wo: Unit directions to the viewer.

    Returns:
        Directions s of the samples of each view v; their mass, the value of BRDF x cosine times solid angle; the
        logarithm of the diffuse density cos / pi; and their extent, solid angle / (4 pi).
    """

    def one(view):
        wi, area = hemisphere.arcs(mirror(view), rings=RINGS, sectors=SECTORS)
        value = brdf(wi, jnp.broadcast_to(view, wi.shape))
        if jnp.ndim(value) != 2 or len(value) != len(wi):
            raise ValueError(
                f"the BRDF must return [{len(wi)}, c] for {len(wi)} directions, got {list(jnp.shape(value))}"
            )
        cosine = jnp.maximum(wi[:, 2], jnp.finfo(wi.dtype).tiny)
        # Over a disk of solid angle a, the mean of 1 - cos of the angle to its center is a / (4 pi).
        return wi, value * (cosine * area)[:, None], jnp.log(cosine / np.pi)[:, None], area / (4 * np.pi)

    return jax.lax.map(one, wo, batch_size=_BATCH)


def _tails(lobes: int) -> int:
    """Number of lobes that may be wide."""
    return lobes // (_TAIL if lobes >= _FEW else 2 * _TAIL)


@partial(jit, static_argnames=("lobes",))
def start(
    wo: Float[Array, "v 3"], sample: Float[Array, "v s 3"], mass: Float[Array, "v s"], *, lobes: int
) -> tuple[mixture.Mixture, Float[Array, "v l"]]:
    """Initial lobes for EM, on a spiral over half vectors that covers the BRDF's core; and their concentration bounds.

    The last lobes, a half or of few a quarter, have smaller bounds, so that they can widen to fit the tails of a sharp
    BRDF. Without them EM would assign the tails to the diffuse part.

    Args:
        wo: Unit directions to the viewer.
        sample: Directions of the samples of each view, from `samples`.
        mass: Mass of each sample, summed over colors.
        lobes: Number of lobes.
    """
    away = 1 - jnp.einsum("vsi,vi->vs", sample, mirror(wo))
    order = jnp.argsort(away, 1)
    portion = jnp.cumsum(jnp.take_along_axis(mass, order, 1), 1)
    last = jnp.argmax(portion >= _CORE * portion[:, -1:], 1)[:, None]
    reach = jnp.take_along_axis(jnp.take_along_axis(away, order, 1), last, 1)
    near = mass * (away <= reach)
    total = jnp.sum(near, 1)
    near = near / jnp.where(total > 0, total, 1)[:, None]
    slope = _slope(sample + wo[:, None])
    # The core holds about half of the variance. The small term serves BRDFs without mass.
    square = 2 * jnp.einsum("vs,vsi,vsj->vij", near, slope, slope) + 1e-8 * jnp.eye(2, dtype=wo.dtype)
    number = jnp.arange(lobes, dtype=wo.dtype)
    radius, turn = 0.9 * jnp.sqrt(-2 * jnp.log1p(-(number + 0.5) / lobes)), np.pi * (3 - 5**0.5) * number
    tilt = jnp.einsum("vij,jl->vli", jnp.linalg.cholesky(square), radius * jnp.stack([jnp.cos(turn), jnp.sin(turn)]))
    drop = 2 * jnp.sum(near * away, 1)
    least = jnp.clip(_WIDEST * mixture.concentration_of(jnp.clip(drop, 1e-7, 0.8)), 1, FINEST / 2)
    mean = _reflect(wo, tilt, _LOWEST)
    wider = jnp.maximum(number + 1 - (lobes - _tails(lobes)), 0) / max(_tails(lobes), 1)
    least = least[:, None] * (_BROADEST / jnp.maximum(least[:, None], _BROADEST)) ** wider
    concentration = 1.5 * least
    weight = jnp.broadcast_to(portion[:, -1:] / lobes, mean.shape[:2])
    return mixture.Mixture(weight, mean, concentration), least


@jit
def most_diffuse(
    mass: Float[Array, "v s c"], fixed: Float[Array, "v s 1"], extent: Float[Array, "v s"]
) -> Float[Array, "v c"]:
    """Largest albedo of the diffuse part for each view and color: pi times the BRDF's median over directions of light.

    Directions count by their cosine. Without this bound, the tails of a sharp BRDF would become diffuse. The arguments
    are those that `samples` returns: mass, logarithm of the diffuse density, and extent.
    """
    measure = np.pi * jnp.exp(fixed) * 4 * np.pi * extent[..., None]
    value = jnp.where(measure > 0, mass / jnp.where(measure > 0, measure, 1), 0)
    order = jnp.argsort(value, 1)
    portion = jnp.cumsum(jnp.take_along_axis(jnp.broadcast_to(measure, value.shape), order, 1), 1)
    middle = jnp.argmax(portion >= portion[:, -1:] / 2, 1)[:, None]
    return np.pi * jnp.take_along_axis(value, jnp.take_along_axis(order, middle, 1), 1)[:, 0]


@partial(jit, static_argnames=("steps",))
def improve(
    sample: Float[Array, "v s 3"],
    mass: Float[Array, "v s"],
    extent: Float[Array, "v s"],
    lobe: mixture.Mixture,
    least: Float[Array, "v l"],
    fixed: Float[Array, "v s k"],
    weight: Float[Array, "v k"],
    *,
    steps: int,
) -> tuple[mixture.Mixture, Float[Array, "v k"]]:
    """Runs `steps` steps of EM for each view v by `jaxprt.decompose.mixture.fit`.

    Args:
        sample: Directions of the samples.
        mass: Mass of each sample.
        extent: Mean of 1 - cos over the solid angle of each sample.
        lobe: The lobes before these steps.
        least: Smallest concentration of each lobe.
        fixed: Logarithm of each fixed density at the samples, such as that of the diffuse part.
        weight: Weight of each fixed density.
        steps: Number of steps.

    Returns:
        The lobes, and the weights of the fixed densities.
    """

    def one(argument):
        sample, mass, extent, lobe, least, fixed, weight = argument
        fit = mixture.fit(
            sample, mass, lobe, extent=extent, fixed=fixed, weight=weight, least=least, most=FINEST, steps=steps
        )
        return fit.lobe, fit.fixed

    return jax.lax.map(one, (sample, mass, extent, lobe, least, fixed, weight), batch_size=_BATCH)


@partial(jit, static_argnames=("nodes", "parameters"))
def blend(
    wo: Float[Array, "v 3"],
    lobe: mixture.Mixture,
    smoothing: Float[Array, ""],
    *,
    nodes: tuple[int, ...],
    parameters: int = 0,
) -> mixture.Mixture:
    """Moves the lobes of each node towards those of its neighbors in the table.

    Slopes of half vectors, logarithms of concentrations and relative weights are averaged. The two neighbors along an
    axis together get the weight `smoothing`, and each of them counts in proportion to its lobe's weight, because a lobe
    without weight has an arbitrary direction. Slopes and widths of neighbors along a BRDF parameter are compared
    relative to the mean width of all lobes that have the same parameters.

    Args:
        wo: Unit directions to the viewer at the nodes.
        lobe: The lobes at the nodes.
        smoothing: Weight of the two neighbors along each axis.
        nodes: Number of nodes along each axis.
        parameters: Number of leading axes that are BRDF parameters; the others are axes of the view.
    """
    total = jnp.sum(lobe.weight, 1, keepdims=True)
    part = (lobe.weight / jnp.where(total > 0, total, 1))[..., None]
    slope, scale = _slope(lobe.mean + wo[:, None]), jnp.log(lobe.concentration)[..., None]
    width = jnp.zeros((1, 1, 1), wo.dtype)  # logarithm of the squared width of lobes with the same parameters
    if parameters:
        member = scale.reshape(math.prod(nodes[:parameters]), -1)
        width = jnp.repeat(-jnp.mean(member, 1), len(wo) // len(member))[:, None, None]
        slope, scale = slope * jnp.exp(-width / 2), scale + width
    state = jnp.concatenate([slope, scale, part], -1)
    sure = part + 1e-4
    count, state, sure = lobe.weight.shape[1], state.reshape(*nodes, -1, 4), sure.reshape(*nodes, -1, 1)
    for axis in range(len(nodes)):
        rim = [(1, 1) if i == axis else (0, 0) for i in range(state.ndim)]
        e, s = jnp.pad(state * sure, rim, mode="edge"), jnp.pad(sure, rim, mode="edge")
        low, middle, high = ([jax.lax.slice_in_dim(x, k, k + nodes[axis], axis=axis) for x in (e, s)] for k in range(3))
        top, sure = ((1 - smoothing) * b + smoothing / 2 * (a + c) for a, b, c in zip(low, middle, high, strict=True))
        state = top / sure
    state = state.reshape(-1, count, 4)
    slope, scale, part = state[..., :2], state[..., 2], state[..., 3]
    if parameters:
        slope, scale = slope * jnp.exp(width / 2), jnp.minimum(scale - width[..., 0], math.log(FINEST))
    return mixture.Mixture(part * total, _reflect(wo, slope, 0.0), jnp.exp(scale))


@jit
def weigh(
    sample: Float[Array, "v s 3"],
    mass: Float[Array, "v s c"],
    extent: Float[Array, "v s"],
    lobe: mixture.Mixture,
    fixed: Float[Array, "v s k"],
    weight: Float[Array, "v k"],
    most: Float[Array, "v c"],
) -> Float[Array, "c m v"]:
    """Weights of the lobes and, last, of the diffuse part per color, scaled to the BRDF's energy above the horizon."""

    def one(argument):
        sample, mass, extent, lobe, fixed, weight, most = argument
        density = mixture.log_density(sample, lobe.mean, lobe.concentration)
        # Part of each lobe above the horizon. For a sharp lobe it is that of a normal distribution cut by a plane.
        wide = jnp.minimum(jnp.sum(jnp.exp(density) * 4 * np.pi * extent[:, None], 0), 1)
        sharp = jax.scipy.special.ndtr(lobe.mean[:, 2] * jnp.sqrt(lobe.concentration))
        above = jnp.append(jnp.where(lobe.concentration < _SHARP, wide, sharp), 1)
        start = jnp.concatenate([lobe.weight, weight])
        start, density = start + 1e-3 * jnp.mean(start), jnp.concatenate([density, fixed], 1)
        weight = jax.vmap(lambda m: mixture.weigh(density, m, start, steps=30)[0], in_axes=1)(mass)
        lobes, diffuse = weight[:, :-1], jnp.minimum(weight[:, -1], most)
        scale = (jnp.sum(weight, 1) - diffuse) / jnp.maximum(lobes @ above[:-1], _TINY)
        return jnp.concatenate([lobes * scale[:, None], diffuse[:, None]], 1)

    return jnp.moveaxis(jax.lax.map(one, (sample, mass, extent, lobe, fixed, weight, most)), 0, -1)


def mirror(wo: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    """Mirror directions: the given directions reflected about the normal."""
    return wo * jnp.array([-1, -1, 1], wo.dtype)


def _slope(half: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
    return half[..., :2] / jnp.maximum(half[..., 2:], _GRAZING)


def _reflect(wo: Float[Array, "v 3"], slope: Float[Array, "v l 2"], lowest: float) -> Float[Array, "v l 3"]:
    """Directions whose half vectors with wo have the given slopes, raised to at least `lowest` in z."""
    normal = directions.normalize(jnp.concatenate([slope, jnp.ones_like(slope[..., :1])], -1))
    mean = 2 * jnp.sum(wo[:, None] * normal, -1, keepdims=True) * normal - wo[:, None]
    return directions.normalize(mean.at[..., 2].set(jnp.maximum(mean[..., 2], lowest)))
