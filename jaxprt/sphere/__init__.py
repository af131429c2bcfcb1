"""Functions on the sphere and hemisphere: directions, disk maps, cubemaps, wavelets."""

from jaxprt.sphere import cubemap, directions, haar, hemisphere

__all__ = ["cubemap", "directions", "haar", "hemisphere"]
