"""Functions on the sphere and hemisphere: directions, disk maps, cubemaps, wavelets, spherical harmonics."""

from jaxprt.sphere import cubemap, directions, haar, harmonics, hemisphere, lighting, products, rotation

__all__ = ["cubemap", "directions", "haar", "harmonics", "hemisphere", "lighting", "products", "rotation"]
