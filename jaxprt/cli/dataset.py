"""The command `jaxprt dataset`: pictures of many scenes under many lights from many cameras, for training."""

import dataclasses
import glob
import importlib.metadata
import io
import itertools
import json
import math
import sys
import tarfile
import time
import traceback
import zlib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import click
import jax.numpy as jnp
import numpy as np
import tqdm

from jaxprt import files, image
from jaxprt.cli import inputs, options
from jaxprt.files import outputs
from jaxprt.files.inputs import JsonObject
from jaxprt.relit import RelitScene
from jaxprt.relit.build import precompute
from jaxprt.relit.exact import exact_pixels
from jaxprt.relit.recipes import Recipe
from jaxprt.scene import Camera, Environment, Scene
from jaxprt.scene.camera import orbit
from jaxprt.scene.formats import nerf
from jaxprt.scene.mesh import bounds

_SETTINGS, _FRAMES, _MANIFEST, _SCENE = "dataset.json", "transforms.json", "manifest.jsonl", "scene.json"
_PIXELS = 200  # pixels at which the error of pictures under each light is measured
_EXPOSED = 4  # most views that the exposure is found from
_GOLDEN = math.pi * (3 - math.sqrt(5))  # angle between successive cameras about the vertical
_MEMORY = 1 << 28  # bytes of pictures that are held at once


@options.command(
    "dataset",
    options.FILES,
    Scene=options.SCENE,
    Light=[
        *options.LIGHT_SIZE,
        {"lights": (str, ()), "random_turns": (options.Range(0), 1)},
    ],
    Camera=[
        {
            "views": (options.Range(1, 100_000), 64),
            "elevations": (options.Several(options.ELEVATION), (-10.0, 80.0)),
            "cameras": (click.Path(exists=True, dir_okay=False, path_type=Path),),
            "size": (options.PIXELS, 512),
        }
    ],
    System=[options.systems(("lobe", "harmonic", "separable", "dynamic"), "One system."), options.NO_BOUNCES],
    Sizes=options.sizes(),
    Output=[
        {"seed": (options.Range(0), 0), "format": (click.Choice(["exr", "png"]), "exr"), "shards": (bool,)},
        options.layers("Layers of EXR files.  [default: color,alpha]"),
        options.folder("Folder for the pictures.", default="dataset"),
        options.JSON,
    ],
)
def command(chosen: SimpleNamespace) -> options.Result:
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

    Options:
        lights: More environments: a pattern such as "maps/*.hdr"; may be given several times.
        random_turns: Rotate each light of each scene by N random angles about the vertical; 0 leaves them as they are.
        views: Cameras on a sphere around each scene.
        elevations: Lowest and highest elevation of these cameras in degrees.
        cameras: Cameras of a transforms.json of NeRF or Blender, in place of --views.
        size: Pixels of an edge.
        seed: Seed of all random choices.
        format: Linear EXR files with layers, or PNG files with alpha at the exposure of each scene and light.
        shards: Pack the pictures of each scene into a tar file for WebDataset.
    """  # noqa: D301
    (scenes, lights), recipe = _inputs(chosen), options.recipe(chosen, "a dataset")
    cameras = None if chosen.cameras is None else nerf.load(chosen.cameras, width=chosen.size)
    options.make_folder(chosen.output)
    _check_settings(chosen, list(lights))
    failed, new, began = {}, 0, time.monotonic()
    for number, (name, path) in enumerate(scenes.items(), 1):
        try:
            count = _render_scene(name, path, lights, cameras, recipe, chosen)
            click.echo(f"jaxprt: {name} is done, scene {number} of {len(scenes)}: {count} new pictures", err=True)
            new += count
        except (ValueError, TypeError, OSError, MemoryError, RuntimeError) as error:
            failed[name] = options.message_of(error)
            click.echo(f"jaxprt: {name} failed: {failed[name]}", err=True)
        except Exception as error:  # a fault of one scene does not stop the others
            failed[name] = f"{type(error).__name__}: {error}"
            click.echo(traceback.format_exc(), err=True)
    rate, done = new / max(time.monotonic() - began, 1e-9), [name for name in scenes if name not in failed]
    manifests = [chosen.output / name / _MANIFEST for name in done]
    rows = [row for path in manifests for row in path.read_text().splitlines()]
    outputs.write(chosen.output / _MANIFEST, "".join(f"{row}\n" for row in rows))
    summary = {"scenes": len(done), "pictures": len(rows), "new": new, "rate": rate, "failed": failed}
    text = f"jaxprt: {len(rows)} pictures, scenes: {len(done)}, in {chosen.output}; {rate:.1f} new ones a second"
    words = "; ".join(f"{name}: {why}" for name, why in failed.items())
    error = click.ClickException(f"scenes that failed: {len(failed)}; {words}") if failed else None
    return options.Result(summary, text, error)


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
    if chosen.layers is not None and chosen.format != "exr":
        raise ValueError(f"--layers needs --format exr, got {chosen.format}")
    low, *high = chosen.elevations
    if len(high) != 1 or not low <= high[0]:
        got = ",".join(f"{angle:g}" for angle in chosen.elevations)
        raise ValueError(f"--elevations must be two angles LOW,HIGH, the lower one first, got {got}")
    names = inputs.unique([path.stem for path in scenes])
    return dict(zip(names, scenes, strict=True)), inputs.lights(lights, light_size=chosen.light_size)


def _check_settings(chosen: SimpleNamespace, lights: list[str]) -> None:
    """Writes what determines the pictures of a folder, or refuses a folder whose pictures have other settings."""
    skipped = {"files", "lights", "output", "json", "outside"}
    settings = options.finite({name: value for name, value in vars(chosen).items() if name not in skipped})
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


def _around(name: str, scene: Scene, chosen: SimpleNamespace) -> list[Camera]:
    """Cameras that see the whole scene, spread evenly over a zone of the sphere that starts at a random angle."""
    start = np.random.default_rng([chosen.seed, zlib.crc32(name.encode()), 1]).uniform(0, 2 * np.pi)
    low, high = np.sin(np.radians(chosen.elevations))
    elevation = np.arcsin(low + (high - low) * (np.arange(chosen.views) + 0.5) / chosen.views)
    mesh, edge = scene.mesh, {"width": chosen.size, "height": chosen.size}
    angles = [(start + _GOLDEN * view, float(angle)) for view, angle in enumerate(elevation)]
    return [orbit(mesh, azimuth=azimuth, elevation=angle, **edge) for azimuth, angle in angles]


def _render_scene(
    name: str,
    path: Path,
    lights: dict[str, Environment],
    cameras: list[Camera] | None,
    recipe: Recipe,
    chosen: SimpleNamespace,
) -> int:
    """Renders what is missing of a scene. Returns the number of new pictures."""
    folder = chosen.output / name
    if (folder / _MANIFEST).exists():
        return 0
    scene = options.call(inputs.scene, chosen, files=[path])
    low, high = bounds(scene.mesh)
    if not np.any(high > low):
        raise ValueError("a scene must have an extent, got one point")
    cameras = _around(name, scene, chosen) if cameras is None else cameras
    turned = _turned(name, lights, turns=chosen.random_turns, seed=chosen.seed)
    wanted = {"bounces": chosen.bounces, "size": turned[0].environment.radiance.shape[-2]}
    relit = precompute(scene, system=recipe, refine=False, progress=sys.stderr.isatty(), **wanted)
    folder.mkdir(exist_ok=True)
    pictures = _Pictures(name, relit, turned, cameras, chosen)
    measured = pictures.measured()
    new = pictures.draw(measured)
    pictures.finish(measured)
    return new


@dataclasses.dataclass(frozen=True)
class _Pictures:
    """The pictures of a scene under its lights from its cameras."""

    name: str
    relit: RelitScene
    lights: list[_Light]
    cameras: list[Camera]
    chosen: SimpleNamespace

    @property
    def folder(self) -> Path:
        return self.chosen.output / self.name

    def path(self, view: int, light: _Light) -> Path:
        return self.folder / f"{view:04d}_{light.name}.{self.chosen.format}"

    def measured(self) -> dict[str, dict[str, float]]:
        """For each light, the error of direct light in one view, and the exposure of pictures; measured once."""
        path = self.folder / _SCENE
        if path.exists():
            return json.loads(path.read_text())
        direct, environments = self.relit.without_bounces(), [light.environment for light in self.lights]
        middle = self.cameras[len(self.cameras) // 2]
        truth = exact_pixels(direct.scene, direct.shading, environments, middle, pixels=_PIXELS)
        # The exposure is the least of some views: views of the lit side would be white at that of the dark side.
        some = self.cameras[:: -(-len(self.cameras) // _EXPOSED)]
        stops = np.full(len(self.lights), np.inf)
        for block in self.relit.picture_blocks(environments, some, memory=_MEMORY):
            for number, picture in zip(block.lights, block.pictures, strict=True):
                stops[number] = min(stops[number], float(self.relit.exposure(picture, some[block.view])))
        result = {}
        for number, light in enumerate(self.lights):
            error, spread = truth.relative_l2(direct.picture(light.environment, middle), light=number)
            result[light.name] = options.finite({"error": error, "spread": spread, "stops": stops[number]})
        outputs.write(path, json.dumps(result, indent=2) + "\n")
        return result

    def draw(self, measured: dict[str, dict[str, float]]) -> int:
        """Writes the pictures that are missing. Returns their number."""
        views: dict[tuple[int, ...], list[int]] = {}  # by the lights whose pictures are missing: all, as a rule
        for view in range(len(self.cameras)):
            missing = [k for k, light in enumerate(self.lights) if not self.path(view, light).exists()]
            views.setdefault(tuple(missing), []).append(view)
        views.pop((), None)
        total = sum(len(lights) * len(members) for lights, members in views.items())
        layers = self.chosen.layers or ("color", "alpha")
        with tqdm.tqdm(total=total, desc=self.name, unit="picture", disable=not sys.stderr.isatty()) as bar:
            for missing, members in sorted(views.items()):
                lights, eyes = [self.lights[k] for k in missing], [self.cameras[view] for view in members]
                drawn = {"background": None, "layers": layers, "memory": _MEMORY}
                for block in self.relit.picture_blocks([light.environment for light in lights], eyes, **drawn):
                    for number, light in enumerate(lights[k] for k in block.lights):
                        picture = {layer: values[number] for layer, values in block.pictures.items()}
                        path = self.path(members[block.view], light)
                        _write(path, picture, stops=measured[light.name]["stops"])
                        bar.update()
        return total

    def finish(self, measured: dict[str, dict[str, float]]) -> None:
        """Writes the cameras, the tar file if asked for, and last the lines of the manifest."""
        frames, rows, views, output = [], [], [], self.chosen.output
        shard = {"shard": f"{self.name}.tar"} if self.chosen.shards else {}
        for view, light in itertools.product(range(len(self.cameras)), self.lights):
            file, source = self.path(view, light).name, {"light": light.source, "turn": light.turn}
            frames.append({"file_path": f"./{file}", **source})
            row = {"scene": self.name, "file": f"{self.name}/{file}", "view": view, **source, **shard}
            rows.append(row | {"seed": self.chosen.seed, **measured[light.name]})
            views.append(view)
        content = nerf.content(self.cameras, frames, views)
        outputs.write(self.folder / _FRAMES, json.dumps(content, indent=2) + "\n")
        if shard:
            _pack(output / f"{self.name}.tar", output, rows)
        outputs.write(self.folder / _MANIFEST, "".join(json.dumps(row) + "\n" for row in rows))
        for row in rows if shard else ():
            (output / row["file"]).unlink(missing_ok=True)


def _write(path: Path, picture: dict[str, np.ndarray], *, stops: float) -> None:
    if path.suffix == ".exr":
        return files.write_exr(path, picture)
    alpha = picture["alpha"][..., None]
    straight = np.divide(picture["color"], alpha, out=np.zeros_like(picture["color"]), where=alpha > 0)
    shown = np.asarray(image.display(jnp.asarray(straight), stops=stops))
    shown = np.broadcast_to(shown, (*shown.shape[:2], 3))
    files.write_png(path, np.concatenate([shown, alpha], -1))


def _pack(path: Path, folder: Path, rows: Sequence[JsonObject]) -> None:
    """Writes a tar file with each picture and its line of the manifest, without times and owners."""
    with outputs.replacing(path) as new, tarfile.open(new, "w", format=tarfile.USTAR_FORMAT) as archive:
        for row in rows:
            line = str(Path(row["file"]).with_suffix(".json")), json.dumps(row).encode()
            for member, data in ((row["file"], (folder / row["file"]).read_bytes()), line):
                entry = tarfile.TarInfo(member)
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
