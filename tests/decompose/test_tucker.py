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
    [((20, 5), (3, 3)), ((4, 5, 6, 7), (2, 2, 3, 3)), ((6, 6, 6), (6, 6, 6))],
)
def test_planted_ranks_are_found_and_factors_orthonormal(decompose, shape, ranks):
    tensor = planted(shape, ranks)
    found = decompose(tensor.astype(np.float32), ranks=ranks)
    assert found.ranks == ranks
    assert distance(found, tensor) < EXACT * np.linalg.norm(tensor)
    for factor, size, rank in zip(map(np.asarray, found.factor), shape, ranks, strict=True):
        assert factor.shape == (size, rank)
        np.testing.assert_allclose(factor.T @ factor, np.eye(rank), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.core), np.linalg.norm(tensor), rtol=1e-4)


@each_kind
def test_the_error_is_within_the_bounds_of_the_theorems(decompose, x64):
    tensor, ranks = decaying((6, 7, 5)), (2, 3, 2)
    out = left_out(tensor, ranks)
    found = decompose(tensor, ranks=ranks)
    error = distance(found, tensor)
    if decompose is tucker.hosvd:
        basis = [
            np.linalg.svd(np.moveaxis(tensor, mode, 0).reshape(size, -1), full_matrices=False)[0][:, :rank]
            for mode, (size, rank) in enumerate(zip(tensor.shape, ranks, strict=True))
        ]
        expected = np.einsum("abc,ai,bj,ck,Ai,Bj,Ck->ABC", tensor, *basis, *basis, optimize=True)
        np.testing.assert_allclose(full(found), expected, atol=1e-9)
    if decompose is KINDS[2]:
        told = np.asarray(hooi(tensor, ranks=ranks, sweeps=6)[1])
        assert told.shape == (7,)
        assert np.all(np.diff(told) <= 1e-12)
        assert told[-1] <= error / np.linalg.norm(tensor) * (1 + 1e-6)
    # No decomposition of these ranks is better than the worst mode alone, and these are at most the sum of all.
    assert np.sqrt(out.max()) * (1 - 1e-9) <= error <= np.sqrt(out.sum()) * (1 + 1e-9)


@pytest.mark.parametrize(("shape", "mode"), [((3, 4, 5, 6), 0), ((3, 4, 5, 6), 2), ((3, 2 * 4096 + 5), 0)])
def test_gram_matrices_and_products_are_those_of_the_unfolding(shape, mode, close):
    """Wide matrices are summed over blocks of columns."""
    tensor = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    unfolded = np.moveaxis(tensor.astype(float), mode, 0).reshape(shape[mode], -1)
    close(tucker.gram(tensor, mode=mode), unfolded @ unfolded.T)
    matrix = np.random.default_rng(1).standard_normal((shape[mode], 2)).astype(np.float32)
    expected = np.moveaxis(np.tensordot(matrix.T.astype(float), tensor, (1, mode)), 0, mode)
    close(tucker.multiply(tensor, matrix, mode=mode), expected)


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
    found = decompose(tensor.astype(np.float32), ranks=(3, 3, 3))
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))
    for factor in map(np.asarray, found.factor):
        np.testing.assert_allclose(factor.T @ factor, np.eye(3), atol=1e-4)
    if kind in ("constant", "zero", "one rank"):
        assert distance(found, tensor) <= EXACT * np.linalg.norm(tensor)
    gradient = square_slope(decompose)(tensor.astype(np.float32))
    assert np.isfinite(gradient).all()


@each_kind
def test_ranks_that_do_not_fit_are_refused(decompose):
    for ranks in ((2, 2), (2, 2, 0), (2, 2, 8), (1, 1, 1, 1)):
        with pytest.raises(ValueError, match=r"one for each mode, from 1 to its size in \[5, 6, 7\], got"):
            decompose(np.ones((5, 6, 7), np.float32), ranks=ranks)
    with pytest.raises(ValueError, match="sweeps must not be negative, got -1"):
        hooi(np.ones((3, 4), np.float32), ranks=(1, 1), sweeps=-1)


def test_oriented_factors_do_not_depend_on_signs_and_stand_for_the_same_tensor():
    found = jax.tree.map(np.asarray, tucker.truncated(decaying((5, 6, 7)).astype(np.float32), ranks=(3, 3, 3)))
    first = tucker.orient(found)
    sign = np.float32([1, -1, 1])
    factor = *found.factor[:2], found.factor[2] * sign
    turned = tucker.Tucker(jnp.asarray(found.core * sign), tuple(map(jnp.asarray, factor)))
    for one, other in zip(first.factor, tucker.orient(turned).factor, strict=True):
        np.testing.assert_allclose(one, other, atol=EXACT)
    np.testing.assert_allclose(full(first), full(found), atol=EXACT * float(np.linalg.norm(full(found))))
