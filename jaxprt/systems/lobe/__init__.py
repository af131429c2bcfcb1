"""The lobe system: BRDFs as mixtures of von Mises-Fisher lobes, and visibility in pyramids of cubemaps."""

from jaxprt.systems.lobe import diffuse, em, knots, pyramid, relight, system, table
from jaxprt.systems.lobe.matte import MatteLight, MatteSystem, MatteTransport, matte_transport
from jaxprt.systems.lobe.pyramid import LobeTransport, TexelBits, bits, compress, precompute, texel_bits
from jaxprt.systems.lobe.relight import LobeLight, LobeView, combine, prefilter, radiance, view_lobes
from jaxprt.systems.lobe.system import LobeSystem
from jaxprt.systems.lobe.table import LobeBrdf, Lobes, tabulate

__all__ = [
    "LobeBrdf",
    "LobeLight",
    "LobeSystem",
    "LobeTransport",
    "LobeView",
    "Lobes",
    "MatteLight",
    "MatteSystem",
    "MatteTransport",
    "TexelBits",
    "bits",
    "combine",
    "compress",
    "diffuse",
    "em",
    "knots",
    "matte_transport",
    "precompute",
    "prefilter",
    "pyramid",
    "radiance",
    "relight",
    "system",
    "table",
    "tabulate",
    "texel_bits",
    "view_lobes",
]
