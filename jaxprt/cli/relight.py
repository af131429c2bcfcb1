"""The command `jaxprt relight`: relights scenes and measures the pictures."""

import json
import platform
import resource
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import jax

import jaxprt
from jaxprt.cli import animation, inputs, options, planned, report
from jaxprt.cli.report import View
from jaxprt.files import outputs
from jaxprt.files.inputs import JsonObject
from jaxprt.image.tonemap import TONES
from jaxprt.relit import RelitScene
from jaxprt.relit.planning import Plan
from jaxprt.scene.scene import centered
from jaxprt.scene.sides import two_sided
from jaxprt.view.state import State, load_state
from jaxprt.visibility import blocks


class Shard(click.ParamType):
    """A part K/N of all blocks of work."""

    name = "K/N"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> blocks.Shard:
        """Parses the part."""
        number, _, count = value.partition("/")
        if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
            self.fail(f"must be K/N, two whole numbers with K from 1 to N, got {value}", param, ctx)
        return blocks.Shard(int(number), int(count))


@options.command(
    "relight",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    Camera=[
        *options.CAMERA,
        {"state": (click.Path(exists=True, path_type=Path, dir_okay=False),)},
    ],
    System=[
        options.systems(options.PLANNED, "One or several systems to compare.  [default: planned]", default=None),
        {"plan": (click.Path(exists=True, path_type=Path, file_okay=False),)},
        *options.PLAN,
    ],
    Sizes=options.sizes(),
    Output=[
        {"animate": (options.Range(2),), "table": (options.Range(1),), "tone": (click.Choice(TONES), "srgb")},
        options.layers("Also write these layers of each picture, as one EXR file without the light behind it."),
        {"part": (Shard(),)},
        options.folder("Folder for pictures, report.json and precomputed data.", default="output"),
        options.JSON,
    ],
)
def command(chosen: SimpleNamespace) -> options.Result:
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

    Options:
        state: Draw what the viewer showed when it saved this file, without --azimuth, --elevation, --turn and --tone.
        plan: Use the plan in this folder, written by `jaxprt plan`.
        animate: Write N pictures by each system with changing light, view and materials.
        table: Report errors of each system at several sizes, on N vertices of the first part.
        tone: Tone curve of the PNG files: clamped radiance, or Hable's, AgX, ACES or Khronos Neutral.
        part: Only precompute the K-th of N parts into a shared --output.
    """  # noqa: D301
    systems = _systems(chosen)
    plan = None if chosen.plan is None else planned.load(chosen.plan)
    view = _view(chosen, plan)
    options.check(chosen, systems, next(iter(view.lights.values())))
    options.make_folder(chosen.output)
    if chosen.part is not None:
        return _share(view, chosen, systems, plan)
    summary = _describe(view, chosen)
    names = ", ".join(f"{name} {count}" for name, count in summary["vertices"].items())
    click.echo(f"jaxprt {jaxprt.__version__}: {names} vertices")
    precomputed = {name: pair for system in systems for name, pair in _precompute(system, view, chosen, plan).items()}
    scenes = {system: scene for system, (scene, _) in precomputed.items()}
    summary["precompute"] = {system: cost for system, (_, cost) in precomputed.items()}
    summary |= report.compare(view, scenes, chosen.output)
    for system, scene in scenes.items():
        if chosen.layers:
            report.write_layers(view, system, scene, chosen.layers, chosen.output)
        if chosen.animate:
            folder = chosen.output / ("animation" if len(scenes) == 1 else f"animation_{system}")
            animation.animate(scene, view, folder, frames=chosen.animate)
    summary["times"] = {system: report.times(view, scene) for system, scene in scenes.items()}
    if chosen.table:
        summary["table"], _ = report.tables(view, systems, chosen.table)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    summary["peak_bytes"] = peak if sys.platform == "darwin" else 1024 * peak  # macOS reports bytes, Linux KiB
    outputs.write(chosen.output / "report.json", json.dumps(options.finite(summary), indent=2) + "\n")
    return options.Result(summary, _text(summary, chosen.output))


def _systems(chosen: SimpleNamespace) -> tuple[str, ...]:
    """The requested systems. Refuses other options that do not fit them."""
    embedded = not inputs.split_files(chosen.files)[0]
    plain = ("separable", "harmonic", "lobe") if embedded and chosen.error is chosen.plan is None else ("planned",)
    systems = chosen.system or plain
    for name in ("error", "plan"):
        if getattr(chosen, name) is not None and "planned" not in systems:
            raise click.UsageError(f"--{name} needs --system planned, got {','.join(systems)}")
    if chosen.error is not None and chosen.plan is not None:
        raise click.UsageError("--plan has its own error: give --error or --plan, got both")
    return systems


def _view(chosen: SimpleNamespace, plan: Plan | None) -> View:
    """The scene, its lights, and a camera that sees everything except the ground."""
    state = None if chosen.state is None else load_state(chosen.state)
    if state is not None:
        return _view_of(state, chosen, plan)
    scene = two_sided(centered(options.call(inputs.scene, chosen)))
    lights = options.call(inputs.lights, chosen, light_size=_light_size(chosen, plan))
    return View(scene, lights, options.call(inputs.camera, chosen, parts=inputs.objects(scene, chosen)), chosen.tone)


def _view_of(state: State, chosen: SimpleNamespace, plan: Plan | None) -> View:
    """What a viewer showed of the files."""
    # Parts without a material are as in the viewer.
    scene = options.call(inputs.scene, chosen, playable=True)
    lights = options.call(inputs.lights, chosen, light_size=_light_size(chosen, plan), turn=(0.0,))
    camera = state.camera(chosen.size).local(scene.parts[0].mesh.origin)
    changed = two_sided(centered(state.changed(scene)))
    return View(changed, {state.light: state.environment(lights)}, camera, state.tone, state.stops)


def _light_size(chosen: SimpleNamespace, plan: Plan | None) -> int | None:
    return chosen.light_size or (None if plan is None else plan.size)


def _share(view: View, chosen: SimpleNamespace, systems: tuple[str, ...], plan: Plan | None) -> options.Result:
    """Computes one part of the blocks. Returns what remains to be done."""
    left = []
    for system in systems:
        try:
            _precompute(system, view, chosen, plan)
        except blocks.UnfinishedError as error:
            left.append(str(error))
    done = "all parts are done: the same command without --part draws the pictures"
    return options.Result({"unfinished": left}, "\n".join(left or [done]))


def _precompute(
    system: str, view: View, chosen: SimpleNamespace, plan: Plan | None
) -> dict[str, tuple[RelitScene, JsonObject]]:
    """The scene, precomputed by one system or by several sizes of it, and the costs."""
    wanted: JsonObject = {"bounces": chosen.bounces, "executor": chosen.part}
    if system != "planned":
        recipes = options.recipes(system, chosen)
    elif plan is not None:
        recipes = {system: plan.recipes}
        wanted["bounces"] = plan.bounces if chosen.bounces is None else chosen.bounces
    else:
        recipes = {system: None}
        wanted |= {"error": chosen.error, "environments": list(view.lights.values())}
    # Data that does not depend on the number of lobes is shared in one folder.
    path = chosen.output / system
    return {name: report.make(view, recipe, path, **wanted) for name, recipe in recipes.items()}


def _describe(view: View, chosen: SimpleNamespace) -> JsonObject:
    """The head of the report: scene, lights, machine and versions."""
    paths, lights = inputs.split_files(chosen.files)
    names = inputs.unique([path.stem for path in lights])
    return {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "devices": jax.devices(),
            "python": platform.python_version(),
            "jax": jax.__version__,
            "jaxprt": jaxprt.__version__,
        },
        "meshes": paths or ["embedded"],
        "up": chosen.up,
        "ground": chosen.ground,
        "environments": dict(zip(names, lights, strict=True)) or "embedded",
        "turn": chosen.turn,
        "light_size": next(iter(view.lights.values())).radiance.shape[-2],
        "vertices": dict(zip(view.scene.names, view.scene.counts, strict=True)),
        "brdf": {part.name: inputs.describe(part.material) for part in view.scene.parts},
        "camera": vars(view.camera),
    }


def _text(summary: JsonObject, output: Path) -> str:
    """The report as text."""
    exact, rows = summary["exact"], []
    for name, light in summary["lights"].items():
        sampled, shown = light["exact_pixels_error"], light["exact_picture_error"]
        rows += [
            f"{name}: errors of pictures are measured by {exact['pixels']} exact pixels, good to {sampled:.1%}",
            f"{name}: the exact picture beside the others, a point for each surface of a pixel, good to {shown:.1%}",
        ]
        for system in summary["times"]:
            parts = ", ".join(f"{part} {error:.1%}" for part, error in light[system]["vertex_error"].items())
            error, spread = (100 * light[system][key] for key in ("picture_error", "picture_error_spread"))
            head = f"{name}, {system}:"
            rows.append(f"{head} relative L2 error of the picture {error:.1f} ± {spread:.1f} %; of vertices: {parts}")
            if "reflected_fraction" in light[system]:
                fraction = light[system]["reflected_fraction"]
                rows.append(f"{head} {fraction:.1%} of the picture's light comes from other surfaces")
    for system, times in summary["times"].items():
        milliseconds = ", ".join(f"{name.removesuffix('_seconds')} {1e3 * x:.1f} ms" for name, x in times.items())
        rows.append(f"{system}: a picture after a {milliseconds.replace('_', ' ')}")
    rows += map(report.row_text, summary.get("table", []))
    if exact["picture_width"] < summary["camera"]["width"]:
        rows.append(f"the exact picture and the differences are {exact['picture_width']} pixels wide")
    return "\n".join([*rows, f"pictures and report.json are in {output}"])
