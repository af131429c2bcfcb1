"""Factorizations; they know no BRDF and no mesh."""

from jaxprt.decompose import eigen, mixture, tucker

__all__ = ["eigen", "mixture", "tucker"]
