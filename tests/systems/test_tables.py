"""What every table of a BRDF refuses: knots, parameters and BRDFs that are none.

To add one, add a line to ``TABULATE``.
"""

from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import dynamic, harmonic, lobe, separable
from jaxprt.brdf import AshikhminShirley, Lambert

TABULATE = {
    "harmonic": partial(harmonic.tabulate, degree=0, resolution=4),
    "lobe": partial(lobe.tabulate, lobes=1, resolution=4),
    "dynamic": partial(dynamic.tabulate, lobes=0, ranks=(1, 1, 1), resolution=4),
}
each_table = pytest.mark.parametrize("name", TABULATE)
TWO = np.array([0.0, 1.0])


def flat(albedo):
    """A Lambert BRDF with any albedo, even one that the model refuses."""
    return eqx.tree_at(lambda brdf: brdf.albedo, Lambert(0.5), jnp.array([albedo]))


@each_table
def test_knots_that_do_not_increase_and_more_than_two_are_refused(name):
    for knot in ([1.0], [1.0, 1.0], [2.0, 1.0], [0.0, np.nan], [0.0, np.inf], [[0.0, 1.0]]):
        with pytest.raises(
            ValueError, match="knots of parameter 1 must be at least two finite increasing numbers, got"
        ):
            TABULATE[name](lambda a, b: Lambert(a), knot=(TWO, np.array(knot)))
    with pytest.raises(ValueError, match="at most two parameters can be tabulated, got 3"):
        TABULATE[name](lambda a, b, c: Lambert(a), knot=(TWO,) * 3)


@each_table
def test_brdfs_that_are_not_finite_or_have_no_colors_are_refused(name):
    for albedo in (np.nan,) if name == "harmonic" else (np.nan, np.inf, -0.1):
        with pytest.raises(ValueError, match="finite"):
            TABULATE[name](flat(albedo))
        with pytest.raises(ValueError, match=r"2\.0|number 2"):
            TABULATE[name](lambda a, albedo=albedo: flat(0.5 if a < 1.5 else albedo), knot=(np.arange(3.0),))
    if name != "dynamic":
        with pytest.raises(ValueError, match=r"must return \[\d+, c\] for \d+ directions, got \[\d+\]"):
            TABULATE[name](lambda wi, wo: jnp.maximum(wi[..., 2], 0))


@pytest.mark.parametrize(
    ("refused", "message"),
    [
        (partial(harmonic.tabulate, degree=-1), "degree of 0 to 50"),
        (partial(harmonic.tabulate, degree=51), "degree of 0 to 50"),
        (partial(harmonic.tabulate, resolution=1), "resolution of at least 2"),
        (partial(harmonic.tabulate, error=0.0), "an error above 0, got"),
        (partial(harmonic.tabulate, error=float("nan")), "error must be finite, got nan"),
        (lobe.tabulate, "give either lobes or error, got lobes="),
        (partial(lobe.tabulate, lobes=2, error=0.1), "give either lobes or error, got lobes="),
        (partial(lobe.tabulate, lobes=0), "at least one lobe or an error above 0"),
        (partial(lobe.tabulate, lobes=2, resolution=3), "a resolution of at least 4"),
        (partial(lobe.tabulate, error=0.0), "an error above 0"),
        (partial(lobe.tabulate, error=float("nan")), "error must be finite"),
        (partial(dynamic.tabulate, lobes=0, ranks=None), "needs lobes, or ranks of a tensor, or both"),
        (partial(dynamic.tabulate, ranks=(0, 2, 2)), "ranks must be three whole numbers of at least 1"),
        (partial(dynamic.tabulate, resolution=3), "resolution must be"),
        (separable.factor, "either terms or error"),
        (partial(separable.factor, terms=2, error=0.1), "either terms or error"),
        (partial(separable.factor, error=0.0), "error must be above 0"),
        (partial(separable.factor, terms=0), "terms must be between 1 and"),
        (partial(separable.factor, terms=1000, resolution=8), "terms must be between 1 and 52, got 1000"),
        (partial(separable.factor, terms=1, resolution=1), "resolution must be at least 2"),
    ],
)
def test_options_out_of_range_are_refused(refused, message):
    with pytest.raises(ValueError, match=message):
        refused(AshikhminShirley())
