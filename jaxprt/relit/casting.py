"""Casts reflection rays against the triangles of a scene, whose ray-tracing structures are cached."""

import collections
import threading
import weakref
from functools import cached_property
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxprt.scene import Mesh
from jaxprt.scene.points import Points
from jaxprt.systems.bounces.traced import Rays
from jaxprt.visibility import Occluder, point_starts, start_points
from jaxprt.visibility.hits import first_fronts

_KEPT = 4  # number of scenes that are cached


class Caster:
    """The triangles of a scene, ready for ray casting.

    Args:
        mesh: The mesh of all parts; its regions are the indices of the parts.
    """

    def __init__(self, mesh: Mesh):
        self.mesh, self.occluder = mesh, Occluder(mesh)
        self.face, self.normal = np.asarray(mesh.face), np.asarray(mesh.normal)
        self.part = np.asarray(mesh.region)[self.face[:, 0]]

    @cached_property
    def start(self) -> Float[np.ndarray, "v 3"]:
        """Origins of the rays of each vertex."""
        return start_points(self.mesh, self.occluder)

    def cast(
        self, rays: Rays, first: int, points: Points | None
    ) -> tuple[Int[np.ndarray, "j v"], Float[np.ndarray, "j v 3"], Float[np.ndarray, "v 3"]]:
        """The triangle that each ray hits (-1 for none), barycentric weights of the hit, and origins of the rays.

        Args:
            rays: Rays that start from vertices or points of a part.
            first: Index of the part's first vertex.
            points: The points; None for the vertices.
        """
        way, chance = np.asarray(rays.direction, np.float32), np.asarray(rays.chance)
        if points is None:
            corner = first + np.arange(way.shape[1])[:, None]
            start = self.start[corner[:, 0]]
        else:
            corner = first + np.asarray(points.corner).T
            start = point_starts(self.mesh, Points(jnp.asarray(corner.T), points.weight), self.occluder)
        ray, own = np.nonzero(chance > 0)
        triangle, barycentric = np.full(chance.shape, -1), np.zeros((*chance.shape, 3), np.float32)
        found, weight = first_fronts(self.occluder, self.normal, start[own], np.ascontiguousarray(way[ray, own]))
        # Ignore hits of the ray's own triangle, or of a triangle around its own vertex: the origin may lie below it.
        met = self.face[found]
        itself = np.all(met == corner[own], 1) if points is not None else np.any(met == corner[own], 1)
        triangle[ray, own], barycentric[ray, own] = np.where(itself, -1, found), weight
        return triangle, barycentric, start


_CASTERS: collections.OrderedDict[int, tuple[Any, Caster]] = collections.OrderedDict()
_LOCK = threading.Lock()


def caster(mesh: Mesh) -> Caster:
    """The `Caster` of a mesh. Those of the last few scenes are cached."""
    key = id(mesh.position)
    with _LOCK:
        alive, kept = _CASTERS.get(key, (lambda: None, None))
        if kept is not None and alive() is mesh.position:
            _CASTERS.move_to_end(key)
            return kept
        made = Caster(mesh)
        _CASTERS[key] = weakref.ref(mesh.position), made
        while len(_CASTERS) > _KEPT:
            _CASTERS.popitem(last=False)
        return made
