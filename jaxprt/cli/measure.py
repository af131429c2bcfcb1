"""The command `jaxprt measure`: measures scenes, and fits of BRDFs."""

import sys
from types import SimpleNamespace

import click

from jaxprt.cli import inputs, options, report
from jaxprt.files.inputs import JsonObject
from jaxprt.relit.build import precompute
from jaxprt.relit.measuring import Report
from jaxprt.scene import Part, Scene, builtin
from jaxprt.scene.camera import orbit

_RINGS, _SECTORS = 24, 36
_VERTICES = 300


@options.command(
    "measure",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    System=[options.systems(options.PLANNED, "One or several.  [default: lobe]", default=None), *options.PLAN],
    Sizes=options.sizes(),
    Fit=[{"fit": (options.Material(),)}],
    Output=[options.folder("Folder that keeps precomputed data for later runs."), options.JSON],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Measure errors, times and bytes of a scene for each system, or of the fit of a BRDF.

    Errors are relative L2 errors of direct light against the exact sum, for pixels from three views and for vertices
    from eight views. Times and bytes include bounces.

    \b
    Examples:
      jaxprt measure scene.glb grace.hdr --system lobe,harmonic
      jaxprt measure scene.glb grace.hdr --system planned --error 0.03 --output kept --json
      jaxprt measure --fit merl:gold-metallic-paint.binary grace.hdr
      jaxprt measure --fit ward:along=.1,across=.3 --system lobe

    Options:
        fit: Measure how accurately each system represents this BRDF at several sizes, on a sphere instead of meshes.
    """  # noqa: D301
    return _scene(chosen) if chosen.fit is None else _fit(chosen)


def _scene(chosen: SimpleNamespace) -> options.Result:
    """The report of a scene for each system."""
    scene, lights = options.call(inputs.scene, chosen), options.call(inputs.lights, chosen)
    systems, environments = chosen.system or ("lobe",), list(lights.values())
    options.check(chosen, systems, environments[0])
    reports, texts, shown = {}, [], {"refine": False, "progress": sys.stderr.isatty()}
    for system in systems:
        wanted = {"bounces": chosen.bounces, "path": chosen.output and chosen.output / system}
        if system == "planned":
            wanted |= {"error": chosen.error, "environments": environments}
        else:
            wanted |= {"size": environments[0].radiance.shape[-2]}
        recipes = {system: None} if system == "planned" else options.recipes(system, chosen)
        for name, recipe in recipes.items():
            summary = precompute(scene, system=recipe, **wanted, **shown).report(environments)
            reports[name] = _content(summary, list(lights))
            texts.append(f"{name}, in the light of {', '.join(lights)}:\n{summary}")
    return options.Result({"lights": list(lights), "systems": reports}, "\n".join(texts))


def _content(summary: Report, lights: list[str]) -> JsonObject:
    """A report as JSON."""

    def errors(values: tuple[float, ...]) -> dict[str, float]:
        return dict(zip(lights, values, strict=True))

    parts = [
        {
            "name": part.name,
            "vertices": part.vertices,
            "pixel_error": errors(part.errors),
            "vertex_error": errors(part.vertex_errors),
            "bytes": part.nbytes,
        }
        for part in summary.part
    ]
    return {
        "parts": parts,
        "pixel_error": errors(summary.errors),
        "pixel_uncertainty": errors(summary.uncertainty),
        "interpolation_error": summary.interpolation_error,
        "light_seconds": summary.light_seconds,
        "view_seconds": summary.view_seconds,
        "bytes": summary.nbytes,
    }


def _fit(chosen: SimpleNamespace) -> options.Result:
    """Errors, times and bytes of a BRDF on a sphere, for the sizes of each system."""
    if inputs.split_files(chosen.files)[0]:
        raise click.UsageError(
            "--fit measures on a sphere and takes environments only, got a mesh: use --brdf to measure on the mesh"
        )
    systems = chosen.system or tuple(report.TABLES)
    unknown = [system for system in systems if system not in report.TABLES]
    if unknown:
        raise click.UsageError(f"--fit needs --system {', '.join(report.TABLES)}, got {unknown[0]}")
    lights = options.call(inputs.lights, chosen)
    scene = Scene([Part("sphere", builtin.sphere(rings=_RINGS, sectors=_SECTORS), chosen.fit)])
    view = report.View(scene, lights, orbit(scene.mesh, azimuth=0.5, elevation=0.3))
    rows, count = report.tables(view, systems, _VERTICES)
    result = {"material": inputs.describe(chosen.fit), "vertices": count, "rows": rows}
    return options.Result(result, "\n".join(map(report.row_text, rows)))
