"""Radiance of the sky: the all-weather sky of Perez for measured irradiance, and the standard skies of the CIE."""

import numpy as np
from jaxtyping import Float

from jaxprt import require
from jaxprt.daylight.weather import Weather, sun_directions
from jaxprt.sphere import patches

EFFICACY = 179.0  # lm/W, of white light over the visible spectrum: luminance / radiance (WHTEFFICACY in Radiance)

# Perez, Seals, Michalsky 1993, Solar Energy 50(3), table 1, as in Radiance's gendaymtx.c: a row for each class of
# clearness, with four coefficients for each of a, b, c, d and e.
_CLEARNESS = [1.065, 1.23, 1.5, 1.95, 2.8, 4.5, 6.2]  # upper bounds of the first seven classes
# fmt: off
_PEREZ = np.array([
    1.3525, -0.2576, -0.2690, -1.4366, -0.7670, 0.0007, 1.2734, -0.1233, 2.8000, 0.6004,
    1.2375, 1.0000, 1.8734, 0.6297, 0.9738, 0.2809, 0.0356, -0.1246, -0.5718, 0.9938,
    -1.2219, -0.7730, 1.4148, 1.1016, -0.2054, 0.0367, -3.9128, 0.9156, 6.9750, 0.1774,
    6.4477, -0.1239, -1.5798, -0.5081, -1.7812, 0.1080, 0.2624, 0.0672, -0.2190, -0.4285,
    -1.1000, -0.2515, 0.8952, 0.0156, 0.2782, -0.1812, -4.5000, 1.1766, 24.7219, -13.0812,
    -37.7000, 34.8438, -5.0000, 1.5218, 3.9229, -2.6204, -0.0156, 0.1597, 0.4199, -0.5562,
    -0.5484, -0.6654, -0.2672, 0.7117, 0.7234, -0.6219, -5.6812, 2.6297, 33.3389, -18.3000,
    -62.2500, 52.0781, -3.5000, 0.0016, 1.1477, 0.1062, 0.4659, -0.3296, -0.0876, -0.0329,
    -0.6000, -0.3566, -2.5000, 2.3250, 0.2937, 0.0496, -5.6812, 1.8415, 21.0000, -4.7656,
    -21.5906, 7.2492, -3.5000, -0.1554, 1.4062, 0.3988, 0.0032, 0.0766, -0.0656, -0.1294,
    -1.0156, -0.3670, 1.0078, 1.4051, 0.2875, -0.5328, -3.8500, 3.3750, 14.0000, -0.9999,
    -7.1406, 7.5469, -3.4000, -0.1078, -1.0750, 1.5702, -0.0672, 0.4016, 0.3017, -0.4844,
    -1.0000, 0.0211, 0.5025, -0.5119, -0.3000, 0.1922, 0.7023, -1.6317, 19.0000, -5.0000,
    1.2438, -1.9094, -4.0000, 0.0250, 0.3844, 0.2656, 1.0468, -0.3788, -2.4517, 1.4656,
    -1.0500, 0.0289, 0.4260, 0.3590, -0.3250, 0.1156, 0.7781, 0.0025, 31.0625, -14.5000,
    -46.1148, 55.3750, -7.2312, 0.4050, 13.3500, 0.6234, 1.5000, -0.6426, 1.8564, 0.5636,
]).reshape(8, 5, 4)
# fmt: on
_SOLAR_CONSTANT = 1367.0  # W/m2

# ISO 15469:2004 (CIE S 011/E:2003), table 1: a and b of six gradations, c, d and e of six indicatrices, and those of
# each of the 15 types.
_GRADATION = [(4.0, -0.7), (1.1, -0.8), (0.0, -1.0), (-1.0, -0.55), (-1.0, -0.32), (-1.0, -0.15)]
_INDICATRIX = [(0, -1, 0), (2, -1.5, 0.15), (5, -2.5, 0.3), (10, -3, 0.45), (16, -3, 0.3), (24, -2.8, 0.15)]
_TYPES = [(1, 1), (1, 2), (2, 1), (2, 2), (3, 1), (3, 2), (3, 3), (3, 4), (4, 2), (4, 3), (4, 4), (5, 4), (5, 5)]
_TYPES += [(6, 5), (6, 6)]


def sky_matrix(weather: Weather, *, subdivision: int = 1, ground: float = 0.2) -> Float[np.ndarray, "p h"]:
    """Radiance of the patches of the sky in each hour, without the sun, in W/m2/sr.

    This is the all-weather sky of Perez at the centers of the patches, as in Radiance's `gendaymtx -s -O1 -c 1 1 1`.
    Each hour is scaled so that the sum of radiance times `patches.projected_solid_angles` over the sky is the diffuse
    horizontal irradiance. `gendaymtx` takes the cosine at the center of a patch instead. Its radiance is lower by
    1 - cos(half the height of a row), which is 0.55 % for subdivision 1, 0.15 % for 2 and 0.04 % for 4.

    As in Radiance, the sun of the model is kept between the horizon and 87 degrees of altitude, brightness between 0.01
    and 0.6, and negative radiance becomes 0. Where this leaves no light, the sky is uniform.

    Args:
        weather: Irradiance by sun and sky.
        subdivision: Number of parts into which the edges of Tregenza's patches are divided, from 1 to 6.
        ground: Albedo of the ground, from 0 to 1. The ground, patch 0, is matte and is lit by sun and sky.

    Returns:
        Radiance, by patch and hour. Hours without diffuse irradiance have a black sky.

    Raises:
        ValueError: `subdivision` or `ground` is out of range.

    Reference: Perez, Seals, Michalsky 1993, All-weather model for sky luminance distribution, equations 1 to 8;
    Perez et al. 1990, Modeling daylight availability and irradiance components, equations 1 and 2.
    """
    weather = require.kind("the weather", weather, Weather, source="load_weather")
    require.number("the albedo of the ground", ground, 0.0, high=1.0)
    direction, area = patches.centers(subdivision=subdivision), patches.projected_solid_angles(subdivision=subdivision)
    up = sun_directions(weather)[:, 1]
    radiance = np.zeros((len(direction), len(up)))
    radiance[0] = ground / np.pi * (weather.diffuse + weather.direct * np.maximum(up, 0))
    lit = np.flatnonzero(weather.diffuse)
    sun, parameter = _model_sun(weather), _perez(weather)
    for hour in np.array_split(lit, len(lit) // 256 + 1):  # for the memory of temporaries
        sky = np.maximum(_relative(direction[1:], sun[hour], 1, *parameter[:, hour]), 0)
        sky = np.where(sky.any(axis=0), sky, 1)
        radiance[1:, hour] = sky * (weather.diffuse[hour] / (area[1:] @ sky))
    return radiance


def cie_sky(sky_type: int, sun_direction: Float[np.ndarray, " 3"], *, subdivision: int = 1) -> Float[np.ndarray, " p"]:
    """Radiance of the patches of a CIE standard general sky, relative to the zenith, at the centers of patches.

    Type 1 is the overcast sky, 5 the uniform sky, 12 the clear sky, and 13 the clear sky of polluted air.

    Args:
        sky_type: From 1 to 15.
        sun_direction: Direction to the sun, of any length, above the horizon. Types 1, 3 and 5 do not depend on it.
        subdivision: Number of parts into which the edges of Tregenza's patches are divided, from 1 to 6.

    Returns:
        Relative radiance; 1 at the zenith, and 0 for patch 0, the ground.

    Raises:
        ValueError: The type is not between 1 and 15, or the sun is not above the horizon.

    Reference: ISO 15469:2004, CIE S 011/E:2003, equations 1 to 8.
    """
    require.count("the type of a CIE sky", sky_type, least=1, most=len(_TYPES))
    require.finite("the direction to the sun", sun_direction)
    sun = np.asarray(sun_direction, np.float64)
    require.array("the direction to the sun", sun, "3")
    if sun[1] <= 0:
        raise ValueError(f"the sun must be above the horizon, got a direction with y = {sun[1]:g}")
    gradation, indicatrix = _TYPES[sky_type - 1]
    c, d, e = _INDICATRIX[indicatrix - 1]
    direction = patches.centers(subdivision=subdivision)
    base = 1 - c * np.exp(d * np.pi / 2)
    sky = _relative(direction[1:], sun[None] / np.linalg.norm(sun), base, *_GRADATION[gradation - 1], c, d, e)[:, 0]
    return np.append(0, sky / sky[-1])


def _relative(direction, sun, base, a, b, c, d, e) -> Float[np.ndarray, "p h"]:
    """The form that both skies share: (1 + a exp(b / cos Z)) (base + c exp(d chi) + e cos^2 chi)."""
    cosine = np.clip(direction @ sun.T, -1, 1)
    return (1 + a * np.exp(b / direction[:, 1:2])) * (base + c * np.exp(d * np.arccos(cosine)) + e * cosine**2)


def _model_sun(weather: Weather) -> Float[np.ndarray, "h 3"]:
    """The sun of the model, between the horizon and 87 degrees, at the azimuth of the sun."""
    x, y, z = sun_directions(weather).T
    up = np.clip(y, 0, np.sin(np.radians(87)))
    scale = np.sqrt(1 - up**2) / np.maximum(np.hypot(x, z), 1e-12)
    return np.stack([x * scale, up, z * scale], axis=-1)


def _perez(weather: Weather) -> Float[np.ndarray, "5 h"]:
    """The parameters a to e of the sky of Perez: equations 6 to 8, with the bounds of `gendaymtx`."""
    up = _model_sun(weather)[:, 1]
    zenith = np.arccos(up)
    diffuse = np.maximum(weather.diffuse, 1e-4)
    bent = 1.041 * zenith**3
    clearness = 1 + weather.direct / diffuse / (1 + bent)
    # Air mass of Kasten 1966, and eccentricity of the orbit of Spencer 1971.
    mass = 1 / (up + 0.15 * (93.885 - np.degrees(zenith)) ** -1.253)
    angle = 2 * np.pi / 365 * (weather.day_of_year - 1)
    orbit = 1.00011 + 0.034221 * np.cos(angle) + 0.00128 * np.sin(angle)
    orbit += 0.000719 * np.cos(2 * angle) + 0.000077 * np.sin(2 * angle)
    brightness = np.clip(diffuse * mass / (_SOLAR_CONSTANT * orbit), 0.01, 0.6)
    between = (clearness > 1.065) & (clearness < 2.8)
    brightness = np.where(between, np.maximum(brightness, 0.2), brightness)

    index = np.searchsorted(_CLEARNESS, clearness, side="right")
    x = np.moveaxis(_PEREZ[index], 0, -1)  # [5, 4, hour]
    a, b, c, d, e = x[:, 0] + x[:, 1] * zenith + brightness * (x[:, 2] + x[:, 3] * zenith)
    (c0, c1, c2, c3), (d0, d1, d2, d3) = x[2], x[3]
    overcast = index == 0
    base = np.where(overcast, brightness * (c0 + c1 * zenith), 1)
    c = np.where(overcast, np.exp(base**c2) - c3, c)
    d = np.where(overcast, d2 + brightness * d3 - np.exp(brightness * (d0 + d1 * zenith)), d)
    return np.stack([a, b, c, d, e])
