"""Sparse transport: Haar coefficients of visibility x cosine x light map, per vertex and BRDF term.

The largest coefficients of each vertex and term are stored, padded to rows of equal length.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped, UInt, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit, linear, total
from jaxprt.files.arrays import Header, Layout, sketch
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.systems.separable.factorization import SeparableBrdf, mark_of
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "separable": 1}
# Chunks for each wavelet coefficient, on average: fewer means more padding, more means more scattered sums.
_CHUNKS = 4


class Transpose(eqx.Module):
    """Kept coefficients sorted by index. Each of n chunks holds up to w coefficients with the same index.

    Attributes:
        row: Vertex and term of each coefficient, as vertex x terms + term; 0 in padding.
        value: Value of each coefficient; 0 in padding.
        number: Index that the coefficients of each chunk have in common, in increasing order.
    """

    row: Int[Array, "w n"]
    value: Float[Array, "w n l"]
    number: Int[Array, " n"]


class SparseTransport(eqx.Module):
    """The k largest wavelet coefficients of the transport of each vertex v and BRDF term r, largest first.

    Attributes:
        index: Index of each kept coefficient, of the 6 n n of the light; 0 in padding.
        value: Value of each kept coefficient; 0 in padding. The last axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        rms: Root mean square of the kept transport over vertices and terms, for each wavelet coefficient.
        transpose: The coefficients sorted by index, for fast gradients with respect to the light; from
            `with_transpose`.
        mark: Samples of the BRDF's light factors, by which relighting refuses another BRDF; None if unknown.
    """

    index: UInt[Array, "k v r"]
    value: Float[Array, "k v r l"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    transpose: Transpose | None = None
    mark: Float[Array, "r m"] | None = None

    def truncate(self, count: int, *, terms: int | None = None) -> "SparseTransport":
        """The transport with the `count` largest coefficients and the first `terms` terms (None: all)."""
        require.count("count", count, least=1, most=self.index.shape[0])
        require.count("terms", self.terms if terms is None else terms, least=1, most=self.terms)
        index, value = self.index[:count, :, :terms], self.value[:count, :, :terms]
        mark = None if self.mark is None else self.mark[:terms]
        size = rms(index, value, self.rms.shape[0])
        return SparseTransport(index, value, self.position, self.frame, size, mark=mark)

    def with_transpose(self) -> "SparseTransport":
        """Adds a transposed copy of the coefficients, which makes gradients with respect to the light faster.

        With it, such a gradient takes about as long as `apply`; without it, several times as long. The copy takes 8
        bytes per coefficient (16 in color) and padding. Derivatives with respect to the transport's values do not use
        it. `truncate` drops it.
        """
        # Sorted by row, so that values read together are contiguous in memory.
        rows, colors = self.index[0].size, self.value.shape[3]
        value = np.asarray(self.value).reshape(-1, rows, colors).swapaxes(0, 1)
        nonzero = np.any(value != 0, -1)
        number = np.asarray(self.index).reshape(-1, rows).T[nonzero]
        order = np.argsort(number, kind="stable")
        count = np.bincount(number, minlength=len(self.rms))
        length = max(1, len(number) // (_CHUNKS * max(1, np.count_nonzero(count))))
        chunks = -(-count // length)
        first = np.repeat((chunks * length).cumsum() - chunks * length, count)
        place = first + np.arange(len(number)) - np.repeat(count.cumsum() - count, count)
        chunk = np.repeat(np.arange(len(count)), chunks)
        padded = np.zeros((len(chunk) * length, colors), value.dtype)
        row = np.zeros(len(padded), np.int32)
        padded[place], row[place] = value[nonzero][order], np.nonzero(nonzero)[0][order]
        row, padded = row.reshape(-1, length).T, padded.reshape(-1, length, colors).swapaxes(0, 1)
        transpose = Transpose(jnp.asarray(row), jnp.asarray(padded), jnp.asarray(chunk, jnp.int32))
        return eqx.tree_at(lambda x: x.transpose, self, transpose, is_leaf=lambda x: x is None)

    @jit
    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r _"]:
        """Multiplies the transport by the light: a sum over the kept coefficients of each vertex, term and color.

        Args:
            coefficient: Haar coefficients of the light, from `jaxprt.separable.system.project`.

        Returns:
            The light-modulated tuple of Wang et al., in units of radiance.
        """
        require.length("the light's coefficients", coefficient, self.rms.shape[0])
        colors = max(coefficient.shape[1], self.value.shape[3])
        coefficient = jnp.broadcast_to(coefficient, (len(coefficient), colors))
        if self.transpose is None:
            return _gather((self, None), coefficient)
        return linear(_gather, _scatter, (dataclasses.replace(self, transpose=None), self.transpose), coefficient)

    @property
    def terms(self) -> int:
        """Number of BRDF terms r."""
        return self.index.shape[2]

    @property
    def nbytes(self) -> int:
        """Bytes of indices and values, and of the transpose if there is one."""
        return self.index.nbytes + self.value.nbytes + sum(array.nbytes for array in jax.tree.leaves(self.transpose))


def _gather(fixed: tuple[SparseTransport, Transpose | None], coefficient: Array) -> Array:
    """`apply`. The axis of kept coefficients comes first, so that each step reads contiguous rows of all vertices."""
    transport, _ = fixed
    keep, vertices, terms = transport.index.shape
    rows = transport.index.reshape(keep, -1), transport.value.reshape(keep, vertices * terms, -1)
    return _accumulate(*rows, coefficient).reshape(vertices, terms, -1)


def _scatter(fixed: tuple[SparseTransport, Transpose], cotangent: Array) -> Array:
    transport, transpose = fixed
    chunk = _accumulate(transpose.row, transpose.value, cotangent.reshape(-1, cotangent.shape[-1]))
    start = jnp.zeros((len(transport.rms), chunk.shape[1]), chunk.dtype)
    return start.at[transpose.number].add(chunk, indices_are_sorted=True)


def _accumulate(index: Shaped[Array, "k n"], value: Float[Array, "k n l"], table: Float[Array, "m c"]) -> Array:
    """Sums, along the first axis, of values times the table rows that `index` names."""
    # Gray values are broadcast by hand: with a trailing axis of 1, XLA's CPU code for the loop takes twice as long.
    gray = value.shape[-1] == 1
    value = value[..., 0] if gray else value

    def term(row):
        number, weight = row
        read = table.at[number.astype(jnp.int32)].get(mode="promise_in_bounds")
        return (weight[:, None] if gray else weight) * read

    return total(term, (index, value), together=4)


@partial(jit, static_argnames=("keep",))
def largest(
    coefficient: Float[Array, "b d r l"], *, keep: int
) -> tuple[Shaped[Array, "k b r"], Float[Array, "k b r l"]]:
    """The `keep` coefficients of largest magnitude of each row, largest first. Colors are chosen together.

    The basis is orthonormal, so this is the best L2 approximation with `keep` coefficients. Among equal magnitudes the
    lower index comes first. Coefficients of zero become padding.

    Args:
        coefficient: Coefficients d of each vertex b and term r, per color l.
        keep: Number of coefficients to keep.

    Returns:
        Indices along d, as uint16 if they fit and else uint32, and values.
    """
    count = coefficient.shape[1]
    if not 1 <= keep <= count:
        raise ValueError(f"keep must be between 1 and {count}, got {keep}")
    rows = coefficient.swapaxes(1, 2)
    size = jnp.abs(rows[..., 0]) if rows.shape[-1] == 1 else jnp.linalg.norm(rows, axis=-1)
    _, index = jax.lax.top_k(size, keep)
    value = jnp.take_along_axis(rows, index[..., None], 2)
    index = jnp.where(jnp.any(value != 0, -1), index, 0)
    small = jnp.uint16 if count <= 1 << 16 else jnp.uint32
    return jnp.moveaxis(index, 2, 0).astype(small), jnp.moveaxis(value, 2, 0)


def rms(index: Array | np.ndarray, value: Array | np.ndarray, size: int) -> Array:
    """Root mean square over vertices, terms and colors of each of `size` coefficients; those not kept count as zero."""
    total = np.zeros(size)
    for number, row in zip(np.asarray(index), np.asarray(value), strict=True):
        total += np.bincount(number.ravel(), np.mean(row**2, -1).ravel(), size)
    return jnp.asarray(np.sqrt(total / max(1, np.prod(index.shape[1:]))), jnp.result_type(float))


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    brdf: SeparableBrdf,
    *,
    keep: int = 96,
    size: int = 64,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    run: Run = Run(),
) -> SparseTransport:
    """Precomputes the transport of a mesh with self-shadowing, for a factored BRDF.

    Args:
        mesh: The mesh to light.
        brdf: Factored BRDF of the mesh, from `jaxprt.separable.factor`.
        keep: Number of wavelet coefficients kept per vertex and term.
        size: Edge of the light's cubemap faces in texels; a power of two.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

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
    result = visibility.blocks.compute(job, run)
    share = rms(result["index"], result["value"], 6 * size * size)
    index, value = jax.device_put(result["index"]), jax.device_put(result["value"])
    position, frame = visibility.rays.place(mesh, vertex), jax.device_put(job.frame)
    return SparseTransport(index, value, position, frame, share, mark=jax.device_put(mark_of(brdf.light_map)))


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
        index, value = largest(project(visible[None], axes[None], brdf), keep=keep)
        return index[:, 0], value[:, 0]

    index, value = jax.lax.map(one, (seen, frame))
    return index.swapaxes(0, 1), value.swapaxes(0, 1)


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Job that computes blocks of transport; see `blocks.Job`."""

    brdf: SeparableBrdf
    keep: int

    @property
    def header(self) -> Header:
        return self.made_by("separable", ALGORITHM, maps=self.brdf.coordinates.__name__, keep=self.keep)

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
