"""Conversion from radiance to display values: exposure and the sRGB transfer function."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit

LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of linear Rec. 709 RGB


@jit
def expose(radiance: Float[Array, "*b"], *, stops: Float[Array, ""] | float) -> Float[Array, "*b"]:
    """Scales radiance by 2^stops, like a camera's exposure. Nothing is clamped."""
    radiance = _floating(radiance)
    return radiance * jnp.exp2(jnp.asarray(stops, radiance.dtype))


@jit
def automatic_exposure(
    image: Float[Array, "h w 3"], *, percentile: Float[Array, ""] | float = 99.0, white: Float[Array, ""] | float = 0.9
) -> Float[Array, ""]:
    """Exposure in stops that brings a high percentile of the luminance near white.

    The percentile is taken over the pixels that are not black, so a black background does not matter. A black picture
    gets 0 stops. The result is meant for display; its derivative is not useful.

    Args:
        image: Linear radiance.
        percentile: Percentage of the pixels that are not black which stays at or below `white`.
        white: Linear value to which the percentile is mapped; 1 is display white.
    """
    image = _floating(image)
    luminance = image @ jnp.asarray(LUMINANCE, image.dtype)
    lit = luminance > 0
    bright = jnp.nanpercentile(jnp.where(lit, luminance, jnp.nan), percentile)
    bright = jnp.where(jnp.any(lit), bright, white)
    return jnp.log2(white / bright)


@jit
def encode_srgb(linear: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Encodes linear values by the sRGB transfer function.

    This is the exact piecewise curve, extended beyond [0, 1]: linear below 0, a power function above 1. Nothing is
    clamped. The derivative is finite everywhere and 12.92 at zero.

    Reference: IEC 61966-2-1.
    """
    dark = linear <= 0.0031308
    bright = jnp.where(dark, 1, linear)
    return jnp.where(dark, 12.92 * linear, 1.055 * bright ** (1 / 2.4) - 0.055)


@jit
def decode_srgb(encoded: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Inverse of `encode_srgb`, extended beyond [0, 1] in the same way."""
    dark = encoded <= 0.04045
    bright = jnp.where(dark, 1, encoded)
    return jnp.where(dark, encoded / 12.92, ((bright + 0.055) / 1.055) ** 2.4)


@jit
def display(radiance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Clamps exposed linear radiance to [0, 1] and encodes it as sRGB, for display or for files of 8 bits."""
    return encode_srgb(jnp.clip(radiance, 0, 1))


def _floating(value: Array) -> Array:
    """Integers converted to floating point. Otherwise options would be rounded to integers too."""
    return value if jnp.issubdtype(value.dtype, jnp.inexact) else value.astype(jnp.result_type(float))
