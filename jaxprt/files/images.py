"""Reading of image files. OpenImageIO reads all formats but KTX 2; what it does not do for EXR and Radiance is here.

Reference: Ward, "Real pixels", Graphics Gems II, 1991; Larson and Shakespeare, "Rendering with Radiance", 1998; the
file formats of Radiance, section "Picture file format".
"""

import math
import pathlib
import re
import tempfile
import warnings
from functools import partial
from typing import Any

import numpy as np
import OpenImageIO
from jaxtyping import Float32

from jaxprt import require
from jaxprt.files import inputs, pixels

# Sets of channels that are read from EXR files; the first that matches is used. Other channels, as of depth, are none.
Attributes = dict[str, Any]  # by name, as the header of an image file has them

_CHANNELS = (("R", "G", "B", "A"), ("R", "G", "B"), ("Y", "A"), ("Y",))
_ENVIRONMENT = {"LatLong Environment": "latlong", "CubeFace Environment": "cube"}  # OpenImageIO's words for envmap
_LONGEST = 2**20  # bytes of a header; longer ones are taken for damage
_RESOLUTION = re.compile(rb"([+-][XY])[ \t]+(\d{1,9})[ \t]+([+-][XY])[ \t]+(\d{1,9})[ \t\r]*\n")
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


@require.arguments(path=partial(require.path, "path"))
def read_image(path: str | pathlib.Path) -> tuple[Float32[np.ndarray, "h w c"], Attributes]:
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
        describe the file before conversion, under OpenImageIO's names; those of Radiance files under their own. For EXR
        environment maps the attribute ``envmap`` is "latlong" or "cube".

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
        path = pathlib.Path(folder) / f"image.{_format(content)}"  # for messages of the right decoder
        path.write_bytes(content)
        try:
            return _read(path, name, decoded=decoded)[0]
        except ValueError as error:  # Messages of the decoders name the temporary file.
            raise ValueError(str(error).replace(str(path), name)) from error


def _format(start: bytes) -> str | None:
    """OpenImageIO's name of the format of a file, from its first bytes; None if it is unknown."""
    if (start[:4], start[8:12]) == _WEBP:
        return "webp"
    return next((form for magic, form in _MAGIC if start.startswith(magic)), None)


def _read(path: pathlib.Path, name: str, *, decoded: bool | None) -> tuple[Float32[np.ndarray, "h w c"], Attributes]:
    """The pixels and attributes of a file; `decoded` is None where the file says whether they are encoded."""
    with path.open("rb") as file:
        start = file.read(16)
    form = _format(start)
    if form is None:
        got = f"one that starts with {_quoted(start[:8])}" if start else "an empty file"
        raise ValueError(f"{name} must be an EXR, HDR, PNG, JPEG, TIFF, PFM, BMP, WebP or KTX 2 image, got {got}")
    try:
        if form == "openexr":
            return _read_exr(path, name)
        if form == "hdr":
            return _read_radiance(inputs.content(path, "an image file"), name)
        if form == "ktx2":
            return _read_ktx2(inputs.content(path, "an image file"), name, decoded=decoded), {}
        return _read_encoded(path, name, form, decoded=decoded)
    except (pixels.DamageError, UnicodeDecodeError) as error:  # Names in a damaged header may have any bytes.
        kind = {"openexr": "EXR", "ktx2": "KTX 2"}.get(form, form)
        raise ValueError(f"{name} must be an undamaged {kind} file, got: {error}") from error
    except MemoryError as error:  # NumPy's does not name the file, where a process may use less than is free.
        raise error if name in str(error) else MemoryError(f"{name} must fit into memory, got: {error}") from error


def _quoted(start: bytes) -> str:
    """Bytes of a file for a message: as text if they are text, otherwise as hexadecimal numbers."""
    if start.isascii() and (text := start.decode("ascii").strip()).isprintable():
        return f"the text {text!r}"
    return f"the bytes {start.hex(' ')}"


def _attributes(spec: Any) -> Attributes:
    return {attribute.name: attribute.value for attribute in spec.extra_attribs}


def _read_exr(path: pathlib.Path, name: str) -> tuple[Float32[np.ndarray, "h w c"], Attributes]:
    """Pixels of the display window of the first part with colors, in linear Rec. 709, and the part's attributes."""
    with pixels.opened(path) as reader:
        parts = []
        while reader.seek_subimage(len(parts), 0):
            parts.append(reader.spec())
        if error := reader.geterror():
            raise pixels.DamageError(error)
        part, channels = _color_part(parts, name)
        spec = parts[part]
        # These attributes hold for all parts, and some writers put them into the first part only.
        first, attributes = _attributes(parts[0]), _attributes(spec)
        shared = {key: first[key] for key in ("chromaticities", "colorInteropID") if key in first}
        attributes = {**shared, **attributes}
        if environment := _ENVIRONMENT.get(str(attributes.get("textureformat"))):
            attributes["envmap"] = environment
        window = spec.roi if environment == "cube" else spec.roi_full  # of a cube OpenImageIO's is one face
        matrix = _exr_matrix(attributes, name) if "R" in channels else None
        image = pixels.read(reader, name, part=part, channels=channels, window=window)
    if matrix is not None:
        pixels.convert(image, matrix)
    return image, attributes


def _color_part(parts: list[Any], name: str) -> tuple[int, tuple[str, ...]]:
    """Index and color channels of the first part with RGB, or else with Y."""
    usable = []
    for index, spec in enumerate(parts):
        channels = next((names for names in _CHANNELS if set(names) <= set(spec.channelnames)), None)
        if channels is not None and not spec.deep:
            usable.append((index, channels))
    usable = [part for part in usable if "R" in part[1]] or usable
    names = sorted({channel for spec in parts for channel in spec.channelnames})
    must = f"{name} must have channels R, G, B or Y and perhaps A, got"
    if not usable:
        if all(spec.deep for spec in parts):
            raise ValueError(f"{name} must be an EXR image of scan lines or tiles, got one of deep pixels")
        layers = sorted({channel.rpartition(".")[0] for channel in names if "." in channel})
        hint = f": only the layers {', '.join(layers)} have colors; write one of them without its prefix"
        raise ValueError(f"{must} {', '.join(names)}{hint if layers else ''}")
    (index, channels), *others = usable
    if others:
        title, *ignored = (repr(str(_attributes(parts[k]).get("name", k))) for k, _ in usable)
        words = f"{name} has colors in several parts: {title} is used, {', '.join(ignored)} ignored"
        warnings.warn(words, stacklevel=6)
    used = set(parts[index].channelnames)
    if "Y" in channels and ({"RY", "BY"} & used or {"X", "Z"} <= used):
        raise ValueError(f"{must} {', '.join(sorted(used))}: convert CIE XYZ, or luminance and chroma, to RGB")
    return index, channels


def _exr_matrix(attributes: Attributes, name: str) -> np.ndarray | None:
    """The matrix to Rec. 709 from the primaries that a header states; None if it states none or those."""
    stated = attributes.get("chromaticities")
    if stated is None:
        stated = pixels.PRIMARIES.get(str(attributes.get("colorInteropID", "")))
    if stated is None and attributes.get("acesImageContainerFlag") == 1:  # SMPTE ST 2065-4
        stated = pixels.ACES_AP0
    return None if stated is None else pixels.to_rec709(stated, f"the chromaticities of {name}")


def _read_radiance(content: bytes, name: str) -> tuple[Float32[np.ndarray, "h w 3"], Attributes]:
    """Radiance in linear Rec. 709, the right way up, and the variables of the header."""
    head, *rest = re.split(rb"\n\r?\n", content[:_LONGEST], maxsplit=1)
    line = _RESOLUTION.match(rest[0]) if rest else None
    orientation = _ORIENTATION.get(line[1] + line[3]) if line else None
    if line is None or orientation is None:
        got = _quoted(rest[0].partition(b"\n")[0][:40]) if rest else "no end of its header"
        raise pixels.DamageError(f"{got}, which must be a resolution such as -Y 8 +X 16")
    attributes = _radiance_attributes(head.decode("latin-1"), name)
    if attributes.get("FORMAT", "32-bit_rle_rgbe") != "32-bit_rle_rgbe":
        raise ValueError(
            f"{name} must hold RGB (32-bit_rle_rgbe), got {attributes['FORMAT']}: convert it first, XYZ with "
            "Radiance's ra_xyze -r"
        )
    height, width = int(line[2]), int(line[4])
    pixels.check_size(name, height, width)
    factor, matrix = _radiance_factor(attributes, name), None
    if "PRIMARIES" in attributes:
        primaries = _numbers(attributes["PRIMARIES"], 8, f"PRIMARIES of {name}")
        # Photoshop writes zeros for colors that it does not state.
        matrix = pixels.to_rec709(primaries, f"PRIMARIES of {name}") if any(primaries) else None
    pixels.check_memory(name, height, width, 3, decoder=0)

    data = memoryview(content)[len(content[:_LONGEST]) - len(rest[0]) + line.end() :]
    if width in _RUNS and data[:4] == b"\2\2" + width.to_bytes(2, "big"):
        image = _read_components(data, height, width, name)
    else:
        image = _read_flat(data, height, width, name)
    if (factor != 1).any():
        for rows in pixels.row_blocks(image):
            rows *= factor
    if matrix is not None:
        pixels.convert(image, matrix)
    return pixels.upright(image, orientation), attributes


def _radiance_attributes(head: str, name: str) -> Attributes:
    """The variables of a header. Exposures are cumulative, and so are color corrections."""
    attributes: Attributes = {}
    factors = {"EXPOSURE": np.ones(1), "COLORCORR": np.ones(3)}
    for text in head.split("\n")[1:]:
        key, equals, value = text.partition("=")
        # Lines that start with white space describe the pictures from which this one was made.
        if not equals or text[:1].isspace():
            continue
        key, value = key.strip(), value.strip()
        attributes[key] = value
        if key in factors:
            factor = _numbers(value, len(factors[key]), f"{key} of {name}")
            if min(factor) <= 0:
                raise ValueError(f"{key} of {name} must be positive, got {value!r}")
            with np.errstate(all="ignore"):  # An infinite product is refused later.
                factors[key] = factors[key] * factor
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


def _radiance_factor(attributes: Attributes, name: str) -> Float32[np.ndarray, "3"]:
    """What pixels are multiplied by to give radiance."""
    if "GAMMA" in attributes and _numbers(attributes["GAMMA"], 1, f"GAMMA of {name}") != [1.0]:
        words = f"{name} states GAMMA={attributes['GAMMA']}, which is ignored: its pixels are taken as linear"
        warnings.warn(words, stacklevel=6)
    with np.errstate(all="ignore"):
        factor = 1 / (attributes.get("EXPOSURE", 1.0) * np.array(attributes.get("COLORCORR", (1.0, 1.0, 1.0))))
        factor = factor.astype(np.float32)
    if not np.isfinite(factor).all() or (factor == 0).any():
        got = {key: attributes[key] for key in ("EXPOSURE", "COLORCORR") if key in attributes}
        raise ValueError(f"the exposures of {name} must give finite radiance, got the products {got}")
    return factor


def _read_components(data: memoryview, height: int, width: int, name: str) -> Float32[np.ndarray, "h w 3"]:
    """Pixels whose components are run-length coded apart, which OpenImageIO reads where the header is a plain one."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "image.hdr"
        with path.open("wb") as file:
            file.write(_PLAIN % (height, width))
            file.write(data)
        with pixels.opened(path) as reader:
            return pixels.read(reader, name)


def _read_flat(data: memoryview, height: int, width: int, name: str) -> Float32[np.ndarray, "h w 3"]:
    """Flat pixels, and those of the old run-length coding: 1, 1, 1, n repeats the pixel before n times."""
    count = height * width
    pixel = np.frombuffer(data, np.uint8, len(data) // 4 * 4).reshape(-1, 4)
    marker = (pixel[:, :3] == 1).all(axis=1)
    if marker.any():
        pixels.check_memory(name, height, width, 3, decoder=40 * len(pixel) + 4 * count)
        expanded = _expand(pixel, marker, height, width)
        if expanded is not None:
            pixel = expanded
        elif len(data) != 4 * count:  # In a flat file a dark pixel of a careless writer may look like a run.
            pixel = pixel[:0]
    if len(pixel) < count:
        raise pixels.DamageError(f"pixels or runs of pixels that do not fill {height} lines of {width}")
    pixel = pixel[:count].reshape(height, width, 4)
    image = np.empty((height, width, 3), np.float32)
    step = max(1, 2**20 // width)
    for first in range(0, height, step):
        rows = slice(first, first + step)
        exponent = pixel[rows, :, 3:].astype(np.int32)
        np.ldexp(pixel[rows, :, :3].astype(np.float32), np.where(exponent > 0, exponent - 136, -400), out=image[rows])
    return image


def _expand(pixel: np.ndarray, marker: np.ndarray, height: int, width: int) -> np.ndarray | None:
    """The pixels of old run-length coding; None if its runs do not fill the scan lines, over whose ends none goes."""
    if marker[0]:
        return None
    literal, run = np.flatnonzero(~marker), np.flatnonzero(marker)
    # Consecutive repetitions have the digits of a number to the base 256, the lowest first.
    digit = run - literal[np.searchsorted(literal, run) - 1] - 1
    if (pixel[run, 3][digit > 3] > 0).any():  # more than 2^32 pixels
        return None
    length = np.ones(len(pixel), np.int64)
    length[run] = pixel[run, 3].astype(np.int64) << (8 * np.minimum(digit, 3))
    length[run[digit > 3]] = 0
    end = np.cumsum(np.add.reduceat(length, literal))
    line_end = width * np.arange(1, height + 1)
    last = np.searchsorted(end, line_end)
    if last[-1] >= len(end) or (end[last] != line_end).any():
        return None
    used = last[-1] + 1
    return np.repeat(pixel[literal[:used]], np.diff(end[:used], prepend=0), axis=0)


def _read_ktx2(content: bytes, name: str, *, decoded: bool | None) -> Float32[np.ndarray, "h w c"]:
    """The finest level of a KTX 2 texture."""
    try:
        import opengl_basisu
    except ImportError as error:
        raise ImportError(
            f"{name} is a KTX 2 texture, which needs the package opengl_basisu: pip install 'jaxprt[web]'"
        ) from error
    try:
        file = opengl_basisu.open(content)
        pixels.check_size(name, file.height, file.width)
        if file.faces != 1 or file.layers != 1:
            raise ValueError(f"{name} must be one image, got {file.layers} layers of {file.faces} faces")
        channels = 4 if file.has_alpha else 3
        pixels.check_memory(name, file.height, file.width, channels, decoder=_TEXELS * file.height * file.width)
        texel = file.transcode(opengl_basisu.Target.RGBA8).data
    except (opengl_basisu.BasisuError, opengl_basisu.UnsupportedError) as error:
        raise pixels.DamageError(f"{error} (only ETC1S and UASTC of Basis Universal are read)") from error
    image = np.asarray(texel[..., :channels], np.float32) / np.float32(255)
    if file.srgb if decoded is None else decoded:
        pixels.decode_srgb(image[..., :3])
    return image


def _read_encoded(
    path: pathlib.Path, name: str, form: str, *, decoded: bool | None
) -> tuple[Float32[np.ndarray, "h w c"], Attributes]:
    """Reads a format of integers, or of floating-point numbers that are used as they are."""
    chunks = pixels.png_chunks(inputs.content(path, "an image file"), name) if form == "png" else {}
    with pixels.opened(path) as reader:
        if reader.format_name() != form:
            raise pixels.DamageError(f"one that only a {reader.format_name()} reader takes")
        spec = reader.spec()
        if not 1 <= spec.nchannels <= 4 or spec.depth > 1:
            raise ValueError(f"{name} must have 1 to 4 channels and be flat, got {spec.nchannels}, depth {spec.depth}")
        # Decoders of interlaced and progressive files, and of strips, hold all values in the file's type.
        native = spec.height * spec.width * spec.nchannels * spec.format.size()
        image = pixels.read(reader, name, decoder=2 * native)
    attributes = _attributes(spec)
    stated = attributes.get("Orientation", 1)
    # Exif has no other orientations than 1 to 8; viewers show files with others as they are.
    orientation = stated if isinstance(stated, int) and 1 <= stated <= 8 else 1
    whole = spec.format.basetype in (OpenImageIO.UINT8, OpenImageIO.UINT16)
    gamma = _check_color(chunks, name, attributes, whole=whole) if decoded is None else None
    colors = image[..., : spec.nchannels - (spec.nchannels in (2, 4))]
    # The gamma of PNG files says more; OpenImageIO takes one of 0 for a linear file.
    linear = form != "png" and str(attributes.get("oiio:ColorSpace", "")).lower().startswith("lin")
    if whole and gamma is not None:
        for rows in pixels.row_blocks(colors):
            rows **= np.float32(gamma)
    elif whole and (decoded if decoded is not None else not linear):
        pixels.decode_srgb(colors)
    return pixels.upright(image, orientation), attributes


def _check_color(chunks: dict[bytes, bytes], name: str, attributes: Attributes, *, whole: bool) -> float | None:
    """The exponent that decodes the values of a PNG file; None for sRGB. Warns of colors that are not converted."""
    gamma, words = pixels.png_color(chunks)
    if not words and "ICCProfile" in attributes:
        profile = np.asarray(attributes["ICCProfile"]).astype(np.uint8).tobytes()
        words = pixels.icc_difference(profile, curves=whole)
        title = str(attributes.get("ICCProfile:profile_description", ""))
        words += f" ({title})" if words and title else ""
    if words:
        how = "sRGB" if whole else "linear Rec. 709"
        warnings.warn(f"{name} has {words}, which is not converted: its values are taken as {how}", stacklevel=6)
    return gamma
