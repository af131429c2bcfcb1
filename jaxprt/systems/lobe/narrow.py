"""Selection of lobes that are narrow enough to be traced by rays."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit

WIDE, NARROW = 8.0, 32.0  # concentrations below which harmonics represent a lobe, and above which rays do


@jit
def share(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Share of a lobe that is traced by rays: 0 for wide lobes, 1 for narrow ones, with a smooth step between."""
    place = jnp.clip(jnp.log(concentration / WIDE) / math.log(NARROW / WIDE), 0, 1)
    return place**2 * (3 - 2 * place)
