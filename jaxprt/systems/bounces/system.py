"""Bounces: their four verbs."""

from collections.abc import Sequence

from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points
from jaxprt.systems import dynamic, protocol
from jaxprt.systems.bounces.relight import (
    Arriving,
    LitTransfer,
    ReflectedView,
    arriving,
    combine,
    light_side,
    view_side,
)
from jaxprt.systems.bounces.tensor import TransferTensor
from jaxprt.systems.dynamic import Material


class BouncesSystem(protocol.System):
    """Light that surfaces have reflected once and twice, without the direct light: `jaxprt.total` adds that.

    Attributes:
        tensor: From `jaxprt.bounces.precompute`.
        direct: The system of direct light, whose regions, BRDFs and materials these are.
    """

    tensor: TransferTensor
    direct: dynamic.DynamicSystem

    def __check_init__(self):
        """Refuses other tensors, systems of other kinds, and unlike numbers of vertices."""
        require.kind("the tensor", self.tensor, TransferTensor, source="jaxprt.bounces.precompute")
        require.kind("the direct system", self.direct, dynamic.DynamicSystem, source="jaxprt.dynamic.DynamicSystem")
        count = len(self.direct.transport.place)
        if len(self.tensor.place) != count:
            raise ValueError(f"the tensor must be of the transport's {count} vertices, got {len(self.tensor.place)}")

    def light(self, environment: Environment) -> LitTransfer:
        """What bounces make of a light, for all materials: `jaxprt.bounces.light_side`."""
        return light_side(self.tensor, environment)

    def shade(self, light: LitTransfer, materials: Sequence[Material | None] | None = None) -> tuple[Arriving, ...]:
        """What arrives at each region, with all materials: `jaxprt.bounces.arriving`."""
        require.kind("the light", light, LitTransfer, source="BouncesSystem.light")
        return arriving(self.direct.transport, self.tensor, light, self.direct.given(materials))

    def view(
        self, eye: Float[Array, "3"], materials: Sequence[Material | None] | None = None
    ) -> tuple[ReflectedView, ...]:
        """What each region sends to the eye of what arrives: `jaxprt.bounces.view_side`."""
        points = self.direct.points
        surfaces = dynamic.mix(self.direct.transport, self.direct.brdf, self.direct.given(materials), points=points)
        return view_side(self.direct.transport, surfaces, eye=eye, points=points)

    def combine(self, light: tuple[Arriving, ...], view: tuple[ReflectedView, ...]) -> Float[Array, "v c"]:
        """Radiance of reflected light."""
        for each in light if isinstance(light, tuple) else (light,):
            require.kind("the light", each, Arriving, source="BouncesSystem.shade")
        for each in view if isinstance(view, tuple) else (view,):
            require.kind("the view", each, ReflectedView, source="BouncesSystem.view")
        return combine(self.direct.transport, light, view, points=self.direct.points)

    def at(self, points: Sequence[Points]) -> "BouncesSystem":
        """Points of each region, as of the direct system: `System.at`."""
        return BouncesSystem(self.tensor, self.direct.at(points))

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return self.direct.vertices
