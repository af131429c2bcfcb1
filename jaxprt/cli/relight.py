"""The command `jaxprt relight`: relights scenes and measures the pictures."""

import json
import os
import platform
import resource
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import jax
import numpy as np

import jaxprt
from jaxprt.cli import animation, inputs, options, report
from jaxprt.cli.options import option
from jaxprt.cli.report import SystemScene, View
from jaxprt.files import outputs
from jaxprt.image.tonemap import TONES
from jaxprt.relit.planning import Plan
from jaxprt.visibility import blocks

SYSTEMS = ("planned", *options.NAMES)


@click.command(cls=options.Command, short_help="Render a scene under lights, and measure errors.")
@options.scene
@options.light
@options.camera
@options.systems(SYSTEMS, default=None, words="One or several systems to compare.  [default: planned]")
@option(
    "--error",
    group="System",
    type=options.Finite(0.0, 1.0, open=True),
    metavar="E",
    help="Largest relative error of the planned system.  [default: 0.05, or the smallest that systems reach]",
)
@option(
    "--plan",
    "saved",
    group="System",
    type=click.Path(exists=True, path_type=Path, file_okay=False),
    help="Use the plan in this folder, written by `jaxprt plan`.",
)
@options.bounces
@options.recipe
@option(
    "--animate",
    group="Output",
    type=options.Whole(2),
    metavar="N",
    help="Write N pictures by each system with changing light, view and materials.",
)
@option(
    "--table",
    group="Output",
    type=options.Whole(1),
    metavar="N",
    help="Report errors of each system at several sizes, on N vertices of the first part.",
)
@option(
    "--tone",
    group="Output",
    type=click.Choice(TONES),
    default="srgb",
    show_default=True,
    help="Tone curve of the PNG files: clamped radiance, or Hable's, AgX or ACES.",
)
@option(
    "--layers",
    group="Output",
    type=options.Several(click.Choice(list(outputs.LAYERS))),
    help="Also write these layers of each picture, as one EXR file without the light behind it.",
)
@option("--part", group="Output", metavar="K/N", help="Only precompute the K-th of N parts into a shared --output.")
@options.folder("Folder for pictures, report.json and precomputed data.", default="output")
@options.as_json
def command(**arguments: Any) -> None:
    """Relight a scene under one or several lights, and measure the pictures.

    FILEs are meshes and scenes (GLB, glTF, OBJ, PLY, STL, OFF) and environments (EXR, HDR), in any order. The default
    scene is a set of chess pieces; the default lights are daylight and a studio.

    The output folder receives a picture for each light and system, the exact picture, differences, and report.json.
    It also keeps precomputed data, so the same command continues after an interruption.

    \b
    Examples:
      jaxprt relight scene.glb grace.hdr --error 0.05 --output out/
      jaxprt relight bunny.ply grace.hdr uffizi.hdr --ground --brdf ashikhmin-shirley:nu=10,nv=100
      jaxprt relight bunny.ply grace.hdr --system lobe,harmonic --bounces all --turn 0,120,240
      jaxprt relight bunny.ply grace.hdr --ground --system dynamic --material 0=cook-torrance:roughness=.2 --animate 60
      jaxprt relight scene.glb --system lobe --output shared --part 3/16
    """  # noqa: D301
    chosen = SimpleNamespace(**arguments)
    with options.reserve_stdout(chosen.as_json):
        summary = _run(chosen)
    if chosen.part is None:
        text = _text(summary, chosen.output / "report.json")
    else:
        done = ["all parts are done: the same command without --part draws the pictures"]
        text = "\n".join(summary["unfinished"] or done)
    options.tell(summary, text, as_json=chosen.as_json)


def _run(chosen: SimpleNamespace) -> dict[str, Any]:
    """Draws and measures everything. If only a part is computed, reports what other parts must still do."""
    systems, part = _systems(chosen), _part(chosen.part)
    plan = load_plan(chosen.saved) if chosen.saved is not None else None
    view = inputs.view(chosen, size=64 if plan is None else plan.size)
    options.check(chosen, systems, 6 * next(iter(view.lights.values())).radiance.shape[-2] ** 2)
    make_folder(chosen.output)
    if part is not None:
        return {"unfinished": _share(view, chosen, systems, plan, part)}
    summary = _describe(view, chosen)
    names = ", ".join(f"{part.name} {len(part.mesh.position)}" for part in view.scene.parts)
    click.echo(f"jaxprt {summary['machine']['jaxprt']}: {names} vertices")
    candidates: dict[str, SystemScene] = {}
    for system in systems:
        candidates |= _precompute(system, view, chosen, plan)
    summary["precompute"] = {system: candidate.cost for system, candidate in candidates.items()}
    _draw(summary, view, candidates, chosen.output)
    for system, candidate in candidates.items() if chosen.layers else ():
        report.write_layers(view, system, candidate, chosen.layers, chosen.output)
    for system, candidate in candidates.items() if chosen.animate else ():
        folder = chosen.output / ("animation" if len(candidates) == 1 else f"animation_{system}")
        animation.animate(candidate.system, view, folder, frames=chosen.animate)
    summary["times"] = {system: report.times(view, candidate) for system, candidate in candidates.items()}
    if chosen.table:
        vertex = report.sample(view, chosen.table)
        right = report.exact_vertices(view, [vertex])[0]
        tabled = [system for system in systems if system in report.TABLES]
        summary["table"] = [row for system in tabled for row in report.table(system, view, vertex, right)]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    summary["peak_bytes"] = peak if sys.platform == "darwin" else 1024 * peak  # macOS reports bytes, Linux KiB
    outputs.write(chosen.output / "report.json", json.dumps(options.finite(summary), indent=2) + "\n")
    return summary


def _draw(summary: dict[str, Any], view: View, candidates: dict[str, SystemScene], output: Path) -> None:
    """Writes all pictures and adds their errors to the report."""
    drawn = report.draw(view, candidates)
    truth = report.exact(view, drawn)
    summary["exact"] = {
        "seconds": truth.seconds,
        "pixels": len(truth.pixels.pixel),
        "picture_width": truth.picture.camera.width,
        "vertices": {part.name: len(vertex) for part, vertex in zip(view.scene.parts, truth.vertex, strict=True)},
    }
    summary["lights"] = report.compare(view, candidates, drawn, truth, output)
    stops = {name: light["exposure_stops"] for name, light in summary["lights"].items()}
    for system, candidate in candidates.items():
        if candidate.system is not candidate.direct:
            for name, fraction in report.reflect(view, system, candidate, stops, output).items():
                summary["lights"][name][system]["reflected_fraction"] = fraction


def _systems(chosen: SimpleNamespace) -> tuple[str, ...]:
    """The requested systems. Refuses other options that do not fit them."""
    embedded = not inputs.split_files(chosen.files)[0]
    plain = ("separable", "harmonic", "lobe") if embedded and chosen.error is chosen.saved is None else ("planned",)
    systems = chosen.system or plain
    for name, value, system in (
        ("--error", chosen.error, "planned"),
        ("--plan", chosen.saved, "planned"),
    ):
        if value is not None and system not in systems:
            raise click.UsageError(f"{name} needs --system {system}, got {','.join(systems)}")
    if chosen.error is not None and chosen.saved is not None:
        raise click.UsageError("--plan has its own error: give --error or --plan, got both")
    return systems


def _part(text: str | None) -> blocks.Shard | None:
    """Parses the part K/N of all blocks to compute; None for all blocks."""
    number, _, count = ("1/1" if text is None else text).partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        raise click.UsageError(f"--part must be K/N, two whole numbers with K from 1 to N, got {text}")
    return None if text is None else blocks.Shard(int(number), int(count))


def load_plan(folder: Path) -> Plan:
    """Loads the plan in a folder that `jaxprt plan` or a planned run has written."""
    inside = folder / "plan"
    path = inside if inside.is_dir() else folder
    try:
        plan = report.objects.load(path)
    except ValueError as error:
        raise ValueError(f"--plan must be a folder of `jaxprt plan`: {error}") from error
    if not isinstance(plan, Plan):
        raise ValueError(f"--plan must be a folder of `jaxprt plan`, got a {type(plan).__name__} in {path}")
    return plan


def make_folder(path: Path, *, name: str = "--output") -> None:
    """Creates the folder of the option `name`, before anything is computed."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{name} must be a folder that can be made, got {path}: {error.strerror}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise ValueError(f"{name} must be a folder that can be written to, got {path}")


def _share(
    view: View, chosen: SimpleNamespace, systems: tuple[str, ...], plan: Plan | None, part: blocks.Shard
) -> list[str]:
    """Computes one part of the blocks. Returns what remains to be done."""
    left = []
    for system in systems:
        try:
            _precompute(system, view, chosen, plan, part)
        except blocks.UnfinishedError as error:
            left.append(str(error))
    return left


def _precompute(
    system: str, view: View, chosen: SimpleNamespace, plan: Plan | None, part: blocks.Shard | None = None
) -> dict[str, SystemScene]:
    """The scene, precomputed by one system, or by several sizes of it."""
    output, more = chosen.output, {"executor": part}
    if system == "planned" and plan is not None:
        bounces = plan.bounces if chosen.bounces is None else chosen.bounces
        return {system: report.make(view, plan.recipes, output / system, bounces=bounces, **more)}
    if system == "planned":
        return {system: report.plan(view, output / system, error=chosen.error, bounces=chosen.bounces, **more)}
    recipes = options.recipes(system, chosen)
    # Data that does not depend on the number of lobes is shared in one folder.
    return {
        name: report.make(view, recipe, output / system, bounces=chosen.bounces, **more)
        for name, recipe in recipes.items()
    }


def _describe(view: View, chosen: SimpleNamespace) -> dict[str, Any]:
    """The head of the report: scene, lights, machine and versions."""
    paths, lights = inputs.split_files(chosen.files)
    names = inputs.unique([path.stem for path in lights])
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "devices": [str(device) for device in jax.devices()],
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxprt": jaxprt.__version__,
        },
        "meshes": [str(path) for path in paths] or ["embedded"],
        "up": chosen.up,
        "ground": chosen.ground,
        "environments": dict(zip(names, map(str, lights), strict=True)) or "embedded",
        "turn": list(chosen.turn),
        "light_size": next(iter(view.lights.values())).radiance.shape[-2],
        "vertices": dict(zip(view.scene.names, view.scene.counts, strict=True)),
        "brdf": {part.name: inputs.describe(part.material) for part in view.scene.parts},
        "camera": {
            name: np.asarray(value).tolist()
            for name, value in vars(view.camera).items()
            if isinstance(value, jax.Array | float | int)
        },
    }


def _text(summary: dict[str, Any], path: Path) -> str:
    """The report as text."""
    exact, rows = summary["exact"], []
    for name, light in summary["lights"].items():
        least = light["exact_pixels_error"]
        rows.append(f"{name}: errors of pictures are measured by {exact['pixels']} exact pixels, good to {least:.1%}")
        least = light["exact_picture_error"]
        rows.append(
            f"{name}: the exact picture beside the others, a point for each surface of a pixel, good to {least:.1%}"
        )
        for system in summary["times"]:
            parts = ", ".join(f"{part} {error:.1%}" for part, error in light[system]["vertex_error"].items())
            error, spread = (100 * light[system][key] for key in ("picture_error", "picture_error_spread"))
            rows.append(
                f"{name}, {system}: relative L2 error of the picture {error:.1f} ± {spread:.1f} %; of vertices: {parts}"
            )
            if "reflected_fraction" in light[system]:
                fraction = light[system]["reflected_fraction"]
                rows.append(f"{name}, {system}: {fraction:.1%} of the picture's light comes from other surfaces")
    for system, times in summary["times"].items():
        milliseconds = ", ".join(f"{name.removesuffix('_seconds')} {1e3 * x:.1f} ms" for name, x in times.items())
        rows.append(f"{system}: a picture after a {milliseconds.replace('_', ' ')}")
    rows += map(report.row_text, summary.get("table", []))
    if exact["picture_width"] < summary["camera"]["width"]:
        rows.append(f"the exact picture and the differences are {exact['picture_width']} pixels wide")
    return "\n".join([*rows, f"pictures and {path.name} are in {path.parent}"])
