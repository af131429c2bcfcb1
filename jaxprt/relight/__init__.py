"""Light, transport and view to radiance per vertex."""

from jaxprt.relight import direct, harmonic, reference, separable

__all__ = ["direct", "harmonic", "reference", "separable"]
