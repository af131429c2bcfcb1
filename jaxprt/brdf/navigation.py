"""Navigation: moving among the BRDFs of a set, by a weight for each; the weights sum to one.

A set holds purely specular gray BRDFs of unit weight; diffuse and specular weights and colors are applied elsewhere.
They also weigh all that is linear in the BRDFs: their coefficients, and the radiance that they reflect.

Reference: Sun et al. 2007, "Interactive relighting with dynamic BRDFs", section 4.2.
"""

import csv
import functools
import math
import pathlib
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from jaxprt.brdf import models
from jaxprt.compile import jit

_ROUNDING = 16  # Units of rounding up to which points coincide, and triangles are lines.
_FAR = 1e30
_SMOOTHEST = 1e-3  # Least roughness that the models tell apart.
_SCALE = np.array([1.0, 1.15, 1.66])  # MERL's scale of colors, which the fits of Ngan et al. lack.
_COLUMNS = ("kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "m", "F0")
_NO_MATERIAL = np.array([0.0, 1.0])[:, None, None]  # Diffuse and specular weight.


def _identity(coordinate: Array) -> Array:
    return coordinate


def _log_roughness(coordinate: Array) -> Array:
    """F0 and the logarithm of the roughness."""
    return jnp.stack([coordinate[..., 0], jnp.log(jnp.maximum(coordinate[..., 1], _SMOOTHEST))], -1)


class Line(eqx.Module):
    """A set with one coordinate: linear between neighbors, the nearest end outside.

    Attributes:
        knot: Coordinate of each BRDF, at least two, increasing.
    """

    knot: Float[Array, " m"]

    def weight(self, coordinate: Float[ArrayLike, ""]) -> Float[Array, " m"]:
        """Weight of each BRDF; not negative, their sum is one.

        Differentiable in the coordinate and the knots: at a knot from above, at the last one from below.

        Raises:
            ValueError: The coordinate is no single number.
        """
        spot = _clip(_checked(coordinate, ()), self.knot[0], self.knot[-1])
        low = jnp.clip(jnp.searchsorted(self.knot, spot, side="right") - 1, 0, len(self.knot) - 2)
        upper = (spot - self.knot[low]) / (self.knot[low + 1] - self.knot[low])
        return jnp.zeros(len(self.knot), upper.dtype).at[low].set(1 - upper).at[low + 1].set(upper)

    def inside(self, coordinate: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether the coordinate is between the ends, or at one."""
        return (self.knot[0] <= coordinate) & (coordinate <= self.knot[-1])


class Plane(eqx.Module):
    """A set with two coordinates: barycentric in a triangle inside, at the nearest point of the boundary outside.

    Triangles are straight, and distances are measured, in the chart: the coordinates, each mapped and then divided by
    the extent of the points, since they are of different units. Made by `triangulate`.

    Attributes:
        point: Coordinates of each BRDF.
        triangle: Points of each triangle, counter-clockwise.
        edge: Points of each edge of the boundary, the convex hull in the chart; the inside is on the left.
        chart: Increasing map of each coordinate, as a function of both.
    """

    point: Float[Array, "m 2"]
    triangle: Int[Array, "t 3"]
    edge: Int[Array, "e 2"]
    chart: Callable[[Array], Array] = eqx.field(static=True, default=_identity)

    def weight(self, coordinate: Float[ArrayLike, "2"]) -> Float[Array, " m"]:
        """Weight of each BRDF; not negative, their sum is one, and three at most are not zero.

        Continuous. Differentiable in the coordinate and the points, with the triangulation fixed: the derivative is
        that of the triangle or edge which was picked, one-sided where several meet, and zero where the nearest point
        of the boundary stays at one vertex.

        Raises:
            ValueError: There are not two coordinates.
        """
        return _weight(self, _checked(coordinate, (2,)))

    def inside(self, coordinate: Float[Array, "2"]) -> Bool[Array, ""]:
        """Whether the coordinate is inside the boundary or on it, up to rounding."""
        point, spot = (_scaled(self.chart, self.point, each) for each in (self.point, coordinate))
        return _within(point[self.edge], spot)


class Family(eqx.Module):
    """A set of BRDFs and the way through it.

    Attributes:
        brdf: Purely specular gray BRDFs of unit weight. Material m is diffuse_m / pi + specular_m brdf_m.
        navigation: Turns coordinates into a weight for each.
        name: What each is called.
        diffuse: Diffuse reflectance of each material in linear RGB; zero where there are no materials.
        specular: Weight of its lobe in linear RGB; one where there are no materials.
    """

    brdf: tuple[Callable, ...]
    navigation: Line | Plane
    name: tuple[str, ...] = eqx.field(static=True)
    diffuse: Float[Array, "m 3"]
    specular: Float[Array, "m 3"]


def blinn_phong(*, exponents: Sequence[float] = range(1, 201)) -> Family:
    """Blinn-Phong lobes over their exponent, at the integers from 1 to 200 as published.

    The lobes are normalized, see `models.BlinnPhong`: each reflects all light at normal incidence.

    Args:
        exponents: Exponent of each BRDF.

    Returns:
        The family, whose coordinate is the exponent.

    Raises:
        ValueError: Exponents are not at least two finite increasing numbers from 0 up.
    """
    knot = np.asarray(exponents, float)
    if knot.ndim != 1 or len(knot) < 2 or not (np.isfinite(knot).all() and knot[0] >= 0 and np.all(np.diff(knot) > 0)):
        raise ValueError(f"exponents must be at least two finite increasing numbers from 0 up, got {knot}")
    brdf = tuple(models.BlinnPhong(diffuse=0.0, specular=1.0, exponent=n) for n in knot)
    line = Line(jnp.asarray(knot, jnp.result_type(float)))
    return _family(brdf, line, tuple(f"exponent {n:g}" for n in knot), _NO_MATERIAL)


def cook_torrance(*, path: str | pathlib.Path | None = None, point: Float[ArrayLike, "m 2"] | None = None) -> Family:
    """Cook-Torrance lobes over the plane of Fresnel reflectance F0 and roughness m.

    Triangles are straight in F0 and log m; published ones are so in m. Of the measured materials, each interpolated
    from the others, the relative rms error by cos_i cos_o is then 0.09 in the mean and 0.03 in the median, instead of
    0.4 and 0.07. A roughness below 0.001 counts as that.

    Without a file or points, the set is a grid of 49: 16 values of m, geometric from 0.02, where lobes are few texels
    of 6 x 64 x 64 wide, to 1, for F0 of 0 and 1, and those between them for F0 of 0.3. Its error is 0.017 in the mean.
    The model is linear in F0, but the sides of triangles trade F0 against m: the error is 0.024 without the middle
    column, and as much if that has the same m as the others, so that triangles are halves of rectangles.

    Args:
        path: A CSV file whose first row names the columns material, kd_r, kd_g, kd_b, ks_r, ks_g, ks_b, m and F0, as
            fitted by Ngan et al. to data without MERL's scale of colors, (1, 1.15, 1.66), by which kd and ks are
            multiplied here. Only m and F0 place a material in the plane.
        point: Instead, F0 and m of each BRDF.

    Returns:
        The family, whose coordinate is (F0, m).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: There are both a file and points; points are out of range; the file is empty or no text, lacks
            columns, has cells that are no numbers or out of range, or names a material twice; or there are fewer than
            three, two coincide, or all lie on one line.

    Reference: Ngan, Durand, Matusik 2005, "Experimental analysis of BRDF models", for the fits.
    """
    if path is not None and point is not None:
        raise ValueError("give either path or point, got both")
    if path is None:
        place = _grid() if point is None else np.asarray(point, float).reshape(-1, 2)
        if not (np.isfinite(place).all() and np.all((place >= 0) & (place[:, :1] <= 1))):
            raise ValueError(f"points must be F0 from 0 to 1 and m from 0, got {place.tolist()}")
        name, weight = tuple(f"F0 {f0:g}, m {m:.3g}" for f0, m in place), _NO_MATERIAL
    else:
        name, weight, place = _read(pathlib.Path(path))
    try:
        plane = triangulate(place, chart=_log_roughness, name=name)
    except ValueError as error:
        raise error if path is None else ValueError(f"{path}: {error}") from error
    brdf = tuple(models.CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=f0) for f0, m in place)
    return _family(brdf, plane, name, weight)


def triangulate(
    point: Float[ArrayLike, "m 2"], *, chart: Callable[[Array], Array] = _identity, name: Sequence[str] = ()
) -> Plane:
    """Triangulates points by Delaunay's criterion in their chart; see `Plane`. Runs on the host.

    Args:
        point: Coordinates of each BRDF.
        chart: Increasing map of each coordinate, as a function of both.
        name: What to call the points in messages, instead of their numbers.

    Returns:
        The plane.

    Raises:
        ValueError: There are fewer than three points, a point is not finite, two coincide, or all lie on one line;
            the latter two up to rounding, in the chart.
    """
    point = np.asarray(point).astype(jnp.result_type(float))
    if point.ndim != 2 or point.shape[1] != 2 or len(point) < 3:
        raise ValueError(f"points must be at least three pairs of coordinates, got an array of shape {point.shape}")
    name = name or [f"point {index}" for index in range(len(point))]
    broken = np.flatnonzero(~np.isfinite(point).all(-1))
    if broken.size:
        first = f"the first is {name[broken[0]]} at {_text(point[broken[0]])}"
        raise ValueError(f"points must be finite, got {broken.size} that are not, {first}")
    # As the plane itself computes them, in its precision.
    scaled = np.asarray(_scaled(chart, point, point), np.float64)
    rounding = _ROUNDING * np.finfo(point.dtype).eps
    distance, pair = scipy.spatial.KDTree(scaled).query(scaled, k=2)
    i, j = sorted(np.asarray(pair)[np.argmin(distance[:, 1])])
    if distance[:, 1].min() <= rounding:
        raise ValueError(
            f"points must not coincide, got {name[i]} at {_text(point[i])} and {name[j]} at {_text(point[j])}"
        )
    try:
        triangle = scipy.spatial.Delaunay(scaled).simplices  # Counter-clockwise.
    except scipy.spatial.QhullError:
        triangle = np.zeros((0, 3), int)
    # Slivers occur along the hull alone.
    area, size = _area(scaled[triangle])
    triangle = triangle[area > rounding * size]
    if not len(triangle):
        raise ValueError(f"points must not all lie on one line, got {len(point)} that do")
    side = np.concatenate([triangle[:, [0, 1]], triangle[:, [1, 2]], triangle[:, [2, 0]]])
    outer = ~np.isin(side @ [len(point), 1], side @ [1, len(point)])
    triangle, side = (jax.device_put(each.astype(np.int32)) for each in (triangle, side[outer]))
    return Plane(jax.device_put(point), triangle, side, chart)


def _family(brdf: tuple, navigation: Line | Plane, name: tuple[str, ...], weight: np.ndarray) -> Family:
    diffuse, specular = np.broadcast_to(weight, (2, len(brdf), 3)).astype(jnp.result_type(float))
    return Family(brdf, navigation, name, jax.device_put(diffuse), jax.device_put(specular))


def _grid() -> np.ndarray:
    """F0 and m of the set without a file."""
    knot = np.geomspace(0.02, 1, 16)
    between = np.concatenate([knot[:1], np.sqrt(knot[1:] * knot[:-1]), knot[-1:]])
    return np.array([(f0, m) for f0, column in ((0, knot), (0.3, between), (1, knot)) for m in column])


def _text(point: np.ndarray) -> str:
    return f"({point[0]:g}, {point[1]:g})"


def _read(path: pathlib.Path) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names, kd and ks [2, m, 3], and F0 and m [m, 2] of the materials in a CSV file."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no table of materials {path}")
    table: dict[str, list[float]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            columns = [column.strip() for column in reader.fieldnames or ()]
            missing = [column for column in ("material", *_COLUMNS) if column not in columns]
            if missing:
                came = f"a file without {', '.join(missing)}" if columns else "an empty file"
                raise ValueError(f"the first row must name material, {', '.join(_COLUMNS)}, got {came}")
            reader.fieldnames = columns
            for row in reader:
                name = (row["material"] or "").strip()
                if name in table:
                    raise ValueError(f"line {reader.line_num}: every material must have one row, got {name!r} again")
                table[name] = [_number(row, column, reader.line_num) for column in _COLUMNS]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"{path}: {error}") from error
    if len(table) < 3:
        raise ValueError(f"{path}: must hold at least three materials, got {len(table)}")
    value = np.array(list(table.values()))
    return tuple(table), value[:, :6].reshape(-1, 2, 3).swapaxes(0, 1) * _SCALE, value[:, [7, 6]]


def _number(row: dict, column: str, line: int) -> float:
    """One cell of a row, checked."""
    if None in row:
        raise ValueError(f"line {line}: must have as many cells as the first row, got {len(row[None])} more")
    try:
        value = float(row[column] or "")
    except ValueError:
        came = repr(row[column]) if row[column] else "nothing"
        raise ValueError(f"line {line}: {column} must be a number, got {came}") from None
    least, most = {"m": (math.ulp(0), math.inf), "F0": (0, 1)}.get(column, (0, math.inf))
    if not (least <= value <= most and math.isfinite(value)):
        required = {"m": "positive", "F0": "between 0 and 1"}.get(column, "not negative")
        raise ValueError(f"line {line}: {column} must be finite and {required}, got {value}")
    return value


@jit
def _weight(plane: Plane, coordinate: Array) -> Array:
    """`Plane.weight` of two numbers that are finite: some sixty operations, as one program."""
    point, spot = (_scaled(plane.chart, plane.point, each) for each in (plane.point, coordinate))
    # What is picked is not differentiated.
    still, fixed = jax.lax.stop_gradient((point, spot))
    weight, flat = _barycentric(still[plane.triangle], fixed)
    triangle = plane.triangle[jnp.argmax(jnp.where(flat, -jnp.inf, jnp.min(weight, -1)))]
    _, nearest = _project(still[plane.edge], fixed)
    # The squared distance less the square of the spot: far away that has no digits left for the difference.
    edge = plane.edge[jnp.argmin(jnp.sum(nearest * (nearest - 2 * fixed), -1))]
    along, _ = _project(point[edge], spot)
    weight, _ = _barycentric(point[triangle], spot)
    # Rounding puts spots on edges just outside all triangles: their values are clipped, their derivatives are not.
    valid = jnp.maximum(weight, 0)
    weight = weight + jax.lax.stop_gradient(valid / jnp.sum(valid) - weight)
    within = _within(still[plane.edge], fixed)
    weight = jnp.where(within, weight, jnp.stack([1 - along, along, jnp.zeros_like(along)]))
    index = jnp.where(within, triangle, edge[jnp.array([0, 1, 0])])
    return jnp.zeros(len(point), weight.dtype).at[index].add(weight)


def _checked(coordinate: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Coordinates as floating-point numbers; infinite ones are far away."""
    value = jnp.asarray(coordinate, jnp.result_type(float))
    if value.shape != shape:
        kind = "two coordinates" if shape else "one coordinate, a number,"
        raise ValueError(f"a point of this set has {kind} not an array of shape {list(value.shape)}")
    return jnp.clip(value, -_FAR, _FAR)


def _clip(value: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """As jnp.clip, but at the ends with the derivative of the inside."""
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


@functools.partial(jit, static_argnums=0)
def _scaled(chart: Callable[[Array], Array], point: Array, coordinate: Array) -> Array:
    """Coordinates in the chart, those of the points from 0 to 1."""
    low, high = jnp.min(chart(point), 0), jnp.max(chart(point), 0)
    return (chart(coordinate) - low) / jnp.where(high > low, high - low, 1)


def _cross(first, second):
    return first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]


def _area(corner):
    """Twice the area of triangles, positive for counter-clockwise ones, and the sum of two sides squared."""
    u, v = corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :]
    return _cross(u, v), (u**2 + v**2).sum(-1)


def _barycentric(corner: Array, spot: Array) -> tuple[Array, Array]:
    """Barycentric coordinates in triangles, and whether these are too thin to have any; linear in the spot."""
    area, size = _area(corner)
    flat = area <= _ROUNDING / 4 * jnp.finfo(area.dtype).eps * size
    start = corner[..., 0, :]
    part = [_cross(spot - start, corner[..., 2, :] - start), _cross(corner[..., 1, :] - start, spot - start)]
    second, third = jnp.stack(part) / jnp.where(flat, 1, area)
    return jnp.stack([1 - second - third, second, third], -1), flat


def _project(segment: Array, spot: Array) -> tuple[Array, Array]:
    """The nearest points of segments: how far along they lie, from 0 to 1, and where they are."""
    start, way = segment[..., 0, :], segment[..., 1, :] - segment[..., 0, :]
    square = jnp.sum(way**2, -1)
    along = _clip(jnp.sum((spot - start) * way, -1) / jnp.where(square > 0, square, 1), 0, 1)
    return along, start + along[..., None] * way


def _within(edge: Array, spot: Array) -> Array:
    """Whether a spot is on the left of all edges: rounding leaves cracks between triangles, not in the hull."""
    start, way = edge[:, 0], edge[:, 1] - edge[:, 0]
    slack = 8 * jnp.finfo(spot.dtype).eps * jnp.sqrt(jnp.sum(way**2, -1))
    return jnp.all(_cross(way, spot - start) >= -slack)
