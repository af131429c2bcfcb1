import os
import pathlib
import re
import struct
import zlib

import numpy as np
import OpenImageIO
import pytest

from jaxprt import require
from jaxprt.files import decode_image, images, pixels, read_image, write_exr, write_png


def random_image(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def write_oiio(path, image, form):
    assert OpenImageIO.ImageBuf(np.ascontiguousarray(image)).write(str(path), form)


def encode_srgb(value):
    return np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_returns_what_was_written_bit_by_bit(tmp_path, channels):
    image = random_image(5, 7, channels) * 1e5 - 1e3
    write_exr(tmp_path / "image.exr", image)
    read, attributes = read_image(tmp_path / "image.exr")
    assert read.dtype == np.float32
    np.testing.assert_array_equal(read, image)
    assert "envmap" not in attributes


@pytest.mark.parametrize("name", ["image.png", "image.tif", "image.bmp"])
def test_whole_numbers_are_decoded_from_srgb(tmp_path, name):
    linear = random_image(9, 6, 3)
    write_oiio(tmp_path / name, encode_srgb(linear), "uint8")
    # Half a step of 8 bits, times the curve's steepest slope.
    np.testing.assert_allclose(read_image(tmp_path / name)[0], linear, atol=0.5 / 255 * 2.3)


@pytest.mark.parametrize(("name", "relative"), [("image.hdr", 1 / 128), ("image.tif", 0), ("image.pfm", 0)])
def test_floats_are_taken_as_they_are(tmp_path, name, relative):
    image = random_image(9, 16, 3) * 100
    write_oiio(tmp_path / name, image, "float")
    read = read_image(tmp_path / name)[0]
    assert np.abs(read - image).max() <= relative * image.max()
    assert read[0].mean() == pytest.approx(image[0].mean(), rel=0.01)


def test_alpha_neither_changes_the_colors_nor_is_decoded(tmp_path):
    image = random_image(4, 5, 4)
    write_png(tmp_path / "image.png", image)
    read = read_image(tmp_path / "image.png")[0]
    np.testing.assert_allclose(encode_srgb(read[..., :3]), image[..., :3], atol=0.51 / 255)
    np.testing.assert_allclose(read[..., 3], image[..., 3], atol=0.51 / 255)


@pytest.mark.parametrize("name", ["image.exr", "image.hdr", "image.png", "image.jpg"])
def test_truncated_files_are_refused_by_name(tmp_path, name):
    path = tmp_path / name
    image = random_image(64, 64, 3)
    write_exr(path, image) if name.endswith("exr") else write_oiio(path, image, "uint8")
    whole = path.read_bytes()
    for length in (0, 3, 100, len(whole) // 2, len(whole) - 40):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=name):
            read_image(path)


@pytest.mark.parametrize("name", ["image.exr", "image.hdr", "image.png"])
def test_noise_after_the_magic_bytes_is_refused(tmp_path, name):
    path = tmp_path / name
    image = random_image(64, 64, 3)
    write_exr(path, image) if name.endswith("exr") else write_oiio(path, image, "uint8")
    start = path.read_bytes()[:20]
    path.write_bytes(start + np.random.default_rng(0).bytes(5000))
    with pytest.raises(ValueError, match=name):
        read_image(path)


def test_content_counts_and_not_the_name(tmp_path):
    image = random_image(8, 16, 3)
    write_exr(tmp_path / "image.exr", image)
    write_oiio(tmp_path / "image.png", image, "uint8")
    write_oiio(tmp_path / "image.hdr", image, "float")
    for source, name in (("image.exr", "a.hdr"), ("image.hdr", "b.exr"), ("image.png", "c.hdr"), ("image.png", "png")):
        (tmp_path / name).write_bytes((tmp_path / source).read_bytes())
        np.testing.assert_array_equal(read_image(tmp_path / name)[0], read_image(tmp_path / source)[0])


def test_what_is_no_image_is_refused_by_name(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"missing\.exr"):
        read_image(tmp_path / "missing.exr")
    with pytest.raises(ValueError, match="got a directory"):
        read_image(tmp_path)
    (tmp_path / "text.hdr").write_text("not an image")
    with pytest.raises(ValueError, match=r"text\.hdr must be an EXR, HDR, .* got one that starts with b'not an i'"):
        read_image(str(tmp_path / "text.hdr"))
    (tmp_path / "empty.exr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.exr .* got an empty file"):
        read_image(tmp_path / "empty.exr")


def test_headers_that_ask_for_something_else_are_refused(tmp_path):
    write_oiio(tmp_path / "image.hdr", random_image(8, 16, 3), "float")
    whole = (tmp_path / "image.hdr").read_bytes()
    path = tmp_path / "changed.hdr"
    for old, new, message in (
        (b"-Y 8 +X 16", b"-Y 8 +Y 16", "resolution"),
        (b"rle_rgbe", b"rle_xyze", "XYZ"),
        (b"-Y 8 +X 16", b"-Y 60000 +X 60000", "must"),
    ):
        assert old in whole
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_image(path)


def test_a_path_may_be_relative(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_exr("image.exr", random_image(2, 2, 3))
    assert read_image(pathlib.Path("image.exr"))[0].shape == (2, 2, 3)


@pytest.mark.parametrize(("form", "error"), [("png", 1 / 255), ("jpeg", 0.02), ("tiff", 1 / 255)])
def test_images_in_memory_are_decoded_as_files_are_or_left_as_they_are_stored(tmp_path, form, error):
    stored = (np.full((16, 8, 3), [0.2, 0.5, 0.9]) * 255).round().astype(np.uint8)
    write_oiio(tmp_path / f"image.{form}", stored, "uint8")
    content = (tmp_path / f"image.{form}").read_bytes()
    decoded = decode_image(content, name="image 3 of a.glb")
    np.testing.assert_array_equal(decoded, read_image(tmp_path / f"image.{form}")[0])
    np.testing.assert_allclose(encode_srgb(decoded), stored / 255, atol=error)
    np.testing.assert_allclose(decode_image(content, name="a", decoded=False), stored / 255, atol=error)
    for damaged in (b"", b"no picture", content[:30]):
        with pytest.raises(ValueError, match=r"image 3 of a\.glb must be an (undamaged|EXR)"):
            decode_image(damaged, name="image 3 of a.glb")


def tagged(content, orientation, form):
    """A picture with an Exif orientation, or with the same tag of TIFF."""
    exif = b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0" + bytes([orientation]) + b"\0\0\0\0\0\0"
    if form == "png":
        return content[:33] + png_chunk(b"eXIf", exif) + content[33:]
    block = b"Exif\0\0" + exif
    return content[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + content[2:]


def png_chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


# Where the corners of the stored picture a b / c d are to be shown, from the table of Exif 2.32, section 4.6.4.
SHOWN = {1: "ab cd", 2: "ba dc", 3: "dc ba", 4: "cd ab", 5: "ac bd", 6: "ca db", 7: "db ca", 8: "bd ac"}


@pytest.mark.parametrize("form", ["jpeg", "png", "tiff"])
def test_pictures_are_turned_as_their_orientation_demands(tmp_path, form):
    level = {"a": 0.1, "b": 0.35, "c": 0.65, "d": 0.9}
    path = tmp_path / f"image.{form}"
    for orientation, words in SHOWN.items():
        stored = np.array([[level["a"], level["b"]], [level["c"], level["d"]]])
        # 16 rows and 32 columns: each corner fills blocks of JPEG.
        stored = np.repeat((255 * stored.repeat(8, 0).repeat(16, 1)).round().astype(np.uint8)[..., None], 3, 2)
        buffer = OpenImageIO.ImageBuf(np.ascontiguousarray(stored))
        if form == "tiff":
            buffer.specmod().attribute("Orientation", orientation)
        assert buffer.write(str(path), form)
        if form != "tiff":
            path.write_bytes(tagged(path.read_bytes(), orientation, form))
        read = decode_image(path.read_bytes(), name="image", decoded=False)
        assert read.shape == ((16, 32, 3) if orientation < 5 else (32, 16, 3))
        np.testing.assert_array_equal(encode_srgb(read_image(path)[0]).round(3), read.round(3))
        corner = [read[i, j, 0] for i in (0, -1) for j in (0, -1)]
        np.testing.assert_allclose(corner, [level[x] for x in words.replace(" ", "")], atol=0.01)


def test_orientations_that_do_not_exist_are_ignored(tmp_path):
    path = tmp_path / "image.png"
    write_png(path, random_image(4, 6, 3))
    upright = read_image(path)[0]
    path.write_bytes(tagged(path.read_bytes(), 9, "png"))
    np.testing.assert_array_equal(read_image(path)[0], upright)


def huge_png(width, height):
    """A black picture, compressed to a thousandth. The sum at its end is wrong, but nothing reads so far."""
    packer = zlib.compressobj()
    lines = bytes((3 * width + 1) * 100)
    first, again = (packer.compress(lines) + packer.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    data = first + again * (height // 100 - 1) + packer.flush()
    return b"\x89PNG\r\n\x1a\n" + header + png_chunk(b"IDAT", data) + png_chunk(b"IEND", b"")


def test_pictures_of_too_many_pixels_are_refused_by_their_header(tmp_path):
    path = tmp_path / "huge.png"
    path.write_bytes(huge_png(30_000, 15_000))
    message = r"must have 1 to 268435456 pixels, got 30000 x 15000 \(width x height\): reduce its size"
    with pytest.raises(ValueError, match=rf"huge\.png {message}"):
        read_image(path)
    with pytest.raises(ValueError, match=rf"image 2 of a\.glb {message}"):
        decode_image(path.read_bytes(), name="image 2 of a.glb")


@pytest.mark.parametrize("form", ["png", "tif", "jpg", "bmp", "hdr", "pfm", "exr"])
def test_pictures_that_do_not_fit_into_memory_are_refused_before_they_are_read(tmp_path, monkeypatch, form):
    path = tmp_path / f"image.{form}"
    assert OpenImageIO.ImageBuf(random_image(300, 400, 3)).write(str(path))
    shape = read_image(path)[0].shape
    # The pixels, 1.44 MB, and half as much for what is needed besides.
    monkeypatch.setattr(require, "available_memory", lambda: 10_000_000)
    message = r"400 x 300 pixels \(width x height\) of 3 channels take 0\.0 GB, and 0\.0 GB are free; free some memory"
    with pytest.raises(MemoryError, match=message):
        read_image(path)
    monkeypatch.setattr(require, "available_memory", lambda: 100_000_000)
    assert read_image(path)[0].shape == shape == (300, 400, 3)


@pytest.mark.parametrize("form", ["png", "tif", "jpg", "bmp", "hdr", "pfm", "exr"])
def test_reading_in_blocks_of_rows_gives_what_reading_at_once_gives(tmp_path, monkeypatch, form):
    path = tmp_path / f"image.{form}"
    assert OpenImageIO.ImageBuf(random_image(50, 31, 3)).write(str(path))
    whole = read_image(path)[0]
    for values in (1, 31 * 3 * 7):
        monkeypatch.setattr(pixels, "_VALUES", values)
        monkeypatch.setattr(images, "_LINES", 16)
        np.testing.assert_array_equal(read_image(path)[0], whole)


def test_ctrl_c_interrupts_reading_between_blocks(tmp_path, monkeypatch):
    path = tmp_path / "image.png"
    write_png(path, random_image(50, 31, 3))
    rows = []

    def interrupted(reader, block, **options):
        rows.append(block)
        if len(rows) == 3:
            raise KeyboardInterrupt
        return np.zeros((len(block), 31, 3), np.float32)

    monkeypatch.setattr(pixels, "_VALUES", 31 * 3 * 7)
    monkeypatch.setattr(pixels, "read_block", interrupted)
    with pytest.raises(KeyboardInterrupt):
        read_image(path)
    assert rows == [range(0, 7), range(7, 14), range(14, 21)]


def test_what_is_no_regular_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    for path in (tmp_path / "pipe.png", pathlib.Path("/dev/zero")):
        with pytest.raises(ValueError, match=f"{path.name} must be an image file, got a special file"):
            read_image(path)


def write_tiff_of_tiles(path, side):
    """A TIFF file of 16 x 16 pixels in a single tile whose sides the header states as `side`."""
    spec = OpenImageIO.ImageSpec(16, 16, 3, "uint8")
    spec.tile_width = spec.tile_height = 16
    output = OpenImageIO.ImageOutput.create("tiff")
    assert output is not None
    assert output.open(str(path), spec)
    assert output.write_image(np.zeros((16, 16, 3), np.float32))
    assert output.close()
    content = path.read_bytes()
    for tag in (322, 323):  # TileWidth, TileLength
        content, count = re.subn(
            re.escape(struct.pack("<H", tag)) + b"[\3\4]" + re.escape(struct.pack("<BII", 0, 1, 16)),
            lambda _, tag=tag: struct.pack("<HHII", tag, 4, 1, side),
            content,
        )
        assert count == 1
    path.write_bytes(content)


def test_large_tiles_of_a_small_tiff_are_refused_before_they_are_read(tmp_path, monkeypatch):
    path = tmp_path / "tile.tif"
    write_tiff_of_tiles(path, 16)
    assert read_image(path)[0].shape == (16, 16, 3)
    write_tiff_of_tiles(path, 32768)
    with pytest.raises(ValueError, match="32768 x 32768"):
        read_image(path)
    write_tiff_of_tiles(path, 8192)
    monkeypatch.setattr(require, "available_memory", lambda: 10**9)
    with pytest.raises(MemoryError, match=r"tile\.tif: 16 x 16 pixels .* take 1\.2 GB"):
        read_image(path)
