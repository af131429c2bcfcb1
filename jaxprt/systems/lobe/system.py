"""The lobe system: `light`, `shade`, `view` and `combine` for BRDFs as lobes."""

import dataclasses
from functools import reduce

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.systems import protocol
from jaxprt.systems.lobe import diffuse
from jaxprt.systems.lobe.pyramid import LobeTransport
from jaxprt.systems.lobe.relight import LobeLight, LobeView, combine, prefilter, view_lobes
from jaxprt.systems.lobe.table import LobeBrdf
from jaxprt.systems.protocol import Blend


class LobeSystem(protocol.VertexSystem):
    """Visibility pyramids with a BRDF as a table of lobes. Light, view and BRDF may all change without precomputation.

    A `Blend` weights the channels of the BRDF table and holds the parameters of each vertex.

    Attributes:
        transport: Visibility pyramids, from `jaxprt.lobe.precompute`.
        brdf: The table, from `jaxprt.lobe.tabulate`.
    """

    transport: LobeTransport
    brdf: LobeBrdf

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems."""
        require.kind("the transport", self.transport, LobeTransport, source="jaxprt.lobe.precompute")
        require.kind("the BRDF", self.brdf, LobeBrdf, source="jaxprt.lobe.tabulate")

    def light(self, environment: Environment) -> LobeLight:
        """The light, blurred by lobes of about a dozen widths; see `jaxprt.lobe.prefilter`."""
        return prefilter(protocol.one_light(environment, size=self.transport.size))

    def shade(self, light: LobeLight, materials: Blend | None = None) -> LobeLight:
        """The light with the irradiance of the vertices, for the diffuse part. Materials do not change it."""
        require.kind("the light", light, LobeLight, source="LobeSystem.light")
        irradiance = diffuse.irradiance(light.coefficient, self.transport.vector)
        return LobeLight(light.pyramid, light.coefficient, light.size, irradiance)

    def tilted(self, light: LobeLight, normal: Float[Array, "v 3"]) -> LobeLight:
        """The light with vector irradiance, for the diffuse part: `System.tilted`."""
        flux = diffuse.flux(light.coefficient, self.transport.vector, normal, size=self.transport.size)
        return dataclasses.replace(light, flux=flux)

    def view(
        self,
        eye: Float[Array, "*p 3"],
        materials: Blend | None = None,
        variance: Float[Array, " v"] | None = None,
    ) -> LobeView:
        """Texels at which each vertex reads the blurred light, with visibility; see `jaxprt.lobe.view_lobes`.

        `variance`, in squared radians, widens the lobes of each vertex or point.
        """
        protocol.check_blend(materials)
        options = {"eye": eye, "points": self.points, "variance": variance}
        # The irradiance comes with the light: each row of points would hold a copy of the vectors.
        transport = eqx.tree_at(lambda each: each.vector, self.transport, self.transport.vector[:0])
        if materials is None:
            return view_lobes(transport, self.brdf, **options)
        materials.check(self.vertices, len(self.brdf.weight))
        seen = view_lobes(transport, self.brdf, *materials.parameter, **options)
        # Channel by channel with the vertices last: an einsum would be a small matrix product for each vertex.
        channel = jnp.moveaxis(materials.weight, 0, 2)
        pairs = list(zip(seen.weight, seen.diffuse, channel, strict=True))
        weight = reduce(jnp.add, (lobe * own[:, None] for lobe, _, own in pairs))
        diffuse = reduce(jnp.add, (albedo * own for _, albedo, own in pairs))
        return eqx.tree_at(lambda each: (each.weight, each.diffuse), seen, (weight, diffuse))

    def combine(self, light: LobeLight, view: LobeView) -> Float[Array, "v c"]:
        """Radiance: the blurred light, read at the texels of the view and weighted."""
        require.kind("the light", light, LobeLight, source="LobeSystem.light")
        require.kind("the view", view, LobeView, source="LobeSystem.view")
        if light.irradiance is None:
            light = self.shade(light)
        return combine(light, view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return len(self.transport.position if self.points is None else self.points)

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and its size only."""
        return LobeSystem, self.transport.size
