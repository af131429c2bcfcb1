"""BRDFs: analytic models, and the form that each system gives them."""

from jaxprt.brdf import (
    cylinders,
    dynamic,
    errors,
    harmonic,
    lobe,
    lobe_em,
    measured,
    models,
    navigation,
    paths,
    published,
    reflected,
    scattered,
    separable,
)
from jaxprt.brdf.cylinders import PoulinFournier, PoulinFournierGrooves
from jaxprt.brdf.dynamic import DynamicBrdf
from jaxprt.brdf.harmonic import HarmonicBrdf
from jaxprt.brdf.lobe import LobeBrdf
from jaxprt.brdf.measured import load_lafortune, load_merl, load_npf
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

__all__ = [
    "AshikhminShirley",
    "BlinnPhong",
    "CookTorrance",
    "DynamicBrdf",
    "HarmonicBrdf",
    "Lafortune",
    "Lambert",
    "LobeBrdf",
    "Phong",
    "PoulinFournier",
    "PoulinFournierGrooves",
    "Ward",
    "WardDuer",
    "cylinders",
    "dynamic",
    "errors",
    "harmonic",
    "load_lafortune",
    "load_merl",
    "load_npf",
    "load_scattered",
    "lobe",
    "lobe_em",
    "measured",
    "models",
    "navigation",
    "paths",
    "published",
    "reflected",
    "scattered",
    "separable",
]
