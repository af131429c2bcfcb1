"""The separable system: factored BRDFs, with light and transport in Haar wavelets (Wang, Tran, Luebke 2004)."""

from jaxprt.systems.separable import clustered, factorization, sparse, system
from jaxprt.systems.separable.clustered import ClusteredTransport
from jaxprt.systems.separable.factorization import SeparableBrdf, factor, light_errors
from jaxprt.systems.separable.sparse import SparseTransport, precompute
from jaxprt.systems.separable.system import SeparableSystem

__all__ = [
    "ClusteredTransport",
    "SeparableBrdf",
    "SeparableSystem",
    "SparseTransport",
    "clustered",
    "factor",
    "factorization",
    "light_errors",
    "precompute",
    "sparse",
    "system",
]
