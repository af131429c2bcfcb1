"""BRDF x cosine as a few lobes on the sphere, tabulated over the view direction.

    f(wi, wo) max(0, wi_z) ~ d(wo) wi_z / pi + sum_l w_l(wo) p(wi; m_l(wo), k_l(wo))

Here p is a von Mises-Fisher density, and d is a diffuse part. Means m, concentrations k and weights w are free and
fitted by expectation maximization (EM). The published form, Gaussians of four fixed widths around the mirror direction,
stands in `benchmarks/published/lobes.py`.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import isolated, jit
from jaxprt.decompose import mixture
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.lobe import em

_STEPS = 4  # EM steps per call; every other number would be compiled separately
# Rounds of EM: the number of calls, and the weight of neighboring nodes in the smoothing after them.
_ROUNDS = ((2, 0.5), (2, 0.5), (2, 0.25), (2, 0.25), (2, 0.1), (2, 0.1), (3, 0.0))
_DEGREE = 24  # of the natural light under which the error of a table is measured
_COUNTS = (2, 4, 6, 8, 12, 16, 24, 32)
_TINY = 1e-12
_GRAZING = 1e-3  # smallest cosine by which the lobes are divided
_VERY_NARROW = 800.0, 3200.0  # concentrations below which stored visibility hides a lobe, and above which rays do
WIDE, NARROW = 8.0, 32.0  # concentrations below which harmonics represent a lobe, and above which rays do


class LobeMixture(eqx.Module):
    """Lobes l of BRDF x cosine for views v, in local frames.

    Attributes:
        mean: Unit direction of each lobe.
        concentration: Von Mises-Fisher concentration of each lobe.
        weight: Integral of each lobe over the sphere, gray or per color.
        diffuse: Albedo of the diffuse part, gray or per color.
    """

    mean: Float[Array, "3 l v"]
    concentration: Float[Array, "l v"]
    weight: Float[Array, "c l v"]
    diffuse: Float[Array, "c v"]

    def evaluate(self, wi: Float[Array, "d 3"]) -> Float[Array, "c d"]:
        """BRDF x cosine of wi in 1/sr, for one view or for one view per wi. It is zero below the horizon."""
        away = sum((wi[:, i] - self.mean[i]) ** 2 for i in range(3)) / 2
        density = jnp.exp(mixture.log_peak(self.concentration) - self.concentration * away)
        value = jnp.sum(self.weight * density, 1) + self.diffuse * wi[:, 2] / np.pi
        return jnp.where(wi[:, 2] > 0, value, 0)

    def widened(self, variance: Float[Array, " v"]) -> "LobeMixture":
        """The lobes averaged over directions of some variance, in squared radians along one axis, at each view.

        A lobe near the horizon is widened less, so that little of it falls below, where nothing is seen.
        """
        variance = jnp.minimum(variance, jnp.maximum(self.mean[2], 0) ** 2 / 2)
        concentration = self.concentration / (1 + self.concentration * variance)
        return LobeMixture(self.mean, concentration, self.weight, self.diffuse)


class LobeBrdf(eqx.Module):
    """BRDF x cosine as lobes, tabulated over the view direction and optionally over BRDF parameters.

    The trailing axes *q are one axis per BRDF parameter, then the nodes of the view direction. Isotropic tables have
    one axis of nodes, at even steps of tan(theta / 2) from the normal to the horizon, for views in the x-z plane.
    Anisotropic tables have two, of a parabolic map.

    Attributes:
        mean: Direction of each lobe.
        scale: Logarithm of the concentration of each lobe.
        weight: Integral of each lobe over the sphere, gray or per color.
        diffuse: Albedo of the diffuse part, gray or per color.
        knot: Increasing values of each BRDF parameter at which the table has entries; empty without parameters.
        error: Relative L2 error of radiance without shadows under light of natural spectrum, over views between the
            nodes. NaN if unknown.
    """

    holds_cosine: ClassVar = True  # values include the cosine of the light direction

    mean: Float[Array, "3 l *q"]
    scale: Float[Array, " l *q"]
    weight: Float[Array, "c l *q"]
    diffuse: Float[Array, " c *q"]
    knot: tuple[Float[Array, " _"], ...]
    error: Float[Array, ""]

    @property
    def lobes(self) -> int:
        """Number of lobes."""
        return self.scale.shape[0]

    @property
    def isotropic(self) -> bool:
        """Whether the table depends on the view angle only, not on the azimuth."""
        return self.scale.ndim - len(self.knot) == 2

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return sum(array.nbytes for array in (self.mean, self.scale, self.weight, self.diffuse))

    def at(self, *parameter: Float[Array, ""]) -> "LobeBrdf":
        """The table at given values of its BRDF parameters, without their axes.

        Values are clamped to the range of the knots. Between knots `mean` interpolates. Differentiable in the
        parameters.

        Raises:
            ValueError: The number of parameters differs from the table's.
        """
        if len(parameter) != len(self.knot):
            needed = f"{len(self.knot)} parameters, got {len(parameter)}"
            raise ValueError(f"the table needs {needed}; a system takes them in its materials, as `Blend.parameter`")
        result = self
        for knot, (low, upper) in zip(self.knot, grid.among(self.knot, parameter), strict=True):
            result = _mean(result, jnp.zeros_like(knot).at[low].set(1 - upper).at[low + 1].set(upper))
        return result

    def lookup(self, wo: Float[Array, "v 3"], *parameter: Float[Array, " v"]) -> LobeMixture:
        """Lobes for given views, interpolated between the nodes. Views below the horizon get weights of zero.

        Args:
            wo: Unit directions to the viewer in the local frame.
            parameter: Values of each BRDF parameter for these views, if the table has parameters. Between knots `mean`
                interpolates.

        Raises:
            ValueError: The number of parameters differs from the table's. `at` sets parameters for all views.
        """
        if len(parameter) != len(self.knot):
            raise ValueError(
                f"the table needs {len(self.knot)} parameters for each view, or `at` to choose them for all, "
                f"got {len(parameter)}"
            )
        resolution = self.scale.shape[-1]
        square = wo[:, 0] ** 2 + wo[:, 1] ** 2
        pole = square < _TINY
        sin_o = jnp.sqrt(jnp.where(pole, _TINY, square))
        if self.isotropic:
            axis = [grid.neighbors(sin_o / (1 + jnp.maximum(wo[:, 2], 0)) * (resolution - 1), size=resolution)]
        else:
            spot = hemisphere.parabolic_coordinates(wo) * resolution - 0.5
            axis = [grid.neighbors(spot[:, i], size=resolution) for i in (1, 0)]
        nodes = self.scale.shape[1:]
        rows = [array.reshape(-1, *nodes) for array in (self.mean, self.scale, self.weight, self.diffuse)]
        place = grid.among(self.knot, parameter)
        if place:
            entry = _entries_between(jnp.concatenate(rows), place, axis, lobes=self.lobes)
            mean, scale, strength, diffuse = (jnp.moveaxis(column, 0, -1) for column in entry)
        else:
            value = grid.read(jnp.concatenate(rows), axis)
            mean, scale, strength, diffuse = jnp.split(value, np.cumsum([len(row) for row in rows])[:-1])
        x, y, z = mean.reshape(3, self.lobes, len(wo))
        if self.isotropic:
            cosine, sine = jnp.where(pole, 1, wo[:, 0] / sin_o), jnp.where(pole, 0, wo[:, 1] / sin_o)
            x, y = cosine * x - sine * y, sine * x + cosine * y
        length = jnp.sqrt(jnp.maximum(x**2 + y**2 + z**2, _TINY))
        up = jnp.where(wo[:, 2] > 0, jnp.ones_like(sin_o), 0)
        strength = strength.reshape(len(self.weight), self.lobes, len(wo))
        return LobeMixture(jnp.stack([x, y, z]) / length, jnp.exp(scale), strength * up, diffuse * up)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """BRDF x cosine of wi in 1/sr, reconstructed from the lobes. It is zero below the horizon."""
        batch = wo.shape[:-1]
        value = self.lookup(wo.reshape(-1, 3)).evaluate(wi.reshape(-1, 3))
        return value.T.reshape(*batch, len(self.weight))

    def value(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the lobes in 1/sr: without the cosine of wi, which counts as at least 0.001."""
        return self(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


@jit
def _mean(table: LobeBrdf, weight: Float[Array, " m"]) -> LobeBrdf:
    """Mean of the lobes, by weights of sum one, along the first parameter axis of a table, which is removed."""
    if weight.shape != table.scale.shape[1:2]:
        raise ValueError(f"weights must be one for each of {table.scale.shape[1]} BRDFs, got {list(weight.shape)}")
    # w = sum_h a_h w_h, (m, log k) = sum_h a_h w_h (m_h, log k_h) / w for weights a. An entry in which the lobe has
    # zero weight does not affect directions and widths.
    weight = weight.reshape(-1, *[1] * (table.scale.ndim - 2))
    part = jnp.maximum(weight * jnp.sum(table.weight, 0), 0) + _TINY
    part = part / jnp.sum(part, 1, keepdims=True)
    place, strength = jnp.sum(table.mean * part, 2), jnp.sum(table.weight * weight, 2)
    scale, diffuse = jnp.sum(table.scale * part, 1), jnp.sum(table.diffuse * weight, 1)
    return LobeBrdf(place, scale, strength, diffuse, table.knot[1:], table.error)


def tabulate(
    brdf: Callable,
    *,
    lobes: int | None = None,
    error: float | None = None,
    resolution: int = 32,
    knot: Sequence[np.ndarray] = (),
) -> LobeBrdf:
    """Fits lobes to BRDF x cosine for all views.

    At each view node, EM fits lobes to samples on arcs around the mirror direction. All nodes start with the same
    arrangement of lobes in terms of half vectors. Between rounds of EM each node is averaged with its neighbors, so
    that corresponding lobes of adjacent nodes can be interpolated; neighbors along a BRDF parameter are averaged too,
    relative to the width of their lobes. Half of the lobes (three quarters of fewer than six) are at most about 0.7
    times as wide as a single lobe would be, so that they resolve light and visibility that vary over the BRDF's lobe.
    The others may be wider, to fit the tails of sharp BRDFs. The diffuse part is at most as bright as the BRDF's median
    over directions of light. The reflected energy of each node is preserved. The last
    node of an isotropic table is half a degree above the horizon and used as if it were on it.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions: a model or any function. With `knot`, a
            function of the parameters that returns such a BRDF.
        lobes: Number of lobes. Give either `lobes` or `error`.
        error: Largest error of the table, see `LobeBrdf`. The number of lobes is the smallest tried that meets it.
        resolution: Number of view angle nodes. Anisotropic BRDFs have maps with half this edge.
        knot: Increasing values of each BRDF parameter, of which there are one or two, for a BRDF that varies over the
            surface. For parameters of which lobe widths are a power, such as roughness or an exponent, use the
            logarithm as parameter, because logarithms of widths are interpolated linearly.

    Returns:
        The table, with its measured error.

    Raises:
        ValueError: Neither or both of `lobes` and `error` are given, an option is out of range, knots do not increase,
            32 lobes do not meet the error, or the BRDF returns values that are negative or not finite.

    Reference: Sun et al. 2007, section 4.1, with free lobes instead of fixed ones.
    """
    if (lobes is None) == (error is None):
        raise ValueError(f"give either lobes or error, got lobes={lobes} and error={error}")
    _check_options(lobes, error, resolution)
    if (lobes is not None and not lobes >= 1) or (error is not None and not error > 0) or resolution < 4:
        raise ValueError(
            f"tabulate needs at least one lobe or an error above 0, and a resolution of at least 4, "
            f"got lobes={lobes}, error={error} and resolution={resolution}"
        )
    grid.check_family(brdf, knot)
    knots = grid.check_knots(knot)
    models = [
        grid.as_argument(brdf(*map(jnp.asarray, point)) if knots else brdf) for point in itertools.product(*knots)
    ]
    isotropic = all(is_isotropic(model) for model in models)
    points = itertools.product(*knots)
    both = [_samples(model, resolution, isotropic, point) for model, point in zip(models, points, strict=True)]
    wo, samples = both[0][0], [sample for _, sample in both]
    reached = np.inf
    for count in _COUNTS if lobes is None else (lobes,):
        tables = _tables(samples, wo, tuple(map(len, knots)), lobes=count)
        result = _stack(tables, knots, wo.shape[:-1])
        reached = max(
            float(_natural_error(b, _stack([t], (), wo.shape[:-1]))) for b, t in zip(models, tables, strict=True)
        )
        if error is None or reached <= error:
            return eqx.tree_at(lambda x: x.error, result, jnp.asarray(reached, wo.dtype))
    raise ValueError(f"error must be at least {reached:.3g}, which {_COUNTS[-1]} lobes reach; got {error}")


def _check_options(lobes: int | None, error: float | None, resolution: int) -> None:
    """Refuses options of other kinds, and numbers of lobes or nodes that no machine holds."""
    if lobes is not None:
        require.count("lobes", lobes, least=-1, most=1 << 10)
    if error is not None:
        require.number("error", error, -1.0)
    require.count("resolution", resolution, least=-1, most=1 << 12)


def brdf_samples(brdf: Callable, *, resolution: int) -> tuple[Float[Array, "*q 3"], tuple[Array, ...]]:
    """Views at the nodes of a table, and samples of a BRDF for each; see `jaxprt.systems.lobe.em.samples`."""
    brdf = grid.as_argument(brdf)
    return _samples(brdf, resolution, is_isotropic(brdf), ())


def _samples(brdf: Callable, resolution: int, isotropic: bool, point: tuple) -> tuple[Array, tuple[Array, ...]]:
    wo = _nodes(resolution, isotropic)
    result = em.samples(brdf, wo.reshape(-1, 3))
    _check(result[0], result[1], wo.reshape(-1, 3), point)
    return jax.device_put(wo), result


def _stack(tables: list, knots: tuple, nodes: tuple[int, ...]) -> LobeBrdf:
    """One table from those of all parameter values. Gray tables are repeated to the colors of the others."""
    size = tuple(map(len, knots))
    colors = max(len(table[2]) for table in tables)

    def stack(index: int, lead: int) -> Array:
        arrays = [np.asarray(table[index]) for table in tables]
        arrays = [np.broadcast_to(array, (colors, *array.shape[1:])) if index > 1 else array for array in arrays]
        whole = np.stack(arrays, lead)
        return jax.device_put(whole.reshape(*whole.shape[:lead], *size, *nodes))

    dtype = tables[0][0].dtype
    knot = tuple(jnp.asarray(values, dtype) for values in knots)
    return LobeBrdf(stack(0, 2), stack(1, 1), stack(2, 2), stack(3, 1), knot, jnp.asarray(jnp.nan, dtype))


def _tables(samples: list[tuple[Array, ...]], wo: Array, size: tuple[int, ...], *, lobes: int) -> list[tuple]:
    """Means, logarithms of concentrations, weights and diffuse albedos of each BRDF at the view nodes `wo` [*q 3]."""
    nodes, view = wo.shape[:-1], np.asarray(wo).reshape(-1, 3)
    state = [_begin(view, sample, mass, lobes=lobes) for sample, mass, _, _ in samples]
    lobe, weight = [knot[1] for knot in state], [knot[3] for knot in state]
    most = [em.most_diffuse(*sample[1:]) for sample in samples]
    # EM runs for one BRDF at a time; smoothing is along the parameters too, which have `size` knots.
    for times, smoothing in _ROUNDS:
        for number, (sample, _, fixed, extent) in enumerate(samples):
            gray, _, least, _ = state[number]
            for _ in range(times):
                lobe[number], weight[number] = em.improve(
                    sample, gray, extent, lobe[number], least, fixed, weight[number], steps=_STEPS
                )
                weight[number] = jnp.minimum(weight[number], jnp.sum(most[number], 1, keepdims=True))
        if smoothing:
            lobe = _smooth(view, lobe, jnp.asarray(smoothing, wo.dtype), size, nodes)
    return [
        _end(one, em.weigh(sample, mass, extent, one, fixed, base, bound), nodes=nodes)
        for one, base, bound, (sample, mass, fixed, extent) in zip(lobe, weight, most, samples, strict=True)
    ]


def _smooth(
    view: np.ndarray, lobe: list[mixture.Mixture], smoothing: Array, size: tuple[int, ...], nodes: tuple[int, ...]
) -> list[mixture.Mixture]:
    """The lobes of all BRDFs, each moved towards its neighbors along the parameters and the view."""
    if not size:
        return [em.blend(view, lobe[0], smoothing, nodes=nodes)]
    stack = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves]), *lobe)
    views = np.tile(view, (len(lobe), 1))
    stack = em.blend(views, stack, smoothing, nodes=(*size, *nodes), parameters=len(size))
    split = [np.split(np.asarray(leaf), len(lobe)) for leaf in jax.tree.leaves(stack)]
    return [jax.tree.unflatten(jax.tree.structure(stack), leaves) for leaves in zip(*split, strict=True)]


@partial(jit, static_argnames=("lobes",))
def _begin(wo: Array, sample: Array, mass: Array, *, lobes: int) -> tuple[Array, mixture.Mixture, Array, Array]:
    """Initial state of EM: mass summed over colors, lobes, their concentration bounds, weight of the diffuse part."""
    gray = jnp.sum(mass, -1)
    lobe, least = em.start(wo, sample, gray, lobes=lobes)
    return gray, lobe, least, jnp.sum(gray, 1, keepdims=True) / 2


@partial(jit, static_argnames=("nodes",))
def _end(lobe: mixture.Mixture, weight: Array, *, nodes: tuple[int, ...]) -> tuple[Array, Array, Array, Array]:
    """The arrays of a table from the lobes that EM found at the view nodes."""
    mean = jnp.moveaxis(lobe.mean, (0, 2), (2, 0)).reshape(3, -1, *nodes)
    weight = weight.reshape(*weight.shape[:2], *nodes)
    return mean, jnp.log(lobe.concentration).T.reshape(-1, *nodes), weight[:, :-1], weight[:, -1]


def _nodes(resolution: int, isotropic: bool) -> Float[np.ndarray, "*q 3"]:
    """View directions at the nodes. The last ones lie slightly above the horizon, where a BRDF has no value."""
    if not isotropic:
        return np.asarray(hemisphere.parabolic_texel_direction(resolution=resolution // 2))
    radius = np.minimum(np.linspace(0, 1, resolution), 1 - 0.25 / resolution)
    wo = np.stack([2 * radius, 0 * radius, 1 - radius**2], -1) / (1 + radius**2)[:, None]
    return wo.astype(jnp.result_type(float))


def is_isotropic(brdf: Callable) -> bool:
    """Whether a BRDF is isotropic: rotates a few hundred random pairs of directions about the normal and compares."""
    height, angle, turn = np.split(np.random.default_rng(0).uniform(size=(5, 256)), [2, 4])
    height, angle = 0.05 + 0.95 * height, 2 * np.pi * angle
    angle = np.concatenate([angle, angle + 2 * np.pi * turn], 1)
    radius, height = np.sqrt(1 - height**2), np.tile(height, 2)
    wi, wo = np.stack([np.tile(radius, 2) * np.cos(angle), np.tile(radius, 2) * np.sin(angle), height], -1)
    dtype = jnp.result_type(float)
    value = np.split(np.asarray(_values(brdf, wi.astype(dtype), wo.astype(dtype))), 2)
    with np.errstate(invalid="ignore", over="ignore"):  # values that are not finite are refused elsewhere
        return bool(np.linalg.norm(value[0] - value[1]) <= 1e-2 * np.linalg.norm(value[0]))


@eqx.filter_jit
def _values(brdf: Callable, wi: Array, wo: Array) -> Array:
    return brdf(wi, wo)


def measured_error(brdf: Callable, table: LobeBrdf) -> float:
    """Relative L2 error of radiance under light of natural spectrum, for a table without parameters; see `LobeBrdf`."""
    return float(_natural_error(grid.as_argument(brdf), table))


@jit
def _natural_error(brdf: Callable, table: LobeBrdf) -> Float[Array, ""]:
    """Relative L2 error of radiance under light of natural spectrum, for a table without parameters."""
    random = np.random.default_rng(1).uniform(size=(2, 24))
    height, angle = 0.05 + 0.95 * random[0], 2 * np.pi * random[1]
    radius = np.sqrt(1 - height**2)
    wo = jnp.asarray(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1), table.scale.dtype)

    def one(view):
        wi, area = hemisphere.arcs(em.mirror(view), rings=em.RINGS, sectors=em.SECTORS)
        view = jnp.broadcast_to(view, wi.shape)
        exact = brdf(wi, view) * jnp.maximum(wi[:, 2:], 0)
        both = jnp.concatenate([table(wi, view) - exact, exact + jnp.zeros_like(table(wi, view))], 1)
        reflected = harmonics.evaluate(wi, degree=_DEGREE).T @ (both * area[:, None])
        return harmonics.convolve(reflected, harmonics.natural(degree=_DEGREE)) ** 2

    wrong, whole = jnp.split(jnp.sum(jax.lax.map(one, wo), (0, 1)), 2)
    return jnp.sqrt(jnp.sum(wrong) / jnp.maximum(jnp.sum(whole), _TINY))


def _check(direction: Array, mass: Array, wo: np.ndarray, point: tuple) -> None:
    """Refuses BRDF values that are negative or not finite, and reports the first pair of directions."""
    value = np.asarray(mass)
    wrong = np.argwhere(~(np.isfinite(value) & (value >= 0)))
    if wrong.size:
        view, sample, _ = wrong[0]
        at = f" at parameters {tuple(map(float, point))}" if point else ""
        raise ValueError(
            f"the BRDF must be finite and not negative{at}, got {len(wrong)} pairs of directions where it is not, the "
            f"first is wi = {np.asarray(direction)[view, sample]}, wo = {wo[view]}"
        )


@jit
def traced_share(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Share of a lobe that is traced by rays: 0 for wide lobes, 1 for narrow ones, with a smooth step between."""
    return _step(concentration, WIDE, NARROW)


@jit
def traced_visibility(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Share of a lobe whose visibility is that of rays: 0 for wide lobes, 1 for very narrow ones, with a smooth step.

    Stored visibility counts for the rest of the lobe. Light varies within lobes that are not very narrow, so that a few
    rays do not tell how much of it arrives.
    """
    return _step(concentration, *_VERY_NARROW)


def _step(concentration: Float[Array, "*b"], wide: float, narrow: float) -> Float[Array, "*b"]:
    place = jnp.clip(jnp.log(concentration / wide) / math.log(narrow / wide), 0, 1)
    return place**2 * (3 - 2 * place)


class _Entry(NamedTuple):
    """Entries of a table of lobes, one for each view: means, logarithms of concentrations, weights, diffuse albedos."""

    mean: Float[Array, "v 3 l"]
    scale: Float[Array, "v l"]
    weight: Float[Array, "v c l"]
    diffuse: Float[Array, "v c"]


def _entries_between(row: Float[Array, " r *q"], knot: list, axis: list, *, lobes: int) -> _Entry:
    """Interpolates rows of a table for views with their own parameters: between knots first, then between nodes."""
    sizes = row.shape[1:]
    place, share = [], []
    # `knot` and `axis` have the index of the lower knot or node and the weight of the upper one, for each view.
    for corner in itertools.product((0, 1), repeat=len(axis)):
        pairs = list(zip(corner, axis, strict=True))
        share.append(math.prod((upper if up else 1 - upper for up, (_, upper) in pairs), start=jnp.ones((), row.dtype)))
        for knots in itertools.product((0, 1), repeat=len(knot)):
            index = jnp.zeros((), jnp.int32)
            for up, size, (low, _) in zip((*knots, *corner), sizes, (*knot, *axis), strict=True):
                index = index * size + low + up
            place.append(index)
    # All rows of a node are read at once, in a program of their own: XLA vectorizes CPU code only without gathers.
    read = _read_rows(row.reshape(len(row), -1).T, tuple(place))
    return _interpolate(read, tuple(upper for _, upper in knot), tuple(share), lobes=lobes)


@partial(isolated, static=("lobes",))
def _interpolate(read: tuple[Array, ...], upper: tuple[Array, ...], share: tuple[Array, ...], *, lobes: int) -> _Entry:
    """Entries at all knots and nodes, interpolated: `upper` between knots, and in the given shares between nodes."""
    entry, knots, parts = [_entry(row, lobes=lobes) for row in read], 1 << len(upper), []
    for node, part in enumerate(share):
        at_knots = entry[node * knots : (node + 1) * knots]
        for weight in reversed(upper):
            pairs = zip(at_knots[::2], at_knots[1::2], strict=True)
            at_knots = [_between_knots(low, high, weight) for low, high in pairs]
        shares = jax.tree.map(lambda value, part=part: value * part.reshape(-1, *[1] * (value.ndim - 1)), at_knots[0])
        parts.append(shares)
    return reduce(partial(jax.tree.map, jnp.add), parts)


@isolated
def _read_rows(row: Float[Array, "q r"], place: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(row.at[index].get(mode="promise_in_bounds") for index in place)


def _entry(row: Float[Array, "v r"], *, lobes: int) -> _Entry:
    """One entry from all its rows."""
    colors = (row.shape[1] - 4 * lobes) // (lobes + 1)
    mean, scale, weight, diffuse = jnp.split(row, (3 * lobes, 4 * lobes, (4 + colors) * lobes), 1)
    return _Entry(mean.reshape(-1, 3, lobes), scale, weight.reshape(-1, colors, lobes), diffuse)


def _between_knots(low: _Entry, high: _Entry, upper: Float[Array, " v"]) -> _Entry:
    """Entries interpolated between two knots by the formula of `_mean`."""
    strength = [
        jnp.maximum(share[:, None] * jnp.sum(entry.weight, 1), 0) + _TINY
        for share, entry in ((1 - upper, low), (upper, high))
    ]
    strong = strength[1] / (strength[0] + strength[1])
    weight = strong[:, None], strong, upper[:, None, None], upper[:, None]
    return _Entry(*(a + (b - a) * part for a, b, part in zip(low, high, weight, strict=True)))
