"""Colors of vertices and faces in mesh files, which are display values like those of images."""

import numpy as np

from jaxprt.files import pixels

_DISPLAY_MOST = 255.0  # largest value in files that write the whole numbers of 8-bit colors as other types
_PAINTED_MOST = 2.0  # largest float that counts as a color above white, such as 1 and rounding


def linear(value: np.ndarray) -> np.ndarray:
    """Converts colors of a mesh file to linear values.

    Integers of 16 bits without a sign are divided by 65535, other integers by 255. Floats are between 0 and 1, or
    between 0 and 255 if one of them is above 2; values a little above 1 are white. The result is decoded from sRGB: the
    formats do not state what colors mean, and MeshLab, CloudCompare and Blender write what they display.

    Args:
        value: Colors of any numeric type [n 3].

    Returns:
        Linear colors between 0 and 1; NaN for colors that are not finite.
    """
    scaled = value.astype(np.float64)
    if value.dtype == np.int8:  # bytes of a color that a header calls signed
        scaled = value.view(np.uint8).astype(np.float64)
    if value.dtype == np.uint16:
        scaled /= np.iinfo(np.uint16).max
    elif value.dtype.kind in "iu" or (scaled[np.isfinite(scaled)] > _PAINTED_MOST).any():
        scaled /= _DISPLAY_MOST
    scaled = np.where(np.isfinite(scaled).all(1, keepdims=True), np.clip(scaled, 0, 1), np.nan)
    return pixels.srgb_to_linear(scaled)
