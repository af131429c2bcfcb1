"""Real spherical harmonics (SH): evaluation, projection of cubemaps, zonal kernels, windows, and circular lights.

The basis is orthonormal, without the Condon-Shortley phase, with polar axis z. Function (l, m) has index l(l+1)+m. The
degree is the largest l; there are (degree+1)^2 functions up to a degree. The first nine, for a unit direction (x, y,
z), are:

    l = 0   sqrt(1 / 4 pi)
    l = 1   sqrt(3 / 4 pi) times y, z, x
    l = 2   sqrt(15 / 4 pi) times x y, y z, (3 z^2 - 1) / sqrt(12), x z, (x^2 - y^2) / 2

A zonal kernel k is a function of the angle to an axis. It is given by one factor per band l, by which convolution with
the kernel multiplies the band: 2 pi times the integral of k(t) P_l(t) over the cosine t. Windows against ringing are
factors per band too. ``convolve`` applies either.
"""

import functools
import math
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Num

from jaxprt.compile import jit
from jaxprt.sphere import cubemap

_NEWTON_STEPS = 12  # ten steps converged for all of thousands of spectra, with shares from 0.9 to 1e-6
_UNROLLED = 8  # above this degree the recurrence is a loop; compiling 50 unrolled steps took twenty seconds


def degree_of(count: int) -> int:
    """The degree, or largest l, of a given number of SH coefficients.

    Args:
        count: Number of coefficients, (degree+1)^2.

    Returns:
        The degree.

    Raises:
        ValueError: `count` is not the square of a positive integer.
    """
    root = math.isqrt(max(count, 0))
    if root < 1 or root**2 != count:
        raise ValueError(f"the number of SH coefficients must be a square number, got {count}")
    return root - 1


@functools.partial(jit, static_argnames="degree")
def evaluate(direction: Num[Array, "*b 3"], *, degree: int) -> Float[Array, "*b lm"]:
    """Evaluates the basis functions for given directions.

    They are computed by recurrences in the Cartesian components, without trigonometric functions. The result is a
    polynomial in the components and differentiated as such: the gradient is finite everywhere, including the poles, and
    its tangential part is the gradient on the sphere. The radial part of the gradient has no meaning.

    Args:
        direction: Unit directions.
        degree: Highest degree l.

    Returns:
        (degree+1)^2 values for each direction, in l(l+1)+m order.

    Raises:
        ValueError: The degree is negative.
    """
    direction = direction.astype(jnp.result_type(direction.dtype, float))  # integers would round the basis
    value = basis(jnp, direction, degree) if degree <= _UNROLLED else _basis_by_scan(direction, degree)
    return jnp.moveaxis(value, 0, -1)


@jit
def reconstruct(coefficient: Float[Array, " lm *c"], direction: Float[Array, "*b 3"]) -> Float[Array, "..."]:
    """Reconstructs the function given by SH coefficients, for given directions.

    Args:
        coefficient: SH coefficients in l(l+1)+m order, with any trailing axes.
        direction: Unit directions. ``evaluate`` describes their gradients.

    Returns:
        Values [*b, *c].

    Raises:
        ValueError: The number of rows is not a square.
    """
    basis = evaluate(direction, degree=degree_of(coefficient.shape[0]))
    return jnp.tensordot(basis, coefficient, axes=1, precision="highest")


@functools.partial(jit, static_argnames="degree")
def project(radiance: Num[Array, "6 n n *c"], *, degree: int) -> Float[Array, " lm *c"]:
    """SH coefficients of a cubemap: the integral of basis times radiance over the sphere.

    Radiance is constant over each texel. The basis functions are integrated over the texel's solid angle by Gauss
    quadrature, exact to about 1e-12, so the result is the projection of the piecewise constant function. Texels that
    are mirror images in the coordinate planes are added and subtracted first, which reduces products and tables to an
    eighth.

    Args:
        radiance: Texels of a cubemap, with any trailing axes.
        degree: Highest degree l.

    Returns:
        SH coefficients in l(l+1)+m order, in units of the radiance times sr^1/2.

    Raises:
        ValueError: The degree is negative, or the cubemap has no texels.
    """
    radiance = radiance.astype(jnp.result_type(radiance.dtype, float))  # integers would round the basis
    size, channel = radiance.shape[1], radiance.shape[3:]
    index, place, table = _projection(size, degree)
    folded = radiance.reshape(6 * size * size, -1)[index]
    for axis in range(3):
        positive, negative = jnp.split(folded, 2, axis)
        folded = jnp.concatenate([positive + negative, positive - negative], axis)
    folded = folded.reshape(8, -1, folded.shape[-1])
    part = [
        jnp.matmul(jnp.asarray(table[parity], radiance.dtype), folded[parity], precision="highest")
        for parity in range(8)
    ]
    return jnp.concatenate(part)[place].reshape(-1, *channel)


def basis(xp: ModuleType, direction: Any, degree: int) -> Any:
    """Basis functions [lm, *b], computed with the array library `xp`, NumPy or JAX.

    sin(theta)^m cos(m phi) and sin(theta)^m sin(m phi) are the real and imaginary parts of (x + iy)^m. The other factor
    is a polynomial in z with a recurrence over l, which is stable for increasing l. Each step computes one band, for
    all m.

    Args:
        xp: `numpy` or `jax.numpy`.
        direction: Unit directions [*b, 3].
        degree: Highest degree l.
    """
    if degree < 0:
        raise ValueError(f"degree must be at least 0, got {degree}")
    x, y, z = (direction[..., i] for i in range(3))
    real, imaginary = [xp.ones_like(x)], [xp.zeros_like(x)]
    for _ in range(degree):
        a, b = real[-1], imaginary[-1]
        real.append(x * a - y * b)
        imaginary.append(x * b + y * a)
    azimuth = xp.stack(imaginary[:0:-1] + real)

    def constant(value):
        return xp.asarray(value, direction.dtype).reshape(-1, *[1] * x.ndim)

    forward, backward, start = _recurrence(degree)
    band, past, now = [], None, None
    for l in range(degree + 1):
        following = xp.broadcast_to(constant(start[l, l]), (1, *x.shape))
        if l > 0:
            higher = constant(forward[l, :l]) * z * now
            if l > 1:
                less = higher[:-1] - constant(backward[l, : l - 1]) * past
                higher = xp.concatenate([less, higher[-1:]])
            following = xp.concatenate([higher, following])
        past, now = now, following
        both_signs = xp.concatenate([now[:0:-1], now])
        band.append(both_signs * azimuth[degree - l : degree + l + 1])
    return xp.concatenate(band)


def _basis_by_scan(direction: Array, degree: int) -> Array:
    """`basis` by loops, over rows that hold all m from 0 to the degree."""
    x, y, z = (direction[..., i] for i in range(3))

    def multiply(power, _):
        a, b = power
        return (x * a - y * b, x * b + y * a), power

    def climb(rows, table):
        now, past = rows
        forward, backward, start = table
        following = forward * z * now - backward * past + start
        return (following, now), following

    none = jnp.zeros((degree + 1, *x.shape), direction.dtype)
    table = [jnp.asarray(part, direction.dtype).reshape(*part.shape, *[1] * x.ndim) for part in _recurrence(degree)]
    _, (real, imaginary) = jax.lax.scan(multiply, (jnp.ones_like(x), jnp.zeros_like(x)), length=degree + 1)
    _, rows = jax.lax.scan(climb, (none, none), table)
    l = _band(degree)
    m = np.arange(len(l)) - l * (l + 1)
    azimuth = jnp.concatenate([imaginary[:0:-1], real])
    return rows.reshape(-1, *x.shape)[l * (degree + 1) + abs(m)] * azimuth[m + degree]


@functools.lru_cache(maxsize=16)
def _recurrence(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tables [l, m] for the polynomials in z: row l = forward z (row l-1) - backward (row l-2) + start."""
    l, m = np.arange(degree + 1.0)[:, None], np.arange(degree + 1.0)
    forward = np.sqrt(np.where(m < l, (4 * l**2 - 1) / np.where(m < l, l**2 - m**2, 1), 0))
    backward = forward * np.sqrt(np.where(m < l - 1, ((l - 1) ** 2 - m**2) / (4 * (l - 1) ** 2 - 1), 0))
    ratio = (2 * m[1:] + 1) / np.where(m[1:] > 1, 2 * m[1:], 1)
    start = np.sqrt(np.cumprod([1 / (4 * np.pi), *ratio]))
    return forward, backward, np.diag(start)


@functools.lru_cache(maxsize=8)
def _projection(size: int, degree: int) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Tables for ``project``: texels of octants, places of coefficients sorted by parity, and integrals by parity."""
    with jax.ensure_compile_time_eval():
        point = np.asarray(cubemap.point(size=size), np.float64).reshape(-1, 3)
    edge = np.unique(np.clip(2 * np.arange(size + 1) / size - 1, 0, None))
    low, high = edge[:-1], edge[1:]
    # If the size is odd, the middle texel lies half in the octant, with its center on the octant's border.
    middle = (2 * np.arange(size) + 1) / size - 1
    middle = np.maximum(middle[-len(low) :], 0)
    octant = _three_faces(*np.meshgrid(middle, middle, indexing="ij"))

    def key(place):  # twice the distance from the corner of the cube in texels, an integer
        whole = np.rint((place + 1) * size).astype(np.int64)
        return whole @ (2 * size + 1) ** np.arange(3)

    order = np.argsort(key(point))
    sign = np.stack(np.meshgrid([1, -1], [1, -1], [1, -1], indexing="ij"), axis=-1)
    index = order[np.searchsorted(key(point)[order], key(sign[..., None, :] * octant))]

    # The number of Gauss points follows from the phase of the highest harmonic over a texel: 1e-12 or better for all
    # sizes and degrees.
    count = 4 + math.ceil(3 * (degree + 2) / size)
    node, weight = np.polynomial.legendre.leggauss(count)
    # Integrals of the basis functions over the part of each texel in the octant +++.
    table = np.zeros(((degree + 1) ** 2, len(octant)))
    for (u, wu), (v, wv) in ((a, b) for a in zip(node, weight, strict=True) for b in zip(node, weight, strict=True)):
        s, t = (low + high + offset * (high - low) for offset in (u, v))
        place = _three_faces(*np.meshgrid(s / 2, t / 2, indexing="ij"))
        length = np.linalg.norm(place, axis=-1)
        area = np.tile(np.outer(high - low, high - low).ravel() / 4, 3)
        table += wu * wv * area / length**3 * basis(np, place / length[:, None], degree)

    l = _band(degree)
    m = np.arange(len(l)) - l * (l + 1)
    parity = 4 * ((np.abs(m) - (m < 0)) % 2) + 2 * (m < 0) + (l - np.abs(m)) % 2
    by_parity = np.argsort(parity, kind="stable")
    place = np.argsort(by_parity)
    return index.astype(np.int32), place.astype(np.int32), [table[parity == which] for which in range(8)]


def _three_faces(s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Points (1, s, t), (t, 1, s) and (s, t, 1), concatenated."""
    local = np.stack([np.ones_like(s), s, t], axis=-1).reshape(-1, 3)
    return np.concatenate([np.roll(local, turn, axis=-1) for turn in range(3)])


@functools.lru_cache(maxsize=8)
def quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadrature on the sphere that integrates all spherical harmonics up to a degree exactly.

    It has Gauss points in z and equal steps of azimuth.

    Args:
        degree: Highest degree l of the integrand. For a product, it is the sum of the factors' degrees.

    Returns:
        Unit directions [q, 3] and weights [q], which sum to 4 pi, in float64.
    """
    height, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    angle = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    radius = np.sqrt(1 - height**2)[:, None]
    node = np.stack([radius * np.cos(angle), radius * np.sin(angle), height[:, None] + 0 * angle], -1)
    return node.reshape(-1, 3), np.repeat(weight * 2 * np.pi / (degree + 1), degree + 1)


@jit
def convolve(coefficient: Float[Array, " lm *c"], factor: Float[Array, " l"]) -> Float[Array, " lm *c"]:
    """Multiplies every band by the factor of a zonal kernel or a window.

    Args:
        coefficient: SH coefficients in l(l+1)+m order, with any trailing axes.
        factor: One factor for each band, from `cosine`, `phong`, `hann`, `lanczos`, `natural` or `least_laplacian`.

    Raises:
        ValueError: The number of coefficients is not a square, or the number of factors is not degree + 1.

    Reference: the Funk-Hecke theorem; Ramamoorthi and Hanrahan 2001.
    """
    degree = degree_of(coefficient.shape[0])
    if factor.shape[0] != degree + 1:
        raise ValueError(f"there must be a factor for each of the {degree + 1} bands, got {factor.shape[0]}")
    rows = factor[jnp.asarray(_band(degree))]
    return coefficient * rows.reshape(-1, *(1,) * (coefficient.ndim - 1))


def cosine(*, degree: int) -> Float[Array, " l"]:
    """Factors of the clamped cosine max(0, cos): pi, 2 pi / 3, pi / 4, 0, -pi / 24, ... up to band `degree`.

    Reference: Ramamoorthi and Hanrahan 2001, equation 8.
    """
    factor = np.zeros(degree + 1)
    for l in range(degree + 1):
        if l == 1:
            factor[l] = 2 * np.pi / 3
        elif l % 2 == 0:
            ratio = math.comb(l, l // 2) / 2**l
            factor[l] = 2 * np.pi * (-1) ** (l // 2 + 1) / ((l + 2) * (l - 1)) * ratio
    return jnp.asarray(factor, jnp.result_type(float))


@functools.partial(jit, static_argnames="degree")
def phong(exponent: Float[Array, "*b"], *, degree: int) -> Float[Array, "*b l"]:
    """Factors of the normalized Phong lobe (n + 1) / (2 pi) max(0, cos)^n.

    Args:
        exponent: Exponent n, any number from 0.
        degree: Highest degree l.

    Reference: the ratio of the integrals of t^n P_l(t) and t^n P_(l-2)(t) over [0, 1] is (n - l + 2) / (n + l + 1).
    """
    factor = [jnp.ones_like(exponent), (exponent + 1) / (exponent + 2)]
    for l in range(2, degree + 1):
        factor.append(factor[l - 2] * (exponent - l + 2) / (exponent + l + 1))
    return jnp.stack(factor[: degree + 1], -1)


def hann(*, degree: int) -> Float[Array, " l"]:
    """Factors of the Hann window, (1 + cos(pi l / (degree + 1))) / 2."""
    return jnp.asarray((1 + np.cos(np.pi * np.arange(degree + 1) / (degree + 1))) / 2, jnp.result_type(float))


def lanczos(*, degree: int) -> Float[Array, " l"]:
    """Factors of the Lanczos window, sinc(l / (degree + 1)). It is milder than the Hann window."""
    return jnp.asarray(np.sinc(np.arange(degree + 1) / (degree + 1)), jnp.result_type(float))


def natural(*, degree: int) -> Float[Array, " l"]:
    """Standard deviation of the coefficients of natural light in each band, 1 / (l + 1/2), in relative units.

    Reference: Dror, Willsky, Adelson 2004, for the power spectra of natural illumination, which fall about like this.
    """
    return 1 / (jnp.arange(degree + 1) + 0.5)


def least_laplacian(coefficient: Float[Array, " lm *c"], share: Float[Array, ""]) -> Float[Array, " l"]:
    """Factors of the window 1 / (1 + lambda l^2 (l+1)^2), which reduces ringing with the least change of the function.

    The window minimizes the squared change plus lambda times the squared Laplacian, both integrated over the sphere.
    lambda is chosen so that the squared Laplacian, summed over channels, falls to a given share.

    Args:
        coefficient: SH coefficients of the function to be windowed.
        share: Share of the squared Laplacian that remains, from 0 to 1. 0 keeps the mean only.

    Returns:
        One factor for each band, for `convolve`. All are 1 if the function is constant. Inside `jax.jit`, where `share`
        cannot be checked, a negative share gives NaN.
    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on windowing.
    """
    if not isinstance(share, Tracer) and not 0 <= np.asarray(share) <= 1:
        raise ValueError(f"the share of the squared Laplacian that remains must be from 0 to 1, got {share}")
    return _least_laplacian(coefficient, share)


@jit
def _least_laplacian(coefficient: Array, share: Array) -> Array:
    degree = degree_of(coefficient.shape[0])
    band = _band(degree)
    coefficient = coefficient.astype(jnp.result_type(coefficient, share))  # The loop below keeps the type of its start.
    energy = jnp.sum(coefficient.reshape(len(band), -1) ** 2, -1)
    weight = jnp.asarray((np.arange(degree + 1) * np.arange(1, degree + 2)) ** 2, coefficient.dtype)
    spectrum = jax.ops.segment_sum(energy, jnp.asarray(band), degree + 1) * weight
    total = jnp.sum(spectrum)
    some = total > 0
    spectrum = spectrum / jnp.where(some, total, 1)

    def step(strength, _):
        # Newton's method for 1 / sqrt(remaining share), which is linear in the strength for one band and concave for
        # several. From 0 it approaches the root from below, quickly for any share.
        factor = 1 / (1 + strength * weight)
        remains = jnp.where(some, jnp.sum(spectrum * factor**2), share)
        slope = jnp.where(some, jnp.sum(spectrum * factor**3 * weight), 1)
        return strength + remains / slope * (jnp.sqrt(remains / some_share) - 1), None

    some_share = jnp.where(share == 0, 1, share)  # A share of 0 is the limit of infinite strength.
    strength, _ = jax.lax.scan(step, jnp.zeros((), coefficient.dtype), length=_NEWTON_STEPS)
    factor = 1 / (1 + jnp.maximum(strength, 0) * weight)
    return jnp.where((share == 0) & some, weight == 0, factor)


@functools.partial(jit, static_argnames="degree")
def disc(direction: Float[Array, "*b 3"], angle: Float[Array, "*b"], *, degree: int) -> Float[Array, "*b lm"]:
    """SH coefficients of circular lights of radiance 1.

    The closed form is 2 pi sin^2(a) P_l'(cos a) / (l (l + 1)) times the basis functions in the direction of the light.
    It is accurate also for lights as small as the sun or smaller.

    Args:
        direction: Unit directions to the centers of the lights.
        angle: Angular radius a of each light in radians, from 0 to pi.
        degree: Highest degree l.

    Reference: Kautz, Sloan, Snyder 2002, section 3 ("circular light sources"); Legendre's differential equation.
    """
    height = jnp.cos(angle)
    value, slope = [jnp.ones_like(height), height], [jnp.zeros_like(height), jnp.ones_like(height)]
    factor = [4 * jnp.pi * jnp.sin(angle / 2) ** 2]
    for l in range(1, degree + 1):
        factor.append(2 * jnp.pi / (l * (l + 1)) * jnp.sin(angle) ** 2 * slope[l])
        value.append(((2 * l + 1) * height * value[l] - l * value[l - 1]) / (l + 1))
        slope.append(slope[l - 1] + (2 * l + 1) * value[l])
    return evaluate(direction, degree=degree) * jnp.stack(factor, -1)[..., jnp.asarray(_band(degree))]


def _band(degree: int) -> np.ndarray:
    """Band l of each coefficient."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
