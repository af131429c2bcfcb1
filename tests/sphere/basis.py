"""Spherical harmonics by SciPy, for the files that compare with them."""

import numpy as np
from scipy.special import sph_harm_y


def band(degree: int) -> np.ndarray:
    """Band l of each coefficient."""
    return np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)


def scipy_basis(direction: np.ndarray, degree: int) -> np.ndarray:
    """SciPy's complex harmonics as real ones, and without their Condon-Shortley phase."""
    x, y, z = np.asarray(direction, np.float64).T
    l = band(degree)
    m = np.arange(len(l)) - l * (l + 1)
    value = sph_harm_y(l, abs(m), np.arctan2(np.hypot(x, y), z)[:, None], np.arctan2(y, x)[:, None])
    part = np.where(m < 0, value.imag, value.real) * np.where(m == 0, 1, np.sqrt(2))
    return part * (-1.0) ** abs(m)
