"""Images: drawing a mesh, showing radiance, comparing pictures."""

from jaxprt.image.metrics import flip, psnr, relative_l2
from jaxprt.image.raster import Fragments, front, interpolate, rasterize, ray_direction, render
from jaxprt.image.tonemap import automatic_exposure, decode_srgb, display, encode_srgb, expose

__all__ = [
    "Fragments",
    "automatic_exposure",
    "decode_srgb",
    "display",
    "encode_srgb",
    "expose",
    "flip",
    "front",
    "interpolate",
    "psnr",
    "rasterize",
    "ray_direction",
    "relative_l2",
    "render",
]
