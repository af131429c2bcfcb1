"""Pixels of image files: how many there may be, how they are read in blocks of rows, and how they are turned."""

import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxprt import require

# 16384 x 16384 pixels, and more than an environment of 16384 x 8192 has. A compressed file of a megabyte can claim a
# thousand times its size, so the limit also holds on machines that have the memory.
MAX_PIXELS = 2**28
_VALUES = 2**21  # values in a block of rows; Ctrl-C takes effect between blocks
_BLOCKS = 16 * _VALUES  # bytes of the temporary arrays of a block, several of float32


def check_size(name: str | pathlib.Path, height: int, width: int) -> None:
    """Refuses images without pixels, and with too many.

    Args:
        name: The image, for the message.
        height: Rows that the header states.
        width: Columns that the header states.

    Raises:
        ValueError: The number of pixels is below 1 or above `MAX_PIXELS`.
    """
    if height < 1 or width < 1 or height * width > MAX_PIXELS:
        raise ValueError(
            f"{name} must have 1 to {MAX_PIXELS} pixels, got {width} x {height} (width x height): reduce its size in "
            "another program first"
        )


def check_memory(name: str | pathlib.Path, height: int, width: int, channels: int, *, decoder: int) -> None:
    """Refuses images that do not fit into memory, before any pixel is read.

    Args:
        name: The image, for the message.
        height: Rows.
        width: Columns.
        channels: Channels that are read, as float32.
        decoder: Bytes that the decoder allocates besides.

    Raises:
        MemoryError: The image does not fit. The message states its size, how much is needed, and how much is free.
    """
    require.memory(
        f"{name}: {width} x {height} pixels (width x height) of {channels} channels",
        4 * height * width * channels + decoder + _BLOCKS,
        "free some memory, or reduce the size of the image in another program first",
    )


def row_blocks(image: np.ndarray) -> Iterator[np.ndarray]:
    """Blocks of rows of an image, which are views of it. Between two blocks Ctrl-C takes effect.

    Args:
        image: Pixels [h, w, c].

    Yields:
        Consecutive rows.
    """
    step = max(1, _VALUES // (image.shape[1] * image.shape[2]))
    for first in range(0, len(image), step):
        yield image[first : first + step]


def read_block(reader: Any, rows: range, *, part: int = 0, channels: range, form: str = "float") -> np.ndarray:
    """Some rows of an image file that OpenImageIO reads, of scan lines or of tiles, at the finest level.

    Args:
        reader: The opened file, an `OpenImageIO.ImageInput`.
        rows: Rows in the coordinates of the file. The first must be the first of a row of tiles.
        part: Number of the image in the file.
        channels: Channels.
        form: Type of the result: "float", or "uint32" for channels of whole numbers in EXR files.

    Returns:
        The pixels, [rows, w, channels].

    Raises:
        ValueError: The file is damaged. The message is the decoder's.
    """
    spec = reader.spec()
    span = channels.start, channels.stop, form
    if spec.tile_width:
        columns = spec.x, spec.x + spec.width
        block = reader.read_tiles(part, 0, *columns, rows.start, rows.stop, 0, 1, *span)
    else:
        block = reader.read_scanlines(part, 0, rows.start, rows.stop, 0, *span)
    # Some readers return incomplete data and only report an error.
    error = reader.geterror()
    if block is None or error:
        raise ValueError(error or "no pixels")
    return np.asarray(block).reshape(len(rows), spec.width, len(channels))


def tile_size(spec: Any) -> tuple[int, int]:
    """Height and width of the tiles of a file that OpenImageIO reads; 1 x 1 for scan lines."""
    return (spec.tile_height, spec.tile_width) if spec.tile_width else (1, 1)


def block_rows(spec: Any) -> int:
    """Rows that `read_rows` reads at once: whole rows of tiles."""
    height, _ = tile_size(spec)
    step = max(1, _VALUES // (spec.width * spec.nchannels))
    return -(-step // height) * height


def block_bytes(spec: Any) -> int:
    """Most bytes that `read_rows` needs besides the image: a block of rows in float32, and a tile.

    Tiles may be larger than the image. The decoder unpacks whole ones, with a copy, and converts them to float32.
    """
    height, width = tile_size(spec)
    block = min(block_rows(spec), spec.height) * spec.width
    return spec.nchannels * (4 * block + (2 * spec.format.size() + 4) * height * width)


def read_rows(reader: Any, image: np.ndarray) -> None:
    """Reads all rows of the first image of a file, block by block, into an array.

    Args:
        reader: The opened file, an `OpenImageIO.ImageInput`.
        image: The array [h, w, c] to fill, of all channels of the file.

    Raises:
        ValueError: The file is damaged. The message is the decoder's.
    """
    spec = reader.spec()
    step = block_rows(spec)
    for first in range(0, spec.height, step):
        rows = range(first, min(first + step, spec.height))
        image[rows.start : rows.stop] = read_block(
            reader, range(spec.y + rows.start, spec.y + rows.stop), channels=range(spec.nchannels)
        )


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
    """Decodes sRGB values to linear ones in place (IEC 61966-2-1).

    Args:
        image: Encoded values [h, w, c] of 0 to 1.
    """
    for rows in row_blocks(image):
        rows[...] = srgb_to_linear(rows)


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Decodes display values of 0 to 1 (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
