"""Lamps: light from surfaces that emit and from point lights near the objects, free in color and strength."""

from jaxprt.systems.lamps import relight, transport
from jaxprt.systems.lamps.relight import LitByLamps
from jaxprt.systems.lamps.transport import LampTransport, precompute

__all__ = ["LampTransport", "LitByLamps", "precompute", "relight", "transport"]
