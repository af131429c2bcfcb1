"""Tucker decompositions against what numpy's singular value decomposition of the unfoldings says."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published.tensors import hooi
from jaxprt.decompose import tucker

EXACT = 2e-5  # Relative L2 error of a tensor whose ranks are the ones asked for.
KINDS = [tucker.hosvd, tucker.truncated, lambda tensor, ranks: hooi(tensor, ranks=ranks)[0]]
each_kind = pytest.mark.parametrize("decompose", KINDS, ids=["hosvd", "truncated", "hooi"])


def planted(shape, ranks, seed=0):
    random = np.random.default_rng(seed)
    tensor = random.standard_normal(ranks)
    for mode, (size, rank) in enumerate(zip(shape, ranks, strict=True)):
        factor, _ = np.linalg.qr(random.standard_normal((size, rank)))
        tensor = np.moveaxis(np.tensordot(factor, tensor, (1, mode)), 0, mode)
    return tensor


def decaying(shape, seed=0):
    """A tensor of full rank whose singular values fall."""
    tensor = np.random.default_rng(seed).standard_normal(shape)
    for mode, size in enumerate(shape):
        scale = 0.6 ** np.arange(size)
        tensor = tensor * scale.reshape([-1 if i == mode else 1 for i in range(len(shape))])
    return planted_rotations(tensor, seed + 1)


def planted_rotations(tensor, seed):
    random = np.random.default_rng(seed)
    for mode, size in enumerate(tensor.shape):
        turn, _ = np.linalg.qr(random.standard_normal((size, size)))
        tensor = np.moveaxis(np.tensordot(turn, tensor, (1, mode)), 0, mode)
    return tensor


def left_out(tensor, ranks):
    """For each mode the sum of the squared singular values that its rank leaves out."""
    spectra = [np.linalg.svd(np.moveaxis(tensor, m, 0).reshape(n, -1))[1] for m, n in enumerate(tensor.shape)]
    return np.array([np.sum(s[r:] ** 2) for s, r in zip(spectra, ranks, strict=True)])


@jax.jit
def full(decomposition):
    return decomposition.full()


@functools.cache
def square_slope(decompose):
    """Gradient of the square of the reconstruction, one program for all tensors."""
    return jax.jit(jax.grad(lambda x: jnp.sum(decompose(x, ranks=(3, 3, 3)).full() ** 2)))


def distance(decomposition, tensor):
    return np.linalg.norm(np.asarray(full(decomposition), float) - tensor)


@each_kind
@pytest.mark.parametrize(
    ("shape", "ranks"),
    [((9, 12, 7), (2, 3, 4)), ((20, 5), (3, 3)), ((4, 5, 6, 7), (2, 2, 3, 3)), ((6, 6, 6), (6, 6, 6))],
)
def test_planted_ranks_are_found_and_factors_orthonormal(decompose, shape, ranks):
    tensor = planted(shape, ranks)
    found = decompose(jnp.asarray(tensor.astype(np.float32)), ranks=ranks)
    assert found.ranks == ranks
    assert distance(found, tensor) < EXACT * np.linalg.norm(tensor)
    for factor, size, rank in zip(map(np.asarray, found.factor), shape, ranks, strict=True):
        assert factor.shape == (size, rank)
        np.testing.assert_allclose(factor.T @ factor, np.eye(rank), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.core), np.linalg.norm(tensor), rtol=1e-4)


@each_kind
def test_the_error_is_within_the_bounds_of_the_theorems(decompose, x64):
    tensor, ranks = decaying((10, 14, 12)), (3, 4, 5)
    out = left_out(tensor, ranks)
    error = distance(decompose(jnp.asarray(tensor), ranks=ranks), tensor)
    # No decomposition of these ranks is better than the worst mode alone, and these are at most the sum of all.
    assert np.sqrt(out.max()) * (1 - 1e-9) <= error <= np.sqrt(out.sum()) * (1 + 1e-9)


def test_hosvd_is_that_of_numpy(x64):
    tensor, ranks = decaying((8, 9, 10)), (3, 3, 3)
    basis = [
        np.linalg.svd(np.moveaxis(tensor, m, 0).reshape(n, -1), full_matrices=False)[0][:, :3]
        for m, n in enumerate(tensor.shape)
    ]
    expected = np.einsum("abc,ai,bj,ck,Ai,Bj,Ck->ABC", tensor, *basis, *basis, optimize=True)
    np.testing.assert_allclose(tucker.hosvd(jnp.asarray(tensor), ranks=ranks).full(), expected, atol=1e-9)


@pytest.mark.parametrize("mode", [0, 1, 2, 3])
def test_gram_matrices_and_products_are_those_of_the_unfolding(mode, close):
    tensor = np.random.default_rng(0).standard_normal((3, 4, 5, 6))
    unfolded = np.moveaxis(tensor, mode, 0).reshape(tensor.shape[mode], -1)
    close(tucker.gram(jnp.asarray(tensor.astype(np.float32)), mode=mode), unfolded @ unfolded.T)
    matrix = np.random.default_rng(1).standard_normal((tensor.shape[mode], 2))
    expected = np.moveaxis(np.tensordot(matrix.T, tensor, (1, mode)), 0, mode)
    close(
        tucker.multiply(jnp.asarray(tensor.astype(np.float32)), jnp.asarray(matrix, jnp.float32), mode=mode), expected
    )


@each_kind
def test_gradients_of_the_reconstruction_are_finite_differences(decompose, x64):
    tensor = decaying((6, 7, 5))
    weight, direction = (np.random.default_rng(s).standard_normal(tensor.shape) for s in (3, 4))
    both = jax.jit(jax.value_and_grad(lambda x: jnp.vdot(weight, decompose(x, ranks=(2, 3, 2)).full())))
    step = 1e-6
    expected = (both(tensor + step * direction)[0] - both(tensor - step * direction)[0]) / (2 * step)
    np.testing.assert_allclose(np.vdot(both(tensor)[1], direction), expected, rtol=1e-5)


@each_kind
@pytest.mark.parametrize("kind", ["identity", "constant", "zero", "one rank", "two alike"])
def test_degenerate_tensors_have_finite_decompositions_and_gradients(decompose, kind):
    one = np.einsum("i,j,k->ijk", *(np.arange(1.0, n + 1) for n in (5, 6, 7)))
    tensor = {
        "identity": np.einsum("ij,k->ijk", np.eye(6), np.ones(7))[:5],
        "constant": np.full((5, 6, 7), 3.0),
        "zero": np.zeros((5, 6, 7)),
        "one rank": one,
        "two alike": np.repeat(decaying((5, 6, 7))[:1], 5, 0),
    }[kind]
    found = decompose(jnp.asarray(tensor.astype(np.float32)), ranks=(3, 3, 3))
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))
    for factor in map(np.asarray, found.factor):
        np.testing.assert_allclose(factor.T @ factor, np.eye(3), atol=1e-4)
    if kind in ("constant", "zero", "one rank"):
        assert distance(found, tensor) <= EXACT * np.linalg.norm(tensor)
    gradient = square_slope(decompose)(jnp.asarray(tensor.astype(np.float32)))
    assert np.isfinite(gradient).all()


@each_kind
@pytest.mark.parametrize("ranks", [(2, 2), (2, 2, 0), (2, 2, 8), (1, 1, 1, 1)])
def test_ranks_that_do_not_fit_are_refused(decompose, ranks):
    with pytest.raises(ValueError, match=r"ranks must be one for each mode, from 1 to its size in \[5, 6, 7\], got"):
        decompose(jnp.ones((5, 6, 7)), ranks=ranks)


def test_oriented_factors_do_not_depend_on_signs_and_stand_for_the_same_tensor():
    found = tucker.truncated(jnp.asarray(decaying((5, 6, 7)), jnp.float32), ranks=(3, 3, 3))
    first = tucker.orient(found)
    turned = tucker.Tucker(
        found.core * jnp.array([1, -1, 1.0]), (*found.factor[:2], found.factor[2] * jnp.array([1, -1, 1.0]))
    )
    for one, other in zip(first.factor, tucker.orient(turned).factor, strict=True):
        np.testing.assert_allclose(one, other, atol=EXACT)
    np.testing.assert_allclose(full(first), full(found), atol=EXACT * float(np.linalg.norm(full(found))))


def test_sweeps_never_raise_the_error_and_tell_it(x64):
    tensor = np.random.default_rng(2).standard_normal((12, 11, 10))
    found, error = hooi(jnp.asarray(tensor), ranks=(2, 3, 4), sweeps=6)
    assert error.shape == (7,)
    assert np.all(np.diff(error) <= 1e-12)
    assert error[-1] < error[0] - 1e-3
    np.testing.assert_allclose(error[-1], distance(found, tensor) / np.linalg.norm(tensor), rtol=1e-9)


def test_a_negative_number_of_sweeps_is_refused():
    with pytest.raises(ValueError, match="sweeps must not be negative, got -1"):
        hooi(jnp.ones((3, 4)), ranks=(1, 1), sweeps=-1)


def test_gram_matrices_of_wide_matrices_are_summed_over_blocks_of_columns(close):
    matrix = np.random.default_rng(6).standard_normal((3, 2 * 4096 + 5)).astype(np.float32)
    close(tucker.gram(jnp.asarray(matrix), mode=0), matrix.astype(float) @ matrix.T.astype(float))
