"""Texels and cells of the light, reflected by lobes: each is a lobe itself, as wide as it is.

The integral of a von Mises-Fisher lobe over a square of variance s, along one axis, is nearly the area of the square
times the density at its middle of a lobe of variance 1 / k + s.
"""

from functools import partial, reduce

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt.compile import TOGETHER, jit, total
from jaxprt.decompose import mixture
from jaxprt.scene.points import Points
from jaxprt.sphere import cubemap
from jaxprt.systems.lobe.table import LobeMixture


@partial(jit, static_argnames=("squares",))
def radiance(
    lobe: LobeMixture,
    frame: Float[Array, "p 3 3"],
    light: tuple[Int[Array, " t"], Float[Array, "t c"], UInt8[Array, "t v"] | Float[Array, "t v"]],
    points: Points,
    *,
    squares: tuple[tuple[int, int, int], ...],
) -> Float[Array, "p e"]:
    """Radiance that lobes of vertices or points reflect from texels or cells.

    Args:
        lobe: Lobes of BRDF x cosine at the points, in local frames.
        frame: Shading frames; rows are tangent, bitangent, normal.
        light: Indices of the texels or cells, their radiance, and their visible share at the vertices.
        points: Points to which the shares are interpolated; all vertices for shares of the points themselves.
        squares: Edge of a face in texels or cells, and number of them, in their order; see
            `jaxprt.systems.bright_texels.Squares`.
    """
    axes, first = jnp.moveaxis(frame, 0, 2), 0
    sent = jnp.zeros((max(lobe.weight.shape[0], light[1].shape[1]), len(frame)), frame.dtype)
    reflects = jnp.any(lobe.weight != 0) | jnp.any(lobe.diffuse != 0)
    for edge, count, _ in squares:
        texel, excess, visible = (rows[first : first + count] for rows in light)
        first += count
        direction, area = (
            quantity(size=edge).reshape(-1, 3)[texel].astype(frame.dtype)
            for quantity in (cubemap.direction, cubemap.vector_area)
        )
        wide = lobe.widened(jnp.full(len(frame), 4 * np.pi / (6 * edge**2 * 12), frame.dtype))
        peak = wide.weight * jnp.exp(mixture.log_peak(wide.concentration))

        def lit(row: tuple[Array, ...], wide: LobeMixture = wide, peak: Array = peak) -> Float[Array, "c v"]:
            direction, flux, visible = row
            wi = [jnp.tensordot(direction, axis, 1) for axis in axes]
            away = reduce(jnp.add, ((axis - mean) ** 2 for axis, mean in zip(wi, wide.mean, strict=True))) / 2
            value = jnp.sum(peak * jnp.exp(-wide.concentration * away), 1) + wide.diffuse * wi[2] / np.pi
            share = points.carry(visible.astype(frame.dtype))
            return jnp.where(wi[2] > 0, value * share, 0) * flux[:, None]

        def counts(rows: tuple[Array, ...]) -> Array:
            return reflects & jnp.any(rows[1] != 0)

        rows = direction, excess * jnp.linalg.norm(area, axis=1, keepdims=True), visible
        sent = sent + total(lit, rows, counts=None if count % TOGETHER else counts)
    return sent.T
