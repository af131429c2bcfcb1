"""Tables of the materials that most scenes have, fitted once and shipped: metallic-roughness and Blinn-Phong."""

from jaxprt.systems.standard import coated, families, tables
from jaxprt.systems.standard.coated import COATED
from jaxprt.systems.standard.families import RoughnessFamily, ShininessFamily
from jaxprt.systems.standard.tables import BLINN_PHONG, DEGREE, METALLIC_ROUGHNESS, StandardTable, forget

__all__ = [
    "BLINN_PHONG",
    "COATED",
    "DEGREE",
    "METALLIC_ROUGHNESS",
    "RoughnessFamily",
    "ShininessFamily",
    "StandardTable",
    "coated",
    "families",
    "forget",
    "tables",
]
