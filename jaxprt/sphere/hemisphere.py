"""Maps of the upper hemisphere to the unit square, bilinear lookup in such maps, and quadrature over the hemisphere.

Texture coordinates are in [0, 1]; the first runs along columns. The center of texel (row, column) of an n x n map is at
((column + 1/2) / n, (row + 1/2) / n).
"""

from functools import lru_cache, partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import directions

_TINY = 1e-12
_LEAST = 1e-20
_CROWD = 4  # power by which the nodes of `arcs` are concentrated around the middle


@jit
def disk_coordinates(direction: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
    """Orthographic projection of local directions, ((d.s + 1) / 2, (d.t + 1) / 2).

    Args:
        direction: Unit directions in the local frame. Those below the horizon get the coordinates of their mirror
            image.

    Returns:
        Texture coordinates. The hemisphere fills the inscribed disk.

    Reference: Wang, Tran, Luebke 2004, equation 7.
    """
    return (direction[..., :2] + 1) / 2


@jit
def polar_coordinates(direction: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
    """Polar coordinates (atan2(d.s, d.t), sqrt(1 - d.n)), with the azimuth scaled from a full turn to [0, 1].

    At the normal the azimuth is 0 and the gradient is zero.

    Reference: Wang, Tran, Luebke 2004, equation 8.
    """
    x, y, z = direction[..., 0], direction[..., 1], direction[..., 2]
    pole = x**2 + y**2 < _TINY
    angle = jnp.arctan2(jnp.where(pole, 0, x), jnp.where(pole, 1, y))
    height = jnp.sqrt(jnp.maximum(jnp.where(pole, 1, 1 - z), 0))
    return jnp.stack([(angle / (2 * jnp.pi)) % 1, jnp.where(pole, 0, height)], -1)


@jit
def parabolic_coordinates(direction: Float[Array, "*b 3"]) -> Float[Array, "*b 2"]:
    """Parabolic coordinates d.xy / (1 + d.z), scaled from [-1, 1] to [0, 1].

    Args:
        direction: Unit directions in the local frame. Those below the horizon are projected to the horizontal plane, so
            that coordinates and gradients are finite everywhere.

    Reference: Heidrich and Seidel 1998; Kautz, Sloan, Snyder 2002, section 3.
    """
    return (direction[..., :2] / (1 + jnp.maximum(direction[..., 2:], 0)) + 1) / 2


@jit
def parabolic_direction(coordinates: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """Inverse of `parabolic_coordinates`. Points outside the disk give directions below the horizon."""
    xy = 2 * coordinates - 1
    square = jnp.sum(xy**2, -1, keepdims=True)
    return jnp.concatenate([2 * xy, 1 - square], -1) / (1 + square)


@jit
def lookup(texel: Float[Array, "n n *c"], coordinates: Float[Array, "*b 2"]) -> Float[Array, "..."]:
    """Bilinear lookup between texel centers, with constant values beyond the outermost centers.

    At the rim of the disk, lookup also reads texels outside the disk. Maps store values of the nearest directions
    inside there; see `parabolic_texel_direction`.

    Args:
        texel: Texels of a map, with any trailing axes.
        coordinates: Texture coordinates. Values outside [0, 1] are clamped.

    Returns:
        Interpolated values [*b *c], differentiable in both arguments.
    """
    n = texel.shape[0]
    place = jnp.clip(coordinates * n - 0.5, 0, n - 1)
    base = jnp.clip(jnp.floor(place), 0, max(n - 2, 0))
    weight = place - base
    column, row = jnp.unstack(base.astype(jnp.int32), axis=-1)
    down, right = (n, 1) if n > 1 else (0, 0)
    start = row * n + column
    table = texel.reshape((n * n, *texel.shape[2:]))
    x, y = (w.reshape(w.shape + (1,) * (texel.ndim - 2)) for w in jnp.unstack(weight, axis=-1))
    top = table[start] * (1 - x) + table[start + right] * x
    bottom = table[start + down] * (1 - x) + table[start + down + right] * x
    return top * (1 - y) + bottom * y


@jit
def polar_lookup(texel: Float[Array, "n n *c"], coordinates: Float[Array, "*b 2"]) -> Float[Array, "..."]:
    """Bilinear lookup in a polar map, periodic in azimuth and continuous across the normal.

    The row before the first is the first row shifted by half a turn, because a path through the normal continues on the
    opposite side. Beyond the last row, at the horizon, the map is constant.

    Args:
        texel: Texels of a polar map, with any trailing axes.
        coordinates: Coordinates from `polar_coordinates`, the first in [0, 1].

    Returns:
        Interpolated values [*b *c], differentiable in both arguments.
    """
    n = texel.shape[0]
    # If n is odd, half a turn is not a whole number of texels.
    opposite = (jnp.roll(texel[:1], n // 2, 1) + jnp.roll(texel[:1], n - n // 2, 1)) / 2
    tall = jnp.concatenate([opposite, texel, texel[-1:]])
    around = jnp.concatenate([tall[:, -1:], tall, tall[:, :1]], 1)
    return lookup(around, (coordinates * n + 1) / (n + 2))


@partial(jit, static_argnames=("resolution",))
def parabolic_texel_direction(*, resolution: int) -> Float[Array, "n n 3"]:
    """Directions of the texels of an n x n parabolic map, including texels outside the disk.

    Centers outside the disk, or within a quarter of a texel of the rim, are moved to a quarter of a texel inside it.
    """
    center = (jnp.arange(resolution) + 0.5) / resolution
    xy = 2 * jnp.stack(jnp.meshgrid(center, center), -1) - 1
    radius = jnp.linalg.norm(xy, axis=-1, keepdims=True)
    inner = xy * jnp.minimum(1, (1 - 0.5 / resolution) / jnp.maximum(radius, 0.5 / resolution))
    return parabolic_direction((inner + 1) / 2)


@partial(jit, static_argnames=("resolution",))
def parabolic_texel_area(*, resolution: int) -> Float[Array, "n n"]:
    """Solid angle of each texel of a parabolic map if its center lies inside the unit disk, else 0.

    The cosine is not part of it: d omega = 4 dx dy / (1 + x^2 + y^2)^2.
    """
    center = 2 * (jnp.arange(resolution) + 0.5) / resolution - 1
    square = center[:, None] ** 2 + center[None, :] ** 2
    return jnp.where(square < 1, (4 / resolution / (1 + square)) ** 2, 0.0)


@partial(jit, static_argnames=("rings", "sectors"))
def arcs(middle: Float[Array, "3"], *, rings: int, sectors: int) -> tuple[Float[Array, "d 3"], Float[Array, " d"]]:
    """Quadrature over the upper hemisphere for functions with a peak around one direction.

    Nodes lie on arcs from that direction to the horizon, at Gauss-Legendre points in the fourth root of 1 - cos of the
    angle. They are dense around the direction, so that a peak three degrees wide needs no more nodes than a wide one.
    Along each arc the integrand is smooth if it is smooth above the horizon.

    Args:
        middle: Unit direction of the peak, above the horizon or on it.
        rings: Number of nodes on each arc.
        sectors: Number of arcs.

    Returns:
        Unit directions of the nodes, and the solid angle of each in sr.
    """
    place, weight = (jnp.asarray(array, middle.dtype)[:, None] for array in _arc(rings))
    angle = 2 * np.pi * (np.arange(sectors) + 0.5) / sectors
    cosine, sine = jnp.asarray(np.cos(angle), middle.dtype), jnp.asarray(np.sin(angle), middle.dtype)
    # rows: horizontal, upwards, middle; at the normal any horizontal direction serves
    across, up, _ = directions.frame(middle, jnp.cross(jnp.array([0, 0, 1], middle.dtype), middle))
    rise = sine * up[2]
    whole = 1 + rise / jnp.sqrt(jnp.maximum(middle[2] ** 2 + rise**2, _LEAST))  # 1 - cos at the horizon
    height = whole * place
    reach = jnp.sqrt(height * (2 - height))
    side = [across[i] * cosine + up[i] * sine for i in range(3)]
    direction = jnp.stack([(1 - height) * middle[i] + reach * side[i] for i in range(3)], -1)
    return direction.reshape(-1, 3), (whole * weight * (2 * np.pi / sectors)).reshape(-1)


@lru_cache(maxsize=8)
def _arc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights on [0, 1], with nodes concentrated around 0."""
    place, weight = np.polynomial.legendre.leggauss(rings)
    t = (place + 1) / 2
    return t**_CROWD, weight / 2 * _CROWD * t ** (_CROWD - 1)
