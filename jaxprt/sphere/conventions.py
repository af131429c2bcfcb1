"""Conventions of different tools for coefficients of real spherical harmonics, and conversion between them.

The convention of jaxprt is an orthonormal basis without the Condon-Shortley phase, in l(l+1)+m order, with polar axis
z, in a right-handed world with +y up. All conventions here use orthonormal bases.
"""

import re
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxprt.sphere import harmonics, products

ORDERS = ("rising", "falling", "alternating")


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

    def written(self, coefficient: ArrayLike, *, axis: int = 0, world: bool = True) -> Float[np.ndarray, "..."]:
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
        """Converts coefficients from the tool's convention to jaxprt's. This is the inverse of `written`.

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
        matrix = _turned(degree, self.axes) if world else np.eye(len(m))
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
def _turned(degree: int, axes: str) -> np.ndarray:
    """Matrix of the tool's basis functions in terms of jaxprt's, from the difference in axes. Zeros are exact."""
    if axes == Convention.axes:
        return np.eye((degree + 1) ** 2)
    node, weight = products.quadrature(2 * degree)
    theirs = harmonics.basis(np, node @ Convention(axes=axes).turn.T, degree)
    matrix = (theirs * weight) @ harmonics.basis(np, node, degree).T
    return np.where(np.abs(matrix) < 1e-12, 0, matrix)
