"""Light of lamps at the points of a picture, by rays from the points.

Soft shadows and highlights of lamps are then right at pixels, on any mesh. Like the transport at vertices it does not
depend on the colors of lamps. Rays are cast on the host. They are constants of all derivatives.
"""

import dataclasses
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Array, Int

from jaxprt.compile import compile_time, known
from jaxprt.image.pixels import Pixels
from jaxprt.relit import canvas
from jaxprt.relit.casting import Caster, caster
from jaxprt.relit.groups import Stage
from jaxprt.scene import Mesh, PointLight
from jaxprt.scene.mesh import split
from jaxprt.scene.points import Points, placed
from jaxprt.systems.lamps import LampTransport
from jaxprt.systems.lamps.places import at_points, outlines, places
from jaxprt.visibility import picture_rays
from jaxprt.visibility.picture_rays import LampPlaces

# Pieces of a lamp, for groups with a part of a higher curvature of radiance, such as gray plastic of roughness .3 or
# metal of .5, and for others.
_FINE, _COARSE, _SMOOTH = 16, 4, 5.0
_MANY = 4  # surfaces, of which more have few pieces each


@dataclasses.dataclass(frozen=True)
class LampLight:
    """The lamps of a scene, and the points of a picture.

    Attributes:
        stage: The scene.
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
    """

    stage: Stage
    pixels: Pixels
    width: int

    @cached_property
    def _caster(self) -> Caster:
        return caster(self.stage.whole)

    @cached_property
    def _sources(self) -> list[Mesh | PointLight]:
        """The lamps in their order: emitting parts first, then point lights."""
        emitting = np.argsort(self.stage.lamp, kind="stable")[self.stage.lamp.count(-1) :]
        meshes = split(self.stage.whole) if len(emitting) else []
        return [*(meshes[part] for part in emitting), *self.stage.point_lights]

    @cached_property
    def _places(self) -> dict[int, tuple[LampPlaces, Any]]:
        """Places on the lamps and outlines, by the number of pieces of each surface, as far as they were needed."""
        return {}

    def _places_for(self, group: int) -> tuple[LampPlaces, Any]:
        """Places on the lamps for the points of a group, and outlines."""
        curvature, parts = self.stage.curvature, list(self.stage.layout.parts[group])
        # Roughness that JAX traces may become small.
        smooth = not known(curvature) or np.asarray(curvature)[parts].max() > _SMOOTH
        few = sum(lamp >= 0 for lamp in self.stage.lamp) <= _MANY
        pieces = _FINE if smooth and few else _COARSE
        if pieces not in self._places:
            with compile_time(self.stage.whole):  # Derivatives trace the shading of a row.
                on_lamps = places(self._sources, np.asarray(self.stage.power), pieces=pieces)
                self._places[pieces] = on_lamps, outlines(self._sources, on_lamps)
        return self._places[pieces]

    def row(self, group: int, index: Int[Array | np.ndarray, " p"], on_group: Points) -> LampTransport:
        """The transport of the lamps to some points.

        Args:
            group: Index of the group of the points.
            index: Indices of the points among those of the picture; -1 in padding.
            on_group: The same points on the group.
        """
        surface = self.stage.surfaces[group]
        with compile_time(surface.position, surface.frame, on_group):
            position, frame = placed(surface.position, surface.frame, on_group)
        points = canvas.traced(self.pixels, self.width, np.asarray(index))
        fields = np.asarray(position), np.asarray(frame)[:, 2]
        on_lamps, flat = self._places_for(group)
        moment = picture_rays.moments(self._caster.triangles, self._caster.occluder, points, *fields, on_lamps)
        return at_points(moment, position, frame, self._sources, on_lamps.pieces, flat)


def of(stage: Stage, pixels: Pixels, width: int) -> LampLight | None:
    """The lamps of a scene for a picture; None without lamps, or if JAX traces the scene or the points.

    Args:
        stage: The scene.
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
    """
    if stage.power is None or not known(stage.whole, stage.power, stage.point_lights, pixels):
        return None
    return LampLight(stage, pixels, width) if known([surface.position for surface in stage.surfaces]) else None
