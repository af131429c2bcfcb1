"""From visibility to coefficients, per block of vertices."""

from jaxprt.transport import blocks, harmonic, interreflection, separable, sparse, visibility
from jaxprt.transport.harmonic import TransferMatrix, TransferVector
from jaxprt.transport.sparse import SparseTransport

__all__ = [
    "SparseTransport",
    "TransferMatrix",
    "TransferVector",
    "blocks",
    "harmonic",
    "interreflection",
    "separable",
    "sparse",
    "visibility",
]
