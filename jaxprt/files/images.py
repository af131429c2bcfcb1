"""Reading of image files. EXR and Radiance pictures have files of their own; OpenImageIO reads all other formats."""

import pathlib
import tempfile
import typing
import warnings
from functools import partial

import numpy as np
import OpenImageIO
from jaxtyping import Float32

from jaxprt import require
from jaxprt.files import color_spaces, inputs, ktx2, pixels
from jaxprt.files.exr import read_exr
from jaxprt.files.radiance_hdr import read_radiance

_MAGIC = (
    (b"\x76\x2f\x31\x01", "openexr"),
    (b"#?", "hdr"),
    (b"\x89PNG", "png"),
    (b"\xff\xd8\xff", "jpeg"),
    (b"II*\x00", "tiff"),
    (b"MM\x00*", "tiff"),
    (b"PF", "pnm"),
    (b"Pf", "pnm"),
    (b"BM", "bmp"),
    (ktx2.MAGIC, "ktx2"),
)
_WEBP = b"RIFF", b"WEBP"  # the first four bytes, and those from the eighth on
_PNG_START = 2**20  # Chunks before the pixels are within these bytes, apart from absurd ones.


@require.arguments(path=partial(require.path, "path"))
def read_image(path: str | pathlib.Path) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    """Reads an image file as linear values.

    The format (EXR, Radiance HDR, PNG, JPEG, TIFF, PFM, BMP, WebP or KTX 2) is recognized from the first bytes of the
    file, not from its name. The pixels are turned as the file's orientation demands. Alpha is not applied; it is the
    last of two or four channels.

    * Radiance HDR: pixels are divided by the exposures and color corrections of the header, and converted from its
      primaries to Rec. 709.
    * EXR: the first part with RGB channels, or else with Y, is read at the finest level. Its chromaticities, color
      interop ID or ACES container flag are converted to Rec. 709. If its data window is smaller than the display
      window, the rest is black; data outside of the display window is cut off. Where white points differ, white stays
      white (Bradford's matrix).
    * Integer formats (PNG, JPEG, ...): values are decoded from sRGB, unless a PNG file states another gamma, or the
      file states that it is linear. Other primaries and ICC profiles are not converted, with a warning.
    * KTX 2: textures of Basis Universal, at the finest level, with the package opengl_basisu (`jaxprt[web]`).
    * Floating-point TIFF and PFM files: values are used as they are.

    Args:
        path: The file.

    Returns:
        The pixels with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGBA) channels, and the attributes of the header, which
        describe the file before conversion. For EXR environment maps the attribute ``envmap`` is "latlong" or "cube".

    Raises:
        FileNotFoundError: The file does not exist.
        ImportError: The file is a KTX 2 texture, and the package opengl_basisu is missing.
        ValueError: The path is not a regular file, or the file is empty, damaged, of an unknown format, has other
            channels, or more than 2^28 pixels.
        MemoryError: The pixels do not fit into memory.
    """
    path = pathlib.Path(path).absolute()
    inputs.check(path, "an image file")
    return _read(path, str(path), decoded=None)


def decode_image(content: bytes, *, name: str, decoded: bool = True) -> Float32[np.ndarray, "h w c"]:
    """Reads an image file whose content is in memory, such as one inside of a GLB file.

    Formats, channels, limits and orientation are those of `read_image`.

    Args:
        content: The bytes of the file.
        name: Name of the image in error messages.
        decoded: True decodes integers from sRGB, whatever the file states, as for colors. False divides them by the
            largest value of their type, as for roughness or normals.

    Returns:
        The pixels with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGBA) channels.

    Raises:
        ValueError: The content is empty, damaged, of an unknown format, or has other channels or too many pixels.
        MemoryError: The pixels do not fit into memory.
    """
    # OpenImageIO can read from memory only in C++, so a temporary file is used.
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "image"
        path.write_bytes(content)
        try:
            return _read(path, name, decoded=decoded)[0]
        except ValueError as error:  # Messages of the decoders name the temporary file.
            raise ValueError(str(error).replace(str(path), name)) from error


def _read(
    path: pathlib.Path, name: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    with path.open("rb") as file:
        start = file.read(16)
    form = next((form for magic, form in _MAGIC if start.startswith(magic)), None)
    if (start[:4], start[8:12]) == _WEBP:
        form = "webp"
    if form is None:
        got = f"one that starts with {start[:8]!r}" if start else "an empty file"
        raise ValueError(f"{name} must be an EXR, HDR, PNG, JPEG, TIFF, PFM, BMP, WebP or KTX 2 image, got {got}")
    try:
        if form == "openexr":
            return read_exr(path, name)
        if form == "hdr":
            return read_radiance(path, name)
        if form == "ktx2":
            return ktx2.read_ktx2(inputs.content(path, "an image file"), name, decoded=decoded)
        return _read_other(path, name, form, decoded=decoded)
    except MemoryError as error:  # NumPy's does not name the file, where a process may use less than is free.
        raise error if name in str(error) else MemoryError(f"{name} must fit into memory, got: {error}") from error


def _read_other(
    path: pathlib.Path, name: str, form: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # Otherwise colors come premultiplied by alpha.
    reader = OpenImageIO.ImageInput.open(str(path), config)
    if reader is None:
        raise ValueError(f"{name} must be an undamaged {form} file, got: {OpenImageIO.geterror()}")
    try:
        if reader.format_name() != form:
            raise ValueError(
                f"{name} must be an undamaged {form} file, got one that only a {reader.format_name()} reader takes"
            )
        spec = reader.spec()
        for height, width in ((spec.height, spec.width), pixels.tile_size(spec)):
            pixels.check_size(name, height, width)
        if not 1 <= spec.nchannels <= 4 or spec.depth > 1:
            raise ValueError(f"{name} must have 1 to 4 channels and be flat, got {spec.nchannels}, depth {spec.depth}")
        # Decoders of interlaced and progressive files, and of strips, hold all values in the file's type.
        native = spec.height * spec.width * spec.nchannels * spec.format.size()
        decoder = 2 * native + pixels.block_bytes(spec)
        pixels.check_memory(name, spec.height, spec.width, spec.nchannels, decoder=decoder)
        image = np.empty((spec.height, spec.width, spec.nchannels), np.float32)
        try:
            pixels.read_rows(reader, image)
        except ValueError as error:
            raise ValueError(f"{name} must be an undamaged {form} file, got: {error}") from error
    finally:
        reader.close()
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    stated = attributes.get("Orientation", 1)
    # Exif has no other orientations than 1 to 8; viewers show files with others as they are.
    orientation = stated if isinstance(stated, int) and 1 <= stated <= 8 else 1
    whole = spec.format.basetype in (OpenImageIO.UINT8, OpenImageIO.UINT16)
    gamma = _check_color(path, name, form, attributes, whole=whole) if decoded is None else None
    colors = image[..., : spec.nchannels - (spec.nchannels in (2, 4))]
    # The gamma of PNG files says more; OpenImageIO takes one of 0 for a linear file.
    linear = form != "png" and str(attributes.get("oiio:ColorSpace", "")).lower().startswith("lin")
    if whole and gamma is not None:
        for rows in pixels.row_blocks(colors):
            rows **= np.float32(gamma)
    elif whole and (decoded if decoded is not None else not linear):
        pixels.decode_srgb(colors)
    return pixels.upright(image, orientation), attributes


def _check_color(
    path: pathlib.Path, name: str, form: str, attributes: dict[str, typing.Any], *, whole: bool
) -> float | None:
    """The exponent that decodes the values of a PNG file; None for sRGB. Warns of colors that are not converted."""
    gamma, words = None, ""
    if form == "png":
        with path.open("rb") as file:
            gamma, words = color_spaces.png_color(file.read(_PNG_START))
    if not words and "ICCProfile" in attributes:
        profile = np.asarray(attributes["ICCProfile"]).astype(np.uint8).tobytes()
        words = color_spaces.icc_difference(profile, curves=whole)
        title = str(attributes.get("ICCProfile:profile_description", ""))
        words += f" ({title})" if words and title else ""
    if words:
        how = "sRGB" if whole else "linear Rec. 709"
        warnings.warn(f"{name} has {words}, which is not converted: its values are taken as {how}", stacklevel=5)
    return gamma
