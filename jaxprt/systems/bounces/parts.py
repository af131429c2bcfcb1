"""Light that the parts of a scene reflect onto each other, for groups of parts with one BRDF.

Each group has one BRDF with channels that textures weight at its vertices, and all its parts send light with the same
functions. The weights of these functions are those of each part's mean material. Here, several parts whose light has
one mean material count as one part.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import jit, promoted
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.systems import harmonic
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bounces.relight import LitTransfer, collect, light_side
from jaxprt.systems.bounces.tensor import TransferTensor
from jaxprt.systems.bounces.varying import Sent
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.protocol import Blend


class ReflectingPart(eqx.Module):
    """Vertices with one BRDF, with which they reflect arriving light that is given in harmonics.

    Attributes:
        position: Positions of the vertices.
        frame: Frames of the vertices; rows are tangent, bitangent, normal.
        brdf: Table of degree 3, from `jaxprt.harmonic.tabulate`.
        sent: Weights of the tensor's functions for each channel of `brdf` and each roughness. None if the channels of
            both are the same, and light that is sent to other surfaces has one roughness.
    """

    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    brdf: HarmonicBrdf
    sent: Sent | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        """Refuses tables of another degree than that of the arriving light."""
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != DEGREE:
            raise ValueError(f"the BRDF must have degree {DEGREE}, that of reflected light, got {self.brdf.degree}")

    def view(
        self, eye: Float[Array, "*p 3"], blend: Blend | None, points: Points | None = None
    ) -> Float[Array, "lm _ _"]:
        """Harmonics of the BRDF at each vertex or point for its view direction. `blend` holds the weights there."""
        return harmonic.blended_view(self.brdf, *placed(self.position, self.frame, points), blend, eye=eye)

    def combine(
        self, light: Float[Array, "lm _ _"], view: Float[Array, "lm _ _"], points: Points | None = None
    ) -> Float[Array, "_ e"]:
        """Radiance of reflected light. `light` is what arrives at the vertices."""
        return harmonic.combine(light if points is None else points.carry(light, axis=2), view)


class Members(eqx.Module):
    """Where the vertices of a group stand in the scene.

    Attributes:
        vertex: Index of each vertex of the group in the scene; padding repeats the last one.
        part: Index of the part of each vertex, among the parts of the group.
        area: Surface area that each vertex represents; 0 in padding.
        parts: Number of parts of the group.
    """

    vertex: Int[Array, " v"]
    part: Int[Array, " v"]
    area: Float[Array, " v"]
    parts: int = eqx.field(static=True)

    def mean(self, value: Float[Array, "v *k"]) -> Float[Array, "r *k"]:
        """Means of a value of the vertices over the area of each part; zero for a part without area."""
        wide = self.area.reshape(-1, *[1] * (value.ndim - 1))
        total, whole = (jax.ops.segment_sum(each, self.part, self.parts) for each in (wide * value, self.area))
        return total / jnp.where(whole > 0, whole, 1).reshape(-1, *[1] * (value.ndim - 1))


class GroupBounces(eqx.Module):
    """Light that the parts of a scene reflect onto each other and themselves, without direct light.

    Light that a part sends to other surfaces has the mean weights and roughness over its area. Differences in albedo
    are added patch by patch, as diffuse light. Light that a part sends to the eye has the weights and roughness of each
    vertex or point.

    Attributes:
        tensor: Transfer tensor from `jaxprt.bounces.precompute`, whose regions are the parts. It is made with one
            factored BRDF for each part, the same for all parts of a group.
        group: The vertices of each group, and their BRDF.
        members: Where the vertices of each group stand.
        factor: Weights of the functions of each part of a group, as in `TransferTensor.factor`.
        strength: Albedo of these functions; None without patches.
        order: Index of each function of the tensor among the functions of all groups, part by part.
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
        """Joins the parts of each group.

        Args:
            tensor: The tensor, whose regions are the parts.
            group: The vertices of each group, and then padding.
            vertices: Index in the scene of each vertex of a group, without padding.

        Raises:
            TypeError: `tensor` is not a `TransferTensor`.
            ValueError: The tensor is of sets, or of other parts or vertices.
        """
        require.kind("the tensor", tensor, TransferTensor, source="jaxprt.bounces.precompute")
        region, area = np.asarray(tensor.region), np.asarray(tensor.area)
        own = [np.unique(region[vertex], return_inverse=True) for vertex in vertices]
        numbers = np.concatenate([number for number, _ in own]).tolist()
        found = [each.ndim for each in tensor.factor]
        if found != [2] * len(numbers):
            raise ValueError(
                f"the tensor must have one factored BRDF for each of {len(numbers)} parts, got {len(found)} BRDFs, "
                f"{sum(each > 2 for each in found)} of them sets"
            )
        members = []
        for each, vertex, (number, part) in zip(group, vertices, own, strict=True):
            room = len(each.position) - len(vertex)
            if room < 0:
                raise ValueError(f"a group must have the tensor's {len(vertex)} vertices, got {len(each.position)}")
            rows = (np.pad(row, (0, room), mode="edge").astype(np.int32) for row in (vertex, part))
            at_vertex, at_part, whole = jax.device_put((*rows, np.pad(area[vertex], (0, room)).astype(area.dtype)))
            members.append(Members(at_vertex, at_part, whole, len(number)))
        size = [len(factor) for factor in tensor.factor]
        start = np.empty(len(size), int)  # of the functions of each part, among those of all groups
        start[numbers] = np.cumsum([0, *(size[number] for number in numbers)])[:-1]
        order = np.concatenate([start[number] + np.arange(size[number]) for number in range(len(size))])
        place, begin = np.empty(len(region), np.int32), 0
        for each, vertex in zip(group, vertices, strict=True):
            place[vertex] = begin + np.arange(len(vertex))
            begin += len(each.position)
        kept = order[np.asarray(tensor.function)].astype(np.int32)
        first = [number[0] for number, _ in own]
        strength = [None if tensor.patches is None else tensor.patches.strength[number] for number in first]
        factor, rows = tuple(tensor.factor[number] for number in first), jax.device_put((kept, place))
        return cls(tensor, tuple(group), tuple(members), factor, tuple(strength), *rows)

    @promoted
    def light(self, environment: Environment) -> LitTransfer:
        """Applies the tensor to a light, before materials are known: `jaxprt.bounces.light_side`."""
        return light_side(self.tensor, environment)

    @promoted
    def shade(self, light: LitTransfer, materials: Sequence[Blend | None]) -> tuple[Float[Array, "lm _ _"], ...]:
        """Harmonics of the light that arrives at the vertices of each group, in their frames, given all materials.

        Args:
            light: The result of `light`.
            materials: Weights at the vertices of each group; None for a group with a BRDF that cannot change.
        """
        require.kind("the light", light, LitTransfer, source="GroupBounces.light")
        return _arriving(self, light, tuple(materials))


@jit
def _arriving(
    system: GroupBounces, light: LitTransfer, materials: tuple[Blend | None, ...]
) -> tuple[Float[Array, "lm _ _"], ...]:
    rows, changes = [], []
    for own, members, factor, strength, blend in zip(
        system.group, system.members, system.factor, system.strength, materials, strict=True
    ):
        sent, change = _sent(own, members, factor, strength, blend)
        rows.append(sent.reshape(-1, sent.shape[-1]))
        changes.append(change)
    weight, change = _stacked(rows)[system.order], None
    if any(each is not None for each in changes):
        none = [jnp.zeros((len(own.position), 1), own.position.dtype) for own in system.group]
        pairs = zip(changes, none, strict=True)
        change = _stacked([zero if each is None else each for each, zero in pairs])[system.place]
    arriving = collect(system.tensor, light, weight, change=change)
    pairs = zip(system.group, system.members, strict=True)
    return tuple(harmonic.local_light(own.frame, arriving[..., members.vertex]) for own, members in pairs)


def _stacked(rows: Sequence[Float[Array, "_ _"]]) -> Float[Array, "_ c"]:
    """Rows one after another. Gray ones are repeated to the colors of the others."""
    colors = max(each.shape[1] for each in rows)
    return jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])


def _sent(
    own: ReflectingPart, members: Members, factor: Array, strength: Array | None, blend: Blend | None
) -> tuple[Float[Array, "r q _"], Float[Array, "v c"] | None]:
    """Weights of the functions of each part of a group; and the albedo of each vertex minus that of its part's mean."""
    if blend is None:
        return jnp.broadcast_to(factor, (members.parts, *factor.shape)), None
    blend.check(len(own.position), factor.shape[1] if own.sent is None else own.sent.factor.shape[1])
    weight = blend.weight if own.sent is None else own.sent.weights(blend)
    mean = members.mean(weight)
    change = None
    if strength is not None:
        albedo = jnp.matmul(strength, factor, precision="highest")
        change = jnp.einsum("k,vkc->vc", albedo, weight - mean[members.part], precision="highest")
    return jnp.einsum("qk,rkc->rqc", factor, mean, precision="highest"), change
