"""Light, transport and view to radiance per vertex."""

from jaxprt.relight import reference, separable

__all__ = ["reference", "separable"]
