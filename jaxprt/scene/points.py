"""Points on the triangles of a mesh, for evaluation between vertices."""

import dataclasses
import functools
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int, Integer, Num

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.sphere import directions

_ROUNDED = 1e-4  # tolerance of barycentric coordinates


class Points(eqx.Module):
    """Points on the triangles of a mesh, in barycentric coordinates; or, as `VERTICES`, all vertices in their order.

    Attributes:
        corner: Vertex indices of each point's triangle.
        weight: Barycentric coordinates, which sum to 1.
        slope: Change of the barycentric coordinates from one pixel to the next, to the right and down; None for points
            that do not belong to a picture.
        normal: Unit shading normals in world space, where normal maps tilt them; None for those of the vertices,
            interpolated.
        all_vertices: Whether the points are all vertices, to which nothing is interpolated.
    """

    corner: Int[Array | np.ndarray, "k p"]
    weight: Float[Array | np.ndarray, "k p"]
    slope: Float[Array | np.ndarray, "2 k p"] | None = None
    normal: Float[Array | np.ndarray, "3 n"] | None = None
    all_vertices: bool = eqx.field(static=True, default=False)

    def __len__(self) -> int:
        """Number of points that are not all vertices."""
        return self.corner.shape[1]

    def count(self, vertices: int) -> int:
        """Number of points on a mesh with a number of vertices."""
        return vertices if self.all_vertices else len(self)

    def corners(self, vertices: int) -> Int[Array | np.ndarray, "k p"]:
        """The vertices from which each point is interpolated: itself alone if these are all vertices."""
        return np.arange(vertices, dtype=np.int32)[None] if self.all_vertices else self.corner

    def carry(self, attribute: Num[Array | np.ndarray, "..."], *, axis: int = 0) -> Num[Array, "..."]:
        """Interpolates a vertex attribute at the points. The vertices are along `axis`; the result is linear in it."""
        return jnp.asarray(attribute) if self.all_vertices else _carry(self.corner, self.weight, attribute, axis=axis)

    def slopes(self, attribute: Float[Array | np.ndarray, "v c"]) -> Float[Array, "2 p c"]:
        """Change of a vertex attribute from one pixel to the next, to the right and down; zero without `slope`."""
        if self.slope is None:
            return jnp.zeros((2, len(self), attribute.shape[1]), attribute.dtype)
        return jnp.stack([Points(self.corner, slope).carry(attribute) for slope in self.slope])

    def tilted(self, normal: Float[Array | np.ndarray, "p 3"] | None) -> "Points":
        """The same points with other shading normals; with the interpolated ones if `normal` is None."""
        return dataclasses.replace(self, normal=None if normal is None else normal.T)

    def check(self, vertices: int) -> None:
        """Refuses points that refer to missing vertices or lie outside of their triangles; not inside of `jax.jit`."""
        if self.all_vertices:
            return
        shapes = list(np.shape(self.corner)), list(np.shape(self.weight))
        if len(shapes[0]) != 2 or shapes[0] != shapes[1]:
            raise ValueError(f"points must have corners [k, p] and weights [k, p], got {shapes[0]} and {shapes[1]}")
        require.within("the corners of points", self.corner, 0, vertices - 1)
        require.at_least("the weights of points", self.weight, 0.0, slack=_ROUNDED)
        if not isinstance(self.weight, Tracer):
            total = np.sum(np.asarray(self.weight), 0)
            if total.size and not np.all(np.abs(total - 1) <= _ROUNDED):
                worst = int(np.argmax(np.abs(total - 1)))
                raise ValueError(f"the weights of points must sum to 1, got {total[worst]:g} at point {worst}")

    def frame(self, frame: Float[Array | np.ndarray, "v 3 3"]) -> Float[Array, "p 3 3"]:
        """Shading frames at the points: normals are interpolated and normalized, tangents made orthogonal to them.

        Points with normals of their own have these in place of the interpolated ones.

        Args:
            frame: Shading frames of the vertices; rows are tangent, bitangent, normal.
        """
        return jnp.asarray(frame) if self.all_vertices and self.normal is None else _frames(self, frame)


# All vertices of any mesh.
VERTICES = Points(np.zeros((0, 0), np.int32), np.zeros((0, 0), np.float32), all_vertices=True)


@partial(jit, static_argnames="axis")
def _carry(corner: Array, weight: Array, attribute: Array, *, axis: int) -> Array:
    wide = [1] * attribute.ndim
    wide[axis] = corner.shape[1]
    floating = jnp.issubdtype(attribute.dtype, jnp.inexact)
    parts = [
        jnp.take(attribute, corner, axis, mode="clip")
        * (weight.astype(attribute.dtype) if floating else weight).reshape(wide)
        for corner, weight in zip(corner, weight, strict=True)
    ]
    return functools.reduce(jnp.add, parts)


@jit
def _frames(points: Points, frame: Array) -> Array:
    rows = points.carry(frame[:, ::2].reshape(len(frame), 6))
    normal = directions.normalize(rows[:, 3:]) if points.normal is None else points.normal.T
    return directions.frame(normal, rows[:, :3])


def placed(
    position: Float[Array | np.ndarray, "v 3"], frame: Float[Array | np.ndarray, "v 3 3"], points: Points
) -> tuple[Float[Array, "p 3"], Float[Array, "p 3 3"]]:
    """Positions and shading frames of points."""
    return points.carry(position), points.frame(frame)


def on_triangles(
    face: Integer[ArrayLike, "f 3"], triangle: Integer[ArrayLike, " p"], barycentric: Float[ArrayLike, "p 3"]
) -> Points:
    """Makes points from triangle indices and barycentric coordinates, such as those of `jaxprt.image.rasterize`.

    Args:
        face: Triangles of the mesh, `Mesh.face`.
        triangle: Index of each point's triangle.
        barycentric: Barycentric coordinates of each point, which sum to 1.
    """
    if np.shape(barycentric) != (*np.shape(triangle), 3) or np.ndim(triangle) != 1:
        shapes = f"{list(np.shape(triangle))} and {list(np.shape(barycentric))}"
        raise ValueError(f"points must be triangles [p] and weights [p, 3], got {shapes}")
    if not any(isinstance(value, Tracer) for value in (face, triangle, barycentric)):
        face, triangle, barycentric = (np.asarray(value) for value in (face, triangle, barycentric))
        if triangle.size and (triangle.min() < 0 or triangle.max() >= len(face)):
            raise ValueError(f"triangles must be from 0 to {len(face) - 1}, got {triangle.min()} to {triangle.max()}")
        off = np.maximum(-barycentric.min(1, initial=0), np.abs(barycentric.sum(1) - 1))
        if not np.all(off <= _ROUNDED):
            worst = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
            raise ValueError(
                f"weights of points must be at least 0 and sum to 1, got {barycentric[worst]} at point {worst}"
            )
        return Points(jnp.asarray(face[triangle].T), jnp.asarray(np.ascontiguousarray(barycentric.T)))
    return Points(jnp.take(jnp.asarray(face), triangle, 0, mode="clip").T, jnp.asarray(barycentric).T)
