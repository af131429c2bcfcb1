"""Lobes widened by the cone of directions that each reflection ray stands for.

A ray of the reflection of a glossy surface stands for a cone of directions, which meets an area of the surface that it
hits and leaves it with a wider spread still. If that surface is read at one direction, a highlight that a few rays hit
makes bright dots. Widened lobes read the mean over the cone: a von Mises-Fisher lobe of concentration k, averaged over
directions of variance s, is nearly one of concentration 1 / (1 / k + s).
"""

from typing import Any

import equinox as eqx
from jaxtyping import Array, Float, PyTree

from jaxprt.compile import jit
from jaxprt.scene.points import Points
from jaxprt.sphere import directions
from jaxprt.systems.bright_texels import FULL, BrightLight, BrightTexels
from jaxprt.systems.lobe import squares as over_squares
from jaxprt.systems.lobe.table import LobeMixture
from jaxprt.systems.protocol import Blend, System


class WidenedView(eqx.Module):
    """A view of a system with widened lobes.

    Attributes:
        rest: The view of the light without its brightest texels.
        lobe: The widened lobes in local frames, for the brightest texels.
        frame: Shading frames of the vertices or points; rows are tangent, bitangent, normal.
    """

    rest: PyTree
    lobe: LobeMixture
    frame: Float[Array, "v 3 3"]


def can_widen(system: System) -> bool:
    """Whether a system represents its BRDF by lobes, possibly besides other terms."""
    return system.lobe_part is not None


@jit
def view(
    system: Any, eye: Float[Array, "*p 3"], blend: Blend | None, points: Points, variance: Float[Array, " p"]
) -> WidenedView:
    """The view of a system with lobes, with or without bright texels, whose lobes are widened.

    Args:
        system: The system.
        eye: Position of the viewer: one, or one for each point.
        blend: Weights and parameters of the channels; None for the BRDF as it is.
        points: The points.
        variance: Variance in squared radians, along one axis, by which all lobes of a vertex or point are widened.
    """
    lobes = system.lobe_part
    inner: Any = system.system if isinstance(system, BrightTexels) else system
    position, frame = lobes.placed(points)
    lobe = lobes.brdf.lookup(directions.view(frame, position, eye), *(() if blend is None else blend.parameter))
    options = {"two_lights": True} if isinstance(system, BrightTexels) and system.by_lobes else {}
    rest = inner.view(eye, blend, points, variance=variance, **options)
    looked = rest if inner is lobes else rest.lobes
    lobe = LobeMixture(lobe.mean, lobe.concentration, looked.weight, looked.diffuse).widened(variance)
    return WidenedView(rest, lobe, frame)


@jit
def combine(system: Any, light: PyTree, seen: WidenedView, points: Points) -> Float[Array, "p c"]:
    """Radiance: the blurred light, read by the widened lobes, and the brightest texels, each times the same lobes.

    Args:
        system: The system of the view.
        light: The result of its `shade`.
        seen: The result of `view`.
        points: The points of the view.
    """
    if not isinstance(light, BrightLight):
        return system.combine(light, seen.rest, points)
    sent = system.system.combine(light.rest, seen.rest, points)
    shares: Any = light.seen
    texels, squares = (light.texel, light.excess / FULL, shares), system.squares
    if system.by_lobes:
        texels, cells = (tuple(rows[part] for rows in texels) for part in system.parts)
        sent = sent + system.system.over_cells(seen.rest, seen.frame, cells, points, squares=squares[1:])
        squares = squares[:1]
    return sent + over_squares.radiance(seen.lobe, seen.frame, texels, points, squares=squares)
