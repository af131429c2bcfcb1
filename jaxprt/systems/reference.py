"""Reference solution for direct light: integrates the BRDF itself over every texel. Slow; errors are measured by it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float, UInt8

from jaxprt import require, visibility
from jaxprt.brdf import grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import Between, finished, jit, known, mapped
from jaxprt.scene import origin as origins
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, relative
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.systems import adaptive, protocol
from jaxprt.visibility.rays import BLOCK, PRECOMPUTE

_MIRROR = np.array([-1, -1, 1], np.float32)
_DARK = 1e-30


def radiance(
    mesh: Mesh,
    brdf: Callable,
    light: Environment,
    *,
    eye: Float[Array | np.ndarray, "3"],
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    points: Points = VERTICES,
    error: float = 1e-3,
    progress: bool = False,
    between: Between = None,
) -> Float[Array, "..."]:
    """Radiance of direct light that vertices or points send to the eye, by ray tracing and adaptive integration.

    Args:
        mesh: The mesh.
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions: a model or any function. Values below the
            horizon are not used. A new function object, such as a lambda in a loop, is compiled again. `PerVertex`
            holds one BRDF for each vertex of the mesh, or each point.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer in world units, in the coordinates of the mesh's file.
        occluder: Mesh that casts shadows; the mesh itself if None.
        vertex: Indices of the vertices to evaluate, or a mask; all if None.
        points: Points on triangles of the mesh at which radiance is evaluated instead of vertices. Each has its own
            rays.
        error: Largest relative error of the radiance of each vertex, averaged over colors, due to integration of BRDF x
            cosine. It is an estimate: a peak of the BRDF that is narrower than a texel is detected around the mirror
            direction only. Light is constant over each texel, and visibility is a share of the texel in sixteenths;
            their errors are not included. With infinity, each texel uses the BRDF at its center. If the BRDF is
            Lambertian, one ray decides about each texel whose share of the unshadowed radiance is below a quarter of
            the error.
        progress: Whether to show a progress bar.
        between: Function called after each block of 64 vertices. An exception that it raises stops the computation.

    Returns:
        Linear radiance [*l v c], in units of the light's radiance. Differentiable in the BRDF's parameters, the light
        and the eye.

    Raises:
        TypeError: The light is not an `Environment`, or the BRDF is a table whose values include the cosine.
        ValueError: A vertex index is out of range, the error is not positive, the BRDF's values have no color axis, or
            the light or the eye is not finite. Values cannot be checked inside `jax.jit`, where NaN reaches the
            vertices.
    """
    if not isinstance(brdf, PerVertex):
        grid.check(brdf)
    require.function("between", between)
    if not (isinstance(error, float | np.floating) and error == np.inf):
        require.number("error", error, 0.0, above=True)
    brdf = grid.as_argument(brdf)
    for name, value in (("mesh", mesh), ("occluder", occluder), ("vertex", vertex)):
        PRECOMPUTE[name](value)
    protocol.check_points(points, len(mesh.position))
    light = protocol.one_light(light, batch=True)
    eye = require.position("the eye", origins.local("the eye", eye, mesh.origin))
    if not isinstance(brdf, PerVertex):
        direction = jax.ShapeDtypeStruct((1, 3), jnp.result_type(float))
        channels = jax.eval_shape(brdf, direction, direction).shape
        protocol.check_colors(light.radiance.shape[-1], channels[-1] if len(channels) > 1 else 1)
    rays = visibility.Occluder(mesh if occluder is None else relative(occluder, mesh.origin))
    if points.all_vertices:
        start = visibility.start_points(mesh, rays)
        vertex = visibility.rays.vertex_indices(mesh, vertex)
    elif vertex is not None:
        raise ValueError("give either vertices or points, got both")
    else:
        start = visibility.point_starts(mesh, points)
        vertex = np.arange(len(points))
    position, frame = map(np.asarray, placed(mesh.position, directions.frame(mesh.normal, mesh.tangent), points))
    # Light arrives from above the smooth surface, whatever a normal map does to its normals.
    above = frame[:, 2] if points.normal is None else _smooth(mesh, points)
    size = light.radiance.shape[-2]
    if isinstance(brdf, PerVertex) and brdf.vertices != len(position):
        raise ValueError(f"the BRDF must have parameters for the mesh's {len(position)} vertices, got {brdf.vertices}")
    if not vertex.size:
        return jnp.zeros((*light.radiance.shape[:-4], 0, light.radiance.shape[-1]))
    result = []
    matte = (
        getattr(brdf.model if isinstance(brdf, PerVertex) else brdf, "matte", False) and known(light) and error < np.inf
    )
    for first in tqdm.trange(0, len(vertex), BLOCK, desc="reference", disable=not progress):
        part = np.resize(vertex[first : first + BLOCK], BLOCK)
        fine = _shares(light, frame[part, 2]) > error / 4 if matte else True
        options = {"size": size, "supersample": fine}
        seen, _ = visibility.fractional(rays, start[part], np.asarray(above[part], np.float32), **options)
        model = PerVertex(brdf.of(jnp.asarray(part))) if isinstance(brdf, PerVertex) else brdf
        block = finished(integrate(seen, position[part], frame[part], model, light, eye, error=error), between)
        result.append(block[..., : len(vertex) - first, :])
    return jnp.concatenate(result, -2)


def _smooth(mesh: Mesh, points: Points) -> Float[np.ndarray, "p 3"]:
    """Interpolated normals of points, without normal maps."""
    frame = directions.frame(mesh.normal, mesh.tangent)
    return np.asarray(points.tilted(None).frame(frame))[:, 2]


def _shares(light: Environment, normal: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "b d"]:
    """Share of each texel in the irradiance of surfaces without shadows: the largest one under several lights."""
    area = np.asarray(cubemap.vector_area(size=light.radiance.shape[-2])).reshape(-1, 3)
    flux, share = np.maximum(normal @ area.T, 0), np.float32(0)
    for radiance in np.abs(np.asarray(light.radiance).mean(-1)).reshape(-1, len(area)):
        share = np.maximum(share, radiance / np.maximum(flux @ radiance, _DARK)[:, None])
    return flux * share


@jit
def integrate(
    seen: UInt8[Array, "b d"],
    position: Float[Array, "b 3"],
    frame: Float[Array, "b 3 3"],
    brdf: Callable,
    light: Environment,
    eye: Float[Array | np.ndarray, "3"],
    *,
    error: float | Float[Array, ""] = 1e-3,
) -> Float[Array, "..."]:
    """Integral of light x BRDF x visibility x cosine over all texels.

    Where the BRDF is smooth, its value at the texel center is multiplied by the exact integral of the cosine. Texels
    with too large an estimated error are subdivided adaptively; see `jaxprt.systems.adaptive`.

    Args:
        seen: Visible share of each texel in sixteenths.
        position: Positions in world units.
        frame: Shading frames; rows are tangent, bitangent, normal.
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr that is a callable pytree, as the models are, or `PerVertex`.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer in world units, in the coordinates of `position`.
        error: Largest relative error of the radiance of each vertex due to integration of BRDF x cosine.

    Returns:
        Linear radiance [*l b c]. Where the eye is below a vertex's horizon, it is that of a grazing view.

    Reference: Wang, Tran, Luebke 2004, equation 1.
    """
    batch, colors = light.radiance.shape[:-4], light.radiance.shape[-1]
    table = light.radiance.reshape(-1, seen.shape[1], colors).astype(jnp.result_type(float))
    wo = directions.view(frame, position, eye)
    whole = adaptive.Integrand(brdf, frame, wo, table)
    smooth, choice, chosen = _centers(whole, seen, jnp.asarray(error, wo.dtype))
    sharp = adaptive.integrate(whole, choice, chosen, colors=smooth.shape[-1])
    return jnp.swapaxes(smooth + sharp, 0, 1).reshape(*batch, *smooth.shape[::2])


def _centers(integrand: adaptive.Integrand, seen: Array, error: Array) -> tuple[Array, adaptive.Choice, Array]:
    """Sums over texels that need no subdivision; data that decide about subdivision; and root cells to subdivide."""
    size = haar.face_edge(seen.shape[1])
    direction, area = (_blocks(texels(size=size)) for texels in (cubemap.direction, cubemap.vector_area))
    middle = jnp.mean(direction, 0)
    light = jax.vmap(lambda row: _blocks(row.reshape(6, size, size, -1)), out_axes=1)(integrand.light)
    level = jax.vmap(lambda row: _blocks(row.reshape(6, size, size)))(seen)
    mean = jax.lax.stop_gradient(jnp.swapaxes(jnp.mean(light, -1), 0, 1))
    light = jnp.moveaxis(light, -1, 1)

    # Vertices are processed one by one, so that their arrays stay in the processor's cache. `brightest` and the sum
    # over texels are explicit loops because XLA recomputes a value for each of its uses, except across loops.
    def one(argument):
        axes, wo, level, vertex = argument
        brdf = integrand.brdf.of(vertex) if isinstance(integrand.brdf, PerVertex) else integrand.brdf
        value = adaptive.value(brdf, directions.to_local(axes, direction.reshape(-1, 3)), wo)
        value = value.reshape(*level.shape, -1)
        flux = area @ axes[2]
        clear = level.astype(flux.dtype) / visibility.LEVELS
        peak = wo[2] * jnp.mean(adaptive.value(brdf, (wo * _MIRROR)[None], wo))
        arriving = jnp.maximum(flux, 0) * clear
        gray, lean, height, flat = jax.lax.stop_gradient((jnp.mean(value, -1), flux, peak, arriving))
        weight = 1 / jnp.maximum(jnp.einsum("let,et->l", mean, gray * flat), _DARK)
        away = jax.lax.stop_gradient(middle @ axes.T - wo * _MIRROR)
        brightest = adaptive.brightest(mean, weight[:, None, None])
        chosen = _vary(gray, lean, clear * brightest, away, height, error)

        def add(total, texel):
            light, value, arriving = texel
            return total + _sums(light, value * (arriving * ~chosen)[:, None]), None

        colors = max(value.shape[-1], light.shape[1])
        total = jax.lax.scan(add, jnp.zeros((len(mean), colors), value.dtype), (light, value, arriving))[0]
        return total, weight, height, chosen

    total, weight, height, chosen = mapped(one, (integrand.frame, integrand.wo, level, jnp.arange(len(integrand.wo))))
    edge = size // adaptive.root(size)
    return total, adaptive.Choice(seen, weight, height, error), chosen.reshape(-1, 6, edge, edge)


def _sums(light: Array, value: Array) -> Array:
    """Sums [l c] over texels t of light [c l t] times values [t c]. Either may be gray, with one color."""
    # One product per color, because the compiler's loops take seven times as long with colors as the last axis.
    pairs = np.broadcast(np.arange(len(light)), np.arange(value.shape[-1]))
    return jnp.stack([light[i] @ value[:, j] for i, j in pairs], -1)


def _blocks(texel: Array) -> Array:
    """Reshapes texels [6 n n *c] to [e t *c], with place e in the root cell and index t of the root cell."""
    edge = adaptive.root(texel.shape[1])
    count = texel.shape[1] // edge
    block = texel.reshape(6, count, edge, count, edge, *texel.shape[3:])
    return jnp.moveaxis(block, (2, 4), (0, 1)).reshape(edge**2, -1, *texel.shape[3:])


def _vary(gray: Array, lean: Array, scale: Array, away: Array, height: Array, error: Array) -> Array:
    """Chooses the root cells t in which sampling the BRDF at texel centers [e t] is not accurate enough."""
    if len(gray) == 1:
        return jnp.broadcast_to(error < jnp.inf, gray[0].shape)
    side, edge = adaptive.SIDE, 2 / haar.face_edge(gray.size)
    flux = jnp.maximum(lean, 0)  # `lean`: integral of the cosine over a texel in sr, negative below the horizon
    miss, size, top, hidden, cut = (jnp.zeros_like(gray[0]) for _ in range(5))
    # Texels are written out one by one, so that XLA fuses all that follows into one loop over cells.
    for here in range(side**2):
        much, sent = scale[here], gray[here] * flux[here]  # `scale`: visible light / vertex's radiance, most of lights
        for step, place in ((side, here // side), (1, here % side)):
            if 0 < place < side - 1:
                back, ahead = here - step, here + step
                # The error of the midpoint rule is f'' / 24, plus f' g' / 12 for a product f g.
                bend = jnp.abs(gray[back] - 2 * gray[here] + gray[ahead]) * flux[here] / 24
                bend += jnp.abs((gray[ahead] - gray[back]) * (flux[ahead] - flux[back])) / 48
                miss += 2 * bend * much  # for the two inner rows and the two outer ones
        size += sent * much
        top = jnp.maximum(top, gray[here])
        hidden += jnp.abs(height * edge**2 - sent) * much
        cut += jnp.where(jnp.abs(lean[here]) < edge**3 / 2, much, 0)
    # The mirror direction, of BRDF x cosine `height`, serves as one more sample, to detect a peak between centers.
    near = jnp.sum(away**2, -1) < ((2.5 + side / np.sqrt(2)) * edge) ** 2
    # The horizon adds at most an eighth of a texel's edge.
    miss += jnp.where(near, hidden / 8, 0) + edge**3 / 16 * top * cut
    return miss > error * jnp.maximum(size, adaptive.SMALL)
