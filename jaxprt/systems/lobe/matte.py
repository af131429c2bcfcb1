"""Ideally diffuse surfaces, lit by transfer vectors of hat functions."""

import dataclasses

import equinox as eqx
from jaxtyping import Array, Float, UInt8

from jaxprt import require
from jaxprt.compile import promoted
from jaxprt.scene.environment import Environment
from jaxprt.systems import protocol
from jaxprt.systems.lobe import diffuse
from jaxprt.systems.lobe.pyramid import LobeTransport
from jaxprt.systems.protocol import Blend


class MatteTransport(eqx.Module):
    """Transfer vectors of the vertices of ideally diffuse surfaces.

    Attributes:
        vector: Transfer vectors in hat functions, as bytes; see `jaxprt.systems.lobe.diffuse`.
        position: Vertex positions in world units.
        size: Edge of the cubemap faces in texels.
    """

    vector: UInt8[Array, "h v"]
    position: Float[Array, "v 3"]
    size: int = eqx.field(static=True)

    @property
    def nbytes(self) -> int:
        """Bytes of the vectors."""
        return self.vector.nbytes


class MatteLight(eqx.Module):
    """Light for ideally diffuse surfaces.

    Attributes:
        coefficient: Coefficients of the light; see `jaxprt.systems.lobe.diffuse`.
        irradiance: Irradiance / pi of the vertices; None before `MatteSystem.shade`.
        flux: Vector irradiance / pi of the vertices, for normals tilted by normal maps; None before
            `MatteSystem.tilted`.
    """

    coefficient: Float[Array, "h c"]
    irradiance: Float[Array, "c v"] | None = None
    flux: Float[Array, "c 3 v"] | None = None


class MatteSystem(protocol.VertexSystem):
    """Transfer vectors of hat functions for ideally diffuse surfaces, whose radiance is the same for all views.

    A `Blend` has one channel, the albedo of each vertex, and replaces `albedo`.

    Attributes:
        transport: Transfer vectors, from `matte_transport`.
        albedo: Albedo of all vertices, gray or per color.
    """

    transport: MatteTransport
    albedo: Float[Array, " c"]

    def __check_init__(self):
        """Refuses other transport, and an albedo that is negative or has neither one nor three colors."""
        require.kind("the transport", self.transport, MatteTransport, source="jaxprt.lobe.matte_transport")
        require.array("the albedo", self.albedo, "1", "3")
        require.at_least("the albedo", self.albedo, 0.0)

    def light(self, environment: Environment) -> MatteLight:
        """Coefficients of the light in hat functions."""
        light = protocol.one_light(environment, size=self.transport.size)
        return MatteLight(diffuse.coefficients(light.radiance))

    def shade(self, light: MatteLight, materials: Blend | None = None) -> MatteLight:
        """The light with the irradiance of the vertices. Materials do not change it."""
        require.kind("the light", light, MatteLight, source="MatteSystem.light")
        return MatteLight(light.coefficient, diffuse.irradiance(light.coefficient, self.transport.vector))

    def tilted(self, light: MatteLight, normal: Float[Array, "v 3"]) -> MatteLight:
        """The light with vector irradiance: `System.tilted`."""
        flux = diffuse.flux(light.coefficient, self.transport.vector, normal, size=self.transport.size)
        return dataclasses.replace(light, flux=flux)

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "_ d"]:
        """Albedo of all vertices, or of each vertex with a blend. It does not depend on the eye."""
        return protocol.albedo_view(self.albedo, eye, materials, vertices=self.vertices)

    @promoted
    def combine(self, light: MatteLight, view: Float[Array, "_ d"]) -> Float[Array, "v e"]:
        """Radiance: irradiance / pi times the albedo."""
        require.kind("the light", light, MatteLight, source="MatteSystem.light")
        require.array("the view", view, "v c", source="MatteSystem.view")
        irradiance = light.irradiance
        if irradiance is None:
            irradiance = diffuse.irradiance(light.coefficient, self.transport.vector)
        protocol.check_colors(len(irradiance), view.shape[1])
        return diffuse.at_points(irradiance, light.flux, self.points).T * view

    @property
    def matte(self) -> bool:
        """True: surfaces are ideally diffuse."""
        return True

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return len(self.transport.position if self.points is None else self.points)

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and its size only."""
        return MatteSystem, self.transport.size


def matte_transport(transport: LobeTransport) -> MatteTransport:
    """The transfer vectors of a lobe transport, without its pyramids."""
    return MatteTransport(transport.vector, transport.position, transport.size)
