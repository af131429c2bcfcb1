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
    """Arrays of NumPy in the default precision: operations of JAX outside of `jit` would be a program each."""
    return tuple(np.asarray(x, jnp.result_type(float)) for x in each)


def planted(
    weight: ArrayLike = WEIGHT, mean: ArrayLike = MEAN, concentration: ArrayLike = CONCENTRATION
) -> mixture.Mixture:
    return mixture.Mixture(*map(jnp.asarray, cast(weight, mean, concentration)))


def density(direction, weight=WEIGHT, mean=MEAN, concentration=CONCENTRATION):
    """Mass per steradian, by SciPy."""
    return sum(
        w * scipy.stats.vonmises_fisher(m, k).pdf(direction)
        for w, m, k in zip(weight, mean, concentration, strict=True)
    )


def quadrature(count=32):
    """Nodes on the sphere, exact for harmonics below degree 64, and their solid angles."""
    height, weight = np.polynomial.legendre.leggauss(count)
    angle = 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    radius = np.sqrt(1 - height**2)
    node = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(height, angle**0)], -1)
    return node.reshape(-1, 3), np.repeat(weight * np.pi / count, 2 * count)


def around(random, *shape):
    direction = random.normal(size=(*shape, 3))
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def scattered(seed, count=1500, lobes=3):
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


@pytest.mark.parametrize("concentration", [1e-3, 1.0, 1e3, 1e6])
def test_densities_are_those_of_scipy(x64, close, concentration):
    random = np.random.default_rng(0)
    mean = around(random)
    near = mean + random.normal(size=(40, 3)) / np.sqrt(concentration)  # Where the lobe is, and anywhere.
    direction = np.concatenate([around(random, 20), near / np.linalg.norm(near, axis=1, keepdims=True), mean[None]])
    actual = np.asarray(mixture.log_density(*cast(direction, mean[None], [concentration])))[:, 0]
    # Concentration times cosine, of which SciPy's logarithm is a difference.
    np.testing.assert_allclose(
        actual, scipy.stats.vonmises_fisher(mean, concentration).logpdf(direction), atol=1e-15 * concentration + 1e-12
    )
    close(mixture.log_peak(np.float64(concentration)), actual[-1])


def test_the_density_of_a_mixture_is_the_weighted_sum_for_any_batch(x64, close):
    direction = around(np.random.default_rng(1), 4, 5)
    close(planted()(jnp.asarray(direction)), density(direction))
    node, area = quadrature()
    close(np.asarray(planted()(jnp.asarray(node))) @ area, WEIGHT.sum())


def test_drop_is_the_closed_form_and_concentration_its_inverse(x64):
    concentration = np.append(np.logspace(-3, 6, 2000), [0.00999, 0.01, 0.0100001, 0.1])
    drop = np.asarray(mixture.drop(concentration))
    series = concentration / 3 - concentration**3 / 45 + 2 * concentration**5 / 945
    closed = np.where(concentration < 0.02, series, 1 / np.tanh(concentration) - 1 / concentration)
    np.testing.assert_allclose(1 - drop, closed, rtol=1e-9)
    np.testing.assert_allclose(mixture.concentration_of(drop), concentration, rtol=1e-9)


def test_sharp_lobes_keep_their_digits_in_float32():
    concentration = np.logspace(-1, 6, 300)
    drop = np.asarray(mixture.drop(*cast(concentration)))
    np.testing.assert_allclose(drop, 1 - 1 / np.tanh(concentration) + 1 / concentration, rtol=2e-5)
    back = np.asarray(mixture.concentration_of(drop))
    np.testing.assert_allclose(back[100:], concentration[100:], rtol=1e-4)
    assert finite([mixture.concentration_of(*cast([-1.0, 0, 1, 2])), mixture.drop(*cast([0.0, 1e-30, 1e30, 1]))])
    tilt = np.array([0.0, 1e-3, 2e-3])
    direction = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], -1)
    actual = np.asarray(mixture.log_density(*cast(direction, [[0, 0, 1]], [1e6])))[:, 0]
    np.testing.assert_allclose(actual - actual[0], -2e6 * np.sin(tilt / 2) ** 2, rtol=1e-5)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("kind", ["lobes", "fixed", "extent"])
def test_the_likelihood_never_falls(seed, kind):
    sample, mass, start = scattered(seed)
    options = {}
    if kind != "lobes":
        cosine = np.asarray(sample) @ MEAN[0]
        fixed = np.stack([np.full(len(sample), UNIFORM), np.where(cosine > 0, -np.log(2 * np.pi), -np.inf)], 1)
        options = dict(zip(("fixed", "weight"), cast(fixed, np.ones(2)), strict=True))
    if kind == "extent":
        options |= {"extent": cast(np.linspace(0, 0.05, len(sample)))[0]}
    fit = mixture.fit(sample, mass, start, steps=20, **options)
    likelihood = np.asarray(fit.likelihood)
    assert likelihood.shape == (21,)
    assert np.diff(likelihood).min() > -ROUNDING
    assert likelihood[-1] > likelihood[0] + 0.01
    assert fit.residual[-1] < fit.residual[0]
    np.testing.assert_allclose(np.sum(fit.lobe.weight) + np.sum(fit.fixed), np.sum(mass), rtol=1e-5)


def test_a_planted_mixture_is_recovered_from_its_density(x64, close):
    node, area = quadrature()
    mass = density(node) * area
    fit = mixture.fit(node, mass, perturbed(np.random.default_rng(2)), steps=100)
    close(fit.lobe.weight, WEIGHT, tolerance=CONVERGED)
    close(fit.lobe.mean, MEAN, tolerance=CONVERGED)
    close(fit.lobe.concentration, CONCENTRATION, tolerance=CONVERGED)
    close(
        np.asarray(fit.likelihood)[-1], np.log(density(node) / WEIGHT.sum()) @ mass / WEIGHT.sum(), tolerance=CONVERGED
    )
    assert fit.residual[-1] < CONVERGED


def test_a_planted_mixture_is_recovered_beside_a_uniform_density(x64, close):
    node, area = quadrature()
    mass, fixed = (density(node) + 0.7 / (4 * np.pi)) * area, np.full((len(node), 1), UNIFORM)
    start = perturbed(np.random.default_rng(3))
    fit = mixture.fit(node, mass, start, fixed=fixed, weight=np.ones(1), steps=300)
    close(fit.lobe.weight, WEIGHT, tolerance=1e-6)  # The widest lobe and the uniform density part slowly.
    close(fit.lobe.concentration, CONCENTRATION, tolerance=1e-6)
    close(fit.fixed, np.array([0.7]), tolerance=1e-6)


def test_one_lobe_is_the_closed_form_after_one_step(x64, close):
    random = np.random.default_rng(5)
    sample, mass = around(random, 50), random.uniform(size=50)
    fit = mixture.fit(*cast(sample, mass), planted([1.0], [[0, 0, 1.0]], [1.0]), steps=1)
    vector = mass @ sample / mass.sum()
    close(fit.lobe.mean[0], vector / np.linalg.norm(vector))
    close(mixture.drop(fit.lobe.concentration), np.full(1, 1 - np.linalg.norm(vector)))
    close(fit.lobe.weight[0], mass.sum())


def test_concentrations_stay_between_least_and_most_and_below_the_extent_of_samples():
    sample, mass = cast(MEAN, np.ones(3))
    start = planted(np.ones(3), MEAN, np.full(3, 50.0))
    finest = float(mixture.concentration_of(np.float32(1e-3)))
    for options, expected in (({}, 1e6), ({"most": 700.0}, 700), ({"extent": 1e-3}, finest)):
        fit = mixture.fit(sample, mass, start, steps=20, **options)
        np.testing.assert_allclose(fit.lobe.concentration, expected, rtol=1e-6)
    # Samples that cancel leave the mean where it was.
    wide = planted([1.0], [[0, 0.6, 0.8]], [5.0])
    fit = mixture.fit(*cast([[0, 0, 1], [0, 0, -1]], [1.0, 1.0]), wide, least=0.5, steps=20)
    np.testing.assert_allclose(fit.lobe.concentration, 0.5, rtol=1e-6)
    np.testing.assert_array_equal(fit.lobe.mean, wide.mean)


def test_permuted_and_rotated_input_gives_the_permuted_and_rotated_mixture(x64, close):
    sample, mass, start = scattered(7)
    turn = scipy.spatial.transform.Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix()
    lobe, row, column = np.array([2, 0, 1]), np.random.default_rng(0).permutation(len(sample)), np.array([1, 0])
    fixed = np.stack([np.full(len(sample), UNIFORM), 2 * sample[:, 2] - 3], 1)
    weight = np.array([1.0, 0.5])
    one = mixture.fit(sample, mass, start, fixed=fixed, weight=weight, steps=20)
    two = mixture.fit(
        sample[row] @ turn.T,
        mass[row],
        planted(*(np.asarray(each)[lobe] for each in (start.weight, start.mean @ turn.T, start.concentration))),
        fixed=fixed[row][:, column],
        weight=weight[column],
        steps=20,
    )
    weight, mean, concentration = map(np.asarray, jax.tree.leaves(one.lobe))
    close(two.lobe.weight, weight[lobe], tolerance=CONVERGED)
    close(two.lobe.mean, mean[lobe] @ turn.T, tolerance=CONVERGED)
    close(two.lobe.concentration, concentration[lobe], tolerance=CONVERGED)
    close(two.fixed, np.asarray(one.fixed)[column], tolerance=CONVERGED)


def test_scaled_mass_scales_the_weights_alone(close):
    sample, mass, start = scattered(8)
    one, two = (mixture.fit(sample, m, start, steps=20) for m in (mass, np.float32(1e-12) * mass))
    close(two.lobe.weight, 1e-12 * np.asarray(one.lobe.weight), tolerance=SINGLE)
    close(two.lobe.mean, one.lobe.mean, tolerance=SINGLE)
    close(two.likelihood, one.likelihood, tolerance=SINGLE)


def test_a_component_that_no_sample_chooses_keeps_its_shape_and_weighs_nothing():
    random = np.random.default_rng(10)
    sample = scipy.stats.vonmises_fisher([0, 0, 1], 500).rvs(1500, random_state=random)
    # The first two coincide, and stay so.
    start = planted([1.0, 1.0, 1.0], [[0, 0, 1.0], [0, 0, 1], [0, 0, -1]], [100.0, 100.0, 1e5])
    fit = jax.tree.map(np.asarray, mixture.fit(*cast(sample, np.ones(1500)), start, steps=20))
    assert finite(fit)
    np.testing.assert_array_equal(fit.lobe.mean[2], [0, 0, -1])
    np.testing.assert_array_equal(fit.lobe.mean[0], fit.lobe.mean[1])
    np.testing.assert_allclose(fit.lobe.weight, [750, 750, 0], rtol=1e-5)
    np.testing.assert_allclose(fit.lobe.concentration[2], 1e5, rtol=1e-6)


def test_zero_mass_gives_zero_weights_and_a_weight_of_zero_stays_zero():
    sample, mass, start = scattered(12)
    options = {"fixed": cast(np.full((len(mass), 2), UNIFORM))[0], "weight": np.float32([0, 1]), "steps": 20}
    fit = mixture.fit(sample, 0 * mass, start, **options)
    assert finite(fit)
    for zero in (fit.lobe.weight, fit.fixed, fit.likelihood):
        np.testing.assert_array_equal(zero, 0)
    np.testing.assert_array_equal(fit.lobe.mean, start.mean)
    start = planted([1.0, 1, 0], start.mean, start.concentration)
    fit = mixture.fit(sample, mass, start, **options)
    assert finite(fit)
    assert np.asarray(fit.lobe.weight)[2] == np.asarray(fit.fixed)[0] == 0
    np.testing.assert_allclose(np.sum(fit.lobe.weight) + np.sum(fit.fixed), np.sum(mass), rtol=1e-5)


@pytest.mark.parametrize("options", [{"weight": np.ones(1, np.float32)}, {"fixed": np.zeros((20, 1), np.float32)}])
def test_fixed_densities_and_weights_must_come_together(options):
    with pytest.raises(ValueError, match="fixed densities and their weights must be given together"):
        mixture.fit(*scattered(0, count=20), **options)


def test_planted_weights_of_known_densities_are_found(x64, close):
    node, area = quadrature()
    each, mass = np.asarray(mixture.log_density(node, MEAN, CONCENTRATION)), density(node) * area
    weight, likelihood = mixture.weigh(each, mass, np.array([3.0, 1, 0.01]), steps=100)
    close(weight, WEIGHT, tolerance=CONVERGED)
    assert likelihood.shape == (101,)
    assert np.diff(np.asarray(likelihood)).min() > -1e-14
    close(np.asarray(likelihood)[-1], np.log(density(node) / WEIGHT.sum()) @ mass / WEIGHT.sum(), tolerance=CONVERGED)


def test_only_mass_that_a_density_explains_is_weighed():
    minus = -np.inf
    each, mass, one = cast(
        [[0.0, minus, minus], [minus, minus, 1.0], [minus, minus, minus], [0.0, 0.0, minus]], [1.0, 2, 4, 8], [1, 0, 1]
    )
    weight, likelihood = mixture.weigh(each, mass, one)
    np.testing.assert_allclose(weight, [9, 0, 2], rtol=1e-5)
    assert finite(likelihood)
    for nothing in ((each, 0 * mass, one), (each, mass, 0 * one), (np.full_like(each, minus), mass, one)):
        for found in mixture.weigh(*nothing):
            np.testing.assert_array_equal(found, 0)


def test_bands_are_ratios_of_bessel_functions():
    concentration = np.logspace(-3, 5, 33)
    order = np.arange(6)[:, None] + 0.5
    exact = scipy.special.ive(order, concentration) / scipy.special.ive(0.5, concentration)
    found = mixture.bands(*cast(concentration), degree=5)
    np.testing.assert_allclose(found, exact, rtol=2e-5)
