"""Light, transport and view to radiance per vertex."""

from jaxprt.relight import direct, dynamic, harmonic, lobe, reference, separable, transfer

__all__ = ["direct", "dynamic", "harmonic", "lobe", "reference", "separable", "transfer"]
