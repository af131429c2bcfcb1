"""From visibility to coefficients, per block of vertices."""

from jaxprt.transport import (
    blocks,
    clustered,
    direct,
    dynamic,
    harmonic,
    hits,
    interreflection,
    lobe,
    quantized,
    separable,
    sparse,
    transfer,
    visibility,
)
from jaxprt.transport.clustered import ClusteredTransport
from jaxprt.transport.direct import DirectTransport
from jaxprt.transport.dynamic import DynamicTransport
from jaxprt.transport.harmonic import TransferMatrix, TransferVector
from jaxprt.transport.lobe import LobeTransport
from jaxprt.transport.quantized import QuantizedTransport
from jaxprt.transport.sparse import SparseTransport
from jaxprt.transport.transfer import TransferTensor

__all__ = [
    "ClusteredTransport",
    "DirectTransport",
    "DynamicTransport",
    "LobeTransport",
    "QuantizedTransport",
    "SparseTransport",
    "TransferMatrix",
    "TransferTensor",
    "TransferVector",
    "blocks",
    "clustered",
    "direct",
    "dynamic",
    "harmonic",
    "hits",
    "interreflection",
    "lobe",
    "quantized",
    "separable",
    "sparse",
    "transfer",
    "visibility",
]
