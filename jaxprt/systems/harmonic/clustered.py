"""Transfer matrices as clustered principal components (Sloan, Hall, Hart, Snyder 2003).

A transfer matrix multiplies light by a vertex's visibility V and rotates the product to the vertex's frame: M =
R(frame) W(V). W is linear in the harmonics of V up to twice the degree. The principal components of a cluster's
matrices, in the world frame, are therefore W of the principal components of its visibilities, in the metric that W
induces. A component takes (2 degree + 1)^2 numbers instead of (degree + 1)^4, and no matrix is formed.

When the light changes, it is multiplied once by every component of every cluster; each vertex then sums a few of these
products. The arriving light stays in the world frame, to which the BRDF's coefficients are rotated.
"""

import os
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit, mapped
from jaxprt.files.arrays import Layout
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import harmonics, products
from jaxprt.systems.harmonic import transfer
from jaxprt.visibility import members
from jaxprt.visibility.arguments import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "harmonic clustered": 1}
_COMPONENTS = 16  # default number per cluster


class ClusteredTransfer(eqx.Module):
    """Transfer matrices of all vertices, as means and principal components of clusters.

    Weights are stored by row. Rows are the vertices in the order of their clusters; smaller clusters are padded by
    repeating their last vertex.

    Attributes:
        mean: SH coefficients of the mean visibility of each cluster p, up to twice the degree, in the world.
        component: SH coefficients of the n principal components of each cluster, the leading one first.
        weight: Weight of each component for each of the m vertices of a cluster.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        place: Row of each vertex.
        left: Squared error of the matrices under light of natural spectrum, summed over the rows of each cluster.
        total: Squared norm of the matrices under the same light, summed over the rows of each cluster.
    """

    mean: Float[Array, "p k"]
    component: Float[Array, "p n k"]
    weight: Float[Array, "p m n"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    place: Int[Array, " v"]
    left: Float[Array, " p"]
    total: Float[Array, " p"]

    @property
    def degree(self) -> int:
        """Highest degree of the matrices."""
        return harmonics.degree_of(self.mean.shape[-1]) // 2

    @property
    def error(self) -> float:
        """Relative L2 error of the compressed matrices of all vertices, under light of natural spectrum."""
        return float(jnp.sqrt(jnp.sum(self.left) / jnp.sum(self.total)))

    @property
    def nbytes(self) -> int:
        """Bytes of means, components and weights."""
        return self.mean.nbytes + self.component.nbytes + self.weight.nbytes

    def visible(self, vertex: Int[Array | np.ndarray, " b"]) -> Float[Array, "k b"]:
        """SH coefficients of the compressed visibility of the given vertices, in the world."""
        row = self.place[jnp.asarray(vertex)]
        cluster = row // self.weight.shape[1]
        weight = self.weight.reshape(-1, self.weight.shape[2])[row]
        return (self.mean[cluster] + jnp.einsum("bn,bnk->bk", weight, self.component[cluster])).T

    def matrices(self, vertex: Int[Array | np.ndarray, " b"]) -> transfer.TransferMatrix:
        """Transfer matrices of the given vertices, (degree + 1)^4 numbers each."""
        vertex = jnp.asarray(vertex)
        matrix = transfer.from_visibility(self.visible(vertex), self.frame[vertex], degree=self.degree)
        return transfer.TransferMatrix(matrix[:, None], self.position[vertex], self.frame[vertex])

    def truncate(self, *, components: int) -> "ClusteredTransfer":
        """The transfer with the first `components` components of each cluster. The error includes the dropped ones.

        Raises:
            ValueError: `components` is below 1 or above the number of components.
        """
        require.between("components", components, 1, self.component.shape[1])
        kept, rest = self.component[:, :components], self.component[:, components:]
        squared = jnp.einsum("pnk,k->pn", rest**2, jnp.asarray(_metric(self.degree), rest.dtype))
        lost = jnp.sum(squared * jnp.sum(self.weight[..., components:] ** 2, 1), 1)
        weight = self.weight[..., :components]
        return eqx.tree_at(
            lambda each: (each.component, each.weight, each.left), self, (kept, weight, self.left + lost)
        )


@jit
def clustered_light(transport: ClusteredTransfer, light: Float[Array, "lm c"]) -> Float[Array, "lm c v"]:
    """SH coefficients of the light that arrives at every vertex, in the world frame.

    The light is made an operator on visibility, which is applied once to each component.

    Args:
        transport: Clustered transfer.
        light: SH coefficients of the distant light in the world, from `project`.

    Raises:
        ValueError: The light and the transport differ in degree.

    Reference: Sloan, Hall, Hart, Snyder 2003, section 5.
    """
    terms, colors = light.shape
    if harmonics.degree_of(terms) != transport.degree:
        raise ValueError(
            f"the light must have the degree of the transport, {transport.degree}, got {harmonics.degree_of(terms)}"
        )
    node, weight = (jnp.asarray(each, light.dtype) for each in products.quadrature(4 * transport.degree))
    basis = harmonics.evaluate(node, degree=transport.degree)
    seen = harmonics.evaluate(node, degree=2 * transport.degree)
    met = (weight[:, None] * (basis @ light))[:, None] * basis[..., None]
    operator = seen.T @ met.reshape(len(node), -1)

    def arriving(cluster: tuple[Array, Array, Array]) -> Array:
        mean, component, share = cluster
        return mean @ operator + share @ (component @ operator)

    rows = mapped(arriving, (transport.mean, transport.component, transport.weight))
    return jnp.moveaxis(rows.reshape(-1, terms, colors)[transport.place], 0, 2)


@require.arguments(**PRECOMPUTE)
def precompute_clustered(
    mesh: Mesh,
    *,
    degree: int = 4,
    clusters: int | None = None,
    components: int | None = None,
    size: int = 32,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> ClusteredTransfer:
    """Precomputes compressed transfer with self-shadowing. Only one cluster at a time is held uncompressed.

    Vertices are clustered by position and normal. The components minimize the squared error of the transfer matrices
    under light of natural spectrum, summed over the vertices of a cluster.

    Args:
        mesh: The vertices to light.
        degree: Highest degree of the harmonics.
        clusters: Number of clusters; if None, the number from `jaxprt.visibility.members.clusters_for`.
        components: Number of principal components per cluster, beside its mean. If None, 16 or the number of vertices
            per cluster, whichever is smaller.
        size: Edge of the cubemap faces of visibility, in texels.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        path: Folder in which finished clusters are stored. A call that was interrupted continues from there.
        executor: A `concurrent.futures.Executor` that computes the clusters; if None, the cores of this machine.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: The degree or the size is out of range, there are more clusters than vertices or more components
            than vertices in a cluster, positions or normals are not finite, or the folder holds results of other
            inputs.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.

    Reference: Sloan, Hall, Hart, Snyder 2003, "Clustered principal components for precomputed radiance transfer".
    """
    transfer.check(degree, size)
    chosen = visibility.rays.chosen(mesh, vertex)
    count = members.clusters_for(len(chosen)) if clusters is None else clusters
    member = members.cluster(np.asarray(mesh.position)[chosen], np.asarray(mesh.normal)[chosen], clusters=count)
    components = min(_COMPONENTS, member.shape[1]) if components is None else components
    if not 1 <= components <= member.shape[1]:
        raise ValueError(
            f"components must be between 1 and the {member.shape[1]} vertices of a cluster, got {components}"
        )
    job = _Job.make(mesh, occluder, vertex, size, member=member, degree=degree, components=components)
    result = visibility.blocks.compute(job, path=path, executor=executor, progress=progress)
    left, total = (jax.device_put(each) for each in np.asarray(result["error"]).T)
    return ClusteredTransfer(
        jax.device_put(result["mean"]),
        jax.device_put(result["component"]),
        jax.device_put(result["weight"]).reshape(*member.shape, components),
        visibility.rays.place(mesh, vertex),
        jax.device_put(job.frame),
        jax.device_put(members.places(member)),
        left,
        total,
    )


@partial(jit, static_argnames=("degree", "components"))
def compress(
    seen: UInt8[Array, "m d"], frame: Float[Array, "m 3 3"], *, degree: int, components: int
) -> tuple[Float[Array, " k"], Float[Array, "n k"], Float[Array, "m n"], Float[Array, " 2"]]:
    """Mean and principal components of the transfer of one cluster.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        degree: Highest degree of the matrices.
        components: Number of components.

    Returns:
        SH coefficients of the mean visibility; those of the components; weights of the vertices; and two numbers: the
        squared error and the squared norm of the matrices, summed over vertices.
    """
    value = transfer.visible(seen, frame, degree=2 * degree).T
    metric = jnp.asarray(_metric(degree), value.dtype)
    mean = jnp.mean(value, 0)
    offset = value - mean
    scaled = offset * jnp.sqrt(metric)
    _, vector = jnp.linalg.eigh(scaled @ scaled.T)
    weight = vector[:, ::-1][:, :components]
    component = weight.T @ offset
    left = jnp.sum((scaled - weight @ (component * jnp.sqrt(metric))) ** 2)
    return mean, component, weight, jnp.stack([left, jnp.sum(value**2 * metric)])


@lru_cache(maxsize=8)
def _metric(degree: int) -> np.ndarray:
    """Weight of each squared SH coefficient of visibility in the squared norm of its transfer matrix.

    The light is random, with the variances C_l of `harmonics.natural` in band l. The expected square of W(V) L is ∫∫
    V(s) V(t) K(s, t) K_C(s, t) with K = sum_i y_i(s) y_i(t) and K_C = sum_i C_i y_i(s) y_i(t). Both kernels are zonal,
    so their product multiplies each band of V by one factor.
    """
    height, weight = np.polynomial.legendre.leggauss(2 * degree + 1)
    band = np.arange(degree + 1)
    kernel = np.polynomial.legendre.legval(height, (2 * band + 1) / (4 * np.pi))
    natural = np.polynomial.legendre.legval(height, (2 * band + 1) / (4 * np.pi) / (band + 0.5) ** 2)
    factor = 2 * np.pi * (weight * kernel * natural) @ np.polynomial.legendre.legvander(height, 2 * degree)
    return np.repeat(np.maximum(factor, 0), 2 * np.arange(2 * degree + 1) + 1)


@dataclass(frozen=True)
class _Job(members.ClusterJob, visibility.rays.VisibilityJob):
    """Job that computes the transfer of each cluster; see `blocks.Job`."""

    member: np.ndarray
    degree: int
    components: int

    @property
    def header(self) -> Mapping[str, Any]:
        made = visibility.blocks.fingerprint(np.asarray(self.member, np.int64))
        sizes = {"degree": self.degree, "components": self.components}
        return self.made_by("harmonic clustered", ALGORITHM, member=made, **sizes)

    @property
    def layout(self) -> Mapping[str, Layout]:
        terms = (2 * self.degree + 1) ** 2
        return {
            "weight": Layout((self.step, self.components), 0, "float32"),
            "mean": Layout((1, terms), 0, "float32"),
            "component": Layout((1, self.components, terms), 0, "float32"),
            "error": Layout((1, 2), 0, "float32"),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        own = self.member[block]
        seen, count = visibility.fractional(self.rays, self.start[own], self.frame[own, 2], size=self.size)
        made = compress(jnp.asarray(seen), self.frame[own], degree=self.degree, components=self.components)
        mean, component, weight, error = (np.asarray(each) for each in made)
        return {"weight": weight, "mean": mean[None], "component": component[None], "error": error[None]}, count.rays
