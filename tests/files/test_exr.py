import numpy as np
import OpenEXR
import OpenImageIO
import pytest

from jaxprt.files import read_image, write_exr

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


def random_image(*shape, seed=0):
    return np.random.default_rng(seed).random(shape).astype(np.float32)


def write_exr_channels(path, channels, **header):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    with OpenEXR.File(header, dict(channels)) as file:  # It changes the dictionary.
        file.write(str(path))


def planes(image, names="RGB", prefix=""):
    return {prefix + name: np.ascontiguousarray(image[..., i]) for i, name in enumerate(names)}


def write_parts(path, **parts):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    made = [OpenEXR.Part(header | more, dict(channels), name) for name, (channels, more) in parts.items()]
    with OpenEXR.File(made) as file:
        file.write(str(path))


def write_tiles(path, image, tile, form="half"):
    spec = OpenImageIO.ImageSpec(image.shape[1], image.shape[0], image.shape[2], form)
    spec.tile_width, spec.tile_height = tile
    output = OpenImageIO.ImageOutput.create("exr")
    assert output.open(str(path), spec)
    assert output.write_image(np.ascontiguousarray(image))
    assert output.close()


def test_mip_mapped_tiles_are_read_at_the_finest_level(data):
    image, attributes = read_image(data / "env" / "KernerEnvCube.exr")
    assert image.shape == (1536, 256, 4)
    assert attributes["envmap"] == "cube"


def test_tristimulus_values_do_not_pass_for_gray_and_a_depth_beside_gray_is_ignored(tmp_path):
    image = random_image(4, 6, 3)
    write_exr_channels(tmp_path / "xyz.exr", planes(image, "XYZ"))
    with pytest.raises(ValueError, match=r"xyz\.exr must have .*, got X, Y, Z: convert CIE XYZ to RGB"):
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


def test_whole_numbers_are_read_as_they_are(tmp_path):
    write_exr_channels(tmp_path / "image.exr", {"Y": np.arange(12, dtype=np.uint32).reshape(3, 4)})
    np.testing.assert_array_equal(read_image(tmp_path / "image.exr")[0][..., 0], np.arange(12).reshape(3, 4))


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


def test_each_part_has_a_data_window_of_its_own(tmp_path):
    path, image = tmp_path / "image.exr", random_image(3, 4, 3)
    display = (np.array([0, 0], np.int32), np.array([7, 5], np.int32))
    window = (np.array([2, 1], np.int32), np.array([5, 3], np.int32))
    whole = {"displayWindow": display, "dataWindow": display}
    write_parts(
        path,
        depth=({"Z": random_image(6, 8)}, whole),
        beauty=(planes(image), {"displayWindow": display, "dataWindow": window}),
    )
    expected = np.zeros((6, 8, 3), np.float32)
    expected[1:4, 2:6] = image
    np.testing.assert_array_equal(read_image(path)[0], expected)


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


def test_chromaticities_of_the_first_part_hold_for_the_others(tmp_path):
    image = random_image(5, 6, 3)
    write_parts(
        tmp_path / "image.exr",
        depth=({"Z": image[..., 0]}, {"chromaticities": AP0}),
        beauty=(planes(image), {"chromaticities": AP0}),
    )
    read = read_image(tmp_path / "image.exr")[0]
    np.testing.assert_allclose(read, image @ AP0_TO_REC709.T, atol=4 * MATRIX_ERROR)


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


def test_rows_of_tall_tiles_count_before_they_are_read(tmp_path):
    image = np.zeros((2048, 32, 3), np.float32)
    write_tiles(tmp_path / "flat.exr", image, (8, 8))
    write_tiles(tmp_path / "tall.exr", image, (8, 2048))
    rows = image[256:].nbytes
    assert rows < read_free(tmp_path / "tall.exr") - read_free(tmp_path / "flat.exr") < 2 * rows
