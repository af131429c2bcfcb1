"""The harmonic system: `light`, `shade`, `view` and `combine` for its three kinds of transport."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import scalar
from jaxprt.compile import promoted
from jaxprt.scene.environment import Environment
from jaxprt.sphere import harmonics
from jaxprt.systems import protocol
from jaxprt.systems.harmonic.clustered import ClusteredTransfer, clustered_light
from jaxprt.systems.harmonic.relight import combine, project, transferred_light, view_coefficients, world_view
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector
from jaxprt.systems.protocol import Blend


class HarmonicSystem(protocol.VertexSystem):
    """Transfer matrices with a BRDF in spherical harmonics, under low-frequency light.

    A `Blend` weights the channels of the BRDF table and holds the parameters of each vertex.

    Attributes:
        transport: Transfer matrices, from `jaxprt.harmonic.precompute` or `jaxprt.harmonic.interreflect`.
        brdf: The table, from `jaxprt.harmonic.tabulate`.
        laplacian: Share of the light's squared Laplacian that remains after windowing against ringing, from 0 to 1.
            With 1 there is no window. See `jaxprt.sphere.harmonics.least_laplacian`.
    """

    transport: TransferMatrix
    brdf: HarmonicBrdf
    laplacian: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems, or of different degrees."""
        require.kind("the transport", self.transport, TransferMatrix, source="jaxprt.harmonic.precompute")
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != self.degree:
            raise ValueError(f"the BRDF must have the transport's degree {self.degree}, got {self.brdf.degree}")

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return harmonics.degree_of(self.transport.matrix.shape[-1])

    def light(self, environment: Environment) -> Float[Array, "lm c v"]:
        """SH coefficients of the light that arrives at each vertex, in its own frame."""
        coefficient = _projected(environment, self.degree)
        window = harmonics.least_laplacian(coefficient, self.laplacian)
        return transferred_light(self.transport, harmonics.convolve(coefficient, window))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "lm d v"]:
        """SH coefficients of the BRDF for each vertex's view; see `jaxprt.harmonic.view_coefficients`."""
        return blended_view(self.brdf, *self.place(self.transport), materials, eye=eye)

    def combine(self, light: Float[Array, "lm c _"], view: Float[Array, "lm d v"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and BRDF coefficients."""
        require.array("the light", light, "lm c v", source="HarmonicSystem.light")
        require.array("the view", view, "lm c v", source="HarmonicSystem.view")
        return combine(self.carried(light, axis=2), view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return len(self.transport.position if self.points is None else self.points)


class ClusteredSystem(protocol.VertexSystem):
    """`HarmonicSystem` with transfer matrices compressed by clustered principal components.

    The arriving light stays in the world frame, to which the coefficients of the view are rotated.

    Attributes:
        transport: Clustered transfer, from `jaxprt.harmonic.precompute_clustered`.
        brdf: The table, from `jaxprt.harmonic.tabulate`.
        laplacian: Share of the light's squared Laplacian that remains after windowing against ringing, from 0 to 1.
            With 1 there is no window.
    """

    transport: ClusteredTransfer
    brdf: HarmonicBrdf
    laplacian: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems, or of different degrees."""
        source = "jaxprt.harmonic.precompute_clustered"
        require.kind("the transport", self.transport, ClusteredTransfer, source=source)
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != self.transport.degree:
            raise ValueError(
                f"the BRDF must have the transport's degree {self.transport.degree}, got {self.brdf.degree}"
            )

    def light(self, environment: Environment) -> Float[Array, "lm c v"]:
        """SH coefficients of the light that arrives at each vertex, in the world."""
        coefficient = _projected(environment, self.transport.degree)
        window = harmonics.least_laplacian(coefficient, self.laplacian)
        return clustered_light(self.transport, harmonics.convolve(coefficient, window))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "lm d v"]:
        """SH coefficients of the BRDF for each vertex's view, rotated to the world."""
        position, frame = self.place(self.transport)
        return world_view(frame, blended_view(self.brdf, position, frame, materials, eye=eye))

    def combine(self, light: Float[Array, "lm c _"], view: Float[Array, "lm d v"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and BRDF coefficients."""
        require.array("the light", light, "lm c v", source="ClusteredSystem.light")
        require.array("the view", view, "lm c v", source="ClusteredSystem.view")
        return combine(self.carried(light, axis=2), view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return len(self.transport.position if self.points is None else self.points)


class DiffuseSystem(protocol.VertexSystem):
    """Transfer vectors for ideal diffuse surfaces, whose radiance is the same for all views.

    A `Blend` has one channel, the albedo of each vertex, and replaces `albedo`.

    Attributes:
        transport: Transfer vectors, from `jaxprt.harmonic.precompute_diffuse`.
        albedo: Albedo of all vertices, gray or per color.
    """

    transport: TransferVector
    albedo: Float[Array, " c"]

    def __check_init__(self):
        """Refuses other transport, and an albedo that is negative or has neither one nor three colors."""
        source = "jaxprt.harmonic.precompute_diffuse"
        require.kind("the transport", self.transport, TransferVector, source=source)
        require.array("the albedo", self.albedo, "1", "3")
        require.at_least("the albedo", self.albedo, 0.0)

    def light(self, environment: Environment) -> Float[Array, "lm c"]:
        """SH coefficients of the light, from `jaxprt.harmonic.project`."""
        return _projected(environment, harmonics.degree_of(self.transport.vector.shape[0]))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "_ d"]:
        """Albedo of all vertices, or of each vertex with a blend. It does not depend on the eye."""
        return protocol.albedo_view(self.albedo, eye, materials, vertices=self.vertices)

    @promoted
    def combine(self, light: Float[Array, "lm c"], view: Float[Array, "_ d"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and transfer vectors, times the albedo."""
        require.array("the light", light, "lm c", source="DiffuseSystem.light")
        require.array("the view", view, "v c", source="DiffuseSystem.view")
        return self.carried(combine(light, self.transport.vector)) * view

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
        """Key of the light, which depends on the environment and the number of coefficients only."""
        return DiffuseSystem, self.transport.vector.shape[0]


def _projected(environment: Environment, degree: int) -> Float[Array, "lm c"]:
    """SH coefficients of one environment."""
    return project(protocol.one_light(environment), degree=degree)


def blended_view(
    brdf: HarmonicBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    materials: Blend | None,
    *,
    eye: Float[Array, "*p 3"],
) -> Float[Array, "lm c v"]:
    """`jaxprt.harmonic.view_coefficients` with the materials of a blend, whose weights sum the table's channels.

    Args:
        brdf: BRDF table, from `tabulate`.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        materials: Weights and parameters of each vertex; None for the table's own channels as colors.
        eye: Position of the viewer in world units: one, or one for each vertex.

    Raises:
        TypeError: The materials are not a `Blend`.
        ValueError: The blend has another number of vertices or channels.
    """
    protocol.check_blend(materials)
    eye = require.position("the eye", eye, each=len(position))
    parameter = () if materials is None else materials.parameter
    row = view_coefficients(brdf, position, frame, *parameter, eye=eye)
    if materials is None:
        return row
    materials.check(len(position), row.shape[1])
    return jnp.einsum("ikv,vkc->icv", row, materials.weight, precision="highest")
