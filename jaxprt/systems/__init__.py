"""The relighting systems, the reference solution, and exact summation of the brightest texels of a light."""

from jaxprt.systems import (
    adaptive,
    bounces,
    bright_texels,
    dynamic,
    harmonic,
    lamps,
    lobe,
    protocol,
    ranges,
    reference,
    separable,
    standard,
)

__all__ = [
    "adaptive",
    "bounces",
    "bright_texels",
    "dynamic",
    "harmonic",
    "lamps",
    "lobe",
    "protocol",
    "ranges",
    "reference",
    "separable",
    "standard",
]
