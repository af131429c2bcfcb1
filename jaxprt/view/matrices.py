"""Transfer matrices for exported pages: spherical harmonics of visibility as bytes, and BRDF tables."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.sphere import harmonics
from jaxprt.systems import harmonic
from jaxprt.systems.harmonic.transfer import from_visibility, to_visibility

_EQUAL = 1e-3  # largest relative error at which matrices count as products of a visibility, and tables as symmetric
_KNOTS = 64  # most knots of the roughness
_CHANNELS = 4


class CoarseMatrix(harmonic.TransferMatrix):
    """Transfer matrices that are computed from the harmonics of a quantized visibility.

    Attributes:
        visible: Harmonics of the visibility in world coordinates, of twice the degree of the matrices.
    """

    visible: Float[Array, "k v"]


def check(name: str, system: harmonic.HarmonicSystem) -> None:
    """Refuses parts that an exported page does not support."""
    table, knots = system.brdf.table, [len(knot) for knot in system.brdf.knot]
    if not system.brdf.isotropic:
        raise ValueError(f"part {name!r} must have an isotropic BRDF to be exported, got an anisotropic one")
    if len(knots) > 1 or table.shape[1] > _CHANNELS or any(knot > _KNOTS for knot in knots):
        raise ValueError(
            f"part {name!r} must have a table of at most {_CHANNELS} channels and one parameter of {_KNOTS} knots to "
            f"be exported, got {table.shape[1]} and {knots}"
        )
    if system.transport.matrix.shape[1] != 1:
        raise ValueError(
            f"part {name!r} must have gray transfer matrices to be exported, "
            f"got {system.transport.matrix.shape[1]} colors"
        )


def visibility_of(name: str, system: harmonic.HarmonicSystem) -> Float[np.ndarray, "k v"]:
    """Harmonics of the visibility from which a part's transfer matrices were computed, of twice their degree.

    Raises:
        ValueError: The matrices do not come from a visibility, for example because they include interreflection.
    """
    transport = system.transport
    if isinstance(transport, CoarseMatrix):
        return np.asarray(transport.visible, np.float64)
    matrix = transport.matrix[:, 0]
    visibility = to_visibility(matrix, transport.frame)
    again = from_visibility(visibility, transport.frame, degree=system.degree)
    if not float(jnp.linalg.norm(again - matrix)) <= _EQUAL * float(jnp.linalg.norm(matrix)):
        raise ValueError(
            f"part {name!r} must have the transfer matrices of direct light to be exported, got others, as with "
            "interreflection"
        )
    return np.asarray(visibility, np.float64)


def truncated(visible: Float[np.ndarray, "k v"], degree: int | None) -> Float[np.ndarray, "m v"]:
    """Harmonics of visibility that matrices of a degree need; all if None."""
    return visible if degree is None else visible[: (2 * degree + 1) ** 2]


def reduced(system: harmonic.HarmonicSystem, visible: Float[np.ndarray, "k v"]) -> harmonic.HarmonicSystem:
    """The system with its visibility replaced by another one, which may have a lower degree."""
    old, degree = system.transport, harmonics.degree_of(len(visible)) // 2
    coefficient = jnp.asarray(visible, old.matrix.dtype)
    matrix = from_visibility(coefficient, old.frame, degree=degree)[:, None]
    transport = CoarseMatrix(matrix, old.position, old.frame, coefficient)
    return harmonic.HarmonicSystem(transport, system.brdf.truncate(degree=degree), system.laplacian)


def plane_table(name: str, brdf: harmonic.HarmonicBrdf) -> Float[np.ndarray, "h q e 4"]:
    """Table of a BRDF by zonal harmonics: for each knot, view node, band and each of `degree + 1` directions.

    A BRDF that is symmetric about the plane of the view direction and the normal can be written, in each band, as a sum
    of zonal harmonics about directions in this plane. Its dot product with the light is then the sum of the light's
    bands, evaluated in these directions, times the entries. The page therefore does not need to rotate harmonics.

    Raises:
        ValueError: The BRDF is not symmetric.
    """
    value = np.asarray(brdf.table, np.float64)
    value = value if brdf.knot else value[:, :, None]
    bands = brdf.degree + 1
    angle = np.pi * (np.arange(bands) + 0.5) / bands
    way = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    basis = np.asarray(harmonics.evaluate(jnp.asarray(way, jnp.result_type(float)), degree=brdf.degree), np.float64)
    result = np.zeros((*value.shape[2:], bands, bands, _CHANNELS))
    missed = 0.0
    for band in range(bands):
        rows = slice(band**2, (band + 1) ** 2)
        factor = np.einsum("jm,mchq->hqjc", np.linalg.pinv(basis[:, rows].T), value[rows])
        missed += float(np.sum((np.einsum("jm,hqjc->mchq", basis[:, rows], factor) - value[rows]) ** 2))
        result[:, :, band, :, : value.shape[1]] = factor
    if not np.sqrt(missed) <= _EQUAL * np.linalg.norm(value):
        raise ValueError(f"part {name!r} must have a BRDF that is symmetric about the plane of the view to be exported")
    return result.reshape(*value.shape[2:], bands**2, _CHANNELS)


def words(system: harmonic.HarmonicSystem) -> int:
    """Number of 4-byte words for the visibility of a vertex."""
    return -(-((2 * system.degree + 1) ** 2) // 4)


def nbytes(system: harmonic.HarmonicSystem, degree: int) -> int:
    """Size in bytes of the visibility of all vertices, for matrices of a degree."""
    return system.vertices * (2 * min(system.degree, degree) + 1) ** 2
