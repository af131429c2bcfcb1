"""Diffuse light of the lobe system: shadowed irradiance by bilinear hat functions on the cube.

Irradiance / pi is the integral of light times visibility times cosine / pi. The light is replaced by the combination of
hat functions that is closest to it, so that irradiance is a dot product of the light's coefficients and of transfer
vectors, the integrals of visibility x cosine / pi x hat function. These lie between zero and a bound that depends on
the hat function alone, and are stored as one byte each.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt import visibility
from jaxprt.compile import jit, total
from jaxprt.sphere import cubemap, haar, harmonics, hats

_CELLS = 8  # cells along the edge of a face
_BYTE = 255


def cells(size: int) -> int:
    """Number of cells along the edge of a face for hat functions over faces with `size` texels along an edge."""
    return min(_CELLS, size // 2)


def count(size: int) -> int:
    """Number of hat functions, the length of a transfer vector."""
    return hats.count(cells=cells(size))


def coefficients(radiance: Float[Array, "6 n n c"]) -> Float[Array, "h c"]:
    """Coefficients of a light for `irradiance`.

    They are those of `jaxprt.sphere.hats.project`, times the transfer that a byte of a transfer vector counts.
    """
    size = radiance.shape[1]
    return hats.project(radiance, cells=cells(size)) * jnp.asarray(_units(size), radiance.dtype)[:, None]


@jit
def vectors(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"]) -> UInt8[Array, "h b"]:
    """Transfer vectors of vertices, as bytes in units that depend on the hat function only.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.

    Raises:
        ValueError: d is not 6 n n for a power of two n.
    """
    size = haar.face_edge(seen.shape[1])
    mean = cubemap.vector_area(size=size) / cubemap.solid_angle(size=size)[..., None]
    cosine = jnp.maximum(frame[:, 2] @ mean.reshape(-1, 3).T.astype(frame.dtype), 0)
    value = seen.astype(frame.dtype) * (cosine / (visibility.LEVELS * np.pi))
    transfer = hats.integrals(value.T.reshape(6, size, size, -1), cells=cells(size))
    unit = jnp.asarray(_units(size), frame.dtype)[:, None]
    return jnp.clip(jnp.round(transfer / unit), 0, _BYTE).astype(jnp.uint8)


@jit
def irradiance(coefficient: Float[Array, "h c"], vector: Array) -> Float[Array, "c v"]:
    """Irradiance / pi of vertices from the light's `coefficients` and the vertices' transfer vectors [h, v]."""
    if not len(vector):
        return jnp.zeros((coefficient.shape[1], vector.shape[1]), coefficient.dtype)
    # Row by row, so that no copy of all vectors in floating point is made.
    return total(lambda row: row[0][:, None] * row[1].astype(coefficient.dtype), (coefficient, vector))


def harmonics_of(vector: UInt8[Array | np.ndarray, "h v"], *, size: int, degree: int) -> Float[Array, "lm v"]:
    """Transfer vectors in spherical harmonics, from those in hat functions.

    Args:
        vector: The result of `vectors`.
        size: Edge of the faces of the visibility in texels.
        degree: Highest degree of the harmonics.
    """
    basis = harmonics.evaluate(cubemap.direction(size=size), degree=degree)
    return irradiance(coefficients(basis), jnp.asarray(vector))


@functools.lru_cache(maxsize=8)
def _units(size: int) -> Float[np.ndarray, " h"]:
    """Transfer that a byte counts: the largest possible one, from all of a hat function above the horizon, / 255."""
    with jax.ensure_compile_time_eval():
        area = np.asarray(cubemap.vector_area(size=size), np.float64).reshape(-1, 3)
    whole = hats.table(size=size, cells=cells(size)).T @ area
    return np.linalg.norm(whole, axis=1) / (np.pi * _BYTE)
