"""Factorizations; they know no BRDF and no mesh."""

from jaxprt.linalg import eigen

__all__ = ["eigen"]
