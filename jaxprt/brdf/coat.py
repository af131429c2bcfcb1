"""A clear coat over a material, as KHR_materials_clearcoat has it: a dielectric layer of index of refraction 1.5.

With c the weight of the coat and Fc(wo) = 0.04 + 0.96 (1 - n.wo)^5,

    value = (1 - c Fc) base + c Fc D V,

where D and V are those of `jaxprt.brdf.microfacet`. As in the extension's text, Fc depends on the view alone, so the
value is not reciprocal, and light is not dimmed on its way in.

Reference: KHR_materials_clearcoat, sections "Layering" and "Clearcoat BRDF".
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.microfacet import MetallicRoughness
from jaxprt.brdf.models import scalar

_F0 = 0.04


def coat_reflectance(cosine: Float[Array | np.ndarray, "*b"] | float) -> Float[Array | np.ndarray, "*b"] | float:
    """Reflectance of a coat for views at some cosines to the normal, by Schlick's approximation."""
    xp = np if isinstance(cosine, np.ndarray | float) else jnp
    away = 1 - xp.clip(cosine, 0, 1)
    return _F0 + (1 - _F0) * away**5


class CoatedModel(eqx.Module):
    """A BRDF times what a coat of weight 1 transmits, or reflects, towards the viewer.

    Attributes:
        model: The BRDF.
        transmits: Whether the factor is 1 - Fc, for what is under the coat. Otherwise it is Fc, for the coat itself.
    """

    model: Any
    transmits: bool = eqx.field(static=True)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr."""
        share = coat_reflectance(wo[..., 2:])
        return self.model(wi, wo) * (1 - share if self.transmits else share)


class ClearCoat(eqx.Module):
    """A metallic-roughness material under a clear coat; see the module for its equation.

    Attributes:
        base: The material.
        clearcoat: Weight of the coat, from 0 to 1.
        clearcoat_roughness: Perceptual roughness of the coat; alpha is its square.

    Raises:
        TypeError: The base is no `MetallicRoughness`.
        ValueError: The weight is not from 0 to 1, or the roughness is negative or not finite.
    """

    base: MetallicRoughness
    clearcoat: Float[Array, "*#b"] = eqx.field(converter=scalar, default=1.0)
    clearcoat_roughness: Float[Array, "*#b"] = eqx.field(converter=scalar, default=0.0)

    def __check_init__(self):
        require.kind("the base of ClearCoat", self.base, MetallicRoughness, source="jaxprt.brdf.MetallicRoughness")
        require.within("clearcoat of ClearCoat", self.clearcoat, 0, 1)
        require.at_least("clearcoat_roughness of ClearCoat", self.clearcoat_roughness, 0.0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        share = self.clearcoat[..., None] * coat_reflectance(wo[..., 2:])
        # A white metal has F = 1 for all directions, so that its value is D V.
        layer = MetallicRoughness(1.0, 1.0, self.clearcoat_roughness)
        return (1 - share) * self.base(wi, wo) + share * layer(wi, wo)
