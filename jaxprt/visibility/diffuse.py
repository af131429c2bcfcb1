"""Radiance that a white diffuse surface reflects under distant light, at any of its points."""

from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from jaxprt.scene import subdivision
from jaxprt.scene.light_samples import LightSamples
from jaxprt.scene.mesh import Mesh
from jaxprt.visibility.occluder import Occluder, offsets
from jaxprt.visibility.starts import inside, start_points, start_points_and_buried

_RAYS = 1 << 17  # rays per call, so that they fit in a core's cache


class DiffuseTracer:
    """Traces shadow rays from points of a surface while the surface is being subdivided.

    Args:
        mesh: The surface, before subdivision.
        occluder: Geometry that casts shadows. It may contain some or all triangles of the surface.
        samples: Directions and weights that sample the lights.
        pool: Threads that trace the rays.

    Attributes:
        offset: Distance of ray origins from each triangle of the surface.
        casts: Which triangles of the surface are in the occluder.
        double: Which triangles of the surface have the same corners as another triangle: the two sides of a sheet.
    """

    offset: Float32[np.ndarray, " f"]
    casts: Bool[np.ndarray, " f"]
    double: Bool[np.ndarray, " f"]

    def __init__(self, mesh: Mesh, occluder: Mesh, samples: LightSamples, pool: ThreadPoolExecutor):
        self._samples, self._pool = samples, pool
        # NumPy arrays, so that new shapes do not cause compilation.
        mesh, occluder = jax.tree.map(np.asarray, (mesh, occluder))
        self._mesh, self._rays = mesh, Occluder(occluder)
        self.offset = offsets(np.asarray(mesh.position), np.asarray(mesh.face))
        count = len(mesh.face)
        corner = np.concatenate([mesh.face, occluder.face + len(mesh.position)])
        place = subdivision.places(np.concatenate([mesh.position, occluder.position]))
        _, alike = np.unique(np.sort(place[corner], 1), axis=0, return_inverse=True)
        of_mesh, other = np.split(alike.ravel(), [count])
        self.casts = np.isin(of_mesh, other)
        self.double = (
            np.maximum(*(np.bincount(identity, minlength=len(corner))[of_mesh] for identity in (of_mesh, other))) > 1
        )
        self._other = _mesh(np.asarray(occluder.position), np.asarray(occluder.face)[~np.isin(other, of_mesh)])

    def at_vertices(self, vertex: Int[np.ndarray, " n"] | None = None) -> Float32[np.ndarray, "v l c"]:
        """Reflected radiance at some or all vertices of the surface, before subdivision; 0 at others."""
        result = np.zeros((len(self._mesh.position), *self._samples.weight.shape[1:]), np.float32)
        vertex = np.arange(len(result)) if vertex is None else vertex
        start = start_points(self._mesh, self._rays)
        result[vertex] = self._light(start[vertex], np.asarray(self._mesh.normal, np.float64)[vertex])
        return result

    def at(
        self,
        position: Float[np.ndarray, "v 3"],
        normal: Float[np.ndarray, "v 3"],
        around: Int[np.ndarray, "n 3"],
        offset: Float32[np.ndarray, " n"],
        casting: Int[np.ndarray, "m 3"],
        vertex: Int[np.ndarray, " p"],
    ) -> tuple[Float32[np.ndarray, "p l c"], Bool[np.ndarray, " p"]]:
        """Reflected radiance at some vertices of the subdivided surface, and whether they are inside of solids.

        Args:
            position: Positions of all vertices.
            normal: Normals of all vertices, of any length.
            around: Vertex indices of all triangles around the vertices `vertex`.
            offset: Distance of ray origins from each of these triangles, that of the triangle which it is part of.
            casting: Vertex indices of the subdivided triangles that belong to the occluder.
            vertex: Indices of the vertices at which radiance is wanted.

        Returns:
            Radiance for each light and color of the samples, and a mask of vertices inside of other solids.
        """
        if not vertex.size:
            return np.zeros((0, *self._samples.weight.shape[1:]), np.float32), np.zeros(0, bool)
        used, index = np.unique(np.concatenate([around.ravel(), vertex]), return_inverse=True)
        mesh = _mesh(position[used], index[: around.size].reshape(-1, 3), normal[used])
        other = self._other
        place, face = (
            np.concatenate(pair) for pair in ((other.position, position), (other.face, casting + len(other.position)))
        )
        rows = index[around.size :]
        start, buried = start_points_and_buried(mesh, Occluder(_mesh(place, face)), offset=offset, wanted=rows)
        return self._light(start[rows], normal[vertex]), buried[rows]

    def at_points(
        self, start: Float[np.ndarray, "p 3"], normal: Float[np.ndarray, "p 3"], out: Float[np.ndarray, "p 3"]
    ) -> tuple[Float32[np.ndarray, "p l c"], Bool[np.ndarray, " p"]]:
        """Reflected radiance at given ray origins, and whether they are inside of solids.

        Args:
            start: Ray origins, off the surface.
            normal: Normals of the surface, of any length.
            out: Unit vectors off the surface.
        """
        start = start.astype(np.float32)
        return self._light(start, normal), inside(self._rays, start, out.astype(np.float32))

    def _light(self, start: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Radiance that surfaces with the given normals reflect at the given ray origins."""
        direction, weight = self._samples
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        upright = (normal / np.where(length > 0, length, 1)).astype(np.float32)
        result = np.empty((len(start), *weight.shape[1:]), np.float32)
        step = max(1, _RAYS // len(weight))

        def fill(part: slice) -> None:
            cosine = np.maximum(upright[part] @ direction.T, 0)
            point, way = np.nonzero(cosine)
            blocked = self._rays.blocked(start[part], direction, point, way)
            cosine[point[blocked], way[blocked]] = 0
            result[part] = (cosine @ weight.reshape(len(weight), -1)).reshape(-1, *weight.shape[1:])

        list(self._pool.map(fill, (slice(first, first + step) for first in range(0, len(start), step))))
        return result


def _mesh(position: np.ndarray, face: np.ndarray, normal: np.ndarray | None = None) -> Mesh:
    """A mesh in NumPy arrays, so that new shapes do not cause compilation. Fields that rays do not need are zero."""
    upright = np.zeros_like(position) if normal is None else normal
    fields = position.astype(np.float32), face.astype(np.int32), upright.astype(np.float32)
    place, corner, upright = (jax.device_put(value) for value in fields)
    region = jax.device_put(np.zeros(len(position), np.int32))
    return jax.tree.map(np.asarray, Mesh(place, corner, upright, upright, region))
