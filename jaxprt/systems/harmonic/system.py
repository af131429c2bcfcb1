"""The harmonic system: arbitrary BRDFs under low-frequency light (Kautz, Sloan, Snyder 2002).

Transfer matrices turn the distant light into the light that arrives at each vertex, in its own frame, and the BRDF is
looked up for the view of each vertex. Radiance is the dot product of the two. Without shadows, `local_light` rotates
the light in place of the matrices.

Lights, eyes and probes must be finite. Values cannot be checked inside `jax.jit`, `jax.vmap` and `jax.grad`: there, NaN
in a light or an eye reaches every vertex, and NaN at a probe reaches every vertex with a weight of it.
"""

import math
from functools import partial
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import scalar
from jaxprt.compile import jit, promoted
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import VERTICES, Points
from jaxprt.sphere import directions, harmonics, rotation
from jaxprt.systems import protocol
from jaxprt.systems.harmonic.exported import ExportedMatrices
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector, right_handed
from jaxprt.systems.protocol import Blend

_DARK, _BRIGHTEST = 1e-6, 4.0  # least light that tilted normals are compared with, and largest ratio to it


def _light_shape(value: Any) -> None:
    require.array("the light", value, "lm c", "lm c v", source="jaxprt.harmonic.project")


def _light(value: Any) -> Array:
    _light_shape(value)
    require.finite("the light", value)
    return require.floating(value)


def _brdf(value: Any) -> None:
    require.kind("the BRDF", value, HarmonicBrdf, source="jaxprt.harmonic.tabulate")


def _matrix(value: Any) -> None:
    require.kind("the transport", value, TransferMatrix, source="jaxprt.harmonic.precompute")


def _eyes(value: Any) -> Array:
    require.real("the eye", value)
    shape = jnp.shape(value)
    return require.position("the eye", value, points=shape[0] if len(shape) == 2 else None)


def _degree(value: Any) -> None:
    require.count("degree", value, least=0, most=256)


def _probe(value: Any) -> Array:
    require.array("probes", value, "p 3")
    require.finite("probes", value)
    if not value.shape[0]:
        raise ValueError("there must be at least one probe, got an array of shape [0, 3]")
    return require.floating(value)


def _probe_coefficient(value: Any) -> Array:
    require.array("the light at the probes", value, "p lm c")
    require.finite("the light at the probes", value)
    return require.floating(value)


class HarmonicSystem(protocol.VertexSystem):
    """Transfer matrices with a BRDF in spherical harmonics, under low-frequency light.

    A `Blend` weights the channels of the BRDF table and holds the parameters of each vertex. Ringing of the harmonics
    can make radiance negative.

    Attributes:
        transport: Transfer matrices, from `jaxprt.harmonic.precompute`.
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

    def light(self, environment: Environment | Float[Array, "lm c *w"]) -> Float[Array, "lm _ v"]:
        """SH coefficients of the light that arrives at each vertex, in its own frame.

        Args:
            environment: The light, or its SH coefficients in the world, from `project`: one set, or one for each
                vertex.
        """
        coefficient = _coefficients(environment, self.degree)
        window = harmonics.least_laplacian(coefficient, self.laplacian)
        return transferred_light(self.transport, harmonics.convolve(coefficient, window))

    def view(
        self, eye: Float[Array, "*p 3"], materials: Blend | None = None, points: Points = VERTICES
    ) -> Float[Array, "lm d p"]:
        """SH coefficients of the BRDF for each point's view."""
        return blended_view(self.brdf, *self.placed(points), materials, eye=eye)

    def combine(
        self, light: Float[Array, "lm c _"], view: Float[Array, "lm d p"], points: Points = VERTICES
    ) -> Float[Array, "p e"]:
        """Radiance: the dot product of light and BRDF coefficients."""
        require.array("the light", light, "lm c v", source="HarmonicSystem.light")
        require.array("the view", view, "lm c v", source="HarmonicSystem.view")
        return combine(points.carry(light, axis=2), view)

    def exported(self, what: str) -> ExportedMatrices:
        """Harmonics of the visibility, from which a page makes the matrices: `System.exported`."""
        return ExportedMatrices.of(what, self)


class TiltedLight(eqx.Module):
    """Light for ideal diffuse surfaces whose normals are tilted by normal maps.

    Attributes:
        coefficient: SH coefficients of the light in the world.
        normal: Unit normals of the vertices.
    """

    coefficient: Float[Array, "lm c *w"]
    normal: Float[Array, "v 3"]


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

    def light(self, environment: Environment | Float[Array, "lm c *w"]) -> Float[Array, "lm c *w"]:
        """SH coefficients of the light, which may be given as such; see `HarmonicSystem.light`."""
        return _coefficients(environment, harmonics.degree_of(self.transport.vector.shape[0]))

    def view(
        self, eye: Float[Array, "*p 3"], materials: Blend | None = None, points: Points = VERTICES
    ) -> Float[Array, "_ d"]:
        """Albedo of all points, or of each point with a blend. It does not depend on the eye."""
        return protocol.albedo_view(self, eye, materials, points)

    def tilted(self, light: Float[Array, "lm c *w"], normal: Float[Array, "v 3"]) -> TiltedLight:
        """The light with the normals of the vertices: `System.tilted`."""
        return TiltedLight(light, normal)

    @promoted
    def combine(
        self, light: Float[Array, "lm c *w"] | TiltedLight, view: Float[Array, "_ d"], points: Points = VERTICES
    ) -> Float[Array, "p e"]:
        """Radiance: the dot product of light and transfer vectors, times the albedo.

        At points with tilted normals it changes by the ratio by which it would change without shadows.
        """
        coefficient = light.coefficient if isinstance(light, TiltedLight) else light
        require.array("the light", coefficient, "lm c", "lm c v", source="DiffuseSystem.light")
        require.array("the view", view, "v c", source="DiffuseSystem.view")
        color = points.carry(combine(coefficient, self.transport.vector)) * view
        if not isinstance(light, TiltedLight) or points.normal is None:
            return color
        smooth = directions.normalize(points.carry(light.normal))
        there = coefficient if coefficient.ndim == 2 else points.carry(coefficient, axis=2)
        return color * tilted_share(*(_unshadowed(there, normal) for normal in (smooth, points.normal.T)))

    def exported(self, what: str) -> protocol.Exported:
        """The transfer vectors: `System.exported`."""
        vector = self.transport.vector
        if vector.shape[1] != 1:
            raise ValueError(f"{what} must have gray transfer vectors to be exported, got {vector.shape[1]} colors")
        return protocol.Exported(self, np.asarray(vector[:, 0], np.float64), np.zeros((0, self.vertices)))

    @property
    def matte(self) -> bool:
        """True: surfaces are ideally diffuse."""
        return True

    @property
    def shared_light(self) -> tuple:
        """Key of the light, which depends on the environment and the number of coefficients only."""
        return DiffuseSystem, self.transport.vector.shape[0]


def tilted_share(before: Float[Array, "*b"], after: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Ratio of the unshadowed light on tilted normals to that on the normals of the surface, at most 4."""
    return jnp.clip(after / jnp.maximum(before, _DARK), 0, _BRIGHTEST)


@jit
def _unshadowed(light: Float[Array, "lm c *w"], normal: Float[Array, "p 3"]) -> Float[Array, "p c"]:
    """Irradiance / pi of normals without shadows."""
    degree = harmonics.degree_of(len(light))
    response = harmonics.convolve(light, harmonics.cosine(degree=degree) / jnp.pi)
    basis = harmonics.evaluate(normal, degree=degree)
    return combine(response, jnp.moveaxis(basis, 1, 0)[:, None])


def _coefficients(light: Any, degree: int) -> Float[Array, "lm c *w"]:
    """SH coefficients of one light, which may be given as such."""
    if getattr(light, "ndim", 0) not in (2, 3):
        return project(protocol.one_light(light), degree=degree)
    rows, edge = light.shape[0], math.isqrt(light.shape[0])
    if not rows or edge**2 != rows:
        raise ValueError(f"the light's number of SH coefficients must be a square number, got {rows}")
    if edge - 1 != degree:
        raise ValueError(f"the light must have the transport's degree {degree}, got {edge - 1}")
    return _light(light)


@require.arguments(light=partial(protocol.one_light, batch=True), degree=_degree)
def project(light: Environment, *, degree: int) -> Float[Array, "*l lm c"]:
    """Projects an environment, or each one of a batch, to spherical harmonics.

    Args:
        light: An environment, or a batch of them along leading axes.
        degree: Highest degree of the harmonics.

    Returns:
        SH coefficients in l(l+1)+m order, in units of radiance times sr^1/2.

    Raises:
        TypeError: The light is not an `Environment`.
        ValueError: The light is not finite, or the degree is negative.
    """
    *batch, faces, edge, _, colors = light.radiance.shape
    radiance = jnp.moveaxis(light.radiance.reshape(-1, faces, edge, edge, colors), 0, -1)
    coefficient = harmonics.project(radiance, degree=degree)
    return jnp.moveaxis(coefficient, -1, 0).reshape(*batch, -1, colors)


@require.arguments(light=_light)
@jit
def local_light(frame: Float[Array, "v 3 3"], light: Float[Array, "lm c *w"]) -> Float[Array, "lm c v"]:
    """Rotates the light to the frame of every vertex. This is the light side without shadows.

    Args:
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal. The bitangent is replaced by normal x
            tangent.
        light: SH coefficients in the world, from `project`: one set, or one for each vertex.
    """
    return rotation.rotate_each(light, right_handed(frame))


@require.arguments(transport=_matrix, light=_light)
@jit
def transferred_light(transport: TransferMatrix, light: Float[Array, "lm c *w"]) -> Float[Array, "lm _ v"]:
    """SH coefficients of the light that arrives at every vertex, in its frame. This is the light side with shadows.

    Args:
        transport: Transfer matrices, from `precompute`.
        light: SH coefficients in the world, from `project`: one set, or one for each vertex.

    Raises:
        ValueError: Light and transport differ in degree.
    """
    count, colors, terms, _ = transport.matrix.shape
    _check_degree(light.shape[0], terms, "the light", "the transport")
    several_colors = _colors(light.shape[1], colors)
    if light.ndim == 3:
        several = jnp.broadcast_to(light, (terms, several_colors, light.shape[2]))
        return jnp.einsum(
            "vcoi,icv->ocv", jnp.broadcast_to(transport.matrix, (count, several.shape[1], terms, terms)), several
        )
    if colors == 1:
        return (transport.matrix.reshape(-1, terms) @ light).reshape(count, terms, -1).transpose(1, 2, 0)
    return jnp.einsum("vcoi,ic->ocv", transport.matrix, jnp.broadcast_to(light, (terms, colors)))


@require.arguments(brdf=_brdf, eye=_eyes)
@jit
def view_coefficients(
    brdf: HarmonicBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    *parameter: Float[Array, " v"],
    eye: Float[Array, "3"] | Float[Array, "v 3"],
) -> Float[Array, "lm c v"]:
    """SH coefficients of BRDF x cosine for every vertex's view, in its frame: the view side.

    Args:
        brdf: BRDF table, from `tabulate`.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        parameter: Values of each BRDF parameter at the vertices, if the table has parameters.
        eye: Position of the viewer in world units: one, or one for each vertex.
    """
    return brdf.coefficients(directions.view(right_handed(frame), position, eye), *parameter)


def blended_view(
    brdf: HarmonicBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    materials: Blend | None,
    *,
    eye: Float[Array, "*p 3"],
) -> Float[Array, "lm c v"]:
    """`view_coefficients` with the materials of a blend, whose weights sum the table's channels.

    Args:
        brdf: BRDF table, from `tabulate`.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        materials: Weights and parameters of each vertex; None for the table's own channels as colors.
        eye: Position of the viewer in world units: one, or one for each vertex.
    """
    protocol.check_blend(materials)
    eye = require.position("the eye", eye, points=len(position))
    parameter = () if materials is None else materials.parameter
    row = view_coefficients(brdf, position, frame, *parameter, eye=eye)
    if materials is None:
        return row
    materials.check(len(position), row.shape[1])
    return jnp.einsum("ikv,vkc->icv", row, materials.weight, precision="highest")


@require.arguments(light=_light_shape)
@jit
def combine(light: Float[Array, "lm c *w"], view: Float[Array, "lm l v"]) -> Float[Array, "v _"]:
    """Radiance: the dot product of light and BRDF coefficients.

    Args:
        light: SH coefficients of the light, one set or one for each vertex, in the same frame as `view`.
        view: SH coefficients of the BRDF, or transfer vectors.

    Raises:
        ValueError: The two differ in degree, or have different numbers of colors and neither is gray.

    Reference: Kautz, Sloan, Snyder 2002, equation 1.
    """
    _check_degree(light.shape[0], view.shape[0], "the light", "the BRDF or transport")
    colors = _colors(light.shape[1], view.shape[1])
    part = [
        sum(light[i, _color(c, light.shape[1])] * view[i, _color(c, view.shape[1])] for i in range(len(light)))
        for c in range(colors)
    ]
    return jnp.stack(part, -1)


def _colors(mine: int, other: int) -> int:
    """Number of colors of a product."""
    if mine != other and 1 not in (mine, other):
        raise ValueError(
            f"both factors must have the same number of colors, or one of them a single color, got {mine} and {other}"
        )
    return max(mine, other)


def _color(number: int, colors: int) -> int:
    """Index of a color along an axis of length 1 (gray) or one entry per color."""
    return number if colors > 1 else 0


def _check_degree(mine: int, other: int, name: str, other_name: str) -> None:
    mine, other = harmonics.degree_of(mine), harmonics.degree_of(other)
    if mine != other:
        raise ValueError(f"{name} must have the same degree as {other_name}, {other}, got {mine}")


@require.arguments(probe=_probe, coefficient=_probe_coefficient)
@jit
def probe_light(
    position: Float[Array, "v 3"], probe: Float[Array, "p 3"], coefficient: Float[Array, "p lm c"]
) -> Float[Array, "lm c v"]:
    """Interpolates the light at a few probes to the vertices, for light that varies over an object.

    The light of each vertex is a weighted mean of the probes. Weights fall with the fourth power of distance (Shepard
    interpolation), which is smooth and exact at the probes. Where a vertex coincides with a probe, derivatives with
    respect to position are zero.

    Args:
        position: Vertex positions in world units.
        probe: Positions of the probes in world units.
        coefficient: SH coefficients of the light at each probe.

    Returns:
        SH coefficients of the light at each vertex, in the world.

    Raises:
        TypeError: Probes or coefficients are not arrays.
        ValueError: There are no probes, the numbers of probes and of lights differ, or a value is not finite.

    Reference: Kautz, Sloan, Snyder 2002, section 4 (finite lighting); Shepard 1968.
    """
    if len(probe) != len(coefficient):
        raise ValueError(f"there must be light at each of the {len(probe)} probes, got light at {len(coefficient)}")
    square = jnp.sum((position[:, None] - probe) ** 2, -1)
    nearest = jnp.min(square, -1, keepdims=True)
    ratio = jnp.where(nearest > 0, nearest, 1) / jnp.where(nearest > 0, square, 1)
    weight = jnp.where(nearest > 0, ratio**2, jnp.where(square > 0, 0, 1))
    weight = weight / jnp.sum(weight, -1, keepdims=True)
    return jnp.einsum("vp,plc->lcv", weight, coefficient)
