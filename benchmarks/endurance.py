"""What happens in long use: kills, damaged files, full disks, interrupts, hundreds of pictures, hostile input?

    python -m benchmarks.endurance [--quick] [--case NAME ...] [--output FILE]

Every case does something many times and compares with what it should give; the benchmark fails where it does not.
`error` is the largest relative difference, 0 where all bits must be equal. `times` says how often.

* `kills`: a process that precomputes with `path=` is killed at random moments and started again until it ends.
* `damage`: each file of a finished store is cut, emptied, removed, or has a byte changed. The next `precompute` gives
  the same bits. `full disk`: files may grow to a small size only; the process says so, and the next one goes on.
* `interrupts`: Ctrl-C at random moments of `precompute`, `picture` and `jaxprt dataset`, which then go on.
* `pictures`: of changing sizes and scenes in one process. `more_bytes`, `more_mappings` and `more_files` are by how
  much it grows in the second half. `bytes` are those of the process, in all cases.
* `looks`: two pages ask one viewer in turn, others lose their connection; growth as for `pictures`.
* `hostile`: lights and meshes scaled by huge and tiny numbers give pictures scaled alike; extreme roughnesses, cameras
  on a surface, and pictures of a pixel and of one row are finite and, where one knows, right.
"""

import contextlib
import hashlib
import os
import pathlib
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import jaxprt as prt
from benchmarks import harness
from benchmarks.view import Page, radiance
from jaxprt import files, image, view
from jaxprt.cli.inputs import example_scene
from jaxprt.scene import Camera, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import make_mesh

FULL = 100_000  # bytes to which files may grow
METAL = TexturedMaterial(base_color=(0.8, 0.6, 0.3), metallic=1.0, roughness=0.3)


def sphere(rings: int = 16, material: TexturedMaterial = METAL, scale: float = 1.0) -> Scene:
    """A sphere on a plane."""
    ball, floor = builtin.sphere(rings=rings, sectors=2 * rings), builtin.plane(cells=8)
    moved = np.asarray(ball.position) + [0, 1.0, 0]
    parts = (("ball", moved, ball), ("floor", 3 * np.asarray(floor.position), floor))
    return Scene(
        [Part(name, make_mesh(scale * position, np.asarray(mesh.face)), material) for name, position, mesh in parts]
    )


def precompute(path: pathlib.Path, quick: bool) -> prt.RelitScene:
    """What processes are killed at: bits of visibility in several dozen blocks."""
    scene = sphere(12 if quick else 64)
    return prt.precompute(scene, system=prt.relit.Lobes(8), refine=False, path=path, progress=False)


def digest(path: pathlib.Path) -> str:
    """Checksum of all arrays of a store. Its own checksums hold a number that is drawn when it is made."""
    result = hashlib.sha256()
    for file in sorted(set(path.rglob("*.npy")) - set(path.rglob("checksum.npy"))):
        result.update(file.relative_to(path).as_posix().encode() + file.read_bytes())
    return result.hexdigest()


def start(path: pathlib.Path, quick: bool) -> subprocess.Popen:
    """A process that is about to precompute."""
    command = [sys.executable, "-m", "benchmarks.endurance", *["--quick"] * quick, "--process", str(path)]
    options = {"cwd": pathlib.Path(__file__).parents[1], "env": {**os.environ, "JAXPRT_KEEP_PROGRAMS": "1"}}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)
    assert process.stdout is not None
    process.stdout.readline()
    return process


def finish(process: subprocess.Popen) -> str:
    """Waits for a process, and returns what it wrote to the standard error."""
    return process.communicate()[1]


def line(case: str, times: int, began: float, *, error: float = 0.0, **more: Any) -> dict[str, Any]:
    """A line of the report."""
    spent = {"seconds": time.perf_counter() - began, "compile_seconds": 0.0}
    return {
        "benchmark": "endurance",
        "case": case,
        **spent,
        "error": error,
        "bytes": held()["bytes"],
        "times": times,
        **more,
    }


def check(right: bool, words: str) -> None:
    """Ends the benchmark where something is wrong."""
    if not right:
        raise RuntimeError(words)


def kills(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, random, killed, count, ended = time.perf_counter(), np.random.default_rng(0), 0, 1 if quick else 50, 0
    process = start(folder / "whole", quick)
    duration = -time.perf_counter()
    check(not finish(process) or process.returncode == 0, "the first process failed")
    duration += time.perf_counter()
    while killed < count or not ended:
        process = start(folder / "killed", quick)
        if killed < count:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(duration * random.uniform(0.1, 0.9))
        if killed < count and process.poll() is None:
            process.kill()
            killed += 1
        words = finish(process)
        if process.returncode == 0:
            ended += 1
            check(digest(folder / "killed") == digest(folder / "whole"), "other bits after kills")
            shutil.rmtree(folder / "killed")
        else:
            check(process.returncode == -signal.SIGKILL, words)
    yield line(f"kills, {ended} runs ended", killed, began)


def damage(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, whole, path = time.perf_counter(), folder / "whole", folder / "damaged"
    precompute(whole, quick)
    right, count = digest(whole), 0

    def flip(file: pathlib.Path) -> None:
        content = bytearray(file.read_bytes())
        content[-1 - len(content) // 3] ^= 4
        file.write_bytes(bytes(content))

    ways: dict[str, Callable[[pathlib.Path], Any]] = {
        "cut": lambda file: os.truncate(file, file.stat().st_size // 2),
        "emptied": lambda file: os.truncate(file, 0),
        "removed": lambda file: file.unlink(),
        "changed": flip,
    }
    said = dict.fromkeys(ways, 0)
    for file in sorted(file.relative_to(whole) for file in whole.rglob("*") if file.is_file() and file.stat().st_size):
        for name, way in list(ways.items())[:: 3 if quick else 1]:
            shutil.copytree(whole, path)
            way(path / file)
            try:
                precompute(path, quick)
                check(digest(path) == right, f"other bits after {file} was {name}")
            except (ValueError, OSError) as error:
                check(str(file.name) in str(error) or str(path) in str(error), f"{file} was {name}: {error}")
                said[name] += 1
            shutil.rmtree(path)
            count += 1
    words = ", ".join(f"{number} {name}" for name, number in said.items() if number)
    yield line(f"damage; refused with the file's name: {words or 'none'}", count, began)
    began = time.perf_counter()
    process = start(path, quick)
    resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (FULL, FULL))
    words = finish(process)
    check(process.returncode > 0 and "Traceback" in words and "OSError" in words, words)
    precompute(path, quick)
    check(digest(path) == right, "other bits after a full disk")
    yield line("full disk: " + words.strip().splitlines()[-1][:100].replace(str(folder), ""), 1, began)


class Interrupts:
    """Calls a function, interrupts it at random moments as Ctrl-C does, and calls it again until it ends.

    Attributes:
        count: Number of interrupts so far.
    """

    def __init__(self) -> None:
        self.count, self._random = 0, np.random.default_rng(0)

    def run(self, function: Callable[[], Any], seconds: float, count: int) -> Any:
        """The result after some interrupts, each at most some seconds after the start."""

        def interrupt(*_: Any) -> None:
            raise KeyboardInterrupt

        before = signal.signal(signal.SIGALRM, interrupt)
        try:
            for _ in range(count):
                try:
                    signal.setitimer(signal.ITIMER_REAL, float(self._random.uniform(0.01, seconds)))
                    function()
                except KeyboardInterrupt:
                    self.count += 1
                finally:
                    signal.setitimer(signal.ITIMER_REAL, 0)
            return function()
        finally:
            signal.signal(signal.SIGALRM, before)


def interrupts(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, count = time.perf_counter(), 2 if quick else 20
    precompute(folder / "whole", quick)
    stop = Interrupts()
    relit = stop.run(lambda: precompute(folder / "stopped", quick), 1.0, count)
    check(digest(folder / "stopped") == digest(folder / "whole"), "other bits after interrupts")
    yield line("interrupts of precompute", stop.count, began)
    if quick:
        return
    began, stop, light = time.perf_counter(), Interrupts(), builtin.daylight()
    camera = orbit(relit.mesh, width=64, height=48)
    right = np.asarray(relit.picture(light, camera=camera))
    got = np.asarray(stop.run(lambda: relit.picture(light, camera=camera), 0.3, count))
    check(np.array_equal(got, right), "another picture after interrupts")
    yield line("interrupts of picture", stop.count, began)
    began, command, stopped = time.perf_counter(), dataset(folder), 0
    subprocess.run([*command, "--output", str(folder / "set")], check=True, capture_output=True)
    for seconds in np.linspace(2, 12, 10):
        process = subprocess.Popen([*command, "--output", str(folder / "part")], stderr=subprocess.PIPE, text=True)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            stopped += 1
        process.communicate(timeout=600)  # the picture under way ends first
    subprocess.run([*command, "--output", str(folder / "part")], check=True, capture_output=True)
    whole, part = (sorted((folder / name / "ball").glob("*.png")) for name in ("set", "part"))
    same = [one.read_bytes() == other.read_bytes() for one, other in zip(whole, part, strict=True)]
    check(len(same) > 0 and all(same), "another dataset after interrupts")
    yield line(f"interrupts of a dataset of {len(same)} pictures", stopped, began)


def dataset(folder: pathlib.Path) -> list[str]:
    """A command that renders a dataset."""
    light = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32)
    files.write_exr(folder / "day.exr", light)
    mesh = sphere(12).mesh
    trimesh.Trimesh(np.asarray(mesh.position), np.asarray(mesh.face), process=False).export(folder / "ball.ply")
    command = [sys.executable, "-m", "jaxprt", "dataset", str(folder / "ball.ply"), str(folder / "day.exr")]
    return [*command, "--light-size", "16", "--size", "32", "--format", "png", "--views", "64"]


def growth(counts: Sequence[dict[str, int]]) -> dict[str, int]:
    """By how much what a process holds has grown in the second half of a run."""
    half = counts[len(counts) // 2]
    return {f"more_{name}": value - half[name] for name, value in counts[-1].items()}


def held() -> dict[str, int]:
    """Resident bytes, memory mappings and open files of this process."""
    proc = pathlib.Path("/proc/self")
    if not proc.exists():
        return {"bytes": harness.peak_memory(), "mappings": 0, "files": 0}
    pages = int((proc / "statm").read_text().split()[1])
    mappings = (proc / "maps").read_bytes().count(b"\n")
    return {"bytes": pages * os.sysconf("SC_PAGE_SIZE"), "mappings": mappings, "files": len(os.listdir(proc / "fd"))}


def pictures(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, count, random = time.perf_counter(), 4 if quick else 300, np.random.default_rng(0)
    scenes = [sphere(rings) for rings in ((8,) if quick else (8, 16, 24))]
    light, counts, size = builtin.daylight(size=16), [], 16 if quick else 96
    relit = [prt.precompute(scene, system="lobe", refine=False, size=16, progress=False) for scene in scenes]
    for number in range(count):
        width, height = (int(value) for value in random.integers(size // 2, size, 2))
        chosen = relit[number % len(relit)]
        camera = orbit(chosen.mesh, width=width, height=height, azimuth=float(random.uniform(0, 6)))
        color = np.asarray(chosen.picture(light, camera=camera))
        check(color.shape[:2] == (height, width) and bool(np.isfinite(color).all()), f"picture {number} is wrong")
        counts.append(held())
    yield line("pictures", count, began, **growth(counts))


def looks(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, count, random = time.perf_counter(), 6 if quick else 500, np.random.default_rng(0)
    size = 8
    relit = prt.precompute(
        example_scene(playable=True), refine=False, system=prt.relit.Lobes(8, texels=2), size=size, progress=False
    )
    light = builtin.daylight(size=size)
    server, counts, error = view.serve(relit, environments={"daylight": light}), [], 0.0
    pages, place = [Page(server.url), Page(server.url)], urllib.parse.urlsplit(server.url)
    for number in range(count):
        page = pages[number % 2]
        eye = (np.asarray(page.scene["eye"]) + random.uniform(-0.3, 0.3, 3)).tolist()
        change = {"eye": eye, "turn": float(random.uniform(0, 6))}
        change |= {"materials": {"pieces": {"roughness": float(random.uniform(0.1, 1))}}}
        color = page.look(**change)
        if number % 25 == 0:
            error = max(error, float(image.relative_l2(color, radiance(relit, light, page.state))))
        if number % 10 == 0:  # a page that asks and is gone
            with socket.create_connection((str(place.hostname), int(place.port or 0))) as lost:
                lost.sendall(
                    f"POST {place.path}ask HTTP/1.1\r\nHost: {place.netloc}\r\nContent-Length: 999\r\n\r\n".encode()
                )
        counts.append(held())
    for page in pages:
        page.close()
    server.close()
    yield line("looks of two pages", count, began, error=error, **growth(counts))


def hostile(folder: pathlib.Path, quick: bool) -> Iterator[dict[str, Any]]:
    began, light = time.perf_counter(), builtin.daylight(size=16)
    options = {"system": "lobe", "refine": False, "size": 16, "progress": False}
    relit = prt.precompute(sphere(8), **options)
    camera = orbit(relit.mesh, width=24, height=16)

    def scaled(factor: float) -> prt.Environment:
        return prt.Environment(jnp.asarray(np.asarray(light.radiance) * np.float32(factor)))

    def picture(scene: prt.RelitScene, camera: Camera, light: prt.Environment = light) -> np.ndarray:
        color = np.asarray(scene.picture(light, camera=camera))
        check(bool(np.isfinite(color).all()), "a picture is not finite")
        return color

    right, errors = picture(relit, camera, scaled(1)), {}
    for factor in (2.0**-64, 2.0**-20, 2.0**20, 2.0**96):  # by which float32 multiplies without rounding
        got = picture(relit, camera, scaled(factor)) / np.float32(factor)
        errors[f"light x {factor:g}"] = float(image.relative_l2(got, right))
    sun = np.asarray(light.radiance).copy()
    sun[2, 8, 8] = 1e30
    picture(relit, camera, prt.Environment(jnp.asarray(sun)))
    check(not picture(relit, camera, scaled(1e-44)).max() > 1e-37, "denormal light grew")
    for factor in (2.0**20,) if quick else (2.0**-20, 2.0**20):
        other = prt.precompute(sphere(8, scale=factor), **options)
        moved = orbit(other.mesh, width=24, height=16)
        errors[f"mesh x {factor:g}"] = float(image.relative_l2(picture(other, moved, scaled(1)), right))
    for roughness in () if quick else (0.0, 1.0):
        material = TexturedMaterial(base_color=(0.8, 0.6, 0.3), metallic=1.0, roughness=roughness)
        picture(prt.precompute(sphere(8, material), **options), camera)
    on_floor = np.array([0.5, 0.0, 0.5])
    for eye in (on_floor, np.array([0.0, 2.0, 0.0])):
        picture(relit, Camera(eye, eye + [0.3, 0.1, 0.2], [0.0, 1, 0], 0.6, 16, 16))
    for width, height in ((1, 1),) if quick else ((1, 1), (1, 10_000), (10_000, 1)):
        check(picture(relit, orbit(relit.mesh, width=width, height=height)).shape[:2] == (height, width), "a size")
    worst = max(errors, key=lambda name: errors[name])
    check(errors[worst] == 0, f"{errors}")
    yield line(f"hostile: largest error for {worst}", len(errors) + 9, began, error=errors[worst])


CASES = {
    **{"kills": kills, "damage": damage, "interrupts": interrupts},
    **{"pictures": pictures, "looks": looks, "hostile": hostile},
}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--case", choices=CASES, nargs="+", default=list(CASES))
    parser.add_argument("--process", type=pathlib.Path, help="precompute into this folder, and do nothing else")
    arguments = parser.parse_args(options)
    if arguments.process:
        jax.block_until_ready(jnp.zeros(()))
        print("ready", flush=True)
        precompute(arguments.process, arguments.quick)
        return
    for case in arguments.case:
        with tempfile.TemporaryDirectory() as folder:
            for result in CASES[case](pathlib.Path(folder), arguments.quick):
                harness.report(result, arguments.output)


if __name__ == "__main__":
    main()
