"""Precomputes transfer tensors for one bounce and two, and patches for diffuse light of all further bounces."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.compile import shared_size
from jaxprt.scene.mesh import Mesh, areas
from jaxprt.systems.bounces import functions, gather, jobs, patches
from jaxprt.systems.bounces.patches import Patches
from jaxprt.systems.bounces.tensor import SecondBounce, TransferTensor, scales, twice
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.visibility import members
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

ALL = "all"  # as many bounces as contribute
_MEMBERS = 230  # number of vertices of a cluster
_SEEN = 4  # edge of the visibility's faces relative to that of the light's
_SAMPLE = 8  # number of clusters from which the worth of a bounce is estimated


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    brdfs: Sequence[SeparableBrdf],
    *,
    weights: Sequence[Float[Array, "_ _"] | None] | None = None,
    lamps: LampTransport | None = None,
    bounces: int | str = 2,
    least: float = 0.0,
    components: int = 32,
    modes: int = 64,
    edge: int = 8,
    size: int = 16,
    patches: int = 256,
    run: Run = Run(),
) -> TransferTensor:
    """Traces reflected light to every vertex, and compresses it into a transfer tensor.

    Memory during precomputation: 24 edge^2 + 6 modes bytes for each vertex and light factor of its region; afterwards,
    for two bounces, 96 bytes for each vertex, light factor and function.

    Args:
        mesh: The whole scene, which reflects light onto itself.
        brdfs: BRDFs along light paths, for each region in the order of their numbers, from `jaxprt.separable.factor` or
            `jaxprt.bounces.functions.shared`.
        weights: For each region, typical weights of the BRDF's channels k in each color, [k, c]. They are used to
            estimate `worth`. None for a BRDF whose channels are colors.
        lamps: Transport of lamps to the vertices of the mesh, whose light is reflected too; None without lamps.
        bounces: Number of times that light is reflected, or "all" for as many as contribute. Bounces after the second
            are diffuse, between patches.
        least: Smallest worth of the second bounce; see `TransferTensor.worth`. If it is worth less, it is omitted.
            Functions that contribute less than this fraction of the arriving light are omitted too.
        components: Number of principal components over the vertices of a cluster, limited by the number of vertices.
            Two bounces have half as many.
        modes: Number of principal components over the light, limited by its number of texels.
        edge: Edge of the light's cubemap faces in texels, a power of two.
        size: Edge of the cubemap faces through whose texels rays are traced.
        patches: Approximate number of patches that exchange diffuse light. They account for the spatial variation of
            textures, and for bounces after the second.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        The tensor for all vertices.

    Raises:
        TypeError: `mesh` is not a `Mesh`, `brdfs` is not a list, or a BRDF is not factored.
        ValueError: There is not one BRDF for each region; weights have another number of channels or are not finite;
            `lamps` has other vertices than the mesh; `bounces` is neither "all" nor a
            whole number of at least 1; `least` is not in [0, 1); another number is below 1; or `edge` is not a power
            of two.

    Reference: Sun et al. 2007, sections 3.1 and 4.3.
    """
    numbers = _regions(mesh, brdfs)
    weights = [None] * len(brdfs) if weights is None else weights
    _check_weights(weights, brdfs)
    _check_sizes(bounces, least, components, modes, edge, size, patches)
    if lamps is not None:
        require.length("vertices of the lamps' transport", lamps.position, len(mesh.position))
    factor = tuple(map(functions.fixed_weights, brdfs))
    white = np.concatenate([_white(*pair) for pair in zip(factor, weights, strict=True)])
    parts = {"lamps": 0 if lamps is None else lamps.lamps, "white": white, "scale": np.asarray(scales(factor))}
    parts["function"] = np.arange(len(white))
    sizes = {"components": components, "modes": min(modes, 6 * edge * edge), "size": size}
    job = _job(mesh, brdfs, np.searchsorted(numbers, mesh.region), edge, lamps, run, parts, sizes)
    blocks, member = visibility.blocks.compute(job, run.within("clusters"), label="bounce"), job.member
    contribution = _contributions(blocks["energy"], job.scale)
    function = np.flatnonzero(contribution >= least)
    worth = [_rms(blocks["white"])]
    weight, core, lamp = blocks["weight"].reshape(*member.shape, -1), blocks["core"][..., function], None
    if lamps is not None:
        lamp = blocks["lamp_weight"].reshape(*member.shape, -1), blocks["lamp"][..., function]
    job, parts = job.without_response(), None
    second, brought_twice = None, np.zeros(0)
    if bounces != 1 and function.size:
        fewer = min(twice(components), member.shape[1])
        again = job.again(weight, core, blocks["mode"], lamp, function, components=fewer)
        second, brought_twice = _second(again, member, job.white[function], least, run)
        worth.append(_rms(brought_twice))
    exchange = _Exchange(mesh, job, patches, None if bounces == ALL else int(bounces), run)
    whole = weight if lamp is None else np.concatenate([weight, lamp[0]], -1)
    exchanged = exchange.make(function, whole, None if second is None else np.asarray(second.weight), edge, lamps)
    if second is not None and bounces != 2:
        worth += exchange.worth(exchanged, job.white[function], function, brought_twice)
    if run.progress is True:
        _tell(contribution, function, worth, second, bounces)
    rows = (members.places(member), job.region.astype(np.int32), areas(mesh).astype(whole.dtype))
    arrays = [jax.device_put(column) for column in (whole, core, blocks["mode"], *rows, function)]
    made_of = {"factor": factor, "second": second, "patches": exchanged}
    made_of |= {"lamp": None if lamp is None else jax.device_put(lamp[1]), "error": jnp.asarray(blocks["error"])}
    return TransferTensor(*arrays, **made_of, worth=jnp.asarray(worth, arrays[0].dtype))


def _job(
    mesh: Mesh,
    brdfs: Sequence[SeparableBrdf],
    region: np.ndarray,
    edge: int,
    lamps: LampTransport | None,
    run: Run,
    parts: dict[str, Any],
    sizes: dict[str, int],
) -> jobs.TransferJob:
    """The job of one bounce, with responses of all vertices. Regions with one BRDF share its functions."""
    different = list({id(brdf): brdf for brdf in brdfs}.values())
    basis = np.array([next(k for k, other in enumerate(different) if other is brdf) for brdf in brdfs])
    bases = tuple(jax.tree.map(np.asarray, functions.basis(brdf)) for brdf in different)
    member = members.cluster(mesh.position, mesh.normal, clusters=max(1, round(len(region) / _MEMBERS)))
    response = _responses(mesh, bases, basis[region], edge, lamps, run)
    parts = parts | {"bases": bases, "basis": basis, "response": response, "region": region, "member": member}
    size, components, modes = sizes["size"], min(sizes["components"], member.shape[1]), sizes["modes"]
    return jobs.TransferJob.make(mesh, None, None, size, components=components, modes=modes, **parts)


class _Exchange(NamedTuple):
    """Makes the patches of a scene."""

    mesh: Mesh  # the whole scene
    job: jobs.TransferJob  # of one bounce
    wanted: int  # approximate number of patches
    bounces: int | None  # total number; None for all
    run: Run

    def make(
        self,
        function: np.ndarray,
        weight: np.ndarray,
        again: np.ndarray | None,
        edge: int,
        lamps: LampTransport | None,
    ) -> Patches:
        """The patches, given the weights of the components of one bounce and of two, and the lamps."""
        position, normal = (np.asarray(column, np.float64) for column in (self.mesh.position, self.mesh.normal))
        count = min(self.wanted, max(1, len(position) // patches.LEAST))
        member, region = self.job.member, self.job.region
        patch, of_region, of_cluster = patches.divide(position, normal, region, member, patches=count)
        size = self.job.size
        job = patches.PatchJob.make(self.mesh, None, None, size, patch=patch, edge=math.gcd(size, edge))
        traced = visibility.blocks.compute(job, self.run.within("patches"), label="patches")
        area = areas(self.mesh)
        mean = patches.Means(patch, area, len(of_region))
        place = members.places(member)
        cosine = gather.cosines(self.job.frame[:, 2])

        def of_components(weight: np.ndarray) -> np.ndarray:
            return mean.product(weight.reshape(-1, weight.shape[-1])[place], cosine)

        strength, first = [], 0
        albedo = [np.asarray(functions.albedo(basis)) for basis in self.job.bases]
        for kind in self.job.basis:
            of_basis = albedo[kind]
            present = np.isin(np.arange(first, first + len(of_basis)), function)
            strength.append(jnp.asarray(np.where(present, of_basis, 0)))
            first += len(of_basis)
        arrays = (traced["factor"], traced["spread"], patch, of_region, of_cluster)
        ours = (mean.of(traced["factor"]), mean.of(traced["light"]), of_components(weight))
        second = None if again is None else jnp.asarray(of_components(again))
        factor, spread, *of_patch, between, light, once = (jnp.asarray(column) for column in (*arrays, *ours))
        more = {"second": second, "strength": tuple(strength), "bounces": self.bounces}
        if lamps is not None:
            pieces = mean.of(np.asarray(lamps.cosine).T / np.float32(np.pi))
            of_lamp = np.asarray(lamps.lamp)[:, None] == np.arange(lamps.lamps)
            more["lamp"] = jnp.asarray(pieces @ of_lamp.astype(pieces.dtype))
        return Patches(factor, spread, *of_patch, between=between, light=light, first=once, **more)

    def worth(self, between: Patches, white: np.ndarray, function: np.ndarray, twice: np.ndarray) -> list[float]:
        """Worth of the bounces after the second: one value for each bounce, or one for all of them together."""
        place = members.places(self.job.member)
        mean = patches.Means(np.asarray(between.patch), areas(self.mesh), len(between.region))
        rho = np.asarray(between.albedo(jnp.asarray(function), jnp.asarray(white[:, None], between.light.dtype)))
        start = rho * mean.of(twice[place][:, None]).astype(rho.dtype)
        factor = np.asarray(between.factor, np.float32)
        if self.bounces is None:
            return [_rms(factor @ np.asarray(between.settled(jnp.minimum(rho, patches.MOST), jnp.asarray(start))))]
        result = []
        for _ in range(self.bounces - 2):
            result.append(_rms(factor @ start))
            start = rho * (np.asarray(between.between) @ start)
        return result


def _regions(mesh: Mesh, brdfs: Sequence) -> np.ndarray:
    """Numbers of the regions. Refuses a list that does not have one BRDF for each region."""
    if not isinstance(mesh, Mesh) or not isinstance(brdfs, Sequence):
        raise TypeError(f"mesh must be a Mesh and brdfs a list, got {type(mesh).__name__} and {type(brdfs).__name__}")
    for number, brdf in enumerate(brdfs):
        require.kind(f"the BRDF of region {number}", brdf, SeparableBrdf, source="jaxprt.separable.factor")
    numbers = np.unique(np.asarray(mesh.region))
    if len(brdfs) != len(numbers):
        raise ValueError(f"brdfs must be one for each of the regions {numbers.tolist()}, got {len(brdfs)}")
    return numbers


def _check_weights(weights: Sequence[Array | None], brdfs: Sequence[SeparableBrdf]) -> None:
    """Refuses weights of other regions or channels."""
    if len(weights) != len(brdfs):
        raise ValueError(
            f"weights must have one entry, an array or None, for each of {len(brdfs)} regions, got {len(weights)}"
        )
    for number, (weight, brdf) in enumerate(zip(weights, brdfs, strict=True)):
        if weight is None:
            continue
        shape, channels = np.shape(weight), brdf.view_map.shape[-1]
        if len(shape) != 2 or shape[0] != channels:
            raise ValueError(f"the weights of region {number} must be [{channels} channels, c], got {list(shape)}")
        require.finite(f"the weights of region {number}", weight)


def _check_sizes(
    bounces: int | str, least: float, components: int, modes: int, edge: int, size: int, patches: int
) -> None:
    """Refuses numbers that are out of range."""
    if bounces != ALL and not (isinstance(bounces, int | np.integer) and bounces >= 1):
        raise ValueError(f"bounces must be a whole number of at least 1, or {ALL!r}, got {bounces!r}")
    if patches < 1:
        raise ValueError(f"patches must be at least 1, got {patches}")
    if not 0 <= least < 1:
        raise ValueError(f"least must be at least 0 and less than 1, got {least}")
    if min(components, modes, edge, size) < 1 or edge & (edge - 1):
        raise ValueError(
            f"components, modes, edge and size must be at least 1, and edge a power of two, got {components}, {modes}, "
            f"{edge} and {size}"
        )


def _responses(
    mesh: Mesh, bases: Sequence, kind: np.ndarray, edge: int, lamps: LampTransport | None, run: Run
) -> tuple[np.ndarray, ...]:
    """Response of the light factors of each basis to each texel of the environment, and to each lamp."""
    result, count = [], 0 if lamps is None else lamps.lamps
    for number, basis in enumerate(bases):
        vertex = np.flatnonzero(kind == number)
        job = jobs.ResponseJob.make(mesh, None, vertex, _SEEN * edge, basis=basis, edge=edge)
        response = visibility.blocks.compute(job, run.within(f"response_{number}"), label=f"response {number}")[
            "response"
        ]
        texels, terms = response.shape[1:]
        padded = np.zeros((shared_size(len(vertex)), terms, texels + count), response.dtype)
        padded[: len(vertex), :, :texels] = response.swapaxes(1, 2)
        if lamps is not None:
            padded[: len(vertex), :, texels:] = _to_lamps(lamps, basis, vertex)
        result.append(padded)
    return tuple(result)


def _to_lamps(lamps: LampTransport, basis: SeparableBrdf, vertex: np.ndarray) -> np.ndarray:
    """Response of light factors to lamps at some vertices."""
    row = np.resize(vertex, shared_size(len(vertex)))  # repeated to a size that scenes share
    moment = [np.asarray(column)[..., row] for column in (lamps.solid_angle, lamps.cosine, lamps.direction)]
    place = np.asarray(lamps.position)[row], np.asarray(lamps.frame)[row]
    few = LampTransport(*jax.device_put((*moment, *place)), lamp=lamps.lamp)
    return np.asarray(gather.respond_to_lamps(few, few.frame, basis))[: len(vertex)]


def _second(
    job: jobs.AgainJob, member: np.ndarray, white: np.ndarray, least: float, run: Run
) -> tuple[SecondBounce | None, np.ndarray]:
    """The second bounce, or None if a sample of clusters shows too little worth; and its irradiance at vertices."""
    if least > 0:
        sample = np.linspace(0, len(member) - 1, min(_SAMPLE, len(member))).astype(int)
        brought = np.concatenate([job.bring(member[cluster]) for cluster in sample])
        if _rms(brought) < least:
            return None, brought
    blocks = visibility.blocks.compute(job, run.within("clusters_2"), label="bounce 2")
    weight, lamp = blocks["weight"].reshape(*member.shape, -1), None
    if job.lamps:
        weight = np.concatenate([weight, blocks["lamp_weight"].reshape(*member.shape, -1)], -1)
        lamp = jax.device_put(blocks["lamp"])
    return SecondBounce(*map(jax.device_put, (weight, blocks["core"], blocks["error"])), lamp=lamp), blocks["white"]


def _white(factor: Array, channel: Array | None) -> np.ndarray:
    """Weights of the functions of a region, those of its BRDF in the brightest color."""
    weight = np.asarray(factor) if channel is None else np.asarray(factor) @ np.asarray(channel)
    return weight[:, np.argmax(np.abs(weight).sum(0))] if len(weight) else np.zeros(0, np.float32)


def _contributions(energy: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Contribution of each function at its largest weight, relative to the contribution of all functions."""
    size = np.sqrt(energy.sum(0)) * scale
    return size / max(np.linalg.norm(size), np.finfo(np.float32).tiny)


def _rms(value: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(value, dtype=np.float64))))


def _tell(contribution: np.ndarray, function: np.ndarray, worth: list[float], second, bounces: int | str) -> None:
    gone = len(contribution) - len(function)
    if gone:
        left = np.linalg.norm(np.delete(contribution, function))
        share = f"which carry {100 * left:.2g} % of the arriving light"
        tqdm.tqdm.write(f"transfer: dropped {gone} of {len(contribution)} path functions, {share}")
    if bounces != 1 and second is None and len(worth) > 1:
        share = f"{100 * worth[1]:.2g} % of the light of an open surface"
        tqdm.tqdm.write(f"transfer: dropped the second bounce, which carries {share}")
