"""Transport as clustered principal components: a few dense products per cluster of vertices instead of sparse sums.

Vertices with similar positions and normals have similar transport. The transport of a cluster is a matrix with one row
per vertex and term and one column per wavelet coefficient of the light. It is compressed twice: each vertex is a
weighted sum of a few principal components, and the components depend on the light through a few linear combinations of
its coefficients, called modes. A change of light evaluates the modes once per cluster. Each term then costs one number
per component and vertex, instead of `keep` sparse coefficients.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int, UInt, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit, linear, mapped
from jaxprt.decompose import eigen
from jaxprt.files.arrays import Header, Layout, Reference, reference, sketch
from jaxprt.sphere import haar
from jaxprt.systems.separable import sparse
from jaxprt.systems.separable.factorization import SeparableBrdf, mark_of
from jaxprt.visibility import StoredVisibility, members
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "clustered": 1}
SPECTRUM = 0.4  # The rms coefficient of natural light is about the area of its Haar function to this power.
_COMPONENTS, _MODES, _KEEP = 16, 128, 1024  # defaults per cluster
_SAMPLE = 24  # number of vertices of a cluster by which its coefficients are chosen


class ClusteredTransport(eqx.Module):
    """Principal components of the transport of each cluster of vertices.

    Weights are stored by row. Rows are the vertices in the order of their clusters; smaller clusters are padded by
    repeating their last vertex. All else, and the result of `apply`, is in the order of the vertices.

    Attributes:
        index: Indices of the k wavelet coefficients that each cluster p keeps, of the 6 n n of the light, the most
            important first.
        mode: Values of the l modes of each cluster on these coefficients, the leading mode first.
        core: Value of each mode for each of n components and each BRDF term r.
        weight: Weight of each component for each of the m vertices of a cluster.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        vertex: Vertex of each row.
        place: Row of each vertex.
        rms: Root mean square of the compressed transport over rows and terms, for each wavelet coefficient.
        mark: Samples of the BRDF's light factors, by which relighting refuses another BRDF; None if unknown.
    """

    index: UInt[Array, "p k"]
    mode: Float16[Array, "p k l"]
    core: Float16[Array, "p l n r"]
    weight: Float[Array, "p m n"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    vertex: Int[Array, " q"]
    place: Int[Array, " v"]
    rms: Float[Array, " b"]
    mark: Float[Array, "r z"] | None = None

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.core.shape[3]

    @property
    def nbytes(self) -> int:
        """Bytes of modes, cores and weights."""
        return self.index.nbytes + self.mode.nbytes + self.core.nbytes + self.weight.nbytes

    def truncate(
        self,
        count: int | None = None,
        *,
        modes: int | None = None,
        components: int | None = None,
        terms: int | None = None,
    ) -> "ClusteredTransport":
        """The transport with the first `count` coefficients, and the first modes, components and terms (None: all)."""
        most = (self.index.shape[1], *self.core.shape[1:])
        asked = {"count": count, "modes": modes, "components": components, "terms": terms}
        for (name, value), limit in zip(asked.items(), most, strict=True):
            require.count(name, limit if value is None else value, least=1, most=limit)
        index, mode = self.index[:, :count], self.mode[:, :count, :modes]
        core, weight = self.core[:, :modes, :components, :terms], self.weight[:, :, :components]
        rms = _rms(index, mode, core, weight, size=self.rms.shape[0])
        same = (self.position, self.frame, self.vertex, self.place)
        mark = None if self.mark is None else self.mark[:terms]
        return ClusteredTransport(index, mode, core, weight, *same, rms, mark)

    @jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Multiplies the transport by the light: one product per BRDF term and vertex.

        Args:
            coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.

        Returns:
            The light-modulated tuple of Wang et al., in units of radiance.
        """
        require.length("the light's coefficients", coefficient, self.rms.shape[0])
        return linear(_relit, _transpose, self, coefficient)


def _relit(transport: ClusteredTransport, coefficient: Array) -> Array:
    """`apply`: writes each cluster's rows to its vertices directly; a gather afterwards would double memory traffic."""
    _, modes, components, terms = transport.core.shape
    light = coefficient[transport.index.astype(jnp.int32)]
    dtype = light.dtype
    count, rows = len(transport.place), len(transport.vertex)
    # Padding rows get an index past the end, and writes there are dropped.
    at = jnp.where(_read(transport), transport.vertex, count + jnp.arange(rows)).reshape(len(light), -1)

    def one(argument):
        mode, core, weight, light = argument
        response = light.T @ mode.astype(dtype) @ core.reshape(modes, components * terms).astype(dtype)
        component = jnp.moveaxis(response.reshape(-1, components, terms), 0, 2)
        return weight.astype(dtype) @ component.reshape(components, -1)

    def write(result, at, value):
        return result.at[at].set(value, mode="drop", unique_indices=True)

    start = jnp.zeros((count, terms * coefficient.shape[1]), dtype)
    clusters = (transport.mode, transport.core, transport.weight, light)
    result = jax.lax.platform_dependent(
        (at, clusters),
        cpu=lambda rows: jax.lax.scan(lambda out, row: (write(out, row[0], one(row[1])), None), start, rows)[0],
        default=lambda rows: write(start, rows[0], mapped(one, rows[1])),
    )
    return result.reshape(count, terms, -1)


def _transpose(transport: ClusteredTransport, cotangent: Array) -> Array:
    """Transpose of `_relit`, cluster by cluster. JAX's own would hold all modes and cores in full precision."""
    clusters, modes, components, terms = transport.core.shape
    dtype = cotangent.dtype

    def one(argument):
        mode, core, weight, at, read = argument
        component = (weight.astype(dtype).T @ jnp.where(read, cotangent[at], 0)).reshape(components, terms, -1)
        response = core.reshape(modes, components * terms).astype(dtype) @ component.reshape(components * terms, -1)
        return mode.astype(dtype) @ response

    at = transport.vertex.reshape(clusters, -1)
    read = _read(transport).reshape(*at.shape, 1)
    cotangent = cotangent.reshape(len(cotangent), -1)
    gradient = mapped(one, (transport.mode, transport.core, transport.weight, at, read))
    start = jnp.zeros((len(transport.rms), gradient.shape[2]), dtype)
    return start.at[transport.index.astype(jnp.int32)].add(gradient)


def _read(transport: ClusteredTransport) -> Array:
    """Whether each row is the one that its vertex is read from; padding rows are not."""
    return transport.place[transport.vertex] == jnp.arange(len(transport.vertex))


@require.arguments(**PRECOMPUTE)
def precompute(
    direct: StoredVisibility,
    brdf: SeparableBrdf,
    *,
    clusters: int | None = None,
    member: Int[np.ndarray, "p m"] | None = None,
    components: int | None = None,
    modes: int | None = None,
    keep: int | None = None,
    run: Run = Run(),
) -> ClusteredTransport:
    """Computes and compresses the transport of a mesh. Only one cluster at a time is held uncompressed.

    Vertices are clustered by position and normal. The components minimize the squared error under light with the
    spectrum of natural light, summed over the cluster's vertices and all terms.

    Args:
        direct: Visibility of the vertices, from `jaxprt.visibility.precompute`.
        brdf: Factored BRDF of the vertices, with light maps shared by all colors, from `jaxprt.separable.factor`.
        clusters: Number of clusters that `members.cluster` makes; if None, the number from `members.clusters_for`.
        member: Vertices of each cluster, instead of `clusters`. A cluster may repeat a vertex.
        components: Number of principal components per cluster. If None, 16 or the number of vertices per cluster,
            whichever is smaller.
        modes: Number of modes of the light per cluster. If None, 128 or as many as there are.
        keep: Number of wavelet coefficients of the light per cluster. If None, 1024 or as many as there are.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        The compressed transport of every vertex.

    Raises:
        TypeError: The BRDF is not a `SeparableBrdf`.
        ValueError: The light maps have colors, a number is out of range, `member` does not name all vertices, or the
            folder holds results of other inputs.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.

    Reference: Sloan, Hall, Hart, Snyder 2003, for clustered principal components.
    """
    if not isinstance(brdf, SeparableBrdf):
        raise TypeError(f"brdf must be factored, by jaxprt.separable.factor, got {type(brdf).__name__}")
    if brdf.light_map.shape[-1] != 1:
        raise ValueError(
            f"light maps must have one channel that all colors share, got {brdf.light_map.shape[-1]} channels"
        )
    if member is None:
        count = members.clusters_for(len(direct.position)) if clusters is None else clusters
        member = members.cluster(direct.position, direct.frame[:, 2], clusters=count)
    missing = np.setdiff1d(np.arange(len(direct.position)), member).size
    if missing or member.min() < 0 or member.max() >= len(direct.position):
        raise ValueError(
            f"member must hold the indices of all {len(direct.position)} vertices and no others, got {missing} missing "
            f"and indices from {member.min()} to {member.max()}"
        )
    components = min(_COMPONENTS, member.shape[1]) if components is None else components
    keep = min(_KEEP, direct.texels) if keep is None else keep
    modes = min(_MODES, keep, components * brdf.terms) if modes is None else modes
    if not 1 <= components <= member.shape[1]:
        raise ValueError(
            f"components must be between 1 and the {member.shape[1]} vertices of a cluster, got {components}"
        )
    if not 1 <= keep <= direct.texels:
        raise ValueError(f"keep must be between 1 and {direct.texels}, got {keep}")
    if not 1 <= modes <= min(keep, components * brdf.terms):
        most = min(keep, components * brdf.terms)
        raise ValueError(f"modes must be between 1 and the smaller of keep and components x terms, {most}, got {modes}")
    job = _Job(jax.tree.map(np.asarray, direct), jax.tree.map(np.asarray, brdf), member, components, modes, keep)
    result = visibility.blocks.compute(job, run, label="compress")
    index, mode, core = (jax.device_put(result[name]) for name in ("index", "mode", "core"))
    weight = jax.device_put(result["weight"]).reshape(*member.shape, components)
    row, place = member.ravel(), members.places(member)
    rms = _rms(index, mode, core, weight, size=direct.texels)
    same = (direct.position, direct.frame, jax.device_put(row.astype(np.int32)), jax.device_put(place))
    return ClusteredTransport(index, mode, core, weight, *same, rms, jax.device_put(mark_of(brdf.light_map)))


@partial(jit, static_argnames=("components", "modes", "keep"))
def compress(
    seen: UInt8[Array, "m d"],
    frame: Float[Array, "m 3 3"],
    brdf: SeparableBrdf,
    *,
    components: int,
    modes: int,
    keep: int,
) -> tuple[UInt[Array, " k"], Float16[Array, "k l"], Float16[Array, "l n r"], Float[Array, "m n"], Array, Array]:
    """Compresses the transport of one cluster: principal components over its vertices, then over the light.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        brdf: The factored BRDF. Only its light maps are used.
        components: Number of principal components over the vertices.
        modes: Number of modes of the light.
        keep: Number of wavelet coefficients.

    Returns:
        Indices of the coefficients; modes and cores, scaled to a largest entry of 1 to fit half precision; weights; and
        two lists of squared errors relative to the squared norm, under light of natural spectrum: after 0, 1, ...
        components, and after all components and 0, 1, ... modes.
    """
    size = haar.face_edge(seen.shape[1])
    importance = jnp.tile(haar.area(size=size).ravel(), 6) ** SPECTRUM

    def transport(argument):
        visible, axes = argument
        return sparse.project(visible[None], axes[None], brdf)[0, ..., 0]

    stride = max(1, len(seen) // _SAMPLE)
    sample = jax.lax.map(lambda a: jnp.sum(transport(a) ** 2, 1), (seen[::stride], frame[::stride]))
    _, index = jax.lax.top_k(jnp.sqrt(jnp.sum(sample, 0)) * importance, keep)
    importance = importance[index, None]
    matrix = jax.lax.map(lambda a: transport(a)[index] * importance, (seen, frame)).reshape(len(seen), -1)
    value, vector = jnp.linalg.eigh(matrix @ matrix.T)
    value, vector = jnp.maximum(value[::-1], 0), vector[:, ::-1][:, :components]
    basis = jnp.moveaxis((vector.T @ matrix).reshape(components, keep, -1), 0, 1).reshape(keep, -1)
    strength, mode, _ = eigen.left_singular(basis, terms=modes)
    core = mode.T @ basis
    mode = mode / importance
    # The scale of each mode moves to its core, and the scale of each core to the weights.
    scale = _largest(mode, 0)
    mode, core = mode / scale, (core * scale[:, None]).reshape(modes, components, -1)
    scale = _largest(core, (0, 2))
    core, weight = core / scale[:, None], vector * scale
    small = jnp.uint16 if seen.shape[1] <= 1 << 16 else jnp.uint32
    total = jnp.sum(value)
    half = (mode.astype(jnp.float16), core.astype(jnp.float16))
    return index.astype(small), *half, weight, _remainder(value, total), _remainder(strength, total)


def _largest(array: Array, axis) -> Array:
    size = jnp.max(jnp.abs(array), axis)
    return jnp.where(size > 0, size, 1)


def _remainder(value: Array, total: Array) -> Array:
    """Share of the squared norm that remains after the first 0, 1, 2, ... values."""
    left = jnp.maximum(total - jnp.cumsum(value), 0)
    return jnp.concatenate([total[None], left]) / jnp.where(total > 0, total, 1)


@partial(jit, static_argnames=("size",))
def _rms(index: Array, mode: Array, core: Array, weight: Array, *, size: int) -> Array:
    def energy(argument):
        dtype = argument[2].dtype
        mode, core, weight = (array.astype(dtype) for array in argument)
        along = jnp.einsum("lnr,no,jor->lj", core, weight.T @ weight, core)
        return jnp.sum((mode @ along) * mode, 1)

    total = jnp.maximum(jax.lax.map(energy, (mode, core, weight)), 0)
    count = weight.shape[0] * weight.shape[1] * core.shape[3]
    return jnp.sqrt(jnp.zeros(size, total.dtype).at[index.astype(jnp.int32)].add(total) / count)


def _is_reference(value: object) -> bool:
    return isinstance(value, Reference)


@dataclass(frozen=True)
class _Job(members.ClusterJob):
    """Job that computes the transport of each cluster; see `blocks.Job`."""

    direct: StoredVisibility
    brdf: SeparableBrdf
    member: np.ndarray
    components: int
    modes: int
    count: int

    def __getstate__(self) -> dict[str, object]:
        """State for pickling. Memory-mapped visibility is pickled as the name of its file."""
        level = reference(self.direct.level)  # pyright: ignore[reportArgumentType]
        return {**vars(self), "direct": eqx.tree_at(lambda stored: stored.level, self.direct, level)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores the state. Memory-mapped visibility is mapped again."""
        direct = state["direct"]
        if isinstance(direct.level, Reference):
            direct = eqx.tree_at(lambda stored: stored.level, direct, direct.level.open(), is_leaf=_is_reference)
        vars(self).update(state, direct=direct)

    @property
    def header(self) -> Header:
        return {
            "system": "clustered",
            "algorithm": ALGORITHM,
            "member": visibility.blocks.fingerprint(np.asarray(self.member, np.int64)),
            "maps": self.brdf.coordinates.__name__,
            **self._shape,
        }

    @property
    def near(self) -> Mapping[str, list[float]]:
        vertices = {"position": self.direct.position, "frame": self.direct.frame}
        near = {name: sketch(array, tolerance=visibility.rays.ROUNDING) for name, array in vertices.items()}
        return {**near, "direct": sketch(self.direct.level), "brdf": sketch(self.brdf.light_map)}

    @property
    def layout(self) -> Mapping[str, Layout]:
        return {
            "weight": Layout((self.step, self.components), 0, "float32"),
            "index": Layout((1, self.count), 0, "uint16" if self.direct.texels <= 1 << 16 else "uint32"),
            "mode": Layout((1, self.count, self.modes), 0, "float16"),
            "core": Layout((1, self.modes, self.components, self.brdf.terms), 0, "float16"),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        member = self.member[block]
        index, mode, core, weight, _, _ = compress(
            self.direct.seen(member), self.direct.frame[member], self.brdf, **self._shape
        )
        cluster = {"index": index, "mode": mode, "core": core}
        return {"weight": np.asarray(weight), **{name: np.asarray(x)[None] for name, x in cluster.items()}}, 0

    @property
    def _shape(self) -> Mapping[str, int]:
        return {"components": self.components, "modes": self.modes, "keep": self.count}
