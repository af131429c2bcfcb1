"""Transfer matrices in a page that relights without Python: harmonics of the visibility in bytes, and BRDF tables."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.sphere import harmonics
from jaxprt.systems import harmonic
from jaxprt.systems.harmonic.transfer import from_visibility, to_visibility

_EQUAL = 1e-3  # relative error of matrices that are those of a visibility, and of tables that are symmetric
_KNOTS = 64  # of the roughness, at most
_CHANNELS = 4


class CoarseMatrix(harmonic.TransferMatrix):
    """The matrices of a visibility that was rounded.

    Attributes:
        visible: Harmonics of the visibility in the world, of twice the degree.
    """

    visible: Float[Array, "k v"]


def check(name: str, system: harmonic.HarmonicSystem) -> None:
    """Refuses parts that a page does not have."""
    table, knots = system.brdf.table, [len(each) for each in system.brdf.knot]
    if not system.brdf.isotropic:
        raise ValueError(f"part {name!r} must have an isotropic BRDF to be exported, got an anisotropic one")
    if len(knots) > 1 or table.shape[1] > _CHANNELS or any(each > _KNOTS for each in knots):
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
    """Harmonics of the visibility that a part's matrices were made of, of twice their degree.

    Raises:
        ValueError: The matrices are of no visibility: with interreflection, for example.
    """
    transport = system.transport
    if isinstance(transport, CoarseMatrix):
        return np.asarray(transport.visible, np.float64)
    matrix = transport.matrix[:, 0]
    found = to_visibility(matrix, transport.frame)
    again = from_visibility(found, transport.frame, degree=system.degree)
    if not float(jnp.linalg.norm(again - matrix)) <= _EQUAL * float(jnp.linalg.norm(matrix)):
        raise ValueError(
            f"part {name!r} must have the transfer matrices of direct light to be exported, got others, as with "
            "interreflection"
        )
    return np.asarray(found, np.float64)


def truncated(visible: Float[np.ndarray, "k v"], degree: int | None) -> Float[np.ndarray, "m v"]:
    """Harmonics of visibility that matrices of a degree have; all for None."""
    return visible if degree is None else visible[: (2 * degree + 1) ** 2]


def reduced(system: harmonic.HarmonicSystem, visible: Float[np.ndarray, "k v"]) -> harmonic.HarmonicSystem:
    """A system with another visibility, which may be of a lower degree."""
    old, degree = system.transport, harmonics.degree_of(len(visible)) // 2
    coefficient = jnp.asarray(visible, old.matrix.dtype)
    matrix = from_visibility(coefficient, old.frame, degree=degree)[:, None]
    transport = CoarseMatrix(matrix, old.position, old.frame, coefficient)
    return harmonic.HarmonicSystem(transport, system.brdf.truncate(degree=degree), system.laplacian)


def plane_table(name: str, brdf: harmonic.HarmonicBrdf) -> Float[np.ndarray, "h q e 4"]:
    """A table for each knot and node of the view, with entries for each band and each of `degree + 1` directions.

    A BRDF that is symmetric about the plane of the view and the normal is, band by band, a sum of zonal harmonics
    about directions in this plane. Its dot product with the light is then the sum of the values of the light's bands
    in these directions, times the entries: the page needs no rotation of harmonics.

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
        found = np.einsum("jm,mchq->hqjc", np.linalg.pinv(basis[:, rows].T), value[rows])
        missed += float(np.sum((np.einsum("jm,hqjc->mchq", basis[:, rows], found) - value[rows]) ** 2))
        result[:, :, band, :, : value.shape[1]] = found
    if not np.sqrt(missed) <= _EQUAL * np.linalg.norm(value):
        raise ValueError(f"part {name!r} must have a BRDF that is symmetric about the plane of the view to be exported")
    return result.reshape(*value.shape[2:], bands**2, _CHANNELS)


def words(system: harmonic.HarmonicSystem) -> int:
    """Words of four bytes that the visibility of a vertex takes."""
    return -(-((2 * system.degree + 1) ** 2) // 4)


def nbytes(system: harmonic.HarmonicSystem, degree: int) -> int:
    """Bytes of the visibility of all vertices, up to a degree of the matrices."""
    return system.vertices * (2 * min(system.degree, degree) + 1) ** 2
