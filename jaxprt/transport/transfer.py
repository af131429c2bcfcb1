"""Precomputed transfer tensors: what arrives at every vertex after one bounce, for any light and any BRDFs.

    I_x(s) = sum_l L(l) sum_q H(q) T_x(l, q, s)

The light is 6 x 8 x 8 texels l, what arrives 16 harmonics s in world directions, and q counts the functions of all
regions, which `jaxprt.brdf.paths` makes; H are their weights at present. Vertices are clustered, and the tensor of each
cluster is decomposed along vertices and light.
"""

import functools
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int

from jaxprt.brdf.separable import SeparableBrdf
from jaxprt.files.arrays import Layout
from jaxprt.linalg import eigen, tucker
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, harmonics
from jaxprt.transport import blocks, bounce, clustered, visibility

_DEGREE = 3  # of the harmonics that arrive
_MEMBERS = 230  # vertices of a cluster
_SEEN = 4  # visibility has faces so many times as large as the light's


class TransferTensor(eqx.Module):
    """One bounce, by clusters of vertices; `weight` holds the sizes, so that half precision holds the rest.

    Attributes:
        weight: Of the components of its cluster, for each row.
        core: Of each cluster: components, modes of the light, harmonics and functions.
        mode: Modes of the light of each cluster, on its texels.
        place: Row of each vertex.
        error: Relative L2 error of each cluster's tensor that the decomposition makes, a difference of squares: less
            than 5e-4 is rounding.
    """

    weight: Float[Array, "g m n"]
    core: Float16[Array, "g n e s q"]
    mode: Float[Array, "g l e"]
    place: Int[Array, " v"]
    error: Float[Array, " g"]

    @property
    def nbytes(self) -> int:
        """Bytes of the tensor."""
        return self.weight.nbytes + self.core.nbytes + self.mode.nbytes

    def arriving(self, light: Float[Array, "l c"], weight: Float[Array, "q d"]) -> Float[Array, "v s e"]:
        """SH coefficients, in world directions, of the radiance that arrives at each vertex.

        Args:
            light: Mean radiance of the light's texels, from `jaxprt.transport.transfer.coarse`.
            weight: Weights H of all functions, region after region; per color or gray.

        Returns:
            Coefficients per color. Linear in the light and in the weights.
        """
        return _arriving(self, light, weight)


@jax.jit
def _arriving(transfer: TransferTensor, light: Array, weight: Array) -> Array:
    colors = max(light.shape[1], weight.shape[1])
    light = jnp.broadcast_to(light, (len(light), colors))
    weight = jnp.broadcast_to(weight, (len(weight), colors))

    def one(argument):
        rows, core, mode = argument
        met = jnp.einsum("nesq,qc->nesc", core.astype(light.dtype), weight)
        return rows @ jnp.einsum("nesc,ec->nsc", met, mode.T @ light).reshape(rows.shape[1], -1)

    whole = jax.lax.map(one, (transfer.weight, transfer.core, transfer.mode))
    return whole.reshape(-1, transfer.core.shape[3], colors)[transfer.place]


@functools.partial(jax.jit, static_argnames=("edge",))
def coarse(radiance: Float[Array, "6 n n c"], *, edge: int = 8) -> Float[Array, "l c"]:
    """Mean radiance of the texels of coarser faces.

    Raises:
        ValueError: The coarse faces' edge does not divide the light's.
    """
    size = radiance.shape[1]
    if edge < 1 or size % edge:
        raise ValueError(f"the edge of coarse faces must divide the light's {size}, got {edge}")
    fold = size // edge
    area = cubemap.solid_angle(size=size)[..., None]
    value, whole = (x.reshape(6, edge, fold, edge, fold, -1).sum((2, 4)) for x in (radiance * area, area))
    return (value / whole).reshape(6 * edge * edge, -1)


def precompute(
    mesh: Mesh,
    bases: Sequence[SeparableBrdf],
    *,
    components: int = 32,
    modes: int = 64,
    edge: int = 8,
    size: int = 16,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> TransferTensor:
    """Traces one bounce from every vertex, and decomposes what arrives.

    Args:
        mesh: The whole scene, which lights itself.
        bases: Functions of each region, in the order of their numbers, from `jaxprt.brdf.paths.basis`.
        components: Along the vertices of a cluster, or as many as it has.
        modes: Along the light, or as many as it has texels.
        edge: Edge of the light's faces in texels, a power of two.
        size: Edge of the faces through whose texels rays are sent.
        path: Folder that keeps what is finished; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show progress bars.

    Returns:
        The tensor of all vertices. Meanwhile the responses of all of them are held: 24 edge^2 bytes for each vertex and
        light factor of its region.

    Raises:
        ValueError: Not one basis for each region, numbers below 1, or an edge that is no power of two.

    Reference: Sun et al. 2007, sections 3.1 and 4.3.
    """
    region = np.asarray(mesh.region)
    numbers = np.unique(region)
    if len(bases) != len(numbers):
        raise ValueError(f"bases must be one for each of the regions {numbers.tolist()}, got {len(bases)}")
    if min(components, modes, edge, size) < 1 or edge & (edge - 1):
        raise ValueError(
            f"components, modes, edge and size must be at least 1, and edge a power of two, got {components}, {modes}, "
            f"{edge} and {size}"
        )
    if path is not None:
        os.makedirs(path, exist_ok=True)
    options = {"executor": executor, "progress": progress}
    response = []
    for number, basis in zip(numbers.tolist(), bases, strict=True):
        vertex = np.flatnonzero(region == number)
        own = _ResponseJob.make(
            mesh, None, vertex, _SEEN * edge, basis=jax.tree.map(np.asarray, basis), edge=edge, key=_key(basis)
        )
        store = None if path is None else os.path.join(path, f"response_{number}")
        response.append(blocks.compute(own, path=store, label=f"region {number}", **options)["response"])
    normal = np.asarray(mesh.normal)
    clusters = max(1, round(len(region) / _MEMBERS))
    job = _TransferJob.make(
        mesh,
        None,
        None,
        size,
        bases=tuple(jax.tree.map(np.asarray, basis) for basis in bases),
        response=tuple(response),
        region=np.searchsorted(numbers, region),
        member=clustered.cluster(mesh.position, jnp.asarray(normal), clusters=clusters),
        components=components,
        modes=modes,
    )
    store = None if path is None else os.path.join(path, "clusters")
    result = blocks.compute(job, path=store, label="bounce", **options)
    weight = result["weight"].reshape(*job.member.shape, -1)
    arrays = (weight, result["core"], result["mode"], clustered.places(job.member), result["error"])
    return TransferTensor(*map(jnp.asarray, arrays))


@functools.partial(jax.jit, static_argnames=("components", "modes"))
def compress(
    tensor: Float[Array, "m l f"], *, components: int, modes: int
) -> tuple[Float[Array, "m n"], Float16[Array, "n e f"], Float[Array, "l e"], Float[Array, ""]]:
    """Decomposes the tensor of a cluster along vertices and then along the light.

    Args:
        tensor: What arrives at each vertex from each texel, of any kinds f.
        components: Along the vertices.
        modes: Along the light.

    Returns:
        Weights of each vertex, cores scaled to largest entries of 1, modes, and the relative error.
    """
    whole = jnp.vdot(tensor, tensor)
    _, vertex, _ = eigen.symmetric(tucker.gram(tensor, mode=0), terms=components)
    core = tucker.multiply(tensor, vertex, mode=0)
    _, mode, _ = eigen.symmetric(tucker.gram(core, mode=1), terms=modes)
    core = tucker.multiply(core, mode, mode=1)
    left = jnp.maximum(whole - jnp.vdot(core, core), 0)
    size = jnp.max(jnp.abs(core), (1, 2))
    size = jnp.where(size > 0, size, 1)
    error = jnp.sqrt(left / jnp.where(whole > 0, whole, 1))
    return vertex * size, (core / size[:, None, None]).astype(jnp.float16), mode, error


def _key(basis: SeparableBrdf) -> str:
    return f"{basis.coordinates.__name__} {blocks.fingerprint(basis.light_map, basis.view_map)}"


@dataclass(frozen=True)
class _ResponseJob(visibility.VisibilityJob):
    """Blocks of what light factors make of direct light; see `blocks.Job`."""

    basis: SeparableBrdf
    edge: int
    key: str

    @property
    def header(self) -> Mapping[str, Any]:
        return {"system": "response", "mesh": self.mesh_key, "size": self.size, "edge": self.edge, "brdf": self.key}

    @property
    def layout(self) -> Mapping[str, Layout]:
        shape = (visibility.BLOCK, 6 * self.edge**2, self.basis.terms)
        return {"response": Layout(shape, 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        seen, count = self.seen(block)
        frame = jnp.asarray(self.frame[self.part(block)])
        response = bounce.respond(jnp.asarray(seen), frame, self.basis, edge=self.edge)
        return {"response": np.asarray(response)}, count.rays


@dataclass(frozen=True)
class _TransferJob(clustered.ClusterJob, visibility.VisibilityJob):
    """Tensors of what arrives at the vertices of each cluster; see `blocks.Job`."""

    bases: tuple[SeparableBrdf, ...]
    response: tuple[np.ndarray, ...]
    region: np.ndarray
    member: np.ndarray
    components: int
    modes: int

    @property
    def header(self) -> Mapping[str, Any]:
        key = " ".join(_key(basis) for basis in self.bases)
        made = blocks.fingerprint(self.region, self.member)
        edge = math.isqrt(self.response[0].shape[1] // 6)
        same = {"system": "transfer", "mesh": self.mesh_key, "size": self.size, "edge": edge, "brdfs": key}
        return {**same, "made": made, **self._cut}

    @property
    def layout(self) -> Mapping[str, Layout]:
        cut, harmonic = self._cut, (_DEGREE + 1) ** 2
        functions = sum(basis.view_map.shape[-1] for basis in self.bases)
        return {
            "weight": Layout((self.step, cut["components"]), 0, "float32"),
            "core": Layout((1, cut["components"], cut["modes"], harmonic, functions), 0, "float16"),
            "mode": Layout((1, self.response[0].shape[1], cut["modes"]), 0, "float32"),
            "error": Layout((1,), 0, "float32"),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        tensor = self.tensor(self.member[block])
        count, light, harmonic, functions = tensor.shape
        weight, core, mode, error = compress(jnp.asarray(tensor.reshape(count, light, -1)), **self._cut)
        core = np.asarray(core).reshape(1, *core.shape[:2], harmonic, functions)
        rows = {"weight": weight, "core": core, "mode": mode[None], "error": error[None]}
        return {name: np.asarray(each) for name, each in rows.items()}, 0

    def tensor(self, part: np.ndarray) -> Float[np.ndarray, "b l s q"]:
        """What arrives at some vertices, before it is decomposed."""
        found = bounce.rays(self.rays, self.start[part], self.frame[part, 2], self.frame, self.region, size=self.size)
        way = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)
        area = np.asarray(cubemap.solid_angle(size=self.size), np.float32).reshape(-1, 1)
        shining = np.asarray(harmonics.evaluate(jnp.asarray(way), degree=_DEGREE)) * area
        result = []
        for number, (basis, response) in enumerate(zip(self.bases, self.response, strict=True)):
            shape = (len(part), shining.shape[1], basis.view_map.shape[-1], response.shape[1])
            if number not in found:
                result.append(np.zeros(shape, np.float32))
                continue
            rays, own = found[number], np.flatnonzero(self.region == number)
            local = np.zeros(len(self.region), np.int32)
            local[own] = np.arange(len(own))
            # Padded to a power of two groups, so that few shapes are compiled; what is added weighs nothing.
            spare = (1 << (len(rays.owner) - 1).bit_length()) - len(rays.owner)
            owner, corner, weight, texel = (np.pad(x, ((0, spare), *[(0, 0)] * (x.ndim - 1))) for x in rays)
            fixed = (owner, local[corner], weight, way[texel], shining[texel])
            arrived = bounce.arrive(response, self.frame[own], basis, *map(jnp.asarray, fixed), points=len(part))
            result.append(np.asarray(arrived))
        return np.moveaxis(np.concatenate(result, 2), 3, 1)

    @property
    def _cut(self) -> dict[str, int]:
        components = min(self.components, self.member.shape[1])
        return {"components": components, "modes": min(self.modes, self.response[0].shape[1])}
