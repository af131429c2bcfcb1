"""Smooth BRDFs from scattered spectral measurements of isotropic materials, by radial basis functions.

This runs on the host when data is loaded. The result is a ``jaxprt.brdf.measured.HalfDifferenceTable``.
"""

import pathlib
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float64

from jaxprt import require
from jaxprt.brdf import measured
from jaxprt.brdf.measured import HalfDifferenceTable
from jaxprt.files import inputs

_GLOSS = 0.01  # sine of theta_h beyond which the first coordinate of the radial basis functions is logarithmic
_HIGHLIGHT = 2.0  # first coordinate up to which samples belong to the highlight: theta_h of 1.5 degrees
_FEWEST = 10  # smallest number of samples
_RESOLUTION = (90, 48, 24)
# Wyman, Sloan, Shirley 2013: channel, height, center in nm, inverse widths below and above it.
_LOBES = (
    (0, 0.362, 442.0, 0.0624, 0.0374),
    (0, 1.056, 599.8, 0.0264, 0.0323),
    (0, -0.065, 501.1, 0.0490, 0.0382),
    (1, 0.821, 568.8, 0.0213, 0.0247),
    (1, 0.286, 530.9, 0.0613, 0.0322),
    (2, 1.217, 437.0, 0.0845, 0.0278),
    (2, 0.681, 459.0, 0.0385, 0.0725),
)
# CIE standard illuminant D65 from 400 to 700 nm in steps of 10 nm.
_D65 = np.array(
    [82.7549, 91.486, 93.4318, 86.6823, 104.865, 117.008, 117.812, 114.861, 115.923, 108.811, 109.354]
    + [107.802, 104.79, 107.689, 104.405, 104.046, 100.0, 96.3342, 95.788, 88.6856, 90.0062, 89.5991]
    + [87.6987, 83.2886, 83.6992, 80.0268, 80.2146, 82.2778, 78.2842, 69.7213, 71.6091]
)
# ITU-R BT.709: chromaticities of red, green, blue and the white D65, as XYZ with Y = 1.
_PRIMARY = np.array([[0.64, 0.33, 0.03], [0.3, 0.6, 0.1], [0.15, 0.06, 0.79]]).T
_WHITE = np.array([0.3127, 0.3290, 0.3583]) / 0.3290
_XYZ_TO_RGB = np.linalg.inv(_PRIMARY * np.linalg.solve(_PRIMARY, _WHITE))


def load_scattered(
    path: str | pathlib.Path, *, smoothing: float = 1.0, resolution: tuple[int, int, int] = _RESOLUTION
) -> HalfDifferenceTable:
    """Loads scattered measurements of an isotropic material as a smooth BRDF.

    ``read_scattered`` explains the file and the colors, ``interpolate_scattered`` the method and the other arguments.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: One of the two functions refuses the file or an argument.
    """
    wi, wo, color = read_scattered(path)
    try:
        return interpolate_scattered(wi, wo, color, smoothing=smoothing, resolution=resolution)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_scattered(
    path: str | pathlib.Path,
) -> tuple[Float64[np.ndarray, "b 3"], Float64[np.ndarray, "b 3"], Float64[np.ndarray, "b 3"]]:
    """Reads scattered spectral measurements of an isotropic material.

    The text file holds the number of wavelengths, the wavelengths in nm, and the samples. A sample is theta_i, phi_i,
    theta_o and phi_o in radians and the BRDF at each wavelength in 1/sr. A # starts a comment.

    Args:
        path: The file.

    Returns:
        For each sample the direction to the light, the direction to the viewer, and the BRDF in linear RGB, converted
        by ``spectrum_to_rgb``.
    """
    number = _numbers(path)
    count = int(number[0]) if number.size and number[0] == np.floor(number[0]) and 0 < number[0] < 1e6 else 0
    if count < 2:
        came = number[0] if number.size else "an empty file"
        raise ValueError(f"{path}: must begin with the number of wavelengths, at least 2, got {came}")
    wavelength, sample = number[1 : 1 + count], number[1 + count :]
    if len(wavelength) < count or not np.all(np.diff(wavelength) > 0) or not 300 <= wavelength[0] < 900:
        raise ValueError(f"{path}: must hold {count} increasing wavelengths in nm, got {wavelength[:40].tolist()}")
    if sample.size == 0 or sample.size % (4 + count):
        whole, rest = divmod(sample.size, 4 + count)
        raise ValueError(
            f"{path}: each sample must have 4 angles and {count} values, got {whole} samples and {rest} further numbers"
        )
    sample = sample.reshape(-1, 4 + count)
    measured.require(path, sample, np.isfinite(sample), "finite", "number at sample, column")
    value = sample[:, 4:]
    measured.require(path, value, value >= 0, "non-negative", "value at sample, wavelength")
    most = measured.LARGEST
    measured.require(path, value, value <= most, f"at most {most:g} per sr", "value at sample, wavelength")
    polar = sample[:, [0, 2]]
    measured.require(
        path, polar, (polar >= 0) & (polar < np.pi / 2), "theta in [0, pi/2)", "angle at sample, direction"
    )
    theta, phi = sample[:, :4:2], sample[:, 1:4:2]
    direction = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    try:
        return direction[:, 0], direction[:, 1], spectrum_to_rgb(sample[:, 4:], wavelength)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _numbers(path: str | pathlib.Path) -> Float64[np.ndarray, " n"]:
    result: list[float] = []
    text = inputs.content(pathlib.Path(path), "a file of scattered measurements").decode("utf-8", "replace")
    for index, line in enumerate(text.splitlines(), 1):
        for word in line.partition("#")[0].split():
            try:
                result.append(float(word))
            except ValueError:
                raise ValueError(f"{path}: line {index} must hold numbers, got {word[:40]!r}") from None
    return np.array(result)


def interpolate_scattered(
    wi: Float64[np.ndarray, "b 3"],
    wo: Float64[np.ndarray, "b 3"],
    value: Float64[np.ndarray, "b c"],
    *,
    smoothing: float = 1.0,
    resolution: tuple[int, int, int] = _RESOLUTION,
) -> HalfDifferenceTable:
    """Interpolates scattered samples to a smooth isotropic BRDF by radial basis functions, and tabulates it.

    The coordinates are log(1 + sin(theta_h)^2 / 0.01^2), 4 sin(theta_d)^2 and 4 (cos_i - cos_o)^2. They are analytic in
    the directions, so there is no seam where the angles are undefined. They are the same for exchanged and for mirrored
    directions, and they resolve glossy highlights around theta_h = 0. Thin-plate splines interpolate log(1 + f / s),
    where s is a tenth of the median; negative values are clamped to zero.

    Cells with a direction farther from the normal than any measured one get the value of the nearest other cell. In the
    other cells, the value is limited to the largest sample and coordinates to their measured range. The BRDF therefore
    stays bounded at grazing angles, where extrapolated splines would not.

    Args:
        wi: Unit directions to the light above the horizon.
        wo: Unit directions to the viewer above the horizon.
        value: The BRDF in 1/sr; negative values count as zero.
        smoothing: Smoothing parameter of ``scipy.interpolate.RBFInterpolator``; larger values fit the samples less
            closely. Much smaller values let the BRDF overshoot between the measured angles of incidence. In the
            highlight (theta_h below 1.5 degrees) a thousandth of it is used, because the few samples there would be
            smoothed away.
        resolution: Number of cells in theta_h, theta_d and phi_d; the last must be even.

    Returns:
        The BRDF. ``jaxprt.brdf.measured.tabulate`` explains its ``filled``.
    Reference: Kautz, Sloan, Snyder 2002, "Calculating BRDF Coefficients", for radial basis functions. The choice of
    coordinates is new.
    """
    if len(resolution) != 3 or min(resolution) < 2 or resolution[2] % 2:
        raise ValueError(f"resolution must be three numbers of at least 2, the last even, got {resolution}")
    if not smoothing >= 0:
        raise ValueError(f"smoothing must be at least 0, got {smoothing}")
    half = np.sum((wi + wo)[:, :2] ** 2, 1) / np.sum((wi + wo) ** 2, 1)
    place = _spline_coordinates(half, np.sum((wi - wo) ** 2, 1) / 4, (wi - wo)[:, 2] ** 2)
    # Exchanged and mirrored samples have equal coordinates. Their mean is used, because smoothing may be zero.
    place, inverse, count = np.unique(place.round(9), axis=0, return_inverse=True, return_counts=True)
    if len(place) < _FEWEST:
        raise ValueError(f"there must be at least {_FEWEST} different samples, got {len(place)}")
    mean = np.zeros((len(place), value.shape[1]))
    np.add.at(mean, inverse, np.maximum(value, 0))
    mean /= count[:, None]
    require.memory(
        f"splines of {len(place):,} samples",
        3 * 8 * len(place) ** 2,
        "give fewer samples: the spline has a square matrix",
    )
    scale = np.median(mean[mean > 0]) / 10 if np.any(mean > 0) else 1.0
    height = np.log1p(mean / scale)
    stiffness: Any = np.where(place[:, 0] < _HIGHLIGHT, smoothing / 1000, smoothing)  # One per sample; typed float.
    try:
        spline = scipy.interpolate.RBFInterpolator(place, height, smoothing=stiffness, kernel="thin_plate_spline")
    except np.linalg.LinAlgError as error:
        raise ValueError("samples must not all lie on one plane of half-vector angles") from error
    theta_h, theta_d, phi_d = measured.cell_angles(resolution)
    half, square = np.sin(theta_h) ** 2, np.sin(theta_d) ** 2
    query = _spline_coordinates(*np.broadcast_arrays(half, square, 4 * half * square * np.cos(phi_d) ** 2))
    known = measured.lower_cosine(resolution) >= min(wi[:, 2].min(), wo[:, 2].min())
    # cos(phi_d)^2 is symmetric about the middle: half of the cells are enough.
    mine = known & (np.arange(resolution[2]) < resolution[2] // 2)
    table = np.zeros((*resolution, value.shape[1]))
    if mine.any():
        table[mine] = spline(np.clip(query[mine], place.min(0), place.max(0)))
    table += table[:, :, ::-1]
    result = measured.tabulate(scale * np.expm1(np.clip(table, 0, height.max(0))), known)
    # Where two measured cells are equally near, filling chose one. The mean restores the mirror symmetry.
    return HalfDifferenceTable((result.root + result.root[:, :, ::-1]) / 2, result.filled)


def _spline_coordinates(half: np.ndarray, difference: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """Coordinates from sin(theta_h)^2, sin(theta_d)^2 and (cos_i - cos_o)^2, scaled by cross-validation."""
    return np.stack([np.log1p(half / _GLOSS**2), 4 * difference, 4 * tilt], -1)


def spectrum_to_rgb(
    reflectance: Float64[np.ndarray, "*b w"], wavelength: Float64[np.ndarray, " w"]
) -> Float64[np.ndarray, "*b 3"]:
    """Converts a spectral reflectance or BRDF to linear Rec. 709 RGB under the illuminant D65.

    A constant spectrum of value 1 becomes (1, 1, 1): each channel is divided by that of a reflectance of 1. This
    corrects for the ends of the spectrum, which are not integrated, and for the approximated matching functions. Colors
    outside of the gamut of Rec. 709 are clipped at zero.

    Args:
        reflectance: Values at the wavelengths.
        wavelength: Increasing wavelengths in nm. Integration uses the trapezoidal rule over their range.

    Returns:
        Color in the units of the values.
    Reference: Wyman, Sloan, Shirley 2013, "Simple Analytic Approximations to the CIE XYZ Color Matching Functions",
    the multi-lobe fit of the 2-degree observer of 1931; CIE 15 for D65; ITU-R BT.709 for the primaries.
    """
    if (
        wavelength[0] > 430
        or wavelength[-1] < 650
        or not 0 < np.diff(wavelength).min() <= np.diff(wavelength).max() <= 40
    ):
        raise ValueError(
            "wavelengths must increase by at most 40 nm and reach from 430 to 650 nm or further, got "
            f"{len(wavelength)} from {wavelength[0]} to {wavelength[-1]}"
        )
    width = np.gradient(wavelength)
    width[[0, -1]] /= 2
    illuminant = np.interp(wavelength, 400 + 10.0 * np.arange(len(_D65)), _D65)
    weight = (width * illuminant)[:, None] * _matching(wavelength) @ _XYZ_TO_RGB.T
    return np.maximum(reflectance @ (weight / weight.sum(0)), 0)


def _matching(wavelength: np.ndarray) -> np.ndarray:
    """CIE 1931 color matching functions [w 3]: per lobe its channel, height, center, and slopes to both sides."""
    result = np.zeros((len(wavelength), 3))
    for channel, height, center, left, right in _LOBES:
        t = (wavelength - center) * np.where(wavelength < center, left, right)
        result[:, channel] += height * np.exp(-(t**2) / 2)
    return result
