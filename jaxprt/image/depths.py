"""Depth buffers with triangle indices, in one form for CPUs and one for other devices."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

CHUNK = 1 << 13  # patches per step on CPUs
WIDE = 1 << 18  # patches per step on GPUs, where few large steps are fastest


class Narrow(eqx.Module):
    """Depth buffer for CPUs. It draws one pixel of all patches after another, so that data stays in the cache.

    Entries are complex numbers, depth + i * triangle index. Their minimum compares real parts first and imaginary
    parts second, so that one scatter finds both depth and index.
    """

    nearest: Complex[Array, " p"]

    @staticmethod
    def blank(count: int, dtype) -> "Narrow":
        """Samples that show nothing."""
        return Narrow(jnp.full(count, jax.lax.complex(jnp.array(jnp.inf, dtype), jnp.array(-1, dtype))))

    @staticmethod
    def chunk(faces: int) -> int:
        """How many patches are drawn at once."""
        return min(CHUNK, -(-faces // 1024) * 1024)

    def depth(self, dtype) -> Float[Array, " p"]:
        """Depths, infinite where nothing is seen."""
        return self.nearest.real.astype(dtype)

    def triangle(self) -> Int[Array, " p"]:
        """Numbers of triangles, -1 where nothing is seen."""
        return self.nearest.imag.astype(jnp.int32)

    def drawn(self, pixel: Callable, count: int, number: Int[Array, " n"]) -> "Narrow":
        """A buffer in which patches of some triangles have been drawn.

        Args:
            pixel: Function from the index of a pixel within a patch to the sample of this pixel in each patch, and its
                depth.
            count: Number of pixels of a patch.
            number: Index of the triangle that each patch belongs to.
        """

        def one(nearest, k):
            place, depth = pixel(k)
            each = jax.lax.complex(depth, number.astype(depth.dtype))
            return nearest.at[place].min(each, mode="promise_in_bounds"), None

        # A scan, because XLA would otherwise recompute the values of a patch for each of its pixels.
        return Narrow(jax.lax.scan(one, self.nearest, jnp.arange(count, dtype=jnp.int32))[0])


class Wide(eqx.Module):
    """Depth buffer for GPUs. It draws all pixels of many patches at once, first depths, then triangle indices.

    Depths are positive, so their bits as integers have the same order, and GPUs compute the minimum of integers in
    hardware. The methods are those of `Narrow`.
    """

    bits: Int[Array, " p"]
    number: Int[Array, " p"]

    @staticmethod
    def blank(count: int, dtype) -> "Wide":
        """Samples that show nothing."""
        return Wide(_bits(jnp.full(count, jnp.inf, dtype)), jnp.full(count, -1, jnp.int32))

    @staticmethod
    def chunk(faces: int) -> int:
        """How many patches are drawn at once."""
        return WIDE

    def depth(self, dtype) -> Float[Array, " p"]:
        """Depths, infinite where nothing is seen."""
        return jax.lax.bitcast_convert_type(self.bits, dtype)

    def triangle(self) -> Int[Array, " p"]:
        """Numbers of triangles, -1 where nothing is seen."""
        return self.number

    def drawn(self, pixel: Callable, count: int, number: Int[Array, " n"]) -> "Wide":
        """A buffer in which patches of some triangles have been drawn."""
        place, depth = jax.vmap(pixel)(jnp.arange(count, dtype=jnp.int32))
        bits = self.bits.at[place].min(_bits(depth), mode="promise_in_bounds")
        most = jnp.iinfo(jnp.int32).max
        kept = jnp.where(bits < self.bits, most, self.number)  # the previous nearest triangle is hidden
        wins = jnp.isfinite(depth) & (_bits(depth) == bits[place])
        return Wide(bits, kept.at[place].min(jnp.where(wins, number, most), mode="promise_in_bounds"))


def _bits(depth: Float[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.bitcast_convert_type(depth, jnp.int32 if depth.dtype == jnp.float32 else jnp.int64)
