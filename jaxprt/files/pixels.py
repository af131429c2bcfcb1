"""Pixels of image files: how many there may be, how they are read in blocks of rows, turned, and their colors."""

import contextlib
import pathlib
import struct
import zlib
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import OpenImageIO
from jaxtyping import Float32, Float64, Num

from jaxprt import require

# 16384 x 16384 pixels, and more than an environment of 16384 x 8192 has. A compressed file of a megabyte can claim a
# thousand times its size, so the limit also holds on machines that have the memory.
MAX_PIXELS = 2**28
_VALUES = 2**21  # values in a block of rows; Ctrl-C takes effect between blocks
_BLOCKS = 16 * _VALUES  # bytes of the temporary arrays of a block, several of float32
# Chromaticities x, y of red, green, blue and white.
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ACES_AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
PRIMARIES = {  # by the color interop IDs of the ASWF's Color Interop Forum that stand for linear values
    "lin_ap0_scene": ACES_AP0,
    "lin_ap1_scene": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
    "lin_p3d65_scene": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290),
    "lin_rec2020_scene": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290),
    "lin_adobergb_scene": (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290),
}
# Chromaticities are written with three to five digits.
_SAME = 1e-3
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
# Red, green and blue of sRGB as ICC profiles hold them: XYZ, adapted to D50 (IEC 61966-2-1 with Bradford's matrix).
_SRGB_IN_ICC = np.array([[0.4361, 0.2225, 0.0139], [0.3851, 0.7169, 0.0971], [0.1431, 0.0606, 0.7141]])
# Profiles of sRGB differ by up to 0.006; those of Display P3 and Adobe RGB by 0.08 and more.
_NEAR = 0.02
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}  # bits, by color type
_PNG_LONGEST = 10**6  # pixels along an edge
# First column and row of each pass of an interlaced PNG file, and the steps between its columns and rows.
_ADAM7 = (0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)
_SRGB_HALF = ((0.5 + 0.055) / 1.055) ** 2.4


def check_size(name: str | pathlib.Path, height: int, width: int) -> None:
    """Refuses images that have no pixels, or too many by their header."""
    if height < 1 or width < 1 or height * width > MAX_PIXELS:
        raise ValueError(
            f"{name} must have 1 to {MAX_PIXELS} pixels, got {width} x {height} (width x height): reduce its size in "
            "another program first"
        )


def check_memory(name: str | pathlib.Path, height: int, width: int, channels: int, *, decoder: int) -> None:
    """Refuses images that do not fit into memory as float32, beside the bytes that their decoder allocates."""
    require.memory(
        f"{name}: {width} x {height} pixels (width x height) of {channels} channels",
        4 * height * width * channels + decoder + _BLOCKS,
        "free some memory, or reduce the size of the image in another program first",
    )


def row_blocks(image: np.ndarray) -> Iterator[np.ndarray]:
    """Blocks of rows of an image, which are views of it. Between two blocks Ctrl-C takes effect."""
    step = max(1, _VALUES // (image.shape[1] * image.shape[2]))
    for first in range(0, len(image), step):
        yield image[first : first + step]


class DamageError(Exception):
    """What a decoder says of a file that it cannot read."""


@contextlib.contextmanager
def opened(path: pathlib.Path) -> Iterator[Any]:
    """OpenImageIO's reader of a file, an `OpenImageIO.ImageInput`; DamageError if there is none."""
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # Otherwise colors come premultiplied by alpha.
    reader = OpenImageIO.ImageInput.open(str(path), config)
    if reader is None:
        raise DamageError(OpenImageIO.geterror())  # which is printed at the end of the program unless it is asked for
    try:
        yield reader
    finally:
        reader.close()


def read(
    reader: Any,
    name: str,
    *,
    part: int = 0,
    channels: Sequence[str] | None = None,
    window: Any = None,
    decoder: int = 0,
) -> Float32[np.ndarray, "h w c"]:
    """Reads an image, if it has the right size and fits into memory, at the finest level.

    Args:
        reader: The opened file.
        name: The image, for messages.
        part: Index of the image in the file.
        channels: Names of the channels that are read; None reads all.
        window: What is returned, an `OpenImageIO.ROI`, with zeros where the file has no pixels; None is that of the
            pixels.
        decoder: Bytes that the decoder allocates besides blocks of rows.
    """
    reader.seek_subimage(part, 0)
    spec = reader.spec()
    data, tile = spec.roi, _chunk_size(spec)
    window = window or data
    for height, width in ((window.height, window.width), (data.height, data.width), tile):
        check_size(name, height, width)
    top, left = data.ybegin - window.ybegin, data.xbegin - window.xbegin
    if top >= window.height or left >= window.width or top + data.height <= 0 or left + data.width <= 0:
        raise ValueError(
            f"{name} must have a data window that overlaps its display window, got columns {data.xbegin}.."
            f"{data.xend - 1} and rows {data.ybegin}..{data.yend - 1} outside of it"
        )
    indices = [spec.channelnames.index(channel) for channel in channels or spec.channelnames]
    kinds = {str(spec.channelformats[index]) for index in indices} if spec.channelformats else {str(spec.format)}
    # OpenImageIO would divide the whole numbers of EXR files by the largest one.
    form = "uint32" if kinds == {"uint"} and reader.format_name() == "openexr" else "float"
    # The decoder unpacks all channels of whole tiles, with a copy, and converts them to float32.
    block = 4 * min(_block_rows(spec), data.height) * data.width
    decoder += spec.nchannels * (block + (2 * spec.format.size() + 4) * tile[0] * tile[1])
    check_memory(name, window.height, window.width, len(indices), decoder=decoder)

    image = np.zeros((window.height, window.width, len(indices)), np.float32)
    for rows, values in blocks(reader, part=part, channels=indices, form=form):
        first = top + rows.start
        inside = image[max(first, 0) : max(first + len(rows), 0), max(left, 0) : left + data.width]
        above, before = max(-first, 0), max(-left, 0)
        inside[...] = values[above : above + inside.shape[0], before : before + inside.shape[1]]
    return image


def blocks(
    reader: Any, *, part: int = 0, channels: Sequence[int], form: str
) -> Iterator[tuple[range, Num[np.ndarray, "h w c"]]]:
    """Blocks of rows of an image, counted from 0, with the channels of some indices in a type of OpenImageIO's name."""
    spec = reader.spec()
    step = _block_rows(spec)
    span = min(channels), max(channels) + 1
    for first in range(0, spec.height, step):
        rows = range(first, min(first + step, spec.height))
        lines = spec.y + rows.start, spec.y + rows.stop
        if spec.tile_width:
            block = reader.read_tiles(part, 0, spec.x, spec.x + spec.width, *lines, 0, 1, *span, form)
        else:
            block = reader.read_scanlines(part, 0, *lines, 0, *span, form)
        # Some readers return incomplete data and only report an error.
        error = reader.geterror()
        if block is None or error:
            raise DamageError(error or "no pixels")
        values = np.asarray(block).reshape(len(rows), spec.width, span[1] - span[0])
        yield rows, values[..., [index - span[0] for index in channels]]


def _block_rows(spec: Any) -> int:
    """Rows that are read at once: whole rows of tiles, which may be larger than the image."""
    height, _ = _chunk_size(spec)
    return -(-max(1, _VALUES // (spec.width * spec.nchannels)) // height) * height


def _chunk_size(spec: Any) -> tuple[int, int]:
    """Height and width of what a decoder unpacks at once: tiles, or scan lines that are compressed together."""
    if spec.tile_width:
        return spec.tile_height, spec.tile_width
    return max(1, spec.get_int_attribute("oiio:RowsPerChunk", 1)), spec.width


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Turns and mirrors an image as its Exif orientation demands. The result is a view.

    Args:
        image: Pixels [h, w, ...] in the order of the file.
        orientation: 1 to 8: where the first row and the first column of the file are to be shown, in the order "top
            left", "top right", "bottom right", "bottom left", "left top", "right top", "right bottom", "left bottom".

    Returns:
        The image with its first row on top and its first column on the left. From 5 on, height and width are exchanged.

    Reference: CIPA DC-008 (Exif 2.32), section 4.6.4, tag 274; TIFF 6.0, page 36.
    """
    if orientation >= 5:  # The first row of the file is a column of the picture.
        image = image.swapaxes(0, 1)
    flipped_rows, flipped_columns = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return image[:: -1 if flipped_rows else 1, :: -1 if flipped_columns else 1]


def decode_srgb(image: np.ndarray) -> None:
    """Decodes sRGB values [h, w, c] of 0 to 1 to linear ones in place (IEC 61966-2-1)."""
    for rows in row_blocks(image):
        rows[...] = srgb_to_linear(rows)


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Decodes display values of 0 to 1 (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def to_rec709(chromaticities: Sequence[float], name: str) -> Float64[np.ndarray, "3 3"] | None:
    """The matrix from linear RGB of other primaries to linear Rec. 709.

    White stays white: where the white points differ, colors are adapted by Bradford's matrix.

    Args:
        chromaticities: x and y of red, green, blue and white.
        name: The image, for the message.

    Returns:
        The matrix, for colors in columns; None if the primaries are those of Rec. 709.
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
    """Multiplies the first three channels of pixels [h, w, c] by a matrix, for colors in columns, in place."""
    with np.errstate(invalid="ignore", over="ignore"):  # An infinite channel may become NaN; neither is hidden.
        for rows in row_blocks(image):
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


def png_color(chunk: dict[bytes, bytes]) -> tuple[float | None, str]:
    """The gamma that a PNG file states, and how its colors differ from sRGB otherwise, apart from ICC profiles.

    Args:
        chunk: The chunks before the pixels, by `png_chunks`.

    Returns:
        Exponent that decodes the values; None for sRGB. Description for a warning, empty if there is nothing to say.

    Reference: PNG specification, third edition, section 11.3.2 and 12.
    """
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


def png_chunks(content: bytes, name: str) -> dict[bytes, bytes]:
    """The chunks of a PNG file up to the end of its pixels, which libpng can read.

    libpng itself prints a line on the standard error for a file that it cannot read.

    Args:
        content: The file.
        name: Name of the file in messages.

    Raises:
        DamageError: libpng cannot read the file.

    Reference: PNG specification, third edition, sections 5, 7, 9 and 11.2.
    """
    chunk: dict[bytes, bytes] = {}
    start, data = 8, []
    # libpng reads on to the end of the file after the pixels only where they are interlaced.
    while not data or content[start + 4 : start + 8] == b"IDAT" or chunk[b"IHDR"][12:] == b"\1":
        size, kind = int.from_bytes(content[start : start + 4], "big"), content[start + 4 : start + 8]
        body, end = content[start + 8 : start + 8 + size], start + 12 + size
        if len(content) < end or not kind.isalpha() or kind[2] & 32:  # the third letter is a capital
            raise DamageError(f"a file that is cut off or damaged at byte {start}")
        needed = not kind[0] & 32  # a capital
        known = kind in (b"IHDR", b"PLTE", b"IDAT", b"IEND") and kind not in chunk
        if (kind == b"IHDR") != (start == 8) or (needed and not known):
            raise DamageError(f"a chunk {kind.decode()} at byte {start}, which no PNG file has there")
        if kind == b"IEND":
            break
        if needed and zlib.crc32(kind + body) != int.from_bytes(content[end - 4 : end], "big"):
            raise DamageError(f"a chunk {kind.decode()} at byte {start} with a wrong checksum")
        if kind == b"IDAT":
            data.append(body)
        elif needed or not data:
            chunk[kind] = body
        start = end
    header = chunk[b"IHDR"]
    if len(header) != 13:
        raise DamageError(f"a header of {len(header)} bytes, which must have 13")
    width, height, depth, color, *methods, interlaced = struct.unpack(">2I5B", header)
    if depth not in _PNG_DEPTHS.get(color, ()) or any(methods) or interlaced > 1:
        words = f"depth {depth}, color type {color} and methods {[*methods, interlaced]}"
        raise DamageError(f"{words}, which no PNG file has")
    palette = len(chunk.get(b"PLTE", b""))
    if color == 3 and (not 0 < palette <= 768 or palette % 3):
        raise DamageError(f"a palette of {palette} bytes, which must have 3 for each of 1 to 256 colors")
    check_size(name, height, width)
    if max(width, height) > _PNG_LONGEST:
        raise DamageError(
            f"{width} x {height} pixels (width x height), which must have edges of at most {_PNG_LONGEST}"
        )
    channels = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}[color]
    packed = b"".join(data)
    # The compressed bytes, and the scan lines with the filter of each.
    check_memory(name, height, width, channels, decoder=len(packed) + height * (width * depth * channels // 8 + 2))
    _check_scanlines(packed, width, height, depth * channels, interlaced=bool(interlaced))
    return chunk


def _check_scanlines(packed: bytes, width: int, height: int, bits: int, *, interlaced: bool) -> None:
    """Raises DamageError for scan lines of a PNG file, with so many bits for each pixel, that cannot be read."""
    passes = _ADAM7 if interlaced else ((0, 0, 1, 1),)
    sizes = [(-(-(height - y) // down), -(-(width - x) // across)) for x, y, across, down in passes]
    lines = [(rows, 1 + -(-columns * bits // 8)) for rows, columns in sizes if rows > 0 and columns > 0]
    total = sum(rows * length for rows, length in lines)
    unpack = zlib.decompressobj()
    try:
        value = np.frombuffer(unpack.decompress(packed, total), np.uint8)
        complete = len(value) == total and (unpack.decompress(unpack.unconsumed_tail, 1) or unpack.eof)
    except zlib.error as error:
        raise DamageError(f"pixels that cannot be unpacked: {error}") from error
    if not complete:
        raise DamageError(f"{len(value)} bytes of pixels and no end of them, which must have {total}")
    first = 0
    for rows, length in lines:
        if (value[first : first + rows * length : length] > 4).any():
            raise DamageError("scan lines of an unknown filter")
        first += rows * length
