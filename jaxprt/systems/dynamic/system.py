"""The dynamic system: direct light on surfaces whose light, view and BRDF all change.

    B(x, wo) = sum_l g_l(wo, material) sum_b L_b T_x(b, l) + lobes + d(wo, material) E_x / pi

The transport T of the light factors and the irradiance E are redone with the light, the view factors g, the lobes and
the albedo d with the view or the materials.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import directions
from jaxprt.systems import protocol
from jaxprt.systems.dynamic.table import DynamicBrdf
from jaxprt.systems.dynamic.transport import DynamicTransport, light_factors
from jaxprt.systems.lobe import LobeSystem, diffuse
from jaxprt.systems.lobe.blurred_light import LobeLight
from jaxprt.systems.lobe.system import LobeView
from jaxprt.systems.protocol import Blend
from jaxprt.systems.separable.factorization import check_mark
from jaxprt.systems.separable.system import combine, project


class DynamicLight(eqx.Module):
    """A light, and what arrives of it at the vertices.

    Attributes:
        coefficient: Haar coefficients of the light.
        blurred: The light, blurred for lobes. After `DynamicSystem.shade` with the irradiance of the vertices.
        arriving: Light that arrives at each vertex, projected on the light factors; None before `shade`.
    """

    coefficient: Float[Array, "b c"]
    blurred: LobeLight
    arriving: Float[Array, "v r c"] | None = None


class DynamicView(eqx.Module):
    """A view of vertices or points with their materials.

    Attributes:
        factor: View factors of the terms.
        lobes: Texels of the blurred light that the lobes read, and the albedo of the diffuse part.
    """

    factor: Float[Array, "v r d"]
    lobes: LobeView


class DynamicSystem(protocol.VertexSystem):
    """Transport of light factors, with a BRDF as lobes, a diffuse part and a tensor over its parameters.

    A `Blend` weights the channels of the BRDF and holds the parameters of each vertex.

    Attributes:
        transport: Transport from `jaxprt.dynamic.precompute`.
        brdf: The BRDF, from `jaxprt.dynamic.tabulate`, for whose light factors the transport was made.
    """

    transport: DynamicTransport
    brdf: DynamicBrdf

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems, and transport that was precomputed for another BRDF."""
        require.kind("the transport", self.transport, DynamicTransport, source="jaxprt.dynamic.precompute")
        require.kind("the BRDF", self.brdf, DynamicBrdf, source="jaxprt.dynamic.tabulate")
        if self.brdf.terms + 1 != self.transport.terms.terms:
            most = self.transport.terms.terms - 1
            raise ValueError(f"the BRDF must have the transport's {most} light factors, got {self.brdf.terms}")
        check_mark(self.transport.terms.mark, light_factors(self.brdf).light_map)

    def light(self, environment: Environment) -> DynamicLight:
        """The light's wavelet coefficients, and the light blurred by lobes of about a dozen widths."""
        environment = protocol.one_light(environment, size=self.transport.size)
        return DynamicLight(project(environment), self.lobe_part.light(environment))

    @jit
    def shade(self, light: DynamicLight, materials: Blend | None = None) -> DynamicLight:
        """The light that arrives at the vertices, projected on the light factors. Materials do not change it."""
        require.kind("the light", light, DynamicLight, source="DynamicSystem.light")
        arriving = self.transport.terms.apply(light.coefficient)
        blurred = dataclasses.replace(light.blurred, irradiance=arriving[:, -1].T)
        return DynamicLight(light.coefficient, blurred, arriving[:, :-1])

    def tilted(self, light: DynamicLight, normal: Float[Array, "v 3"]) -> DynamicLight:
        """The light with vector irradiance, for the diffuse part: `System.tilted`."""
        pyramid, blurred = self.transport.pyramid, light.blurred
        flux = diffuse.flux(blurred.coefficient, pyramid.vector, normal, size=pyramid.size)
        return dataclasses.replace(light, blurred=dataclasses.replace(blurred, flux=_turned(flux, blurred, normal)))

    def view(
        self,
        eye: Float[Array, "*p 3"],
        materials: Blend | None = None,
        points: Points = VERTICES,
        *,
        variance: Float[Array, " p"] | None = None,
        missed: Float[Array, " p"] | None = None,
        finer: bool = False,
    ) -> DynamicView:
        """View factors of the terms, and texels at which each point reads the blurred light for its lobes.

        `variance`, in squared radians, widens the lobes of each point. It does not change the terms, and nor does
        `missed`, the visibility of narrow lobes by rays, and `finer`; see `LobeSystem.view`.
        """
        protocol.check_blend(materials)
        protocol.check_points(points, self.vertices)
        count = points.count(self.vertices)
        eye = require.position("the eye", eye, points=count)
        if materials is not None:
            materials.check(count, self.brdf.channels)
        wo = _direction(self.transport.position, self.transport.frame, points, eye)
        lobes = self.lobe_part.view(eye, materials, points, variance=variance, missed=missed, finer=finer)
        return DynamicView(self.brdf.view(wo, materials), lobes)

    def combine(self, light: DynamicLight, view: DynamicView, points: Points = VERTICES) -> Float[Array, "p c"]:
        """Radiance: terms, lobes and the diffuse part."""
        require.kind("the light", light, DynamicLight, source="DynamicSystem.light")
        require.kind("the view", view, DynamicView, source="DynamicSystem.view")
        light = self.shade(light) if light.arriving is None else light
        result = self.lobe_part.combine(light.blurred, view.lobes, points)
        if not self.brdf.terms:
            return result
        return result + combine(points.carry(_shaded(light.arriving)), view.factor)

    @property
    def lobe_part(self) -> LobeSystem:
        """The lobes and the diffuse part alone, without the tensor: what exported pages show."""
        return LobeSystem(self.transport.pyramid, self.brdf.lobe)

    def exported(self, what: str) -> protocol.Exported:
        """That of the lobes, without the tensor."""
        return self.lobe_part.exported(what)

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and its size only."""
        return DynamicSystem, self.transport.size


@jit
def _direction(position: Array, frame: Array, points: Points, eye: Array) -> Float[Array, "v 3"]:
    """Directions to the viewer in the frames of the light factors."""
    place, axes = placed(position, frame, points)
    wo = directions.view(axes, place, eye)
    if points.normal is None:
        return wo
    # Light factors are in frames without the normal map. Points are seen from where the mirror direction of the tilted
    # normal is also that of the frame.
    smooth = points.tilted(None).frame(frame)
    mirror = jnp.einsum("vi,vij->vj", wo * jnp.array([-1.0, -1.0, 1.0], wo.dtype), axes, precision="highest")
    return jnp.einsum("vij,vj->vi", smooth, mirror, precision="highest") * jnp.array([-1.0, -1.0, 1.0], wo.dtype)


@jit
def _turned(flux: Float[Array, "c 3 v"], light: LobeLight, normal: Float[Array, "v 3"]) -> Float[Array, "c 3 v"]:
    """Vector irradiance whose component along the normals is the irradiance of the transport."""
    along = jnp.sum(flux * normal.T, 1)
    return flux + (_shaded(light.irradiance) - along)[:, None] * normal.T


def _shaded(value: Array | None) -> Array:
    """What the light has after `DynamicSystem.shade`."""
    return require.kind("what arrives", value, jax.Array, source="DynamicSystem.shade")
