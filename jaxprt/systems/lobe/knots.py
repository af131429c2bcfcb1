"""Interpolation of a table of lobes over BRDF parameters that differ from view to view."""

import itertools
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

_TINY = 1e-12


def between(row: Float[Array, "r *q"], knot: list, axis: list, *, lobes: int) -> Float[Array, "r v"]:
    """Interpolates the rows of a table for views v with their own parameters: between knots first, then between nodes.

    Args:
        row: Means, logarithms of concentrations, weights and diffuse albedos [r] of all lobes, at all knots and nodes.
        knot: For each parameter, the index of the lower knot and the weight of the upper one, for each view.
        axis: For each axis of view nodes, the index of the lower node and the weight of the upper one, for each view.
        lobes: Number of lobes.
    """
    sizes, nodes = row.shape[1 : 1 + len(knot)], row.shape[1 + len(knot) :]
    flat = row.reshape(len(row), -1).T  # All rows of a node are read at once.

    def read(index: Array, node: Array, left: list) -> Array:
        """Rows at a node, interpolated over the parameters in `left`."""
        if not left:
            return flat.at[index * math.prod(nodes) + node].get(mode="promise_in_bounds")
        size, (low, upper) = left[0]
        first, second = (read(index * size + low + up, node, left[1:]) for up in (0, 1))
        return _merged(first, second, upper, lobes=lobes)

    total = jnp.zeros((), row.dtype)
    for corner in itertools.product((0, 1), repeat=len(axis)):
        node, weight = jnp.zeros((), jnp.int32), jnp.ones((), row.dtype)
        for up, size, (low, upper) in zip(corner, nodes, axis, strict=True):
            node, weight = node * size + low + up, weight * (upper if up else 1 - upper)
        total = total + weight[:, None] * read(jnp.zeros((), jnp.int32), node, list(zip(sizes, knot, strict=True)))
    return total.T


def _merged(first: Array, second: Array, upper: Array, *, lobes: int) -> Array:
    """Rows interpolated between two knots by the formula of `jaxprt.systems.lobe.table.mean`."""
    rows, upper = first.shape[1], upper[:, None]
    count = (3 * lobes, 4 * lobes, rows - (rows - 4 * lobes) // (lobes + 1))
    parts = [jnp.split(each, count, 1) for each in (first, second)]
    strong = [jnp.sum(each[2].reshape(len(each[2]), -1, lobes), 1) for each in parts]
    low, high = jnp.maximum((1 - upper) * strong[0], 0) + _TINY, jnp.maximum(upper * strong[1], 0) + _TINY
    high = high / (low + high)
    weight = jnp.tile(high, (1, 3)), high, upper, upper
    return jnp.concatenate([a + (b - a) * each for a, b, each in zip(*parts, weight, strict=True)], 1)
