"""Transport as clustered principal components: a few dense products per cluster of vertices instead of sparse sums.

Vertices that lie and face alike have transport alike. In each cluster the matrices of its vertices, all terms
together, are combinations of a few; only these meet the light. So the cost of a term falls from `keep` sparse
coefficients a vertex to as many numbers as there are vectors, and thirty-two to a hundred terms become affordable.
"""

import os
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int, UInt, UInt8

from jaxprt.brdf.separable import SeparableBrdf
from jaxprt.files.arrays import Layout
from jaxprt.linalg import clustering
from jaxprt.sphere import haar
from jaxprt.transport import blocks, separable
from jaxprt.transport.direct import DirectTransport

_SPECTRUM = 0.4  # rms of natural light grows with the area of a Haar function to about this power
_SAMPLE = 24  # vertices of a cluster that choose its coefficients


class ClusteredTransport(eqx.Module):
    """Principal components of the transport of each cluster of vertices.

    Rows are vertices in the order of the clusters, the last of a smaller cluster repeated: `ordered` takes what was
    computed by row to the order of the vertices.

    Attributes:
        index: Numbers of the coefficients among the 6 n n that each cluster keeps, the most important first.
        basis: Its n vectors on those coefficients, the leading first, times its terms.
        weight: What each vertex takes of each vector.
        position: Positions of the rows in world units.
        frame: Their tangents, bitangents and normals.
        vertex: Vertex of each row.
        place: Row of each vertex.
        rms: Root mean square over vertices and terms of each coefficient as kept.
    """

    index: UInt[Array, "p k"]
    basis: Float16[Array, "p k n r"]
    weight: Float[Array, "p m n"]
    position: Float[Array, "q 3"]
    frame: Float[Array, "q 3 3"]
    vertex: Int[Array, " q"]
    place: Int[Array, " v"]
    rms: Float[Array, " b"]

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.basis.shape[3]

    @property
    def nbytes(self) -> int:
        """Bytes of bases and weights."""
        return self.index.nbytes + self.basis.nbytes + self.weight.nbytes

    def keep(
        self, count: int | None = None, *, vectors: int | None = None, terms: int | None = None
    ) -> "ClusteredTransport":
        """The first `count` coefficients, vectors and terms (all of them if None)."""
        for name, value, most in zip(
            ("count", "vectors", "terms"), (count, vectors, terms), self.basis.shape[1:], strict=True
        ):
            if value is not None and not 1 <= value <= most:
                raise ValueError(f"{name} must be between 1 and {most}, got {value}")
        index, basis, weight = (
            self.index[:, :count],
            self.basis[:, :count, :vectors, :terms],
            self.weight[:, :, :vectors],
        )
        rms = _rms(index, basis, weight, size=self.rms.shape[0])
        return ClusteredTransport(index, basis, weight, self.position, self.frame, self.vertex, self.place, rms)

    @jax.jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "q r c"]:
        """Transport times light coefficients, by row: each cluster's vectors meet the light once.

        Args:
            coefficient: Coefficients of the light.

        Returns:
            The light-modulated tuple of Wang et al., in the light's units.
        """
        _, kept, vectors, terms = self.basis.shape
        light = coefficient[self.index.astype(jnp.int32)]
        dtype = light.dtype

        def one(argument):
            basis, weight, light = argument
            vector = basis.reshape(kept, vectors * terms).astype(dtype).T @ light
            return weight.astype(dtype) @ vector.reshape(vectors, -1)

        return jax.lax.map(one, (self.basis, self.weight, light)).reshape(len(self.position), terms, -1)

    def ordered(self, value: Float[Array, "q *c"]) -> Float[Array, "v *c"]:
        """What was computed by row, in the order of the vertices."""
        return value[self.place]


def precompute(
    direct: DirectTransport,
    brdf: SeparableBrdf,
    *,
    clusters: int = 160,
    vectors: int = 16,
    keep: int = 512,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> ClusteredTransport:
    """Compresses the transport of a mesh, cluster by cluster; no more than a cluster is ever held uncompressed.

    Vertices are clustered by position and normal. What is least is the squared error under light whose spectrum falls
    like that of natural light, summed over the cluster's vertices and all terms.

    Args:
        direct: Visibility of the vertices.
        brdf: Their factored BRDF, with light maps that all colors share, as `jaxprt.brdf.separable.factor` makes them.
        clusters: Number of clusters; a few hundred vertices in each pay best.
        vectors: Principal components per cluster.
        keep: Wavelet coefficients kept per cluster.
        path: Folder that keeps finished clusters; a call that was stopped, or killed, goes on from there.
        executor: Where clusters are computed; this machine's cores if None.
        progress: Whether to show a progress bar.

    Returns:
        The compressed transport of every vertex.

    Raises:
        TypeError: The BRDF is not factored.
        ValueError: Light maps per color, more clusters than vertices, more vectors than vertices in a cluster, more
            coefficients than there are, or a store at `path` made from something else.
        BlockingIOError: The store is being written by another process.
        RuntimeError: A worker of the executor died.

    Reference: Sloan, Hall, Hart, Snyder 2003, for the principal components of clusters.
    """
    if not isinstance(brdf, SeparableBrdf):
        raise TypeError(f"brdf must be factored, by jaxprt.brdf.separable.factor, got {type(brdf).__name__}")
    if brdf.light_map.shape[-1] != 1:
        raise ValueError(f"light maps must be shared by all colors, got {brdf.light_map.shape[-1]} channels")
    member = cluster(direct, clusters=clusters)
    if not 1 <= vectors <= member.shape[1]:
        raise ValueError(f"vectors must be between 1 and the {member.shape[1]} vertices of a cluster, got {vectors}")
    if not 1 <= keep <= direct.level.shape[0]:
        raise ValueError(f"keep must be between 1 and {direct.level.shape[0]}, got {keep}")
    job = _Job(jax.tree.map(np.asarray, direct), jax.tree.map(np.asarray, brdf), member, vectors, keep)
    result = blocks.compute(job, path=path, executor=executor, progress=progress, label="compress")
    index, weight = jnp.asarray(result["index"]), jnp.asarray(result["weight"]).reshape(*member.shape, vectors)
    basis = jnp.asarray(result["basis"]).reshape(clusters, keep, vectors, brdf.terms)
    row = member.ravel()
    place = np.zeros(len(direct.position), np.int32)
    place[row] = np.arange(row.size)
    rms = _rms(index, basis, weight, size=direct.level.shape[0])
    return ClusteredTransport(
        index,
        basis,
        weight,
        direct.position[row],
        direct.frame[row],
        jnp.asarray(row, jnp.int32),
        jnp.asarray(place),
        rms,
    )


def cluster(direct: DirectTransport, *, clusters: int) -> Int[np.ndarray, "p m"]:
    """Vertices of each cluster, alike in position and normal, by `jaxprt.linalg.clustering.bisect`."""
    position, normal = np.asarray(direct.position, np.float64), np.asarray(direct.frame[:, 2], np.float64)
    spread = [np.sqrt(np.mean((x - x.mean(0)) ** 2)) or 1.0 for x in (position, normal)]
    point = np.concatenate([(position - position.mean(0)) / spread[0], normal / spread[1]], 1)
    return clustering.bisect(point, clusters=clusters)


@partial(jax.jit, static_argnames=("vectors", "keep"))
def compress(
    seen: UInt8[Array, "m d"], frame: Float[Array, "m 3 3"], brdf: SeparableBrdf, *, vectors: int, keep: int
) -> tuple[UInt[Array, " k"], Float16[Array, "k n r"], Float[Array, "m n"], Float[Array, " m"]]:
    """Principal components of one cluster.

    Args:
        seen: Visibility of each cubemap texel in sixteenths.
        frame: Rows are tangent, bitangent, normal.
        brdf: The factored BRDF, of which only the light maps matter.
        vectors: How many components.
        keep: How many coefficients.

    Returns:
        Numbers of the coefficients; the components on them, scaled to a largest entry of 1 so that half precision
        holds them; weights; and the squared error that remains, under light of natural spectrum, relative to the
        whole, after 0, 1, ... components.
    """
    size = haar.face_edge(seen.shape[1])
    importance = jnp.tile(haar.area(size=size).ravel(), 6) ** _SPECTRUM

    def transport(argument):
        visible, axes = argument
        return separable.project(visible[None], axes[None], brdf)[0, ..., 0]

    stride = max(1, len(seen) // _SAMPLE)
    sample = jax.lax.map(lambda a: jnp.sum(transport(a) ** 2, 1), (seen[::stride], frame[::stride]))
    _, index = jax.lax.top_k(jnp.sqrt(jnp.sum(sample, 0)) * importance, keep)
    kept = jax.lax.map(lambda a: transport(a)[index], (seen, frame))
    weighted = (kept * importance[index, None]).reshape(len(seen), -1)
    value, vector = jnp.linalg.eigh(weighted @ weighted.T)
    value, vector = jnp.maximum(value[::-1], 0), vector[:, ::-1][:, :vectors]
    basis = jnp.einsum("mn,mkr->knr", vector, kept)
    scale = jnp.max(jnp.abs(basis), (0, 2))
    scale = jnp.where(scale > 0, scale, 1)
    total = jnp.sum(value)
    remainder = jnp.maximum(total - jnp.cumsum(value) + value, 0) / jnp.where(total > 0, total, 1)
    small = jnp.uint16 if seen.shape[1] <= 1 << 16 else jnp.uint32
    return index.astype(small), (basis / scale[:, None]).astype(jnp.float16), vector * scale, remainder


@partial(jax.jit, static_argnames=("size",))
def _rms(index: Array, basis: Array, weight: Array, *, size: int) -> Array:
    energy = jnp.einsum("pmn,pmo->pno", weight, weight)
    total = jax.lax.map(
        lambda a: jnp.einsum("knr,no,kor->k", a[0].astype(a[1].dtype), a[1], a[0].astype(a[1].dtype)), (basis, energy)
    )
    count = weight.shape[0] * weight.shape[1] * basis.shape[3]
    return jnp.sqrt(jnp.zeros(size, total.dtype).at[index.astype(jnp.int32)].add(jnp.maximum(total, 0)) / count)


@dataclass(frozen=True)
class _Job(blocks.Job):
    """Clusters as blocks; see `blocks.Job`."""

    direct: DirectTransport
    brdf: SeparableBrdf
    member: np.ndarray
    vectors: int
    count: int

    @property
    def header(self) -> Mapping[str, Any]:
        brdf = f"{self.brdf.coordinates.__name__} {blocks.fingerprint(self.brdf.light_map)}"
        direct = blocks.fingerprint(self.direct.level, self.direct.frame, self.member)
        return {"system": "clustered", "direct": direct, "brdf": brdf, "vectors": self.vectors, "keep": self.count}

    @property
    def layout(self) -> Mapping[str, Layout]:
        return {
            "weight": Layout((self.step, self.vectors), 0, "float32"),
            "index": Layout((1, self.count), 0, "uint16" if self.direct.level.shape[0] <= 1 << 16 else "uint32"),
            "basis": Layout((1, self.count, self.vectors, self.brdf.terms), 0, "float16"),
        }

    @property
    def vertices(self) -> int:
        return self.member.size

    @property
    def step(self) -> int:
        return self.member.shape[1]

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        member = self.member[block]
        frame = self.direct.frame[member]
        index, basis, weight, _ = compress(
            self.direct.seen(member), frame, self.brdf, vectors=self.vectors, keep=self.count
        )
        return {"weight": np.asarray(weight), "index": np.asarray(index)[None], "basis": np.asarray(basis)[None]}, 0
