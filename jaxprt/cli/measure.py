"""The command `jaxprt measure`: measures scenes, and fits of BRDFs."""

import sys
from types import SimpleNamespace
from typing import Any

import click

from jaxprt.cli import inputs, options, report
from jaxprt.cli.options import option
from jaxprt.cli.report import View
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.relit.measuring import Report
from jaxprt.scene import Part, Scene, builtin
from jaxprt.scene.camera import orbit

_SYSTEMS = ("planned", *options.NAMES)
_RINGS, _SECTORS = 24, 36
_VERTICES = 300


@click.command(cls=options.Command, short_help="Measure errors, times and sizes of a scene or of a BRDF's fit.")
@options.scene
@options.light
@options.systems(_SYSTEMS, default=None, words="One or several.  [default: lobe]")
@option(
    "--error",
    group="System",
    type=options.Finite(0.0, 1.0, open=True),
    metavar="E",
    help="Largest relative error of the planned system.  [default: 0.05, or the smallest that systems reach]",
)
@options.bounces
@options.recipe
@option(
    "--fit",
    type=options.Material(),
    group="Fit",
    metavar="MATERIAL",
    help="Measure how accurately each system represents this BRDF at several sizes, on a sphere instead of meshes.",
)
@options.folder("Folder that keeps precomputed data for later runs.")
@options.as_json
def command(**arguments: Any) -> None:
    """Measure errors, times and bytes of a scene for each system, or of the fit of a BRDF.

    Errors are relative L2 errors of direct light against the exact sum, for pixels from three views and for vertices
    from eight views. Times and bytes include bounces.

    \b
    Examples:
      jaxprt measure scene.glb grace.hdr --system lobe,harmonic
      jaxprt measure scene.glb grace.hdr --system planned --error 0.03 --output kept --json
      jaxprt measure --fit merl:gold-metallic-paint.binary grace.hdr
      jaxprt measure --fit ward:along=.1,across=.3 --system lobe
    """  # noqa: D301
    chosen = SimpleNamespace(**arguments)
    with options.reserve_stdout(chosen.as_json):
        result, text = _scene(chosen) if chosen.fit is None else _fit(chosen)
    options.tell(result, text, as_json=chosen.as_json)


def _scene(chosen: SimpleNamespace) -> tuple[dict[str, Any], str]:
    """The report of a scene for each system."""
    scene, lights = inputs.scene(chosen), inputs.lights(chosen)
    systems = chosen.system or ("lobe",)
    options.check(chosen, systems, 6 * next(iter(lights.values())).radiance.shape[-2] ** 2)
    reports, texts = {}, []
    for system in systems:
        recipes = {"planned": None} if system == "planned" else options.recipes(system, chosen)
        for name, recipe in recipes.items():
            ready = prepare(scene, lights, recipe, chosen, None if chosen.output is None else chosen.output / system)
            summary = ready.report(list(lights.values()))
            reports[name] = report_json(summary, list(lights))
            texts.append(f"{name}, in the light of {', '.join(lights)}:\n{summary}")
    return {"lights": list(lights), "systems": reports}, "\n".join(texts)


def prepare(scene: Scene, lights: dict[str, Any], recipe: Any, chosen: SimpleNamespace, path: Any) -> RelitScene:
    """The scene, precomputed by a recipe, or by a plan if the recipe is None."""
    more: dict[str, Any] = {"system": recipe, "size": next(iter(lights.values())).radiance.shape[-2]}
    if recipe is None:
        more = {"error": chosen.error, "environments": list(lights.values())}
    more |= {"bounces": chosen.bounces, "path": path, "progress": sys.stderr.isatty()}
    return precompute(scene, refine=False, **more)


def report_json(summary: Report, lights: list[str]) -> dict[str, Any]:
    """A report as JSON."""

    def errors(values: Any) -> dict[str, float]:
        return {name: float(value) for name, value in zip(lights, values, strict=True)}

    return {
        "parts": [
            {
                "name": part.name,
                "vertices": part.vertices,
                "pixel_error": errors(part.errors),
                "vertex_error": errors(part.vertex_errors),
                "bytes": int(part.nbytes),
            }
            for part in summary.part
        ],
        "pixel_error": errors(summary.errors),
        "pixel_uncertainty": errors(summary.uncertainty),
        "interpolation_error": float(summary.interpolation_error),
        "light_seconds": float(summary.light_seconds),
        "view_seconds": float(summary.view_seconds),
        "bytes": int(summary.nbytes),
    }


def _fit(chosen: SimpleNamespace) -> tuple[dict[str, Any], str]:
    """Errors, times and bytes of a BRDF on a sphere, for the sizes of each system."""
    if inputs.split_files(chosen.files)[0]:
        raise click.UsageError(
            "--fit measures on a sphere and takes environments only, got a mesh: use --brdf to measure on the mesh"
        )
    systems = chosen.system or tuple(report.TABLES)
    unknown = [system for system in systems if system not in report.TABLES]
    if unknown:
        raise click.UsageError(f"--fit needs --system {', '.join(report.TABLES)}, got {unknown[0]}")
    lights = inputs.lights(chosen)
    scene = Scene([Part("sphere", builtin.sphere(rings=_RINGS, sectors=_SECTORS), chosen.fit)])
    view = View(scene, lights, orbit(scene.mesh, azimuth=0.5, elevation=0.3))
    vertex = report.sample(view, _VERTICES)
    right = report.exact_vertices(view, [vertex])[0]
    rows = [row for system in systems for row in report.table(system, view, vertex, right)]
    result = {"material": inputs.describe(chosen.fit), "vertices": len(vertex), "rows": rows}
    return result, "\n".join(map(report.row_text, rows))
