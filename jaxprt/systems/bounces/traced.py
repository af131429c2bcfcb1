"""Reflections that are too sharp for sixteen harmonics: the lobes that rays represent instead, and their directions.

The average of light over a von Mises-Fisher lobe of concentration k scales its band l by A_l(k). Arriving light has few
bands, so narrow lobes lose what higher bands would contribute; these lobes are traced. `traced_share` gives the traced
fraction of each lobe, a smooth function of its concentration. The same fraction is subtracted from the harmonics of the
BRDF, where a lobe has the coefficients weight * A_l(k) * Y(center). Nothing is counted twice.

The rays of a point are quantiles of the mixture of its narrow lobes. Their directions depend on the view and on the
widths of the lobes, but not on colors. Their weights depend on colors too, and are differentiable in them.
"""

import dataclasses
import math
from functools import partial, reduce

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike

from jaxprt.compile import jit
from jaxprt.decompose import mixture
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import directions, harmonics
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.table import LobeMixture, traced_share, traced_visibility
from jaxprt.systems.protocol import Blend

FEW = 0.55  # traced fraction of what a BRDF's lobes reflect, below which rays bring nothing
LEAST = 0.04  # what rays must bring, relative to all reflected light
_GOLDEN = (5**0.5 - 1) / 2  # fraction of a turn from one ray to the next
_TINY = 1e-12


class ReflectionRays(eqx.Module):
    """The rays of some vertices or points.

    Attributes:
        direction: Unit directions in world space.
        lobe: Index of the lobe that each ray samples.
        chance: Probability of that lobe; 0 where nothing is traced.
        concentration: Concentration of that lobe.
    """

    direction: Float[Array, "j v 3"]
    lobe: Int[Array, "j v"]
    chance: Float[Array, "j v"]
    concentration: Float[Array, "j v"]


@jit
def albedos(table: LobeBrdf) -> Float[Array, "3 c *k"]:
    """Mean albedos of each channel of a table: of the traced lobes, of all lobes, and of the diffuse part.

    They are in relative units. Views are weighted by projected solid angle. Axes of parameters remain.
    """
    views = table.scale.shape[len(table.knot) + 1 :]
    if table.isotropic:
        radius = jnp.linspace(0, 1, views[0])
        area = radius
    else:
        place = (jnp.arange(views[0]) + 0.5) / views[0] * 2 - 1
        radius = jnp.minimum(jnp.hypot(place[:, None], place), 1)
        area = jnp.ones_like(radius)
    # Projected solid angle in the parabolic map, whose radius is the tangent of half the angle.
    area = area * jnp.maximum(1 - radius**2, 0) / (1 + radius**2) ** 3
    traced = jnp.sum(table.weight * traced_share(jnp.exp(table.scale)), 1)
    weights = jnp.stack([traced, jnp.sum(table.weight, 1), table.diffuse])
    return jnp.sum(weights * area, tuple(range(-len(views), 0)))


def is_traced(traced: ArrayLike, glossy: ArrayLike, diffuse: ArrayLike) -> Bool[np.ndarray, "*k"]:
    """Whether rays bring enough: lobes are narrow, and reflect a large enough share of the light.

    Rays bring the share of the traced lobes in all reflected light, times what sixteen harmonics lose of these lobes,
    which is little if a smaller fraction than `FEW` of the lobes is traced.

    Args:
        traced: Albedo of the traced lobes.
        glossy: Albedo of all lobes.
        diffuse: Albedo of the diffuse part.
    """
    traced, glossy, diffuse = (np.asarray(albedo) for albedo in (traced, glossy, diffuse))
    share = traced / np.maximum(glossy + diffuse, _TINY)
    lost = (traced / np.maximum(glossy, _TINY) - FEW) / (1 - FEW)
    return np.asarray(share * lost > LEAST)


def is_sharp(table: LobeBrdf) -> bool:
    """Whether rays bring enough for any parameter of a table."""
    return bool(np.any(is_traced(*np.asarray(jnp.sum(albedos(table), 1)))))


@jit
def lookup(
    table: LobeBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    eye: Float[Array, "*p 3"],
    parameter: tuple[Float[Array, " v"], ...],
) -> LobeMixture:
    """The lobes of points towards the eye."""
    return table.lookup(directions.view(frame, position, eye), *parameter)


@jit
def harmonics_of(lobes: LobeMixture, blend: Blend | None, seen: Float[Array, " v"] | None) -> Float[Array, "lm c v"]:
    """Harmonics, in local frames, of what rays represent.

    Args:
        lobes: The lobes of each point.
        blend: Weights of the channels of each point; None for channels as colors.
        seen: Factor of what rays represent, at each point; None for 1.
    """
    weight = _traced_weight(lobes, blend, seen)
    band = mixture.bands(lobes.concentration, degree=DEGREE)
    basis = jnp.moveaxis(harmonics.evaluate(jnp.moveaxis(lobes.mean, 0, -1), degree=DEGREE), -1, 0)
    rows = [
        reduce(jnp.add, (weight[:, i] * (band[math.isqrt(s), i] * basis[s, i]) for i in range(lobes.mean.shape[1])))
        for s in range(len(basis))
    ]
    return jnp.stack(rows)


@partial(jit, static_argnames="count")
def quantiles(
    lobes: LobeMixture, seen: Float[Array, " v"] | None, position: Array, frame: Float[Array, "v 3 3"], *, count: int
) -> ReflectionRays:
    """The rays of each point: quantiles of the mixture of its narrow lobes, rotated by a random angle.

    Args:
        lobes: The lobes of each point. Their colors do not change the rays.
        seen: Factor of what rays represent, at each point; None for 1.
        position: Positions of the points, which choose the angle.
        frame: Frames of the points.
        count: Number of rays of each point.
    """
    mass = jnp.maximum(jnp.sum(lobes.weight, 0), 0) * traced_share(lobes.concentration)
    total = jnp.sum(mass if seen is None else mass * seen, 0)
    chance = jnp.where(total > 0, mass / jnp.where(total > 0, total, 1), 0)
    above = jnp.cumsum(chance, 0)
    shift, turn = _scattered(position)
    place = (jnp.arange(count, dtype=shift.dtype)[:, None] + shift) / count
    number = jnp.minimum(jnp.sum(above[:, None] <= place, 0), len(above) - 1)

    def of_lobe(value: Float[Array, "l v"]) -> Float[Array, "j v"]:
        return jnp.take_along_axis(value, number, 0)

    share, concentration = of_lobe(chance), of_lobe(lobes.concentration)
    within = jnp.clip((place - of_lobe(above) + share) / jnp.where(share > 0, share, 1), 0, 1 - 1e-6)
    drop = -jnp.log1p(within * jnp.expm1(-2 * concentration)) / concentration
    angle = 2 * np.pi * (turn + _GOLDEN * jnp.arange(count, dtype=turn.dtype)[:, None])
    local = _around([of_lobe(axis) for axis in lobes.mean], drop, angle)
    world = [reduce(jnp.add, (local[i] * frame[:, i, j] for i in range(3))) for j in range(3)]
    return ReflectionRays(jnp.stack(world, -1), number.astype(jnp.int32), share, concentration)


@partial(jit, static_argnames="count")
def very_narrow(
    table: LobeBrdf,
    position: Float[Array, "v 3"],
    frame: Float[Array, "v 3 3"],
    points: Points,
    eye: Float[Array, "3"],
    parameter: tuple[Float[Array, " p"], ...],
    *,
    count: int,
) -> ReflectionRays:
    """The rays of points between vertices whose visibility counts for very narrow lobes."""
    position, frame = placed(position, frame, points)
    rays = quantiles(lookup(table, position, frame, eye, parameter), None, position, frame, count=count)
    return dataclasses.replace(rays, chance=jnp.where(traced_visibility(rays.concentration) > 0, rays.chance, 0))


@jit
def weights(
    lobes: LobeMixture, rays: ReflectionRays, blend: Blend | None, seen: Float[Array, " v"] | None
) -> Float[Array, "j v c"]:
    """Factor of the radiance along each ray. The sum over the rays of a point is the albedo of its traced lobes."""
    lobe_weight = _traced_weight(lobes, blend, seen)
    taken = jnp.stack([jnp.take_along_axis(color, rays.lobe, 0) for color in lobe_weight], -1)
    weight = jnp.where(rays.chance > 0, 1 / jnp.where(rays.chance > 0, rays.chance, 1), 0)[..., None] * taken
    # Normalize, so that the rays have exactly the energy of the lobes in every color.
    albedo, total = jnp.sum(lobe_weight, 1).T, jnp.sum(weight, 0)
    return weight * (albedo / jnp.where(total > _TINY, total, 1))


def _traced_weight(lobes: LobeMixture, blend: Blend | None, seen: Array | None) -> Float[Array, "c l v"]:
    """Weight of the traced fraction of each lobe in each color."""
    traced = traced_share(lobes.concentration)
    weight = lobes.weight * (traced if seen is None else traced * seen)
    if blend is None:
        return weight
    return jnp.einsum("klv,vkc->clv", weight, blend.weight, precision="highest")


def _around(mean: list[Array], drop: Array, angle: Array) -> list[Array]:
    """Directions at given angles around means, with cosine 1 - drop to them. Those below the horizon are mirrored."""
    x, y, z = mean
    # Branchless orthonormal basis: Duff et al. 2017.
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(z.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first, second = (1 + sign * x**2 * a, sign * b, -sign * x), (b, sign + y**2 * a, -y)
    radius = jnp.sqrt(jnp.maximum(drop * (2 - drop), 0))
    right, up = radius * jnp.cos(angle), radius * jnp.sin(angle)
    way = [p * right + q * up + m * (1 - drop) for p, q, m in zip(first, second, mean, strict=True)]
    return [way[0], way[1], jnp.abs(way[2])]


@jit
def _scattered(position: Float[Array, "v 3"]) -> tuple[Float[Array, " v"], Float[Array, " v"]]:
    """Two hashed numbers in [0, 1) for each position: equal for equal positions, unrelated for neighbors."""
    bits = position.astype(jnp.float32).view(jnp.uint32) & np.uint32(0x807FFFFF)  # the same at twice the size
    state = (
        bits[:, 0] * np.uint32(0x9E3779B1) ^ (bits[:, 1] * np.uint32(0x85EBCA77)) ^ (bits[:, 2] * np.uint32(0xC2B2AE3D))
    )
    result = []
    for salt in (0x27D4EB2F, 0x165667B1):
        word = state + np.uint32(salt)
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
            word = (word ^ (word >> shift)) * np.uint32(factor)
        word = word ^ (word >> 16)
        result.append((word >> 8).astype(position.dtype) / np.asarray(1 << 24, position.dtype))
    return result[0], result[1]
