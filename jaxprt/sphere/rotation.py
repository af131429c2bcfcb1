"""Rotation of functions on the sphere that are given by SH coefficients.

A rotation R maps f to s -> f(R^T s). Its matrix D(R) on the coefficients is orthogonal and has one block per band. R is
decomposed into Euler angles: rotations about z, y and z. The rotation about y is a rotation about z between fixed
quarter turns about x. Rotations about z mix pairs of coefficients, and the quarter turns are constant sparse matrices.
Cosines and sines of the angles come from the entries of R, and those of multiples of the angles from a recurrence, so
no trigonometric function is called.

Derivatives with respect to R are defined for rotations: a change dR of the matrix counts as the infinitesimal rotation
w whose cross-product matrix is the antisymmetric part of dR R^T. It changes D by (w_x L_x + w_y L_y + w_z L_z) D, where
the generators L have nonzero entries next to the diagonals only. This is the derivative of the function that replaces
any matrix by the nearest rotation (its polar factor) and then rotates. The gradient lies in the tangent space of the
rotations at R. It is valid at every rotation, including the identity, half turns and rotations about the poles, and so
are second derivatives along rotations.

A reflection, with determinant -1, is -1 times a proper rotation. It changes the sign of odd bands, by s -> f(-s), and
rotates. Matrices must be orthogonal to rounding; for other matrices the result is meaningless.

Reference: Kautz, Sloan, Snyder 2002, appendix.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import harmonics

# Up to this degree every sum is written out, which is fast and compiles in two seconds. Above it compiling would take
# minutes, so whole bands are multiplied by matrices.
_UNROLLED = 6


@jit
def rotate(coefficient: Float[Array, " lm *c"], rotation: Float[Array, "3 3"]) -> Float[Array, " lm *c"]:
    """Rotates a spherical function given by its SH coefficients.

    The result represents s -> f(R^T s), so rotate(evaluate(s), R) == evaluate(R s). Differentiable in both arguments at
    every rotation; the docstring of this module defines the derivative with respect to a matrix.

    Args:
        coefficient: (degree+1)^2 SH coefficients in l(l+1)+m order, with any trailing axes.
        rotation: Matrix of a rotation or a reflection.

    Returns:
        Rotated coefficients in the same units.

    Raises:
        ValueError: The number of rows is not a square.

    Reference: Kautz, Sloan, Snyder 2002, appendix.
    """
    return _rotate(coefficient, rotation)


@jit
def rotate_each(coefficient: Float[Array, "lm c *v"], rotation: Float[Array, "w 3 3"]) -> Float[Array, "lm c w"]:
    """Rotates by many rotations at once, such as those of all vertices. They are the last axis, which is fastest.

    Args:
        coefficient: SH coefficients: one function for all rotations, [lm, c], or one for each, [lm, c, w].
        rotation: Matrices of rotations or reflections.

    Returns:
        Rotated coefficients for each rotation.
    """
    count = rotation.shape[0]
    if coefficient.ndim == 2:
        coefficient = coefficient[..., None]
    elif coefficient.shape[2:] != (count,):
        raise ValueError(
            f"the last axis must have one entry for each of the {count} rotations, got the shape {coefficient.shape}"
        )
    return _rotate(coefficient, jnp.moveaxis(rotation, 0, -1))


@jit
def about_z(
    coefficient: Float[Array, " lm *c"], cosine: Float[Array, "*v"], sine: Float[Array, "*v"]
) -> Float[Array, " lm *d"]:
    """Rotates about z by angles given by their cosine and sine. This mixes orders m and -m of each band.

    The result is a polynomial in cosine and sine, and differentiated as such. If (cosine, sine) is not of unit length,
    order m is also scaled by its length to the power of |m|.

    Args:
        coefficient: SH coefficients in l(l+1)+m order.
        cosine: Cosine of each angle. Its axes broadcast against the last axes of the coefficients.
        sine: Sine of each angle.
    Reference: Kautz, Sloan, Snyder 2002, appendix.
    """
    degree = harmonics.degree_of(coefficient.shape[0])
    angle = _signed_multiples(cosine, sine, degree, coefficient.ndim)
    return jnp.concatenate([_about_z(coefficient[l * l : (l + 1) ** 2], angle) for l in range(degree + 1)])


@functools.partial(jit, static_argnames="degree")
def matrix(rotation: Float[Array, "3 3"], *, degree: int) -> Float[Array, "lm lm"]:
    """Rotation matrix D(R) of SH coefficients, with Y(R s) = D(R) Y(s). It is orthogonal, with one block per band.

    Args:
        rotation: Matrix of a rotation or a reflection.
        degree: Highest degree l of the harmonics.
    """
    return rotate(jnp.eye((degree + 1) ** 2, dtype=rotation.dtype), rotation)


@functools.partial(jax.custom_jvp)
def _rotate(coefficient: Array, rotation: Array) -> Array:
    """Rotates coefficients [lm, *c] by rotations [3, 3, *v], where *v broadcasts against the last axes of *c."""
    degree = harmonics.degree_of(coefficient.shape[0])
    shape = jnp.broadcast_shapes(coefficient.shape[1:], rotation.shape[2:])
    hand = _hand(rotation)
    angle = _euler_angles(rotation * hand)
    if degree <= _UNROLLED:
        row = _turn_rows(coefficient, hand, *(_multiples(*part, degree) for part in angle))
        return jnp.stack([jnp.broadcast_to(part, shape) for part in row])
    band = _turn_bands(coefficient, hand, *(_signed_multiples(*part, degree, coefficient.ndim) for part in angle))
    return jnp.concatenate([jnp.broadcast_to(part, (len(part), *shape)) for part in band])


@functools.partial(_rotate.defjvp, symbolic_zeros=True)
def _rotate_jvp(primal, tangent):
    coefficient, rotation = primal
    result = _rotate(coefficient, rotation)
    change = jnp.zeros_like(result)
    if not isinstance(tangent[0], SymbolicZero):
        change = _rotate(tangent[0], rotation)
    if not isinstance(tangent[1], SymbolicZero):
        relative = jnp.einsum("ij...,kj...->ik...", tangent[1], rotation, precision="highest")
        turn = [(relative[i, j] - relative[j, i]) / 2 for i, j in ((2, 1), (0, 2), (1, 0))]
        change = change + (_generate_rows if len(result) <= (_UNROLLED + 1) ** 2 else _generate)(result, turn)
    return result, change


def _hand(rotation: Array) -> Array:
    """Sign of the determinant: 1 for rotations and -1 for reflections."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    return jnp.where(a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g) < 0, -1, 1).astype(rotation.dtype)


def _turn_rows(coefficient: Array, hand: Array, alpha: tuple, beta: tuple, gamma: tuple) -> list[Array]:
    """Rotated rows of all bands, with every sum written out over its nonzero terms."""

    def about_z(row, angle):
        (cosine, sine), l = angle, len(row) // 2
        pair = [(row[l + m] * cosine[m], row[l - m] * sine[m]) for m in range(1, l + 1)]
        other = [(row[l - m] * cosine[m], row[l + m] * sine[m]) for m in range(1, l + 1)]
        return [a + b for a, b in other[::-1]] + [row[l]] + [a - b for a, b in pair]

    def fixed(row, matrix):
        return [sum(float(entry) * row[j] for j, entry in enumerate(line) if entry) for line in matrix]

    result = []
    for l in range(harmonics.degree_of(len(coefficient)) + 1):
        quarter = _quarter_turn(l)
        row = fixed(about_z(list(coefficient[l * l : (l + 1) ** 2]), gamma), quarter.T)
        row = about_z(fixed(about_z(row, beta), quarter), alpha)
        result.extend([part * hand for part in row] if l % 2 else row)
    return result


def _about_z(row: Array, angle: tuple[Array, Array]) -> Array:
    """One band rotated about z, with cosines and sines from `_signed_multiples`."""
    cosine, sine = (part[(len(part) - len(row)) // 2 :][: len(row)] for part in angle)
    return row * cosine + row[::-1] * sine


def _turn_bands(coefficient: Array, hand: Array, alpha: tuple, beta: tuple, gamma: tuple) -> list[Array]:
    """Rotated bands by matrix products. Cosines and sines are those of m = -degree to degree times the angles."""
    result = []
    for l in range(harmonics.degree_of(len(coefficient)) + 1):
        quarter = jnp.asarray(_quarter_turn(l), coefficient.dtype)
        row = _about_z(coefficient[l * l : (l + 1) ** 2], gamma)
        row = _about_z(jnp.tensordot(quarter.T, row, axes=1, precision="highest"), beta)
        row = _about_z(jnp.tensordot(quarter, row, axes=1, precision="highest"), alpha)
        result.append(row * hand if l % 2 else row)
    return result


def _generate_rows(coefficient: Array, turn: list[Array]) -> Array:
    """Applies w_x L_x + w_y L_y + w_z L_z to coefficients [lm, *c], for an infinitesimal rotation w of arrays [*v]."""
    # Broadcast once, so that the transpose sums over the channels once.
    x, y, z = (jnp.broadcast_to(part, coefficient.shape[1:]) for part in turn)
    result = []
    for l in range(harmonics.degree_of(len(coefficient)) + 1):
        row = coefficient[l * l : (l + 1) ** 2]
        for m in range(-l, l + 1):
            part = -m * z * row[l - m]
            for other, by_x, by_y in _ladder(l, m):
                part = part + by_x * x * row[l - other] + by_y * y * row[l + other]
            result.append(part)
    return jnp.stack(result)


def _generate(coefficient: Array, turn: list[Array]) -> Array:
    """`_generate_rows` for all rows at once: L_y shifts rows by one, L_z reverses bands, and L_x does both."""
    reverse, entry = _generators(harmonics.degree_of(len(coefficient)))
    entry = jnp.asarray(entry, coefficient.dtype).reshape(5, -1, *(1,) * (coefficient.ndim - 1))
    reversed_ = coefficient[reverse]
    none = jnp.zeros_like(coefficient[:1])

    def beside(rows, below, above):
        return below * jnp.concatenate([none, rows[:-1]]) + above * jnp.concatenate([rows[1:], none])

    x, y, z = (jnp.broadcast_to(part, coefficient.shape[1:]) for part in turn)
    return x * beside(reversed_, *entry[:2]) + y * beside(coefficient, *entry[2:4]) + z * entry[4] * reversed_


@functools.lru_cache(maxsize=16)
def _generators(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the rows with every band reversed; and the entries of L_x and L_y below and above, and of L_z."""
    reverse, entry = [], np.zeros((5, (degree + 1) ** 2))
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            place = l * (l + 1) + m
            reverse.append(place - 2 * m)
            entry[4, place] = -m
            for other, by_x, by_y in _ladder(l, m):
                entry[int(other > m), place], entry[2 + int(other > m), place] = by_x, by_y
    return np.array(reverse, np.int32), entry


def _ladder(l: int, m: int) -> list[tuple[int, float, float]]:
    """Nonzero entries of two generators in row m: m' = m +- 1, that of L_x in column -m', that of L_y in column m'."""
    entry = []
    for other in (m - 1, m + 1):
        low, high = sorted((abs(m), abs(other)))
        size = math.sqrt((l - low) * (l + high)) / 2 * (math.sqrt(2) if low == 0 else 1)
        by_x = 0.0 if (m, other) in ((0, -1), (1, 0)) else math.copysign(size, m)
        by_y = 0.0 if {m, other} == {0, -1} else math.copysign(size, abs(m) - abs(other))
        if high <= l:
            entry.append((other, by_x, by_y))
    return entry


def _euler_angles(rotation: Array) -> list[tuple[Array, Array]]:
    """Cosine and sine of alpha, beta, gamma with R = R_z(alpha) R_y(beta) R_z(gamma)."""
    # alpha is arbitrary if the rotation fixes or exchanges the poles, and inaccurate nearby, from tiny entries. This
    # does not matter, because gamma compensates for it.
    alpha = _unit(rotation[0, 2], rotation[1, 2])
    cosine, sine = alpha
    beta = _unit(rotation[2, 2], cosine * rotation[0, 2] + sine * rotation[1, 2])
    gamma = _unit(
        cosine * rotation[1, 1] - sine * rotation[0, 1],
        cosine * rotation[1, 0] - sine * rotation[0, 0],
    )
    return [alpha, beta, gamma]


def _unit(x: Array, y: Array) -> tuple[Array, Array]:
    """Scales (x, y) to unit length. The result is (1, 0) where the squares underflow."""
    square = x**2 + y**2
    zero = square < jnp.finfo(x.dtype).tiny
    scale = jax.lax.rsqrt(jnp.where(zero, 1, square))
    return jnp.where(zero, 1, x * scale), jnp.where(zero, 0, y * scale)


def _multiples(cosine: Array, sine: Array, degree: int) -> tuple[list[Array], list[Array]]:
    """Cosines and sines of 0, 1, ..., degree times an angle."""
    real, imaginary = [jnp.ones_like(cosine)], [jnp.zeros_like(sine)]
    for _ in range(degree):
        a, b = real[-1], imaginary[-1]
        real.append(a * cosine - b * sine)
        imaginary.append(b * cosine + a * sine)
    return real, imaginary


def _signed_multiples(cosine: Array, sine: Array, degree: int, axes: int) -> tuple[Array, Array]:
    """Cosines and negated sines of -degree to degree times an angle, with axes that broadcast to `axes` axes."""

    def step(power, _):
        a, b = power
        return (a * cosine - b * sine, b * cosine + a * sine), power

    _, (real, imaginary) = jax.lax.scan(step, (jnp.ones_like(cosine), jnp.zeros_like(sine)), length=degree + 1)
    both = jnp.concatenate([real[:0:-1], real]), jnp.concatenate([imaginary[:0:-1], -imaginary])
    shape = (2 * degree + 1, *(1,) * (axes - 1 - cosine.ndim), *cosine.shape)
    return both[0].reshape(shape), both[1].reshape(shape)


@functools.lru_cache(maxsize=128)
def _quarter_turn(l: int) -> np.ndarray:
    """Block D of one band for the quarter turn about x that maps z to y: the exponential of pi / 2 times L_x."""
    generator = np.zeros((2 * l + 1, 2 * l + 1))
    for m in range(-l, l + 1):
        for other, by_x, _ in _ladder(l, m):
            generator[l + m, l - other] = by_x
    # The eigenvalues of i L_x are integers, so only its eigenvectors have rounding errors.
    order, vector = np.linalg.eigh(1j * generator)
    matrix = ((vector * 1j ** np.round(order)) @ vector.conj().T).real
    # Parity in x is preserved, parity in y and z exchanged, so three quarters of the entries are zero.
    matrix[np.abs(matrix) < 1e-12] = 0
    return matrix
