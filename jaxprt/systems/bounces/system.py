"""Bounces as a system: light, shade, view, combine and points."""

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
    """Light that surfaces have reflected at least once, without direct light; `jaxprt.total` adds the two.

    Attributes:
        tensor: Transfer tensor from `jaxprt.bounces.precompute`.
        direct: The system of direct light, which defines the regions, BRDFs and materials.
    """

    tensor: TransferTensor
    direct: dynamic.SetSystem

    def __check_init__(self):
        """Refuses other kinds of tensors and systems, and different numbers of vertices."""
        require.kind("the tensor", self.tensor, TransferTensor, source="jaxprt.bounces.precompute")
        require.kind("the direct system", self.direct, dynamic.SetSystem, source="jaxprt.dynamic.SetSystem")
        count = len(self.direct.transport.place)
        if len(self.tensor.place) != count:
            raise ValueError(f"the tensor must have the transport's {count} vertices, got {len(self.tensor.place)}")

    def light(self, environment: Environment) -> LitTransfer:
        """Applies the tensor to a light, before materials are known: `jaxprt.bounces.light_side`."""
        return light_side(self.tensor, environment)

    def shade(self, light: LitTransfer, materials: Sequence[Material | None] | None = None) -> tuple[Arriving, ...]:
        """Reflected light that arrives at each region, given all materials: `jaxprt.bounces.arriving`."""
        require.kind("the light", light, LitTransfer, source="BouncesSystem.light")
        return arriving(self.direct.transport, self.tensor, light, self.direct.given(materials))

    def view(
        self, eye: Float[Array, "3"], materials: Sequence[Material | None] | None = None
    ) -> tuple[ReflectedView, ...]:
        """How each region reflects the arriving light to the eye: `jaxprt.bounces.view_side`."""
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
        """The same system at points of each region; see `SetSystem.at`."""
        return BouncesSystem(self.tensor, self.direct.at(points))

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points if the system was moved to points by `at`."""
        return self.direct.vertices
