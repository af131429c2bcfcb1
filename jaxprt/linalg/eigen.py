"""Leading eigenvectors and singular vectors by block subspace iteration.

A block of `terms + oversample` vectors is multiplied, orthonormalized and rotated (Rayleigh-Ritz) a fixed number of
times. One vector at a time with deflation, as Wang et al. print it, does not converge where eigenvalues of opposite
sign are nearly equal, as they are in BRDF matrices; the block does.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_OVERSAMPLE = 8


def _iterate(apply: Callable, size: int, terms: int, steps: int, dtype) -> tuple[Array, Array, Array]:
    """Subspace iteration for a symmetric operator; eigenpairs by falling magnitude and residuals per step."""
    block = min(terms + _OVERSAMPLE, size)
    start = jax.random.normal(jax.random.key(0), (size, block), dtype)

    def step(carry, _):
        vector, _ = jnp.linalg.qr(carry[0])
        image = apply(vector)
        ritz = vector.T @ image
        value, rotation = jnp.linalg.eigh((ritz + ritz.T) / 2)
        order = jnp.argsort(-jnp.abs(value))
        value, rotation = value[order], rotation[:, order]
        vector, image = vector @ rotation, image @ rotation
        error = jnp.linalg.norm((image - vector * value)[:, :terms])
        scale = jnp.linalg.norm(value[:terms])
        residual = jnp.where(scale > 0, error / jnp.where(scale > 0, scale, 1), 0)
        # Where the operator gives nothing the old vectors stand in, so that QR never meets a zero column.
        alive = jnp.linalg.norm(image, axis=0) > 0
        return (jnp.where(alive, image, vector), vector, value), residual

    empty = (start, jnp.zeros_like(start), jnp.zeros(block, dtype))
    (_, vector, value), residual = jax.lax.scan(step, empty, None, length=steps)
    return value[:terms], vector[:, :terms], residual


def _check(terms: int, size: int) -> None:
    if not 1 <= terms <= size:
        raise ValueError(f"terms must be between 1 and the matrix's rank bound {size}, got {terms}")


@partial(jax.jit, static_argnames=("terms", "steps"))
def symmetric(
    matrix: Float[Array, "n n"], *, terms: int, steps: int = 30
) -> tuple[Float[Array, " r"], Float[Array, "n r"], Float[Array, " s"]]:
    """Eigenpairs of largest magnitude of a symmetric matrix, either sign.

    Args:
        matrix: A symmetric matrix.
        terms: How many pairs.
        steps: Number of sweeps.

    Returns:
        Eigenvalues by falling magnitude, unit eigenvectors as columns, and after each sweep the relative residual
        |A V - V D| / |D| of the pairs asked for.

    Raises:
        ValueError: More terms than rows.

    Reference: Halko, Martinsson, Tropp 2011, section 4.5; for the use, Wang, Tran, Luebke 2004, appendix.
    """
    _check(terms, matrix.shape[0])
    return _iterate(lambda x: matrix @ x, matrix.shape[0], terms, steps, matrix.dtype)


@partial(jax.jit, static_argnames=("terms", "steps"))
def left_singular(
    matrix: Float[Array, "m n"], metric: Float[Array, "n n"], *, terms: int, steps: int = 30
) -> tuple[Float[Array, " r"], Float[Array, "m r"], Float[Array, " s"]]:
    """Leading left singular vectors of M C^(1/2), for a metric C that need not be factored.

    They span the best subspace for the images M x of random x with covariance C, since these are the eigenvectors
    of M C M^T.

    Args:
        matrix: M.
        metric: C, symmetric and positive semidefinite.
        terms: How many vectors.
        steps: Number of sweeps.

    Returns:
        Squared singular values, falling; orthonormal vectors as columns; residuals as in `symmetric`.

    Raises:
        ValueError: More terms than rows or columns.
    """
    _check(terms, min(matrix.shape))
    value, vector, residual = _iterate(
        lambda x: matrix @ (metric @ (matrix.T @ x)), matrix.shape[0], terms, steps, matrix.dtype
    )
    return jnp.maximum(value, 0), vector, residual
