"""BRDFs: analytic models, measured data, and families of BRDFs."""

from jaxprt.brdf import coat, cylinders, fitted, measured, microfacet, models, navigation, scattered, sheen
from jaxprt.brdf.coat import ClearCoat, CoatedModel, coat_reflectance
from jaxprt.brdf.cylinders import PoulinFournier, PoulinFournierGrooves
from jaxprt.brdf.fitted import load_lafortune, load_ngan
from jaxprt.brdf.measured import load_merl, load_npf
from jaxprt.brdf.microfacet import GGX, GGXInterface, MetallicRoughness, SchlickDiffuse
from jaxprt.brdf.models import (
    AshikhminShirley,
    BlinnPhong,
    CookTorrance,
    Lafortune,
    Lambert,
    Phong,
    Ward,
    WardDuer,
)
from jaxprt.brdf.scattered import load_scattered
from jaxprt.brdf.sheen import Charlie, Sheen, UnderSheen, sheen_albedo

__all__ = [
    "GGX",
    "AshikhminShirley",
    "BlinnPhong",
    "Charlie",
    "ClearCoat",
    "CoatedModel",
    "CookTorrance",
    "GGXInterface",
    "Lafortune",
    "Lambert",
    "MetallicRoughness",
    "Phong",
    "PoulinFournier",
    "PoulinFournierGrooves",
    "SchlickDiffuse",
    "Sheen",
    "UnderSheen",
    "Ward",
    "WardDuer",
    "coat",
    "coat_reflectance",
    "cylinders",
    "fitted",
    "load_lafortune",
    "load_merl",
    "load_ngan",
    "load_npf",
    "load_scattered",
    "measured",
    "microfacet",
    "models",
    "navigation",
    "scattered",
    "sheen",
    "sheen_albedo",
]
