"""How long do precomputation, a change of light and a change of view take, beside the figures of Wang et al. 2004?

    python -m benchmarks.tables [--quick] [--mesh NAME] [--output FILE]

Tables 1 and 2 of the paper: a glossy mesh with one and with four terms of Ashikhmin and Shirley's BRDF on a diffuse
ground with one, 96 coefficients a vertex and term, light of 6 x 64 x 64 texels, shadows cast by a simplified scene.
Transport is stored in whole numbers, as in the paper. `view` and `light` are whole frames: a new view or a new light
in, a picture of vertex colors of 512 x 512 pixels out. A new light redraws nothing: triangles stay where they are, and
their colors are interpolated anew. `peer` are the paper's figures, of a 2.6 GHz Pentium 4 with a GeForce 5900 in 2004,
so their ratio is of two machines and of two meshes: three of the files have fewer vertices than the paper's meshes.
`error` is what storing in whole numbers changes in the light tuples. `radiance_error` and `ground_error` are those of
the relit radiance against the sum over all texels with the BRDF itself and the same shadows, at some vertices of the
mesh that face the eye and some of the ground. All meshes together take twenty minutes to an hour on two cores. Without
JAXPRT_DATA, and with `--quick`, a small embedded scene stands in, which has no peer.
"""

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import harness
from benchmarks.published.quantized import quantize
from jaxprt import radiance, reference, separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.image import interpolate, rasterize
from jaxprt.scene import Camera, Mesh, builtin, camera, load_mesh, occluder
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.systems.separable import SeparableBrdf, SeparableSystem
from jaxprt.visibility import Run

KEEP = 96
TERMS = (1, 4)  # of the paper's tables
SIZE = 64
PICTURE = 512  # pixels along an edge
GLOSSY, MATTE = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100), Lambert(0.5)


class Published(NamedTuple):
    """A column of the paper's tables; pairs are for one and four terms."""

    vertices: int
    ground: int
    simplified: int
    minutes: tuple[int, int]
    megabytes: tuple[int, int]
    view: tuple[float, float]
    light: tuple[float, float]


# Vertex counts of tables 1 are in thousands there.
PUBLISHED = {
    "stanford_bunny": Published(36_000, 22_000, 11_000, (21, 70), (30, 84), (90, 63), (20, 7.2)),
    "happy_buddha_100k": Published(56_000, 31_000, 20_000, (35, 101), (44, 127), (46, 35), (14, 5.0)),
    "dragon_100k": Published(100_000, 63_000, 32_000, (70, 194), (81, 230), (24, 18), (7.8, 2.7)),
    "lucy_100k": Published(180_000, 23_000, 17_000, (80, 233), (100, 370), (18, 12), (6.2, 1.7)),
}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--mesh", choices=list(PUBLISHED), action="append", help="only this mesh; may be repeated")
    arguments = parser.parse_args(options)
    folder = harness.data() / "meshes"
    lines = []
    if arguments.quick or not folder.exists():
        ball = builtin.sphere(rings=8, sectors=16)
        cases = [("ball", ball, ground_plane(ball, vertices=100), 256, None)]
    else:
        cases = (case(name) for name in arguments.mesh or PUBLISHED)
    for name, mesh, ground, faces, paper in cases:
        size, repeats = (16, 3) if arguments.quick else (SIZE, 21)
        measured = measure(name, mesh, ground, faces, paper, size=size, repeats=repeats)
        lines += [harness.report(line, arguments.output) for line in measured]
    print(table(lines))


def case(name: str) -> tuple[str, Mesh, Mesh, int, Published]:
    """A mesh of the paper, its ground, and as many faces to cast shadows as a closed mesh of the paper's vertices."""
    mesh, paper = load_mesh(harness.data() / "meshes" / f"{name}.ply"), PUBLISHED[name]
    return name, mesh, ground_plane(mesh, vertices=paper.ground), 2 * paper.simplified, paper


def measure(
    name: str, mesh: Mesh, ground: Mesh, faces: int, paper: Published | None, *, size: int, repeats: int
) -> list[dict]:
    """The lines of one mesh: precomputation, view and light, each with one and with four terms."""
    whole = join([mesh, ground])
    shadows = occluder.simplify(whole, faces=faces)
    one_term = separable.factor(MATTE, terms=1)
    # One vertex compiles and does not count.
    separable.precompute(
        ground, one_term, keep=KEEP, size=size, occluder=shadows, vertex=np.arange(1), run=Run(progress=False)
    )
    began = time.perf_counter()
    below = precompute(ground, one_term, shadows, size)
    ground_seconds = time.perf_counter() - began
    seconds, scenes = [], []
    for terms in TERMS:
        glossy = separable.factor(GLOSSY, terms=terms)
        began = time.perf_counter()
        separable.precompute(
            mesh, glossy, keep=KEEP, size=size, occluder=shadows, vertex=np.arange(1), run=Run(progress=False)
        )
        compiled = time.perf_counter() - began
        began = time.perf_counter()
        upon = precompute(mesh, glossy, shadows, size)
        seconds.append(harness.Timing(time.perf_counter() - began + ground_seconds, compiled, 1))
        scenes.append([(upon, glossy), (below, one_term)])
    edge = PICTURE if paper else 64
    shot = camera.orbit(mesh, elevation=0.3, width=edge, height=edge)
    systems = [[SeparableSystem(quantized, brdf) for (_, quantized), brdf in parts] for parts in scenes]
    drawn = harness.alternate(
        [frame for parts in systems for frame in frames(parts, whole, shot, size)], repeats=repeats
    )
    lines = []
    for column, (terms, parts) in enumerate(zip(TERMS, scenes, strict=True)):
        common = {
            "benchmark": "tables",
            "error": change(parts, size),
            "bytes": sum(quantized.nbytes for (_, quantized), _ in parts),
            "vertices": len(mesh.position),
            "ground": len(ground.position),
            "shadow_faces": len(shadows.face),
            "mesh": name,
            "terms": terms,
        }
        few, glossy = 300 if paper else 20, parts[0][1]
        common["radiance_error"] = radiance_error(mesh, shadows, GLOSSY, glossy, shot.eye, size=size, count=few)
        common["ground_error"] = radiance_error(ground, shadows, MATTE, one_term, shot.eye, size=size, count=few)
        view, light = drawn[2 * column : 2 * column + 2]
        timings = {"precompute": seconds[column], "view": view, "light": light}
        for what, timing in timings.items():
            line = {**common, "case": f"{what}, {name}, {terms} terms", "what": what, **timing.line()}
            lines.append(line | (peer(paper, what, column) if paper else {}))
    return lines


def precompute(mesh: Mesh, brdf: SeparableBrdf, shadows: Mesh, size: int):
    """Transport in floating point and in whole numbers."""
    result = separable.precompute(mesh, brdf, keep=KEEP, size=size, occluder=shadows, run=Run(progress=False))
    return result, jax.block_until_ready(quantize(result))


def frames(
    parts: list[SeparableSystem], mesh: Mesh, shot: Camera, size: int
) -> tuple[Callable[[], jax.Array], Callable[[], jax.Array]]:
    """A change of view, which keeps the light's tuples, and one of light, which keeps the view's; both drawn."""
    environment = builtin.daylight(size=size)
    lights = [part.light(environment) for part in parts]
    views = [part.view(jnp.asarray(shot.eye)) for part in parts]
    fragments = rasterize(mesh, shot)

    def view():
        colors = [part.combine(g, part.view(jnp.asarray(shot.eye))) for g, part in zip(lights, parts, strict=True)]
        return interpolate(rasterize(mesh, shot), mesh.face, jnp.concatenate(colors))

    def light():
        colors = [part.combine(part.light(environment), h) for h, part in zip(views, parts, strict=True)]
        return interpolate(fragments, mesh.face, jnp.concatenate(colors))

    return view, light


def change(parts: list, size: int) -> float:
    """Relative L2 difference of the light tuples that whole numbers make."""
    environment = builtin.daylight(size=size)
    pairs = [[SeparableSystem(each, brdf).light(environment) for each in both] for both, brdf in parts]
    return float(
        jnp.sqrt(sum(jnp.sum((q - plain) ** 2) for plain, q in pairs) / sum(jnp.sum(plain**2) for plain, _ in pairs))
    )


def radiance_error(
    mesh: Mesh, shadows: Mesh, brdf: AshikhminShirley | Lambert, factored: SeparableBrdf, eye, *, size: int, count: int
) -> float:
    """Relative L2 of relit radiance, as timed, against the sum over all texels, at some vertices that face the eye."""
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal) * (np.asarray(eye) - np.asarray(mesh.position)), 1) > 0)
    vertex = np.sort(np.random.default_rng(0).permutation(facing)[:count])
    options = {"occluder": shadows, "vertex": vertex}
    kept = separable.precompute(mesh, factored, keep=KEEP, size=size, run=Run(progress=False), **options)
    light = builtin.daylight(size=size)
    color = radiance(SeparableSystem(quantize(kept), factored), light, eye=jnp.asarray(eye))
    exact = reference.radiance(mesh, brdf, light, eye=jnp.asarray(eye), **options)
    return float(jnp.linalg.norm(color - exact) / jnp.linalg.norm(exact))


def peer(paper: Published, what: str, column: int) -> dict:
    """The paper's figure; its errors are not known."""
    seconds = {
        "precompute": 60.0 * paper.minutes[column],
        "view": 1 / paper.view[column],
        "light": 1 / paper.light[column],
    }
    return {
        "peer": "Wang et al. 2004",
        "peer_seconds": seconds[what],
        "peer_error": None,
        "peer_bytes": 1_000_000 * paper.megabytes[column],
        "peer_vertices": paper.vertices,
    }


def table(lines: list[dict]) -> str:
    """Both tables in Markdown: here, and in the paper where it has the mesh."""
    rows = [
        "",
        "| mesh | terms | vertices + ground | precompute | size | view | light | error | error of the ground |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for start in range(0, len(lines), 3):
        first, view, light = lines[start : start + 3]
        rows.append(
            f"| {first['mesh']} | {first['terms']} | {first['vertices']:,} + {first['ground']:,} "
            f"| {first['seconds'] / 60:.1f} min | {first['bytes'] / 1e6:.0f} MB "
            f"| {1 / view['seconds']:.0f} fps | {1 / light['seconds']:.0f} fps "
            f"| {_percent(first, 'radiance_error')} | {_percent(first, 'ground_error')} |"
        )
        paper = PUBLISHED.get(first["mesh"])
        if paper:
            column = TERMS.index(first["terms"])
            rows.append(
                f"| in the paper | {first['terms']} | {paper.vertices:,} + {paper.ground:,} "
                f"| {paper.minutes[column]} min | {paper.megabytes[column]} MB "
                f"| {paper.view[column]} fps | {paper.light[column]} fps | | |"
            )
    return "\n".join(rows)


def _percent(line: dict, key: str) -> str:
    """A share as percent; nothing where it was not measured."""
    return f"{100 * line[key]:.1f} %" if key in line else ""


if __name__ == "__main__":
    main()
