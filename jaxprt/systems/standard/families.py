"""Families of BRDFs over the logarithm of roughness, whose channels are the terms of a material."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.brdf import BlinnPhong, Charlie, CookTorrance, Lambert, MetallicRoughness
from jaxprt.brdf.varying import Channels


class RoughnessFamily(eqx.Module):
    """Maps a roughness to the BRDF whose channels are terms of `MetallicRoughness`.

    Attributes:
        term: Indices of the terms that are channels.
        scale: Factor of each channel.
        anisotropy: Strength of the anisotropy, along the tangent.
    """

    term: tuple[int, ...] = eqx.field(static=True)
    scale: Float[Array, " k"]
    anisotropy: Float[Array, ""]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithm of a roughness."""
        terms = MetallicRoughness(roughness=jnp.exp(log_roughness), anisotropy=self.anisotropy).terms()
        return Channels(tuple(terms[k] for k in self.term), self.scale)


class ShininessFamily(eqx.Module):
    """Maps a roughness to the BRDF whose channels are the diffuse base and the lobe of `BlinnPhong`.

    Attributes:
        scale: Factor of each channel.
    """

    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithm of a roughness, the square root of 2 / (exponent + 2)."""
        return Channels((Lambert(1.0), BlinnPhong(0.0, 1.0, 2 * jnp.exp(-2 * log_roughness) - 2)), self.scale)


class SlopeFamily(eqx.Module):
    """Maps a root mean square slope m to the BRDF whose channels are the terms of `CookTorrance`.

    The model is linear in F0: it is diffuse / pi + specular (F0 mirror + (1 - F0) rim). The mirror has an F0 of 1, the
    rim one of 0.

    Attributes:
        scale: Factor of each channel: base, mirror and rim.
    """

    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithm of the slope, the roughness of the model."""
        slope = jnp.exp(log_roughness)
        mirror, rim = (CookTorrance(0.0, 1.0, slope, f0) for f0 in (1.0, 0.0))
        return Channels((Lambert(1.0), mirror, rim), self.scale)


class SheenFamily(eqx.Module):
    """Maps a roughness to the fibers of a sheen, as one channel.

    Attributes:
        scale: Factor of the channel.
    """

    scale: Float[Array, " k"]

    def __call__(self, log_roughness: Float[Array, ""] | float) -> Channels:
        """The BRDF for the natural logarithm of a roughness."""
        return Channels((Charlie(jnp.exp(log_roughness)),), self.scale)
