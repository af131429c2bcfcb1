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
from jaxprt.scene.points import Points
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


@functools.partial(jit, static_argnames="size")
def flux(
    coefficient: Float[Array, "h c"], vector: Array, normal: Float[Array, "v 3"], *, size: int
) -> Float[Array, "c 3 v"]:
    """Vector irradiance / pi of vertices: the integral of light times visibility times direction, above the horizon.

    Its dot product with the normal is `irradiance`. With another normal it is the irradiance of a surface that is
    tilted by a normal map, as far as the same light arrives at it.

    A transfer vector holds the integral of visibility x hat function x cosine. The direction of the visible part of a
    hat function is close to that of its center, raised above the horizon, so that dividing by the cosine of this
    direction and multiplying by the direction gives the integral that is wanted.

    Args:
        coefficient: The light's `coefficients`.
        vector: Transfer vectors [h, v] of the vertices.
        normal: Unit normals of the vertices.
        size: Edge of the cubemap faces in texels.
    """
    center = jnp.asarray(hats.centers(cells=cells(size)), normal.dtype)
    width, axes = np.pi / 2 / cells(size), normal.T

    def row(argument):
        light, transfer, direction = argument
        cosine = jnp.tensordot(direction, axes, 1)
        # Mean cosine over the part of a tent of this width that lies above the horizon: a third of the width for a
        # center on the horizon, and the cosine itself from one width above it.
        over = jnp.clip(cosine + width, 1e-2 * width, 2 * width)
        mean = jnp.where(cosine < width, over / 3 + over**2 / (12 * width), cosine)
        weight = transfer.astype(normal.dtype) / mean
        return light[:, None, None] * (weight * (direction[:, None] + (mean - cosine) * axes))

    return total(row, (coefficient, vector, center))


def at_points(
    irradiance: Float[Array, "c v"], flux: Float[Array, "c 3 v"] | None, points: Points
) -> Float[Array, "c _"]:
    """Irradiance / pi at points, from `irradiance` and `flux` at the vertices.

    Points with tilted normals have that of their normals if there is a flux.
    """
    if points.normal is None or flux is None:
        return points.carry(irradiance, axis=1)
    return jnp.sum(points.carry(flux, axis=2) * points.normal, 1)


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
