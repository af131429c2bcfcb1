"""Tools for low-frequency light in spherical harmonics: irradiance, directional lights, products, other conventions.

Coefficients are those of radiance in the orthonormal basis of `jaxprt.sphere.harmonics`, in l(l+1)+m order, without the
Condon-Shortley phase, with polar axis z, in a right-handed world with +y up. Results are not clamped.

The product of functions of degrees a and b has degree a + b. It is evaluated at the nodes of a quadrature that is exact
for the integrand, so coefficients of products are exact to rounding. In the usual notation

    product(f, g)_k = sum_ij Gamma_ijk f_i g_j,      operator(f)_kj = sum_i Gamma_ijk f_i,
    Gamma_ijk = ∫ y_i y_j y_k,  the integrals of three basis functions (Gaunt coefficients).

The usual sparse sums over Gamma take about as many operations at degree 4, and more at higher degrees.
"""

import re
from dataclasses import dataclass
from functools import lru_cache, partial

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from jaxprt.compile import jit
from jaxprt.sphere import harmonics

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of Rec. 709
ORDERS = ("rising", "falling", "alternating")


@jit
def irradiance(coefficient: Float[Array, " lm *c"], normal: Float[Array, "*b 3"]) -> Float[Array, "..."]:
    """Irradiance without shadows for given normals: the light convolved with the clamped cosine.

    Irradiance times albedo / pi is the radiance of an ideal diffuse surface. Nine coefficients determine almost all of
    it, because the clamped cosine has no odd bands above 1 and its even bands fall as l^(-5/2).

    Args:
        coefficient: SH coefficients of the light, gray or with any trailing axes such as colors.
        normal: Unit normals, in the same frame as the light.

    Returns:
        Irradiance [*b, *c], in units of radiance times sr.

    Raises:
        ValueError: The number of coefficients is not a square.

    Reference: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment maps".
    """
    kernel = harmonics.cosine(degree=harmonics.degree_of(coefficient.shape[0]))
    return harmonics.reconstruct(harmonics.convolve(coefficient, kernel.astype(coefficient.dtype)), normal)


@jit
def dominant_direction(coefficient: Float[Array, " lm *c"]) -> Float[Array, "3"]:
    """Dominant direction of a light: the mean of directions weighted by radiance, normalized.

    It is the direction of the linear band (l = 1). With three colors, their luminance is used, otherwise their mean.

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        A unit vector. It is zero, with zero derivatives, where the linear band is exactly zero, for example without
        light. If light is uniform up to rounding, the direction is meaningless.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on extracting directional lights.
    """
    _check(coefficient)
    linear = coefficient[1:4].reshape(3, -1)
    colors = linear.shape[1]
    weight = jnp.asarray(_LUMINANCE if colors == 3 else (1 / colors,) * colors, coefficient.dtype)
    mean = (linear @ weight)[jnp.array([2, 0, 1])]  # functions y, z, x
    largest = lax.stop_gradient(jnp.max(jnp.abs(mean)))
    some = largest > 0
    scaled = jnp.where(some, mean / jnp.where(some, largest, 1), jnp.array([1, 0, 0], coefficient.dtype))
    return jnp.where(some, scaled / jnp.sqrt(jnp.sum(scaled**2)), 0)


@jit
def directional_light(coefficient: Float[Array, " lm *c"]) -> tuple[Float[Array, "3"], Float[Array, "*c"]]:
    """The directional light in the dominant direction that approximates a light best by least squares.

    A directional light E delta(s - d) has SH coefficients E y_i(d). The irradiance E minimizes their squared difference
    from the given coefficients. In closed form, E is 4 pi / (degree + 1)^2 times the light's reconstruction at d.

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the light, from `dominant_direction`; and its irradiance on a surface that faces it. Both
        are zero if there is no dominant direction.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks". He normalizes by the radiance of a white surface that
    faces the light, for which E is 16 pi / 17 at degree 2.
    """
    direction = dominant_direction(coefficient)
    there = _zero_without_direction(direction, harmonics.reconstruct(coefficient, direction))
    return direction, there * (4 * jnp.pi / coefficient.shape[0])


@jit
def directional_and_ambient(
    coefficient: Float[Array, " lm *c"],
) -> tuple[Float[Array, "3"], Float[Array, "*c"], Float[Array, "*c"]]:
    """The sum of a directional and a constant (ambient) light that approximates a light best by least squares.

    Let n = (degree + 1)^2 be the number of coefficients, m the mean radiance, and r the light's reconstruction in the
    dominant direction. The irradiance of the directional light is 4 pi (r - m) / (n - 1), and the radiance of the
    constant light is (n m - r) / (n - 1).

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the directional light, from `dominant_direction`; its irradiance on a surface that faces
        it; and the radiance of the constant light, whose irradiance is pi times that. Either may be negative where
        light comes from several sides. Without a dominant direction, the constant light is the mean and the directional
        light is zero.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on ambient and directional lights.
    """
    direction = dominant_direction(coefficient)
    terms = coefficient.shape[0]
    mean = coefficient[0] / jnp.sqrt(4 * jnp.pi).astype(coefficient.dtype)
    excess = _zero_without_direction(direction, (harmonics.reconstruct(coefficient, direction) - mean) / (terms - 1))
    return direction, 4 * jnp.pi * excess, mean - excess


def _zero_without_direction(direction: Array, value: Array) -> Array:
    """The value, or zero if there is no dominant direction."""
    return jnp.where(jnp.any(direction != 0), value, 0)


def _check(coefficient: Array) -> None:
    degree = harmonics.degree_of(coefficient.shape[0])
    if degree < 1:
        raise ValueError(f"the light must have degree 1 or more to have a direction, got degree {degree}")


@partial(jit, static_argnames="degree")
def product(first: Float[Array, " i *c"], second: Float[Array, "j *#c"], *, degree: int) -> Float[Array, " k *c"]:
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
    one, other, back = (jnp.asarray(basis, first.dtype) for basis in values)
    at_nodes = jnp.tensordot(one, first, axes=1) * jnp.tensordot(other, second, axes=1)
    return jnp.tensordot(back, at_nodes, axes=1)


@partial(jit, static_argnames="degree")
def operator(coefficient: Float[Array, " i *c"], *, degree: int) -> Float[Array, "k j *c"]:
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
    fixed, other, back = _tables(harmonics.degree_of(coefficient.shape[0]), degree, degree)
    fixed, other, back = (jnp.asarray(basis, coefficient.dtype) for basis in (fixed, other, back))
    value = jnp.tensordot(fixed, coefficient, axes=1)
    weighted = back.reshape(*back.shape, *(1,) * (value.ndim - 1)) * value
    return jnp.moveaxis(jnp.tensordot(weighted, other, axes=(1, 0)), -1, 1)


@jit
def triple(
    first: Float[Array, " i *c"], second: Float[Array, "j *#c"], third: Float[Array, "k *#c"]
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
    node, weight = harmonics.quadrature(first + second + max(degree, 0))
    one, other, back = (harmonics.basis(np, node, band) for band in (first, second, degree))
    return one.T, other.T, back * weight


@dataclass(frozen=True)
class Convention:
    """The convention of a tool for coefficients of real, orthonormal spherical harmonics.

    Attributes:
        condon_shortley: Whether basis functions have the factor (-1)^m. With it, the function l=1, m=1 is negative
            towards +x.
        over_pi: Whether transfer vectors include the factor 1/pi of a diffuse BRDF with albedo 1. With it, their dot
            product with the light is radiance, otherwise irradiance. It does not affect light and transfer matrices.
        order: Order of the coefficients of a band: "rising" for m from -l to l, which is l(l+1)+m; "falling" for m from
            l to -l; "alternating" for m = 0, 1, -1, 2, -2, ...
        axes: Directions of the tool's x, y and z axes in the world of jaxprt: "+x-z+y" for a world with z up, or
            "+x+y-z" for a left-handed world with y up.
    """

    condon_shortley: bool = False
    over_pi: bool = True
    order: str = "rising"
    axes: str = "+x+y+z"

    def __post_init__(self):
        """Refuses unknown orders, and axes that do not name x, y and z once each."""
        if self.order not in ORDERS:
            raise ValueError(f"the order must be one of {', '.join(ORDERS)}, got {self.order!r}")
        letters = re.fullmatch(r"[+-]([xyz])[+-]([xyz])[+-]([xyz])", self.axes)
        if letters is None or len(set(letters.groups())) < 3:
            raise ValueError(f'the axes must be such as "+x-z+y", each letter once, got {self.axes!r}')

    @property
    def turn(self) -> Float[np.ndarray, "3 3"]:
        """Matrix from jaxprt's coordinates to the tool's: a rotation, or a reflection if the axes are left-handed."""
        signs = np.array([1.0 if sign == "+" else -1.0 for sign in self.axes[::2]])
        return signs[:, None] * np.eye(3)[["xyz".index(letter) for letter in self.axes[1::2]]]

    def write(self, coefficient: ArrayLike, *, axis: int = 0, world: bool = True) -> Float[np.ndarray, "..."]:
        """Converts coefficients from jaxprt's convention to the tool's.

        Args:
            coefficient: SH coefficients in l(l+1)+m order along one axis.
            axis: The axis of the coefficients.
            world: Whether the coefficients are in world axes, which are rotated to the tool's. Use False for
                coefficients in a local frame.

        Raises:
            ValueError: The number of coefficients is not a square.
        """
        return _along(coefficient, axis, lambda degree: self._matrix(degree, world))

    def read(self, coefficient: ArrayLike, *, axis: int = 0, world: bool = True) -> Float[np.ndarray, "..."]:
        """Converts coefficients from the tool's convention to jaxprt's. This is the inverse of `write`.

        Args:
            coefficient: SH coefficients in the tool's order along one axis.
            axis: The axis of the coefficients.
            world: Whether the coefficients are in the tool's world axes, which are rotated to jaxprt's.

        Raises:
            ValueError: The number of coefficients is not a square.
        """
        return _along(coefficient, axis, lambda degree: self._matrix(degree, world).T)

    def _matrix(self, degree: int, world: bool) -> np.ndarray:
        """Orthogonal matrix from jaxprt's coefficients to the tool's."""
        m = np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
        matrix = _axes_matrix(degree, self.axes) if world else np.eye(len(m))
        if self.condon_shortley:
            matrix = matrix * np.where(m % 2, -1.0, 1.0)[:, None]
        return matrix[_order(degree, self.order)]


# Conventions by which the tools evaluate their basis functions. Mitsuba 3, Dr.Jit and DirectXMath use Sloan's code
# (2013, "Efficient spherical harmonic evaluation"). three.js has the same convention as jaxprt.
TOOLS = {
    "jaxprt": Convention(),
    "Mitsuba 3": Convention(condon_shortley=True),
    "three.js": Convention(),
    "e3nn": Convention(axes="+z+x+y"),
    "Blender axes": Convention(axes="+x-z+y"),
}


def _along(coefficient: ArrayLike, axis: int, matrix) -> np.ndarray:
    value = np.asarray(coefficient)
    degree = harmonics.degree_of(value.shape[axis])
    turned = np.tensordot(matrix(degree), value, axes=(1, axis))
    return np.ascontiguousarray(np.moveaxis(turned, 0, axis)).astype(value.dtype)


def _order(degree: int, order: str) -> np.ndarray:
    """For each coefficient in the tool's order, its index l(l+1)+m."""
    rows = []
    for l in range(degree + 1):
        rising = list(range(-l, l + 1))
        of_band = {
            "rising": rising,
            "falling": rising[::-1],
            "alternating": sorted(rising, key=lambda m: (abs(m), -m)),
        }
        rows += [l * (l + 1) + m for m in of_band[order]]
    return np.array(rows)


@lru_cache(maxsize=32)
def _axes_matrix(degree: int, axes: str) -> np.ndarray:
    """Matrix of the tool's basis functions in terms of jaxprt's, from the difference in axes. Zeros are exact."""
    if axes == Convention.axes:
        return np.eye((degree + 1) ** 2)
    node, weight = harmonics.quadrature(2 * degree)
    theirs = harmonics.basis(np, node @ Convention(axes=axes).turn.T, degree)
    matrix = (theirs * weight) @ harmonics.basis(np, node, degree).T
    return np.where(np.abs(matrix) < 1e-12, 0, matrix)
