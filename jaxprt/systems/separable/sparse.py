"""Sparse transport: the largest wavelet coefficients of each vertex and BRDF term, padded to rows of equal length."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt

from jaxprt import require, visibility
from jaxprt.compile import jit, linear, total

# Versions of the algorithms of `separable.wavelets`. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "separable": 1}
_CHUNKS = 4  # per wavelet coefficient on average; longer chunks have more padding, shorter ones more sums to scatter


class Transpose(eqx.Module):
    """Kept coefficients sorted by index. Each of n chunks holds up to w coefficients with the same index.

    Attributes:
        row: Vertex and term of each coefficient, as vertex x terms + term; 0 in padding.
        value: Value of each coefficient; 0 in padding.
        number: Index that the coefficients of each chunk have in common, in increasing order.
    """

    row: Int[Array, "w n"]
    value: Float[Array, "w n l"]
    number: Int[Array, " n"]


class SparseTransport(eqx.Module):
    """The k largest wavelet coefficients of the transport of each vertex v and BRDF term r, largest first.

    Attributes:
        index: Index of each kept coefficient, of the 6 n n of the light; 0 in padding.
        value: Value of each kept coefficient; 0 in padding. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        rms: Root mean square of the kept transport over vertices and terms, for each wavelet coefficient.
        transpose: The coefficients sorted by index, for fast gradients with respect to the light; from
            `with_transpose`.
        mark: Samples of the BRDF's light factors, by which relighting refuses another BRDF; None if unknown.
    """

    index: UInt[Array, "k v r"]
    value: Float[Array, "k v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    transpose: Transpose | None = None
    mark: Float[Array, "r m"] | None = None

    def truncate(self, count: int, *, terms: int | None = None) -> "SparseTransport":
        """The transport with the `count` largest coefficients and the first `terms` terms (None: all)."""
        require.between("count", count, 1, self.index.shape[0])
        require.between("terms", terms, 1, self.terms)
        index, value = self.index[:count, :, :terms], self.value[:count, :, :terms]
        mark = None if self.mark is None else self.mark[:terms]
        size = rms(index, value, self.rms.shape[0])
        return SparseTransport(index, value, self.position, self.frame, size, mark=mark)

    def with_transpose(self) -> "SparseTransport":
        """Adds a transposed copy of the coefficients, which makes gradients with respect to the light faster.

        With it, such a gradient takes about as long as `apply`; without it, several times as long. The copy takes 8
        bytes per coefficient (16 in color) and padding. Derivatives with respect to the transport's values do not use
        it. `truncate` drops it.
        """
        # Sorted by row, so that values read together are contiguous in memory.
        rows, colors = self.index[0].size, self.value.shape[3]
        value = np.asarray(self.value).reshape(-1, rows, colors).swapaxes(0, 1)
        kept = np.any(value != 0, -1)
        number = np.asarray(self.index).reshape(-1, rows).T[kept]
        order = np.argsort(number, kind="stable")
        count = np.bincount(number, minlength=len(self.rms))
        length = max(1, len(number) // (_CHUNKS * max(1, np.count_nonzero(count))))
        chunks = -(-count // length)
        first = np.repeat((chunks * length).cumsum() - chunks * length, count)
        place = first + np.arange(len(number)) - np.repeat(count.cumsum() - count, count)
        chunk = np.repeat(np.arange(len(count)), chunks)
        padded = np.zeros((len(chunk) * length, colors), value.dtype)
        row = np.zeros(len(padded), np.int32)
        padded[place], row[place] = value[kept][order], np.nonzero(kept)[0][order]
        row, padded = row.reshape(-1, length).T, padded.reshape(-1, length, colors).swapaxes(0, 1)
        found = Transpose(jnp.asarray(row), jnp.asarray(padded), jnp.asarray(chunk, jnp.int32))
        return eqx.tree_at(lambda x: x.transpose, self, found, is_leaf=lambda x: x is None)

    @jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r _"]:
        """Multiplies the transport by the light: a sum over the kept coefficients of each vertex, term and color.

        Args:
            coefficient: Haar coefficients of the light, from `jaxprt.separable.project`.

        Returns:
            The light-modulated tuple of Wang et al., in units of radiance.

        Raises:
            ValueError: The light has another number of coefficients than the transport.
        """
        require.length("the light's coefficients", coefficient, self.rms.shape[0])
        colors = max(coefficient.shape[1], self.value.shape[3])
        coefficient = jnp.broadcast_to(coefficient, (len(coefficient), colors))
        if self.transpose is None:
            return _gather(self, coefficient)
        return linear(_gather, _scatter, self, coefficient)

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.index.shape[2]

    @property
    def nbytes(self) -> int:
        """Bytes of indices and values, and of the transpose if there is one."""
        return self.index.nbytes + self.value.nbytes + sum(each.nbytes for each in jax.tree.leaves(self.transpose))


def _gather(transport: SparseTransport, coefficient: Array) -> Array:
    """`apply`. The axis of kept coefficients comes first, so that each step reads contiguous rows of all vertices."""
    kept, vertices, terms = transport.index.shape
    rows = transport.index.reshape(kept, -1), transport.value.reshape(kept, vertices * terms, -1)
    return _accumulate(*rows, coefficient).reshape(vertices, terms, -1)


def _scatter(transport: SparseTransport, cotangent: Array) -> Array:
    assert transport.transpose is not None
    each = transport.transpose
    chunk = _accumulate(each.row, each.value, cotangent.reshape(-1, cotangent.shape[-1]))
    start = jnp.zeros((len(transport.rms), chunk.shape[1]), chunk.dtype)
    return start.at[each.number].add(chunk, indices_are_sorted=True)


def _accumulate(index: Shaped[Array, "k n"], value: Float[Array, "k n l"], table: Float[Array, "m c"]) -> Array:
    """Sums, along the first axis, of values times the table rows that `index` names."""
    # Gray values are broadcast by hand: with a trailing axis of 1, XLA's CPU code for the loop takes twice as long.
    gray = value.shape[-1] == 1
    value = value[..., 0] if gray else value

    def term(row):
        number, weight = row
        read = table.at[number.astype(jnp.int32)].get(mode="promise_in_bounds")
        return (weight[:, None] if gray else weight) * read

    return total(term, (index, value))


@partial(jit, static_argnames=("keep",))
def largest(
    coefficient: Float[Array, "b d r l"], *, keep: int
) -> tuple[Shaped[Array, "k b r"], Float[Array, "k b r l"]]:
    """The `keep` coefficients of largest magnitude of each row, largest first. Colors are chosen together.

    The basis is orthonormal, so this is the best L2 approximation with `keep` coefficients. Among equal magnitudes the
    lower index comes first. Coefficients of zero become padding.

    Args:
        coefficient: Coefficients d of each vertex b and term r, per color l.
        keep: Number of coefficients to keep.

    Returns:
        Indices along d, as uint16 if they fit and else uint32, and values.

    Raises:
        ValueError: `keep` is below 1 or above the number of coefficients.
    """
    count = coefficient.shape[1]
    if not 1 <= keep <= count:
        raise ValueError(f"keep must be between 1 and {count}, got {keep}")
    rows = coefficient.swapaxes(1, 2)
    size = jnp.abs(rows[..., 0]) if rows.shape[-1] == 1 else jnp.linalg.norm(rows, axis=-1)
    _, index = jax.lax.top_k(size, keep)
    value = jnp.take_along_axis(rows, index[..., None], 2)
    index = jnp.where(jnp.any(value != 0, -1), index, 0)
    small = jnp.uint16 if count <= 1 << 16 else jnp.uint32
    return jnp.moveaxis(index, 2, 0).astype(small), jnp.moveaxis(value, 2, 0)


def rms(index: Array | np.ndarray, value: Array | np.ndarray, size: int) -> Array:
    """Root mean square over vertices, terms and colors of each of `size` coefficients; those not kept count as zero."""
    total = np.zeros(size)
    for number, kept in zip(np.asarray(index), np.asarray(value), strict=True):
        total += np.bincount(number.ravel(), np.mean(kept**2, -1).ravel(), size)
    return jnp.asarray(np.sqrt(total / max(1, np.prod(index.shape[1:]))), jnp.result_type(float))
