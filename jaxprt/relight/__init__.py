"""Light, transport and view to radiance per vertex."""

from jaxprt.relight import direct, harmonic, lobe, reference, separable

__all__ = ["direct", "harmonic", "lobe", "reference", "separable"]
