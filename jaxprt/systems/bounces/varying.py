"""Weights of path functions for a part whose roughness varies, by channel and roughness.

    H_p = sum_k w_k A(k, p, r)

w_k are the weights of the channels of a `Blend`, r is the roughness or another parameter, and A is tabulated at knots
of r. Light that a vertex sends to other surfaces thus has the same roughness as light that it sends to the eye.
"""

import itertools
import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.brdf import grid
from jaxprt.compile import jit
from jaxprt.systems.protocol import Blend


class FunctionWeights(eqx.Module):
    """Weights of path functions for the channels of a BRDF.

    Attributes:
        knot: Increasing values of each parameter; empty for a BRDF without a parameter.
        factor: Weight of each function p for each channel k at each knot, with one axis for each parameter; one row
            without knots.
    """

    knot: tuple[Float[Array, " _"], ...]
    factor: Float[Array, "*n k p"]

    def __check_init__(self):
        """Refuses factors for another number of knots."""
        knots = [len(values) for values in self.knot] or [1]
        if list(self.factor.shape[:-2]) != knots:
            raise ValueError(
                f"the factors must have {knots} rows, one for each knot, got {list(self.factor.shape[:-2])}"
            )

    def weights(self, blend: Blend) -> Float[Array, "v p c"]:
        """Weights of the functions for the material of each vertex, given the weights of the BRDF channels there."""
        return _weights(self, blend)


@jit
def _weights(sent: FunctionWeights, blend: Blend) -> Array:
    if not sent.knot:
        return jnp.einsum("kp,vkc->vpc", sent.factor[0], blend.weight, precision="highest")
    pairs = zip(sent.knot, blend.parameter, strict=True)
    axis = [grid.neighbors(grid.place(knot, parameter), size=len(knot)) for knot, parameter in pairs]
    between = [((low, 1 - upper), (low + 1, upper)) for low, upper in axis]
    total: Array | float = 0.0
    for corner in itertools.product(*between):
        share = jnp.asarray(math.prod(part for _, part in corner))
        total = total + sent.factor[tuple(place for place, _ in corner)] * share[:, None, None]
    return jnp.einsum("vkp,vkc->vpc", total, blend.weight, precision="highest")
