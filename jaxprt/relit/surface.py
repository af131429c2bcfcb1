"""Shading of rows of points or vertices: all light that they send to the eye.

`view` computes all that does not depend on the light, and `radiance` is the one sum of direct light, reflected light,
lamps and emission. Both are one program for each kind of group.
"""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from jaxprt import require
from jaxprt.compile import jit, kept, mapped
from jaxprt.relit.groups import Surface, VertexMaterials, material
from jaxprt.scene.material_table import MaterialLook
from jaxprt.scene.points import VERTICES, Points, placed
from jaxprt.sphere import directions
from jaxprt.systems import bright_texels, protocol
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.lobe import widened
from jaxprt.systems.protocol import Blend
from jaxprt.visibility import picture_rays


class Sight(eqx.Module):
    """What the BRDF of points needs, apart from the direction of the light.

    Attributes:
        frame: Shading frames of the points; rows are tangent, bitangent, normal.
        wo: Unit directions to the viewer in these frames.
        blend: Weights and parameters of the BRDF's channels; None for a BRDF that cannot change.
        above: Normals of the smooth surface, below whose horizon no light arrives; None where they are those of the
            frames.
    """

    frame: Float[Array, "p 3 3"]
    wo: Float[Array, "p 3"]
    blend: Blend | None
    above: Float[Array, "p 3"] | None = None


class Viewed(eqx.Module):
    """Points of a group with all that does not depend on the light.

    Attributes:
        points: The points on the group.
        seen: The view of each system of the group: direct light, reflected light and lamps.
        emitted: Radiance that the points emit; None for a group that does not emit.
        sight: What single texels of the light need; None where they are not summed one by one.
    """

    points: Points
    seen: tuple[PyTree, PyTree, PyTree]
    emitted: Float[Array | np.ndarray, "p 3"] | None
    sight: Sight | None = None


class TexelLight(NamedTuple):
    """Light of single texels at some points.

    Attributes:
        texel: Indices of the texels.
        excess: Their radiance.
        share: Share of each texel that each point sees, in 240ths.
        spot: Where in each texel its light comes from.
        size: Edge of the cubemap faces in texels.
        samples: Number of sample points along the edge of each texel.
    """

    texel: Int[Array, " t"]
    excess: Float[Array, "t c"]
    share: UInt8[Array, "t p"]
    spot: Float[Array, "t 4"]
    size: int
    samples: int


@partial(kept, static=("glows", "finer"), quick=True)
def view(
    surface: Surface,
    points: Points,
    look: MaterialLook,
    eye: Float[Array, "*p 3"],
    *,
    fixed: VertexMaterials | None = None,
    sharp: Float[Array, " p"] | None = None,
    variance: Float[Array, " p"] | None = None,
    glows: bool = True,
    lamps: LampTransport | None = None,
    missed: Float[Array, " p"] | None = None,
    finer: bool = False,
) -> Viewed:
    """All of the points' radiance that does not depend on the light.

    Args:
        surface: The group.
        points: Points on the group.
        look: The materials at the points.
        eye: Position of the viewer: one, or one for each point.
        fixed: Materials that users give at vertices; None without.
        sharp: 1 at points whose narrow lobes are traced by rays, 0 at others; None where no lobe is.
        variance: Variance in squared radians by which lobes are widened, at points that reflection rays hit; see
            `jaxprt.systems.lobe.widened`.
        glows: Whether emission is seen. Reflection rays do not see it, because they add lamps separately.
        lamps: The transport of the lamps to the points; None to interpolate it between vertices.
        missed: Share of the reflection rays of narrow lobes that hit nothing; see `LobeSystem.view`.
        finer: Whether very narrow lobes read texels that only `shadows.sharpened` light has.
    """
    points = points.tilted(look.normal)
    blend, emitted = material(surface, points, look, fixed)
    options = {"variance": variance, "lamps": lamps, "missed": missed, "finer": finer}
    seen = view_of(surface, eye, blend, points, sharp, **options)
    sight = _sight(surface, points, eye, blend)
    return Viewed(points, seen, emitted if glows else jnp.zeros_like(emitted), sight)


def radiance(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    viewed: Viewed,
    *,
    texels: TexelLight | None = None,
    reflections: Float[Array, "p c"] | None = None,
) -> Float[Array, "p _"]:
    """Radiance that points of a group send to the eye: the sum of all light of a scene.

    Args:
        surface: The group.
        arriving: Direct light, reflected light, and radiance of each lamp.
        viewed: The result of `view`.
        texels: Direct light of texels that are not in `arriving`; None without.
        reflections: What reflection rays add; None without.
    """
    color = _lit(surface, arriving, viewed.seen, viewed.points, viewed.emitted)
    if texels is not None:
        *rows, size, samples = texels
        sight = require.kind("the sight of the points", viewed.sight, Sight, source="surface.view")
        color = color + _from_texels(surface, sight, *rows, size=size, samples=samples)
    return color if reflections is None else color + reflections


@partial(kept, static=("size", "samples"))
def _from_texels(
    surface: Surface,
    sight: Sight,
    texel: Int[Array, " t"],
    excess: Float[Array, "t c"],
    share: UInt8[Array, "t p"],
    spot: Float[Array, "t 4"],
    *,
    size: int,
    samples: int,
) -> Float[Array, "p c"]:
    """Radiance that points reflect from single texels of the light."""
    light = texel, excess / picture_rays.FULL, share
    squares = (bright_texels.Squares(size, len(texel), samples),)
    return bright_texels.texel_radiance(
        surface.brdf, sight.frame, sight.wo, light, VERTICES, sight.blend, squares=squares, above=sight.above, spot=spot
    )


def _sight(surface: Surface, points: Points, eye: Array, blend: Blend | None) -> Sight:
    position, frame = placed(surface.position, surface.frame, points)
    above = None if points.normal is None else points.tilted(None).frame(surface.frame)[:, 2]
    return Sight(frame, directions.view(frame, position, eye), blend, above)


@partial(jit, static_argnames=("finer",))
def view_of(
    surface: Surface,
    eye: Float[Array, "*p 3"],
    blend: Blend | None,
    points: Points,
    sharp: Array | None,
    *,
    variance: Array | None = None,
    lamps: LampTransport | None = None,
    missed: Float[Array, " p"] | None = None,
    finer: bool = False,
) -> tuple[PyTree, PyTree, PyTree]:
    """The view of all systems of a group at points on it.

    Args:
        surface: The group.
        eye: Position of the viewer: one, or one for each point.
        blend: Weights of the channels there.
        points: The points.
        sharp: 1 where narrow lobes are traced by rays, 0 elsewhere; None for a group without rays.
        variance: Variance in squared radians by which lobes are widened; see `jaxprt.systems.lobe.widened`.
        lamps: The transport of the lamps to the points; None to interpolate it between vertices.
        missed: Share of the reflection rays of narrow lobes that hit nothing; see `LobeSystem.view`.
        finer: Whether very narrow lobes read texels that only `shadows.sharpened` light has.
    """
    system, reflecting, lit = surface.system, surface.reflecting, surface.lit
    reflected = None if reflecting is None else reflecting.view(eye, blend, points, sharp)
    if lit is not None and lamps is not None:
        lamps = lamps if points.normal is None else lamps.tilted(points.frame(surface.frame))
        lit = lit.at(lamps).view(eye, blend, traced=sharp)
    elif lit is not None:
        lit = lit.view(eye, blend, points, sharp)
    if variance is not None and widened.can_widen(system):
        return widened.view(system, eye, blend, points, variance), reflected, lit
    options: dict[str, Any] = {} if missed is None else {"missed": missed}
    options |= {"finer": True} if finer else {}
    options = {} if system.lobe_part is None else options
    return system.view(eye, blend, points, **options), reflected, lit


@kept
def _lit(
    surface: Surface,
    arriving: tuple[PyTree, PyTree, PyTree],
    seen: tuple[PyTree, PyTree, PyTree],
    points: Points,
    emitted: Float[Array, "_ 3"] | None,
) -> Float[Array, "_ c"]:
    """Radiance of the light that arrives at a group and of emission."""
    if isinstance(seen[0], widened.WidenedView):
        color = widened.combine(surface.system, arriving[0], seen[0], points)
    else:
        color = surface.system.combine(arriving[0], seen[0], points)
    if surface.reflecting is not None:
        color = color + surface.reflecting.combine(arriving[1], seen[1], points)
    if surface.lit is not None:
        color = color + surface.lit.combine(arriving[2], seen[2])
    return color if emitted is None else color + emitted


@partial(kept, static=("tilts",))
def under_lights(
    surface: Surface,
    lights: tuple[PyTree, PyTree],
    lamp: Float[Array, "n 3"] | None,
    blend: Blend | None,
    viewed: Viewed,
    *,
    tilts: bool,
) -> Float[Array, "l _ c"]:
    """Radiance of the vertices of a group, or of points on it, under several lights.

    Args:
        surface: The group.
        lights: Direct light, from `groups.projected`, and reflected light under each of the lights.
        lamp: Radiance of each lamp; None without.
        blend: Weights of the channels at the vertices of the group.
        viewed: What does not depend on the light.
        tilts: Whether normal maps tilt the normals.
    """

    def lit(row: tuple[PyTree, PyTree]) -> Float[Array, "_ c"]:
        direct = protocol.arriving(surface.system, row[0], blend)
        direct = surface.system.tilted(direct, surface.frame[:, 2]) if tilts else direct
        return _lit(surface, (direct, row[1], lamp), viewed.seen, viewed.points, viewed.emitted)

    return mapped(lit, lights)
