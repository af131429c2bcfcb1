"""Shading of parts of scenes: radiance at points and vertices from direct light, bounces and lamps together."""

from functools import partial, reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jaxprt.compile import jit
from jaxprt.relit.channels import Appearance, Shading, at_points
from jaxprt.scene import Part
from jaxprt.scene.points import Points
from jaxprt.systems.bounces import ReflectingPart
from jaxprt.systems.bounces.traced import SharpPart
from jaxprt.systems.lamps import LitByLamps
from jaxprt.systems.lobe import widened
from jaxprt.systems.protocol import Blend, System


class Surface(eqx.Module):
    """A part of a scene with everything that its shading requires.

    Attributes:
        part: The part.
        first: Index of its first vertex in the mesh of all parts.
        shading: Mesh, BRDF and channel weights of the part.
        system: The system of direct light from the environment.
        reflecting: How it reflects light from other surfaces; None without bounces.
        lit: How it reflects light from lamps; None without lamps.
        appearance: Its material at the vertices.
        material: Source of its material at points: a `TexturedMaterial` or `BlinnPhong`, an `Appearance` at the
            vertices, or None for the part's own material.
        curvature: How fast its radiance varies with direction, from `interpolation.curvature`.
        lamp: Index of the lamp that the part is; None if it does not emit.
        glows: Whether its emission is visible. It is not for reflection rays, which add lamps separately.
    """

    part: Part
    first: int = eqx.field(static=True)
    shading: Shading
    system: System
    reflecting: ReflectingPart | None
    lit: LitByLamps | None
    appearance: Appearance
    material: Any
    curvature: Float[Array, ""]
    lamp: int | None = eqx.field(static=True, default=None)
    glows: bool = eqx.field(static=True, default=True)


@partial(jit, static_argnames="at_pixels")
def look(
    surface: Surface, points: Points, eye: Array, *, at_pixels: bool, variance: Float[Array, " p"] | None = None
) -> tuple[Points, Appearance, PyTree]:
    """Some points of a part, the material there, and the view of each system of the part (None unless `at_pixels`).

    `variance`, in squared radians, widens the lobes of each point; see `jaxprt.systems.lobe.widened`.
    """
    appearance = at_points(surface.part, surface.shading, surface.material, points)
    return points, appearance, _view(surface, eye, points, appearance.blend, variance) if at_pixels else None


@jit
def lit(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    vertices: Float[Array, "k v c"] | None,
    viewed: tuple[Points, Appearance, PyTree],
) -> Float[Array, "p c"]:
    """Colors of some points of a part, from the arriving light or, if given, from the radiance of the vertices.

    Args:
        surface: The part.
        arriving: Direct light, reflected light, and radiance of each lamp.
        vertices: Radiance of each channel at the vertices, from `at_vertices`; None to shade at the points.
        viewed: Result of `look`.
    """
    points, appearance, view = viewed
    if vertices is None:
        color = _combine(surface, arriving, view, points)
    elif appearance.blend is None:
        color = points.carry(vertices[0])
    else:
        weight = jnp.moveaxis(appearance.blend.weight, 1, 0)
        color = reduce(jnp.add, (points.carry(own) * each for own, each in zip(vertices, weight, strict=True)))
    return color if appearance.emitted is None or not surface.glows else color + appearance.emitted


@partial(jit, static_argnames="at_pixels")
def shaded(
    surface, arriving, vertices, points: Points, eye, *, at_pixels: bool, variance: Array | None = None
) -> Array:
    """Colors of some points of a part. Intermediate results are recomputed for derivatives instead of stored."""

    def both(surface, arriving, vertices, eye):
        viewed = look(surface, points, eye, at_pixels=at_pixels, variance=variance)
        return lit(surface, arriving, vertices, viewed)

    return jax.checkpoint(both)(surface, arriving, vertices, eye)


@jit
def at_vertices(surface: Surface, arriving: tuple[PyTree, PyTree, PyTree], eye: Array) -> Float[Array, "k v c"]:
    """Radiance of the vertices of a part, separately for each channel of its BRDF."""
    blend = surface.appearance.blend
    if blend is None:
        return _combine(surface, arriving, _view(surface, eye, None, None), None)[None]
    rows = []
    for channel in range(blend.weight.shape[1]):
        one = jnp.zeros_like(blend.weight[..., :1]).at[:, channel].set(1)
        rows.append(_combine(surface, arriving, _view(surface, eye, None, Blend(one, blend.parameter)), None))
    return jnp.stack(rows)


def _view(
    surface: Surface, eye: Array, points: Points | None, blend: Blend | None, variance: Array | None = None
) -> tuple[PyTree, PyTree, PyTree]:
    """The view of each system of a part: direct light, reflected light and lamps; at points or at the vertices."""
    system = surface.system if points is None else surface.system.at(points)
    reflecting, lit = surface.reflecting, surface.lit
    traced = jnp.ones(len(points)) if isinstance(reflecting, SharpPart) and points is not None else None
    reflected = None if reflecting is None else reflecting.view(eye, blend, points)
    if variance is not None and widened.can_widen(system):
        direct = widened.view(system, eye, blend, variance)
    else:
        direct = system.view(eye, blend)
    return direct, reflected, None if lit is None else lit.view(eye, blend, points, traced)


def _combine(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    view: tuple[PyTree, PyTree, PyTree],
    points: Points | None,
) -> Array:
    """Radiance of a part from all its systems."""
    system = surface.system if points is None else surface.system.at(points)
    if isinstance(view[0], widened.WidenedView):
        assert widened.can_widen(system)
        color = widened.combine(system, arriving[0], view[0])
    else:
        color = system.combine(arriving[0], view[0])
    if surface.reflecting is not None:
        color = color + surface.reflecting.combine(arriving[1], view[1], points)
    return color if surface.lit is None else color + surface.lit.combine(arriving[2], view[2])
