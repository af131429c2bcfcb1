"""What do scenes like those of Sun et al. 2007 cost, with two bounces? The columns of their Table 1.

    python -m benchmarks.paper_scenes [--quick] [--only SCENE...] [--most VERTICES] [--store FOLDER]
        [--output FILE]
    python -m benchmarks.paper_scenes --table FILE      prints the lines of a file as a table

Scenes have several regions whose materials change while all of them light each other. Room, chess, walls and ring are
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

`error` is what the tensor of the first bounce leaves out of what arrives, rms over clusters.
"""

import itertools
import json
import pathlib
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness
from benchmarks.interreflection import rms
from benchmarks.paper_recipes import RECIPES, Look, Published, Recipe
from jaxprt import bounces, dynamic, separable
from jaxprt.brdf import Lambert, navigation
from jaxprt.image import render
from jaxprt.scene import Camera, Environment, Mesh, builtin, load_environment
from jaxprt.scene.environment import rotate
from jaxprt.scene.mesh import bounds

EDGE = 512  # pixels
LOBES = 6
KINDS = ("view", "material", "light")  # of frames
SIZES = {"direct": 32, "edge": 8, "size": 16, "components": 32, "modes": 64, "bounces": 2}
COOK_TORRANCE = tuple(itertools.product((0.0, 1.0), (0.05, 0.1, 0.2, 0.4, 0.8)))  # F0 and roughness
BLINN_PHONG = (2.0, 6.0, 20.0, 60.0, 200.0)
PATHS = {
    "functions": 3,
    "terms": 16,
}  # of sets along light paths, besides the diffuse one; the paper has four functions
SHARP = (20.0, 200.0)  # exponents where caustics are looked at
SHARP_TERMS = 40


class Made(NamedTuple):
    """A scene that is ready to be relit.

    Attributes:
        name: Name of the scene.
        recipe: How it was made.
        mesh: Mesh of the scene.
        system: Direct light and bounces.
        navigation: From coordinates to weights of the set.
        seconds: What precomputation took, over all runs.
        peak: The most memory that a process of it had.
    """

    name: str
    recipe: Recipe
    mesh: Mesh
    system: Any
    navigation: Any
    seconds: float
    peak: int

    @property
    def tensor(self) -> bounces.TransferTensor:
        """The tensor of the bounces."""
        return self.system.part[1].tensor

    def materials(self, changed: Look | None = None) -> list[dynamic.Material | None]:
        """Materials of all regions; `changed` has those of some free regions, as `Recipe.free` has them."""
        free = {**self.recipe.free, **(changed or {})}
        return [self._material(*free[number]) if number in free else None for number in range(_regions(self.mesh))]

    def _material(self, diffuse: Any, specular: Any, coordinate: Any) -> dynamic.Material:
        colors = (jnp.broadcast_to(jnp.asarray(each, jnp.float32), 3) for each in (diffuse, specular))
        return dynamic.Material(self.navigation.weight(jnp.asarray(coordinate, jnp.float32)), *colors)


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
    for name in arguments.only or (["walls"] if arguments.quick else RECIPES):
        published = RECIPES[name].published
        if arguments.most and published and published.vertices > arguments.most:
            continue
        for line in measure(prepare(name, quick=arguments.quick, store=arguments.store), arguments.quick):
            harness.report(line, arguments.output)


def prepare(name: str, *, quick: bool = False, store: pathlib.Path | None = None, **options: Any) -> Made:
    """Makes a scene ready.

    Args:
        name: One of `RECIPES`.
        quick: A small scene of the same regions.
        store: Folder that keeps what is finished.
        options: Options of `bounces.precompute` that replace those of the recipe.
    """
    recipe = RECIPES[name]
    mesh = recipe.mesh(quick)
    sharp = "edge" in recipe.options  # finer light than that of the paper's scenes
    seen, met, family = sets(recipe.space, quick=quick, sharp=sharp)
    regions: list[Any] = [seen] * _regions(mesh)
    paths: list[Any] = [met] * len(regions)
    for number, albedo in recipe.fixed.items():
        fixed = separable.factor(Lambert(albedo), terms=1, resolution=8)
        regions[number], paths[number] = fixed, fixed
    folder = store and store / name
    given: dict[str, Any] = {**SIZES, **recipe.options, **options}
    size = given.pop("direct")
    if quick:
        size, given = 16, given | {"edge": 4, "size": 8, "components": 8, "modes": 16}
    marks = "_".join(f"{key}{value}" for key, value in given.items() if key != "bounces")
    start = time.perf_counter()
    try:
        path = folder and folder / f"direct{size}"
        transport = dynamic.precompute_sets(mesh, regions, size=size, path=path, progress=False)
        tensor = bounces.precompute(mesh, paths, path=folder and folder / marks, progress=False, **given)
    finally:
        kept = folder and folder / f"{marks}_bounces{given['bounces']}.json"
        seconds, peak = _spent(kept, time.perf_counter() - start)
    direct = dynamic.SetSystem(transport, regions, samples=1 if quick else 2)
    system = prt.total(direct, bounces.BouncesSystem(tensor, direct))
    return Made(name, recipe, mesh, system, family.navigation, seconds, peak)


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


def sets(space: str, *, quick: bool, sharp: bool) -> tuple[dynamic.BrdfSet, dynamic.BrdfSet, navigation.Family]:
    """What is seen of a set of BRDFs, by lobes, what light meets on its way, by terms, and the way through the set.

    Usual light paths have 16 terms and views smoothed to degree 5. Sharp ones, for caustics, have a tensor of the
    BRDFs themselves with more terms, which keeps lobes narrower.
    """
    if space == "BP":
        knots = SHARP if sharp else BLINN_PHONG
        family = navigation.blinn_phong(exponents=(knots[0], knots[-1]) if quick else knots)
    else:
        family = navigation.cook_torrance(
            point=np.array([each for each in COOK_TORRANCE if not quick or each[1] in (0.05, 0.8)])
        )
    seen = dynamic.factor(family.brdf, dynamic.separate(family.brdf, lobes=1 if quick else LOBES))
    sizes: dict[str, Any] = {"functions": 2, "terms": 4, "resolution": 8} if quick else PATHS
    if not sharp:
        return seen, bounces.factor(family.brdf, navigation=family.navigation, **sizes), family
    ranks = (2, 4, 4) if quick else (len(family.brdf), SHARP_TERMS, SHARP_TERMS)
    return seen, dynamic.factor(family.brdf, None, ranks=ranks, resolution=8 if quick else 32), family


def measure(made: Made, quick: bool) -> Iterator[dict[str, Any]]:
    """Lines of one scene."""
    tensor, row = made.tensor, made.recipe.published
    direct = prt.memory(made.system.part[0])
    common = {
        **{"benchmark": "paper_scenes", "scene": made.name, "space": made.recipe.space},
        **{"vertices": len(made.mesh.position), "regions": _regions(made.mesh), "adjustable": len(made.recipe.free)},
        **{"bytes": tensor.nbytes, "direct_bytes": direct, "error": rms(tensor.error)},
        "worth": [round(float(each), 4) for each in tensor.worth],
    }
    peer: dict[str, Any] = {}
    if row is not None:
        peer = {"peer": f"Sun et al. 2007, {row.name}", "peer_error": None, "peer_vertices": row.vertices}
        peer |= {"peer_adjustable": row.adjustable, "peer_bytes": 1e6 * row.megabytes}
    spent = {"seconds": made.seconds, "compile_seconds": 0.0, "peak_bytes": made.peak}
    theirs = {"peer_seconds": 3600 * sum(row.hours)} if row else {}
    yield {**common, "case": f"{made.name}, precompute", **spent, **peer, **theirs}
    for number, (kind, frame) in enumerate(frames(made, quick)):
        timing = harness.measure(frame, repeats=2 if quick else 9)
        theirs = {"peer_seconds": 1 / row.fps[number], "peer_fps": row.fps[number]} if row else {}
        yield {
            **{**common, "case": f"{made.name}, frame, new {kind}", **timing.line(), "fps": 1 / timing.seconds},
            **{**peer, **theirs},
        }


def table(lines: Sequence[Mapping[str, Any]]) -> str:
    """The columns of the paper's Table 1 in Markdown, the paper's figures in parentheses; of a case the last line.

    Args:
        lines: What was reported, of any scenes; those whose frames are not all there are left out.
    """
    rows = [
        "| scene (the paper's) | vertices | regions, free | precomputation, minutes | tensor, MB | peak, GB "
        "| new view, fps | new material, fps | new light, fps |",
        "|---" * 9 + "|",
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
            f"{first['bytes'] / 1e6:.0f}{theirs[2]}",
            f"{first['peak_bytes'] / 1e9:.1f}",
            *(f"{line['fps']:.1f}{fps}" for line, fps in zip(each, theirs[3:], strict=True)),
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
    cameras = [camera_of(made, edge=edge, turn=turn) for turn in (0.0, 0.15, 0.3)]
    lights = [turned(light_of(made), turn) for turn in (0.0, 0.7, 1.4)]
    materials = [made.materials(_darker(made, amount)) for amount in (1.0, 0.8, 0.6)]
    system, count = made.system, itertools.count()
    lit = system.light(lights[0])
    shaded = system.shade(lit, materials[0])

    def frame(matter: bool, light: bool) -> jax.Array:
        number = next(count) % 3
        now = materials[number if matter else 0]
        arrived = shaded
        if matter:
            arrived = system.shade(system.light(lights[number]) if light else lit, now)
        color = system.combine(arrived, system.view(cameras[number].eye, now))
        return render(made.mesh, color, cameras[number], background=None)

    changes = ((False, False), (True, False), (True, True))
    for kind, change in zip(KINDS, changes, strict=True):
        yield kind, partial(frame, *change)


def _darker(made: Made, amount: float) -> Look:
    """Materials of all free regions with other colors, and in other places of the set."""
    free = made.recipe.free.items()
    return {number: tuple(amount * np.asarray(each, float) for each in look) for number, look in free}  # pyright: ignore


def light_of(made: Made) -> Environment:
    """The light of a scene."""
    size, name = made.system.part[0].transport.size, made.recipe.light
    path = harness.data() / "env" / name
    return load_environment(path, size=size) if path.is_file() else builtin.daylight(size=size)


def turned(light: Environment, turn: float) -> Environment:
    """A light turned about the vertical axis."""
    cosine, sine = np.cos(turn), np.sin(turn)
    about = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]], np.float32)
    return rotate(light, jnp.asarray(about)) if turn else light


def camera_of(made: Made, *, edge: int = EDGE, turn: float = 0.0) -> Camera:
    """The camera of a scene, turned about the vertical axis through what it looks at."""
    low, high = bounds(made.mesh)
    diagonal, (eye, target, angle) = float(np.linalg.norm(high - low)), made.recipe.camera
    middle = (low + high) / 2 + diagonal * np.asarray(target)
    away = diagonal * (np.asarray(eye) - np.asarray(target))
    cosine, sine = np.cos(turn), np.sin(turn)
    away = away @ np.array([[cosine, 0, -sine], [0, 1, 0], [sine, 0, cosine]])
    return Camera(middle + away, middle, [0.0, 1.0, 0.0], angle, edge, edge)


def _regions(mesh: Mesh) -> int:
    return int(np.max(np.asarray(mesh.region))) + 1


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # So that the seconds of a run that is stopped are kept.
    main()
