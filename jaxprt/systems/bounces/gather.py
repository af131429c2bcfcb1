"""Reflected light along paths of functions: the light that arrives at vertices from surfaces with given functions.

    R_y(l, k) = int_l u_k(w) V_y(w) (w . n) dw
    T_x(s, p, l) = sum_rays m_s sum_y b_y sum_k g_kp(wo) R_y(l, k)

One bounce T is a tensor over measures s of the arriving light, such as harmonics, the function p of the reflecting
surface, and the light's texels l. It is computed from the responses R of light factors u at the corners y of the
triangles that rays hit, with barycentric weights b, by gathers and products. The response to reflected light gives the
next bounce by the same steps. The functions are those of `jaxprt.bounces.functions`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt import visibility
from jaxprt.compile import jit
from jaxprt.sphere import cubemap, directions, haar, harmonics, rotation
from jaxprt.systems.bounces import functions
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.separable import SeparableBrdf

DEGREE = 3  # degree of the harmonics that arrive
_HITS = 16  # number of hits in a group: few are padding, and their responses fit in the cache
_GRAZING = 1e-3  # smallest cosine of a view: interpolated normals may face away where the surface does not


@functools.partial(jit, static_argnames=("edge",))
def respond(
    seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], basis: SeparableBrdf, *, edge: int
) -> Float[Array, "b l k"]:
    """Response of light factors to direct light from each texel of coarse cubemap faces.

    Args:
        seen: Visibility of each cubemap texel in sixteenths.
        frame: Frame of each vertex; rows are tangent, bitangent, normal.
        basis: Functions of the surfaces, from `jaxprt.bounces.functions.basis`.
        edge: Edge of the coarse faces, a divisor of that of the visibility's faces.

    Returns:
        Integrals over each coarse texel of light factor x visibility x cosine.
    """
    size = haar.face_edge(seen.shape[1])
    fold = size // edge

    def one(argument):
        visible, axes = argument
        factor = _met(axes, basis, size) * (visible / visibility.LEVELS)[:, None].astype(axes.dtype)
        return jnp.sum(factor.reshape(6, edge, fold, edge, fold, -1), (2, 4)).reshape(6 * edge * edge, -1)

    return jax.lax.map(one, (seen, frame))


@jit
def respond_again(
    arriving: Float[Array, "s q b"], frame: Float[Array, "b 3 3"], basis: SeparableBrdf
) -> Float[Array, "b q k"]:
    """Response of light factors to light that arrives as harmonics, for each kind q of light.

    Args:
        arriving: SH coefficients of radiance in world directions.
        frame: Frame of each vertex; rows are tangent, bitangent, normal.
        basis: Functions of the surfaces, from `jaxprt.bounces.functions.basis`.

    Returns:
        Integrals over the hemisphere of light factor x radiance x cosine.
    """
    local = rotation.rotate_each(arriving, frame)
    return jnp.einsum("sqb,sk->bqk", local, functions.project(basis, degree=harmonics.degree_of(len(arriving))))


@jit
def respond_to_lamps(
    transport: LampTransport, frame: Float[Array, "v 3 3"], basis: SeparableBrdf
) -> Float[Array, "v k i"]:
    """Response of light factors to lamps of radiance 1, for each lamp i.

    The light of each piece of a lamp comes from the mean direction in which it is seen.

    Args:
        transport: Transport of the lamps to the vertices.
        frame: Frame of each vertex; rows are tangent, bitangent, normal.
        basis: Functions of the surfaces, from `jaxprt.bounces.functions.basis`.

    Returns:
        Integrals over the visible part of each lamp of light factor x cosine.
    """
    wi = directions.normalize(jnp.einsum("vij,mjv->mvi", frame, transport.direction, precision="highest"))
    piece = basis.light(wi)[..., 0] * transport.cosine[..., None]
    lamp = jax.ops.segment_sum(piece, np.asarray(transport.lamp), transport.lamps, indices_are_sorted=True)
    return jnp.moveaxis(lamp, 0, -1)


class Rays(NamedTuple):
    """Rays that hit surfaces, in groups that each belong to one point. Padding of a group has zero weights.

    Attributes:
        owner: Index of the point of each group.
        corner: Vertices of the triangle that each ray hits.
        weight: Barycentric weights of the hit.
        texel: Texel through which each ray is traced.
    """

    owner: Int[np.ndarray, " g"]
    corner: Int[np.ndarray, "g h 3"]
    weight: Float[np.ndarray, "g h 3"]
    texel: Int[np.ndarray, "g h"]


@jit
def arrive(
    total: Float[Array, "b s p l"],
    response: Float[Array, "v k l"],
    frame: Float[Array, "v 3 3"],
    basis: SeparableBrdf,
    owner: Int[Array, " g"],
    corner: Int[Array, "g h 3"],
    weight: Float[Array, "g h 3"],
    direction: Float[Array, "g h 3"],
    measure: Float[Array, "g h s"],
) -> Float[Array, "b s p l"]:
    """Adds the light that surfaces send to some points, summed over the rays of each point with given measures.

    Args:
        total: The sum so far, for each point, measure, function and light.
        response: Responses of the light factors at all vertices of the surfaces, from `respond` or `respond_again`. The
            light is the last axis, so that memory is read contiguously.
        frame: Frames of these vertices.
        basis: Functions of the surfaces, from `jaxprt.bounces.functions.basis`.
        owner: Index of the point of each group of rays; see `Rays`.
        corner: Vertices of the triangle that each ray hits.
        weight: Barycentric weights of the hit.
        direction: Directions of the rays.
        measure: Weights of each ray: harmonics times solid angle, or cosine times solid angle over pi.

    Returns:
        The sum with the light of these rays.
    """

    def add(total, group):
        owner, corner, weight, direction, measure = group
        wo = jnp.sum(frame[corner] * -direction[:, None, None], -1)
        wo = directions.normalize(wo.at[..., 2].max(_GRAZING))
        view = basis.view(wo) * weight[..., None, None]  # [h, 3, k, p]
        sent = jnp.einsum("hckp,hckl->hpl", view, response[corner])
        return total.at[owner].add(jnp.einsum("hs,hpl->spl", measure, sent).astype(total.dtype)), None

    return jax.lax.scan(add, total, (owner, corner, weight, direction, measure))[0]


def rays(
    occluder: visibility.Occluder,
    start: Float[np.ndarray, "b 3"],
    normal: Float[np.ndarray, "b 3"],
    frame: Float[np.ndarray, "v 3 3"],
    region: Int[np.ndarray, " v"],
    *,
    size: int = 16,
) -> dict[int, Rays]:
    """Traces rays through the texels above the horizon of some points, and finds the front faces that they hit.

    Args:
        occluder: The scene.
        start: Origins of the rays.
        normal: Normals at the origins.
        frame: Frames of the scene's vertices.
        region: Region of each vertex of the scene.
        size: Edge of the cubemap faces through whose texels rays are traced.

    Returns:
        For each region that is hit, its rays. If the corners of a triangle belong to several regions, each of them has
        the ray, with the weights of its own corners.
    """
    point, texel, corner, barycentric, _ = visibility.rays.hemisphere_hits(occluder, start, normal, size=size)
    way = np.asarray(cubemap.direction(size=size), np.float32).reshape(-1, 3)[texel]
    seen = visibility.rays.hits_front(occluder, frame[:, 2], corner, way)
    result = {}
    for number in np.unique(region[corner[seen]]).tolist():
        inside = region[corner] == number
        hit = np.flatnonzero(seen & inside.any(1))
        count = np.bincount(point[hit], minlength=len(start))
        place = np.arange(len(hit)) - np.repeat(np.cumsum(count) - count, count)
        groups = -(-count // _HITS)
        group = (np.cumsum(groups) - groups)[point[hit]] + place // _HITS
        padded = [np.zeros((groups.sum(), _HITS, *x.shape[1:]), x.dtype) for x in (corner, barycentric, texel)]
        for whole, rows in zip(padded, (corner[hit], (barycentric * inside)[hit], texel[hit]), strict=True):
            whole[group, place % _HITS] = rows
        result[number] = Rays(np.repeat(np.arange(len(start)), groups), *padded)
    return result


def shares(normal: Float[np.ndarray, "b 3"], *, size: int) -> Float[np.ndarray, "b d"]:
    """Fraction that each texel contributes to the irradiance of points under uniform light. Rows sum to one."""
    flux = np.maximum(normal @ np.asarray(cubemap.vector_area(size=size), np.float32).reshape(-1, 3).T, 0)
    return flux / flux.sum(1, keepdims=True)


def cosines(normal: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "b s"]:
    """Weights that give irradiance over pi from the harmonics that arrive at points."""
    kernel = harmonics.evaluate(jnp.asarray(normal), degree=DEGREE).T
    return np.asarray(harmonics.convolve(kernel, harmonics.cosine(degree=DEGREE) / np.pi).T, np.float32)


def measures(
    cosine: Float[np.ndarray, "*b s"],
    texel: Int[np.ndarray, "*b"],
    share: Float[np.ndarray, "*b"],
    *,
    size: int,
) -> Float[np.ndarray, "*b s"]:
    """Weights of rays in the harmonics that arrive, corrected such that these give the right irradiance.

    The truncated harmonics of a ray have a wrong irradiance, because the cosine has higher bands: for instance, it is
    not zero just below the horizon. The smallest correction of the coefficients is along the harmonics of the cosine.

    Args:
        cosine: Result of `cosines` for the point at which each ray arrives.
        texel: Texel of each ray.
        share: Fraction that the ray contributes to the irradiance of the point under uniform light.
        size: Edge of the cubemap faces.
    """
    way = np.asarray(cubemap.direction(size=size), np.float32).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=size), np.float32).reshape(-1, 1)
    plain = (np.asarray(harmonics.evaluate(jnp.asarray(way), degree=DEGREE)) * area)[texel]
    off = share - np.sum(plain * cosine, -1)
    return plain + (off / np.sum(cosine**2, -1))[..., None] * cosine


def _met(axes: Array, basis: SeparableBrdf, size: int) -> Array:
    """Light factor times cosine times solid angle of all texels, [d, k]."""
    direction, area = (x(size=size).reshape(-1, 3) for x in (cubemap.direction, cubemap.vector_area))
    flux = jnp.maximum(area @ axes[2], 0)
    return basis.light(directions.to_local(axes, direction))[..., 0] * flux[:, None]
