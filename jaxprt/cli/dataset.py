"""The command `jaxprt dataset`: pictures of many scenes under many lights from many cameras, for training."""

import dataclasses
import glob
import importlib.metadata
import io
import json
import math
import sys
import tarfile
import time
import traceback
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import jax.numpy as jnp
import numpy as np
import tqdm

from jaxprt import files, image
from jaxprt.cli import inputs, options, relight
from jaxprt.cli.options import option
from jaxprt.files import outputs
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.relit.exact import exact_pixels
from jaxprt.scene import Camera, Environment, Scene
from jaxprt.scene.camera import orbit
from jaxprt.scene.formats import nerf
from jaxprt.scene.mesh import bounds

_SETTINGS, _FRAMES, _MANIFEST, _SCENE = "dataset.json", "transforms.json", "manifest.jsonl", "scene.json"
_PIXELS = 200  # pixels at which the error of pictures under each light is measured
_EXPOSED = 4  # most views that the exposure is found from
_GOLDEN = math.pi * (3 - math.sqrt(5))  # angle between successive cameras about the vertical
_LOBES = 8  # whose tables are shipped
_MEMORY = 1 << 28  # bytes of pictures that are held at once


@click.command(cls=options.Command, short_help="Render pictures of many scenes under many lights, for training.")
@options.scene
@options.light_size
@option(
    "--lights",
    group="Light",
    multiple=True,
    metavar="PATTERN",
    help='More environments: a pattern such as "maps/*.hdr". May be given several times.',
)
@option(
    "--random-turns",
    group="Light",
    type=options.Whole(0),
    default=1,
    show_default=True,
    metavar="N",
    help="Rotate each light of each scene by N random angles about the vertical; 0 leaves lights as they are.",
)
@option(
    "--views",
    group="Camera",
    type=options.Whole(1, 100_000),
    default=64,
    show_default=True,
    help="Cameras on a sphere around each scene.",
)
@option(
    "--elevations",
    group="Camera",
    type=options.Several(options.Finite(-90.0, 90.0)),
    default="-10,80",
    metavar="LOW,HIGH",
    help="Lowest and highest elevation of these cameras in degrees.  [default: -10,80]",
)
@option(
    "--cameras",
    group="Camera",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    metavar="FILE",
    help="Cameras of a transforms.json of NeRF or Blender, in place of --views.",
)
@option(
    "--size", group="Camera", type=options.Whole(1, 8192), default=512, show_default=True, help="Pixels of an edge."
)
@option(
    "--seed", group="Output", type=options.Whole(0), default=0, show_default=True, help="Seed of all random choices."
)
@option(
    "--format",
    "form",
    group="Output",
    type=click.Choice(["exr", "png"]),
    default="exr",
    show_default=True,
    help="Linear EXR files with layers, or PNG files with alpha at the exposure of each scene and light.",
)
@option(
    "--layers",
    group="Output",
    type=options.Several(click.Choice(list(outputs.LAYERS))),
    default=None,
    help="Layers of EXR files.  [default: color,alpha]",
)
@option(
    "--shards", group="Output", is_flag=True, help="Pack the pictures of each scene into a tar file for WebDataset."
)
@options.systems(("lobe", "harmonic", "separable", "dynamic"), default="lobe", words="One system.  [default: lobe]")
@options.no_bounces
@options.recipe
@options.folder("Folder for the pictures.", default="dataset")
@options.as_json
def command(**arguments: Any) -> None:
    """Render pictures of many scenes under many lights from many cameras.

    Each mesh or scene among the FILEs is a scene of its own; environments among them are lights. All lights are seen
    from all cameras. The same command goes on where an earlier one stopped, and gives the same files. A scene that
    fails is named, and does not stop the others.

    \b
    FOLDER/SCENE/VIEW_LIGHT.exr   pictures
    FOLDER/SCENE/transforms.json  cameras, in the convention of NeRF and Blender
    FOLDER/manifest.jsonl         a line for each picture: files, light, turn, seed, measured error

    \b
    Examples:
      jaxprt dataset chair.glb lamp.glb --lights "maps/*.hdr" --views 64 --output set
      jaxprt dataset *.glb grace.hdr --format png --size 256 --shards --output set
      jaxprt dataset scene.glb sun.exr --cameras transforms.json --layers color,alpha,depth,normal --output set
    """  # noqa: D301
    chosen = SimpleNamespace(**arguments)
    with options.reserve_stdout(chosen.as_json):
        summary = render(chosen)
    text = (
        f"jaxprt: {summary['pictures']} pictures, scenes: {summary['scenes']}, in {chosen.output}; "
        f"{summary['rate']:.1f} new ones a second"
    )
    options.tell(summary, text, as_json=chosen.as_json)
    if summary["failed"]:
        words = "; ".join(f"{name}: {why}" for name, why in summary["failed"].items())
        raise click.ClickException(f"scenes that failed: {len(summary['failed'])}; {words}")


def render(chosen: SimpleNamespace) -> dict[str, Any]:
    """Renders all pictures that are missing.

    Raises:
        ValueError: There are no scenes or lights, an option is wrong, or the folder has the pictures of another set.
    """
    scenes, lights = _inputs(chosen)
    cameras = None if chosen.cameras is None else nerf.load(chosen.cameras, width=chosen.size)
    relight.make_folder(chosen.output)
    _check_settings(chosen, list(lights))
    failed, new, began = {}, 0, time.monotonic()
    for number, (name, path) in enumerate(scenes.items(), 1):
        try:
            count = _render_scene(name, path, lights, cameras, chosen)
            click.echo(f"jaxprt: {name} is done, scene {number} of {len(scenes)}: {count} new pictures", err=True)
            new += count
        except (ValueError, TypeError, OSError, MemoryError, RuntimeError) as error:
            failed[name] = options.message_of(error)
            click.echo(f"jaxprt: {name} failed: {failed[name]}", err=True)
        except Exception as error:  # a fault of one scene does not stop the others
            failed[name] = f"{type(error).__name__}: {error}"
            click.echo(traceback.format_exc(), err=True)
    seconds = time.monotonic() - began
    done = [name for name in scenes if name not in failed]
    rows = [row for name in done for row in _lines(chosen.output / name / _MANIFEST)]
    outputs.write(chosen.output / _MANIFEST, "".join(f"{row}\n" for row in rows))
    return {"scenes": len(done), "pictures": len(rows), "new": new, "rate": new / max(seconds, 1e-9), "failed": failed}


def _inputs(chosen: SimpleNamespace) -> tuple[dict[str, Path], dict[str, Environment]]:
    """The files of scenes, and the lights, by unique names."""
    more = []
    for pattern in chosen.lights:
        matches = sorted(glob.glob(pattern))
        if not matches:
            raise ValueError(f"--lights must match environments, got {pattern!r}, which matches no file")
        more += map(Path, matches)
    scenes, lights = inputs.split_files([*chosen.files, *more])
    if not scenes:
        raise ValueError("a dataset needs a mesh or a scene, got none")
    if not lights:
        raise ValueError("a dataset needs an environment, got none: name EXR or HDR files, or --lights PATTERN")
    if len(chosen.system) > 1 or len(chosen.lobes or ()) > 1:
        raise ValueError("a dataset takes one system and one number of lobes, got several")
    if chosen.layers is not None and chosen.form != "exr":
        raise ValueError(f"--layers needs --format exr, got {chosen.form}")
    low, *high = chosen.elevations
    if len(high) != 1 or not low <= high[0]:
        got = ",".join(f"{angle:g}" for angle in chosen.elevations)
        raise ValueError(f"--elevations must be two angles LOW,HIGH, the lower one first, got {got}")
    named = SimpleNamespace(files=lights, light_size=chosen.light_size, turn=(0.0,))
    names = inputs.unique([path.stem for path in scenes])
    return dict(zip(names, scenes, strict=True)), inputs.lights(named)


def _check_settings(chosen: SimpleNamespace, lights: list[str]) -> None:
    """Writes what determines the pictures of a folder, or refuses a folder whose pictures have other settings."""
    skipped = {"files", "lights", "output", "as_json", "outside"}
    settings = {name: _text(value) for name, value in vars(chosen).items() if name not in skipped}
    settings |= {"lights": lights, "jaxprt": importlib.metadata.version("jaxprt")}
    path = chosen.output / _SETTINGS
    if path.exists():
        before = json.loads(path.read_text())
        for name, value in settings.items():
            if before.get(name) != value:
                raise ValueError(
                    f"--output must be a new folder or that of the same set: {name} of the set in {chosen.output} is "
                    f"{before.get(name)}, got {value}"
                )
        return
    others = [entry.name for entry in chosen.output.iterdir()]
    if others:
        raise ValueError(f"--output must be an empty folder or one of an earlier dataset, got one with {others[0]}")
    outputs.write(path, json.dumps(settings, indent=2) + "\n")


def _text(value: Any) -> Any:
    """A setting as JSON."""
    if isinstance(value, list | tuple):
        return [_text(item) for item in value]
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines() if path.exists() else []


@dataclasses.dataclass(frozen=True)
class _Light:
    """A light of a scene: the environment `source`, rotated by `turn` degrees about the vertical."""

    name: str  # in the names of files
    source: str
    turn: float
    environment: Environment


def _turned(name: str, lights: dict[str, Environment], *, turns: int, seed: int) -> list[_Light]:
    """The lights of a scene, by random angles that depend on the seed and the scene's name alone."""
    random = np.random.default_rng([seed, zlib.crc32(name.encode())])
    result = []
    for source, environment in lights.items():
        plain = source.replace(".", "_")  # WebDataset takes names up to the first point
        if not turns:
            result.append(_Light(plain, source, 0.0, environment))
        for number, turn in enumerate(random.uniform(0, 360, turns)):
            label = plain if turns == 1 else f"{plain}_{number}"
            result.append(_Light(label, source, float(turn), inputs.rotate_light(environment, float(turn))))
    return result


def _around(name: str, scene: Scene, *, views: int, elevations: Sequence[float], size: int, seed: int) -> list[Camera]:
    """Cameras that see the whole scene, spread evenly over a zone of the sphere that starts at a random angle."""
    start = np.random.default_rng([seed, zlib.crc32(name.encode()), 1]).uniform(0, 2 * np.pi)
    low, high = np.sin(np.radians(elevations))
    heights = low + (high - low) * (np.arange(views) + 0.5) / views
    mesh = scene.mesh
    return [
        orbit(mesh, azimuth=start + _GOLDEN * view, elevation=float(np.arcsin(height)), width=size, height=size)
        for view, height in enumerate(heights)
    ]


def _render_scene(
    name: str, path: Path, lights: dict[str, Environment], cameras: list[Camera] | None, chosen: SimpleNamespace
) -> int:
    """Renders what is missing of a scene. Returns the number of new pictures."""
    folder = chosen.output / name
    if (folder / _MANIFEST).exists():
        return 0
    scene = inputs.scene(SimpleNamespace(**{**vars(chosen), "files": [path]}))
    low, high = bounds(scene.mesh)
    if not np.any(high > low):
        raise ValueError("a scene must have an extent, got one point")
    if cameras is None:
        options_ = {"views": chosen.views, "elevations": chosen.elevations, "size": chosen.size, "seed": chosen.seed}
        cameras = _around(name, scene, **options_)
    turned = _turned(name, lights, turns=chosen.random_turns, seed=chosen.seed)
    (recipe,) = options.recipes(chosen.system[0], chosen, lobes=_LOBES).values()
    size = turned[0].environment.radiance.shape[-2]
    shown = sys.stderr.isatty()
    relit = precompute(scene, system=recipe, bounces=chosen.bounces, refine=False, size=size, progress=shown)
    folder.mkdir(exist_ok=True)
    measured = _measured(relit, turned, cameras, folder)
    new = _draw(relit, turned, cameras, measured, folder, chosen, name=name)
    _finish(name, turned, cameras, measured, folder, chosen)
    return new


def _measured(
    relit: RelitScene, lights: list[_Light], cameras: list[Camera], folder: Path
) -> dict[str, dict[str, float]]:
    """For each light, the error of direct light in one view, and the exposure of pictures; measured once."""
    path = folder / _SCENE
    if path.exists():
        return json.loads(path.read_text())
    direct, environments = relit.without_bounces(), [light.environment for light in lights]
    middle = cameras[len(cameras) // 2]
    truth = exact_pixels(direct.scene, direct.shading, environments, middle, pixels=_PIXELS)
    # The exposure is the least of some views: views of the lit side would be white at that of the dark side.
    some = cameras[:: -(-len(cameras) // _EXPOSED)]
    stops = np.full(len(lights), np.inf)
    for block in relit.picture_blocks(environments, some, memory=_MEMORY):
        for number, picture in zip(block.lights, block.pictures, strict=True):
            stops[number] = min(stops[number], float(relit.exposure(picture, some[block.view])))
    result = {}
    for number, light in enumerate(lights):
        error, spread = truth.relative_l2(direct.picture(light.environment, middle), light=number)
        values = {"error": float(error), "spread": float(spread), "stops": float(stops[number])}
        result[light.name] = options.finite(values)
    outputs.write(path, json.dumps(result, indent=2) + "\n")
    return result


def _draw(
    relit: RelitScene,
    lights: list[_Light],
    cameras: list[Camera],
    measured: dict[str, dict[str, float]],
    folder: Path,
    chosen: SimpleNamespace,
    *,
    name: str,
) -> int:
    """Writes the pictures that are missing. Returns their number."""
    missing = {
        view: [number for number, light in enumerate(lights) if not _path(folder, view, light, chosen.form).exists()]
        for view in range(len(cameras))
    }
    total = sum(map(len, missing.values()))
    layers = chosen.layers or ("color", "alpha")
    with tqdm.tqdm(total=total, desc=name, unit="picture", disable=not sys.stderr.isatty()) as bar:
        for numbers in sorted(set(map(tuple, missing.values()))):  # all lights, as a rule
            views = [view for view, some in missing.items() if tuple(some) == numbers and numbers]
            if not views:
                continue
            environments, eyes = [lights[k].environment for k in numbers], [cameras[view] for view in views]
            blocks = relit.picture_blocks(environments, eyes, background=None, layers=layers, memory=_MEMORY)
            for block in blocks:
                for number, at in enumerate(block.lights):
                    light = lights[numbers[at]]
                    picture = {key: value[number] for key, value in block.pictures.items()}
                    path = _path(folder, views[block.view], light, chosen.form)
                    _write(path, picture, stops=measured[light.name]["stops"])
                    bar.update()
    return total


def _path(folder: Path, view: int, light: _Light, form: str) -> Path:
    return folder / f"{view:04d}_{light.name}.{form}"


def _write(path: Path, picture: dict[str, np.ndarray], *, stops: float) -> None:
    if path.suffix == ".exr":
        return files.write_exr(path, picture)
    alpha = picture["alpha"][..., None]
    straight = np.divide(picture["color"], alpha, out=np.zeros_like(picture["color"]), where=alpha > 0)
    shown = np.asarray(image.display(jnp.asarray(straight), stops=stops))
    shown = np.broadcast_to(shown, (*shown.shape[:2], 3))
    files.write_png(path, np.concatenate([shown, alpha], -1))


def _finish(
    name: str,
    lights: list[_Light],
    cameras: list[Camera],
    measured: dict[str, dict[str, float]],
    folder: Path,
    chosen: SimpleNamespace,
) -> None:
    """Writes the cameras, the tar file if asked for, and last the lines of the manifest."""
    pairs = [(view, light) for view in range(len(cameras)) for light in lights]
    frames = [
        {"file_path": f"./{_path(folder, view, light, chosen.form).name}", "light": light.source, "turn": light.turn}
        for view, light in pairs
    ]
    content = nerf.content(cameras, frames, [view for view, _ in pairs])
    outputs.write(folder / _FRAMES, json.dumps(content, indent=2) + "\n")
    rows = []
    for view, light in pairs:
        file = _path(folder, view, light, chosen.form)
        row = {"scene": name, "file": f"{name}/{file.name}", "view": view, "light": light.source, "turn": light.turn}
        if chosen.shards:
            row["shard"] = f"{name}.tar"
        rows.append(row | {"seed": chosen.seed, **measured[light.name]})
    if chosen.shards:
        _pack(chosen.output / f"{name}.tar", chosen.output, rows)
    outputs.write(folder / _MANIFEST, "".join(json.dumps(row) + "\n" for row in rows))
    for row in rows if chosen.shards else ():
        (chosen.output / row["file"]).unlink(missing_ok=True)


def _pack(path: Path, folder: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Writes a tar file with each picture and its line of the manifest, without times and owners."""
    with outputs.replacing(path) as new, tarfile.open(new, "w", format=tarfile.USTAR_FORMAT) as archive:
        for row in rows:
            for member, data in _members(folder, row):
                entry = tarfile.TarInfo(member)
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))


def _members(folder: Path, row: dict[str, Any]) -> Iterator[tuple[str, bytes]]:
    yield row["file"], (folder / row["file"]).read_bytes()
    yield str(Path(row["file"]).with_suffix(".json")), json.dumps(row).encode()
