"""BRDFs: analytic models, and the form that each system gives them."""

from jaxprt.brdf import models, separable
from jaxprt.brdf.models import AshikhminShirley, Lambert

__all__ = ["AshikhminShirley", "Lambert", "models", "separable"]
