import pathlib
import re
import subprocess

import numpy as np
import pytest

from jaxprt.daylight import Weather, load_weather, sun_directions

MONTHS = [31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31]
YEAR = [
    (month, day, hour) for month in range(1, 13) for day in range(1, MONTHS[month - 1] + 1) for hour in range(1, 25)
]
SITE = "LOCATION,Munich,BY,DEU,IWEC,108660,48.13,11.7,1.0,529.0"


def epw(path, rows=YEAR, site=SITE, value=lambda row: (row[2] * 10, row[2])):
    """Writes an EPW file with irradiance that depends on the hour."""
    head = [site, *["DESIGN CONDITIONS,0"] * 6, "DATA PERIODS,1,1,Data,Sunday,1/1,12/31"]
    line = [
        f"1999,{month},{day},{hour},60,?9,5.0,1.0,70,95000,0,1415,300,99,{direct},{diffuse},0,0,0,0,180,2.0"
        + ",5,5,20.0,2000,9,999999999,10,0.1,0,88,0.2,0.0,1.0"
        for month, day, hour in rows
        for direct, diffuse in [value((month, day, hour))]
    ]
    path.write_text("\n".join([*head, *line, ""]))
    return path


def wea(path, rows=("6 21 12.5 800 100",), longitude=-11.7, time_zone=-15, units=1):
    """Writes a WEA file."""
    head = f"place Munich\nlatitude 48.13\nlongitude {longitude}\ntime_zone {time_zone}\nsite_elevation 529\n"
    path.write_text(f"{head}weather_data_file_units {units}\n" + "\n".join(rows) + "\n")
    return path


def at(month, day, hour, latitude=48.13, longitude=15.0, time_zone=1.0):
    """Weather of single hours."""
    month, day, hour = np.broadcast_arrays(month, day, np.asarray(hour, float))
    month, day, hour = map(np.atleast_1d, (month, day, hour))
    return Weather("here", latitude, longitude, time_zone, month, day, hour, 0.0 * hour, 0.0 * hour)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "weather"


def test_epw_has_hours_by_their_middle_and_east_positive(path):
    weather = load_weather(epw(path))
    assert (weather.place, weather.latitude, weather.longitude, weather.time_zone) == ("Munich", 48.13, 11.7, 1)
    assert weather.hour[:24].tolist() == [hour + 0.5 for hour in range(24)]
    assert weather.direct[:3].tolist() == [10, 20, 30]
    assert weather.diffuse[-1] == 24
    assert (weather.month[-1], weather.day[-1], weather.day_of_year[-1]) == (12, 31, 365)


def test_wea_has_west_positive(path):
    weather = load_weather(wea(path))
    assert (weather.place, weather.longitude, weather.time_zone) == ("Munich", 11.7, 1)
    assert (weather.hour[0], weather.direct[0], weather.diffuse[0]) == (12.5, 800, 100)


def test_epw_equals_its_wea_by_radiance(path):
    program = pathlib.Path(pytest.importorskip("pyradiance").__file__).parent / "bin" / "epw2wea"
    subprocess.run([program, epw(path), path.with_suffix(".wea")], check=True, capture_output=True)
    left, right = load_weather(path), load_weather(path.with_suffix(".wea"))
    for name in ("latitude", "longitude", "time_zone", "month", "day", "hour", "direct", "diffuse"):
        np.testing.assert_allclose(getattr(left, name), getattr(right, name), err_msg=name)


def test_leap_day_is_left_out_with_a_warning(path):
    rows = [*YEAR, *[(2, 29, hour) for hour in range(1, 25)]]
    with pytest.warns(UserWarning, match="24 hours of February 29 are left out"):
        weather = load_weather(epw(path, rows=rows))
    assert len(weather.hour) == 8760


def test_far_time_zone_warns_but_the_date_line_does_not(path):
    with pytest.warns(UserWarning, match=r"UTC-8 is 8\.8 hours from solar time at longitude 11\.7"):
        load_weather(wea(path, time_zone=120))
    load_weather(wea(path, longitude=157, time_zone=-210))


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: path.write_text("hello"), "must start with 'LOCATION,' (EPW) or 'place' (WEA), got 'hello'"),
        (lambda path: path.write_text(""), "got ''"),
        (lambda path: epw(path, rows=YEAR[:30] + YEAR[32:]), "got none for 2: month 1, day 2, hour 7; month 1, day 2"),
        (lambda path: epw(path, rows=[*YEAR, YEAR[0]]), "got 8761 rows"),
        (lambda path: epw(path, value=lambda row: (9999, 0)), "got 8760 of 8760 values that are not, first in month 1"),
        (lambda path: epw(path, site=SITE.replace("48.13", "x")), "could not convert string to float: 'x'"),
        (lambda path: epw(path, site=SITE.replace("48.13", "98")), "the latitude must be at least -90 and at most 90"),
        (lambda path: epw(path, value=lambda row: ("", 0)), "line 9 must have numbers in columns 2, 3, 4, 15, 16"),
        (lambda path: wea(path, rows=["6 21 12.5 800 -1"]), "diffuse horizontal irradiance must be between 0 and 9998"),
        (lambda path: wea(path, rows=["13 1 12.5 0 0"]), "the month must be between 1 and 12"),
        (lambda path: wea(path, rows=["6 31 12.5 0 0"]), "first in month 6, day 31, hour 12.5: 31"),
        (lambda path: wea(path, rows=["nan 1 12.5 0 0"]), "must be finite, got 1 of 5 values that are not"),
        (lambda path: wea(path, units=2), "weather_data_file_units must be 1"),
        (lambda path: path.write_text("place x\nlatitude 1\n"), "longitude, time_zone, site_elevation"),
    ],
)
def test_bad_files_are_refused_by_name(path, write, message):
    write(path)
    with pytest.raises(ValueError, match=re.escape(str(path)) + ".*" + re.escape(message)):
        load_weather(path)


def test_sun_rises_in_the_east_and_is_in_the_south_at_solar_noon():
    morning, noon, evening = sun_directions(at(3, 21, [7.5, 12.0, 17.0]))
    assert morning[0] > 0.8
    assert evening[0] < -0.8
    assert noon[2] > 0.6
    np.testing.assert_allclose(np.linalg.norm([morning, noon, evening], axis=1), 1)


def test_sun_turns_with_longitude_as_with_time():
    np.testing.assert_allclose(
        sun_directions(at(6, 1, 10.0, longitude=15.0)), sun_directions(at(6, 1, 11.0, longitude=0.0)), atol=1e-14
    )


def test_altitudes_at_solstice_noons_are_those_of_the_obliquity():
    noon = sun_directions(at([6, 12], [21, 21], 12.0))
    expected = 90 - 48.13 + np.array([23.44, -23.44])
    np.testing.assert_allclose(np.degrees(np.arcsin(noon[:, 1])), expected, atol=0.1)


def test_sun_is_within_the_stated_error_of_the_almanac():
    """The Astronomical Almanac's low-precision sun, for 2001: mean longitude, anomaly, equation of the center."""
    weather = at(np.array([row[0] for row in YEAR]), np.array([row[1] for row in YEAR]), [row[2] - 0.5 for row in YEAR])
    day = 365.5 + weather.day_of_year - 1 + (weather.hour - 1) / 24
    mean, anomaly = np.radians(280.46 + 0.9856474 * day), np.radians(357.528 + 0.9856003 * day)
    longitude = mean + np.radians(1.915 * np.sin(anomaly) + 0.02 * np.sin(2 * anomaly))
    tilt = np.radians(23.439)
    right = np.arctan2(np.cos(tilt) * np.sin(longitude), np.cos(longitude))
    declination = np.arcsin(np.sin(tilt) * np.sin(longitude))
    angle = np.radians(15 * (weather.hour - 12)) + mean - right
    latitude = np.radians(48.13)
    sun = np.stack(
        [
            -np.cos(declination) * np.sin(angle),
            np.sin(declination) * np.sin(latitude) + np.cos(declination) * np.cos(latitude) * np.cos(angle),
            np.cos(declination) * np.sin(latitude) * np.cos(angle) - np.sin(declination) * np.cos(latitude),
        ],
        axis=-1,
    )
    error = np.degrees(np.arccos(np.clip((sun * sun_directions(weather)).sum(axis=1), -1, 1)))
    assert error.mean() < 0.45
    assert error.max() < 1.25


def test_sun_is_that_of_gendaymtx(path):
    program = pathlib.Path(pytest.importorskip("pyradiance").__file__).parent / "bin" / "gendaymtx"
    rows = [f"{month} {day} {hour} 700 100" for month in range(1, 13) for day in (5, 21) for hour in (10.5, 12.5, 14.5)]
    suns = path.with_suffix(".rad")
    subprocess.run([program, "-d", "-D", suns, wea(path, rows=rows)], check=True, capture_output=True)
    value = [line.split()[1:4] for line in suns.read_text().splitlines() if line.startswith("4 ")]
    east, north, up = np.array(value, float).T
    np.testing.assert_allclose(sun_directions(load_weather(path)), np.stack([east, up, -north], axis=-1), atol=1e-5)
