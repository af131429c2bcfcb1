"""How much of the light inside concave scenes do bounces bring, against Mitsuba 3 at several depths of paths?

    python -m benchmarks.concave [--quick] [--pictures FOLDER] [--output FILE]

`room` is `benchmarks.published.interiors.room`, white walls and matte colors, under the embedded daylight. `walls` is
a white floor beside one wall whose left half is red and whose right half is blue, under constant light. Lines are of
the light that surfaces reflect, at pixels of one view of 128 x 128: `bounces` is what the system was made with,
`depth` how many segments Mitsuba's paths have at most, 3 for one bounce. `error` is relative L2 of the reflected
part, with Mitsuba's noise taken out by two pictures of unlike seeds; `brightness` is its mean over that of Mitsuba's.
Lines `floor` are of the pixels of the white floor alone, which the wall colors.
"""

import pathlib
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness, path_tracing
from benchmarks.interreflection import norm, write
from benchmarks.published import interiors
from jaxprt import image
from jaxprt.brdf import Lambert, MetallicRoughness
from jaxprt.brdf.varying import PerVertex
from jaxprt.relit import reflection
from jaxprt.relit.channels import Shading, of_part
from jaxprt.relit.groups import Layout
from jaxprt.relit.recipes import Target
from jaxprt.scene import Camera, Environment, Mesh, Part, TexturedMaterial, builtin
from jaxprt.scene.mesh import make_mesh, split
from jaxprt.systems.bounces import GroupBounces

EDGE, SAMPLES = 128, 1024
DEPTHS = (3, 4, 8)
DEEPEST = 64  # segments, for light after all bounces
ROOM = (
    *([0.6, 0.45, 0.3], [0.7, 0.15, 0.1], [0.8, 0.8, 0.75], [0.8, 0.8, 0.75], [0.8, 0.8, 0.75], [0.85, 0.85, 0.85]),
    *([0.2, 0.3, 0.6], [0.4, 0.25, 0.15], [0.8, 0.75, 0.6], [0.5, 0.5, 0.55], [0.3, 0.4, 0.3], [0.7, 0.6, 0.2]),
)  # albedos of its regions


class Scene(NamedTuple):
    """What is lit, and what Mitsuba has in its place.

    Attributes:
        name: Its name.
        shadings: Parts as jaxprt has them.
        traced: Meshes with materials as Mitsuba has them.
        mesh: All parts.
        light: The light.
        camera: The view.
        judged: Vertices whose pixels have lines of their own; None without.
    """

    name: str
    shadings: list[Shading]
    traced: list[tuple[Mesh, Any]]
    mesh: Mesh
    light: Environment
    camera: Camera
    judged: np.ndarray | None


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write pictures beside the exact ones")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what Mitsuba traced")
    parser.add_argument("--bounces", nargs="+", default=["1", "2", "4", "all"], help="what systems are made with")
    parser.add_argument("--scene", choices=["room", "walls"], nargs="+", default=["room", "walls"])
    arguments = parser.parse_args(options)
    counts = [each if each == "all" else int(each) for each in arguments.bounces]
    for name in ["walls"] if arguments.quick else arguments.scene:
        scene = room() if name == "room" else walls(cells=6 if arguments.quick else 24)
        exact = kept(scene, 16 if arguments.quick else SAMPLES, arguments.store)
        counts = counts[1::2] if arguments.quick else counts
        for line in measure(scene, counts, exact, arguments.quick, arguments.pictures):
            harness.report(line, arguments.output)


def room() -> Scene:
    """The room, matte."""
    mesh = interiors.room()
    meshes = split(mesh)
    parts = [
        Part(f"part {n}", each, Lambert(albedo)) for n, (each, albedo) in enumerate(zip(meshes, ROOM, strict=True))
    ]
    camera = Camera([0.2, 1.3, 4.2], [0.0, 1.1, -1.0], [0.0, 1.0, 0.0], 0.9, EDGE, EDGE)
    traced = [(part.mesh, part.material) for part in parts]
    return Scene(
        "room", [of_part(part) for part in parts], traced, prt.Scene(parts).mesh, builtin.daylight(), camera, None
    )


def walls(*, cells: int) -> Scene:
    """A white floor beside a wall whose left half is red and whose right half is blue, blended over one cell."""
    floor = builtin.plane(cells=cells)
    position = np.asarray(floor.position)[:, [0, 2, 1]] * [1, -1, 1] + [0, 1, -1]
    wall = make_mesh(position.astype(np.float32), floor.face)
    left = np.clip(0.5 - position[:, :1] * cells / 4, 0, 1)
    color = jnp.asarray(left * [0.9, 0.1, 0.1] + (1 - left) * [0.1, 0.1, 0.9], jnp.float32)
    parts = [Part("floor", floor, Lambert(0.9)), Part("wall", wall, TexturedMaterial(metallic=0.0, specular=0.0))]
    shadings = [of_part(part) for part in parts]
    assert shadings[1].blend is not None
    painted = eqx.tree_at(lambda each: each.blend.weight, shadings[1], shadings[1].blend.weight * color[:, None])
    none = jnp.zeros(len(color))
    rest = {"ior": none + 1.5, "specular_color": 0 * color + 1, "anisotropy": none, "rotation": none}
    matte = MetallicRoughness(color, none, none + 1, specular=none, **rest)
    traced = [(floor, Lambert(0.9)), (wall, PerVertex(matte))]
    light = Environment(jnp.ones((6, 16, 16, 3)))
    camera = Camera([0.4, 2.2, 3.0], [0.0, 0.4, -0.3], [0.0, 1.0, 0.0], 0.7, EDGE, EDGE)
    mesh = prt.Scene(parts).mesh
    judged = np.arange(len(mesh.position)) < len(floor.position)
    return Scene("walls", [shadings[0], painted], traced, mesh, light, camera, judged)


def measure(
    scene: Scene, counts: list, exact: dict[int, np.ndarray], quick: bool, pictures: pathlib.Path | None
) -> Iterator[dict[str, Any]]:
    """Lines of a scene."""
    chosen: dict[str, np.ndarray] = {scene.name: np.ones((EDGE, EDGE, 1), bool)}
    if scene.judged is not None:
        own = jnp.asarray(scene.judged[:, None], jnp.float32)
        chosen["floor"] = np.asarray(image.render(scene.mesh, own, scene.camera, background=None)) > 0.99
    sizes = [len(each.mesh.position) for each in scene.shadings]
    layout = Layout.apart(sizes)
    for count in counts:
        start = time.perf_counter()
        target = Target(scene.mesh, size=16, run=prt.Run(progress=False))
        system = reflection.make(scene.shadings, layout, count, target)
        seconds = time.perf_counter() - start
        blends = [each.blend for each in scene.shadings]
        frame = harness.measure(lambda: _radiance(system, scene, blends), repeats=2 if quick else 10)  # noqa: B023
        color = _radiance(system, scene, blends)
        mine = np.asarray(image.render(scene.mesh, color, scene.camera, background=None))
        for depth, both in exact.items():
            for name, at in chosen.items():
                value, one, other = (np.where(at, each, 0) for each in (mine, *both))
                yield {
                    **{"benchmark": "concave", "case": f"{name}, {count} bounces, depth {depth}", **frame.line()},
                    **{"error": norm(value, one, other) / norm(0, one, other), "bytes": system.tensor.nbytes},
                    "brightness": float(np.sum(value) / np.sum(one + other) * 2),
                    "precompute_seconds": seconds,
                    "worth": np.round(np.asarray(system.tensor.worth, np.float64), 4).tolist(),
                }
        if pictures is not None:
            mean = np.mean(exact[DEEPEST], 0)
            row = np.concatenate([mine, mean, np.abs(mine - mean) * 4], 1)
            write(pictures / f"{scene.name}_{count}.png", row, mean)


def _radiance(system: GroupBounces, scene: Scene, blends: list) -> jax.Array:
    """Reflected radiance of all vertices, part after part."""
    arriving = system.shade(system.light(scene.light), blends)
    eye, colors = jnp.asarray(scene.camera.eye), []
    for part, lit, blend in zip(system.group, arriving, blends, strict=True):
        color = part.combine(lit, part.view(eye, blend))
        colors.append(jnp.broadcast_to(color, (len(color), 3)))
    return jax.block_until_ready(jnp.concatenate(colors))


def kept(scene: Scene, samples: int, store: pathlib.Path | None) -> dict[int, np.ndarray]:
    """Two pictures of the reflected light by depth of the paths, from a folder if they are there."""
    path = None if store is None else store / f"{scene.name}_{samples}.npz"
    if path is not None and path.exists():
        found = np.load(path)
        return {int(depth): found[depth] for depth in found.files}
    made = {depth: np.stack(each) for depth, each in traced(scene, samples).items()}
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, allow_pickle=False, **{str(depth): each for depth, each in made.items()})
    return made


def traced(scene: Scene, samples: int) -> dict[int, list[np.ndarray]]:
    """Two pictures of the reflected light by depth of the paths."""
    result: dict[int, list[np.ndarray]] = {depth: [] for depth in (*DEPTHS, DEEPEST)}
    for seed in (0, 1):
        direct, *every = (
            path_tracing.trace(scene.traced, scene.light, scene.camera, depth=depth, samples=samples, seed=seed)
            for depth in (2, *result)
        )
        for depth, whole in zip(result, every, strict=True):
            result[depth].append(whole - direct)
    return result


if __name__ == "__main__":
    main()
