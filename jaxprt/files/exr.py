"""Reading of EXR files. OpenEXR reads the header, and OpenImageIO the pixels, which it can read in blocks of rows."""

import pathlib
import typing
import warnings

import numpy as np
import OpenEXR
import OpenImageIO
from jaxtyping import Float32

from jaxprt.files import color_spaces, pixels

# Sets of channels that are read; the first that matches is used. Alpha is read too if there is one.
_CHANNELS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
_FLAT = (OpenEXR.scanlineimage, OpenEXR.tiledimage)
_LINES = 256  # Every compression has blocks of this number of rows, or of a divisor of it.


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

    Raises:
        ValueError: The file is damaged, or has no part that can be read.
        MemoryError: The pixels do not fit into memory.
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
    matrix = _matrix(part, name)
    _check_memory(part, name)

    image = np.zeros((len(rows), len(columns), len(part.channels)), np.float32)
    inside = image[_places(shared_rows, rows), _places(shared_columns, columns)]
    try:
        _read_part(path, part, shared_rows, inside)
    except (ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be an undamaged EXR file, got: {error}") from error
    if matrix is not None:
        color_spaces.convert(inside, matrix)
    header = dict(part.header)
    if "envmap" in header:
        header["envmap"] = header["envmap"].name.removeprefix("ENVMAP_").lower()
    return image, header


def _headers(path: pathlib.Path, name: str) -> list[dict[str, typing.Any]]:
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            headers = [_well_formed(dict(part.header)) for part in file.parts]
    except Exception as error:  # OpenEXR raises several types for damaged files.
        raise ValueError(f"{name} must be an undamaged EXR file, got: {error}") from error
    if not headers:
        raise ValueError(f"{name} must be an undamaged EXR file, got one without parts")
    return headers


def _well_formed(header: dict[str, typing.Any]) -> dict[str, typing.Any]:
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


def _matrix(part: _Part, name: str) -> np.ndarray | None:
    """The matrix to Rec. 709, if the part has other primaries. Gray stays gray."""
    stated = part.header.get("chromaticities")
    if stated is None and hasattr(OpenEXR, "colorInteropIDToChromaticities"):  # OpenEXR 3.5
        stated = OpenEXR.colorInteropIDToChromaticities(str(part.header.get("colorInteropID", "")))
    if stated is None and part.header.get("acesImageContainerFlag") == 1:  # SMPTE ST 2065-4
        stated = color_spaces.ACES_AP0
    if stated is None or "R" not in part.channels:
        return None
    return color_spaces.to_rec709(tuple(stated), f"the chromaticities of {name}")


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
