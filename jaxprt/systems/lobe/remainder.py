"""What lobes leave of a BRDF."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.systems.lobe.table import LobeBrdf

_GRAZING = 1e-3


class Remainder(eqx.Module):
    """What the lobes leave of a BRDF, itself a BRDF of either sign, for low-rank terms.

    Attributes:
        brdf: The BRDF.
        lobe: Its lobes; the diffuse part counts as one of them.
    """

    brdf: Callable
    lobe: LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr: the BRDF less the lobes over the cosine, which counts as at least 0.001."""
        return self.brdf(wi, wo) - self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)
