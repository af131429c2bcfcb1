"""Tone curves: published maps from exposed linear radiance to linear display values from 0 to 1.

Each works on NumPy and JAX arrays, whose module it is given. Values below 0 count as 0. Above, all have finite
derivatives.
"""

from types import ModuleType
from typing import Any

import numpy as np

TONES = ("srgb", "filmic", "agx", "aces")
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
_SIGMOID = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)  # its coefficients, from the highest power


def toned(linear: Any, tone: str, xp: ModuleType) -> Any:
    """Applies a tone curve.

    Args:
        linear: Exposed radiance in linear Rec. 709; the last axis is of three colors for "agx" and "aces".
        tone: One of `TONES`.
        xp: NumPy, or `jax.numpy` for JAX arrays.

    Returns:
        Linear values from 0 to 1 in Rec. 709, to be encoded as sRGB.
    """
    # Infinite values are displayed as white, and the curves are constant long before these bounds.
    curve = {"srgb": _same, "filmic": _filmic, "agx": _agx, "aces": _aces}[tone]
    return xp.clip(curve(xp.clip(linear, 0, 1e6), xp), 0, 1)


def _same(x: Any, xp: ModuleType) -> Any:
    return x


def _filmic(x: Any, xp: ModuleType) -> Any:
    """Hable 2010, Uncharted 2: HDR Lighting, with its exposure bias of 2 and white of 11.2."""

    def curve(x: Any) -> Any:
        return (x * (0.15 * x + 0.05) + 0.004) / (x * (0.15 * x + 0.5) + 0.06) - 0.02 / 0.3

    return curve(2 * x) / curve(_WHITE)


def _aces(x: Any, xp: ModuleType) -> Any:
    """Hill 2016, a fit of the ACES reference rendering and output transforms, with the factor 1 / .6 of three.js."""
    x = _by(_ACES_IN, x / 0.6, xp)
    return _by(_ACES_OUT, (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081), xp)


def _agx(x: Any, xp: ModuleType) -> Any:
    """Sobotka 2022, AgX base look; the curve is Wrensch's polynomial of 2023, as in three.js."""
    x = xp.log2(xp.maximum(_by(_INSET, xp.maximum(_by(np.linalg.inv(_TO_REC709), x, xp), 0), xp), 1e-10))
    x = xp.clip((x - _LEAST) / (_MOST - _LEAST), 0, 1)
    y = 0 * x
    for coefficient in _SIGMOID:
        y = y * x + coefficient
    y = xp.maximum(_by(_OUTSET, y, xp), 1e-6)  # as black as 0, with a finite slope
    return _by(_TO_REC709, y**2.2, xp)


def _by(matrix: Any, x: Any, xp: ModuleType) -> Any:
    """A matrix times each color, in the type of the colors."""
    return xp.stack([sum(float(w) * x[..., k] for k, w in enumerate(row)) for row in matrix], -1)
