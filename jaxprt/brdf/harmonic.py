"""The harmonic form of a BRDF: f times cosine in spherical harmonics of the light, tabulated over the view direction.

    f*(s, v) = f(s, v) max(0, s_z) = sum_i c_i(v) y_i(s),        c_i(v) = ∫ y_i(s) f*(s, v) ds

as published by Kautz, Sloan and Snyder (2002), with one or two further parameters of the BRDF where it varies over a
surface.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.brdf import grid
from jaxprt.sphere import harmonics, hemisphere

# Rings and sectors of the quadrature, one after the other until the error is reached; the last only tells it.
_RULES = ((24, 96), (32, 160), (48, 320), (64, 640), (96, 960))
_PROBES = 48  # views at which the error of the quadrature is measured
_BATCH = 16  # views integrated at once


class HarmonicBrdf(eqx.Module):
    """A BRDF times cosine as SH coefficients of the light direction, tabulated over the view direction.

    Attributes:
        table: Coefficients in l(l+1)+m order, gray or one per color, at the texels of a parabolic map of the view
            direction; axes between follow the parameters.
        knot: Increasing values of each parameter at which the table was made; none where the BRDF does not vary.
        error: Relative L2 error of the quadrature over all coefficients of some fifty views, evenly spread in height:
            the rule that was used against the next finer one. Views that graze the surface may have several times it.
    """

    table: Float[Array, "lm c *q n n"]
    knot: tuple[Float[Array, " _"], ...]
    error: Float[Array, ""]

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return harmonics.degree_of(self.table.shape[0])

    @property
    def nbytes(self) -> int:
        """Bytes of the table."""
        return self.table.nbytes

    def truncate(self, *, degree: int) -> "HarmonicBrdf":
        """The table with fewer bands."""
        if not 0 <= degree <= self.degree:
            raise ValueError(f"degree must be between 0 and the table's {self.degree}, got {degree}")
        return HarmonicBrdf(self.table[: (degree + 1) ** 2], self.knot, self.error)

    def coefficients(self, wo: Float[Array, "v 3"], *parameter: Float[Array, " v"]) -> Float[Array, "lm c v"]:
        """Coefficients c_i(wo) by bilinear lookup, and linearly between the knots of each parameter.

        Zero below the horizon. Parameters outside their knots count as the nearest knot.

        Raises:
            ValueError: The number of parameters is not that of the table.
        """
        if len(parameter) != len(self.knot):
            raise ValueError(f"the table has {len(self.knot)} parameters, got {len(parameter)}")
        resolution = self.table.shape[-1]
        spot = hemisphere.parabolic_coordinates(wo) * resolution - 0.5
        axis = [
            grid.neighbors(grid.place(knot, each), size=len(knot))
            for knot, each in zip(self.knot, parameter, strict=True)
        ] + [grid.neighbors(spot[:, i], size=resolution) for i in (1, 0)]
        value = grid.read(self.table.reshape(-1, *self.table.shape[2:]), axis) * (wo[:, 2] > 0)
        return value.reshape(*self.table.shape[:2], len(wo))

    def __call__(
        self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"], *parameter: Float[Array, "*b"]
    ) -> Float[Array, "*b c"]:
        """Value of the BRDF times the cosine of wi in 1/sr, as far as the harmonics carry it; may be negative.

        Not zero below the horizon of wi, where the sum rings about zero.
        """
        batch = wo.shape[:-1]
        basis = harmonics.evaluate(wi.reshape(-1, 3), degree=self.degree)
        row = self.coefficients(wo.reshape(-1, 3), *(each.reshape(-1) for each in parameter))
        return jnp.einsum("vi,icv->vc", basis, row).reshape(*batch, row.shape[1])


def tabulate(
    brdf: Callable, *, degree: int = 4, resolution: int = 128, error: float = 1e-3, knot: Sequence[np.ndarray] = ()
) -> HarmonicBrdf:
    """Tabulates a BRDF times cosine in spherical harmonics.

    Args:
        brdf: A BRDF (wi, wo) -> value [*b c] in 1/sr, a model or any function; with `knot` a function of the
            parameters that makes one.
        degree: Highest degree of the harmonics: 4 for the 25 coefficients of the paper.
        resolution: Edge of the parabolic map of view directions.
        error: Largest quadrature error; four rules are tried, each finer, and what was reached is in the result.
        knot: For a BRDF that varies, the increasing values of each of its one or two parameters.

    Returns:
        The table.

    Raises:
        ValueError: An option is out of range, knots do not increase, or the BRDF has values that are not finite or
            no axis for colors.

    Reference: Kautz, Sloan, Snyder 2002, section 3.
    """
    if not 0 <= degree <= 50 or resolution < 2 or not error > 0:
        raise ValueError(
            "tabulate needs a degree of 0 to 50, a resolution of at least 2 and an error above 0, "
            f"got {degree}, {resolution} and {error}"
        )
    knots = grid.checked(knot)
    points = list(itertools.product(*knots))
    # A middle and the extreme parameters stand for all where the number of nodes is chosen.
    made = [grid.as_argument(brdf(*map(jnp.asarray, point)) if knots else brdf) for point in points]
    probes = [made[i] for i in sorted({0, len(made) // 2, len(made) - 1})]
    rings, sectors, reached = _choose_rule(probes, degree, error)
    wo = hemisphere.parabolic_texel_direction(resolution=resolution).reshape(-1, 3)
    tables = [_in_blocks(each, wo, degree=degree, rings=rings, sectors=sectors) for each in made]
    for point, table in zip(points, tables, strict=True):
        if not bool(jnp.all(jnp.isfinite(table))):
            at = f" at parameters {point}" if point else ""
            raise ValueError(f"the BRDF must be finite for all directions above the horizon, and is not{at}")
    colors, dtype = max(table.shape[1] for table in tables), tables[0].dtype
    tables = [jnp.broadcast_to(table, (table.shape[0], colors, table.shape[2])) for table in tables]
    shape = ((degree + 1) ** 2, colors, *map(len, knots), resolution, resolution)
    return HarmonicBrdf(
        jnp.stack(tables, 2).reshape(shape),
        tuple(jnp.asarray(each, dtype) for each in knots),
        jnp.asarray(reached, dtype),
    )


@partial(jax.jit, static_argnames=("degree", "rings", "sectors"))
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


def _in_blocks(brdf: Callable, wo: Float[Array, "v 3"], **rule: int) -> Float[Array, "lm c v"]:
    """`project` of many views, as many at once as there are probes: what was compiled for these serves again."""
    block = np.resize(wo, (-(-len(wo) // _PROBES), _PROBES, 3))
    value = [np.asarray(project(brdf, jnp.asarray(each), **rule)) for each in block]
    return jnp.asarray(np.concatenate(value, -1)[..., : len(wo)])


def _choose_rule(brdfs: Sequence[Callable], degree: int, error: float) -> tuple[int, int, float]:
    """Numbers of rings and sectors that reach an error, told by the next finer rule, and the error."""
    random = np.random.default_rng(0).uniform(size=(2, _PROBES))
    height, angle = 0.02 + 0.98 * random[0], 2 * np.pi * random[1]
    radius = np.sqrt(1 - height**2)
    wo = jnp.asarray(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1), jnp.result_type(float))

    def integrals(rule):
        return [project(each, wo, degree=degree, rings=rule[0], sectors=rule[1]) for each in brdfs]

    rule, reached, coarse = _RULES[0], np.inf, integrals(_RULES[0])
    for finer in _RULES[1:]:
        fine = integrals(finer)
        reached = max(
            float(jnp.linalg.norm(a - b) / jnp.maximum(jnp.linalg.norm(b), jnp.finfo(b.dtype).tiny))
            for a, b in zip(coarse, fine, strict=True)
        )
        if not reached > error or finer == _RULES[-1]:  # No rule helps what is NaN.
            break
        rule, coarse = finer, fine
    return *rule, reached
