"""Blocks of work for transfer tensors: responses to direct light, and one bounce and two for clusters of vertices."""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Float16

from jaxprt import visibility
from jaxprt.compile import jit, shared_size
from jaxprt.files.arrays import Header, Layout, sketch
from jaxprt.sphere import cubemap, haar
from jaxprt.systems.bounces import gather
from jaxprt.systems.separable import SeparableBrdf, clustered
from jaxprt.visibility import members

# Versions of the algorithms that make the results. A release that changes results increments one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "transfer": 4}
DEGREE = gather.DEGREE  # degree of the harmonics that arrive
_GROUPS = 128  # groups of rays that are summed by one program
_AGAIN = 2  # edge of the light's faces for two bounces
_COARSE = 8  # edge of the faces of rays for two bounces, of which fewer would not be enough
_SAMPLE = 4096  # most vertices of a basis from whose responses the modes of the light are found
_DIM = 0.03  # responses of vertices count relative to their size, unless they are this small beside the mean


@dataclass(frozen=True)
class ResponseJob(visibility.rays.VisibilityJob):
    """Responses of light factors to direct light, in blocks of vertices; see `blocks.Job`."""

    basis: SeparableBrdf
    edge: int

    @property
    def header(self) -> Header:
        """What the result depends on."""
        return self.made_by("response", ALGORITHM, edge=self.edge, maps=self.basis.coordinates.__name__)

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches of the light factors."""
        return {**super().near, "brdf": sketch(self.basis.light_map)}

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Shapes of one block."""
        shape = (visibility.rays.BLOCK, 6 * self.edge**2, self.basis.terms)
        return {"response": Layout(shape, 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """One block."""
        seen, count = self.seen(block)
        frame = jnp.asarray(self.frame[self.part(block)])
        response = gather.respond(jnp.asarray(seen), frame, self.basis, edge=self.edge)
        return {"response": np.asarray(response)}, count.rays


@dataclass(frozen=True)
class _PathJob(members.ClusterJob, visibility.rays.VisibilityJob):
    """Light that surfaces of all regions send to the vertices of each cluster; see `blocks.Job`."""

    bases: tuple[SeparableBrdf, ...]  # functions of the regions, which may share them
    basis: np.ndarray  # index of the functions of each region
    # For each basis, at the vertices of all its regions, padded to a size that scenes share: the responses of its light
    # factors, with the light as the last axis, texels of the environment and then lamps.
    response: tuple[np.ndarray, ...]
    lamps: int
    white: np.ndarray  # weights of all functions with which the worth of a bounce is estimated
    scale: np.ndarray  # weights of all functions in the errors of decompositions
    function: np.ndarray  # indices of the functions that are computed
    region: np.ndarray  # of each vertex
    member: np.ndarray  # vertices of each cluster
    components: int  # principal components over the vertices of a cluster
    modes: int  # principal components over the light
    system: ClassVar[str] = "transfer"

    @property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix [l l] from the columns of the environment's light to ones that matter alike, and its inverse."""
        raise NotImplementedError

    @property
    def uniform(self) -> np.ndarray:
        """Columns [l] of the environment's light under which the worth of a bounce is estimated."""
        raise NotImplementedError

    @functools.cached_property
    def reduced(self) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
        """Responses [v k m] to orthonormal modes m of the light, then lamps; and the modes [l m]."""
        forward, _ = self.spectrum
        # The modes are principal components of the responses: one and a half times as many as the decomposition keeps,
        # but fewer than the columns, and gathering takes as much less time.
        columns, count = len(forward), self.modes * 3 // 2
        mode = np.eye(columns)
        if count < columns:
            mode = np.linalg.eigh(self._products(forward.T.astype(np.float32)))[1][:, : -count - 1 : -1]
        lamps = np.eye(self.response[0].shape[2] - columns)
        onto = scipy.linalg.block_diag(forward.T @ mode, lamps).astype(np.float32)
        rows = [(response.reshape(-1, len(onto)) @ onto).reshape(*response.shape[:2], -1) for response in self.response]
        return tuple(rows), mode.astype(np.float32)

    def _products(self, forward: np.ndarray) -> np.ndarray:
        """Products [l l] of columns of the light, summed over the responses of a sample of vertices."""
        result = np.zeros((len(forward), len(forward)))
        for number, (basis, response) in enumerate(zip(self.bases, self.response, strict=True)):
            strength = np.sqrt(np.mean(np.square(np.asarray(basis.view_map)), (1, 2, 3)))
            vertices = len(self.vertices_of(number))
            sample = np.unique(np.linspace(0, vertices - 1, min(_SAMPLE, vertices)).astype(int))
            rows = response[sample, :, : len(forward)] @ forward * strength[:, None]
            size = np.sum(rows**2, (1, 2))
            size = np.sqrt(size + _DIM**2 * max(np.mean(size), np.finfo(np.float32).tiny))
            # Responses are divided by the size of their vertex's: dim corners of a scene count as bright places do.
            flat = (rows / size[:, None, None]).reshape(-1, len(forward))
            result += flat.T @ flat
        return result

    @property
    def header(self) -> Header:
        """What the result depends on."""
        maps = [self.bases[number].coordinates.__name__ for number in self.basis]
        divided = visibility.blocks.fingerprint(*(np.asarray(index, np.int64) for index in (self.region, self.member)))
        kinds = self.response[0].shape[2]
        lamps = {"lamps": self.lamps} if self.lamps else {}
        sizes = {"kinds": kinds, "components": self.components, "modes": self.modes} | lamps
        return self.made_by(self.system, ALGORITHM, maps=maps, made=divided, **sizes)

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches of the BRDFs' functions, and of the responses of their light factors."""
        parts = {"white": self.white, "scale": self.scale}
        for number, (basis, response) in enumerate(zip(self.bases, self.response, strict=True)):
            parts |= {f"light {number}": basis.light_map, f"view {number}": basis.view_map}
            parts |= {f"response {number}": response[: len(self.vertices_of(number))]}
        return {**super().near, **{name: sketch(value) for name, value in parts.items()}}

    def vertices_of(self, basis: int) -> np.ndarray:
        """Vertices of all regions with the functions of a basis, in the order of its responses."""
        return np.flatnonzero(self.basis[self.region] == basis)

    def arrived(self, part: np.ndarray) -> Float[np.ndarray, "b s q l"]:
        """Harmonics of the light that arrives at some vertices, for each mode of the light and then for each lamp."""
        hits = gather.rays(self.rays, self.start[part], self.frame[part, 2], self.frame, self.region, size=self.size)
        way = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)
        share, cosine = gather.shares(self.frame[part, 2], size=self.size), gather.cosines(self.frame[part, 2])
        result, surfaces, reduced = [], {}, self.reduced[0]
        for number, kind in enumerate(self.basis.tolist()):
            basis, response = self.bases[kind], reduced[kind]
            if number not in hits:
                shape = (len(part), cosine.shape[-1], basis.view_map.shape[-1], response.shape[2])
                result.append(np.zeros(shape, np.float32))
                continue
            rays = hits[number]
            if kind not in surfaces:
                vertex = self.vertices_of(kind)
                local = np.zeros(len(self.region), np.int32)
                local[vertex] = np.arange(len(vertex))
                frame = np.pad(self.frame[vertex], ((0, len(response) - len(vertex)), (0, 0), (0, 0)))
                surfaces[kind] = local, jax.device_put((response, frame, basis))
            local, surface = surfaces[kind]
            # Groups of rays in blocks of one length, which regions and scenes share. Padding has zero weight.
            spare = -len(rays.owner) % _GROUPS
            owner, corner, weight, texel = (np.concatenate([x, np.zeros((spare, *x.shape[1:]), x.dtype)]) for x in rays)
            point = np.repeat(owner[:, None], texel.shape[1], 1)
            measure = gather.measures(cosine[point], texel, share[point, texel], size=self.size)
            shape = (shared_size(len(part)), cosine.shape[-1], basis.view_map.shape[-1], response.shape[2])
            arrived = jax.device_put(np.zeros(shape, response.dtype))
            for first in range(0, len(owner), _GROUPS):
                block = slice(first, first + _GROUPS)
                fixed = (owner, local[corner], weight, way[texel], measure)
                arrived = gather.arrive(arrived, *surface, *jax.device_put(tuple(rows[block] for rows in fixed)))
            result.append(np.asarray(arrived)[: len(part)])
        return np.concatenate(result, 2)

    def lamp_layout(self, *functions: int) -> Mapping[str, Layout]:
        """Shapes of what one block holds for lamps; nothing without lamps."""
        if not self.lamps:
            return {}
        core = (1, self.lamps, self.components, (DEGREE + 1) ** 2, *functions)
        return {"lamp_weight": Layout((self.step, self.components), 0, "float32"), "lamp": Layout(core, 0, "float16")}

    def lamp_rows(
        self, tensor: Float[np.ndarray, "b i s *q"], scale: Float[np.ndarray, "*q"]
    ) -> Mapping[str, np.ndarray]:
        """Components of light from lamps: weights of the vertices of a cluster, and the core. Nothing without lamps."""
        if not self.lamps:
            return {}
        vertex, core, _ = _along_vertices(tensor * scale, components=self.components)
        weight, core = _scaled(vertex, core)
        return {"lamp_weight": weight, "lamp": (core.swapaxes(0, 1) / scale).astype(np.float16)[None]}

    def irradiance(self, light: Float[np.ndarray, "b m s q"], part: np.ndarray) -> Float[np.ndarray, " b"]:
        """Irradiance over pi at each vertex of a part, for white surfaces under uniform light."""
        uniform = self.reduced[1].T @ (self.spectrum[1].T @ self.uniform).astype(np.float32)
        arriving = np.tensordot(light, uniform, (1, 0)) @ self.white[self.function]
        return np.sum(arriving * gather.cosines(self.frame[part, 2]), 1)

    def bring(self, part: np.ndarray) -> Float[np.ndarray, " b"]:
        """Irradiance over pi that a bounce brings to some vertices, for white surfaces under uniform light."""
        return self.irradiance(self.tensors(part)[0], part)

    def tensors(self, part: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The light that arrives at some vertices before compression: for modes of the light, and for lamps."""
        raise NotImplementedError


@dataclass(frozen=True)
class TransferJob(_PathJob):
    """Tensors of one bounce."""

    @property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrix from texels to wavelets under a natural power spectrum, and its inverse."""
        return _spectrum(self.response[0].shape[2] - self.lamps)

    @property
    def uniform(self) -> np.ndarray:
        """Light of radiance 1."""
        return np.ones(self.response[0].shape[2] - self.lamps)

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Shapes of one block."""
        harmonic, functions = (DEGREE + 1) ** 2, len(self.white)
        return {
            "weight": Layout((self.step, self.components), 0, "float32"),
            "core": Layout((1, self.modes, self.components, harmonic, functions), 0, "float16"),
            "mode": Layout((1, self.response[0].shape[2] - self.lamps, self.modes), 0, "float32"),
            "error": Layout((1,), 0, "float32"),
            "energy": Layout((1, functions), 0, "float32"),
            "white": Layout((self.step,), 0, "float32"),
            **self.lamp_layout(functions),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """One block."""
        light, lamp = self.tensors(self.member[block])
        weight, core, mode, error = compress(light * self.scale, components=self.components, modes=self.modes)
        texels = self.spectrum[1] @ self.reduced[1]  # of the modes of the light
        reflected = np.tensordot((texels.T @ texels).astype(light.dtype), light, (1, 1)).swapaxes(0, 1)
        energy = np.sum(light * reflected, (0, 1, 2)) + np.sum(lamp**2, (0, 1, 2))
        rows = {"weight": weight, "core": (core / self.scale)[None], "mode": (texels @ mode)[None]}
        rows |= {"energy": energy[None]}
        rows |= {"error": np.array([error]), "white": self.irradiance(light, self.member[block])}
        rows |= self.lamp_rows(lamp, self.scale)
        return {name: np.asarray(row) for name, row in rows.items()}, 0

    def tensors(self, part: np.ndarray) -> tuple[Float[np.ndarray, "b m s q"], Float[np.ndarray, "b i s q"]]:
        """The light that arrives at some vertices before compression: for modes of the light, and for lamps."""
        tensor = np.moveaxis(self.arrived(part), 3, 1)
        light, lamp = np.split(tensor, [tensor.shape[1] - self.lamps], 1)
        return light, lamp

    def without_response(self) -> "TransferJob":
        """The job without responses: about 40 kB for each vertex that are not needed when its blocks are done."""
        none = tuple(np.zeros((0, *response.shape[1:]), response.dtype) for response in self.response)
        return replace(self, response=none)

    def again(
        self,
        weight: np.ndarray,
        core: np.ndarray,
        mode: np.ndarray,
        lamp: tuple[np.ndarray, np.ndarray] | None,
        function: np.ndarray,
        *,
        components: int,
    ) -> "AgainJob":
        """The job of the second bounce, off surfaces that the first one lights.

        Args:
            weight: Weights of the components of each vertex, from the first bounce.
            core: Cores of the clusters.
            mode: Modes of the light.
            lamp: Weights and cores of light from lamps; None without lamps.
            function: Indices of the functions that are kept.
            components: Number of components of the second bounce.
        """
        fine = math.isqrt((self.response[0].shape[2] - self.lamps) // 6)
        edge = min(_AGAIN, fine)
        shape = (len(mode), 6, edge, fine // edge, edge, fine // edge, -1)
        coarse = mode.reshape(shape).sum((3, 5)).reshape(len(mode), 6 * edge * edge, -1)
        count = (coarse.shape[1] + self.lamps) * len(function)
        vertices = [self.vertices_of(number) for number in range(len(self.bases))]
        pairs = zip(vertices, self.bases, strict=True)
        response = [np.zeros((shared_size(len(v)), b.terms, count), np.float32) for v, b in pairs]
        local = np.zeros(len(self.region), np.int32)
        for vertex in vertices:
            local[vertex] = np.arange(len(vertex))
        for cluster, (member, *parts) in enumerate(zip(self.member, weight, core, coarse, strict=True)):
            arriving = _expand(*map(jax.device_put, parts))
            if lamp is not None:
                from_lamps = _expand(*jax.device_put((lamp[0][cluster], lamp[1][cluster], np.eye(self.lamps))))
                arriving = jnp.concatenate([arriving, from_lamps.astype(arriving.dtype)], 1)
            for number, basis in enumerate(self.bases):
                here = self.basis[self.region[member]] == number
                if here.any():
                    responses = gather.respond_again(arriving, jnp.asarray(self.frame[member]), basis)
                    response[number][local[member[here]]] = np.asarray(responses)[here].swapaxes(1, 2)
        same = {field.name: getattr(self, field.name) for field in fields(_PathJob)}
        changed = {"response": tuple(response), "components": components, "function": function}
        return AgainJob(**{**same, **changed, "size": max(self.size // 2, min(self.size, _COARSE))})


@dataclass(frozen=True)
class AgainJob(_PathJob):
    """Tensors of two bounces."""

    system: ClassVar[str] = "transfer 2"

    @property
    def texels(self) -> int:
        """Number of texels of the light."""
        return self.response[0].shape[2] // len(self.function) - self.lamps

    @property
    def spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Scales of the functions that send the light of each texel, as a matrix, and its inverse."""
        scale = np.tile(self.scale[self.function], self.texels)
        return np.diag(scale), np.diag(1 / scale)

    @property
    def uniform(self) -> np.ndarray:
        """Light of radiance 1 by white functions."""
        return np.tile(self.white[self.function], self.texels)

    @property
    def header(self) -> Header:
        """What the result depends on."""
        return {**super().header, "function": self.function.tolist()}

    @property
    def layout(self) -> Mapping[str, Layout]:
        """Shapes of one block."""
        functions = len(self.function)
        shape = (1, self.texels, self.components, (DEGREE + 1) ** 2, functions, functions)
        return {
            "weight": Layout((self.step, self.components), 0, "float32"),
            "core": Layout(shape, 0, "float16"),
            "error": Layout((1,), 0, "float32"),
            "white": Layout((self.step,), 0, "float32"),
            **self.lamp_layout(functions, functions),
        }

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """One block."""
        light, lamp = self.tensors(self.member[block])
        scale = self.scale[self.function]
        vertex, core, error = _along_vertices(light * scale, components=self.components)
        core = np.tensordot(core, self.reduced[1], (1, 1))  # [components, harmonic, second function, column]
        core = np.moveaxis(core.reshape(*core.shape[:3], self.texels, -1), 2, -1)
        weight, core = _scaled(vertex, np.moveaxis(core, 2, 1))
        both = scale[:, None] * scale
        rows = {"weight": weight, "core": (core.swapaxes(0, 1) / both).astype(np.float16)[None]}
        rows |= {"error": np.array([error]), "white": self.irradiance(light, self.member[block])}
        rows |= self.lamp_rows(lamp, both)
        return {name: np.asarray(row) for name, row in rows.items()}, 0

    def tensors(self, part: np.ndarray) -> tuple[Float[np.ndarray, "b m s q"], Float[np.ndarray, "b i s q q"]]:
        """The light that arrives at some vertices before compression: for modes of the light, and for lamps."""
        tensor = np.moveaxis(self.arrived(part)[:, :, self.function], 3, 1)
        light, lamp = np.split(tensor, [self.reduced[1].shape[1]], 1)
        lamp = lamp.reshape(len(lamp), self.lamps, len(self.function), *lamp.shape[2:])
        return light, lamp.transpose(0, 1, 3, 2, 4)


def compress(
    tensor: Float[np.ndarray, "m l *f"], *, components: int, modes: int
) -> tuple[Float[np.ndarray, "m n"], Float16[np.ndarray, "e n *f"], Float[np.ndarray, "l e"], float]:
    """Decomposes the tensor of a cluster along the vertices, and then along the light.

    Eigenvectors are LAPACK's, on the host: the matrices are small, and no program is compiled.

    Args:
        tensor: Light that arrives at each vertex for each of some orthonormal modes of the light, for all harmonics and
            functions f.
        components: Number of principal components over the vertices.
        modes: Number of principal components over the light.

    Returns:
        Weights of each vertex, cores scaled to a largest entry of 1, principal components of the light, and the
        relative error.
    """
    whole = _square(tensor)
    vertex, core = _principal(tensor, components, axis=0)
    mode, core = _principal(core, modes, axis=1)
    left = max(whole - _square(core), 0)
    weight, core = _scaled(vertex, core)
    error = math.sqrt(left / whole) if whole > 0 else 0.0
    return weight, core.astype(np.float16).swapaxes(0, 1), mode, error


def _along_vertices(
    tensor: Float[np.ndarray, "m l *f"], *, components: int
) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "n l *f"], float]:
    """Decomposes a tensor along the vertices only: orthonormal weights, cores, and the relative error."""
    whole = _square(tensor)
    vertex, core = _principal(tensor, components, axis=0)
    left = max(whole - _square(core), 0)
    return vertex, core, math.sqrt(left / whole) if whole > 0 else 0.0


@functools.cache
def _spectrum(texels: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrix from texels to wavelets under a natural power spectrum, and its inverse."""
    size = haar.face_edge(texels)
    importance = np.tile(np.asarray(haar.area(size=size), np.float64).ravel(), 6) ** clustered.SPECTRUM
    with jax.ensure_compile_time_eval():
        texel = np.asarray(haar.inverse(jnp.eye(texels).reshape(texels, 6, size, size, 1)), np.float64)
    inverse = texel.reshape(texels, texels).T  # the wavelets are orthonormal
    return importance[:, None] * inverse.T, inverse / importance


def _principal(tensor: np.ndarray, count: int, *, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Leading left singular vectors of a mode of a tensor, and the tensor in their coordinates."""
    flat = np.moveaxis(tensor, axis, 0)
    rows = flat.reshape(len(flat), -1)
    vector = np.linalg.eigh((rows @ rows.T).astype(np.float64))[1][:, : -count - 1 : -1].astype(tensor.dtype)
    return vector, np.moveaxis((vector.T @ rows).reshape(count, *flat.shape[1:]), 0, axis)


def _square(value: np.ndarray) -> float:
    """Squared norm."""
    flat = value.reshape(len(value), -1)
    return float(np.sum(np.einsum("ij,ij->i", flat, flat), dtype=np.float64))


def _scaled(vertex: np.ndarray, core: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights that carry the scale of the core, and the core with a largest entry of 1."""
    size = np.max(np.abs(core), tuple(range(1, core.ndim)), initial=0)  # There may be no functions.
    size = np.where(size > 0, size, 1)
    return vertex * size, core / size.reshape(-1, *[1] * (core.ndim - 1))


@jit
def _expand(weight: Array, core: Array, coarse: Array) -> Array:
    """Light that arrives at the vertices of a cluster from each coarse texel and function, [harmonic, l q, vertex]."""
    # For lamps, `coarse` is the identity.
    sent = jnp.einsum("le,ensq->nslq", coarse, core.astype(weight.dtype))
    return jnp.einsum("mn,nslq->slqm", weight, sent).reshape(core.shape[2], -1, len(weight))
