"""Meshes as fine as their shadows: edges are halved where the light in their middle is not the mean of their ends.

Light here is what a white diffuse surface reflects. Rays are traced in the middle of each edge, and at points inside of
triangles that are large enough to hide whole shadows. A triangle's part in the error of a picture is its area times its
mean squared difference; triangles with the largest parts are divided first.
"""

import bisect
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import tqdm
from jaxtyping import Bool, Float, Float32, Int
from threadpoolctl import threadpool_limits

from jaxprt.scene import light_samples, subdivision
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.subdivision import Division, Edges
from jaxprt.visibility import blocks
from jaxprt.visibility.diffuse import DiffuseTracer

_DIRECTIONS = 1024  # to each light: penumbrae have steps of a thousandth of its power
_SIZE, _DEGREE = 16, 6  # of light from unknown directions: texels along an edge, and the degree of its harmonics
_FACES = 1 << 13  # triangles whose errors are summed at a time
_HIDDEN = 4  # points inside of triangles for each shadow that alone makes the error
_FINEST = 0.01  # There are no more points inside of triangles than for this error.
_SHARE = 0.7  # of the squared error whose triangles are divided before rays are traced again
_TOGETHER = 0.5  # Of a triangle, edges are cut whose squared difference is at least this share of the largest.
_SHORTEST = 8  # length of the shortest edge that is cut, over the distance from the surface at which rays start
_ROUNDING = 1e-5  # relative difference that rounding makes


def refine(
    mesh: Mesh,
    *,
    error: float = 0.02,
    vertices: int = 100_000,
    environments: Sequence[Environment] | None = None,
    occluder: Mesh | None = None,
    progress: bool = True,
) -> Mesh:
    """Divides the triangles of a mesh where its shadows are finer than its vertices.

    Radiance is computed at vertices and interpolated between them. Rays to the middle of each edge tell where that is
    wrong, and edges are halved there. The surface does not change: no gaps open, also where vertices are split at a
    seam, and images lie on it as before.

    Args:
        mesh: The mesh.
        error: The largest relative L2 error that interpolation may leave in the radiance of the surface, were it white
            and diffuse: the root of the mean squared error over the surface's area, over the root of the mean squared
            radiance. It is estimated from the points where rays were traced. Glossy surfaces need finer meshes.
            With 0 the mesh is divided until it has as many vertices as allowed.
        vertices: How many vertices the mesh may have afterwards. Where these are too few for the error, the largest
            errors are removed first, and a warning tells what is left. A mesh that has more already is not divided.
        environments: Lights under which the error must hold. If None, the mean over lights of natural spectrum from
            all directions. The shadows of a sun need the light that the sun is in.
        occluder: What casts shadows; the mesh itself if None.
        progress: Whether to show a progress bar.

    Returns:
        The mesh with more vertices; those that it had come first.

    Raises:
        TypeError: The environments are no list of lights.
        ValueError: The error is negative or not finite, vertices are fewer than 1, there are no environments or one
            is a batch, or the mesh or the occluder is none that `Occluder` takes.

    Reference: Křivánek, Pattanaik, Žára 2004, "Adaptive mesh subdivision for precomputed radiance transfer", who
    compare the ends of each edge instead.
    """
    options = {"error": error, "vertices": vertices, "environments": environments, "progress": progress}
    return subdivision.subdivide(mesh, divisions(mesh, mesh if occluder is None else occluder, **options))


def divisions(
    mesh: Mesh,
    occluder: Mesh,
    *,
    error: float,
    vertices: int,
    environments: Sequence[Environment] | None,
    progress: bool,
) -> list[Division]:
    """The divisions of triangles, one after another, that `refine` carries out: see there."""
    if not 0 <= error < np.inf:
        raise ValueError(f"error must be at least 0 and finite, got {error}")
    if vertices < 1:
        raise ValueError(f"vertices must be at least 1, got {vertices}")
    if environments is None:
        samples = light_samples.natural(size=_SIZE, degree=_DEGREE)
    else:
        samples = light_samples.importance(environments, count=_DIRECTIONS)
    # A shadow on a share of error^2 of the area makes the whole error.
    points = round(_HIDDEN * min(max(error, _FINEST) ** -2, vertices))
    result: list[Division] = []
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(blocks.cores()) as pool,
        tqdm.tqdm(desc="refine", unit="vertex", unit_scale=True, disable=not progress) as bar,
    ):
        surface = _Surface(mesh, DiffuseTracer(mesh, occluder, samples, pool), points)
        while True:
            count, squares = len(surface.position), surface.squares()
            left = float(squares.sum(0).max()) ** 0.5
            bar.update(count - bar.n)
            bar.set_postfix_str(f"{100 * left:.2g} % error")
            if left <= error:
                return result
            edges = Edges(surface.position, surface.face)
            marked = _marked(surface, edges, squares, error, vertices - count)
            if not marked.any():
                break
            result.append(edges.divide(marked))
            surface.divide(result[-1])
    if error > 0:
        warnings.warn(
            f"{count} vertices leave an error of {100 * left:.2g} % by interpolation, above the {100 * error:.2g} % "
            f"asked for; at most {vertices} were allowed",
            stacklevel=3,
        )
    return result


class _Surface:
    """Triangles with the light at their vertices, in the middles of their edges, and at points inside of large ones.

    Attributes:
        position: Positions of the vertices.
        normal: Their normals, of any length.
        face: Vertices of each triangle.
        light: Light at the vertices.
        error: Mean over each triangle of the squared error of interpolation, for each light.
        shortest: Length of the shortest edge that is cut.
    """

    def __init__(self, mesh: Mesh, tracer: DiffuseTracer, points: int):
        self.position, self.normal = np.asarray(mesh.position), np.asarray(mesh.normal, np.float64)
        self.face = np.asarray(mesh.face, np.int64)
        self.shortest = _SHORTEST * tracer.nudge
        self._tracer, self._casts = tracer, tracer.casts
        self.light = tracer.at_vertices()
        self._key = np.zeros(0, np.int64)  # of the edges whose middles are known, in ascending order
        self._middle = self.light[:0]
        area = self._area()
        share = points * area / max(area.sum(), np.finfo(np.float64).tiny)
        # None on sheets, where only vertices that triangles share tell the two sides apart.
        self._points = subdivision.scatter(np.where(tracer.double, 0, share).astype(np.int64))
        self._at_points = self._traced_points()
        self.error = np.zeros((len(self.face), self.light.shape[1]))
        self._measure(np.arange(len(self.face)))

    def scale(self) -> Float[np.ndarray, " l"]:
        """Integral over the surface of the squared light."""
        return self._area() @ self._square()[self.face].mean(1)

    def squares(self) -> Float[np.ndarray, "f l"]:
        """What each triangle adds to the squared relative error of the surface."""
        scale = self.scale()
        return self._area()[:, None] * self.error / np.where(scale > 0, scale, 1)

    def differences(self, face: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 l c"]:
        """Light in the middles of edges beyond the mean of their ends."""
        ends = _ends(face)
        return self._middle[np.searchsorted(self._key, _key(ends))] - self.light[ends].mean(2)

    def divide(self, division: Division) -> None:
        """Divides triangles, and traces light on the smaller ones."""
        self.light = np.concatenate([self.light, self._middle[np.searchsorted(self._key, _key(division.parent))]])
        self.normal = np.concatenate([self.normal, subdivision.middle_normal(self.normal, division.parent)])
        self.position = np.concatenate([self.position, subdivision.middle(self.position, division.parent)])
        self._points = subdivision.relocate(self._points, self.face, division)
        self.face = division.face
        self.error, self._casts = self.error[division.origin], self._casts[division.origin]
        self._measure(np.flatnonzero((np.bincount(division.origin) > 1)[division.origin]))

    def _square(self) -> Float[np.ndarray, " v l"]:
        return np.sum(np.square(self.light, dtype=np.float64), -1)

    def _area(self) -> Float[np.ndarray, " f"]:
        a, b, c = np.swapaxes(self.position[self.face].astype(np.float64), 0, 1)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def _measure(self, changed: Int[np.ndarray, " n"]) -> None:
        """Finds the error of some triangles, and traces light where it is not known."""
        self._trace_middles(changed)
        for first in range(0, len(changed), _FACES):
            own = changed[first : first + _FACES]
            apart = self.differences(self.face[own]).astype(np.float64)
            square, both = np.sum(apart**2, (1, 3)), np.sum(np.sum(apart, 1) ** 2, -1)
            # The mean over a triangle of the square of a quadratic function that is zero at the corners.
            self.error[own] = 4 / 45 * (square + both)
        # Where there are points, the middles count as three of them.
        again = np.zeros(len(self.face), bool)
        again[changed] = True
        here = again[self._points.triangle]
        triangle, weight = self._points.triangle[here], self._points.weight[here]
        apart = self._at_points[here] - np.einsum("pk,pklc->plc", weight, self.light[self.face[triangle]])
        total = 3 * self.error
        np.add.at(total, triangle, np.sum(apart**2, -1))
        error = (total / (3 + np.bincount(triangle, minlength=len(total)))[:, None])[changed]
        level = self._square()[self.face[changed]].mean(1)
        self.error[changed] = np.where(error > _ROUNDING**2 * level, error, 0)

    def _trace_middles(self, changed: Int[np.ndarray, " n"]) -> None:
        """Traces light in the middles of some triangles' edges where it is not known."""
        edge, middle = np.unique(_key(_ends(self.face[changed])), return_inverse=True)
        corner = np.concatenate([self.face[changed], len(self.position) + middle.reshape(-1, 3)], 1)
        smaller = corner[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]].reshape(-1, 3)
        parent = np.stack(np.divmod(edge, 1 << 32), -1)
        position = np.concatenate([self.position, subdivision.middle(self.position, parent)])
        normal = np.concatenate([self.normal, subdivision.middle_normal(self.normal, parent)])
        rest = self._casts.copy()
        rest[changed] = False
        casting = np.concatenate([self.face[rest], smaller[np.repeat(self._casts[changed], 4)]])
        new = np.flatnonzero(~np.isin(edge, self._key))
        light = self._tracer.at(position, normal, smaller, casting, len(self.position) + new)
        key, light = np.concatenate([self._key, edge[new]]), np.concatenate([self._middle, light])
        # Edges that have been cut are forgotten.
        keep = np.flatnonzero(np.isin(key, _key(_ends(self.face))))
        order = keep[np.argsort(key[keep])]
        self._key, self._middle = key[order], light[order]

    def _traced_points(self) -> Float32[np.ndarray, "p l c"]:
        """Light at the points inside of triangles."""
        triangle, weight = self._points
        count, corner = len(self.position), self.face[triangle]
        place, normal = (
            np.einsum("pk,pkc->pc", weight, np.asarray(each, np.float64)[corner])
            for each in (self.position, self.normal)
        )
        # Each is a vertex of a small triangle, so that its rays start as those of vertices do.
        small = (0.5 / np.sqrt(1 + np.bincount(triangle, minlength=1)))[triangle, None, None]
        beside = place[:, None] + small * (self.position[corner][:, :2] - place[:, None])
        position = np.concatenate([place, beside.reshape(-1, 3)]).astype(self.position.dtype)
        around = np.arange(len(place))
        around = np.stack([around, len(place) + 2 * around, len(place) + 2 * around + 1], -1)
        casting = np.concatenate([around[self._casts[triangle]] + count, self.face[self._casts]])
        position = np.concatenate([self.position, position])
        normal = np.concatenate([self.normal, normal, np.repeat(normal, 2, 0)])
        return self._tracer.at(position, normal, around + count, casting, count + np.arange(len(place)))


def _marked(surface: _Surface, edges: Edges, squares: np.ndarray, error: float, room: int) -> Bool[np.ndarray, " e"]:
    """The edges to cut next: those of the triangles with the largest errors, as many as there is room for."""
    total = squares.sum(0)
    unmet = total > error**2
    priority = np.where(edges.length[edges.longest] > surface.shortest, squares[:, unmet].max(1), 0)
    # At the edge of a shadow, halving the edges removes half of the squared error.
    wanted = min(_SHARE * total.max(), 2 * (total.max() - error**2))
    order = np.argsort(-priority, kind="stable")[: np.count_nonzero(priority)]
    order = order[: 1 + np.searchsorted(np.cumsum(priority[order]), wanted)]
    scale = surface.scale()[unmet]
    apart = np.sum(surface.differences(surface.face[order])[:, :, unmet] ** 2, -1) / np.where(scale > 0, scale, 1)
    apart = apart.max(-1)
    cut = (apart >= _TOGETHER * apart.max(1, keepdims=True)) & (edges.length[edges.number[order]] > surface.shortest)

    def closed(count: int) -> np.ndarray:
        marked = np.zeros(len(edges.length), bool)
        marked[edges.longest[order[:count]]] = True
        marked[edges.number[order[:count]][cut[:count]]] = True
        return edges.closed(marked)

    def needed(count: int) -> int:
        return int(edges.added[closed(count)].sum())

    return closed(bisect.bisect_right(range(len(order) + 1), max(room, 0), key=needed) - 1)


def _ends(face: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3 2"]:
    """The vertices at the ends of each triangle's edges, the lower number first."""
    return np.sort(np.stack([face, np.roll(face, -1, 1)], -1), -1)


def _key(ends: Int[np.ndarray, "*b 2"]) -> Int[np.ndarray, "*b"]:
    """One number for the two ends of an edge."""
    return ends[..., 0] << 32 | ends[..., 1]
