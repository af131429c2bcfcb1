"""Light that the parts of a scene reflect onto each other, for groups of parts with one BRDF.

Each group has one BRDF with channels that textures weight at its vertices. It consists of one or more regions of the
transfer tensor: a part, or several parts of similar materials. All regions of a group send light with the same
functions, weighted by the mean material of each region.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import jit, promoted
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.systems import harmonic
from jaxprt.systems.bounces import traced
from jaxprt.systems.bounces.functions import FunctionWeights
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bounces.tensor import LitTransfer, TransferTensor, collect, light_side
from jaxprt.systems.bounces.traced import ReflectionRays
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.table import LobeMixture
from jaxprt.systems.protocol import Blend


class ReflectingPart(eqx.Module):
    """Vertices with one BRDF, with which they reflect arriving light.

    Light arrives in harmonics. With `lobe`, rays stand for what is too sharp for them: `view` omits it, and `rays` and
    `weights` give the rays.

    Attributes:
        position: Positions of the vertices.
        frame: Frames of the vertices; rows are tangent, bitangent, normal.
        brdf: Table of degree 3, from `jaxprt.harmonic.tabulate`.
        sent: Weights of the tensor's functions for each channel of `brdf` and each roughness. None if the channels of
            both are the same, and light that is sent to other surfaces has one roughness.
        lobe: The BRDF as lobes, from `jaxprt.lobe.tabulate`, with the channels and parameters of `brdf`, whose narrow
            lobes rays represent; None to reflect by harmonics alone.
        count: Number of rays of each vertex or point.
    """

    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    brdf: HarmonicBrdf
    sent: FunctionWeights | None = eqx.field(default=None, kw_only=True)
    lobe: LobeBrdf | None = eqx.field(default=None, kw_only=True)
    count: int = eqx.field(static=True, default=8, kw_only=True)

    def __check_init__(self):
        """Refuses tables of other kinds or of another degree than the arriving light, and numbers of rays below 1."""
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != DEGREE:
            raise ValueError(f"the BRDF must have degree {DEGREE}, that of reflected light, got {self.brdf.degree}")
        if self.lobe is not None:
            require.kind("the lobes", self.lobe, LobeBrdf, source="jaxprt.lobe.tabulate")
            require.at_least("the number of rays", np.asarray(self.count), 1.0)

    @property
    def harmonics_alone(self) -> "ReflectingPart":
        """The same part without rays."""
        return self if self.lobe is None else dataclasses.replace(self, lobe=None)

    def view(
        self,
        eye: Float[Array, "*p 3"],
        blend: Blend | None,
        points: Points = VERTICES,
        seen: Float[Array, " _"] | None = None,
    ) -> Float[Array, "lm _ _"]:
        """Harmonics of the BRDF at each vertex or point for its view direction, without what rays represent.

        Args:
            eye: Position of the viewer.
            blend: Weights and parameters of the channels at the vertices or points.
            points: The points; by default the vertices.
            seen: Factor of what rays represent, at each vertex or point; None for 1.
        """
        whole = harmonic.system.blended_view(self.brdf, *placed(self.position, self.frame, points), blend, eye=eye)
        return whole if self.lobe is None else whole - self.carried(eye, blend, points, seen)

    def carried(
        self,
        eye: Float[Array, "*p 3"],
        blend: Blend | None,
        points: Points = VERTICES,
        seen: Float[Array, " _"] | None = None,
    ) -> Float[Array, "lm _ _"]:
        """Harmonics of what rays represent. The arguments are those of `view`."""
        return traced.harmonics_of(self._lobes(eye, _parameter(blend), points), blend, seen)

    def combine(
        self, light: Float[Array, "lm _ _"], view: Float[Array, "lm _ _"], points: Points = VERTICES
    ) -> Float[Array, "_ e"]:
        """Radiance of reflected light, without what rays represent. `light` is what arrives at the vertices."""
        return harmonic.system.combine(points.carry(light, axis=2), view)

    def rays(
        self,
        eye: Float[Array, "3"],
        parameter: tuple[Float[Array, " _"], ...],
        points: Points = VERTICES,
        seen: Float[Array, " _"] | None = None,
    ) -> ReflectionRays:
        """The rays of each vertex or point. Colors do not change them.

        Args:
            eye: Position of the viewer.
            parameter: Parameters of the table at the vertices or points, as in `Blend`.
            points: The points; by default the vertices.
            seen: Factor of what rays represent, at each vertex or point; None for 1.
        """
        position, frame = placed(self.position, self.frame, points)
        return traced.quantiles(self._lobes(eye, parameter, points), seen, position, frame, count=self.count)

    def weights(
        self,
        rays: ReflectionRays,
        eye: Float[Array, "3"],
        blend: Blend | None,
        points: Points = VERTICES,
        seen: Float[Array, " _"] | None = None,
    ) -> Float[Array, "j _ c"]:
        """Factor of the radiance along each ray. The sum over the rays of a point is the albedo of its traced lobes."""
        return traced.weights(self._lobes(eye, _parameter(blend), points), rays, blend, seen)

    def _lobes(self, eye: Array, parameter: tuple[Array, ...], points: Points) -> LobeMixture:
        if self.lobe is None:
            raise ValueError("rays need a part with lobes, got one that reflects by harmonics alone")
        return traced.lookup(self.lobe, *placed(self.position, self.frame, points), eye, parameter)


def _parameter(blend: Blend | None) -> tuple[Array, ...]:
    return () if blend is None else blend.parameter


class Members(eqx.Module):
    """Where the vertices of a group stand in the scene.

    Attributes:
        vertex: Index of each vertex of the group in the scene; padding repeats the last one.
        region: Index of the region of each vertex, among the regions of the group.
        area: Surface area that each vertex represents; 0 in padding.
        regions: Number of regions of the group.
    """

    vertex: Int[Array, " v"]
    region: Int[Array, " v"]
    area: Float[Array, " v"]
    regions: int = eqx.field(static=True)

    def mean(self, value: Float[Array, " v *k"]) -> Float[Array, " r *k"]:
        """Means of a value of the vertices over the area of each region; zero for a region without area."""
        wide = self.area.reshape(-1, *[1] * (value.ndim - 1))
        total, whole = (jax.ops.segment_sum(column, self.region, self.regions) for column in (wide * value, self.area))
        return total / jnp.where(whole > 0, whole, 1).reshape(-1, *[1] * (value.ndim - 1))


class GroupBounces(eqx.Module):
    """Light that the parts of a scene reflect onto each other and themselves, without direct light.

    Light that a region sends to other surfaces has the mean weights and roughness over its area. Differences in albedo
    are added patch by patch, as diffuse light. Light that a region sends to the eye has the weights and roughness of
    each vertex or point.

    Attributes:
        tensor: Transfer tensor from `jaxprt.bounces.precompute`, with one factored BRDF for each region, the same for
            all regions of a group.
        group: The vertices of each group, and their BRDF.
        members: Where the vertices of each group stand.
        factor: Weights of the functions of each region of a group, as in `TransferTensor.factor`.
        strength: Albedo of these functions; None without patches.
        order: Index of each function of the tensor among the functions of all groups, region by region.
        place: Index of each vertex of the scene among the vertices of all groups.
    """

    tensor: TransferTensor
    group: tuple[ReflectingPart, ...] = eqx.field(converter=tuple)
    members: tuple[Members, ...] = eqx.field(converter=tuple)
    factor: tuple[Float[Array, "_ _"], ...]
    strength: tuple[Float[Array, " _"] | None, ...]
    order: Int[Array, " q"]
    place: Int[Array, " v"]

    @classmethod
    def make(
        cls, tensor: TransferTensor, group: Sequence[ReflectingPart], vertices: Sequence[Int[np.ndarray, " _"]]
    ) -> "GroupBounces":
        """Joins the regions of each group.

        Args:
            tensor: The tensor. Each of its regions lies in one group.
            group: The vertices of each group, and then padding.
            vertices: Index in the scene of each vertex of a group, without padding.

        Raises:
            TypeError: `tensor` is not a `TransferTensor`.
            ValueError: The tensor is of other regions or vertices.
        """
        require.kind("the tensor", tensor, TransferTensor, source="jaxprt.bounces.precompute")
        region, area = np.asarray(tensor.region), np.asarray(tensor.area)
        regions = [np.unique(region[vertex], return_inverse=True) for vertex in vertices]
        numbers = np.concatenate([number for number, _ in regions]).tolist()
        if len(tensor.factor) != len(numbers):
            raise ValueError(
                f"the tensor must have a BRDF for each of {len(numbers)} regions, got {len(tensor.factor)}"
            )
        members = []
        for surface, vertex, (number, of_vertex) in zip(group, vertices, regions, strict=True):
            room = len(surface.position) - len(vertex)
            if room < 0:
                raise ValueError(f"a group must have the tensor's {len(vertex)} vertices, got {len(surface.position)}")
            index = (np.pad(row, (0, room), mode="edge").astype(np.int32) for row in (vertex, of_vertex))
            columns = jax.device_put((*index, np.pad(area[vertex], (0, room)).astype(area.dtype)))
            members.append(Members(*columns, regions=len(number)))
        size = [len(factor) for factor in tensor.factor]
        start = np.empty(len(size), int)  # of the functions of each region, among those of all groups
        start[numbers] = np.cumsum([0, *(size[number] for number in numbers)])[:-1]
        order = np.concatenate([start[number] + np.arange(size[number]) for number in range(len(size))])
        place, begin = np.empty(len(region), np.int32), 0
        for surface, vertex in zip(group, vertices, strict=True):
            place[vertex] = begin + np.arange(len(vertex))
            begin += len(surface.position)
        of_tensor = order[np.asarray(tensor.function)].astype(np.int32)
        first = [number[0] for number, _ in regions]
        strength = [None if tensor.patches is None else tensor.patches.strength[number] for number in first]
        factor, rows = tuple(tensor.factor[number] for number in first), jax.device_put((of_tensor, place))
        return cls(tensor, tuple(group), tuple(members), factor, tuple(strength), *rows)

    @promoted
    def light(self, environment: Environment) -> LitTransfer:
        """Applies the tensor to a light, before materials are known."""
        return light_side(self.tensor, environment)

    @promoted
    def shade(
        self, light: LitTransfer, materials: Sequence[Blend | None], lamp: Float[Array, "i c"] | None = None
    ) -> tuple[Float[Array, "lm _ _"], ...]:
        """Harmonics of the light that arrives at the vertices of each group, in their frames, given all materials.

        Args:
            light: The result of `light`.
            materials: Weights at the vertices of each group; None for a group with a BRDF that cannot change.
            lamp: Radiance of each lamp; None for lamps that are off, and without lamps.

        Raises:
            ValueError: The tensor was made for another number of lamps.
        """
        require.kind("the light", light, LitTransfer, source="GroupBounces.light")
        if lamp is not None:
            require.length("rows of the lamps' radiance", lamp, self.tensor.lamps)
        return _arriving(self, light, tuple(materials), lamp)


@jit
def _arriving(
    system: GroupBounces, light: LitTransfer, materials: tuple[Blend | None, ...], lamp: Array | None
) -> tuple[Float[Array, "lm _ _"], ...]:
    rows, changes = [], []
    for part, members, factor, strength, blend in zip(
        system.group, system.members, system.factor, system.strength, materials, strict=True
    ):
        sent, change = _sent(part, members, factor, strength, blend)
        rows.append(sent.reshape(-1, sent.shape[-1]))
        changes.append(change)
    weight, change = _stacked(rows)[system.order], None
    if any(rows is not None for rows in changes):
        none = [jnp.zeros((len(part.position), 1), part.position.dtype) for part in system.group]
        pairs = zip(changes, none, strict=True)
        change = _stacked([zero if rows is None else rows for rows, zero in pairs])[system.place]
    arriving = collect(system.tensor, light, weight, change=change, lamp=lamp)
    pairs = zip(system.group, system.members, strict=True)
    return tuple(harmonic.system.local_light(part.frame, arriving[..., members.vertex]) for part, members in pairs)


def _stacked(rows: Sequence[Float[Array, "_ _"]]) -> Float[Array, "_ c"]:
    """Rows one after another. Gray ones are repeated to the colors of the others."""
    colors = max(row.shape[1] for row in rows)
    return jnp.concatenate([jnp.broadcast_to(row, (len(row), colors)) for row in rows])


def _sent(
    part: ReflectingPart, members: Members, factor: Array, strength: Array | None, blend: Blend | None
) -> tuple[Float[Array, "r q _"], Float[Array, "v c"] | None]:
    """Weights of the functions of each region of a group, and each vertex's albedo minus that of its region's mean."""
    if blend is None:
        return jnp.broadcast_to(factor, (members.regions, *factor.shape)), None
    blend.check(len(part.position), factor.shape[1] if part.sent is None else part.sent.factor.shape[1])
    weight = blend.weight if part.sent is None else part.sent.weights(blend)
    mean = members.mean(weight)
    change = None
    if strength is not None:
        albedo = jnp.matmul(strength, factor, precision="highest")
        change = jnp.einsum("k,vkc->vc", albedo, weight - mean[members.region], precision="highest")
    return jnp.einsum("qk,rkc->rqc", factor, mean, precision="highest"), change
