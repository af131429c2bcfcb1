"""What do changing materials cost per frame, and how wrong are they? The direct part of Sun et al. 2007's Table 1.

    python -m benchmarks.relight_dynamic [--quick] [--store FOLDER] [--output FILE]

Objects on grounds, as many vertices as in three scenes of the paper, with as many adjustable BRDFs: Cook-Torrance's
model over Fresnel reflectance and roughness, by free lobes, with and without a tensor. `V` are frames of a new view,
`V&B` of new materials too, `V&B&L` of a new light too; each is drawn, in 512 x 512 pixels. `peer` are frames of the
paper, with interreflections, which it says take three quarters of `V&B&L`; of two Xeons of 3.2 GHz and a GeForce 7800
in 2007. `error` is the median over thirty random triples of light, BRDF and view, relative L2 of the radiance of those
of 600 vertices that face the eye, against the integral over all texels.

Lines `m = ...` are of the triples of one roughness.
"""

import itertools
import pathlib
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import compression, harness
from jaxprt import RelitScene, reference, visibility
from jaxprt.brdf import CookTorrance
from jaxprt.image import interpolate, raster
from jaxprt.relit import Dynamic
from jaxprt.scene import Environment, TexturedMaterial, builtin, camera, environment, load_mesh
from jaxprt.scene.mesh import ground_plane

ROUGHNESS = (0.2, 0.05, 0.35, 0.1, 0.5)  # in turn; a quick run has the first three
RECIPES = {"4 lobes": Dynamic(4, None), "8 lobes": Dynamic(8, None), "12 lobes, tensor": Dynamic()}


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
    """A light, a material of each part and a view, all random."""

    light: Environment
    f0: float
    roughness: float
    diffuse: np.ndarray
    specular: np.ndarray
    eye: np.ndarray

    def materials(self, adjustable: int) -> dict[str, CookTorrance]:
        """The materials of the parts; the ground has the roles of the weights exchanged, if it is adjustable."""
        model = CookTorrance(self.diffuse, self.specular, self.roughness, self.f0)
        ground = CookTorrance(0.8 * self.specular, self.diffuse, self.roughness, self.f0)
        return {"object": model, "ground": ground} if adjustable == 2 else {"object": model}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what was precomputed")
    arguments = parser.parse_args(options)
    quick = arguments.quick
    for published in PUBLISHED[:1] if quick else PUBLISHED:
        scene, size, triples = scene_of(published.mesh, published.ground, published.adjustable, quick=quick)
        for name, recipe in list(RECIPES.items())[: 1 if quick else None]:
            start = time.perf_counter()
            path = arguments.store and arguments.store / published.mesh / name
            relit = prt.precompute(scene, system=recipe, refine=False, size=size, path=path, progress=False)
            seconds = time.perf_counter() - start
            for line in measure(published, name, relit, triples, quick=quick):
                harness.report({**line, "precompute_seconds": seconds}, arguments.output)


def scene_of(mesh: str, ground: int, adjustable: int, *, quick: bool) -> tuple[prt.Scene, int, list[Triple]]:
    """An object on a ground, the edge of the light's faces, and what both are relit with."""
    data = harness.data() / "meshes"
    real = data.is_dir() and not quick
    shape = load_mesh(data / f"{mesh}.ply") if real else builtin.sphere(rings=8, sectors=12)
    size = 64 if real else 16
    triples = draw(shape, size, quick)
    matte = TexturedMaterial(base_color=0.5, metallic=0.0, roughness=1.0, specular=0.0)
    below = ground_plane(shape, vertices=ground if real else 100)
    first: dict[str, Any] = {"ground": matte, **triples[0].materials(adjustable)}
    parts = [prt.Part("object", shape, first["object"]), prt.Part("ground", below, first["ground"])]
    return prt.Scene(parts), size, triples


def measure(published: Published, name: str, relit: RelitScene, triples: list[Triple], *, quick: bool):
    """Frames and errors by one recipe."""
    materials = [triple.materials(published.adjustable) for triple in triples]
    error = errors(relit, triples, materials, quick)
    case = f"{relit.vertices} vertices, {name}"
    common = {"benchmark": "relight_dynamic", "lobes": name, "vertices": relit.vertices, "bytes": prt.memory(relit)}
    common |= {"adjustable": published.adjustable}
    median, repeats = float(np.median(np.concatenate(list(error.values())))), 3 if quick else 15
    timing = harness.Timing(0.0, 0.0, 0)
    edge = 64 if quick else 512
    shots = camera.orbit(relit.mesh, width=edge, height=edge)
    for (kind, frame), fps in zip(frames(relit, triples, materials), published.fps, strict=True):

        def drawn(frame=frame):
            eye, color = frame()
            shot = eqx.tree_at(lambda shot: shot.eye, shots, eye)
            return interpolate(raster.rasterize(relit.mesh, shot), relit.mesh.face, color)

        timing = harness.measure(drawn, repeats=repeats)
        peer = {"peer": f"Sun et al. 2007, {published.name}", "peer_seconds": 1 / fps, "peer_error": None}
        yield {**common, "case": f"{kind}, {case}", **timing.line(), "error": median, **peer}
    for roughness, values in error.items():
        yield {**common, "case": f"m = {roughness}, {case}", **timing.line(), "error": float(np.median(values))}


def frames(relit: RelitScene, triples: Sequence[Triple], materials: Sequence[dict]) -> Iterator[tuple[str, Any]]:
    """Name and function of each kind of frame: every call has another view, other materials, another light."""
    turn = itertools.count()
    lit = relit.light(triples[0].light)
    shaded = relit.shade(lit, materials[0])

    def frame(matter: bool, light: bool) -> tuple[jax.Array, jax.Array]:
        number = next(turn) % len(triples)
        now, eye, arriving = materials[number if matter else 0], jnp.asarray(triples[number].eye), shaded
        if matter:
            arriving = relit.shade(relit.light(triples[number].light) if light else lit, now)
        return eye, relit.combine(arriving, relit.view(eye, now))

    yield "V", lambda: frame(False, False)
    yield "V&B", lambda: frame(True, False)
    yield "V&B&L", lambda: frame(True, True)


def draw(mesh: prt.scene.Mesh, size: int, quick: bool) -> list[Triple]:
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
        colors = diffuse.astype(np.float32), specular.astype(np.float32)
        roughness = ROUGHNESS[number % len(ROUGHNESS)]
        result.append(Triple(light, float(np.float32(f0)), roughness, *colors, views[random.integers(40)]))
    return result


def errors(relit: RelitScene, triples: Sequence[Triple], materials: Sequence[dict], quick: bool) -> dict[float, list]:
    """Errors of the triples of each roughness, at some vertices that face the eye."""
    chosen = np.random.default_rng(1).permutation(relit.vertices)[: 40 if quick else 600]
    vertex, size = np.sort(chosen), triples[0].light.radiance.shape[-2]
    visible = visibility.precompute(relit.mesh, size=size, vertex=vertex, run=prt.Run(progress=False))
    seen, part = jnp.asarray(visible.seen(np.arange(len(vertex)))), np.asarray(relit.mesh.region)[vertex]
    result: dict[float, list] = {roughness: [] for roughness in ROUGHNESS[: len(triples)]}
    for triple, now in zip(triples, materials, strict=True):
        color = np.asarray(relit.radiance(triple.light, eye=triple.eye, materials=now))[vertex]
        exact = np.zeros_like(color)
        for number, name in enumerate(("object", "ground")):
            model, eye = now.get(name, prt.brdf.Lambert(0.5)), jnp.asarray(triple.eye)
            value = reference.integrate(seen, visible.position, visible.frame, model, triple.light, eye)
            exact = np.where((part == number)[:, None], value, exact)
        facing = np.einsum("vi,vi->v", visible.frame[:, 2], triple.eye - np.asarray(visible.position)) > 0
        result[triple.roughness].append(np.linalg.norm((color - exact)[facing]) / np.linalg.norm(exact[facing]))
    return result


if __name__ == "__main__":
    main()
