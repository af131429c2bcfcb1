"""Texels of the published maps of the hemisphere: the orthographic disk, and polar maps."""

from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit


@jit
def disk_direction(coordinates: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """Inverse of `jaxprt.sphere.hemisphere.disk_coordinates`.

    Points outside the disk give the nearest direction at the horizon. At and beyond the rim the gradient is that of the
    horizontal direction, so it is finite everywhere.
    """
    xy = 2 * coordinates - 1
    square = jnp.sum(xy**2, -1, keepdims=True)
    outside = square >= 1
    radius = jnp.sqrt(jnp.where(outside, square, 1))
    z = jnp.sqrt(jnp.where(outside, 1, 1 - square))
    return jnp.concatenate([xy / radius, jnp.where(outside, 0, z)], -1)


@partial(jit, static_argnames=("resolution",))
def texel_direction(*, resolution: int) -> Float[Array, "n n 3"]:
    """Directions of the texels of an n x n disk map, including texels outside the disk.

    A texel whose center lies outside the disk gets a direction a quarter of a texel inside the rim, so that bilinear
    lookup up to the horizon never reads an undefined texel.
    """
    center = (jnp.arange(resolution) + 0.5) / resolution
    xy = 2 * jnp.stack(jnp.meshgrid(center, center), -1) - 1
    radius = jnp.linalg.norm(xy, axis=-1, keepdims=True)
    xy = jnp.where(radius >= 1, xy * (1 - 0.5 / resolution) / jnp.maximum(radius, 1), xy)
    return jnp.concatenate([xy, jnp.sqrt(1 - jnp.sum(xy**2, -1, keepdims=True))], -1)


@partial(jit, static_argnames=("resolution",))
def texel_area(*, resolution: int) -> Float[Array, "n n"]:
    """Area of each texel of a disk map: (2 / n)^2 if its center lies inside the unit disk, else 0.

    On the orthographic disk dx dy = cos(theta) d omega, so areas are the weights of cosine-weighted integrals.
    """
    center = 2 * (jnp.arange(resolution) + 0.5) / resolution - 1
    inside = center[:, None] ** 2 + center[None, :] ** 2 < 1
    return jnp.where(inside, (2 / resolution) ** 2, 0.0)


@jit
def polar_direction(coordinates: Float[Array, "*b 2"]) -> Float[Array, "*b 3"]:
    """Inverse of `jaxprt.sphere.hemisphere.polar_coordinates`.

    Reference: Wang, Tran, Luebke 2004, equation 8.
    """
    angle = 2 * jnp.pi * coordinates[..., 0]
    square = coordinates[..., 1] ** 2
    radius = coordinates[..., 1] * jnp.sqrt(2 - square)
    return jnp.stack([radius * jnp.sin(angle), radius * jnp.cos(angle), 1 - square], -1)


def polar_texel_direction(*, resolution: int) -> Float[Array, "n n 3"]:
    """Directions of the texels of an n x n polar map. All lie above the horizon."""
    center = (jnp.arange(resolution) + 0.5) / resolution
    return polar_direction(jnp.stack(jnp.meshgrid(center, center), -1))


def polar_texel_area(*, resolution: int) -> Float[Array, "n n"]:
    """Exact integral of cos(theta) d omega over each texel of a polar map."""
    square = (jnp.arange(resolution + 1) / resolution) ** 2
    # d omega = 2 y dy d phi and cos(theta) = 1 - y^2; y^2 - y^4 / 2 is the integral of 2 y (1 - y^2).
    ring = jnp.diff(square - square**2 / 2) * (2 * jnp.pi / resolution)
    return jnp.broadcast_to(ring[:, None], (resolution, resolution))
