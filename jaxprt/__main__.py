"""Relights a mesh and measures itself: `python -m jaxprt --mesh FILE --environment FILE --output FOLDER`."""

import argparse
import itertools
import json
import platform
import resource
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from jaxprt.brdf.separable import SeparableBrdf
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.transport import SparseTransport

_TABLE_TERMS = (1, 4, 16, 64)
_TABLE_KEEP = (32, 96, 256)
# Turns that bring an axis of the file to +y.
_UPRIGHT = {
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}
_AMPLIFY = 4.0  # brightness of the difference picture beside the others


class Part(NamedTuple):
    """Vertices of one material."""

    name: str
    mesh: Mesh
    brdf: Callable
    terms: int


class Scene(NamedTuple):
    """What the command relights."""

    parts: list[Part]
    lights: dict[str, Environment]
    camera: Camera

    @property
    def mesh(self) -> Mesh:
        """All parts as one mesh."""
        return prt.scene.mesh.join([part.mesh for part in self.parts])


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    warnings.showwarning = lambda message, *_, **__: print(f"jaxprt: {message}", file=sys.stderr)
    try:
        _run(options)
    except (ValueError, OSError, RuntimeError) as error:
        print(f"jaxprt: error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxprt", description=__doc__)
    parser.add_argument("--mesh", type=Path, help="PLY, OBJ, STL, OFF or GLB; an embedded scene if not given")
    parser.add_argument("--up", choices=list(_UPRIGHT), default="y", help="axis of the file that points up (default y)")
    parser.add_argument("--environment", type=Path, nargs="+", metavar="FILE", help="EXR or HDR; embedded if not given")
    parser.add_argument("--brdf", choices=["ashikhmin-shirley", "lambert"], default="ashikhmin-shirley")
    parser.add_argument("--diffuse", type=float, nargs="+", default=[0.5], help="gray or three colors (default 0.5)")
    parser.add_argument("--specular", type=float, nargs="+", default=[0.75], help="gray or three colors (default 0.75)")
    parser.add_argument("--nu", type=float, default=10.0, help="exponent along the tangent (default 10)")
    parser.add_argument("--nv", type=float, default=100.0, help="exponent across it (default 100)")
    parser.add_argument("--terms", type=int, default=4, help="terms of the factored BRDF (default 4)")
    parser.add_argument("--keep", type=int, default=96, help="wavelet coefficients per vertex and term (default 96)")
    parser.add_argument("--ground", action="store_true", help="stand the mesh on a diffuse ground plane")
    parser.add_argument("--size", type=int, default=512, help="edge of the pictures in pixels (default 512)")
    parser.add_argument("--azimuth", type=float, default=20.0, help="of the camera, degrees from +z to +x (default 20)")
    parser.add_argument("--elevation", type=float, default=15.0, help="of the camera, degrees (default 15)")
    parser.add_argument(
        "--table",
        type=int,
        nargs="?",
        const=4000,
        metavar="N",
        help="add the error table, on N vertices (default 4000)",
    )
    parser.add_argument("--output", type=Path, default=Path("output"), help="folder for pictures and report.json")
    return parser


def _run(options: argparse.Namespace) -> None:
    scene = _scene(options)
    options.output.mkdir(parents=True, exist_ok=True)
    report: dict[str, Any] = {"machine": _machine(), "vertices": {p.name: len(p.mesh.position) for p in scene.parts}}
    print(f"jaxprt {prt.__version__}: {', '.join(f'{p.name} {len(p.mesh.position)}' for p in scene.parts)} vertices")
    transport, factored, report["precompute"] = _precompute(scene, options)
    picture = _pictures(scene, transport, factored)
    seen = _seen(scene)
    start = time.perf_counter()
    exact = [
        np.asarray(prt.relight.reference.radiance(
            part.mesh, part.brdf, _stack(scene.lights), eye=scene.camera.eye, occluder=scene.mesh, vertex=vertex,
            progress=True,
        ))
        for part, vertex in zip(scene.parts, seen, strict=True)
    ]  # fmt: skip
    report["reference_seconds"] = time.perf_counter() - start
    report["difference_png_gain"] = _AMPLIFY
    report["lights"] = {}
    for number, (name, light) in enumerate(scene.lights.items()):
        values = [each[number] for each in exact]
        report["lights"][name] = _compare(scene, name, light, picture[name], values, seen, options.output)
    report["times"] = _times(transport, factored, next(iter(scene.lights.values())), scene)
    if options.table:
        report["table"] = _table(scene, options.table)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    report["peak_bytes"] = peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, Linux KiB
    path = options.output / "report.json"
    path.write_text(json.dumps(report, indent=2) + "\n")
    _tell(report, path)


def _scene(options: argparse.Namespace) -> Scene:
    if options.size < 1:
        raise ValueError(f"--size must be at least 1, got {options.size}")
    if options.table is not None and options.table < 1:
        raise ValueError(f"--table must be at least 1, got {options.table}")
    if options.mesh is None:
        parts = _chess(_brdf(options), options.terms)
    else:
        mesh = prt.scene.mesh.turn(prt.scene.load_mesh(options.mesh), np.array(_UPRIGHT[options.up]))
        parts = [Part("object", mesh, _brdf(options), 1 if options.brdf == "lambert" else options.terms)]
        if options.ground:
            parts.append(Part("ground", prt.scene.mesh.ground_plane(mesh), prt.brdf.Lambert(0.5), 1))
    if options.environment:
        lights = {path.stem: prt.scene.load_environment(path) for path in options.environment}
    else:
        lights = {"daylight": prt.scene.builtin.daylight(), "studio": prt.scene.builtin.studio()}
    camera = prt.scene.camera.orbit(
        parts[0].mesh,
        azimuth=np.radians(options.azimuth),
        elevation=np.radians(options.elevation),
        width=options.size,
        height=options.size,
    )
    return Scene(parts, lights, camera)


def _chess(brdf: Callable, terms: int) -> list[Part]:
    pieces, light, dark = prt.scene.mesh.split(prt.scene.builtin.chess())
    return [
        Part("pieces", pieces, brdf, terms),
        Part("light squares", light, prt.brdf.Lambert([0.6, 0.55, 0.45]), 1),
        Part("dark squares", dark, prt.brdf.Lambert([0.12, 0.08, 0.06]), 1),
    ]


def _brdf(options: argparse.Namespace) -> Callable:
    for name in ("diffuse", "specular"):
        if len(getattr(options, name)) not in (1, 3):
            raise ValueError(f"--{name} must be one number or three, got {len(getattr(options, name))}")
    if options.brdf == "lambert":
        return prt.brdf.Lambert(options.diffuse)
    return prt.brdf.AshikhminShirley(diffuse=options.diffuse, specular=options.specular, nu=options.nu, nv=options.nv)


def _precompute(scene: Scene, options: argparse.Namespace):
    """Factored BRDFs and transport of every part, with times and sizes."""
    transport, factored, told = [], [], {}
    for part in scene.parts:
        start = time.perf_counter()
        factored.append(prt.brdf.separable.factor(part.brdf, terms=part.terms))
        middle = time.perf_counter()
        store = options.output / f"{part.name.replace(' ', '_')}.prt"
        transport.append(
            prt.transport.separable.precompute(
                part.mesh, factored[-1], keep=options.keep, occluder=scene.mesh, path=store
            )
        )
        told[part.name] = {
            "terms": part.terms,
            "keep": options.keep,
            "factor_seconds": middle - start,
            "factor_error": float(factored[-1].error),
            "transport_seconds": time.perf_counter() - middle,
            "transport_bytes": transport[-1].nbytes,
        }
    return transport, factored, told


def _pictures(scene: Scene, transport: list[SparseTransport], factored: list[SeparableBrdf]) -> dict[str, list]:
    """Per light, the radiance of every vertex of every part."""
    return {
        name: [
            prt.relight.separable.radiance(t, f, light, eye=scene.camera.eye)
            for t, f in zip(transport, factored, strict=True)
        ]
        for name, light in scene.lights.items()
    }


def _seen(scene: Scene) -> list[np.ndarray]:
    """Per part, the vertices of the triangles in the picture."""
    triangle = np.unique(np.asarray(prt.image.rasterize(scene.mesh, scene.camera).triangle))
    vertex = np.unique(np.asarray(scene.mesh.face)[triangle[triangle >= 0]])
    first = np.cumsum([0, *(len(part.mesh.position) for part in scene.parts)])
    return [vertex[(vertex >= a) & (vertex < b)] - a for a, b in itertools.pairwise(first)]


def _compare(scene, name, light, color, exact, seen, output: Path) -> dict[str, Any]:
    """Writes the pictures of one light, and returns their errors."""
    told: dict[str, Any] = {"vertex_error": {}}
    full = []
    for part, mine, truth, vertex in zip(scene.parts, color, exact, seen, strict=True):
        told["vertex_error"][part.name] = float(prt.image.relative_l2(mine[vertex], truth))
        full.append(jnp.zeros_like(mine).at[vertex].set(truth))
    sky = prt.scene.environment.background(light, prt.image.ray_direction(scene.camera))
    image = prt.image.render(scene.mesh, jnp.concatenate(color), scene.camera, background=sky)
    reference = prt.image.render(scene.mesh, jnp.concatenate(full), scene.camera, background=sky)
    surface = prt.image.render(scene.mesh, jnp.ones((len(scene.mesh.position), 1)), scene.camera, background=None)
    stops = prt.image.automatic_exposure(reference * surface)
    for kind, picture in (("image", image), ("reference", reference), ("difference", jnp.abs(image - reference))):
        prt.files.write_exr(output / f"{name}_{kind}.exr", np.asarray(picture))
        shown = picture * (_AMPLIFY if kind == "difference" else 1)
        prt.files.write_png(
            output / f"{name}_{kind}.png", np.asarray(prt.image.display(prt.image.expose(shown, stops=stops)))
        )
    told["image_error"] = float(prt.image.relative_l2(image * surface, reference * surface))
    told["negative_vertices"] = int(sum(jnp.sum(jnp.any(mine < 0, -1)) for mine in color))
    told["exposure_stops"] = float(stops)
    return told


def _times(transport, factored, light: Environment, scene: Scene) -> dict[str, float]:
    """Median seconds of what a frame needs."""
    tuples = [prt.relight.separable.light_tuple(t, light) for t in transport]

    def view():
        return [
            prt.relight.separable.combine(g, prt.relight.separable.view_tuple(t, f, scene.camera.eye))
            for g, t, f in zip(tuples, transport, factored, strict=True)
        ]

    color, mesh = jnp.concatenate(view()), scene.mesh
    return {
        "light_change_seconds": _median(lambda: [prt.relight.separable.light_tuple(t, light) for t in transport]),
        "view_change_seconds": _median(view),
        "render_seconds": _median(lambda: prt.image.render(mesh, color, scene.camera, background=None)),
    }


def _median(function: Callable[[], Any]) -> float:
    jax.block_until_ready(function())
    seconds = []
    for _ in range(7):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def _table(scene: Scene, count: int) -> list[dict[str, Any]]:
    """Error against terms and kept coefficients, on a sample of the first part's vertices that face the eye."""
    part, eye = scene.parts[0], scene.camera.eye
    facing = np.flatnonzero(np.sum(np.asarray(part.mesh.normal * (eye - part.mesh.position)), 1) > 0)
    vertex = np.random.default_rng(0).permutation(facing)[:count]
    lights = _stack(scene.lights)
    exact = prt.relight.reference.radiance(
        part.mesh, part.brdf, lights, eye=eye, occluder=scene.mesh, vertex=vertex, progress=True
    )
    factored = prt.brdf.separable.factor(part.brdf, terms=max(_TABLE_TERMS))
    full = prt.transport.separable.precompute(
        part.mesh, factored, keep=max(_TABLE_KEEP), occluder=scene.mesh, vertex=vertex
    )
    rows = []
    for terms in _TABLE_TERMS:
        brdf = factored.keep(terms)
        for keep in _TABLE_KEEP:
            transport = full.keep(keep, terms=terms)
            row = {"terms": terms, "keep": keep, "bytes_per_vertex": transport.nbytes / len(vertex)}
            light = next(iter(scene.lights.values()))
            seconds = _median(lambda t=transport, e=light: prt.relight.separable.light_tuple(t, e))
            row["light_change_nanoseconds_per_vertex"] = seconds / len(vertex) * 1e9
            for number, (name, each) in enumerate(scene.lights.items()):
                mine = prt.relight.separable.radiance(transport, brdf, each, eye=eye)
                row[f"error {name}"] = float(prt.image.relative_l2(mine, exact[number]))
            rows.append(row)
    return rows


def _stack(lights: dict[str, Environment]) -> Environment:
    return jax.tree.map(lambda *each: jnp.stack(each), *lights.values())


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "devices": [str(device) for device in jax.devices()],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxprt": prt.__version__,
    }


def _tell(report: dict[str, Any], path: Path) -> None:
    for name, light in report["lights"].items():
        parts = ", ".join(f"{part} {error:.1%}" for part, error in light["vertex_error"].items())
        print(f"{name}: relative L2 error of the picture {light['image_error']:.1%}; of vertex radiance: {parts}")
    times = report["times"]
    print(
        f"light change {times['light_change_seconds'] * 1e3:.1f} ms, view change "
        f"{times['view_change_seconds'] * 1e3:.1f} ms, picture {times['render_seconds'] * 1e3:.1f} ms"
    )
    for row in report.get("table", []):
        print("  ".join(f"{key} {value:.4g}" for key, value in row.items()))
    print(f"pictures and {path.name} are in {path.parent}")


if __name__ == "__main__":
    sys.exit(main())
