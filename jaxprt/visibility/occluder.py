"""Ray casting against triangles, by Embree. All rays of the package are traced here."""

import threading
from functools import cached_property
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float32, Integer

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.subdivision import orientations

# Offset of ray origins from a triangle, in spacings of float32 at its largest coordinate. With four (rays from
# vertices) or eight (from points inside of slivers), none of 60,000 rays hits the random triangle that it starts from,
# down to a cosine of 1e-4.
_SPACINGS = 8
_SMALLEST, _LARGEST = 1e-12, 1e13  # range of diagonals for which products of three lengths stay within float32


class Occluder:
    """Triangles that cast shadows, as an Embree scene.

    Args:
        mesh: The triangles. Degenerate ones cast no shadow. Those with an opacity stop as much light as it says.

    Attributes:
        position: Positions of the vertices.
        face: Vertex indices of each triangle.
        opacity: Opacity of the vertices; None if all are opaque.
        diagonal: Diagonal of the bounding box of all triangles.
        offset: Distance from each triangle at which rays start, from `offsets`.

    Raises:
        ValueError: The mesh has no triangles, positions, normals or tangents are not finite, a face refers to a
            missing vertex, or the mesh is so large or small that float32 would lose triangles.
    """

    def __init__(self, mesh: Mesh):
        check(mesh, "occluder")
        self.position = np.asarray(mesh.position, np.float32)
        self.face = np.asarray(mesh.face, np.int32)
        self.opacity = mesh.opacity
        used = self.position[self.face.ravel()]
        low, high = used.min(0), used.max(0)
        self.diagonal = float(np.linalg.norm(high.astype(np.float64) - low)) or 1.0
        if not _SMALLEST <= self.diagonal <= _LARGEST:
            raise ValueError(
                f"the bounding box of an occluder must have a diagonal of {_SMALLEST:g} to {_LARGEST:g} units, "
                f"got {self.diagonal:.3g}: "
                "scale it"
            )
        self.offset = offsets(self.position, self.face)
        self._building = threading.Lock()

    @cached_property
    def _single(self) -> EmbreeScene:
        """The Embree scene for single rays."""
        scene = EmbreeScene()
        TriangleMesh(scene, np.ascontiguousarray(self.position), np.ascontiguousarray(self.face))
        return scene

    @cached_property
    def _packed(self):
        return self._packets()

    @cached_property
    def translucent(self):
        """The triangles that are not opaque alone, as `jaxprt.visibility.packets.Packets`."""
        return self._packets(clear_only=True)

    def _packets(self, **options: bool):
        from jaxprt.visibility.packets import Packets  # numba takes half a second to import

        return Packets(self.position, self.face, opacity=self.opacity, **options)

    def packets(self) -> Any:
        """The Embree scene for packets of rays, as `jaxprt.visibility.packets.Packets`."""
        with self._building:
            return self._packed

    def _run(self, origin: np.ndarray, direction: np.ndarray, **options: Any) -> Any:
        """Traces rays one at a time."""
        with self._building:
            single = self._single
        return single.run(origin, direction, **options)

    @property
    def blends(self) -> bool:
        """Whether some surfaces stop a share of the light, so that `passed` says more than `blocked`."""
        return self.opacity is not None and self.opacity.blends

    @cached_property
    def _twin(self) -> tuple[np.ndarray, np.ndarray]:
        """For each face, the coincident one of opposite orientation, or itself; and its corners in the face's order."""
        # Which of the two coincident faces a ray hits is arbitrary.
        alike, odd, order = orientations(self.position, self.face)
        corner = np.take_along_axis(self.face, order, 1)
        example = np.full((2, len(self.face)), -1)
        example[odd, alike] = np.arange(len(self.face))
        other = example[1 - odd, alike]
        twin = np.where((other >= 0)[:, None], corner[other], corner)
        result = np.empty_like(self.face)
        np.put_along_axis(result, order, twin, 1)
        return np.where(other >= 0, other, np.arange(len(other))), result

    def facing(
        self, triangle: Integer[np.ndarray, " n"], direction: Float32[np.ndarray, "n 3"]
    ) -> Integer[np.ndarray, "n 3"]:
        """Corners of the triangles that rays hit. Of two coincident faces it takes the one that faces the ray.

        Args:
            triangle: Indices of the triangles.
            direction: Directions of the rays.
        """
        away = self.hits_back(triangle, direction)
        return np.where(away[:, None], self._twin[1][triangle], self.face[triangle])

    def hits_back(
        self, triangle: Integer[np.ndarray, " n"], direction: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether rays hit triangles from behind, by the order of their corners."""
        a, b, c = (self.position[self.face[triangle, corner]] for corner in range(3))
        return np.sum(np.cross(b - a, c - a) * direction, -1) > 0

    def facing_hit(self, origin: Float32[np.ndarray, "m 3"], direction: Float32[np.ndarray, "m 3"]):
        """The result of `hit`. Of two coincident faces it takes the one that faces the ray."""
        triangle, distance, weight = self.hit(origin, direction)
        hit = np.flatnonzero(triangle >= 0)
        away = hit[self.hits_back(triangle[hit], direction[hit])]
        if away.size:
            partner, corner = (table[triangle[away]] for table in self._twin)
            same = self.face[partner][:, :, None] == corner[:, None]
            triangle[away], weight[away] = partner, np.einsum("nij,nj->ni", same, weight[away])
        return triangle, distance, weight

    def blocked(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray hits a triangle. Releases the global interpreter lock.

        It is fastest if every sixteen consecutive rays have nearby origins and similar directions. Translucent surfaces
        stop a ray with the probability that its light is stopped, by a hash of its origin and direction.

        Args:
            origin: Origins in world units.
            direction: Unit directions.
            point: Index of each ray's origin in `origin`.
            way: Index of each ray's direction in `direction`.
        """
        from jaxprt.visibility import embree

        if self.opacity is None and embree.library() is None:
            return self._run(origin.take(point, axis=0), direction.take(way, axis=0), query="OCCLUDED") == 0
        return self.packets().blocked(origin, direction, point, way)

    def passed(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Float32[np.ndarray, " n"]:
        """Share of light that passes along each ray, for an occluder that `blends`. `blocked` has the arguments."""
        return self.packets().passed(origin, direction, point, way)

    def hit(self, origin: Float32[np.ndarray, "m 3"], direction: Float32[np.ndarray, "m 3"], *, solid: bool = False):
        """Index of the first triangle on each ray (-1 for none), its distance, and the barycentric coordinates.

        Args:
            origin: Origins of the rays.
            direction: Their unit directions.
            solid: Whether surfaces with an opacity count as opaque. Otherwise rays pass holes, and translucent surfaces
                stop a ray with the probability of their opacity, by a hash of the ray.
        """
        if self.opacity is not None and not solid:
            return self.packets().hit(np.ascontiguousarray(origin), np.ascontiguousarray(direction))
        hit = self._run(origin, direction, query="INTERSECT", output=True)
        u, v = hit["u"], hit["v"]
        return hit["primID"].astype(np.int64), hit["tfar"], np.stack([1 - u - v, u, v], -1)


def offsets(position: Float32[np.ndarray, "v 3"], face: Integer[np.ndarray, "f k"]) -> Float32[np.ndarray, " f"]:
    """Distance from each triangle at which rays start, so that rounding does not make them hit the triangle.

    Positions and intersections are rounded in proportion to the coordinates of the triangle's corners, whatever else is
    in the scene.

    Args:
        position: Positions of the vertices in world units.
        face: Vertex indices of each triangle, or of each group of other size.
    """
    largest = np.abs(position).max(1)[face].max(1)
    return (_SPACINGS * np.spacing(largest)).astype(np.float32)


def check(mesh: Mesh, name: str) -> None:
    """Refuses meshes for which Embree would hang or return wrong results, and normals or tangents without a frame.

    Raises:
        ValueError: The mesh has no faces, a face refers to a missing vertex, or positions, normals or tangents are not
            finite.
    """
    if not mesh.face.size:
        raise ValueError(f"the {name} must have faces, got none")
    for field in ("position", "normal", "tangent"):
        broken = np.flatnonzero(~np.isfinite(np.asarray(getattr(mesh, field))).all(1))
        if broken.size:
            value = np.asarray(getattr(mesh, field))[broken[0]]
            raise ValueError(
                f"the {name}'s {field}s must be finite, got {broken.size} that are not, first at {broken[0]}: {value}"
            )
    face = np.asarray(mesh.face)
    low, high = int(face.min()), int(face.max())
    if low < 0 or high >= len(mesh.position):
        raise ValueError(
            f"faces of the {name} must refer to vertices 0 to {len(mesh.position) - 1}, got {low} to {high}"
        )
