"""Quantized sparse transport: 16 bits per gray coefficient, 11 + 11 + 10 bits per colored one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Integer, UInt

from jaxprt import require
from jaxprt.compile import jit, total
from jaxprt.systems.separable import sparse
from jaxprt.systems.separable.sparse import SparseTransport

_GRAY = (16,)
_COLOR = (11, 11, 10)  # red in the highest bits


class QuantizedTransport(eqx.Module):
    """Kept wavelet coefficients of transport, as integer multiples of a quantum per vertex, term and color.

    Attributes:
        index: Index of each of the k kept coefficients of vertex v and term r, of the 6 n n of the light; 0 in padding.
        level: Integer multiple of the quantum: int16 if gray. If colored, three signed integers of 11, 11 and 10 bits
            in a uint32.
        quantum: Value of level 1. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        rms: Root mean square of the kept transport over vertices and terms, for each wavelet coefficient.
        mark: Samples of the BRDF's light factors, by which relighting refuses another BRDF; None if unknown.
    """

    index: UInt[Array, "k v r"]
    level: Integer[Array, "k v r"]
    quantum: Float[Array, "v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    mark: Float[Array, "r m"] | None = None

    def truncate(self, count: int, *, terms: int | None = None) -> "QuantizedTransport":
        """The transport with the first `count` coefficients, the largest ones, and `terms` terms (None: all)."""
        require.count("count", count, least=1, most=self.index.shape[0])
        require.count("terms", self.terms if terms is None else terms, least=1, most=self.terms)
        index, level, quantum = self.index[:count, :, :terms], self.level[:count, :, :terms], self.quantum[:, :terms]
        kept = QuantizedTransport(index, level, quantum, self.position, self.frame, self.rms)
        rms = sparse.rms(index, dequantize(kept).value, self.rms.shape[0])
        mark = None if self.mark is None else self.mark[:terms]
        return QuantizedTransport(index, level, quantum, self.position, self.frame, rms, mark)

    @jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Multiplies the transport by the light: a sum over the kept coefficients of each vertex, term and color.

        Levels are converted to floating point one row at a time, and multiplied by their quantum after the sum.

        Args:
            coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.

        Returns:
            The light-modulated tuple of Wang et al., in units of radiance.

        Raises:
            ValueError: The light has another number of coefficients than the transport.
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
        """Bytes of indices, levels and quanta."""
        return self.index.nbytes + self.level.nbytes + self.quantum.nbytes


@jit
def quantize(transport: SparseTransport) -> QuantizedTransport:
    """Rounds coefficients to integer multiples of a quantum, with one quantum per vertex, term and color.

    The quantum is the largest magnitude divided by the highest level. The error of a coefficient is at most half a
    quantum: relative to the largest coefficient, 1 / 65,534 if gray, and 1 / 2,046 (red and green) or 1 / 1,022 (blue)
    if colored. The paper does not state the range of its uniform quantization. A single range for all vertices would
    leave few levels to vertices that see little light. Coefficients that round to zero become padding.

    Args:
        transport: Sparse transport, gray or in three colors.

    Returns:
        The quantized transport. It takes two thirds of the bytes if gray, and less than half if colored.

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
    """Converts quantized transport back to floating point. The rounding stays."""
    level = _unpack(transport.level.reshape(-1)).reshape(*transport.level.shape, -1)
    value = level.astype(transport.quantum.dtype) * transport.quantum
    same = (transport.position, transport.frame, transport.rms)
    return SparseTransport(transport.index, value, *same, mark=transport.mark)


def _pack(level: Array) -> Array:
    """Packs levels [... l] into the stored integers."""
    if level.shape[-1] == 1:
        return level[..., 0].astype(jnp.int16)
    left, right = _shifts()
    word = jax.lax.bitcast_convert_type(level << right, jnp.uint32) >> left.astype(jnp.uint32)
    return jax.lax.reduce_or(word, (word.ndim - 1,))


def _unpack(level: Array) -> Array:
    """Unpacks stored integers [n] to signed levels [n l]."""
    if level.dtype == jnp.int16:
        return level[:, None]
    left, right = _shifts()
    return (jax.lax.bitcast_convert_type(level, jnp.int32)[:, None] << left) >> right


def _shifts() -> tuple[np.ndarray, np.ndarray]:
    """For each color, the left shift that moves its bits to the top of a word, and the right shift back with sign."""
    bits = np.array(_COLOR, np.int32)
    return (np.cumsum(bits) - bits).astype(np.int32), 32 - bits
