"""A year of daylight: metrics of the field, the sun's disk against Radiance, and what is written."""

import csv
import datetime
import pathlib
import subprocess

import numpy as np
import pytest

from jaxprt.brdf import Lambert
from jaxprt.daylight import Weather, false_colors, load_rad, picture_matrix, sky_matrix, sun_directions, year
from jaxprt.daylight.pictures import lights
from jaxprt.daylight.sky import EFFICACY
from jaxprt.daylight.year import SUN_RADIUS
from jaxprt.relit import precompute
from jaxprt.scene import Environment, Part, Scene, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import make_mesh

UP = np.array([[0.0, 1.0, 0.0]])


def weather(direct, diffuse, *, days=(80, 172, 355)):
    """Hours of some days in Munich, with one irradiance for all hours in which the sun is up."""
    dates = [datetime.date(2025, 1, 1) + datetime.timedelta(day - 1) for day in days for _ in range(24)]
    hour = np.tile(np.arange(24) + 0.5, len(days))
    month, day = (np.array([getattr(date, name) for date in dates]) for name in ("month", "day"))
    dark = Weather("Munich", 48.1, 11.6, 1.0, month, day, hour, np.zeros(len(hour)), np.zeros(len(hour)))
    up = sun_directions(dark)[:, 1] > 0.05
    return Weather("Munich", 48.1, 11.6, 1.0, month, day, hour, direct * up, diffuse * up)


def plate(height=-5.0):
    """A scene that shades nothing: a plate far below."""
    square = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * 0.1 + [0, height, 0]
    return Scene([Part("plate", make_mesh(square, np.array([[0, 2, 1], [0, 3, 2]])), Lambert([0.2] * 3))])


def test_an_open_sensor_receives_all_light_of_the_sky_and_the_sun():
    hours = weather(600.0, 120.0)
    result = year(plate(), np.zeros((1, 3)), UP, hours, bounces=0, size=32, hours=True, progress=False)
    expected = hours.diffuse + hours.direct * np.maximum(sun_directions(hours)[:, 1], 0)
    np.testing.assert_allclose(np.asarray(result.illuminance)[0] / EFFICACY, expected, rtol=3e-3, atol=0.05)
    np.testing.assert_allclose(result.radiation, expected.sum() / 1000, rtol=3e-3)
    np.testing.assert_allclose(result.factor, 100, rtol=3e-3)


def test_metrics_count_the_occupied_hours():
    hours = weather(0.0, 1000.0 / EFFICACY)
    occupied = hours.diffuse > 0
    result = year(plate(), np.zeros((1, 3)), UP, hours, bounces=0, size=32, occupied=occupied, progress=False)
    assert (result.sda, result.ase, float(result.exposed[0])) == (1, 0, 0)
    np.testing.assert_allclose(result.useful, [[0, 1, 0]], atol=1e-6)
    np.testing.assert_allclose(result.mean, 1000, rtol=3e-3)
    below = year(plate(), np.zeros((1, 3)), -UP, hours, bounces=0, size=32, occupied=occupied, progress=False)
    np.testing.assert_allclose(below.mean, 0.2 * 1000, rtol=3e-2)  # the ground reflects a fifth
    assert below.sda == 0


def test_the_sun_between_slats_is_that_of_radiance(tmp_path):
    binaries = pathlib.Path(pytest.importorskip("pyradiance").__file__).parent / "bin"
    lines = ["void plastic gray 0 0 5 .5 .5 .5 0 0"]
    for number in range(30):
        z, corners = 1 + 0.05 * number, ""
        for x, y, up in ((-2, 0, 0), (2, 0, 0), (2, 0.04, 0.03), (-2, 0.04, 0.03)):
            corners += f" {x} {y} {z + up}"
        lines.append(f"gray polygon slat{number} 0 0 12{corners}")
    (tmp_path / "slats.rad").write_text("\n".join(lines))
    scene, _ = load_rad(str(tmp_path / "slats.rad"))
    hours = weather(700.0, 0.0, days=(172,))
    rng = np.random.default_rng(0)
    position = np.stack([rng.uniform(-1, 1, 200), np.full(200, 0.5), -rng.uniform(0.3, 1.5, 200)], -1)
    result = year(scene, position, np.tile(UP, (200, 1)), hours, bounces=0, size=8, hours=True, progress=False)
    noon = 12
    x, y, z = sun_directions(hours)[noon]
    radiance = 700 / (2 * np.pi * (1 - np.cos(SUN_RADIUS)))
    sun = f"void light sun 0 0 3 {radiance} {radiance} {radiance}\n"
    sun += f"sun source disk 0 0 4 {x} {-z} {y} {2 * np.degrees(SUN_RADIUS)}\n"
    (tmp_path / "sun.rad").write_text(sun)
    tree = subprocess.run([binaries / "oconv", "slats.rad", "sun.rad"], cwd=tmp_path, capture_output=True, check=True)
    (tmp_path / "sun.oct").write_bytes(tree.stdout)
    rows = "".join(f"{p[0]} {-p[2]} {p[1]} 0 0 1\n" for p in np.tile(position, (16, 1)))
    command = [binaries / "rtrace", "-h", "-I+", "-ab", "0", "-dj", "1", "-dt", "0", "sun.oct"]
    traced = subprocess.run(command, cwd=tmp_path, input=rows, capture_output=True, text=True, check=True).stdout
    exact = np.array(traced.split(), float).reshape(16, 200, 3)[..., 0].mean(0)
    mine = np.asarray(result.illuminance)[:, noon] / EFFICACY
    assert 0.2 < exact.mean() / (700 * y) < 0.9
    assert abs(mine.mean() / exact.mean() - 1) < 0.03


def test_results_are_written_as_a_table_and_a_dataset(tmp_path):
    xarray = pytest.importorskip("xarray")
    hours = weather(100.0, 100.0, days=(80,))
    position = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    result = year(plate(), position, np.tile(UP, (2, 1)), hours, bounces=0, size=8, hours=True, progress=False)
    result.write_csv(str(tmp_path / "kept.csv"))
    with open(tmp_path / "kept.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["x"]) for row in rows] == [0, 1]
    np.testing.assert_allclose([float(row["radiation_kwh_m2"]) for row in rows], result.radiation, rtol=1e-5)
    data = result.to_xarray(hours)
    assert isinstance(data, xarray.Dataset)
    assert data.illuminance_lx.dims == ("sensor", "hour")
    assert data.attrs["sda_300_50"] == result.sda


def test_a_picture_shows_the_largest_value_in_the_last_color():
    position = np.array([[x, 0.0, z] for x in np.arange(-1, 1, 0.25) for z in np.arange(-1, 1, 0.25)])
    value = np.where(np.arange(len(position)) % 2, 4.0, 0.0)
    image = false_colors.picture(plate(-0.5), position, np.tile(UP, (len(position), 1)), value, title="test (lx)")
    for color in false_colors.scale(np.array([0.0, 1.0])):
        assert np.mean(np.all(np.abs(image[:480] - color) < 0.02, -1)) > 0.01
    assert np.all((image >= 0) & (image <= 1))


def test_pictures_of_hours_are_sums_of_those_of_patches():
    ball = Scene([Part("ball", builtin.sphere(rings=6, sectors=8), Lambert([0.5] * 3))])
    relit = precompute(ball, system="harmonic", size=8, refine=False, progress=False)
    camera = orbit(relit.mesh, elevation=0.3, width=12, height=12)
    matrix = picture_matrix(relit, camera=camera, samples=1)
    hours = sky_matrix(weather(0.0, 100.0, days=(80,)))[:, 12]
    light = Environment(sum(weight * row.radiance for weight, row in zip(hours, lights(1, size=64), strict=True)))
    np.testing.assert_allclose(np.tensordot(hours, matrix, 1), relit.picture(light, camera, samples=1), rtol=2e-3)


def test_bad_input_is_refused():
    hours = weather(1.0, 1.0, days=(80,))
    with pytest.raises(ValueError, match="occupied must be a mask of the 24 hours with one or more set"):
        year(plate(), np.zeros((1, 3)), UP, hours, occupied=np.zeros(24, bool), progress=False)
