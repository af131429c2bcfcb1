"""Lamps of a scene: parts that emit light, and point lights."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt.compile import known
from jaxprt.relit.channels import Appearance, Shading
from jaxprt.relit.groups import Layout, joined_mesh
from jaxprt.relit.recipes import Target, lobe_table
from jaxprt.scene import PointLight, Scene
from jaxprt.scene import origin as origins
from jaxprt.scene.mesh import areas
from jaxprt.systems import axes, lamps
from jaxprt.systems.lamps import LampTransport, LitByLamps
from jaxprt.systems.protocol import System

_LOBES = 12  # number of lobes for a BRDF whose system has no table of lobes


class SceneLamps(eqx.Module):
    """The lamps of a scene, and the transport of their light to all groups.

    Lamps are numbered with emitting parts first, then point lights.

    Attributes:
        group: For each group, the transport of the light of all lamps.
        emitting: Indices of the parts that emit.
        area: For each part that emits, the surface area that each of its vertices represents.
        point_lights: The point lights with their default intensities.
    """

    group: tuple[LitByLamps, ...]
    emitting: tuple[int, ...] = eqx.field(static=True)
    area: tuple[Float[Array | np.ndarray, " _"], ...]
    point_lights: tuple[PointLight, ...]

    def transport(self, layout: Layout) -> LampTransport:
        """The transport to the vertices of all parts, in their order.

        Args:
            layout: Where the vertices of the parts stand in the groups.
        """
        groups = [(layout.vertices(group), lit.transport) for group, lit in enumerate(self.group)]
        order = np.argsort(np.concatenate([vertex for vertex, _ in groups]))

        def column(name: str, axis: int) -> np.ndarray:
            rows = [np.take(np.asarray(getattr(to, name)), np.arange(len(vertex)), axis) for vertex, to in groups]
            return np.take(np.concatenate(rows, axis), order, axis)

        solid, cosine, direction = (column(name, -1) for name in ("solid_angle", "cosine", "direction"))
        arrays = jax.device_put((solid, cosine, direction, column("position", 0), column("frame", 0)))
        return LampTransport(*arrays, lamp=groups[0][1].lamp)

    def radiance(self, appearances: Sequence[Appearance], changed: Mapping[str, PointLight]) -> Float[Array, "n 3"]:
        """Radiance of each lamp: the mean over the area of an emitting part, or the intensity of a point light.

        Args:
            appearances: Materials of all parts at their vertices.
            changed: Point lights with other intensities, by name.
        """
        rows: list[Any] = [
            _mean(area, appearances[part].emitted) for part, area in zip(self.emitting, self.area, strict=True)
        ]
        rows += [changed.get(light.name, light).intensity for light in self.point_lights]
        return jax.device_put(np.stack(rows)) if known(rows) else jnp.stack(rows)

    def names(self, parts: Sequence[str]) -> tuple[str, ...]:
        """Names of the lamps in their order, from the names of all parts."""
        return (*(parts[part] for part in self.emitting), *(light.name for light in self.point_lights))

    def sources(
        self, radiance: Float[Array, "n 3"], origin: origins.Origin
    ) -> tuple[tuple[PointLight, ...], Float[Array | np.ndarray, " n"]]:
        """The point lights relative to an origin, and the power of each lamp.

        Args:
            radiance: Radiance of each lamp.
            origin: The origin.
        """
        lights = tuple(
            dataclasses.replace(light, position=origins.local(f"point light {light.name!r}", light.position, origin))
            for light in self.point_lights
        )
        xp = np if known(radiance, self.area) else jnp
        surface = [np.pi * xp.sum(xp.asarray(area)) for area in self.area]
        return lights, xp.asarray([*surface, *(4 * np.pi for _ in lights)]) * xp.mean(xp.asarray(radiance), -1)


def _mean(area: Any, emitted: Any) -> Any:
    """Mean of emitted radiance over an area."""
    if emitted is None:
        return np.zeros(3, area.dtype)
    xp = np if known(area, emitted) else jnp
    return xp.asarray(area) @ xp.asarray(emitted) / xp.sum(area)


def make(
    scene: Scene,
    shadings: Sequence[Shading],
    layout: Layout,
    systems: Sequence[System],
    targets: Sequence[Target],
    point_lights: tuple[PointLight, ...],
) -> SceneLamps | None:
    """Precomputes the transport from the lamps of a scene to all its parts; None if there are no lamps.

    Args:
        scene: The scene, with its origin at zero.
        shadings: One `Shading` for each part: its mesh, BRDF and channel weights.
        layout: Where the vertices of the parts stand in their groups.
        systems: The systems of the groups. If one has a table of lobes, it is used.
        targets: For each group, what casts shadows, and where and how to compute.
        point_lights: The point lights of the scene, in the coordinates of its file.
    """
    emitting = [part for part, shading in enumerate(shadings) if shading.emitted is not None]
    if not emitting and not scene.point_lights:
        return None
    sources = [*(shadings[part].mesh for part in emitting), *scene.point_lights]
    groups = []
    for members, size, system, target in zip(layout.parts, layout.size, systems, targets, strict=True):
        shading, mesh = shadings[members[0]], joined_mesh([shadings[part] for part in members])
        transport = axes.pad(lamps.precompute(mesh, sources, apart=True, **target.traced("lamps")), size)
        if shading.matte:
            groups.append(LitByLamps(transport, albedo=shading.albedo))
        else:
            groups.append(LitByLamps(transport, lobe_table(shading, _LOBES, system=system)))
    area = tuple(np.asarray(areas(shadings[part].mesh), jnp.result_type(float)) for part in emitting)
    return SceneLamps(tuple(groups), tuple(emitting), area, point_lights)


def split(lamp: SceneLamps | None, materials: Any) -> tuple[Any, dict[str, PointLight]]:
    """Separates a dictionary of materials into materials of parts and point lights. Other values are kept as they are.

    Raises:
        ValueError: There is no point light of the given name, or it moved, turned or got another cone since
            precomputation.
    """
    if not isinstance(materials, Mapping):
        return materials, {}
    changed = {name: value for name, value in materials.items() if isinstance(value, PointLight)}
    of_parts = {name: value for name, value in materials.items() if name not in changed}
    known = {} if lamp is None else {light.name: light for light in lamp.point_lights}
    for name, light in changed.items():
        if name not in known:
            raise ValueError(f"point lights must be among those of the scene, {list(known)}, got one named {name!r}")
        then = known[name]
        if not _same(light.position, then.position):
            raise ValueError(
                f"point light {name!r} was traced from {np.asarray(then.position).tolist()}, got one at "
                f"{np.asarray(light.position).tolist()}: precompute the scene with it there"
            )
        if light.axis is None and then.axis is None:
            continue
        if not _same(light.axis, then.axis) or light.cone != then.cone:
            raise ValueError(
                f"point light {name!r} was traced with the axis and cone {_aim(then)}, got {_aim(light)}: precompute "
                "the scene with these"
            )
    return of_parts, changed


def _same(now: Any, then: Any) -> bool:
    """Whether two values are equal, as far as that is known."""
    if isinstance(now, Tracer) or isinstance(then, Tracer):
        return True
    return (now is None) == (then is None) and np.array_equal(np.asarray(now), np.asarray(then))


def _aim(light: PointLight) -> str:
    return "of all directions" if light.axis is None else f"{np.asarray(light.axis).tolist()}, {light.cone}"
