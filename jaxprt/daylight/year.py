"""Daylight of sensors over a year: the light of the sky by a matrix, and that of the sun by rays to its disk."""

import dataclasses
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.daylight.sky import EFFICACY, sky_matrix
from jaxprt.daylight.weather import Weather, sun_directions
from jaxprt.files import outputs
from jaxprt.scene import Scene
from jaxprt.sensors.bases import Patches
from jaxprt.sensors.build import PointJob, prepared, transport
from jaxprt.sensors.matrix import PointTransport
from jaxprt.sphere import patches
from jaxprt.visibility import blocks
from jaxprt.visibility.blocks import Progress

SUN_RADIUS = np.deg2rad(0.2665)  # of the disk, in radians
_PLACES = 16  # on the disk of the sun
_RAYS = 4  # from each sensor to each position of the sun
_BLOCK = 64  # sensors that a thread computes at a time
ENOUGH, GLARE, USEFUL = 300.0, 1000.0, (100.0, 3000.0)  # lux
AUTONOMOUS, EXPOSED = 0.5, 250.0  # share of the occupied hours of sDA, and hours of ASE


@dataclasses.dataclass(frozen=True)
class Year:
    """What each sensor receives in a year.

    Attributes:
        position: Positions of the sensors, in the coordinates of the file.
        normal: Directions that they face.
        radiation: Energy that arrives in the year, in kWh/m2.
        mean: Mean illuminance of the occupied hours, in lx.
        autonomy: Share of the occupied hours with at least 300 lx.
        useful: Shares of the occupied hours below 100 lx, from 100 to 3000 lx, and above: useful daylight illuminance.
        exposed: Occupied hours with at least 1000 lx of the sun alone, without reflected light.
        factor: Daylight factor: illuminance under the traditional overcast sky of CIE (that of `gensky -c`) relative to
            that of the open ground, in %.
        error: Relative L2 error of the matrix of the sky; see `jaxprt.sensors.PointTransport`.
        illuminance: Illuminance of each hour in lx; None unless it was asked for.
    """

    position: Float[np.ndarray, "p 3"]
    normal: Float[np.ndarray, "p 3"]
    radiation: Float[np.ndarray, " p"]
    mean: Float[np.ndarray, " p"]
    autonomy: Float[np.ndarray, " p"]
    useful: Float[np.ndarray, "p 3"]
    exposed: Float[np.ndarray, " p"]
    factor: Float[np.ndarray, " p"]
    error: float
    illuminance: Float32[np.ndarray, "p h"] | None = None

    @property
    def sda(self) -> float:
        """Spatial daylight autonomy sDA 300/50%: share of the sensors with 300 lx in half of the occupied hours."""
        return float(np.mean(self.autonomy >= AUTONOMOUS))

    @property
    def ase(self) -> float:
        """Annual sunlight exposure ASE 1000/250h: share of the sensors with more than 250 hours of such sun."""
        return float(np.mean(self.exposed > EXPOSED))

    @property
    def columns(self) -> dict[str, Float[np.ndarray, " p"]]:
        """The results by their names with units, one array for each."""
        low, middle, high = self.useful.T
        return {
            "radiation_kwh_m2": self.radiation,
            "mean_illuminance_lx": self.mean,
            "daylight_autonomy_300": self.autonomy,
            "udi_below_100": low,
            "udi_100_3000": middle,
            "udi_above_3000": high,
            "sun_hours_1000": self.exposed,
            "daylight_factor_percent": self.factor,
        }

    def write_csv(self, path: str) -> None:
        """Writes a table with one row for each sensor: position, normal, and the results."""
        place = dict(
            zip(("x", "y", "z", "nx", "ny", "nz"), np.concatenate([self.position, self.normal], 1).T, strict=True)
        )
        table = place | self.columns
        rows = [",".join(f"{value:.6g}" for value in row) for row in zip(*table.values(), strict=True)]
        outputs.write(path, "\n".join([",".join(table), *rows, ""]))

    def to_xarray(self, weather: Weather | None = None) -> Any:
        """The results as an `xarray.Dataset` with names and coordinates, for which xarray must be installed."""
        import xarray  # pyright: ignore[reportMissingImports]  # an extra of the user's

        along = {name: ("sensor", self.position[:, axis]) for axis, name in enumerate("xyz")}
        data: dict[str, Any] = {name: ("sensor", value) for name, value in self.columns.items()}
        if self.illuminance is not None and weather is not None:
            along |= {name: ("hour", getattr(weather, name)) for name in ("month", "day", "hour")}
            data["illuminance_lx"] = (("sensor", "hour"), self.illuminance)
        return xarray.Dataset(data, along, {"sda_300_50": self.sda, "ase_1000_250": self.ase})


def year(
    scene: Scene,
    points: Float[np.ndarray, "p 3"],
    normals: Float[np.ndarray, "p 3"],
    weather: Weather,
    *,
    bounces: int = 2,
    glass: Mapping[str, float] | None = None,
    subdivision: int = 1,
    ground: float = 0.2,
    occupied: Bool[np.ndarray, " h"] | None = None,
    hours: bool = False,
    size: int = 64,
    path: str | None = None,
    executor: Executor | None = None,
    progress: Progress = True,
) -> Year:
    """Daylight of sensors over the hours of a weather file.

    The sky is that of Perez, one radiance for each patch. The sun is a disk at its position in each hour, to which rays
    go from each sensor, so that a blind's slats cut it right; what surfaces reflect of it comes from its patch.

    Args:
        scene: The building and what stands around it. +y is up, +x is east and -z is north.
        points: Positions of the sensors in the coordinates of the scene's file.
        normals: Directions that they face.
        weather: The weather, from `load_weather`.
        bounces: How often surfaces reflect light before it arrives; see `jaxprt.transport`.
        glass: Transmissivity of the parts that are panes; see `jaxprt.transport`.
        subdivision: Patches of the sky: 1 for 145 (Tregenza), 2 to 6 for finer ones (Reinhart).
        ground: Albedo of the ground around the scene, which lies below the horizon.
        occupied: Hours that count for the metrics; those from 8 to 18 o'clock of each day if None.
        hours: Whether to keep the illuminance of every hour.
        size: Resolution of the rays; see `jaxprt.transport`.
        path: Folder of finished work; see `jaxprt.transport`.
        executor: Where the matrix is computed; see `jaxprt.transport`.
        progress: Whether to show progress bars, or a function; see `jaxprt.Run`.

    Raises:
        ValueError: The hours that count are no mask of the hours of the weather, or for the reasons that
            `jaxprt.transport` gives.
    """
    require.kind("the weather", weather, Weather, source="jaxprt.daylight.load_weather")
    count = len(weather.hour)
    occupied = (weather.hour > 8) & (weather.hour < 18) if occupied is None else np.asarray(occupied)
    if occupied.shape != (count,) or occupied.dtype != bool or not occupied.any():
        raise ValueError(f"occupied must be a mask of the {count} hours with one or more set, got {occupied.shape}")
    if hours:
        require.memory("the illuminance of every hour", 4 * len(points) * count, "leave out hours=True")
    basis = Patches(subdivision)
    options = {"basis": basis, "glass": glass, "size": size}
    received = transport(
        scene, points, normals, bounces=bounces, path=path, executor=executor, progress=progress, **options
    ).luminance()
    job, _ = prepared(scene, points, normals, **options)
    sky, sun = sky_matrix(weather, subdivision=subdivision, ground=ground), _Sun.of(weather, subdivision)
    light = jnp.asarray(sky, jnp.float32), jnp.asarray(sky + sun.in_patches(len(sky), count), jnp.float32)
    overcast = np.asarray(_overcast(subdivision, ground), np.float32)
    factor = 100 * np.asarray(received.apply(overcast)) / _horizontal(overcast, subdivision)

    def of_block(part: slice) -> tuple[np.ndarray, ...]:
        return _summed(
            np.array(_irradiance(received.rows(part), *light)), _by_sun(job, sun, part), sun, occupied, hours
        )

    starts = range(0, job.vertices, _BLOCK)
    slices = [slice(first, min(first + _BLOCK, job.vertices)) for first in starts]
    with ThreadPoolExecutor(blocks.cores()) as pool:
        results = list(_tracked(pool.map(of_block, slices), len(slices), progress))
    radiation, mean, autonomy, useful, exposed, *each_hour = map(np.concatenate, zip(*results, strict=True))
    place = np.asarray(points, np.float64), job.frame[:, 2].astype(np.float64)
    return Year(
        *place, radiation, mean, autonomy, useful, exposed, factor, received.error, each_hour[0] if hours else None
    )


def _tracked(results: Iterator, count: int, progress: Progress) -> Iterator:
    with blocks.ProgressBar(progress, "hours", total=count, unit="block") as bar:
        for result in results:
            yield result
            bar.update(1)


@dataclasses.dataclass(frozen=True)
class _Sun:
    """The hours in which the sun is up: their numbers, directions of places on the disk, irradiance, and patch."""

    hour: np.ndarray
    way: Float32[np.ndarray, "s n 3"]
    center: Float32[np.ndarray, "s 3"]
    normal_irradiance: Float32[np.ndarray, " s"]
    patch: np.ndarray
    solid_angle: np.ndarray

    @classmethod
    def of(cls, weather: Weather, subdivision: int) -> "_Sun":
        direction = sun_directions(weather)
        hour = np.flatnonzero((direction[:, 1] > 0) & (weather.direct > 0))
        center = direction[hour]
        side = np.cross(center, [0.0, 0.0, 1.0])
        side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
        other = np.cross(center, side)
        number = np.arange(_PLACES)
        radius, angle = SUN_RADIUS * np.sqrt((number + 0.5) / _PLACES), np.pi * (3 - np.sqrt(5)) * number
        around = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
        way = center[:, None] + around[0, :, None] * side[:, None] + around[1, :, None] * other[:, None]
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        patch = patches.index_of(center, subdivision=subdivision)
        area = patches.solid_angles(subdivision=subdivision)[patch]
        return cls(
            hour,
            way.astype(np.float32),
            center.astype(np.float32),
            np.asarray(weather.direct, np.float32)[hour],
            patch,
            area,
        )

    def in_patches(self, count: int, hours: int) -> Float[np.ndarray, "p h"]:
        """The sun's radiance, spread over its patch."""
        result = np.zeros((count, hours))
        result[self.patch, self.hour] = self.normal_irradiance / self.solid_angle
        return result


def _overcast(subdivision: int, ground: float) -> Float[np.ndarray, " p"]:
    """The traditional overcast sky of CIE (Moon and Spencer 1942) over a ground that it lights."""
    sky = (1 + 2 * patches.centers(subdivision=subdivision)[:, 1]) / 3
    sky[0] = ground / np.pi * _horizontal(sky, subdivision)
    return sky


def _horizontal(sky: Float[np.ndarray, " p"], subdivision: int) -> float:
    """Irradiance of the open ground."""
    return float(np.sum((sky * patches.projected_solid_angles(subdivision=subdivision))[1:]))


@jit
def _irradiance(received: PointTransport, sky: Array, all_light: Array) -> Float[Array, "b h"]:
    """Irradiance by the sky and by reflected light, of which the sun is a part."""
    direct: Any = received.direct
    reflected: Any = received.reflected
    return direct @ sky if reflected is None else direct @ sky + reflected @ all_light


def _by_sun(job: PointJob, sun: _Sun, part: slice) -> Float32[np.ndarray, "b s"]:
    """Irradiance by the sun's disk in the hours in which it is up."""
    start, normal = job.start[part], job.frame[part, 2]
    cosine = np.maximum(normal @ sun.center.T, 0)
    point, place = np.nonzero(cosine)
    share = np.zeros(len(point), np.float32)
    for ray in range(_RAYS):  # other places of the disk for other sensors and hours
        way = _PLACES * place + (_RAYS * ray + point + part.start + 5 * place) % _PLACES
        share += job.passed(start, sun.way.reshape(-1, 3), point, way) / np.float32(_RAYS)
    lit = np.flatnonzero(share)
    share[lit] *= job.through(start[point[lit]], sun.center[place[lit]])
    cosine[point, place] *= share * sun.normal_irradiance[place]
    return cosine


def _summed(irradiance: np.ndarray, by_sun: np.ndarray, sun: _Sun, occupied: np.ndarray, hours: bool) -> tuple:
    """The results of a block of sensors."""
    irradiance[:, sun.hour] += by_sun
    lux = EFFICACY * irradiance[:, occupied]
    useful = [np.mean(lux < USEFUL[0], 1), None, np.mean(lux > USEFUL[1], 1)]
    useful[1] = 1 - useful[0] - useful[2]
    exposed = (EFFICACY * by_sun[:, occupied[sun.hour]] >= GLARE).sum(1).astype(np.float64)
    metrics = irradiance.sum(1, dtype=np.float64) / 1000, lux.mean(1), np.mean(lux >= ENOUGH, 1)
    result = (*metrics, np.stack(useful, -1), exposed)
    return (*result, (EFFICACY * irradiance).astype(np.float32)) if hours else result
