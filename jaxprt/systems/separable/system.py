"""The separable system: the dot product of a light-modulated and a view-modulated tuple per vertex."""

from functools import reduce
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import isolated, jit, linear
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points
from jaxprt.sphere import directions, haar
from jaxprt.systems import protocol
from jaxprt.systems.protocol import Blend
from jaxprt.systems.separable.factorization import SeparableBrdf, check_mark


@runtime_checkable
class Transport(Protocol):
    """Interface of precomputed transport: what relighting needs from sparse and clustered transport.

    Attributes:
        position: Vertex positions in world units, in the order of the mesh.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        rms: Root mean square of the transport over vertices and terms, for each wavelet coefficient.
        mark: Samples of the BRDF's light factors, from `factorization.mark_of`; None if unknown.
    """

    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]
    rms: Float[Array, " b"]
    mark: Float[Array, "r m"] | None

    @property
    def terms(self) -> int:
        """Number of BRDF terms."""
        ...

    def apply(self, coefficient: Float[Array, "b c"]) -> Float[Array, "v r c"]:
        """Multiplies the transport by Haar coefficients of the light: one value per vertex, term and color."""
        ...


class SeparableSystem(protocol.VertexSystem):
    """A factored BRDF with the transport of its terms, which may be sparse or clustered.

    A `Blend` weights the channels of the view maps. Light maps are part of the transport, so gradients with respect to
    the BRDF cover the view maps only. For gradients with respect to the parameters of a BRDF model use
    `jaxprt.reference.radiance`.

    Attributes:
        transport: Transport from `jaxprt.separable.precompute` or `jaxprt.separable.clustered.precompute`.
        brdf: The factored BRDF for which the transport was precomputed.

    Reference: Wang, Tran, Luebke 2004, equation 6.
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
        """The light-modulated tuple of every vertex."""
        return light_tuple(self.transport, environment)

    def view(
        self, eye: Float[Array, "*p 3"], materials: Blend | None = None, points: Points = VERTICES
    ) -> Float[Array, "p r d"]:
        """The view-modulated tuple of every point."""
        protocol.check_blend(materials)
        factor = view_tuple(self.brdf, *self.placed(points), eye)
        if materials is None:
            return factor
        materials.check(len(factor), self.brdf.view_map.shape[-1])
        return jnp.einsum("vrk,vkc->vrc", factor, materials.weight, precision="highest")

    def combine(
        self, light: Float[Array, "_ r c"], view: Float[Array, "p r d"], points: Points = VERTICES
    ) -> Float[Array, "p e"]:
        """Radiance: the dot product of the two tuples."""
        require.array("the light", light, "v r c", source="SeparableSystem.light")
        require.array("the view", view, "v r c", source="SeparableSystem.view")
        return combine(points.carry(light), view)

    @property
    def light_size(self) -> int:
        """Edge of the faces of the light, whose coefficients the transport has."""
        return haar.face_edge(self.transport.rms.shape[0])


@require.arguments(light=protocol.one_light)
@jit
def project(light: Environment) -> Float[Array, "b c"]:
    """Haar coefficients of an environment. Each cubemap face is transformed separately.

    The solid angles of texels are part of the transport, so radiance is transformed without weights.

    Args:
        light: One environment. The edge n of its cubemap faces must be a power of two.

    Returns:
        b = 6 n n coefficients per color, in units of radiance.
    """
    coefficient = haar.forward(light.radiance)
    return coefficient.reshape(-1, coefficient.shape[-1])


def light_tuple(transport: Transport, light: Environment) -> Float[Array, "v r c"]:
    """The light-modulated tuple of every vertex: light times visibility, cosine and the light factor of each term.

    Args:
        transport: Precomputed transport.
        light: The environment. Its cubemap must have the size of the transport's.

    Returns:
        One value per vertex, term and color, with vertices in the order of the mesh.
    """
    require.kind("the light", light, Environment, source="jaxprt.scene.load_environment")
    return transport.apply(project(protocol.one_light(light, size=haar.face_edge(transport.rms.shape[0]))))


def view_tuple(
    brdf: SeparableBrdf, position: Float[Array, "v 3"], frame: Float[Array, "v 3 3"], eye: Float[Array, "*p 3"]
) -> Float[Array, "v r c"]:
    """The view-modulated tuple of every vertex: view maps looked up in the direction to the eye.

    Args:
        brdf: The factored BRDF.
        position: Positions in world units.
        frame: Shading frames; rows are tangent, bitangent, normal.
        eye: Position of the viewer in world units: one, or one for each position.
    Reference: Wang, Tran, Luebke 2004, sections 3.1 and 3.4.
    """
    eye = require.position("the eye", eye, points=len(position))
    return _view_tuple(brdf, position, frame, eye)


@jit
def _view_tuple(brdf: SeparableBrdf, position: Array, frame: Array, eye: Array) -> Array:
    return brdf.view(directions.view(frame, position, eye))


@isolated
def combine(light: Float[Array, "v r c"], view: Float[Array, "v r d"]) -> Float[Array, "v e"]:
    """Radiance: the dot product of the light tuple and the view tuple over the terms r.

    Args:
        light: The result of `light_tuple`, with the c colors of the light.
        view: The result of `view_tuple`, with the d colors of the BRDF.

    Returns:
        Linear radiance of each vertex in e = max(c, d) colors. If one tuple is gray, it is used for all colors.

    Raises:
        ValueError: The tuples differ in vertices, terms or colors, and neither is gray.
    """
    (c, d), shapes = (light.shape[-1], view.shape[-1]), (list(light.shape), list(view.shape))
    if light.shape[:2] != view.shape[:2] or (c != d and 1 not in (c, d)):
        raise ValueError(
            f"light and view must have the same vertices, terms and colors, got {shapes[0]} and {shapes[1]}"
        )
    return _product(light, view)


@jax.custom_jvp
def _product(light: Array, view: Array) -> Array:
    return _sum(light, view)


@_product.defjvp
def _(primal, tangent):
    light, view = primal
    parts = [
        linear(_sum, _outer_gray if x.shape[2] < fixed.shape[2] else _outer, fixed, x)
        for fixed, x in ((view, tangent[0]), (light, tangent[1]))
    ]
    return _sum(light, view), parts[0] + parts[1]


def _sum(fixed: Array, x: Array) -> Array:
    # Written out term by term, because XLA's CPU code for a reduction over the middle axis takes ten times as long.
    return reduce(jnp.add, (fixed[:, term] * x[:, term] for term in range(fixed.shape[1])))


def _outer(fixed: Array, cotangent: Array) -> Array:
    """Transpose of `_sum`. JAX's own transpose pads every term."""
    return fixed * cotangent[:, None]


def _outer_gray(fixed: Array, cotangent: Array) -> Array:
    """`_outer` for a gray factor beside a colored one: sums over colors, written out for the same reason as `_sum`."""
    colors = range(cotangent.shape[1])
    return reduce(jnp.add, (fixed[..., c] * cotangent[:, None, c] for c in colors))[..., None]
