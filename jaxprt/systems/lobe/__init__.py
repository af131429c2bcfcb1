"""The lobe system: BRDFs as mixtures of von Mises-Fisher lobes, visibility in pyramids."""

from jaxprt.systems.lobe import em, published, pyramid, relight, table
from jaxprt.systems.lobe.published import mirror_lobes
from jaxprt.systems.lobe.pyramid import LobeTransport, compress, precompute
from jaxprt.systems.lobe.relight import LobeLight, LobeView, combine, look, prefilter, radiance
from jaxprt.systems.lobe.table import LobeBrdf, Lobes, Remainder, tabulate

__all__ = [
    "LobeBrdf",
    "LobeLight",
    "LobeTransport",
    "LobeView",
    "Lobes",
    "Remainder",
    "combine",
    "compress",
    "em",
    "look",
    "mirror_lobes",
    "precompute",
    "prefilter",
    "published",
    "pyramid",
    "radiance",
    "relight",
    "table",
    "tabulate",
]
