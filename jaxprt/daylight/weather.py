"""Hourly weather of a place, from EnergyPlus (EPW) and Radiance (WEA) files, and the positions of the sun."""

import dataclasses
import os
import pathlib
import warnings

import numpy as np
from jaxtyping import Float, Int

from jaxprt import require

_MONTHS = np.array([31, 28, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31])
_EPW_HEADER = 8  # lines
_MISSING = 9999  # stands for a missing value in weather files
_FARTHEST = 3  # hours between a time zone and solar time; only the westernmost places of China have more


@dataclasses.dataclass(frozen=True, eq=False)
class Weather:
    """Solar irradiance of a place, hour by hour, in a year of 365 days.

    Attributes:
        place: Name of the place.
        latitude: In degrees, north positive.
        longitude: In degrees, east positive.
        time_zone: Local standard time minus UTC, in hours.
        month: From 1 to 12.
        day: Day of the month, from 1.
        hour: Local standard time in the middle of the interval, in decimal hours.
        direct: Irradiance by the sun of a surface that faces it (direct normal), in W/m2.
        diffuse: Irradiance of a horizontal surface by the sky without the sun, in W/m2.

    Raises:
        TypeError: A value is not a number.
        ValueError: A value is out of its range, or the arrays are of different lengths.
    """

    place: str
    latitude: float
    longitude: float
    time_zone: float
    month: Int[np.ndarray, " h"]
    day: Int[np.ndarray, " h"]
    hour: Float[np.ndarray, " h"]
    direct: Float[np.ndarray, " h"]
    diffuse: Float[np.ndarray, " h"]

    def __post_init__(self):
        require.number("the latitude", self.latitude, -90.0, high=90.0)
        require.number("the longitude", self.longitude, -180.0, high=180.0)
        require.number("the time zone", self.time_zone, -14.0, high=14.0)
        for name, dtype in {"month": int, "day": int, "hour": float, "direct": float, "diffuse": float}.items():
            require.array(f"the {name}", np.asarray(getattr(self, name)), "h")
            require.finite(f"the {name}", getattr(self, name))
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype))
            require.length(f"hours of {name}", getattr(self, name), len(self.month))
        self._check("month", self.month, 1, 12, "between 1 and 12")
        self._check("day", self.day, 1, _MONTHS[self.month - 1], "a day of the month, without February 29")
        self._check("hour", self.hour, 0, 24, "between 0 and 24")
        limits = f"between 0 and {_MISSING - 1} W/m2 ({_MISSING} stands for a missing value)"
        self._check("direct normal irradiance", self.direct, 0, _MISSING - 1, limits)
        self._check("diffuse horizontal irradiance", self.diffuse, 0, _MISSING - 1, limits)

    @property
    def day_of_year(self) -> Int[np.ndarray, " h"]:
        """From 1 to 365."""
        return (np.cumsum(_MONTHS) - _MONTHS)[self.month - 1] + self.day

    def _check(self, name, value, low, high, limits) -> None:
        """Refuses values out of a range, naming the first one's date."""
        wrong = np.flatnonzero((value < low) | (value > high))
        if len(wrong):
            date = f"month {self.month[wrong[0]]}, day {self.day[wrong[0]]}, hour {self.hour[wrong[0]]:g}"
            raise ValueError(
                f"the {name} must be {limits}, got {len(wrong)} of {len(value)} values that are not, first in {date}: "
                f"{value[wrong[0]]:g}"
            )


def load_weather(path: str | os.PathLike) -> Weather:
    """Reads a weather file: EnergyPlus (EPW), with all 8760 hours, or Radiance (WEA), with any hours.

    Hours of EPW are numbered by their ends, 1 to 24, so 0.5 is subtracted. WEA has decimal hours, and counts longitude
    and time zone positive to the west, which is converted. February 29 is left out with a warning.

    Args:
        path: The file. Its first line tells the format: "LOCATION," for EPW, "place" for WEA.

    Raises:
        ValueError: The file is neither, or hours are missing, or values are missing, negative or out of range.
    """
    require.path("the weather file", path)
    line = pathlib.Path(path).read_text("utf-8-sig", errors="replace").splitlines() or [""]
    try:
        if line[0].upper().startswith("LOCATION,"):
            site, column = _epw(line)
        elif line[0].startswith("place "):
            site, column = _wea(line)
        else:
            raise ValueError(f"the first line must start with 'LOCATION,' (EPW) or 'place' (WEA), got {line[0][:40]!r}")
        require.finite("the numbers of the table", column)
        leap = (column[0] == 2) & (column[1] == 29)
        if leap.any():
            warnings.warn(f"{path}: {leap.sum()} hours of February 29 are left out", stacklevel=2)
        month, day, hour, direct, diffuse = column[:, ~leap]
        weather = Weather(*site, month.astype(int), day.astype(int), hour, direct, diffuse)
        if line[0][0] in "Ll":
            _require_whole_year(weather)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    difference = (weather.time_zone - weather.longitude / 15 + 12) % 24 - 12
    if abs(difference) > _FARTHEST:
        warnings.warn(
            f"{path}: time zone UTC{weather.time_zone:+g} is {abs(difference):.1f} hours from solar time at "
            f"longitude {weather.longitude:g} degrees east: check their signs",
            stacklevel=2,
        )
    return weather


def _epw(line: list[str]) -> tuple[tuple[str, float, float, float], Float[np.ndarray, "5 h"]]:
    """Site, and month, day, hour, direct and diffuse irradiance of an EPW file."""
    head = line[0].split(",")
    if len(head) < 9:
        raise ValueError(f"LOCATION must have 9 values after it, got {len(head) - 1}")
    latitude, longitude, time_zone = (float(value) for value in head[6:9])
    column = _numbers(line, _EPW_HEADER, ",", [1, 2, 3, 14, 15])
    return (head[1].strip(), latitude, longitude, time_zone), column - np.array([[0, 0, 0.5, 0, 0]]).T


def _wea(line: list[str]) -> tuple[tuple[str, float, float, float], Float[np.ndarray, "5 h"]]:
    """The same of a WEA file."""
    names = ["latitude", "longitude", "time_zone", "site_elevation", "weather_data_file_units"]
    head = dict(text.split(maxsplit=1) for text in line[: len(names) + 1] if len(text.split()) > 1)
    missing = [name for name in names if name not in head]
    if missing:
        raise ValueError(f"lines 2 to 6 must be {', '.join(names)}, got no {', '.join(missing)}")
    latitude, west, meridian, _, units = (float(head[name]) for name in names)
    if units != 1:
        raise ValueError(
            f"weather_data_file_units must be 1 (direct normal and diffuse horizontal W/m2), got {units:g}"
        )
    return (head.get("place", "").strip(), latitude, -west, -meridian / 15), _numbers(
        line, len(names) + 1, None, range(5)
    )


def _numbers(line: list[str], start: int, separator: str | None, index) -> Float[np.ndarray, "5 h"]:
    """Columns of the table that starts at a line."""
    row = []
    for number, text in enumerate(line[start:], start + 1):
        if text.strip():
            value = text.split(separator)
            try:
                row.append([float(value[column]) for column in index])
            except (ValueError, IndexError):
                names = ", ".join(str(column + 1) for column in index)
                raise ValueError(f"line {number} must have numbers in columns {names}, got {text[:60]!r}") from None
    return np.array(row, float).reshape(-1, 5).T


def _require_whole_year(weather: Weather) -> None:
    """Refuses weather that lacks hours of the year or has some twice."""
    hours = list(zip(weather.month.tolist(), weather.day.tolist(), weather.hour.tolist(), strict=True))
    year = [
        (month, day, hour + 0.5)
        for month in range(1, 13)
        for day in range(1, _MONTHS[month - 1] + 1)
        for hour in range(24)
    ]
    missing = sorted(set(year) - set(hours))
    if missing:
        dates = "; ".join(f"month {month}, day {day}, hour {hour + 0.5:g}" for month, day, hour in missing[:3])
        more = ", ..." * (len(missing) > 3)
        raise ValueError(f"all 8760 hours of the year are required, got none for {len(missing)}: {dates}{more}")
    if len(hours) > len(year):
        raise ValueError(f"one row for each of the 8760 hours of the year is required, got {len(hours)} rows")


def sun_directions(weather: Weather) -> Float[np.ndarray, "h 3"]:
    """Unit directions to the sun, in a world where +x is east, +y up and -z north. They may be below the horizon.

    Declination and equation of time are the approximations of Radiance's `gendaymtx` (sun.c of 2019; the equation of
    time is that of the IES Lighting Handbook), so the directions are those of `gendaymtx`. They depend on the day
    alone. They deviate from the sun of the Astronomical Almanac by 0.4 degrees on average and by up to 1.2.
    Refraction is neglected.
    """
    day = weather.day_of_year
    declination = 0.4093 * np.sin(2 * np.pi / 365 * (day - 81))
    equation = 0.170 * np.sin(4 * np.pi / 373 * (day - 80)) - 0.129 * np.sin(2 * np.pi / 355 * (day - 8))
    solar = weather.hour + equation + weather.longitude / 15 - weather.time_zone
    angle, latitude = (solar - 12) * np.pi / 12, np.radians(weather.latitude)
    axial, radial, level = np.sin(declination), np.cos(declination) * np.cos(angle), np.cos(declination) * np.sin(angle)
    up = axial * np.sin(latitude) + radial * np.cos(latitude)
    north = axial * np.cos(latitude) - radial * np.sin(latitude)
    return np.stack([-level, up, -north], axis=-1)
