"""The difference of a BRDF and its lobes."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.systems.lobe.table import LobeBrdf

_GRAZING = 1e-3


class Remainder(eqx.Module):
    """The difference of a BRDF and its lobes, for low-rank terms. It is a BRDF whose values may be negative.

    Attributes:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        lobe: Table of its lobes, including the diffuse part.
    """

    brdf: Callable
    lobe: LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr: the BRDF minus the lobes divided by the cosine of wi, which is clamped to at least 0.001."""
        return self.brdf(wi, wo) - self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)
