"""Daylight of buildings over a year: weather files, skies, the sun, and what sensors receive."""

from jaxprt.daylight import false_colors
from jaxprt.daylight.files import load_honeybee, load_rad, load_sensors
from jaxprt.daylight.pictures import picture_matrix
from jaxprt.daylight.sky import cie_sky, sky_matrix
from jaxprt.daylight.weather import Weather, load_weather, sun_directions
from jaxprt.daylight.year import Year, year

__all__ = [
    "Weather",
    "Year",
    "cie_sky",
    "false_colors",
    "load_honeybee",
    "load_rad",
    "load_sensors",
    "load_weather",
    "picture_matrix",
    "sky_matrix",
    "sun_directions",
    "year",
]
