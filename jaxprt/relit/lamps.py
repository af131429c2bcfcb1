"""Lamps of a scene: parts that emit, and point lights."""

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

_LOBES = 12  # of BRDFs whose system has none


class SceneLamps(eqx.Module):
    """What the lamps of a scene are to its parts. Emitting parts come first, then point lights.

    Attributes:
        part: What each part makes of their light.
        emitting: Numbers of the parts that emit.
        area: Surface that each vertex of these stands for.
        point_lights: The point lights, with the intensities that they have if nothing else is said.
    """

    part: tuple[LitByLamps, ...]
    emitting: tuple[int, ...] = eqx.field(static=True)
    area: tuple[Float[Array, " _"], ...]
    point_lights: tuple[PointLight, ...]

    def radiance(self, appearances: Sequence[Appearance], changed: Mapping[str, PointLight]) -> Float[Array, "n 3"]:
        """Radiance of each lamp, the mean over its area; intensity of each point light.

        Args:
            appearances: The materials of all parts at their vertices.
            changed: Point lights that are not as the scene has them, by their names.
        """
        rows = [
            self._mean(number, own, appearances[number]) for number, own in zip(self.emitting, self.area, strict=True)
        ]
        rows += [changed.get(each.name, each).intensity for each in self.point_lights]
        return jnp.stack(rows)

    def number(self, part: int) -> int | None:
        """Number of the lamp that a part is; None for none."""
        return self.emitting.index(part) if part in self.emitting else None

    def view(
        self,
        eye: Float[Array, "3"],
        blends: Sequence[Blend | None],
        points: Sequence[Points] | None,
        traced: Sequence[Float[Array, " _"] | None],
    ) -> tuple[Float[Array, "n _ _"], ...]:
        """`LitByLamps.view` of each part."""
        rows = zip(self.part, blends, points or [None] * len(self.part), traced, strict=True)
        return tuple(part.view(eye, blend, place, narrow) for part, blend, place, narrow in rows)

    def combine(self, radiance: Float[Array, "n 3"], view: Sequence[Float[Array, "n _ _"]]) -> Float[Array, "v 3"]:
        """Radiance of the vertices or points of all parts in the light of all lamps.

        Args:
            radiance: Of each lamp.
            view: Of each part, from `LitByLamps.view`.
        """
        return jnp.concatenate([part.combine(radiance, own) for part, own in zip(self.part, view, strict=True)])

    def _mean(self, number: int, area: Array, appearance: Appearance) -> Float[Array, "3"]:
        emitted = appearance.emitted
        return jnp.zeros(3, area.dtype) if emitted is None else area @ emitted / jnp.sum(area)


def make(
    scene: Scene, shadings: Sequence[Shading], systems: Sequence[System], targets: Sequence[Target]
) -> SceneLamps | None:
    """Traces what all parts see of the lamps of a scene; None where there are none.

    Args:
        scene: The scene.
        shadings: What its parts are to systems.
        systems: The systems of the parts, whose tables of lobes are used.
        targets: What casts shadows, and where it is computed.
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
    return SceneLamps(tuple(rows), tuple(emitting), area, scene.point_lights)


def _table(shading: Shading, system: System, target: Target) -> lobe.LobeBrdf:
    """The BRDF of a part in lobes."""
    own = system.system if isinstance(system, bright_texels.BrightTexels) else system
    if isinstance(own, lobe.LobeSystem):
        return own.brdf
    return kept(
        None if target.path is None else pathlib.Path(f"{target.path}_table_{_LOBES}.prt"),
        (shading.brdf, shading.knot, _LOBES),
        lambda: lobe.tabulate(shading.brdf, lobes=_LOBES, knot=shading.knot),
    )


def split(lamp: SceneLamps | None, materials: Any) -> tuple[Any, dict[str, PointLight]]:
    """Materials of parts, and point lights, of a dictionary of both; what is no dictionary is left as it is.

    Raises:
        ValueError: There is no such point light, or it is at another place than that from which it was traced.
    """
    if not isinstance(materials, Mapping):
        return materials, {}
    given = dict(materials)
    changed = {name: given.pop(name) for name, each in list(given.items()) if isinstance(each, PointLight)}
    known = {} if lamp is None else {each.name: each for each in lamp.point_lights}
    for name, each in changed.items():
        if name not in known:
            raise ValueError(f"point lights must be of those of the scene, {list(known)}, got one called {name!r}")
        now, then = each.position, known[name].position
        if isinstance(now, Tracer) or isinstance(then, Tracer):
            continue
        if not np.array_equal(np.asarray(now), np.asarray(then)):
            raise ValueError(
                f"point light {name!r} was traced from {np.asarray(known[name].position).tolist()}, got one at "
                f"{np.asarray(each.position).tolist()}: precompute the scene with it there"
            )
    return given, changed
