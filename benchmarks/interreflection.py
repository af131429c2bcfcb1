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

Lines `basis` are of the functions that stand for BRDFs along light paths: `error` of the light that they reflect, in
the norm in which they are factored over the directions; `PCA alone` in the norm of the disk, of the 86 materials of
Ngan et al. 2005 and of 200 exponents, where the paper has squared errors of 6.23e-4 and 1.61e-7 with five functions,
one of them diffuse.
"""

import itertools
import pathlib
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from benchmarks import harness, path_tracing, relight_dynamic
from benchmarks.published.transfer import truncate
from benchmarks.relight_dynamic import Triple
from jaxprt import bounces, dynamic, files, image
from jaxprt.brdf import CookTorrance, navigation
from jaxprt.scene import Camera, Environment, Mesh, builtin, load_mesh
from jaxprt.scene.mesh import ground_plane, join

LOBES = 4
TEXELS = 16
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


class Scene(NamedTuple):
    """What is relit."""

    mesh: Mesh
    transport: dynamic.SetTransport
    tensor: bounces.TransferTensor
    brdfs: list
    triples: list[Triple]
    materials: list[list]


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write pictures beside the exact ones")
    arguments = parser.parse_args(options)
    for line in measure(arguments.quick, arguments.store, arguments.pictures):
        harness.report(line, arguments.output)


def measure(quick: bool, store: pathlib.Path | None, pictures: pathlib.Path | None):
    """Lines of all scenes."""
    point = np.array(list(itertools.product((0.0, 1.0), (0.2, 0.4)))) if quick else None
    family = navigation.cook_torrance(point=point)
    members = dynamic.factor(family.brdf, dynamic.separate(family.brdf, lobes=1 if quick else LOBES))
    start = time.perf_counter()
    sizes: dict = {"functions": 2, "terms": 4, "resolution": 8} if quick else {}
    along = bounces.factor(family.brdf, navigation=family.navigation, **sizes)
    functions, terms = along.factor.shape[-1], len(along.light_map)
    yield {
        **{"benchmark": "interreflection", "case": f"basis: Cook-Torrance, {functions} functions of {terms} terms"},
        **{"seconds": time.perf_counter() - start, "compile_seconds": 0.0, "bytes": along.nbytes},
        **{"error": float(along.error), "squared_error": float(along.error) ** 2},
    }
    data = harness.data() / "brdf" / "ngan2005_cooktorrance.csv"
    fitted = navigation.cook_torrance(path=data).brdf if data.is_file() and not quick else family.brdf
    shiny = navigation.blinn_phong(exponents=(1.0, 8.0, 64.0) if quick else range(1, 201)).brdf
    for name, brdfs in {"Cook-Torrance": fitted, "Blinn-Phong": shiny}.items():
        found = relight_dynamic.principal(brdfs, functions=functions)
        yield {"benchmark": "interreflection", "case": f"basis: {name}, {functions} functions, PCA alone", **found}
    for published in PUBLISHED[:1] if quick else PUBLISHED:
        yield from measure_scene(published, members, along, family.navigation, quick, store, pictures)


def measure_scene(published: Published, members, along, plane, quick: bool, store, pictures):
    """Lines of one scene."""
    data = harness.data() / "meshes"
    real = data.is_dir() and not quick
    glossy = load_mesh(data / f"{published.mesh}.ply") if real else builtin.sphere(rings=8, sectors=12)
    mesh = join([glossy, ground_plane(glossy, vertices=published.ground if real else 100)])
    size = 64 if real else 16
    path = store and store / published.mesh
    transport = dynamic.precompute_sets(mesh, [members] * 2, size=size, path=path and path / "direct", progress=False)
    start = time.perf_counter()
    longest = (8, 8) if quick else LONGEST
    options: dict = {"components": longest[0], "modes": longest[1], "edge": 8 if real else 4, "size": 16 if real else 8}
    options |= {"path": path and path / "bounces", "progress": False}
    full = bounces.precompute(mesh, [along] * 2, **options)
    seconds = time.perf_counter() - start
    tensor = truncate(full, 4, modes=4) if quick else truncate(full, DEFAULT[0], modes=DEFAULT[1])
    triples = relight_dynamic.draw(glossy, size, quick)[: 2 if quick else 10]
    materials = [relight_dynamic.materials(plane, each, 2) for each in triples]
    scene = Scene(mesh, transport, tensor, [members] * 2, triples, materials)
    common = {
        **{"benchmark": "interreflection", "vertices": len(mesh.position), "bytes": tensor.nbytes},
        **{"worth": [round(float(each), 4) for each in tensor.worth]},
    }
    found = errors(scene, pictures and pictures / published.mesh) if path_tracing.available() and not quick else {}
    if not found:
        found = {"error": rms(tensor.error)}
    peer = f"Sun et al. 2007, {published.name}"
    second = full.second
    assert second is not None
    yield {
        **{**common, "case": f"precompute, {len(mesh.position)} vertices", "seconds": seconds, "compile_seconds": 0.0},
        **{
            "error": rms(tensor.error),
            "second_error": rms(second.error),
            "peer": peer,
            "peer_error": None,
        },
        **{"peer_seconds": 3600 * published.hours, "peer_bytes": 1e6 * published.megabytes},
        "peak_bytes": harness.peak_memory(),
    }
    for name, frame, fps in frames(scene, published):
        timing = harness.measure(frame, repeats=3 if quick else 15)
        case = f"{name}, {len(mesh.position)} vertices"
        line = {"peer": peer, "peer_seconds": 1 / fps, "peer_error": None, **found}
        yield {**common, "case": case, **timing.line(), **line}
    yield from figure_9(scene, full, common, quick)
    if pictures is not None and not quick:
        figure_10(scene, full, pictures / published.mesh)


def frames(scene: Scene, published: Published):
    """Name, function and the paper's rate of each kind of frame."""
    transport, tensor, brdfs = scene.transport, scene.tensor, scene.brdfs
    lit = dynamic.light_side(transport, scene.triples[0].light, texels=TEXELS)
    bounced = bounces.light_side(tensor, scene.triples[0].light)
    arrived = bounces.arriving(transport, tensor, bounced, scene.materials[0])
    samples = [relight_dynamic.samples_for(triple, transport.size) for triple in scene.triples]
    turn = itertools.count()

    def frame(matter: bool, light: bool):
        number = next(turn) % len(scene.triples)
        triple, now = scene.triples[number], scene.materials[number if matter else 0]
        view = dynamic.view_side(transport, brdfs, now, eye=jnp.asarray(triple.eye))
        sun, bounce, comes = lit, bounced, arrived
        if light:
            sun = dynamic.light_side(transport, triple.light, texels=TEXELS)
            bounce = bounces.light_side(tensor, triple.light)
        if matter:
            comes = bounces.arriving(transport, tensor, bounce, now)
        surfaces = dynamic.mix(transport, brdfs, now)
        reflected = bounces.combine(transport, comes, bounces.view_side(transport, surfaces, eye=view.eye))
        return dynamic.combine(transport, sun, view, samples=samples[number if matter else 0]) + reflected

    yield "V", lambda: frame(False, False), published.fps[0]
    yield "V&B", lambda: frame(True, False), published.fps[1]
    yield "V&B&L", lambda: frame(True, True), published.fps[2]


def reflected(scene: Scene, tensor: bounces.TransferTensor, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of one bounce and of two bounces, in one triple."""
    triple, now = scene.triples[number], scene.materials[number]
    surfaces = dynamic.mix(scene.transport, scene.brdfs, now)
    seen = bounces.view_side(scene.transport, surfaces, eye=jnp.asarray(triple.eye))
    lit = bounces.light_side(tensor, triple.light)
    both, once = (
        bounces.combine(scene.transport, bounces.arriving(scene.transport, tensor, each, now), seen)
        for each in (lit, bounces.relight.LitTransfer(lit.first, None))
    )
    return np.asarray(once), np.asarray(both - once)


def errors(scene: Scene, pictures: pathlib.Path | None) -> dict:
    """Medians over all triples of what is off, relative to the picture or to its indirect part."""
    rows = []
    for number, triple in enumerate(scene.triples):
        camera = camera_of(scene, triple)
        eye = camera.eye
        samples = relight_dynamic.samples_for(triple, scene.transport.size)
        color = dynamic.radiance(
            scene.transport,
            scene.brdfs,
            scene.materials[number],
            triple.light,
            eye=jnp.asarray(eye),
            texels=TEXELS,
            samples=samples,
        )
        mine = [np.asarray(image.render(scene.mesh, jnp.asarray(each), camera, background=None))
                for each in (color, *reflected(scene, scene.tensor, number))]  # fmt: skip
        f0, roughness = triple.coordinate.tolist()
        model = [
            CookTorrance(diffuse, specular, roughness, f0)
            for diffuse, specular in (
                (triple.diffuse, triple.specular),
                (0.8 * triple.specular, triple.diffuse),
            )
        ]
        rough = bounces.gather.coarse(triple.light.radiance, edge=8).reshape(6, 8, 1, 8, 1, 3)
        rough = Environment(jnp.broadcast_to(rough, (6, 8, 8, 8, 8, 3)).reshape(6, 64, 64, 3))
        exact, blurred = [], []
        for seed in (0, 1):
            options = {"samples": SAMPLES, "seed": seed}
            two, three, four = (
                path_tracing.picture(scene.mesh, model, triple.light, camera, depth=depth, **options)
                for depth in (2, 3, 4)
            )
            exact.append((two, three - two, four - three))
            low, high = (
                path_tracing.picture(scene.mesh, model, rough, camera, depth=depth, **options) for depth in (2, 3)
            )
            blurred.append(high - low)
        whole = [np.sum(each, 0) for each in exact]
        bounced = [each[1] + each[2] for each in exact]
        indirect = norm(0, *bounced)
        rows.append(
            {
                "error": norm(np.sum(mine, 0), *whole) / norm(0, *whole),
                "direct_error": norm(mine[0], *(each[0] for each in exact)) / norm(0, *whole),
                "indirect_error": norm(mine[1] + mine[2], *bounced) / indirect,
                "first_error": norm(mine[1], *(each[1] for each in exact)) / indirect,
                "second_error": norm(mine[2], *(each[2] for each in exact)) / indirect,
                "light_error": norm(0, *(a - b[1] for a, b in zip(blurred, exact, strict=True))) / indirect,
                "indirect_fraction": indirect / norm(0, *whole),
            }
        )
        print({key: round(value, 4) for key, value in rows[-1].items()}, roughness, flush=True)
        if pictures is not None:
            mean = np.mean(whole, 0)
            row = np.concatenate([mine[0], np.sum(mine, 0), mean, 4 * (mine[1] + mine[2]), 4 * np.mean(bounced, 0)], 1)
            write(pictures / f"triple_{number}.png", row, mean)
    return {key: float(np.median([row[key] for row in rows])) for key in rows[0]}


def camera_of(scene: Scene, triple: Triple) -> Camera:
    """From the eye of a triple to the middle of what stands on the ground."""
    center = np.mean(np.asarray(scene.mesh.position)[np.asarray(scene.mesh.region) == 0], 0)
    return Camera(triple.eye, center, [0.0, 1.0, 0.0], 0.6, EDGE, EDGE)


def write(path: pathlib.Path, picture: np.ndarray, exposed: np.ndarray) -> None:
    """Writes a picture with the exposure that another one asks for."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shown = image.expose(jnp.asarray(picture), stops=image.automatic_exposure(jnp.asarray(exposed)))
    files.write_png(path, np.asarray(image.display(shown)))


def norm(value, one: np.ndarray, other: np.ndarray) -> float:
    """Of the difference from what two noisy pictures are means of: their noise has no part in the product."""
    return float(np.sqrt(max(np.sum((value - one) * (value - other), dtype=np.float64), 0)))


def figure_9(scene: Scene, full: bounces.TransferTensor, common: dict, quick: bool):
    """Lines of shorter decompositions."""
    numbers = range(len(scene.triples))
    exact = [reflected(scene, full, number)[0] for number in numbers]
    for components, modes in [(2, 4)] if quick else CUTS:
        start = time.perf_counter()
        short = truncate(full, components, modes=modes)
        seconds = time.perf_counter() - start
        found = [reflected(scene, short, number)[0] for number in numbers]
        change = [np.linalg.norm(a - b) / np.linalg.norm(b) for a, b in zip(found, exact, strict=True)]
        yield {
            **{**common, "case": f"Figure 9: {components} components, {modes} modes", "bytes": short.nbytes},
            **{"seconds": seconds, "compile_seconds": 0.0, "error": rms(short.error)},
            "picture_error": float(np.median(change)),
        }


def figure_10(scene: Scene, full: bounces.TransferTensor, pictures: pathlib.Path) -> None:
    """Reflected light by shorter decompositions, and by the longest one last."""
    camera = camera_of(scene, scene.triples[PICTURED])
    tiles = []
    for tensor in (*(truncate(full, components, modes=modes) for components, modes in CUTS), full):
        color = jnp.asarray(sum(reflected(scene, tensor, PICTURED)))
        tiles.append(np.asarray(image.render(scene.mesh, color, camera, background=None)))
    rows = [np.concatenate(tiles[at : at + 4], 1) for at in (0, 4)]
    write(pictures / "figure_10.png", np.concatenate(rows), tiles[-1])


def rms(value) -> float:
    """Root mean square."""
    return float(jnp.sqrt(jnp.mean(jnp.asarray(value) ** 2)))


if __name__ == "__main__":
    main()
