import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxprt.decompose import eigen


def on_host(solve):
    """A solver whose results are of NumPy: operations of JAX outside of `jit` would be a program each."""
    return lambda *arrays, **options: [np.asarray(each) for each in solve(*arrays, **options)]


symmetric, power, left_singular = map(on_host, (eigen.symmetric, eigen.power, eigen.left_singular))


def _planted(value, size=60):
    basis = scipy.linalg.qr(np.random.default_rng(0).standard_normal((size, size)))[0][:, : len(value)]
    return ((basis * value) @ basis.T).astype(np.float32), basis


def test_planted_eigenvalues_of_either_sign_come_by_magnitude():
    matrix, basis = _planted([1.0, -8.0, 4.0, -2.0, 0.5])
    value, vector, residual = symmetric(matrix, terms=3)
    np.testing.assert_allclose(value, [-8, 4, -2], rtol=1e-5)
    np.testing.assert_allclose(np.abs(vector.T @ basis[:, [1, 2, 3]]), np.eye(3), atol=1e-4)
    assert residual[-1] < 1e-5


def test_nearly_equal_pairs_of_opposite_sign_are_separated():
    matrix, _ = _planted([242.0, -241.99, 240.0, -239.8, 10.0])
    value, vector, _ = symmetric(matrix, terms=4)
    np.testing.assert_allclose(value, [242, -241.99, 240, -239.8], rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(matrix @ vector - vector * value), 0, atol=2e-2)


def test_repeated_eigenvalues_give_an_orthonormal_basis_of_their_space():
    matrix, basis = _planted([3.0, 3.0, 3.0, 1.0])
    value, vector, _ = symmetric(matrix, terms=3)
    np.testing.assert_allclose(value, 3, rtol=1e-5)
    np.testing.assert_allclose(vector.T @ vector, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(vector @ vector.T, basis[:, :3] @ basis[:, :3].T, atol=1e-4)


def test_left_singular_vectors_equal_scipy_of_the_weighted_matrix():
    rng = np.random.default_rng(1)
    matrix = rng.standard_normal((40, 25)) * 0.7 ** np.arange(25)
    root = rng.standard_normal((25, 25))
    u, s, _ = scipy.linalg.svd(matrix @ root)
    value, vector, residual = left_singular(
        jnp.asarray(matrix, jnp.float32), metric=jnp.asarray(root @ root.T, jnp.float32), terms=5
    )
    np.testing.assert_allclose(value, s[:5] ** 2, rtol=1e-4)
    np.testing.assert_allclose(np.abs(vector.T @ u[:, :5]), np.eye(5), atol=2e-3)
    assert residual[-1] < 1e-4


def test_residual_falls_with_the_steps():
    matrix, basis = _planted(0.97 ** np.arange(200), 300)
    value, vector, residual = symmetric(matrix, terms=2, steps=6)
    assert residual.shape == (6,)
    assert residual[5] < residual[1] < residual[0] / 10
    np.testing.assert_allclose(value, [1, 0.97], rtol=1e-5)
    np.testing.assert_allclose(np.abs(vector.T @ basis[:, :2]), np.eye(2), atol=1e-3)


@pytest.mark.parametrize("name", ["zero", "identity", "few rows", "low rank"])
def test_vectors_are_orthonormal_where_products_add_nothing_to_the_span(name):
    size = 85  # The span of 60 vectors fills most of it.
    corner = np.zeros((size, size))
    corner[:4, :4] = np.asarray(_planted([4.0, -3.0, 2.0, 1.0], 4)[0])
    low = _planted([5.0, -2.0], size)[0]
    matrix = {"zero": 0 * corner, "identity": np.eye(size), "few rows": corner, "low rank": low}[name]
    value, vector, _ = symmetric(jnp.asarray(matrix, jnp.float32), terms=4)
    expected = {"zero": [0] * 4, "identity": [1] * 4, "few rows": [4, -3, 2, 1], "low rank": [5, -2, 0, 0]}
    np.testing.assert_allclose(value, expected[name], atol=1e-4)
    np.testing.assert_allclose(vector.T @ vector, np.eye(4), atol=1e-4)


def test_power_iteration_finds_well_separated_eigenvalues_in_order():
    matrix, basis = _planted([1.0, -8.0, 4.0, -2.0, 0.5])
    value, vector, residual = power(matrix, terms=3, steps=60)
    assert residual.shape == (3, 60)
    np.testing.assert_allclose(value, [-8, 4, -2], rtol=1e-5)
    np.testing.assert_allclose(np.abs(vector.T @ basis[:, [1, 2, 3]]), np.eye(3), atol=1e-4)
    assert np.all(residual[:, -1] < 1e-5)


def test_power_iteration_stalls_between_eigenvalues_of_opposite_sign_and_its_residual_tells():
    matrix, _ = _planted([242.0, -241.99, 240.0, -239.8, 10.0])
    value, vector, residual = power(matrix, terms=1, steps=60)
    # The Rayleigh quotient has settled, as the published criterion asks, on no eigenvalue.
    before, _, _ = power(matrix, terms=1, steps=58)
    assert np.abs(value[0] - before[0]) < 1
    assert np.abs(value[0]) < 230
    assert residual[0, -1] > 0.3
    assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)
    exact, _, residual = symmetric(matrix, terms=1)
    assert exact[0] == pytest.approx(242, rel=1e-5)
    assert residual[-1] < 1e-4


@pytest.mark.parametrize("solve", [eigen.symmetric, eigen.power])
@pytest.mark.parametrize("terms", [0, 21])
def test_more_terms_than_rows_are_refused(terms, solve):
    with pytest.raises(ValueError, match="terms must be between 1 and"):
        solve(np.eye(20, dtype=np.float32), terms=terms)


def test_orientation_makes_one_basis_of_all_that_rounding_may_choose_and_keeps_different_values_apart():
    random = np.random.default_rng(1)
    basis = np.linalg.qr(random.normal(size=(50, 6)))[0]
    value = np.array([9.0, 5.0, 5.0 - 1e-6, 5.0 - 2e-6, -2.0, 1.0])
    expected = basis @ eigen.orientation(value, basis)
    for _ in range(4):
        turn = np.diag(random.choice([-1.0, 1.0], 6))
        turn[1:4, 1:4] = np.linalg.qr(random.normal(size=(3, 3)))[0]
        again = basis @ turn
        np.testing.assert_allclose(again @ eigen.orientation(value, again), expected, atol=1e-12)
    np.testing.assert_allclose(np.abs(expected.T @ basis)[[0, 4, 5]], np.eye(6)[[0, 4, 5]], atol=1e-12)


@pytest.mark.parametrize(("size", "rank", "least", "sweeps"), [(200, 4, 0.1, 8), (384, 30, 0.01, 3)])
def test_more_sweeps_than_the_rank_needs_keep_all_of_a_matrix(size, rank, least, sweeps):
    rng, residuals = np.random.default_rng(0), []
    for _ in range(4):
        left, right = (np.linalg.qr(rng.standard_normal((count, rank)))[0] for count in (size, rank))
        matrix = jnp.asarray((left * np.geomspace(0.5, least, rank)) @ right.T, jnp.float32)
        residuals.append(left_singular(matrix, terms=rank, steps=sweeps)[2])
    # Measured 1e-6. By two projections up to 4.5e-6 here, and 5.6e-3 by jaxlib 0.12 on a matrix of clustered transport.
    assert np.max(residuals) < 2e-6
