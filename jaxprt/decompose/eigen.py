"""Leading eigenvectors and singular vectors by block Krylov iteration, and one by one by power iteration.

A block of `terms` + 8 vectors is multiplied a few times; the span of all the products is searched for the block that
is best in it (Rayleigh-Ritz), and the search starts again from there. One vector at a time with deflation, as Wang et
al. print it, does not converge where eigenvalues of opposite sign are nearly equal, as they are in BRDF matrices; the
block does.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit

_OVERSAMPLE = 8
_DEPTH = 5  # Blocks in the span, at most; one block alone needs five times as many products on BRDF matrices.
_EQUAL = 1e-3  # difference of neighboring eigenvalues, as a share of the larger, below which they count as equal
_WIDTH = 512  # Vectors in the span, about at most: its own eigenvectors must not cost more than the products.


def _iterate(apply: Callable, size: int, terms: int, steps: int, dtype) -> tuple[Array, Array, Array]:
    """Block Krylov iteration for a symmetric operator; eigenpairs by falling magnitude and residuals per step."""
    block = min(terms + _OVERSAMPLE, size)
    depth = max(2, min(_DEPTH, _WIDTH // block))
    draw = jax.random.normal(jax.random.key(0), (depth, size, block), dtype)
    if depth * block >= size:  # The whole space, in any basis.
        block, depth, draw = size, 1, jnp.eye(size, dtype=dtype)[None]

    def grow(carry, item):
        basis, image, fresh = carry
        place, noise = item
        # Random vectors stand in where a product adds nothing to the span. Projecting twice is then enough.
        fresh = _normalized(fresh) + 10 * jnp.finfo(dtype).eps * _normalized(noise)
        for _ in range(2):
            fresh = _orthonormal(fresh - basis @ (basis.T @ fresh))
        product = apply(fresh)
        basis, image = (
            jax.lax.dynamic_update_slice(every, each, (0, place)) for every, each in ((basis, fresh), (image, product))
        )
        return (basis, image, product), None

    def step(carry, sweep):
        fresh = _orthonormal(carry[0])
        product = apply(fresh)
        basis, image = (jnp.pad(each, ((0, 0), (0, (depth - 1) * block))) for each in (fresh, product))
        # Others in each sweep, which keeps the random vectors of the last one in its own.
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
    """Householder's QR: orthonormal columns whatever the rank."""
    return jnp.linalg.qr(vector)[0]


def _normalized(vector: Array) -> Array:
    length = jnp.linalg.norm(vector, axis=0)
    return vector / jnp.where(length > 0, length, 1)


def _check(terms: int, size: int) -> None:
    if not 1 <= terms <= size:
        raise ValueError(f"terms must be between 1 and the matrix's rank bound {size}, got {terms}")


@partial(jit, static_argnames=("terms", "steps"))
def symmetric(
    matrix: Float[Array, "n n"], *, terms: int, steps: int = 2
) -> tuple[Float[Array, " r"], Float[Array, "n r"], Float[Array, " s"]]:
    """Eigenpairs of largest magnitude of a symmetric matrix, either sign.

    Args:
        matrix: A symmetric matrix.
        terms: How many pairs.
        steps: Number of sweeps. A sweep is five products of the matrix with a block of `terms` + 8 vectors, fewer for
            more than 94 terms.

    Returns:
        Eigenvalues by falling magnitude, unit eigenvectors as columns, and after each sweep the relative residual
        |A V - V D| / |D| of the pairs asked for.

    Raises:
        ValueError: More terms than rows.

    Reference: Musco and Musco 2015, algorithm 2; for the use, Wang, Tran, Luebke 2004, appendix.
    """
    _check(terms, matrix.shape[0])
    return _iterate(lambda x: matrix @ x, matrix.shape[0], terms, steps, matrix.dtype)


@partial(jit, static_argnames=("terms", "steps"))
def left_singular(
    matrix: Float[Array, "m n"], *, metric: Float[Array, "n n"] | None = None, terms: int, steps: int = 2
) -> tuple[Float[Array, " r"], Float[Array, "m r"], Float[Array, " s"]]:
    """Leading left singular vectors of M C^(1/2), for a metric C that need not be factored.

    They span the best subspace for the images M x of random x with covariance C, since these are the eigenvectors
    of M C M^T.

    Args:
        matrix: M.
        metric: C, symmetric and positive semidefinite; the identity if None.
        terms: How many vectors.
        steps: Number of sweeps, as in `symmetric`.

    Returns:
        Squared singular values, falling; orthonormal vectors as columns; residuals as in `symmetric`.

    Raises:
        ValueError: More terms than rows or columns.
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
    """Eigenpairs of a symmetric matrix one after the other, by power iteration with deflation, as published.

    For each term a random vector is multiplied by what the terms before it leave of the matrix, and normalized, a fixed
    number of times. Where two eigenvalues of largest magnitude are nearly equal and of opposite sign the vector stays a
    mixture of both eigenvectors, whose Rayleigh quotient lies between the two and hardly moves: the published
    criterion, that it converges, is met by a wrong term. The residual stays large, and so tells it. `symmetric` has no
    such case.

    Args:
        matrix: A symmetric matrix.
        terms: How many pairs.
        steps: Sweeps of each term; a sweep is one product with the matrix.

    Returns:
        Eigenvalues in the order found, which is by falling magnitude where they have converged; unit vectors as
        columns, orthogonal as far as they have converged; and after each sweep of each term the relative residual
        |A v - value v| / |value|.

    Raises:
        ValueError: More terms than rows.

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
    """The rotation after which eigenvectors are the same on every kind of processor, up to rounding.

    Rounding decides the signs of eigenvectors, and which basis stands for equal eigenvalues. Here each vector, and each
    set of vectors whose eigenvalues are nearly equal, is turned so that its products with fixed random vectors are
    triangular with a positive diagonal. Values on both sides of a cut may be equal too: then only more vectors help.

    Args:
        value: Eigenvalues, falling.
        vector: Orthonormal eigenvectors as columns.

    Returns:
        An orthogonal matrix that mixes only vectors of nearly equal eigenvalues: multiply the columns by it.
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
