"""Refinement of meshes to the scale of their shadows.

Edges are halved where the radiance at their midpoint differs from the mean of their endpoints. The radiance is that of
a white diffuse surface. Rays are traced at the midpoint of each edge, at places that pictures of the scene show, and at
points inside of triangles that are large enough to contain whole shadows. A triangle's part of the squared error is its
share of the pictures times its mean squared difference; triangles with the largest parts are divided first. A small
part of the error is that of the whole surface, for views that no camera of ours has.
"""

import bisect
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from threadpoolctl import threadpool_limits

from jaxprt import require
from jaxprt.scene import light_samples, subdivision
from jaxprt.scene.camera import Camera, orbit
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, relative
from jaxprt.scene.subdivision import Division, Edges, TrianglePoints
from jaxprt.visibility import blocks
from jaxprt.visibility.diffuse import DiffuseTracer
from jaxprt.visibility.occluder import Occluder, check
from jaxprt.visibility.rays import PRECOMPUTE, first_fronts

ALGORITHM = 2  # version of the division; raised by a release that divides otherwise

_DIRECTIONS = 1024  # per light: penumbrae have steps of a thousandth of its power
_SIZE, _DEGREE = 8, 6  # texels along an edge and degree of harmonics, if no environments are given
_UNSEEN = 0.2  # share of the error that belongs to the whole surface, and not to the pictures
_FINE = 1000  # triangles with edges shorter than this share of the scene's diagonal are not measured
_MANY = 8  # places in pictures from which a triangle's share of them is counted, and not estimated by its area
_FACES = 1 << 13  # triangles in a block whose errors are summed at once
_HIDDEN = 4  # points inside of triangles per shadow that is just large enough to cause the whole error
_FINEST = 0.01  # smaller errors do not increase the number of points inside of triangles
_SHARE = 0.7  # share of the squared error whose triangles are divided before rays are traced again
_TOGETHER = 0.5  # A triangle's edge is cut if its squared difference is at least this share of the triangle's largest.
_SHORTEST = 256  # length of the shortest edge that is cut, relative to the offset of ray origins from the surface
_ROUNDING = 1e-5  # relative difference that rounding may cause
EDGE = 64  # rays along an edge of a picture
_MOST = 16  # largest number of cameras
_TURNS = ((0.5, 0.3), (2.6, 0.6), (4.7, 0.15))  # azimuth and elevation of the cameras around the scene
_CLOSER = ((0.9, 0.4), (3.6, 0.25))  # and around parts


def cameras(mesh: Mesh, scene_cameras: Sequence[Camera], parts: Sequence[Mesh]) -> list[Camera]:
    """Cameras from which a scene is likely to be seen: its own, some around it, and some around its parts.

    Args:
        mesh: The mesh of all parts.
        scene_cameras: The cameras of the scene.
        parts: The meshes of the parts.
    """
    size = {"width": EDGE, "height": EDGE}
    around = [orbit(mesh, azimuth=azimuth, elevation=elevation, **size) for azimuth, elevation in _TURNS]
    chosen = [*scene_cameras[: _MOST // 2], *around]
    # Parts with many triangles are what scenes are about.
    solid = [part for part in parts if len(part.face)] if len(parts) > 1 else []
    order = sorted(solid, key=lambda part: -len(part.face))
    for part in order[: (_MOST - len(chosen)) // len(_CLOSER)]:
        chosen += [orbit(part, azimuth=azimuth, elevation=elevation, **size) for azimuth, elevation in _CLOSER]
    return chosen


def places(mesh: Mesh, occluder: Occluder, views: Sequence[Camera]) -> tuple[TrianglePoints, Float[np.ndarray, " p"]]:
    """Points of a mesh that cameras see from the front, and the share of all pictures that each stands for.

    Args:
        mesh: The mesh, whose triangles are those of the occluder.
        occluder: The triangles.
        views: The cameras, in the coordinates of the mesh's file.
    """
    normal = np.asarray(mesh.normal)
    triangles: list[Int[np.ndarray, " _"]] = []
    weights, shares = [], []
    for camera in views:
        eye, direction = _rays(camera.local(mesh.origin))
        triangle, weight = first_fronts(occluder, normal, np.repeat(eye[None], len(direction), 0), direction)
        seen = triangle >= 0
        if seen.any():
            triangles.append(triangle[seen])
            weights.append(weight[seen])
            shares.append(np.full(np.count_nonzero(seen), 1 / np.count_nonzero(seen)))
    if not triangles:
        return TrianglePoints(np.zeros(0, np.int64), np.zeros((0, 3))), np.zeros(0)
    share = np.concatenate(shares) / len(shares)
    return TrianglePoints(np.concatenate(triangles), np.concatenate(weights).astype(np.float64)), share


def _rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """The eye, and unit directions through the pixels of a small picture of the camera's shape."""
    eye, target, up = (np.asarray(vector, np.float64) for vector in (camera.eye, camera.target, camera.up))
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * max(np.linalg.norm(up), 1e-30):
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    height = np.tan(float(camera.field_of_view) / 2)
    across = height * camera.width / camera.height
    x, y = np.meshgrid(*[(np.arange(EDGE) + 0.5) / EDGE * 2 - 1] * 2)
    way = forward + across * x[..., None] * right - height * y[..., None] * np.cross(right, forward)
    way = (way / np.linalg.norm(way, axis=-1, keepdims=True)).reshape(-1, 3)
    return eye.astype(np.float32), way.astype(np.float32)


@require.arguments(**PRECOMPUTE)
def refine(
    mesh: Mesh,
    *,
    error: float = 0.02,
    vertices: int = 100_000,
    environments: Sequence[Environment] | None = None,
    occluder: Mesh | None = None,
    progress: blocks.Progress = True,
) -> Mesh:
    """Subdivides the triangles of a mesh where shadows are finer than the spacing of its vertices.

    Radiance is computed at vertices and interpolated between them. Rays from the midpoint of each edge show where
    interpolation is wrong, and edges are halved there. The surface does not change: no gaps open, also where vertices
    are split at a seam, and texture coordinates stay valid.

    Args:
        mesh: The mesh.
        error: Largest allowed relative L2 error of interpolation, for the radiance of a white diffuse surface: the
            root mean squared error over pictures of the mesh from three sides, divided by the root mean squared
            radiance. A fifth of the square is that of the whole surface's area, for other views. It is estimated from
            the points where rays are traced. Glossy surfaces need finer meshes. With 0 the mesh is subdivided until it
            has the largest allowed number of vertices.
        vertices: Largest allowed number of vertices. If this is too few to reach `error`, the largest errors are
            removed first, and a warning states the remaining error. A mesh that already has more is not subdivided.
        environments: Lights under which the error must hold. If None, an average over lights with a natural spectrum
            and all orientations. For the shadows of a sun, give the environment that contains it.
        occluder: Geometry that casts shadows; the mesh itself if None.
        progress: Whether to show a progress bar, or a function; see `jaxprt.Run`.

    Returns:
        The subdivided mesh. The original vertices come first.

    Raises:
        TypeError: `environments` is not a sequence of `Environment`.
        ValueError: `error` is negative or not finite, `vertices` is below 1, `environments` is empty or one of them is
            a batch, or the mesh or the occluder is invalid: no faces, missing vertices, or values that are not finite.

    Reference: Křivánek, Pattanaik, Žára 2004, "Adaptive mesh subdivision for precomputed radiance transfer". They
    compare the endpoints of each edge instead.
    """
    options = {"error": error, "tolerated": error, "vertices": vertices, "environments": environments}
    options |= {"progress": progress}
    check(mesh, "mesh")
    shadowing = mesh if occluder is None else relative(occluder, mesh.origin)
    return subdivision.subdivide(mesh, divisions(mesh, shadowing, views=cameras(mesh, (), ()), **options)[0])


def divisions(
    mesh: Mesh,
    occluder: Mesh,
    *,
    error: float,
    tolerated: float,
    vertices: int,
    environments: Sequence[Environment] | None,
    views: Sequence[Camera],
    progress: blocks.Progress,
) -> tuple[list[Division], float]:
    """Successive subdivisions that `refine` applies to a mesh, and the error that is left.

    Args:
        mesh: As in `refine`.
        occluder: As in `refine`.
        error: As in `refine`.
        tolerated: Error above which a warning is given.
        vertices: As in `refine`.
        environments: As in `refine`.
        views: Cameras whose pictures the error is of.
        progress: As in `refine`.
    """
    if not 0 <= error < np.inf:
        raise ValueError(f"error must be at least 0 and finite, got {error}")
    if vertices < 1:
        raise ValueError(f"vertices must be at least 1, got {vertices}")
    if environments is None:
        samples = light_samples.natural(size=_SIZE, degree=_DEGREE)
    else:
        samples = light_samples.importance(environments, count=_DIRECTIONS)
    # A single shadow on a share error^2 of the area is enough to cause the whole error.
    points = round(_HIDDEN * min(max(error, _FINEST) ** -2, vertices))
    result: list[Division] = []
    joint = None
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(blocks.cores()) as pool,
        blocks.ProgressBar(progress, "refine") as bar,
    ):
        first = None
        surface = _Surface(mesh, DiffuseTracer(mesh, occluder, samples, pool), points, _visible_places(mesh, views))
        while True:
            count, squares = len(surface.position), surface.squares()
            left = float(squares.sum(0).max()) ** 0.5
            first = left if first is None else first
            # Steps reduce the error by about one factor.
            share = np.log(first / left) / np.log(first / error) if first > left > error > 0 else float(left <= error)
            bar.update(count - bar.count, share=share, words=f"{100 * left:.2g} % error")
            if left <= error:
                return result, left
            edges = Edges(surface.position, surface.face, joint)
            marked = _edges_to_cut(surface, edges, squares, error, vertices - count)
            if not marked.any():
                break
            result.append(edges.divide(marked))
            joint = edges.joints_after(result[-1])
            surface.divide(result[-1])
    if left > tolerated > 0:
        warnings.warn(
            f"{count} vertices leave an error of {100 * left:.4g} % by interpolation, above the limit of "
            f"{100 * tolerated:.2g} %; at most {vertices} vertices were allowed",
            stacklevel=3,
        )
    return result, left


def interpolation_error(mesh: Mesh, *, views: Sequence[Camera]) -> float:
    """Relative L2 error of pictures that interpolation of visibility between vertices causes, as `refine` defines it.

    Args:
        mesh: The mesh, which casts the shadows.
        views: Cameras of the pictures.
    """
    samples, points = light_samples.natural(size=_SIZE, degree=_DEGREE), round(_HIDDEN * _FINEST**-2)
    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(blocks.cores()) as pool:
        surface = _Surface(mesh, DiffuseTracer(mesh, mesh, samples, pool), points, _visible_places(mesh, views))
        return float(surface.squares().sum(0).max()) ** 0.5


def _visible_places(mesh: Mesh, views: Sequence[Camera]) -> tuple[subdivision.TrianglePoints, Float[np.ndarray, " p"]]:
    return places(mesh, Occluder(mesh), views)


class _Surface:
    """Triangles with the radiance at vertices, at midpoints of edges, and at points inside of large triangles."""

    def __init__(
        self,
        mesh: Mesh,
        tracer: DiffuseTracer,
        points: int,
        seen: tuple[subdivision.TrianglePoints, Float[np.ndarray, " p"]],
    ):
        self.position, self.normal = np.asarray(mesh.position), np.asarray(mesh.normal, np.float64)
        self.face = np.asarray(mesh.face, np.int64)
        self.offset = tracer.offset  # distance of ray origins from each triangle
        self._tracer, self._casts = tracer, tracer.casts
        corner = self.position[self.face].astype(np.float64)
        longest = np.linalg.norm(np.roll(corner, -1, 1) - corner, axis=2).max(1)
        self._coarse = longest * _FINE > np.linalg.norm(np.ptp(corner.reshape(-1, 3), axis=0))
        self.light = tracer.at_vertices(np.unique(self.face[self._coarse]))
        self._key = np.zeros(0, np.int64)  # keys of the edges whose midpoints are known, in ascending order
        self._middle, self._buried = self.light[:0], np.zeros(0, bool)
        area = self._area()
        area = area / max(area.sum(), np.finfo(np.float64).tiny)
        even = subdivision.scatter(np.where(self._coarse, points * area, 0).astype(np.int64))
        coarse = self._coarse[seen[0].triangle]
        of_pictures = np.bincount(seen[0].triangle, seen[1], len(area))
        self._shown = seen[1][coarse].sum() > 0
        self.share = _UNSEEN * area + (1 - _UNSEEN) * of_pictures if self._shown else area
        pairs = zip(even, seen[0], strict=True)
        self._points = subdivision.TrianglePoints(*(np.concatenate([one, other[coarse]]) for one, other in pairs))
        self._picture = np.concatenate([np.zeros(len(even.triangle)), seen[1][coarse]])
        self._at_points, self._inside = self._traced_points()
        # Squared error of interpolation under each light, averaged over each triangle.
        self.error = np.zeros((len(self.face), self.light.shape[1]))
        self._measure(np.flatnonzero(self._coarse))

    def scale(self) -> Float[np.ndarray, " l"]:
        """Mean of the squared radiance."""
        share = self.share[self._coarse]
        return share @ self._square()[self.face[self._coarse]].mean(1) / max(share.sum(), np.finfo(np.float64).tiny)

    def squares(self) -> Float[np.ndarray, "f l"]:
        """Contribution of each triangle to the squared relative error of pictures and of the surface."""
        scale = self.scale()
        return self.share[:, None] * self.error / np.where(scale > 0, scale, 1)

    def differences(self, face: Int[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 l c"]:
        """Radiance at the midpoints of edges, minus the mean of their endpoints; 0 inside of solids."""
        ends = _edge_ends(face)
        middle = np.searchsorted(self._key, _key(ends))
        apart = self._middle[middle] - self.light[ends].mean(2)
        apart[self._buried[middle]] = 0
        return apart

    def divide(self, division: Division) -> None:
        """Divides triangles and traces rays on the new ones."""
        middle, key = np.searchsorted(self._key, _key(division.parent)), _key(division.parent)
        known = np.append(self._key, -1)[middle] == key  # Others are of triangles that are not measured.
        added = np.zeros((len(key), *self.light.shape[1:]), self.light.dtype)
        added[known] = self._middle[middle[known]]
        self.light = np.concatenate([self.light, added])
        self.normal = np.concatenate([self.normal, subdivision.middle_normal(self.normal, division.parent)])
        self.position = np.concatenate([self.position, subdivision.middle(self.position, division.parent)])
        before = self._area()
        self._points = subdivision.relocate(self._points, self.face, division)
        self.face = division.face
        self._divide_shares(division.origin, before)
        self._coarse = self._coarse[division.origin]
        self.error, self._casts = self.error[division.origin], self._casts[division.origin]
        self.offset = self.offset[division.origin]
        self._measure(np.flatnonzero((np.bincount(division.origin) > 1)[division.origin] & self._coarse))

    def _divide_shares(self, origin: Int[np.ndarray, " f"], before: Float[np.ndarray, " _"]) -> None:
        """Gives new triangles their shares of pictures: by the places in them, or where these are few, by area."""
        of_area = self._area() / np.maximum(before, np.finfo(np.float64).tiny)[origin]
        share = self.share[origin] * of_area
        if self._shown:
            inside = self._points.triangle[self._picture > 0]
            many = np.bincount(origin[inside], minlength=len(before)) >= _MANY * np.bincount(origin)
            total = self._area() / max(self._area().sum(), np.finfo(np.float64).tiny)
            counted = np.bincount(self._points.triangle, self._picture, len(origin))
            share = np.where(many[origin], _UNSEEN * total + (1 - _UNSEEN) * counted, share)
        self.share = share

    def _square(self) -> Float[np.ndarray, " v l"]:
        return np.sum(np.square(self.light, dtype=np.float64), -1)

    def _area(self) -> Float[np.ndarray, " f"]:
        a, b, c = np.swapaxes(self.position[self.face].astype(np.float64), 0, 1)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2

    def _measure(self, changed: Int[np.ndarray, " n"]) -> None:
        """Computes the error of some triangles. Traces rays where the radiance is not known."""
        self._trace_middles(changed)
        for first in range(0, len(changed), _FACES):
            faces = changed[first : first + _FACES]
            apart = self.differences(self.face[faces]).astype(np.float64)
            square, both = np.sum(apart**2, (1, 3)), np.sum(np.sum(apart, 1) ** 2, -1)
            # Mean, over a triangle, of the square of a quadratic function that is zero at the corners.
            self.error[faces] = 4 / 45 * (square + both)
        # Where there are points inside, the midpoints count as three more.
        again = np.zeros(len(self.face), bool)
        again[changed] = True
        here = again[self._points.triangle]
        triangle, weight = self._points.triangle[here], self._points.weight[here]
        apart = self._at_points[here] - np.einsum("pk,pklc->plc", weight, self.light[self.face[triangle]])
        apart[self._inside[here]] = 0
        total = 3 * self.error
        np.add.at(total, triangle, np.sum(apart**2, -1))
        error = (total / (3 + np.bincount(triangle, minlength=len(total)))[:, None])[changed]
        level = self._square()[self.face[changed]].mean(1)
        self.error[changed] = np.where(error > _ROUNDING**2 * level, error, 0)

    def _trace_middles(self, changed: Int[np.ndarray, " n"]) -> None:
        """Traces rays at those midpoints of some triangles' edges whose radiance is not known."""
        edge, middle = np.unique(_key(_edge_ends(self.face[changed])), return_inverse=True)
        corner = np.concatenate([self.face[changed], len(self.position) + middle.reshape(-1, 3)], 1)
        smaller = corner[:, [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]].reshape(-1, 3)
        parent = np.stack(np.divmod(edge, 1 << 32), -1)
        position = np.concatenate([self.position, subdivision.middle(self.position, parent)])
        normal = np.concatenate([self.normal, subdivision.middle_normal(self.normal, parent)])
        rest = self._casts.copy()
        rest[changed] = False
        casting = np.concatenate([self.face[rest], smaller[np.repeat(self._casts[changed], 4)]])
        new = np.flatnonzero(~np.isin(edge, self._key))
        offset = np.repeat(self.offset[changed], 4)
        light, buried = self._tracer.at(position, normal, smaller, offset, casting, len(self.position) + new)
        key, light = np.concatenate([self._key, edge[new]]), np.concatenate([self._middle, light])
        buried = np.concatenate([self._buried, buried])
        # Drop the edges that have been cut.
        keep = np.flatnonzero(np.isin(key, _key(_edge_ends(self.face))))
        order = keep[np.argsort(key[keep])]
        self._key, self._middle, self._buried = key[order], light[order], buried[order]

    def _traced_points(self) -> tuple[Float32[np.ndarray, "p l c"], Bool[np.ndarray, " p"]]:
        """Radiance at the points inside of triangles, and whether they are inside of solids."""
        triangle, weight = self._points
        corner = self.face[triangle]
        place, normal = (
            np.einsum("pk,pkc->pc", weight, np.asarray(attribute, np.float64)[corner])
            for attribute in (self.position, self.normal)
        )
        light = np.zeros((len(triangle), *self.light.shape[1:]), self.light.dtype)
        inside = np.zeros(len(triangle), bool)
        sheet = self._tracer.double[triangle]
        for rows, traced in ((np.flatnonzero(~sheet), self._beside), (np.flatnonzero(sheet), self._on_sheets)):
            light[rows], inside[rows] = traced(triangle[rows], place[rows], normal[rows])
        return light, inside

    def _beside(
        self, triangle: Int[np.ndarray, " p"], place: Float[np.ndarray, "p 3"], normal: Float[np.ndarray, "p 3"]
    ) -> tuple[Float32[np.ndarray, "p l c"], Bool[np.ndarray, " p"]]:
        """The result of `_traced_points`, for points of triangles without a second side."""
        count = len(self.position)
        # Each point becomes a vertex of a small triangle, so that its ray origin is found like that of a vertex.
        small = (0.5 / np.sqrt(1 + np.bincount(triangle, minlength=1)))[triangle, None, None]
        beside = place[:, None] + small * (self.position[self.face[triangle]][:, :2] - place[:, None])
        position = np.concatenate([place, beside.reshape(-1, 3)]).astype(self.position.dtype)
        around = np.arange(len(place))
        around = np.stack([around, len(place) + 2 * around, len(place) + 2 * around + 1], -1)
        casting = np.concatenate([around[self._casts[triangle]] + count, self.face[self._casts]])
        position = np.concatenate([self.position, position])
        normal = np.concatenate([self.normal, normal, np.repeat(normal, 2, 0)])
        offset = self.offset[triangle]
        return self._tracer.at(position, normal, around + count, offset, casting, count + np.arange(len(place)))

    def _on_sheets(
        self, triangle: Int[np.ndarray, " p"], place: Float[np.ndarray, "p 3"], normal: Float[np.ndarray, "p 3"]
    ) -> tuple[Float32[np.ndarray, "p l c"], Bool[np.ndarray, " p"]]:
        """The result of `_traced_points`, for points of triangles with two sides."""
        one, other = (self.position[self.face[triangle, corner]].astype(np.float64) - place for corner in (0, 1))
        out = np.cross(one, other)
        out /= np.maximum(np.linalg.norm(out, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        # Only shared vertices tell the sides apart. Rays start on that of the normal, whatever touches the sheet there.
        out *= np.where(np.sum(out * normal, 1, keepdims=True) < 0, -1, 1)
        return self._tracer.at_points(place + self.offset[triangle, None] * out, normal, out)


def _edges_to_cut(
    surface: _Surface, edges: Edges, squares: np.ndarray, error: float, room: int
) -> Bool[np.ndarray, " e"]:
    """Edges to cut next: those of the triangles with the largest errors, within the allowed number of vertices."""
    total = squares.sum(0)
    unmet = total > error**2
    shortest = _SHORTEST * surface.offset
    priority = np.where(edges.length[edges.longest] > shortest, squares[:, unmet].max(1), 0)
    # At a shadow boundary, halving the edges removes half of the squared error.
    wanted = min(_SHARE * total.max(), 2 * (total.max() - error**2))
    order = np.argsort(-priority, kind="stable")[: np.count_nonzero(priority)]
    order = order[: 1 + np.searchsorted(np.cumsum(priority[order]), wanted)]
    scale = surface.scale()[unmet]
    apart = np.sum(surface.differences(surface.face[order])[:, :, unmet] ** 2, -1) / np.where(scale > 0, scale, 1)
    apart = apart.max(-1)
    cut = apart >= _TOGETHER * apart.max(1, keepdims=True)
    cut &= edges.length[edges.number[order]] > shortest[order, None]

    def closed(count: int) -> np.ndarray:
        marked = np.zeros(len(edges.length), bool)
        marked[edges.longest[order[:count]]] = True
        marked[edges.number[order[:count]][cut[:count]]] = True
        return edges.closed(marked)

    def needed(count: int) -> int:
        return int(edges.added[closed(count)].sum())

    return closed(bisect.bisect_right(range(len(order) + 1), max(room, 0), key=needed) - 1)


def _edge_ends(face: Int[np.ndarray, "f 3"]) -> Int[np.ndarray, "f 3 2"]:
    """Indices of the endpoints of each triangle's edges, the lower index first."""
    return np.sort(np.stack([face, np.roll(face, -1, 1)], -1), -1)


def _key(ends: Int[np.ndarray, "*b 2"]) -> Int[np.ndarray, "*b"]:
    """One integer key for the two endpoints of an edge."""
    return ends[..., 0] << 32 | ends[..., 1]
