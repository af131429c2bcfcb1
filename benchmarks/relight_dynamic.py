"""What do changing materials cost per frame, and how wrong are they? The direct part of Sun et al. 2007's Table 1.

    python -m benchmarks.relight_dynamic [--quick] [--store FOLDER] [--output FILE]

Objects on grounds, as many vertices as in three scenes of the paper, with as many adjustable BRDFs: Cook-Torrance's
model over the Fresnel-roughness plane, by free lobes. `V` are frames of a new view, `V&B` of new materials too, `V&B&L`
of a new light too; each is drawn, in 512 x 512 pixels. `peer` are frames of the paper, with interreflections, which it
says take three quarters of `V&B&L`; of two Xeons of 3.2 GHz and a GeForce 7800 in 2007. `error` is the median over
thirty random triples of light, BRDF and view, relative L2 of the radiance of those of 600 vertices that face the eye,
against the integral over all texels.

Lines `m = ...` are of the triples of one roughness. `brdf_error` is the part of the BRDF, with visibility as it is;
`matte_error` that of the diffuse part, by clustered wavelets; what is left is light and visibility taken apart.

Lines `Figure 5` are of sets as such: error of the light that they reflect under light of natural spectrum, without
shadows; `squared_error` is its square, as the paper prints errors, of which 0.952465 are left by the finest tensor of
whole BRDFs there. Materials are those of Ngan et al. 2005 (from JAXPRT_DATA; else the built-in grid). `PCA` is in the
norm of the disk, over materials of equal norm; the paper has 6.23e-4 with five functions, one of them diffuse.
"""

import itertools
import pathlib
import time
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import compression, harness
from benchmarks.published import maps
from benchmarks.published.lobes import mirror_lobes
from jaxprt import bright_texels, dynamic, reference, separable, visibility
from jaxprt.brdf import CookTorrance, Lambert, navigation
from jaxprt.image import interpolate, raster
from jaxprt.scene import Environment, Mesh, builtin, camera, environment, load_mesh
from jaxprt.scene.mesh import ground_plane, join

ROUGHNESS = (0.2, 0.05, 0.35, 0.1, 0.5)  # in turn; a quick run has the first three
LOBES = (4, 8)
TEXELS = 16


class Published(NamedTuple):
    """A row of the paper's Table 1, and the scene here."""

    name: str
    adjustable: int
    fps: tuple[float, float, float]
    mesh: str
    ground: int


PUBLISHED = [
    Published("Tweety", 2, (121.58, 28.73, 5.82), "rocker_arm", 3000),
    Published("Venus", 1, (57.09, 10.94, 2.62), "stanford_bunny", 4000),
    Published("Watch", 2, (43.06, 7.23, 1.53), "nefertiti", 12000),
]


class Triple(NamedTuple):
    """A light, a material of each region and a view, all random."""

    light: Environment
    coordinate: np.ndarray
    diffuse: np.ndarray
    specular: np.ndarray
    eye: np.ndarray


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    arguments = parser.parse_args(options)
    for line in measure(arguments.quick, arguments.store):
        harness.report(line, arguments.output)


def measure(quick: bool, store: pathlib.Path | None):
    """Lines of all scenes, and of sets as such."""
    family = navigation.cook_torrance()
    if quick:
        point = np.array([(f0, m) for m in sorted(ROUGHNESS[:3]) for f0 in (0.05, 1.0)])
        models = tuple(CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=f0) for f0, m in point)
        plane = navigation.triangulate(point)
        family = navigation.Family(models, plane, family.name[:6], family.diffuse[:6], family.specular[:6])
    sets, fitted = [], []
    for lobes in (1,) if quick else LOBES:
        start = time.perf_counter()
        sets.append(dynamic.factor(family.brdf, dynamic.separate(family.brdf, lobes=lobes)))
        fitted.append(time.perf_counter() - start)
    for scene in PUBLISHED[:1] if quick else PUBLISHED:
        yield from measure_scene(scene, sets, fitted, family.navigation, quick, store)
    yield from figure_5(quick)


def measure_scene(scene: Published, sets: list, fitted: list, plane, quick: bool, store: pathlib.Path | None):
    """Frames and errors of one scene."""
    data = harness.data() / "meshes"
    real = data.is_dir() and not quick
    glossy = load_mesh(data / f"{scene.mesh}.ply") if real else builtin.sphere(rings=8, sectors=12)
    ground = ground_plane(glossy, vertices=scene.ground if real else 100)
    mesh = join([glossy, ground])
    fixed = separable.factor(Lambert(0.5), terms=1, resolution=8)
    size = 64 if real else 16
    start = time.perf_counter()
    # One for any number of lobes.
    both = [sets[0], sets[0] if scene.adjustable == 2 else fixed]
    path = store and store / scene.mesh
    transport = dynamic.precompute_sets(mesh, both, size=size, path=path, progress=False)
    seconds = time.perf_counter() - start
    triples = draw(glossy, size, quick)
    for members, took in zip(sets, fitted, strict=True):
        brdfs = [members, members if scene.adjustable == 2 else fixed]
        more = {"precompute_seconds": seconds, "fit_seconds": took, "adjustable": scene.adjustable}
        yield from measure_set(scene, mesh, transport, brdfs, plane, triples, more, quick)


def measure_set(scene: Published, mesh: Mesh, transport, brdfs, plane, triples: list[Triple], more: dict, quick: bool):
    """Frames and errors by one set."""
    first = dynamic.light_side(transport, triples[0].light, texels=TEXELS)
    samples = [samples_for(triple, transport.size) for triple in triples]
    material = [materials(plane, triple, scene.adjustable) for triple in triples]
    turn = itertools.count()
    edge = 64 if quick else 512
    shots = [
        eqx.tree_at(lambda c: c.eye, camera.orbit(mesh, width=edge, height=edge), jnp.asarray(each.eye))
        for each in triples
    ]

    def frame(view: bool, matter: bool, light: bool):
        number = next(turn) % len(triples)
        shot = shots[number if view else 0]
        lit = dynamic.light_side(transport, triples[number].light, texels=TEXELS) if light else first
        seen = dynamic.view_side(transport, brdfs, material[number if matter else 0], eye=shot.eye)
        color = dynamic.combine(transport, lit, seen, samples=samples[number if matter else 0])
        return interpolate(raster.rasterize(mesh, shot), mesh.face, color)

    found = errors(mesh, transport, brdfs, triples, material, quick)
    count = brdfs[0].lobe.lobes
    case = f"{len(mesh.position)} vertices, {count} lobes"
    common = {
        **{"benchmark": "relight_dynamic", "lobes": count, "vertices": len(mesh.position)},
        **{"bytes": transport.nbytes, **more},
    }
    repeats = 3 if quick else 15
    median = np.median([each for every in found.values() for each in every], 0)[0]
    changes = {"V": (True, False, False), "V&B": (True, True, False), "V&B&L": (True, True, True)}
    timing = harness.Timing(0.0, 0.0, 0)
    for (name, each), fps in zip(changes.items(), scene.fps, strict=True):
        timing = harness.measure(lambda each=each: frame(*each), repeats=repeats)
        peer = {"peer": f"Sun et al. 2007, {scene.name}", "peer_seconds": 1 / fps, "peer_error": None}
        yield {**common, "case": f"{name}, {case}", **timing.line(), "error": median, **peer}
    for roughness, each in found.items():
        part = dict(zip(("error", "brdf_error", "matte_error"), np.median(each, 0).tolist(), strict=True))
        yield {**common, "case": f"m = {roughness}, {case}", **timing.line(), **part}
    yield gradient(
        mesh, transport, brdfs, plane, triples[0], median, {**common, "case": f"gradient, {case}"}, repeats, quick
    )


def draw(mesh: Mesh, size: int, quick: bool) -> list[Triple]:
    """Thirty triples, as many of each roughness."""
    random = np.random.default_rng(0)
    lights = compression.scene(quick)[2]
    views = compression.eyes(mesh, 40)
    result = []
    for number in range(3 if quick else 30):
        angle = random.uniform(0, 2 * np.pi)
        turned = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        light = environment.rotate(lights[number % len(lights)], jnp.asarray(turned, jnp.float32))
        f0, diffuse, specular = random.uniform(0.05, 1), random.uniform(0, 0.5, 3), random.uniform(0.2, 0.8, 3)
        at = np.array([f0, ROUGHNESS[number % len(ROUGHNESS)]], np.float32)
        triple = Triple(light, at, diffuse.astype(np.float32), specular.astype(np.float32), views[random.integers(40)])
        result.append(triple)
    return result


def materials(plane, triple: Triple, adjustable: int) -> list:
    """Those of a triple; a second region has the roles of its weights exchanged."""
    weight = plane.weight(jnp.asarray(triple.coordinate))
    first = dynamic.Material(weight, jnp.asarray(triple.diffuse), jnp.asarray(triple.specular))
    second = dynamic.Material(weight, jnp.asarray(0.8 * triple.specular), jnp.asarray(triple.diffuse))
    return [first, second if adjustable == 2 else None]


def samples_for(triple: Triple, size: int) -> int:
    """Points along the edge of the single texels that a triple's BRDF needs."""
    f0, roughness = triple.coordinate.tolist()
    return bright_texels.samples_for(CookTorrance(diffuse=0.0, specular=1.0, roughness=roughness, f0=f0), size=size)


def errors(mesh: Mesh, transport, brdfs, triples, material, quick: bool) -> dict[float, list]:
    """Of the triples of each roughness the error, the part of the BRDF, and that of the diffuse part."""
    number = np.random.default_rng(1).permutation(len(mesh.position))[: 40 if quick else 600]
    vertex = np.sort(number)
    visible = visibility.precompute(mesh, size=transport.size, vertex=vertex, progress=False)
    seen = jnp.asarray(visible.seen(np.arange(len(vertex))))
    region = np.asarray(mesh.region)[vertex]

    def exact(brdf, triple):
        batch = Environment(triple.light.radiance[None])
        return np.asarray(
            reference.integrate(seen, visible.position, visible.frame, brdf, batch, jnp.asarray(triple.eye))
        )[0]

    result: dict[float, list] = {roughness: [] for roughness in ROUGHNESS[: len(triples)]}
    for number, (triple, matter) in enumerate(zip(triples, material, strict=True)):
        f0, roughness = triple.coordinate.tolist()
        eye = jnp.asarray(triple.eye)
        options = {"eye": eye, "texels": TEXELS, "samples": samples_for(triple, transport.size)}
        color = dynamic.radiance(transport, brdfs, matter, triple.light, **options)
        dull = [each and dynamic.Material(each.weight, each.diffuse, 0 * each.specular) for each in matter]
        matte = dynamic.radiance(transport, brdfs, dull, triple.light, **options)
        white = exact(Lambert(1.0), triple)
        glossy = exact(CookTorrance(diffuse=0.0, specular=1.0, roughness=roughness, f0=f0), triple)
        fitted = exact(brdfs[0].at(matter[0].weight), triple)
        sums = np.zeros((3, len(vertex), 3))
        for place, each in enumerate(matter):
            diffuse, specular = (0.5, 0.0) if each is None else (np.asarray(each.diffuse), np.asarray(each.specular))
            own = (region == place)[:, None]
            for row, (base, sharp) in enumerate([(white, glossy), (white, fitted), (white, 0 * glossy)]):
                sums[row] += own * (base * diffuse + sharp * specular)
        whole, by_brdf, base = sums
        facing = np.einsum("vi,vi->v", visible.frame[:, 2], triple.eye - np.asarray(visible.position)) > 0
        norm = np.linalg.norm(whole[facing])
        wrong = (np.asarray(color)[vertex] - whole, by_brdf - whole, np.asarray(matte)[vertex] - base)
        wrong = [each[facing] for each in wrong]
        result[ROUGHNESS[number % len(ROUGHNESS)]].append([float(np.linalg.norm(each) / norm) for each in wrong])
    return result


def gradient(
    mesh: Mesh, transport, brdfs, plane, triple: Triple, error: float, common: dict, repeats: int, quick: bool
) -> dict:
    """An image's loss and its gradient in light, weights and coordinates, beside the loss alone."""
    edge = 32 if quick else 256
    view = camera.orbit(mesh, width=edge, height=edge)
    fragments = raster.rasterize(mesh, view)
    fixed = materials(plane, triple, common["adjustable"])

    def loss(light, diffuse, specular, coordinate):
        first = dynamic.Material(plane.weight(coordinate), diffuse, specular)
        color = dynamic.radiance(
            transport, brdfs, [first, fixed[1]], Environment(light), eye=jnp.asarray(view.eye), texels=TEXELS
        )
        return jnp.mean(interpolate(fragments, mesh.face, color) ** 2)

    each = (triple.light.radiance, *map(jnp.asarray, (triple.diffuse, triple.specular, triple.coordinate)))
    slope, alone = harness.compare(lambda: jax.grad(loss, (0, 1, 2, 3))(*each), lambda: loss(*each), repeats=repeats)
    peer = {"peer": "the loss alone", **alone.peer(), "peer_error": error}
    return {**common, **slope.line(), "error": error, **peer}


def figure_5(quick: bool):
    """Errors of tensors with and without lobes."""
    path = harness.data() / "brdf" / "ngan2005_cooktorrance.csv"
    family = navigation.cook_torrance(path=path if path.is_file() and not quick else None)
    brdfs = family.brdf[:: 20 if quick else 1]
    tables: dict[str, tuple] = {"free lobes": (dynamic.separate(brdfs, lobes=2 if quick else 8), [(2, 4), (4, 8)])}
    if not quick:
        mirror = dynamic.separate(brdfs, separator=mirror_lobes)
        more = [(1, 4), (2, 4), (4, 8), (6, 32)]
        tables |= {"no lobes": (None, more), "published lobes": (mirror, more)}
    for name, (lobes, ranks) in tables.items():
        for count, terms in ranks[:1] if quick else ranks:
            start = time.perf_counter()
            made = dynamic.factor(brdfs, lobes, ranks=(count, terms, terms))
            yield {
                **{"benchmark": "relight_dynamic", "case": f"Figure 5: {name}, n_h = {count}, n_wi = n_wo = {terms}"},
                **{"seconds": time.perf_counter() - start, "compile_seconds": 0.0, "bytes": made.nbytes},
                **{"error": float(made.error), "squared_error": float(made.error) ** 2},
            }
    yield {"benchmark": "relight_dynamic", "case": "PCA of the set, four functions", **principal(brdfs, functions=4)}


def principal(brdfs, *, functions: int) -> dict:
    """What some functions leave of a set, in the norm of the disk and of BRDFs of equal norm."""
    start = time.perf_counter()
    direction = maps.texel_direction(resolution=24).reshape(-1, 3)
    area = jnp.sqrt(maps.texel_area(resolution=24).ravel())
    rows = np.stack(
        [np.ravel(separable.factorization.tabulate(each, direction) * area * area[:, None]) for each in brdfs]
    )
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    value = np.linalg.eigvalsh(rows @ rows.T)
    left = float(np.sum(np.maximum(value[:-functions], 0)) / np.sum(value))
    return {
        **{"bytes": functions * rows[0].nbytes, "seconds": time.perf_counter() - start, "compile_seconds": 0.0},
        **{"error": left**0.5, "squared_error": left},
    }


if __name__ == "__main__":
    main()
