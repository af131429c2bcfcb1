"""Orthonormal two-dimensional Haar wavelet transform of square images, over all levels, in the non-standard form.

Coefficients have the layout of PyWavelets' `coeffs_to_array`: the mean times n in the corner, surrounded by the details
of each level.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit


@jit
def forward(image: Float[Array, "*b n n c"]) -> Float[Array, "*b n n c"]:
    """Transforms each image to Haar coefficients.

    The transform is orthonormal: it preserves inner products and norms.

    Args:
        image: Square images whose edge n is a power of two, with channels c last.

    Returns:
        Haar coefficients, in the units of the image.
    Reference: Stollnitz, DeRose, Salesin 1995; Wang, Tran, Luebke 2004, section 3.3.
    """
    n = _edge(image.shape)
    if n == 1:
        return image
    a, b = image[..., 0::2, 0::2, :], image[..., 0::2, 1::2, :]
    c, d = image[..., 1::2, 0::2, :], image[..., 1::2, 1::2, :]
    mean, vertical = (a + b + c + d) / 2, (a - b + c - d) / 2
    horizontal, diagonal = (a + b - c - d) / 2, (a - b - c + d) / 2
    top = jnp.concatenate([forward(mean), vertical], -2)
    return jnp.concatenate([top, jnp.concatenate([horizontal, diagonal], -2)], -3)


@jit
def inverse(coefficient: Float[Array, "*b n n c"]) -> Float[Array, "*b n n c"]:
    """Inverse of `forward`, which is also its transpose.

    Args:
        coefficient: Haar coefficients.

    Raises:
        ValueError: The edge is not a power of two.
    """
    n = _edge(coefficient.shape)
    if n == 1:
        return coefficient
    half = n // 2
    mean = inverse(coefficient[..., :half, :half, :])
    vertical = coefficient[..., :half, half:, :]
    horizontal, diagonal = coefficient[..., half:, :half, :], coefficient[..., half:, half:, :]
    a, b = mean + vertical + horizontal + diagonal, mean - vertical + horizontal - diagonal
    c, d = mean + vertical - horizontal - diagonal, mean - vertical - horizontal + diagonal
    upper, lower = jnp.stack([a, b], -2), jnp.stack([c, d], -2)
    return jnp.stack([upper, lower], -4).reshape(coefficient.shape) / 2


def _edge(shape: tuple[int, ...]) -> int:
    n = shape[-2]
    if n < 1 or n & (n - 1):
        raise ValueError(f"the edge of an image must be a power of two, got {n}")
    return n


def area(*, size: int) -> Float[Array, "n n"]:
    """Share of the image that each basis function covers: 1 for the mean, 4 / size^2 for the finest wavelets."""
    place = jnp.arange(_edge((size, size, 1)))
    level = jnp.where(place > 0, jnp.floor(jnp.log2(jnp.maximum(place, 1) + 0.5)), 0)
    coarse = jnp.maximum(level[:, None], level[None, :])
    return 4.0 ** (-coarse)


def face_edge(count: int) -> int:
    """Edge n of cubemap faces with `count` = 6 n n texels or coefficients."""
    n = math.isqrt(max(count, 0) // 6)
    if n < 1 or 6 * n * n != count or n & (n - 1):
        raise ValueError(f"a cubemap must have 6 n n texels with n a power of two, got {count}")
    return n
