"""Conventions for coefficients of real spherical harmonics, by which tools differ, and conversion between them.

Ours: orthonormal, without the Condon-Shortley phase, in l(l+1)+m order, in a right-handed world with +y up, polar axis
z. All conventions here are of orthonormal bases.
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
    """How a tool writes coefficients of real, orthonormal spherical harmonics.

    Attributes:
        condon_shortley: Whether basis functions have the factor (-1)^m: then that of l=1, m=1 is negative towards +x.
        over_pi: Whether transfer vectors hold the 1/pi of an albedo of 1, so that their product with light is radiance;
            otherwise it is irradiance. Light and transfer matrices do not depend on it.
        order: Order of a band: "rising", m from -l to l, which is l(l+1)+m; "falling", from l to -l; "alternating",
            0, 1, -1, 2, -2, ...
        axes: Where the x, y and z of the tool's basis functions point in our world, such as "+x-z+y" of a world with z
            up, or "+x+y-z" of a left-handed one with y up.
    """

    condon_shortley: bool = False
    over_pi: bool = True
    order: str = "rising"
    axes: str = "+x+y+z"

    def __post_init__(self):
        """Refuses orders and axes that are none."""
        if self.order not in ORDERS:
            raise ValueError(f"the order must be one of {', '.join(ORDERS)}, got {self.order!r}")
        letters = re.fullmatch(r"[+-]([xyz])[+-]([xyz])[+-]([xyz])", self.axes)
        if letters is None or len(set(letters.groups())) < 3:
            raise ValueError(f'the axes must be such as "+x-z+y", each letter once, got {self.axes!r}')

    @property
    def turn(self) -> Float[np.ndarray, "3 3"]:
        """Matrix from our coordinates to those of the tool: a rotation, or a mirror for left-handed axes."""
        signs = np.array([1.0 if sign == "+" else -1.0 for sign in self.axes[::2]])
        return signs[:, None] * np.eye(3)[["xyz".index(letter) for letter in self.axes[1::2]]]

    def written(self, coefficient: ArrayLike, *, axis: int = 0, world: bool = True) -> Float[np.ndarray, "..."]:
        """Our coefficients as the tool has them.

        Args:
            coefficient: Coefficients in l(l+1)+m order along one axis.
            axis: That axis.
            world: Whether they are of the world's axes, and turned to the tool's. Those of a local frame are not.

        Raises:
            ValueError: The number of coefficients is not a square.
        """
        return _along(coefficient, axis, lambda degree: self._matrix(degree, world))

    def read(self, coefficient: ArrayLike, *, axis: int = 0, world: bool = True) -> Float[np.ndarray, "..."]:
        """The tool's coefficients as ours: the inverse of `written`.

        Args:
            coefficient: Coefficients in the tool's order along one axis.
            axis: That axis.
            world: Whether they are of the world's axes.

        Raises:
            ValueError: The number of coefficients is not a square.
        """
        return _along(coefficient, axis, lambda degree: self._matrix(degree, world).T)

    def _matrix(self, degree: int, world: bool) -> np.ndarray:
        """From our coefficients to the tool's; orthogonal."""
        m = np.concatenate([np.arange(-l, l + 1) for l in range(degree + 1)])
        matrix = _turned(degree, self.axes) if world else np.eye(len(m))
        if self.condon_shortley:
            matrix = matrix * np.where(m % 2, -1.0, 1.0)[:, None]
        return matrix[_order(degree, self.order)]


# As the tools evaluate their bases. Mitsuba 3 and Dr.Jit have Sloan's code (2013, "Efficient spherical harmonic
# evaluation"), as DirectXMath has; three.js is as ours. The axes are those of the same world.
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
    """For each place of the tool, the place l(l+1)+m of ours."""
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
    """Basis functions of the tool's axes by those of ours; exactly the identity and exactly 0 where they are."""
    if axes == Convention.axes:
        return np.eye((degree + 1) ** 2)
    node, weight = products.quadrature(2 * degree)
    theirs = harmonics.basis(np, node @ Convention(axes=axes).turn.T, degree)
    matrix = (theirs * weight) @ harmonics.basis(np, node, degree).T
    return np.where(np.abs(matrix) < 1e-12, 0, matrix)
