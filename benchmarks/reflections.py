"""How wrong are pictures of scenes whose parts light each other, and their indirect part alone? Beside Mitsuba 3's.

    python -m benchmarks.reflections [--quick] [--only SCENE] [--store FOLDER] [--pictures FOLDER] [--output FILE]

Four scenes by the lobe system with two bounces, made ready for every roughness from .05 to .8: spheres on a ground, the
Duck of Khronos' samples on a ground, two sides of chess, and a room. Each is looked at in ten random triples of a light
(turned about), a view and materials; parts are metals or dielectrics with roughness between .05 and .8. Lines
`roughness` have one roughness on all parts that are not grounds, half of them metals.

Mitsuba traces the same triangles and materials, two bounces too (our rays show one more), twice with unlike seeds, so
that noise falls out of each squared error. Pixels are means over squares there, and over 16 samples here;
`_of_4_samples` are the errors of 4. `error` is that of the whole picture, `indirect_error` that of light that was
reflected at least once, relative to that light; both are relative L2 over the pixels that surfaces fill, and the
medians over the triples. `indirect_fraction` is how much of the picture the indirect part is. `seconds` are of a new
picture of 16 samples, rays included. Without LLVM of version 17 or newer, which Mitsuba needs, there are no errors. A
store keeps Mitsuba's pictures too, so that a run that was stopped goes on.
"""

import dataclasses
import pathlib
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import harness, path_tracing
from benchmarks.published import interiors
from benchmarks.scenes import spheres, traced_parts
from jaxprt import RelitScene, files, image, memory, precompute
from jaxprt.image import raster
from jaxprt.relit import Lobes
from jaxprt.scene import (
    Camera,
    Environment,
    Part,
    Scene,
    TexturedMaterial,
    builtin,
    load_environment,
    load_scene,
)
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import rotate
from jaxprt.scene.mesh import ground_plane, split

EDGE, SAMPLES, TRIPLES, BOUNCES = 256, 144, 10, 2
FINAL = 16  # samples of our pixels
RANGE = (0.05, 0.8)
ROUGHNESS = (0.05, 0.1, 0.2, 0.4, 0.8)
SCENES = ("spheres", "duck", "chess", "room")
LIGHTS = ("grace_cross.hdr", "eucalyptus_rnl_cross.hdr", "polyhaven_courtyard_1k.exr", "uffizi_latlong_256x128.hdr")
_MATTE = TexturedMaterial(base_color=0.5, metallic=0.0, roughness=0.6)


class Triple(NamedTuple):
    """A light, a view and materials."""

    light: Environment
    camera: Camera
    materials: dict[str, TexturedMaterial]


class Sizes(NamedTuple):
    """How many random triples there are, Mitsuba's samples per pixel, and whether Mitsuba may take long for these."""

    triples: int
    samples: int
    quick: bool = False


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument(
        "--store", type=pathlib.Path, metavar="FOLDER", help="keep what was made, Mitsuba's pictures too"
    )
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write ours and Mitsuba's, both parts")
    parser.add_argument("--only", metavar="SCENE", help=f"one of {', '.join(SCENES)}")
    parser.add_argument(
        "--triples", type=int, default=TRIPLES, metavar="N", help="random ones; up to three of these at each roughness"
    )
    parser.add_argument("--samples", type=int, default=SAMPLES, metavar="N", help="Mitsuba's, per pixel")
    arguments = parser.parse_args(options)
    for name in SCENES[:1] if arguments.quick else SCENES:
        if arguments.only in (None, name):
            sizes = Sizes(1, 16, quick=True) if arguments.quick else Sizes(arguments.triples, arguments.samples)
            for line in measure(name, arguments.quick, arguments.store, arguments.pictures, sizes):
                harness.report(line, arguments.output)


def scene_of(name: str, quick: bool) -> Scene:
    """What is relit; parts without textures."""
    if name == "spheres":
        parts = spheres(sectors=12 if quick else 96, ground=36 if quick else 4900).parts
        return Scene(
            [dataclasses.replace(each, material=_MATTE) for each in (parts[:1] if quick else parts[:3]) + parts[3:]]
        )
    if name == "duck":
        duck = load_scene(harness.data() / "scenes" / "Duck.glb")
        plain = [dataclasses.replace(each, material=_MATTE) for each in duck.parts]
        return Scene([*plain, Part("ground", ground_plane(duck.mesh, vertices=4900), _MATTE)])
    mesh = interiors.chess_sides() if name == "chess" else interiors.room()
    return Scene([Part(f"region {number}", each, _MATTE) for number, each in enumerate(split(mesh))])


def measure(name: str, quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None, sizes: Sizes):
    """Lines of one scene."""
    scene = scene_of(name, quick)
    lights = lights_of(quick)
    path = store and store / f"reflections_{name}"
    recipe = Lobes(lobes=8, texels=2) if quick else Lobes(lobes=8)
    low = (0.4, 0.5) if quick else RANGE
    size = lights[0].radiance.shape[-2]
    whole = precompute(scene, refine=False, system=recipe, bounces=BOUNCES, size=size, path=path, progress=False)
    common = {"benchmark": "reflections", "scene": name, "vertices": whole.vertices, "bytes": memory(whole)}
    keep = store and store / f"mitsuba_{name}"
    random = np.random.default_rng(5)
    every = [drawn(random, name, scene, lights, low, quick) for _ in range(sizes.triples)]
    found = judged(whole, every, sizes, pictures and pictures / name, keep)
    yield {**common, "case": f"{name}, random materials", **found}
    for roughness in ROUGHNESS[2:3] if quick else ROUGHNESS:
        rough = max(roughness, low[0])
        few = every[: min(3, -(-sizes.triples // 3))]
        alike = [each._replace(materials=of_roughness(each.materials, rough)) for each in few]
        folder = pictures and pictures / f"{name}_{roughness}"
        own = keep and keep / f"roughness_{roughness}"
        yield {**common, "case": f"{name}, roughness {roughness}", **judged(whole, alike, sizes, folder, own)}


def lights_of(quick: bool) -> list[Environment]:
    """What scenes are lit by."""
    paths = [harness.data() / "env" / file for file in LIGHTS]
    found = [] if quick else [load_environment(path) for path in paths if path.is_file()]
    return found or ([builtin.studio(size=8)] if quick else [builtin.daylight(), builtin.studio()])


def drawn(
    random, name: str, scene: Scene, lights: list[Environment], roughness: tuple[float, float], quick: bool
) -> Triple:
    """A random triple."""
    light = lights[random.integers(len(lights))]
    turn = 2 * np.pi * random.random()
    about = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    turned = rotate(light, jnp.asarray(about, jnp.float32))
    edge = 16 if quick else EDGE
    angle, height = 2 * np.pi * random.random(), random.uniform(0.2, 0.6)
    if name == "room":  # open to one side only, through which it is looked into
        angle, height = 0.05 * (angle - np.pi), height / 5
    camera = orbit(scene.mesh, azimuth=angle, elevation=height, width=edge, height=edge)
    materials = {}
    for part in scene.parts:
        color = random.uniform(0.2, 0.9, 3)
        rough = float(np.exp(random.uniform(*np.log(roughness))))
        metal = float(random.random() < 0.5 and part.name != "ground")
        materials[part.name] = TexturedMaterial(base_color=jnp.asarray(color), metallic=metal, roughness=rough)
    return Triple(turned, camera, materials)


def of_roughness(materials: dict[str, TexturedMaterial], roughness: float) -> dict[str, TexturedMaterial]:
    """The same materials with one roughness, but for grounds; every second one a metal."""
    return {
        name: each
        if name == "ground"
        else TexturedMaterial(base_color=each.base_color, metallic=float(number % 2 == 0), roughness=roughness)
        for number, (name, each) in enumerate(materials.items())
    }


def judged(
    whole: RelitScene, triples: list[Triple], sizes: Sizes, folder: pathlib.Path | None, keep: pathlib.Path | None
) -> dict:
    """Medians over some triples."""
    direct = whole.without_bounces()
    first = triples[0]
    timing = harness.measure(
        lambda: whole.picture(first.light, first.camera, materials=first.materials, samples=FINAL), repeats=3
    )
    rows = []
    for number, (light, camera, materials) in enumerate(triples):
        rough, rough_alone, mine, alone = (
            np.asarray(each.picture(light, camera, materials=materials, samples=samples))
            for samples in (4, FINAL)
            for each in (whole, direct)
        )
        if not (sizes.quick or path_tracing.available()):
            continue
        parts = [dataclasses.replace(each, material=materials[each.name]) for each in whole.scene.parts]
        exact, spent = kept(keep and keep / f"{number}.npz", Scene(parts), light, camera, sizes.samples)
        # Pixels that surfaces fill: at silhouettes ours have the background, which Mitsuba leaves out.
        shown = (np.asarray(raster.rasterize(whole.mesh, camera, samples=4).triangle) >= 0).all(-1, keepdims=True)
        filled = [(a * shown, b * shown) for a, b in exact]
        coarser = off(rough * shown, rough_alone * shown, filled)
        rows.append(
            off(mine * shown, alone * shown, filled)
            | {f"{key}_of_4_samples": coarser[key] for key in ("error", "direct_error", "indirect_error")}
            | {"peer_seconds": spent}
        )
        print(number, {key: round(value, 4) for key, value in rows[-1].items()}, flush=True)
        if folder is not None:
            write(folder / f"triple_{number}.png", mine, alone, exact[0])
    none = {"error": None, "peer_seconds": None, "peer_error": None}
    found = {key: float(np.median([row[key] for row in rows])) for key in rows[0]} if rows else none
    return {**timing.line(), **found, "peer": "mitsuba", "peer_samples": sizes.samples}


def kept(path: pathlib.Path | None, *asked: Any) -> tuple[list[tuple[np.ndarray, np.ndarray]], float]:
    """The result of `reference` and the seconds of one of its pictures, from a file if there is one."""
    if path is not None and path.is_file():
        with np.load(path) as file:
            return [(one, other) for one, other in file["pictures"]], float(file["seconds"])
    start = time.perf_counter()
    made = reference(*asked)
    spent = (time.perf_counter() - start) / 4  # two of four pictures have the bounces
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, pictures=np.asarray(made, np.float32), seconds=spent)
    return made, spent


def reference(
    scene: Scene, light: Environment, camera: Camera, samples: int, *, bounces: int = BOUNCES
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Two pictures with bounces and two of direct light, of unlike seeds."""
    parts = traced_parts(scene)
    depths = (2 + bounces, 2)
    return [
        tuple(path_tracing.trace(parts, light, camera, depth=depth, samples=samples, seed=seed) for depth in depths)
        for seed in (1, 2)
    ]  # pyright: ignore[reportReturnType]


def off(mine: np.ndarray, alone: np.ndarray, exact: list[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Errors of the whole picture and of its indirect part."""
    (one, one_direct), (other, other_direct) = exact
    indirect = one - one_direct, other - other_direct
    part = norm(0, *indirect)
    return {
        "error": norm(mine, one, other) / norm(0, one, other),
        "peer_error": float(np.linalg.norm(one - other) / 2**0.5) / norm(0, one, other),
        "direct_error": norm(alone, one_direct, other_direct) / norm(0, one_direct, other_direct),
        "indirect_error": norm(mine - alone, *indirect) / part,
        "indirect_fraction": part / norm(0, one, other),
        "indirect_bias": float(np.sum(mine - alone) / np.mean([np.sum(each) for each in indirect]) - 1),
    }


def norm(value, one: np.ndarray, other: np.ndarray) -> float:
    """Norm of the difference from a picture that is known as two noisy ones, whose noise falls out of the product."""
    return float(np.sqrt(max(np.sum((value - one) * (value - other), dtype=np.float64), 0)))


def write(path: pathlib.Path, mine: np.ndarray, alone: np.ndarray, exact: tuple[np.ndarray, np.ndarray]) -> None:
    """Writes our picture and Mitsuba's, and the indirect parts of both, at the exposure of Mitsuba's."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stops = image.automatic_exposure(jnp.asarray(exact[0]))
    row = np.concatenate([mine, exact[0], np.maximum(mine - alone, 0), np.maximum(exact[0] - exact[1], 0)], 1)
    files.write_png(path, np.asarray(image.display(image.expose(jnp.asarray(row), stops=stops))))


if __name__ == "__main__":
    main()
