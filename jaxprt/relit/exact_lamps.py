"""Reference light of lamps at points of a surface: the sum over random places on each lamp, with a ray to each place.

Places are drawn anew for each point, evenly over the area of the lamp. Emission is that of the place.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import visibility
from jaxprt.brdf import grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import jit, mapped
from jaxprt.relit.channels import Shading
from jaxprt.scene import Mesh, PointLight, Scene
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import directions
from jaxprt.systems import adaptive
from jaxprt.visibility import Occluder

PLACES = 256  # on each surface, for each point
_BLOCK = 64  # points whose rays are cast together
_GOLDEN = (5**0.5 - 1) / 2
_LEAST = 1e-30  # smallest distance
_NEAR = 1e-3  # a hit within this share of the distance to a place is the lamp itself


class Receivers(NamedTuple):
    """Points that lamps light.

    Attributes:
        position: Positions.
        start: Origins of their rays.
        frame: Shading frames; rows are tangent, bitangent, normal.
        above: Normals of the smooth surface, below whose horizon no light arrives.
    """

    position: Float[np.ndarray, "p 3"]
    start: Float[np.ndarray, "p 3"]
    frame: Float[np.ndarray, "p 3 3"]
    above: Float[np.ndarray, "p 3"]


class EmittingSurface(NamedTuple):
    """Triangles that emit, on the side to which their normals point.

    Attributes:
        corner: Positions of the corners.
        across: Unit normals.
        emitted: Radiance at the corners.
        total: Area of the triangles up to each one.
    """

    corner: Float[np.ndarray, "f 3 3"]
    across: Float[np.ndarray, "f 3"]
    emitted: Float[np.ndarray, "f 3 c"]
    total: Float[np.ndarray, " f"]

    @classmethod
    def of(cls, mesh: Mesh, emitted: Float[np.ndarray, "v c"]) -> "EmittingSurface":
        """The triangles of a mesh that have an area."""
        face = np.asarray(mesh.face)
        corner, normal = (np.asarray(column, np.float64)[face] for column in (mesh.position, mesh.normal))
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        across *= np.where(np.sum(across * normal.sum(1), 1) < 0, -1, 1)[:, None]
        size = np.linalg.norm(across, axis=1)
        real = size > 0
        unit = across[real] / size[real, None]
        return cls(corner[real], unit, np.asarray(emitted, np.float64)[face][real], np.cumsum(size[real] / 2))

    def places(
        self, random: np.random.Generator, points: int
    ) -> tuple[Float[np.ndarray, "p k 3"], Float[np.ndarray, "p k 3"], Float[np.ndarray, "p k c"]]:
        """Places for each point; normals there; and radiance times the area of each place."""
        # One coordinate runs through the area of all triangles, the other through a lattice that is shifted at random.
        along = (np.arange(PLACES) + random.random((points, PLACES))) / PLACES * self.total[-1]
        triangle = np.minimum(np.searchsorted(self.total, along), len(self.total) - 1)
        before = np.concatenate([[0.0], self.total[:-1]])[triangle]
        root = np.sqrt(np.clip((along - before) / (self.total[triangle] - before), 0, 1))
        turn = np.mod(random.random((points, 1)) + _GOLDEN * np.arange(PLACES), 1)
        weight = np.stack([1 - root, root * (1 - turn), root * turn], -1)
        place, glow = (np.einsum("pkj,pkjc->pkc", weight, rows[triangle]) for rows in (self.corner, self.emitted))
        return place, self.across[triangle], glow * (self.total[-1] / PLACES)


class Lamps(NamedTuple):
    """The lamps of a scene: parts that emit, and point lights.

    Attributes:
        lamp: The lamps, in the coordinates of the occluder.
        occluder: What casts shadows; None without lamps.
    """

    lamp: list[EmittingSurface | PointLight]
    occluder: Occluder | None

    @classmethod
    def of(cls, scene: Scene, shadings: Sequence[Shading]) -> "Lamps":
        """The lamps of a scene whose origin is zero."""
        glowing = [shading for shading in shadings if shading.emitted is not None]
        surfaces = [EmittingSurface.of(shading.mesh, np.asarray(shading.emitted)) for shading in glowing]
        lamp = [*(surface for surface in surfaces if len(surface.total)), *scene.point_lights]
        return cls(lamp, Occluder(scene.mesh) if lamp else None)

    def at_points(
        self, mesh: Mesh, brdf: Callable, points: Points, eye: Float[Array, "3"]
    ) -> Float[np.ndarray, "p c"] | float:
        """What points on triangles of a mesh reflect of the light of all lamps; 0 without lamps.

        Args:
            mesh: The mesh.
            brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions, or `PerVertex` with one for each point.
            points: The points.
            eye: Position of the viewer.
        """
        if self.occluder is None:
            return 0.0
        frame = directions.frame(mesh.normal, mesh.tangent)
        position, axes = (np.asarray(column) for column in placed(mesh.position, frame, points))
        smooth = points if points.normal is None else points.tilted(None)
        above = np.asarray(smooth.frame(frame))[:, 2]
        receivers = Receivers(position, visibility.point_starts(mesh, points), axes, above)
        return self._reflect(self.occluder, receivers, brdf, eye)

    def at_vertices(
        self, mesh: Mesh, brdf: Callable, vertex: Int[np.ndarray, " p"], eye: Float[Array, "3"]
    ) -> Float[np.ndarray, "p c"] | float:
        """The same at some vertices of a mesh; `brdf` is that of these vertices."""
        if self.occluder is None:
            return 0.0
        frame = np.asarray(directions.frame(mesh.normal, mesh.tangent))[vertex]
        start = visibility.start_points(mesh, self.occluder)[vertex]
        receivers = Receivers(np.asarray(mesh.position)[vertex], start, frame, frame[:, 2])
        return self._reflect(self.occluder, receivers, brdf, eye)

    def _reflect(
        self, occluder: Occluder, receivers: Receivers, brdf: Callable, eye: Array
    ) -> Float[np.ndarray, "p c"]:
        random, rows, count = np.random.default_rng(2), [], len(receivers.position)
        for first in range(0, count, _BLOCK):
            index = np.resize(np.arange(first, min(first + _BLOCK, count)), _BLOCK)
            block = Receivers(*(column[index] for column in receivers))
            arriving = [_arriving(block, lamp, occluder, random) for lamp in self.lamp]
            wi, light = (np.concatenate(parts, 1) for parts in zip(*arriving, strict=True))
            model = PerVertex(brdf.of(jnp.asarray(index))) if isinstance(brdf, PerVertex) else grid.as_argument(brdf)
            rows.append(np.asarray(_reflect(model, *map(jnp.asarray, (block.position, block.frame, wi, light)), eye)))
        return np.concatenate(rows)[:count]


def _arriving(
    points: Receivers, lamp: EmittingSurface | PointLight, occluder: Occluder, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Directions to places on a lamp [p k 3], and radiance times solid angle that arrives from them [p k c]."""
    if isinstance(lamp, PointLight):
        way = (np.asarray(lamp.position, np.float64) - points.start)[:, None]
        distance = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), _LEAST)
        wi = way / distance
        light = lamp.share(-wi)[..., None] * np.asarray(lamp.intensity, np.float64)
    else:
        place, normal, light = lamp.places(random, len(points.start))
        way = place - points.start[:, None]
        distance = np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), _LEAST)
        wi = way / distance
        light = light * np.maximum(-np.sum(wi * normal, -1, keepdims=True), 0)
    light = light / distance**2
    lit = (light.max(-1) > 0) & (np.einsum("pki,pi->pk", wi, points.above) > 0)
    point, number = np.nonzero(lit)
    triangle, hit, _ = occluder.hit(points.start[point].astype(np.float32), wi[point, number].astype(np.float32))
    seen = np.zeros(lit.shape)
    seen[point, number] = (triangle < 0) | (hit > (1 - _NEAR) * distance[point, number, 0])
    return wi.astype(points.frame.dtype), (light * seen[..., None]).astype(points.frame.dtype)


@jit
def _reflect(
    brdf: Callable,
    position: Float[Array, "p 3"],
    frame: Float[Array, "p 3 3"],
    wi: Float[Array, "p k 3"],
    light: Float[Array, "p k c"],
    eye: Float[Array, "3"],
) -> Float[Array, "p c"]:
    """Sum over directions of BRDF x cosine x light."""

    def one(argument):
        axes, wo, way, arriving, number = argument
        local = directions.to_local(axes, way)
        value = adaptive.value(brdf.of(number) if isinstance(brdf, PerVertex) else brdf, local, wo)
        return jnp.sum(value * arriving * jnp.maximum(local[:, 2:], 0), 0)

    wo = directions.view(frame, position, eye)
    return mapped(one, (frame, wo, wi, light, jnp.arange(len(wo))))
