"""Transport as padded sparse rows: the coefficients that each vertex keeps of each BRDF term."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped, UInt


class SparseTransport(eqx.Module):
    """Kept wavelet coefficients of transport, largest first, and the vertices that they belong to.

    Attributes:
        index: Number of each kept coefficient among the 6 n n; 0 where padded.
        value: Its value; 0 where padded. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
        rms: Root mean square over vertices and terms of each coefficient as kept.
    """

    index: UInt[Array, "k v r"]
    value: Float[Array, "k v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]

    def keep(self, count: int, *, terms: int | None = None) -> "SparseTransport":
        """The `count` largest coefficients of the first `terms` terms (all of them if None)."""
        if not 1 <= count <= self.index.shape[0]:
            raise ValueError(f"count must be between 1 and {self.index.shape[0]}, got {count}")
        index, value = self.index[:count, :, :terms], self.value[:count, :, :terms]
        return SparseTransport(index, value, self.position, self.frame, rms(index, value, self.rms.shape[0]))

    @jax.jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Transport times light coefficients: each vertex's sum over its kept coefficients, per term and color.

        The kept-coefficient axis comes first, so one step reads contiguous rows of all vertices.

        Args:
            coefficient: Coefficients of the light.

        Returns:
            The light-modulated tuple of Wang et al., in the light's units.
        """
        kept, vertices, terms = self.index.shape
        index, value = self.index.reshape(kept, -1), self.value.reshape(kept, vertices * terms, -1)
        # A gray value is broadcast by hand: a trailing axis of 1 in the loop costs XLA's CPU code twice the time.
        gray = value.shape[-1] == 1
        value = value[..., 0] if gray else value

        def step(total, row):
            number, weight = row
            light = coefficient.at[number.astype(jnp.int32)].get(mode="promise_in_bounds")
            return total + (weight[:, None] if gray else weight) * light, None

        colors = max(coefficient.shape[1], self.value.shape[3])
        start = jnp.zeros((vertices * terms, colors), jnp.result_type(coefficient, value))
        return jax.lax.scan(step, start, (index, value))[0].reshape(vertices, terms, -1)

    def ordered(self, value: Float[Array, "v *c"]) -> Float[Array, "v *c"]:
        """The same: rows are in the order of the vertices."""
        return value

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.index.shape[2]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.index.nbytes + self.value.nbytes


@partial(jax.jit, static_argnames=("keep",))
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
