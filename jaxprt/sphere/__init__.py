"""Functions on the sphere and hemisphere: directions, hemisphere maps, cubemaps, wavelets, spherical harmonics."""

from jaxprt.sphere import (
    conventions,
    cubemap,
    directions,
    haar,
    harmonics,
    hats,
    hemisphere,
    lighting,
    products,
    rotation,
)

__all__ = [
    "conventions",
    "cubemap",
    "directions",
    "haar",
    "harmonics",
    "hats",
    "hemisphere",
    "lighting",
    "products",
    "rotation",
]
