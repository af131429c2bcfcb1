import functools

import numpy as np
import pytest
import trimesh

from benchmarks.published import interiors
from jaxprt import visibility
from jaxprt.scene import builtin
from jaxprt.scene.mesh import bounds, join, split

SUN = np.array([-0.62, 0.62, 0.48], np.float32) / np.float32(np.linalg.norm([-0.62, 0.62, 0.48]))  # Of the daylight.
# Least cosine between the normals of vertices and faces: in the grooves of the pieces, and where edges are rounded
# in one step of 45 degrees from flat to slanted.
GROOVES, ROUNDED, SMOOTH = 0.19, 0.84, 0.999
# Of all rays of a vertex. Starts differ by a fraction of the nudge when a region is relit apart, and at this size
# a vertex beside a groove has few texels.
APART = 0.095  # At the open rim of two walls, vertices start on the rim together and inside of it apart: measured .094.
# Of all rays, which Embree lets through exactly between two triangles.
BETWEEN = 5e-6
NUMBER = {2: "two", 4: "four", 12: "twelve"}


def pieces():
    """An object of two regions, closed unlike the board."""
    return join(split(interiors.chess_sides())[:2])


@functools.cache
def make(name):
    return {
        "sides": interiors.chess_sides,
        "room": interiors.room,
        "corner": lambda: interiors.corner(pieces()),
        "ring": interiors.ring,
        "watch": interiors.watch,
    }[name]()


@functools.cache
def occluder(name):
    return visibility.Occluder(make(name))


def blocked(name, start, direction):
    number = np.arange(len(start))
    return occluder(name).blocked(start.astype(np.float32), direction.astype(np.float32), number, number)


@functools.cache
def starts(name):
    return visibility.start_points(make(name), occluder(name))


each_scene = pytest.mark.parametrize("name", ["sides", "room", "corner", "ring"])


def surface(mesh):
    return trimesh.Trimesh(np.asarray(mesh.position, np.float64), mesh.face, process=False)


def weld(mesh):
    """Vertices in one place made one; positions are built from the same points, up to rounding."""
    _, first, place = np.unique(np.round(np.asarray(mesh.position), 6), axis=0, return_index=True, return_inverse=True)
    return trimesh.Trimesh(np.asarray(mesh.position)[first], place.reshape(-1)[np.asarray(mesh.face)], process=False)


def regions(mesh, numbers):
    return join([part for number, part in enumerate(split(mesh)) if number in numbers])


def rays(name, *, count=64):
    """Starts and directions of rays from every vertex, above its horizon; none along the lines of a grid."""
    direction = np.random.default_rng(0).normal(size=(count, 3))
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    vertex, number = np.nonzero(np.asarray(make(name).normal) @ direction.T > 0.05)
    return starts(name)[vertex], direction[number]


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("sides", [6044, 4066, 3042, 3626]),
        ("room", [1481, 2568, 1182, 1204, 1176, 1806, 573, 688, 1300, 1474, 440, 472]),
        ("ring", [3072, 7897]),
        ("watch", [2363, 5712, 529, 3721]),
    ],
)
def test_scenes_have_the_stated_vertices_and_regions(name, counts):
    mesh = make(name)
    assert np.bincount(mesh.region).tolist() == counts
    stated = getattr(interiors, {"sides": "chess_sides"}.get(name, name)).__doc__
    assert f"{sum(counts):,} vertices in {NUMBER[len(counts)]} regions" in stated


@pytest.mark.parametrize(
    ("name", "least"),
    [("sides", GROOVES), ("room", ROUNDED), ("corner", GROOVES), ("ring", SMOOTH), ("watch", ROUNDED)],
)
def test_winding_agrees_with_normals(name, least):
    mesh = make(name)
    cosine = (surface(mesh).face_normals[:, None] * np.asarray(mesh.normal)[np.asarray(mesh.face)]).sum(2)
    assert cosine.min() > least


@each_scene
def test_no_face_is_degenerate(name):
    assert surface(make(name)).area_faces.min() > 1.4e-5
    assert surface(make(name)).edges_unique_length.min() > 3e-3


@each_scene
def test_from_no_vertex_is_the_back_of_a_surface_seen(name):
    """So none starts inside of a closed thing, or beneath a floor."""
    start, direction = rays(name)
    triangle, _, _ = occluder(name).hit(start, direction)
    back = (surface(make(name)).face_normals[triangle] * direction).sum(1) > 0
    assert np.mean(back & (triangle >= 0)) < BETWEEN


@each_scene
def test_regions_relit_apart_see_what_they_see_together(name):
    """A vertex that lies in the plane of another region's faces would see nothing."""
    mesh = make(name)
    rays = occluder(name)
    parts = split(mesh)
    normal = np.concatenate([part.normal for part in parts])
    apart = np.concatenate([visibility.start_points(part, rays) for part in parts])
    together = visibility.start_points(join(parts), rays)
    moved = (apart != together).any(1)
    both = apart[moved], together[moved]
    seen = [visibility.fractional(rays, start, normal[moved], size=8)[0].sum(1).astype(int) for start in both]
    assert np.abs(seen[0] - seen[1]).max(initial=0) < APART * 16 * 3 * 8 * 8


def test_the_sides_are_the_pieces_of_the_chess_scene_on_both_sides_of_the_diagonal():
    sides, chess = make("sides"), builtin.chess()
    for field in ("position", "face", "normal", "tangent"):
        np.testing.assert_array_equal(getattr(sides, field), getattr(chess, field))
    np.testing.assert_array_equal(np.maximum(np.asarray(sides.region) - 1, 0), chess.region)
    x, _, z = np.asarray(sides.position)[np.asarray(chess.region) == 0].T
    np.testing.assert_array_equal(z > x, np.asarray(sides.region)[np.asarray(chess.region) == 0] == 1)
    assert np.abs(z - x).min() > 0.3


@pytest.mark.parametrize(
    ("name", "region", "bodies"),
    [
        *[("sides", 0, 4), ("sides", 1, 3), ("ring", 0, 1), ("watch", 1, 51)],
        *[("room", region, bodies) for region, bodies in ((1, 6), (7, 5), (8, 3), (9, 1), (10, 1), (11, 2))],
    ],
)
def test_things_are_closed_with_their_outside_out(name, region, bodies):
    whole = weld(split(make(name))[region])
    assert whole.is_watertight
    assert whole.is_winding_consistent
    parts = whole.split(only_watertight=True)
    assert len(parts) == bodies
    assert all(part.volume > 0 for part in parts)


def test_light_comes_into_the_room_through_the_front_and_the_window_only():
    start, direction = rays("room")
    inside = start[:, 0] > -2
    start, direction = start[inside].astype(float), direction[inside].astype(float)
    clear = ~blocked("room", start, direction)
    start, direction = start[clear], direction[clear]
    with np.errstate(divide="ignore"):
        ends = np.where(direction > 0, (np.array([2, 2.5, 2]) - start) / direction, ([-2, 0, -2] - start) / direction)
    axis = ends.argmin(1)
    leaving = start + ends.min(1, keepdims=True) * direction
    front = (axis == 2) & (direction[:, 2] > 0)
    _, y, z = leaving.T
    window = (axis == 0) & (direction[:, 0] < 0) & (y > 0.8) & (y < 2.1) & (z > -0.4) & (z < 1.2)
    assert np.mean(front | window) > 1 - BETWEEN
    assert 0.1 < window.mean() < 0.5


def test_a_corner_keeps_the_object_and_stands_around_it_without_touching():
    assert np.unique(make("corner").region).tolist() == [0, 1, 2, 3]
    for wrong, message in (
        (lambda: interiors.corner(builtin.plane(), cells=0), "cells must be at least 1, got 0"),
        (lambda: interiors.ring(spacing=9.0), r"spacing must be from 0.25 to 4, got 9.0"),
        (lambda: interiors.watch(step=0.01), r"step must be from 0.03 to 0.5, got 0.01"),
    ):
        with pytest.raises(ValueError, match=message):
            wrong()
    whole, floor, back, right = split(make("corner"))
    for field in ("position", "face", "normal", "tangent"):
        np.testing.assert_array_equal(getattr(whole, field), getattr(pieces(), field))
    low, high = bounds(whole)
    assert float(floor.position[:, 1].min()) == pytest.approx(low[1] - 5e-4 * np.linalg.norm(high - low), abs=1e-6)
    unit = max(high - low)
    assert float(back.position[:, 2].min()) == pytest.approx(low[2] - 0.3 * unit, rel=1e-6)
    assert float(right.position[:, 0].max()) == pytest.approx(high[0] + 0.3 * unit, rel=1e-6)
    assert float(back.position[:, 1].max()) == pytest.approx(high[1] + 0.4 * unit, rel=1e-6)
    for side, normal in ((floor, [0, 1, 0]), (back, [0, 0, 1]), (right, [-1, 0, 0])):
        assert np.mean(np.asarray(side.normal) @ normal > 0.999) > 0.9


def test_the_sun_that_the_inside_of_the_ring_mirrors_gathers_on_the_table():
    mesh = make("ring")
    turns, heights, radius = 720, 60, 0.93
    turn, height = np.meshgrid((np.arange(turns) + 0.5) * 2 * np.pi / turns, (np.arange(heights) + 0.5) * 0.5 / heights)
    turn, height = turn.ravel(), height.ravel()
    normal = -np.stack([np.cos(turn), 0 * turn, np.sin(turn)], -1)
    place = -0.99 * radius * normal + np.stack([0 * turn, height + 0.003, 0 * turn], -1)
    cosine = normal @ SUN
    lit = (cosine > 0) & ~blocked("ring", place, np.broadcast_to(SUN, place.shape))
    direction = 2 * cosine[:, None] * normal - SUN
    triangle, distance, _ = occluder("ring").hit(place.astype(np.float32), direction.astype(np.float32))
    region = np.asarray(mesh.region)[np.asarray(mesh.face)[triangle, 0]]
    x, y, z = (place + distance[:, None] * direction).T
    inside = lit & (triangle >= 0) & (region == 1) & (np.hypot(x, z) < radius)
    np.testing.assert_allclose(y[inside], 0, atol=1e-5)
    assert 0.92 < inside.sum() / lit.sum() < 0.94  # The rest meets the ring once more.
    # Light on the table in squares somewhat wider than its cells, over that of the sun itself.
    power = cosine[inside] * radius * 2 * np.pi / turns * 0.5 / heights
    gathered, _, _ = np.histogram2d(x[inside], z[inside], bins=np.arange(-1, 1.01, 0.05), weights=power)
    assert gathered.max() / (0.05**2 * SUN[1]) > 10
