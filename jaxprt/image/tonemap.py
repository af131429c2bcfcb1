"""Conversion from radiance to display values: exposure and the sRGB transfer function."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.image.arguments import STOPS, numbers

LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of linear Rec. 709 RGB


def _stops(value: Any) -> None:
    require.number("stops", value, -STOPS, high=STOPS)


def _percentile(value: Any) -> None:
    require.number("percentile", value, 0.0, high=100.0)


def _white(value: Any) -> None:
    require.number("white", value, 1e-15, high=1e15)


@require.arguments(radiance=numbers("the radiance"), stops=_stops)
@jit
def expose(radiance: Float[Array, "*b"], *, stops: Float[Array, ""] | float) -> Float[Array, "*b"]:
    """Scales radiance by 2^stops, like a camera's exposure. Nothing is clamped.

    Raises:
        TypeError: An argument does not consist of real numbers.
        ValueError: The radiance holds NaN, or `stops` is not one number from -100 to 100.
    """
    return radiance * jnp.exp2(jnp.asarray(stops, radiance.dtype))


@require.arguments(image=numbers("the image", "h w 3"), percentile=_percentile, white=_white)
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

    Raises:
        TypeError: An argument does not consist of real numbers.
        ValueError: The image is not [h, w, 3] or holds NaN, `percentile` is not from 0 to 100, or `white` is not
            positive.
    """
    luminance = image @ jnp.asarray(LUMINANCE, image.dtype)
    lit = luminance > 0
    bright = jnp.nanpercentile(jnp.where(lit, luminance, jnp.nan), percentile)
    bright = jnp.where(jnp.any(lit), bright, white)
    return jnp.log2(white / bright)


@require.arguments(linear=numbers("the linear values"))
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


@require.arguments(encoded=numbers("the encoded values"))
@jit
def decode_srgb(encoded: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Inverse of `encode_srgb`, extended beyond [0, 1] in the same way."""
    dark = encoded <= 0.04045
    bright = jnp.where(dark, 1, encoded)
    return jnp.where(dark, encoded / 12.92, ((bright + 0.055) / 1.055) ** 2.4)


@require.arguments(radiance=numbers("the radiance"))
@jit
def display(radiance: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Clamps exposed linear radiance to [0, 1] and encodes it as sRGB, for display or for files of 8 bits."""
    return encode_srgb(jnp.clip(radiance, 0, 1))
