"""Depth and number of the triangle that is nearest so far at every sample, in a form for CPUs and one for others."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

CHUNK = 1 << 13  # Patches drawn at once on CPUs.
WIDE = 1 << 18  # The same on GPUs, where few steps with much to do in each take least.


class Narrow(eqx.Module):
    """As CPUs draw: one pixel of all patches after another, in the cache.

    Numbers are complex, depth + i number. Their minimum goes by the real part, then by the imaginary one, so that one
    scatter finds both.
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
        """The same with patches of some triangles drawn over it.

        Args:
            pixel: From the number of a pixel of a patch to its sample in each patch, and the depth there.
            count: Number of pixels of a patch.
            number: The number of the triangle that each patch belongs to.
        """

        def one(nearest, k):
            place, depth = pixel(k)
            each = jax.lax.complex(depth, number.astype(depth.dtype))
            return nearest.at[place].min(each, mode="promise_in_bounds"), None

        # A scan, since XLA would else compute what belongs to a patch anew for each of its pixels.
        return Narrow(jax.lax.scan(one, self.nearest, jnp.arange(count, dtype=jnp.int32))[0])


class Wide(eqx.Module):
    """As GPUs draw: all pixels of many patches at once, first the depths, then the numbers.

    Depths are positive, so that their bits as whole numbers have the same order; GPUs have the minimum of those in
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
        """The same with patches of some triangles drawn over it."""
        place, depth = jax.vmap(pixel)(jnp.arange(count, dtype=jnp.int32))
        bits = self.bits.at[place].min(_bits(depth), mode="promise_in_bounds")
        most = jnp.iinfo(jnp.int32).max
        kept = jnp.where(bits < self.bits, most, self.number)  # What was the nearest there is no more.
        wins = jnp.isfinite(depth) & (_bits(depth) == bits[place])
        return Wide(bits, kept.at[place].min(jnp.where(wins, number, most), mode="promise_in_bounds"))


def _bits(depth: Float[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.bitcast_convert_type(depth, jnp.int32 if depth.dtype == jnp.float32 else jnp.int64)
