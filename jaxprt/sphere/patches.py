"""Sky patches of Tregenza and Reinhart, numbered as in Radiance's `gendaymtx` and `reinhart.cal`.

Patch 0 is the ground, the whole lower hemisphere. The sky follows in rows of equal height from the horizon up. A row
starts at north and runs clockwise, and its first patch is centered on north. The last patch is a cap around the zenith.
Subdivision 1 is the sky of Tregenza; subdivision m (MF in Radiance) divides its patches into m x m.

In the world +x is east, +y up and -z north. Everything here is float64 on the host.

Reference: Tregenza 1987, Subdivision of the sky hemisphere for luminance measurements; Bourgeois, Reinhart, Ward 2008,
Standard daylight coefficient model for dynamic daylighting simulations.
"""

import numpy as np
from jaxtyping import Float, Int

MOST = 6  # the finest subdivision
_TREGENZA = np.array([30, 30, 24, 24, 18, 12, 6])  # patches per row, from the horizon up


def count(subdivision: int) -> int:
    """Number of patches with the ground: 146, 578, 1298, 2306, 3602 and 5186 for subdivisions 1 to 6.

    Raises:
        ValueError: `subdivision` is not between 1 and 6.
    """
    return int(_row_sizes(subdivision).sum()) + 1


def centers(*, subdivision: int = 1) -> Float[np.ndarray, "p 3"]:
    """Unit directions to the centers of the patches. The ground's is straight down."""
    row, column, size = _columns(subdivision)
    altitude = np.minimum((row + 0.5) * _height(subdivision), np.pi / 2)
    azimuth = 2 * np.pi * column / size
    level = np.where(row == row[-1], 0, np.cos(altitude))  # exactly 0 at the zenith
    sky = np.stack([level * np.sin(azimuth), np.sin(altitude), -level * np.cos(azimuth)], axis=-1)
    return np.concatenate([[[0.0, -1.0, 0.0]], sky])


def solid_angles(*, subdivision: int = 1) -> Float[np.ndarray, " p"]:
    """Exact solid angles of the patches, in sr. They sum to 4 pi, and those of the sky to 2 pi."""
    row, _, size = _columns(subdivision)
    return np.concatenate([[2 * np.pi], 2 * np.pi * np.diff(_edges(subdivision))[row] / size])


def projected_solid_angles(*, subdivision: int = 1) -> Float[np.ndarray, " p"]:
    """Integrals of |cos(angle to the vertical)| over the patches, in sr. The ground's is pi, the sky's sum to pi.

    The sum of radiance times these over the sky is the irradiance of a horizontal surface.
    """
    row, _, size = _columns(subdivision)
    return np.concatenate([[np.pi], np.pi * np.diff(_edges(subdivision) ** 2)[row] / size])


def index_of(direction: Float[np.ndarray, "n 3"], *, subdivision: int = 1) -> Int[np.ndarray, " n"]:
    """Index of the patch that a direction points into. Directions of the horizon belong to the sky.

    Args:
        direction: Directions of any length but 0.
        subdivision: Number of parts into which the edges of Tregenza's patches are divided.

    Raises:
        ValueError: A direction is zero, NaN or infinite, or `subdivision` is not between 1 and 6.
    """
    size = _row_sizes(subdivision)
    if not np.isfinite(direction).all():
        raise ValueError("the directions must be finite")
    x, y, z = np.moveaxis(np.asarray(direction, np.float64), -1, 0)
    zero = np.flatnonzero((x == 0) & (y == 0) & (z == 0))
    if len(zero):
        raise ValueError(f"directions must not be zero, got {len(zero)} that are, first at {zero[0]}")
    row = (np.arctan2(np.maximum(y, 0), np.hypot(x, z)) / _height(subdivision)).astype(int).clip(0, len(size) - 1)
    turn = np.arctan2(x, -z) / (2 * np.pi)
    column = np.floor(turn * size[row] + 0.5).astype(int) % size[row]
    first = 1 + np.cumsum(size) - size
    return np.where(y < 0, 0, first[row] + column)


def _row_sizes(subdivision: int) -> Int[np.ndarray, " r"]:
    """Patches in each row of the sky; the last row is the zenith."""
    if subdivision not in range(1, MOST + 1):
        raise ValueError(f"the subdivision of the sky must be a whole number between 1 and {MOST}, got {subdivision!r}")
    return np.append(np.repeat(_TREGENZA, subdivision) * subdivision, 1)


def _height(subdivision: int) -> float:
    """Height of a row in radians; the zenith's cap has half of it as its radius."""
    return np.pi / 2 / (len(_TREGENZA) * subdivision + 0.5)


def _edges(subdivision: int) -> Float[np.ndarray, " e"]:
    """Sines of the altitudes of the edges between rows, from the horizon to the zenith."""
    altitude = np.arange(len(_TREGENZA) * subdivision + 1) * _height(subdivision)
    return np.append(np.sin(altitude), 1)


def _columns(subdivision: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column in it, and size of the row of each patch of the sky."""
    size = _row_sizes(subdivision)
    row = np.repeat(np.arange(len(size)), size)
    return row, np.concatenate([np.arange(columns) for columns in size]), size[row]
