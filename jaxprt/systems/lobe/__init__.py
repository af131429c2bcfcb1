"""The lobe system: BRDFs as mixtures of von Mises-Fisher lobes, and visibility in pyramids of cubemaps."""

from jaxprt.systems.lobe import diffuse, em, knots, published, pyramid, relight, remainder, system, table
from jaxprt.systems.lobe.matte import MatteLight, MatteSystem, MatteTransport, matte_transport
from jaxprt.systems.lobe.published import mirror_lobes
from jaxprt.systems.lobe.pyramid import LobeTransport, TexelBits, bits, compress, precompute, texel_bits
from jaxprt.systems.lobe.relight import LobeLight, LobeView, combine, prefilter, radiance, view_lobes
from jaxprt.systems.lobe.remainder import Remainder
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
    "Remainder",
    "TexelBits",
    "bits",
    "combine",
    "compress",
    "diffuse",
    "em",
    "knots",
    "matte_transport",
    "mirror_lobes",
    "precompute",
    "prefilter",
    "published",
    "pyramid",
    "radiance",
    "relight",
    "remainder",
    "system",
    "table",
    "tabulate",
    "texel_bits",
    "view_lobes",
]
