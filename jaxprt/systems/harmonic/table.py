"""The harmonic form of a BRDF: f times cosine in spherical harmonics of the light, tabulated over the view direction.

    f*(s, v) = f(s, v) max(0, s_z) = sum_i c_i(v) y_i(s),        c_i(v) = ∫ y_i(s) f*(s, v) ds

as published by Kautz, Sloan and Snyder (2002), with one or two further parameters of the BRDF where it varies over a
surface. An isotropic BRDF is tabulated over the view angle alone: for a view at azimuth phi its coefficients are those
at azimuth 0, rotated about z by phi.
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

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.sphere import harmonics, hemisphere, rotation

# Rings and sectors of the quadrature, one after the other until the error is reached; the last is for judging alone.
_RULES = ((24, 96), (32, 160), (48, 320), (64, 640), (96, 960))
_ANGLES = (48, 96, 192, 384, 768)  # nodes of the view angle that are tried
_EDGES = (16, 32, 64, 128)  # edges of maps that are tried
_ERROR = 1e-3  # asked for where nothing is said
_WORTHWHILE = 0.8  # A finer table must have at most this share of the error, or finer ones still are not tried.
_ISOTROPIC = 1e-4  # Rotated coefficients of sharp BRDFs agree so well in float32.
_PROBES = 48  # views at which errors are measured
_BATCH = 16  # views integrated at once
_TINY = 1e-12


class HarmonicBrdf(eqx.Module):
    """A BRDF times cosine as SH coefficients of the light direction, tabulated over the view direction.

    Attributes:
        table: Coefficients in l(l+1)+m order, gray or one per color. Axes after these two follow the parameters. The
            last axis, or the last two, are nodes of the view: tables of isotropic BRDFs are over tan(theta / 2) from
            the normal to the horizon, at azimuth 0; others are parabolic maps.
        knot: Increasing values of each parameter at which the table was made; none where the BRDF does not vary.
        error: Relative L2 error of the coefficients that are looked up, over some fifty views that are evenly spread in
            height and not nodes of the table; of a BRDF that varies the largest, at the knots and halfway between
            them. NaN where it is not known. Views that graze the surface may have several times it.
    """

    holds_cosine: ClassVar = True  # Values are the BRDF times the cosine.

    table: Float[Array, "lm c *q"]
    knot: tuple[Float[Array, " _"], ...]
    error: Float[Array, ""]

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return harmonics.degree_of(self.table.shape[0])

    @property
    def isotropic(self) -> bool:
        """Whether the table is over the view angle alone."""
        return self.table.ndim - len(self.knot) == 3

    @property
    def steps(self) -> float:
        """Nodes for one unit of tan(theta / 2), in the table of an isotropic BRDF."""
        resolution = self.table.shape[-1]
        return (resolution - 1) / _outermost(resolution)

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return self.table.nbytes

    def truncate(self, *, degree: int) -> "HarmonicBrdf":
        """The table with fewer bands; its error is no longer known and reads NaN where bands were dropped."""
        if not 0 <= degree <= self.degree:
            raise ValueError(f"degree must be between 0 and the table's {self.degree}, got {degree}")
        error = self.error if degree == self.degree else jnp.full_like(self.error, jnp.nan)
        return HarmonicBrdf(self.table[: (degree + 1) ** 2], self.knot, error)

    def coefficients(self, wo: Float[Array, "v 3"], *parameter: Float[Array, " v"]) -> Float[Array, "lm c v"]:
        """Coefficients c_i(wo), linearly between nodes of the view and between knots of each parameter.

        Zero below the horizon. Parameters outside their knots count as the nearest knot. Differentiable in the view,
        the normal included.

        Raises:
            ValueError: The number of parameters is not that of the table.
        """
        if len(parameter) != len(self.knot):
            raise ValueError(f"the table has {len(self.knot)} parameters, got {len(parameter)}")
        resolution = self.table.shape[-1]
        # At the normal the azimuth is undefined; there (x, y) / sin_o is 0, as all orders but m = 0 are.
        sin_o = jnp.sqrt(wo[:, 0] ** 2 + wo[:, 1] ** 2 + _TINY)
        if self.isotropic:
            place = [sin_o / (1 + jnp.maximum(wo[:, 2], 0)) * self.steps]
        else:
            spot = hemisphere.parabolic_coordinates(wo) * resolution - 0.5
            place = [spot[:, 1], spot[:, 0]]
        axis = [
            grid.neighbors(grid.place(knot, each), size=len(knot))
            for knot, each in zip(self.knot, parameter, strict=True)
        ] + [grid.neighbors(each, size=resolution) for each in place]
        value = grid.read(self.table.reshape(-1, *self.table.shape[2:]), axis) * (wo[:, 2] > 0)
        value = value.reshape(*self.table.shape[:2], len(wo))
        return rotation.about_z(value, wo[:, 0] / sin_o, wo[:, 1] / sin_o) if self.isotropic else value

    def __call__(
        self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"], *parameter: Float[Array, "*b"]
    ) -> Float[Array, "*b c"]:
        """Value of the BRDF times the cosine of wi in 1/sr, as far as the harmonics carry it; may be negative.

        Not zero below the horizon of wi, where the sum rings about zero.
        """
        batch = wo.shape[:-1]
        basis = harmonics.evaluate(wi.reshape(-1, 3), degree=self.degree)
        row = self.coefficients(wo.reshape(-1, 3), *(each.reshape(-1) for each in parameter))
        return jnp.einsum("vi,icv->vc", basis, row, precision="highest").reshape(*batch, row.shape[1])


def tabulate(
    brdf: Callable,
    *,
    degree: int = 4,
    error: float | None = None,
    resolution: int | None = None,
    knot: Sequence[np.ndarray] = (),
) -> HarmonicBrdf:
    """Tabulates a BRDF times cosine in spherical harmonics.

    Tables of BRDFs that are isotropic, as far as these harmonics tell, are over the view angle alone; others are maps.

    Args:
        brdf: A BRDF (wi, wo) -> value [*b c] in 1/sr, a model or any function; with `knot` a function of the
            parameters that makes one.
        degree: Highest degree of the harmonics: 4 for the 25 coefficients of the paper.
        error: Largest error of the table, see `HarmonicBrdf`; 1e-3 if neither it nor a resolution is given. Warns if
            the table misses it.
        resolution: Nodes of the view angle, or edge of the parabolic map of an anisotropic BRDF. If None, as many as
            the error needs, up to 768 nodes or an edge of 128.
        knot: For a BRDF that varies, the increasing values of each of its one or two parameters.

    Returns:
        The table, with the error that was measured.

    Raises:
        ValueError: An option is out of range, knots do not increase, or the BRDF has values that are not finite or
            no axis for colors.

    Reference: Kautz, Sloan, Snyder 2002, section 3.
    """
    wanted = _ERROR if error is None else error
    if not 0 <= degree <= 50 or (resolution is not None and resolution < 2) or not wanted > 0:
        raise ValueError(
            "tabulate needs a degree of 0 to 50, a resolution of at least 2 and an error above 0, "
            f"got {degree}, {resolution} and {error}"
        )
    knots = grid.checked(knot)
    points = list(itertools.product(*knots))
    halfway = list(itertools.product(*((each[1:] + each[:-1]) / 2 for each in knots))) if knots else []
    made, between = (
        [grid.as_argument(brdf(*map(jnp.asarray, each)) if knots else brdf) for each in every]
        for every in (points, halfway)
    )
    # A middle and the extreme parameters stand for all where the number of nodes is chosen.
    rule, finer, quadrature = _choose_rule(
        [made[i] for i in sorted({0, len(made) // 2, len(made) - 1})], degree, wanted
    )
    isotropic = all(_is_isotropic(each, max(wanted / 2, _ISOTROPIC), degree, rule) for each in made)
    wo = _probe_views()
    truth, further = ([_project(each, wo, degree, finer) for each in every] for every in (made, between))
    sizes = (_ANGLES if isotropic else _EDGES) if resolution is None else (resolution,)
    known: list[tuple[float, HarmonicBrdf]] = []
    for size in sizes:
        # Linear interpolation has an error of second order: a size that is far from enough is not tried.
        if known and 2 * wanted * (size / known[-1][1].table.shape[-1]) ** 2 < known[-1][0] and size != sizes[-1]:
            continue
        table = _table(made, points, knots, _nodes(size, isotropic), degree, rule)
        known.append((_missed(table, wo, points, truth), table))
        if known[-1][0] <= wanted or (len(known) > 1 and not known[-1][0] <= _WORTHWHILE * known[-2][0]):
            break
    by_view, table = known[-1]
    reached = max([by_view, _missed(table, wo, halfway, further)], key=lambda each: (np.isnan(each), each))
    if (error is not None or resolution is None) and not reached <= wanted:
        if by_view <= wanted:
            advice = "give knots that are closer to each other"
        elif quadrature > wanted / 2:
            advice = "the BRDF is too sharp for the finest quadrature"
        else:
            advice = f"give a resolution above {table.table.shape[-1]}"
        warnings.warn(
            f"the error of the table of harmonics must be at most {wanted:.3g}, and is {reached:.3g}: {advice}",
            stacklevel=2,
        )
    return eqx.tree_at(lambda each: each.error, table, jnp.asarray(reached, table.table.dtype))


@partial(jit, static_argnames=("degree", "rings", "sectors"))
def project(
    brdf: Callable, wo: Float[Array, "v 3"], *, degree: int, rings: int, sectors: int
) -> Float[Array, "lm c v"]:
    """SH coefficients of f(wi, wo) max(0, wi_z) for given views, by quadrature on arcs around the mirror direction.

    Args:
        brdf: A BRDF that is a pytree and callable, as the models are.
        wo: Unit view directions in the local frame.
        degree: Highest degree of the harmonics.
        rings: Number of nodes on an arc.
        sectors: Number of arcs.

    Returns:
        Coefficients in l(l+1)+m order; zero for views below the horizon where the BRDF is.

    Reference: Kautz, Sloan, Snyder 2002, section 3.
    """

    def one(view):
        mirror = view * jnp.array([-1, -1, 1], wo.dtype)
        wi, area = hemisphere.arcs(mirror, rings=rings, sectors=sectors)
        value = brdf(wi, jnp.broadcast_to(view, wi.shape))
        if jnp.ndim(value) != 2 or value.shape[0] != len(wi):
            raise ValueError(f"the BRDF must return [{len(wi)}, c] here, got {list(jnp.shape(value))}")
        return harmonics.evaluate(wi, degree=degree).T @ (value * jnp.maximum(wi[:, 2:], 0) * area[:, None])

    return jnp.moveaxis(jax.lax.map(one, wo, batch_size=_BATCH), 0, -1)


def _project(brdf: Callable, wo: Array, degree: int, rule: tuple[int, int]) -> np.ndarray:
    """`project` of many views, as many at once as there are probes: what was compiled for these serves again."""
    block = np.resize(wo, (-(-len(wo) // _PROBES), _PROBES, 3))
    value = [
        np.asarray(project(brdf, jnp.asarray(each), degree=degree, rings=rule[0], sectors=rule[1])) for each in block
    ]
    return np.concatenate(value, -1)[..., : len(wo)]


def _table(
    made: Sequence[Callable], points: Sequence[tuple], knots: tuple, wo: Array, degree: int, rule: tuple[int, int]
) -> HarmonicBrdf:
    """The table of some BRDFs on the nodes `wo` [*q 3], its error not yet known; gray ones are as colored as others.

    Raises:
        ValueError: A BRDF has values that are not finite.
    """
    tables = [_project(each, wo.reshape(-1, 3), degree, rule) for each in made]
    for point, table in zip(points, tables, strict=True):
        if not np.isfinite(table).all():
            at = f" at parameters {point}" if point else ""
            raise ValueError(f"the BRDF must be finite for all directions above the horizon, and is not{at}")
    colors, dtype = max(table.shape[1] for table in tables), tables[0].dtype
    every = np.stack([np.broadcast_to(each, (len(each), colors, each.shape[2])) for each in tables], 2)
    value = every.reshape(len(every), colors, *map(len, knots), *wo.shape[:-1])
    knot = tuple(jnp.asarray(each, dtype) for each in knots)
    return HarmonicBrdf(jax.device_put(value), knot, jax.device_put(np.asarray(np.nan, dtype)))


def _missed(table: HarmonicBrdf, wo: Array, points: Sequence[tuple], truth: Sequence[np.ndarray]) -> float:
    """Largest relative error of what is looked up at some parameters."""
    error = [0.0]
    for point, expected in zip(points, truth, strict=True):
        value = np.asarray(_looked_up(table, wo, tuple(jnp.full(len(wo), each, wo.dtype) for each in point)))
        error.append(_difference(value, np.broadcast_to(expected, value.shape)))
    return float(np.max(error))


@jit
def _looked_up(table: HarmonicBrdf, wo: Array, parameter: tuple[Array, ...]) -> Array:
    return table.coefficients(wo, *parameter)


def _difference(value: np.ndarray, expected: np.ndarray) -> float:
    """Relative L2 difference."""
    return float(np.linalg.norm(value - expected) / max(np.linalg.norm(expected), np.finfo(expected.dtype).tiny))


def _outermost(resolution: int) -> float:
    """tan(theta / 2) of the last node: a quarter of a step above the horizon, where a BRDF has no value."""
    return 1 - 0.25 / resolution


def _nodes(resolution: int, isotropic: bool) -> Float[Array, "*q 3"]:
    """View directions of the nodes of a table."""
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
    """Views at which errors are measured: evenly spread in height, their azimuths by the golden angle."""
    number = np.arange(_PROBES)
    return _views((number + 0.5) / _PROBES, number * np.pi * (3 - np.sqrt(5)))


def _is_isotropic(brdf: Callable, error: float, degree: int, rule: tuple[int, int]) -> bool:
    """Whether coefficients at some azimuths are those at azimuth 0, rotated about z."""
    number = np.arange(_PROBES // 2)
    height, angle = (number + 0.5) / len(number), 1 + number * np.pi * (3 - np.sqrt(5))
    both = jnp.concatenate([_views(height, 0 * angle), _views(height, angle)])
    straight, turned = np.split(_project(brdf, both, degree, rule), 2, -1)
    cosine, sine = (jnp.asarray(each(angle), straight.dtype) for each in (np.cos, np.sin))
    return _difference(np.asarray(rotation.about_z(jnp.asarray(straight), cosine, sine)), turned) <= error


def _choose_rule(
    brdfs: Sequence[Callable], degree: int, error: float
) -> tuple[tuple[int, int], tuple[int, int], float]:
    """Rings and sectors that reach half an error, the next finer ones that judge them, and the error reached."""
    wo = _probe_views()

    def integrals(rule):
        return [_project(each, wo, degree, rule) for each in brdfs]

    rule, finer, reached, coarse = _RULES[0], _RULES[1], np.inf, integrals(_RULES[0])
    for finer in _RULES[1:]:
        fine = integrals(finer)
        reached = max(_difference(a, b) for a, b in zip(coarse, fine, strict=True))
        if not reached > error / 2 or finer == _RULES[-1]:  # No rule helps what is NaN.
            break
        rule, coarse = finer, fine
    return rule, finer, reached
