"""Relights a mesh and measures itself: `python -m jaxprt --mesh FILE --environment FILE --output FOLDER`."""

import argparse
import itertools
import json
import os
import platform
import resource
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

import jaxprt as prt
from jaxprt.cli import animation, play, report
from jaxprt.cli.report import Made, View
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Environment, Part, Scene
from jaxprt.visibility import blocks

SYSTEMS = ("planned", "separable", "harmonic", "lobe", "dynamic")
_LAPLACIAN = {"none": 1.0, "laplacian": 0.4}  # share of the squared Laplacian that each window leaves
# Turns that bring an axis of the file to +y.
_UPRIGHT = {
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}
# What the numbers of some options must be.
_RANGES = (
    (("size",), "from 1 to 8192", lambda x: 1 <= x <= 8192),
    (("terms", "keep", "table"), "at least 1", lambda x: x >= 1),
    (("order",), "from 1 to 15", lambda x: 1 <= x <= 15),
    (("lobes",), "from 1 to 64", lambda x: 1 <= x <= 64),
    (("animate",), "at least 2", lambda x: x >= 2),
    (("error",), "positive and less than 1", lambda x: 0 < x < 1),
    (("roughness", "f0"), "from 0 to 1", lambda x: 0 <= x <= 1),
    (("nu", "nv"), "positive and finite", lambda x: 0 < x < np.inf),
    (("diffuse", "specular"), "not negative and finite", lambda x: 0 <= x < np.inf),
    (("elevation",), "from -90 to 90 degrees", lambda x: abs(x) <= 90),
    (("azimuth",), "finite", np.isfinite),
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    plays = arguments[:1] == ["view"]
    options = None if plays else _parser().parse_args(arguments)
    warnings.showwarning = lambda message, *_, **__: print(f"jaxprt: {message}", file=sys.stderr)
    try:
        if options is None:
            play.main(arguments[1:])
        else:
            _run(options)
    except (ValueError, OSError, RuntimeError, MemoryError) as error:
        print(f"jaxprt: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxprt: stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m jaxprt", description=__doc__)
    parser.add_argument("--mesh", type=Path, help="GLB, glTF, OBJ, PLY, STL or OFF; an embedded scene if not given")
    parser.add_argument("--up", choices=list(_UPRIGHT), default="y", help="axis of the file that points up (default y)")
    parser.add_argument("--environment", type=Path, nargs="+", metavar="FILE", help="EXR or HDR; embedded if not given")
    parser.add_argument(
        "--brdf",
        choices=["ashikhmin-shirley", "cook-torrance", "lambert"],
        help="instead of the file's materials; matte gray if it has none",
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
        help="of one of the scene's parts, numbered from 0, Cook-Torrance's model; can change in the dynamic system",
    )
    parser.add_argument(
        "--system", choices=SYSTEMS, nargs="+", help="one, or several; planned (default) finds one for each part"
    )
    parser.add_argument("--error", type=float, help="relative error that the planned system must meet (default 0.05)")
    parser.add_argument(
        "--bounces",
        type=play.bounces,
        metavar="N",
        help='how often parts reflect light onto each other, or "all" (default: dynamic 2, others 0; planned decides)',
    )
    parser.add_argument(
        "--animate", type=int, metavar="N", help="write N pictures while light, view and materials change (dynamic)"
    )
    parser.add_argument("--terms", type=int, default=4, help="terms of the factored BRDF (default 4)")
    parser.add_argument("--keep", type=int, default=96, help="wavelet coefficients per vertex and term (default 96)")
    parser.add_argument(
        "--order", type=int, default=5, help="bands of the harmonic system (default 5: 25 coefficients)"
    )
    parser.add_argument(
        "--window", choices=list(_LAPLACIAN), default="laplacian", help="against ringing on what is glossy"
    )
    parser.add_argument(
        "--lobes", type=int, default=12, help="lobes of the glossy BRDF in the lobe system (default 12)"
    )
    parser.add_argument("--ground", action="store_true", help="stand the mesh on a diffuse ground plane")
    parser.add_argument("--size", type=int, default=512, help="edge of the pictures in pixels (default 512)")
    parser.add_argument("--azimuth", type=float, default=20.0, help="of the camera, degrees from +z to +x (default 20)")
    parser.add_argument("--elevation", type=float, default=15.0, help="of the camera, degrees (default 15)")
    parser.add_argument("--table", type=int, nargs="?", const=4000, metavar="N", help="add errors on N vertices (4000)")
    parser.add_argument("--part", metavar="K/N", help="only precompute the K-th of N parts into a shared --output")
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
    if options.error is not None and "planned" not in (options.system or ["planned"]):
        raise ValueError("--error needs --system planned")
    if options.animate is not None and "dynamic" not in (options.system or ()):
        raise ValueError("--animate needs --system dynamic")
    if options.part is not None and "dynamic" in (options.system or ()):
        raise ValueError("--part needs systems other than dynamic")


def _part(text: str | None) -> blocks.Part | None:
    """The part K/N of all blocks that is asked for; None for all of them."""
    number, _, count = ("1/1" if text is None else text).partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise ValueError(f"--part must be K/N, two whole numbers with K from 1 to N, got {text}")
    return None if text is None else blocks.Part(int(number), int(count))


def _run(options: argparse.Namespace) -> None:
    _check(options)
    part = _part(options.part)
    view = _view(options)
    _make_folder(options.output)
    systems = options.system or (["separable", "harmonic", "lobe"] if options.mesh is None else ["planned"])
    if part is not None:
        _share(view, options, systems, part)
        return
    found = _describe(view, options)
    print(
        f"jaxprt {prt.__version__}: {', '.join(f'{p.name} {len(p.mesh.position)}' for p in view.scene.parts)} vertices"
    )
    _warn_of_backs(view)
    made, changing = {}, None
    for system in systems:
        if system == "dynamic":
            count = 2 if options.bounces is None else options.bounces
            changing = animation.prepare(view, options.output, terms=options.terms, reflections=count)
            made[system] = animation.made(changing, view)
        else:
            made[system] = _made(system, view, options)
    found["precompute"] = {system: each.cost for system, each in made.items()}
    drawn = report.draw(view, made)
    truth = report.exact(view, drawn)
    found["exact"] = {
        "seconds": truth.seconds,
        "pixels": len(truth.pixels.pixel),
        "picture_width": truth.picture.camera.width,
        "vertices": {part.name: len(each) for part, each in zip(view.scene.parts, truth.vertex, strict=True)},
    }
    found["lights"] = report.compare(view, made, drawn, truth, options.output)
    stops = {name: light["exposure_stops"] for name, light in found["lights"].items()}
    for system, each in made.items():
        if each.system is not each.direct:
            for name, fraction in report.reflect(view, system, each, stops, options.output).items():
                found["lights"][name][system]["reflected_fraction"] = fraction
    if changing is not None and options.animate:
        animation.animate(changing, view, options.output, frames=options.animate)
    found["times"] = {system: report.times(view, each) for system, each in made.items()}
    if options.table:
        vertex = report.sample(view, options.table)
        right = report.exact_vertices(view, [vertex])[0]
        chosen = [system for system in systems if system in report.TABLES]
        found["table"] = [row for system in chosen for row in report.table(system, view, vertex, right)]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found["peak_bytes"] = peak if sys.platform == "darwin" else 1024 * peak  # macOS counts bytes, Linux KiB
    path = options.output / "report.json"
    path.write_text(json.dumps(found, indent=2) + "\n")
    _tell(found, path)


def _share(view: View, options: argparse.Namespace, systems: Sequence[str], part: blocks.Part) -> None:
    """Computes one part of the blocks, and says what is left to do."""
    left = []
    for system in systems:
        try:
            _made(system, view, options, part)
        except blocks.UnfinishedError as error:
            left.append(str(error))
    print("\n".join(left or ["all parts are done: the same command without --part draws the pictures"]))


def _make_folder(path: Path) -> None:
    """Makes the folder of the output, or says what is wrong with it before anything is computed."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--output must be a folder that can be made, got {path}: {error.strerror}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"--output must be a folder that can be written to, got {path}")


def _made(system: str, view: View, options: argparse.Namespace, part: blocks.Part | None = None) -> Made:
    """The scene, made ready by one system."""
    output = options.output / system
    if system == "planned":
        error = 0.05 if options.error is None else options.error
        return report.plan(view, output, error=error, bounces=options.bounces, executor=part)
    recipe: Recipe
    if system == "separable":
        recipe = prt.relit.Terms(options.terms, options.keep)
    elif system == "harmonic":
        recipe = prt.relit.Harmonics(options.order - 1, _LAPLACIAN[options.window])
    else:
        recipe = prt.relit.Lobes(options.lobes)
    return report.make(view, recipe, output, bounces=options.bounces, executor=part)


def _view(options: argparse.Namespace) -> View:
    """The scene, its lights, and the camera."""
    scene = _embedded(options) if options.mesh is None else _loaded(options)
    parts = list(scene.parts)
    for number, diffuse, specular, roughness, f0 in options.material:
        if number >= len(parts):
            raise ValueError(f"--material must name one of parts 0 to {len(parts) - 1}, got {number:g}")
        brdf = prt.brdf.CookTorrance(diffuse=diffuse, specular=specular, roughness=roughness, f0=f0)
        parts[int(number)] = _with(parts[int(number)], brdf)
    if options.environment:
        lights = _load_lights(options.environment)
    elif scene.environments:
        lights = {f"light_{number}": each for number, each in enumerate(scene.environments)}
    else:
        lights = {"daylight": prt.scene.builtin.daylight(), "studio": prt.scene.builtin.studio()}
    texels = 6 * next(iter(lights.values())).radiance.shape[-2] ** 2
    if options.keep > texels:
        raise ValueError(f"--keep must be at most {texels}, got {options.keep}")
    azimuth, elevation = np.radians([options.azimuth, options.elevation])
    edge = {"width": options.size, "height": options.size}
    # The board of the embedded scene, and the ground, may reach beyond the picture.
    shown = parts[:1] if options.mesh is None else parts[:-1] if options.ground else parts
    camera = prt.scene.camera.orbit(Scene(shown).mesh, azimuth=azimuth, elevation=elevation, **edge)
    return View(Scene(parts), lights, camera)


def _embedded(options: argparse.Namespace) -> Scene:
    """Chess pieces on a board."""
    if options.ground:
        raise ValueError("--ground needs --mesh: the embedded scene has a board")
    pieces, light, dark = prt.scene.mesh.split(prt.scene.builtin.chess())
    brdf = _brdf(options) or prt.brdf.AshikhminShirley(
        diffuse=options.diffuse, specular=options.specular, nu=options.nu, nv=options.nv
    )
    return Scene(
        [
            Part("pieces", pieces, brdf),
            Part("light squares", light, prt.brdf.Lambert([0.6, 0.55, 0.45])),
            Part("dark squares", dark, prt.brdf.Lambert([0.12, 0.08, 0.06])),
        ]
    )


def _loaded(options: argparse.Namespace) -> Scene:
    """The file's scene, upright, on its ground if one is asked for."""
    scene, brdf = prt.load_scene(options.mesh), _brdf(options)
    turn = np.array(_UPRIGHT[options.up])
    parts = [eqx.tree_at(lambda each: each.mesh, part, prt.scene.mesh.rotate(part.mesh, turn)) for part in scene.parts]
    if brdf is not None:
        parts = [_with(part, brdf) for part in parts]
    if options.ground:
        ground = prt.scene.mesh.ground_plane(Scene(parts).mesh)
        parts.append(Part("ground", ground, prt.brdf.Lambert(0.5)))
    return Scene(parts, environments=scene.environments)


def _with(part: Part, brdf: Callable) -> Part:
    """The part, of another BRDF."""
    return Part(part.name, part.mesh, brdf)


def _load_lights(paths: Sequence[Path]) -> dict[str, Environment]:
    """Environments by the names of their files, numbered where these are the same."""
    lights = {}
    for path in paths:
        names = itertools.chain([path.stem], (f"{path.stem}_{number}" for number in itertools.count(2)))
        lights[next(name for name in names if name not in lights)] = prt.scene.load_environment(path)
    return lights


def _brdf(options: argparse.Namespace) -> Callable | None:
    """The BRDF that is asked for, if one is."""
    if options.brdf is None:
        return None
    if options.brdf == "lambert":
        return prt.brdf.Lambert(options.diffuse)
    if options.brdf == "cook-torrance":
        more = {"roughness": options.roughness, "f0": options.f0}
        return prt.brdf.CookTorrance(diffuse=options.diffuse, specular=options.specular, **more)
    return prt.brdf.AshikhminShirley(diffuse=options.diffuse, specular=options.specular, nu=options.nu, nv=options.nv)


def _describe(view: View, options: argparse.Namespace) -> dict[str, Any]:
    """What is relit, where and by what: the head of the report."""

    def values(module):
        leaves = {name: value for name, value in vars(module).items() if isinstance(value, jax.Array | float | int)}
        return {name: np.asarray(value).tolist() for name, value in leaves.items()}

    files = options.environment or ["embedded"] * len(view.lights)
    parts = view.scene.parts
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
        "environments": {name: str(file) for name, file in zip(view.lights, files, strict=True)},
        "vertices": {part.name: len(part.mesh.position) for part in parts},
        "brdf": {part.name: {"model": type(part.material).__name__, **values(part.material)} for part in parts},
        "camera": values(view.camera),
    }


def _warn_of_backs(view: View) -> None:
    """Tells on stderr where the normals of most triangles in the picture point away, as in an inside-out mesh."""
    mesh, triangle = view.scene.parts[0].mesh, report.visible(view)
    corner = np.asarray(mesh.face)[triangle[triangle < len(mesh.face)]]
    normal, position = (np.asarray(field)[corner].mean(1) for field in (mesh.normal, mesh.position))
    away = np.sum(normal * (np.asarray(view.camera.eye) - position), 1) < 0
    if 2 * np.sum(away) > len(away):
        message = f"{np.sum(away)} of {len(away)} triangles in the picture face away and will be black"
        print(f"jaxprt: warning: {message}: is the mesh inside out, with clockwise faces?", file=sys.stderr)


def _tell(found: dict[str, Any], path: Path) -> None:
    exact = found["exact"]
    for name, light in found["lights"].items():
        least = light["exact_pixels_error"]
        print(f"{name}: errors of pictures are measured by {exact['pixels']} exact pixels, which are {least:.1%} off")
        for system in found["times"]:
            parts = ", ".join(f"{part} {error:.1%}" for part, error in light[system]["vertex_error"].items())
            error, spread = (100 * light[system][key] for key in ("picture_error", "picture_error_spread"))
            print(
                f"{name}, {system}: relative L2 error of the picture {error:.1f} ± {spread:.1f} %; of vertices: {parts}"
            )
            if "reflected_fraction" in light[system]:
                fraction = light[system]["reflected_fraction"]
                print(f"{name}, {system}: {fraction:.1%} of the picture's light comes from other surfaces")
    for system, times in found["times"].items():
        milliseconds = ", ".join(f"{name.removesuffix('_seconds')} {1e3 * x:.1f} ms" for name, x in times.items())
        print(f"{system}: a picture after a {milliseconds.replace('_', ' ')}")
    for row in found.get("table", []):
        print(
            "  ".join(
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
        )
    if exact["picture_width"] < found["camera"]["width"]:
        print(f"the exact picture and the differences are {exact['picture_width']} pixels wide")
    print(f"pictures and {path.name} are in {path.parent}")
