"""Functions on the sphere and hemisphere: directions, hemisphere maps, cubemaps, wavelets, spherical harmonics."""

from jaxprt.sphere import cubemap, directions, haar, harmonics, hemisphere, low_frequency, rotation
from jaxprt.sphere import hats as hats

__all__ = [
    "cubemap",
    "directions",
    "haar",
    "harmonics",
    "hemisphere",
    "low_frequency",
    "rotation",
]
