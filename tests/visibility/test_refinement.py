"""Refinement by shadows whose radiance is known in closed form."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt.scene import Environment
from jaxprt.scene.builtin import assemble, patch
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.visibility import refine

SIZE, ROW, COLUMN = 4, 1, 2  # the texel of the sun on the upper face: s in [0, 1/2], t in [-1/2, 0]
HEIGHT = 0.8


@pytest.fixture
def sun() -> Environment:
    """Light in one texel above."""
    radiance = np.zeros((6, SIZE, SIZE, 3))
    radiance[2, ROW, COLUMN] = [3.0, 2.0, 1.0]
    return Environment(jnp.asarray(radiance, jnp.float32))


def ground(cells=1):
    """A square of [-2, 2]^2 that faces up."""
    return assemble([patch([[[-2, 0, -2], [2, 0, -2]], [[-2, 0, 2], [2, 0, 2]]], rows=cells, columns=cells)])


def half_plane():
    """What covers all of the ground with x < 0 in the light of the sun."""
    return assemble(
        [patch([[[-3, HEIGHT, -3], [0, HEIGHT, -3]], [[-3, HEIGHT, 3], [0, HEIGHT, 3]]], rows=1, columns=1)]
    )


def radiance(x) -> np.ndarray:
    """Of a white diffuse ground under the half-plane, over that without it.

    The sun's directions (s, 1, t) pass the edge where x + HEIGHT s > 0; the cosine over the solid angle has the density
    1 / (1 + s^2 + t^2)^2.
    """
    edge = np.clip(-np.asarray(x) / HEIGHT, 0, 0.5)
    s, t = (np.arange(2000) + 0.5) / 4000, -(np.arange(400) + 0.5) / 800
    density = np.sum(1 / (1 + s[:, None] ** 2 + t**2) ** 2, 1)
    beyond = np.append(np.cumsum(density[::-1])[::-1], 0)
    return np.interp(edge, np.linspace(0, 0.5, 2001), beyond) / beyond[0]


def interpolated(mesh, value, point) -> np.ndarray:
    """Values of the vertices of a flat mesh at points of it."""
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)][:, :, ::2]
    side = np.linalg.inv(np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2))
    weight = np.einsum("fab,fpb->fpa", side, point[None, :, ::2] - corner[:, :1])
    weight = np.concatenate([1 - weight.sum(-1, keepdims=True), weight], -1)
    triangle = np.argmax(weight.min(-1), 0)
    weight = weight[triangle, np.arange(len(point))]
    assert weight.min() > -1e-6
    return np.sum(weight * np.asarray(value)[np.asarray(mesh.face)[triangle]], 1)


def true_error(mesh) -> float:
    """Relative L2 of the exact radiance of vertices interpolated, over random points of the ground."""
    point = np.random.default_rng(0).uniform(-2, 2, (1500, 3)) * [1, 0, 1]
    exact = radiance(point[:, 0])
    found = interpolated(mesh, radiance(np.asarray(mesh.position)[:, 0]), point)
    return float(np.linalg.norm(found - exact) / np.linalg.norm(exact))


@pytest.mark.parametrize("error", [0.1, 0.02])
def test_error_is_kept_at_points_that_were_not_traced(sun, error):
    mesh = refine(ground(), error=error, environments=[sun], occluder=half_plane(), progress=False)
    assert 0.3 * error < true_error(mesh) < error


def test_vertices_are_where_the_shadow_ends(sun):
    mesh = refine(ground(), error=0.02, environments=[sun], occluder=half_plane(), progress=False)
    uniform = ground(round(len(mesh.position) ** 0.5) - 1)
    assert true_error(mesh) < 0.4 * true_error(uniform)
    x = np.asarray(mesh.position)[:, 0]
    # The penumbra is a tenth of the ground.
    assert np.mean((x >= -HEIGHT / 2) & (x <= 0)) > 0.3


def test_nothing_is_divided_where_nothing_is_shadowed(sun):
    alone = ground(3)
    for lights in ([sun], None):
        assert refine(alone, error=0.0, environments=lights, vertices=50, progress=False) is alone
    lower = make_mesh(np.asarray(alone.position), np.asarray(alone.face)[:, ::-1])
    sheet = join([alone, lower])  # Each side has its own light.
    assert refine(sheet, error=0.0, vertices=100, environments=[sun], progress=False) is sheet
    dark = Environment(jnp.zeros((6, 2, 2, 3)))
    assert refine(alone, error=0.0, vertices=50, environments=[dark], occluder=half_plane(), progress=False) is alone
    far = ground(8)
    mesh = refine(far, error=0.02, environments=[sun], occluder=half_plane(), progress=False)
    assert len(mesh.position) > len(far.position)
    np.testing.assert_array_equal(np.asarray(mesh.position)[: len(far.position)], far.position)
    added = np.asarray(mesh.position)[len(far.position) :]
    assert np.all(np.abs(added[:, 0] + HEIGHT / 4) < HEIGHT / 4 + 1)


@pytest.mark.parametrize("sides", [1, 2])
def test_a_small_shadow_inside_of_a_large_triangle_is_found(sun, sides):
    floor = ground()
    back = make_mesh(np.asarray(floor.position), np.asarray(floor.face)[:, ::-1])
    floor = floor if sides == 1 else join([floor, back])
    lid = assemble([patch([[[0.6, 0.1, 0.5], [0.8, 0.1, 0.5]], [[0.6, 0.1, 0.7], [0.8, 0.1, 0.7]]], rows=1, columns=1)])
    options = {"error": 0.02, "environments": [sun], "progress": False}
    mesh = refine(floor, occluder=join([floor, lid]), **options)
    # In a fiftieth of the ground there were none.
    near = np.abs(np.asarray(mesh.position) - [0.67, 0, 0.63]).max(1) < 0.3
    assert np.sum(near & (np.asarray(mesh.normal)[:, 1] > 0)) > 5
    assert len(mesh.position) < 80 * sides


def test_there_are_never_more_vertices_than_allowed_and_more_never_leave_a_larger_error(sun):
    options, errors = {"environments": [sun], "occluder": half_plane(), "progress": False}, []
    for vertices in (1, 4, 17, 60, 300):
        mesh = refine(ground(), error=0.0, vertices=vertices, **options)
        assert max(4, vertices - 10) <= len(mesh.position) <= max(4, vertices)
        errors.append(true_error(mesh))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.1 * errors[0]
    limit = r"leave an error of .* above the limit of 1 %; at most 20 vertices were allowed"
    with pytest.warns(UserWarning, match=limit):
        refine(ground(), error=0.01, vertices=20, **options)


def test_both_sides_of_a_seam_are_divided_alike(sun):
    left, right = (
        assemble([patch([[[low, 0, -2], [low + 2, 0, -2]], [[low, 0, 2], [low + 2, 0, 2]]], rows=1, columns=1)])
        for low in (-2, 0)
    )
    mesh = join([left, right])
    whole = join([mesh, half_plane()])
    divided = refine(mesh, error=0.02, environments=[sun], occluder=whole, progress=False)
    assert len(divided.position) > 50
    region, position = np.asarray(divided.region), np.asarray(divided.position)
    border = [set(map(tuple, position[(region == side) & (position[:, 0] == 0)])) for side in (0, 1)]
    assert border[0] == border[1]
    assert len(border[0]) > 3
    merged = trimesh.Trimesh(position, np.asarray(divided.face), process=False)
    merged.merge_vertices()
    # One boundary loop around the ground, none at the seam.
    outline = merged.outline()
    assert len(outline.entities) == 1
    assert outline.length == pytest.approx(16)
    assert merged.area == pytest.approx(16)


def test_what_lies_inside_of_another_surface_is_divided_down_to_the_length_of_rays(sun):
    # Radiance jumps where a wall stands in the ground: no number of vertices is enough.
    wall = assemble([patch([[[0.3, -1, -1], [0.3, 1, -1]], [[0.3, -1, 1], [0.3, 1, 1]]], rows=1, columns=1)])
    small = make_mesh(1e-2 * np.asarray(ground().position), np.asarray(ground().face))
    moved = make_mesh(np.asarray(small.position) + [0.3, 0, 0], np.asarray(small.face))
    with pytest.warns(UserWarning, match="leave an error of"):
        mesh = refine(moved, error=0.002, vertices=40_000, environments=[sun], occluder=wall, progress=False)
    assert len(moved.position) < len(mesh.position) < 40_000


@pytest.mark.parametrize(
    "face", [[[0, 1, 2]], [[0, 1, 2], [0, 0, 1]], [[0, 1, 2], [0, 3, 1], [2, 2, 2]]], ids=["one", "edge", "straight"]
)
def test_one_triangle_and_triangles_without_area(sun, face):
    position = np.array([[-2.0, 0, -2], [-2, 0, 2], [2, 0, -2], [-2, 0, 0], [5, 5, 5]])
    mesh = make_mesh(position, np.array(face), normal=np.tile([0.0, 1, 0], (5, 1)))
    divided = refine(mesh, error=0.03, environments=[sun], occluder=half_plane(), progress=False)
    assert len(divided.position) > 20
    for field in ("position", "normal", "tangent"):
        assert np.isfinite(np.asarray(getattr(divided, field))).all()


def test_every_light_is_heeded(sun):
    # The other sun's shadow falls elsewhere.
    other = Environment(sun.radiance[:, ::-1, ::-1] / 100)
    options = {"error": 0.03, "occluder": half_plane(), "progress": False}
    one, two, both = (refine(ground(), environments=lights, **options) for lights in ([sun], [other], [sun, other]))
    places = [set(map(tuple, np.asarray(mesh.position))) for mesh in (one, two, both)]
    assert len(places[2]) > max(len(places[0]), len(places[1]))
    x = np.asarray(both.position)[:, 0]
    assert np.sum(x > 0.1) > 0.6 * np.sum(np.asarray(two.position)[:, 0] > 0.1)


def test_a_mesh_far_from_the_origin_and_small_is_refined_alike(sun):
    options = {"error": 0.03, "environments": [sun], "progress": False}

    def moved(each):
        return make_mesh(0.125 * np.asarray(each.position) + [16, -8, 4], np.asarray(each.face))

    far = refine(moved(ground()), occluder=moved(half_plane()), **options)
    back = make_mesh(8 * (np.asarray(far.position) - [16, -8, 4]), np.asarray(far.face))
    assert 0.3 * 0.03 < true_error(back) < 0.03


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"error": -0.1}, "error must be at least 0 and finite, got -0.1"),
        ({"error": np.nan}, "error must be at least 0 and finite, got nan"),
        ({"error": np.inf}, "error must be at least 0 and finite, got inf"),
        ({"vertices": 0}, "vertices must be at least 1, got 0"),
        ({"environments": []}, "environments must be at least one, got none"),
    ],
)
def test_bad_input_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        refine(ground(), progress=False, **options)
