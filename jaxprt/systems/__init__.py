"""The relighting systems, the reference solution, and exact summation of the brightest texels of a light."""

from jaxprt.systems import adaptive as adaptive
from jaxprt.systems import (
    bounces,
    bright_texels,
    dynamic,
    harmonic,
    lamps,
    lobe,
    ranges,
    reference,
    separable,
    standard,
)
from jaxprt.systems import protocol as protocol

__all__ = [
    "bounces",
    "bright_texels",
    "dynamic",
    "harmonic",
    "lamps",
    "lobe",
    "ranges",
    "reference",
    "separable",
    "standard",
]
