"""What does a user wait for? Seconds and compiled programs from the start of a process to pictures of further views.

    python -m benchmarks.first_picture [--quick] [--scene NAME ...] [--stage NAME ...] [--output FILE]

Each stage is a process of its own. `cold` starts with an empty folder for compiled programs. `programs` does the same
again with the folder that `cold` has filled. `store` also loads what `cold` has precomputed, with
`precompute(path=...)`. `cameras` is like `store`, and then renders 300 pictures of one size, each with another camera.

The steps of a process are import, load (reading the scene and the first light, or building the scene), precompute
(lobes, light of 6 x 64 x 64 texels), first picture (320 x 240 pixels, four samples), second light (reading it, and a
picture), and seven views. Each step is one line. `seconds` are those of the clock, `processor_seconds` those that all
threads of the process have used. `programs` are compiled or found in the folder, `found` of them there, in
`compile_seconds`. Programs that are loaded without tracing them (`jaxprt.compile.kept`) do not count. `mappings` and
`bytes` are the memory mappings of the process and its peak memory at the end of the step. `error` is the relative L2
difference of the stage's first picture from that of `cold`.

`truck`, `duck`, `spaceship` and `cake` are files of JAXPRT_DATA. `chess` has three parts, `room` twelve, with two
bounces. `hundred` has 100 spheres of ten sizes of mesh as parts, and `one` has the same 100 spheres as a single part.
"""

import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np

import jaxprt as prt
from benchmarks import harness
from benchmarks.published import interiors
from jaxprt.scene import Camera, Mesh, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import join, make_mesh, split

WIDTH, HEIGHT, SAMPLES, SIZE = 320, 240, 4, 64
LIGHTS = "uffizi_latlong_256x128.hdr", "ennis_latlong_256x128.hdr"
FILES = {
    "truck": "scenes/CesiumMilkTruck.glb",
    "duck": "scenes/Duck.glb",
    "spaceship": "foreign/alien.glb",
    "cake": "foreign/cakeBirthday.glb",
}
SCENES = (*FILES, "chess", "room", "hundred", "one")
STAGES = "cold", "programs", "store", "cameras"
BOUNCES = {"room": 2}
VIEWS = [(0.9 * number, 0.1 * number) for number in range(1, 8)]  # azimuth and elevation in radians
PICTURES = 300  # of the stage `cameras`
ROOM = (  # base color and roughness of the parts
    *(([0.6, 0.45, 0.3], 0.3), ([0.7, 0.15, 0.1], 0.9), ([0.8, 0.8, 0.75], 1.0), ([0.8, 0.8, 0.75], 1.0)),
    *(([0.8, 0.8, 0.75], 1.0), ([0.85, 0.85, 0.85], 1.0), ([0.2, 0.3, 0.6], 1.0), ([0.4, 0.25, 0.15], 0.4)),
    *(([0.8, 0.75, 0.6], 0.5), ([0.5, 0.5, 0.55], 0.2), ([0.3, 0.4, 0.3], 0.6), ([0.7, 0.6, 0.2], 0.9)),
)


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--scene", choices=SCENES, nargs="+", default=list(SCENES))
    parser.add_argument("--stage", choices=STAGES, nargs="+", default=list(STAGES[:3]), help="cold always runs first")
    parser.add_argument("--process", nargs=3, metavar=("SCENE", "STAGE", "FOLDER"), help=argparse.SUPPRESS)
    arguments = parser.parse_args(options)
    if arguments.process:
        scene, stage, folder = arguments.process
        run(scene, stage, pathlib.Path(folder), arguments.quick)
        return
    names = ["small"] if arguments.quick else [name for name in arguments.scene if available(name)]
    for name in names:
        for line in measure(name, STAGES if arguments.quick else arguments.stage, arguments.quick):
            harness.report(line, arguments.output)


def available(name: str) -> bool:
    """Whether a scene's file is there, or it needs none."""
    return name not in FILES or (harness.data() / FILES[name]).is_file()


def measure(name: str, stages: Sequence[str], quick: bool) -> Iterator[dict[str, Any]]:
    """Lines of the stages of a scene, each from a process of its own."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = pathlib.Path(temporary)
        command = [sys.executable, "-m", "benchmarks.first_picture", *["--quick"] * quick, "--process", name]
        root = pathlib.Path(__file__).parents[1]
        for stage in ("cold", *(stage for stage in STAGES[1:] if stage in stages)):
            jax_cache = ("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")  # with these set, jaxprt keeps no programs
            inherited = {name: value for name, value in os.environ.items() if not name.startswith(jax_cache)}
            folders = dict.fromkeys(("XDG_CACHE_HOME", "HOME", "LOCALAPPDATA"), str(folder))
            start = {"JAXPRT_KEEP_PROGRAMS": "1", "FIRST_PICTURE_START": repr(time.time())}
            environment = {**inherited, **folders, **start}
            process = subprocess.run(
                [*command, stage, str(folder)], cwd=root, env=environment, check=True, stdout=subprocess.PIPE, text=True
            )
            first, cold = (np.load(folder / f"{each}.npy") for each in (stage, "cold"))
            error = float(np.linalg.norm(first - cold) / np.linalg.norm(cold))
            for line in process.stdout.splitlines() if stage in stages else ():
                step = json.loads(line)
                case = f"{name}, {stage}, {step.pop('step')}"
                yield {"benchmark": "first_picture", "case": case, **step, "error": error}


class Steps:
    """Prints one line for each step of a process.

    Attributes:
        programs: Programs that were compiled or found, since the start of the process.
        found: Programs that were found in the folder.
        compile_seconds: Seconds that both took.
        start: Seconds of the clock and of the processor at which the step has started.
    """

    def __init__(self):
        self.programs, self.found, self.compile_seconds = 0, 0, 0.0
        self.start = float(os.environ["FIRST_PICTURE_START"]), 0.0
        jax.monitoring.register_event_duration_secs_listener(self._compiled)
        jax.monitoring.register_event_listener(self._event)

    def _compiled(self, event: str, duration_secs: float, **kwargs: Any) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            self.programs, self.compile_seconds = self.programs + 1, self.compile_seconds + duration_secs

    def _event(self, event: str, **kwargs: Any) -> None:
        self.found += event == "/jax/compilation_cache/cache_hits"

    def take(self, step: str, function: Callable[[], Any]) -> Any:
        """Runs a step and prints its line."""
        self.programs, self.found, self.compile_seconds = 0, 0, 0.0
        result = jax.block_until_ready(function())
        now = time.time(), time.process_time()
        seconds, processor = (end - start for end, start in zip(now, self.start, strict=True))
        line = {
            **{"step": step, "seconds": seconds, "processor_seconds": processor},
            **{"compile_seconds": self.compile_seconds, "programs": self.programs, "found": self.found},
            **{"mappings": mappings(), "bytes": harness.peak_memory()},
        }
        print(json.dumps(line), flush=True)
        self.start = time.time(), time.process_time()
        return result


def run(name: str, stage: str, folder: pathlib.Path, quick: bool) -> None:
    """Takes the steps of one process."""
    steps = Steps()
    steps.take("import", lambda: None)
    scene, light = steps.take("load", lambda: (load(name), environment(0, quick)))
    store = folder / ("programs.prt" if stage == "programs" else "cold.prt")
    options = {"bounces": BOUNCES.get(name), "size": 8 if quick else SIZE, "path": store, "progress": False}
    relit = steps.take("precompute", lambda: prt.precompute(scene, system="lobe", **options))
    width, height = (48, 36) if quick else (WIDTH, HEIGHT)
    mesh = scene.mesh

    def picture(light: prt.scene.Environment, camera: Camera) -> np.ndarray:
        return np.asarray(relit.picture(light, camera, samples=SAMPLES))

    camera = orbit(mesh, azimuth=0.5, elevation=0.3, width=width, height=height)
    first = steps.take("first picture", lambda: picture(light, camera))
    np.save(folder / f"{stage}.npy", first)
    if stage == "cameras":
        cameras = mixed(mesh, 2 if quick else PICTURES, width, height)
        steps.take(f"{len(cameras)} cameras", lambda: [picture(light, camera) for camera in cameras])
        return
    steps.take("second light", lambda: picture(environment(1, quick), camera))
    views = [orbit(mesh, azimuth=turn, elevation=up, width=width, height=height) for turn, up in VIEWS]
    steps.take("seven views", lambda: [picture(light, camera) for camera in views])


def mixed(mesh: Mesh, count: int, width: int, height: int) -> list[Camera]:
    """Cameras around a scene, near and far, wide and narrow."""
    random = np.random.default_rng(0)
    return [
        orbit(
            mesh,
            azimuth=random.uniform(-np.pi, np.pi),
            elevation=random.uniform(-0.2, 1.2),
            field_of_view=random.uniform(0.2, 1.2),
            width=width,
            height=height,
        )
        for _ in range(count)
    ]


def mappings() -> int:
    """Memory mappings of this process; 0 where the system does not tell them."""
    path = pathlib.Path("/proc/self/maps")
    return path.read_bytes().count(b"\n") if path.exists() else 0


def environment(number: int, quick: bool) -> prt.scene.Environment:
    """The first or second light."""
    path = harness.data() / "env" / LIGHTS[number]
    if quick or not path.is_file():
        return (builtin.daylight, builtin.studio)[number](size=8 if quick else SIZE)
    return prt.load_environment(path, size=SIZE)


def load(name: str) -> Scene:
    """The scene of a name."""
    if name in FILES:
        return prt.load_scene(harness.data() / FILES[name])
    if name == "chess":
        return parts(split(builtin.chess()), [([0.6, 0.4, 0.2], 0.3), ([0.8, 0.7, 0.5], 0.5), ([0.1, 0.05, 0.03], 0.5)])
    if name == "room":
        return parts(split(interiors.room()), ROOM)
    meshes = spheres(10)[: 1 if name == "small" else None]
    materials = [([0.2 + 0.006 * number, 0.5, 0.8 - 0.006 * number], 0.3 + 0.2 * (number % 4)) for number in range(100)]
    if name == "one":
        return parts([join(meshes)], materials[:1])
    return parts(meshes, materials[: len(meshes)])


def parts(meshes: Sequence[Mesh], materials: Sequence[tuple[list[float], float]]) -> Scene:
    """A scene of meshes with colors and roughnesses."""
    return Scene(
        [
            Part(f"part {number}", mesh, TexturedMaterial(color, metallic=0.0, roughness=roughness))
            for number, (mesh, (color, roughness)) in enumerate(zip(meshes, materials, strict=True))
        ]
    )


def spheres(edge: int) -> list[Mesh]:
    """A square of small spheres, in columns of different numbers of vertices."""
    meshes = []
    for row in range(edge):
        for column in range(edge):
            ball = builtin.sphere(rings=6 + column, sectors=12)
            position = np.asarray(ball.position) * 0.4 + np.array([column, 0, row], np.float32)
            meshes.append(make_mesh(position, np.asarray(ball.face), normal=np.asarray(ball.normal)))
    return meshes


if __name__ == "__main__":
    main()
