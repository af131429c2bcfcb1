"""Products of functions given by SH coefficients, and integrals of triple products.

The product of functions of degrees a and b has degree a + b. All functions here evaluate it at the nodes of a
quadrature that is exact for their integrands, so the coefficients are exact to rounding. In the usual notation

    product(f, g)_k = sum_ij Gamma_ijk f_i g_j,      operator(f)_kj = sum_i Gamma_ijk f_i,
    Gamma_ijk = ∫ y_i y_j y_k,  the integrals of three basis functions (Gaunt coefficients).

The usual sparse sums over Gamma take about as many operations at degree 4, and more at higher degrees.
"""

from functools import lru_cache, partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import harmonics


@lru_cache(maxsize=8)
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


@partial(jit, static_argnames="degree")
def product(first: Float[Array, "i *c"], second: Float[Array, "j *#c"], *, degree: int) -> Float[Array, "k *c"]:
    """SH coefficients of the product of two functions, up to a degree.

    For example, light times visibility, or an albedo map times irradiance. Linear in each argument.

    Args:
        first: SH coefficients of the first function in l(l+1)+m order, with any trailing axes.
        second: SH coefficients of the second function, of any degree. Its trailing axes broadcast to those of the
            first.
        degree: Highest degree l of the result. The sum of both degrees gives the whole product; a lower degree
            truncates it.

    Returns:
        (degree+1)^2 coefficients of the projected product.

    Raises:
        ValueError: The number of rows of a factor is not a square, or the degree is negative.

    Reference: Snyder 2006, "Code generation and factoring for fast evaluation of low-order spherical harmonic products
    and squares", for the sparse sums; Ng, Ramamoorthi, Hanrahan 2004 for triple products.
    """
    of_first, of_second = harmonics.degree_of(first.shape[0]), harmonics.degree_of(second.shape[0])
    values = _tables(of_first, of_second, degree)
    one, other, back = (jnp.asarray(each, first.dtype) for each in values)
    at_nodes = jnp.tensordot(one, first, axes=1) * jnp.tensordot(other, second, axes=1)
    return jnp.tensordot(back, at_nodes, axes=1)


@partial(jit, static_argnames="degree")
def operator(coefficient: Float[Array, "i *c"], *, degree: int) -> Float[Array, "k j *c"]:
    """Matrix that multiplies functions of a degree by a given function and projects the product to that degree.

    `operator(f, degree=n) @ g` equals `product(f, g, degree=n)` for g of degree n. Use it to multiply many functions by
    one. The matrix is symmetric. The matrix of visibility is a transfer matrix in the world frame.

    Args:
        coefficient: SH coefficients of the given function. Bands above twice `degree` have no effect.
        degree: Degree of the functions that are multiplied, and of the result.

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
    """Integral of the product of three functions over the sphere, such as light x visibility x BRDF.

    Args:
        first: SH coefficients of the first function in l(l+1)+m order, with any trailing axes.
        second: SH coefficients of the second function. Its trailing axes broadcast to those of the first.
        third: SH coefficients of the third function. Its trailing axes broadcast to those of the first.

    Raises:
        ValueError: The number of rows of a factor is not a square.

    Reference: Ng, Ramamoorthi, Hanrahan 2004, "Triple product wavelet integrals for all-frequency relighting".
    """
    both = product(first, second, degree=harmonics.degree_of(third.shape[0]))
    return jnp.sum(both * third, 0)


@lru_cache(maxsize=16)
def _tables(first: int, second: int, degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Basis functions at the nodes for both factors, [q, i] and [q, j], and weighted for the result, [k, q]."""
    node, weight = quadrature(first + second + max(degree, 0))
    one, other, back = (harmonics.basis(np, node, each) for each in (first, second, degree))
    return one.T, other.T, back * weight
