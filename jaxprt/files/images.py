"""Reading of image files. EXR and Radiance pictures have files of their own; OpenImageIO reads all other formats.

Reference: Ward, "Real pixels", Graphics Gems II, 1991; Larson and Shakespeare, "Rendering with Radiance", 1998; the
file formats of Radiance, section "Picture file format".
"""

import math
import pathlib
import re
import tempfile
import typing
import warnings
from functools import partial
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO
from jaxtyping import Float32

from jaxprt import require
from jaxprt.files import inputs, pixels

# Sets of channels that are read; the first that matches is used. Alpha is read too if there is one.
_CHANNELS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
_FLAT = (OpenEXR.scanlineimage, OpenEXR.tiledimage)
_LINES = 256  # Every compression has blocks of this number of rows, or of a divisor of it.
_LONGEST = 2**20  # bytes of a header; longer ones are taken for damage
_RESOLUTION = re.compile(rb"([+-])([XY])\s+(\d{1,9})\s+([+-])([XY])\s+(\d{1,9})\s*")
# Exif orientation by the signs and axes of the resolution line: the first axis is the slow one.
_ORIENTATION = {
    b"-Y+X": 1,
    b"-Y-X": 2,
    b"+Y-X": 3,
    b"+Y+X": 4,
    b"+X-Y": 5,
    b"-X-Y": 6,
    b"-X+Y": 7,
    b"+X+Y": 8,
}
_RUNS = range(8, 2**15)  # widths for which run-length coding by component exists
_PLAIN = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n"
MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
_TEXELS = 8  # bytes of a pixel while it is transcoded: RGBA, and the file's blocks at most
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
    (MAGIC, "ktx2"),
)
_WEBP = b"RIFF", b"WEBP"  # the first four bytes, and those from the eighth on
_PNG_START = 2**20  # Chunks before the pixels are within these bytes, apart from absurd ones.


class _Part(typing.NamedTuple):
    """A part of a file that can be read, from its header."""

    number: int
    header: dict[str, typing.Any]
    channels: tuple[str, ...]

    @property
    def title(self) -> str:
        """Name of the part for messages."""
        return str(self.header.get("name") or self.number)

    def window(self, key: str) -> tuple[range, range]:
        """Rows and columns of the data window or display window."""
        (x0, y0), (x1, y1) = (corner.tolist() for corner in self.header[key])
        return range(y0, y1 + 1), range(x0, x1 + 1)


def read_exr(path: pathlib.Path, name: str) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    """Reads the first part of an EXR file that has colors, at the finest level, as linear Rec. 709.

    Args:
        path: The file.
        name: Name of the file in messages.

    Returns:
        The pixels of the display window, and the attributes of the part. The chromaticities among them are those of the
        file, not of the pixels.
    """
    part = _color_part(_headers(path, name), name)
    rows, columns = part.window("displayWindow")
    data_rows, data_columns = part.window("dataWindow")
    for height, width in ((len(rows), len(columns)), (len(data_rows), len(data_columns)), _tile(part)):
        pixels.check_size(name, height, width)
    shared_rows, shared_columns = _overlap(rows, data_rows), _overlap(columns, data_columns)
    if not len(shared_rows) or not len(shared_columns):
        raise ValueError(
            f"{name} must have a data window that overlaps its display window, got columns {data_columns.start}.."
            f"{data_columns.stop - 1} and rows {data_rows.start}..{data_rows.stop - 1} outside of it"
        )
    matrix = _exr_matrix(part, name)
    _check_memory(part, name)

    image = np.zeros((len(rows), len(columns), len(part.channels)), np.float32)
    inside = image[_places(shared_rows, rows), _places(shared_columns, columns)]
    try:
        _read_part(path, part, shared_rows, inside)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be an undamaged EXR file, got: {error}") from error
    if matrix is not None:
        pixels.convert(inside, matrix)
    header = dict(part.header)
    if "envmap" in header:
        header["envmap"] = header["envmap"].name.removeprefix("ENVMAP_").lower()
    return image, header


def _headers(path: pathlib.Path, name: str) -> list[dict[str, typing.Any]]:
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            headers = [_check_header(dict(part.header)) for part in file.parts]
    except Exception as error:  # OpenEXR raises several types for damaged files.
        raise ValueError(f"{name} must be an undamaged EXR file, got: {error}") from error
    if not headers:
        raise ValueError(f"{name} must be an undamaged EXR file, got one without parts")
    return headers


def _check_header(header: dict[str, typing.Any]) -> dict[str, typing.Any]:
    """The header. Attributes of damaged files may have any type, and names any bytes, which raises any error here."""
    names = [channel.name for channel in header["channels"]]
    corners = [corner.tolist() for key in ("dataWindow", "displayWindow") for corner in header[key]]
    if not names or [len(corner) for corner in corners] != [2] * 4 or not isinstance(header["type"], OpenEXR.Storage):
        raise ValueError("a header without channels, windows or type")
    for key, kind in (("tiles", OpenEXR.TileDescription), ("envmap", OpenEXR.Envmap), ("colorInteropID", str)):
        if not isinstance(header.get(key), kind | None):
            raise ValueError(f"an attribute {key} of another type")
    if "chromaticities" in header:
        header["chromaticities"] = tuple(map(float, header["chromaticities"]))
    return header


def _color_part(headers: list[dict[str, typing.Any]], name: str) -> _Part:
    """The first part with RGB, or else with Y. Other channels, such as depth, are no colors."""
    flat = [(number, header) for number, header in enumerate(headers) if header["type"] in _FLAT]
    if not flat:
        kinds = ", ".join(header["type"].name for header in headers)
        raise ValueError(f"{name} must be an EXR image of scan lines or tiles, got {kinds}")
    parts = [
        _Part(number, header, channels)
        for channels in _CHANNELS
        for number, header in flat
        if set(channels) <= (names := _names(header)) and channels == _best(names)
    ]
    colored = sorted((part for part in parts if "R" in part.channels), key=lambda part: part.number)
    usable = colored or sorted(parts, key=lambda part: part.number)
    if not usable:
        channels = sorted({channel for _, header in flat for channel in _names(header)})
        layers = sorted({channel.rpartition(".")[0] for channel in channels if "." in channel})
        hint = (
            f": only the layers {', '.join(layers)} have colors; write one of them without its prefix" if layers else ""
        )
        raise ValueError(f"{name} must have channels R, G, B or Y and perhaps A, got {', '.join(channels)}{hint}")
    part = usable[0]
    if len(usable) > 1:
        others = ", ".join(repr(other.title) for other in usable[1:])
        warnings.warn(f"{name} has colors in several parts: {part.title!r} is used, {others} ignored", stacklevel=5)
    channel = {item.name: item for item in part.header["channels"]}
    if {"RY", "BY"} & set(channel):
        raise ValueError(f"{name} must have channels R, G, B or Y and perhaps A, got {', '.join(channel)}")
    if part.channels[0] == "Y" and {"X", "Z"} <= set(channel):
        raise ValueError(f"{name} must have channels R, G, B or Y and perhaps A, got X, Y, Z: convert CIE XYZ to RGB")
    if any(channel[key].xSampling != 1 or channel[key].ySampling != 1 for key in part.channels):
        raise ValueError(f"{name} must have all its channels at full resolution, got subsampled ones")
    # These attributes hold for all parts, and some writers put them into the first part only.
    shared = {key: headers[0][key] for key in ("chromaticities", "colorInteropID") if key in headers[0]}
    return part._replace(header={**shared, **part.header})


def _names(header: dict[str, typing.Any]) -> set[str]:
    return {channel.name for channel in header["channels"]}


def _best(names: set[str]) -> tuple[str, ...]:
    return next(channels for channels in _CHANNELS if set(channels) <= names)


def _tile(part: _Part) -> tuple[int, int]:
    """Height and width of the tiles; 1 x 1 for scan lines."""
    tile = part.header.get("tiles") if part.header["type"] == OpenEXR.tiledimage else None
    return (1, 1) if tile is None else (int(tile.ySize), int(tile.xSize))


def _check_memory(part: _Part, name: str) -> None:
    """The pixels, and blocks of rows and of the decoder: it unpacks all channels, also those that are not read."""
    rows, columns = part.window("displayWindow")
    data_rows, data_columns = part.window("dataWindow")
    height, width = _tile(part)
    lines = min(_LINES, len(data_rows)) * len(data_columns)
    block = min(_step(height), len(data_rows)) * len(data_columns)
    decoder = 4 * (len(part.header["channels"]) * (lines + 2 * height * width) + len(part.channels) * block)
    pixels.check_memory(name, len(rows), len(columns), len(part.channels), decoder=decoder)


def _step(tile_height: int) -> int:
    """Rows that are read at once: whole rows of tiles."""
    return -(-_LINES // tile_height) * tile_height


def _exr_matrix(part: _Part, name: str) -> np.ndarray | None:
    """The matrix to Rec. 709, if the part has other primaries. Gray stays gray."""
    stated = part.header.get("chromaticities")
    if stated is None and hasattr(OpenEXR, "colorInteropIDToChromaticities"):  # OpenEXR 3.5
        stated = OpenEXR.colorInteropIDToChromaticities(str(part.header.get("colorInteropID", "")))
    if stated is None and part.header.get("acesImageContainerFlag") == 1:  # SMPTE ST 2065-4
        stated = pixels.ACES_AP0
    if stated is None or "R" not in part.channels:
        return None
    return pixels.to_rec709(tuple(stated), f"the chromaticities of {name}")


def _read_part(path: pathlib.Path, part: _Part, rows: range, image: np.ndarray) -> None:
    """Fills `image` with rows of a part, and with those columns of the data window that the display window has."""
    reader = OpenImageIO.ImageInput.open(str(path))
    if reader is None:
        raise ValueError(OpenImageIO.geterror())
    try:
        if not reader.seek_subimage(part.number, 0):
            raise ValueError(reader.geterror() or "a missing part")
        spec = reader.spec()
        data_rows, data_columns = part.window("dataWindow")
        names = list(spec.channelnames)
        window = (spec.y, spec.x, spec.height, spec.width)
        if window != (data_rows.start, data_columns.start, len(data_rows), len(data_columns)) or not set(
            part.channels
        ) <= set(names):
            raise ValueError(f"a header that two readers understand in different ways: {window}, {names}")
        number = [names.index(channel) for channel in part.channels]
        span = range(min(number), max(number) + 1)
        kinds = {str(kind) for kind in spec.channelformats} or {str(spec.format)}
        # OpenImageIO would divide whole numbers by the largest one.
        form = "uint32" if kinds == {"uint"} else "float"
        left = _overlap(data_columns, part.window("displayWindow")[1])
        step = _step(max(1, spec.tile_height))
        for first in range(data_rows.start, data_rows.stop, step):
            block = range(first, min(first + step, data_rows.stop))
            wanted = _overlap(block, rows)
            if len(wanted):
                data = pixels.read_block(reader, block, part=part.number, channels=span, form=form)
                for i, k in enumerate(number):
                    image[_places(wanted, rows), :, i] = data[
                        _places(wanted, block), _places(left, data_columns), k - span.start
                    ]
    finally:
        reader.close()


def _overlap(one: range, other: range) -> range:
    return range(max(one.start, other.start), min(one.stop, other.stop))


def _places(span: range, whole: range) -> slice:
    """Where a range of rows or columns is in a longer one."""
    return slice(span.start - whole.start, span.stop - whole.start)


class _Header(typing.NamedTuple):
    attributes: dict[str, typing.Any]
    orientation: int
    length: int  # number of scan lines
    width: int  # pixels of a scan line
    start: int  # place of the first pixel in the file


def read_radiance(path: pathlib.Path, name: str) -> tuple[Float32[np.ndarray, "h w 3"], dict[str, typing.Any]]:
    """Reads a Radiance picture as radiance in linear Rec. 709.

    Pixels are divided by all exposures and color corrections of the header, and converted if it states primaries.

    Args:
        path: The file.
        name: Name of the file in messages.

    Returns:
        The pixels, the right way up, and the variables of the header. "EXPOSURE" is the product of all exposures.
    """
    content = inputs.content(path, "an image file")
    try:
        header = _header(content, name)
    except (UnicodeDecodeError, OverflowError) as error:
        raise ValueError(f"{name} must be an undamaged hdr file, got: {error}") from error
    pixels.check_size(name, header.length, header.width)
    factor, matrix = _factor(header.attributes, name), _hdr_matrix(header.attributes, name)
    pixels.check_memory(name, header.length, header.width, 3, decoder=0)

    start = content[header.start : header.start + 4]
    if header.width in _RUNS and start[:2] == b"\2\2" and int.from_bytes(start[2:], "big") == header.width:
        image = _read_components(content, header, name)
    else:
        image = _read_pixels(content, header, name)
    if (factor != 1).any():
        for rows in pixels.row_blocks(image):
            rows *= factor
    if matrix is not None:
        pixels.convert(image, matrix)
    return pixels.upright(image, header.orientation), header.attributes


def _header(content: bytes, name: str) -> _Header:
    head, blank, _ = content[:_LONGEST].replace(b"\r\n", b" \n").partition(b"\n \n")
    plain, plain_blank, _ = content[:_LONGEST].partition(b"\n\n")
    if plain_blank and (not blank or len(plain) < len(head)):
        head, blank = plain, plain_blank
    start = len(head) + len(blank)
    line, end, _ = content[start : start + 256].partition(b"\n")
    match = _RESOLUTION.fullmatch(line)
    if not blank or not end or match is None or match[2] == match[5]:
        raise ValueError(
            f"{name} must be an undamaged hdr file with a resolution such as -Y 8 +X 16, got {_quoted(line[:40])}"
        )
    attributes = _attributes(head.decode("latin-1"), name)
    if attributes.get("FORMAT", "32-bit_rle_rgbe") != "32-bit_rle_rgbe":
        raise ValueError(
            f"{name} must hold RGB (32-bit_rle_rgbe), got {attributes['FORMAT']}: convert it first, XYZ with "
            "Radiance's ra_xyze -r"
        )
    orientation = _ORIENTATION[match[1] + match[2] + match[4] + match[5]]
    return _Header(attributes, orientation, int(match[3]), int(match[6]), start + len(line) + 1)


def _attributes(head: str, name: str) -> dict[str, typing.Any]:
    """The variables of a header. Exposures are cumulative, and so are color corrections."""
    attributes: dict[str, typing.Any] = {}
    factors = {"EXPOSURE": np.ones(1), "COLORCORR": np.ones(3)}
    for text in head.split("\n")[1:]:
        key, equals, value = text.partition("=")
        # Lines that start with white space describe the pictures from which this one was made.
        if not equals or text[:1].isspace():
            continue
        key, value = key.strip(), value.strip()
        attributes[key] = value
        if key in factors:
            number = _numbers(value, len(factors[key]), f"{key} of {name}")
            if min(number) <= 0:
                raise ValueError(f"{key} of {name} must be positive, got {value!r}")
            with np.errstate(all="ignore"):  # An infinite product is refused later.
                factors[key] = factors[key] * number
            attributes[key] = tuple(factors[key].tolist())
    if "EXPOSURE" in attributes:
        (attributes["EXPOSURE"],) = attributes["EXPOSURE"]
    return attributes


def _numbers(text: str, count: int, what: str) -> list[float]:
    try:
        value = [float(word) for word in text.split()]
    except ValueError:
        value = []
    if len(value) != count or not all(map(math.isfinite, value)):
        raise ValueError(f"{what} must be {count} finite numbers, got {text!r}")
    return value


def _factor(attributes: dict[str, typing.Any], name: str) -> np.ndarray:
    """What pixels are multiplied by to give radiance."""
    if "GAMMA" in attributes and _numbers(attributes["GAMMA"], 1, f"GAMMA of {name}") != [1.0]:
        words = f"{name} states GAMMA={attributes['GAMMA']}, which is ignored: its pixels are taken as linear"
        warnings.warn(words, stacklevel=5)
    with np.errstate(all="ignore"):
        factor = 1 / (attributes.get("EXPOSURE", 1.0) * np.array(attributes.get("COLORCORR", (1.0, 1.0, 1.0))))
        factor = factor.astype(np.float32)
    if not np.isfinite(factor).all() or (factor == 0).any():
        got = {key: attributes[key] for key in ("EXPOSURE", "COLORCORR") if key in attributes}
        raise ValueError(f"the exposures of {name} must give finite radiance, got the products {got}")
    return factor


def _hdr_matrix(attributes: dict[str, typing.Any], name: str) -> np.ndarray | None:
    if "PRIMARIES" not in attributes:
        return None
    primaries = _numbers(attributes["PRIMARIES"], 8, f"PRIMARIES of {name}")
    # Photoshop writes zeros for colors that it does not state.
    return pixels.to_rec709(primaries, f"PRIMARIES of {name}") if any(primaries) else None


def _read_components(content: bytes, header: _Header, name: str) -> Float32[np.ndarray, "h w 3"]:
    """Reads pixels whose components are run-length coded apart. OpenImageIO does that, for upright pictures."""
    image = np.empty((header.length, header.width, 3), np.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "image.hdr"
        with path.open("wb") as file:
            file.write(_PLAIN % (header.length, header.width))
            file.write(memoryview(content)[header.start :])
        reader = OpenImageIO.ImageInput.open(str(path))
        if reader is None:
            raise ValueError(f"{name} must be an undamaged hdr file, got: {OpenImageIO.geterror()}")
        try:
            pixels.read_rows(reader, image)
        except ValueError as error:
            raise ValueError(f"{name} must be an undamaged hdr file, got: {error}") from error
        finally:
            reader.close()
    return image


def _read_pixels(content: bytes, header: _Header, name: str) -> Float32[np.ndarray, "h w 3"]:
    """Reads flat pixels, and those of the old run-length coding: 1, 1, 1, n repeats the pixel before n times."""
    count = header.length * header.width
    stored = len(content) - header.start
    unit = np.frombuffer(content, np.uint8, stored // 4 * 4, header.start).reshape(-1, 4)
    marker = (unit[:, 0] == 1) & (unit[:, 1] == 1) & (unit[:, 2] == 1)
    if marker.any():
        pixels.check_memory(name, header.length, header.width, 3, decoder=40 * len(unit) + 4 * count)
        # Consecutive repetitions have the digits of n to the base 256, the lowest first. No run crosses a scan line.
        expanded = _expand(unit, marker, header)
        # In a flat file a dark pixel of a careless writer may look like a run.
        whole = expanded is not None or stored == 4 * count
        unit = unit if expanded is None else expanded
    else:
        whole = stored >= 4 * count
        unit = unit[:count]
    if not whole:
        raise ValueError(
            f"{name} must be an undamaged hdr file, got pixels or runs of pixels that do not fill {header.length} "
            f"lines of {header.width}"
        )
    image = np.empty((header.length, header.width, 3), np.float32)
    unit = unit.reshape(header.length, header.width, 4)
    step = max(1, 2**20 // header.width)
    for first in range(0, header.length, step):
        rows = slice(first, first + step)
        exponent = unit[rows, :, 3:].astype(np.int32)
        np.ldexp(unit[rows, :, :3].astype(np.float32), np.where(exponent > 0, exponent - 136, -400), out=image[rows])
    return image


def _expand(unit: np.ndarray, marker: np.ndarray, header: _Header) -> np.ndarray | None:
    """The pixels of old run-length coding; None if its runs do not fill the scan lines."""
    if marker[0]:
        return None
    pixel = np.flatnonzero(~marker)
    place = np.flatnonzero(marker)
    digit = place - pixel[np.searchsorted(pixel, place) - 1] - 1  # number of the repetition among consecutive ones
    if (unit[place, 3][digit > 3] > 0).any():  # more than 2^32 pixels
        return None
    length = np.ones(len(unit), np.int64)
    length[place] = unit[place, 3].astype(np.int64) << (8 * np.minimum(digit, 3))
    length[place[digit > 3]] = 0
    end = np.cumsum(np.add.reduceat(length, pixel))
    line_end = header.width * np.arange(1, header.length + 1)
    last = np.searchsorted(end, line_end)
    if last[-1] >= len(end) or (end[last] != line_end).any():
        return None
    used = last[-1] + 1
    return np.repeat(unit[pixel[:used]], np.diff(end[:used], prepend=0), axis=0)


def read_ktx2(
    content: bytes, name: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, Any]]:
    """The finest level of a KTX 2 image.

    Args:
        content: The bytes of the file.
        name: Name of the image in error messages.
        decoded: Whether colors are decoded from sRGB; None does what the file states.

    Returns:
        The pixels with 3 (RGB) or 4 (RGBA) channels, and no attributes.
    """
    try:
        import opengl_basisu
    except ImportError as error:
        raise ImportError(
            f"{name} is a KTX 2 texture, which needs the package opengl_basisu: pip install 'jaxprt[web]'"
        ) from error
    must = f"{name} must be an undamaged KTX 2 texture of Basis Universal, ETC1S or UASTC"
    try:
        file = opengl_basisu.open(content)
        pixels.check_size(name, file.height, file.width)
        if file.faces != 1 or file.layers != 1:
            raise ValueError(f"{name} must be one image, got {file.layers} layers of {file.faces} faces")
        channels = 4 if file.has_alpha else 3
        pixels.check_memory(name, file.height, file.width, channels, decoder=_TEXELS * file.height * file.width)
        texel = file.transcode(opengl_basisu.Target.RGBA8).data
    except (opengl_basisu.BasisuError, opengl_basisu.UnsupportedError) as error:
        raise ValueError(f"{must}, got: {error}") from error
    image = np.asarray(texel[..., :channels], np.float32) / np.float32(255)
    if file.srgb if decoded is None else decoded:
        pixels.decode_srgb(image[..., :3])
    return image, {}


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
        got = f"one that starts with {_quoted(start[:8])}" if start else "an empty file"
        raise ValueError(f"{name} must be an EXR, HDR, PNG, JPEG, TIFF, PFM, BMP, WebP or KTX 2 image, got {got}")
    try:
        if form == "openexr":
            return read_exr(path, name)
        if form == "hdr":
            return read_radiance(path, name)
        if form == "ktx2":
            return read_ktx2(inputs.content(path, "an image file"), name, decoded=decoded)
        return _read_other(path, name, form, decoded=decoded)
    except MemoryError as error:  # NumPy's does not name the file, where a process may use less than is free.
        raise error if name in str(error) else MemoryError(f"{name} must fit into memory, got: {error}") from error


def _quoted(start: bytes) -> str:
    """Bytes of a file for a message: as text if they are text, otherwise as hexadecimal numbers."""
    if start.isascii() and (text := start.decode("ascii").strip()).isprintable():
        return f"the text {text!r}"
    return f"the bytes {start.hex(' ')}"


def _read_other(
    path: pathlib.Path, name: str, form: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], dict[str, typing.Any]]:
    damage = pixels.png_damage(inputs.content(path, "an image file"), name) if form == "png" else ""
    if damage:
        raise ValueError(f"{name} must be an undamaged png file, got {damage}")
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
            gamma, words = pixels.png_color(file.read(_PNG_START))
    if not words and "ICCProfile" in attributes:
        profile = np.asarray(attributes["ICCProfile"]).astype(np.uint8).tobytes()
        words = pixels.icc_difference(profile, curves=whole)
        title = str(attributes.get("ICCProfile:profile_description", ""))
        words += f" ({title})" if words and title else ""
    if words:
        how = "sRGB" if whole else "linear Rec. 709"
        warnings.warn(f"{name} has {words}, which is not converted: its values are taken as {how}", stacklevel=5)
    return gamma
