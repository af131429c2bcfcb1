"""Lamps: emitting surfaces and point lights near the objects. Their colors and intensities may change."""

from jaxprt.systems.lamps import relight, transport
from jaxprt.systems.lamps.relight import LitByLamps
from jaxprt.systems.lamps.transport import LampTransport, precompute

__all__ = ["LampTransport", "LitByLamps", "precompute", "relight", "transport"]
