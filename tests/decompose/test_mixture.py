"""Mixtures of densities on the sphere: SciPy's von Mises-Fisher densities, planted mixtures, and what EM promises."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial.transform
import scipy.special
import scipy.stats
from numpy.typing import ArrayLike

from jaxprt.decompose import mixture

ROUNDING = 2e-6  # By which float32 sums over thousands of samples may let the likelihood fall.
SINGLE = 1e-4  # Twenty steps in float32: the last digits of every step go into the next.
CONVERGED = 1e-8  # EM converges geometrically; lobes that hardly overlap are there after a hundred steps.
UNIFORM = -np.log(4 * np.pi)

WEIGHT = np.array([0.5, 1.5, 1.0])
MEAN = np.array([[0.6, 0, 0.8], [-0.8, 0.6, 0], [0, -0.6, -0.8]])
CONCENTRATION = np.array([8.0, 30.0, 15.0])


def cast(*each):
    return tuple(jnp.asarray(x, jnp.result_type(float)) for x in each)


def planted(
    weight: ArrayLike = WEIGHT, mean: ArrayLike = MEAN, concentration: ArrayLike = CONCENTRATION
) -> mixture.Mixture:
    return mixture.Mixture(*cast(weight, mean, concentration))


def density(direction, weight=WEIGHT, mean=MEAN, concentration=CONCENTRATION):
    """Mass per steradian, by SciPy."""
    return sum(
        w * scipy.stats.vonmises_fisher(m, k).pdf(direction)
        for w, m, k in zip(weight, mean, concentration, strict=True)
    )


def quadrature(count=48):
    """Nodes on the sphere, exact for harmonics below degree 96, and their solid angles."""
    height, weight = np.polynomial.legendre.leggauss(count)
    angle = 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    radius = np.sqrt(1 - height**2)
    node = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, angle**0)], -1)
    return node.reshape(-1, 3), np.repeat(weight * np.pi / count, 2 * count)


def around(random, *shape):
    direction = random.normal(size=(*shape, 3))
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def scattered(seed, count=1500, lobes=4):
    """Samples of no mixture in particular, with mass, and a start."""
    random = np.random.default_rng(seed)
    sample = around(random, count)
    mass = random.uniform(size=count) * np.exp(3 * sample @ around(random))
    start = planted(np.ones(lobes), around(random, lobes), random.uniform(1, 20, lobes))
    return *cast(sample, mass), start


def perturbed(random):
    """A start near the planted mixture."""
    mean = MEAN + 0.2 * random.normal(size=MEAN.shape)
    return planted(np.ones(3), mean / np.linalg.norm(mean, axis=1, keepdims=True), np.full(3, 12.0))


def finite(tree):
    return all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(tree))


@pytest.mark.parametrize("concentration", [1e-3, 0.3, 1.0, 10.0, 1e3, 1e6])
def test_densities_are_those_of_scipy(x64, close, concentration):
    random = np.random.default_rng(0)
    mean = around(random)
    near = mean + random.normal(size=(40, 3)) / np.sqrt(concentration)  # Where the lobe is, and anywhere.
    direction = np.concatenate([around(random, 20), near / np.linalg.norm(near, axis=1, keepdims=True), mean[None]])
    actual = mixture.log_density(*cast(direction, mean[None], [concentration]))[:, 0]
    # Concentration times cosine, of which SciPy's logarithm is a difference.
    np.testing.assert_allclose(
        actual, scipy.stats.vonmises_fisher(mean, concentration).logpdf(direction), atol=1e-15 * concentration + 1e-12
    )
    close(mixture.log_peak(jnp.asarray(concentration)), actual[-1])


def test_the_density_of_a_mixture_is_the_weighted_sum_for_any_batch(x64, close):
    direction = around(np.random.default_rng(1), 4, 5)
    close(planted()(jnp.asarray(direction)), density(direction))
    node, area = quadrature()
    close(planted()(jnp.asarray(node)) @ area, WEIGHT.sum())


def test_sharp_lobes_keep_their_digits_in_float32():
    tilt = np.array([0.0, 1e-3, 2e-3])
    direction = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], -1)
    actual = mixture.log_density(*cast(direction, [[0, 0, 1]], [1e6]))[:, 0]
    np.testing.assert_allclose(actual - actual[0], -2e6 * np.sin(tilt / 2) ** 2, rtol=1e-5)


def test_drop_is_the_closed_form_and_concentration_its_inverse(x64):
    concentration = np.append(np.logspace(-3, 6, 2000), [0.00999, 0.01, 0.0100001, 0.1])
    drop = mixture.drop(jnp.asarray(concentration))
    series = concentration / 3 - concentration**3 / 45 + 2 * concentration**5 / 945
    closed = np.where(concentration < 0.02, series, 1 / np.tanh(concentration) - 1 / concentration)
    np.testing.assert_allclose(1 - drop, closed, rtol=1e-9)
    np.testing.assert_allclose(mixture.concentration_of(drop), concentration, rtol=1e-9)


def test_drop_and_its_inverse_hold_in_float32():
    concentration = np.logspace(-1, 6, 300)
    drop = mixture.drop(*cast(concentration))
    np.testing.assert_allclose(drop, 1 - 1 / np.tanh(concentration) + 1 / concentration, rtol=2e-5)
    np.testing.assert_allclose(mixture.concentration_of(drop)[100:], concentration[100:], rtol=1e-4)
    assert finite([mixture.concentration_of(*cast([-1.0, 0, 1, 2])), mixture.drop(*cast([0.0, 1e-30, 1e30]))])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["lobes", "fixed", "extent"])
def test_the_likelihood_never_falls(seed, kind):
    sample, mass, start = scattered(seed)
    options = {}
    if kind != "lobes":
        cosine = np.asarray(sample) @ MEAN[0]
        fixed = np.stack([np.full(len(sample), UNIFORM), np.where(cosine > 0, -np.log(2 * np.pi), -np.inf)], 1)
        options = {"fixed": cast(fixed)[0], "weight": jnp.ones(2)}
    if kind == "extent":
        options |= {"extent": jnp.linspace(0, 0.05, len(sample))}
    fit = mixture.fit(sample, mass, start, steps=30, **options)
    likelihood = np.asarray(fit.likelihood)
    assert likelihood.shape == (31,)
    assert np.diff(likelihood).min() > -ROUNDING
    assert likelihood[-1] > likelihood[0] + 0.01
    assert fit.residual[-1] < fit.residual[0]
    np.testing.assert_allclose(jnp.sum(fit.lobe.weight) + jnp.sum(fit.fixed), jnp.sum(mass), rtol=1e-5)


def test_a_planted_mixture_is_recovered_from_its_density(x64, close):
    node, area = quadrature()
    mass = jnp.asarray(density(node) * area)
    fit = mixture.fit(jnp.asarray(node), mass, perturbed(np.random.default_rng(2)), steps=100)
    close(fit.lobe.weight, WEIGHT, tolerance=CONVERGED)
    close(fit.lobe.mean, MEAN, tolerance=CONVERGED)
    close(fit.lobe.concentration, CONCENTRATION, tolerance=CONVERGED)
    close(fit.likelihood[-1], np.log(density(node) / WEIGHT.sum()) @ mass / WEIGHT.sum(), tolerance=CONVERGED)
    assert fit.residual[-1] < CONVERGED


def test_a_planted_mixture_is_recovered_beside_a_uniform_density(x64, close):
    node, area = quadrature()
    mass = jnp.asarray((density(node) + 0.7 / (4 * np.pi)) * area)
    fixed = jnp.full((len(node), 1), UNIFORM)
    start = perturbed(np.random.default_rng(3))
    fit = mixture.fit(jnp.asarray(node), mass, start, fixed=fixed, weight=jnp.ones(1), steps=300)
    close(fit.lobe.weight, WEIGHT, tolerance=1e-6)  # The widest lobe and the uniform density part slowly.
    close(fit.lobe.concentration, CONCENTRATION, tolerance=1e-6)
    close(fit.fixed, np.array([0.7]), tolerance=1e-6)


def test_samples_drawn_by_scipy_give_the_mixture_that_they_were_drawn_from():
    random, each = np.random.default_rng(4), 4000
    drawn = [
        scipy.stats.vonmises_fisher(m, k).rvs(each, random_state=random)
        for m, k in zip(MEAN, CONCENTRATION, strict=True)
    ]
    sample, mass = cast(np.concatenate(drawn), np.repeat(WEIGHT / each, each))
    fit = mixture.fit(sample, mass, perturbed(random), steps=40)
    # Of 4000 samples a lobe's concentration is known to 1 / sqrt(4000), its mean to sqrt(2 / (4000 k)).
    np.testing.assert_allclose(fit.lobe.weight, WEIGHT, rtol=0.02)
    np.testing.assert_allclose(fit.lobe.concentration, CONCENTRATION, rtol=0.06)
    np.testing.assert_allclose(fit.lobe.mean, MEAN, atol=0.025)


def test_one_lobe_is_the_closed_form_after_one_step(x64, close):
    random = np.random.default_rng(5)
    sample, mass = around(random, 50), random.uniform(size=50)
    fit = mixture.fit(*cast(sample, mass), planted([1.0], [[0, 0, 1.0]], [1.0]), steps=1)
    vector = mass @ sample / mass.sum()
    close(fit.lobe.mean[0], vector / np.linalg.norm(vector))
    close(mixture.drop(fit.lobe.concentration[0]), 1 - np.linalg.norm(vector))
    close(fit.lobe.weight[0], mass.sum())


def test_no_lobe_is_finer_than_the_extent_of_its_samples(x64, close):
    sample, mass, start = jnp.asarray(MEAN), jnp.ones(3), planted(np.ones(3), MEAN, np.full(3, 50.0))
    fit = mixture.fit(sample, mass, start, extent=1e-3, steps=20)
    close(fit.lobe.concentration, np.asarray(mixture.concentration_of(jnp.full(3, 1e-3))))


def test_concentrations_stay_between_least_and_most():
    sample, mass, start = jnp.asarray(MEAN, jnp.float32), jnp.ones(3), planted(np.ones(3), MEAN, np.full(3, 50.0))
    fit = mixture.fit(sample, mass, start, steps=20)
    np.testing.assert_allclose(fit.lobe.concentration, 1e6, rtol=1e-6)
    fit = mixture.fit(sample, mass, start, most=700.0, steps=20)
    np.testing.assert_allclose(fit.lobe.concentration, 700, rtol=1e-6)
    node, area = cast(*quadrature(12))
    fit = mixture.fit(node, area, planted([1.0], [[0, 0, 1.0]], [5.0]), least=0.5, steps=20)
    np.testing.assert_allclose(fit.lobe.concentration, 0.5, rtol=1e-6)


def test_rotated_samples_and_start_give_the_rotated_mixture(x64, close):
    sample, mass, start = scattered(6)
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix()
    turned = mixture.Mixture(start.weight, start.mean @ turn.T, start.concentration)
    one, two = (mixture.fit(x, mass, s, steps=20).lobe for x, s in ((sample, start), (sample @ turn.T, turned)))
    close(two.mean, one.mean @ turn.T, tolerance=CONVERGED)
    close(two.weight, one.weight, tolerance=CONVERGED)
    close(two.concentration, one.concentration, tolerance=CONVERGED)


def test_permuted_lobes_samples_and_densities_give_the_permuted_mixture(x64, close):
    sample, mass, start = scattered(7)
    lobe, row, column = np.array([2, 0, 3, 1]), np.random.default_rng(0).permutation(len(sample)), np.array([1, 0])
    fixed = jnp.stack([jnp.full(len(sample), UNIFORM), 2 * sample[:, 2] - 3], 1)
    weight = jnp.array([1.0, 0.5])
    one = mixture.fit(sample, mass, start, fixed=fixed, weight=weight, steps=20)
    two = mixture.fit(
        sample[row],
        mass[row],
        jax.tree.map(lambda x: x[lobe], start),
        fixed=fixed[row][:, column],
        weight=weight[column],
        steps=20,
    )
    for actual, expected in zip(jax.tree.leaves(two.lobe), jax.tree.leaves(one.lobe), strict=True):
        close(actual, expected[lobe], tolerance=CONVERGED)
    close(two.fixed, one.fixed[column], tolerance=CONVERGED)


def test_scaled_mass_scales_the_weights_alone(close):
    sample, mass, start = scattered(8)
    one, two = (mixture.fit(sample, m, start, steps=20) for m in (mass, 1e-12 * mass))
    close(two.lobe.weight, 1e-12 * one.lobe.weight, tolerance=SINGLE)
    close(two.lobe.mean, one.lobe.mean, tolerance=SINGLE)
    close(two.likelihood, one.likelihood, tolerance=SINGLE)


def test_a_sample_of_twice_the_mass_is_two_samples(close):
    sample, mass, start = scattered(9, count=200)
    once = mixture.fit(sample, 2 * mass, start, steps=20).lobe
    twice = mixture.fit(jnp.concatenate([sample, sample]), jnp.concatenate([mass, mass]), start, steps=20).lobe
    close(twice.weight, once.weight, tolerance=SINGLE)
    close(twice.mean, once.mean, tolerance=SINGLE)


def test_a_component_that_no_sample_chooses_keeps_its_shape_and_weighs_nothing():
    random = np.random.default_rng(10)
    sample = scipy.stats.vonmises_fisher([0, 0, 1], 500).rvs(300, random_state=random)
    start = planted([1.0, 1.0], [[0, 0, 1.0], [0, 0, -1]], [100.0, 1e5])
    fit = mixture.fit(*cast(sample, np.ones(300)), start, steps=10)
    assert finite(fit)
    np.testing.assert_array_equal(fit.lobe.mean[1], [0, 0, -1])
    np.testing.assert_allclose(fit.lobe.weight, [300, 0], rtol=1e-5)
    np.testing.assert_allclose(fit.lobe.concentration[1], 1e5, rtol=1e-6)


def test_components_that_coincide_stay_so():
    sample, mass, start = scattered(11)
    same = jax.tree.map(lambda x: x.at[1].set(x[0]), start)
    lobe = mixture.fit(sample, mass, same, steps=20).lobe
    assert finite(lobe)
    for each in (lobe.weight, lobe.mean, lobe.concentration):
        np.testing.assert_allclose(each[1], each[0], rtol=1e-4)


def test_zero_mass_gives_zero_weights():
    sample, mass, start = scattered(12)
    fit = mixture.fit(sample, 0 * mass, start, fixed=jnp.full((len(mass), 1), UNIFORM), weight=jnp.ones(1), steps=5)
    assert finite(fit)
    for zero in (fit.lobe.weight, fit.fixed, fit.likelihood):
        np.testing.assert_array_equal(zero, 0)
    np.testing.assert_array_equal(fit.lobe.mean, start.mean)


def test_a_weight_of_zero_stays_zero():
    sample, mass, start = scattered(13)
    fixed = jnp.full((len(mass), 2), UNIFORM)
    start = mixture.Mixture(start.weight.at[2].set(0), start.mean, start.concentration)
    fit = mixture.fit(sample, mass, start, fixed=fixed, weight=jnp.array([0.0, 1]), steps=5)
    assert finite(fit)
    assert fit.lobe.weight[2] == fit.fixed[0] == 0
    np.testing.assert_allclose(jnp.sum(fit.lobe.weight) + fit.fixed[1], jnp.sum(mass), rtol=1e-5)
    none = mixture.fit(sample, mass, mixture.Mixture(0 * start.weight, start.mean, start.concentration), steps=5)
    assert finite(none)
    np.testing.assert_array_equal(none.lobe.weight, 0)


def test_samples_that_cancel_leave_the_mean_where_it_was():
    start = planted([1.0], [[0, 0.6, 0.8]], [3.0])
    fit = mixture.fit(*cast([[0, 0, 1], [0, 0, -1]], [1.0, 1.0]), start, steps=3)
    assert finite(fit)
    np.testing.assert_array_equal(fit.lobe.mean, start.mean)
    assert fit.lobe.concentration[0] == pytest.approx(1e-3)


@pytest.mark.parametrize("options", [{"weight": jnp.ones(1)}, {"fixed": jnp.zeros((20, 1))}])
def test_fixed_densities_and_weights_must_come_together(options):
    with pytest.raises(ValueError, match="fixed densities and their weights must be given together"):
        mixture.fit(*scattered(0, count=20), **options)


def test_planted_weights_of_known_densities_are_found(x64, close):
    node, area = quadrature()
    each = mixture.log_density(jnp.asarray(node), jnp.asarray(MEAN), jnp.asarray(CONCENTRATION))
    mass = jnp.asarray(density(node) * area)
    weight, likelihood = mixture.weigh(each, mass, jnp.array([3.0, 1, 0.01]), steps=100)
    close(weight, WEIGHT, tolerance=CONVERGED)
    assert likelihood.shape == (101,)
    assert np.diff(np.asarray(likelihood)).min() > -1e-14
    close(likelihood[-1], np.log(density(node) / WEIGHT.sum()) @ mass / WEIGHT.sum(), tolerance=CONVERGED)


def test_weigh_is_fit_with_no_free_lobes(close):
    sample, mass, start = scattered(14)
    each = mixture.log_density(sample, start.mean, start.concentration)
    weight, likelihood = mixture.weigh(each, mass, start.weight, steps=10)
    none = mixture.Mixture(*cast(np.zeros(0), np.zeros((0, 3)), np.zeros(0)))
    fit = mixture.fit(sample, mass, none, fixed=each, weight=start.weight, steps=10)
    close(weight, fit.fixed, tolerance=SINGLE)
    close(likelihood, fit.likelihood, tolerance=SINGLE)


def test_only_mass_that_a_density_explains_is_weighed():
    minus = -jnp.inf
    each = jnp.array([[0.0, minus, minus], [minus, minus, 1.0], [minus, minus, minus], [0.0, 0.0, minus]])
    weight, likelihood = mixture.weigh(each, jnp.array([1.0, 2, 4, 8]), jnp.array([1.0, 0, 1]))
    np.testing.assert_allclose(weight, [9, 0, 2], rtol=1e-5)
    assert finite(likelihood)


@pytest.mark.parametrize("nothing", ["mass", "weight", "density"])
def test_weighing_nothing_gives_zeros(nothing):
    each, mass, weight = jnp.zeros((5, 2)), jnp.ones(5), jnp.ones(2)
    if nothing == "density":
        each = each - jnp.inf
    found, likelihood = mixture.weigh(each, mass * (nothing != "mass"), weight * (nothing != "weight"), steps=3)
    np.testing.assert_array_equal(found, 0)
    np.testing.assert_array_equal(likelihood, 0)


def test_bands_are_ratios_of_bessel_functions():
    concentration = np.logspace(-3, 5, 33)
    order = np.arange(6)[:, None] + 0.5
    exact = scipy.special.ive(order, concentration) / scipy.special.ive(0.5, concentration)
    found = mixture.bands(jnp.asarray(concentration, jnp.float32), degree=5)
    np.testing.assert_allclose(found, exact, rtol=2e-5)
