"""Inputs of commands: classifies files, and makes scenes, lights and cameras from them.

ward:diffuse=.1/.05/.02,specular=.3,along=.1,across=.3        colors have / between them
lafortune:diffuse=.1,cx=-1:-.8,cy=-1:-.8,cz=.9:.5,exponent=20:5    values of several lobes or axes have :
merl:gold.binary        ngan:ngan2005_wardduer.fit,material=nickel        npf:table.bin,material=nickel
"""

import dataclasses
import inspect
import itertools
import math
import sys
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import numpy as np

from jaxprt import brdf
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.files.inputs import JsonObject
from jaxprt.relit import refinement, registry
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial, builtin, load_environment, load_scene
from jaxprt.scene import mesh as meshes
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import rotate
from jaxprt.scene.formats.mesh_file import SUFFIXES
from jaxprt.scene.scene import default_camera, unique_names
from jaxprt.view.stages import about

# Loader of each kind of file, and its further options: True for required ones.
FILES: dict[str, tuple[Callable, dict[str, bool]]] = {
    "merl": (brdf.load_merl, {}),
    "npf": (brdf.load_npf, {"material": True, "names": False}),
    "lafortune": (brdf.load_lafortune, {"material": True}),
    "ngan": (brdf.load_ngan, {"material": True}),
    "scattered": (brdf.load_scattered, {"smoothing": False}),
}
_ALIASES = {"alpha_x": "along", "alpha_y": "across"}  # names of renderers for parameters of Ward's models
# Rotations that bring an axis of the file to +y.
UPRIGHT = {
    "x": [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
    "y": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "z": [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
}
LIGHTS = (".exr", ".hdr", ".pic")
_LIGHT_STARTS = (b"\x76\x2f\x31\x01", b"#?RADIANCE", b"#?RGBE")
LIGHT_SIZE = 64  # texels along the edge of the faces of lights by default
_PLASTIC = TexturedMaterial(base_color=(0.4, 0.1, 0.08), metallic=0.0, roughness=0.4)


def parse(text: str) -> Callable | TexturedMaterial:
    """Parses the text form of a material."""
    models = registry.materials()
    name, _, rest = text.partition(":")
    words = [word.strip() for word in rest.split(",")] if rest.strip() else []
    if name in FILES and ((words and "=" not in words[0]) or name not in models):
        return _load_measured(name, words)
    if name not in models:
        names = ", ".join(dict.fromkeys([*models, *FILES]))
        raise ValueError(f"a material must be one of {names}, got {name!r}")
    known = parameters(name)
    texts = _assigned(name, words, known, ", ".join(f"{parameter}=" for parameter in known))
    arguments = {key: _numbers(name, key, value) for key, value in texts.items()}
    missing = [f"{key}=" for key, default in known.items() if default is None and key not in arguments]
    if missing:
        raise ValueError(f"{name} must have {', '.join(missing)}, got {text!r}")
    return models[name](**arguments)


def _assigned(name: str, words: Sequence[str], known: Collection[str], form: str) -> dict[str, str]:
    """The values of words KEY=VALUE by their keys."""
    result: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        key = _ALIASES.get(key, key) if "along" in known else key
        if not equals or key not in known:
            raise ValueError(f"{name} takes {form}, got {word!r}")
        if key in result:
            raise ValueError(f"{name} takes each parameter once, got {key} twice")
        result[key] = value
    return result


def parameters(name: str) -> dict[str, float | None]:
    """Parameters of a model that commands can set, those of one number, with their defaults; None for required ones."""
    result = {}
    for field in inspect.signature(registry.materials()[name]).parameters.values():
        if field.default is inspect.Parameter.empty:
            result[field.name] = None
        elif np.ndim(field.default) == 0 and np.asarray(field.default).dtype.kind in "biuf":
            result[field.name] = float(field.default)
    return result


def of_part(text: str) -> tuple[str, str]:
    """Splits PART=MATERIAL into the part and the material."""
    part, equals, material = text.partition("=")
    if not (part and equals and material):
        raise ValueError(f"must be PART=MATERIAL, such as 0=lambert:albedo=.5, got {text!r}")
    return part, material


def describe(material: object) -> JsonObject:
    """A material as JSON: its model, parameters and textures."""
    result: JsonObject = {"model": type(material).__name__}
    fields = dataclasses.fields(material) if dataclasses.is_dataclass(material) else ()
    for field in fields:
        value = getattr(material, field.name)
        if field.name.endswith("_texture"):
            if value is not None:
                result[field.name] = list(value.image.shape) if hasattr(value, "image") else True
        elif hasattr(value, "shape"):
            result[field.name] = np.asarray(value).tolist() if np.size(value) <= 16 else {"shape": list(value.shape)}
        elif isinstance(value, float | int):
            result[field.name] = value
    return result


def _load_measured(name: str, words: list[str]) -> Callable:
    load, takes = FILES[name]
    if not words or "=" in words[0]:
        raise ValueError(f"{name} must name a file, {form(name)}, got {', '.join(words) or 'none'}")
    arguments: JsonObject = _assigned(name, words[1:], takes, form(name))
    if "smoothing" in arguments:
        arguments["smoothing"] = _material_number(name, "smoothing", arguments["smoothing"])
    # A name that no file has makes the loader's error message list existing ones.
    return load(Path(words[0]), **{key: "" for key, needed in takes.items() if needed} | arguments)


def form(name: str) -> str:
    """The text form of a material from a file."""
    more = [f",{key}=.." if needed else f"[,{key}=..]" for key, needed in FILES[name][1].items()]
    return f"{name}:FILE{''.join(more)}"


def _numbers(name: str, key: str, text: str) -> Any:
    """Parses a number, a color r/g/b, or several of them separated by colons."""
    rows = [[_material_number(name, key, word) for word in row.split("/")] for row in text.split(":")]
    if {len(row) for row in rows} not in ({1}, {3}):
        raise ValueError(f"{key} of {name} must be numbers, or colors as .1/.2/.3, got {text!r}")
    value = [row[0] if len(row) == 1 else row for row in rows]
    of_lobes = name == "lafortune" and key != "diffuse"
    most = math.inf if of_lobes else 2 if (name[:3], key) == ("ggx", "roughness") else 1
    if len(value) > most:
        raise ValueError(f"{key} of {name} must be {'one value' if most == 1 else 'at most two values'}, got {text!r}")
    return value if len(value) > 1 or of_lobes else value[0]


def _material_number(name: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{key} of {name} must be a finite number, got {text!r}")
    return value


def kind(path: Path) -> str:
    """The kind of a file, "mesh" or "light", from its suffix or else from its first bytes; "" for neither."""
    suffix = path.suffix.lower()
    if suffix in LIGHTS:
        return "light"
    if suffix in SUFFIXES:
        return "mesh"
    if path.is_file():
        with path.open("rb") as file:
            return "light" if file.read(16).startswith(_LIGHT_STARTS) else ""
    return ""


def split_files(files: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Separates files into meshes and environments."""
    kinds = [(kind(path), path) for path in files]
    for contents, path in kinds:
        if not contents:
            known = ", ".join((*SUFFIXES, *LIGHTS))
            raise ValueError(f"files must be meshes and environments, which end in one of {known}; got {path}")
    return [path for contents, path in kinds if contents == "mesh"], [
        path for contents, path in kinds if contents == "light"
    ]


def check(files: Sequence[Path], *, ground: bool = False, light_size: int | None = None) -> list[Path]:
    """Refuses options that do not fit the files, before files are read. Returns the meshes among the files.

    Raises:
        ValueError: A file is neither a mesh nor an environment, a ground is requested without a mesh, or the size of
            the light is not a power of two.
    """
    paths, _ = split_files(files)
    if not paths and ground:
        raise ValueError("--ground needs a mesh: the embedded scene has a board")
    if light_size and light_size & (light_size - 1):
        raise ValueError(f"--light-size must be a power of two, got {light_size}")
    return paths


def scene(
    files: Sequence[Path],
    *,
    up: str = "y",
    ground: bool = False,
    refine: bool | float = True,
    outside: bool = False,
    brdf: Callable | None = None,
    material: Sequence[tuple[str, Callable | TexturedMaterial]] = (),
    playable: bool = False,
) -> Scene:
    """The upright scene of the files, with the requested materials. Without meshes it is the embedded scene.

    Args:
        files: Files, of which environments do not count.
        up: Axis of the meshes that points up.
        ground: Stand the meshes on a diffuse ground plane.
        refine: Divide the meshes of files until interpolated visibility errs by E in pictures.  [default: 0.015]
        outside: Let scenes read files outside of their folders.
        brdf: Material of all meshes instead of the files' own, such as ward:along=.1,across=.3 or merl:FILE.
        material: Material of one part, given by its name or its number from 0; may be given several times.
        playable: Whether to make materials changeable for the viewer. Parts without a material become plastic.

    Raises:
        ValueError: A file is not a scene, a ground is requested without a mesh, or a part does not exist.
    """
    paths = check(files, ground=ground)
    if not paths:  # The embedded scene has as many vertices as it needs.
        return _with_materials(example_scene(brdf=brdf, playable=playable), material)
    turn, scenes = np.array(UPRIGHT[up]), [load_scene(path, outside=outside) for path in paths]
    parts = [part for loaded in scenes for part in loaded.parts]
    if up != "y":
        parts = [eqx.tree_at(lambda p: p.mesh, part, meshes.rotate(part.mesh, turn)) for part in parts]
    if playable:
        parts = [_playable(part) for part in parts]
    if brdf is not None:  # vertex colors belong to the file's material
        parts = [Part(part.name, part.mesh, brdf) for part in parts]
    cameras = scenes[0].cameras if up == "y" else ()
    lamps = [lamp for loaded in scenes for lamp in loaded.point_lights if up == "y"]
    names = unique_names([part.name for part in parts])
    parts = [dataclasses.replace(part, name=name) for part, name in zip(parts, names, strict=True)]
    if ground:
        alone, matte = Scene(parts), _matte if playable else Lambert
        parts.append(Part(unique_names([*names, "ground"])[-1], meshes.ground_plane(alone.mesh), matte(0.5)))
        cameras = cameras or [default_camera(alone, alone.mesh)]  # of the object, which the ground is wider than
    names = unique_names([*(part.name for part in parts), *(lamp.name for lamp in lamps)])[len(parts) :]
    lamps = [dataclasses.replace(lamp, name=name) for lamp, name in zip(lamps, names, strict=True)]
    result = _with_materials(Scene(parts, cameras, point_lights=lamps), material)
    progress = sys.stderr.isatty()
    return refinement.divided(result, refine, vertices=None, environments=None, folder=None, progress=progress)[0]


def example_scene(*, brdf: Callable | None = None, playable: bool = False) -> Scene:
    """The embedded scene: chess pieces on a board."""
    pieces, light, dark = meshes.split(builtin.chess())
    matte = _matte if playable else Lambert
    return Scene(
        [
            Part("pieces", pieces, brdf or (_PLASTIC if playable else AshikhminShirley())),
            Part("light squares", light, matte((0.6, 0.55, 0.45))),
            Part("dark squares", dark, matte((0.12, 0.08, 0.06))),
        ]
    )


def lights(
    files: Sequence[Path], *, turn: Sequence[float] = (0.0,), light_size: int | None = None
) -> dict[str, Environment]:
    """Rotated lights by the names of their files, or the two embedded lights.

    Args:
        files: Files, of which meshes do not count.
        turn: Rotate each light by each angle about the vertical, counterclockwise as seen from above.
        light_size: Texels along the edge of the light's cubemap faces, a power of two. If None, 64.
    """
    size, (_, paths) = light_size or LIGHT_SIZE, split_files(files)
    check((), light_size=size)
    environments = {"daylight": builtin.daylight, "studio": builtin.studio}
    if paths:
        names = unique([path.stem for path in paths])
        environments = {name: partial(load_environment, path) for name, path in zip(names, paths, strict=True)}
    loaded = {name: load(size=size) for name, load in environments.items()}
    names = {angle: f"_{angle:g}" if len(turn) > 1 else "" for angle in turn}
    return {name + names[angle]: rotate_light(light, angle) for name, light in loaded.items() for angle in turn}


def unique(names: Sequence[str]) -> list[str]:
    """Makes names unique by appending numbers."""
    result: list[str] = []
    for name in names:
        candidates = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
        result.append(next(candidate for candidate in candidates if candidate not in result))
    return result


def rotate_light(light: Environment, degrees: float) -> Environment:
    """A light rotated about the vertical, counterclockwise as seen from above."""
    return light if degrees % 360 == 0 else rotate(light, about(float(np.radians(degrees))))


def camera(parts: Sequence[Part], *, azimuth: float = 20.0, elevation: float = 15.0, size: int = 512) -> Camera:
    """A camera that sees some parts of a scene.

    Args:
        parts: The parts.
        azimuth: Azimuth of the camera, from +z towards +x.
        elevation: Elevation of the camera above the horizon, from -90 to 90.
        size: Width and height of the pictures in pixels.
    """
    azimuth, elevation = np.radians([azimuth, elevation])
    return orbit(Scene(parts).mesh, azimuth=azimuth, elevation=elevation, width=size, height=size)


def objects(scene: Scene, chosen: SimpleNamespace) -> Sequence[Part]:
    """The parts that pictures show whole. The board of the embedded scene and the ground may extend beyond them."""
    if not split_files(chosen.files)[0]:
        return scene.parts[:1]
    return scene.parts[: -1 if chosen.ground else None]


def _with_materials(scene: Scene, materials: Sequence[tuple[str, Callable | TexturedMaterial]]) -> Scene:
    """The scene with other materials of parts, which are named or numbered."""
    parts, names = list(scene.parts), scene.names
    for name, material in materials:
        if name not in names and not (name.isdecimal() and int(name) < len(names)):
            known = ", ".join(f"{number} {label!r}" for number, label in enumerate(names))
            raise ValueError(f"--material must name one of the parts {known}, got {name!r}")
        number = names.index(name) if name in names else int(name)
        parts[number] = dataclasses.replace(parts[number], material=material)
    return dataclasses.replace(scene, parts=parts)


def _playable(part: Part) -> Part:
    """Makes a part without a material plastic, so that its material can be changed in the viewer."""
    return dataclasses.replace(part, material=_PLASTIC) if eqx.tree_equal(part.material, _matte(0.5)) else part


def _matte(color: float | tuple[float, ...]) -> TexturedMaterial:
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0)
