"""Tables of materials that most scenes have, fitted once and shipped."""

from jaxprt.systems.standard import families, layered, tables
from jaxprt.systems.standard.layered import COATED, SHEENED, LayeredTable
from jaxprt.systems.standard.tables import (
    BLINN_PHONG,
    COOK_TORRANCE,
    METALLIC_ROUGHNESS,
    SHEEN,
    StandardTable,
)

__all__ = [
    "BLINN_PHONG",
    "COATED",
    "COOK_TORRANCE",
    "METALLIC_ROUGHNESS",
    "SHEEN",
    "SHEENED",
    "LayeredTable",
    "StandardTable",
    "families",
    "layered",
    "tables",
]
