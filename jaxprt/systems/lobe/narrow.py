"""Which lobes are narrow enough for rays along them."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit

WIDE, NARROW = 8.0, 32.0  # concentrations up to which harmonics carry a lobe, and from which rays carry all of it


@jit
def share(concentration: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """How much of a lobe is traced: nothing of a wide one, all of a narrow one, with a smooth step between."""
    place = jnp.clip(jnp.log(concentration / WIDE) / math.log(NARROW / WIDE), 0, 1)
    return place**2 * (3 - 2 * place)
