"""Image files. OpenEXR reads and writes EXR; OpenImageIO handles all other formats."""

import pathlib
import tempfile
import typing
from functools import partial

import numpy as np
import OpenEXR
import OpenImageIO
from jaxtyping import Array, Float, Float32

from jaxprt import require

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
)
# Sets of channels that are read from EXR files; the first that matches is used. Alpha is read too if there is one.
_CHANNELS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
# A larger size is taken for a broken header: 16384 x 32768 pixels are 6 GB as float32 RGB.
_MAX_PIXELS = 2**29


@require.arguments(path=partial(require.path, "path"))
def read_image(path: str | pathlib.Path) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    """Reads an image file as linear values.

    The format (EXR, Radiance HDR, PNG, JPEG, TIFF, PFM or BMP) is recognized from the first bytes of the file, not from
    its name. Integer formats (PNG, JPEG, ...) are decoded from sRGB unless the file states that it is linear. Files of
    floating-point numbers are used as they are. Primaries and the exposure in HDR headers are not applied; they are
    among the returned attributes. Of an EXR file only the first part is read, at the finest level. If its data window
    is smaller than the display window, the rest is black; data outside of the display window is cut off. Alpha is not
    applied; it is the last of two or four channels.

    Args:
        path: The file.

    Returns:
        The pixels with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGBA) channels, and the attributes of the header. For
        EXR environment maps the attribute ``envmap`` is "latlong" or "cube".

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The path is a directory, or the file is empty, damaged, of an unknown format, or has other channels.
    """
    path = pathlib.Path(path).absolute()
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    if not path.is_file():
        raise ValueError(f"{path} must be an image file, got a {'directory' if path.is_dir() else 'special file'}")
    return _read(path, decoded=None)


def decode_image(content: bytes, *, name: str, decoded: bool = True) -> Float32[np.ndarray, "h w c"]:
    """Reads an image file whose content is in memory, such as one inside of a GLB file.

    Formats and channels are those of `read_image`.

    Args:
        content: The bytes of the file.
        name: Name of the image in error messages.
        decoded: True decodes integers from sRGB, whatever the file states, as for colors. False divides them by the
            largest value of their type, as for roughness or normals.

    Returns:
        The pixels with 1 (gray), 2 (gray, alpha), 3 (RGB) or 4 (RGBA) channels.

    Raises:
        ValueError: The content is empty, damaged, of an unknown format, or has other channels.
    """
    # OpenImageIO can read from memory only in C++, so a temporary file is used.
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "image"
        path.write_bytes(content)
        try:
            return _read(path, decoded=decoded)[0]
        except ValueError as error:
            raise ValueError(str(error).replace(str(path), name)) from error


def _read(path: pathlib.Path, *, decoded: bool | None) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    with path.open("rb") as file:
        start = file.read(2048)
    form = next((form for magic, form in _MAGIC if start.startswith(magic)), None)
    if form is None:
        got = f"one that starts with {start[:8]!r}" if start else "an empty file"
        raise ValueError(f"{path} must be an EXR, HDR, PNG, JPEG, TIFF, PFM or BMP image, got {got}")
    if form == "openexr":
        return _read_exr(path)
    if form == "hdr" and b"32-bit_rle_xyze" in start:
        raise ValueError(f"{path} must hold RGB (32-bit_rle_rgbe), got XYZ (32-bit_rle_xyze): convert it first")
    return _read_other(path, form, decoded=decoded)


def write_exr(path: str | pathlib.Path, image: Float[np.ndarray | Array, "h w c"]) -> None:
    """Writes linear values to an EXR file of 32-bit floats with lossless compression.

    Args:
        path: The file. An existing file is replaced.
        image: Linear values with 1 (gray, written as Y), 3 (RGB) or 4 (RGBA) channels.

    Raises:
        ValueError: The image is empty, not of a floating-point type, or has another number of channels.
        OSError: The file cannot be written.
    """
    names = _channel_names(image, {1: "Y", 3: "RGB", 4: "RGBA"})
    _check_folder(path)
    # OpenEXR silently writes wrong values for arrays that are not contiguous.
    values = np.asarray(image, np.float32)
    channels = {name: np.ascontiguousarray(values[..., i]) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def write_png(path: str | pathlib.Path, image: Float[np.ndarray | Array, "h w c"]) -> None:
    """Writes an image that is already encoded for display to an 8-bit PNG file.

    Args:
        path: The file. An existing file is replaced.
        image: Display values with 1, 3 or 4 channels. 0 is black and 1 is white; other values are clamped.

    Raises:
        ValueError: The image is empty, not of a floating-point type, has another number of channels, or holds NaN.
        OSError: The file cannot be written.
    """
    _channel_names(image, {1: "Y", 3: "RGB", 4: "RGBA"})
    _check_folder(path)
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
    if not (output.open(str(path), spec) and output.write_image(values) and output.close()):
        raise OSError(f"{path}: {output.geterror() or 'cannot be written'}")


def _channel_names(image: Float[np.ndarray | Array, "h w c"], names: dict[int, str]) -> str:
    require.real("image", image)
    require.array("image", image, "h w c")
    if image.dtype.kind != "f":
        raise ValueError(f"image must be of floating point, with 1 for white in pictures, got {image.dtype}")
    if image.ndim != 3 or 0 in image.shape or image.shape[-1] not in names:
        raise ValueError(f"image must be [h, w, c] with c one of {list(names)} and no empty axis, got {image.shape}")
    return names[image.shape[-1]]


def _check_folder(path: str | pathlib.Path) -> None:
    require.path("path", path)
    folder = pathlib.Path(path).absolute().parent
    if not folder.is_dir():
        raise FileNotFoundError(f"{path}: there is no folder {folder}")


def _check_size(path: pathlib.Path, height: int, width: int) -> None:
    if height < 1 or width < 1 or height * width > _MAX_PIXELS:
        raise ValueError(f"{path} must have 1 to {_MAX_PIXELS} pixels, got {width} x {height}")


def _read_exr(path: pathlib.Path) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            header = dict(file.parts[0].header)
    except Exception as error:
        raise ValueError(f"{path} must be an undamaged EXR file, got: {error}") from error
    if header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
        raise ValueError(f"{path} must be an EXR image of scan lines or tiles, got {header['type'].name}")
    (x0, y0), (x1, y1) = (corner.tolist() for corner in header["dataWindow"])
    (left, top), (right, bottom) = (corner.tolist() for corner in header["displayWindow"])
    _check_size(path, y1 - y0 + 1, x1 - x0 + 1)
    _check_size(path, bottom - top + 1, right - left + 1)
    found = {channel.name: channel for channel in header["channels"]}
    names = next((names for names in _CHANNELS if set(names) <= set(found)), None)
    if names is None or {"RY", "BY"} & set(found):
        raise ValueError(f"{path} must have channels R, G, B or Y and perhaps A, got {', '.join(found)}")
    if any(found[name].xSampling != 1 or found[name].ySampling != 1 for name in names):
        raise ValueError(f"{path} must have all its channels at full resolution, got subsampled ones")
    if x0 > right or y0 > bottom or x1 < left or y1 < top:
        raise ValueError(
            f"{path} must have a data window that overlaps its display window, got {x0}..{x1}, {y0}..{y1} outside of it"
        )

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            if not file.parts:  # OpenEXR has already printed the reason.
                raise ValueError("pixels that cannot be read")
            channels = file.parts[0].channels
            data = np.stack([np.asarray(channels[name].pixels, np.float32) for name in names], axis=-1)
    except Exception as error:
        raise ValueError(f"{path} must be an undamaged EXR file, got: {error}") from error
    if data.shape[:2] != (y1 - y0 + 1, x1 - x0 + 1):
        raise ValueError(f"{path} must hold {x1 - x0 + 1} x {y1 - y0 + 1} pixels, got {data.shape[1::-1]}")
    image = np.zeros((bottom - top + 1, right - left + 1, len(names)), np.float32)
    rows = slice(max(y0, top), min(y1, bottom) + 1)
    columns = slice(max(x0, left), min(x1, right) + 1)
    image[_shift(rows, top), _shift(columns, left)] = data[_shift(rows, y0), _shift(columns, x0)]
    if "envmap" in header:
        header["envmap"] = header["envmap"].name.removeprefix("ENVMAP_").lower()
    return image, header


def _shift(span: slice, origin: int) -> slice:
    return slice(span.start - origin, span.stop - origin)


def _read_other(
    path: pathlib.Path, form: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    config = OpenImageIO.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # Otherwise colors come premultiplied by alpha.
    reader = OpenImageIO.ImageInput.open(str(path), config)
    if reader is None:
        raise ValueError(f"{path} must be an undamaged {form} file, got: {OpenImageIO.geterror()}")
    try:
        spec = reader.spec()
        _check_size(path, spec.height, spec.width)
        if spec.nchannels > 4 or spec.depth > 1:
            raise ValueError(f"{path} must have 1 to 4 channels and be flat, got {spec.nchannels}, depth {spec.depth}")
        image = reader.read_image("float")
        # Some readers return incomplete data and only report an error.
        error = reader.geterror()
        if image is None or error:
            raise ValueError(f"{path} must be an undamaged {form} file, got: {error or 'no pixels'}")
    finally:
        reader.close()
    attributes = {attribute.name: attribute.value for attribute in spec.extra_attribs}
    if attributes.get("Orientation", 1) != 1:
        raise ValueError(f"{path} must be stored upright (orientation 1), got orientation {attributes['Orientation']}")
    image = np.asarray(image, np.float32).reshape(spec.height, spec.width, spec.nchannels)
    space = str(attributes.get("oiio:ColorSpace", ""))
    whole = spec.format.basetype in (OpenImageIO.UINT8, OpenImageIO.UINT16)
    if whole and (decoded if decoded is not None else not space.lower().startswith("lin")):
        colors = spec.nchannels - (spec.nchannels in (2, 4))
        image[..., :colors] = _decode_srgb(image[..., :colors])
    return image, attributes


def _decode_srgb(value: np.ndarray) -> np.ndarray:
    """Decodes sRGB values to linear ones (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
