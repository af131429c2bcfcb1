"""Factorizations; they know no BRDF and no mesh."""

from jaxprt.linalg import eigen, mixture, tucker

__all__ = ["eigen", "mixture", "tucker"]
