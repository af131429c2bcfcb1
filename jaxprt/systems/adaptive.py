"""Adaptive integration over the texels of a cubemap.

A cell has 4 x 4 children, and each child is integrated with 2 x 2 Gauss points. A child whose estimated error is too
large is subdivided: it becomes a cell. The root cells are 4 x 4 texels, so their children are texels.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree, UInt8

from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import linear
from jaxprt.sphere import cubemap, haar

SIDE = 4  # number of children along the edge of a cell
LEVELS = 16  # visibility is stored in sixteenths
SMALL = 1 / 64  # the tolerance is relative to a cell's radiance, but at least to this share of the vertex's
_CHUNK = 256  # number of cells integrated at once
_FINEST = 4e-4  # edge of the smallest children, on faces of edge 2
_CURVED = 1 / 200  # error estimate over (squared second difference / value); 1 / 1440 at the center of a Gaussian
_PEAKED = 16.0  # second difference over the excess of the mirror direction's value over that of a sample
_GAP = 1 / np.sqrt(3)  # distance of the two Gauss points of an interval of length 1
_STEEPEST = 8.0  # largest second difference around a point, relative to its value
_NEAR = 16.0  # squared distance of two child edges, relative to the solid angle of a Gauss point
_TINY = 1e-30


class Integrand(NamedTuple):
    """The integrand light x BRDF x cosine.

    Attributes:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr that is a callable pytree, or `PerVertex` with one BRDF per vertex.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        wo: Unit directions to the viewer in these frames.
        light: Radiance of the texels d of each light l.
    """

    brdf: Callable
    frame: Float[Array, "b 3 3"]
    wo: Float[Array, "b 3"]
    light: Float[Array, "l d c"]


class Choice(NamedTuple):
    """Data that decide which cells are subdivided.

    Attributes:
        seen: Visible share of each texel in sixteenths.
        weight: Reciprocal of the radiance of each vertex under each light.
        peak: BRDF x cosine in the mirror direction, averaged over colors, in 1/sr.
        error: Largest relative error.
    """

    seen: UInt8[Array, "b d"]
    weight: Float[Array, "b l"]
    peak: Float[Array, " b"]
    error: Float[Array, ""]


def root(size: int) -> int:
    """Number of texels along the edge of a root cell."""
    return SIDE if size % SIDE == 0 else 1


def value(brdf: Callable, wi: Float[Array, "*b 3"], wo: Float[Array, "... 3"]) -> Float[Array, "*b c"]:
    """Values of a BRDF for pairs of directions, in 1/sr."""
    wo = jnp.broadcast_to(wo, wi.shape).reshape(-1, 3)
    color = brdf(wi.reshape(-1, 3), wo)
    if jnp.ndim(color) != 2 or color.shape[0] != len(wo):
        raise ValueError(f"the BRDF must return [{len(wo)}, c] for {len(wo)} directions, got {list(jnp.shape(color))}")
    return color.reshape(*wi.shape[:-1], -1)


def integrate(
    integrand: Integrand, choice: Choice, chosen: Bool[Array, "b f m m"], *, colors: int
) -> Float[Array, "b l c"]:
    """Integrates light x visibility x BRDF x cosine over the chosen root cells.

    Differentiable in the integrand, with the subdivision held fixed.

    Args:
        integrand: The integrand.
        choice: Data that decide which cells are subdivided.
        chosen: For each vertex and face, which of the m x m root cells to integrate.
        colors: Number of colors of the result.
    """
    moving = [leaf for leaf in jax.tree.leaves(integrand) if _floating(leaf)]
    return _total(colors, moving, jax.lax.stop_gradient((integrand, choice, chosen)))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _total(colors: int, moving: list[Array], fixed: tuple) -> Array:
    integrand, choice, chosen = fixed
    visit = _visit(fixed, colors)

    def add(total, cell):
        part, again = visit(moving, cell)
        return total.at[cell[:, 0]].add(part), again

    zero = jnp.zeros((len(integrand.wo), len(integrand.light), colors), integrand.light.dtype)
    return _walk(add, zero, choice, chosen)


@_total.defjvp
def _(colors, primals, tangents):
    moving, fixed = primals
    tangent, restore = ravel_pytree(tangents[0])

    def forward(arguments, tangent):
        moving, fixed = arguments
        visit = _visit(fixed, colors)

        def add(total, cell):
            _, part, again = jax.jvp(partial(visit, cell=cell), (moving,), (restore(tangent),), has_aux=True)
            return total.at[cell[:, 0]].add(part), again

        return _walk(add, jnp.zeros(shape, dtype), *fixed[1:])

    def backward(arguments, cotangent):
        moving, fixed = arguments
        visit = _visit(fixed, colors)

        def add(total, cell):
            _, pull, again = jax.vjp(partial(visit, cell=cell), moving, has_aux=True)
            return jax.tree.map(jnp.add, total, pull(cotangent[cell[:, 0]])[0]), again

        return ravel_pytree(_walk(add, jax.tree.map(jnp.zeros_like, moving), *fixed[1:]))[0]

    result = _total(colors, moving, fixed)
    shape, dtype = result.shape, result.dtype
    return result, linear(forward, backward, (moving, fixed), tangent)


def _walk(add: Callable, total: PyTree, choice: Choice, chosen: Array) -> PyTree:
    """Sums over all chosen root cells and their descendants, depth first."""
    size = haar.face_edge(choice.seen.shape[1])
    deepest = _deepest(size)
    first = jnp.stack(jnp.nonzero(chosen, size=chosen.size, fill_value=0), -1).astype(jnp.int32)
    first, count = jnp.insert(first, 1, 0, axis=1), jnp.sum(chosen, dtype=jnp.int32)
    stack = jnp.zeros((_CHUNK * (SIDE**2 * (deepest + 1) + 1), 5), jnp.int32)
    child = jnp.stack(jnp.meshgrid(*2 * [jnp.arange(SIDE, dtype=jnp.int32)], indexing="ij"), -1)
    number = jnp.arange(_CHUNK, dtype=jnp.int32)

    def step(state):
        """Processes the cells on top of the stack and, if they are fewer than a chunk, the next root cells."""
        stack, top, begun, total = state
        after = begun + number - top
        cell = jnp.where((number < top)[:, None], stack[top - 1 - number], first[after])
        valid = (number < top) | (after < count)
        # A cell is (vertex, level, face, row, column), padding has level -1; `again` says which children to subdivide.
        total, again = add(total, jnp.where(valid[:, None], cell, jnp.array([0, -1, 0, 0, 0])))
        again &= (valid & (cell[:, 1] < deepest))[:, None, None]
        below = jnp.broadcast_to(cell[:, None, None], (*again.shape, 5))
        below = jnp.concatenate(
            [below[..., :1], below[..., 1:2] + 1, below[..., 2:3], SIDE * below[..., 3:] + child], -1
        )
        left, again = jnp.maximum(top - _CHUNK, 0), again.ravel()
        place = jnp.where(again, left + jnp.cumsum(again) - 1, len(stack))
        stack = stack.at[place].set(below.reshape(-1, 5), mode="drop")
        begun = jnp.minimum(begun + jnp.maximum(_CHUNK - top, 0), count)
        return stack, left + jnp.sum(again, dtype=jnp.int32), begun, total

    begin = stack, jnp.int32(0), jnp.int32(0), total
    return jax.lax.while_loop(lambda state: (state[1] > 0) | (state[2] < count), step, begin)[3]


def _deepest(size: int) -> int:
    """Level of the cells with the smallest children. Root cells have level 0."""
    return max(1, int(np.ceil(np.log(2 * root(size) / size / SIDE / _FINEST) / np.log(SIDE))))


def _visit(fixed: tuple, colors: int) -> Callable:
    """Makes the function (floating-point leaves of the integrand, cells) -> (sums of cells, children to subdivide)."""
    whole, choice, _ = fixed
    leaves, tree = jax.tree.flatten(whole)
    size = haar.face_edge(choice.seen.shape[1])
    deepest = _deepest(size)
    mean = jax.lax.stop_gradient(jnp.mean(whole.light, -1))

    def visit(moving, cell):
        left = iter(moving)
        integrand = tree.unflatten([next(left) if _floating(leaf) else leaf for leaf in leaves])
        vertex, level = cell[:, 0], cell[:, 1]
        wo = integrand.wo[vertex]
        wi, weight, texel = _nodes(cell, integrand.frame[vertex], size)
        weight *= wo[:, 2:, None] > 0
        brdf = integrand.brdf
        if isinstance(brdf, PerVertex):
            brdf = brdf.of(jnp.broadcast_to(vertex[:, None, None], wi[0].shape).ravel())
        sent = value(brdf, jnp.stack(wi, -1), wo[:, None, None])
        inner = _children(sent * (jnp.maximum(wi[2], 0) * weight)[..., None])
        clear = choice.seen[vertex[:, None, None], texel].astype(weight.dtype) / LEVELS
        scale = clear * brightest(mean[:, texel], choice.weight[vertex].T[:, :, None, None])
        again = _is_rough(jax.lax.stop_gradient((sent, wi, wo, weight, scale)), vertex, choice)
        again &= ((level >= 0) & (level < deepest))[:, None, None]
        share = clear * ((level >= 0)[:, None, None] & ~again)
        inner = jnp.broadcast_to(inner * share[..., None], (*inner.shape[:-1], colors))
        # One child at a time, because the compiler's loop for a sum over all of them takes ten times as long.
        light, child = integrand.light.swapaxes(0, 1), np.ndindex(SIDE, SIDE)
        return sum(light[texel[:, i, j]] * inner[:, i, j, None] for i, j in child), again

    return visit


def brightest(light: Float[Array, " l *d"], weight: Float[Array, "l *#d"]) -> Float[Array, "*d"]:
    """Maximum over lights of light times weight.

    Lights are processed one at a time, because the compiler's loop for a maximum over all lights is much slower.
    """

    def step(most, pair):
        return jnp.maximum(most, pair[0] * pair[1]), None

    return jax.lax.scan(step, jnp.zeros(light.shape[1:], jnp.result_type(light, weight)), (light, weight))[0]


def _nodes(cell: Array, frame: Array, size: int) -> tuple[list[Array], Array, Array]:
    """Gauss points [k 8 8] of k cells: components of local directions, and solid angles; and the children's texels."""
    _, level, face, row, column = cell.T
    level = jnp.maximum(level, 0)
    edge = (2 * root(size) / size * 0.25 ** level.astype(frame.dtype))[:, None]
    offset = (np.arange(SIDE)[:, None] + 0.5 + np.array([-_GAP, _GAP]) / 2).ravel() / SIDE
    s, t = (edge * (at[:, None] + jnp.asarray(offset, frame.dtype)) - 1 for at in (column, row))
    s, t = s[:, None, :], t[:, :, None]
    # Component by component, which XLA fuses; it does not fuse matrix products.
    axes = jnp.asarray(cubemap.axes(), frame.dtype)[face]
    axis = jnp.einsum("kij,kaj->kia", frame, axes, precision="highest")[..., None, None]
    short = jax.lax.rsqrt(1 + s**2 + t**2)
    wi = [(s * axis[:, i, 0] + t * axis[:, i, 1] + axis[:, i, 2]) * short for i in range(3)]
    weight = (edge[..., None] / (2 * SIDE)) ** 2 * short**3
    per = (SIDE ** (level if root(size) > 1 else level + 1))[:, None]  # number of children along the edge of a texel
    y, x = (SIDE * at[:, None] + np.arange(SIDE) for at in (row, column))
    texel = ((face[:, None] * size + y // per)[:, :, None] * size) + (x // per)[:, None, :]
    return wi, weight, texel


def _children(node: Array) -> Array:
    """Sums over the 2 x 2 Gauss points of each child."""
    shape = node.shape
    return jnp.sum(node.reshape(shape[0], SIDE, 2, SIDE, 2, *shape[3:]), (2, 4))


def _is_rough(samples: tuple, vertex: Array, choice: Choice) -> Array:
    """Whether each child has too large an error and must be subdivided."""
    sent, wi, wo, weight, scale = samples
    gray = jax.lax.optimization_barrier(jnp.mean(sent, -1) * jnp.maximum(wi[2], 0) * weight)
    miss = jnp.zeros_like(gray)
    gap = jnp.where(jnp.arange(2 * SIDE - 1) % 2 == 0, _GAP, 1 - _GAP).astype(gray.dtype)
    # The error of two Gauss points is the fourth difference / 4320. For a Gaussian lobe, that is proportional to the
    # squared second difference divided by the value.
    for axis, apart in ((1, gap[None, :, None]), (2, gap[None, None, :])):
        bend = jnp.abs(2 * jnp.diff(jnp.diff(gray, axis=axis) / apart, axis=axis))
        miss += _loss(jnp.pad(bend, [(0, 0), *((1, 1) if axis == a else (0, 0) for a in (1, 2))], mode="edge"), gray)
    wo = wo[:, :, None, None]
    # The mirror direction serves as one more sample, to detect a peak between all other samples.
    near = (wi[0] + wo[:, 0]) ** 2 + (wi[1] + wo[:, 1]) ** 2 + (wi[2] - wo[:, 2]) ** 2 < _NEAR * weight
    higher = jnp.abs(choice.peak[vertex][:, None, None] * weight - gray)
    miss += jnp.where(near, _loss(_PEAKED * higher, gray + higher), 0)
    return scale * _children(miss) > choice.error * jnp.maximum(scale * jnp.abs(_children(gray)), SMALL)


def _loss(bend: Array, size: Array) -> Array:
    return _CURVED * bend**2 / jnp.maximum(jnp.maximum(jnp.abs(size), bend / _STEEPEST), _TINY)


def _floating(leaf: Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.inexact)
