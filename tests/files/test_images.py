"""Image files: what is read, of which formats, and what is refused."""

import re
import struct
import zlib

import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from jaxprt import require
from jaxprt.files import decode_image, pixels, read_image, write_exr, write_png
from tests.files.samples import encode_srgb, planes, png_chunk, random_image, write_parts, write_tiles

AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, 0.32168, 0.33767)
# ACES2065-1 to linear sRGB with Bradford's adaptation, from the OpenColorIO configuration of ACES.
AP0_TO_REC709 = np.array(
    [
        [2.52168618674388, -1.13413098823972, -0.387555198504164],
        [-0.276479914229922, 1.37271908766826, -0.096239173438334],
        [-0.0153780649660342, -0.152975335867399, 1.16835340083343],
    ]
)
MATRIX_ERROR = 2e-5  # of chromaticities in float32
# Two pixels and the radiance that they stand for: mantissa / 256 * 2^(exponent - 128).
RED, SKY = bytes([128, 64, 32, 129]), bytes([16, 32, 128, 131])
VALUE = {RED: [1.0, 0.5, 0.25], SKY: [0.5, 1.0, 4.0]}
HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"


def write_oiio(path, image, form):
    assert OpenImageIO.ImageBuf(np.ascontiguousarray(image)).write(str(path), form)


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
    with pytest.raises(
        ValueError, match=r"text\.hdr must be an EXR, HDR, .* got one that starts with the text 'not an i'"
    ):
        read_image(str(tmp_path / "text.hdr"))
    (tmp_path / "empty.exr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"empty\.exr .* got an empty file"):
        read_image(tmp_path / "empty.exr")


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
        np.testing.assert_array_equal(read_image(path)[0], whole)


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


def write_exr_channels(path, channels, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, dict(channels)) as file:  # It changes the dictionary.
        file.write(str(path))


def test_mip_mapped_tiles_are_read_at_the_finest_level(data):
    image, attributes = read_image(data / "env" / "KernerEnvCube.exr")
    assert image.shape == (1536, 256, 4)
    assert attributes["envmap"] == "cube"


def test_tristimulus_values_do_not_pass_for_gray_and_a_depth_beside_gray_is_ignored(tmp_path):
    image = random_image(4, 6, 3)
    write_exr_channels(tmp_path / "xyz.exr", planes(image, "XYZ"))
    with pytest.raises(ValueError, match=r"xyz\.exr must have .*, got X, Y, Z: convert CIE XYZ, or"):
        read_image(tmp_path / "xyz.exr")
    write_exr_channels(tmp_path / "depth.exr", planes(image, "YZ"))
    np.testing.assert_array_equal(read_image(tmp_path / "depth.exr")[0][..., 0], image[..., 0])


def test_exr_channels_are_found_in_any_order_and_type(tmp_path):
    red, green, blue = (np.ascontiguousarray(random_image(4, 4, 3)[..., i]) for i in range(3))
    half = {"R": red.astype(np.float16), "G": green.astype(np.float16), "B": blue.astype(np.float16)}
    write_exr_channels(tmp_path / "half.exr", half)
    np.testing.assert_array_equal(
        read_image(tmp_path / "half.exr")[0], np.stack(list(half.values()), -1).astype(np.float32)
    )
    write_exr_channels(tmp_path / "mixed.exr", {"Z": red, "B": blue, "A": half["R"], "G": green, "R": red})
    np.testing.assert_array_equal(
        read_image(tmp_path / "mixed.exr")[0], np.stack([red, green, blue, half["R"].astype(np.float32)], -1)
    )


def test_cropped_exr_is_placed_in_its_display_window(tmp_path):
    image = random_image(4, 5, 1)
    windows = {
        "dataWindow": (np.array([3, -1], np.int32), np.array([7, 2], np.int32)),
        "displayWindow": (np.array([1, 0], np.int32), np.array([6, 4], np.int32)),
    }
    write_exr_channels(tmp_path / "crop.exr", {"Y": np.ascontiguousarray(image[..., 0])}, **windows)
    expected = np.zeros((5, 6, 1), np.float32)
    expected[0:3, 2:6] = image[1:4, 0:4]
    np.testing.assert_array_equal(read_image(tmp_path / "crop.exr")[0], expected)


def test_exr_without_color_channels_is_refused_and_its_channels_named(tmp_path):
    plane = np.ascontiguousarray(random_image(4, 4, 1)[..., 0])
    write_exr_channels(tmp_path / "depth.exr", {"Z": plane, "left.R": plane})
    with pytest.raises(ValueError, match=r"depth\.exr must have channels R, G, B or Y .* got .*left\.R"):
        read_image(tmp_path / "depth.exr")


@pytest.mark.parametrize(
    "compression", [name for name in dir(OpenEXR) if name.endswith("_COMPRESSION") and not name.startswith("NUM")]
)
def test_every_compression_is_read_in_blocks_as_openexr_reads_it(tmp_path, compression):
    """700 rows are three blocks of DWAB, the coarsest, and of ours."""
    smooth = np.sin(np.arange(700)[:, None] / 40 + np.arange(9) / 3) + 2
    image = np.stack([smooth, smooth**2, 1 / smooth], -1).astype(np.float16)
    path = tmp_path / "image.exr"
    try:
        write_exr_channels(path, planes(image), compression=getattr(OpenEXR, compression))
    except (RuntimeError, ValueError):
        pytest.skip(f"this build of OpenEXR does not write {compression}")
    with OpenEXR.File(str(path), separate_channels=True) as file:
        expected = np.stack([file.channels()[name].pixels for name in "RGB"], -1).astype(np.float32)
    np.testing.assert_array_equal(read_image(path)[0], expected)


@pytest.mark.parametrize("tile", [(16, 16), (64, 48), (7, 300)])
def test_tiles_of_any_shape_are_read(tmp_path, tile):
    image = random_image(290, 50, 4).astype(np.float16).astype(np.float32)
    write_tiles(tmp_path / "image.exr", image, tile)
    np.testing.assert_array_equal(read_image(tmp_path / "image.exr")[0], image)


def test_the_first_part_with_rgb_is_read_and_depth_is_no_color(tmp_path):
    path, image = tmp_path / "image.exr", random_image(4, 6, 3)
    depth = {"Z": image[..., 0] + 5}
    gray = {"Y": image[..., 1] + 7}
    for first in ({"depth": (depth, {})}, {"gray": (gray, {})}, {"depth": (depth, {}), "gray": (gray, {})}):
        write_parts(path, **first, beauty=(planes(image), {}))
        read, attributes = read_image(path)
        np.testing.assert_array_equal(read, image)
        assert attributes["name"] == "beauty"
    write_parts(path, depth=(depth, {}), gray=(gray, {}))
    np.testing.assert_array_equal(read_image(path)[0][..., 0], gray["Y"])


def test_parts_that_are_ignored_though_they_have_colors_are_named(tmp_path):
    path, image = tmp_path / "image.exr", random_image(4, 6, 3)
    write_parts(path, left=(planes(image), {}), depth=({"Z": image[..., 0]}, {}), right=(planes(image[::-1]), {}))
    with pytest.warns(UserWarning, match=r"image\.exr has colors in several parts: 'left' is used, 'right' ignored"):
        read = read_image(path)[0]
    np.testing.assert_array_equal(read, image)


def test_layers_are_named_where_there_is_no_other_color(tmp_path):
    image = random_image(4, 6, 3)
    write_exr_channels(tmp_path / "a.exr", planes(image, prefix="diffuse.") | planes(image, prefix="specular.left."))
    with pytest.raises(ValueError, match=r"a\.exr must have .* got diffuse\.B.*layers diffuse, specular\.left have"):
        read_image(tmp_path / "a.exr")
    write_exr_channels(tmp_path / "b.exr", planes(image) | planes(image + 1, prefix="diffuse."))
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr")[0], image)


@pytest.mark.parametrize(
    "header",
    [
        {"chromaticities": AP0},
        {"chromaticities": AP0, "acesImageContainerFlag": 1, "whiteLuminance": 80.0},
        {"acesImageContainerFlag": 1},
    ],
    ids=["chromaticities", "both", "container"],
)
def test_aces_colors_become_rec709(tmp_path, header):
    image = random_image(5, 6, 4) * 30
    write_exr_channels(tmp_path / "image.exr", planes(image, "RGBA"), **header)
    read = read_image(tmp_path / "image.exr")[0]
    np.testing.assert_allclose(read[..., :3], image[..., :3] @ AP0_TO_REC709.T, atol=30 * 4 * MATRIX_ERROR)
    np.testing.assert_array_equal(read[..., 3], image[..., 3])


@pytest.mark.skipif(not hasattr(OpenEXR, "colorInteropIDToChromaticities"), reason="OpenEXR 3.5")
def test_color_interop_ids_are_used_where_there_are_no_chromaticities(tmp_path):
    image = random_image(5, 6, 3)
    for name, expected in (("lin_ap0_scene", image @ AP0_TO_REC709.T), ("lin_rec709_scene", image), ("data", image)):
        write_exr_channels(tmp_path / "image.exr", planes(image), colorInteropID=name)
        np.testing.assert_allclose(read_image(tmp_path / "image.exr")[0], expected, atol=4 * MATRIX_ERROR)


def test_gray_and_rec709_are_left_as_they_are(tmp_path):
    image = random_image(5, 6, 3) - 0.5
    rec709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
    write_exr_channels(tmp_path / "a.exr", planes(image), chromaticities=rec709)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr")[0], image)
    write_exr_channels(tmp_path / "b.exr", planes(image, "Y"), chromaticities=AP0)
    np.testing.assert_array_equal(read_image(tmp_path / "b.exr")[0], image[..., :1])


def test_chromaticities_that_span_no_colors_are_refused(tmp_path):
    for wrong in ((0.0,) * 8, (0.3, 0.3) * 4, (*AP0[:6], 0.3, 0.0), (*AP0[:7], float("nan"))):
        write_exr_channels(tmp_path / "image.exr", planes(random_image(2, 2, 3)), chromaticities=wrong)
        with pytest.raises(ValueError, match=r"the chromaticities of .*image\.exr must state primaries"):
            read_image(tmp_path / "image.exr")


def windows(path, *corners):
    """Overwrites the data window and the display window of a file."""
    data = bytearray(path.read_bytes())
    for name, corner in zip((b"dataWindow", b"displayWindow"), corners, strict=True):
        place = data.index(name + b"\0box2i\0") + len(name) + 11
        data[place : place + 16] = np.array(corner, "<i4").tobytes()
    path.write_bytes(data)


@pytest.mark.parametrize("tiled", [False, True])
def test_windows_of_too_many_pixels_are_refused_by_the_header(tmp_path, tiled):
    path, image = tmp_path / "image.exr", random_image(8, 16, 3)
    small = (0, 0, 15, 7)
    for data, display, size in (
        (small, (0, 0, 49_999, 39_999), "50000 x 40000"),
        ((0, 0, 2**30, 2**29), small, "1073741825 x 536870913"),
        ((0, 0, 0, 2**31 - 1), small, "1 x 2147483648"),
        (small, (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), "4294967296 x 4294967296"),
    ):
        write_tiles(path, image, (8, 8)) if tiled else write_exr(path, image)
        windows(path, data, display)
        with pytest.raises(ValueError, match=rf"image\.exr must .*({size}|undamaged)"):
            read_image(path)
    write_tiles(path, image, (8, 8)) if tiled else write_exr(path, image)
    windows(path, small, (0, 0, 20_000, 10_000))  # Only the display window needs memory, 2.4 GB.
    free = read_free(path)
    assert free > 2.4e9


def read_free(path):
    """Smallest memory with which an image is read."""
    needed = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "jaxprt.require.memory", lambda what, size, *_: needed.append(size) or (_ for _ in ()).throw(MemoryError)
        )
        with pytest.raises(MemoryError):
            read_image(path)
    return needed[-1]


def again(count):
    return bytes([1, 1, 1, count])


def picture(data, width, height=1, *, head=HEAD, resolution=None):
    return head + b"\n" + (resolution or b"-Y %d +X %d" % (height, width)) + b"\n" + data


def read(data, width, height=1, **more):
    return decode_image(picture(data, width, height, **more), name="sky.hdr")


def values(*pixels):
    return np.array([VALUE[pixel] for pixel in pixels])


def test_pixels_have_the_values_of_ward():
    assert read(RED + SKY, 2).dtype == np.float32
    np.testing.assert_array_equal(read(RED + SKY, 2)[0], values(RED, SKY))
    np.testing.assert_array_equal(read(bytes([255, 255, 255, 0]), 1)[0, 0], 0)
    np.testing.assert_array_equal(read(bytes([255, 1, 0, 255]), 1)[0, 0], [255 * 2.0**119, 2.0**119, 0])
    np.testing.assert_array_equal(
        read(bytes([128, 1, 0, 1]), 1)[0, 0], np.ldexp([128.0, 1, 0], -135).astype(np.float32)
    )


def test_old_runs_repeat_the_pixel_before_them():
    np.testing.assert_array_equal(read(RED + again(3) + SKY, 5)[0], values(RED, RED, RED, RED, SKY))
    np.testing.assert_array_equal(read(RED + SKY + again(2), 4)[0], values(RED, SKY, SKY, SKY))
    np.testing.assert_array_equal(read(RED + again(0) + SKY, 2)[0], values(RED, SKY))
    # A pixel after a run ends it: the next run starts at the lowest digit.
    np.testing.assert_array_equal(
        read(RED + again(1) + SKY + again(2) + RED, 6)[0], values(RED, RED, SKY, SKY, SKY, RED)
    )


def test_consecutive_old_runs_are_the_digits_of_a_number_to_the_base_256():
    for digits in ((44, 1), (0, 1), (255,), (0, 0, 1), (7, 2, 1), (5, 0, 0, 0, 0)):
        count = sum(digit * 256**i for i, digit in enumerate(digits))
        row = read(RED + b"".join(map(again, digits)) + SKY, count + 2)[0]
        np.testing.assert_array_equal(row[:-1], np.broadcast_to(VALUE[RED], (count + 1, 3)))
        np.testing.assert_array_equal(row[-1], VALUE[SKY])


def test_old_runs_start_anew_in_each_line():
    data = RED + again(9) + SKY + again(4) + RED + again(4) + b"".join([RED] * 10)
    expected = np.stack([values(*[RED] * 10), values(*[SKY] * 5, *[RED] * 5), values(*[RED] * 10)])
    np.testing.assert_array_equal(read(data, 10, 3), expected)


@pytest.mark.parametrize(
    "data",
    [
        RED + again(10) + SKY + again(8),  # over the end of a line
        RED + again(9) + SKY + again(8),  # too few
        RED + again(9) + again(9),  # a line that starts with a run
        again(9) + RED + again(9),
        RED + again(9) + SKY + again(9)[:3],
        RED + again(0) + again(0) + again(0) + again(0) + again(0) + again(1),
        RED + b"".join(map(again, [255] * 40)),
        RED * 19,
        b"",
    ],
)
def test_runs_that_do_not_fill_the_lines_are_refused(data):
    with pytest.raises(
        ValueError, match=r"sky\.hdr must be an undamaged hdr file, got: pixels or runs .* 2 lines of 10"
    ):
        read(data, 10, 2)


def test_flat_pixels_that_look_like_runs_are_pixels_where_the_file_has_all_of_them():
    data = bytes([1, 1, 1, 129]) + RED * 19
    np.testing.assert_array_equal(read(data, 10, 2)[0, 0], np.full(3, 2 / 256))


def component_runs(image):
    """The newer coding of a line: each component by itself, here a run of its first half, and the rest as it is."""
    data = b""
    for line in image:
        width = len(line)
        data += bytes([2, 2]) + struct.pack(">H", width)
        for component in line.T:
            half = width // 2
            data += bytes([128 + half, component[0], width - half]) + component[half:].tobytes()
    return data


def coded(stored, coding):
    """Pixels [h, w, 4] whose lines have equal pixels in their first half."""
    if coding == "flat":
        return stored.tobytes()
    if coding == "runs":
        return component_runs(stored)
    half = stored.shape[1] // 2
    return b"".join(line[0].tobytes() + again(half - 1) + line[half:].tobytes() for line in stored)


def blocks(height, width, seed=0):
    mantissa = np.random.default_rng(seed).integers(128, 256, (height, width, 3))
    stored = np.concatenate([mantissa, np.full((height, width, 1), 129)], -1).astype(np.uint8)
    stored[:, : width // 2] = stored[:, :1]
    return stored


# What the resolution line says of the rows and columns of the picture, from Radiance's description of its files: the
# first axis is the one between scan lines, -Y is downwards, +X is to the right.
TURNED = {
    b"-Y 6 +X 10": lambda lines: lines,
    b"-Y 6 -X 10": lambda lines: lines[:, ::-1],
    b"+Y 6 +X 10": lambda lines: lines[::-1],
    b"+Y 6 -X 10": lambda lines: lines[::-1, ::-1],
    b"+X 6 -Y 10": lambda lines: lines.transpose(1, 0, 2),
    b"-X 6 -Y 10": lambda lines: lines.transpose(1, 0, 2)[:, ::-1],
    b"+X 6 +Y 10": lambda lines: lines.transpose(1, 0, 2)[::-1],
    b"-X 6 +Y 10": lambda lines: lines.transpose(1, 0, 2)[::-1, ::-1],
}


@pytest.mark.parametrize("coding", ["flat", "old runs", "runs"])
@pytest.mark.parametrize("resolution", TURNED)
def test_every_coding_is_read_in_every_orientation(coding, resolution):
    stored = blocks(6, 10)
    expected = TURNED[resolution](stored[..., :3] / 128.0)
    np.testing.assert_array_equal(read(coded(stored, coding), 0, resolution=resolution), expected)


def test_what_openimageio_reads_is_read_alike(tmp_path):
    image = np.exp(4 * np.random.default_rng(0).normal(size=(40, 70, 3))).astype(np.float32)
    path = tmp_path / "image.hdr"
    assert OpenImageIO.ImageBuf(image).write(str(path))
    expected = np.asarray(OpenImageIO.ImageBuf(str(path)).get_pixels("float"))
    np.testing.assert_array_equal(read_image(path)[0], expected)


@pytest.mark.parametrize("coding", ["flat", "old runs", "runs"])
def test_radiance_is_the_pixel_divided_by_all_exposures_and_color_corrections(coding):
    stored = blocks(2, 8)
    expected = stored[..., :3] / 128.0
    for lines, factor in (
        (b"EXPOSURE=2\n", 1 / 2),
        (b"EXPOSURE= 2.0\nVIEW= -vp 0 0 0\nEXPOSURE=4e0\n", 1 / 8),
        (b"EXPOSURE=0.25\n\tEXPOSURE=7\n EXPOSURE=9\n", 4),  # Indented lines are about other pictures.
        (b"COLORCORR= 1 2 4\n", [1, 1 / 2, 1 / 4]),
        (b"COLORCORR=1 2 4\nEXPOSURE=.5\nCOLORCORR=2 1 1\n", [1, 1, 1 / 2]),
        (b"EXPOSURE=1\nSOFTWARE=EXPOSURE=3\n#EXPOSURE=3\n", 1),
    ):
        read_pixels = read(coded(stored, coding), 8, 2, head=HEAD + lines)
        np.testing.assert_allclose(read_pixels, expected * factor, rtol=1e-7)


def test_the_variables_of_the_header_are_returned(tmp_path):
    path = tmp_path / "a.hdr"
    head = b"#?RGBE\nSOFTWARE=one = two\nEXPOSURE=2\nEXPOSURE=4\nCOLORCORR=1 1 2\n"
    path.write_bytes(picture(RED, 1, head=head))
    attributes = read_image(path)[1]
    assert attributes == {"SOFTWARE": "one = two", "EXPOSURE": 8.0, "COLORCORR": (1.0, 1.0, 2.0)}


@pytest.mark.parametrize(
    "line", ["EXPOSURE=", "EXPOSURE=0", "EXPOSURE=-1", "EXPOSURE=nan", "EXPOSURE=two", "COLORCORR=1 1", "GAMMA=x"]
)
def test_headers_with_impossible_numbers_are_refused(line):
    with pytest.raises(ValueError, match=f"{line.split('=')[0]} of sky.hdr must be"):
        read(RED, 1, head=HEAD + line.encode() + b"\n")


def test_exposures_whose_product_overflows_are_refused():
    for value in (b"1e30", b"1e-30"):
        with pytest.raises(ValueError, match=r"exposures of sky\.hdr must give finite radiance"):
            read(RED, 1, head=HEAD + b"EXPOSURE=" + value + b"\nEXPOSURE=" + value + b"\n")


def test_primaries_become_rec709():
    """Those of Rec. 2020, by the matrix of ITU-R BT.2087; white stays white for any."""
    primaries = b"PRIMARIES= 0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n"
    published = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
    row = read(RED + SKY, 2, head=HEAD + primaries)[0]
    np.testing.assert_allclose(row, values(RED, SKY) @ published.T, atol=4e-4)
    equal_energy = b"PRIMARIES=.640 .330 .290 .600 .150 .060 .333333 .333333\n"
    np.testing.assert_allclose(read(bytes([128, 128, 128, 129]), 1, head=HEAD + equal_energy)[0, 0], 1, rtol=1e-6)
    rec709 = b"PRIMARIES=.64 .33 .30 .60 .15 .06 .3127 .3290\n"
    np.testing.assert_array_equal(read(RED + SKY, 2, head=HEAD + rec709)[0], values(RED, SKY))
    unstated = b"PRIMARIES=0 0 0 0 0 0 0 0\n"
    np.testing.assert_array_equal(read(RED + SKY, 2, head=HEAD + unstated)[0], values(RED, SKY))
    for wrong in (b"1 2 3", b"0 0 0 0 0 0 0 1", b"a b c d e f g h"):
        with pytest.raises(ValueError, match=r"PRIMARIES of sky\.hdr must"):
            read(RED, 1, head=HEAD + b"PRIMARIES=" + wrong + b"\n")


def test_gamma_is_ignored_with_a_warning():
    with pytest.warns(UserWarning, match=r"sky\.hdr states GAMMA=2\.2, which is ignored"):
        read(RED, 1, head=HEAD + b"GAMMA=2.2\n")
    read(RED, 1, head=HEAD + b"GAMMA=1.0\n")


def test_line_ends_of_other_systems_and_missing_formats_are_read():
    np.testing.assert_array_equal(read(RED, 1, head=b"#?RADIANCE\n")[0], values(RED))
    data = b"#?RADIANCE\r\nFORMAT=32-bit_rle_rgbe\r\nEXPOSURE=2\r\n\r\n-Y 1 +X 2\r\n" + RED + SKY
    np.testing.assert_array_equal(decode_image(data, name="a")[0], values(RED, SKY) / 2)


def test_formats_and_resolutions_of_other_kinds_are_refused():
    for form in (b"32-bit_rle_xyze", b"Radiance_spectra"):
        with pytest.raises(ValueError, match=rf"sky\.hdr must hold RGB .*, got {form.decode()}: convert it first"):
            read(RED, 1, head=b"#?RADIANCE\nFORMAT=" + form + b"\n")
    for resolution in (b"-Y 1 +Y 1", b"-Y 1", b"", b"-Z 1 +X 1", b"-Y -1 +X 1", b"-Y 9999999999 +X 1", b"-Y 1 +X 1 1"):
        with pytest.raises(
            ValueError, match=r"sky\.hdr must be an undamaged hdr file, got: .* resolution such as -Y 8 \+X 16"
        ):
            read(RED, 1, resolution=resolution or b" ")
    for size in (b"-Y 0 +X 4", b"-Y 60000 +X 60000"):
        with pytest.raises(ValueError, match=r"sky\.hdr must have 1 to 268435456 pixels"):
            read(RED, 1, resolution=size)


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
