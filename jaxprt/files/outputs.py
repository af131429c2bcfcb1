"""Output files: written beside the old file, checked, and renamed, so that a failure leaves the old file as it was."""

import contextlib
import errno
import os
import pathlib
import re
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import OpenImageIO
from jaxtyping import Array, Float, UInt8

from jaxprt import require
from jaxprt.files import pixels

_PNG_END = b"\0\0\0\0IEND\xae\x42\x60\x82"  # the last chunk, with its checksum
_NAMES = {1: "Y", 3: "RGB", 4: "RGBA"}  # channels of an image, by their number
_INCOMPLETE = "the file is incomplete; the disk may be full"
# Channels of the layers of pictures. Blender and Nuke read R, G, B and A as the picture and Z as its depth.
LAYERS = {
    "color": ("R", "G", "B"),
    "alpha": ("A",),
    "depth": ("Z",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "albedo": ("albedo.R", "albedo.G", "albedo.B"),
    "roughness": ("roughness.V",),
    "position": ("position.X", "position.Y", "position.Z"),
    "part": ("part.V",),
    "direct": ("direct.R", "direct.G", "direct.B"),
    "reflected": ("reflected.R", "reflected.G", "reflected.B"),
}


def target(path: str | os.PathLike, suffix: str) -> pathlib.Path:
    """Checks, before the work begins, that a file with this suffix can be written."""
    require.path("path", path)
    if pathlib.Path(path).suffix.lower() != suffix:
        raise ValueError(f"path must end in {suffix}, because the file will be of that format, got {os.fspath(path)!r}")
    path = pathlib.Path(path)
    _old_mode(path, pathlib.Path(os.path.realpath(path)))
    return path


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[pathlib.Path]:
    """A new, empty file in the same folder, which replaces `path` when the block ends without an error.

        with outputs.replacing("page.html") as file:
            file.write_text(page)

    The bytes are on the disk before the file is renamed. After an error, or Ctrl-C, the old file is unchanged, and the
    new one is removed. The permissions of an old file are kept. If the path is a symbolic link, its target is replaced.

    Args:
        path: The file.

    Yields:
        Path of the new file, with the suffix of `path`.
    """
    target = pathlib.Path(os.path.realpath(path))
    mode = _old_mode(path, target)
    # A short name: one made of the file's name could be too long for the file system.
    new = target.with_name(f".{secrets.token_hex(8)}.new{target.suffix if len(target.suffix) < 10 else ''}")
    try:
        new.open("xb").close()
    except OSError as error:
        raise _name_error(path, error) from error
    try:
        yield new
        if mode is not None:
            new.chmod(mode)
        with new.open("rb+") as file:
            os.fsync(file.fileno())  # Some file systems report a full disk only here.
        new.replace(target)
    except OSError as error:
        raise _name_error(path, error) from error
    finally:
        new.unlink(missing_ok=True)


@contextlib.contextmanager
def new_folder(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A new folder beside `path`, which gets this name when the block ends: no process sees an incomplete one.

    Args:
        path: The folder, which must not exist yet. Missing parents are created.

    Yields:
        Path of the new folder. It is removed after an error.
    """
    new = path.with_name(f".{secrets.token_hex(8)}.new")
    try:
        new.mkdir(parents=True)
        yield new
        if path.exists():  # An empty folder would be replaced.
            raise FileExistsError(errno.EEXIST, "it exists; remove it or name another path")
        new.rename(path)
    except OSError as error:
        raise _name_error(path, error) from error
    finally:
        shutil.rmtree(new, ignore_errors=True)


def write(path: str | os.PathLike, content: bytes | str) -> None:
    """Writes a file as `replacing` does. Text is encoded as UTF-8, with the line ends that it has.

    Args:
        path: The file. An old one is replaced.
        content: The bytes or the text.

    Raises:
        OSError: The file cannot be written. The old file, if any, is unchanged.
    """
    with replacing(path) as file:
        file.write_bytes(content.encode() if isinstance(content, str) else content)


def _old_mode(path: str | os.PathLike, target: pathlib.Path) -> int | None:
    """Permissions of the file that will be replaced; None if there is none."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        if not target.parent.is_dir():
            raise FileNotFoundError(f"{os.fspath(path)}: there is no folder {target.parent}") from None
        return None
    except OSError as error:
        raise _name_error(path, error) from error
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(f"{os.fspath(path)} must be a file, got a directory")
    if not stat.S_ISREG(mode):  # Renaming would put a file in place of the device.
        raise OSError(f"{os.fspath(path)} must be a regular file, got a pipe, a socket or a device")
    if not os.access(target, os.W_OK):
        raise PermissionError(f"{os.fspath(path)} cannot be written: it is read-only")
    return stat.S_IMODE(mode)


def _name_error(path: str | os.PathLike, error: OSError) -> OSError:
    """The same error about the file that the caller named."""
    words = f"{os.fspath(path)} cannot be written: {error.strerror or error}"
    named = type(error)(words)
    named.errno = error.errno
    return named


def webp(image: UInt8[np.ndarray, "h w 3"], *, quality: int | None) -> bytes:
    """A WebP file of display values.

    Args:
        image: The bytes of the pixels, first row on top.
        quality: From 0 to 100; None for an exact file.

    Raises:
        OSError: The file cannot be made.
    """
    spec = OpenImageIO.ImageSpec(image.shape[1], image.shape[0], 3, "uint8")
    spec.attribute("compression", "lossless" if quality is None else f"webp:{quality}")
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "image.webp")
        file = OpenImageIO.ImageOutput.create(path)
        if not (file and file.open(path, spec) and file.write_image(np.ascontiguousarray(image)) and file.close()):
            size = f"{image.shape[1]} x {image.shape[0]}"
            raise OSError(f"an image of {size} pixels could not be written as WebP: {OpenImageIO.geterror()}")
        return pathlib.Path(path).read_bytes()


def write_exr(
    path: str | pathlib.Path, image: Float[np.ndarray | Array, "h w c"] | Mapping[str, np.ndarray | Array]
) -> None:
    """Writes linear values to an EXR file of 32-bit floats with lossless compression.

    Args:
        path: The file, which must end in .exr. An old file is replaced once the new one is complete.
        image: Linear values with 1 (gray, written as Y), 3 (RGB) or 4 (RGBA) channels; or the layers of a picture, a
            dictionary as `RelitScene.picture` returns it, which become one file with several layers. Color, alpha and
            depth have the names R, G, B, A and Z, and the others names such as "normal.X", so that Blender and Nuke
            read them. Layers with other names are written as colors, or with the one channel V.

    Raises:
        TypeError: `image` is neither an array nor a dictionary from names to arrays.
        ValueError: The image is empty, not of a floating-point type, or has another number of channels; the layers have
            different sizes; or the name does not end in .exr.
        OSError: The file cannot be written. An old file is unchanged.
    """
    if isinstance(image, Mapping):
        channels = _layer_channels(image)
    else:
        names = _channel_names(image)
        channels = {name: np.asarray(image, np.float32)[..., i] for i, name in enumerate(names)}
    path = target(path, ".exr")
    # An empty date makes equal pictures equal files.
    _write(path, np.stack(list(channels.values()), -1), list(channels), {"compression": "zip", "DateTime": ""})


def is_layer_name(name: str) -> bool:
    """Whether a layer of a file can have this name."""
    return re.fullmatch(r"[A-Za-z0-9 _-]+", name) is not None


def _layer_channels(layers: Mapping[str, Any]) -> dict[str, Float[np.ndarray, "h w"]]:
    """The channels of the layers of a picture."""
    result: dict[str, np.ndarray] = {}
    for name, layer in layers.items():
        if not isinstance(name, str) or not is_layer_name(name):
            raise ValueError(f"names of layers must be of letters, digits, spaces, - and _, got {name!r}")
        what = f"the layer {name!r}"
        require.real(what, layer)
        require.array(what, layer, "h w c", "h w")
        values = np.asarray(layer, np.float32)
        values = values[..., None] if values.ndim == 2 else values
        channels = LAYERS.get(name, [f"{name}.{letter}" for letter in ("RGB" if values.shape[-1] > 1 else "V")])
        if 0 in values.shape or values.shape[-1] not in (1, len(channels)):
            raise ValueError(f"{what} must have {len(channels)} channels and a pixel, got {list(np.shape(layer))}")
        values = np.broadcast_to(values, (*values.shape[:2], len(channels)))
        result |= {channel: values[..., i] for i, channel in enumerate(channels)}
    sizes = sorted({values.shape for values in result.values()})
    if len(sizes) != 1:
        got = ", ".join(f"{width} x {height}" for height, width in sizes) or "none"
        raise ValueError(f"image must have layers of one size, got {got}")
    return result


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
    names = _channel_names(image)
    path = target(path, ".png")
    values = np.asarray(image, np.float64)
    wrong = np.argwhere(np.isnan(values).any(axis=-1))
    if len(wrong):
        raise ValueError(f"image must not hold NaN, got {len(wrong)} such pixels, first at {tuple(map(int, wrong[0]))}")
    values = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    _write(path, values, names, {"oiio:ColorSpace": "sRGB", "oiio:UnassociatedAlpha": 1})


def _write(path: pathlib.Path, values: np.ndarray, names: Sequence[str], attributes: Mapping[str, Any]) -> None:
    """Writes pixels [h, w, c], and checks that they are in the file bit by bit."""
    height, width, count = values.shape
    spec = OpenImageIO.ImageSpec(width, height, count, {np.float32: "float", np.uint8: "uint8"}[values.dtype.type])
    spec.channelnames = tuple(names)
    for name, value in attributes.items():
        spec.attribute(name, value)
    with replacing(path) as new:
        output = OpenImageIO.ImageOutput.create(str(new))
        if output is None:
            raise OSError(OpenImageIO.geterror())
        # Encoders do not report every full disk, so their word alone does not count.
        if not (output.open(str(new), spec) and output.write_image(np.ascontiguousarray(values)) and output.close()):
            raise OSError(output.geterror().replace(str(new), os.fspath(path)) or "the encoder failed")
        _compare(new, values, names)


def _compare(path: pathlib.Path, values: np.ndarray, names: Sequence[str]) -> None:
    """Raises an OSError if a file does not hold the values of channels of some names, bit by bit."""
    try:
        with pixels.opened(path) as reader:
            spec = reader.spec()
            whole = (spec.height, spec.width, spec.nchannels) == values.shape
            order = [spec.channelnames.index(name) for name in names]
            form = "uint8" if values.dtype == np.uint8 else "float"
            for rows, block in pixels.blocks(reader, channels=order, form=form) if whole else ():
                whole &= block.tobytes() == values[rows.start : rows.stop].tobytes()
    except (pixels.DamageError, ValueError):  # ValueError: a channel of another name
        whole = False
    with path.open("rb") as file:  # The pixels of PNG files can be read without their end, but not by every program.
        whole = whole and (path.suffix.lower() != ".png" or file.read().endswith(_PNG_END))
    if not whole:
        raise OSError(_INCOMPLETE)


def _channel_names(image: Float[np.ndarray | Array, "h w c"]) -> str:
    """Names of the channels of an image, which must be of floating point."""
    require.real("image", image)
    require.array("image", image, "h w c")
    if image.dtype.kind != "f":
        raise ValueError(f"image must be of floating point, with 1 for white in pictures, got {image.dtype}")
    if 0 in image.shape or image.shape[-1] not in _NAMES:
        raise ValueError(f"image must be [h, w, c] with c one of {list(_NAMES)} and no empty axis, got {image.shape}")
    return _NAMES[image.shape[-1]]
