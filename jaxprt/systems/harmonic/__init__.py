"""The harmonic system: arbitrary BRDFs under low-frequency light (Kautz, Sloan, Snyder 2002)."""

from jaxprt.systems.harmonic import clustered, exchange, interreflection, relight, system, table, transfer
from jaxprt.systems.harmonic.clustered import ClusteredTransfer, clustered_light, precompute_clustered
from jaxprt.systems.harmonic.exchange import export_transfer, import_transfer
from jaxprt.systems.harmonic.interreflection import interreflect, interreflect_diffuse
from jaxprt.systems.harmonic.relight import (
    combine,
    diffuse_radiance,
    local_light,
    probe_light,
    project,
    radiance,
    transferred_light,
    transferred_view,
    unshadowed_radiance,
    view_coefficients,
    world_view,
)
from jaxprt.systems.harmonic.system import ClusteredSystem, DiffuseSystem, HarmonicSystem, blended_view
from jaxprt.systems.harmonic.table import HarmonicBrdf, tabulate
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector, precompute, precompute_diffuse

__all__ = [
    "ClusteredSystem",
    "ClusteredTransfer",
    "DiffuseSystem",
    "HarmonicBrdf",
    "HarmonicSystem",
    "TransferMatrix",
    "TransferVector",
    "blended_view",
    "clustered",
    "clustered_light",
    "combine",
    "diffuse_radiance",
    "exchange",
    "export_transfer",
    "import_transfer",
    "interreflect",
    "interreflect_diffuse",
    "interreflection",
    "local_light",
    "precompute",
    "precompute_clustered",
    "precompute_diffuse",
    "probe_light",
    "project",
    "radiance",
    "relight",
    "system",
    "table",
    "tabulate",
    "transfer",
    "transferred_light",
    "transferred_view",
    "unshadowed_radiance",
    "view_coefficients",
    "world_view",
]
