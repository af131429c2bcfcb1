"""What does an object cost whose pictures train a network? Many views under many lights, beside Mitsuba 3 and OIDN.

    python -m benchmarks.dataset [--quick] [--only TEXT] [--edge N] [--store FOLDER]

An object on a matte ground, in direct light, from 64 cameras under 16 turned copies of a light. `seconds` are processor
seconds of all threads, of all that leads to the pictures: division of meshes, rays, programs, views and lights.
`error` is relative L2 over the pixels that surfaces fill, over some of the pictures, against Mitsuba's converged ones
of the same triangles, materials and light file (see `benchmarks.denoised`).

`peer_seconds` are those of Mitsuba for as many pictures of the same error: bare, or denoised by one of the three
qualities of Intel's denoiser, with albedo and normals. For the measured pictures the cheapest way that reaches the
error is taken, on a curve over the number of samples; `peer_time` says how it was found. `core_hours` and
`peer_core_hours` are the same of an object. Programs of Mitsuba are compiled before its time is taken.
"""

import itertools
import pathlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import denoised, harness
from benchmarks.pictures import BRDFS, GROUND, LIGHTS, MESHES, NOISE, NOISE_ELSEWHERE, Case, standing, view
from benchmarks.scenes import file_name
from jaxprt import precompute
from jaxprt.brdf import MetallicRoughness
from jaxprt.relit import Lobes
from jaxprt.scene import Camera, Environment, builtin, load_environment, load_mesh
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import finer, rotate

VIEWS, TURNS, EDGE = 64, 16, 512
MEASURED = 3  # pictures that are compared
MATERIALS = {
    "spot": ("plastic 0.4", MetallicRoughness((0.6, 0.3, 0.2), metallic=0.0, roughness=0.4)),
    "rocker arm": ("metal 0.3", BRDFS["metal 0.3"]),
    "bunny": ("exponent 20", BRDFS["exponent 20"]),
}
SAMPLES = (1, 4, 16, 64, 256)
QUALITIES = ("fast", "balanced", "high")
MOST = 4096  # samples of a converged picture


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="TEXT", default="", help="cases whose names have TEXT, as 'spot, studio'")
    parser.add_argument(
        "--edge", type=int, metavar="N", default=EDGE, help=f"pixels along an edge; {EDGE} if not given"
    )
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep the converged pictures")
    arguments = parser.parse_args(options)
    for case in cases(arguments.quick, arguments.only, arguments.edge):
        harness.report(measure(case, arguments.quick, arguments.store), arguments.output)


def cases(quick: bool, only: str, edge: int) -> Iterator[Case]:
    """Three objects of three materials under a soft light and a sun; without real data, an embedded one."""
    folder = harness.data()
    if quick or not folder.is_dir():
        ball, size = builtin.sphere(rings=12, sectors=16), 8 if quick else 64
        scene = standing("sphere", ball, BRDFS["exponent 20"], 100 if quick else GROUND)
        yield Case(("sphere", "studio", "exponent 20"), scene, builtin.studio(size=size), view(ball, 0.5, 16))
        return
    for name, light in itertools.product(MESHES, ("studio", "sunrise")):
        material, brdf = MATERIALS[name]
        names = (name, light, material)
        if only in ", ".join(names):
            file, azimuth = MESHES[name]
            mesh = load_mesh(folder / "meshes" / file)
            scene = standing(name, mesh, brdf, GROUND)
            environment = load_environment(folder / "env" / LIGHTS[light])
            yield Case(names, scene, environment, view(mesh, azimuth, edge))


def turned(light: Environment, count: int) -> list[Environment]:
    """Copies of a light, turned about the vertical by equal steps."""
    result = []
    for angle in 2 * np.pi * np.arange(count) / count:
        c, s = np.cos(angle), np.sin(angle)
        result.append(rotate(light, jnp.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]], light.radiance.dtype)))
    return result


def around(case: Case, count: int) -> list[Camera]:
    """Cameras around the object, at three heights."""
    mesh, edge = case.scene.parts[0].mesh, case.camera.width
    angles, heights = 2 * np.pi * np.arange(count) / count, np.resize([0.15, 0.4, 0.8], count)
    return [
        orbit(mesh, azimuth=angle, elevation=height, width=edge, height=edge)
        for angle, height in zip(angles.tolist(), heights.tolist(), strict=True)
    ]


def measure(case: Case, quick: bool, store: pathlib.Path | None) -> dict[str, Any]:
    """The line of one object."""
    views, turns = (2, 2) if quick else (VIEWS, TURNS)
    lights, cameras = turned(case.light, turns), around(case, views)
    chosen = [(number * views // MEASURED, number * turns // MEASURED) for number in range(1 if quick else MEASURED)]
    recipe = Lobes(lobes=3, texels=0) if quick else Lobes()
    start = time.process_time()
    relit = precompute(case.scene, system=recipe, size=case.light.radiance.shape[-2], progress=False)
    made, drawn, nbytes = time.process_time() - start, {}, 0
    for block in relit.picture_blocks(lights, cameras, background=None):
        nbytes += block.pictures.nbytes
        for picture, light in zip(block.pictures, block.lights.tolist(), strict=True):
            if (block.view, light) in chosen:
                drawn[block.view, light] = picture
    seconds = time.process_time() - start
    errors, peers, ways = [], [], []
    for number, (camera, light) in enumerate(chosen):
        path = store and store / f"{file_name(*case.names, str(case.camera.width), str(number))}.npz"
        error, peer, way = at_equal_error(case, lights[light], cameras[camera], drawn[camera, light], quick, path)
        errors.append(error)
        peers.append(peer)
        ways.append(way)
    count, error = views * turns, float(np.sqrt(np.mean(np.square(errors))))
    peer = float(np.mean(peers)) * count
    return {
        **{"benchmark": "dataset", "case": ", ".join(case.names), "seconds": seconds, "compile_seconds": 0.0},
        **{"error": error, "bytes": nbytes, "precompute_seconds": made, "pictures": count, "vertices": relit.vertices},
        **{"peer": "Mitsuba 3, OIDN", "peer_seconds": peer, "peer_error": error, "peer_time": ", ".join(ways)},
        **{"core_hours": seconds / 3600, "peer_core_hours": peer / 3600, "devices": str(jax.devices()[0].platform)},
    }


def at_equal_error(
    case: Case, light: Environment, camera: Camera, picture: np.ndarray, quick: bool, path: pathlib.Path | None
) -> tuple[float, float, str]:
    """The error of a picture, the processor seconds of Mitsuba's of that error, and how they were found."""
    seen = denoised.View([(part.mesh, part.material) for part in case.scene.parts], finer(light), camera)
    noise = 0.02 if quick else NOISE.get(case.names[1], NOISE_ELSEWHERE)
    most, block = (144, 36) if quick else (MOST, denoised.BLOCK)
    truth = denoised.converged(seen, noise=noise, most=most, block=block, path=path)
    error = truth.error(picture)
    features = processor_seconds(lambda: seen.features(1))
    albedo, normal = seen.features(1)
    curves: dict[str, list[tuple[float, float]]] = {}
    for samples in (4, 16) if quick else SAMPLES:
        traced = processor_seconds(lambda samples=samples: seen.radiance(samples, 1))
        bare = seen.radiance(samples, 1)
        curves.setdefault("bare", []).append((traced, truth.error(bare)))
        for quality in QUALITIES:
            smooth = denoised.denoise(bare, albedo, normal, clean=False, quality=quality)
            spent = processor_seconds(
                lambda bare=bare, quality=quality: denoised.denoise(bare, albedo, normal, clean=False, quality=quality)
            )
            curves.setdefault(quality, []).append((traced + features + spent, truth.error(smooth)))
    found = {name: denoised.seconds_at(max(error, 1e-6), curve) for name, curve in curves.items()}
    name = min(found, key=lambda name: found[name][0])
    return error, found[name][0], f"{name} {found[name][1]}"


def processor_seconds(function: Callable[[], Any]) -> float:
    """Processor seconds of all threads of the second call; the first one compiles."""
    function()
    start = time.process_time()
    function()
    return time.process_time() - start


if __name__ == "__main__":
    main()
