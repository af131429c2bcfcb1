"""Direct light by quadrature over every texel with the BRDF itself: slow, and the yardstick of every error here."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import tqdm
from jaxtyping import Array, Float, UInt8

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.transport import visibility

_BLOCK = 64


def radiance(
    mesh: Mesh,
    brdf: Callable,
    light: Environment,
    *,
    eye: Float[Array, "3"],
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    progress: bool = False,
) -> Float[Array, "..."]:
    """Radiance that vertices send to the eye: visibility traced, and every texel of the light summed.

    Args:
        mesh: The vertices.
        brdf: A model, or any function (wi, wo) -> value [*b c] in 1/sr on local directions, of which values below
            the horizon do not count; a new function object, as a lambda in a loop, compiles anew.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer in world units.
        occluder: What casts shadows; the mesh itself if None.
        vertex: Numbers of the vertices asked for, or a mask; all if None.
        progress: Whether to show a progress bar.

    Returns:
        Linear radiance [*l v c], in the light's units. Differentiable in the BRDF's parameters, the light and the eye.

    Raises:
        TypeError: The light is no Environment.
        ValueError: No such vertices, the BRDF's values have no axis for colors, or the light or the eye is not finite.
            Inside `jax.jit` values are not known: NaN then reaches the vertices.
    """
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
        block = integrate(seen, mesh.position[part], frame[part], brdf, light, eye)
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
) -> Float[Array, "..."]:
    """Sum over all texels of light x BRDF x visibility x cosine x solid angle.

    The cosine is integrated exactly over each texel; the BRDF is taken at its center.

    Args:
        seen: Visibility of each texel in sixteenths.
        position: Positions in world units.
        frame: Rows are tangent, bitangent, normal.
        brdf: A BRDF that is a pytree and callable, as the models are.
        light: The environment, or a batch of them along leading axes.
        eye: Position of the viewer.

    Returns:
        Linear radiance [*l b c]; that of the grazing view where the eye is below a vertex's horizon.

    Reference: Wang, Tran, Luebke 2004, equation 1.
    """
    size = haar.face_edge(seen.shape[1])
    direction = cubemap.direction(size=size).reshape(-1, 3)
    area = cubemap.vector_area(size=size).reshape(-1, 3)
    table = light.radiance.reshape(*light.radiance.shape[:-4], seen.shape[1], -1)

    def one(argument):
        visible, place, axes = argument
        flux = jnp.maximum(directions.to_local(axes, area)[:, 2], 0) * visible.astype(axes.dtype) / visibility.LEVELS
        wo = directions.view(axes, place, eye)
        value = brdf(directions.to_local(axes, direction), jnp.broadcast_to(wo, direction.shape))
        if jnp.ndim(value) != 2 or value.shape[0] != len(direction):
            raise ValueError(f"the BRDF must return [{len(direction)}, c] here, got {list(jnp.shape(value))}")
        value = value * flux[:, None]
        value = jnp.broadcast_to(value, (value.shape[0], max(value.shape[1], table.shape[-1])))
        return jnp.einsum("...dc,dc->...c", table, value)

    return jnp.moveaxis(jax.lax.map(one, (seen, position, frame), batch_size=8), 0, -2)
