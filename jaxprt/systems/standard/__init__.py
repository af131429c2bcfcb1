"""Tables of materials that most scenes have, fitted once and shipped."""

from jaxprt.systems.standard import families, layered, tables
from jaxprt.systems.standard.families import RoughnessFamily, SheenFamily, ShininessFamily, SlopeFamily
from jaxprt.systems.standard.layered import COATED, SHEENED, LayeredTable
from jaxprt.systems.standard.tables import (
    BLINN_PHONG,
    COOK_TORRANCE,
    DEGREE,
    METALLIC_ROUGHNESS,
    RANKS,
    SHEEN,
    TENSOR_LOBES,
    StandardTable,
    forget,
)

__all__ = [
    "BLINN_PHONG",
    "COATED",
    "COOK_TORRANCE",
    "DEGREE",
    "METALLIC_ROUGHNESS",
    "RANKS",
    "SHEEN",
    "SHEENED",
    "TENSOR_LOBES",
    "LayeredTable",
    "RoughnessFamily",
    "SheenFamily",
    "ShininessFamily",
    "SlopeFamily",
    "StandardTable",
    "families",
    "forget",
    "layered",
    "tables",
]
