"""Damaged image files end in a picture or a clear error, within a memory limit, and without a hang."""

import json
import struct
import subprocess
import sys
import zlib

import numpy as np
import OpenEXR
import OpenImageIO
import PIL.Image
import PIL.ImageCms
import pytest

from jaxprt.files import decode_image
from tests.files.samples import planes, png_chunk, random_image, write_parts, write_tiles

MUTATIONS = 200
HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nPRIMARIES=.64 .33 .29 .6 .15 .06 .333 .333\n\n-Y 12 +X 24\n"
PIXEL, SKY = bytes([128, 64, 32, 129]), bytes([16, 32, 128, 131])
AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)

# The memory is limited to a gigabyte above what the imports take; no picture in these files needs a hundredth of it.
READ = """
import collections, json, pathlib, resource, sys, time, warnings
import jax
import numpy as np
from jaxprt.files import decode_image, read_image

jax.devices()
used = 4096 * int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (used + 10**9, resource.RLIM_INFINITY))
warnings.simplefilter("ignore")


def mutated(content, random):
    data, kind = bytearray(content), random.integers(5)
    head = min(len(data), int(random.choice([64, 400, len(data)])))  # Headers matter most.
    place = int(random.integers(head))
    if kind == 0:
        for _ in range(random.integers(1, 6)):
            data[random.integers(head)] = random.integers(256)
    elif kind == 1:
        del data[random.integers(len(data)) :]
    elif kind == 2:
        number = random.choice([0, 1, -1, 2**31 - 1, -(2**31)]).astype("<i4").tobytes()
        data[place : place + 4] = number[:: random.choice([-1, 1])]
    elif kind == 3:
        del data[place : place + int(random.integers(1, 50))]
    else:
        data[place:place] = random.bytes(int(random.integers(1, 40)))
    return bytes(data)


results = {}
for path in map(pathlib.Path, sys.argv[2:]):
    counts, wrong = collections.Counter(), []
    content = path.read_bytes()
    read_image(path)
    for seed in range(int(sys.argv[1])):
        data = mutated(content, np.random.default_rng(seed))
        path.write_bytes(data)
        start = time.monotonic()
        try:
            if seed % 2:
                decode_image(data, name=path.name)
            else:
                read_image(path)
            counts["picture"] += 1
        except (ValueError, MemoryError) as error:
            counts[type(error).__name__] += 1
            if path.name not in str(error) or type(error) not in (ValueError, MemoryError):
                wrong.append([seed, repr(error)])
        except Exception as error:
            wrong.append([seed, repr(error)])
        if time.monotonic() - start > 10:
            wrong.append([seed, "a hang"])
    results[path.name] = [counts, wrong]
print(json.dumps(results))
"""


def write_sample(path):
    """A small valid file. Its name says the kind."""
    image = random_image(12, 24, 3)
    kind = path.stem
    if kind in ("zip", "piz", "dwaa", "b44", "pxr24", "rle"):
        compression = getattr(OpenEXR, f"{kind.upper()}_COMPRESSION")
        write_parts(path, image=(planes(image), {"compression": compression, "chromaticities": AP0}))
    elif kind == "parts":
        write_parts(path, depth=(planes(image, "Z"), {}), image=(planes(image), {}))
    elif kind == "tiles":
        write_tiles(path, image, (8, 8))
    elif kind == "flat":
        path.write_bytes(HEAD + PIXEL * 288)
    elif kind == "old_runs":
        path.write_bytes(HEAD + 12 * (PIXEL + bytes([1, 1, 1, 10]) + SKY + bytes([1, 1, 1, 12])))
    elif kind == "turned":
        picture = PIL.Image.fromarray((255 * image).astype(np.uint8))
        exif = picture.getexif()
        exif[0x112] = 6
        picture.save(path, exif=exif, progressive=True)
    elif kind == "profile":
        profile = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("sRGB")).tobytes()
        PIL.Image.fromarray((255 * image).astype(np.uint8)).save(path, icc_profile=profile)
    else:
        assert OpenImageIO.ImageBuf(image).write(str(path), "float" if kind == "float" else "uint8")


@pytest.mark.parametrize(
    "names",
    [
        ["image.png", "profile.png", "image.jpg", "turned.jpg", "image.bmp", "image.tif", "float.tif", "float.pfm"],
        ["float.hdr", "flat.hdr", "old_runs.hdr"],
        ["zip.exr", "piz.exr", "dwaa.exr", "b44.exr", "pxr24.exr", "rle.exr", "parts.exr", "tiles.exr"],
    ],
    ids=["others", "radiance", "exr"],
)
def test_mutated_files_are_read_or_refused_and_decoders_print_nothing(tmp_path, names):
    for name in names:
        write_sample(tmp_path / name)
    run = [sys.executable, "-c", READ, str(MUTATIONS), *(str(tmp_path / name) for name in names)]
    done = subprocess.run(run, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    results = json.loads(done.stdout)
    assert list(results) == names
    assert not {name: wrong for name, (_, wrong) in results.items() if wrong}
    for name, (counts, _) in results.items():
        assert sum(counts.values()) == MUTATIONS
        assert counts["ValueError"] > 0, name
        assert counts["picture"] > 0, name


@pytest.mark.parametrize(
    ("chunks", "words"),
    [
        ([(b"IDAT", b"abc")], "pixels that cannot be unpacked"),
        ([(b"IDAT", zlib.compress(bytes(10)))], "10 bytes of pixels and no end of them, which must have 52"),
        ([(b"IDAT", zlib.compress(bytes([7] * 52)))], "scan lines of an unknown filter"),
        ([(b"IDAT", zlib.compress(bytes(52))[:-4])], "52 bytes of pixels and no end of them"),
        ([(b"ABCD", b""), (b"IDAT", zlib.compress(bytes(52)))], "a chunk ABCD at byte 33, which no PNG file has there"),
    ],
)
def test_png_files_with_right_checksums_of_wrong_content_are_refused_without_a_line_of_libpng(capfd, chunks, words):
    header = (b"IHDR", struct.pack(">2I5B", 4, 4, 8, 2, 0, 0, 0))
    content = b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(*each) for each in (header, *chunks, (b"IEND", b"")))
    with pytest.raises(ValueError, match=rf"a\.png must be an undamaged png file, got: {words}"):
        decode_image(content, name="a.png")
    assert capfd.readouterr().err == ""
