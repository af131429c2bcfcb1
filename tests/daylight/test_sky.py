import pathlib
import subprocess

import numpy as np
import pytest

from jaxprt.daylight import Weather, cie_sky, load_weather, sky_matrix, sun_directions
from jaxprt.sphere import patches

# Clear, intermediate, overcast, sunrise, a brightness above the model's bound, and one that the model leaves black.
HOURS = [(6, 21, 10.5, 850, 90), (6, 21, 12.5, 900, 110), (9, 3, 15.5, 350, 250), (3, 20, 8.5, 150, 120)]
HOURS += [(12, 5, 12.5, 0, 80), (10, 10, 13.5, 20, 300), (4, 2, 6.5, 300, 40), (4, 2, 5.5, 0, 12), (6, 1, 4.5, 10, 300)]
HOURS += [(6, 21, 7.5, 50, 5), (3, 18, 17.5, 20, 5)]
SUN = np.array([0.3, 0.6, 0.5]) / np.linalg.norm([0.3, 0.6, 0.5])


def weather(rows=HOURS):
    month, day, hour, direct, diffuse = np.array(rows, float).T
    return Weather("here", 48.13, 11.7, 1.0, month.astype(int), day.astype(int), hour, direct, diffuse)


def gendaymtx(path, subdivision):
    """The sky without the sun by Radiance, of the hours above."""
    program = pathlib.Path(pytest.importorskip("pyradiance").__file__).parent / "bin" / "gendaymtx"
    head = "place here\nlatitude 48.13\nlongitude -11.7\ntime_zone -15\nsite_elevation 0\nweather_data_file_units 1\n"
    path.write_text(head + "".join(f"{' '.join(map(str, row))}\n" for row in HOURS))
    option = ["-m", str(subdivision), "-s", "-O1", "-c", "1", "1", "1", "-od", "-h"]
    output = subprocess.run([program, *option, path], check=True, capture_output=True).stdout
    return np.frombuffer(output).reshape(patches.count(subdivision), len(HOURS), 3)[..., 0]


@pytest.mark.parametrize("subdivision", [1, 2, 4])
def test_sky_is_that_of_gendaymtx_up_to_the_cosine_of_its_irradiance(tmp_path, subdivision):
    expected = gendaymtx(tmp_path / "hours.wea", subdivision)
    matrix = sky_matrix(load_weather(tmp_path / "hours.wea"), subdivision=subdivision)
    # gendaymtx takes the cosine at the center of a patch; so do we here.
    center = patches.centers(subdivision=subdivision)[1:, 1] * patches.solid_angles(subdivision=subdivision)[1:]
    scale = np.array([row[-1] for row in HOURS]) / (center @ matrix[1:])
    np.testing.assert_allclose(matrix[1:] * scale, expected[1:], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(matrix[0], expected[0], rtol=1e-5)
    half_row = np.pi / 4 / (7 * subdivision + 0.5)
    assert ((scale > np.cos(half_row)) & (scale <= 1 + 1e-12)).all()


@pytest.mark.parametrize("subdivision", [1, 3])
def test_horizontal_irradiance_is_the_diffuse_one(subdivision):
    matrix = sky_matrix(weather(), subdivision=subdivision)
    irradiance = patches.projected_solid_angles(subdivision=subdivision)[1:] @ matrix[1:]
    np.testing.assert_allclose(irradiance, weather().diffuse, rtol=1e-12)


def test_ground_reflects_sun_and_sky():
    light = weather()
    irradiance = light.diffuse + light.direct * np.maximum(sun_directions(light)[:, 1], 0)
    np.testing.assert_allclose(sky_matrix(light, ground=0.4)[0], 0.4 / np.pi * irradiance)


def test_night_is_black_and_hours_do_not_depend_on_each_other():
    matrix = sky_matrix(weather([*HOURS, (1, 1, 0.5, 0, 0)]))
    assert not matrix[:, -1].any()
    np.testing.assert_allclose(matrix[:, :-1], sky_matrix(weather()), rtol=1e-12)


def test_clear_sky_is_brightest_around_the_sun_and_overcast_sky_at_the_zenith():
    matrix = sky_matrix(weather(), subdivision=4)[1:]
    sun = patches.index_of(sun_directions(weather()), subdivision=4) - 1
    assert matrix[:, 0].argmax() == sun[0]
    assert matrix[-1, 4] > 1.5 * matrix[0, 4]


def test_weather_without_hours_has_a_sky_without_hours():
    assert sky_matrix(weather(np.zeros((0, 5)))).shape == (146, 0)


@pytest.mark.parametrize("sky_type", range(1, 16))
def test_cie_skies_are_one_at_the_zenith_and_positive(sky_type):
    sky = cie_sky(sky_type, SUN, subdivision=2)
    assert (sky[0], sky[-1]) == (0, 1)
    assert (sky[1:] > 0).all()


def test_cie_sky_does_not_depend_on_the_length_of_the_direction():
    np.testing.assert_allclose(cie_sky(13, 7 * SUN), cie_sky(13, SUN), rtol=1e-12)


def test_uniform_and_overcast_cie_skies_have_their_published_values():
    np.testing.assert_allclose(cie_sky(5, SUN)[1:], 1)
    # Horizon to zenith, and horizontal irradiance, of the overcast sky of Moon and Spencer, 1942: 1 / 3 and 7 pi / 9.
    sky = cie_sky(1, SUN, subdivision=6)
    assert sky[1] == pytest.approx(1 / 3, rel=0.01)
    assert sky @ patches.projected_solid_angles(subdivision=6) == pytest.approx(7 * np.pi / 9, rel=0.01)


def test_clear_cie_sky_is_the_one_of_kittler():
    """CIE 22, 1973; its 0.91 is 1 - 10 exp(-3 pi / 2)."""
    direction = patches.centers()[1:]
    angle, zenith = np.arccos(direction @ SUN), np.arccos(SUN[1])

    def indicatrix(chi):
        return 0.91 + 10 * np.exp(-3 * chi) + 0.45 * np.cos(chi) ** 2

    expected = indicatrix(angle) * (1 - np.exp(-0.32 / direction[:, 1])) / (indicatrix(zenith) * (1 - np.exp(-0.32)))
    np.testing.assert_allclose(cie_sky(12, SUN)[1:], expected, rtol=1e-3)


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="albedo of the ground must be at least 0 and at most 1, got 2"):
        sky_matrix(weather(), ground=2.0)
    with pytest.raises(ValueError, match="between 1 and 15, got 16"):
        cie_sky(16, SUN)
    with pytest.raises(ValueError, match=r"must be above the horizon, got a direction with y = -0"):
        cie_sky(1, -SUN)
