"""The separable system: `light`, `shade`, `view` and `combine` for factored BRDFs."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.scene.environment import Environment
from jaxprt.systems import protocol
from jaxprt.systems.protocol import Blend
from jaxprt.systems.separable.factorization import SeparableBrdf, check_mark
from jaxprt.systems.separable.relight import Transport, combine, light_tuple, view_factors


class SeparableSystem(protocol.VertexSystem):
    """A factored BRDF with the transport of its terms, which may be sparse, quantized or clustered.

    A `Blend` weights the channels of the view maps.

    Attributes:
        transport: Transport from `jaxprt.separable.precompute`, `jaxprt.separable.quantized.quantize` or
            `jaxprt.separable.clustered.precompute`.
        brdf: The factored BRDF for which the transport was precomputed.
    """

    transport: Any
    brdf: SeparableBrdf

    def __check_init__(self):
        """Refuses transport and BRDFs of other systems, and transport that was precomputed for another BRDF."""
        require.kind("the transport", self.transport, Transport, source="jaxprt.separable.precompute")
        require.kind("the BRDF", self.brdf, SeparableBrdf, source="jaxprt.separable.factor")
        if self.brdf.terms != self.transport.terms:
            raise ValueError(f"the BRDF must have the transport's {self.transport.terms} terms, got {self.brdf.terms}")
        check_mark(self.transport.mark, self.brdf.light_map)

    def light(self, environment: Environment) -> Float[Array, "v r c"]:
        """The light-modulated tuple of every vertex; see `jaxprt.separable.light_tuple`."""
        return light_tuple(self.transport, environment)

    def view(self, eye: Float[Array, "*p 3"], materials: Blend | None = None) -> Float[Array, "v r d"]:
        """The view-modulated tuple of every vertex; see `jaxprt.separable.view_tuple`."""
        protocol.check_blend(materials)
        factor = view_factors(self.brdf, *self.place(self.transport), eye)
        if materials is None:
            return factor
        materials.check(self.vertices, self.brdf.view_map.shape[-1])
        return jnp.einsum("vrk,vkc->vrc", factor, materials.weight, precision="highest")

    def combine(self, light: Float[Array, "_ r c"], view: Float[Array, "v r d"]) -> Float[Array, "v e"]:
        """Radiance: the dot product of the two tuples."""
        require.array("the light", light, "v r c", source="SeparableSystem.light")
        require.array("the view", view, "v r c", source="SeparableSystem.view")
        return combine(self.carried(light), view)

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points where radiance is evaluated at points."""
        return len(self.transport.position if self.points is None else self.points)
