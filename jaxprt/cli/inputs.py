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
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt import brdf
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.cli.report import View
from jaxprt.relit import refinement, registry
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin, load_environment, load_scene
from jaxprt.scene import mesh as meshes
from jaxprt.scene.camera import orbit
from jaxprt.scene.environment import rotate
from jaxprt.scene.formats.mesh_file import SUFFIXES
from jaxprt.scene.scene import centered, default_camera, unique_names
from jaxprt.scene.sides import two_sided

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
_SIZE = 64
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
    kind, arguments = models[name], {}
    known = parameters(name)
    for word in words:
        key, equals, value = word.partition("=")
        key = _ALIASES.get(key, key) if "along" in known else key
        if not equals or key not in known:
            raise ValueError(f"{name} takes {', '.join(f'{parameter}=' for parameter in known)}, got {word!r}")
        if key in arguments:
            raise ValueError(f"{name} takes each parameter once, got {key} twice")
        arguments[key] = _numbers(name, key, value)
    missing = [key for key, default in known.items() if default is None and key not in arguments]
    if missing:
        raise ValueError(f"{name} must have {', '.join(f'{parameter}=' for parameter in missing)}, got {text!r}")
    return kind(**arguments)


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


def describe(material: Any) -> dict[str, Any]:
    """A material as JSON: its model, parameters and textures."""
    result: dict[str, Any] = {"model": type(material).__name__}
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
    arguments: dict[str, Any] = {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals or key not in takes or key in arguments:
            raise ValueError(f"{name} takes {form(name)}, got {word!r}")
        arguments[key] = _material_number(name, key, value) if key == "smoothing" else value
    if any(needed and key not in arguments for key, needed in takes.items()):
        # A name that no file has, so that the loader's error message lists existing ones.
        arguments["material"] = ""
    return load(Path(words[0]), **arguments)


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


def check(options: SimpleNamespace) -> None:
    """Refuses options that do not fit the files, before files are read.

    Raises:
        ValueError: A file is neither a mesh nor an environment, a ground is requested without a mesh, or the size of
            the light is not a power of two.
    """
    _meshes(options)
    _light_size(options, _SIZE)


def _meshes(options: SimpleNamespace) -> list[Path]:
    """The files that are meshes."""
    paths, _ = split_files(options.files)
    if not paths and options.ground:
        raise ValueError("--ground needs a mesh: the embedded scene has a board")
    return paths


def _light_size(options: SimpleNamespace, size: int) -> int:
    """Texels along the edge of the faces of lights."""
    size = options.light_size or size
    if size & (size - 1):
        raise ValueError(f"--light-size must be a power of two, got {size}")
    return size


def scene(options: SimpleNamespace, *, playable: bool = False) -> Scene:
    """The upright scene of the files, with the requested materials. Without meshes it is the embedded scene.

    Args:
        options: Object with `files`, `outside`, `up`, `ground`, `brdf`, `material` and `refine`.
        playable: Whether to make materials changeable for the viewer. Parts without a material become plastic.

    Raises:
        ValueError: A file is not a scene, a ground is requested without a mesh, or a part does not exist.
    """
    paths = _meshes(options)
    result = _load_scenes(paths, options, playable) if paths else example_scene(brdf=options.brdf, playable=playable)
    parts = list(result.parts)
    for name, material in options.material:
        number = _number([part.name for part in parts], name)
        parts[number] = dataclasses.replace(parts[number], material=material)
    result = dataclasses.replace(result, parts=parts)
    if not paths:  # The embedded scene has as many vertices as it needs.
        return result
    options_ = {"vertices": None, "environments": None, "folder": None, "progress": sys.stderr.isatty()}
    return refinement.divided(result, options.refine, **options_)[0]


def example_scene(*, brdf: Any = None, playable: bool = False) -> Scene:
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


def lights(options: SimpleNamespace, *, size: int = _SIZE) -> dict[str, Environment]:
    """Rotated lights by the names of their files, or the two embedded lights.

    Args:
        options: Object with `files`, `turn` and `light_size`.
        size: Texels along a face's edge if `light_size` is None.
    """
    _, paths = split_files(options.files)
    size = _light_size(options, size)
    if paths:
        names = unique([path.stem for path in paths])
        environments = {name: load_environment(path, size=size) for name, path in zip(names, paths, strict=True)}
    else:
        environments = {"daylight": builtin.daylight(size=size), "studio": builtin.studio(size=size)}
    angles = options.turn
    if len(angles) == 1:
        return {name: rotate_light(light, angles[0]) for name, light in environments.items()}
    return {f"{name}_{angle:g}": rotate_light(light, angle) for name, light in environments.items() for angle in angles}


def unique(names: Sequence[str]) -> list[str]:
    """Makes names unique by appending numbers."""
    result: list[str] = []
    for name in names:
        candidates = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
        result.append(next(candidate for candidate in candidates if candidate not in result))
    return result


def rotate_light(light: Environment, degrees: float) -> Environment:
    """A light rotated about the vertical, counterclockwise as seen from above."""
    if degrees % 360 == 0:
        return light
    return rotate(light, about(float(np.radians(degrees))))


def about(angle: float) -> Any:
    """Rotation matrix about the vertical by an angle in radians, from +z towards +x."""
    c, s = np.cos(angle), np.sin(angle)
    return jnp.asarray([[c, 0, s], [0, 1, 0], [-s, 0, c]], jnp.result_type(float))


def view(options: SimpleNamespace, *, size: int = _SIZE) -> View:
    """The scene, its lights, and a camera that sees everything except the ground."""
    looked, lit = two_sided(centered(scene(options))), lights(options, size=size)
    azimuth, elevation = np.radians([options.azimuth, options.elevation])
    # The board of the embedded scene and the ground may extend beyond the picture.
    alone = not split_files(options.files)[0]
    shown = looked.parts[:1] if alone else looked.parts[:-1] if options.ground else looked.parts
    edge = {"width": options.size, "height": options.size}
    camera = orbit(Scene(shown).mesh, azimuth=azimuth, elevation=elevation, **edge)
    return View(looked, lit, camera, tone=options.tone)


def _load_scenes(paths: Sequence[Path], options: SimpleNamespace, playable: bool) -> Scene:
    """The scenes of all files as one upright scene, with a ground if requested."""
    turn = np.array(UPRIGHT[options.up])
    scenes = [load_scene(path, outside=options.outside) for path in paths]
    parts = [part for loaded in scenes for part in loaded.parts]
    names = unique_names([part.name for part in parts])
    if options.up != "y":
        parts = [eqx.tree_at(lambda p: p.mesh, part, meshes.rotate(part.mesh, turn)) for part in parts]
    if playable:
        parts = [_playable(part) for part in parts]
    if options.brdf is not None:  # vertex colors belong to the file's material
        parts = [Part(part.name, part.mesh, options.brdf) for part in parts]
    parts = [dataclasses.replace(part, name=name) for name, part in zip(names, parts, strict=True)]
    cameras = scenes[0].cameras if options.up == "y" else []
    if options.ground:
        matte: Callable = _matte if playable else Lambert
        name, alone = unique_names([*names, "ground"])[-1], Scene(parts)
        parts.append(Part(name, meshes.ground_plane(alone.mesh), matte(0.5)))
        cameras = cameras or [default_camera(alone, alone.mesh)]  # of the object, which the ground is wider than
    if options.up != "y":
        return Scene(parts, cameras)
    lamps = [lamp for loaded in scenes for lamp in loaded.point_lights]
    names = unique_names([*(part.name for part in parts), *(lamp.name for lamp in lamps)])[len(parts) :]
    lamps = [dataclasses.replace(lamp, name=name) for name, lamp in zip(names, lamps, strict=True)]
    return Scene(parts, cameras, point_lights=lamps)


def _number(names: Sequence[str], name: str) -> int:
    """The index of a part that is given by its name or index."""
    if name in names:
        return names.index(name)
    if name.isdecimal() and int(name) < len(names):
        return int(name)
    known = ", ".join(f"{number} {label!r}" for number, label in enumerate(names))
    raise ValueError(f"--material must name one of the parts {known}, got {name!r}")


def _playable(part: Part) -> Part:
    """Makes a part without a material plastic, so that its material can be changed in the viewer."""
    return dataclasses.replace(part, material=_PLASTIC) if eqx.tree_equal(part.material, _matte(0.5)) else part


def _matte(color: float | tuple[float, ...]) -> TexturedMaterial:
    return TexturedMaterial(base_color=color, metallic=0.0, specular=0.0)
