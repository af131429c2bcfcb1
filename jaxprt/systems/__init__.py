"""The systems, their yardstick, and single bright texels beside any of them."""

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
]
