"""Bilinear hat functions on the surface of a cube, as finite elements for functions on the sphere.

Each face is divided into n x n cells. A hat function is 1 at one corner of the cells, 0 at all others, and bilinear
within each cell. Corners on edges of the cube belong to two faces and the cube's corners to three, so that there are
6 n^2 + 2 functions. They are continuous, not negative, and sum to one. Unlike spherical harmonics of the same number
they are local: a bright light does not ring on the other side of the sphere.
"""

import functools
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt.compile import jit
from jaxprt.sphere import cubemap

_SHARED = 3  # most faces that meet in a corner


def count(*, cells: int) -> int:
    """Number of hat functions for `cells` cells along the edge of a face."""
    return 6 * cells * cells + 2


@partial(jit, static_argnames="cells")
def integrals(value: Float[Array, "6 n n *c"], *, cells: int) -> Float[Array, " h *c"]:
    """Integrals over the sphere of a function times each hat function.

    Args:
        value: The function as a cubemap, constant over each texel.
        cells: Number of cells along the edge of a face, a divisor of n.

    Returns:
        Integrals in the units of the function times sr.
    """
    size, channels = value.shape[1], value.shape[3:]
    profile = jnp.asarray(_profile(size, cells), value.dtype)
    area = cubemap.solid_angle(size=size).astype(value.dtype)
    weighted = value.reshape(6, size, size, -1) * area[..., None]
    faces = jnp.einsum("frtc,ri->fitc", weighted, profile)
    faces = jnp.einsum("fitc,tj->fijc", faces, profile)
    padded = jnp.concatenate([faces.reshape(-1, faces.shape[-1]), jnp.zeros_like(faces[0, 0, :1])])
    index = jnp.asarray(_members(cells))
    return jnp.sum(padded[index], 1).reshape(-1, *channels)


def project(value: Float[Array, "6 n n *c"], *, cells: int) -> Float[Array, " h *c"]:
    """Coefficients of the combination of hat functions that is closest to a function in the least-squares sense.

    Args:
        value: The function as a cubemap, constant over each texel.
        cells: Number of cells along the edge of a face, a divisor of n, at most n / 2.

    Returns:
        Coefficients in the units of the function.

    Raises:
        ValueError: The cells do not divide the texels, or are too many for them.
    """
    return _project(value, inverse_gram(value, cells=cells), cells=cells)


@partial(jit, static_argnames="cells")
def _project(value: Array, gram: Array, *, cells: int) -> Array:
    return jnp.tensordot(gram, integrals(value, cells=cells), 1)


def inverse_gram(value: Float[Array | np.ndarray, "6 n n *c"], *, cells: int) -> Array | np.ndarray:
    """Inverse of the matrix of integrals of products of two hat functions, over texels like those of a cubemap.

    It is cached on the device of the cubemap; inside a compiled program it is a constant.
    """
    with jax.ensure_compile_time_eval():  # Traced arrays could not be cached.
        size, dtype = value.shape[1], str(value.dtype)
        if isinstance(value, np.ndarray | Tracer):
            return _inverse_gram(size, cells, dtype)
        return _on_device(size, cells, dtype, min(value.devices(), key=lambda device: device.id))


@functools.lru_cache(maxsize=8)
def _on_device(size: int, cells: int, dtype: str, device: Any) -> Array:
    with jax.default_device(device):
        return jax.device_put(_inverse_gram(size, cells, dtype))


@functools.lru_cache(maxsize=8)
def _inverse_gram(size: int, cells: int, dtype: str) -> np.ndarray:
    if cells > size // 2:
        raise ValueError(f"cells must be at most {size // 2}, half of the texels along an edge, got {cells}")
    hat = table(size=size, cells=cells)
    area = scipy.sparse.diags(np.asarray(cubemap.solid_angle(size=size), np.float64).ravel())
    return np.linalg.inv((hat.T @ area @ hat).toarray()).astype(dtype)


@functools.lru_cache(maxsize=8)
def table(*, size: int, cells: int) -> scipy.sparse.csr_matrix:
    """Means of all hat functions over the texels of a cubemap, as a sparse matrix [texel, h] of the host.

    Raises:
        ValueError: The cells do not divide the texels.
    """
    profile, node = scipy.sparse.csr_matrix(_profile(size, cells)), _nodes(cells).ravel()
    corners = scipy.sparse.block_diag([scipy.sparse.kron(profile, profile)] * 6)  # [texel, corner of a face's cells]
    shared = scipy.sparse.csr_matrix((np.ones(len(node)), (np.arange(len(node)), node)))
    return scipy.sparse.csr_matrix(corners @ shared)


@functools.lru_cache(maxsize=8)
def centers(*, cells: int) -> Float[np.ndarray, "h 3"]:
    """Unit directions of the corners at which the hat functions are 1."""
    point = np.unique(_corners(cells), axis=0)
    return point / np.linalg.norm(point, axis=1, keepdims=True)


@functools.lru_cache(maxsize=8)
def _profile(size: int, cells: int) -> Float[np.ndarray, "n k"]:
    """Mean of each one-dimensional hat function over the texels along an edge of a face."""
    if cells < 1 or size % cells:
        raise ValueError(f"cells must divide the {size} texels along an edge, got {cells}")
    place = (np.arange(size) + 0.5) / size * cells
    return np.maximum(1 - np.abs(place[:, None] - np.arange(cells + 1)), 0)


@functools.lru_cache(maxsize=8)
def _nodes(cells: int) -> Int[np.ndarray, "6 k k"]:
    """Number of the hat function at each corner of the cells of each face."""
    _, node = np.unique(_corners(cells), axis=0, return_inverse=True)
    return node.reshape(6, cells + 1, cells + 1)


def _corners(cells: int) -> Int[np.ndarray, "n 3"]:
    """Places of the corners of the cells of all faces."""
    along = 2 * np.arange(cells + 1) - cells  # on the surface of the cube [-cells, cells]^3
    t, s = np.meshgrid(along, along, indexing="ij")
    local = np.stack([s, t, np.full_like(s, cells)], -1)
    return np.einsum("ija,fac->fijc", local, np.rint(cubemap.axes()).astype(int)).reshape(-1, 3)


@functools.lru_cache(maxsize=8)
def _members(cells: int) -> Int[np.ndarray, "h 3"]:
    """For each hat function the corners of faces that it stands at; the first index past them all fills the rest."""
    node = _nodes(cells).ravel()
    result = np.full((count(cells=cells), _SHARED), len(node), np.int32)
    order = np.argsort(node, kind="stable")
    first = np.searchsorted(node[order], np.arange(len(result)))
    result[node[order], np.arange(len(node)) - first[node[order]]] = order
    return result
