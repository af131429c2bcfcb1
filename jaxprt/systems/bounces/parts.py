"""Bounces between the parts of a scene. Each part has one BRDF with channels that textures weight at its vertices."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import promoted
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.systems import harmonic, protocol
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bounces.relight import LitTransfer, area_mean, collect, gathered, light_side
from jaxprt.systems.bounces.tensor import TransferTensor
from jaxprt.systems.bounces.varying import Sent
from jaxprt.systems.harmonic import HarmonicBrdf
from jaxprt.systems.protocol import Blend


class ReflectingPart(eqx.Module):
    """The vertices of a part, and the BRDF with which they reflect arriving light that is given in harmonics.

    Attributes:
        position: Positions of the vertices.
        frame: Frames of the vertices; rows are tangent, bitangent, normal.
        brdf: Table of degree 3, from `jaxprt.harmonic.tabulate`.
        sent: Weights of the tensor's functions for each channel of `brdf` and each roughness. None if the channels of
            both are the same, and light that the part sends to others has one roughness.
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


class PartBounces(protocol.System):
    """Light that the parts of a scene reflect onto each other and themselves, without direct light.

    Materials are a list with one `Blend` for each part, None for a part that keeps its tabulated BRDF. Light that a
    part sends to other surfaces has the mean weights and roughness over its area. Differences in albedo are added patch
    by patch, as diffuse light. Light that a part sends to the eye has the weights and roughness of each vertex.

    Attributes:
        tensor: Transfer tensor from `jaxprt.bounces.precompute`, made with one factored BRDF for each part, with the
            same channels.
        part: The parts, in the order of the tensor's vertices.
        points: Points on each part at which radiance is computed; None for the vertices.
    """

    tensor: TransferTensor
    part: tuple[ReflectingPart, ...] = eqx.field(converter=tuple)
    points: tuple[Points, ...] | None = None

    def __check_init__(self):
        """Refuses tensors of sets, of other vertices, or of parts in another order."""
        require.kind("the tensor", self.tensor, TransferTensor, source="jaxprt.bounces.precompute")
        counts = [len(each.position) for each in self.part]
        found = [each.ndim for each in self.tensor.factor]
        if found != [2] * len(counts):
            raise ValueError(
                f"the tensor must have one factored BRDF for each of {len(counts)} parts, got {len(found)} BRDFs, "
                f"{sum(each > 2 for each in found)} of them sets"
            )
        if len(self.tensor.place) != sum(counts):
            raise ValueError(f"the tensor must have the parts' {sum(counts)} vertices, got {len(self.tensor.place)}")
        if isinstance(self.tensor.region, Tracer):
            return
        if np.any(np.asarray(self.tensor.region) != np.repeat(np.arange(len(counts)), counts)):
            raise ValueError("the tensor's regions must be the parts in the same order, got other regions")

    @promoted
    def light(self, environment: Environment) -> LitTransfer:
        """Applies the tensor to a light, before materials are known: `jaxprt.bounces.light_side`."""
        return light_side(self.tensor, environment)

    @promoted
    def shade(
        self, light: LitTransfer, materials: Sequence[Blend | None] | None = None
    ) -> tuple[Float[Array, "lm _ _"], ...]:
        """Harmonics of the light that arrives at the vertices of each part, in their frames, given all materials."""
        require.kind("the light", light, LitTransfer, source="PartBounces.light")
        blends = list(zip(self.part, self._given(materials), strict=True))
        means = [self._mean(number, *each) for number, each in enumerate(blends)]
        rows = [
            own if mean is None else jnp.matmul(own, mean, precision="highest")
            for own, mean in zip(self.tensor.factor, means, strict=True)
        ]
        arriving = collect(self.tensor, light, gathered(self.tensor, rows), change=self._changes(blends, means))
        each = jnp.split(arriving, np.cumsum([len(part.position) for part in self.part])[:-1], -1)
        return tuple(harmonic.local_light(part.frame, own) for part, own in zip(self.part, each, strict=True))

    @promoted
    def view(
        self, eye: Float[Array, "3"], materials: Sequence[Blend | None] | None = None
    ) -> tuple[Float[Array, "lm _ _"], ...]:
        """Harmonics of the BRDF at each vertex or point for its view direction."""
        eye = require.position("the eye", eye)
        rows = zip(self.part, self._given(materials), self._points(), strict=True)
        return tuple(part.view(eye, own, points) for part, own, points in rows)

    @promoted
    def combine(
        self, light: tuple[Float[Array, "lm _ _"], ...], view: tuple[Float[Array, "lm _ _"], ...]
    ) -> Float[Array, "_ e"]:
        """Radiance of reflected light."""
        require.kind("the light", light, tuple, source="PartBounces.shade")
        require.kind("the view", view, tuple, source="PartBounces.view")
        sides = zip(self.part, light, view, self._points(), strict=True)
        rows = [part.combine(arriving, seen, points) for part, arriving, seen, points in sides]
        colors = max(each.shape[1] for each in rows)
        return jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])

    def at(self, points: Sequence[Points]) -> "PartBounces":
        """The same system at points on each part, concatenated; see `System.at`. `shade` still uses the vertices."""
        given = protocol.check_points(points, [len(each.position) for each in self.part])
        return eqx.tree_at(lambda each: each.points, self, given, is_leaf=lambda each: each is None)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points if the system was moved to points by `at`."""
        return len(self.tensor.place) if self.points is None else sum(map(len, self.points))

    def _points(self) -> Sequence[Points | None]:
        return [None] * len(self.part) if self.points is None else self.points

    def _mean(self, number: int, part: ReflectingPart, blend: Blend | None) -> Float[Array, "k c"] | None:
        """Mean weights of the tensor's functions over a part's area; None without a blend."""
        if blend is None:
            return None
        channels = self.tensor.factor[number].shape[1] if part.sent is None else part.sent.factor.shape[1]
        blend.check(len(part.position), channels)
        first = sum(len(each.position) for each in self.part[:number])
        area = self.tensor.area[first : first + len(part.position)]
        return area_mean(blend.weight, area) if part.sent is None else part.sent.mean(blend, area)

    def _changes(self, blends: Sequence, means: Sequence[Array | None]) -> Float[Array, "v c"] | None:
        """Albedo of each vertex minus the mean of its part; None without blends or patches."""
        if self.tensor.patches is None or not any(mean is not None for mean in means):
            return None
        rows = []
        for number, ((part, blend), mean) in enumerate(zip(blends, means, strict=True)):
            if mean is None:
                rows.append(jnp.zeros((len(part.position), 1), part.position.dtype))
                continue
            channel = jnp.matmul(self.tensor.patches.strength[number], self.tensor.factor[number], precision="highest")
            if part.sent is None:
                rows.append(jnp.einsum("k,vkc->vc", channel, blend.weight - mean, precision="highest"))
            else:
                rows.append(part.sent.values(blend, channel) - jnp.matmul(channel, mean, precision="highest"))
        colors = max(each.shape[1] for each in rows)
        return jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])

    def _given(self, materials: Any) -> Sequence[Blend | None]:
        if materials is None:
            return [None] * len(self.part)
        if not isinstance(materials, Sequence) or len(materials) != len(self.part):
            raise TypeError(f"the materials must be a list, one for each of {len(self.part)} parts, got {materials}")
        for each in materials:
            protocol.check_blend(each)
        return materials
