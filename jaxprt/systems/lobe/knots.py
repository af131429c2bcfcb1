"""Interpolation of a table of lobes over BRDF parameters that differ from view to view."""

import itertools
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import isolated

_TINY = 1e-12


class Entry(NamedTuple):
    """Entries of a table of lobes, one for each view: means, logarithms of concentrations, weights, diffuse albedos."""

    mean: Float[Array, "v 3 l"]
    scale: Float[Array, "v l"]
    weight: Float[Array, "v c l"]
    diffuse: Float[Array, "v c"]


def between(row: Float[Array, "r *q"], knot: list, axis: list, *, lobes: int) -> Entry:
    """Interpolates the rows of a table for views v with their own parameters: between knots first, then between nodes.

    Args:
        row: Means, logarithms of concentrations, weights and diffuse albedos [r] of all lobes, at all knots and nodes.
        knot: For each parameter, the index of the lower knot and the weight of the upper one, for each view.
        axis: For each axis of view nodes, the index of the lower node and the weight of the upper one, for each view.
        lobes: Number of lobes.
    """
    sizes = row.shape[1:]
    place, share = [], []
    for corner in itertools.product((0, 1), repeat=len(axis)):
        pairs = list(zip(corner, axis, strict=True))
        share.append(math.prod((upper if up else 1 - upper for up, (_, upper) in pairs), start=jnp.ones((), row.dtype)))
        for knots in itertools.product((0, 1), repeat=len(knot)):
            index = jnp.zeros((), jnp.int32)
            for up, size, (low, _) in zip((*knots, *corner), sizes, (*knot, *axis), strict=True):
                index = index * size + low + up
            place.append(index)
    # All rows of a node are read at once, in a program of their own: XLA vectorizes CPU code only without gathers.
    read = _read(row.reshape(len(row), -1).T, tuple(place))
    return _between(read, tuple(upper for _, upper in knot), tuple(share), lobes=lobes)


@partial(isolated, static=("lobes",))
def _between(read: tuple[Array, ...], upper: tuple[Array, ...], share: tuple[Array, ...], *, lobes: int) -> Entry:
    """Entries at all knots and nodes, interpolated: `upper` between knots, and in the given shares between nodes."""
    entry, knots, total = [_entry(row, lobes=lobes) for row in read], 1 << len(upper), None
    for node, part in enumerate(share):
        at_knots = entry[node * knots : (node + 1) * knots]
        for weight in reversed(upper):
            pairs = zip(at_knots[::2], at_knots[1::2], strict=True)
            at_knots = [_interpolated(low, high, weight) for low, high in pairs]
        scaled = jax.tree.map(lambda value, part=part: value * part.reshape(-1, *[1] * (value.ndim - 1)), at_knots[0])
        total = scaled if total is None else jax.tree.map(jnp.add, total, scaled)
    assert total is not None
    return total


@isolated
def _read(row: Float[Array, "q r"], place: tuple[Array, ...]) -> tuple[Array, ...]:
    return tuple(row.at[index].get(mode="promise_in_bounds") for index in place)


def _entry(row: Float[Array, "v r"], *, lobes: int) -> Entry:
    """One entry from all its rows."""
    colors = (row.shape[1] - 4 * lobes) // (lobes + 1)
    mean, scale, weight, diffuse = jnp.split(row, (3 * lobes, 4 * lobes, (4 + colors) * lobes), 1)
    return Entry(mean.reshape(-1, 3, lobes), scale, weight.reshape(-1, colors, lobes), diffuse)


def _interpolated(low: Entry, high: Entry, upper: Float[Array, " v"]) -> Entry:
    """Entries interpolated between two knots by the formula of `jaxprt.systems.lobe.table.mean`."""
    strength = [
        jnp.maximum(share[:, None] * jnp.sum(entry.weight, 1), 0) + _TINY
        for share, entry in ((1 - upper, low), (upper, high))
    ]
    strong = strength[1] / (strength[0] + strength[1])
    weight = strong[:, None], strong, upper[:, None, None], upper[:, None]
    return Entry(*(a + (b - a) * part for a, b, part in zip(low, high, weight, strict=True)))
