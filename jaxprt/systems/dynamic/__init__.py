"""The dynamic system: direct light, with materials that can change at run time (Sun et al. 2007)."""

from jaxprt.systems.dynamic import (
    brdf_set,
    reflected,
    relight,
    system,
    table,
    transport,
    vertex_system,
    vertices,
)
from jaxprt.systems.dynamic.brdf_set import DynamicBrdf, Mixed, factor, separate
from jaxprt.systems.dynamic.relight import (
    DynamicLight,
    DynamicView,
    Material,
    RegionBrdf,
    combine,
    light_side,
    mix,
    radiance,
    view_side,
)
from jaxprt.systems.dynamic.system import DynamicSystem
from jaxprt.systems.dynamic.transport import DynamicTransport, RegionTransport, precompute

__all__ = [
    "DynamicBrdf",
    "DynamicLight",
    "DynamicSystem",
    "DynamicTransport",
    "DynamicView",
    "Material",
    "Mixed",
    "RegionBrdf",
    "RegionTransport",
    "brdf_set",
    "combine",
    "factor",
    "light_side",
    "mix",
    "precompute",
    "radiance",
    "reflected",
    "relight",
    "separate",
    "system",
    "table",
    "transport",
    "vertex_system",
    "vertices",
    "view_side",
]
