"""Relighting by spherical harmonics: arbitrary BRDFs under low-frequency light (Kautz, Sloan, Snyder 2002).

`local_light` rotates the light to each vertex's frame, `view_coefficients` looks the BRDF up for each vertex's view,
and `combine` forms their dot product: radiance. With shadows, `transferred_light` takes the place of `local_light`.
While the light is fixed, keep its result; while the view is fixed, keep that of `world_view`, or of `transferred_view`
with shadows, which is combined with the coefficients of the distant light. `radiance` and `unshadowed_radiance` do all
steps.

Lights, eyes and probes must be finite. Values cannot be checked inside `jax.jit`, `jax.vmap` and `jax.grad`: there, NaN
in a light or an eye reaches every vertex, and NaN at a probe reaches every vertex with a weight of it.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import directions, harmonics, rotation
from jaxprt.systems import protocol
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector, right_handed


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


def _vector(value: Any) -> None:
    require.kind("the transport", value, TransferVector, source="jaxprt.harmonic.precompute_diffuse")


_eye = partial(require.position, "the eye")


def _eyes(value: Any) -> Array:
    require.real("the eye", value)
    shape = jnp.shape(value)
    return require.position("the eye", value, each=shape[0] if len(shape) == 2 else None)


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
    every = jnp.moveaxis(light.radiance.reshape(-1, faces, edge, edge, colors), 0, -1)
    coefficient = harmonics.project(every, degree=degree)
    return jnp.moveaxis(coefficient, -1, 0).reshape(*batch, -1, colors)


@require.arguments(transport=_matrix, brdf=_brdf, light=_light, eye=_eye)
@jit
def radiance(
    transport: TransferMatrix,
    brdf: HarmonicBrdf,
    light: Float[Array, "lm c *w"],
    *parameter: Float[Array, " v"],
    eye: Float[Array, "3"],
) -> Float[Array, "v _"]:
    """Radiance of every vertex towards the eye, with shadows.

    Differentiable in all arguments.

    Args:
        transport: Transfer matrices, from `precompute`.
        brdf: BRDF table, from `tabulate`.
        light: SH coefficients of the distant light in the world, from `project`: one set, or one for each vertex.
        parameter: Values of each BRDF parameter at the vertices, if the table has parameters.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance. Ringing of the harmonics can make it negative.

    Raises:
        TypeError: The transport is not a `TransferMatrix`, the BRDF not a `HarmonicBrdf`, or the light an environment
            instead of its coefficients.
        ValueError: Light, transport and table differ in degree, an array has other axes, or the light or the eye is not
            finite.

    Reference: Kautz, Sloan, Snyder 2002, sections 4 and 5.
    """
    view = view_coefficients(brdf, transport.position, transport.frame, *parameter, eye=eye)
    return combine(light, transferred_view(transport, view))


@require.arguments(brdf=_brdf, light=_light, eye=_eye)
@jit
def unshadowed_radiance(
    mesh: Mesh,
    brdf: HarmonicBrdf,
    light: Float[Array, "lm c *w"],
    *parameter: Float[Array, " v"],
    eye: Float[Array, "3"],
) -> Float[Array, "v _"]:
    """Radiance of every vertex towards the eye, without shadows. Only the BRDF table is precomputed.

    Args:
        mesh: The mesh.
        brdf: BRDF table, from `tabulate`.
        light: SH coefficients of the distant light in the world, from `project`: one set, or one for each vertex.
        parameter: Values of each BRDF parameter at the vertices, if the table has parameters.
        eye: Position of the viewer in world units.

    Returns:
        Linear radiance. Ringing of the harmonics can make it negative.

    Raises:
        TypeError: The BRDF is not a `HarmonicBrdf`, or the light is an environment instead of its coefficients.
        ValueError: Light and table differ in degree, an array has other axes, or the light or the eye is not finite.

    Reference: Kautz, Sloan, Snyder 2002, section 4.
    """
    frame = directions.frame(mesh.normal, mesh.tangent)
    return combine(local_light(frame, light), view_coefficients(brdf, mesh.position, frame, *parameter, eye=eye))


@require.arguments(transport=_vector, light=_light)
@jit
def diffuse_radiance(
    transport: TransferVector, albedo: Float[Array, "..."], light: Float[Array, "lm c *w"]
) -> Float[Array, "v _"]:
    """Radiance of ideal diffuse vertices, which is the same for all views.

    Args:
        transport: Transfer vectors, from `precompute_diffuse`.
        albedo: Albedo, gray or per color: one for all vertices, or one for each.
        light: SH coefficients of the distant light in the world, from `project`: one set, or one for each vertex.

    Raises:
        TypeError: The transport is not a `TransferVector`, or the light is an environment instead of its coefficients.
        ValueError: Light and transport differ in degree, or the light has other axes or is not finite.
    """
    return combine(light, transport.vector) * albedo


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


@jit
def world_view(frame: Float[Array, "v 3 3"], view: Float[Array, "lm c v"]) -> Float[Array, "lm c v"]:
    """Rotates `view_coefficients` to the world frame, where all vertices share the same light: for a fixed view."""
    return rotation.rotate_each(view, right_handed(frame).swapaxes(1, 2))


@require.arguments(transport=_matrix)
@jit
def transferred_view(transport: TransferMatrix, view: Float[Array, "lm c v"]) -> Float[Array, "lm _ v"]:
    """Applies transposed transfer matrices to `view_coefficients`: for a fixed view with shadows.

    The result is combined with the coefficients of the distant light in the world.

    Args:
        transport: Transfer matrices, from `precompute`.
        view: The result of `view_coefficients`.

    Raises:
        ValueError: The table and the transport differ in degree.
    """
    count, colors, terms, _ = transport.matrix.shape
    _check_degree(view.shape[0], terms, "the BRDF", "the transport")
    _colors(view.shape[1], colors)
    rows = view.transpose(2, 1, 0)
    if colors == 1:
        # One color at a time: a product of one vector and one matrix per vertex.
        part = [jnp.einsum("voi,vo->iv", transport.matrix[:, 0], rows[:, c]) for c in range(view.shape[1])]
        return jnp.stack(part, 1)
    return jnp.einsum("vcoi,vco->icv", transport.matrix, jnp.broadcast_to(rows, (count, colors, terms)))


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
