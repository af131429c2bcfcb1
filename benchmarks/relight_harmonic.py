"""What does low-frequency relighting cost per frame, and how wrong is it? The paper's Table 1, and errors by order.

    python -m benchmarks.relight_harmonic [--quick] [--output FILE] [--plot FILE]

Times are of the rows of Table 1, by real meshes of JAXPRT_DATA (spheres of as many vertices without it), 25
coefficients and three colors of light. The teapot is divided until it has the paper's number of vertices. Other meshes
of about as many stand in for the head, the bird and the tyrannosaur, which are not to be had. General: light and view
change, measured against rotating the light alone. Transfer: the same with shadows; fixed light and fixed view: what is
left to do when only the other changes. These are measured against reading their arrays once on two threads. Transfer
matrices hold random numbers, on which times do not depend. `frames_per_second` are whole frames with drawing, in
512 x 512 pixels; where the view is fixed, colors alone are drawn.

Errors are relative L2 of radiance against quadrature over all texels, on vertices of the bunny that face the eye.
Precomputed transfer is timed against Embree alone on the very rays that it traces.
"""

import pathlib
import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness
from benchmarks.precompute_separable import Recorder, embree_alone
from benchmarks.published.harmonics import transferred_view, unshadowed_radiance, world_view
from jaxprt import harmonic, reference, scene, visibility
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.image import interpolate, rasterize
from jaxprt.scene import Mesh, builtin, camera, load_mesh, subdivision
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import directions, harmonics, rotation
from jaxprt.systems.harmonic import TransferMatrix

DEGREE = 4


class Row(NamedTuple):
    """A row of the paper's Table 1, and the mesh that stands for it here.

    Attributes:
        vertices: Of the paper's mesh.
        frames: A second: no transfer, transfer, fixed light, fixed view (2.2 GHz Pentium 4, Radeon 8500).
        file: The mesh here.
        divided: Whether it is divided until it has the paper's vertices.
    """

    vertices: int
    frames: tuple[float, float, float, float]
    file: str
    divided: bool = False


PAPER = {
    "teapot": Row(152_413, (2.0, 1.64, 9.5, 48.9), "teapot.obj", divided=True),
    "head": Row(50_060, (5.24, 4.18, 25.3, 130.0), "nefertiti.ply"),
    "buddha": Row(49_990, (4.05, 3.22, 15.6, 127.0), "happy_buddha_100k.ply"),
    "bird": Row(48_668, (6.04, 4.74, 28.4, 128.0), "horse.ply"),
    "tyra": Row(100_000, (2.62, 2.08, 9.9, 71.5), "armadillo.ply", divided=True),
}
LIGHTS = {"grace": "grace_cross.hdr", "eucalyptus": "eucalyptus_rnl_cross.hdr", "sunrise": "polyhaven_sunrise_1k.exr"}
WINDOWS = {
    "none": lambda light: jnp.ones(harmonics.degree_of(len(light)) + 1),
    "hann": lambda light: harmonics.hann(degree=harmonics.degree_of(len(light))),
    "lanczos": lambda light: harmonics.lanczos(degree=harmonics.degree_of(len(light))),
    "laplacian": lambda light: harmonics.least_laplacian(light, jnp.asarray(0.4)),
}
BRDFS = {
    "matte": Lambert(0.8),
    "glossy (12, 4)": AshikhminShirley(nu=12, nv=4),
    "sharp (48, 16)": AshikhminShirley(nu=48, nv=16),
}


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--plot", type=pathlib.Path, metavar="FILE", help="draw errors against time")
    arguments = parser.parse_args(options)
    lines = [*frames(arguments.quick), *errors(arguments.quick), precomputation(arguments.quick)]
    for line in lines:
        harness.report(line, arguments.output)
    if arguments.plot:
        plot([line for line in lines if "coefficients" in line], arguments.plot)


def meshes(quick: bool) -> dict[str, Mesh]:
    """What is relit: the rows of Table 1."""
    if quick:
        return {"sphere": builtin.sphere(rings=20, sectors=40)}
    return {name: table_mesh(name) for name in PAPER}


def table_mesh(name: str) -> Mesh:
    """The mesh of a row; without the data a sphere of as many vertices."""
    row = PAPER[name]
    path = harness.data() / "meshes" / row.file
    if not path.exists():
        rings = round((row.vertices / 2) ** 0.5)
        return builtin.sphere(rings=rings, sectors=2 * rings)
    mesh = load_mesh(path)
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)]
    if np.sum(np.cross(corner[:, 0], corner[:, 1]) * corner[:, 2]) < 0:  # the horse's file is inside out
        mesh = make_mesh(mesh.position, np.asarray(mesh.face)[:, ::-1], name=row.file)
    return divided(mesh, row.vertices) if row.divided else mesh


def divided(mesh: Mesh, vertices: int) -> Mesh:
    """The mesh with its longest edges halved until it has a number of vertices, or as near below as that leads."""
    face, position, divisions = np.asarray(mesh.face), np.asarray(mesh.position), []
    while len(position) < vertices:
        edges = subdivision.Edges(position, face)
        rank = np.argsort(np.argsort(-edges.length, kind="stable"))
        low, high = 0, len(rank)
        while low < high:
            count = (low + high + 1) // 2
            fits = len(position) + edges.added[edges.closed(rank < count)].sum() <= vertices
            low, high = (count, high) if fits else (low, count - 1)
        if not low:
            break
        divisions.append(edges.divide(edges.closed(rank < low)))
        face = divisions[-1].face
        position = np.concatenate([position, subdivision.middle(position, divisions[-1].parent)])
    return subdivision.subdivide(mesh, divisions)


def frames(quick: bool) -> list[dict]:
    """The paper's Table 1."""
    table = harmonic.tabulate(BRDFS["glossy (12, 4)"], degree=DEGREE, resolution=32 if quick else 128)
    light = jax.random.normal(jax.random.key(0), ((DEGREE + 1) ** 2, 3))
    return [
        line for name, mesh in meshes(quick).items() for line in frame(name, mesh, table, light, 3 if quick else 15)
    ]


def frame(name: str, mesh: Mesh, table, light: jax.Array, repeats: int) -> list[dict]:
    """One row of it."""
    count, terms = len(mesh.position), len(light)
    axes = directions.frame(mesh.normal, mesh.tangent)
    eye = mesh.position.mean(0) + 3 * (mesh.position.max(0) - mesh.position.min(0))
    matrix = jax.random.normal(jax.random.key(1), (count, 1, terms, terms))
    shadowed = TransferMatrix(matrix, mesh.position, axes)
    system = harmonic.HarmonicSystem(shadowed, table)
    view = harmonic.system.view_coefficients(table, mesh.position, axes, eye=eye)
    turned, through = world_view(axes, view), transferred_view(shadowed, view)
    arriving = harmonic.system.local_light(axes, light)
    cases = {
        "general": (lambda: unshadowed_radiance(mesh, table, light, eye=eye), "rotation", table.nbytes),
        "transfer": (lambda: prt.radiance(system, light, eye=eye), matrix, shadowed.nbytes),
        "fixed light": (
            lambda: system.combine(arriving, system.view(eye)),
            arriving,
            arriving.nbytes,
        ),
        "fixed view": (lambda: harmonic.system.combine(light, turned), turned, turned.nbytes),
        "fixed view, transfer": (lambda: harmonic.system.combine(light, through), through, through.nbytes),
    }
    # Another order of the same products tells the rounding.
    exact = {"transfer": harmonic.system.combine(harmonic.system.transferred_light(shadowed, light), view)}
    exact["fixed view, transfer"] = exact["transfer"]
    lines, pictures = [], []
    paper = dict(
        zip(
            ("general", "transfer", "fixed light", "fixed view"),
            PAPER[name].frames if name in PAPER else (),
            strict=False,
        )
    )
    edge = 512 if repeats > 3 else 64
    shot = camera.orbit(mesh, width=edge, height=edge)
    drawn = rasterize(mesh, shot)
    for case, (function, array, size) in cases.items():
        rotating = isinstance(array, str)
        peer = (lambda: rotation.rotate_each(light, axes)) if rotating else harness.reader([np.asarray(array)])
        mine, theirs = harness.compare(function, peer, repeats=repeats)
        expected = exact.get(case, harmonic.system.combine(arriving, view))

        kept = case.startswith("fixed view")

        def picture(function=function, kept=kept):
            return interpolate(drawn if kept else rasterize(mesh, shot), mesh.face, function())

        pictures.append(picture)
        lines.append(
            {
                "benchmark": "relight_harmonic",
                "case": f"{case}, {name}, {count} vertices",
                **mine.line(),
                "error": float(jnp.linalg.norm(function() - expected) / jnp.linalg.norm(expected)),
                "bytes": size,
                "peer": "rotation" if rotating else "memory-read",
                **theirs.peer(),
                "peer_error": 0.0,
                **({"paper_frames_per_second": paper[case]} if case in paper else {}),
            }
        )
    for line, timing in zip(lines, harness.alternate(pictures, repeats=repeats), strict=True):
        line["frames_per_second"] = 1 / timing.seconds
    return lines


def errors(quick: bool) -> list[dict]:
    """Errors by order, BRDF, light and window, with what they cost."""
    orders = (3,) if quick else (3, 5, 7, 10, 15)
    degree = DEGREE if quick else max(orders) - 1
    path = harness.data() / "meshes" / "stanford_bunny.ply"
    real = path.exists() and not quick
    mesh = load_mesh(path) if real else builtin.sphere(rings=20, sectors=40)
    lights = {"daylight": builtin.daylight(size=16 if quick else 64)}
    if real:
        lights = {name: scene.load_environment(harness.data() / "env" / file) for name, file in LIGHTS.items()}
    eye = mesh.position.mean(0) + jnp.array([0.5, 0.7, 2.0]) * jnp.linalg.norm(jnp.ptp(mesh.position, 0))
    facing = np.flatnonzero(np.sum(np.asarray(mesh.normal * (eye - mesh.position)), 1) > 0)
    vertex = np.random.default_rng(0).permutation(facing)[: 50 if quick else 400]
    full = harmonic.precompute(mesh, degree=degree, vertex=vertex, run=prt.Run(progress=False))
    lines = []
    for name, model in list(BRDFS.items())[1:2] if quick else BRDFS.items():
        table = harmonic.tabulate(model, degree=degree, resolution=32 if quick else 128)
        for sky, light in lights.items():
            truth = reference.radiance(mesh, model, light, eye=eye, vertex=vertex)
            for order in orders:
                matrix = full.matrix[..., : order**2, : order**2]
                short, few = TransferMatrix(matrix, full.position, full.frame), table.truncate(degree=order - 1)
                for window in WINDOWS:
                    coefficient = harmonic.project(light, degree=order - 1)
                    coefficient = harmonics.convolve(coefficient, WINDOWS[window](coefficient))
                    call = lambda s=short, f=few, c=coefficient: prt.radiance(harmonic.HarmonicSystem(s, f), c, eye=eye)  # noqa: E731
                    color = call()
                    lines.append(
                        {
                            "benchmark": "relight_harmonic",
                            "case": f"error, {name}, {sky}, {order**2} coefficients, window {window}",
                            **harness.measure(call, repeats=3).line(),
                            "error": float(jnp.linalg.norm(color - truth) / jnp.linalg.norm(truth)),
                            "bytes": short.nbytes,
                            "bytes_per_vertex": short.nbytes / len(vertex),
                            "vertices": len(vertex),
                            "negative": float(jnp.mean(jnp.any(color < 0, -1))),
                            "coefficients": order**2,
                            "brdf": name,
                            "light": sky,
                            "window": window,
                        }
                    )
    return lines


def precomputation(quick: bool) -> dict:
    """Transfer matrices of 50,000 vertices against their rays alone."""
    name, mesh = next(iter(meshes(quick).items())) if quick else ("buddha", table_mesh("buddha"))
    recorder, size = Recorder(mesh), 32
    start, normal = visibility.start_points(mesh, recorder), np.asarray(mesh.normal)
    harmonic.precompute(mesh, degree=DEGREE, size=size, vertex=np.arange(1), run=prt.Run(progress=False))
    chosen = np.arange(0, len(start), visibility.rays.BLOCK)[:: 2 if quick else 8]
    before = embree_alone(recorder, start, normal, chosen[0::2], size)
    began = time.perf_counter()
    made = harmonic.precompute(mesh, degree=DEGREE, size=size, run=prt.Run(progress=not quick))
    seconds = time.perf_counter() - began
    after = embree_alone(recorder, start, normal, chosen[1::2], size)
    embree = (before[1] + after[1]) / (before[2] + after[2]) * len(start)
    few = np.random.default_rng(0).choice(len(start), 64, replace=False)
    fine = harmonic.precompute(mesh, degree=DEGREE, size=2 * size, vertex=few, run=prt.Run(progress=False)).matrix
    return {
        "benchmark": "relight_harmonic",
        "case": f"precomputed transfer, {name}, {len(start)} vertices, 25 x 25",
        "seconds": seconds,
        "compile_seconds": 0.0,
        "error": float(jnp.linalg.norm(made.matrix[few] - fine) / jnp.linalg.norm(fine)),
        "bytes": made.nbytes,
        "peer": "embree-rays",
        "peer_seconds": embree,
        "peer_error": 0.0,
    }


def plot(lines: list[dict], path: pathlib.Path) -> None:
    """Error against time per vertex, one panel for each light."""
    from matplotlib import pyplot

    lights = list(dict.fromkeys(line["light"] for line in lines))
    figure, axes = pyplot.subplots(1, len(lights), figsize=(5 * len(lights), 4), sharey=True, squeeze=False)
    for panel, light in zip(axes[0], lights, strict=True):
        for name in BRDFS:
            for window, style in zip(WINDOWS, ("-", "--", ":", "-."), strict=True):
                row = [x for x in lines if (x["light"], x["brdf"], x["window"]) == (light, name, window)]
                time_each = [1e9 * x["seconds"] / x["vertices"] for x in row]
                panel.loglog(time_each, [x["error"] for x in row], style, marker="o", label=f"{name}, {window}")
        panel.set(title=light, xlabel="nanoseconds per vertex")
    axes[0, 0].set_ylabel("relative L2 error")
    axes[0, -1].legend(fontsize=6)
    figure.savefig(path, dpi=120, bbox_inches="tight")


if __name__ == "__main__":
    main()
