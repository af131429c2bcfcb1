"""Images of tests, and files that other libraries write."""

import struct
import zlib

import numpy as np
import OpenEXR
import OpenImageIO


def random_image(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def encode_srgb(value):
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


def png_chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def planes(image, names="RGB", prefix=""):
    """The channels of an image by name, as OpenEXR takes them."""
    return {prefix + name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)}


def write_parts(path, **parts):
    """An EXR file of parts, each its channels and more of its header."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    images = [OpenEXR.Part(header | more, dict(channels), name) for name, (channels, more) in parts.items()]
    with OpenEXR.File(images) as file:
        file.write(str(path))


def write_tiles(path, image, tile, form="half"):
    """An EXR file of tiles of some width and height."""
    spec = OpenImageIO.ImageSpec(image.shape[1], image.shape[0], image.shape[2], form)
    spec.tile_width, spec.tile_height = tile
    output = OpenImageIO.ImageOutput.create("exr")
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(image))
    assert output.close()
