"""Direct light integrated over every texel with the BRDF itself: slow, and the yardstick of every error here."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float, UInt8

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.relight import refine
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.transport import visibility

_BLOCK = 64
_MIRROR = np.array([-1, -1, 1], np.float32)
_DARK = 1e-30


def radiance(
    mesh: Mesh,
    brdf: Callable,
    light: Environment,
    *,
    eye: Float[Array, "3"],
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    error: float = 1e-3,
    progress: bool = False,
) -> Float[Array, "..."]:
    """Radiance that vertices send to the eye: visibility traced, and BRDF and cosine integrated over every texel.

    Args:
        mesh: The vertices.
        brdf: A model, or any function (wi, wo) -> value [*b c] in 1/sr on local directions, of which values below
            the horizon do not count; a new function object, as a lambda in a loop, compiles anew.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer in world units.
        occluder: What casts shadows; the mesh itself if None.
        vertex: Numbers of the vertices asked for, or a mask; all if None.
        error: Relative error that the integrals of BRDF times cosine may cause in the radiance of each vertex, mean
            over colors. It is an estimate: a peak of the BRDF narrower than a texel is found around the mirror
            direction only. The light counts as constant over each texel, and visibility as a share of it, in
            sixteenths; this error leaves theirs out. With infinity each texel counts with the BRDF at its center.
        progress: Whether to show a progress bar.

    Returns:
        Linear radiance [*l v c], in the light's units. Differentiable in the BRDF's parameters, the light and the eye.

    Raises:
        TypeError: The light is no Environment.
        ValueError: No such vertices, an error that is not positive, the BRDF's values have no axis for colors, or the
            light or the eye is not finite. Inside `jax.jit` values are not known: NaN then reaches the vertices.
    """
    if not error > 0:
        raise ValueError(f"error must be positive, got {error}")
    require.kind("the light", light, Environment, source="jaxprt.scene.load_environment")
    require.finite("the light", light.radiance)
    require.position("the eye", eye)
    rays = visibility.Occluder(mesh if occluder is None else occluder)
    start = visibility.start_points(mesh, rays)
    vertex = visibility.chosen(mesh, vertex)
    normal = np.asarray(mesh.normal, np.float32)
    frame = directions.frame(mesh.normal, mesh.tangent)
    size = light.radiance.shape[-2]
    brdf = grid.as_argument(brdf)
    if not vertex.size:
        return jnp.zeros((*light.radiance.shape[:-4], 0, light.radiance.shape[-1]))
    result = []
    for first in tqdm.trange(0, len(vertex), _BLOCK, desc="reference", disable=not progress):
        part = np.resize(vertex[first : first + _BLOCK], _BLOCK)
        seen, _ = visibility.fractional(rays, start[part], normal[part], size=size)
        block = integrate(seen, mesh.position[part], frame[part], brdf, light, eye, error=error)
        result.append(block[..., : len(vertex) - first, :])
    return jnp.concatenate(result, -2)


@jax.jit
def integrate(
    seen: UInt8[Array, "b d"],
    position: Float[Array, "b 3"],
    frame: Float[Array, "b 3 3"],
    brdf: Callable,
    light: Environment,
    eye: Float[Array, "3"],
    *,
    error: float | Float[Array, ""] = 1e-3,
) -> Float[Array, "..."]:
    """Integral of light x BRDF x visibility x cosine over all texels.

    Where the BRDF is smooth, a texel counts with the BRDF at its center and the exact integral of the cosine. Texels
    where that errs too much are divided, as often as it takes. See `jaxprt.relight.refine`.

    Args:
        seen: Visible share of each texel in sixteenths.
        position: Positions in world units.
        frame: Rows are tangent, bitangent, normal.
        brdf: A BRDF that is a pytree and callable, as the models are.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer.
        error: As in `radiance`.

    Returns:
        Linear radiance [*l b c]; that of the grazing view where the eye is below a vertex's horizon.

    Reference: Wang, Tran, Luebke 2004, equation 1.
    """
    batch, colors = light.radiance.shape[:-4], light.radiance.shape[-1]
    table = light.radiance.reshape(-1, seen.shape[1], colors)
    wo = directions.view(frame, position, eye)
    whole = refine.Integrand(brdf, frame, wo, table)
    smooth, choice, chosen = _centers(whole, seen, jnp.asarray(error, wo.dtype))
    sharp = refine.integrate(whole, choice, chosen, colors=smooth.shape[-1])
    return jnp.swapaxes(smooth + sharp, 0, 1).reshape(*batch, *smooth.shape[::2])


def _centers(given: refine.Integrand, seen: Array, error: Array) -> tuple[Array, refine.Choice, Array]:
    """Sums over texels that need not be divided; what cells are chosen by; and which of the first cells are."""
    size = haar.face_edge(seen.shape[1])
    direction, area = (_blocks(each(size=size)) for each in (cubemap.direction, cubemap.vector_area))
    light = jax.vmap(lambda each: _blocks(each.reshape(6, size, size, -1)))(given.light)
    mean = jnp.mean(light, -1)
    level = jax.vmap(lambda each: _blocks(each.reshape(6, size, size)))(seen)

    def sent(argument):
        axes, wo = argument
        flux = jnp.maximum(directions.to_local(axes, area.reshape(-1, 3))[:, 2], 0)
        value = refine.value(given.brdf, directions.to_local(axes, direction.reshape(-1, 3)), wo)
        peak = wo[2] * jnp.mean(refine.value(given.brdf, (wo * _MIRROR)[None], wo))
        return value.reshape(*level.shape[1:], -1), flux.reshape(level.shape[1:]), peak

    # All vertices before what follows: the compiler would compute the BRDF once for each of its uses.
    value, flux, peak = jax.lax.map(sent, (given.frame, given.wo), batch_size=8)
    clear = level.astype(flux.dtype) / visibility.LEVELS
    gray, flat, height = jax.lax.stop_gradient((jnp.mean(value, -1), flux, peak))
    weight = 1 / jnp.maximum(jnp.einsum("left,beft->bl", jax.lax.stop_gradient(mean), gray * flat * clear), _DARK)

    def varying(argument):
        gray, flux, clear, weight, axes, wo, height = argument
        scale = clear * jnp.max(mean * weight[:, None, None, None], 0)
        x, y, z = jnp.moveaxis(direction, -1, 0)
        wi = [x * axes[i, 0] + y * axes[i, 1] + z * axes[i, 2] for i in range(3)]
        return _vary(gray, flux, scale, wi, wo * _MIRROR, height, error)

    told = jax.lax.stop_gradient((gray, flat, clear, weight, given.frame, given.wo, height))
    chosen = jax.lax.map(varying, told, batch_size=8)
    value = value * (flux * clear * ~chosen[:, None, None])[..., None]
    value = jnp.broadcast_to(value, (*value.shape[:-1], max(value.shape[-1], light.shape[-1])))
    total = jnp.einsum("leftc,beftc->blc", light, value)
    edge = size // refine.root(size)
    chosen = chosen.reshape(-1, 6, edge, edge)
    return total, refine.Choice(seen, weight, height, error), chosen


def _blocks(texel: Array) -> Array:
    """Texels [6 n n *c] as [e e t *c]: row and column in the first cell, then the cells, next to each other."""
    edge = refine.root(texel.shape[1])
    count = texel.shape[1] // edge
    block = texel.reshape(6, count, edge, count, edge, *texel.shape[3:])
    return jnp.moveaxis(block, (2, 4), (0, 1)).reshape(edge, edge, -1, *texel.shape[3:])


def _vary(
    gray: Array, flux: Array, scale: Array, wi: Sequence[Array], mirror: Array, height: Array, error: Array
) -> Array:
    """First cells of whose texels the BRDF at the center tells too little.

    The middle of an interval errs by f'' / 24, and of a product by f' g' / 12 too; the horizon adds an eighth of a
    texel's edge at most. A peak between centers shows in the mirror direction.
    """
    if len(gray) == 1:
        return jnp.broadcast_to(error < jnp.inf, gray[0, 0].shape)
    edge = 2 / haar.face_edge(gray.size)
    miss = jnp.zeros_like(gray[0, 0])
    for value, other, much in ((gray, flux, scale), [jnp.swapaxes(each, 0, 1) for each in (gray, flux, scale)]):
        bend = jnp.abs(value[:-2] - 2 * value[1:-1] + value[2:]) * other[1:-1] / 24
        bend += jnp.abs((value[2:] - value[:-2]) * (other[2:] - other[:-2])) / 48
        miss += 2 * jnp.sum(bend * much[1:-1], (0, 1))  # for the two rows in the middle and the two outside
    cut = jnp.where(jnp.abs(wi[2]) < edge / 2, edge / 16 * jnp.max(gray, (0, 1)), 0)
    near = sum((wi[i] - mirror[i]) ** 2 for i in range(3)) < (2.5 * edge) ** 2
    hidden = jnp.where(near, jnp.abs(height - gray * jnp.maximum(wi[2], 0)) / 8, 0)
    miss += jnp.sum((cut + hidden) * scale, (0, 1)) * edge**2
    return miss > error * jnp.maximum(jnp.sum(gray * flux * scale, (0, 1)), refine.SMALL)
