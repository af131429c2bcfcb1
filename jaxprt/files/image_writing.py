"""Writing of image files. OpenEXR writes EXR, and OpenImageIO PNG. What was written is read back and compared."""

import os
import pathlib

import numpy as np
import OpenEXR
import OpenImageIO
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.files import outputs, pixels

_PNG_END = b"\0\0\0\0IEND\xae\x42\x60\x82"  # the last chunk, with its checksum
_INCOMPLETE = "the file is incomplete; the disk may be full"
_BLOCK = 2**21  # values that are compared per step


def write_exr(path: str | pathlib.Path, image: Float[np.ndarray | Array, "h w c"]) -> None:
    """Writes linear values to an EXR file of 32-bit floats with lossless compression.

    Args:
        path: The file, which must end in .exr. An old file is replaced once the new one is complete.
        image: Linear values with 1 (gray, written as Y), 3 (RGB) or 4 (RGBA) channels.

    Raises:
        ValueError: The image is empty, not of a floating-point type, or has another number of channels; or the name
            does not end in .exr.
        OSError: The file cannot be written. An old file is unchanged.
    """
    names = _channel_names(image, {1: "Y", 3: "RGB", 4: "RGBA"})
    outputs.target(path, ".exr")
    # OpenEXR silently writes wrong values for arrays that are not contiguous.
    values = np.asarray(image, np.float32)
    channels = {name: np.ascontiguousarray(values[..., i]) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with outputs.replacing(path) as new:
        try:
            with OpenEXR.File(header, channels) as file:
                file.write(str(new))
        except RuntimeError as error:  # also for a full disk
            raise OSError(str(error).replace(str(new), os.fspath(path))) from error
        _compare(new, values, "float")


def write_png(path: str | pathlib.Path, image: Float[np.ndarray | Array, "h w c"]) -> None:
    """Writes an image that is already encoded for display to an 8-bit PNG file.

    Args:
        path: The file, which must end in .png. An old file is replaced once the new one is complete.
        image: Display values with 1, 3 or 4 channels. 0 is black and 1 is white; other values are clamped.

    Raises:
        ValueError: The image is empty, not of a floating-point type, has another number of channels, or holds NaN; or
            the name does not end in .png.
        OSError: The file cannot be written. An old file is unchanged.
    """
    _channel_names(image, {1: "Y", 3: "RGB", 4: "RGBA"})
    outputs.target(path, ".png")
    values = np.asarray(image, np.float64)
    wrong = np.argwhere(np.isnan(values).any(axis=-1))
    if len(wrong):
        raise ValueError(f"image must not hold NaN, got {len(wrong)} such pixels, first at {tuple(map(int, wrong[0]))}")
    values = np.ascontiguousarray(np.round(np.clip(values, 0, 1) * 255).astype(np.uint8))
    height, width, count = values.shape
    spec = OpenImageIO.ImageSpec(width, height, count, "uint8")
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("oiio:UnassociatedAlpha", 1)
    output = OpenImageIO.ImageOutput.create("png")
    assert output is not None  # OpenImageIO's wheels include PNG.
    with outputs.replacing(path) as new:
        # The encoder does not report a full disk, so its word alone does not count.
        if not (output.open(str(new), spec) and output.write_image(values) and output.close()):
            raise OSError(output.geterror().replace(str(new), os.fspath(path)) or "the encoder failed")
        _compare(new, values, "uint8")
        with new.open("rb") as file:
            file.seek(-len(_PNG_END), os.SEEK_END)
            if file.read() != _PNG_END:  # The pixels can be read without it, but not by every program.
                raise OSError(_INCOMPLETE)


def _channel_names(image: Float[np.ndarray | Array, "h w c"], names: dict[int, str]) -> str:
    require.real("image", image)
    require.array("image", image, "h w c")
    if image.dtype.kind != "f":
        raise ValueError(f"image must be of floating point, with 1 for white in pictures, got {image.dtype}")
    if image.ndim != 3 or 0 in image.shape or image.shape[-1] not in names:
        raise ValueError(f"image must be [h, w, c] with c one of {list(names)} and no empty axis, got {image.shape}")
    return names[image.shape[-1]]


def _compare(path: pathlib.Path, values: np.ndarray, form: str) -> None:
    """Raises an OSError if a file does not hold the values, bit by bit."""
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    reader = OpenImageIO.ImageInput.open(str(path), config)
    if reader is None:
        OpenImageIO.geterror()  # Otherwise it is printed at the end of the program.
        raise OSError(_INCOMPLETE)
    try:
        spec = reader.spec()
        if (spec.height, spec.width, spec.nchannels) != values.shape:
            raise OSError(_INCOMPLETE)
        step = max(16, _BLOCK // (spec.width * spec.nchannels) // 16 * 16)  # EXR has blocks of 16 rows.
        for first in range(0, spec.height, step):
            rows = range(first, min(first + step, spec.height))
            block = pixels.read_block(reader, rows, channels=range(spec.nchannels), form=form)
            same = block.view(np.uint8) == np.ascontiguousarray(values[rows.start : rows.stop]).view(np.uint8)
            if not same.all():
                raise OSError(_INCOMPLETE)
    except ValueError as error:
        raise OSError(_INCOMPLETE) from error
    finally:
        reader.close()
