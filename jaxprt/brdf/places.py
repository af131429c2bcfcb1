"""Interpolation weights for a set of BRDFs from one or two coordinates: on lines, in triangles and in columns.

Weights are not negative and sum to one. `jaxprt.brdf.navigation` uses them to make families of BRDFs.
"""

import functools
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxprt.compile import jit

_ROUNDING = 16  # units of rounding within which points coincide and triangles are degenerate
_FAR = 1e30


def identity(coordinate: Array) -> Array:
    """The coordinates, unchanged."""
    return coordinate


class Line(eqx.Module):
    """Linear interpolation in one coordinate, constant beyond the ends.

    Attributes:
        knot: Coordinate of each BRDF; at least two, increasing.
        chart: Increasing function of the coordinate, such as a logarithm, in which interpolation is linear.
    """

    knot: Float[Array, " m"]
    chart: Callable[[Array], Array] = eqx.field(static=True, default=identity)

    def weight(self, coordinate: Float[ArrayLike, ""]) -> Float[Array, " m"]:
        """Weight of each BRDF. Weights are not negative and sum to one.

        They are differentiable in the coordinate and the knots. At a knot the derivative is that from above, at the
        last knot that from below.
        """
        knot = self.chart(self.knot)
        low, upper = _neighbors(knot, self.chart(_check_coordinate(coordinate, ())), len(knot))
        return jnp.zeros(len(knot), upper.dtype).at[low].set(1 - upper).at[low + 1].set(upper)

    def inside(self, coordinate: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether the coordinate is between the first and the last knot, inclusive."""
        return (self.knot[0] <= coordinate) & (coordinate <= self.knot[-1])


class Plane(eqx.Module):
    """Barycentric interpolation in a triangulation of two coordinates. Points outside are moved to the boundary.

    Triangles and distances are defined in the chart: each coordinate is mapped and then divided by the extent of the
    points, because the coordinates have different units. `triangulate` makes it.

    Attributes:
        point: Coordinates of each BRDF.
        triangle: Point indices of each triangle, counterclockwise.
        edge: Point indices of each edge of the boundary (the convex hull in the chart); the interior is on the left.
        chart: Function that maps an array of both coordinates to the chart; increasing in each coordinate.
    """

    point: Float[Array, "m 2"]
    triangle: Int[Array, "t 3"]
    edge: Int[Array, "e 2"]
    chart: Callable[[Array], Array] = eqx.field(static=True, default=identity)

    def weight(self, coordinate: Float[ArrayLike, "2"]) -> Float[Array, " m"]:
        """Weight of each BRDF. Weights are not negative and sum to one; at most three are nonzero.

        They are continuous, and differentiable in the coordinate and the points for a fixed triangulation. The
        derivative is that of the selected triangle or edge. It is one-sided where several meet, and zero where the
        nearest point of the boundary remains a vertex.
        """
        return _weight(self, _check_coordinate(coordinate, (2,)))

    def inside(self, coordinate: Float[Array, "2"]) -> Bool[Array, ""]:
        """Whether the coordinate is inside of the boundary or on it, up to rounding."""
        point, spot = (_scale(self.chart, self.point, spot) for spot in (self.point, coordinate))
        return _within(point[self.edge], spot)


class Columns(eqx.Module):
    """Interpolation of two coordinates for points in columns: linear along each column, then between two columns.

    Each column has one value of the first coordinate and at least two values of the second. The smallest and largest
    values of the second coordinate are the same in all columns. A place between two columns gets weights only from its
    neighbors in these columns; if both have a point with its second coordinate, only these two points count. Places
    outside are moved to the nearest place inside. `columns` makes it.

    Attributes:
        point: Coordinates of each BRDF.
        order: Point indices of each column, sorted by the second coordinate. Shorter columns repeat their last point.
        count: Number of points in each column.
        chart: Function that maps an array of both coordinates to the chart, each coordinate on its own and increasing.
            Weights are linear in the chart.
    """

    point: Float[Array, "m 2"]
    order: Int[Array, "k r"]
    count: Int[Array, " k"]
    chart: Callable[[Array], Array] = eqx.field(static=True, default=identity)

    def weight(self, coordinate: Float[ArrayLike, "2"]) -> Float[Array, " m"]:
        """Weight of each BRDF. Weights are not negative and sum to one; at most four are nonzero.

        They are continuous, and differentiable in the coordinate and the points for fixed columns. At a point the
        derivative is that from above, at the last point that from below. Outside, the derivative across the border is
        zero.
        """
        return _column_weight(self, _check_coordinate(coordinate, (2,)))

    def inside(self, coordinate: Float[Array, "2"]) -> Bool[Array, ""]:
        """Whether both coordinates are between their ends, inclusive."""
        point = self.point[self.order]
        low, high = jnp.min(point, (0, 1)), jnp.max(point, (0, 1))
        return jnp.all((low <= coordinate) & (coordinate <= high))


def triangulate(
    point: Float[ArrayLike, "m 2"], *, chart: Callable[[Array], Array] = identity, name: Sequence[str] = ()
) -> Plane:
    """Makes a `Plane` by Delaunay triangulation of points in their chart. Runs on the host.

    Args:
        point: Coordinates of each BRDF.
        chart: Function that maps an array of both coordinates to the chart; increasing in each coordinate.
        name: Names of the points in error messages, instead of their indices.

    Returns:
        The triangulation.
    """
    point, scaled, rounding = _apart(point, chart, name)
    try:
        triangle = scipy.spatial.Delaunay(scaled).simplices  # Counter-clockwise.
    except scipy.spatial.QhullError:
        triangle = np.zeros((0, 3), int)
    # Slivers occur only along the hull.
    area, size = _area(scaled[triangle])
    triangle = triangle[area > rounding * size]
    if not len(triangle):
        raise ValueError(f"points must not all lie on one line, got {len(point)} that do")
    side = np.concatenate([triangle[:, [0, 1]], triangle[:, [1, 2]], triangle[:, [2, 0]]])
    outer = ~np.isin(side @ [len(point), 1], side @ [1, len(point)])
    triangle, side = (jax.device_put(index.astype(np.int32)) for index in (triangle, side[outer]))
    return Plane(jax.device_put(point), triangle, side, chart)


def in_columns(point: Float[ArrayLike, "m 2"], *, chart: Callable[[Array], Array] = identity) -> bool:
    """Whether points lie in at least two columns as `Columns` requires, up to rounding. Runs on the host.

    Args:
        point: Coordinates of each BRDF.
        chart: Function that maps an array of both coordinates to the chart, each coordinate on its own and increasing.
    """
    point = np.asarray(point).astype(jnp.result_type(float))
    if point.ndim != 2 or point.shape[1] != 2 or len(point) < 4 or not np.isfinite(point).all():
        return False
    scaled = np.asarray(_scale(chart, point, point), np.float64)
    rounding = float(_ROUNDING * np.finfo(point.dtype).eps)
    groups = _split(scaled, rounding)
    ends = [(min(scaled[group, 1]), max(scaled[group, 1])) for group in groups]
    return len(groups) > 1 and all(low <= rounding and high >= 1 - rounding for low, high in ends)


def columns(
    point: Float[ArrayLike, "m 2"], *, chart: Callable[[Array], Array] = identity, name: Sequence[str] = ()
) -> Columns:
    """Makes a `Columns` by sorting points into columns. Runs on the host.

    Args:
        point: Coordinates of each BRDF.
        chart: Function that maps an array of both coordinates to the chart, each coordinate on its own and increasing.
        name: Names of the points in error messages, instead of their indices.

    Returns:
        The columns.
    """
    point, scaled, rounding = _apart(point, chart, name)
    if not in_columns(point, chart=chart):
        count = len(_split(scaled, rounding))
        raise ValueError(
            "points must form at least two columns: the points of a column share their first coordinate, and all "
            "columns have the same smallest and largest second coordinate; "
            f"got {len(point)} points with {count} different first coordinates"
        )
    groups = _split(scaled, rounding)
    most = max(map(len, groups))
    order = np.stack([np.pad(group, (0, most - len(group)), mode="edge") for group in groups])
    order, count = (jax.device_put(np.asarray(group, np.int32)) for group in (order, [len(group) for group in groups]))
    return Columns(jax.device_put(point), order, count, chart)


def _split(scaled: np.ndarray, rounding: float) -> list[np.ndarray]:
    """Point indices of each column, sorted by the second coordinate."""
    along = np.argsort(scaled[:, 0], kind="stable")
    parts = np.split(along, np.flatnonzero(np.diff(scaled[along, 0]) > rounding) + 1)
    return [part[np.argsort(scaled[part, 1], kind="stable")] for part in parts]


def _apart(
    point: ArrayLike, chart: Callable[[Array], Array], name: Sequence[str]
) -> tuple[np.ndarray, np.ndarray, float]:
    """The points, the points in the scaled chart, and the rounding error there. Refuses equal or non-finite points."""
    point = np.asarray(point).astype(jnp.result_type(float))
    if point.ndim != 2 or point.shape[1] != 2 or len(point) < 3:
        raise ValueError(f"points must be at least three pairs of coordinates, got an array of shape {point.shape}")
    name = name or [f"point {index}" for index in range(len(point))]
    broken = np.flatnonzero(~np.isfinite(point).all(-1))
    if broken.size:
        first = f"the first is {name[broken[0]]} at {_text(point[broken[0]])}"
        raise ValueError(f"points must be finite, got {broken.size} that are not, {first}")
    # Computed in the same precision as `Plane` does.
    scaled = np.asarray(_scale(chart, point, point), np.float64)
    rounding = float(_ROUNDING * np.finfo(point.dtype).eps)
    distance, pair = scipy.spatial.KDTree(scaled).query(scaled, k=2)
    i, j = sorted(np.asarray(pair)[np.argmin(distance[:, 1])])
    if distance[:, 1].min() <= rounding:
        raise ValueError(
            f"points must not coincide, got {name[i]} at {_text(point[i])} and {name[j]} at {_text(point[j])}"
        )
    return point, scaled, rounding


def _text(point: np.ndarray) -> str:
    return f"({point[0]:g}, {point[1]:g})"


@jit
def _column_weight(columns: Columns, coordinate: Array) -> Array:
    """`Columns.weight` for two finite numbers."""
    point, spot = (columns.chart(spot) for spot in (columns.point, coordinate))
    place = point[columns.order]
    left, across = _neighbors(place[:, 0, 0], spot[0], len(place))
    result = jnp.zeros(len(point), across.dtype)
    for column, part in ((left, 1 - across), (left + 1, across)):
        low, upper = _neighbors(place[column, :, 1], spot[1], columns.count[column])
        index = columns.order[column]
        result = result.at[index[low]].add(part * (1 - upper)).at[index[low + 1]].add(part * upper)
    return result


def _neighbors(knot: Array, spot: Array, count: ArrayLike) -> tuple[Array, Array]:
    """Index of the lower neighbor of a spot among the first `count` of increasing knots, and the upper one's weight."""
    spot = _clip(spot, knot[0], knot[-1])
    low = jnp.clip(jnp.searchsorted(knot, spot, side="right") - 1, 0, count - 2)
    return low, (spot - knot[low]) / (knot[low + 1] - knot[low])


@jit
def _weight(plane: Plane, coordinate: Array) -> Array:
    """`Plane.weight` for two finite numbers: some sixty operations, compiled as one program."""
    point, spot = (_scale(plane.chart, plane.point, spot) for spot in (plane.point, coordinate))
    # The selection of a triangle or edge is not differentiated.
    still, fixed = jax.lax.stop_gradient((point, spot))
    weight, flat = _barycentric(still[plane.triangle], fixed)
    triangle = plane.triangle[jnp.argmax(jnp.where(flat, -jnp.inf, jnp.min(weight, -1)))]
    _, nearest = _project(still[plane.edge], fixed)
    # The squared distance without the square of the spot, which far away would round away the differences.
    edge = plane.edge[jnp.argmin(jnp.sum(nearest * (nearest - 2 * fixed), -1))]
    along, _ = _project(point[edge], spot)
    weight, _ = _barycentric(point[triangle], spot)
    # Rounding may put spots on edges just outside of all triangles. Their values are clipped, their derivatives not.
    valid = jnp.maximum(weight, 0)
    weight = weight + jax.lax.stop_gradient(valid / jnp.sum(valid) - weight)
    within = _within(still[plane.edge], fixed)
    weight = jnp.where(within, weight, jnp.stack([1 - along, along, jnp.zeros_like(along)]))
    index = jnp.where(within, triangle, edge[jnp.array([0, 1, 0])])
    return jnp.zeros(len(point), weight.dtype).at[index].add(weight)


def _check_coordinate(coordinate: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Coordinates as floating-point numbers. Infinite ones become large finite ones."""
    value = jnp.asarray(coordinate, jnp.result_type(float))
    if value.shape != shape:
        kind = "two coordinates" if shape else "one number"
        raise ValueError(f"a point of this set must be {kind}, got an array of shape {list(value.shape)}")
    return jnp.clip(value, -_FAR, _FAR)


def _clip(value: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Like jnp.clip, but the derivative at the ends is that of the inside."""
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


@functools.partial(jit, static_argnums=0)
def _scale(chart: Callable[[Array], Array], point: Array, coordinate: Array) -> Array:
    """Coordinates in the chart, scaled so that those of the points range from 0 to 1."""
    low, high = jnp.min(chart(point), 0), jnp.max(chart(point), 0)
    return (chart(coordinate) - low) / jnp.where(high > low, high - low, 1)


def _cross(first, second):
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def _area(corner):
    """Twice the signed area of triangles, positive if counterclockwise, and the sum of two squared sides."""
    u, v = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    return _cross(u, v), (u**2 + v**2).sum(-1)


def _barycentric(corner: Array, spot: Array) -> tuple[Array, Array]:
    """Barycentric coordinates in triangles, linear in the spot, and whether the triangles are degenerate."""
    area, size = _area(corner)
    flat = area <= _ROUNDING / 4 * jnp.finfo(area.dtype).eps * size
    start = corner[..., 0, :]
    part = [_cross(spot - start, corner[..., 2, :] - start), _cross(corner[..., 1, :] - start, spot - start)]
    second, third = jnp.stack(part) / jnp.where(flat, 1, area)
    return jnp.stack([1 - second - third, second, third], -1), flat


def _project(segment: Array, spot: Array) -> tuple[Array, Array]:
    """The nearest points on segments: their parameter from 0 to 1, and their position."""
    start, way = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    square = jnp.sum(way**2, -1)
    along = _clip(jnp.sum((spot - start) * way, -1) / jnp.where(square > 0, square, 1), 0, 1)
    return along, start + along[..., None] * way


def _within(edge: Array, spot: Array) -> Array:
    """Whether a spot is on the left of all edges. Rounding may leave gaps between triangles, but not in the hull."""
    start, way = edge[:, 0], edge[:, 1] - edge[:, 0]
    slack = 8 * jnp.finfo(spot.dtype).eps * jnp.sqrt(jnp.sum(way**2, -1))
    return jnp.all(_cross(way, spot - start) >= -slack)
