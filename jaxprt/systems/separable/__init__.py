"""The separable system: factored BRDFs, with light and transport in Haar wavelets (Wang, Tran, Luebke 2004)."""

from jaxprt.systems.separable import clustered as clustered
from jaxprt.systems.separable import factorization as factorization
from jaxprt.systems.separable import sparse as sparse
from jaxprt.systems.separable import system as system
from jaxprt.systems.separable.clustered import ClusteredTransport
from jaxprt.systems.separable.factorization import SeparableBrdf, factor, light_errors
from jaxprt.systems.separable.sparse import SparseTransport, precompute
from jaxprt.systems.separable.system import SeparableSystem

__all__ = [
    "ClusteredTransport",
    "SeparableBrdf",
    "SeparableSystem",
    "SparseTransport",
    "factor",
    "light_errors",
    "precompute",
]
