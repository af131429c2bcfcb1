"""Images: rasterization of meshes, tone mapping, and image metrics."""

from jaxprt.image.metrics import flip, psnr, relative_l2
from jaxprt.image.pixels import Pixels, interpolate, render, resolve, shading_points, sky
from jaxprt.image.raster import Fragments, rasterize
from jaxprt.image.raster import front as front
from jaxprt.image.raster import ray_direction as ray_direction
from jaxprt.image.tonemap import automatic_exposure, decode_srgb, display, encode_srgb, expose

__all__ = [
    "Fragments",
    "Pixels",
    "automatic_exposure",
    "decode_srgb",
    "display",
    "encode_srgb",
    "expose",
    "flip",
    "interpolate",
    "psnr",
    "rasterize",
    "relative_l2",
    "render",
    "resolve",
    "shading_points",
    "sky",
]
