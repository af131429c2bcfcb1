import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import eval_legendre

from jaxprt.sphere import harmonics
from tests.sphere.basis import band, scipy_basis

DEGREE = 50
POLES = np.array([[0.0, 0, 1], [0, 0, -1]])


def unit(seed, count, dtype=np.float64):
    vector = np.random.default_rng(seed).normal(size=(count, 3))
    return jnp.asarray(vector / np.linalg.norm(vector, axis=1, keepdims=True), dtype)


def normal(seed, *shape, dtype=np.float64):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), dtype)


@functools.lru_cache
def quadrature(degree):
    """Directions and weights that integrate products of two harmonics exactly."""
    height, weight = np.polynomial.legendre.leggauss(degree + 1)
    azimuth = 2 * np.pi * np.arange(2 * degree + 2) / (2 * degree + 2)
    radius, around = np.sqrt(1 - height**2), np.stack([np.cos(azimuth), np.sin(azimuth)], -1)
    flat = radius[:, None, None] * around
    direction = np.concatenate([flat, np.broadcast_to(height[:, None, None], (*flat.shape[:2], 1))], -1)
    return direction.reshape(-1, 3), np.repeat(weight * 2 * np.pi / len(azimuth), len(azimuth))


def zonal_factor(kernel, l, low, high):
    return 2 * np.pi * quad(lambda t: kernel(t) * eval_legendre(l, t), low, high, epsabs=1e-13, epsrel=1e-13)[0]


@pytest.mark.parametrize("degree", [0, 1, DEGREE])
def test_the_basis_is_orthonormal_and_scipys_in_real_form_without_its_phase(degree, x64, close):
    direction, weight = quadrature(degree)
    others = np.concatenate([unit(0, 100), POLES, np.eye(3), -np.eye(3)])
    basis = np.asarray(harmonics.evaluate(jnp.asarray(np.concatenate([direction, others])), degree=degree))
    inside, outside = np.split(basis, [len(direction)])
    some = np.unique(np.random.default_rng(1).integers(0, (degree + 1) ** 2, 200))
    close((inside[:, some] * weight[:, None]).T @ inside, np.eye((degree + 1) ** 2)[some])
    close(outside, scipy_basis(others, degree))
    single = others.astype(np.float32)
    exact = single / np.linalg.norm(single.astype(float), axis=1, keepdims=True)
    close(harmonics.evaluate(single, degree=degree), scipy_basis(exact, degree))


def test_the_gradient_at_the_poles_is_that_along_great_circles(x64, close):
    forward, reverse = (jax.jit(slope(lambda s: harmonics.evaluate(s, degree=8))) for slope in (jax.jacfwd, jax.jacrev))
    for pole, tangent in itertools.product(POLES, np.eye(3)[:2]):
        jacobian = np.asarray(forward(pole))
        close(reverse(pole), jacobian)

        def along(t, pole=pole, tangent=tangent):
            return scipy_basis((np.cos(t) * pole + np.sin(t) * tangent)[None], 8)[0]

        h = 1e-3
        expected = (8 * (along(h) - along(-h)) - (along(2 * h) - along(-2 * h))) / (12 * h)
        close(jacobian @ tangent, expected, tolerance=1e-8)  # The rule's error, of fourth order.


def test_gradients_of_high_degree_in_float32_are_those_of_finite_differences(x64, close):
    degree = 20  # Derivatives of degree 50 take tens of seconds to compile.
    direction = np.concatenate([unit(3, 20), POLES, np.eye(3)])
    weight = normal(4, (degree + 1) ** 2)
    _, pull = jax.vjp(lambda s: harmonics.evaluate(s, degree=degree), jnp.asarray(direction, jnp.float32))
    (gradient,) = pull(jnp.broadcast_to(jnp.asarray(weight, jnp.float32), (len(direction), len(weight))))

    def along(axis, h):  # NumPy's copy of the same polynomial, in float64.
        return np.asarray(weight) @ harmonics.basis(np, direction + h * np.eye(3)[axis], degree)

    h = 1e-4
    expected = [(8 * (along(i, h) - along(i, -h)) - (along(i, 2 * h) - along(i, -2 * h))) / (12 * h) for i in range(3)]
    close(gradient, np.stack(expected, -1))


@pytest.mark.parametrize(("size", "degree"), [(1, 9), (5, 9), (16, 0)])
def test_constant_light_has_one_coefficient_only(size, degree, x64, close):
    expected = np.zeros(((degree + 1) ** 2, 2))
    expected[0] = np.sqrt(4 * np.pi) * np.array([1, 3])
    radiance = jnp.broadcast_to(jnp.array([1.0, 3.0]), (6, size, size, 2))
    close(harmonics.project(radiance, degree=degree), expected)


def test_one_texel_projects_to_the_integral_of_scipys_basis_over_it(x64, close):
    size, face, row, column = 5, 3, 1, 2
    node, weight = np.polynomial.legendre.leggauss(24)
    s, t = ((2 * k + 1 + node) / size - 1 for k in (column, row))
    t, s = np.meshgrid(t, s, indexing="ij")
    place = np.stack([s, -np.ones_like(s), -t], -1).reshape(-1, 3)  # Face -y: s along +x, t along -z.
    length = np.linalg.norm(place, axis=1)
    solid_angle = np.outer(weight, weight).ravel() / size**2 / length**3
    radiance = jnp.zeros((6, size, size)).at[face, row, column].set(2)
    close(harmonics.project(radiance, degree=9), 2 * solid_angle @ scipy_basis(place / length[:, None], 9))


def test_reconstruction_sums_coefficients_times_the_basis(x64, close):
    direction = unit(8, 12).reshape(3, 4, 3)
    basis = scipy_basis(direction.reshape(-1, 3), 6).reshape(3, 4, 49)
    for channel in ((), (3,), (2, 3)):
        coefficient = normal(9, 49, *channel)
        close(harmonics.reconstruct(coefficient, direction), np.tensordot(basis, coefficient, 1))


def test_the_clamped_cosine_has_the_factors_of_its_integral(x64, close):
    expected = [zonal_factor(lambda t: t, l, 0, 1) for l in range(15)]
    close(harmonics.cosine(degree=14), np.array(expected))
    close(harmonics.cosine(degree=0), np.array(expected[:1]))
    close(harmonics.cosine(degree=1), np.array(expected[:2]))


@pytest.mark.parametrize("exponent", [0.0, 1.0, 33.3, 200.0])
def test_phong_lobes_have_the_factors_of_their_integral(exponent, x64, close):
    scale = (exponent + 1) / (2 * np.pi)
    expected = [zonal_factor(lambda t: scale * t**exponent, l, 0, 1) for l in range(15)]
    close(harmonics.phong(jnp.array(exponent), degree=14), np.array(expected))


def test_a_convolved_light_is_the_integral_of_the_light_over_the_kernel(x64, close):
    # White furnace with a lamp: irradiance of a function in its own harmonics, by quadrature over half the sphere.
    coefficient, node = normal(11, 16), 30
    height, weight = np.polynomial.legendre.leggauss(node)
    height, weight = (height + 1) / 2, weight / 2
    azimuth = 2 * np.pi * np.arange(node) / node
    radius = np.sqrt(1 - height**2)[:, None]
    local = np.stack(np.broadcast_arrays(radius * np.cos(azimuth), radius * np.sin(azimuth), height[:, None]), -1)
    expected = 2 * np.pi / node * np.einsum("i,i,ijb,b->", weight, height, _basis(local, 3), coefficient)
    irradiance = harmonics.convolve(coefficient, harmonics.cosine(degree=3))
    close(harmonics.reconstruct(irradiance, jnp.array([0.0, 0, 1])), expected)


def _basis(direction, degree):
    return scipy_basis(direction.reshape(-1, 3), degree).reshape(*direction.shape[:-1], -1)


disc_slope = jax.jit(jax.jacfwd(lambda direction, angle: harmonics.disc(direction, angle, degree=14), 1))
ANGLE = [1e-4, 4.7e-3, 0.7, np.pi / 2, np.pi - 1e-3, np.pi]


def disc_factors(angle, degree):
    """2 pi times the integral of sin P_l(cos) from 0 to the angle, by Gauss points in the angle."""
    node, weight = np.polynomial.legendre.leggauss(60)
    theta = angle * (node + 1) / 2
    l = np.arange(degree + 1)[:, None]
    return np.pi * angle * np.sum(weight * np.sin(theta) * eval_legendre(l, np.cos(theta)), -1)


@pytest.mark.parametrize("angle", ANGLE)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_discs_of_any_size_are_their_quadrature(angle, dtype, x64, close):
    direction = unit(12, 5, dtype)
    expected = scipy_basis(np.asarray(direction, np.float64), 14) * disc_factors(float(dtype(angle)), 14)[band(14)]
    actual = harmonics.disc(direction, jnp.full(5, angle, dtype), degree=14)
    assert actual.dtype == dtype
    close(actual, expected)


@pytest.mark.parametrize("angle", [0.0, *ANGLE])
def test_the_change_of_a_disc_with_its_angle_is_its_rim(angle, x64, close):
    direction = unit(12, 5)[0]
    actual = disc_slope(direction, jnp.array(angle))
    rim = 2 * np.pi * np.sin(angle) * eval_legendre(np.arange(15), np.cos(angle))
    expected = scipy_basis(direction[None], 14)[0] * rim[band(14)]
    if angle == np.pi:
        assert np.abs(np.asarray(actual)).max() < 1e-12
    else:
        close(actual, expected)


def test_hann_and_lanczos_are_their_values_of_the_band_over_the_first_left_out(x64, close):
    root = np.sqrt(0.5)
    close(harmonics.hann(degree=3), np.array([1, (1 + root) / 2, 0.5, (1 - root) / 2]))
    close(harmonics.lanczos(degree=3), np.array([1, root * 4 / np.pi, 2 / np.pi, root * 4 / (3 * np.pi)]))


def laplacian(coefficient):
    l = band(harmonics.degree_of(len(coefficient)))
    return float(np.sum((l * (l + 1))[:, None] ** 2 * np.asarray(coefficient) ** 2))


@pytest.mark.parametrize("kept", [1.0, 0.1, 1e-6])
@pytest.mark.parametrize("degree", [1, DEGREE])
def test_the_window_of_least_laplacian_leaves_the_share_that_was_asked_for(kept, degree, x64, close):
    coefficient = normal(15, (degree + 1) ** 2, 3)
    factor = harmonics.least_laplacian(coefficient, jnp.array(kept))
    assert (np.diff(factor) <= 0).all()
    assert factor[0] == 1
    left = laplacian(harmonics.convolve(coefficient, factor)) / laplacian(coefficient)
    close(np.array(left), np.array(kept), tolerance=1e-9)
    if degree > 1 and kept == 0.1:  # No other window of its Laplacian changes the function less.
        for window in (harmonics.hann(degree=degree), harmonics.lanczos(degree=degree)):
            other = harmonics.convolve(coefficient, window)
            share = jnp.array(laplacian(other) / laplacian(coefficient))
            least = harmonics.convolve(coefficient, harmonics.least_laplacian(coefficient, share))
            assert laplacian(least) == pytest.approx(laplacian(other), rel=1e-9)
            assert np.linalg.norm(least - coefficient) < 0.999 * np.linalg.norm(other - coefficient)


def test_a_share_of_zero_keeps_the_mean_alone_and_shares_out_of_range_are_refused(x64):
    factor = harmonics.least_laplacian(normal(17, 25, 3), jnp.array(0.0))
    np.testing.assert_array_equal(factor, [1, 0, 0, 0, 0])
    for kept in (-0.1, 1.5, np.nan):
        with pytest.raises(ValueError, match="share of the squared Laplacian that remains must be from 0 to 1, got"):
            harmonics.least_laplacian(normal(17, 25, 3), jnp.array(kept))


def test_where_there_is_no_laplacian_the_window_is_one_and_gradients_are_finite(x64):
    for coefficient in (jnp.zeros((25, 3)), jnp.zeros((25, 3)).at[0].set(2.0)):
        factor = harmonics.least_laplacian(coefficient, jnp.array(0.5))
        np.testing.assert_array_equal(factor, 1)
        gradient = jax.grad(lambda c: jnp.sum(harmonics.least_laplacian(c, jnp.array(0.5))))(coefficient)
        assert np.isfinite(gradient).all()


def test_wrong_numbers_are_refused_by_what_was_required_and_what_came(unchecked):
    for count in (-4, 0, 5, 24):
        with pytest.raises(ValueError, match=f"square number, got {count}"):
            harmonics.degree_of(count)
    assert [harmonics.degree_of((l + 1) ** 2) for l in range(51)] == list(range(51))
    direction = jnp.array([0.0, 0, 1])
    with pytest.raises(ValueError, match="at least 0, got -1"):
        harmonics.evaluate(direction, degree=-1)
    with pytest.raises(ValueError, match="at least 0, got -1"):
        harmonics.project(jnp.zeros((6, 2, 2)), degree=-1)
    with pytest.raises(ValueError, match="at least 1, got 0"):
        harmonics.project(jnp.zeros((6, 0, 0)), degree=1)
    with pytest.raises(ValueError, match="square number, got 7"):
        harmonics.reconstruct(jnp.zeros((7, 3)), direction)
    with pytest.raises(ValueError, match="square number, got 7"):
        harmonics.convolve(jnp.zeros((7, 3)), jnp.ones(3))
    with pytest.raises(ValueError, match="each of the 3 bands, got 4"):
        harmonics.convolve(jnp.zeros((9, 3)), jnp.ones(4))
    with pytest.raises(ValueError, match="at least 0, got -1"):
        harmonics.disc(direction, jnp.array(0.1), degree=-1)
