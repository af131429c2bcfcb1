"""Relights a mesh and measures itself: `python -m jaxprt --mesh FILE --environment FILE --output FOLDER`."""

import argparse
import itertools
import json
import platform
import resource
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxprt as prt
from jaxprt.cli import animation, report
from jaxprt.cli.report import Part, Scene
from jaxprt.scene import Environment

SYSTEMS = ("separable", "harmonic", "lobe", "dynamic")
# Turns that bring an axis of the file to +y.
_UPRIGHT = {
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}
# What the numbers of some options must be.
_RANGES = (
    (("size", "terms", "keep", "table"), "at least 1", lambda x: x >= 1),
    (("order",), "from 1 to 15", lambda x: 1 <= x <= 15),
    (("lobes",), "from 1 to 64", lambda x: 1 <= x <= 64),
    (("animate",), "at least 2", lambda x: x >= 2),
    (("roughness", "f0"), "from 0 to 1", lambda x: 0 <= x <= 1),
    (("nu", "nv"), "positive and finite", lambda x: 0 < x < np.inf),
    (("diffuse", "specular"), "not negative and finite", lambda x: 0 <= x < np.inf),
    (("elevation",), "from -90 to 90 degrees", lambda x: abs(x) <= 90),
    (("azimuth",), "finite", np.isfinite),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = _parser().parse_args(arguments)
    warnings.showwarning = lambda message, *_, **__: print(f"jaxprt: {message}", file=sys.stderr)
    try:
        _run(options)
    except (ValueError, OSError, RuntimeError) as error:
        print(f"jaxprt: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxprt: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxprt", description=__doc__)
    parser.add_argument("--mesh", type=Path, help="PLY, OBJ, STL, OFF, GLB or glTF; an embedded scene if not given")
    parser.add_argument("--up", choices=list(_UPRIGHT), default="y", help="axis of the file that points up (default y)")
    parser.add_argument("--environment", type=Path, nargs="+", metavar="FILE", help="EXR or HDR; embedded if not given")
    parser.add_argument(
        "--brdf", choices=["ashikhmin-shirley", "cook-torrance", "lambert"], help="default ashikhmin-shirley"
    )
    parser.add_argument("--diffuse", type=float, nargs="+", default=[0.5], help="gray or three colors (default 0.5)")
    parser.add_argument("--specular", type=float, nargs="+", default=[0.75], help="gray or three colors (default 0.75)")
    parser.add_argument("--nu", type=float, default=10.0, help="exponent along the tangent (default 10)")
    parser.add_argument("--nv", type=float, default=100.0, help="exponent across it (default 100)")
    parser.add_argument("--roughness", type=float, default=0.2, help="of Cook-Torrance's model (default 0.2)")
    parser.add_argument("--f0", type=float, default=0.1, help="its reflectance at normal incidence (default 0.1)")
    parser.add_argument(
        "--material",
        type=float,
        nargs=5,
        action="append",
        default=[],
        metavar=("REGION", "DIFFUSE", "SPECULAR", "ROUGHNESS", "F0"),
        help="of one of the scene's regions, numbered from 0, Cook-Torrance's model; can change in the dynamic system",
    )
    parser.add_argument("--system", choices=SYSTEMS, nargs="+", help="one, or several")
    parser.add_argument("--bounces", type=int, choices=[0, 1, 2], help="of light, in the dynamic system (default 2)")
    parser.add_argument(
        "--animate", type=int, metavar="N", help="write N pictures while light, view and materials change (dynamic)"
    )
    parser.add_argument("--terms", type=int, default=4, help="terms of the factored BRDF (default 4)")
    parser.add_argument("--keep", type=int, default=96, help="wavelet coefficients per vertex and term (default 96)")
    parser.add_argument(
        "--order", type=int, default=5, help="bands of the harmonic system (default 5: 25 coefficients)"
    )
    parser.add_argument(
        "--window", choices=list(report.WINDOWS), default="laplacian", help="against ringing on what is glossy"
    )
    parser.add_argument(
        "--lobes", type=int, default=12, help="lobes of the glossy BRDF in the lobe system (default 12)"
    )
    parser.add_argument("--ground", action="store_true", help="stand the mesh on a diffuse ground plane")
    parser.add_argument("--size", type=int, default=512, help="edge of the pictures in pixels (default 512)")
    parser.add_argument("--azimuth", type=float, default=20.0, help="of the camera, degrees from +z to +x (default 20)")
    parser.add_argument("--elevation", type=float, default=15.0, help="of the camera, degrees (default 15)")
    parser.add_argument("--table", type=int, nargs="?", const=4000, metavar="N", help="add errors on N vertices (4000)")
    parser.add_argument("--output", type=Path, default=Path("output"), help="folder for pictures and report.json")
    return parser


def _check(options: argparse.Namespace) -> None:
    """Refuses wrong numbers before anything is computed."""
    for names, required, holds in _RANGES:
        for name in names:
            value = getattr(options, name)
            numbers = value if isinstance(value, list) else [value]
            if len(numbers) not in (1, 3):
                raise ValueError(f"--{name} must be one number or three, got {len(numbers)}")
            wrong = [x for x in numbers if x is not None and not holds(x)]
            if wrong:
                raise ValueError(f"--{name} must be {required}, got {wrong[0]:g}")
    for region, *numbers in options.material:
        if not (all(0 <= x <= 1 for x in numbers) and region >= 0 and region == int(region)):
            raise ValueError(
                "--material must be the number of a region and four numbers from 0 to 1, got "
                f"{' '.join(f'{x:g}' for x in (region, *numbers))}"
            )
    for name in ("animate", "bounces"):
        if getattr(options, name) is not None and "dynamic" not in (options.system or ()):
            raise ValueError(f"--{name} needs --system dynamic")


def _run(options: argparse.Namespace) -> None:
    _check(options)
    scene = _scene(options)
    options.output.mkdir(parents=True, exist_ok=True)
    told = _describe(scene, options)
    print(f"jaxprt {prt.__version__}: {', '.join(f'{p.name} {len(p.mesh.position)}' for p in scene.parts)} vertices")
    _warn_of_backs(scene)
    systems = options.system or (["separable", "harmonic", "lobe"] if options.mesh is None else ["separable"])
    ready, changing = {}, None
    for system in systems:
        if system == "separable":
            ready[system] = report.relight_separable(scene, options.output, keep=options.keep)
        elif system == "harmonic":
            ready[system] = report.relight_harmonic(scene, options.output, order=options.order, window=options.window)
        elif system == "lobe":
            ready[system] = report.relight_lobe(scene, options.output, lobes=options.lobes)
        else:
            changing = animation.prepare(
                scene, options.output, bounces=2 if options.bounces is None else options.bounces
            )
            # The exact pictures have direct light alone, and so has what is compared with them.
            ready[system] = animation.relit(changing._replace(tensor=None), scene)
    told["precompute"] = {system: each.told for system, each in ready.items()}
    start, seen = time.perf_counter(), report.seen(scene)
    exact = report.exact(scene, seen)
    told["reference_seconds"] = time.perf_counter() - start
    told["lights"] = {
        name: report.compare(scene, name, ready, [each[number] for each in exact], seen, options.output)
        for number, name in enumerate(scene.lights)
    }
    if changing is not None:
        ready["dynamic"] = animation.relit(changing, scene)
        for name, light in told["lights"].items() if changing.tensor is not None else ():
            stops = light["exposure_stops"]
            light["dynamic"]["reflected_share"] = animation.reflect(changing, scene, name, stops, options.output)
        if options.animate:
            animation.animate(changing, scene, options.output, frames=options.animate)
    told["times"] = {system: report.times(scene, each) for system, each in ready.items()}
    if options.table:
        vertex = report.sample(scene, options.table)
        truth = report.exact(scene, [vertex])[0]
        tables = {"separable": report.table_separable, "harmonic": report.table_harmonic, "lobe": report.table_lobe}
        told["table"] = [row for system in systems if system in tables for row in tables[system](scene, vertex, truth)]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    told["peak_bytes"] = peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, Linux KiB
    path = options.output / "report.json"
    path.write_text(json.dumps(told, indent=2) + "\n")
    _tell(told, path)


def _scene(options: argparse.Namespace) -> Scene:
    terms = 1 if options.brdf == "lambert" else options.terms
    if options.mesh is None:
        pieces, light, dark = prt.scene.mesh.split(prt.scene.builtin.chess())
        parts = [
            Part("pieces", pieces, _brdf(options), terms),
            Part("light squares", light, prt.brdf.Lambert([0.6, 0.55, 0.45]), 1),
            Part("dark squares", dark, prt.brdf.Lambert([0.12, 0.08, 0.06]), 1),
        ]
    else:
        mesh = prt.scene.mesh.turn(prt.scene.load_mesh(options.mesh), np.array(_UPRIGHT[options.up]))
        parts = [Part("object", mesh, _brdf(options), terms)]
        if options.material and len(np.unique(np.asarray(mesh.region))) > 1:
            regions = enumerate(prt.scene.mesh.split(mesh))
            parts = [Part(f"region {number}", each, _brdf(options), terms) for number, each in regions]
        if options.ground:
            parts.append(Part("ground", prt.scene.mesh.ground_plane(mesh), prt.brdf.Lambert(0.5), 1))
    for region, diffuse, specular, roughness, f0 in options.material:
        if region >= len(parts):
            raise ValueError(f"--material must name one of regions 0 to {len(parts) - 1}, got {region:g}")
        brdf = prt.brdf.CookTorrance(diffuse=diffuse, specular=specular, roughness=roughness, f0=f0)
        parts[int(region)] = parts[int(region)]._replace(brdf=brdf, terms=options.terms)
    if options.environment:
        lights = _load_lights(options.environment)
    else:
        lights = {"daylight": prt.scene.builtin.daylight(), "studio": prt.scene.builtin.studio()}
    texels = 6 * next(iter(lights.values())).radiance.shape[-2] ** 2
    if options.keep > texels:
        raise ValueError(f"--keep must be at most {texels}, got {options.keep}")
    azimuth, elevation = np.radians([options.azimuth, options.elevation])
    edge = {"width": options.size, "height": options.size}
    return Scene(parts, lights, prt.scene.camera.orbit(parts[0].mesh, azimuth=azimuth, elevation=elevation, **edge))


def _load_lights(paths: Sequence[Path]) -> dict[str, Environment]:
    """Environments by the names of their files, numbered where these are the same."""
    lights = {}
    for path in paths:
        names = itertools.chain([path.stem], (f"{path.stem}_{number}" for number in itertools.count(2)))
        lights[next(name for name in names if name not in lights)] = prt.scene.load_environment(path)
    return lights


def _brdf(options: argparse.Namespace) -> Callable:
    if options.brdf == "lambert":
        return prt.brdf.Lambert(options.diffuse)
    if options.brdf == "cook-torrance":
        more = {"roughness": options.roughness, "f0": options.f0}
        return prt.brdf.CookTorrance(diffuse=options.diffuse, specular=options.specular, **more)
    return prt.brdf.AshikhminShirley(diffuse=options.diffuse, specular=options.specular, nu=options.nu, nv=options.nv)


def _describe(scene: Scene, options: argparse.Namespace) -> dict[str, Any]:
    """What is relit, where and by what: the head of the report."""

    def values(module):
        return {name: np.asarray(value).tolist() for name, value in vars(module).items()}

    files = options.environment or ["embedded"] * len(scene.lights)
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "devices": [str(device) for device in jax.devices()],
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxprt": prt.__version__,
        },
        "mesh": str(options.mesh or "embedded"),
        "up": options.up,
        "ground": options.ground,
        "environments": {name: str(file) for name, file in zip(scene.lights, files, strict=True)},
        "vertices": {part.name: len(part.mesh.position) for part in scene.parts},
        "brdf": {part.name: {"model": type(part.brdf).__name__, **values(part.brdf)} for part in scene.parts},
        "camera": values(scene.camera),
    }


def _warn_of_backs(scene: Scene) -> None:
    """Tells on stderr where the normals of most triangles in the picture point away, as in an inside-out mesh."""
    mesh, triangle = scene.parts[0].mesh, report.visible(scene)
    corner = np.asarray(mesh.face)[triangle[triangle < len(mesh.face)]]
    normal, position = (np.asarray(field)[corner].mean(1) for field in (mesh.normal, mesh.position))
    away = np.sum(normal * (np.asarray(scene.camera.eye) - position), 1) < 0
    if 2 * np.sum(away) > len(away):
        told = f"{np.sum(away)} of {len(away)} triangles in the picture face away and will be black"
        print(f"jaxprt: warning: {told}: is the mesh inside out, with clockwise faces?", file=sys.stderr)


def _tell(told: dict[str, Any], path: Path) -> None:
    for name, light in told["lights"].items():
        for system in told["times"]:
            parts = ", ".join(f"{part} {error:.1%}" for part, error in light[system]["vertex_error"].items())
            error = light[system]["image_error"]
            print(f"{name}, {system}: relative L2 error of the picture {error:.1%}; of vertex radiance: {parts}")
            if "reflected_share" in light[system]:
                share = light[system]["reflected_share"]
                print(f"{name}, {system}: {share:.1%} of the picture's light comes from other surfaces")
    for system, times in told["times"].items():
        milliseconds = ", ".join(f"{name.removesuffix('_seconds')} {1e3 * x:.1f} ms" for name, x in times.items())
        print(f"{system}: {milliseconds.replace('_', ' ')}")
    for row in told.get("table", []):
        print(
            "  ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
        )
    print(f"pictures and {path.name} are in {path.parent}")


if __name__ == "__main__":
    sys.exit(main())
