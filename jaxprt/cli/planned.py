"""The command `jaxprt plan`: chooses systems and sizes for a scene."""

import sys
from types import SimpleNamespace
from typing import Any

import click

from jaxprt.cli import inputs, options, relight
from jaxprt.cli.options import option
from jaxprt.files import objects
from jaxprt.relit.planning import ERROR, Plan, key_of, plan


@click.command(cls=options.Command, short_help="Find the smallest system that meets an error.")
@options.scene
@options.light
@option(
    "--error",
    group="Plan",
    type=options.Finite(0.0, 1.0, open=True),
    metavar="E",
    help="Largest relative L2 error of the radiance of each part.  [default: 0.05, or the smallest that systems reach]",
)
@option(
    "--rate",
    group="Plan",
    type=options.Finite(0.0, open=True),
    metavar="FPS",
    default=30.0,
    show_default=True,
    help="Least frames per second with a new light and a new view in each frame, without rasterization.",
)
@options.folder("Folder that keeps the plan, for `jaxprt relight --plan`, and the measurements.")
@options.as_json
def command(**arguments: Any) -> None:
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
    chosen = SimpleNamespace(**arguments)
    with options.reserve_stdout(chosen.as_json):
        result = _plan(chosen)
    options.tell(plan_json(result), str(result), as_json=chosen.as_json)


def _plan(chosen: SimpleNamespace) -> Plan:
    scene, lights = inputs.scene(chosen), list(inputs.lights(chosen).values())
    folder = None
    if chosen.output is not None:
        relight.make_folder(chosen.output)
        folder = chosen.output / "plan"
        if folder.exists():
            stored = relight.load_plan(chosen.output)
            asked = ERROR if chosen.error is None else chosen.error
            if (stored.key, stored.asked, stored.rate) == (key_of(scene, lights), asked, chosen.rate):
                return stored
            raise ValueError(f"{folder} was made for another scene, lights, error or rate: name another --output")
    candidates = None if chosen.output is None else chosen.output / "candidates"
    options_ = {"error": chosen.error, "rate": chosen.rate, "path": candidates, "progress": sys.stderr.isatty()}
    result = plan(scene, refine=False, environments=lights, **options_)
    if folder is not None:
        objects.save(folder, result)
    return result


def plan_json(result: Plan) -> dict[str, Any]:
    """A plan as JSON."""

    def candidate(option: Any) -> dict[str, Any]:
        sizes = {"system": type(option.recipe).__name__, **vars(option.recipe)}
        numbers = {"error": option.error, "seconds": option.seconds, "bytes": option.nbytes}
        numbers["precompute_seconds"] = option.precompute_seconds
        return {"recipe": sizes, **{name: float(value) for name, value in numbers.items()}}

    return {
        "asked": {"error": result.asked, "rate": result.rate, "light_size": result.size},
        "groups": [
            {
                "parts": list(group.names),
                "vertices": group.vertices,
                "mesh_error": float(group.mesh_error),
                "chosen": candidate(group.chosen),
                "considered": [candidate(one) for one in group.considered],
            }
            for group in result.group
        ],
        "reflected": {
            name: [float(share) for share in shares]
            for name, shares in zip(result.names, result.reflected.T, strict=True)
        },
        "bounces": result.bounces,
        "error": float(result.error),
        "seconds": float(result.seconds),
        "bytes": float(result.nbytes),
    }
