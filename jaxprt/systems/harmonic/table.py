"""BRDF x cosine in spherical harmonics of the light direction, tabulated over the view direction.

    f*(s, v) = f(s, v) max(0, s_z) = sum_i c_i(v) y_i(s),        c_i(v) = ∫ y_i(s) f*(s, v) ds

as published by Kautz, Sloan and Snyder (2002). The table may have one or two more axes, for BRDF parameters that vary
over a surface. An isotropic BRDF is tabulated over the view angle only: its coefficients for a view at azimuth phi are
those at azimuth 0, rotated about z by phi.
"""

import itertools
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.sphere import harmonics, hemisphere, rotation

# Rings and sectors of the quadrature, tried in this order until the error is met. The last one only measures errors.
_RULES = ((24, 96), (32, 160), (48, 320), (64, 640), (96, 960))
_ANGLES = (48, 96, 192, 384, 768)  # numbers of view angle nodes, tried in this order
_EDGES = (16, 32, 64, 128)  # edges of parabolic maps, tried in this order
_ERROR = 1e-3  # default error
_WORTHWHILE = 0.8  # Refinement stops when a finer table has more than this share of the coarser one's error.
_ISOTROPIC = 1e-4  # relative difference of rotated coefficients that float32 rounding causes for sharp BRDFs
_PROBES = 48  # number of views at which errors are measured
_BATCH = 16  # number of views integrated at once
_TINY = 1e-12


class HarmonicBrdf(eqx.Module):
    """BRDF x cosine as SH coefficients of the light direction, tabulated over the view direction.

    Attributes:
        table: SH coefficients in l(l+1)+m order, then gray or colors, then one axis per BRDF parameter, then nodes of
            the view direction. Isotropic tables have one axis of nodes, at even steps of tan(theta / 2) from the normal
            to the horizon and azimuth 0. Anisotropic tables have two, of a parabolic map.
        knot: Increasing values of each BRDF parameter at which the table has entries; empty without parameters.
        error: Relative L2 error of interpolated coefficients over about fifty views between the nodes, spread evenly in
            cos(theta). With parameters it is the largest error at and halfway between the knots. NaN if unknown.
            Grazing views may have several times this error.
    """

    holds_cosine: ClassVar = True  # values include the cosine of the light direction

    table: Float[Array, "lm c *q"]
    knot: tuple[Float[Array, " _"], ...]
    error: Float[Array, ""]

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return harmonics.degree_of(self.table.shape[0])

    @property
    def isotropic(self) -> bool:
        """Whether the table depends on the view angle only, not on the azimuth."""
        return self.table.ndim - len(self.knot) == 3

    @property
    def steps(self) -> float:
        """Number of nodes per unit of tan(theta / 2), for an isotropic table."""
        resolution = self.table.shape[-1]
        return (resolution - 1) / _outermost(resolution)

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return self.table.nbytes

    def truncate(self, *, degree: int) -> "HarmonicBrdf":
        """The table with the bands up to `degree`. If bands are dropped, its error is unknown and set to NaN."""
        if not 0 <= degree <= self.degree:
            raise ValueError(f"degree must be between 0 and the table's {self.degree}, got {degree}")
        error = self.error if degree == self.degree else jnp.full_like(self.error, jnp.nan)
        return HarmonicBrdf(self.table[: (degree + 1) ** 2], self.knot, error)

    def coefficients(self, wo: Float[Array, "v 3"], *parameter: Float[Array, " v"]) -> Float[Array, "lm c v"]:
        """SH coefficients c_i(wo), interpolated linearly between view nodes and between the knots of each parameter.

        They are zero for views below the horizon. Parameters are clamped to the range of their knots. Differentiable in
        the view direction, also at the normal.

        Args:
            wo: Unit directions to the viewer in the local frame.
            parameter: Values of each BRDF parameter for these views.
        """
        if len(parameter) != len(self.knot):
            needed = f"{len(self.knot)} parameters, got {len(parameter)}"
            raise ValueError(f"the table needs {needed}; a system takes them in its materials, as `Blend.parameter`")
        resolution = self.table.shape[-1]
        # At the normal the azimuth is undefined. There (x, y) / sin_o is 0, and so are all coefficients except m = 0.
        sin_o = jnp.sqrt(wo[:, 0] ** 2 + wo[:, 1] ** 2 + _TINY)
        if self.isotropic:
            place = [sin_o / (1 + jnp.maximum(wo[:, 2], 0)) * self.steps]
        else:
            spot = hemisphere.parabolic_coordinates(wo) * resolution - 0.5
            place = [spot[:, 1], spot[:, 0]]
        axis = grid.among(self.knot, parameter) + [grid.neighbors(spot, size=resolution) for spot in place]
        value = grid.read(self.table.reshape(-1, *self.table.shape[2:]), axis) * (wo[:, 2] > 0)
        value = value.reshape(*self.table.shape[:2], len(wo))
        return rotation.about_z(value, wo[:, 0] / sin_o, wo[:, 1] / sin_o) if self.isotropic else value

    def __call__(
        self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"], *parameter: Float[Array, "*b"]
    ) -> Float[Array, "*b c"]:
        """BRDF x cosine of wi in 1/sr, reconstructed from the harmonics.

        Ringing can make it negative, and nonzero for wi below the horizon.
        """
        batch = wo.shape[:-1]
        basis = harmonics.evaluate(wi.reshape(-1, 3), degree=self.degree)
        row = self.coefficients(wo.reshape(-1, 3), *(values.reshape(-1) for values in parameter))
        return jnp.einsum("vi,icv->vc", basis, row, precision="highest").reshape(*batch, row.shape[1])


def tabulate(
    brdf: Callable,
    *,
    degree: int = 4,
    error: float | None = None,
    resolution: int | None = None,
    knot: Sequence[np.ndarray] = (),
) -> HarmonicBrdf:
    """Tabulates BRDF x cosine in spherical harmonics.

    The table of an isotropic BRDF depends on the view angle only; that of an anisotropic one is a parabolic map.
    Whether the BRDF is isotropic is tested at a few views.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions: a model or any function. With `knot`, a
            function of the parameters that returns such a BRDF.
        degree: Highest degree of the harmonics; 4 gives the 25 coefficients of the paper.
        error: Largest error of the table; see `HarmonicBrdf`. The default is 1e-3 if `resolution` is None. A table that
            misses it causes a warning.
        resolution: Number of view angle nodes, or edge of the parabolic map of an anisotropic BRDF. If None, as many as
            the error requires, up to 768 nodes or an edge of 128.
        knot: Increasing values of each BRDF parameter, of which there are one or two, for a BRDF that varies over the
            surface.

    Returns:
        The table, with its measured error.

    Raises:
        ValueError: An option is out of range, knots do not increase, or the BRDF returns values that are not finite or
            have no color axis.

    Reference: Kautz, Sloan, Snyder 2002, section 3.
    """
    wanted = _ERROR if error is None else error
    grid.check_family(brdf, knot)
    require.count("degree", degree, least=-1)
    require.number("error", wanted, -require.LARGEST)
    if resolution is not None:
        require.count("resolution", resolution, least=-1, most=1 << 12)
    if not 0 <= degree <= 50 or (resolution is not None and resolution < 2) or not wanted > 0:
        raise ValueError(
            "tabulate needs a degree of 0 to 50, a resolution of at least 2 and an error above 0, "
            f"got degree={degree}, resolution={resolution} and error={error}"
        )
    knots = grid.check_knots(knot)
    points = list(itertools.product(*knots))
    halfway = list(itertools.product(*((values[1:] + values[:-1]) / 2 for values in knots))) if knots else []
    at_points, between = (
        [grid.as_argument(brdf(*map(jnp.asarray, point)) if knots else brdf) for point in group]
        for group in (points, halfway)
    )
    # The quadrature is chosen for the first, middle and last parameters only.
    rule, finer, quadrature = _choose_rule(
        [at_points[i] for i in sorted({0, len(at_points) // 2, len(at_points) - 1})], degree, wanted
    )
    isotropic = all(_is_isotropic(model, max(wanted / 2, _ISOTROPIC), degree, rule) for model in at_points)
    wo = _probe_views()
    truth, further = ([_project(model, wo, degree, finer) for model in group] for group in (at_points, between))
    sizes = (_ANGLES if isotropic else _EDGES) if resolution is None else (resolution,)
    known: list[tuple[float, HarmonicBrdf]] = []
    for size in sizes:
        # The error of linear interpolation is of second order. Sizes that are predicted to miss it by far are skipped.
        if known and 2 * wanted * (size / known[-1][1].table.shape[-1]) ** 2 < known[-1][0] and size != sizes[-1]:
            continue
        table = _table(at_points, points, knots, _nodes(size, isotropic), degree, rule)
        known.append((_interpolation_error(table, wo, points, truth), table))
        if known[-1][0] <= wanted or (len(known) > 1 and not known[-1][0] <= _WORTHWHILE * known[-2][0]):
            break
    by_view, table = known[-1]
    reached = max(
        [by_view, _interpolation_error(table, wo, halfway, further)], key=lambda error: (np.isnan(error), error)
    )
    if (error is not None or resolution is None) and not reached <= wanted:
        if by_view <= wanted:
            advice = "give knots that are closer to each other"
        elif quadrature > wanted / 2:
            advice = "the BRDF is too sharp for the finest quadrature"
        else:
            advice = f"give a resolution above {table.table.shape[-1]}"
        warnings.warn(
            f"the error of the table of harmonics must be at most {wanted:.3g}, got {reached:.3g}: {advice}",
            stacklevel=2,
        )
    return eqx.tree_at(lambda stored: stored.error, table, jnp.asarray(reached, table.table.dtype))


@partial(jit, static_argnames=("degree", "rings", "sectors"))
def project(
    brdf: Callable, wo: Float[Array, "v 3"], *, degree: int, rings: int, sectors: int
) -> Float[Array, "lm c v"]:
    """SH coefficients of f(wi, wo) max(0, wi_z) for given views, by quadrature on arcs around the mirror direction.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr that is a callable pytree, as the models are.
        wo: Unit directions to the viewer in the local frame.
        degree: Highest degree of the harmonics.
        rings: Number of quadrature nodes on each arc.
        sectors: Number of arcs.

    Returns:
        SH coefficients in l(l+1)+m order. They are zero for views at which the BRDF is zero.

    Reference: Kautz, Sloan, Snyder 2002, section 3.
    """

    def one(view):
        mirror = view * jnp.array([-1, -1, 1], wo.dtype)
        wi, area = hemisphere.arcs(mirror, rings=rings, sectors=sectors)
        value = brdf(wi, jnp.broadcast_to(view, wi.shape))
        if jnp.ndim(value) != 2 or value.shape[0] != len(wi):
            raise ValueError(
                f"the BRDF must return [{len(wi)}, c] for {len(wi)} directions, got {list(jnp.shape(value))}"
            )
        return harmonics.evaluate(wi, degree=degree).T @ (value * jnp.maximum(wi[:, 2:], 0) * area[:, None])

    return jnp.moveaxis(jax.lax.map(one, wo, batch_size=_BATCH), 0, -1)


def _project(brdf: Callable, wo: Array, degree: int, rule: tuple[int, int]) -> np.ndarray:
    """`project` for many views, in blocks of the number of probes, so that one compiled program serves all."""
    block = np.resize(wo, (-(-len(wo) // _PROBES), _PROBES, 3))
    value = [
        np.asarray(project(brdf, jnp.asarray(views), degree=degree, rings=rule[0], sectors=rule[1])) for views in block
    ]
    return np.concatenate(value, -1)[..., : len(wo)]


def _table(
    models: Sequence[Callable], points: Sequence[tuple], knots: tuple, wo: Array, degree: int, rule: tuple[int, int]
) -> HarmonicBrdf:
    """The table of BRDFs at the view nodes `wo` [*q 3], with an error of NaN. Gray BRDFs are repeated to all colors."""
    tables = [_project(model, wo.reshape(-1, 3), degree, rule) for model in models]
    for point, table in zip(points, tables, strict=True):
        if not np.isfinite(table).all():
            at = f" at parameters {point}" if point else ""
            raise ValueError(f"the BRDF must be finite for all directions above the horizon, got NaN or infinity{at}")
    colors, dtype = max(table.shape[1] for table in tables), tables[0].dtype
    stack = np.stack([np.broadcast_to(table, (len(table), colors, table.shape[2])) for table in tables], 2)
    value = stack.reshape(len(stack), colors, *map(len, knots), *wo.shape[:-1])
    knot = tuple(jnp.asarray(values, dtype) for values in knots)
    return HarmonicBrdf(jax.device_put(value), knot, jax.device_put(np.asarray(np.nan, dtype)))


def _interpolation_error(table: HarmonicBrdf, wo: Array, points: Sequence[tuple], truth: Sequence[np.ndarray]) -> float:
    """Largest relative error of interpolated coefficients over the given parameter values."""
    error = [0.0]
    for point, expected in zip(points, truth, strict=True):
        value = np.asarray(_look_up(table, wo, tuple(jnp.full(len(wo), value, wo.dtype) for value in point)))
        error.append(_difference(value, np.broadcast_to(expected, value.shape)))
    return float(np.max(error))


@jit
def _look_up(table: HarmonicBrdf, wo: Array, parameter: tuple[Array, ...]) -> Array:
    return table.coefficients(wo, *parameter)


def _difference(value: np.ndarray, expected: np.ndarray) -> float:
    """Relative L2 difference."""
    return float(np.linalg.norm(value - expected) / max(np.linalg.norm(expected), np.finfo(expected.dtype).tiny))


def _outermost(resolution: int) -> float:
    """tan(theta / 2) of the last node, a quarter of a step above the horizon: at the horizon a BRDF has no value."""
    return 1 - 0.25 / resolution


def _nodes(resolution: int, isotropic: bool) -> Float[Array, "*q 3"]:
    """View directions at the nodes of a table."""
    if not isotropic:
        return hemisphere.parabolic_texel_direction(resolution=resolution)
    radius = np.linspace(0, _outermost(resolution), resolution)
    wo = np.stack([2 * radius, 0 * radius, 1 - radius**2], -1) / (1 + radius**2)[:, None]
    return jnp.asarray(wo, jnp.result_type(float))


def _views(height: np.ndarray, angle: np.ndarray) -> Float[Array, "v 3"]:
    radius = np.sqrt(1 - height**2)
    wo = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    return jnp.asarray(wo, jnp.result_type(float))


def _probe_views() -> Float[Array, "v 3"]:
    """Views at which errors are measured: evenly spread in cos(theta), with azimuths in steps of the golden angle."""
    number = np.arange(_PROBES)
    return _views((number + 0.5) / _PROBES, number * np.pi * (3 - np.sqrt(5)))


def _is_isotropic(brdf: Callable, error: float, degree: int, rule: tuple[int, int]) -> bool:
    """Whether the coefficients at other azimuths equal those at azimuth 0 rotated about z, within the error."""
    number = np.arange(_PROBES // 2)
    height, angle = (number + 0.5) / len(number), 1 + number * np.pi * (3 - np.sqrt(5))
    both = jnp.concatenate([_views(height, 0 * angle), _views(height, angle)])
    straight, turned = np.split(_project(brdf, both, degree, rule), 2, -1)
    cosine, sine = (jnp.asarray(function(angle), straight.dtype) for function in (np.cos, np.sin))
    return _difference(np.asarray(rotation.about_z(jnp.asarray(straight), cosine, sine)), turned) <= error


def _choose_rule(
    brdfs: Sequence[Callable], degree: int, error: float
) -> tuple[tuple[int, int], tuple[int, int], float]:
    """Chooses a quadrature with at most half the error; returns it, the finer one that measured it, and its error."""
    wo = _probe_views()

    def integrals(rule):
        return [_project(brdf, wo, degree, rule) for brdf in brdfs]

    rule, finer, reached, coarse = _RULES[0], _RULES[1], np.inf, integrals(_RULES[0])
    for finer in _RULES[1:]:
        fine = integrals(finer)
        reached = max(_difference(a, b) for a, b in zip(coarse, fine, strict=True))
        if not reached > error / 2 or finer == _RULES[-1]:  # NaN does not improve with a finer rule.
            break
        rule, coarse = finer, fine
    return rule, finer, reached
