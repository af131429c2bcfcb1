"""Light at any points of a scene, as a matrix: sensors, texels of lightmaps, points of clouds."""

from jaxprt.sensors.bases import Harmonics, Patches, Texels
from jaxprt.sensors.build import transport
from jaxprt.sensors.lightmaps import Lightmap, lightmap
from jaxprt.sensors.matrix import PointTransport

__all__ = ["Harmonics", "Lightmap", "Patches", "PointTransport", "Texels", "lightmap", "transport"]
