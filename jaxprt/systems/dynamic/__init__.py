"""The dynamic system: direct light, with materials that can change at run time (Sun et al. 2007)."""

from jaxprt.systems.dynamic import reflected as reflected
from jaxprt.systems.dynamic import system as system
from jaxprt.systems.dynamic import table as table
from jaxprt.systems.dynamic import transport as transport
from jaxprt.systems.dynamic.system import DynamicSystem
from jaxprt.systems.dynamic.table import DynamicBrdf, tabulate
from jaxprt.systems.dynamic.transport import DynamicTransport, compress, precompute

__all__ = ["DynamicBrdf", "DynamicSystem", "DynamicTransport", "compress", "precompute", "tabulate"]
