"""The dynamic system: direct light, with materials that can change at run time (Sun et al. 2007)."""

from jaxprt.systems.dynamic import brdf_set as brdf_set
from jaxprt.systems.dynamic import reflected as reflected
from jaxprt.systems.dynamic import set_relight as set_relight
from jaxprt.systems.dynamic import set_system as set_system
from jaxprt.systems.dynamic import set_transport as set_transport
from jaxprt.systems.dynamic import system as system
from jaxprt.systems.dynamic import table as table
from jaxprt.systems.dynamic import transport as transport
from jaxprt.systems.dynamic.brdf_set import BrdfSet, Mixed, factor, separate
from jaxprt.systems.dynamic.set_relight import (
    Material,
    RegionBrdf,
    SetLight,
    SetView,
    combine,
    light_side,
    mix,
    radiance,
    view_side,
)
from jaxprt.systems.dynamic.set_system import SetSystem
from jaxprt.systems.dynamic.set_transport import RegionTransport, SetTransport, precompute_sets
from jaxprt.systems.dynamic.system import DynamicSystem
from jaxprt.systems.dynamic.table import DynamicBrdf, tabulate
from jaxprt.systems.dynamic.transport import DynamicTransport, compress, precompute

__all__ = [
    "BrdfSet",
    "DynamicBrdf",
    "DynamicSystem",
    "DynamicTransport",
    "Material",
    "Mixed",
    "RegionBrdf",
    "RegionTransport",
    "SetLight",
    "SetSystem",
    "SetTransport",
    "SetView",
    "combine",
    "compress",
    "factor",
    "light_side",
    "mix",
    "precompute",
    "precompute_sets",
    "radiance",
    "separate",
    "tabulate",
    "view_side",
]
