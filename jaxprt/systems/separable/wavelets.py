"""Transport of the separable system: Haar coefficients of visibility x cosine x light map, per vertex and BRDF term."""

import os
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit
from jaxprt.files.arrays import Layout, sketch
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.systems.separable import sparse
from jaxprt.systems.separable.factorization import SeparableBrdf, marked
from jaxprt.systems.separable.sparse import SparseTransport
from jaxprt.visibility.arguments import PRECOMPUTE


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    brdf: SeparableBrdf,
    *,
    keep: int = 96,
    size: int = 64,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> SparseTransport:
    """Precomputes the transport of a mesh with self-shadowing, for a factored BRDF.

    Args:
        mesh: The mesh to light.
        brdf: Factored BRDF of the mesh, from `jaxprt.separable.factor`.
        keep: Number of wavelet coefficients kept per vertex and term.
        size: Edge of the light's cubemap faces in texels; a power of two.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        path: Folder in which finished blocks are stored; it is created with its parents. A call that was interrupted
            continues from there.
        executor: A `concurrent.futures.Executor` that computes the blocks; if None, the cores of this machine. Process
            pools must have the context "spawn": forked processes hang where JAX runs.
        progress: Whether to show a progress bar.

    Returns:
        The transport of every vertex.

    Raises:
        TypeError: The BRDF is not a `SeparableBrdf`.
        ValueError: The size is not a power of two, `keep` or a vertex index is out of range, positions, normals or
            tangents are not finite, or the folder holds results of other inputs.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.

    Reference: Wang, Tran, Luebke 2004, section 3.3.
    """
    if not isinstance(brdf, SeparableBrdf):
        raise TypeError(f"brdf must be factored, by jaxprt.separable.factor, got {type(brdf).__name__}")
    if size < 1 or size & (size - 1):
        raise ValueError(f"size must be a power of two, got {size}")
    if not 1 <= keep <= 6 * size * size:
        raise ValueError(f"keep must be at most {6 * size * size} and at least 1, got {keep}")
    job = _Job.make(mesh, occluder, vertex, size, brdf=jax.tree.map(np.asarray, brdf), keep=keep)
    result = visibility.blocks.compute(job, path=path, executor=executor, progress=progress)
    rms = sparse.rms(result["index"], result["value"], 6 * size * size)
    index, value = jax.device_put(result["index"]), jax.device_put(result["value"])
    position, frame = visibility.rays.place(mesh, vertex), jax.device_put(job.frame)
    return SparseTransport(index, value, position, frame, rms, mark=jax.device_put(marked(brdf.light_map)))


@jit
def project(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], brdf: SeparableBrdf) -> Float[Array, "b d r l"]:
    """Haar coefficients of visibility x cosine x solid angle x light map.

    Light map x cosine is integrated over each texel with 2 x 2 Gauss points. Points below the horizon contribute zero.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        brdf: The factored BRDF. Only its light maps are used.

    Returns:
        d = 6 n n coefficients per vertex, term and color. Each face is transformed separately by `haar.forward`.

    Raises:
        ValueError: d is not 6 n n for a power of two n.

    Reference: Wang, Tran, Luebke 2004, section 3.3.
    """
    size = haar.face_edge(seen.shape[1])
    visible = seen.astype(frame.dtype) / visibility.LEVELS
    value = jnp.zeros((), frame.dtype)
    for direction, area in zip(*_points(size), strict=True):
        flux = jnp.maximum(directions.to_local(frame, area.astype(frame.dtype))[..., 2], 0) * visible
        value += brdf.light(directions.to_local(frame, direction.astype(frame.dtype))) * flux[..., None, None]
    faces = value.reshape(seen.shape[0] * 6, size, size, -1)
    return haar.forward(faces).reshape(value.shape)


def _points(size: int) -> tuple[Float[np.ndarray, "p d 3"], Float[np.ndarray, "p d 3"]]:
    """Directions of 2 x 2 Gauss points in each texel, and their weights: direction times solid angle."""
    center, step = (2 * np.arange(size) + 1) / size - 1, 1 / (np.sqrt(3) * size)
    axis = cubemap.axes()[:, None, None]
    direction, area = [], []
    for down in (-step, step):
        for right in (-step, step):
            s, t = np.meshgrid(center + right, center + down)
            point = s[..., None] * axis[..., 0, :] + t[..., None] * axis[..., 1, :] + axis[..., 2, :]
            length = np.linalg.norm(point, axis=-1, keepdims=True)
            direction.append((point / length).reshape(-1, 3))
            area.append((point / length**4 / size**2).reshape(-1, 3))
    return np.stack(direction), np.stack(area)


@partial(jit, static_argnames=("keep",))
def compress(
    seen: UInt8[Array, "b d"],
    frame: Float[Array, "b 3 3"],
    brdf: SeparableBrdf,
    *,
    keep: int,
) -> tuple[Shaped[Array, "k b r"], Float[Array, "k b r l"]]:
    """Projects one block of vertices and keeps the largest coefficients: one block of a `SparseTransport`.

    Vertices are processed one by one, so that intermediate arrays stay in a core's cache and blocks can run in
    parallel.
    """

    def one(argument):
        visible, axes = argument
        index, value = sparse.largest(project(visible[None], axes[None], brdf), keep=keep)
        return index[:, 0], value[:, 0]

    index, value = jax.lax.map(one, (seen, frame))
    return index.swapaxes(0, 1), value.swapaxes(0, 1)


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Job that computes blocks of transport; see `blocks.Job`."""

    brdf: SeparableBrdf
    keep: int

    @property
    def header(self) -> Mapping[str, Any]:
        return self.made_by("separable", sparse.ALGORITHM, maps=self.brdf.coordinates.__name__, keep=self.keep)

    @property
    def near(self) -> Mapping[str, list[float]]:
        return {**super().near, "brdf": sketch(self.brdf.light_map)}

    @property
    def layout(self) -> Mapping[str, Layout]:
        terms, _, _, colors = self.brdf.light_map.shape
        index = "uint16" if 6 * self.size**2 <= 1 << 16 else "uint32"
        return {
            "index": Layout((self.keep, visibility.rays.BLOCK, terms), 1, index),
            "value": Layout((self.keep, visibility.rays.BLOCK, terms, colors), 1, "float32"),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        seen, count = self.seen(block)
        index, value = compress(seen, self.frame[self.part(block)], self.brdf, keep=self.keep)
        return {"index": np.asarray(index), "value": np.asarray(value)}, count.rays
