"""What do many lights cost at once? Sixteen lights of a scene against one, for each system.

    python -m benchmarks.lights [--quick] [--only TEXT] [--store FOLDER] [--output FILE]

The scene is an object on a ground, 17,000 vertices together, with one metallic-roughness material or matte; the lights
are one environment turned about the vertical. A call of `RelitScene.radiance` projects the lights, evaluates the view
and combines both, for all vertices. `seconds` are processor seconds of a call with sixteen lights, `peer_seconds` those
of one with a single light, and `times` their ratio: which is low where transport is read once for all lights. `error`
is the largest deviation of the batch from calls with single lights, relative to the largest radiance. `pixels` is
`RelitScene.pictures` of one camera in place of the vertices.
"""

import pathlib
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.dataset import turned
from jaxprt import RelitScene, memory, precompute
from jaxprt.brdf import Lambert
from jaxprt.relit import Clusters, Dynamic, Harmonics, Lobes, Terms
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin, load_mesh
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import ground_plane

LIGHTS = 16
GROUND = 7000  # vertices, beside 10,000 of the object
EDGE = 128  # pixels along an edge
REPEATS = 5
SHINY = TexturedMaterial(base_color=[0.8, 0.6, 0.4], metallic=0.5, roughness=0.35)
MATTE = Lambert([0.8, 0.6, 0.4])


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="TEXT", default="", help="cases whose names have TEXT, as 'lobe'")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed")
    arguments = parser.parse_args(options)
    size = 8 if arguments.quick else 64
    lights = turned(builtin.daylight(size=size), 3 if arguments.quick else LIGHTS)
    for name, relit in scenes(arguments.quick, arguments.only, size, arguments.store):
        harness.report(measure(name, relit, lights, 1 if arguments.quick else REPEATS), arguments.output)
        if name == "lobe":
            harness.report(measure_pictures(relit, lights, arguments.quick), arguments.output)


def cases(quick: bool) -> dict[str, tuple[Any, Any, dict[str, Any]]]:
    """The material, the recipe and the options of `precompute` of each case."""
    if quick:
        return {"lobe": (SHINY, Lobes(texels=4), {})}
    return {
        "lobe": (SHINY, Lobes(), {}),
        "lobe, no single texels": (SHINY, Lobes(texels=0), {}),
        "lobe, matte": (MATTE, Lobes(), {}),
        "lobe, 2 bounces": (SHINY, Lobes(), {"bounces": 2, "rays": 0}),
        "harmonic": (SHINY, Harmonics(), {}),
        "harmonic, matte": (MATTE, Harmonics(), {}),
        "separable": (SHINY, Terms(), {}),
        "separable, clusters": (SHINY, Clusters(), {}),
        "dynamic": (SHINY, Dynamic(), {}),
        "dynamic, no single texels": (SHINY, Dynamic(texels=0), {}),
    }


def scenes(quick: bool, only: str, size: int, store: pathlib.Path | None) -> Iterator[tuple[str, RelitScene]]:
    """The scenes that are measured; without real data the object is a sphere."""
    folder = harness.data()
    real = folder.is_dir() and not quick
    rings, sectors = (6, 8) if quick else (99, 100)
    mesh = load_mesh(folder / "meshes" / "rocker_arm.ply") if real else builtin.sphere(rings=rings, sectors=sectors)
    ground = ground_plane(mesh, vertices=36 if quick else GROUND)
    for name, (material, recipe, options) in cases(quick).items():
        if only in name:
            scene = Scene([Part("object", mesh, material), Part("ground", ground, material)])
            path = store and store / f"{name.replace(', ', '_').replace(' ', '_')}.prt"
            made = {"system": recipe, "size": size, "refine": False, "progress": False, "path": path, **options}
            yield name, precompute(scene, **made)


def measure(name: str, relit: RelitScene, lights: Sequence[Environment], repeats: int) -> dict[str, Any]:
    """The line of a system: radiance of all vertices."""
    eye = jnp.asarray(relit.camera.eye)
    batch = Environment(jnp.stack([light.radiance for light in lights]))
    many, first = processor_seconds(lambda: relit.radiance(batch, eye=eye), repeats)
    one, _ = processor_seconds(lambda: relit.radiance(lights[0], eye=eye), repeats)
    color = np.asarray(relit.radiance(batch, eye=eye))
    single = np.stack([np.asarray(relit.radiance(light, eye=eye)) for light in lights])
    error = np.abs(color - single).max() / np.abs(single).max()
    return line(name, relit, many, first, one, error, len(lights))


def measure_pictures(relit: RelitScene, lights: Sequence[Environment], quick: bool) -> dict[str, Any]:
    """The line of pictures from one camera."""
    edge = 16 if quick else EDGE
    camera = orbit(relit.mesh, azimuth=0.5, elevation=0.4, width=edge, height=edge)
    repeats = 1 if quick else 3
    many, first = processor_seconds(lambda: relit.pictures(lights, [camera]), repeats)
    one, _ = processor_seconds(lambda: relit.pictures(lights[:1], [camera]), repeats)
    pictures = relit.pictures(lights, [camera])[:, 0]
    single = np.stack([np.asarray(relit.picture(light, camera)) for light in lights])
    error = np.abs(pictures - single).max() / np.abs(single).max()
    return line("lobe, pixels", relit, many, first, one, error, len(lights))


def line(
    name: str, relit: RelitScene, many: float, first: float, one: float, error: float, lights: int
) -> dict[str, Any]:
    """A reported line."""
    return {
        **{"benchmark": "lights", "case": name, "seconds": many, "compile_seconds": max(first - many, 0.0)},
        **{"error": float(error), "bytes": memory(relit), "vertices": relit.vertices, "lights": lights},
        **{"peer": "one light", "peer_seconds": one, "peer_error": 0.0, "times": many / one},
    }


def processor_seconds(function: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Processor seconds of all threads: the median of the calls after the first, and the first."""
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        jax.block_until_ready(function())
        times.append(time.process_time() - start)
    return statistics.median(times[1:]), times[0]


if __name__ == "__main__":
    main()
