"""Cells of a light: squares of texels whose mean radiance is taken out of it, from fine to coarse.

`jaxprt.systems.bright_texels` sums cells one by one, because lobes cannot follow soft boxes that are half hidden.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap
from jaxprt.systems import protocol

# Numbers of cells that are taken out together, by the edge of a face in cells. The light chooses one of them.
_PLANS = {32: 64, 8: 32}, {16: 64, 8: 64}, {8: 64}
_JUMP, _WITHIN = 16, 0.1  # edge of the means whose steps lobes cannot follow, and what steps within them count
_WIDE = 4  # edge of the means about which steps are counted
WIDEST = 8  # edge of a face in the largest cells


def _plans(size: int) -> list[dict[int, int]]:
    """The numbers of cells that can be taken out of a light: all cells are larger than its texels."""
    return [plan for plan in _PLANS if max(plan) < size]


def counts(size: int) -> dict[int, int]:
    """Most cells that a plan takes out, by the edge of a face in cells, from fine to coarse."""
    most: dict[int, int] = {}
    for plan in _plans(size):
        most |= {edge: max(count, most.get(edge, 0)) for edge, count in plan.items()}
    return dict(sorted(most.items(), reverse=True))


@require.arguments(light=protocol.one_light)
@jit
def split(light: Environment) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment]:
    """Takes radiance out of cells of a light: squares of texels, 6 x 32 x 32, 6 x 16 x 16 and 6 x 8 x 8 of them.

    From fine to coarse, the cells with the most flux lose what exceeds the next one. The light chooses how many of each
    size: those that leave it the most even. Derivatives are those of the chosen cells.

    Args:
        light: One environment, whose faces have an edge of a power of two texels. Cells are larger than texels.

    Returns:
        Indices of cells, size after size; the radiance taken out of each, 0 for cells that are not used; and the rest
        of the environment, which may be negative in parts of a cell.

    Raises:
        TypeError: The light is not an `Environment`.
        ValueError: The light is a batch, or the edge of its faces is not a power of two.
    """
    if (size := light.radiance.shape[-2]) & (size - 1):
        raise ValueError(f"the light must have faces of a power of two texels along an edge, got {size}")
    colors, most_of = light.radiance.shape[-1], counts(size)
    if not most_of:
        return jnp.zeros(0, jnp.int32), jnp.zeros((0, colors), light.radiance.dtype), light
    area, results, steps = cubemap.solid_angle(size=size)[..., None], [], []
    largest = jnp.maximum(jnp.max(light.radiance), jnp.finfo(light.radiance.dtype).tiny)  # squares would overflow
    for plan in _plans(size):
        rest, cells, taken = light.radiance, [], []
        for edge, most in most_of.items():
            count = plan.get(edge, 0)
            cell, excess = _largest_cells(rest, area, edge, count)
            full = jnp.zeros((6 * edge**2, colors), rest.dtype).at[cell].set(excess)
            rest = rest - _repeated(full.reshape(6, edge, edge, colors), size)
            cells.append(jnp.pad(cell, (0, most - count)))
            taken.append(jnp.pad(excess, ((0, most - count), (0, 0))))
        results.append((jnp.concatenate(cells), jnp.concatenate(taken), rest))
        steps.append(_steps(jnp.sum(rest / largest, -1, keepdims=True), area))
    best = jnp.argmin(jax.lax.stop_gradient(jnp.stack(steps)))
    cell, excess, rest = (jnp.stack(rows)[best] for rows in zip(*results, strict=True))
    return cell, excess, Environment(rest)


def _largest_cells(light: Array, area: Array, edge: int, count: int) -> tuple[Int[Array, " t"], Float[Array, "t c"]]:
    """The cells with the most flux, and the radiance by which each exceeds the next one."""
    mean = _means(light, area, edge).reshape(6 * edge**2, -1)
    flux = jnp.sum(mean, -1) * jnp.sum(_squares(area, edge), (2, 4)).ravel()
    cell = jax.lax.top_k(jax.lax.stop_gradient(flux), count + 1)[1]
    bright = flux[cell]
    fraction = jnp.maximum(1 - jnp.maximum(bright[-1], 0) / jnp.where(bright[:-1] > 0, bright[:-1], 1), 0)
    fraction = jnp.where(bright[:-1] > 0, fraction, 0).astype(light.dtype)
    return cell[:-1], mean[cell[:-1]] * fraction[:, None]


def _squares(value: Float[Array, "6 n n c"], edge: int) -> Array:
    """Texels by cells: [6 e f e f c]."""
    fold = value.shape[1] // edge
    return value.reshape(6, edge, fold, edge, fold, -1)


def _means(value: Array, area: Array, edge: int) -> Float[Array, "6 e e c"]:
    """Means over cells."""
    return jnp.sum(_squares(value * area, edge), (2, 4)) / jnp.sum(_squares(area, edge), (2, 4))


def _repeated(value: Float[Array, "6 e e c"], size: int) -> Float[Array, "6 n n c"]:
    """Cells as texels."""
    fold = size // value.shape[1]
    return jnp.repeat(jnp.repeat(value, fold, 1), fold, 2)


def _steps(light: Float[Array, "6 n n 1"], area: Array) -> Array:
    """How much a light varies between cells, as far as lobes cannot follow it."""
    size = light.shape[1]
    fine = _repeated(_means(light, area, min(_JUMP, size)), size)
    wide = _repeated(_means(light, area, _WIDE), size)
    return jnp.sqrt(jnp.sum(area * ((fine - wide) ** 2 + (_WITHIN * (light - fine)) ** 2)))
