"""Light, transport and view to radiance per vertex."""

from jaxprt.relight import harmonic, reference, separable

__all__ = ["harmonic", "reference", "separable"]
