"""What do scenes like those of Sun et al. 2007 cost, with two bounces? The columns of their Table 1.

    python -m benchmarks.paper_scenes [--quick] [--only SCENE...] [--most VERTICES] [--store FOLDER]
        [--output FILE]
    python -m benchmarks.paper_scenes --table FILE      prints the lines of a file as a table

Scenes have several parts whose materials change while all of them light each other. Room, chess, walls and ring are
made by formula (`benchmarks/published/interiors.py`). The others stand in for the paper's meshes, which are not public:
scans of JAXPRT_DATA, simplified so that each scene has the paper's number of vertices. Without the data spheres replace
them.

Lines `precompute` have the time of transport and bounces, the bytes of the bounces' tensor and of the direct light, and
the peak of the process's memory. Where a run was stopped, a `--store` goes on from there, and the seconds of all runs
are added up. `--most` leaves out the scenes whose counterpart in the paper has more vertices.

Lines `frame` are of a picture of 512 x 512 pixels with 4 samples of coverage each: all vertices are relit and then
drawn, as in the paper. `view` has a new view in each frame, `material` a new view and new materials, `light` a new
light too. `peer_seconds` are the paper's, on two Xeons of 3.2 GHz and a GeForce 7800 in 2007: Table 1 of the paper,
columns V, V&B and V,B&L, and for `precompute` the sum of its columns Precomp and Compress.

`error` is what the tensor of the first bounce leaves out of what arrives, rms over clusters. Where Mitsuba 3 can run,
lines have errors against it with as many bounces, in the light's own pixels, over the pixels that the scene fills:
`frame_error` of a frame as it is timed, `picture_error` of a picture whose radiance is that of its pixels, with
reflection rays, and `direct_error` of that picture without bounces.
"""

import dataclasses
import itertools
import json
import pathlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness, path_tracing
from benchmarks.paper_recipes import RECIPES, Look, Published, Recipe
from benchmarks.path_tracing import Exact
from benchmarks.published.lobes import BrdfSet
from jaxprt import bounces, separable
from jaxprt.brdf import BlinnPhong, CookTorrance, Lambert
from jaxprt.image import render
from jaxprt.relit import Dynamic, paths
from jaxprt.relit.groups import joined_mesh
from jaxprt.scene import Camera, Environment, Mesh, TexturedMaterial, builtin, load_environment
from jaxprt.scene.environment import rotate
from jaxprt.scene.mesh import bounds, split
from jaxprt.systems import standard
from jaxprt.systems.bounces.functions import FunctionWeights

EDGE = 512  # pixels
KINDS = ("view", "material", "light")  # of frames
ERRORS = ("frame_error", "picture_error", "direct_error")
EXPONENTS, _FINE = (200.0, 60.0, 20.0), 40  # of sharp light paths, from the sharpest; edge of their maps in texels
RAYS = 16  # of mirror images, which scenes have after `with_rays`
SIZE, BOUNCES = 32, 2  # edge of the light's faces for direct light, and number of bounces
ORIGINAL, SAMPLES = 256, 64  # edge of the light's faces for Mitsuba, and its samples in each of two pictures


class Made(NamedTuple):
    """A scene that is ready to be relit.

    Attributes:
        name: Name of the scene.
        recipe: How it was made.
        scene: The scene. Its parts are named by the numbers of their regions.
        seconds: What precomputation took, over all runs.
        peak: The most memory that a process of it had.
    """

    name: str
    recipe: Recipe
    scene: prt.RelitScene
    seconds: float
    peak: int

    @property
    def tensor(self) -> bounces.TransferTensor:
        """The tensor of the bounces."""
        assert self.scene.bounces is not None
        return self.scene.bounces.tensor

    def materials(self, changed: Look | None = None) -> dict[str, Any]:
        """Materials of the free regions; `changed` has those of some, as `Recipe.free` has them."""
        looks = {**self.recipe.free, **(changed or {})}
        return {str(number): model(self.recipe.space, look) for number, look in looks.items()}


def model(space: str, look: tuple[Any, Any, Any]) -> BlinnPhong | CookTorrance:
    """The BRDF of a free region."""
    diffuse, specular, place = look
    if space == "BP":
        return BlinnPhong(diffuse, specular, place)
    return CookTorrance(diffuse, specular, place[1], place[0])


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed, and go on")
    parser.add_argument("--only", nargs="+", choices=list(RECIPES), metavar="SCENE", help=", ".join(RECIPES))
    parser.add_argument("--most", type=int, metavar="VERTICES", help="leave larger scenes out")
    parser.add_argument("--table", type=pathlib.Path, metavar="FILE", help="print lines of that file as a table")
    arguments = parser.parse_args(options)
    if arguments.table:
        print(table([json.loads(line) for line in arguments.table.read_text().splitlines()]))
        return
    names = arguments.only or (["walls"] if arguments.quick else list(RECIPES))
    if arguments.most:
        names = [name for name in names if not (row := RECIPES[name].published) or row.vertices <= arguments.most]
    if len(names) > 1:
        _apart(names, sys.argv[1:] if options is None else options)
        return
    for name in names:
        for line in measure(prepare(name, quick=arguments.quick, store=arguments.store), arguments.quick):
            harness.report(line, arguments.output)


def _apart(names: Sequence[str], options: Sequence[str]) -> None:
    """Runs each scene in a process of its own, whose peak of memory is that of one scene."""
    for name in names:
        command = [sys.executable, "-m", "benchmarks.paper_scenes", *options, "--only", name]
        subprocess.run(command, check=True)


def prepare(name: str, *, quick: bool = False, store: pathlib.Path | None = None, **options: Any) -> Made:
    """Makes a scene ready.

    Args:
        name: One of `RECIPES`.
        quick: A small scene of the same regions.
        store: Folder that keeps what is finished.
        options: Options of `bounces.precompute` that replace those of the recipe.
    """
    recipe = RECIPES[name]
    wanted = (
        {"bounces": BOUNCES, "direct": 16, **options} if quick else {"bounces": BOUNCES, **recipe.options, **options}
    )
    count, size, path = wanted.pop("bounces"), wanted.pop("direct", SIZE), store and store / name
    parts, whole = [], recipe.mesh(quick)
    for number, mesh in enumerate(split(whole)):
        free = number in recipe.free
        material = model(recipe.space, recipe.free[number]) if free else matte(recipe.fixed[number])
        parts.append(prt.Part(str(number), mesh, material))
    start = time.perf_counter()
    marks = "_".join(f"{key}{value}" for key, value in {"direct": size, **wanted}.items())
    try:
        options = {
            "refine": False,
            "size": size,
            "rays": RAYS,
            "progress": False,
            "path": path and path / f"direct{size}",
        }
        system = Dynamic(lobes=4, ranks=None) if quick else Dynamic()
        scene = prt.Scene(parts, [camera_of(recipe, whole)])
        scene = prt.precompute(scene, system=system, bounces=1 if wanted else count, **options)
        if wanted:
            scene = with_transfer(scene, path and path / marks, bounces=count, **wanted)
    finally:
        seconds, peak = _spent(path and path / f"{marks}_bounces{count}.json", time.perf_counter() - start)
    return Made(name, recipe, scene.with_rays(0), seconds, peak)


def models(ready: Made, changed: Look | None = None) -> list[Any]:
    """BRDFs of all regions, for Mitsuba; `changed` is that of `Made.materials`."""
    free = ready.materials(changed)
    names = [part.name for part in ready.scene.scene.parts]
    return [free.get(name) or Lambert(ready.recipe.fixed[int(name)]) for name in names]


def traced(
    ready: Made,
    changed: Look | None = None,
    *,
    camera: Camera,
    light: Environment | None = None,
    bounces: int = BOUNCES,
    samples: int = SAMPLES,
) -> Exact:
    """Mitsuba's pictures of a scene with so many bounces, with the coverage of ours."""
    light, cover = light_of(ready) if light is None else light, ready.scene.coverage(camera)[..., None]
    mesh, materials = joined_mesh(ready.scene.shading), models(ready, changed)
    options = {"depth": 2 + bounces, "samples": samples}
    halves = (path_tracing.picture(mesh, materials, light, camera, seed=seed, **options) for seed in (0, 1))
    return Exact(*(np.concatenate([radiance, cover], -1) for radiance in halves))


def rms(value: Any) -> float:
    """Root mean square."""
    return float(jnp.sqrt(jnp.mean(jnp.asarray(value) ** 2)))


def matte(albedo: Any) -> TexturedMaterial:
    """The material of a region that does not change."""
    return TexturedMaterial(base_color=albedo, metallic=0.0, roughness=1.0, specular=0.0)


def with_transfer(
    scene: prt.RelitScene, path: pathlib.Path | None = None, *, terms: int | None = None, **options: Any
) -> prt.RelitScene:
    """The scene with reflected light that is precomputed with other options, and a region for each part.

    With `terms`, light paths off parts of Blinn-Phong have as many terms, and lobes of `EXPONENTS` as they are.
    """
    assert scene.bounces is not None
    shadings = [scene.shading[parts[0]] for parts in scene.layout.parts]
    lights = [
        sharp_path(terms) if terms is not None and shading.table == standard.BLINN_PHONG else paths.factor(shading)
        for shading in shadings
    ]
    weights = [paths.typical(part, lights[n]) for part, n in zip(scene.shading, scene.layout.group, strict=True)]
    brdfs, mesh = [lights[number].brdf for number in scene.layout.group], joined_mesh(scene.shading)
    tensor = bounces.precompute(mesh, brdfs, weights=weights, run=prt.Run(path, progress=False), **options)
    vertices = [scene.layout.vertices(number) for number in range(len(lights))]
    groups = [
        dataclasses.replace(group, sent=light.sent) for group, light in zip(scene.bounces.group, lights, strict=True)
    ]
    made = bounces.GroupBounces.make(tensor, groups, vertices)
    return eqx.tree_at(lambda relit: relit.bounces, scene, made)


def sharp_path(terms: int) -> paths.Path:
    """Light paths of Blinn-Phong's lobes that are not smoothed over outgoing directions, so that caustics are sharp.

    Functions are the lobes of `EXPONENTS` and a diffuse one. Between exponents the weights are interpolated.
    """
    lobes = BrdfSet.of([BlinnPhong(0.0, 1.0, exponent) for exponent in EXPONENTS])
    factored = separable.factor(lobes, terms=terms, resolution=_FINE)
    light = jnp.concatenate([factored.light_map, jnp.ones_like(factored.light_map[:1])])
    view = jnp.pad(factored.view_map, ((0, 1), (0, 0), (0, 0), (0, 1))).at[-1, ..., -1].set(1 / np.pi)
    brdf = separable.SeparableBrdf(light, view, factored.error, factored.coordinates)
    exact = np.append(paths.channels(lobes), 1.0)
    scale = exact / np.asarray(bounces.functions.albedo(brdf))
    weight = np.zeros((len(EXPONENTS), 2, len(scale)), np.float32)  # of the diffuse channel and of the lobe
    weight[:, 0, -1], weight[:, 1, :-1] = scale[-1], np.diag(scale[:-1])
    weight *= standard.BLINN_PHONG.scale[:, None]
    knot = -np.log((np.asarray(EXPONENTS) + 2) / 2) / 2  # the logarithm of the roughness of the standard table
    return paths.Path(brdf, FunctionWeights((jnp.asarray(knot, jnp.float32),), jnp.asarray(weight)))


def _spent(path: pathlib.Path | None, seconds: float) -> tuple[float, int]:
    """Seconds of all runs until everything was there, and the most memory of any; a run that found it adds none."""
    peak, before = harness.peak_memory(), {"seconds": 0.0, "peak": 0, "done": False}
    if path is not None and path.is_file():
        before = json.loads(path.read_text())
    if before["done"]:
        return before["seconds"], before["peak"]
    done = sys.exc_info()[0] is None
    found = {"seconds": before["seconds"] + seconds, "peak": max(before["peak"], peak), "done": done}
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(found))
    return found["seconds"], found["peak"]


def measure(made: Made, quick: bool) -> Iterator[dict[str, Any]]:
    """Lines of one scene."""
    tensor, row = made.tensor, made.recipe.published
    direct = prt.memory(made.scene.without_bounces())
    common = {
        **{"benchmark": "paper_scenes", "scene": made.name, "space": made.recipe.space},
        **{"vertices": made.scene.vertices, "regions": len(made.scene.shading), "adjustable": len(made.recipe.free)},
        **{"bytes": tensor.nbytes, "direct_bytes": direct, "error": rms(tensor.error)},
        "worth": [round(float(each), 4) for each in tensor.worth],
        **errors(made, quick),
    }
    peer: dict[str, Any] = {}
    if row is not None:
        peer = {"peer": f"Sun et al. 2007, {row.name}", "peer_error": None, "peer_vertices": row.vertices}
        peer |= {"peer_adjustable": row.adjustable, "peer_bytes": 1e6 * row.megabytes}
    spent = {"seconds": made.seconds, "compile_seconds": 0.0, "peak_bytes": made.peak}
    theirs = {"peer_seconds": 3600 * sum(row.hours)} if row else {}
    yield {**common, "case": f"{made.name}, precompute", **spent, **peer, **theirs}
    kinds, functions = zip(*frames(made, quick), strict=True)
    timings = harness.alternate(functions, repeats=2 if quick else 9)
    for number, (kind, timing) in enumerate(zip(kinds, timings, strict=True)):
        theirs = {"peer_seconds": 1 / row.fps[number], "peer_fps": row.fps[number]} if row else {}
        yield {
            **{**common, "case": f"{made.name}, frame, new {kind}", **timing.line(), "fps": 1 / timing.seconds},
            **{**peer, **theirs},
        }


def errors(made: Made, quick: bool) -> dict[str, float]:
    """Relative L2 against Mitsuba in the light's own pixels; nothing where it cannot run."""
    if not path_tracing.available():
        return {}
    camera, light = camera_of(made.recipe, made.scene.mesh, edge=32 if quick else EDGE), light_of(made)
    original = light if quick else light_of(made, size=ORIGINAL)
    exact = traced(made, camera=camera, light=original)
    materials = made.materials()
    color = prt.radiance(made.scene, light, eye=camera.eye, materials=materials)
    cover = jnp.asarray(made.scene.coverage(camera))[..., None]
    drawn = {"frame_error": jnp.concatenate([render(made.scene.mesh, color, camera), cover], -1)}
    rays = made.scene.with_rays(RAYS)
    for name, scene in (("picture_error", rays), ("direct_error", rays.without_bounces())):
        drawn[name] = scene.picture(light, camera, materials=materials, background=None)
    return {name: exact.off(np.asarray(picture)) for name, picture in drawn.items()}


def table(lines: Sequence[Mapping[str, Any]]) -> str:
    """The columns of the paper's Table 1 in Markdown, the paper's figures in parentheses; of a case the last line.

    Args:
        lines: What was reported, of any scenes; those whose frames are not all there are left out.
    """
    rows = [
        "| scene (the paper's) | vertices | regions, free | precomputation, minutes | storage, MB | peak, GB "
        "| new view, fps | new material, fps | new light, fps | frame off | picture off | without bounces |",
        "|---" * 12 + "|",
    ]
    found = {line["case"]: line for line in lines}
    for name in RECIPES:
        cases = [f"{name}, precompute", *(f"{name}, frame, new {kind}" for kind in KINDS)]
        if not all(case in found for case in cases):
            continue
        first, *each = (found[case] for case in cases)
        row = RECIPES[name].published
        theirs = [""] * 6 if row is None else [f" ({value})" for value in _figures(row)]
        title = name if row is None else f"{name} ({row.name})"
        cells = [
            f"{first['vertices']:,}{theirs[0]}",
            f"{first['regions']}, {first['adjustable']}" + ("" if row is None else f" ({row.adjustable} free)"),
            f"{first['seconds'] / 60:.1f}{theirs[1]}",
            f"{(first['bytes'] + first['direct_bytes']) / 1e6:.0f}{theirs[2]}",
            f"{first['peak_bytes'] / 1e9:.1f}",
            *(f"{line['fps']:.1f}{fps}" for line, fps in zip(each, theirs[3:], strict=True)),
            *(f"{100 * first[key]:.1f} %" if key in first else "" for key in ERRORS),
        ]
        rows.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _figures(row: Published) -> list[str]:
    """Figures of the paper as they are printed: vertices, minutes, MB, frames a second."""
    minutes, megabytes = f"{60 * sum(row.hours):,.0f}", f"{row.megabytes:g}"
    return [f"{row.vertices:,}", minutes, megabytes, *(f"{each:.2f}" for each in row.fps)]


def frames(made: Made, quick: bool) -> Iterator[tuple[str, Callable[[], jax.Array]]]:
    """Kind and function of each frame: every call has another view, other materials, another light."""
    edge = 32 if quick else EDGE
    cameras = [camera_of(made.recipe, made.scene.mesh, edge=edge, turn=turn) for turn in (0.0, 0.15, 0.3)]
    lights = [turned(light_of(made), turn) for turn in (0.0, 0.7, 1.4)]
    materials = [made.materials(_darker(made, amount)) for amount in (1.0, 0.8, 0.6)]
    system, count = made.scene, itertools.count()
    lit = system.light(lights[0])
    shaded = system.shade(lit, materials[0])

    def frame(matter: bool, light: bool) -> jax.Array:
        number = next(count) % 3
        now = materials[number if matter else 0]
        arrived = shaded
        if matter:
            arrived = system.shade(system.light(lights[number]) if light else lit, now)
        color = system.combine(arrived, system.view(cameras[number].eye, now))
        return render(system.mesh, color, cameras[number], background=None)

    changes = ((False, False), (True, False), (True, True))
    for kind, change in zip(KINDS, changes, strict=True):
        yield kind, partial(frame, *change)


def _darker(made: Made, amount: float) -> Look:
    """Materials of all free regions with other colors, and in other places of the set."""
    free = made.recipe.free.items()
    return {number: tuple(amount * np.asarray(each, float) for each in look) for number, look in free}  # pyright: ignore


def light_of(made: Made, size: int | None = None) -> Environment:
    """The light of a scene; in texels of its size, unless another one is given."""
    name, size = made.recipe.light, size or made.scene.surfaces[0].system.light_size
    assert size is not None
    path = harness.data() / "env" / name
    return load_environment(path, size=size) if path.is_file() else builtin.daylight(size=size)


def turned(light: Environment, turn: float) -> Environment:
    """A light turned about the vertical axis."""
    cosine, sine = np.cos(turn), np.sin(turn)
    about = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], np.float32)
    return rotate(light, jnp.asarray(about)) if turn else light


def camera_of(recipe: Recipe, mesh: Mesh, *, edge: int = EDGE, turn: float = 0.0) -> Camera:
    """The camera of a scene with a mesh, turned about the vertical axis through what it looks at."""
    low, high = bounds(mesh)
    diagonal, (eye, target, angle) = float(np.linalg.norm(high - low)), recipe.camera
    middle = (low + high) / 2 + diagonal * np.asarray(target)
    away = diagonal * (np.asarray(eye) - np.asarray(target))
    cosine, sine = np.cos(turn), np.sin(turn)
    away = away @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    return Camera(middle + away, middle, [0.0, 1.0, 0.0], angle, edge, edge)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # So that the seconds of a run that is stopped are kept.
    main()
