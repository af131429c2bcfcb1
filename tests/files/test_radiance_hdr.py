import struct

import numpy as np
import OpenImageIO
import pytest

from jaxprt import require
from jaxprt.files import decode_image, read_image

# Two pixels and the radiance that they stand for: mantissa / 256 * 2^(exponent - 128).
RED, SKY = bytes([128, 64, 32, 129]), bytes([16, 32, 128, 131])
VALUE = {RED: [1.0, 0.5, 0.25], SKY: [0.5, 1.0, 4.0]}
HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"


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
        ValueError, match=r"sky\.hdr must be an undamaged hdr file, got pixels or runs .* 2 lines of 10"
    ):
        read(data, 10, 2)


def test_runs_longer_than_the_picture_take_no_memory():
    with pytest.raises(ValueError, match="do not fill"):
        read(RED + b"".join(map(again, [255, 255, 255, 255])), 10, 2)


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
        with pytest.raises(ValueError, match=r"sky\.hdr must be an undamaged hdr file with a resolution"):
            read(RED, 1, resolution=resolution or b" ")
    for size in (b"-Y 0 +X 4", b"-Y 60000 +X 60000"):
        with pytest.raises(ValueError, match=r"sky\.hdr must have 1 to 268435456 pixels"):
            read(RED, 1, resolution=size)


def test_pictures_that_do_not_fit_into_memory_are_refused(monkeypatch):
    data = coded(blocks(100, 200), "old runs")
    monkeypatch.setattr(require, "available_memory", lambda: 34_000_000)  # 33.55 MB are for blocks.
    with pytest.raises(MemoryError, match=r"sky\.hdr: 200 x 100 pixels"):
        read(data, 200, 100)
