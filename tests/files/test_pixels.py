import struct
import zlib

import numpy as np
import OpenImageIO
import PIL.Image
import PIL.ImageCms
import pytest

from jaxprt.files import decode_image, pixels, read_image, write_png
from tests.files.samples import png_chunk

D65, ACES_WHITE = (0.3127, 0.3290), (0.32168, 0.33767)
# Published to four or more digits: the OpenColorIO configuration of ACES (AP0, AP1, with Bradford's adaptation),
# ITU-R BT.2087 (Rec. 2020), Lindbloom and others (P3 with D65; Adobe RGB).
PUBLISHED = {
    "ACES AP0": (
        (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *ACES_WHITE),
        [[2.521686, -1.134131, -0.387555], [-0.276480, 1.372719, -0.096239], [-0.015378, -0.152975, 1.168353]],
    ),
    "ACES AP1": (
        (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *ACES_WHITE),
        [[1.705051, -0.621792, -0.083259], [-0.130256, 1.140805, -0.010548], [-0.024003, -0.128969, 1.152972]],
    ),
    "Rec. 2020": (
        (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65),
        [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]],
    ),
    "P3": (
        (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *D65),
        [[1.2249, -0.2249, 0.0], [-0.0420, 1.0420, 0.0], [-0.0197, -0.0786, 1.0983]],
    ),
    "Adobe RGB": (
        (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65),
        [[1.3984, -0.3984, 0.0], [0.0, 1.0, 0.0], [0.0, -0.0429, 1.0429]],
    ),
}
DIGITS = 1e-4


@pytest.mark.parametrize("name", PUBLISHED)
def test_matrices_to_rec709_are_the_published_ones(name):
    chromaticities, published = PUBLISHED[name]
    matrix = pixels.to_rec709(chromaticities, name)
    np.testing.assert_allclose(matrix, published, atol=DIGITS)
    np.testing.assert_allclose(matrix @ np.ones(3), 1, rtol=1e-12)


def test_xyz_is_a_color_space_too():
    """Linear sRGB of XYZ (IEC 61966-2-1), where white is adapted from equal energy to D65."""
    xyz = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
    published = [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    matrix = pixels.to_rec709((*xyz, 0.3127, 0.3290), "XYZ")
    np.testing.assert_allclose(matrix @ np.diag(1 / np.array([0.9505, 1, 1.0891])), published, atol=1e-3)
    np.testing.assert_allclose(pixels.to_rec709((*xyz, 1 / 3, 1 / 3), "XYZ") @ np.ones(3), 1, rtol=1e-12)


def png(*chunks, bits=8):
    """A picture of 4 x 1 gray pixels of 0, 1/5, 3/5 and 1."""
    level = [0, 51, 153, 255]
    row = bytes([0, *level]) if bits == 8 else b"\0" + struct.pack(">4H", *(257 * value for value in level))
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 1, bits, 0, 0, 0, 0))
    data = png_chunk(b"IDAT", zlib.compress(row))
    return (
        b"\x89PNG\r\n\x1a\n" + header + b"".join(png_chunk(*each) for each in chunks) + data + png_chunk(b"IEND", b"")
    )


LEVEL = np.array([0, 0.2, 0.6, 1])
SRGB = np.array([0, ((0.2 + 0.055) / 1.055) ** 2.4, ((0.6 + 0.055) / 1.055) ** 2.4, 1])


def gamma(value):
    return b"gAMA", struct.pack(">I", value)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("chunks", "expected"),
    [
        ([], SRGB),
        ([gamma(45455)], SRGB),
        ([gamma(100_000)], LEVEL),
        ([gamma(55_556)], LEVEL**1.8),
        ([gamma(50_000)], LEVEL**2),
        ([gamma(100_000), (b"sRGB", b"\0")], SRGB),
        ([gamma(0)], SRGB),
        ([gamma(2**32 - 1)], SRGB),
    ],
    ids=["none", "2.2", "1", "1.8", "2", "overridden", "zero", "absurd"],
)
def test_the_gamma_of_png_files_is_applied(tmp_path, chunks, expected, bits):
    path = tmp_path / "image.png"
    path.write_bytes(png(*chunks, bits=bits))
    np.testing.assert_allclose(read_image(path)[0][0, :, 0], expected, atol=2e-5)
    # glTF 2.0, section 3.8.2: what the file states is ignored.
    np.testing.assert_allclose(decode_image(path.read_bytes(), name="a")[0, :, 0], SRGB, atol=1e-6)
    np.testing.assert_allclose(decode_image(path.read_bytes(), name="a", decoded=False)[0, :, 0], LEVEL, atol=1e-6)


def chromaticities(red, green, blue):
    numbers = [*D65, *red, *green, *blue]
    return b"cHRM", struct.pack(">8I", *(round(1e5 * number) for number in numbers))


P3 = chromaticities((0.68, 0.32), (0.265, 0.69), (0.15, 0.06))
REC709 = chromaticities((0.64, 0.33), (0.3, 0.6), (0.15, 0.06))


@pytest.mark.parametrize(
    ("chunks", "words"),
    [
        ([P3], r"a cHRM chunk with other primaries than sRGB, \[0\.68, 0\.32"),
        ([(b"cICP", bytes([12, 13, 0, 1]))], "a cICP"),
    ],
)
def test_primaries_of_png_files_that_are_not_converted_are_told(tmp_path, chunks, words):
    path = tmp_path / "image.png"
    path.write_bytes(png(*chunks))
    with pytest.warns(UserWarning, match=rf"image\.png has {words}.* is not converted: its values are taken as sRGB"):
        read_image(path)


@pytest.mark.parametrize(
    "chunks", [[REC709], [REC709, gamma(45455)], [P3, (b"sRGB", b"\0")], [(b"cICP", bytes([1, 13, 0, 1]))]]
)
def test_srgb_files_give_no_warning(tmp_path, chunks):
    path = tmp_path / "image.png"
    path.write_bytes(png(*chunks))
    np.testing.assert_allclose(read_image(path)[0][0, :, 0], SRGB, atol=1e-6)


def fixed(*numbers):
    return struct.pack(f">{len(numbers)}i", *(round(65536 * number) for number in numbers))


def icc_profile(colors, curve, space=b"RGB "):
    """A profile of three colors (XYZ, adapted to D50) and one curve."""
    tags = {
        name: b"XYZ \0\0\0\0" + fixed(*color) for name, color in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colors, strict=True)
    }
    tags |= {b"rTRC": curve, b"gTRC": curve, b"bTRC": curve, b"kTRC": curve}
    place, table, data = 132 + 12 * len(tags), b"", b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", place + len(data), len(content))
        data += content
    head = (
        struct.pack(">I4sI4s4s4s", place + len(data), b"test", 0x02400000, b"mntr", space, b"XYZ ")
        + bytes(12)
        + b"acsp"
    )
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + table + data


SRGB_COLORS = ((0.43607, 0.22249, 0.01392), (0.38515, 0.71687, 0.09708), (0.14307, 0.06061, 0.7141))
DISPLAY_P3 = ((0.51512, 0.2412, -0.00105), (0.29198, 0.69225, 0.04189), (0.1571, 0.06657, 0.78407))
ADOBE = ((0.60974, 0.31111, 0.01947), (0.20528, 0.62567, 0.06087), (0.14919, 0.06322, 0.74457))
SRGB_CURVE = b"para\0\0\0\0\0\3\0\0" + fixed(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)
TABLE = b"curv\0\0\0\0" + struct.pack(
    ">I1024H",
    1024,
    *(round(65535 * (x / 12.92 if x < 0.04045 else ((x + 0.055) / 1.055) ** 2.4)) for x in np.linspace(0, 1, 1024)),
)
GAMMA_22 = b"curv\0\0\0\0" + struct.pack(">IH", 1, 563)
LINEAR = b"curv\0\0\0\0\0\0\0\0"


def test_the_profile_that_others_make_for_srgb_is_srgb():
    made = PIL.ImageCms.ImageCmsProfile(PIL.ImageCms.createProfile("sRGB")).tobytes()
    assert not pixels.icc_difference(made, curves=True)


@pytest.mark.parametrize(
    ("profile", "words"),
    [
        (icc_profile(SRGB_COLORS, SRGB_CURVE), ""),
        (icc_profile(SRGB_COLORS, TABLE), ""),
        (icc_profile(SRGB_COLORS, GAMMA_22), ""),
        (icc_profile(((0, 0, 0),) * 3, SRGB_CURVE, b"GRAY"), ""),
        (icc_profile(SRGB_COLORS, LINEAR), "another curve"),
        (icc_profile(((0, 0, 0),) * 3, LINEAR, b"GRAY"), "another curve"),
        (icc_profile(SRGB_COLORS, b"para\0\0\0\0\0\0\0\0" + fixed(1.8)), "another curve"),
        (icc_profile(DISPLAY_P3, SRGB_CURVE), "other primaries"),
        (icc_profile(ADOBE, GAMMA_22), "other primaries"),
        (b"", "other primaries"),
        (icc_profile(SRGB_COLORS, b"para\0\0\0\0\0\1\0\0" + fixed(-30000, 0, 0)), "another curve"),
        (icc_profile(SRGB_COLORS, b"none"), ""),
    ],
)
def test_profiles_are_compared_with_srgb(profile, words):
    difference = pixels.icc_difference(profile, curves=True)
    assert words in difference if words else not difference
    assert "curve" not in pixels.icc_difference(profile, curves=False)


@pytest.mark.parametrize("name", ["image.png", "image.jpg", "image.tif"])
def test_profiles_in_files_that_are_not_converted_are_told(tmp_path, name):
    image = PIL.Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    image.save(tmp_path / name, icc_profile=icc_profile(SRGB_COLORS, SRGB_CURVE))
    expected = read_image(tmp_path / name)[0]
    image.save(tmp_path / name, icc_profile=icc_profile(DISPLAY_P3, SRGB_CURVE))
    with pytest.warns(UserWarning, match=rf"{name} has an ICC profile with other primaries than sRGB, which is not"):
        np.testing.assert_array_equal(read_image(tmp_path / name)[0], expected)
    decode_image((tmp_path / name).read_bytes(), name="a")  # glTF 2.0 demands that it is ignored.


def test_curves_of_floating_point_files_do_not_count(tmp_path):
    path = tmp_path / "image.tif"
    for profile in (icc_profile(SRGB_COLORS, LINEAR), icc_profile(DISPLAY_P3, LINEAR)):
        buffer = OpenImageIO.ImageBuf(np.ones((4, 4, 3), np.float32))
        buffer.specmod().attribute("ICCProfile", f"uint8[{len(profile)}]", np.frombuffer(profile, np.uint8))
        assert buffer.write(str(path))
        if profile.count(fixed(*DISPLAY_P3[0])):
            with pytest.warns(UserWarning, match=r"image\.tif has an ICC .* taken as linear Rec\. 709"):
                read_image(path)
        else:
            np.testing.assert_array_equal(read_image(path)[0], 1)


def test_what_the_package_writes_gives_no_warning(tmp_path):
    image = np.linspace(0, 1, 48, dtype=np.float32).reshape(4, 4, 3)
    write_png(tmp_path / "image.png", image)
    read_image(tmp_path / "image.png")
