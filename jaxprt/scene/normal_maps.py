"""Normal maps: shading normals at points, and the roughness that normals within a pixel add.

Mip maps average unit normals. The direction of a mean is the normal of its pixel. Its length says how far the normals
are apart: for a von Mises-Fisher distribution of normals it determines the concentration k, and the variance along one
axis is 1 / k. A microfacet distribution of width alpha has the variance alpha^2 / 2. Variances add, so that

    alpha'^2 = alpha^2 + 2 / k

Reference: Toksvig 2005, "Mipmapping normal maps", for the length of the mean; Han et al. 2007, "Frequency domain normal
map filtering", for the distribution.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Num

from jaxprt.sphere import directions

_LOWEST = 0.1  # least ratio of a normal's height to its slope: lower normals are raised to it
_FLAT = 1e-3  # Below this, slopes may be rounding errors: a normal without height is then that of the surface.


def of_unit_length(image: Any) -> Any:
    """A normal map with all normals scaled to unit length; zero normals become that of the surface.

    Args:
        image: Texels [h w c] with (normal + 1) / 2 in their first three channels. Maps of fewer channels are returned
            as they are. In NumPy unless JAX traces the image.
    """
    xp: Any = jnp if isinstance(image, Tracer) else np
    texel = xp.asarray(image)
    if texel.shape[2] < 3:
        return texel
    normal = 2 * texel[..., :3] - 1
    square = xp.sum(normal**2, -1, keepdims=True)
    zero = square < np.finfo(np.float32).eps
    unit = xp.where(zero, xp.asarray([0.0, 0.0, 1.0], texel.dtype), normal / xp.sqrt(xp.where(zero, 1, square)))
    return (unit + 1) / 2


def tilted(
    frame: Float[Array | np.ndarray, "p 3 3"],
    handedness: Num[Array | np.ndarray, " p"],
    mean: Float[Array | np.ndarray, "p 3"],
    scale: Float[Array | np.ndarray, " p"],
) -> Float[Array, "p 3"]:
    """Unit normals in world space.

    Normals that point along the surface or below it are raised to about six degrees above it, so that they are lit.

    Args:
        frame: Shading frames of the smooth surface; rows are tangent, bitangent, normal.
        handedness: -1 where the bitangent of the texture coordinates is opposite to that of the frame, 1 elsewhere.
        mean: Mean normals of the map in the frame of the texture coordinates, of any length.
        scale: Factor of the first two components.
    """
    x, y = mean[:, 0] * scale, mean[:, 1] * scale * handedness
    square = x**2 + y**2
    flat = square < _FLAT**2
    slope = jnp.where(flat, 0, jnp.sqrt(jnp.where(flat, 1, square)))
    height = jnp.maximum(mean[:, 2], _LOWEST * slope)
    height = jnp.where(flat & (height < _FLAT), 1, height)
    local = jnp.stack([x, y, height], -1)
    return directions.normalize(sum(local[:, i, None] * frame[:, i] for i in range(3)))


def variance(
    mean: Float[Array | np.ndarray, "p 3"],
    scale: Float[Array | np.ndarray, " p"],
    footprint: Float[Array | np.ndarray, " p"],
) -> Float[Array, " p"]:
    """Variance along one axis, in squared radians, of the normals that a pixel averages.

    Between texels of a map that is seen magnified, the mean of their normals is shorter too, although the pixel sees
    one normal. The variance is therefore reduced where a pixel covers less than a texel.

    Args:
        mean: Mean of the unit normals of the map.
        scale: Factor of the slopes of the map.
        footprint: Longest edge of the footprint with which the map is read, in texels.
    """
    square = jnp.clip(jnp.sum(mean**2, -1), 1e-4, 1)
    length = jnp.sqrt(square)
    inverse = (1 - square) / (length * (3 - square))  # 1 / k, as of Banerjee et al. 2005
    return inverse * scale**2 * jnp.minimum(footprint, 1) ** 2


def rougher(
    roughness: Float[Array | np.ndarray, " p"], variance: Float[Array | np.ndarray, " p"]
) -> Float[Array, " p"]:
    """Roughness, the square root of alpha, of a surface whose normals have a variance along one axis; at most 1."""
    spread = variance > 0
    wide = jnp.where(spread, roughness, 1) ** 4 + 2 * variance
    return jnp.where(spread, jnp.minimum(jnp.sqrt(jnp.sqrt(wide)), jnp.maximum(roughness, 1)), roughness)
