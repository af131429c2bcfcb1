"""Reading of Radiance pictures (HDR): the header, its exposure and primaries, and all codings of pixels.

Reference: Ward, "Real pixels", Graphics Gems II, 1991; Larson and Shakespeare, "Rendering with Radiance", 1998; the
file formats of Radiance, section "Picture file format".
"""

import math
import pathlib
import re
import tempfile
import typing
import warnings

import numpy as np
import OpenImageIO
from jaxtyping import Float32

from jaxprt.files import color_spaces, inputs, pixels

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

    Raises:
        ValueError: The file is damaged, or holds XYZ.
        MemoryError: The pixels do not fit into memory.
    """
    content = inputs.content(path, "an image file")
    try:
        header = _header(content, name)
    except (UnicodeDecodeError, OverflowError) as error:
        raise ValueError(f"{name} must be an undamaged hdr file, got: {error}") from error
    pixels.check_size(name, header.length, header.width)
    factor, matrix = _factor(header.attributes, name), _matrix(header.attributes, name)
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
        color_spaces.convert(image, matrix)
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
            f"{name} must be an undamaged hdr file with a resolution such as -Y 8 +X 16, got {line[:40]!r}"
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


def _matrix(attributes: dict[str, typing.Any], name: str) -> np.ndarray | None:
    if "PRIMARIES" not in attributes:
        return None
    primaries = _numbers(attributes["PRIMARIES"], 8, f"PRIMARIES of {name}")
    # Photoshop writes zeros for colors that it does not state.
    return color_spaces.to_rec709(primaries, f"PRIMARIES of {name}") if any(primaries) else None


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
    """Reads flat pixels, and those of the old run-length coding: 1, 1, 1, n repeats the pixel before n times.

    Consecutive repetitions have the digits of n to the base 256, the lowest first. No run crosses a scan line.
    """
    count = header.length * header.width
    stored = len(content) - header.start
    unit = np.frombuffer(content, np.uint8, stored // 4 * 4, header.start).reshape(-1, 4)
    marker = (unit[:, 0] == 1) & (unit[:, 1] == 1) & (unit[:, 2] == 1)
    if marker.any():
        pixels.check_memory(name, header.length, header.width, 3, decoder=40 * len(unit) + 4 * count)
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
