"""The separable system: factored BRDFs, with light and transport in Haar wavelets (Wang, Tran, Luebke 2004)."""

from jaxprt.systems.separable import (
    clustered,
    errors,
    factorization,
    published,
    quantized,
    relight,
    sparse,
    system,
    wavelets,
)
from jaxprt.systems.separable.clustered import ClusteredTransport
from jaxprt.systems.separable.errors import light_errors, sample_error
from jaxprt.systems.separable.factorization import SeparableBrdf, factor, join
from jaxprt.systems.separable.quantized import QuantizedTransport
from jaxprt.systems.separable.relight import (
    Transport,
    choose_by_area,
    choose_by_magnitude,
    choose_by_transport,
    combine,
    light_tuple,
    modulate,
    project,
    quantize,
    radiance,
    view_factors,
    view_tuple,
)
from jaxprt.systems.separable.sparse import SparseTransport
from jaxprt.systems.separable.system import SeparableSystem
from jaxprt.systems.separable.wavelets import precompute
from jaxprt.visibility import members

__all__ = [
    "ClusteredTransport",
    "QuantizedTransport",
    "SeparableBrdf",
    "SeparableSystem",
    "SparseTransport",
    "Transport",
    "choose_by_area",
    "choose_by_magnitude",
    "choose_by_transport",
    "clustered",
    "combine",
    "errors",
    "factor",
    "factorization",
    "join",
    "light_errors",
    "light_tuple",
    "members",
    "modulate",
    "precompute",
    "project",
    "published",
    "quantize",
    "quantized",
    "radiance",
    "relight",
    "sample_error",
    "sparse",
    "system",
    "view_factors",
    "view_tuple",
    "wavelets",
]
