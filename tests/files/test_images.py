import pathlib

import jax.numpy as jnp
import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from jaxprt.files import decode_image, read_image, write_exr, write_png


def random_image(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def write_exr_channels(path, channels, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, dict(channels)) as file:  # It changes the dictionary.
        file.write(str(path))


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


def test_exr_of_arrays_that_are_not_contiguous_or_not_numpy_is_written_rightly(tmp_path):
    image = random_image(6, 8, 3)
    for i, view in enumerate((image.transpose(1, 0, 2), image[::-1, ::2], image[..., ::-1], jnp.asarray(image))):
        write_exr(tmp_path / f"{i}.exr", view)
        np.testing.assert_array_equal(read_image(tmp_path / f"{i}.exr")[0], view)


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


def test_mip_mapped_tiles_are_read_at_the_finest_level(data):
    image, attributes = read_image(data / "env" / "KernerEnvCube.exr")
    assert image.shape == (1536, 256, 4)
    assert attributes["envmap"] == "cube"


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


def test_png_holds_the_display_values_clamped_and_rounded(tmp_path):
    image = np.linspace(-0.5, 1.5, 60, dtype=np.float32).reshape(4, 5, 3)
    write_png(tmp_path / "image.png", image)
    expected = np.round(np.clip(image, 0, 1) * 255)
    np.testing.assert_allclose(encode_srgb(read_image(tmp_path / "image.png")[0]) * 255, expected, atol=1e-3)


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
        (b"-Y 8 +X 16", b"+Y 8 +X 16", "orientation"),
        (b"rle_rgbe", b"rle_xyze", "XYZ"),
        (b"-Y 8 +X 16", b"-Y 60000 +X 60000", "must"),
    ):
        assert old in whole
        path.write_bytes(whole.replace(old, new))
        with pytest.raises(ValueError, match=message):
            read_image(path)


def test_exr_without_color_channels_is_refused_and_its_channels_named(tmp_path):
    plane = np.ascontiguousarray(random_image(4, 4, 1)[..., 0])
    write_exr_channels(tmp_path / "depth.exr", {"Z": plane, "left.R": plane})
    with pytest.raises(ValueError, match=r"depth\.exr must have channels R, G, B or Y .* got .*left\.R"):
        read_image(tmp_path / "depth.exr")


@pytest.mark.usefixtures("unchecked")
def test_unwritable_images_are_refused(tmp_path):
    for write in (write_exr, write_png):
        with pytest.raises(ValueError, match=r"image must be of floating point, with 1 for white .*, got uint8"):
            write(tmp_path / "image", np.full((4, 4, 3), 255, np.uint8))
        with pytest.raises(ValueError, match=r"\(4, 4, 2\)"):
            write(tmp_path / "image", random_image(4, 4, 2))
        with pytest.raises(ValueError, match=r"\(0, 4, 3\)"):
            write(tmp_path / "image", random_image(0, 4, 3))
        with pytest.raises(FileNotFoundError, match="no folder"):
            write(tmp_path / "missing" / "image", random_image(4, 4, 3))
    image = random_image(4, 4, 3)
    image[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match=r"1 such pixels, first at \(1, 2\)"):
        write_png(tmp_path / "image.png", image)


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
