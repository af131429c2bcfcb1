"""The dynamic system: its four verbs."""

from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points
from jaxprt.systems import protocol
from jaxprt.systems.dynamic.brdf_set import DynamicBrdf
from jaxprt.systems.dynamic.relight import DynamicLight, DynamicView, Material, combine, light_side, view_side
from jaxprt.systems.dynamic.transport import DynamicTransport
from jaxprt.systems.separable import SeparableBrdf


class DynamicSystem(protocol.System):
    """Transport by regions, and for each region a set of BRDFs among which its material moves. Direct light.

    Materials are one `Material` for each region, None for one that has its BRDF for good.

    Attributes:
        transport: From `jaxprt.dynamic.precompute`.
        brdf: One for each region, from `jaxprt.dynamic.factor` or `jaxprt.separable.factor`.
        texels: How many of the brightest texels light the vertices one by one.
        samples: Points along the edge of each at which the BRDF is taken, see `jaxprt.bright_texels.samples_for`.
        points: Where in each region radiance is asked for; None for the vertices.
    """

    transport: DynamicTransport
    brdf: tuple[DynamicBrdf | SeparableBrdf, ...] = eqx.field(converter=tuple)
    texels: int = eqx.field(static=True, default=16)
    samples: int = eqx.field(static=True, default=1)
    points: tuple[Points, ...] | None = None

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems."""
        require.kind("the transport", self.transport, DynamicTransport, source="jaxprt.dynamic.precompute")
        source = "jaxprt.dynamic.factor or jaxprt.separable.factor"
        for number, each in enumerate(self.brdf):
            require.kind(f"the BRDF of region {number}", each, DynamicBrdf, SeparableBrdf, source=source)
        if len(self.brdf) != len(self.transport.region):
            raise ValueError(
                f"BRDFs must be one for each of {len(self.transport.region)} regions, got {len(self.brdf)}"
            )

    def light(self, environment: Environment) -> DynamicLight:
        """What a light is for all regions: `jaxprt.dynamic.light_side`."""
        return light_side(self.transport, environment, texels=self.texels)

    def view(self, eye: Float[Array, "3"], materials: Sequence[Material | None] | None = None) -> DynamicView:
        """What a view and all materials are: `jaxprt.dynamic.view_side`."""
        return view_side(self.transport, self.brdf, self.given(materials), eye=eye, points=self.points)

    def combine(self, light: DynamicLight, view: DynamicView) -> Float[Array, "v c"]:
        """Radiance of direct light."""
        require.kind("the light", light, DynamicLight, source="DynamicSystem.light")
        require.kind("the view", view, DynamicView, source="DynamicSystem.view")
        return combine(self.transport, light, view, samples=self.samples)

    def given(self, materials: Sequence[Material | None] | None) -> Sequence[Material | None]:
        """The materials; where none are given, None for each region.

        Raises:
            TypeError: They are no sequence.
        """
        if materials is None:
            return [None] * len(self.brdf)
        if not isinstance(materials, Sequence):
            raise TypeError(f"the materials must be a list, one for each region, got {type(materials).__name__}")
        return materials

    def at(self, points: Sequence[Points]) -> "DynamicSystem":
        """Points of each region, numbered as its vertices are, one list after the other: `System.at`."""
        given = protocol.check_points(points, [len(each.seen.position) for each in self.transport.region])
        return eqx.tree_at(lambda each: each.points, self, given, is_leaf=lambda each: each is None)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return len(self.transport.place) if self.points is None else sum(map(len, self.points))
