"""Division of polygons into triangles."""

import numpy as np
import pytest

from jaxprt.scene import load_mesh
from jaxprt.scene.formats import geometry
from jaxprt.scene.formats.geometry import Polygons

L_SHAPE = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, -1], [1, 0, -1], [1, 0, -2], [0, 0, -2]])  # area 3, front +y
DART = np.array([[0.0, 0, 0], [2, 0, -1], [0, 0, -2], [1, 0, -1]])  # area 1, concave at the last corner


def triangle_areas(position, triangle):
    """Vector areas [t 3] of triangles."""
    first, second, third = position[triangle].swapaxes(0, 1)
    return np.cross(second - first, third - first) / 2


def vector_area(polygon):
    """Newell's vector area of a polygon."""
    edge = polygon - polygon[0]
    return np.cross(edge[1:-1], edge[2:]).sum(0) / 2


def divided(polygon):
    return geometry.triangulate(polygon, geometry.polygons_of_rows(np.arange(len(polygon))[None]), "file").corner


def star(rng, corners):
    """A simple polygon in a random plane, which is concave nearly always."""
    angle = (np.arange(corners) + rng.uniform(0, 0.9, corners)) * 2 * np.pi / corners
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1) * rng.uniform(0.1, 1, (corners, 1))
    return flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0]


def assert_covers(polygon, triangle, tolerance=1e-9):
    area = triangle_areas(polygon, triangle)
    total = vector_area(polygon)
    size = np.linalg.norm(total)
    np.testing.assert_allclose(area.sum(0), total, rtol=0, atol=tolerance * size)
    np.testing.assert_allclose(np.linalg.norm(area, axis=1).sum(), size, rtol=tolerance)


@pytest.mark.parametrize("shape", [L_SHAPE, DART])
@pytest.mark.parametrize("flip", [False, True])
def test_concave_polygons_keep_area_and_orientation_from_every_first_corner(shape, flip):
    for turn in range(len(shape)):
        polygon = np.roll(shape[::-1] if flip else shape, turn, axis=0)
        triangle = divided(polygon)
        assert triangle.shape == (len(shape) - 2, 3)
        assert_covers(polygon, triangle)


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize("corners", [5, 8, 40, 3000])
def test_simple_polygons_of_any_size_keep_their_area(scale, corners):
    rng = np.random.default_rng(corners)
    for _ in range(20 if corners < 100 else 1):
        polygon = star(rng, corners) * scale
        assert_covers(polygon, divided(polygon))


def test_repeated_corners_and_corners_on_a_line_keep_the_area():
    rng = np.random.default_rng(0)
    for corners in (5, 9, 20):
        polygon = star(rng, corners)
        middle = (polygon + np.roll(polygon, -1, axis=0)) / 2
        line = np.stack([polygon, middle], 1).reshape(-1, 3)
        assert_covers(line, divided(line))
        repeated = np.repeat(polygon, rng.integers(1, 4, corners), axis=0)
        assert_covers(repeated, divided(repeated))


def test_convex_polygons_are_fans_and_quadrilaterals_are_cut_between_their_first_and_third_corner():
    angle = np.arange(7) * 2 * np.pi / 7
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    np.testing.assert_array_equal(divided(circle), [[0, i, i + 1] for i in range(1, 6)])
    np.testing.assert_array_equal(divided(circle[[0, 2, 4, 6]]), [[0, 1, 2], [0, 2, 3]])
    skew = np.array([[0.0, 0, 0], [1, 0, 0.3], [1, 1, 0], [0, 1, 0.3]])
    np.testing.assert_array_equal(divided(skew), [[0, 1, 2], [0, 2, 3]])


def test_polygons_without_area_or_with_crossing_edges_have_triangles_of_existing_corners():
    bow_tie = np.array([[0.0, 0, 0], [1, 1, 0], [1, 0, 0], [0, 1, 0]])
    pentagram = np.array([[np.cos(k * 4 * np.pi / 5), np.sin(k * 4 * np.pi / 5), 0] for k in range(5)])
    line = np.arange(6.0)[:, None] * [1, 2, 3]
    for polygon in (bow_tie, pentagram, line, np.zeros((7, 3)), np.full((6, 3), np.nan), np.full((5, 3), 1e308)):
        triangle = divided(polygon)
        assert 0 < len(triangle) <= len(polygon) - 2
        assert triangle.min() >= 0
        assert triangle.max() < len(polygon)


def large_polygons(corners):
    """Simple polygons: a comb, a spiral, an annulus with a bridge, and a square with corners on its sides."""
    place = np.arange(corners)
    comb = np.stack([place, np.where(place % 2, 1, 100)], 1)
    yield np.concatenate([comb, [[corners, 0], [0, 0]]])[::-1]
    angle, radius = np.linspace(0, 60 * np.pi, corners // 2), np.linspace(1, 100, corners // 2)[:, None]
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    yield np.concatenate([radius * circle, ((radius + 0.5) * circle)[::-1]])
    angle = np.linspace(0, 2 * np.pi, corners // 2)
    circle = np.stack([np.cos(angle), np.sin(angle)], 1)
    yield np.concatenate([circle, 0.5 * circle[::-1]])
    side = np.arange(corners // 4) * 4 / corners
    along = np.concatenate([side, 0 * side + 1, 1 - side, 0 * side])
    square = np.stack([along, np.roll(along, corners // 4)], 1)
    square[corners // 8, 1] += 0.3
    yield square


@pytest.mark.parametrize("corners", [4000, 16_000])
def test_large_simple_polygons_keep_their_area(corners):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for flat in large_polygons(corners):
        polygon = np.pad(flat, ((0, 0), (0, 1))) @ turn
        assert_covers(polygon, divided(polygon), 1e-6)


@pytest.mark.parametrize("knot", [1, 4, 16])
def test_large_polygons_that_cross_themselves_stay_fans_at_once_with_a_warning(monkeypatch, knot):
    monkeypatch.setattr(geometry.mapbox_earcut, "triangulate_float64", lambda *_: pytest.fail("hangs"))
    corners = 48_000
    angle = np.linspace(0, 2 * np.pi, corners, endpoint=False)
    polygon = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) * np.where(np.arange(corners) % 2, 1, 0.9)[:, None]
    wound = angle[: corners // knot] * corners / 2.001
    polygon[: corners // knot] = np.stack([np.cos(wound) - 0.1, np.sin(wound), 0 * wound], 1)
    message = (
        "file: faces should not cross themselves, got 1 of 1 large ones that do, the first is face 0 of 48000 corners"
    )
    with pytest.warns(UserWarning, match=message):
        triangle = divided(polygon)
    assert (triangle[:, 0] == 0).all()
    np.testing.assert_allclose(triangle_areas(polygon, triangle).sum(0), vector_area(polygon), rtol=1e-9)


def test_polygons_of_different_sizes_stay_in_order():
    rng = np.random.default_rng(1)
    shapes = [star(rng, size) for size in (3, 6, 4, 3, 9, 5, 6)]
    size = np.array([len(shape) for shape in shapes])
    position = np.concatenate(shapes)
    triangle, polygon = geometry.triangulate(position, Polygons(np.arange(len(position)), size), "file")
    np.testing.assert_array_equal(polygon, np.repeat(np.arange(7), size - 2))
    area = triangle_areas(position, triangle)
    for index, shape in enumerate(shapes):
        np.testing.assert_allclose(area[polygon == index].sum(0), vector_area(shape), atol=1e-12)


@pytest.mark.parametrize("suffix", ["obj", "ply", "off"])
def test_a_concave_face_of_a_file_has_its_area_and_one_normal(tmp_path, suffix):
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in L_SHAPE)
    index = np.roll(np.arange(6), 2)
    header = "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    face = " ".join(map(str, index))
    text = {
        "obj": "".join(f"v {row}\n" for row in rows.splitlines()) + "f " + " ".join(str(i + 1) for i in index),
        "ply": f"{header}{rows}6 {face}\n",
        "off": f"OFF\n6 1 0\n{rows}6 {face}\n",
    }
    path = tmp_path / f"shape.{suffix}"
    path.write_text(text[suffix])
    mesh = load_mesh(path)
    area = triangle_areas(np.asarray(mesh.position, float), np.asarray(mesh.face))
    np.testing.assert_allclose(area[:, [0, 2]], 0, atol=1e-12)
    assert (area[:, 1] > 0).all()
    assert area[:, 1].sum() == pytest.approx(3)
    np.testing.assert_allclose(mesh.normal, np.tile([0, 1, 0], (6, 1)), atol=1e-6)
