"""Color spaces that image files state: conversion to linear Rec. 709, and what is not converted."""

import struct
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from jaxprt.files import pixels

# Chromaticities x, y of red, green, blue and white.
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
# Chromaticities are written with three to five digits.
_SAME = 1e-3
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# Red, green and blue of sRGB as ICC profiles hold them: XYZ, adapted to D50 (IEC 61966-2-1 with Bradford's matrix).
_SRGB_IN_ICC = np.array([[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7141]])
# Profiles of sRGB differ by up to 0.006; those of Display P3 and Adobe RGB by 0.08 and more.
_NEAR = 0.02
_SRGB_HALF = ((0.5 + 0.055) / 1.055) ** 2.4


def to_rec709(chromaticities: Sequence[float], name: str) -> Float64[np.ndarray, "3 3"] | None:
    """The matrix from linear RGB of other primaries to linear Rec. 709.

    White stays white: where the white points differ, colors are adapted by Bradford's matrix.

    Args:
        chromaticities: x and y of red, green, blue and white.
        name: The image, for the message.

    Returns:
        The matrix, for colors in columns; None if the primaries are those of Rec. 709.

    Raises:
        ValueError: The chromaticities are not finite, or are no primaries.

    Reference: SMPTE RP 177; Lindbloom, "Chromatic adaptation"; ITU-R BT.709.
    """
    if len(chromaticities) == 8 and np.abs(np.subtract(chromaticities, REC709)).max() < _SAME:
        return None
    value = np.asarray(chromaticities, float)
    to_xyz = _rgb_to_xyz(value) if value.shape == (8,) and np.isfinite(value).all() and abs(value[7]) > 1e-6 else None
    if to_xyz is None or not np.isfinite(to_xyz).all() or abs(np.linalg.det(to_xyz)) < 1e-6:
        raise ValueError(f"{name} must state primaries and a white point that span colors, got {value.tolist()}")
    cone, own_cone = (_BRADFORD @ matrix.sum(1) for matrix in (_rgb_to_xyz(np.array(REC709)), to_xyz))
    if (own_cone <= 0).any():
        raise ValueError(f"{name} must state a white point that is a color, got {value[6:].tolist()}")
    adapted = np.linalg.inv(_BRADFORD) @ np.diag(cone / own_cone) @ _BRADFORD
    return np.linalg.inv(_rgb_to_xyz(np.array(REC709))) @ adapted @ to_xyz


def convert(image: np.ndarray, matrix: np.ndarray) -> None:
    """Multiplies the first three channels by a matrix, in place.

    Args:
        image: Pixels [h, w, c] with at least three channels.
        matrix: The matrix, for colors in columns.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # An infinite channel may become NaN; neither is hidden.
        for rows in pixels.row_blocks(image):
            rows[..., :3] = rows[..., :3] @ matrix.T.astype(np.float32)


def icc_difference(profile: bytes, *, curves: bool) -> str:
    """How an ICC profile differs from sRGB.

    Args:
        profile: The profile.
        curves: Whether the curves count too; those of floating-point files do not.

    Returns:
        Description for a warning; empty for sRGB, and for profiles of gray.
    """
    tags = _icc_tags(profile)
    colors = [
        np.frombuffer(tags.get(tag, b"")[8:20].ljust(12, b"\0"), ">i4") / 65536 for tag in (b"rXYZ", b"gXYZ", b"bXYZ")
    ]
    if profile[16:20] != b"GRAY" and np.abs(np.stack(colors) - _SRGB_IN_ICC).max() > _NEAR:
        return "an ICC profile with other primaries than sRGB"
    half = _icc_half(tags.get(b"kTRC", tags.get(b"gTRC", b"")))
    if curves and half is not None and abs(half - _SRGB_HALF) > _NEAR:
        return "an ICC profile with another curve than sRGB"
    return ""


def png_color(start: bytes) -> tuple[float | None, str]:
    """The gamma that a PNG file states, and how its colors differ from sRGB otherwise, apart from ICC profiles.

    Args:
        start: The file, at least up to its pixels.

    Returns:
        Exponent that decodes the values; None for sRGB. Description for a warning, empty if there is nothing to say.

    Reference: PNG specification, third edition, section 11.3.2 and 12.
    """
    chunk = _png_chunks(start)
    if b"cICP" in chunk:  # It overrides all others. 1 and 13 are the primaries and the curve of sRGB.
        code = tuple(chunk[b"cICP"][:2])
        return None, "" if code == (1, 13) else f"a cICP chunk with the code points {code}, where sRGB has (1, 13)"
    if b"iCCP" in chunk or b"sRGB" in chunk:
        return None, ""
    words = ""
    if len(chunk.get(b"cHRM", b"")) == 32:
        white_first = np.array(struct.unpack(">8I", chunk[b"cHRM"])) / 1e5
        if np.abs(np.roll(white_first, -2) - REC709).max() > _NEAR:
            words = f"a cHRM chunk with other primaries than sRGB, {np.roll(white_first, -2).round(4).tolist()}"
    gamma = struct.unpack(">I", chunk[b"gAMA"])[0] / 1e5 if len(chunk.get(b"gAMA", b"")) == 4 else 0.0
    # 1 / 2.2 is how files state the curve of sRGB. A gamma that no display has is a writer's mistake.
    if not 0.1 <= gamma <= 10 or abs(gamma - 1 / 2.2) < 0.01:
        return None, words
    return 1 / gamma, words


def _rgb_to_xyz(chromaticities: np.ndarray) -> np.ndarray:
    x, y = chromaticities.reshape(4, 2).T
    primary = np.stack([x, y, 1 - x - y])
    with np.errstate(all="ignore"):
        white = primary[:, 3] / y[3]
        try:
            return primary[:, :3] * np.linalg.solve(primary[:, :3], white)
        except np.linalg.LinAlgError:
            return np.full((3, 3), np.nan)


def _icc_tags(profile: bytes) -> dict[bytes, bytes]:
    tags = {}
    count = int.from_bytes(profile[128:132], "big")
    for start in range(132, min(132 + 12 * count, len(profile) - 11), 12):
        name, offset, size = struct.unpack(">4sII", profile[start : start + 12])
        tags[name] = profile[offset : offset + size]
    return tags


def _icc_half(curve: bytes) -> float | None:
    """Value of a curve at one half; None if it is of an unknown kind."""
    count = int.from_bytes(curve[8:12], "big")
    if curve[:4] == b"curv" and count == 0:
        return 0.5
    if curve[:4] == b"curv" and count == 1:
        return 0.5 ** (int.from_bytes(curve[12:14], "big") / 256)
    if curve[:4] == b"curv":
        table = np.frombuffer(curve[12 : 12 + 2 * ((len(curve) - 12) // 2)], ">u2")[:count] / 65535
        return float(np.interp(0.5 * (count - 1), np.arange(len(table)), table)) if len(table) else None
    kind = int.from_bytes(curve[8:10], "big")
    lengths = (1, 3, 4, 5, 7)
    if curve[:4] != b"para" or kind >= len(lengths) or len(curve) < 12 + 4 * lengths[kind]:
        return None
    value = (np.frombuffer(curve[12 : 12 + 4 * lengths[kind]], ">i4") / 65536).tolist()
    gamma, scale, shift = (*value, 1.0, 0.0)[:3] if kind == 0 else value[:3]
    with np.errstate(all="ignore"):
        return float(np.power(np.float64(max(scale * 0.5 + shift, 0.0)), gamma))


def _png_chunks(start: bytes) -> dict[bytes, bytes]:
    """Chunks before the pixels."""
    chunk, place = {}, 8
    while place + 8 <= len(start):
        size, name = struct.unpack(">I4s", start[place : place + 8])
        if name == b"IDAT":
            break
        chunk[name] = start[place + 8 : place + 8 + size]
        place += 12 + size
    return chunk
