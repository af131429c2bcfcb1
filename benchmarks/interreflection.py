"""What does reflected light cost per frame while everything changes, and how wrong is it? Sun et al. 2007's Table 1.

    python -m benchmarks.interreflection [--quick] [--store FOLDER] [--pictures FOLDER] [--output FILE]

Objects on grounds, both of Cook-Torrance's model over the Fresnel-roughness plane and both adjustable, with two
bounces. `V` are frames of a new view, `V&B` of new materials too, `V&B&L` of a new light too. `peer` are frames of the
paper, on two Xeons of 3.2 GHz and a GeForce 7800 in 2007; for `precompute` it is the time there.

`error` is that of pictures of 256 x 256 pixels against Mitsuba 3's path tracer with the same BRDFs, the median over ten
random triples of light, BRDF and view: relative L2 of the whole picture. `indirect_error` is that of its indirect part,
by one bounce and two. What of it is due to whom: `first_error` and `second_error` are those of each bounce, and
`light_error` what the 6 x 8 x 8 texels change in one bounce as Mitsuba has it, all relative to the indirect part. Two
pictures of unlike seeds stand for the exact one, so that their noise falls out of each squared error. Without LLVM of
version 17 or newer, which Mitsuba needs, there are no errors but those of decompositions.

Lines `Figure 9` are of fewer components and modes: `error` is that of tensors under light of natural spectrum,
`picture_error` what the reflected light changes against the longest, in the median triple. With pictures comes Figure
10 too: the reflected light of one triple, 8 / 64, 16 / 64, 32 / 16, 32 / 32; below 32 / 64, 32 / 96, 64 / 64, longest.
"""

import pathlib
import time
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness, path_tracing, relight_dynamic
from benchmarks.paper_scenes import rms, with_transfer
from benchmarks.published.transfer import truncate
from benchmarks.relight_dynamic import Triple
from jaxprt import RelitScene, bounces, files, image
from jaxprt.relit import Dynamic
from jaxprt.relit.groups import joined_mesh
from jaxprt.scene import Camera, Environment
from jaxprt.sphere import cubemap

EDGE, SAMPLES = 256, 144
LONGEST = (64, 96)
PICTURED = 2  # triple
DEFAULT = (32, 64)
CUTS = [(8, 64), (16, 64), (32, 16), (32, 32), (32, 64), (32, 96), (64, 64)]


class Published(NamedTuple):
    """A row of the paper's Table 1, and the scene here."""

    name: str
    hours: float
    megabytes: float
    fps: tuple[float, float, float]
    mesh: str
    ground: int


PUBLISHED = [
    Published("Tweety", 2.6 + 4.0, 148, (121.58, 28.73, 5.82), "rocker_arm", 3000),
    Published("Venus", 5.0 + 7.3, 389, (57.09, 10.94, 2.62), "stanford_bunny", 4000),
]


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write pictures beside the exact ones")
    arguments = parser.parse_args(options)
    for line in measure(arguments.quick, arguments.store, arguments.pictures):
        harness.report(line, arguments.output)


def measure(quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None):
    """Lines of all scenes."""
    for published in PUBLISHED[:1] if quick else PUBLISHED:
        yield from measure_scene(published, quick, store, pictures)


def measure_scene(published: Published, quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None):
    """Lines of one scene."""
    parts, size, triples = relight_dynamic.scene_of(published.mesh, published.ground, 2, quick=quick)
    triples = triples[: 2 if quick else 10]
    path = store and store / published.mesh
    options: dict = {"refine": False, "size": size, "rays": 0, "path": path and path / "direct", "progress": False}
    first = prt.precompute(parts, system=Dynamic(4, None) if quick else Dynamic(), bounces=1, **options)
    start = time.perf_counter()
    longest = (8, 8) if quick else LONGEST
    sizes = {"components": longest[0], "modes": longest[1]} | ({"edge": 4, "size": 8} if quick else {})
    full = with_transfer(first, path and path / "bounces", bounces=2, **sizes)
    seconds = time.perf_counter() - start
    scene = shorter(full, 4, 4) if quick else shorter(full, *DEFAULT)
    tensor, second = transfer(scene), transfer(full).second
    assert second is not None
    common = {
        **{"benchmark": "interreflection", "vertices": scene.vertices, "bytes": tensor.nbytes},
        **{"worth": [round(float(value), 4) for value in tensor.worth]},
    }
    if path_tracing.available() and not quick:
        error = errors(scene, triples, pictures and pictures / published.mesh)
    else:
        error = {"error": rms(tensor.error)}
    peer = {"peer": f"Sun et al. 2007, {published.name}", "peer_error": None}
    yield {
        **{**common, "case": f"precompute, {scene.vertices} vertices", "seconds": seconds, "compile_seconds": 0.0},
        **{"error": rms(tensor.error), "second_error": rms(second.error), **peer},
        **{"peer_seconds": 3600 * published.hours, "peer_bytes": 1e6 * published.megabytes},
        "peak_bytes": harness.peak_memory(),
    }
    materials = [triple.materials(2) for triple in triples]
    for (kind, frame), fps in zip(relight_dynamic.frames(scene, triples, materials), published.fps, strict=True):
        timing = harness.measure(frame, repeats=3 if quick else 15)
        case = f"{kind}, {scene.vertices} vertices"
        yield {**common, "case": case, **timing.line(), **peer, "peer_seconds": 1 / fps, **error}
    yield from figure_9(full, triples, common, quick)
    if pictures is not None and not quick:
        figure_10(full, triples[PICTURED], pictures / published.mesh)


def transfer(scene: RelitScene) -> bounces.TransferTensor:
    """The tensor of a scene's bounces."""
    assert scene.bounces is not None
    return scene.bounces.tensor


def shorter(scene: RelitScene, components: int, modes: int) -> RelitScene:
    """The scene with fewer components and modes of its tensor."""
    return eqx.tree_at(transfer, scene, truncate(transfer(scene), components, modes=modes))


def radiance(scene: RelitScene, triple: Triple) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Radiance of direct light, of one bounce and of the second bounce, in one triple."""
    once = eqx.tree_at(lambda relit: transfer(relit).second, scene, None)
    total = [
        np.asarray(relit.radiance(triple.light, eye=triple.eye, materials=triple.materials(2)))
        for relit in (scene.without_bounces(), once, scene)
    ]
    return total[0], total[1] - total[0], total[2] - total[1]


def errors(scene: RelitScene, triples: Sequence[Triple], pictures: pathlib.Path | None) -> dict:
    """Medians over all triples of what is off, relative to the picture or to its indirect part."""
    rows, mesh = [], joined_mesh(scene.shading)
    for number, triple in enumerate(triples):
        camera, model = camera_of(scene, triple), list(triple.materials(2).values())
        mine = [
            np.asarray(image.render(mesh, jnp.asarray(color), camera, background=None))
            for color in radiance(scene, triple)
        ]
        rough = cubemap.coarse(triple.light.radiance, edge=8).reshape(6, 8, 1, 8, 1, 3)
        rough = Environment(jnp.broadcast_to(rough, (6, 8, 8, 8, 8, 3)).reshape(6, 64, 64, 3))
        exact, blurred = [], []
        for seed in (0, 1):
            options = {"samples": SAMPLES, "seed": seed}
            two, three, four = (
                path_tracing.picture(mesh, model, triple.light, camera, depth=depth, **options) for depth in (2, 3, 4)
            )
            exact.append((two, three - two, four - three))
            low, high = (path_tracing.picture(mesh, model, rough, camera, depth=depth, **options) for depth in (2, 3))
            blurred.append(high - low)
        whole = [np.sum(each, 0) for each in exact]
        bounced = [each[1] + each[2] for each in exact]
        indirect = norm(0, *bounced)
        rows.append(
            {
                "error": norm(sum(mine), *whole) / norm(0, *whole),
                "direct_error": norm(mine[0], *(each[0] for each in exact)) / norm(0, *whole),
                "indirect_error": norm(mine[1] + mine[2], *bounced) / indirect,
                "first_error": norm(mine[1], *(each[1] for each in exact)) / indirect,
                "second_error": norm(mine[2], *(each[2] for each in exact)) / indirect,
                "light_error": norm(0, *(a - b[1] for a, b in zip(blurred, exact, strict=True))) / indirect,
                "indirect_fraction": indirect / norm(0, *whole),
            }
        )
        print({key: round(value, 4) for key, value in rows[-1].items()}, triple.roughness, flush=True)
        if pictures is not None:
            mean = np.mean(whole, 0)
            row = np.concatenate([mine[0], sum(mine), mean, 4 * (mine[1] + mine[2]), 4 * np.mean(bounced, 0)], 1)
            write(pictures / f"triple_{number}.png", row, mean)
    return {key: float(np.median([row[key] for row in rows])) for key in rows[0]}


def camera_of(scene: RelitScene, triple: Triple) -> Camera:
    """From the eye of a triple to the middle of what stands on the ground."""
    center = np.mean(np.asarray(scene.mesh.position)[: scene.layout.counts[0]], 0)
    return Camera(triple.eye, center, [0.0, 1.0, 0.0], 0.6, EDGE, EDGE)


def write(path: pathlib.Path, picture: np.ndarray, exposed: np.ndarray) -> None:
    """Writes a picture with the exposure that another one asks for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shown = image.expose(jnp.asarray(picture), stops=image.automatic_exposure(jnp.asarray(exposed)))
    files.write_png(path, np.asarray(image.display(shown)))


def norm(value, one: np.ndarray, other: np.ndarray) -> float:
    """Of the difference from what two noisy pictures are means of: their noise has no part in the product."""
    return float(np.sqrt(max(np.sum((value - one) * (value - other), dtype=np.float64), 0)))


def figure_9(full: RelitScene, triples: Sequence[Triple], common: dict, quick: bool):
    """Lines of shorter decompositions."""
    exact = [radiance(full, triple)[1] for triple in triples]
    for components, modes in [(2, 4)] if quick else CUTS:
        start = time.perf_counter()
        short = shorter(full, components, modes)
        seconds = time.perf_counter() - start
        change = [
            np.linalg.norm(radiance(short, triple)[1] - bounce) / np.linalg.norm(bounce)
            for triple, bounce in zip(triples, exact, strict=True)
        ]
        yield {
            **{**common, "case": f"Figure 9: {components} components, {modes} modes", "bytes": transfer(short).nbytes},
            **{"seconds": seconds, "compile_seconds": 0.0, "error": rms(transfer(short).error)},
            "picture_error": float(np.median(change)),
        }


def figure_10(full: RelitScene, triple: Triple, pictures: pathlib.Path) -> None:
    """Reflected light by shorter decompositions, and by the longest one last."""
    camera, tiles = camera_of(full, triple), []
    for scene in (*(shorter(full, components, modes) for components, modes in CUTS), full):
        color = jnp.asarray(sum(radiance(scene, triple)[1:]))
        tiles.append(np.asarray(image.render(full.mesh, color, camera, background=None)))
    rows = [np.concatenate(tiles[at : at + 4], 1) for at in (0, 4)]
    write(pictures / "figure_10.png", np.concatenate(rows), tiles[-1])


if __name__ == "__main__":
    main()
