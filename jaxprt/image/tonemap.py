"""Conversion from radiance to display values: exposure, tone curves and the sRGB transfer function.

Each works on NumPy and JAX arrays, whose module it is given. Values below 0 count as 0. Above, all have finite
derivatives.
"""

import functools
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.image.arguments import STOPS, numbers

Pixels = Float[Array | np.ndarray, "..."]

TONES = ("srgb", "filmic", "agx", "aces", "neutral")
_OF_COLORS = ("agx", "aces", "neutral")  # curves of three colors at once
_WHITE = 11.2  # linear value that the filmic curve maps to 1, after the doubling
# Rows of matrices. Hill 2016: sRGB to the AP1 primaries of the RRT, and back.
_ACES_IN = ((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777))
_ACES_OUT = ((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602))
# Recommendation ITU-R BT.2407: linear Rec. 2020 to Rec. 709.
_TO_REC709 = np.array(((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187)))
# Sobotka's AgX in Rec. 2020, as in Blender 4 and Filament: inset before the curve, and outset after it.
_INSET = np.array(
    (
        (0.856627153315983, 0.0951212405381588, 0.0482516061458583),
        (0.137318972929847, 0.761241990602591, 0.101439036467562),
        (0.11189821299995, 0.0767994186031903, 0.811302368396859),
    )
)
_OUTSET = np.linalg.inv(
    (
        (0.899796955911611, 0.0871996192028351, 0.013003424885555),
        (0.11142098895748, 0.875575586156966, 0.0130034248855548),
        (0.11142098895748, 0.0871996192028349, 0.801379391839686),
    )
)
_LEAST, _MOST = -12.47393, 4.026069  # binary logarithms that the curve of AgX begins and ends at
_KNEE, _PALE = 0.76, 0.15  # of the neutral curve: the value that it compresses from on, and how fast colors become pale
_SIGMOID = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)  # its coefficients, from the highest power
LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of linear Rec. 709 RGB


def apply_curve(linear: Pixels, tone: str, xp: ModuleType) -> Pixels:
    """Applies a tone curve.

    Args:
        linear: Exposed radiance in linear Rec. 709; the last axis is of three colors for "agx", "aces" and "neutral".
        tone: One of `TONES`.
        xp: NumPy, or `jax.numpy` for JAX arrays.

    Returns:
        Linear values from 0 to 1 in Rec. 709, to be encoded as sRGB.
    """
    # Infinite values are displayed as white, and the curves are constant long before these bounds.
    curve = {"srgb": _same, "filmic": _filmic, "agx": _agx, "aces": _aces, "neutral": _neutral}[tone]
    return xp.clip(curve(xp.clip(linear, 0, 1e6), xp), 0, 1)


def _same(x: Pixels, xp: ModuleType) -> Pixels:
    return x


def _filmic(x: Pixels, xp: ModuleType) -> Pixels:
    """Hable 2010, Uncharted 2: HDR Lighting, with its exposure bias of 2 and white of 11.2."""

    def curve(x):
        return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3

    return curve(2 * x) / curve(_WHITE)


def _aces(x: Pixels, xp: ModuleType) -> Pixels:
    """Hill 2016, a fit of the ACES reference rendering and output transforms, with the factor 1 / .6 of three.js."""
    x = _by(_ACES_IN, x / 0.6, xp)
    return _by(_ACES_OUT, (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081), xp)


def _agx(x: Pixels, xp: ModuleType) -> Pixels:
    """Sobotka 2022, AgX base look; the curve is Wrensch's polynomial of 2023, as in three.js."""
    x = xp.log2(xp.maximum(_by(_INSET, xp.maximum(_by(np.linalg.inv(_TO_REC709), x, xp), 0), xp), 1e-10))
    x = xp.clip((x - _LEAST) / (_MOST - _LEAST), 0, 1)
    y = 0 * x
    for coefficient in _SIGMOID:
        y = y * x + coefficient
    y = xp.maximum(_by(_OUTSET, y, xp), 1e-6)  # as black as 0, with a finite slope
    return _by(_TO_REC709, y**2.2, xp)


def _neutral(x: Pixels, xp: ModuleType) -> Pixels:
    """Khronos PBR Neutral 2024: base colors under white light as they are, and highlights compressed."""
    least = xp.min(x, axis=-1, keepdims=True)
    x = x - xp.where(least < 0.08, least - 6.25 * least**2, 0.04)
    peak = xp.maximum(xp.max(x, axis=-1, keepdims=True), _KNEE)
    new = 1 - (1 - _KNEE) ** 2 / (peak + 1 - 2 * _KNEE)
    share = 1 / (_PALE * (peak - new) + 1)
    return x * (new / peak) * share + new * (1 - share)


def _by(matrix: np.ndarray | tuple, x: Pixels, xp: ModuleType) -> Pixels:
    """A matrix times each color, in the type of the colors."""
    return xp.stack([sum(float(w) * x[..., k] for k, w in enumerate(row)) for row in matrix], -1)


_stops = functools.partial(require.number, "stops", low=-STOPS, high=STOPS)
_percentile = functools.partial(require.number, "percentile", low=0.0, high=100.0)
_white = functools.partial(require.number, "white", low=1e-15, high=1e15)


@require.arguments(radiance=numbers("the radiance"), stops=_stops)
@jit
def expose(radiance: Float[Array, "*b"], *, stops: Float[Array, ""] | float) -> Float[Array, "*b"]:
    """Scales radiance by 2^stops, like a camera's exposure. Nothing is clamped.

    Raises:
        TypeError: An argument does not consist of real numbers.
        ValueError: The radiance holds NaN, or `stops` is not one number from -100 to 100.
    """
    return radiance * jnp.exp2(jnp.asarray(stops, radiance.dtype))


def _coverage(value: Any) -> Any:
    return value if value is None else numbers("the coverage", "h w")(value)


@require.arguments(image=numbers("the image", "h w 3"), coverage=_coverage, percentile=_percentile, white=_white)
def automatic_exposure(
    image: Float[Array, "h w 3"],
    *,
    coverage: Float[Array, "h w"] | None = None,
    percentile: Float[Array, ""] | float = 99.0,
    white: Float[Array, ""] | float = 0.9,
) -> Float[Array, ""]:
    """Exposure in stops that brings a high percentile of the luminance near white.

    The percentile is taken over the pixels that are not black, so a black background does not matter. With `coverage`
    it is taken over the surfaces alone, so that an object before a bright window is not dark. A black picture gets 0
    stops. The result is meant for display; its derivative is not useful.

    Args:
        image: Linear radiance.
        coverage: Fraction of each pixel that shows surfaces, as `RelitScene.coverage` returns it. Only the pixels with
            the largest fraction count, which is 1 where a surface fills a pixel. None, or 0 everywhere: all count.
        percentile: Percentage of the pixels that are not black which stays at or below `white`.
        white: Linear value to which the percentile is mapped; 1 is display white.

    Raises:
        TypeError: An argument does not consist of real numbers.
        ValueError: The image is not [h, w, 3] or holds NaN, the coverage has another size, `percentile` is not from 0
            to 100, or `white` is not positive.
    """
    if coverage is not None and coverage.shape != image.shape[:2]:
        raise ValueError(f"the coverage must be {list(image.shape[:2])} as the image is, got {list(coverage.shape)}")
    return _exposure(image, coverage, percentile, white)


@jit
def _exposure(
    image: Float[Array, "h w 3"],
    coverage: Float[Array, "h w"] | None,
    percentile: Float[Array, ""] | float,
    white: Float[Array, ""] | float,
) -> Float[Array, ""]:
    luminance = image @ jnp.asarray(LUMINANCE, image.dtype)
    lit = luminance > 0
    if coverage is not None:
        lit = lit & (coverage >= 0.999 * jnp.max(coverage))
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


def _tone(value: object) -> None:
    if not isinstance(value, str) or value not in TONES:
        raise ValueError(f"tone must be one of {', '.join(TONES)}, got {require.shown(value)}")


@require.arguments(radiance=numbers("the radiance"), tone=_tone, stops=_stops)
def display(
    radiance: Float[Array, "*b"], *, tone: str = "srgb", stops: Float[Array, ""] | float = 0.0
) -> Float[Array, "*b"]:
    """Encodes linear radiance as sRGB, for display or for files of 8 bits.

    Radiance is scaled by 2^stops, mapped to [0, 1] by a tone curve, and encoded by `encode_srgb`. Curves:

    * "srgb": none. Values are clamped, so display values are radiance, and everything above 1 is white.
    * "filmic": Hable 2010, the curve of Uncharted 2, with its exposure bias of 2 and its white of 11.2. For each color.
    * "agx": Sobotka's AgX of Blender 4, base look, in the form of Filament and three.js. Bright colors become pale.
    * "aces": Hill's fit of the ACES reference rendering transform, scaled by 1 / 0.6 as in three.js. Contrasty.
    * "neutral": Khronos PBR Neutral. Base colors keep their hue and saturation; only highlights are compressed.

    Args:
        radiance: Linear radiance; the last axis is of three colors for "agx", "aces" and "neutral".
        tone: The curve.
        stops: Exposure, such as `RelitScene.exposure` or `automatic_exposure` return it.

    Raises:
        TypeError: The radiance or `stops` does not consist of real numbers.
        ValueError: The radiance holds NaN, has other than three colors for "agx", "aces" or "neutral", `tone` is no
            curve's name, or `stops` is not one number from -100 to 100.
    """
    if tone in _OF_COLORS and radiance.shape[-1:] != (3,):
        raise ValueError(f"the radiance must have three colors for the tone {tone!r}, got {list(radiance.shape)}")
    return _display(radiance, stops, tone=tone)


@functools.partial(jit, static_argnames="tone")
def _display(radiance: Float[Array, "*b"], stops: Float[Array, ""] | float, *, tone: str) -> Float[Array, "*b"]:
    return encode_srgb(apply_curve(radiance * jnp.exp2(jnp.asarray(stops, radiance.dtype)), tone, jnp))
