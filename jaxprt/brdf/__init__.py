"""BRDFs: analytic models, measured data, and families of BRDFs."""

from jaxprt.brdf import coat as coat
from jaxprt.brdf import cylinders as cylinders
from jaxprt.brdf import fitted as fitted
from jaxprt.brdf import measured as measured
from jaxprt.brdf import microfacet as microfacet
from jaxprt.brdf import models as models
from jaxprt.brdf import navigation
from jaxprt.brdf import scattered as scattered
from jaxprt.brdf import sheen as sheen
from jaxprt.brdf.coat import ClearCoat, CoatedModel
from jaxprt.brdf.coat import coat_reflectance as coat_reflectance
from jaxprt.brdf.cylinders import PoulinFournier, PoulinFournierGrooves
from jaxprt.brdf.fitted import load_lafortune, load_ngan
from jaxprt.brdf.measured import load_merl, load_npf
from jaxprt.brdf.microfacet import GGX, GGXInterface, MetallicRoughness, SchlickDiffuse
from jaxprt.brdf.models import AshikhminShirley, BlinnPhong, CookTorrance, Lafortune, Lambert, Phong, Ward, WardDuer
from jaxprt.brdf.scattered import load_scattered
from jaxprt.brdf.sheen import Charlie, Sheen, UnderSheen
from jaxprt.brdf.sheen import sheen_albedo as sheen_albedo

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
    "load_lafortune",
    "load_merl",
    "load_ngan",
    "load_npf",
    "load_scattered",
    "navigation",
]
