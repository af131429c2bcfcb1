"""The lobe system: BRDFs as mixtures of von Mises-Fisher lobes, and visibility in pyramids of cubemaps."""

from jaxprt.systems.lobe import blurred_light as blurred_light
from jaxprt.systems.lobe import diffuse as diffuse
from jaxprt.systems.lobe import em as em
from jaxprt.systems.lobe import pyramid as pyramid
from jaxprt.systems.lobe import system as system
from jaxprt.systems.lobe import table as table
from jaxprt.systems.lobe.pyramid import LobeTransport, compress, precompute, texel_bits
from jaxprt.systems.lobe.system import LobeSystem, MatteSystem, matte_transport
from jaxprt.systems.lobe.table import LobeBrdf, tabulate

__all__ = [
    "LobeBrdf",
    "LobeSystem",
    "LobeTransport",
    "MatteSystem",
    "compress",
    "matte_transport",
    "precompute",
    "tabulate",
    "texel_bits",
]
