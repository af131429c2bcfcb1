"""Analytic models fitted to measurements: text files of the BSDF benchmark BBM, and JSON with Lafortune's model."""

import pathlib
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from jaxprt.brdf import measured, models
from jaxprt.brdf.models import Model
from jaxprt.files import inputs

_SCALE = (1.0, 1.15, 1.66)  # MERL's color scale, which the fitted data lacked
_LINE = re.compile(
    r"(?P<name>[\w-]+) *= *Aggregate\(Lambertian\(albedo = (?P<diffuse>\[[^\]]*\])\), *(?P<model>\w+)\((?P<rest>.*)\)\)"
)
_FIELD = re.compile(r"\b(\w+) = (\[[^\]]*\]|[-+\w.]+)")
_MODELS = {
    "NganBlinnPhong": ("albedo", "sharpness"),
    "NganCookTorrance": ("albedo", "roughness", "eta"),
    "NganLafortune": ("albedo", "Cxy", "Cz", "sharpness"),
    "NganWardDuer": ("albedo", "roughness"),
}
_LARGEST = 1e9  # largest number of a fit; real exponents are below 1e5


def load_ngan(path: str | pathlib.Path, material: str) -> Model:
    """Loads one material from a file of fits by Ngan, Durand and Matusik, in the format of the BSDF benchmark BBM.

    Each line of the file is a material, `name = Aggregate(Lambertian(albedo = [..]), NganWardDuer(albedo = [..], ..))`.
    Supported models are Blinn-Phong, Cook-Torrance, Lafortune and Ward-Duer. The fitted data lacked MERL's color scale
    (1, 1.15, 1.66), so all reflectances are multiplied by it here.

    Args:
        path: The file, such as `ngan_cooktorrance.fit`.
        material: Name of the material, such as "blue-acrylic".

    Returns:
        The BRDF in linear RGB.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file has no such lines, the material is unknown or there twice, its model is not supported, or a
            number is missing, not finite, negative, or so large that the BRDF would not be finite.

    Reference: Ngan, Durand, Matusik 2005, "Experimental analysis of BRDF models"; BBM, include/bsdfmodel/ngan.h.
    """
    text = inputs.content(pathlib.Path(path), "a file of fits").decode("utf-8", "replace")
    lines = [line for line in map(_LINE.fullmatch, map(str.strip, text.splitlines())) if line]
    if not lines:
        raise ValueError(
            f"{path}: must have lines such as `name = Aggregate(Lambertian(..), NganWardDuer(..))`, got none"
        )
    names = [line["name"] for line in lines]
    measured.check_unique(path, names)
    line = lines[names.index(measured.one_of(material, names, path))]
    if line["model"] not in _MODELS:
        raise ValueError(f"{path}: the model of {material} must be one of {', '.join(_MODELS)}, got {line['model']}")
    try:
        number = _parameters(line["rest"], _MODELS[line["model"]])
        return _model(line["model"], _numbers("the diffuse albedo", line["diffuse"], 3) * _SCALE, number)
    except ValueError as error:
        raise ValueError(f"{path}: the numbers of {material} must fit its model {line['model']}: {error}") from error


def _parameters(text: str, names: tuple[str, ...]) -> dict[str, Any]:
    """The parameters of a model from `name = value` pairs: a color for the albedo, otherwise a number."""
    pairs = [pair for pair in _FIELD.findall(text) if pair[0] in names]
    if sorted(name for name, _ in pairs) != sorted(names):
        came = ", ".join(name for name, _ in pairs) or "none"
        raise ValueError(f"it must have {', '.join(names)} once, got {came}")
    return {name: _numbers(name, value, 3 if name == "albedo" else 1) for name, value in pairs}


def _numbers(name: str, text: str, count: int) -> Any:
    """A number, or a list of `count` numbers in brackets."""
    words = text[1:-1].split(",") if text.startswith("[") else [text]
    try:
        value = np.array([float(word) for word in words])
    except ValueError:
        raise ValueError(f"{name} must be numbers, got {text[:80]!r}") from None
    if len(value) != count:
        raise ValueError(f"{name} must be {count} numbers, got {text[:80]!r}")
    low = -_LARGEST if name in ("Cxy", "Cz") else 0
    if not np.all((value >= low) & (value <= _LARGEST)):
        raise ValueError(f"{name} must be from {low:g} to {_LARGEST:g}, got {text[:80]}")
    return value if count > 1 else value[0]


def _model(name: str, diffuse: np.ndarray, field: dict[str, Any]) -> Model:
    """The model with the parameters of a fit."""
    specular = field["albedo"] * _SCALE
    if name == "NganCookTorrance":  # its eta is the reflectance at normal incidence
        return models.CookTorrance(diffuse=diffuse, specular=specular, roughness=field["roughness"], f0=field["eta"])
    if name == "NganWardDuer":
        m = field["roughness"]
        return models.WardDuer(diffuse=diffuse, specular=specular, along=m, across=m)
    n = field["sharpness"]
    if name == "NganBlinnPhong":  # ks (n + 2) / (2 pi) (n.h)^n in the paper
        return models.BlinnPhong(diffuse=diffuse, specular=specular * 4 * (2 ** (-n / 2) + n) / (n + 4), exponent=n)
    # The published lobe is divided by the larger coefficient and normalized like Phong's. Here that scale is part of
    # the coefficients.
    size = max(abs(field["Cxy"]), abs(field["Cz"]))
    if not (n > 0 and size > 0):
        raise ValueError(f"sharpness must be positive, and Cxy or Cz not 0, got {n}, {field['Cxy']} and {field['Cz']}")
    with np.errstate(over="ignore"):
        height = (specular * (n + 2) / (2 * np.pi)) ** (1 / n) / size
        cxy, cz = ((height * field[key])[None] for key in ("Cxy", "Cz"))
    exponent = np.full((1, 3), n)
    _check_lobes(cxy, cz, exponent)
    return models.Lafortune(diffuse=diffuse, cx=cxy, cy=cxy, cz=cz, exponent=exponent)


def load_lafortune(path: str | pathlib.Path, material: str) -> models.Lafortune:
    """Loads one material from a JSON file with coefficients of Lafortune's model.

    The file holds ``materials`` by name, each with ``diffuse`` and a list ``lobes`` of ``Cxy``, ``Cz`` and ``n``. All
    values have three colors. ``jaxprt.brdf.Lafortune`` explains the model.

    Args:
        path: The file.
        material: Name of the material, such as "clay".

    Returns:
        The BRDF in linear RGB.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file has another structure, the material is unknown, a number is not finite, a diffuse
            reflectance is negative, an exponent is not positive, or a value of the BRDF would be above
            ``jaxprt.brdf.measured.LARGEST``.

    Reference: Lafortune, Foo, Torrance, Greenberg 1997.
    """
    form = f"{path}: must be JSON with materials, each with diffuse and lobes, whose Cxy, Cz and n have three colors"
    known = inputs.json_object(pathlib.Path(path), "a file of Lafortune BRDFs").get("materials")
    if not isinstance(known, dict) or not known:
        raise ValueError(f"{form}, got a file without materials")
    entry = known[measured.one_of(material, list(known), path)]
    lobes = entry.get("lobes") if isinstance(entry, dict) else None
    if not isinstance(lobes, list) or not all(isinstance(lobe, dict) for lobe in lobes):
        raise ValueError(f"{form}, got {material} in another form")
    try:
        diffuse = _color("diffuse", entry)
        cxy, cz, exponent = (
            np.array([_color(key, lobe) for lobe in lobes]).reshape(-1, 3) for key in ("Cxy", "Cz", "n")
        )
    except ValueError as error:
        raise ValueError(f"{form}, got {material} in another form: {error}") from error
    good = (diffuse >= 0) & (diffuse <= measured.LARGEST)
    required = f"finite and non-negative, and at most {measured.LARGEST:g}"
    measured.require(path, diffuse, good, required, "diffuse at color")
    for value, name in ((cxy, "Cxy"), (cz, "Cz"), (exponent, "n")):
        with np.errstate(over="ignore"):
            good = np.isfinite(np.float32(value)) & ((np.float32(value) > 0) | (name != "n"))
        measured.require(path, value, good, "positive" if name == "n" else "finite", f"{name} at lobe, color")
    try:
        _check_lobes(cxy, cz, exponent)
    except ValueError as error:
        raise ValueError(f"{path}: {material}: {error}") from error
    return models.Lafortune(diffuse=diffuse, cx=cxy, cy=cxy, cz=cz, exponent=exponent)


def _color(name: str, entry: Mapping[str, Any]) -> Float64[np.ndarray, "3"]:
    """Three numbers of a JSON object."""
    value = entry.get(name)
    if not isinstance(value, list) or len(value) != 3 or not all(type(number) in (int, float) for number in value):
        raise ValueError(f"{name} must be three numbers, got {str(value)[:80]}")
    try:
        return np.array([float(number) for number in value])
    except OverflowError:
        raise ValueError(f"{name} must be numbers that float64 can hold, got an integer beyond it") from None


def _check_lobes(cxy: np.ndarray, cz: np.ndarray, exponent: np.ndarray) -> None:
    """Refuses lobes whose peak is too high. x_i x_o + y_i y_o is in [-1, 1], and z_i z_o in [0, 1]."""
    with np.errstate(divide="ignore", over="ignore"):
        power = exponent * np.log10(np.maximum(np.abs(cxy), cz))
    most = np.log10(measured.LARGEST)
    wrong = np.argwhere(~(power <= most))
    if len(wrong):
        first = tuple(wrong[0].tolist())
        raise ValueError(
            f"lobes must be at most {measured.LARGEST:g} high, got {len(wrong)} that are not, the first lobe at lobe, "
            f"color {first}: Cxy {cxy[first]:g}, Cz {cz[first]:g}, n {exponent[first]:g}"
        )
