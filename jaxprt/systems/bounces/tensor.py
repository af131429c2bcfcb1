"""Precomputed transfer tensors: what arrives at every vertex after one bounce and two, for any light and any BRDFs.

    I1_x(s) = sum_l L(l) sum_q H(q) T1_x(l, q, s)
    I2_x(s) = sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)

One bounce has light of 6 x 8 x 8 texels l, and arrives as 16 harmonics s in world directions. q counts the functions of
all regions, which `jaxprt.bounces.functions` makes, and H are their weights at present. For two bounces, off functions
q and then p, the light is reduced to 6 x 2 x 2 texels, which costs 7 % error. The paper treats the second bounce as
uniform over direction, which would cost 50 %. Vertices are clustered, and the tensors of each cluster are decomposed,
along vertices and light. `jaxprt.bounces.radiance` makes radiance of them.

A third bounce would follow in the same way, and cost as many times the second as there are functions.
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import Executor
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float, Float16, Int

from jaxprt import require, visibility
from jaxprt.compile import jit
from jaxprt.scene.mesh import Mesh
from jaxprt.systems import separable
from jaxprt.systems.bounces import functions, jobs
from jaxprt.systems.dynamic import DynamicBrdf
from jaxprt.systems.separable import SeparableBrdf

ALGORITHM = jobs.ALGORITHM
_MEMBERS = 230  # vertices of a cluster
_SEEN = 4  # visibility has faces so many times as large as the light's
_FEWER = 2  # as many times fewer components have two bounces
_LEAST = 0.01  # of the largest weight
_SAMPLE = 8  # clusters that tell what a bounce is worth


class SecondBounce(eqx.Module):
    """Two bounces, by clusters of vertices; `weight` holds the sizes.

    Attributes:
        weight: Weights of the components of its cluster, for each row.
        core: For each cluster: texels of the light, components, harmonics, functions of the first and second bounce.
        error: Relative L2 error of each cluster's tensor that the components make, as that of one bounce.
    """

    weight: Float[Array, "g m o"]
    core: Float16[Array, "g l o s q q"]
    error: Float[Array, " g"]

    def truncate(self, components: int, *, scale: Float[Array, " q"]) -> "SecondBounce":
        """The first components; functions count by some scale."""
        core = self.core * (scale[:, None] * scale)
        energy = jnp.sum(core**2, (1, 3, 4, 5)) * jnp.sum(self.weight**2, 1)
        whole = jnp.sum(energy, 1) / jnp.maximum(1 - self.error**2, jnp.finfo(energy.dtype).eps)
        kept = jnp.sum(energy[:, :components], 1)
        error = jnp.where(whole > 0, jnp.sqrt(jnp.maximum(1 - kept / jnp.where(whole > 0, whole, 1), 0)), 0)
        return SecondBounce(self.weight[..., :components], self.core[:, :, :components], error)


class TransferTensor(eqx.Module):
    """One bounce and two, by clusters of vertices; `weight` holds the sizes, so that half precision holds the rest.

    Attributes:
        weight: Weights of the components of its cluster, for each row.
        core: For each cluster: modes of the light, components, harmonics and functions.
        mode: Modes of the light of each cluster, on its texels.
        place: Row of each vertex.
        region: Number of the region of each vertex.
        area: Surface that each vertex stands for, a third of the triangles around it.
        function: Numbers of the functions that are kept among those of all regions.
        factor: What makes the weights of each region's functions: those of the BRDFs of a set, or of one BRDF.
        second: Two bounces, if asked for and not left out.
        error: Relative L2 error of each cluster's tensor that the decomposition makes, of functions at the largest
            weights they can have; a difference of squares: less than 5e-4 is rounding.
        worth: What each bounce brings to white surfaces under constant light, root mean square of irradiance over that
            of an open surface. Regions with one BRDF count as they are.
        mesh: Fingerprint of the mesh, by which transport of another one is refused; empty if made by hand.
    """

    weight: Float[Array, "g m n"]
    core: Float16[Array, "g e n s q"]
    mode: Float[Array, "g l e"]
    place: Int[Array, " v"]
    region: Int[Array, " v"]
    area: Float[Array, " v"]
    function: Int[Array, " q"]
    factor: tuple[Float[Array, "..."], ...]
    second: SecondBounce | None
    error: Float[Array, " g"]
    worth: Float[Array, " _"]
    mesh: str = eqx.field(static=True, default="")

    @property
    def nbytes(self) -> int:
        """Bytes of the tensors."""
        return sum(each.nbytes for each in jax.tree.leaves((self.weight, self.core, self.mode, self.second)))

    def truncate(self, components: int, *, modes: int) -> "TransferTensor":
        """The first components and modes of one bounce, and half as many components of two.

        Their errors are then larger.

        Raises:
            ValueError: Numbers below 1, or above those of the tensor.
        """
        most = self.core.shape[2], self.core.shape[1]
        if not (1 <= components <= most[0] and 1 <= modes <= most[1]):
            raise ValueError(f"components and modes must be at least 1 and at most {most}, got {components}, {modes}")
        weight, core = self.weight[..., :components], self.core[:, :modes, :components]
        energy, whole = _energy(self)
        kept = jnp.sum(energy[:, :modes, :components], (1, 2))
        error = jnp.sqrt(jnp.maximum(1 - kept / jnp.where(whole > 0, whole, 1), 0))
        second = self.second and self.second.truncate(_twice(components), scale=scales(self.factor)[self.function])
        same = (self.place, self.region, self.area, self.function, self.factor, second)
        error = jnp.where(whole > 0, error, 0)
        return TransferTensor(weight, core, self.mode[..., :modes], *same, error, self.worth, self.mesh)

    def shorten(self, *, error: float | None = None, nbytes: int | None = None) -> "TransferTensor":
        """The smallest tensor whose root mean square error is no larger, or that of least error that is no larger.

        Raises:
            ValueError: Neither or both of error and bytes, or one that no components and modes reach.
        """
        if (error is None) == (nbytes is None):
            raise ValueError(f"give either error or nbytes, got error={error} and nbytes={nbytes}")
        energy, whole = (np.asarray(each, np.float64) for each in _energy(self))
        fraction = energy / np.where(whole > 0, whole, 1)[:, None, None]
        left = np.where(whole[:, None, None] > 0, 1 - fraction.cumsum(1).cumsum(2), 0)
        wrong = np.sqrt(np.maximum(left, 0).mean(0))  # [e, n]
        modes, components = (np.arange(1, n + 1) for n in wrong.shape)
        clusters, _, _, *shape = self.core.shape
        size = 2 * clusters * math.prod(shape) * modes[:, None] * components
        size = size + 4 * self.weight[..., 0].size * components + 4 * self.mode[..., 0].size * modes[:, None]
        if self.second is not None:
            each = self.second.core[:, :, 0].nbytes + self.second.weight[..., 0].nbytes
            held = np.minimum([_twice(int(count)) for count in components], self.second.core.shape[2])
            size = size + each * held + self.second.error.nbytes
        fits = wrong <= error if error is not None else size <= nbytes
        if not fits.any():
            reached = (
                f"error must be at least {wrong.min():.3g}"
                if nbytes is None
                else f"nbytes must be at least {size.min()}"
            )
            raise ValueError(f"{reached}, got {error if nbytes is None else nbytes}")
        cost = np.where(fits, size if nbytes is None else wrong, np.inf)
        mode, component = np.unravel_index(np.argmin(cost), cost.shape)
        return self.truncate(int(component) + 1, modes=int(mode) + 1)


def precompute(
    mesh: Mesh,
    brdfs: Sequence[DynamicBrdf | SeparableBrdf],
    *,
    weights: Sequence[Float[Array, "_ _"] | None] | None = None,
    bounces: int = 2,
    least: float = 0.0,
    components: int = 32,
    modes: int = 64,
    edge: int = 8,
    size: int = 16,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> TransferTensor:
    """Traces bounces from every vertex, and decomposes what arrives.

    Args:
        mesh: The whole scene, which lights itself.
        brdfs: What light meets on its way, for each region in the order of their numbers: a set from
            `jaxprt.bounces.factor`, or the one BRDF that it has for good, factored.
        weights: Typical weights of the channels k of each region's BRDF in each color, by which `worth` is judged. None
            for a set, and for a BRDF whose channels are colors.
        bounces: 1 or 2.
        least: The second bounce is left out if it is worth less, see `TransferTensor.worth`; and functions that bring
            less than this share of what arrives.
        components: Along the vertices of a cluster, or as many as it has; half of them for two bounces.
        modes: Along the light, or as many as it has texels.
        edge: Edge of the light's faces in texels, a power of two.
        size: Edge of the faces through whose texels rays are sent.
        path: Folder that keeps what is finished; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show progress bars, and to say what is left out.

    Returns:
        The tensor of all vertices. Meanwhile the responses of all of them are held: 24 edge^2 bytes for each vertex and
        light factor of its region, and for two bounces 96 for each function too.

    Raises:
        TypeError: A mesh or BRDFs of another kind.
        ValueError: Not one BRDF for each region, weights of other channels or not finite, a set without terms or with
            lobes, bounces other than 1 and 2, numbers below 1, or an edge that is no power of two.

    Reference: Sun et al. 2007, sections 3.1 and 4.3.
    """
    numbers = _regions(mesh, brdfs)
    weights = [None] * len(brdfs) if weights is None else weights
    _check_weights(weights, brdfs)
    _check_sizes(bounces, least, components, modes, edge, size)
    bases = tuple(jax.tree.map(np.asarray, functions.basis(brdf)) for brdf in brdfs)
    factor = tuple(each.factor if isinstance(each, DynamicBrdf) else functions.fixed_weights(each) for each in brdfs)
    if path is not None:
        os.makedirs(path, exist_ok=True)
    run = _Run(path, executor, progress)
    region = np.asarray(mesh.region)
    member = separable.members.cluster(mesh.position, mesh.normal, clusters=max(1, round(len(region) / _MEMBERS)))
    job = jobs.TransferJob.make(
        mesh,
        None,
        None,
        size,
        bases=bases,
        response=_responses(mesh, bases, numbers, edge, run),
        white=np.concatenate([_white(*each) for each in zip(factor, weights, strict=True)]),
        scale=np.asarray(scales(factor)),
        region=np.searchsorted(numbers, region),
        member=member,
        components=min(components, member.shape[1]),
        modes=min(modes, 6 * edge * edge),
    )
    found = run.compute(job, "clusters", "bounce")
    contribution = _contributions(found["energy"], job.scale)
    function = np.flatnonzero(contribution >= least)
    worth = [_rms(found["white"])]
    weight = found["weight"].reshape(*member.shape, -1)
    core = found["core"][..., function]
    second = None
    if bounces == 2 and function.size:
        count = min(_twice(components), member.shape[1])
        again = job.again(weight, core, found["mode"], function, components=count)
        second, brought = _second(again, member, job.white[function], least, run)
        worth.append(brought)
    if progress:
        _tell(contribution, function, worth, second, bounces)
    rows = (separable.members.places(member), job.region.astype(np.int32), _areas(mesh).astype(weight.dtype))
    arrays = [jax.device_put(each) for each in (weight, core, found["mode"], *rows, function)]
    judged = {"error": jnp.asarray(found["error"]), "worth": jnp.asarray(worth, arrays[0].dtype)}
    return TransferTensor(*arrays, factor=factor, second=second, **judged, mesh=visibility.blocks.scene_key(mesh))


class _Run(NamedTuple):
    """Where blocks are computed and kept."""

    path: str | os.PathLike | None
    executor: Executor | None
    progress: bool

    def compute(self, job: visibility.blocks.Job, name: str, label: str) -> dict[str, np.ndarray]:
        """The results of a job, kept in a folder of a name."""
        store = None if self.path is None else os.path.join(self.path, name)
        options = {"executor": self.executor, "progress": self.progress}
        return visibility.blocks.compute(job, path=store, label=label, **options)


def _regions(mesh: Mesh, brdfs: Sequence) -> np.ndarray:
    """Numbers of the regions, if there is a BRDF for each."""
    if not isinstance(mesh, Mesh) or not isinstance(brdfs, Sequence):
        raise TypeError(f"mesh must be a Mesh and brdfs a list, got {type(mesh).__name__} and {type(brdfs).__name__}")
    for number, each in enumerate(brdfs):
        if not isinstance(each, DynamicBrdf | SeparableBrdf):
            raise TypeError(
                f"the BRDF of region {number} must be from jaxprt.bounces.factor or separable.factor, got "
                f"{type(each).__name__}"
            )
    numbers = np.unique(np.asarray(mesh.region))
    if len(brdfs) != len(numbers):
        raise ValueError(f"brdfs must be one for each of the regions {numbers.tolist()}, got {len(brdfs)}")
    return numbers


def _check_weights(weights: Sequence[Array | None], brdfs: Sequence[DynamicBrdf | SeparableBrdf]) -> None:
    """Refuses weights of other regions or channels."""
    if len(weights) != len(brdfs):
        raise ValueError(f"weights must be one, or None, for each of {len(brdfs)} regions, got {len(weights)}")
    for number, (each, brdf) in enumerate(zip(weights, brdfs, strict=True)):
        if each is None:
            continue
        if isinstance(brdf, DynamicBrdf):
            raise ValueError(f"the weights of region {number}, which has a set of BRDFs, must be None")
        shape, channels = np.shape(each), brdf.view_map.shape[-1]
        if len(shape) != 2 or shape[0] != channels:
            raise ValueError(f"the weights of region {number} must be [{channels} channels, c], got {list(shape)}")
        require.finite(f"the weights of region {number}", each)


def _check_sizes(bounces: int, least: float, components: int, modes: int, edge: int, size: int) -> None:
    """Refuses numbers that are out of range."""
    if bounces not in (1, 2):
        raise ValueError(f"bounces must be 1 or 2, got {bounces}")
    if not 0 <= least < 1:
        raise ValueError(f"least must be at least 0 and less than 1, got {least}")
    if min(components, modes, edge, size) < 1 or edge & (edge - 1):
        raise ValueError(
            f"components, modes, edge and size must be at least 1, and edge a power of two, got {components}, {modes}, "
            f"{edge} and {size}"
        )


def _responses(mesh: Mesh, bases: Sequence, numbers: np.ndarray, edge: int, run: _Run) -> tuple[np.ndarray, ...]:
    """What the light factors of each region make of direct light."""
    result = []
    for number, basis in zip(numbers.tolist(), bases, strict=True):
        vertex = np.flatnonzero(np.asarray(mesh.region) == number)
        job = jobs.ResponseJob.make(mesh, None, vertex, _SEEN * edge, basis=basis, edge=edge)
        result.append(run.compute(job, f"response_{number}", f"region {number}")["response"])
    return tuple(result)


def _second(
    job: jobs.AgainJob, member: np.ndarray, white: np.ndarray, least: float, run: _Run
) -> tuple[SecondBounce | None, float]:
    """The second bounce, or None if some clusters show that it brings too little; and what it brings."""
    sample = np.linspace(0, len(member) - 1, min(_SAMPLE, len(member))).astype(int)
    worth = _rms(np.concatenate([job.brought(job.tensor(member[each]), member[each], white) for each in sample]))
    if worth < least:
        return None, worth
    found = run.compute(job, "clusters_2", "bounce 2")
    parts = (found["weight"].reshape(*member.shape, -1), found["core"], found["error"])
    return SecondBounce(*map(jax.device_put, parts)), _rms(found["white"])


def _areas(mesh: Mesh) -> Float[np.ndarray, " v"]:
    """A third of the area of the triangles around each vertex: weights by which means over vertices are over area."""
    face = np.asarray(mesh.face)
    corner = np.asarray(mesh.position, np.float64)[face]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
    return np.bincount(face.ravel(), np.repeat(area / 3, 3), len(mesh.position))


@jit
def _energy(tensor: TransferTensor) -> tuple[Float[Array, "g e n"], Float[Array, " g"]]:
    """What each mode and component holds of a cluster's tensor under light of natural spectrum, and all of it."""
    size = jnp.sum(tensor.weight**2, 1)
    energy = jnp.sum((tensor.core * scales(tensor.factor)[tensor.function]) ** 2, (3, 4)) * size[:, None]
    return energy, jnp.sum(energy, (1, 2)) / jnp.maximum(1 - tensor.error**2, jnp.finfo(size.dtype).eps)


def _twice(components: int) -> int:
    """Components of two bounces beside those of one."""
    return max(1, components // _FEWER)


def _white(factor: Array, channel: Array | None) -> np.ndarray:
    """Weights of the functions of a region that is white if it can be, else as it is, brightest color."""
    if factor.ndim > 2:
        return np.append(np.zeros(factor.shape[-1], np.float32), np.float32(1))
    weight = np.asarray(factor) if channel is None else np.asarray(factor) @ np.asarray(channel)
    return weight[:, np.argmax(np.abs(weight).sum(0))] if len(weight) else np.zeros(0, np.float32)


def scales(factor: Sequence[Array]) -> Float[Array, " q"]:
    """Largest weights of all functions, at least a hundredth of the largest of all: half precision must hold both."""
    largest = []
    for each in factor:
        size = jnp.abs(each)
        largest += [jnp.max(size, range(each.ndim - 1)), jnp.ones(1)] if each.ndim > 2 else [jnp.max(size, 1)]
    whole = jnp.concatenate(largest)
    return jnp.maximum(whole, _LEAST * jnp.max(whole, initial=0))


def _contributions(energy: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """What each function brings at its largest weight, as a share of what all bring."""
    size = np.sqrt(energy.sum(0)) * scale
    return size / max(np.linalg.norm(size), np.finfo(np.float32).tiny)


def _rms(value: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(value, dtype=np.float64))))


def _tell(contribution: np.ndarray, function: np.ndarray, worth: list[float], second, bounces: int) -> None:
    gone = len(contribution) - len(function)
    if gone:
        left = np.linalg.norm(np.delete(contribution, function))
        tqdm.tqdm.write(f"transfer: left out {gone} of {len(contribution)} functions, {left:.2g} of what arrives")
    if bounces == 2 and second is None and len(worth) > 1:
        tqdm.tqdm.write(f"transfer: left out the second bounce, {worth[1]:.2g} of the light of an open surface")
