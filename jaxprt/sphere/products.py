"""Products of functions that are given by spherical harmonics, and integrals of three of them.

The product of functions of degrees a and b has degree a + b. All functions here evaluate it at the nodes of a
quadrature that is exact for what they integrate, so the coefficients are exact to rounding. In the usual notation

    product(f, g)_k = sum_ij Gamma_ijk f_i g_j,      operator(f)_kj = sum_i Gamma_ijk f_i,
    Gamma_ijk = ∫ y_i y_j y_k,  the integrals of three basis functions (Gaunt coefficients).

The sparse sums over Gamma that are usual take as many operations at degree 4 and more from there.
"""

from functools import lru_cache, partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import harmonics


@lru_cache(maxsize=8)
def quadrature(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions and weights whose sums are exact integrals of harmonics up to a degree.

    Gauss points in z, and equal steps of azimuth.

    Args:
        degree: The largest l of what is integrated: of products, the sum of the degrees of their factors.

    Returns:
        Unit directions [q, 3] and weights [q], which sum to 4 pi, in float64.
    """
    height, weight = np.polynomial.legendre.leggauss(degree // 2 + 1)
    angle = 2 * np.pi * np.arange(degree + 1) / (degree + 1)
    radius = np.sqrt(1 - height**2)[:, None]
    node = np.stack([radius * np.cos(angle), radius * np.sin(angle), height[:, None] + 0 * angle], -1)
    return node.reshape(-1, 3), np.repeat(weight * 2 * np.pi / (degree + 1), degree + 1)


@partial(jit, static_argnames="degree")
def product(first: Float[Array, "i *c"], second: Float[Array, "j *#c"], *, degree: int) -> Float[Array, "k *c"]:
    """Coefficients of the product of two functions, up to a degree.

    Multiplies light by visibility, an albedo map by irradiance, or a window by a light. Linear in each argument.

    Args:
        first: Coefficients in l(l+1)+m order, with any trailing axes.
        second: Those of the other function, of any degree; its trailing axes broadcast against those of the first.
        degree: The largest l of the result. The sum of both degrees holds all of the product; less truncates it.

    Returns:
        Coefficients of the projection of the product, (degree+1)^2 rows.

    Raises:
        ValueError: The number of rows of a factor is not a square, or the degree is negative.

    Reference: Snyder 2006, "Code generation and factoring for fast evaluation of low-order spherical harmonic
    products and squares", which has the sparse sums; Ng, Ramamoorthi, Hanrahan 2004 for triple products.
    """
    of_first, of_second = harmonics.degree_of(first.shape[0]), harmonics.degree_of(second.shape[0])
    values = _tables(of_first, of_second, degree)
    one, other, back = (jnp.asarray(each, first.dtype) for each in values)
    at_nodes = jnp.tensordot(one, first, axes=1) * jnp.tensordot(other, second, axes=1)
    return jnp.tensordot(back, at_nodes, axes=1)


@partial(jit, static_argnames="degree")
def operator(coefficient: Float[Array, "i *c"], *, degree: int) -> Float[Array, "k j *c"]:
    """The matrix that multiplies functions of a degree by a function, and projects back to that degree.

    `operator(f, degree=n) @ g` is `product(f, g, degree=n)` for g of degree n: one function that multiplies many. It
    is symmetric. That of visibility is a transfer matrix in the world's frame.

    Args:
        coefficient: Coefficients of the function; what is beyond twice the degree changes nothing.
        degree: Degree of what it multiplies, and of the result.

    Raises:
        ValueError: The number of rows is not a square, or the degree is negative.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on products.
    """
    own, other, back = _tables(harmonics.degree_of(coefficient.shape[0]), degree, degree)
    own, other, back = (jnp.asarray(each, coefficient.dtype) for each in (own, other, back))
    value = jnp.tensordot(own, coefficient, axes=1)
    weighted = back.reshape(*back.shape, *(1,) * (value.ndim - 1)) * value
    return jnp.moveaxis(jnp.tensordot(weighted, other, axes=(1, 0)), -1, 1)


@jit
def triple(
    first: Float[Array, "i *c"], second: Float[Array, "j *#c"], third: Float[Array, "k *#c"]
) -> Float[Array, "*c"]:
    """The integral of the product of three functions over the sphere: light times visibility times BRDF, say.

    Args:
        first: Coefficients in l(l+1)+m order, with any trailing axes.
        second: Those of the second function; trailing axes broadcast against those of the first.
        third: Those of the third.

    Raises:
        ValueError: The number of rows of a factor is not a square.

    Reference: Ng, Ramamoorthi, Hanrahan 2004, "Triple product wavelet integrals for all-frequency relighting".
    """
    both = product(first, second, degree=harmonics.degree_of(third.shape[0]))
    return jnp.sum(both * third, 0)


@lru_cache(maxsize=16)
def _tables(first: int, second: int, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The basis at the nodes for two degrees [q, i], [q, j], and the weighted one [k, q] of the result."""
    node, weight = quadrature(first + second + max(degree, 0))
    one, other, back = (harmonics.basis(np, node, each) for each in (first, second, degree))
    return one.T, other.T, back * weight
