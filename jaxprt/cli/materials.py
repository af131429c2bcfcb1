"""Materials on the command line: a model with its parameters, or a file of measurements.

ward:diffuse=.1/.05/.02,specular=.3,along=.1,across=.3        colors have / between them
lafortune:diffuse=.1,cx=-1:-.8,cy=-1:-.8,cz=.9:.5,exponent=20:5    values of several lobes or axes have :
merl:gold.binary        ngan:ngan2005_wardduer.fit,material=nickel        npf:table.bin,material=nickel
"""

import dataclasses
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxprt import brdf
from jaxprt.scene import TexturedMaterial

MODELS: dict[str, type] = {
    "lambert": brdf.Lambert,
    "phong": brdf.Phong,
    "blinn-phong": brdf.BlinnPhong,
    "ashikhmin-shirley": brdf.AshikhminShirley,
    "ward": brdf.Ward,
    "ward-duer": brdf.WardDuer,
    "cook-torrance": brdf.CookTorrance,
    "lafortune": brdf.Lafortune,
    "poulin-fournier": brdf.PoulinFournier,
    "poulin-fournier-grooves": brdf.PoulinFournierGrooves,
    "ggx": brdf.GGX,
    "ggx-interface": brdf.GGXInterface,
    "charlie": brdf.Charlie,
    "metallic-roughness": TexturedMaterial,
}
# Loader of each kind of file, and its further options: True for required ones.
FILES: dict[str, tuple[Callable, dict[str, bool]]] = {
    "merl": (brdf.load_merl, {}),
    "npf": (brdf.load_npf, {"material": True, "names": False}),
    "lafortune": (brdf.load_lafortune, {"material": True}),
    "ngan": (brdf.load_ngan, {"material": True}),
    "scattered": (brdf.load_scattered, {"smoothing": False}),
}
_ALIASES = {"alpha_x": "along", "alpha_y": "across"}  # names of renderers for parameters of Ward's models


def parse(text: str) -> Callable | TexturedMaterial:
    """Parses the text form of a material.

    Raises:
        ValueError: A model, parameter or file does not exist, or a value is not a number or out of range.
        OSError: A file cannot be read.
    """
    name, _, rest = text.partition(":")
    words = [word.strip() for word in rest.split(",")] if rest.strip() else []
    if name in FILES and ((words and "=" not in words[0]) or name not in MODELS):
        return _measured(name, words)
    if name not in MODELS:
        names = ", ".join(dict.fromkeys([*MODELS, *FILES]))
        raise ValueError(f"a material must be one of {names}, got {name!r}")
    kind, given = MODELS[name], {}
    known = parameters(name)
    for word in words:
        key, equals, value = word.partition("=")
        key = _ALIASES.get(key, key) if "along" in known else key
        if not equals or key not in known:
            raise ValueError(f"{name} takes {', '.join(f'{each}=' for each in known)}, got {word!r}")
        if key in given:
            raise ValueError(f"{name} takes each parameter once, got {key} twice")
        given[key] = _numbers(name, key, value)
    missing = [key for key, default in known.items() if default is None and key not in given]
    if missing:
        raise ValueError(f"{name} must have {', '.join(f'{each}=' for each in missing)}, got {text!r}")
    return kind(**given)


def parameters(name: str) -> dict[str, float | None]:
    """Numeric parameters of a model with their defaults; None for required ones."""
    result = {}
    for field in inspect.signature(MODELS[name]).parameters.values():
        if not field.name.endswith("_texture") and not isinstance(field.default, str):
            result[field.name] = None if field.default is inspect.Parameter.empty else float(field.default)
    return result


def of_part(text: str) -> tuple[str, str]:
    """Splits PART=MATERIAL into the part and the material.

    Raises:
        ValueError: The text does not have this form.
    """
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


def _measured(name: str, words: list[str]) -> Callable:
    load, takes = FILES[name]
    if not words or "=" in words[0]:
        raise ValueError(f"{name} must name a file, {form(name)}, got {', '.join(words) or 'none'}")
    given: dict[str, Any] = {}
    for word in words[1:]:
        key, equals, value = word.partition("=")
        if not equals or key not in takes or key in given:
            raise ValueError(f"{name} takes {form(name)}, got {word!r}")
        given[key] = _number(name, key, value) if key == "smoothing" else value
    if any(needed and key not in given for key, needed in takes.items()):
        # A name that no file has, so that the loader's error message lists existing ones.
        given["material"] = ""
    return load(Path(words[0]), **given)


def form(name: str) -> str:
    """The text form of a material from a file."""
    more = [f",{key}=.." if needed else f"[,{key}=..]" for key, needed in FILES[name][1].items()]
    return f"{name}:FILE{''.join(more)}"


def _numbers(name: str, key: str, text: str) -> Any:
    """Parses a number, a color r/g/b, or several of them separated by colons."""
    rows = [[_number(name, key, each) for each in row.split("/")] for row in text.split(":")]
    if {len(row) for row in rows} not in ({1}, {3}):
        raise ValueError(f"{key} of {name} must be numbers, or colors as .1/.2/.3, got {text!r}")
    value = [row[0] if len(row) == 1 else row for row in rows]
    of_lobes = name == "lafortune" and key != "diffuse"
    most = math.inf if of_lobes else 2 if (name[:3], key) == ("ggx", "roughness") else 1
    if len(value) > most:
        raise ValueError(f"{key} of {name} must be {'one value' if most == 1 else 'at most two values'}, got {text!r}")
    return value if len(value) > 1 or of_lobes else value[0]


def _number(name: str, key: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{key} of {name} must be a finite number, got {text!r}")
    return value
