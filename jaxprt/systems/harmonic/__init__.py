"""The harmonic system: arbitrary BRDFs under low-frequency light (Kautz, Sloan, Snyder 2002)."""

from jaxprt.systems.harmonic import system as system
from jaxprt.systems.harmonic import table as table
from jaxprt.systems.harmonic import transfer as transfer
from jaxprt.systems.harmonic.exchange import export_transfer, import_transfer
from jaxprt.systems.harmonic.system import DiffuseSystem, HarmonicSystem, probe_light, project
from jaxprt.systems.harmonic.table import HarmonicBrdf, tabulate
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector, precompute, precompute_diffuse

__all__ = [
    "DiffuseSystem",
    "HarmonicBrdf",
    "HarmonicSystem",
    "TransferMatrix",
    "TransferVector",
    "export_transfer",
    "import_transfer",
    "precompute",
    "precompute_diffuse",
    "probe_light",
    "project",
    "tabulate",
]
