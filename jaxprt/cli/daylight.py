"""`jaxprt daylight`: what sensors of a building receive in a year."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np

from jaxprt import files
from jaxprt.cli import inputs, options
from jaxprt.daylight import false_colors
from jaxprt.daylight import files as buildings
from jaxprt.daylight.weather import load_weather
from jaxprt.daylight.year import Year, year
from jaxprt.scene import Scene
from jaxprt.visibility import Shard, UnfinishedError
from jaxprt.visibility.blocks import fingerprint

_WEATHER = (".epw", ".wea")
_SENSORS = ".pts"
_RADIANCE = ".rad", ".mat"
_LARGE = 3000.0  # of the file's units: a model in millimeters, or a town


class _Share(click.ParamType):
    """A part of a job array, as 2/8."""

    name = "i/n"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses both numbers."""
        try:
            number, count = map(int, str(value).split("/"))
            return Shard(number, count)
        except ValueError as error:
            self.fail(f"must be a part such as 2/8, got {value!r}: {error}", param, ctx)


class _Glass(click.ParamType):
    """Transmissivity of a part."""

    name = "part=transmissivity"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parses the name and the number."""
        name, _, number = str(value).rpartition("=")
        try:
            return name, float(number)
        except ValueError:
            self.fail(f"must be a part and its transmissivity, such as window=.88, got {value!r}", param, ctx)


@options.command(
    "daylight",
    options.FILES,
    Building=[
        *options.options_of(inputs.scene, up=click.Choice(list(inputs.UPRIGHT))),
        {"bounces": (options.Range(0), 2), "glass": (_Glass(), ())},
        {"ground": (options.Range(0.0, 1.0, kind=float, name="ALBEDO"), 0.2)},
    ],
    Accuracy=[{"subdivision": (options.Range(1, 6), 1), "rays": (options.Range(8, 512), 64)}],
    Output=[options.folder("Folder of the table, the pictures and finished work.", default="daylight")],
    Work=[{"part": (_Share(),)}, options.JSON],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Daylight of sensors in a building over the year of a weather file.

    FILEs are a building (OBJ, glTF, Radiance's .rad and .mat, or a folder of honeybee), sensors (.pts; a folder of
    honeybee has its own) and weather (.epw or .wea). +y is up, +x east and -z north; files of Radiance are turned.
    Light of the sky comes by a matrix, the sun by rays to its disk in each hour. Surfaces reflect diffusely. Not
    modelled: blinds that move, light that glass or venetian systems scatter (Klems BSDFs).

    \b
    Examples:
      jaxprt daylight room.rad materials.mat city.epw grid.pts
      jaxprt daylight model.obj city.epw facade.pts --glass window=.88 --bounces 1
      jaxprt daylight honeybee_folder city.epw --part 2/8 --output shared

    Options:
        bounces: How often surfaces reflect light before it arrives.
        glass: Transmissivity at normal incidence of a part that is a pane. May be given for several parts.
        ground: Albedo of the ground around the building.
        subdivision: Patches of the sky: 1 for Tregenza's 145, 2 to 6 for Reinhart's finer ones.
        rays: Texels along the edge of a cube through whose middles rays go from each sensor.
        part: Part of a job array that shares the folder. The last one, or a call without a part, gives the results.
    """  # noqa: D301
    scene, glass, grids, weather_file = _read(chosen.files, chosen.up)
    glass |= dict(chosen.glass)
    weather = load_weather(str(weather_file))
    options.make_folder(chosen.output)
    place = np.asarray(scene.mesh.position, np.float64) + np.asarray(scene.mesh.origin)
    size = float(np.linalg.norm(np.ptp(place, 0)))
    if size > _LARGE:
        click.echo(f"Warning: the model is {size:.0f} meters large; are its units millimeters?", err=True)
    results = {}
    for name, (position, normal) in grids.items():
        off = np.any((position < place.min(0) - size) | (position > place.max(0) + size), 1).sum()
        if off:
            told = f"{off} of {len(position)} sensors of {name} are farther from the model than its size"
            click.echo(f"Warning: {told}: do units, axes and coordinates agree?", err=True)
        setting = np.array([chosen.bounces, chosen.subdivision, chosen.rays, *glass.values()])
        key = fingerprint(position, normal, place, np.asarray(scene.mesh.face), setting)[:12]
        work = {
            "path": str(chosen.output / "work" / f"{name}-{key}"),
            "executor": chosen.part,
            "progress": sys.stderr.isatty(),
        }
        known = {"bounces": chosen.bounces, "glass": glass, "ground": chosen.ground, "subdivision": chosen.subdivision}
        try:
            result = year(scene, position, normal, weather, size=chosen.rays, **known, **work)
        except UnfinishedError as told:
            return options.Result({"unfinished": str(told)}, str(told))
        result.write_csv(str(chosen.output / f"{name}.csv"))
        for key in ("radiation_kwh_m2", "daylight_autonomy_300", "mean_illuminance_lx"):
            shown = false_colors.picture(scene, position, normal, result.columns[key], title=f"{name}: {key}")
            files.write_png(chosen.output / f"{name}_{key}.png", shown)
        results[name] = _summary(result)
    lines = [
        f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in row.items()) for name, row in results.items()
    ]
    return options.Result({"place": weather.place, "grids": results}, "\n".join([weather.place, *lines]))


def _summary(result: Year) -> dict[str, Any]:
    """What a table of several grids shows."""
    return {
        "sensors": len(result.position),
        "sDA_300_50": result.sda,
        "ASE_1000_250": result.ase,
        "UDI_100_3000": float(result.useful[:, 1].mean()),
        "daylight_factor_percent": float(result.factor.mean()),
        "radiation_kwh_m2": float(result.radiation.mean()),
        "error": result.error,
    }


def _read(paths: tuple[Path, ...], up: str) -> tuple[Scene, dict[str, float], dict[str, Any], Path]:
    """The building, its glass, the sensors by grid, and the weather file."""
    kinds: dict[str, list[Path]] = {"weather": [], "sensors": [], "radiance": [], "folder": [], "model": []}
    for path in paths:
        suffix = path.suffix.lower()
        kind = "weather" if suffix in _WEATHER else "sensors" if suffix == _SENSORS else "model"
        kinds["folder" if path.is_dir() else "radiance" if suffix in _RADIANCE else kind].append(path)
    buildings_given = bool(kinds["radiance"]) + len(kinds["folder"]) + len(kinds["model"])
    if len(kinds["weather"]) != 1 or buildings_given != 1:
        raise click.UsageError(
            "daylight needs one building (a model, files of Radiance, or a folder of honeybee) and one weather file, "
            f"got {buildings_given} and {len(kinds['weather'])}"
        )
    glass, grids = {}, {}
    if kinds["folder"]:
        scene, glass, grids = buildings.load_honeybee(str(kinds["folder"][0]))
    elif kinds["radiance"]:
        scene, glass = buildings.load_rad(*map(str, kinds["radiance"]))
    else:
        scene = inputs.scene([kinds["model"][0]], up=up, refine=False)
    names = inputs.unique([*grids, *(path.stem for path in kinds["sensors"])])[len(grids) :]
    grids |= {name: buildings.load_sensors(str(path)) for name, path in zip(names, kinds["sensors"], strict=True)}
    if not grids:
        raise click.UsageError("daylight needs sensors: a .pts file with rows x y z nx ny nz, got none")
    return scene, glass, {name.replace("/", "_"): grid for name, grid in grids.items()}, kinds["weather"][0]
