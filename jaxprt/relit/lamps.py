"""Lamps of a scene: parts that emit light, and point lights."""

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt.brdf import Lambert
from jaxprt.relit.channels import Appearance, Shading
from jaxprt.relit.kept import kept
from jaxprt.relit.recipes import Target
from jaxprt.scene import PointLight, Scene
from jaxprt.scene.mesh import areas
from jaxprt.scene.points import Points
from jaxprt.systems import bright_texels, lamps, lobe
from jaxprt.systems.lamps import LitByLamps
from jaxprt.systems.protocol import Blend, System

_LOBES = 12  # number of lobes for a BRDF whose system has no table of lobes


class SceneLamps(eqx.Module):
    """The lamps of a scene, and the transport of their light to all parts.

    Lamps are numbered with emitting parts first, then point lights.

    Attributes:
        part: For each part, the transport of the light of all lamps.
        emitting: Indices of the parts that emit.
        area: For each part that emits, the surface area that each of its vertices represents.
        point_lights: The point lights with their default intensities.
    """

    part: tuple[LitByLamps, ...]
    emitting: tuple[int, ...] = eqx.field(static=True)
    area: tuple[Float[Array, " _"], ...]
    point_lights: tuple[PointLight, ...]

    def radiance(self, appearances: Sequence[Appearance], changed: Mapping[str, PointLight]) -> Float[Array, "n 3"]:
        """Radiance of each lamp: the mean over the area of an emitting part, or the intensity of a point light.

        Args:
            appearances: Materials of all parts at their vertices.
            changed: Point lights with other intensities, by name.
        """
        rows = [
            self._mean(number, own, appearances[number]) for number, own in zip(self.emitting, self.area, strict=True)
        ]
        rows += [changed.get(each.name, each).intensity for each in self.point_lights]
        return jnp.stack(rows)

    def number(self, part: int) -> int | None:
        """Index of the lamp that a part is; None if the part does not emit."""
        return self.emitting.index(part) if part in self.emitting else None

    def view(
        self,
        eye: Float[Array, "3"],
        blends: Sequence[Blend | None],
        points: Sequence[Points] | None,
        traced: Sequence[Float[Array, " _"] | None],
    ) -> tuple[Float[Array, "n _ _"], ...]:
        """What depends on the view, for each part: `LitByLamps.view`."""
        rows = zip(self.part, blends, points or [None] * len(self.part), traced, strict=True)
        return tuple(part.view(eye, blend, place, narrow) for part, blend, place, narrow in rows)

    def combine(self, radiance: Float[Array, "n 3"], view: Sequence[Float[Array, "n _ _"]]) -> Float[Array, "v 3"]:
        """Radiance of the vertices or points of all parts due to all lamps.

        Args:
            radiance: Radiance of each lamp.
            view: View of each part, from `LitByLamps.view`.
        """
        return jnp.concatenate([part.combine(radiance, own) for part, own in zip(self.part, view, strict=True)])

    def _mean(self, number: int, area: Array, appearance: Appearance) -> Float[Array, "3"]:
        emitted = appearance.emitted
        return jnp.zeros(3, area.dtype) if emitted is None else area @ emitted / jnp.sum(area)


def make(
    scene: Scene,
    shadings: Sequence[Shading],
    systems: Sequence[System],
    targets: Sequence[Target],
    point_lights: tuple[PointLight, ...],
) -> SceneLamps | None:
    """Precomputes the transport from the lamps of a scene to all its parts; None if there are no lamps.

    Args:
        scene: The scene, with its origin at zero.
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        systems: The systems of the parts. If one has a table of lobes, it is used.
        targets: For each part, what casts shadows, and where and how to compute.
        point_lights: The point lights of the scene, in the coordinates of its file.
    """
    emitting = [number for number, each in enumerate(shadings) if each.emitted is not None]
    if not emitting and not scene.point_lights:
        return None
    sources = [*(shadings[number].mesh for number in emitting), *scene.point_lights]
    rows = []
    for shading, system, target in zip(shadings, systems, targets, strict=True):
        transport = lamps.precompute(shading.mesh, sources, **target.traced(), **target.options("lamps"))
        if isinstance(shading.brdf, Lambert):
            rows.append(LitByLamps(transport, albedo=shading.brdf.albedo))
        else:
            rows.append(LitByLamps(transport, _table(shading, system, target)))
    area = tuple(jnp.asarray(areas(shadings[number].mesh), jnp.result_type(float)) for number in emitting)
    return SceneLamps(tuple(rows), tuple(emitting), area, point_lights)


def _table(shading: Shading, system: System, target: Target) -> lobe.LobeBrdf:
    """The BRDF of a part as lobes."""
    own = system.system if isinstance(system, bright_texels.BrightTexels) else system
    if isinstance(own, lobe.LobeSystem):
        return own.brdf
    return kept(
        None if target.path is None else pathlib.Path(f"{target.path}_table_{_LOBES}.prt"),
        (shading.brdf, shading.knot, _LOBES),
        lambda: lobe.tabulate(shading.brdf, lobes=_LOBES, knot=shading.knot),
    )


def split(lamp: SceneLamps | None, materials: Any) -> tuple[Any, dict[str, PointLight]]:
    """Separates a dictionary of materials into materials of parts and point lights. Other values are kept as they are.

    Raises:
        ValueError: There is no point light of the given name, or it has moved since precomputation.
    """
    if not isinstance(materials, Mapping):
        return materials, {}
    given = dict(materials)
    changed = {name: given.pop(name) for name, each in list(given.items()) if isinstance(each, PointLight)}
    known = {} if lamp is None else {each.name: each for each in lamp.point_lights}
    for name, each in changed.items():
        if name not in known:
            raise ValueError(f"point lights must be among those of the scene, {list(known)}, got one named {name!r}")
        now, then = each.position, known[name].position
        if isinstance(now, Tracer) or isinstance(then, Tracer):
            continue
        if not np.array_equal(np.asarray(now), np.asarray(then)):
            raise ValueError(
                f"point light {name!r} was traced from {np.asarray(known[name].position).tolist()}, got one at "
                f"{np.asarray(each.position).tolist()}: precompute the scene with it there"
            )
    return given, changed
