"""From visibility to coefficients, per block of vertices."""

from jaxprt.transport import blocks, separable, sparse, visibility
from jaxprt.transport.sparse import SparseTransport

__all__ = ["SparseTransport", "blocks", "separable", "sparse", "visibility"]
