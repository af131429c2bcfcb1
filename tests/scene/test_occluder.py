"""Simplified meshes against distances measured by rays and solids of known shape, volume and rim."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt.scene import builtin, load_mesh
from jaxprt.scene.mesh import bounds, ground_plane, join, make_mesh, split
from jaxprt.scene.occluder import simplify


@pytest.fixture(scope="module")
def sphere():
    """1,104 faces."""
    return builtin.sphere(rings=24, sectors=24)


def moved(mesh, *, scale=1.0, shift=0.0):
    return eqx.tree_at(lambda m: m.position, mesh, mesh.position * scale + jnp.asarray(shift, jnp.float32))


def triangle(mesh):
    """Corners [f 3 3] in float64."""
    return np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)]


def area(mesh):
    edge = np.diff(triangle(mesh), axis=1)
    return np.linalg.norm(np.cross(edge[:, 0], edge[:, 1]), axis=1).sum() / 2


def volume(mesh):
    return np.linalg.det(triangle(mesh)).sum() / 6


def edges(mesh):
    """How many faces meet at each edge, vertices told apart by their places."""
    _, place = np.unique(np.asarray(mesh.position), axis=0, return_inverse=True)
    face = place.reshape(-1)[np.asarray(mesh.face)]
    pair = np.sort(np.concatenate([face[:, [0, 1]], face[:, [1, 2]], face[:, [2, 0]]]), 1)
    return np.unique(pair, axis=0, return_counts=True)[1]


@pytest.mark.parametrize("faces", [500, 100])
def test_a_sphere_stays_a_closed_sphere(sphere, faces):
    simple = simplify(sphere, faces=faces)
    assert faces - 2 <= len(simple.face) <= faces
    np.testing.assert_array_equal(edges(simple), 2)
    # A polyhedron of f equal triangles on the sphere holds 1 - 3.6 / f of its volume.
    np.testing.assert_allclose(volume(simple), 4 / 3 * np.pi, rtol=6 / faces + 0.01)
    radius = np.linalg.norm(simple.position, axis=1)
    assert 0.99 - 6 / faces < radius.min()
    assert radius.max() < 1.02 + 1 / faces
    # Normals look out, so that rays start on the right side.
    assert np.all(np.sum(np.asarray(simple.normal * simple.position), 1) > 0.7)


def test_a_cube_of_many_faces_becomes_the_twelve_of_a_cube():
    box = trimesh.creation.box()
    for _ in range(3):
        box = box.subdivide()
    simple = simplify(make_mesh(np.array(box.vertices), np.array(box.faces)), faces=12)
    assert len(simple.face) == 12
    np.testing.assert_allclose(volume(simple), 1, rtol=1e-5)
    np.testing.assert_allclose(area(simple), 6, rtol=1e-5)


def test_the_rim_of_an_open_mesh_stays_vertex_by_vertex():
    plane = builtin.plane(cells=12)
    simple = simplify(plane, faces=60)
    assert len(simple.face) <= 60
    low, high = bounds(plane)

    def rim(mesh):
        place = np.asarray(mesh.position)
        on = ((place == low.astype(np.float32)) | (place == high.astype(np.float32)))[:, [0, 2]].any(1)
        return np.unique(np.round(place[on], 5), axis=0)

    np.testing.assert_allclose(rim(simple), rim(plane), atol=1e-5)
    np.testing.assert_allclose(area(simple), area(plane), rtol=1e-5)
    assert np.all(np.asarray(simple.normal)[:, 1] > 0.999)


def test_a_ground_of_two_triangles_survives_beside_what_is_simplified(sphere):
    ground = moved(builtin.plane(cells=1), scale=4.0, shift=[0, -1.5, 0])
    simple = split(simplify(join([sphere, ground]), faces=50))
    assert len(simple) == 2
    assert len(simple[0].face) <= 48
    np.testing.assert_allclose(
        np.sort(np.asarray(simple[1].position), 0), np.sort(np.asarray(ground.position), 0), atol=1e-5
    )
    assert len(simple[1].face) == 2


def test_faces_go_where_the_mesh_is_curved(sphere):
    ground = ground_plane(sphere, vertices=900)
    ball, floor = split(simplify(join([sphere, ground]), faces=600))
    # The rim of 30 x 30 vertices is 116 edges, and a polygon with as many takes 114 triangles.
    assert 114 <= len(floor.face) < 160
    assert len(ball.face) > 430


def test_regions_stay_where_they_were(sphere):
    both = join([moved(sphere, shift=[-2, 0, 0]), moved(sphere, shift=[2, 0, 0])])
    for number, part in enumerate(split(simplify(both, faces=400))):
        np.testing.assert_allclose(np.mean(part.position[:, 0]), 4 * number - 2, atol=0.1)
        np.testing.assert_array_equal(edges(part), 2)


def test_a_seam_between_regions_stays_closed():
    plane = builtin.plane(cells=8)
    across = np.asarray(plane.position)[np.asarray(plane.face)].mean(1)[:, 0] > 0
    halves = [
        make_mesh(plane.position, plane.face[side], region=np.full(81, n)) for n, side in ((0, ~across), (1, across))
    ]
    simple = simplify(join(halves), faces=80)
    low, high = (np.asarray(part.position) for part in split(simple))
    assert len(split(simple)) == 2
    # The eight edges in the middle: nine vertices, on both sides.
    for half in (low, high):
        middle = half[np.abs(half[:, 0]) < 1e-5]
        np.testing.assert_allclose(np.sort(middle[:, 2]), np.unique(np.asarray(plane.position)[:, 2]), atol=1e-5)
    np.testing.assert_allclose(area(simple), area(plane), rtol=1e-5)


def test_seams_of_split_vertices_do_not_hold_faces_back(sphere):
    soup = make_mesh(triangle(sphere).reshape(-1, 3), np.arange(3 * len(sphere.face)).reshape(-1, 3))
    simple = simplify(soup, faces=200)
    assert len(simple.face) <= 200
    np.testing.assert_array_equal(edges(simple), 2)


def test_the_two_sides_of_a_sheet_stay_and_what_is_beside_them_is_simplified(sphere):
    up = builtin.plane(cells=8)
    face = np.asarray(up.face)
    sheet = make_mesh(np.tile(np.asarray(up.position), (2, 1)), np.concatenate([face, face[:, ::-1] + 81]))
    np.testing.assert_allclose(area(simplify(sheet, faces=40)), 2 * area(up), rtol=1e-5)
    both = simplify(join([sheet, moved(sphere, shift=[0, 3, 0])]), faces=500)
    assert len(face) * 2 < len(both.face) <= 500
    upper = np.asarray(both.position)[np.asarray(both.face)].mean(1)[:, 1] > 1
    assert np.count_nonzero(~upper) == 2 * len(face)


@pytest.mark.parametrize("scale", [2.0**-40, 2.0**40])
def test_size_and_place_do_not_matter(sphere, scale):
    expected = simplify(sphere, faces=200)
    simple = simplify(moved(sphere, scale=scale), faces=200)
    np.testing.assert_array_equal(simple.face, expected.face)
    np.testing.assert_allclose(simple.position / scale, expected.position, atol=1e-5)
    np.testing.assert_allclose(
        volume(simplify(moved(sphere, shift=[5.0, -3, 8]), faces=200)), volume(expected), rtol=0.01
    )


def test_a_mesh_with_few_faces_is_returned_as_it_is(sphere):
    assert simplify(sphere, faces=len(sphere.face)) is sphere
    # Boundaries alone can be more than is asked for.
    plane = builtin.plane(cells=8)
    assert len(simplify(plane, faces=4).face) >= 30


def test_faces_without_area_and_vertices_without_faces_are_left_out(sphere):
    count = len(sphere.position)
    position = np.concatenate([np.asarray(sphere.position), [[50, 0, 0], [50, 0, 0], [50, 1, 0.0]]])
    line = [[count, count, count + 2], [count, count + 1, count + 2], [0, 0, 0]]
    mesh = make_mesh(position, np.concatenate([np.asarray(sphere.face), line]))
    simple = simplify(mesh, faces=300)
    assert np.abs(np.asarray(simple.position)).max() < 1.1
    np.testing.assert_array_equal(edges(simple), 2)
    with pytest.raises(ValueError, match="mesh must have at least one face with an area above 0, got 5"):
        simplify(make_mesh(np.zeros((3, 3)), np.zeros((5, 3), int)), faces=4)


def test_loose_triangles_stay(data):
    soup = load_mesh(data / "meshes_awkward" / "soup.stl")
    assert len(np.unique(np.asarray(soup.position), axis=0)) == 3 * len(soup.face)
    np.testing.assert_allclose(area(simplify(soup, faces=10)), area(soup), rtol=1e-4)


def test_a_chair_of_double_sheets_stays(data):
    chair = load_mesh(data / "meshes_awkward" / "chair_model.obj")
    simple = simplify(chair, faces=len(chair.face) // 4)
    np.testing.assert_allclose(area(simple), area(chair), rtol=1e-5)


@pytest.mark.parametrize("name", ["cycloidal.ply", "quadknot.obj"])
def test_awkward_meshes_keep_their_extent(data, name):
    mesh = load_mesh(data / "meshes_awkward" / name)
    simple = simplify(mesh, faces=len(mesh.face) // 4)
    assert np.isfinite(np.asarray(simple.position)).all()
    assert len(simple.face) < 0.6 * len(mesh.face)
    size = np.linalg.norm(np.subtract(*bounds(mesh)))
    np.testing.assert_allclose(bounds(simple), bounds(mesh), atol=0.02 * size)
