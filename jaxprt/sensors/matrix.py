"""The light of points as a matrix: what they receive of each function of a basis of distant light."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8, UInt16

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.sensors.bases import Basis

_LEVELS = 255
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of linear Rec. 709


class Sparse(eqx.Module):
    """The largest coefficients of each row, and how many the rows have in all.

    Attributes:
        index: Columns; 0 in padding.
        value: Values; 0 in padding.
    """

    index: UInt16[Array, "p k"]
    value: Float[Array, "p k"]

    def rows(self, light: Float[Array, "b h"]) -> Float[Array, "p h"]:
        """The product with a matrix, coefficient by coefficient."""

        def added(total, column):
            number, value = column
            return total + value[:, None] * light[number.astype(jnp.int32)], None

        start = jnp.zeros((len(self.index), light.shape[1]), self.value.dtype)
        return jax.lax.scan(added, start, (self.index.T, self.value.T))[0]


class Quantized(eqx.Module):
    """Rows in whole numbers from 0 to 255 of a unit of their own.

    Attributes:
        level: The whole numbers.
        unit: Value of one, for each row.
    """

    level: UInt8[Array, "p b"]
    unit: Float[Array, " p"]

    def rows(self, light: Float[Array, "b h"]) -> Float[Array, "p h"]:
        """The product with a matrix."""
        return (self.level.astype(self.unit.dtype) @ light) * self.unit[:, None]


class PointTransport(eqx.Module):
    """What points receive of distant light: a linear map from the coefficients of a basis.

    Without a BRDF it is irradiance (W/m2 of a radiance of 1 W/m2/sr), or the integral of radiance over all directions
    if it was asked for without cosines; with a BRDF it is the radiance that leaves the points.

    Attributes:
        direct: The part of light that comes without a reflection: a matrix, or a smaller form from `compressed`. The
            last axis holds colors, if there are any.
        reflected: The part that other surfaces have reflected; None without bounces.
        basis: The functions of light.
        error: Relative L2 difference of the matrix from one with four times the rays, at some of the points.
        dark: Points that no light reaches, such as those inside of solids.
    """

    direct: Float[Array, "p b *c"] | Sparse | Quantized
    reflected: Float[Array, "p b *d"] | None
    basis: Basis
    error: float = eqx.field(static=True, default=0.0)
    dark: tuple[int, ...] = eqx.field(static=True, default=())

    @property
    def matrix(self) -> Float[Array, "p b *e"]:
        """Direct and reflected light together, as one matrix."""
        if isinstance(self.direct, Sparse | Quantized):
            raise TypeError("a compressed transport has no matrix: use apply, or the transport it was made of")
        if self.reflected is None:
            return self.direct
        wider = self.direct[..., None] if self.reflected.ndim > self.direct.ndim else self.direct
        return wider + self.reflected

    def rows(self, part: slice) -> "PointTransport":
        """The transport of some of the points."""
        direct, reflected = jax.tree.map(lambda leaf: leaf[part], (self.direct, self.reflected))
        return PointTransport(direct, reflected, self.basis, self.error)

    @property
    def points(self) -> int:
        """Number of points."""
        return len(jax.tree.leaves(self.direct)[0])

    @property
    def nbytes(self) -> int:
        """Bytes of the matrices."""
        return sum(leaf.nbytes for leaf in jax.tree.leaves((self.direct, self.reflected)))

    def apply(self, light: Environment | Float[Array | np.ndarray, " _ *h"]) -> Float[Array, " p *_"]:
        """What the points receive under a light, or many.

        Args:
            light: An environment, or coefficients of the basis [b], or columns of them [b, h]: the hours of a year, or
                colors. Transport in color takes three columns.

        Returns:
            One row for each point. It is linear in the light, and differentiable.

        Raises:
            ValueError: The light has another number of coefficients than the basis.
        """
        value = self.basis.project(light) if isinstance(light, Environment) else jnp.asarray(light)
        require.length("the light", value, self.basis.count)
        return _apply((self.direct, self.reflected), value.reshape(len(value), -1)).reshape(-1, *value.shape[1:])

    def luminance(self) -> "PointTransport":
        """The transport of gray light: colors are weighted as luminance."""
        if self.reflected is None or self.reflected.ndim == 2:
            return self
        return eqx.tree_at(lambda known: known.reflected, self, self.reflected @ _LUMINANCE)

    def compressed(self, error: float) -> "PointTransport":
        """The transport in the form of the fewest bytes whose direct part differs by at most a relative L2 `error`.

        Raises:
            ValueError: The error is not above zero.
        """
        require.number("error", error, 0.0, above=True)
        whole = np.asarray(self.direct)
        if whole.ndim > 2:
            raise ValueError("transport of a colored BRDF cannot be compressed")
        forms: list[Any] = [form for form in (_sparse(whole, error), _quantized(whole, error)) if form is not None]
        forms.append(self.direct)
        least = min(forms, key=lambda form: sum(leaf.nbytes for leaf in jax.tree.leaves(form)))
        return eqx.tree_at(lambda known: known.direct, self, least)


@jit
def _apply(parts: tuple[Any, Array | None], light: Float[Array, "b h"]) -> Float[Array, "p h"]:
    direct, reflected = parts
    result = _product(direct, light)
    return result if reflected is None else result + _product(reflected, light)


def _product(matrix: Any, light: Array) -> Array:
    if isinstance(matrix, Sparse | Quantized):
        return matrix.rows(light)
    if matrix.ndim == 2:
        return matrix @ light
    return jnp.einsum("pbc,bc->pc", matrix, jnp.broadcast_to(light, (len(light), matrix.shape[2])))


def _sparse(whole: np.ndarray, error: float) -> Sparse | None:
    """The fewest coefficients of each row that keep the error of the row."""
    if whole.shape[1] > 1 << 16:
        return None
    order = np.argsort(-np.abs(whole), 1, kind="stable")
    value = np.take_along_axis(whole, order, 1)
    left = np.cumsum((value**2)[:, ::-1].astype(np.float64), 1)[:, ::-1]
    needed = (left > error**2 * np.maximum(left[:, :1], 1e-30)).sum(1)
    most = max(1, int(needed.max()))
    value = np.where(np.arange(most) < needed[:, None], value[:, :most], 0)
    index = np.where(value != 0, order[:, :most], 0)
    return Sparse(jnp.asarray(index.astype(np.uint16)), jnp.asarray(value))


def _quantized(whole: np.ndarray, error: float) -> Quantized | None:
    """Bytes, if they are exact enough and nothing is negative."""
    if whole.min() < 0:
        return None
    unit = whole.max(1) / _LEVELS
    level = np.round(whole / np.maximum(unit, 1e-30)[:, None]).astype(np.uint8)
    wrong = np.linalg.norm(level * unit[:, None] - whole) / max(float(np.linalg.norm(whole)), 1e-30)
    return Quantized(jnp.asarray(level), jnp.asarray(unit)) if wrong <= error else None
