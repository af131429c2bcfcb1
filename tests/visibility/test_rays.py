"""Visibility against geometry that can be worked out, and its invariances."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from jaxprt.scene import Mesh, builtin, load_mesh
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.scene.points import Points
from jaxprt.sphere import cubemap
from jaxprt.visibility import Occluder, exhaustive, fractional, point_starts, start_points

# A convex surface seen through texels that the horizon cuts, whose lower rays its own faces stop.
CUT = 0.008
SUPERSAMPLING = 3e-3
# Files of the folder of awkward meshes that are meshes.
AWKWARD = ["dragon_vrip_res3.ply", "bunny_vrip_res2.ply", "chair_model.obj", "cycloidal.ply", "busted.STL"]
AWKWARD += ["featuretype.STL", "fuze.obj", "rabbit.obj", "quadknot.obj", "negative_indices.obj", "polygonfaces.obj"]
AWKWARD += ["singlevn.obj", "soup.stl", "cube_blender_uv.ply", "tube.obj", "suzanne_facets.ply", "nancolor.obj"]
AWKWARD += ["joined_tetrahedra.obj"]
SLIVERS = 7e-3  # The same where a plane seen from its edge is thinner than a texel: no center meets it.


def trace(mesh, *, occluder=None, vertex=slice(None), size=8):
    """Sixteenths [v d] of some vertices."""
    rays = Occluder(mesh if occluder is None else occluder)
    start, normal = start_points(mesh, rays)[vertex], np.asarray(mesh.normal)[vertex]
    return fractional(rays, start, normal, size=size)[0]


def texels(size):
    """Exact integrals of the direction over the texels [d 3], and their corners [d 4 3]."""
    area = np.asarray(cubemap.vector_area(size=size), np.float64).reshape(-1, 3)
    point = np.asarray(cubemap.point(size=size), np.float64).reshape(-1, 3)
    axis = np.arange(6).repeat(size * size) // 2
    corner = np.repeat(point[:, None], 4, axis=1)
    for texel, across in enumerate([[a for a in range(3) if a != axis[t]] for t in range(len(point))]):
        corner[texel][:, across] += np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) / size
    return area, corner


def visible_fraction(mesh, seen, *, vertex=slice(None)):
    """Cosine-weighted share of the hemisphere that is seen."""
    area, _ = texels(round((seen.shape[1] / 6) ** 0.5))
    flux = np.maximum(np.asarray(mesh.normal, np.float64)[vertex] @ area.T, 0)
    return (flux * seen / 16).sum(1) / flux.sum(1)


def wholly_above(normal, size, *, margin=0.0):
    """Texels whose four corners are above the horizon [v d]."""
    _, corner = texels(size)
    corner = corner / np.linalg.norm(corner, axis=-1, keepdims=True)
    return (np.einsum("vj,dcj->vdc", np.asarray(normal, np.float64), corner) > margin).all(2)


def difference(first, second):
    """Relative L2 difference of two visibilities."""
    first, second = first.astype(float), second.astype(float)
    return np.linalg.norm(first - second) / np.linalg.norm(second)


def moved(mesh, *, scale=1.0, shift=0.0):
    position = np.asarray(mesh.position) * np.float32(scale) + np.float32(shift)
    return eqx.tree_at(lambda m: m.position, mesh, jnp.asarray(position))


def from_trimesh(mesh):
    return make_mesh(np.array(mesh.vertices), np.array(mesh.faces))


def scene():
    """A sphere that hovers over the ground: each shadows the other."""
    ground = moved(builtin.plane(cells=4), scale=2.0, shift=[0, -1.2, 0])
    return join([builtin.sphere(rings=8, sectors=12), ground])


def torus():
    return from_trimesh(trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12))


def tetrahedron():
    position = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    return make_mesh(position, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


CONVEX = {
    "fine sphere": lambda: builtin.sphere(rings=24, sectors=48),
    "cube with smooth normals": lambda: from_trimesh(trimesh.creation.box()),
    "tetrahedron": tetrahedron,
    "cylinder": lambda: from_trimesh(trimesh.creation.cylinder(0.3, 2, sections=7)),
}


@pytest.mark.parametrize("name", CONVEX)
def test_vertices_of_convex_meshes_see_their_whole_upper_hemisphere(name):
    mesh = CONVEX[name]()
    seen = trace(mesh, size=8)
    assert (seen[wholly_above(mesh.normal, 8)] == 16).all()
    assert visible_fraction(mesh, seen).min() > 1 - CUT
    area, _ = texels(8)
    assert (seen[np.asarray(mesh.normal, np.float64) @ area.T < -1e-6] == 0).all()


@pytest.mark.parametrize("half", [0.5, 1.0, 3.0])
def test_a_point_under_a_parallel_square_sees_the_analytic_share(half):
    plate = moved(builtin.plane(cells=1), scale=half, shift=[0, 0.7, 0])
    mesh = join([builtin.plane(cells=2), plate])
    # Askew to the cubemap: along edges that follow its rows, the error of all texels would have one sign.
    c, s = np.cos(0.4), np.sin(0.4)
    mesh = eqx.tree_at(lambda m: m.position, mesh, mesh.position @ jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    center = int(np.flatnonzero((np.asarray(mesh.position)[:9] == 0).all(1))[0])
    seen = trace(mesh, vertex=[center], size=16)
    # Form factor of a rectangle over its corner, four times.
    x = half / 0.7
    corner = 2 * x / np.sqrt(1 + x * x) * np.arctan(x / np.sqrt(1 + x * x)) / (2 * np.pi)
    assert abs(visible_fraction(mesh, seen, vertex=[center])[0] - (1 - 4 * corner)) < 2e-3


def test_the_inside_of_a_closed_box_sees_nothing():
    box = trimesh.creation.box()
    box = trimesh.Trimesh(*trimesh.remesh.subdivide(box.vertices, box.faces))
    inward = make_mesh(np.array(box.vertices), np.array(box.faces)[:, ::-1])
    assert np.sum(np.asarray(inward.normal * inward.position), 1).max() < 0
    assert not trace(inward).any()
    # With the faces' winding left as it was, the normals alone say which side counts.
    assert not trace(make_mesh(np.array(box.vertices), np.array(box.faces), normal=-np.array(box.vertices))).any()


@pytest.mark.parametrize("height", [0.05, 0.6])
def test_shading_normals_that_lean_below_their_faces_make_no_black_spots(height):
    plane = builtin.plane(cells=4)
    angle = np.linspace(0, 6, len(plane.position))
    flat = np.sqrt(1 - height**2)
    normal = np.stack([flat * np.cos(angle), np.full_like(angle, height), flat * np.sin(angle)], 1)
    mesh = make_mesh(plane.position, plane.face, normal=normal)
    inner = np.flatnonzero(np.abs(np.asarray(mesh.position)).max(1) < 0.9)
    seen = trace(mesh, vertex=inner)
    up = np.tile([0.0, 1.0, 0.0], (len(inner), 1))
    assert (seen[wholly_above(mesh.normal[inner], 8) & wholly_above(up, 8)] == 16).all()


def test_inconsistent_winding_changes_nothing_where_there_are_shadows():
    mesh = torus()
    turned = np.random.default_rng(1).random(len(mesh.face)) < 0.3
    face = np.where(turned[:, None], np.asarray(mesh.face)[:, ::-1], mesh.face)
    flipped = make_mesh(mesh.position, face, normal=mesh.normal)
    np.testing.assert_array_equal(trace(flipped), trace(mesh))


def test_faces_without_area_vertices_without_faces_and_duplicate_vertices_change_nothing():
    mesh = scene()
    face = np.concatenate([mesh.face, [[0, 0, 1], [5, 5, 5], [20, 40, 20]]])
    position = np.concatenate([mesh.position, [[0, 1e6, 0]]])
    more = make_mesh(position, face, normal=np.concatenate([mesh.normal, [[0, 1, 0]]]))
    np.testing.assert_array_equal(trace(more)[:-1], trace(mesh))
    corner = np.asarray(mesh.face).ravel()
    soup = make_mesh(
        mesh.position[corner], np.arange(len(corner)).reshape(-1, 3), normal=np.asarray(mesh.normal)[corner]
    )
    # Ends of the ground's edge have fewer faces on one side than on the other; all else is the same start.
    assert difference(trace(soup), trace(mesh)[corner]) < 1e-3


@pytest.mark.parametrize("exponent", [-12, 10])
def test_scaling_by_a_power_of_two_changes_no_bit(exponent):
    mesh = scene()
    np.testing.assert_array_equal(trace(moved(mesh, scale=2.0**exponent)), trace(mesh))


def hills(radius):
    """A ring of walls around the origin, below the horizon of what lies at a height of 0."""
    angle = np.linspace(0, 2 * np.pi, 33)[:-1]
    ring = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    start, stop = np.arange(32), (np.arange(32) + 1) % 32
    face = np.concatenate([np.stack([start, stop, stop + 32], 1), np.stack([start, stop + 32, start + 32], 1)])
    return make_mesh(np.concatenate([ring - [0, 0.01 * radius, 0], ring]), face)


@pytest.mark.parametrize("radius", [50.0, 2e4, 1e6])
def test_a_far_backdrop_changes_nothing(radius):
    # A book half a millimeter above a table: what is under it sees nothing of the sky, however large the scene is.
    table = moved(builtin.plane(cells=24), scale=0.6)
    box = trimesh.creation.box(extents=(0.2, 0.03, 0.14))
    book = make_mesh(np.array(box.vertices) + [0.003, 0.0155, 0.002], np.array(box.faces))
    near = join([table, book])
    seen = trace(near, vertex=slice(len(table.position)))
    under = (np.abs(np.asarray(table.position)) < [0.09, 1, 0.06]).all(1)
    assert under.sum() > 4
    assert not seen[under].any()
    np.testing.assert_array_equal(trace(join([near, hills(radius)]), vertex=slice(len(table.position))), seen)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-5])
def test_a_sheet_shadows_a_table_of_size_two_however_near_it_is(gap):
    table = moved(builtin.plane(cells=8))
    sheet = moved(table, scale=0.5, shift=[0, gap, 0])
    seen = trace(join([table, sheet]))[: len(table.position)]
    inside = (np.abs(np.asarray(table.position)[:, ::2]) < 0.49).all(1)
    assert inside.sum() == 9
    assert not seen[inside].any()


def test_points_of_pixels_start_as_near_to_their_triangle_as_rounding_allows():
    table, far = moved(builtin.plane(cells=1)), hills(2e4)
    for mesh in (table, join([table, far])):
        corner = np.asarray(mesh.face)[:2].T
        points = Points(jnp.asarray(corner), jnp.full(corner.shape, 1 / 3))
        np.testing.assert_allclose(point_starts(mesh, points)[:, 1], 8 * np.spacing(np.float32(1)), rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-13, 1e14, 1e30])
def test_sizes_at_which_triangles_get_lost_are_refused(scale):
    with pytest.raises(ValueError, match=r"diagonal of 1e-12 to 1e\+13 units, got 6\.07e.*: scale it"):
        trace(moved(scene(), scale=scale))


@pytest.mark.parametrize("make", [scene, torus])
def test_moving_a_thousand_sizes_away_leaves_visibility_nearly_as_it_is(make):
    mesh = make()
    far = moved(mesh, shift=[4000.0, -4000.0, 4000.0])
    assert difference(trace(far), trace(mesh)) < 0.02
    assert (visible_fraction(mesh, trace(far)) > visible_fraction(mesh, trace(mesh)) - 0.05).all()


@pytest.mark.parametrize("name", ["box", "sphere"])
def test_what_stands_on_the_ground_does_not_see_the_sky_from_beneath(name):
    if name == "box":
        box = trimesh.creation.box()
        body = make_mesh(np.array(box.vertices) + np.array([0.03, 0.5, -0.02]), np.array(box.faces))
    else:
        body = moved(builtin.sphere(rings=8, sectors=12), shift=[0, 1, 0])
    mesh = join([body, moved(builtin.plane(cells=51), scale=51.0)])
    near = np.flatnonzero(np.abs(np.asarray(mesh.position)).max(1) < 5)
    seen = trace(mesh, vertex=near)
    _, corner = texels(8)
    height = corner[..., 1].max(1)
    touching = np.asarray(mesh.position)[near, 1] < 1e-6
    assert touching[near < len(body.position)].any()
    assert not seen[np.ix_(touching, height <= 1e-6)].any()
    # From two units up, the rim of the plane is 45 away.
    assert not seen[np.ix_(~touching, height <= -2.1 / 45)].any()


def test_the_two_sides_of_a_sheet_see_their_own_halves():
    up = builtin.plane(cells=2)
    down = make_mesh(up.position, np.asarray(up.face)[:, ::-1], normal=-np.asarray(up.normal))
    mesh = join([up, down])
    seen = trace(mesh)
    assert (seen[:9][wholly_above(up.normal, 8)] == 16).all()
    assert (seen[9:][wholly_above(down.normal, 8)] == 16).all()
    assert not seen[:9][wholly_above(down.normal, 8)].any()
    assert not seen[9:][wholly_above(up.normal, 8)].any()


@pytest.mark.parametrize("scale", [0.98, 1.03])
def test_a_simplified_occluder_does_not_shadow_what_it_stands_for(scale):
    fine = builtin.sphere(rings=30, sectors=48)
    coarse = moved(builtin.sphere(rings=12, sectors=24), scale=scale)
    seen = trace(fine, occluder=coarse)
    assert visible_fraction(fine, seen).min() > 0.97


@pytest.mark.parametrize(("make", "tolerance"), [(torus, SUPERSAMPLING), (scene, SLIVERS)])
def test_supersampling_the_boundary_is_as_good_as_supersampling_everything(make, tolerance):
    mesh = make()
    vertex = np.random.default_rng(0).permutation(len(mesh.position))[:40]
    rays = Occluder(mesh)
    start, normal = start_points(mesh, rays)[vertex], np.asarray(mesh.normal)[vertex]
    seen, count = fractional(rays, start, normal, size=32)
    everything = exhaustive(rays, start, normal, size=32)
    assert difference(seen, everything) < tolerance
    assert count.rays == count.texels + 16 * count.supersampled < 0.5 * 16 * count.texels


@pytest.mark.parametrize("radius", [0.2, 0.6])
def test_a_sphere_blocks_the_disk_of_directions_that_it_subtends(radius):
    toward = np.array([0.3, 0.8, 0.5])
    toward /= np.linalg.norm(toward)
    ball = moved(builtin.sphere(rings=64, sectors=128), scale=radius, shift=toward)
    start, normal = np.zeros((1, 3), np.float32), np.array([[0, 1, 0]], np.float32)
    size = 16
    fine = np.asarray(cubemap.direction(size=4 * size), np.float64)
    # A polyhedron's outline lies between the sphere's own and that of its inscribed sphere.
    cosine = fine @ toward
    inner, outer = (np.sqrt(1 - (radius * s) ** 2) for s in (np.cos(np.pi / 64) ** 2, 1))
    least, most = (
        (cosine < c).reshape(6, size, 4, size, 4).sum((2, 4)).reshape(-1).astype(float) for c in (outer, inner)
    )
    area, _ = texels(size)
    above = area @ [0, 1, 0] > 0
    seen = exhaustive(Occluder(ball), start, normal, size=size)[0]
    assert ((seen >= least) & (seen <= most))[above].all()
    assert not seen[~above].any()
    assert np.abs(most - least).sum() < 0.02 * (16 - least).sum()


@pytest.mark.parametrize("shape", ["one triangle", "one point"])
def test_the_smallest_meshes_see_the_sky(shape):
    corner = [[0, 0, 0], [0, 0, 1], [1, 0, 0.0]] if shape == "one triangle" else [[1, 2, 3.0]] * 3
    mesh = make_mesh(np.array(corner), np.array([[0, 1, 2]]))
    assert isinstance(mesh, Mesh)
    seen = trace(mesh)
    assert (seen[wholly_above(mesh.normal, 8)] == 16).all()


def packets_and_single_rays(mesh, *, size):
    """Whether the same rays meet a triangle: by the occluder, by its last packet alone, and by embreex's own query."""
    rays = Occluder(mesh)
    start = start_points(mesh, rays)[:300]
    point, way = np.nonzero(np.asarray(mesh.normal, np.float32)[:300] @ texels(size)[0].T > 0)
    center = np.asarray(cubemap.direction(size=size), np.float32).reshape(-1, 3)
    single = EmbreeScene()
    TriangleMesh(single, rays.position, rays.face)
    expected = single.run(start[point], center[way], query="OCCLUDED") == 0
    return rays.blocked(start, center, point, way), rays.blocked(start, center, point[-5:], way[-5:]), expected


def test_packets_of_rays_answer_as_single_rays():
    found, last, expected = packets_and_single_rays(torus(), size=16)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(last, expected[-5:])
    assert 0.05 < expected.mean() < 0.95


@pytest.mark.parametrize("name", AWKWARD)
def test_packets_of_rays_answer_as_single_rays_on_awkward_meshes(data, name):
    found, last, expected = packets_and_single_rays(load_mesh(data / "meshes_awkward" / name), size=8)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(last, expected[-5:])


def test_every_awkward_mesh_is_in_the_list_or_refused(data):
    found = {path.name for path in (data / "meshes_awkward").iterdir() if path.suffix != ".mtl"}
    assert found == {*AWKWARD, "empty.obj"}
    with pytest.raises(ValueError, match=r"empty\.obj must hold vertices and faces"):
        load_mesh(data / "meshes_awkward" / "empty.obj")


def test_without_packets_visibility_is_the_same(monkeypatch):
    expected = trace(torus())
    monkeypatch.setattr("jaxprt.visibility.embree.library", lambda: None)
    np.testing.assert_array_equal(trace(torus()), expected)


def test_vertices_on_a_seam_that_rounding_splits_see_out():
    u, v = np.meshgrid(np.linspace(0, 1, 33), np.linspace(0.05, 0.95, 17))
    turn, height = 2 * np.pi * u - np.pi, np.pi * (v - 0.5)
    normal = np.stack([np.cos(height) * np.sin(turn), np.sin(height), np.cos(height) * np.cos(turn)], -1)
    assert (normal[:, 0] != normal[:, -1]).any()  # sin(pi) and sin(-pi) are not 0
    number = np.arange(33 * 17).reshape(17, 33)
    a, b, c, d = (each.ravel() for each in (number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]))
    for face in (np.stack([[*a, *a], [*b, *c], [*c, *d]], 1), np.stack([[*a, *a], [*c, *d], [*b, *c]], 1)):
        mesh = make_mesh(normal.reshape(-1, 3), face, normal=normal.reshape(-1, 3))
        start = start_points(mesh, Occluder(mesh))
        assert (np.linalg.norm(start, axis=1) > 1).all()
