"""Sparse transport in whole numbers: 16 bits for a gray coefficient, 11 + 11 + 10 bits for a colored one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, UInt

from jaxprt import require
from jaxprt.compile import jit, total
from jaxprt.systems.separable import sparse
from jaxprt.systems.separable.sparse import SparseTransport

ALGORITHM = sparse.ALGORITHM
_GRAY = (16,)
_COLOR = (11, 11, 10)  # red in the highest bits


class QuantizedTransport(eqx.Module):
    """Kept wavelet coefficients of transport as multiples of a quantum of each vertex, term and color.

    Attributes:
        index: Number of each kept coefficient among the 6 n n; 0 where padded.
        level: Its multiples: int16 if gray; if colored three signed numbers of 11, 11 and 10 bits in a uint32.
        quantum: Value of level 1. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
        rms: Root mean square over vertices and terms of each coefficient as kept.
        mark: As `jaxprt.separable.SparseTransport` has it.
    """

    index: UInt[Array, "k v r"]
    level: Integer[Array, "k v r"]
    quantum: Float[Array, "v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    mark: Float[Array, "r m"] | None = None

    def truncate(self, count: int, *, terms: int | None = None) -> "QuantizedTransport":
        """The first `count` coefficients, largest before rounding, of the first `terms` terms (all of them if None)."""
        require.between("count", count, 1, self.index.shape[0])
        require.between("terms", terms, 1, self.terms)
        index, level, quantum = self.index[:count, :, :terms], self.level[:count, :, :terms], self.quantum[:, :terms]
        kept = QuantizedTransport(index, level, quantum, self.position, self.frame, self.rms)
        rms = sparse.rms(index, dequantize(kept).value, self.rms.shape[0])
        mark = None if self.mark is None else self.mark[:terms]
        return QuantizedTransport(index, level, quantum, self.position, self.frame, rms, mark)

    @jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Transport times light coefficients: each vertex's sum over its kept coefficients, per term and color.

        Levels become floating point one row at a time, and meet their quantum after the sum.

        Args:
            coefficient: Coefficients of the light.

        Returns:
            The light-modulated tuple of Wang et al., in the light's units.

        Raises:
            ValueError: The light has another number of coefficients than the transport was made for.
        """
        require.length("the light's coefficients", coefficient, self.rms.shape[0])
        kept, vertices, terms = self.index.shape
        rows = self.index.reshape(kept, -1), self.level.reshape(kept, -1)
        dtype = jnp.result_type(coefficient, self.quantum)

        def term(row):
            number, level = row
            light = coefficient.at[number.astype(jnp.int32)].get(mode="promise_in_bounds")
            return _unpack(level).astype(dtype) * light

        return total(term, rows).reshape(vertices, terms, -1) * self.quantum

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.index.shape[2]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.index.nbytes + self.level.nbytes + self.quantum.nbytes


@jit
def quantize(transport: SparseTransport) -> QuantizedTransport:
    """Rounds coefficients to multiples of a quantum: the largest of each vertex, term and color over the last level.

    The error of a coefficient is at most half a quantum, 1 / 65,534 of the largest beside it if gray, 1 / 2,046 (red
    and green) or 1 / 1,022 (blue) if colored. The paper names no range for its uniform quantization. One range for all
    vertices leaves few levels to those that see little: on the bunny and its ground, with 4 terms of 96 coefficients,
    its error in transport is twice that of a range per vertex, term and color, and 5 (gray) to 13 times (color) in the
    radiance of the worst vertex. Ranges add 1 % to the bytes.

    Coefficients that round to zero become padding.

    Args:
        transport: Gray or in three colors.

    Returns:
        The same transport, in two thirds of the bytes if gray and less than half of them if colored.

    Raises:
        ValueError: The transport has neither one nor three colors.

    Reference: Wang, Tran, Luebke 2004, section 3.3.
    """
    colors = transport.value.shape[-1]
    if colors not in (1, 3):
        raise ValueError(f"the transport must have 1 or 3 colors, got {colors}")
    bits = np.array(_GRAY if colors == 1 else _COLOR)
    last = ((1 << (bits - 1)) - 1).astype(transport.value.dtype)
    quantum = jnp.max(jnp.abs(transport.value), 0) / last
    level = jnp.round(transport.value / jnp.where(quantum > 0, quantum, 1))
    level = jnp.clip(level, -last, last).astype(jnp.int32)
    index = jnp.where(jnp.any(level != 0, -1), transport.index, 0)
    same = (transport.position, transport.frame, transport.rms, transport.mark)
    return QuantizedTransport(index, _pack(level), quantum, *same)


@jit
def dequantize(transport: QuantizedTransport) -> SparseTransport:
    """The transport in floating point again, rounded as it is."""
    level = _unpack(transport.level.reshape(-1)).reshape(*transport.level.shape, -1)
    value = level.astype(transport.quantum.dtype) * transport.quantum
    same = (transport.position, transport.frame, transport.rms)
    return SparseTransport(transport.index, value, *same, mark=transport.mark)


def _pack(level: Array) -> Array:
    """Levels [... l] in the form that is stored."""
    if level.shape[-1] == 1:
        return level[..., 0].astype(jnp.int16)
    left, right = _shifts()
    word = jax.lax.bitcast_convert_type(level << right, jnp.uint32) >> left.astype(jnp.uint32)
    return jax.lax.reduce_or(word, (word.ndim - 1,))


def _unpack(level: Array) -> Array:
    """Levels [n l] of what is stored, a sign in front of each."""
    if level.dtype == jnp.int16:
        return level[:, None]
    left, right = _shifts()
    return (jax.lax.bitcast_convert_type(level, jnp.int32)[:, None] << left) >> right


def _shifts() -> tuple[np.ndarray, np.ndarray]:
    """How far each color's bits are from the top of a word, and how many of its bits are others'."""
    bits = np.array(_COLOR, np.int32)
    return (np.cumsum(bits) - bits).astype(np.int32), 32 - bits
