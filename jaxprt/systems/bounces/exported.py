"""What an exported page holds of reflected light: what bounces and lamps add to the irradiance of the vertices.

Reflected light is linear in the light of the environment, for the materials that the scene has. Transfer vectors hold
it for environments of low harmonics, and one more row holds the light of lamps. Both are reflected diffusely:

    radiance += albedo (sum over k of L_k T_k + T_lamps)
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points
from jaxprt.sphere import harmonics
from jaxprt.systems.protocol import System, VertexSystem

DEGREE = 4  # of the light that is reflected: it varies little with the direction of its source
ROWS = (DEGREE + 1) ** 2 + 1  # a row for each harmonic, and one for the light of lamps


class ReflectingLight(eqx.Module):
    """The light of a `ReflectingSystem`.

    Attributes:
        direct: The light of the system of direct light.
        irradiance: Irradiance / pi of the vertices from bounces and lamps.
    """

    direct: PyTree
    irradiance: Float[Array, "c v"]


class ReflectingSystem(VertexSystem):
    """A system of direct light with what bounces and lamps add to its irradiance, as an exported page computes it.

    Attributes:
        direct: The system of direct light: lobes or ideally diffuse, with or without single texels.
        vector: Irradiance / pi at the vertices v in each color: a row for each harmonic of the environment up to
            `DEGREE`, or none without bounces, and the last one for the light of lamps.
    """

    direct: System
    vector: Float[Array, "k 3 v"]

    def light(self, environment: Environment) -> ReflectingLight:
        """The light of the system of direct light, and the irradiance of reflected light."""
        coefficient = harmonics.project(environment.radiance, degree=DEGREE)
        coefficient = jnp.broadcast_to(coefficient, (len(coefficient), 3))[: len(self.vector) - 1]
        irradiance = jnp.einsum("kc,kcv->cv", coefficient, self.vector[:-1], precision="highest") + self.vector[-1]
        return ReflectingLight(self.direct.light(environment), irradiance)

    def shade(self, light: ReflectingLight, materials: PyTree = None) -> ReflectingLight:
        """Light that arrives at the vertices. Materials do not change it."""
        return ReflectingLight(self.direct.shade(light.direct, materials), light.irradiance)

    def tilted(self, light: ReflectingLight, normal: Float[Array, "v 3"]) -> ReflectingLight:
        """The light, whose reflected part arrives alike at tilted normals: `System.tilted`."""
        return ReflectingLight(self.direct.tilted(light.direct, normal), light.irradiance)

    def view(self, eye: Float[Array, "*p 3"], materials: PyTree = None, points: Points = VERTICES) -> PyTree:
        """The view of the system of direct light, which has the albedo of the diffuse response."""
        return self.direct.view(eye, materials, points)

    def combine(self, light: ReflectingLight, view: PyTree, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance: direct light, and irradiance times the albedo of the diffuse response."""
        require.kind("the light", light, ReflectingLight, source="ReflectingSystem.light")
        reflected = points.carry(light.irradiance, axis=1).T * self.direct.diffuse_albedo(view)
        return self.direct.combine(light.direct, view, points) + reflected

    @property
    def vertices(self) -> int:
        """Number of vertices."""
        return self.direct.vertices

    @property
    def matte(self) -> bool:
        """Whether the system of direct light is ideally diffuse."""
        return self.direct.matte

    @property
    def texel_visibility(self) -> PyTree:
        """That of the system of direct light."""
        return self.direct.texel_visibility
