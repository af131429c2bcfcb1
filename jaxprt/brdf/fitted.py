"""Analytic models fitted to the MERL database, read from text files of the BSDF benchmark BBM."""

import ast
import pathlib
import re
from typing import Any

import numpy as np

from jaxprt.brdf import measured, models
from jaxprt.brdf.models import Model

_SCALE = (1.0, 1.15, 1.66)  # MERL's color scale, which the fitted data lacked
_LINE = re.compile(
    r"(?P<name>[\w-]+) *= *Aggregate\(Lambertian\(albedo = (?P<diffuse>\[[^\]]*\])\), *(?P<model>\w+)\((?P<rest>.*)\)\)"
)
_FIELD = re.compile(r"(\w+) = (\[[^\]]*\]|[-+\w.]+)")
_MODELS = ("NganBlinnPhong", "NganCookTorrance", "NganLafortune", "NganWardDuer")


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
        ValueError: The file has no such lines, the material is unknown, its model is not supported, or a number is out
            of range.

    Reference: Ngan, Durand, Matusik 2005, "Experimental analysis of BRDF models"; BBM, include/bsdfmodel/ngan.h.
    """
    text = pathlib.Path(path).read_text(encoding="utf-8", errors="replace")
    lines = {found["name"]: found for found in map(_LINE.fullmatch, map(str.strip, text.splitlines())) if found}
    if not lines:
        raise ValueError(
            f"{path}: must have lines such as `name = Aggregate(Lambertian(..), NganWardDuer(..))`, got none"
        )
    found = lines[measured.one_of(material, list(lines), path)]
    if found["model"] not in _MODELS:
        raise ValueError(f"{path}: the model of {material} must be one of {', '.join(_MODELS)}, got {found['model']}")
    try:
        field = {name: np.array(ast.literal_eval(value), float) for name, value in _FIELD.findall(found["rest"])}
        return _model(found["model"], np.array(ast.literal_eval(found["diffuse"]), float) * _SCALE, field)
    except (ValueError, KeyError, SyntaxError, TypeError) as error:
        raise ValueError(f"{path}: the numbers of {material} must fit its model {found['model']}: {error}") from error


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
    height = (specular * (n + 2) / (2 * np.pi)) ** (1 / n) / size
    cxy, cz = ((height * field[key])[None] for key in ("Cxy", "Cz"))
    return models.Lafortune(diffuse=diffuse, cx=cxy, cy=cxy, cz=cz, exponent=np.full((1, 3), n))
