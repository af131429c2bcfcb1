import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
import trimesh

from jaxprt import brdf
from jaxprt.brdf.varying import PerVertex
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin, load_scene, subdivision
from jaxprt.scene.mesh import grid_face, make_mesh
from jaxprt.scene.subdivision import Edges


def watertight(mesh) -> bool:
    """Whether trimesh finds two triangles at every edge, where vertices at one place count as one."""
    solid = trimesh.Trimesh(np.asarray(mesh.position), np.asarray(mesh.face), process=False)
    solid.merge_vertices(merge_tex=True, merge_norm=True)
    return solid.is_watertight and solid.is_winding_consistent


def hanging(mesh, *, tolerance=2e-6) -> int:
    """How many places of vertices lie inside of an edge of a triangle: T-junctions.

    Args:
        mesh: The mesh.
        tolerance: Distance of corners at one place and of a vertex from an edge, relative to the extent.
    """
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)]
    tolerance *= np.ptp(corner.reshape(-1, 3), axis=0).max()
    tree = scipy.spatial.cKDTree(corner.reshape(-1, 3))
    start, stop = corner.reshape(-1, 3), np.roll(corner, -1, 1).reshape(-1, 3)
    length = np.linalg.norm(stop - start, axis=1)
    near = tree.query_ball_point((start + stop) / 2, length / 2)
    edge, vertex = np.repeat(np.arange(len(near)), [len(row) for row in near]), np.concatenate(near).astype(int)
    along = (stop - start)[edge] / np.where(length > 0, length, 1)[edge, None]
    away = tree.data[vertex] - start[edge]
    part = np.sum(away * along, 1)
    inside = (part > 2 * tolerance) & (part < length[edge] - 2 * tolerance)
    inside &= np.linalg.norm(away - part[:, None] * along, axis=1) < tolerance
    point = np.unique(vertex[inside])
    pairs = scipy.spatial.cKDTree(tree.data[point]).query_pairs(2 * tolerance, output_type="ndarray")
    return len(point) - len(np.unique(pairs[:, 1]))


def areas(face, corner) -> np.ndarray:
    a, b, c = np.swapaxes(np.asarray(corner, np.float64)[np.asarray(face)], 0, 1)
    return np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2


def cube():
    """A cube whose faces have vertices of their own, with creases, on [-1, 1]^3."""
    box = trimesh.creation.box(extents=[2, 2, 2])
    position = np.asarray(box.vertices)[np.asarray(box.faces)].reshape(-1, 3)
    place = position[:, :2] + 0.3 * position[:, 2:]
    return make_mesh(position, np.arange(36).reshape(-1, 3), texture=place)


def random_divisions(mesh, *, passes=4, share=0.1, seed=0) -> list:
    """Divisions at random edges."""
    rng = np.random.default_rng(seed)
    position, face, joint, result = np.asarray(mesh.position), np.asarray(mesh.face), None, []
    for _ in range(passes):
        edges = Edges(position, face, joint)
        result.append(edges.divide(edges.closed(rng.random(len(edges.length)) < share)))
        face, joint = result[-1].face, edges.joints_after(result[-1])
        position = np.concatenate([position, subdivision.middle(position, result[-1].parent)])
    return result


def shaken(mesh, *, extent=1.0, steps=2, seed=0):
    """The mesh at another extent, each triangle with corners of its own, moved by a few steps of float32."""
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)].reshape(-1, 3)
    corner = (corner * extent / np.ptp(corner, axis=0).max()).astype(np.float32)
    step = np.random.default_rng(seed).integers(-steps, steps + 1, corner.shape) * np.spacing(np.abs(corner).max())
    return make_mesh(corner + step, np.arange(len(corner)).reshape(-1, 3))


def angles(mesh) -> np.ndarray:
    corner = np.asarray(mesh.position, np.float64)[np.asarray(mesh.face)]
    return trimesh.triangles.angles(corner)


@pytest.mark.parametrize("mesh", [cube(), builtin.sphere(rings=6, sectors=9)], ids=["cube", "sphere"])
def test_a_closed_surface_stays_closed_without_hanging_vertices(mesh):
    assert watertight(mesh)
    divided = subdivision.subdivide(mesh, random_divisions(mesh))
    assert len(divided.face) > 3 * len(mesh.face)
    assert watertight(divided)
    assert hanging(divided) == 0


def test_surface_and_images_on_it_stay_where_they_are(close):
    mesh = cube()
    divisions = random_divisions(mesh)
    divided = subdivision.subdivide(mesh, divisions)
    origin = np.arange(len(divisions[-1].face))
    for each in reversed(divisions):
        origin = each.origin[origin]
    place = [np.column_stack([np.asarray(each.texture), np.zeros(len(each.texture))]) for each in (mesh, divided)]
    for before, after in ((mesh.position, divided.position), place):
        parts = np.bincount(origin, areas(divided.face, after))
        close(parts, areas(mesh.face, before), tolerance=1e-6)
    # The texture is the same function of the place on every side.
    texture = np.asarray(divided.position)[:, :2] + 0.3 * np.asarray(divided.position)[:, 2:]
    close(np.asarray(divided.texture), texture)


def test_angles_stay_above_half_of_the_smallest():
    mesh = builtin.sphere(rings=6, sectors=9)
    divided = subdivision.subdivide(mesh, random_divisions(mesh, passes=7, share=0.02))
    assert angles(divided).min() > 0.45 * angles(mesh).min()


def test_vertices_that_were_there_stay_as_they_are_and_first():
    mesh = builtin.sphere(rings=6, sectors=9)
    divided = subdivision.subdivide(mesh, random_divisions(mesh))
    for field in ("position", "normal", "tangent", "region"):
        before, after = (np.asarray(getattr(each, field)) for each in (mesh, divided))
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(after[: len(before)], before)


def test_normals_are_interpolated_as_pictures_do_and_frames_are_orthonormal(close):
    # A triangle with three different normals: at each added vertex they are mixed by its barycentric weights.
    normal = np.array([[0.6, 0.8, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.8, 0.6]])
    position = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, -1]])
    mesh = make_mesh(position, np.array([[0, 1, 2]]), normal=normal, tangent=np.tile([1.0, 0.2, 0.1], (3, 1)))
    divided = subdivision.subdivide(mesh, random_divisions(mesh, share=1.0))
    x, z = np.asarray(divided.position)[:, 0], -np.asarray(divided.position)[:, 2]
    mixed = np.stack([1 - x - z, x, z], -1) @ normal
    close(np.asarray(divided.normal), (mixed / np.linalg.norm(mixed, axis=1, keepdims=True)).astype(np.float32))
    across = np.asarray(divided.tangent)
    close(np.linalg.norm(across, axis=1), np.ones(len(x), np.float32))
    assert np.abs(np.sum(across * np.asarray(divided.normal), 1)).max() < 1e-6


def test_a_hanging_vertex_of_the_mesh_is_met_where_it_is_the_middle():
    # One triangle on one side of an edge, two on the other.
    position = np.array([[0.0, 0, 0], [2, 0, 0], [1, 0, 1], [0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, -1]])
    mesh = make_mesh(position, np.array([[0, 2, 1], [3, 4, 6], [4, 5, 6]]))
    edges = Edges(position, mesh.face)
    divided = subdivision.subdivide(mesh, [edges.divide(edges.closed(edges.length == 2))])
    assert hanging(mesh) == 1
    assert len(divided.position) == 8
    assert hanging(divided) == 0
    assert np.sum(np.bincount(Edges(divided.position, divided.face).number.ravel()) == 2) == 4


@pytest.mark.parametrize("extent", [1e-3, 1e3])
def test_sides_of_a_joint_that_rounding_moved_apart_are_divided_alike(extent):
    mesh = shaken(builtin.sphere(rings=6, sectors=9), extent=extent)
    assert len(subdivision.places(np.asarray(mesh.position))) == len(mesh.position)
    divided = subdivision.subdivide(mesh, random_divisions(mesh))
    assert len(divided.face) > 3 * len(mesh.face)
    assert hanging(mesh) == hanging(divided) == 0


def test_triangles_whose_shared_corner_differs_by_one_step_stay_joined():
    position = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0], [1, 0, 1]], np.float32)
    position[4, 0] = np.nextafter(position[4, 0], np.float32(np.inf))
    mesh = make_mesh(position, np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(subdivision.joints(position, np.arange(6).reshape(2, 3)), [[1, 4]])
    for seed in range(5):
        divided = subdivision.subdivide(mesh, random_divisions(mesh, share=0.4, seed=seed))
        assert len(divided.position) > 8
        assert hanging(divided) == 0


def test_triangles_without_area_and_doubled_ones_keep_joints_closed():
    ball = shaken(builtin.sphere(rings=6, sectors=9))
    position, face = np.asarray(ball.position), np.asarray(ball.face)
    flat = np.column_stack([face[::3, 0], face[::3, 0], face[::3, 1]])
    thin = np.column_stack([face[::4, 0], face[::4, 1], len(position) + np.arange(len(face[::4]))])
    position = np.concatenate([position, np.nextafter(position[face[::4, 1]], np.float32(2))])
    mesh = make_mesh(position, np.concatenate([face, face[::2], face[::5, ::-1], flat, thin]))
    assert hanging(mesh) == 0
    divided = subdivision.subdivide(mesh, random_divisions(mesh))
    assert len(divided.face) > 2 * len(mesh.face)
    assert hanging(divided) == 0


def test_parts_that_rounding_moved_apart_share_their_border(scene):
    left, right = scene.parts[1], scene.parts[0]
    place = np.asarray(right.mesh.position)
    moved = eqx.tree_at(lambda m: m.position, right.mesh, jnp.asarray(np.nextafter(place, np.float32(-1))))
    apart = Scene([dataclasses.replace(right, mesh=moved), left])
    assert subdivision.joints(np.asarray(apart.mesh.position), np.asarray(apart.mesh.face)).size
    for divided in (
        subdivision.divide(apart, edge=0.2),
        subdivision.subdivide_scene(apart, random_divisions(apart.mesh, passes=3)),
    ):
        assert len(divided.mesh.face) > 60
        assert hanging(divided.mesh) == 0


def test_slices_of_a_cake_stay_joined(data):
    # Slices are turned copies of one. One part is left out: in the file, corners of it lie inside of longer edges.
    scene = load_scene(data / "foreign" / "cakeBirthday.glb")
    scene = Scene([part for part in scene.parts if part.name != "brownDarkest"])
    assert len(subdivision.joints(np.asarray(scene.mesh.position), np.asarray(scene.mesh.face))) > 50
    assert hanging(scene.mesh) == 0
    divided = subdivision.subdivide(scene.mesh, random_divisions(scene.mesh, passes=3))
    assert len(divided.face) > 2 * len(scene.mesh.face)
    assert hanging(divided) == 0


def test_what_is_apart_by_more_than_rounding_is_not_joined(data):
    sheet = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    face = np.arange(6).reshape(2, 3)

    def joined(size, gap, *others):
        position = np.concatenate([size * sheet, size * sheet + np.float32([0, gap, 0]), *others])
        return subdivision.joints(position, np.concatenate([face, np.arange(6, len(position)).reshape(-1, 3)])).size > 0

    assert joined(1, 5e-7)
    assert not joined(1, 2e-6)
    # A gap that small triangles show, beside large ones.
    assert not joined(1e-4, 5e-7, sheet + 2)
    assert not joined(1, 1e-2, 1e6 * sheet + 2)
    assert not subdivision.joints(sheet, np.zeros((0, 3), int)).size
    assert not subdivision.joints(sheet, np.array([[0, 0, 0]])).size
    for name in ("meshes/spot.obj", "meshes/teapot.obj", "scenes/Duck.glb"):
        mesh = load_scene(data / name).mesh
        assert not subdivision.joints(np.asarray(mesh.position), np.asarray(mesh.face)).size


@pytest.mark.parametrize("face", [[[0, 0, 1]], [[0, 1, 2], [0, 1, 3]], [[0, 0, 0]]], ids=["edge", "straight", "point"])
def test_triangles_without_area_are_divided_too(face):
    position = np.array([[0.0, 0, 0], [4, 0, 0], [0, 3, 0], [1, 0, 0]])
    mesh = make_mesh(position, np.array(face))
    divided = subdivision.subdivide(mesh, random_divisions(mesh, passes=3, share=1.0))
    assert all(np.isfinite(np.asarray(getattr(divided, name))).all() for name in ("position", "normal", "tangent"))
    assert np.sum(areas(divided.face, divided.position)) == pytest.approx(np.sum(areas(face, position)))
    assert len(divided.position) > 4 or face == [[0, 0, 0]]


def test_points_stay_where_they_are():
    mesh = builtin.sphere(rings=4, sectors=5)
    points = subdivision.scatter(np.arange(len(mesh.face)) % 4)
    position, face, divisions = np.asarray(mesh.position, np.float64), np.asarray(mesh.face), random_divisions(mesh)
    place = np.einsum("pk,pkc->pc", points.weight, position[face[points.triangle]])
    triangle = points.triangle
    for division in divisions:
        points = subdivision.relocate(points, face, division)
        np.testing.assert_array_equal(division.origin[points.triangle], triangle)
        face, triangle = division.face, points.triangle
        position = np.concatenate([position, subdivision.middle(position, division.parent)])
    assert points.weight.min() > -1e-9
    moved = np.einsum("pk,pkc->pc", points.weight, position[face[triangle]])
    np.testing.assert_allclose(moved, place, atol=1e-12)


def test_scattered_points_fill_a_triangle_evenly():
    points = subdivision.scatter(np.array([0, 400]))
    assert np.all(points.triangle == 1)
    assert points.weight.min() > 0
    # Moments of the uniform distribution: mean 1/3, mean square 1/6.
    np.testing.assert_allclose(points.weight.mean(0), 1 / 3, atol=2e-3)
    np.testing.assert_allclose((points.weight**2).mean(0), 1 / 6, atol=2e-3)


@pytest.fixture
def scene() -> Scene:
    """Two parts that share a border, the first with colors, a second set of coordinates and mirrored textures."""
    u, v = (each.ravel() for each in np.meshgrid(np.linspace(0, 1, 4), np.linspace(0, 1, 3), indexing="xy"))
    position = np.stack([u, 0 * u, -v], -1)
    face = grid_face(rows=3, columns=4)[:, ::-1]
    place = np.stack([u, v], -1).astype(np.float32)
    left = make_mesh(position, face, texture=place)
    right = make_mesh(position + [1, 0, 0], face)
    image = Texture(np.random.default_rng(0).random((4, 4, 3), np.float32))
    first = Part(
        "left",
        left,
        TexturedMaterial(base_color_texture=image),
        color=jnp.asarray(np.stack([u, v, u + v], -1), jnp.float32),
        second=jnp.asarray(3 * place[:, ::-1] + 1),
        handedness=jnp.asarray(np.where(u < 0.5, -1.0, 1.0), jnp.float32),
    )
    light = Environment(jnp.ones((6, 1, 1, 3)))
    camera = Camera([0, 1, 0], [0, 0, 0], [0, 0, 1], 0.5, 8, 8)
    return Scene([Part("right", right, brdf.Lambert(0.5)), first], [camera], [light])


def test_parts_keep_what_belongs_to_them_and_share_their_border(scene, close):
    divided = subdivision.subdivide_scene(scene, random_divisions(scene.mesh, passes=3))
    assert [part.name for part in divided.parts] == ["right", "left"]
    assert eqx.tree_equal(divided.cameras, scene.cameras)
    assert eqx.tree_equal(divided.environments, scene.environments)
    left, right = divided["left"], divided["right"]
    assert left.material is scene["left"].material
    assert right.color is right.second is right.handedness is right.mesh.texture is None
    u, v = np.asarray(left.mesh.position)[:, 0], -np.asarray(left.mesh.position)[:, 2]
    close(np.asarray(left.color), np.stack([u, v, u + v], -1))
    close(np.asarray(left.mesh.texture), np.stack([u, v], -1))
    close(np.asarray(left.second), 3 * np.stack([v, u], -1) + 1)
    assert set(np.asarray(left.handedness)) == {-1.0, 1.0}
    np.testing.assert_array_equal(np.asarray(left.handedness)[:12], np.asarray(scene["left"].handedness))
    assert hanging(divided.mesh) == 0
    border = [np.asarray(part.mesh.position) for part in divided.parts]
    ends = [set(map(tuple, each[each[:, 0] == 1])) for each in border]
    assert ends[0] == ends[1]
    assert len(ends[0]) > 3
    together = subdivision.subdivide(scene.mesh, random_divisions(scene.mesh, passes=3))
    assert len(divided.mesh.face) == len(together.face)
    assert sum(areas(divided.mesh.face, divided.mesh.position)) == pytest.approx(2)


def test_no_edge_is_longer_than_asked(scene):
    divided = subdivision.divide(scene, edge=0.2)
    corner = np.asarray(divided.mesh.position)[np.asarray(divided.mesh.face)]
    longest = np.linalg.norm(corner - np.roll(corner, 1, 1), axis=-1).max()
    assert 0.1 < longest <= 0.2
    assert hanging(divided.mesh) == 0
    assert subdivision.divide(scene, edge=10.0) is scene


def test_what_cannot_be_divided_is_refused(scene, unchecked):
    with pytest.raises(TypeError, match="the scene must be of class Scene, which"):
        subdivision.divide(scene.mesh, edge=1.0)
    varying = PerVertex(brdf.Lambert(jnp.full((12,), 0.5)))
    broken = dataclasses.replace(scene.parts[0], material=varying)
    with pytest.raises(TypeError, match="part 'right' must be one BRDF for all vertices or a TexturedMaterial"):
        subdivision.divide(Scene([broken]), edge=1.0)
