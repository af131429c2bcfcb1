"""The relighting systems, the reference solution, and exact summation of the brightest texels of a light."""

from jaxprt.systems import adaptive as adaptive
from jaxprt.systems import bounces as bounces
from jaxprt.systems import bright_texels as bright_texels
from jaxprt.systems import dynamic as dynamic
from jaxprt.systems import harmonic as harmonic
from jaxprt.systems import lamps as lamps
from jaxprt.systems import lobe as lobe
from jaxprt.systems import protocol as protocol
from jaxprt.systems import ranges, standard
from jaxprt.systems import reference as reference
from jaxprt.systems import separable as separable

__all__ = [
    "ranges",
    "standard",
]
