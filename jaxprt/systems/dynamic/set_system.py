"""The dynamic system: light, view, combine and points."""

from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points
from jaxprt.systems import protocol
from jaxprt.systems.dynamic.brdf_set import BrdfSet
from jaxprt.systems.dynamic.set_relight import Material, SetLight, SetView, combine, light_side, view_side
from jaxprt.systems.dynamic.set_transport import SetTransport
from jaxprt.systems.separable import SeparableBrdf


class SetSystem(protocol.System):
    """Direct light on a mesh of regions. Each region has a set of BRDFs, within which its material can change.

    Materials are a list with one `Material` for each region, None for a region with one fixed BRDF.

    Attributes:
        transport: Transport from `jaxprt.dynamic.precompute_sets`.
        brdf: BRDF of each region, from `jaxprt.dynamic.factor` or `jaxprt.separable.factor`.
        texels: Number of brightest texels that are summed one by one.
        samples: Number of points along the edge of each of them at which the BRDF is evaluated; see
            `jaxprt.bright_texels.samples_for`.
        points: Points on each region at which radiance is computed; None for the vertices.
    """

    transport: SetTransport
    brdf: tuple[BrdfSet | SeparableBrdf, ...] = eqx.field(converter=tuple)
    texels: int = eqx.field(static=True, default=16)
    samples: int = eqx.field(static=True, default=1)
    points: tuple[Points, ...] | None = None

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems."""
        require.kind("the transport", self.transport, SetTransport, source="jaxprt.dynamic.precompute_sets")
        source = "jaxprt.dynamic.factor or jaxprt.separable.factor"
        for number, each in enumerate(self.brdf):
            require.kind(f"the BRDF of region {number}", each, BrdfSet, SeparableBrdf, source=source)
        if len(self.brdf) != len(self.transport.region):
            raise ValueError(
                f"BRDFs must be one for each of {len(self.transport.region)} regions, got {len(self.brdf)}"
            )

    def light(self, environment: Environment) -> SetLight:
        """Projects an environment for all regions: `jaxprt.dynamic.light_side`."""
        return light_side(self.transport, environment, texels=self.texels)

    def view(self, eye: Float[Array, "3"], materials: Sequence[Material | None] | None = None) -> SetView:
        """What depends on the view and the materials: `jaxprt.dynamic.view_side`."""
        return view_side(self.transport, self.brdf, self.given(materials), eye=eye, points=self.points)

    def combine(self, light: SetLight, view: SetView) -> Float[Array, "v c"]:
        """Radiance in direct light."""
        require.kind("the light", light, SetLight, source="SetSystem.light")
        require.kind("the view", view, SetView, source="SetSystem.view")
        return combine(self.transport, light, view, samples=self.samples)

    def given(self, materials: Sequence[Material | None] | None) -> Sequence[Material | None]:
        """The materials; None for each region if none are given.

        Raises:
            TypeError: `materials` is not a sequence.
        """
        if materials is None:
            return [None] * len(self.brdf)
        if not isinstance(materials, Sequence):
            raise TypeError(f"the materials must be a list, one for each region, got {type(materials).__name__}")
        return materials

    def at(self, points: Sequence[Points]) -> "SetSystem":
        """The same system at points of each region, concatenated; see `System.at`.

        Corners of the points are indices into the vertices of their region.
        """
        given = protocol.check_points(points, [len(each.seen.position) for each in self.transport.region])
        return eqx.tree_at(lambda each: each.points, self, given, is_leaf=lambda each: each is None)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points if the system was moved to points by `at`."""
        return len(self.transport.place) if self.points is None else sum(map(len, self.points))
