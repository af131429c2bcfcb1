"""Weights of path functions for a part whose roughness varies, by channel and roughness.

    H_p = sum_k w_k A(k, p, r)

w_k are the weights of the channels of a `Blend`, r is the roughness or another parameter, and A is tabulated at knots
of r. Light that a vertex sends to other surfaces thus has the same roughness as light that it sends to the eye.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.systems.protocol import Blend


class Sent(eqx.Module):
    """Weights of path functions for the channels of a BRDF.

    Attributes:
        knot: Increasing values of the parameter; empty for a BRDF without a parameter.
        factor: Weight of each function p for each channel k at each knot; one row without knots.
    """

    knot: tuple[Float[Array, " _"], ...]
    factor: Float[Array, "n k p"]

    def __check_init__(self):
        """Refuses factors for another number of knots."""
        knots = len(self.knot[0]) if self.knot else 1
        if len(self.knot) > 1 or len(self.factor) != knots:
            raise ValueError(
                f"the factors must have one row for each knot of at most one parameter, got {len(self.factor)} rows "
                f"for {len(self.knot)} parameters"
            )

    def weights(self, blend: Blend) -> Float[Array, "v p c"]:
        """Weights of the functions for the material of each vertex, given the weights of the BRDF channels there."""
        return _weights(self, blend)


@jit
def _weights(sent: Sent, blend: Blend) -> Array:
    if not sent.knot:
        return jnp.einsum("kp,vkc->vpc", sent.factor[0], blend.weight, precision="highest")
    (knot,), (parameter,) = sent.knot, blend.parameter
    low, upper = grid.neighbors(grid.place(knot, parameter), size=len(knot))
    each = [sent.factor[low + step] * part[:, None, None] for step, part in ((0, 1 - upper), (1, upper))]
    return jnp.einsum("vkp,vkc->vpc", each[0] + each[1], blend.weight, precision="highest")
