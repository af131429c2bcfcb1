"""The dynamic system: materials that change at run time, direct light (Sun et al. 2007)."""

from jaxprt.systems.dynamic import brdf_set, published, reflected, relight, transport
from jaxprt.systems.dynamic.brdf_set import DynamicBrdf, Mixed, factor, separate
from jaxprt.systems.dynamic.published import factor_tensor
from jaxprt.systems.dynamic.relight import DynamicLight, DynamicView, Material, combine, light_side, radiance, view_side
from jaxprt.systems.dynamic.transport import DynamicTransport, RegionTransport, precompute

__all__ = [
    "DynamicBrdf",
    "DynamicLight",
    "DynamicTransport",
    "DynamicView",
    "Material",
    "Mixed",
    "RegionTransport",
    "brdf_set",
    "combine",
    "factor",
    "factor_tensor",
    "light_side",
    "precompute",
    "published",
    "radiance",
    "reflected",
    "relight",
    "separate",
    "transport",
    "view_side",
]
