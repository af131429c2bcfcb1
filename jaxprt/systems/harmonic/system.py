"""The harmonic system: its four verbs."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import scalar
from jaxprt.scene.environment import Environment
from jaxprt.sphere import harmonics
from jaxprt.systems import protocol
from jaxprt.systems.harmonic.clustered import ClusteredTransfer, clustered_light
from jaxprt.systems.harmonic.relight import combine, project, transferred_light, view_coefficients, world_view
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector
from jaxprt.systems.protocol import Blend


class HarmonicSystem(protocol.VertexSystem):
    """Transfer matrices and the harmonics of a BRDF, under low-frequency light.

    A `Blend` weights the channels of the table, and has the parameters of each vertex for a table over some.

    Attributes:
        transport: Transfer matrices, from `jaxprt.harmonic.precompute` or `jaxprt.harmonic.interreflect`.
        brdf: The table, from `jaxprt.harmonic.tabulate`.
        laplacian: Share of the light's squared Laplacian that a window against ringing leaves, from 0 to 1; 1 leaves
            the light as it is. See `jaxprt.sphere.harmonics.least_laplacian`.
    """

    transport: TransferMatrix
    brdf: HarmonicBrdf
    laplacian: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems or of unlike degrees."""
        require.kind("the transport", self.transport, TransferMatrix, source="jaxprt.harmonic.precompute")
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != self.degree:
            raise ValueError(f"the BRDF must have the transport's degree {self.degree}, got {self.brdf.degree}")

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics."""
        return harmonics.degree_of(self.transport.matrix.shape[-1])

    def light(self, environment: Environment) -> Float[Array, "lm c v"]:
        """Harmonics of the light that arrives at each vertex, in its own frame."""
        coefficient = _projected(environment, self.degree)
        window = harmonics.least_laplacian(coefficient, self.laplacian)
        return transferred_light(self.transport, harmonics.convolve(coefficient, window))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "lm d v"]:
        """The BRDF's harmonics for each vertex's view: `jaxprt.harmonic.view_coefficients`."""
        return blended_view(self.brdf, *self.place(self.transport), materials, eye=eye)

    def combine(self, light: Float[Array, "lm c _"], view: Float[Array, "lm d v"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and BRDF."""
        require.array("the light", light, "lm c v", source="HarmonicSystem.light")
        require.array("the view", view, "lm c v", source="HarmonicSystem.view")
        return combine(self.carried(light, axis=2), view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return len(self.transport.position if self.points is None else self.points)


class ClusteredSystem(protocol.VertexSystem):
    """Clustered principal components of transfer matrices with the harmonics of a BRDF: `HarmonicSystem` in few bytes.

    The arriving light stays in the world, and the view's harmonics are turned there.

    Attributes:
        transport: Clustered transfer, from `jaxprt.harmonic.precompute_clustered`.
        brdf: The table, from `jaxprt.harmonic.tabulate`.
        laplacian: Share of the light's squared Laplacian that a window against ringing leaves, as in `HarmonicSystem`.
    """

    transport: ClusteredTransfer
    brdf: HarmonicBrdf
    laplacian: Float[Array, ""] = eqx.field(converter=scalar, default=1.0)

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems or of unlike degrees."""
        source = "jaxprt.harmonic.precompute_clustered"
        require.kind("the transport", self.transport, ClusteredTransfer, source=source)
        require.kind("the BRDF", self.brdf, HarmonicBrdf, source="jaxprt.harmonic.tabulate")
        if self.brdf.degree != self.transport.degree:
            raise ValueError(
                f"the BRDF must have the transport's degree {self.transport.degree}, got {self.brdf.degree}"
            )

    def light(self, environment: Environment) -> Float[Array, "lm c v"]:
        """Harmonics of the light that arrives at each vertex, in the world."""
        coefficient = _projected(environment, self.transport.degree)
        window = harmonics.least_laplacian(coefficient, self.laplacian)
        return clustered_light(self.transport, harmonics.convolve(coefficient, window))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "lm d v"]:
        """The BRDF's harmonics for each vertex's view, turned to the world."""
        position, frame = self.place(self.transport)
        return world_view(frame, blended_view(self.brdf, position, frame, materials, eye=eye))

    def combine(self, light: Float[Array, "lm c _"], view: Float[Array, "lm d v"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and BRDF."""
        require.array("the light", light, "lm c v", source="ClusteredSystem.light")
        require.array("the view", view, "lm c v", source="ClusteredSystem.view")
        return combine(self.carried(light, axis=2), view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return len(self.transport.position if self.points is None else self.points)


class DiffuseSystem(protocol.VertexSystem):
    """Transfer vectors: ideal diffuse vertices, which look the same from everywhere.

    A `Blend` has one channel, the albedo of each vertex; it takes the place of `albedo`.

    Attributes:
        transport: Transfer vectors, from `jaxprt.harmonic.precompute_diffuse`.
        albedo: One for all vertices, gray or a color.
    """

    transport: TransferVector
    albedo: Float[Array, " c"]

    def __check_init__(self):
        """Refuses other transport, and an albedo that is no color."""
        source = "jaxprt.harmonic.precompute_diffuse"
        require.kind("the transport", self.transport, TransferVector, source=source)
        require.array("the albedo", self.albedo, "1", "3")
        require.at_least("the albedo", self.albedo, 0.0)

    def light(self, environment: Environment) -> Float[Array, "lm c"]:
        """Harmonics of the light: `jaxprt.harmonic.project`."""
        return _projected(environment, harmonics.degree_of(self.transport.vector.shape[0]))

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "_ d"]:
        """The albedo, of all or of each; the eye changes nothing."""
        protocol.check_blend(materials)
        require.position("the eye", eye, each=self.vertices)
        if materials is None:
            return self.albedo[None]
        materials.check(self.vertices, 1)
        return materials.weight[:, 0]

    def combine(self, light: Float[Array, "lm c"], view: Float[Array, "_ d"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of light and transfer, times the albedo."""
        require.array("the light", light, "lm c", source="DiffuseSystem.light")
        require.array("the view", view, "v c", source="DiffuseSystem.view")
        return self.carried(combine(light, self.transport.vector)) * view

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return len(self.transport.position if self.points is None else self.points)

    @property
    def shared_light(self) -> tuple:
        """The coefficients depend on the environment alone."""
        return DiffuseSystem, self.transport.vector.shape[0]


def _projected(environment: Environment, degree: int) -> Float[Array, "lm c"]:
    """Harmonics of one environment."""
    require.kind("the light", environment, Environment, source="jaxprt.scene.load_environment")
    if environment.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(environment.radiance.shape)}")
    return project(environment, degree=degree)


def blended_view(
    brdf: HarmonicBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    materials: Blend | None,
    *,
    eye: Float[Array, "*p 3"],
) -> Float[Array, "lm c v"]:
    """`jaxprt.harmonic.view_coefficients` of a table whose channels and parameters a blend has for each vertex.

    Raises:
        TypeError: The materials are no `Blend`.
        ValueError: They are of other vertices or channels.
    """
    protocol.check_blend(materials)
    parameter = () if materials is None else materials.parameter
    row = view_coefficients(brdf, position, frame, *parameter, eye=eye)
    if materials is None:
        return row
    materials.check(len(position), row.shape[1])
    return jnp.einsum("ikv,vkc->icv", row, materials.weight, precision="highest")
