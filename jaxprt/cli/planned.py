"""The command `jaxprt plan`: chooses systems and sizes for a scene."""

import sys
from pathlib import Path
from types import SimpleNamespace

from jaxprt.cli import inputs, options
from jaxprt.files import objects
from jaxprt.files.inputs import JsonObject
from jaxprt.relit.build import precompute
from jaxprt.relit.planning import ERROR, Candidate, Plan, key_of, plan

_RATE = options.Range(0.0, kind=float, open=True, name="FPS")


@options.command(
    "plan",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    Plan=options.options_of(precompute, error=options.FRACTION, rate=_RATE),
    Output=[
        options.folder("Folder that keeps the plan, for `jaxprt relight --plan`, and the measurements."),
        options.JSON,
    ],
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Choose the system and sizes that meet an error with the fewest bytes, for each part of a scene.

    The table has a row for each candidate: its error, time per frame, bytes, and precomputation time, measured on a
    sample of the vertices. A star marks the choice.

    \b
    Examples:
      jaxprt plan scene.glb grace.hdr --error 0.02
      jaxprt plan scene.glb grace.hdr uffizi.hdr --error 0.05 --rate 60 --output kept
      jaxprt relight scene.glb grace.hdr --plan kept
      jaxprt plan bunny.ply --brdf ggx:roughness=.2 --json > plan.json
    """  # noqa: D301
    scene, lights = options.call(inputs.scene, chosen), list(options.call(inputs.lights, chosen).values())
    options.make_folder(chosen.output)
    folder, measurements = (chosen.output and chosen.output / name for name in ("plan", "candidates"))
    if folder is not None and folder.exists():
        result, asked = load(folder), ERROR if chosen.error is None else chosen.error
        if (result.key, result.asked, result.rate) != (key_of(scene, lights), asked, chosen.rate):
            raise ValueError(f"{folder} was made for another scene, lights, error or rate: name another --output")
    else:
        wanted = {"error": chosen.error, "rate": chosen.rate, "environments": lights, "path": measurements}
        result = plan(scene, refine=False, progress=sys.stderr.isatty(), **wanted)
        if folder is not None:
            objects.save(folder, result)
    return options.Result(_content(result), str(result))


def load(folder: Path) -> Plan:
    """Loads the plan in a folder that `jaxprt plan` or a planned run has written."""
    path = folder / "plan" if (folder / "plan").is_dir() else folder
    try:
        plan = objects.load(path)
    except ValueError as error:
        raise ValueError(f"--plan must be a folder of `jaxprt plan`: {error}") from error
    if not isinstance(plan, Plan):
        raise ValueError(f"--plan must be a folder of `jaxprt plan`, got a {type(plan).__name__} in {path}")
    return plan


def _content(result: Plan) -> JsonObject:
    """A plan as JSON."""

    def candidate(option: Candidate) -> JsonObject:
        values = {"error": option.error, "seconds": option.seconds, "bytes": option.nbytes}
        sizes = {"system": type(option.recipe).__name__, **vars(option.recipe)}
        return {"recipe": sizes, **values, "precompute_seconds": option.precompute_seconds}

    groups = [
        {
            "parts": group.names,
            "vertices": group.vertices,
            "mesh_error": group.mesh_error,
            "chosen": candidate(group.chosen),
            "considered": list(map(candidate, group.considered)),
        }
        for group in result.group
    ]
    return {
        "asked": {"error": result.asked, "rate": result.rate, "light_size": result.size},
        "groups": groups,
        "reflected": dict(zip(result.names, result.reflected.T, strict=True)),
        "bounces": result.bounces,
        "error": result.error,
        "seconds": result.seconds,
        "bytes": result.nbytes,
    }
