"""Transport as padded sparse rows: the coefficients that each vertex keeps of each BRDF term."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt

from jaxprt import require, visibility
from jaxprt.compile import jit, linear, total

# Versions of what makes the results of `separable.wavelets`; a release that changes them raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "separable": 1}
_CHUNKS = 4  # of each number on average: longer ones are padded more, shorter ones leave more sums to scatter


class Transpose(eqx.Module):
    """Kept coefficients by their number, in chunks of those with the same one.

    Attributes:
        row: Vertex and term of each, as vertex x terms + term; 0 where padded.
        value: Its value; 0 where padded.
        number: Number that all of a chunk have, rising.
    """

    row: Int[Array, "w n"]
    value: Float[Array, "w n l"]
    number: Int[Array, " n"]


class SparseTransport(eqx.Module):
    """Kept wavelet coefficients of transport, largest first, and the vertices that they belong to.

    Attributes:
        index: Number of each kept coefficient among the 6 n n; 0 where padded.
        value: Its value; 0 where padded. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
        rms: Root mean square over vertices and terms of each coefficient as kept.
        transpose: The same by number, for gradients by the light; from `with_transpose`.
        mark: Some values of the light factors that it was made of, by which other BRDFs are refused; None if unknown.
    """

    index: UInt[Array, "k v r"]
    value: Float[Array, "k v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    transpose: Transpose | None = None
    mark: Float[Array, "r m"] | None = None

    def truncate(self, count: int, *, terms: int | None = None) -> "SparseTransport":
        """The `count` largest coefficients of the first `terms` terms (all of them if None)."""
        require.between("count", count, 1, self.index.shape[0])
        require.between("terms", terms, 1, self.terms)
        index, value = self.index[:count, :, :terms], self.value[:count, :, :terms]
        mark = None if self.mark is None else self.mark[:terms]
        size = rms(index, value, self.rms.shape[0])
        return SparseTransport(index, value, self.position, self.frame, size, mark=mark)

    def with_transpose(self) -> "SparseTransport":
        """The same, whose gradient by the light takes about as long as the light itself: without, five times as long.

        It takes 8 bytes more for each coefficient (16 in color), and some again for padding: 1.5 times the transport's
        own. Derivatives by the values need none of it, and are right with it; `keep` drops it.
        """
        # By row, so that what is read together lies together.
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
        """Transport times light coefficients: each vertex's sum over its kept coefficients, per term and color.

        Args:
            coefficient: Coefficients of the light.

        Returns:
            The light-modulated tuple of Wang et al., in the light's units.

        Raises:
            ValueError: The light has another number of coefficients than the transport was made for.
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
        """Bytes of the coefficients, and of their transpose where there is one."""
        return self.index.nbytes + self.value.nbytes + sum(each.nbytes for each in jax.tree.leaves(self.transpose))


def _gather(transport: SparseTransport, coefficient: Array) -> Array:
    """The kept-coefficient axis comes first, so that one step reads contiguous rows of all vertices."""
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
    """Sums along the first axis of values times the rows of a table."""
    # A gray value is broadcast by hand: a trailing axis of 1 in the loop costs XLA's CPU code twice the time.
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
    """The `keep` coefficients of largest magnitude (over colors jointly) of each row, largest first.

    The best approximation with as many coefficients in the L2 norm, since the basis is orthonormal. Of equal ones
    that with the lower number comes first; those that are zero become padding.

    Args:
        coefficient: Rows of coefficients along d.
        keep: How many to keep.

    Returns:
        Numbers along d, uint16 where they fit, and values.

    Raises:
        ValueError: More are to be kept than there are.
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
    """Root mean square over vertices and terms (and colors) of each of `size` coefficients, zero where not kept."""
    total = np.zeros(size)
    for number, kept in zip(np.asarray(index), np.asarray(value), strict=True):
        total += np.bincount(number.ravel(), np.mean(kept**2, -1).ravel(), size)
    return jnp.asarray(np.sqrt(total / max(1, np.prod(index.shape[1:]))), jnp.result_type(float))
