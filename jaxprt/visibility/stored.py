"""Stored visibility, for lighting vertices by single texels exactly, with any BRDF.

A sun or a few bright windows would need most of the terms and coefficients of a compressed transport. If their texels
are summed one by one with the BRDF itself, the remaining light is smooth. The transport of other systems can be
computed from stored visibility without tracing rays again.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import require
from jaxprt.files.arrays import Header, Layout
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import haar
from jaxprt.visibility import blocks, rays
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms; a release that changes results raises one of them.
ALGORITHM = {"visibility": rays.ALGORITHM, "direct": 1}
_HALF = rays.BLOCK // 2
_MIDDLE = 8  # four bits hold sixteen of the seventeen levels, so level 9 is stored as 8


class StoredVisibility(eqx.Module):
    """Visibility of every texel from every vertex, in four bits each.

    Attributes:
        level: Blocks of 64 vertices, two vertices to a byte: the first half of a block in the low bits, the second
            half in the high bits. If it comes from a store, on CPUs, it is memory-mapped: only what is read takes
            memory.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
    """

    level: UInt8[Array, "block d w"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]

    @property
    def texels(self) -> int:
        """Number of texels."""
        return self.level.shape[1]

    @property
    def size(self) -> int:
        """Edge of the cubemap's faces in texels."""
        return haar.face_edge(self.texels)

    @property
    def nbytes(self) -> int:
        """Size of the visibility in bytes."""
        return self.level.nbytes

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t v"]:
        """Visible fraction of some texels from each vertex, 0 to 1; 0 below its horizon."""
        level = _unpack(self.level[:, texel]).astype(jnp.result_type(float))
        return level[:, : len(self.position)] / rays.LEVELS

    def seen(self, vertex: Int[np.ndarray, " b"]) -> UInt8[np.ndarray, "b d"]:
        """Visibility of all texels from some vertices, in sixteenths, on the host."""
        block, place = np.divmod(vertex, rays.BLOCK)
        level = np.empty((len(vertex), self.texels), np.uint8)
        held = np.asarray(self.level)
        for number in np.unique(block):  # Whole blocks are contiguous in memory, single vertices are not.
            rows = np.flatnonzero(block == number)
            pair = np.ascontiguousarray(held[number].T)
            level[rows] = np.where(
                place[rows, None] < _HALF, pair[place[rows] % _HALF] & 15, pair[place[rows] % _HALF] >> 4
            )
        level += level > _MIDDLE
        return level


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    *,
    size: int = 64,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    run: Run = Run(),
) -> StoredVisibility:
    """Traces the visibility of every texel from each vertex and stores it.

    It takes 12 kB per vertex at 6 x 64 x 64 texels.

    Args:
        mesh: The mesh whose vertices are lit.
        size: Edge of the light's cubemap faces in texels, a power of two.
        occluder: Geometry that casts shadows: the whole scene, or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        The visibility of every chosen vertex. With a path it is memory-mapped on CPUs: only what is read takes memory.

    Raises:
        ValueError: `size` is not a power of two, positions, normals or tangents are not finite, `vertex` refers to
            missing vertices, or the store at `path` was made from other inputs.
        BlockingIOError: Another process is writing to the store.
        RuntimeError: A worker of the executor died.
    """
    if size < 1 or size & (size - 1):
        raise ValueError(f"size must be a power of two, got {size}")
    job = _Job.make(mesh, occluder, vertex, size)
    result = blocks.compute(job, run, label="visibility")
    position = rays.place(mesh, vertex)
    return StoredVisibility(jax.device_put(result["level"]), position, jax.device_put(job.frame))


def _unpack(pair: UInt8[Array, "g t w"]) -> UInt8[Array, "t v"]:
    """Unpacks levels in sixteenths from two levels per byte."""
    level = jnp.concatenate([pair & 15, pair >> 4], 2).swapaxes(0, 1)
    level = level.reshape(pair.shape[1], pair.shape[0] * rays.BLOCK)
    return level + (level > _MIDDLE)


@dataclass(frozen=True)
class _Job(rays.VisibilityJob):
    """Job that computes blocks of visibility."""

    @property
    def header(self) -> Header:
        return self.made_by("direct", ALGORITHM)

    @property
    def layout(self) -> Mapping[str, Layout]:
        return {"level": Layout((1, 6 * self.size**2, _HALF), 0, "uint8")}

    @property
    def step(self) -> int:
        return rays.BLOCK

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        seen, count = self.seen(block)
        level = (seen - (seen > _MIDDLE)).T
        return {"level": (level[:, :_HALF] | level[:, _HALF:] << 4)[None]}, count.rays
