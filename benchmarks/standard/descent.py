"""Improves a table of lobes over one BRDF parameter by gradient descent on the error of reflected light.

EM fits each node of a table alone. What a vertex reads is interpolated between knots of the parameter and nodes of the
view, and under real light a deviation matters less the finer it is. Descent minimizes that error itself:

    E = sum_v |Y^T (table - BRDF x cosine)|^2 / sum_v |Y^T (BRDF x cosine)|^2  +  _FINE (the same without Y)

for random parameters, views v and sums of channels. Y has the harmonics up to degree 20, scaled by the natural spectrum
of light. The second term keeps details that these harmonics do not resolve.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxprt.decompose import mixture
from jaxprt.sphere import directions, harmonics, hemisphere
from jaxprt.systems.lobe import LobeBrdf, em

_DEGREE = 20
_FINE = 0.05  # weight of the error without harmonics
_EVERY_VIEW = 0.1  # weight of the mean over views of their relative errors, beside the error of all views
_RINGS, _SECTORS = 32, 32  # of the quadrature around the mirror direction
_VIEWS, _LOWEST = 48, 0.975  # views that are drawn from, and tan(theta / 2) of the lowest
_PARAMETERS, _SUMS = 4, 6  # number of parameters and of sums of channels in a step; a third of the views is in it
_RATE, _WARM = 0.03, 50  # first step, relative to widths and weights of lobes, and steps until it is reached
_MEMORY = 0.9, 0.99  # decay of the mean gradient and of the mean squared gradient
_LEAST_WEIGHT = 1e-5  # smaller weights, relative to the largest of a channel, are raised to this
_CHUNK = 100  # steps of one call
_TINY = 1e-12


class Change(eqx.Module):
    """A table as the variables of the descent, all of which have a natural step of the same size.

    Attributes:
        shift: Displacement of each mean, in widths of its lobe.
        scale: Logarithms of concentrations.
        weight: Logarithms of weights.
        diffuse: Logarithms of diffuse albedos.
    """

    shift: Float[Array, "3 l *q"]
    scale: Float[Array, " l *q"]
    weight: Float[Array, "c l *q"]
    diffuse: Float[Array, " c *q"]


class Views(eqx.Module):
    """Views v, and the quadrature s around the mirror direction of each.

    Attributes:
        wo: Unit directions to the viewer, in the x-z plane.
        wi: Directions of the quadrature.
        area: Solid angle of each direction.
        basis: Scaled harmonics of each direction, times solid angle.
        share: Weight of each view in the error: its solid angle, with a small constant for those from above.
    """

    wo: Float[Array, "*v 3"]
    wi: Float[Array, "*v s 3"]
    area: Float[Array, "*v s"]
    basis: Float[Array, "*v s r"]
    share: Float[Array, "*v"]


def improve(
    table: LobeBrdf,
    family: Callable,
    weight: Float[np.ndarray, "n k"],
    least: Float[np.ndarray, " l *q"],
    *,
    first: float,
    steps: int,
) -> LobeBrdf:
    """Improves the lobes at all knots from `first` on, by Adam with a rate that decays to zero.

    Args:
        table: An isotropic table with one parameter.
        family: Function from the parameter to the BRDF of the table.
        weight: Weights of the channels in typical materials; each step draws some of them.
        least: Smallest concentration of each lobe.
        first: Parameter from which on lobes change. Narrower ones need a finer quadrature.
        steps: Number of steps.
    """
    views, free = _views(), jnp.asarray(table.knot[0] >= first - 1e-3, table.scale.dtype)[:, None]
    bound = jnp.log(jnp.asarray(least, table.scale.dtype)), float(np.log(em.FINEST))
    floor = _LEAST_WEIGHT * jnp.max(jnp.sum(table.weight, 1, keepdims=True), (2, 3), keepdims=True) + _TINY
    change = Change(
        jnp.zeros_like(table.mean),
        jnp.clip(table.scale, *bound),
        jnp.log(jnp.maximum(table.weight, floor)),
        jnp.log(jnp.maximum(table.diffuse, _LEAST_WEIGHT)),
    )
    zero = jax.tree.map(jnp.zeros_like, change)
    state, arguments = (change, zero, zero), (table, family, jnp.asarray(weight, jnp.float32), views, free, bound)
    for number in range(0, steps, _CHUNK):
        state = _descend(state, *arguments, jnp.float32(first), jnp.float32(number), steps=steps)
    result = _table(state[0], table)
    return jax.tree.map(lambda old, new: jnp.where(free > 0, new, old) if old.ndim > 1 else old, table, result)


def _views() -> Views:
    """Views with random heights, evenly spread over the nodes of a table."""
    radius = (np.arange(_VIEWS) + np.random.default_rng(0).uniform(size=_VIEWS)) / _VIEWS
    radius = np.minimum(radius, _LOWEST)
    wo = np.stack([2 * radius, 0 * radius, 1 - radius**2], -1) / (1 + radius**2)[:, None]
    share = radius / (1 + radius**2) ** 2 + 0.02
    wo, share = jnp.asarray(wo, jnp.float32), jnp.asarray(share, jnp.float32)
    wi, area = jax.vmap(partial(hemisphere.arcs, rings=_RINGS, sectors=_SECTORS))(em.mirror(wo))
    band = np.repeat(np.asarray(harmonics.natural(degree=_DEGREE)), 2 * np.arange(_DEGREE + 1) + 1)
    basis = jnp.stack([harmonics.evaluate(direction, degree=_DEGREE) for direction in wi])
    return Views(wo, wi, area, basis * jnp.asarray(band, jnp.float32) * area[..., None], share)


def _table(change: Change, table: LobeBrdf) -> LobeBrdf:
    """The changed table."""
    mean = table.mean + jnp.exp(-table.scale / 2) * change.shift
    mean = jnp.moveaxis(directions.normalize(jnp.moveaxis(mean.at[2].set(jnp.maximum(mean[2], 0)), 0, -1)), -1, 0)
    return LobeBrdf(mean, change.scale, jnp.exp(change.weight), jnp.exp(change.diffuse), table.knot, table.error)


@eqx.filter_jit
def _descend(state, table, family, weight, views, free, bound, first, number, *, steps: int):
    """Some steps of Adam, the first of which has the given number."""

    def step(state, count):
        change, mean, square = state
        gradient = jax.grad(_error)(change, table, family, weight, views, first, jax.random.key(count.astype(int)))
        gradient = jax.tree.map(lambda leaf: leaf * free, gradient)
        rate = _RATE * jnp.minimum(1, count / _WARM) * 0.5 * (1 + jnp.cos(np.pi * count / steps))
        one, two = _MEMORY
        mean = jax.tree.map(lambda a, b: one * a + (1 - one) * b, mean, gradient)
        square = jax.tree.map(lambda a, b: two * a + (1 - two) * b**2, square, gradient)
        rate = rate / (1 - one ** (count + 1)) * jnp.sqrt(1 - two ** (count + 1))
        change = jax.tree.map(lambda x, a, b: x - rate * a / (jnp.sqrt(b) + _TINY), change, mean, square)
        change = eqx.tree_at(lambda change: change.scale, change, jnp.clip(change.scale, *bound))
        return (change, mean, square), None

    return jax.lax.scan(step, state, number + jnp.arange(_CHUNK))[0]


def _error(
    change: Change, table: LobeBrdf, family: Callable, weight: Array, views: Views, first: Array, key: PRNGKeyArray
) -> Float[Array, ""]:
    """The error E for random parameters, views and materials."""
    changed, keys = _table(change, table), jax.random.split(key, 3)
    place = (jnp.arange(_PARAMETERS) + jax.random.uniform(keys[0], (_PARAMETERS,))) / _PARAMETERS
    index = 3 * jnp.arange(_VIEWS // 3) + jax.random.randint(keys[1], (_VIEWS // 3,), 0, 3)
    weight = jax.random.choice(keys[2], weight, (_SUMS,), replace=False)
    view = jax.tree.map(lambda leaf: leaf[index], views)

    def one(parameter):
        lobes = changed.lookup(view.wo, jnp.full(len(view.wo), parameter))
        arrays = lobes.mean, lobes.concentration, lobes.weight, lobes.diffuse
        wrong, whole = jax.vmap(partial(_square_norms, family(parameter), weight), (0, 2, 1, 2, 1))(view, *arrays)
        share = view.share[:, None, None]
        total = jnp.sum(wrong * share, 0) / jnp.sum(whole * share, 0)
        return jnp.mean(total @ jnp.array([1, _FINE])) + _EVERY_VIEW * jnp.mean(wrong[..., 0] / whole[..., 0])

    last = table.knot[0][-1]
    return jnp.mean(jax.vmap(one)(first + (last - first) * place))


def _square_norms(
    brdf: Callable, material: Array, view: Views, mean: Array, concentration: Array, weight: Array, diffuse: Array
) -> tuple[Array, Array]:
    """Squared norm of the error of a view and of what it sees, for each material: by harmonics, and by direction."""
    away = sum((view.wi[:, i, None] - mean[i]) ** 2 for i in range(3)) / 2
    density = jnp.exp(mixture.log_peak(concentration) - concentration * away)
    value = density @ weight.T + diffuse * view.wi[:, 2:] / np.pi
    exact = brdf(view.wi, jnp.broadcast_to(view.wo, view.wi.shape)) * view.wi[:, 2:]

    def square(value):
        value = value @ material.T
        return jnp.stack([jnp.sum((view.basis.T @ value) ** 2, 0), jnp.sum(view.area[:, None] * value**2, 0)], -1)

    return square(value - exact), square(exact)
