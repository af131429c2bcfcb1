"""The brightest texels of a light one by one, exactly: stored visibility times the BRDF itself."""

import itertools
from collections.abc import Callable
from functools import partial
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from jaxprt import require
from jaxprt.brdf import grid
from jaxprt.compile import jit, total
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points
from jaxprt.sphere import cubemap, directions
from jaxprt.systems import adaptive
from jaxprt.systems.protocol import Blend, System, VertexSystem
from jaxprt.visibility import LEVELS

_ROW = 32  # texels of which the brightest is looked at first
_SAMPLES = (1, 2, 3, 4, 6, 8, 12, 16)
_FINE = 32
_value = jit(adaptive.value)


@runtime_checkable
class Visibility(Protocol):
    """What this system asks of transport: visibility of single texels."""

    @property
    def position(self) -> Float[Array, "v 3"]:
        """Positions in world units."""
        ...

    @property
    def frame(self) -> Float[Array, "v 3 3"]:
        """Rows are tangent, bitangent, normal."""
        ...

    @property
    def size(self) -> int:
        """Edge of the cubemap's faces in texels."""
        ...

    def visible(self, texel: Int[Array, " t"]) -> Float[Array, "t v"]:
        """Share of some texels that each vertex sees."""
        ...


class BrightLight(eqx.Module):
    """A light whose brightest texels stand apart.

    Attributes:
        rest: The light without them, as the other system has it.
        texel: Numbers of the texels.
        excess: Radiance by which each stands out.
        seen: How much of each texel each vertex sees, in sixteenths; None before `BrightTexels.shade`.
    """

    rest: PyTree
    texel: Int[Array, " t"]
    excess: Float[Array, "t c"]
    seen: UInt8[Array, "t v"] | None = None


class BrightView(eqx.Module):
    """A view of a system with single texels.

    Attributes:
        rest: The view, as the other system has it.
        frame: Shading frames of the vertices or points; rows are tangent, bitangent, normal.
        wo: Unit directions to the viewer, in these frames.
        blend: What the vertices are made of, where that is free.
    """

    rest: PyTree
    frame: Float[Array, "v 3 3"]
    wo: Float[Array, "v 3"]
    blend: Blend | None


class BrightTexels(VertexSystem):
    """Any system with the brightest texels of the light summed one by one, exactly.

    Attributes:
        system: What relights the rest of the light.
        visibility: Of single texels, of the same vertices: `StoredVisibility`, or `LobeTransport`.
        brdf: The BRDF itself; with a `Blend` one whose channels are those of the system.
        count: Number of texels.
        samples: Points along the edge of each, from `samples_for`.
    """

    system: System
    visibility: Any
    brdf: Callable
    count: int = eqx.field(static=True, default=16)
    samples: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        """Refuses what is no system or no visibility, and visibility of other vertices."""
        source = "jaxprt.visibility.precompute or jaxprt.lobe.precompute"
        require.kind("the system", self.system, System, source="jaxprt.lobe.LobeSystem or another system")
        require.kind("the visibility", self.visibility, Visibility, source=source)
        if self.points is None:
            require.length("the vertices of the visibility", self.visibility.position, self.system.vertices)

    def light(self, environment: Environment) -> BrightLight:
        """The light, split; the rest as the system has it."""
        texel, excess, rest = split(environment, count=self.count)
        return BrightLight(self.system.light(rest), texel, excess)

    def shade(self, light: BrightLight, materials: PyTree = None) -> BrightLight:
        """What arrives of the rest, and how much of each texel the vertices see."""
        rest = self.system.shade(light.rest, materials)
        return BrightLight(rest, light.texel, light.excess, _seen(self.visibility, light.texel))

    def view(self, eye: Float[Array, "*p 3"], materials: PyTree = None) -> BrightView:
        """The view, as the system has it, and the frames and directions in which the texels are summed."""
        position, frame = self.place(self.visibility)
        return BrightView(self.system.view(eye, materials), frame, directions.view(frame, position, eye), materials)

    def combine(self, light: BrightLight, view: BrightView) -> Float[Array, "v c"]:
        """Radiance: that of the system, and that of the texels."""
        require.kind("the light", light, BrightLight, source="BrightTexels.light")
        require.kind("the view", view, BrightView, source="BrightTexels.view")
        seen = _seen(self.visibility, light.texel) if light.seen is None else light.seen
        texels = light.texel, light.excess / LEVELS, seen
        options = {"size": self.visibility.size, "samples": self.samples}
        brdf = grid.as_argument(self.brdf)
        sent = _sent(brdf, view.frame, view.wo, texels, self.points, view.blend, **options)
        return self.system.combine(light.rest, view.rest) + sent

    def at(self, points: Points) -> "BrightTexels":
        """The same at points: `System.at`."""
        return eqx.tree_at(
            lambda each: (each.points, each.system), self, (points, self.system.at(points)), is_leaf=lambda x: x is None
        )

    @property
    def vertices(self) -> int:
        """Number of vertices, or of points."""
        return self.system.vertices

    @property
    def shared_light(self) -> tuple | None:
        """That of the system, and the number of texels."""
        rest = self.system.shared_light
        return rest and (BrightTexels, self.count, rest)


@partial(jit, static_argnames=("count",))
def split(light: Environment, *, count: int) -> tuple[Int[Array, " t"], Float[Array, "t c"], Environment]:
    """Takes the brightest texels out of a light, as far as they stand out.

    Args:
        light: One environment.
        count: Number of texels to take.

    Returns:
        Numbers of the texels; the radiance by which each stands out, in its own color, so that what is left of it has
        the flux of the brightest texel not taken; and the environment without that.

    Raises:
        TypeError: The light is no Environment.
        ValueError: The light is a batch, or as many texels as there are are asked for, or less than none.
    """
    require.kind("the light", light, Environment, source="jaxprt.scene.load_environment")
    size, colors = light.radiance.shape[-2:]
    if light.radiance.ndim != 4:
        raise ValueError(f"the light must be one environment [6, n, n, c], got {list(light.radiance.shape)}")
    if not 0 <= count < 6 * size * size:
        raise ValueError(f"the number of texels must be from 0 to {6 * size * size - 1}, got {count}")
    radiance = light.radiance.reshape(-1, colors)
    flux = jnp.sum(radiance, -1) * cubemap.solid_angle(size=size).ravel()
    texel = _largest(jax.lax.stop_gradient(flux), count + 1)
    bright = flux[texel]
    fraction = jnp.maximum(1 - bright[-1] / jnp.where(bright[:-1] > 0, bright[:-1], 1), 0)
    texel, excess = texel[:-1], radiance[texel[:-1]] * fraction[:, None].astype(radiance.dtype)
    rest = radiance.at[texel].add(-excess).reshape(light.radiance.shape)
    return texel, excess, Environment(rest)


def radiance(
    transport: Visibility,
    brdf: Callable,
    texel: Int[Array, " t"],
    excess: Float[Array, "t c"],
    *,
    eye: Float[Array, "3"],
    samples: int = 1,
    blend: Blend | None = None,
) -> Float[Array, "v e"]:
    """Radiance that vertices send to the eye, of light from some texels.

    Args:
        transport: Visibility of the vertices: `StoredVisibility`, or the bits of `LobeTransport`.
        brdf: A model: a pytree that is callable, (wi, wo) -> value [*b c] in 1/sr on local directions.
        texel: Numbers of the texels.
        excess: Radiance of each, as `split` returns it.
        eye: Position of the viewer in world units.
        samples: Points along the edge of a texel at which the BRDF is taken: the texel's center, or a Gauss rule. A
            BRDF that varies over a texel, like a mirror, needs more than one; `samples_for` tells how many. The time
            grows with the square.
        blend: What each vertex is made of, over the channels of the BRDF. If it has parameters, `brdf` is a function
            of them that makes a BRDF, as of `jaxprt.lobe.tabulate` with knots.

    Returns:
        Linear radiance per vertex in the light's units; that of the grazing view where the eye is below a vertex's
        horizon.
        Differentiable in the BRDF's parameters, the excess and the eye.

    Raises:
        TypeError: The BRDF is a table whose values hold the cosine of the light's direction.
        ValueError: No samples, the eye is not one position, or it or the excess is not finite. Inside `jax.jit` values
            are not known, and NaN reaches the vertices.

    Reference: Wang, Tran, Luebke 2004, equation 1, for single texels.
    """
    brdf = grid.as_argument(brdf)
    if samples < 1:
        raise ValueError(f"samples must be at least 1, got {samples}")
    excess = _checked(transport, texel, excess)
    require.position("the eye", eye)
    wo = directions.view(transport.frame, transport.position, eye)
    light = texel, excess, transport.visible(texel)
    return _sent(brdf, transport.frame, wo, light, None, blend, size=transport.size, samples=samples)


def _checked(transport: Visibility, texel: Array, excess: Array) -> Array:
    """The excess as floating-point numbers, once texels and excess are those of one light of the transport's size."""
    require.length("the rows of the excess", excess, len(texel))
    require.finite("the excess", excess)
    require.within("the texels", texel, 0, 6 * transport.size**2 - 1)
    return jnp.asarray(excess, jnp.result_type(excess, transport.position))


@partial(jit, static_argnames=("size", "samples"))
def _sent(
    brdf: Callable,
    frame: Float[Array, "p 3 3"],
    wo: Float[Array, "p 3"],
    light: tuple[Int[Array, " t"], Float[Array, "t c"], UInt8[Array, "t v"] | Float[Array, "t v"]],
    points: Points | None,
    blend: Blend | None,
    *,
    size: int,
    samples: int,
) -> Float[Array, "p e"]:
    """Radiance that vertices, or points, send: the sum over texels of light x BRDF x cosine x visibility.

    Args:
        brdf: The BRDF, in 1/sr.
        frame: Rows are tangent, bitangent, normal.
        wo: Directions to the viewer in it.
        light: Numbers of the texels; their radiance; and how much of each the vertices see. Only the product of the
            last two counts, so that the second may be in sixteenths and the first divided by 16.
        points: The points; None for the vertices.
        blend: As in `radiance`.
        size: Edge of the cubemap's faces in texels.
        samples: Points along the edge of each texel.
    """
    texel, excess, visible = light
    # Vertices last, which XLA's CPU code turns into vectors of them.
    frame, wo = jnp.moveaxis(frame, 0, 2), wo.T
    parameter = () if blend is None else blend.parameter
    weight = None if blend is None else jnp.moveaxis(blend.weight, 0, 2)

    def one(wi, wo, *parameter):
        return brdf(*parameter)(wi, wo) if parameter else brdf(wi, wo)

    value = jax.vmap(one, in_axes=(1, 1, *(0 for _ in parameter)), out_axes=1)

    def lit(argument):
        direction, area, excess, visible = argument
        share = visible.astype(wo.dtype) if points is None else points.carry(visible)
        sent = total(point, (direction, area)) * share
        if weight is not None:
            sent = jnp.sum(sent[:, None] * weight, 0)
        return sent * excess[:, None]

    def point(argument):
        direction, area = argument
        wi = jnp.stack([_along(axis, direction) for axis in frame])
        return value(wi, wo, *parameter) * jnp.maximum(_along(frame[2], area), 0)

    direction, area = (each.astype(excess.dtype) for each in _points(texel, size, samples))
    # One after another, so that what is between stays in the processor's cache.
    return total(lit, (direction, area, excess, visible)).T


@jit
def _seen(visibility: Visibility, texel: Int[Array, " t"]) -> UInt8[Array, "t v"]:
    """Share of some texels that each vertex sees, in sixteenths."""
    return jnp.round(visibility.visible(texel) * LEVELS).astype(jnp.uint8)


def samples_for(brdf: Callable, *, size: int = 64, error: float = 0.02) -> int:
    """Points along the edge of a texel that `radiance` needs for a BRDF.

    Texels are laid around the mirror direction of sixteen views down to 15 degrees above the surface, and the
    integrals of BRDF times cosine over them compared to those by 32 x 32 points. Runs on the host: call it once for a
    BRDF, and keep the number. Inside `jax.jit` parameters are not known; take the number for the sharpest BRDF there.

    Args:
        brdf: A model, or any function (wi, wo) -> value [b c] in 1/sr on local directions.
        size: Edge of the cubemap's faces in texels.
        error: Largest relative L2 error over the texels of a view.

    Returns:
        The smallest number that meets the error, or the largest that is tried, 16.

    Raises:
        ValueError: An error that is not positive.
    """
    if not error > 0:
        raise ValueError(f"error must be positive, got {error}")
    rule = [np.polynomial.legendre.leggauss(count) for count in (*_SAMPLES, _FINE)]
    place = np.concatenate([np.stack(np.meshgrid(x, x), -1).reshape(-1, 2) for x, _ in rule])
    weight = np.concatenate([np.outer(w, w).ravel() for _, w in rule])
    first = np.cumsum([0, *(len(x) ** 2 for x, _ in rule[:-1])])
    offset = np.random.default_rng(0).uniform(-2, 2, (12, 1, 2))  # middles of texels, in texels
    s, t = np.moveaxis((2 * offset + place) / size, -1, 0)[..., None]
    brdf = grid.as_argument(brdf)
    need = 0
    for angle, turn in itertools.product(np.radians([0, 30, 60, 75]), np.pi / 4 * np.arange(4)):
        wo = np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
        axes = np.asarray(directions.frame(jnp.asarray(wo * [-1, -1, 1]), jnp.zeros(3)), np.float64)
        wi = s * axes[0] + t * axes[1] + axes[2]
        wi = (wi / np.linalg.norm(wi, axis=-1, keepdims=True)).reshape(-1, 3)
        value = _value(brdf, *(jnp.asarray(each, jnp.result_type(float)) for each in (wi, wo)))
        sent = np.asarray(value, np.float64).mean(-1) * np.maximum(wi[:, 2], 0)
        mean = np.add.reduceat(sent.reshape(len(offset), -1) * weight, first, axis=1)
        off = np.linalg.norm(mean - mean[:, -1:], axis=0)
        good = np.flatnonzero(off <= error * np.linalg.norm(mean[:, -1]))
        need = max(need, min(int(good[0]), len(_SAMPLES) - 1))
    return _SAMPLES[need]


def irradiance(transport: Visibility, texel: Int[Array, " t"], excess: Float[Array, "t c"]) -> Float[Array, "v c"]:
    """Irradiance over pi of light from some texels: the radiance of white diffuse vertices, from any side.

    Args:
        transport: Visibility of the vertices.
        texel: Numbers of the texels.
        excess: Radiance of each, as `split` returns it.

    Raises:
        ValueError: Texels that the transport's cubemap does not have, or excess that is not one row for each texel or
            not finite. Inside `jax.jit` values are not known: NaN then reaches the vertices.
    """
    return _irradiance(transport, texel, _checked(transport, texel, excess))


@jit
def _irradiance(transport: Visibility, texel: Array, excess: Array) -> Array:
    flux = _flux(transport.frame[:, 2].T, texel, transport.visible(texel), size=transport.size)
    return (excess.T @ flux).T / np.pi


def _points(texel: Int[Array, " t"], size: int, samples: int) -> tuple[Array, Array]:
    """Directions of the points in some texels, and their integrals of direction, [t k 3]."""
    if samples == 1:
        direction, area = (each(size=size).reshape(-1, 3) for each in (cubemap.direction, cubemap.vector_area))
        return direction[texel, None], area[texel, None]
    place, weight = np.polynomial.legendre.leggauss(samples)
    face, row = jnp.divmod(texel[:, None, None], size**2)
    row, column = jnp.divmod(row, size)
    s, t = (2 * column + 1 + place) / size - 1, (2 * row + 1 + place[:, None]) / size - 1
    axis = jnp.asarray(cubemap.axes())[face]
    point = s[..., None] * axis[..., 0, :] + t[..., None] * axis[..., 1, :] + axis[..., 2, :]
    length = jnp.linalg.norm(point, axis=-1, keepdims=True)
    area = point / length**4 * (weight * weight[:, None] / size**2)[..., None]
    return (point / length).reshape(len(texel), -1, 3), area.reshape(len(texel), -1, 3)


def _flux(normal: Float[Array, "3 v"], texel: Array, visible: Float[Array, "t v"], *, size: int) -> Array:
    """Visible solid angle of some texels times the cosine."""
    area = cubemap.vector_area(size=size).reshape(-1, 3)[texel]
    return jnp.maximum(_along(normal, area[:, None]), 0) * visible


def _largest(value: Float[Array, " n"], count: int) -> Int[Array, " t"]:
    """Where the largest values are, the largest first: in the rows with the largest maxima, which are few to sort."""
    rows = len(value) // _ROW
    if rows <= count or len(value) % _ROW:
        return jax.lax.top_k(value, count)[1]
    table = value.reshape(rows, _ROW)
    row = jnp.sort(jax.lax.top_k(jnp.max(table, 1), count)[1])  # In order, so that of equal values the first is taken.
    place = jax.lax.top_k(table[row].ravel(), count)[1]
    return row[place // _ROW] * _ROW + place % _ROW


def _along(axis: Float[Array, "3 v"], direction: Float[Array, "*t 3"]) -> Array:
    """Components along an axis of each vertex."""
    return axis[0] * direction[..., 0] + axis[1] * direction[..., 1] + axis[2] * direction[..., 2]
