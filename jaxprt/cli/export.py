"""The command `jaxprt export`: writes scenes and lights for other programs."""

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import numpy as np

from jaxprt.cli import inputs, options, play, relight
from jaxprt.cli.options import option
from jaxprt.files import outputs
from jaxprt.scene import Environment, light_probe
from jaxprt.scene.light_probes import TOOLS
from jaxprt.view import export, export_baked, export_gltf, gltf, page_error

_KINDS = {".html": "page", ".glb": "baked", ".json": "probes"}
_BAKED, _TRANSFER = "baked", "gltf"  # formats of *.glb


@click.command(cls=options.Command, short_help="Export web pages, baked glTF, and light probes.")
@options.scene
@options.light
@option(
    "--output",
    "-o",
    group="Output",
    type=click.Path(path_type=Path),
    multiple=True,
    required=True,
    metavar="FILE",
    help="File to write: *.html, *.glb or *.json. May be given several times.",
)
@option(
    "--format",
    group="Output",
    type=click.Choice([_BAKED, _TRANSFER]),
    default=_BAKED,
    show_default=True,
    help="What *.glb holds: colors of one light and view, or transfer in vertex attributes and materials.",
)
@option(
    "--degree",
    group="Output",
    type=options.Whole(0, gltf.MOST_DEGREE),
    default=gltf.DEGREE,
    show_default=True,
    help="Degree of the harmonics of the transfer in *.glb.",
)
@options.systems(("lobe", "harmonic", "dynamic"), default="lobe", words="Of pages and scenes.  [default: lobe]")
@options.no_bounces
@options.few_sizes
@option(
    "--most",
    group="Output",
    type=options.Whole(1),
    metavar="BYTES",
    default=32_000_000,
    show_default=True,
    help="Largest size of the page in bytes.",
)
@option(
    "--error",
    group="Output",
    type=options.Finite(0.0),
    metavar="E",
    default=page_error.NOTABLE,
    show_default=True,
    help="Largest relative L2 error of the page's pictures. A page with more is not written; the message says why.",
)
@option(
    "--tool",
    group="Output",
    type=options.Several(click.Choice(TOOLS, case_sensitive=False)),
    default=",".join(TOOLS),
    help="Tools for which *.json has light probes.  [default: all]",
)
@option(
    "--store",
    group="Output",
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder that keeps precomputed data for later runs.",
)
@options.as_json
def command(**arguments: Any) -> None:
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
    """  # noqa: D301
    chosen = SimpleNamespace(**arguments)
    _check(chosen)
    with options.reserve_stdout(chosen.as_json):
        files = _write(chosen)
    rows = [f"jaxprt: {row['path']}, {row['bytes']:,} bytes{row.pop('words')}" for row in files]
    options.tell(files, "\n".join(rows), as_json=chosen.as_json)


def _check(chosen: SimpleNamespace) -> None:
    """Refuses files that cannot be written, before anything is computed."""
    for path in chosen.output:
        if path.suffix.lower() not in _KINDS:
            raise click.UsageError(f"--output must end in {', '.join(_KINDS)}, got {path}")
        if not path.parent.exists():
            raise click.UsageError(f"--output must be in a folder that exists, got {path}: there is no {path.parent}")
        if os.path.isdir(path):
            raise click.UsageError(f"--output must be a file, got the folder {path}")
    if len(chosen.system) > 1 or len(chosen.lobes or ()) > 1:
        raise click.UsageError("an export takes one system and one number of lobes, got several")
    for path in chosen.output:
        _check_writable(path)
    if chosen.store is not None:
        relight.make_folder(chosen.store, name="--store")


def _check_writable(path: Path) -> None:
    """Opens the file for writing, because permissions alone do not tell. An existing file is not changed."""
    new = not os.path.lexists(path)
    try:
        with path.open("ab"):
            pass
        if new:
            path.unlink()
    except OSError as error:
        raise click.ClickException(
            f"--output must be a file that can be written, got {path}: {error.strerror}"
        ) from error


def _write(chosen: SimpleNamespace) -> list[dict[str, Any]]:
    """Writes all files. Returns a description of each."""
    lights, ready, rows = inputs.lights(chosen), None, []
    for path in chosen.output:
        kind = _KINDS[path.suffix.lower()]
        if kind == "probes":
            rows.append(probes(path, lights, chosen.tool))
            continue
        if ready is None:
            (recipe,) = options.recipes(chosen.system[0], chosen, lobes=play.LOBES).values()
            scene = inputs.scene(chosen, playable=True)
            ready = play.precompute_scene(scene, lights, recipe, chosen.bounces, chosen.store)
        if kind == "page":
            piece = export(ready, path, environments=lights, most=chosen.most, error=chosen.error)
            causes = {cause.name: cause.error for cause in piece.causes}
            row = {"error": piece.error, "causes": causes, "visibility_edge": piece.edge, "degree": piece.degree}
            words = f", {100 * piece.error:.1f} % off pictures of the scene in the light {piece.light!r}"
            words += "".join(f"\n  {cause}" for cause in piece.causes)
        elif chosen.format == _TRANSFER:
            kind = "transfer"
            export_gltf(ready, path, environments=lights, degree=chosen.degree)
            row = {"degree": chosen.degree}
            words = f", with transfer of degree {chosen.degree} in vertex attributes, and lights {', '.join(lights)}"
        else:
            name, light = next(iter(lights.items()))
            row = {"light": name, "exposure": export_baked(ready, path, light)}
            words = f", in the light of {name}; its colors times {row['exposure']:.4g} are radiance"
        rows.append({"path": str(path), "kind": kind, "bytes": path.stat().st_size, **row, "words": words})
    return rows


def probes(path: Path, lights: dict[str, Environment], tools: tuple[str, ...]) -> dict[str, Any]:
    """Writes light probes. Returns a description of the file."""
    content = {
        tool: {name: np.asarray(light_probe(light, tool=tool), float).tolist() for name, light in lights.items()}
        for tool in tools
    }
    outputs.write(path, json.dumps(content, indent=2) + "\n")
    words = f", nine colors of each of {', '.join(lights)} for {', '.join(tools)}"
    return {"path": str(path), "kind": "probes", "bytes": path.stat().st_size, "words": words}
