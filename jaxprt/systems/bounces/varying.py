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

    def mean(self, blend: Blend, area: Float[Array, " v"]) -> Float[Array, "p c"]:
        """Mean weights of the functions over a surface, given the area of each vertex."""
        return _mean(self, blend, area)

    def values(self, blend: Blend, value: Float[Array, " p"]) -> Float[Array, "v c"]:
        """Value of each vertex's material, given the value (such as albedo) of each function."""
        return _values(self, blend, value)


def _shares(sent: Sent, blend: Blend) -> Float[Array, "v n"]:
    """Weight of each knot at each vertex, for linear interpolation."""
    if not sent.knot:
        return jnp.ones((len(blend.weight), 1), blend.weight.dtype)
    (knot,), (parameter,) = sent.knot, blend.parameter
    low, upper = (each[:, None] for each in grid.neighbors(grid.place(knot, parameter), size=len(knot)))
    number = jnp.arange(len(knot))
    return jnp.where(number == low, 1 - upper, jnp.where(number == low + 1, upper, 0))


@jit
def _mean(sent: Sent, blend: Blend, area: Array) -> Array:
    whole = jnp.sum(area)
    share = (area / jnp.where(whole > 0, whole, 1))[:, None] * _shares(sent, blend)
    total = jnp.tensordot(share, blend.weight, (0, 0), precision="highest")
    return jnp.einsum("nkp,nkc->pc", sent.factor, total, precision="highest")


@jit
def _values(sent: Sent, blend: Blend, value: Array) -> Array:
    channel = jnp.matmul(sent.factor, value, precision="highest")
    each = jnp.matmul(_shares(sent, blend), channel, precision="highest")
    return jnp.einsum("vk,vkc->vc", each, blend.weight, precision="highest")
