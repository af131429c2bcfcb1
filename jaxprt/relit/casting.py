"""Casts reflection rays against the triangles of a scene, whose ray-tracing structures are cached."""

import collections
import threading
import weakref
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import ReflectionRays
from jaxprt.visibility import Occluder, picture_rays, point_starts, start_points
from jaxprt.visibility.rays import first_fronts

_CACHED = 4  # number of scenes that are cached


class Caster:
    """The triangles of a scene, ready for ray casting.

    Args:
        mesh: The mesh of all parts; its regions are the indices of the parts.
    """

    def __init__(self, mesh: Mesh):
        self.mesh, self.occluder = mesh, Occluder(mesh)
        self.face, self.normal = np.asarray(mesh.face), np.asarray(mesh.normal)

    @cached_property
    def bend(self) -> Float[np.ndarray, " f"]:
        """Curvature of each triangle: change of the shading normal over distance, root mean square over its edges."""
        position = np.asarray(self.mesh.position)
        turn, length = (
            sum(((column[self.face[:, i]] - column[self.face[:, i - 1]]) ** 2).sum(1) for i in range(3))
            for column in (self.normal, position)
        )
        return np.sqrt(turn / np.maximum(length, np.finfo(np.float32).tiny))

    @cached_property
    def triangles(self) -> tuple[np.ndarray, ...]:
        """The triangles, from `picture_rays.triangles`."""
        return picture_rays.triangles(self.mesh)

    @cached_property
    def start(self) -> Float[np.ndarray, "v 3"]:
        """Origins of the rays of each vertex."""
        return start_points(self.mesh, self.occluder)

    def cast(
        self, rays: ReflectionRays, points: Points, *, at_vertices: bool
    ) -> tuple[Int[np.ndarray, "j v"], Float[np.ndarray, "j v 3"], Float[np.ndarray, "v 3"]]:
        """The triangle that each ray hits, barycentric weights of the hit, and origins of the rays.

        The triangle is -1 for a ray that hits none or is not cast, -2 for one that hits a back or the triangle of its
        point, and -3 for one that hits a triangle around its vertex.

        Args:
            rays: ReflectionRays that start from vertices or points.
            points: The points of the scene.
            at_vertices: Whether each point is the vertex that is its first corner.
        """
        way, chance = np.asarray(rays.direction, np.float32), np.asarray(rays.chance)
        corner = np.asarray(points.corner).T[:, : 1 if at_vertices else 3]
        start = self.start[corner[:, 0]] if at_vertices else point_starts(self.mesh, points)
        ray, point = np.nonzero(chance > 0)
        triangle, barycentric = np.full(chance.shape, -1), np.zeros((*chance.shape, 3), np.float32)
        hit, weight = first_fronts(self.occluder, self.normal, start[point], np.ascontiguousarray(way[ray, point]))
        # A ray enters its point's own triangle where the shading normal leans away from it: nothing is seen below.
        # A vertex may lie below one of its own triangles, and what that hides is not known.
        same = self.face[hit] == corner[point]
        itself = (hit >= 0) & (np.any(same, 1) if at_vertices else np.all(same, 1))
        triangle[ray, point], barycentric[ray, point] = np.where(itself, -3 if at_vertices else -2, hit), weight
        return triangle, barycentric, start

    def blocked(self, rays: ReflectionRays, points: Points) -> Int[np.ndarray, "j v"]:
        """-1 for each ray that hits no triangle or is not cast, -2 for others.

        Args:
            rays: Rays that start from points.
            points: The points of the scene.
        """
        way, chance = np.asarray(rays.direction, np.float32), np.asarray(rays.chance)
        ray, point = np.nonzero(chance > 0)
        result = np.full(chance.shape, -1)
        # Rays of one number and of neighboring points are alike.
        direction, number = np.ascontiguousarray(way[ray, point]), np.arange(len(point))
        start = point_starts(self.mesh, points)
        result[ray, point] -= self.occluder.blocked(start, direction, point, number)
        return result

    def spread(
        self,
        rays: ReflectionRays,
        triangle: Int[np.ndarray, "j v"],
        barycentric: Float[np.ndarray, "j v 3"],
        start: Float[np.ndarray, "v 3"],
    ) -> Float[np.ndarray, "j v"]:
        """Variance of the directions into which what a ray hits reflects the cone that the ray stands for.

        The cone is the ray's share of its lobe. A curved surface spreads it further: over a distance d the cone becomes
        d times its angle wide, and normals turn by that times the curvature.

        Args:
            rays: The rays that were cast.
            triangle: The triangle that each ray hits.
            barycentric: Barycentric weights of the hit.
            start: Origins of the rays.

        Returns:
            The variance along one axis in squared radians, at most 1; without meaning where nothing was hit.
        """
        chance = np.asarray(rays.chance)
        cone = 1 / (np.asarray(rays.concentration) * np.maximum(len(chance) * chance, 1))
        triangle = np.maximum(triangle, 0)
        corner = np.asarray(self.mesh.position)[self.face[triangle]]
        distance = np.linalg.norm(np.einsum("jvk,jvki->jvi", barycentric, corner) - start, axis=-1)
        return np.minimum(cone * (1 + 2 * distance * self.bend[triangle]) ** 2, 1).astype(np.float32)


_CASTERS: collections.OrderedDict[int, tuple[Any, Caster]] = collections.OrderedDict()
_LOCK = threading.Lock()


def caster(mesh: Mesh) -> Caster:
    """The `Caster` of a mesh. Those of the last few scenes are cached."""
    key = id(mesh.position)
    with _LOCK:
        alive, cached = _CASTERS.get(key, (lambda: None, None))
        if cached is not None and alive() is mesh.position:
            _CASTERS.move_to_end(key)
            return cached
        result = Caster(mesh)
        _CASTERS[key] = weakref.ref(mesh.position), result
        while len(_CASTERS) > _CACHED:
            _CASTERS.popitem(last=False)
        return result
