import csv

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import interpolate, spatial

from jaxprt.brdf import BlinnPhong, CookTorrance, navigation, places
from jaxprt.brdf.navigation import blinn_phong, cook_torrance
from jaxprt.brdf.places import Columns, Line, Plane, columns, in_columns, triangulate
from tests.upper import pairs

STEP = 1e-6  # Of central differences in float64.
GRADIENT = 1e-7  # What they leave.
KNOT = np.array([0.5, 1.0, 3.0, 4.0, 10.0])
TABLE = "brdf/ngan2005_cooktorrance.csv"
LOG = navigation._log_roughness


def scattered(count=25, seed=0):
    """Points of units that differ by a factor of a thousand."""
    return np.random.default_rng(seed).uniform(0.1, 1, (count, 2)) * [1, 1000]


def lattice():
    return np.stack(np.meshgrid([0, 0.2, 0.5, 1], np.geomspace(0.01, 1, 5)), -1).reshape(-1, 2)


PLANES = {"scattered": (scattered, None), "lattice": (lattice, None), "lattice in a chart": (lattice, LOG)}
each_plane = pytest.mark.parametrize("kind", PLANES)
each_straight_plane = pytest.mark.parametrize("kind", ["scattered", "lattice"])


def make(kind):
    point, chart = PLANES[kind]
    return triangulate(point(), **{"chart": chart} if chart else {})


@jax.jit
def _look(plane, spot):
    def each(spot):
        weight, pull = jax.vjp(lambda plane, spot: plane.weight(spot), plane, spot)
        ahead = jax.jacfwd(plane.weight)(spot)
        by_plane, by_spot = pull(jnp.cos(jnp.arange(len(weight), dtype=weight.dtype)))
        return weight, plane.inside(spot), ahead, by_plane.point, by_spot

    return jax.vmap(each)(spot)


@jax.jit
def _place(plane, spot):
    return jax.vmap(lambda spot: (plane.weight(spot), plane.inside(spot)))(spot)


def ask(function, plane, spot):
    """What a function has to say of spots in a plane.

    All that planes are asked is asked in one shape, with copies of what comes first: compiling is what takes time.
    """
    fields = plane.point, plane.triangle, plane.edge, np.asarray(spot, plane.point.dtype)
    point, triangle, edge, wide = (
        np.concatenate([field, np.broadcast_to(field[:1], (size - len(field), field.shape[1]))])
        for field, size in zip(fields, (90, 160, 40, 2048), strict=True)
    )
    seen = function(Plane(jnp.asarray(point), jnp.asarray(triangle), jnp.asarray(edge), plane.chart), wide)
    seen = [np.array(each)[: len(spot)] for each in seen]
    assert not np.any(seen[0][:, len(plane.point) :])
    return seen


def look(plane, spot):
    """Weights, whether inside, their derivatives, and gradients of sum_m cos(m) weight_m in the points and the spot."""
    count = len(plane.point)
    weight, within, ahead, by_point, by_spot = ask(_look, plane, spot)
    by_point[:, 0] += np.sum(by_point[:, count:], 1)
    return weight[:, :count], within, ahead[:, :count], by_point[:, :count], by_spot


def weights(plane, spot):
    return ask(_place, plane, spot)[0][:, : len(plane.point)]


def inside(plane, spot):
    return ask(_place, plane, spot)[1]


def scaled(plane, coordinate):
    """Coordinates in the chart over the extent of the points, by NumPy."""
    chart = [np.array(each, float) for each in (plane.point, coordinate)]
    if plane.chart is LOG:
        for each in chart:
            each[..., 1] = np.log(np.maximum(each[..., 1], navigation._SMOOTHEST))
    return (chart[1] - chart[0].min(0)) / np.ptp(chart[0], axis=0)


def placed(plane, spot):
    """Where weights put spots, in the scaled plane."""
    return np.asarray(weights(plane, spot), float) @ scaled(plane, plane.point)


def around(plane, count=400, seed=1):
    """Coordinates inside and outside."""
    point = np.asarray(plane.point)
    offset = 0.4 * np.ptp(point, axis=0)
    low = point.min(0) - offset
    if plane.chart is LOG:
        low[1] = 0.3 * point.min(0)[1]
    return np.random.default_rng(seed).uniform(low, point.max(0) + offset, (count, 2))


def special(plane):
    """Vertices, middles of all sides, and spots at random on them."""
    point, corner = np.asarray(plane.point), np.asarray(plane.point)[np.asarray(plane.triangle)]
    other = np.roll(corner, 1, axis=1)
    spots = [point]
    for along in (0.5, np.random.default_rng(2).uniform(0, 1, (len(corner), 3, 1))):
        spot = corner + along * (other - corner)
        if plane.chart is not places.identity:
            spot[..., 1] = (corner ** (1 - along) * other**along)[..., 1]
        spots.append(spot.reshape(-1, 2))
    return np.concatenate(spots)


def far():
    direction = np.random.default_rng(3).standard_normal((40, 2))
    return np.concatenate([direction * 10.0**power for power in (0, 3, 6, 12)])


def nearest(plane, spot, samples=4000):
    """Nearest of many spots on the hull, in the scaled plane, how far that is, and how far apart they are."""
    point = scaled(plane, plane.point)
    corner = point[spatial.ConvexHull(point).vertices]
    along = np.linspace(0, 1, samples)[:, None]
    border = np.concatenate([a + along * (b - a) for a, b in zip(corner, np.roll(corner, 1, 0), strict=True)])
    distance, index = spatial.KDTree(border).query(spot)
    return border[index], distance, 1.5 / samples


@pytest.mark.parametrize("coordinate", [0.3, [0.3], [0.3, 0.1, 0.1], [[0.3, 0.1]]])
def test_a_place_in_a_plane_has_two_coordinates(coordinate, unchecked):
    with pytest.raises(ValueError, match="a point of this set must be two coordinates, got an array of shape"):
        cook_torrance().navigation.weight(coordinate)
    with pytest.raises(ValueError, match="a point of this set must be one number, got an array of shape"):
        Line(jnp.array([1.0, 2.0])).weight([1.5])


def test_infinite_coordinates_are_far_away(unchecked):
    plane = cook_torrance().navigation
    np.testing.assert_array_equal(plane.weight([np.inf, 0.2]), plane.weight([1e30, 0.2]))
    np.testing.assert_array_equal(Line(jnp.array([1.0, 2.0])).weight(-np.inf), [1, 0])


# Lines.


line = jax.jit(jax.vmap(lambda knot, spot: Line(knot).weight(spot), (None, 0)))
line_slope = jax.jit(jax.vmap(jax.jacrev(lambda knot, spot: Line(knot).weight(spot), (0, 1)), (None, 0)))


def test_a_line_interpolates_as_numpy_does(x64, close):
    spot = np.concatenate([np.linspace(-2, 12, 57), KNOT, [-1e6, 1e6]])
    close(line(jnp.asarray(KNOT), spot), np.stack([np.interp(spot, KNOT, unit) for unit in np.eye(5)], -1))
    within = jax.vmap(Line(jnp.asarray(KNOT)).inside)(jnp.asarray(spot))
    np.testing.assert_array_equal(within, (spot >= 0.5) & (spot <= 10))


def test_derivatives_along_a_line_are_finite_differences(x64, close):
    spot = np.array([-1.0, 0.7, 3.5, 9.0, 11.0])
    by_knot, by_spot = line_slope(jnp.asarray(KNOT), spot)
    knot = jnp.asarray(KNOT)
    close(by_spot, (line(knot, spot + STEP) - line(knot, spot - STEP)) / (2 * STEP), tolerance=GRADIENT)
    for index, unit in enumerate(STEP * np.eye(5)):
        slope = (line(jnp.asarray(KNOT + unit), spot) - line(jnp.asarray(KNOT - unit), spot)) / (2 * STEP)
        close(by_knot[..., index], slope, tolerance=GRADIENT)


def test_derivatives_at_the_knots_of_a_line_are_those_of_one_side(x64, close):
    side = np.diff(np.eye(5), axis=0) / np.diff(KNOT)[:, None]
    close(line_slope(jnp.asarray(KNOT), KNOT)[1], side[[0, 1, 2, 3, 3]])


# Planes.


@each_plane
def test_weights_are_not_negative_and_sum_to_one_and_all_is_finite_everywhere(kind, close):
    plane = make(kind)
    weight, _, *derivative = look(plane, np.concatenate([around(plane), special(plane), far()]))
    assert np.all(weight >= 0)
    close(np.sum(weight, -1), np.ones(len(weight)))
    assert np.max(np.sum(weight > 0, -1)) <= 3
    for each in derivative:
        assert np.all(np.isfinite(each))


def test_weights_inside_are_those_of_scipy(x64, close):
    plane = make("scattered")
    value = np.random.default_rng(4).standard_normal((len(plane.point), 3))
    spot = around(plane, 2000)
    expected = interpolate.LinearNDInterpolator(scaled(plane, plane.point), value)(scaled(plane, spot))
    known = np.isfinite(expected[:, 0])
    np.testing.assert_array_equal(inside(plane, spot), known)
    assert 200 < np.sum(known) < 1800
    close((weights(plane, spot) @ value)[known], expected[known])


@each_plane
def test_weights_put_what_is_inside_where_it_is_and_what_is_outside_at_the_nearest_point_of_the_hull(kind, x64, close):
    plane = make(kind)
    spot = around(plane, 1000)
    found, goal, within = placed(plane, spot), scaled(plane, spot), inside(plane, spot)
    assert 100 < np.sum(within) < 900
    close(found[within], goal[within])
    expected, distance, apart = nearest(plane, goal[~within])
    length = np.linalg.norm(found - goal, axis=-1)[~within]
    assert np.all(length <= distance + 1e-12)
    assert np.all(length >= distance - apart)
    np.testing.assert_allclose(found[~within], expected, atol=apart)


@each_plane
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_points_and_edges_are_inside_though_rounded(kind, dtype):
    with jax.enable_x64(dtype == "float64"):
        plane = make(kind)
        bound = 100 * np.finfo(dtype).eps
        np.testing.assert_allclose(weights(plane, plane.point), np.eye(len(plane.point)), atol=bound)
        assert np.all(inside(plane, special(plane)))
        np.testing.assert_allclose(placed(plane, special(plane)), scaled(plane, special(plane)), atol=bound)


@each_plane
def test_derivatives_are_finite_differences_inside_and_outside(kind, x64, close):
    plane = make(kind)
    spot = np.concatenate([around(plane, 6, seed=5), np.mean(plane.point[plane.triangle], 1)[:3]])
    unit = STEP * np.ptp(plane.point, axis=0)
    _, within, ahead, by_point, by_spot = look(plane, spot)
    assert 0 < np.sum(within[:6]) < 6
    for axis in (0, 1):
        step = np.eye(2)[axis] * unit
        slope = (weights(plane, spot + step) - weights(plane, spot - step)) / 2
        close(ahead[..., axis] * unit[axis], slope, tolerance=1e-6)
        close(by_spot[:, axis] * unit[axis], slope @ np.cos(np.arange(len(plane.point))), tolerance=1e-6)
    move = np.random.default_rng(10).standard_normal(plane.point.shape) * unit
    up, down = (weights(eqx.tree_at(lambda p: p.point, plane, plane.point + m), spot) for m in (move, -move))
    close(np.sum(by_point * move, (1, 2)), (up - down) @ np.cos(np.arange(len(plane.point))) / 2, tolerance=1e-5)


@each_straight_plane
def test_derivatives_on_edges_and_at_vertices_are_those_of_a_side(kind, x64):
    """Weights put a spot where it is, so that its place has the identity for a derivative."""
    plane = make(kind)
    extent = np.ptp(plane.point, axis=0)
    found = np.einsum("sma,mb->sab", look(plane, special(plane))[2] * extent, plane.point / extent)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(2), found.shape), atol=1e-9)


def test_derivatives_outside_are_along_the_edge_and_zero_at_a_vertex(x64, close):
    plane = triangulate(np.array([[0.0, 0], [1, 0], [0, 1]]))
    weight, within, ahead, *_ = look(plane, np.array([[0.3, -2.0], [-1.0, -2.0], [2.0, 1.0], [2.0, 2.0]]))
    close(weight, np.array([[0.7, 0.3, 0], [1, 0, 0], [0, 1, 0], [0, 0.5, 0.5]]))
    assert not np.any(within)
    close(ahead[0], np.array([[-1.0, 0], [1, 0], [0, 0]]))
    close(ahead[1], np.zeros((3, 2)))
    close(ahead[3], np.array([[0, 0], [0.5, -0.5], [-0.5, 0.5]]))


@each_plane
def test_triangles_cover_the_hull_once_and_edges_surround_it(kind, x64):
    plane = make(kind)
    point, triangle, edge = scaled(plane, plane.point), np.asarray(plane.triangle), np.asarray(plane.edge)
    u, v = (point[triangle[:, i]] - point[triangle[:, 0]] for i in (1, 2))
    area = (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    assert np.all(area > 0)
    hull = spatial.ConvexHull(point)
    assert np.sum(area) == pytest.approx(hull.volume)
    assert np.sum(np.linalg.norm(point[edge[:, 1]] - point[edge[:, 0]], axis=-1)) == pytest.approx(hull.area)
    start, way = point[edge[:, 0]], point[edge[:, 1]] - point[edge[:, 0]]
    off = point[triangle].mean(1)[:, None] - start
    assert np.all(way[:, 0] * off[..., 1] > way[:, 1] * off[..., 0])


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_slivers_along_the_hull_are_no_trouble(dtype):
    along = np.stack([np.linspace(-0.1, 1.1, 200), np.zeros(200)], -1)
    for height in (0.0, 1e-17, 1e-8):
        point = np.array([[0, 0], [0.3, height], [0.7, -height], [1, 0], [0.5, 1], [0.4, 0.5], [0.2, 0.4]])
        with jax.enable_x64(dtype == "float64"):
            plane = triangulate(point)
            assert set(np.unique(plane.triangle)) == set(range(7))
            weight, _, *derivative = look(plane, np.concatenate([along, special(plane), around(plane), far()]))
        assert weight.dtype == dtype
        assert np.all(weight >= 0)
        np.testing.assert_allclose(np.sum(weight, -1), 1, atol=1e-6)
        assert all(np.all(np.isfinite(each)) for each in derivative)
        if height < np.finfo(dtype).eps:
            # Along the row the weights are those of a line.
            expected = np.stack([np.interp(along[:, 0], [0, 0.3, 0.7, 1], unit) for unit in np.eye(4)], -1)
            np.testing.assert_allclose(weight[:200, :4], expected, atol=20 * np.finfo(dtype).eps)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ([[0, 0], [1, 1]], r"at least three pairs of coordinates, got an array of shape \(2, 2\)"),
        ([[0, 0], [1, 0], [np.nan, 1], [0, np.inf]], r"finite, got 2 that are not, the first is point 2 at \(nan, 1\)"),
        ([[0, 0], [1, 2], [2, 4], [3, 6]], r"must not all lie on one line, got 4 that do"),
        ([[0, 0], [1, 0], [0, 1], [1, 0]], r"not coincide, got point 1 at \(1, 0\) and point 3 at \(1, 0\)"),
        ([[0, 0], [1, 0], [0, 1], [1, 1e-9]], r"not coincide, got point 1 at \(1, 0\) and point 3 at \(1, 1e-09\)"),
    ],
)
def test_points_that_make_no_plane_are_refused(point, message, unchecked):
    with pytest.raises(ValueError, match=message):
        triangulate(np.array(point, float))


# Columns.


def staggered():
    """F0 and m: three columns, of which the middle one has knots of its own; in any order."""
    knot, other = [0.02, 0.1, 0.3, 1.0], [0.02, 0.05, 0.2, 0.6, 1.0]
    point = [(f0, m) for f0, column in ((0.0, knot), (0.3, other), (1.0, knot)) for m in column]
    return np.random.default_rng(7).permutation(np.array(point))


@jax.jit
def _column_look(columns, spot):
    def each(spot):
        by_point = jax.jacrev(lambda point: eqx.tree_at(lambda c: c.point, columns, point).weight(spot))(columns.point)
        return columns.weight(spot), columns.inside(spot), jax.jacfwd(columns.weight)(spot), by_point

    return jax.vmap(each)(spot)


def by_numpy(point, spot):
    """Weights by columns: linear in log m along each, then in F0."""
    value = np.zeros((len(spot), len(point)))
    f0 = np.unique(point[:, 0])
    part = np.stack([np.interp(spot[:, 0], f0, unit) for unit in np.eye(len(f0))], -1)
    for number, each in enumerate(f0):
        own = np.flatnonzero(point[:, 0] == each)
        own = own[np.argsort(point[own, 1])]
        for index, unit in zip(own, np.eye(len(own)), strict=True):
            along = np.interp(np.log(spot[:, 1]), np.log(point[own, 1]), unit)
            value[:, index] = part[:, number] * along
    return value


def test_columns_interpolate_along_each_and_then_between_two(x64, close):
    """Everywhere, at points, on the borders of cells and outside; weights sum to one and derivatives are finite."""
    point = staggered()
    plane = columns(point, chart=LOG)
    random = np.random.default_rng(1)
    inner = np.stack([random.uniform(-0.2, 1.2, 200), np.exp(random.uniform(np.log(0.01), np.log(2), 200))], -1)
    border = np.stack([random.permutation(point[:, 0]), random.permutation(point[:, 1])], -1)
    spot = np.concatenate([inner, point, border, far() * [1, 0] + [0, 0.1]])
    weight, within, ahead, by_point = _column_look(plane, spot)
    close(weight, by_numpy(point, spot))
    close(weight[200 : 200 + len(point)], np.eye(len(point)))
    assert np.all(np.asarray(weight) >= 0)
    assert np.max(np.sum(np.asarray(weight) > 0, -1)) == 4
    close(np.sum(weight, -1), np.ones(len(spot)))
    between = (spot[:, 0] >= 0) & (spot[:, 0] <= 1) & (spot[:, 1] >= 0.02) & (spot[:, 1] <= 1)
    np.testing.assert_array_equal(within, between)
    assert np.all(np.isfinite(ahead))
    assert np.all(np.isfinite(by_point))
    for axis, unit in enumerate(STEP * np.eye(2)):
        up, down = (_column_look(plane, spot + step)[0][:200] for step in (unit, -unit))
        close(ahead[:200, :, axis], (up - down) / (2 * STEP), tolerance=1e-6)
    # At the border of cells the derivative is that of the side above, at the last column and row that of the inside.
    above = 1e-7 * np.where(border >= 1, -1, 1)
    rows = slice(200 + len(point), 200 + 2 * len(point))
    close(
        ahead[rows],
        _column_look(plane, np.concatenate([spot[: -len(border)], border + above]))[2][-len(border) :],
        tolerance=1e-4,
    )


def test_a_place_in_a_row_between_two_columns_has_weight_from_its_two_ends_alone(close):
    """Triangles gave most of (0.3, 0.354) to a roughness of 0.25."""
    point = np.array([(f0, m) for f0 in (0.0, 1.0) for m in (0.05, 0.12, 0.25, 0.5)])
    plane = cook_torrance(point=point).navigation
    assert isinstance(plane, Columns)
    close(plane.weight(jnp.array([0.3, 0.25])), np.array([0, 0, 0.7, 0, 0, 0, 0.3, 0]))
    half = np.array([0, 0, 0.35, 0.35, 0, 0, 0.15, 0.15])
    close(plane.weight(jnp.array([0.3, np.sqrt(0.25 * 0.5)])), half)


def test_scattered_points_keep_their_triangles(unchecked):
    ragged = lattice()[:-1]
    assert not in_columns(ragged, chart=LOG)
    assert not in_columns(scattered())
    assert isinstance(cook_torrance(point=ragged).navigation, Plane)
    assert isinstance(cook_torrance(point=lattice()).navigation, Columns)
    with pytest.raises(ValueError, match=r"at least two columns.*; got 19 points with 4 different first coordinates"):
        columns(ragged)
    with pytest.raises(ValueError, match="at least three pairs of coordinates"):
        columns(np.zeros((2, 2)))


# Families.


def values(family, wi, wo):
    """All BRDFs of a family, [m, q]."""
    stacked = jax.tree.map(lambda *leaf: np.stack(leaf), *family.brdf)
    return jax.jit(jax.vmap(lambda brdf: brdf(wi, wo)[..., 0]))(stacked)


def test_blinn_phong_is_that_model_at_integers_and_the_mean_of_two_between(close):
    family = blinn_phong()
    assert isinstance(family.navigation, Line)
    assert len(family.brdf) == len(family.name) == 200
    assert family.name[199] == "exponent 200"
    wi, wo = map(jnp.asarray, np.float32(pairs(200, seed=8)))
    value = values(family, wi, wo)
    model = jax.jit(lambda n: BlinnPhong(diffuse=0.0, specular=1.0, exponent=n)(wi, wo)[:, 0])
    for coordinate, expected in (
        (37.0, model(37.0)),
        (np.sqrt(37.0 * 38.0), (model(37.0) + model(38.0)) / 2),
        (0.2, model(1.0)),
        (1e6, model(200.0)),
    ):
        close(family.navigation.weight(coordinate) @ value, expected)
    np.testing.assert_array_equal(family.diffuse, np.zeros((200, 3)))
    np.testing.assert_array_equal(family.specular, np.ones((200, 3)))


@pytest.mark.parametrize("exponents", [[], [5], [1, 1], [-1, 2], [1, np.nan], [[1, 2]]])
def test_exponents_that_are_no_knots_are_refused(exponents, unchecked):
    with pytest.raises(ValueError, match="exponents must be at least two finite increasing numbers from 0 up, got"):
        blinn_phong(exponents=exponents)


def lobes(f0, roughness):
    """Cook-Torrance lobes at half vectors that resolve all roughnesses, [m, q], and cos_i cos_o dwi dwo, [q]."""
    slope, phi = np.meshgrid(np.geomspace(1e-3, 30, 60), (np.arange(6) + 0.5) * np.pi / 6, indexing="ij")
    cosine = 1 / np.hypot(1, slope)
    half = np.stack([slope * cosine * np.cos(phi), slope * cosine * np.sin(phi), cosine], -1)
    node, gauss = np.polynomial.legendre.leggauss(3)
    theta = (node[:, None, None, None] + 1) * np.pi / 4
    wo = np.concatenate([np.sin(theta), 0 * theta, np.cos(theta)], -1)
    cos_d = np.sum(wo * half, -1)
    wi = 2 * cos_d[..., None] * half - wo
    # dwi = 4 cos_d dwh, and the solid angle of half vectors is cosine^3 slope^2 d(log slope) dphi.
    weight = np.where((cos_d > 0) & (wi[..., 2] > 0.01), cos_d * wi[..., 2], 0) * cosine**3 * slope**2
    weight = weight * wo[..., 2] * wo[..., 0] * gauss[:, None, None]
    wi, wo = jnp.asarray(wi), jnp.broadcast_to(wo, wi.shape)
    model = jax.jit(jax.vmap(lambda f0, m: CookTorrance(0.0, 1.0, m, f0)(wi, wo)))
    return np.asarray(model(f0[:, None], roughness)).reshape(len(f0), -1), weight.ravel()


def rms(found, expected, weight):
    return np.sqrt(np.sum((found - expected) ** 2 * weight, -1) / np.sum(expected**2 * weight, -1))


def test_the_grid_is_as_near_to_the_model_as_it_says(x64):
    family = cook_torrance()
    point = np.asarray(family.navigation.point)  # pyright: ignore[reportAttributeAccessIssue]
    assert len(family.brdf) == len(family.name) == len(point) == 49
    assert family.name[16:18] == ("F0 0.3, m 0.02", "F0 0.3, m 0.0228")
    random = np.random.default_rng(9)
    spot = np.stack([random.uniform(0, 1, 200), np.exp(random.uniform(np.log(0.02), 0, 200))], -1)
    (value, weight), (expected, _) = lobes(*point.T), lobes(*spot.T)
    found, within, *_ = _column_look(family.navigation, spot)
    error = rms(found @ value, expected, weight)
    assert np.all(within)
    assert np.mean(error) < 0.02
    assert np.max(error) < 0.06
    np.testing.assert_array_equal(family.diffuse, np.zeros((49, 3)))
    np.testing.assert_array_equal(family.specular, np.ones((49, 3)))


@pytest.fixture(scope="module")
def table(data):
    return data / TABLE


@pytest.fixture(scope="module")
def measured(table):
    return cook_torrance(path=table)


def test_all_measured_materials_are_in_the_plane_at_their_own_place(table, measured, close):
    with open(table, newline="") as file:
        row = list(csv.DictReader(file))
    assert len(row) == len(measured.brdf) == 86
    assert list(measured.name) == [line["material"] for line in row]
    place = jnp.array([[float(line["F0"]), float(line["m"])] for line in row])
    close(measured.navigation.point, place)
    np.testing.assert_allclose(weights(measured.navigation, place), np.eye(86), atol=1e-4)
    parameter = [(brdf.f0[0], brdf.roughness, brdf.diffuse[0], brdf.specular[0]) for brdf in measured.brdf]
    np.testing.assert_array_equal(parameter, [(f0, m, 0, 1) for f0, m in np.asarray(place)])
    assert measured.navigation.chart is LOG
    specular = [[float(line[f"ks_{color}"]) for color in "rgb"] for line in row]
    close(measured.specular, np.array(specular) * [1, 1.15, 1.66], tolerance=1e-6)


HEADER = "material,kd_r,kd_g,kd_b,ks_r,ks_g,ks_b,m,F0\n"
GOOD = ["a,.1,.1,.1,.2,.2,.2,.1,.5\n", "b,.1,.1,.1,.2,.2,.2,.2,.5\n", "c,.3,.2,.1,.3,.2,.1,.3,.9\n"]


def write(tmp_path, text):
    path = tmp_path / "table.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_columns_may_be_in_any_order_with_others_between(tmp_path, close):
    text = "\ufeffF0, m,note,kd_r,kd_g,kd_b,ks_r,ks_g,ks_b,material\r\n"
    text += ".5, .1,x,.1,.1,.1,.2,.2,.2,a\r\n\r\n.5,.2,,.1,.1,.1,.2,.2,.2, b\r\n.9,.3,,.3,.2,.1,.3,.2,.1,c\r\n"
    found, expected = (cook_torrance(path=write(tmp_path, text)) for text in (text, HEADER + "".join(GOOD)))
    assert found.name == expected.name == ("a", "b", "c")
    jax.tree.map(close, found, expected)
    close(found.diffuse[2], np.array([0.3, 0.23, 0.166]))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"the first row must name material, kd_r.*, got an empty file"),
        ("material,kd_r,kd_g,ks_r,ks_g,ks_b,m\n", r"must name .*, got a file without kd_b, F0"),
        (HEADER + GOOD[0] + GOOD[1], r"at least three materials, got 2"),
        (HEADER + GOOD[0] + "b,.1,.1,x,.2,.2,.2,.2,.5\n" + GOOD[2], r"line 3: kd_b must be a number, got 'x'"),
        (HEADER + GOOD[0] + "b,.1,.1,.1,.2,.2,.2,.2\n" + GOOD[2], r"line 3: F0 must be a number, got nothing"),
        (HEADER + "a,0,1,0,1,.1,.1,.2,.2,.2,.1,.5\n", r"line 2: must have as many cells as the first row, got 3 more"),
        (HEADER + "a,.1,.1,.1,.2,.2,.2,0,.5\n", r"line 2: m must be finite and positive, got 0.0"),
        (HEADER + "a,.1,.1,.1,.2,.2,.2,.1,1.5\n", r"line 2: F0 must be finite and between 0 and 1, got 1.5"),
        (HEADER + "a,.1,-.1,.1,.2,.2,.2,.1,.5\n", r"line 2: kd_g must be finite and not negative, got -0.1"),
        (HEADER + "".join(GOOD) + GOOD[1], r"line 5: every material must have one row, got 'b' again"),
        (HEADER + "".join(GOOD) + "d" + GOOD[1][1:], r"not coincide, got b at \(0.5, 0.2\) and d at \(0.5, 0.2\)"),
        (b"\xff\xfe\x00", r"table.csv: 'utf-8' codec can't decode"),
    ],
)
def test_bad_tables_of_materials_are_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=f"table.csv: .*{message.removeprefix('table.csv: ')}"):
        cook_torrance(path=write(tmp_path, text))


@each_straight_plane
def test_far_away_the_nearest_point_is_the_outermost_in_that_direction(kind):
    """In float32, the squares of distances of 1e6 would all be equal."""
    plane = make(kind)
    point, angle = np.asarray(plane.point, float), 0.1 + np.arange(40) * np.pi / 20
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    spot = point.min(0) + 1e6 * np.ptp(point, axis=0) * direction
    reach = np.max(scaled(plane, point) @ direction.T, 0)
    np.testing.assert_allclose(np.sum(placed(plane, spot) * direction, -1), reach, atol=1e-5)


def test_between_exponents_the_model_is_that_of_the_exponent_asked_for(close):
    """Weights reproduce coordinates: exponents and roughness in the logarithm, an exponent from 0 up as it is."""
    log = blinn_phong(exponents=(1.0, 8.0, 64.0)).navigation
    for exponent in (1.5, 30.0, 64.0):
        close(jnp.exp(log.weight(exponent) @ jnp.log(log.knot)), np.float32(exponent))
    plain = blinn_phong(exponents=(0.0, 8.0, 64.0)).navigation
    for exponent in (0.5, 30.0):
        close(plain.weight(exponent) @ plain.knot, np.float32(exponent))
    plane = cook_torrance().navigation
    for place in ((0.2, 0.05), (0.7, 0.333)):
        f0, log_m = plane.weight(jnp.array(place)) @ jnp.asarray(plane.chart(plane.point))
        close(jnp.stack([f0, jnp.exp(log_m)]), np.array(place))
