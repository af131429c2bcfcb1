"""Opacity of the surfaces of a scene, in the form in which rays and pictures look it up.

It belongs to the shape of a scene: it is read when a scene is precomputed, and later materials do not change it.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

BLEND = -1.0  # in place of a cutoff, for surfaces that stop the share alpha
CLEAR = 1 / 512  # share of light that no 8-bit image resolves: less is nothing, and all but this is everything


class Opacity(eqx.Module):
    """Opacity of the vertices of a mesh, and the images that multiply it.

    The opacity of a point is interpolated between the vertices and multiplied by the texel. All arrays are in NumPy.

    Attributes:
        coordinate: Where each vertex lies in its image; v points up.
        factor: Opacity of each vertex, without its image.
        layer: Row of each vertex in the fields below; row 0 is opaque.
        cutoff: Opacity from which on the surface is there; `BLEND` for surfaces that stop this share of light.
        wrap: Wrap mode of the image along u and v, as an index into `texture.WRAPS`.
        start: Index of the image's first texel; -1 without an image.
        shape: Height and width of the image.
        texel: The texels of all images, row by row, first row on top.
        passing: Color of the light that passes each layer, relative to its mean: 1 for alpha, a tint for glass.
        glass: Whether a layer lets light through without being reflected less, as glass does and holes do not.
    """

    coordinate: Float[Array | np.ndarray, "v 2"]
    factor: Float[Array | np.ndarray, " v"]
    layer: Int[Array | np.ndarray, " v"]
    cutoff: Float[Array | np.ndarray, " m"]
    wrap: Int[Array | np.ndarray, "m 2"]
    start: Int[Array | np.ndarray, " m"]
    shape: Int[Array | np.ndarray, "m 2"]
    texel: Float[Array | np.ndarray, " t"]
    passing: Float[Array | np.ndarray, "m 3"]
    glass: Bool[Array | np.ndarray, " m"]

    @property
    def blends(self) -> bool:
        """Whether some surfaces stop a share of the light."""
        return bool(np.any(np.asarray(self.cutoff) == BLEND))
