"""Leading eigenvectors and singular vectors, by block Krylov iteration or by power iteration with deflation.

A block of `terms` + 8 vectors is multiplied by the matrix a few times. Rayleigh-Ritz finds the best block in the span
of all products, and the iteration restarts from that block. Power iteration on one vector at a time with deflation, as
in Wang et al. 2004, does not converge where eigenvalues of opposite sign have nearly the same magnitude. BRDF matrices
have such eigenvalues; the block iteration converges for them.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit

_OVERSAMPLE = 8
_DEPTH = 5  # most blocks in the span; a single block needs five times as many products on BRDF matrices
_EQUAL = 1e-3  # neighboring eigenvalues with a smaller relative difference count as equal
_WIDTH = 512  # approximate limit of vectors in the span: its eigenproblem must not cost more than the products


def _iterate(apply: Callable, size: int, terms: int, steps: int, dtype) -> tuple[Array, Array, Array]:
    """Block Krylov iteration for a symmetric operator: eigenpairs by descending magnitude, and a residual per step."""
    block = min(terms + _OVERSAMPLE, size)
    depth = max(2, min(_DEPTH, _WIDTH // block))
    draw = jax.random.normal(jax.random.key(0), (depth, size, block), dtype)
    if depth * block >= size:  # the span is the whole space
        block, depth, draw = size, 1, jnp.eye(size, dtype=dtype)[None]

    def grow(carry, item):
        basis, image, fresh = carry
        place, noise = item
        # Random vectors replace products that add nothing to the span. The first projection leaves rounding of those,
        # which may lie in the span; after three all vectors are orthogonal to it.
        fresh = _normalize(fresh) + 10 * jnp.finfo(dtype).eps * _normalize(noise)
        for _ in range(3):
            fresh = _orthonormal(fresh - basis @ (basis.T @ fresh))
        product = apply(fresh)
        basis, image = (
            jax.lax.dynamic_update_slice(whole, part, (0, place)) for whole, part in ((basis, fresh), (image, product))
        )
        return (basis, image, product), None

    def step(carry, sweep):
        fresh = _orthonormal(carry[0])
        product = apply(fresh)
        basis, image = (jnp.pad(array, ((0, 0), (0, (depth - 1) * block))) for array in (fresh, product))
        # Other random vectors in each sweep, because the span already contains those of the last sweep.
        items = block * jnp.arange(1, depth), jnp.roll(draw[1:], sweep, 1)
        (basis, image, _), _ = jax.lax.scan(grow, (basis, image, product), items)
        ritz = basis.T @ image
        value, rotation = jnp.linalg.eigh((ritz + ritz.T) / 2)
        order = jnp.argsort(-jnp.abs(value))[:block]
        value, rotation = value[order], rotation[:, order]
        vector, image = basis @ rotation, image @ rotation
        error = jnp.linalg.norm((image - vector * value)[:, :terms])
        scale = jnp.linalg.norm(value[:terms])
        residual = jnp.where(scale > 0, error / jnp.where(scale > 0, scale, 1), 0)
        return (vector, value), residual

    (vector, value), residual = jax.lax.scan(step, (draw[0], jnp.zeros(block, dtype)), jnp.arange(steps))
    return value[:terms], vector[:, :terms], residual


def _orthonormal(vector: Array) -> Array:
    """Orthonormal columns by Householder QR, for matrices of any rank."""
    return jnp.linalg.qr(vector)[0]


def _normalize(vector: Array) -> Array:
    length = jnp.linalg.norm(vector, axis=0)
    return vector / jnp.where(length > 0, length, 1)


def _check(terms: int, size: int) -> None:
    if not 1 <= terms <= size:
        raise ValueError(f"terms must be between 1 and the matrix's rank bound {size}, got {terms}")


@partial(jit, static_argnames=("terms", "steps"))
def symmetric(
    matrix: Float[Array, "n n"], *, terms: int, steps: int = 2
) -> tuple[Float[Array, " r"], Float[Array, "n r"], Float[Array, " s"]]:
    """Eigenpairs of a symmetric matrix with the eigenvalues of largest magnitude, of either sign.

    Args:
        matrix: A symmetric matrix.
        terms: Number of eigenpairs.
        steps: Number of sweeps. A sweep multiplies the matrix five times by a block of `terms` + 8 vectors, fewer times
            for more than 94 terms.

    Returns:
        Eigenvalues by descending magnitude; unit eigenvectors as columns; and, after each sweep, the relative residual
        |A V - V D| / |D| of the returned pairs.
    Reference: Musco and Musco 2015, algorithm 2; for the use, Wang, Tran, Luebke 2004, appendix.
    """
    _check(terms, matrix.shape[0])
    return _iterate(lambda x: matrix @ x, matrix.shape[0], terms, steps, matrix.dtype)


@partial(jit, static_argnames=("terms", "steps"))
def left_singular(
    matrix: Float[Array, "m n"], *, metric: Float[Array, "n n"] | None = None, terms: int, steps: int = 2
) -> tuple[Float[Array, " r"], Float[Array, "m r"], Float[Array, " s"]]:
    """Leading left singular vectors of M C^(1/2). The metric C need not be factored.

    The vectors are the eigenvectors of M C M^T. They span the subspace that best represents M x for random x with
    covariance C.

    Args:
        matrix: The matrix M.
        metric: The metric C, symmetric and positive semidefinite; the identity if None.
        terms: Number of singular vectors.
        steps: Number of sweeps. A sweep multiplies M C M^T five times by a block of `terms` + 8 vectors, fewer times
            for more than 94 terms.

    Returns:
        Squared singular values in descending order; orthonormal vectors as columns; and, after each sweep, the
        relative residual of these eigenpairs of M C M^T.
    """
    _check(terms, min(matrix.shape))

    def apply(block):
        image = matrix.T @ block
        return matrix @ (image if metric is None else metric @ image)

    value, vector, residual = _iterate(apply, matrix.shape[0], terms, steps, matrix.dtype)
    return jnp.maximum(value, 0), vector, residual


@partial(jit, static_argnames=("terms", "steps"))
def power(
    matrix: Float[Array, "n n"], *, terms: int, steps: int = 100
) -> tuple[Float[Array, " r"], Float[Array, "n r"], Float[Array, "r s"]]:
    """Eigenpairs of a symmetric matrix one after another, by power iteration with deflation, as published.

    Each term starts from a random vector. A fixed number of times the vector is multiplied by the deflated matrix and
    normalized. Where the two largest eigenvalues have nearly the same magnitude and opposite sign, the vector remains a
    mixture of both eigenvectors. Its Rayleigh quotient lies between the two eigenvalues and hardly changes, so the
    published convergence criterion accepts a wrong term. The residual stays large in that case and reveals it. The
    method of `symmetric` does not have this problem.

    Args:
        matrix: A symmetric matrix.
        terms: Number of eigenpairs.
        steps: Number of sweeps for each term. A sweep is one product with the matrix.

    Returns:
        Eigenvalues in the order found (descending magnitude if they have converged); unit vectors as columns
        (orthogonal if they have converged); and, after each sweep of each term, the relative residual
        |A v - value v| / |value|.
    Reference: Wang, Tran, Luebke 2004, appendix.
    """
    size, dtype = matrix.shape[0], matrix.dtype
    _check(terms, size)

    def term(carry, item):
        values, vectors = carry
        index, key = item

        def sweep(carry, _):
            image = carry[0]
            length = jnp.linalg.norm(image)
            vector = jnp.where(length > 0, image / jnp.where(length > 0, length, 1), carry[1])
            product = matrix @ vector
            image = product - vectors @ (values * (vector @ vectors))
            value = vector @ image
            error, scale = jnp.linalg.norm(product - value * vector), jnp.abs(value)
            return (image, vector, value), jnp.where(scale > 0, error / jnp.where(scale > 0, scale, 1), 0)

        start = jax.random.normal(key, (size,), dtype)
        empty = (start, jnp.zeros(size, dtype), jnp.zeros((), dtype))
        (_, vector, value), residual = jax.lax.scan(sweep, empty, None, length=steps)
        return (values.at[index].set(value), vectors.at[:, index].set(vector)), residual

    empty = (jnp.zeros(terms, dtype), jnp.zeros((size, terms), dtype))
    items = (jnp.arange(terms), jax.random.split(jax.random.key(0), terms))
    (values, vectors), residual = jax.lax.scan(term, empty, items)
    return values, vectors, residual


def orientation(value: Float[np.ndarray, " r"], vector: Float[np.ndarray, "n r"]) -> Float[np.ndarray, "r r"]:
    """Orthogonal matrix that makes eigenvectors the same on every processor, up to rounding.

    Rounding determines the signs of eigenvectors and the basis that represents equal eigenvalues. This function turns
    each vector, and each set of vectors with nearly equal eigenvalues, so that its products with fixed random vectors
    form a triangular matrix with a positive diagonal. If eigenvalues on both sides of a truncation are equal, this does
    not help; only more vectors do.

    Args:
        value: Eigenvalues in descending order of magnitude.
        vector: Orthonormal eigenvectors as columns.

    Returns:
        An orthogonal matrix that mixes only vectors of nearly equal eigenvalues. Multiply `vector` by it from the
        right.
    """
    value, vector = np.abs(np.asarray(value, np.float64)), np.asarray(vector, np.float64)
    probe = np.random.default_rng(0).normal(size=vector.shape)
    falls = value[:-1] - value[1:] > _EQUAL * value[:-1]
    first = np.flatnonzero(np.concatenate([[True], falls]))
    result = np.zeros((len(value), len(value)))
    for start, end in zip(first, [*first[1:], len(value)], strict=True):
        turn, triangle = np.linalg.qr(vector[:, start:end].T @ probe[:, : end - start])
        result[start:end, start:end] = turn * np.where(np.diag(triangle) < 0, -1, 1)
    return result
