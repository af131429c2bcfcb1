"""Is the light of sensors as exact as Radiance's at a fraction of its time, and what does a year take?

    python -m benchmarks.daylight [--quick] [--output FILE]

Scenes are made: a room of 6 x 8 x 3 m with a window, the same with slats of 6 cm before the window, and a street
between houses with sensors on a facade. `error` is the relative L2 of the sensors' irradiance under uniform light from
`rfluxmtx` with many more rays, and `rows` the same of the whole matrix of 146 patches. `seconds` are processor seconds
without compilation; `peer_seconds` are those of `rfluxmtx` with the number of rays whose error, `peer_error`, is the
nearest to ours. The line of a year is of a made weather file: the sums over its hours, after the matrix. Radiance is
that of `pyradiance`.
"""

import datetime
import os
import pathlib
import subprocess
import tempfile
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyradiance

from benchmarks import harness
from jaxprt.daylight import Weather, load_rad, sun_directions, year
from jaxprt.sensors import Patches, transport

_BINARIES = pathlib.Path(str(pyradiance.__file__)).parent
_RECEIVERS = """#@rfluxmtx h=u u=Y
void glow below 0 0 4 1 1 1 0
below source ground 0 0 4 0 0 -1 180
#@rfluxmtx h=r1 u=Y
void glow above 0 0 4 1 1 1 0
above source sky 0 0 4 0 0 1 180
"""
_MATERIALS = {"floor": 0.3, "wall": 0.6, "ceiling": 0.8, "slat": 0.5}


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    quick = arguments.quick
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        (folder / "receivers.rad").write_text(_RECEIVERS)
        for case in ("room",) if quick else ("room", "slats", "street"):
            polygons, sensors = scene(case, quick)
            write(folder, polygons, sensors)
            for bounces, sizes in {0: (16,)}.items() if quick else {0: (32, 64, 128), 1: (64,), 2: (64,)}.items():
                most = 1 << (12 if quick else 19 if bounces == 0 else 15)
                exact, _ = radiance(folder, most, bounces)
                ladder = [radiance(folder, most >> shift, bounces) for shift in ((2,) if quick else (2, 4, 6))]
                for size in sizes:
                    line = measure(folder, exact, ladder, size, bounces)
                    case_name = f"{case}, {bounces} bounces, size {size}"
                    harness.report({"benchmark": "daylight", "case": case_name, **line}, arguments.output)
        harness.report(measure_year(folder, quick), arguments.output)


def scene(case: str, quick: bool) -> tuple[list[tuple[str, list[tuple[float, ...]]]], np.ndarray]:
    """Polygons by their materials, and sensors, in Radiance's axes."""
    if case == "street":
        walls = []
        for x in (-20.0, 10.0):
            for y in range(-60, 60, 12):
                height = 9 + (7 * y + 3 * x) % 11
                walls += box((x, y, 0), (x + 10, y + 12, height))
        ground = [("floor", [(-60, -80, 0), (60, -80, 0), (60, 80, 0), (-60, 80, 0)])]
        y, z = np.meshgrid(np.arange(-20, 20, 1.0), np.arange(0.5, 9, 1.0))
        place = np.stack([np.full(y.size, -9.99), y.ravel(), z.ravel()], -1)
        return walls + ground, np.concatenate([place, np.tile([1.0, 0, 0], (len(place), 1))], 1)
    room = box((0, 0, 0), (6, 8, 3))[:2] + box((0, 0, 0), (6, 8, 3))[3:]
    room = [("floor" if k == 0 else "ceiling" if k == 1 else "wall", polygon) for k, (_, polygon) in enumerate(room)]
    for x0, x1, z0, z1 in ((0, 6, 0, 1), (0, 6, 2.6, 3), (0, 1, 1, 2.6), (5, 6, 1, 2.6)):
        room.append(("wall", [(x0, 0, z0), (x0, 0, z1), (x1, 0, z1), (x1, 0, z0)]))
    for number in range(16 if case == "slats" else 0):
        z = 1.05 + 0.1 * number
        room.append(("slat", [(1, -0.12, z - 0.03), (5, -0.12, z - 0.03), (5, -0.04, z + 0.03), (1, -0.04, z + 0.03)]))
    step = 1.0 if quick else 0.5
    x, y = np.meshgrid(np.arange(0.5, 6, step), np.arange(0.5, 8, step))
    place = np.stack([x.ravel(), y.ravel(), np.full(x.size, 0.8)], -1)
    return room, np.concatenate([place, np.tile([0, 0, 1.0], (len(place), 1))], 1)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> list[tuple[str, list[tuple[float, ...]]]]:
    """The faces of a box: floor, ceiling, then the sides to -y, +y, -x and +x."""
    (a, b, c), (d, e, f) = low, high
    faces = [[(a, b, c), (d, b, c), (d, e, c), (a, e, c)], [(a, b, f), (a, e, f), (d, e, f), (d, b, f)]]
    faces += [[(a, b, c), (a, b, f), (d, b, f), (d, b, c)], [(a, e, c), (d, e, c), (d, e, f), (a, e, f)]]
    faces += [[(a, b, c), (a, e, c), (a, e, f), (a, b, f)], [(d, b, c), (d, b, f), (d, e, f), (d, e, c)]]
    return [("wall", [tuple(map(float, corner)) for corner in face]) for face in faces]


def write(folder: pathlib.Path, polygons: list, sensors: np.ndarray) -> None:
    """Writes the scene and the sensors as Radiance reads them."""
    lines = [f"void plastic {name} 0 0 5 {gray} {gray} {gray} 0 0" for name, gray in _MATERIALS.items()]
    for number, (name, polygon) in enumerate(polygons):
        corners = " ".join(f"{value:g}" for corner in polygon for value in corner)
        lines.append(f"{name} polygon p{number} 0 0 {3 * len(polygon)} {corners}")
    (folder / "scene.rad").write_text("\n".join(lines) + "\n")
    np.savetxt(folder / "sensors.pts", sensors, "%g")


def radiance(folder: pathlib.Path, rays: int, bounces: int) -> tuple[np.ndarray, float]:
    """The matrix of rfluxmtx, and its processor seconds."""
    count = len(np.loadtxt(folder / "sensors.pts", ndmin=2))
    options = ["-h", "-I+", "-ab", str(1 + bounces), "-ad", str(rays), "-lw", f"{0.01 / rays:g}", "-n", "1"]
    command = [str(_BINARIES / "bin" / "rfluxmtx"), *options, "-y", str(count), "-", "receivers.rad", "scene.rad"]
    surroundings = os.environ | {"RAYPATH": str(_BINARIES / "lib"), "PATH": f"{_BINARIES / 'bin'}:{os.environ['PATH']}"}
    before, text = os.times().children_user, (folder / "sensors.pts").read_text()
    told = subprocess.run(command, cwd=folder, input=text, env=surroundings, capture_output=True, text=True, check=True)
    rows = np.array(told.stdout.split(), float).reshape(count, -1, 3)[..., 0]
    return rows, os.times().children_user - before


def measure(folder: pathlib.Path, exact: np.ndarray, ladder: list, size: int, bounces: int) -> dict[str, Any]:
    """The line of one size of a scene, given the matrix of most rays, and those of fewer with their seconds."""
    points, normals = _sensors(folder)
    building, _ = load_rad(str(folder / "scene.rad"))
    options = {"basis": Patches(), "bounces": bounces, "size": size, "progress": False}
    start = time.process_time()
    transport(building, points, normals, **options)
    first, start = time.process_time() - start, time.process_time()
    result = transport(building, points, normals, **options)
    seconds = time.process_time() - start
    error = _error(np.asarray(result.matrix).sum(1), exact.sum(1))
    peers = [(_error(rows.sum(1), exact.sum(1)), taken) for rows, taken in ladder]
    nearest = min(peers, key=lambda peer: abs(np.log(peer[0] / error)))
    return {
        **{"seconds": seconds, "compile_seconds": max(first - seconds, 0.0), "error": error, "bytes": result.nbytes},
        **{"rows": _error(np.asarray(result.matrix), exact), "stated": result.error, "sensors": len(points)},
        **{"peer": "rfluxmtx", "peer_seconds": nearest[1], "peer_error": nearest[0], "ratio": nearest[1] / seconds},
    }


def _sensors(folder: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    row = np.loadtxt(folder / "sensors.pts", ndmin=2)
    turned = row.reshape(-1, 2, 3)[..., [0, 2, 1]] * [1, 1, -1]
    return turned[:, 0], turned[:, 1]


def _error(value: np.ndarray, exact: np.ndarray) -> float:
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def measure_year(folder: pathlib.Path, quick: bool) -> dict[str, Any]:
    """The line of a year of 8,760 hours, for sensors of the last scene, repeated."""
    points, normals = _sensors(folder)
    count = 100 if quick else 10_000
    points = np.resize(points, (count, 3)) + np.random.default_rng(0).uniform(-0.01, 0.01, (count, 3))
    normals = np.resize(normals, (count, 3))
    building, _ = load_rad(str(folder / "scene.rad"))
    hours = made_weather()
    start = time.process_time()
    transport(building, points, normals, basis=Patches(), progress=False, size=16 if quick else 64)
    matrix, start, wall = time.process_time() - start, time.process_time(), time.perf_counter()
    result = year(building, points, normals, hours, bounces=0, progress=False, size=16 if quick else 64)
    whole, wall = time.process_time() - start, time.perf_counter() - wall
    return {
        **{"benchmark": "daylight", "case": f"a year of {count} sensors", "seconds": whole - matrix},
        **{"compile_seconds": 0.0, "error": 0.0, "bytes": 8 * count, "matrix_seconds": matrix, "wall_seconds": wall},
        **{"mean_kwh_m2": float(result.radiation.mean())},
    }


def made_weather() -> Weather:
    """A year at 48 degrees north whose days are clear, hazy or overcast by chance."""
    dates = [datetime.date(2025, 1, 1) + datetime.timedelta(day) for day in range(365) for _ in range(24)]
    month, day = (np.array([getattr(date, name) for date in dates]) for name in ("month", "day"))
    hour, none = np.tile(np.arange(24) + 0.5, 365), np.zeros(8760)
    dark = Weather("made", 48.0, 11.0, 1.0, month, day, hour, none, none)
    up = np.maximum(sun_directions(dark)[:, 1], 0)
    clear = np.repeat(np.random.default_rng(0).uniform(0, 1, 365), 24)
    direct = np.where(up > 0.02, 900 * clear * up**0.3, 0.0)
    return Weather("made", 48.0, 11.0, 1.0, month, day, hour, direct, (60 + 250 * (1 - clear)) * up)


if __name__ == "__main__":
    main()
