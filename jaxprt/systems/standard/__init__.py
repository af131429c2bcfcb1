"""Tables of what most scenes have, fitted once and shipped: metallic-roughness, its layers, and Blinn-Phong."""

from jaxprt.systems.standard import families, layered, tables
from jaxprt.systems.standard.families import RoughnessFamily, SheenFamily, ShininessFamily
from jaxprt.systems.standard.layered import COATED, SHEENED, LayeredTable
from jaxprt.systems.standard.tables import BLINN_PHONG, DEGREE, METALLIC_ROUGHNESS, SHEEN, StandardTable, forget

__all__ = [
    "BLINN_PHONG",
    "COATED",
    "DEGREE",
    "METALLIC_ROUGHNESS",
    "SHEEN",
    "SHEENED",
    "LayeredTable",
    "RoughnessFamily",
    "SheenFamily",
    "ShininessFamily",
    "StandardTable",
    "families",
    "forget",
    "layered",
    "tables",
]
