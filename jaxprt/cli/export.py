"""The command `jaxprt export`: writes scenes and lights for other programs."""

import json
import os
import sys
from pathlib import Path
from types import SimpleNamespace

import click

from jaxprt.cli import inputs, options
from jaxprt.files import outputs
from jaxprt.files.inputs import JsonObject
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.scene import Environment, light_probe
from jaxprt.scene.light_probes import TOOLS
from jaxprt.view import browser, export, export_baked, export_gltf, gltf, page_error

_KINDS = {".html": "page", ".glb": "baked", ".json": "probes"}


@options.command(
    "export",
    options.FILES,
    Scene=options.SCENE,
    Light=options.LIGHT,
    Output=[
        click.Option(
            ["--output", "-o"],
            type=click.Path(path_type=Path),
            multiple=True,
            required=True,
            metavar="FILE",
            help="File to write: *.html, *.glb or *.json. May be given several times.",
        ),
        {"format": (click.Choice(["baked", "gltf"]), "baked")},
        *options.options_of(export_gltf, degree=options.Range(0, gltf.MOST_DEGREE)),
        *options.options_of(export, most=options.Range(1, name="bytes")),
        {
            "error": (options.Range(0.0, kind=float, name="E"), page_error.NOTABLE),
            "tool": (options.Several(click.Choice(TOOLS, case_sensitive=False)), TOOLS),
            "store": (click.Path(path_type=Path, file_okay=False),),
        },
        options.JSON,
    ],
    System=[options.systems(("lobe", "harmonic", "dynamic"), "Of pages and scenes."), options.NO_BOUNCES],
    Sizes=options.FEW_SIZES,
)
def command(chosen: SimpleNamespace) -> options.Result:
    """Write a scene or its lights for other programs.

    \b
    *.html  a page that relights the scene in any browser, without Python and offline; it is written if its pictures are
          at most --error off those of the scene
    *.glb   the scene as glTF, with the radiance under the first light as vertex colors; with --format gltf its
          materials, and transfer in vertex attributes, for shaders of other programs
    *.json  light probes: nine spherical harmonics of each light, in the scaling and axes of other tools

    \b
    Examples:
      jaxprt export scene.glb grace.hdr --output piece.html
      jaxprt export scene.glb grace.hdr --output piece.html --output baked.glb --system harmonic --store kept
      jaxprt export scene.glb grace.hdr --format gltf --output prt.glb
      jaxprt export grace.hdr uffizi.hdr --output probes.json --tool three.js

    Options:
        format: What *.glb holds: colors of one light and view, or transfer in vertex attributes and materials.
        error: Largest relative L2 error of the page's pictures: a page with more is not written; the message says why.
        tool: Tools for which *.json has light probes.
        store: Folder that keeps precomputed data for later runs.
    """  # noqa: D301
    recipe = options.recipe(chosen, "an export")
    for path in chosen.output:
        _check(path)
    options.make_folder(chosen.store, name="--store")
    lights, ready, rows, texts = options.call(inputs.lights, chosen), None, [], []
    for path in chosen.output:
        kind = _KINDS[path.suffix.lower()]
        if kind == "probes":
            text = _write_probes(path, lights, chosen.tool)
            row = {}
        else:
            if ready is None:
                scene = options.call(inputs.scene, chosen, playable=True)
                size = next(iter(lights.values())).radiance.shape[-2]
                wanted = {"size": size, "bounces": chosen.bounces, "path": chosen.store}
                shown = {"refine": False, "progress": sys.stderr.isatty()}
                ready = precompute(scene, system=recipe, **wanted, **shown)
            kind, row, text = _write(path, kind, ready, lights, chosen)
        size = path.stat().st_size
        rows.append({"path": path, "kind": kind, "bytes": size, **row})
        texts.append(f"jaxprt: {path}, {size:,} bytes{text}")
    return options.Result(rows, "\n".join(texts))


def _check(path: Path) -> None:
    """Refuses a file that cannot be written. It is opened, because permissions alone do not tell, and not changed."""
    if path.suffix.lower() not in _KINDS:
        raise click.UsageError(f"--output must end in {', '.join(_KINDS)}, got {path}")
    if not path.parent.exists():
        raise click.UsageError(f"--output must be in a folder that exists, got {path}: there is no {path.parent}")
    if os.path.isdir(path):
        raise click.UsageError(f"--output must be a file, got the folder {path}")
    new = not os.path.lexists(path)
    try:
        with path.open("ab"):
            pass
        if new:
            path.unlink()
    except OSError as error:
        reason = f"--output must be a file that can be written, got {path}: {error.strerror}"
        raise click.ClickException(reason) from error


def _write(
    path: Path, kind: str, scene: RelitScene, lights: dict[str, Environment], chosen: SimpleNamespace
) -> tuple[str, JsonObject, str]:
    """Writes a scene. Returns the kind of the file, and its description as JSON and as text."""
    if kind == "page":
        piece = export(scene, path, environments=lights, most=chosen.most, error=chosen.error)
        text = f", {100 * piece.error:.1f} % off pictures of the scene in the light {piece.light!r}"
        text += "".join(f"\n  {cause}" for cause in piece.causes)
        causes = {cause.name: cause.error for cause in piece.causes}
        row = {"error": piece.error, "causes": causes, "visibility_edge": piece.edge, "degree": piece.degree}
        return kind, row, text
    if chosen.format == "gltf":
        export_gltf(scene, path, environments=lights, degree=chosen.degree)
        text = f", with transfer of degree {chosen.degree} in vertex attributes, and lights {', '.join(lights)}"
        text += f"\n  relight it in three.js by {browser.FOLDER / 'three.js'}"
        return "transfer", {"degree": chosen.degree}, text
    name, light = next(iter(lights.items()))
    exposure = export_baked(scene, path, light)
    text = f", in the light of {name}; its colors times {exposure:.4g} are radiance"
    return kind, {"light": name, "exposure": exposure}, text


def _write_probes(path: Path, lights: dict[str, Environment], tools: tuple[str, ...]) -> str:
    """Writes light probes. Returns a description of the file."""
    content = {tool: {name: light_probe(light, tool=tool) for name, light in lights.items()} for tool in tools}
    outputs.write(path, json.dumps(options.finite(content), indent=2) + "\n")
    return f", nine colors of each of {', '.join(lights)} for {', '.join(tools)}"
