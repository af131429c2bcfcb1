"""Meshes.

Real files, sound and awkward, and files that are broken.
"""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt.scene import builtin
from jaxprt.scene.formats.scene_file import load_mesh
from jaxprt.scene.mesh import Mesh, brush, ground_plane, join, make_mesh, rotate, split
from jaxprt.sphere import directions

SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE_FACE = np.array([[0, 1, 2], [0, 2, 3]])
CUBE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1\n"
CUBE_FACE = "f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
ICOSPHERE = 1e-2  # How far means of its face normals are from a sphere's normals.
# Vertices, faces and regions; the first two as data/README.md has them.
FILES = {
    "meshes/stanford_bunny.ply": (35947, 69451, 1),
    "meshes/happy_buddha_100k.ply": (49950, 100000, 1),
    "meshes/dragon_100k.ply": (50000, 100000, 1),
    "meshes/lucy_100k.ply": (49987, 99970, 1),
    "meshes/armadillo.ply": (43243, 86482, 1),
    "meshes/nefertiti.ply": (49971, 99938, 1),
    "meshes/max_planck_decimated.ply": (5272, 10540, 1),
    "meshes/horse.ply": (48485, 96966, 1),
    "meshes/rocker_arm.ply": (10044, 20088, 1),
    "meshes/beetle_open.ply": (19887, 38656, 1),
    "meshes/teapot.obj": (3644, 6320, 1),
    "meshes/suzanne.obj": (507, 968, 1),
    "meshes/spot.obj": (3225, 5856, 1),
    "meshes/cow.obj": (2903, 5804, 1),
    "meshes_awkward/dragon_vrip_res3.ply": (22998, 47794, 1),
    "meshes_awkward/bunny_vrip_res2.ply": (8171, 16301, 1),
    "meshes_awkward/chair_model.obj": (11250, 12756, 3),
    "meshes_awkward/cycloidal.ply": (21384, 43368, 1),
    "meshes_awkward/busted.STL": (11634, 3878, 1),
    "meshes_awkward/featuretype.STL": (10428, 3476, 1),
    "meshes_awkward/fuze.obj": (664, 1000, 1),
    "meshes_awkward/rabbit.obj": (732, 1252, 1),
    "meshes_awkward/quadknot.obj": (2879, 2880, 1),
    "meshes_awkward/negative_indices.obj": (24, 12, 1),
    "meshes_awkward/polygonfaces.obj": (5, 3, 1),
    "meshes_awkward/singlevn.obj": (4, 2, 1),
    "meshes_awkward/soup.stl": (300, 100, 1),
    "meshes_awkward/cube_blender_uv.ply": (24, 12, 1),
    "meshes_awkward/tube.obj": (128, 120, 1),
    "meshes_awkward/suzanne_facets.ply": (1966, 968, 1),
    "meshes_awkward/nancolor.obj": (8, 12, 1),
    "meshes_awkward/joined_tetrahedra.obj": (15, 8, 1),
}


def write(folder, name, content):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def assert_equal(a: Mesh, b: Mesh):
    for field in ("position", "face", "normal", "tangent", "region", "texture"):
        np.testing.assert_array_equal(getattr(a, field), getattr(b, field), err_msg=field)


def assert_frames(mesh: Mesh):
    frame = np.asarray(directions.frame(mesh.normal, mesh.tangent), np.float64)
    assert np.abs(frame @ frame.swapaxes(1, 2) - np.eye(3)).max() < 1e-5
    assert np.abs(np.linalg.det(frame) - 1).max() < 1e-5
    assert np.abs(frame[:, 0] - np.asarray(mesh.tangent)).max() < 1e-5


def ball(**options):
    return trimesh.creation.icosphere(subdivisions=2, **options)


def export(mesh, path):
    """Writes a mesh; a glTF file with normals, since its triangles would be separate without."""
    mesh.export(path, **({"include_normals": True} if path.suffix == ".glb" else {}))


@pytest.mark.parametrize("suffix", ["ply", "obj", "off", "glb"])
def test_a_ball_comes_back_from_every_format_with_its_vertices_in_order(tmp_path, suffix, close):
    source = ball()
    export(source, tmp_path / f"ball.{suffix}")
    mesh = load_mesh(tmp_path / f"ball.{suffix}")
    close(mesh.position, source.vertices, tolerance=1e-6)
    np.testing.assert_array_equal(mesh.face, source.faces)
    close(mesh.normal, source.vertices, tolerance=ICOSPHERE)
    assert_frames(mesh)


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_texture_coordinates_come_back_and_follow_joining_splitting_and_turning(tmp_path, suffix, close):
    source = ball()
    place = np.random.default_rng(0).uniform(-1, 2, (len(source.vertices), 2))
    source.visual = trimesh.visual.TextureVisuals(uv=place)
    export(source, tmp_path / f"ball.{suffix}")
    mesh = load_mesh(tmp_path / f"ball.{suffix}")
    close(mesh.texture, place, tolerance=1e-5)
    plain = builtin.plane(cells=2)
    first, second = split(join([mesh, plain]))
    assert_equal(first, mesh)
    np.testing.assert_array_equal(second.texture, np.zeros((len(plain.position), 2)))
    np.testing.assert_array_equal(rotate(mesh, np.eye(3)).texture, mesh.texture)
    assert join([plain, plain]).texture is None


@pytest.mark.parametrize("index", ["-9", "x"])
def test_faces_that_name_missing_texture_coordinates_are_loaded_without_them_and_a_warning_says_so(tmp_path, index):
    lines = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 -1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl sound\nf 1/1/1 2/2/1 3/3/1\n"
    damaged = f"usemtl damaged\nf 1/1/1 2/{index}/1 3/3/1\n"
    with pytest.warns(
        UserWarning, match=r"missing.obj: faces should refer to .* 1 to 3 or none, got 1 of 2 .* in line 11"
    ):
        mesh = load_mesh(write(tmp_path, "missing.obj", lines + damaged))
    place = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.position, np.concatenate([place, place]))
    np.testing.assert_array_equal(mesh.face, [[0, 1, 2], [3, 4, 5]])
    np.testing.assert_array_equal(mesh.normal, np.tile([0, 0, -1], (6, 1)))
    np.testing.assert_array_equal(mesh.texture, [[0, 0], [1, 0], [0, 1], [0, 0], [0, 0], [0, 0]])
    with pytest.warns(UserWarning, match="1 to 0 or none, got 1 of 1 .* in line 4"):
        mesh = load_mesh(write(tmp_path, "none.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/2 3/3  # a comment\n"))
    assert mesh.texture is None
    np.testing.assert_array_equal(mesh.position, place)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_is_flat_with_three_vertices_per_face(tmp_path, kind, close):
    source = ball()
    source.export(tmp_path / "ball.stl", file_type=kind)
    mesh = load_mesh(tmp_path / "ball.stl")
    assert mesh.position.shape == (3 * len(source.faces), 3)
    close(np.asarray(mesh.normal).reshape(-1, 3, 3), np.repeat(source.face_normals[:, None], 3, 1), tolerance=1e-5)


def test_normals_do_not_depend_on_scale_and_place(close):
    source = ball()
    mesh = make_mesh(source.vertices, source.faces)
    close(make_mesh(source.vertices * 1e-12, source.faces).normal, np.asarray(mesh.normal), tolerance=1e-5)
    # 100 diameters off, float32 positions have five digits left.
    close(make_mesh(source.vertices + 200, source.faces).normal, np.asarray(mesh.normal), tolerance=1e-3)


def test_faces_without_area_leave_normals_alone(close):
    on_diagonal = (2 * SQUARE[3] + SQUARE[1]) / 3  # But for rounding, which gives face 1 3 4 a normal at random.
    thin = np.array([[0, 0, 1], [2, 2, 2], [1, 3, 4]])
    mesh = make_mesh(np.concatenate([SQUARE, [on_diagonal]]), np.concatenate([SQUARE_FACE, thin]))
    close(mesh.normal[:4], np.tile([0.0, 0, 1], (4, 1)))
    close(np.abs(mesh.normal[4]), np.array([0.0, 0, 1]))


def test_vertices_whose_faces_cancel_or_that_have_none_get_unit_normals():
    sheet = np.concatenate([SQUARE_FACE, SQUARE_FACE[:, ::-1]])
    mesh = make_mesh(np.concatenate([SQUARE, [[5.0, 5, 5]]]), sheet)
    np.testing.assert_array_equal(np.abs(mesh.normal[:4, 2]), 1)
    np.testing.assert_array_equal(mesh.normal[4], [0, 1, 0])
    np.testing.assert_array_equal(make_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])).normal, [[0, 1, 0]] * 3)


def test_given_normals_are_made_unit_and_missing_ones_computed(close):
    given = np.array([[3.0, 0, 4], [0, 0, 0], [np.nan, 0, 1], [0, 1e-30, 0]])
    mesh = make_mesh(SQUARE, SQUARE_FACE, normal=given)
    close(mesh.normal, np.array([[0.6, 0, 0.8], [0, 0, 1], [0, 0, 1], [0, 1, 0]]))
    assert_frames(mesh)


def test_given_tangents_are_made_orthogonal_and_missing_ones_computed(close):
    given = np.array([[0.0, 2, 5], [np.nan, 0, 0], [0, 0, 0], [0, 0, 7]])
    mesh = make_mesh(SQUARE, SQUARE_FACE, tangent=given)
    own = np.asarray(directions.tangent(mesh.normal))
    close(mesh.tangent, np.concatenate([[[0, 1, 0]], own[1:]]))


def test_arrays_come_out_in_single_precision(x64):
    mesh = make_mesh(SQUARE, SQUARE_FACE.astype(np.uint8))
    assert [f.dtype for f in (mesh.position, mesh.normal, mesh.tangent)] == [jnp.float32] * 3
    assert [f.dtype for f in (mesh.face, mesh.region)] == [jnp.int32] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": np.zeros((0, 3))}, "hat must hold vertices and faces, got 0 vertices and 2 faces"),
        ({"face": np.array([[0, 1, 2], [0, 1, 4]])}, r"refer to vertices 0 to 3, got 1 of 2 .* \[0, 1, 4\] at face 1"),
        (
            {"position": SQUARE + np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, np.inf], [0, 0, 0]])},
            "got 2 of 4 .* at vertex 1",
        ),
        ({"position": SQUARE * 1e39}, "positions must be finite, got 3 of 4"),
        ({"texture": SQUARE[:, :2] * 1e39}, "hat: texture must be finite, got 3 of 4"),
        ({"region": np.array([0, 0, -1, 0])}, "regions must not be negative, got 1 of 4 .* -1 at vertex 2"),
    ],
)
def test_impossible_arrays_are_refused_with_name_count_and_first_offender(change, message):
    fields = {"position": SQUARE, "face": SQUARE_FACE} | change
    with pytest.raises(ValueError, match=message):
        make_mesh(fields.pop("position"), fields.pop("face"), name="hat", **fields)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"position": SQUARE[:, :2]}, r"hat: position must be real numbers \[any, 3\], got float64 \[4, 2\]"),
        ({"position": SQUARE.astype(complex)}, r"position must be real numbers .* got complex128"),
        ({"face": np.array([[0, 1, 2, 3]])}, r"hat: face must be integers \[any, 3\], got int64 \[1, 4\]"),
        ({"face": SQUARE_FACE.astype(float)}, r"face must be integers \[any, 3\], got float64 \[2, 3\]"),
        ({"normal": SQUARE[:3]}, r"normal must be real numbers \[4, 3\], got float64 \[3, 3\]"),
        ({"region": np.zeros(3, int)}, r"region must be integers \[4\], got int64 \[3\]"),
    ],
)
def test_arrays_of_another_shape_or_kind_are_refused_with_what_was_required_and_what_came(change, message):
    fields = {"position": SQUARE, "face": SQUARE_FACE} | change
    with pytest.raises(ValueError, match=message):
        make_mesh(fields.pop("position"), fields.pop("face"), name="hat", **fields)


def test_text_that_ends_within_its_last_face_is_refused_and_more_than_is_counted_is_not(tmp_path):
    rows = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2\n\n4 0 1 2 3\n"
    ply = "ply\nformat ascii 1.0\ncomment property of nobody\nelement vertex 4\nproperty float x\nproperty float y\n"
    ply += "property float z\nelement face 2\nproperty list uchar int vertex_indices\nelement edge 0\nproperty int a\n"
    texts = {
        "a.ply": ply + "end_header\n" + rows.replace("\n\n", "\n"),
        "a.off": "OFF # 9 9 9\n4 2 0\n# two faces\n" + rows,
    }
    for name, text in texts.items():
        assert load_mesh(write(tmp_path, name, text)).face.shape == (3, 3)
        assert load_mesh(write(tmp_path, name, text.replace("\n", "\r\n") + "\n1 2\n")).face.shape == (3, 3)
        with pytest.raises(ValueError, match="row 2 of the face rows must have 5 numbers, but has 4"):
            load_mesh(write(tmp_path, name, text.removesuffix(" 3\n")))


def test_normals_are_smooth_across_seams_of_an_obj_but_not_across_creases(tmp_path, close):
    # Texture coordinates that differ per face split every vertex of this sphere and of this cube.
    source = ball()
    corner = "".join(f"vt {i / 960} 0\n" for i in range(3 * len(source.faces)))
    vertex = "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in source.vertices)
    face = "".join(
        "f " + " ".join(f"{v + 1}/{3 * i + j + 1}" for j, v in enumerate(f)) + "\n" for i, f in enumerate(source.faces)
    )
    mesh = load_mesh(write(tmp_path, "ball.obj", vertex + corner + face))
    assert len(mesh.position) == 3 * len(source.faces)
    close(mesh.normal, np.asarray(mesh.position), tolerance=ICOSPHERE)

    face = "".join(
        "f " + " ".join(f"{v}/{4 * i + j + 1}" for j, v in enumerate(line.split()[1:])) + "\n"
        for i, line in enumerate(CUBE_FACE.splitlines())
    )
    mesh = load_mesh(write(tmp_path, "cube.obj", CUBE + "".join(f"vt {i} 0\n" for i in range(24)) + face))
    assert len(mesh.position) == 24
    np.testing.assert_allclose(np.abs(mesh.normal).max(1), 1, atol=1e-6)


@pytest.mark.parametrize("groups", [False, True])
def test_regions_of_an_obj_are_materials_or_groups_in_order_of_appearance(tmp_path, groups):
    lines = "usemtl steel\ng left\nf 1 2 3\nusemtl wood\nf 1 3 4\nusemtl steel\ng right\nf 5 6 7\nf 5 7 8\n"
    path = write(tmp_path, "two.obj", "mtllib absent.mtl\n" + CUBE + lines)
    parts = split(load_mesh(path, groups=groups))
    assert [len(part.face) for part in parts] == ([2, 2] if groups else [3, 1])
    assert float(parts[0].position[:, 2].max()) == (0 if groups else 1)


def test_relative_indices_of_an_obj_count_back_from_their_own_line(tmp_path):
    first, second = (f"v 0 0 {z}\nv 1 0 {z}\nv 0 1 {z}\nvn 0 0 1\nf -3//-1 -2//-1 -1//-1 # -9\n" for z in (0, 5))
    mesh = load_mesh(write(tmp_path, "strips.obj", first + second))
    np.testing.assert_array_equal(
        np.sort(np.asarray(mesh.position)[np.asarray(mesh.face)][..., 2], 0), [[0, 0, 0], [5, 5, 5]]
    )
    np.testing.assert_array_equal(np.asarray(mesh.normal)[:, 2], 1)


def test_joined_meshes_come_apart_again():
    parts = [builtin.sphere(rings=4, sectors=5), builtin.plane(cells=2), builtin.sphere(rings=3, sectors=3)]
    joined = join(parts)
    assert np.unique(joined.region).tolist() == [0, 1, 2]
    for part, again in zip(parts, split(joined), strict=True):
        assert_equal(part, again)
    assert_equal(join(split(joined)), joined)
    assert_equal(join([joined]), joined)


def test_join_renumbers_regions_consecutively_in_order():
    gap = make_mesh(SQUARE, SQUARE_FACE, region=np.array([7, 7, 7, 7]))
    pair = join([gap, gap])
    assert np.asarray(join([pair, gap]).region).reshape(3, 4).tolist() == [[0] * 4, [1] * 4, [2] * 4]
    with pytest.raises(ValueError, match="at least one mesh, got none"):
        join([])


def test_the_ground_lies_under_the_mesh_and_faces_up():
    source = ball()
    mesh = make_mesh(source.vertices * 3 + [10, 4, -7], source.faces)
    ground = ground_plane(mesh, vertices=900, extent=5.0)
    position = np.asarray(ground.position)
    assert position.shape == (900, 3)
    low, high = position.min(0), position.max(0)
    np.testing.assert_allclose((low + high)[[0, 2]] / 2, [10, -7], atol=1e-4)
    np.testing.assert_allclose((high - low)[[0, 2]], 30, rtol=1e-5)
    gap = (np.asarray(mesh.position)[:, 1].min() - position[:, 1]) / (6 * np.sqrt(3))
    np.testing.assert_allclose(gap, 5e-4, rtol=1e-2)
    np.testing.assert_array_equal(ground.normal, np.tile([0.0, 1, 0], (900, 1)))
    face_normal = trimesh.Trimesh(ground.position, ground.face, process=False).face_normals
    np.testing.assert_allclose(face_normal[:, 1], 1, atol=1e-6)
    step = np.diff(np.unique(position[:, 0]))
    assert step.min() > 0
    assert step[len(step) // 2] < 0.5 * 30 / 29 < step[0]


def test_the_ground_under_a_mesh_without_extent_is_a_square_all_the_same():
    assert float(ground_plane(make_mesh(np.zeros((3, 3)), np.array([[0, 1, 2]])), vertices=4).position[:, 0].max()) == 2
    with pytest.raises(ValueError, match="vertices must be at least 4, got 3"):
        ground_plane(builtin.plane(), vertices=3)
    with pytest.raises(ValueError, match=r"extent must be above 0 and at most 1e\+32, got 0"):
        ground_plane(builtin.plane(), extent=0.0)


def test_turned_mesh_keeps_its_shape_and_frames():
    mesh = builtin.sphere(rings=4, sectors=6)
    turned = rotate(mesh, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]))
    np.testing.assert_allclose(turned.position[:, 1], mesh.position[:, 2], atol=1e-6)
    assert_frames(turned)
    np.testing.assert_allclose(turned.normal, turned.position, atol=1e-6)
    np.testing.assert_array_equal(turned.face, mesh.face)


def test_brushed_tangents_are_the_direction_in_every_tangent_plane():
    mesh = brush(builtin.sphere(rings=9, sectors=12), np.array([0, 3e-30, 0]))
    assert_frames(mesh)
    level = np.asarray(mesh.normal)
    flat = np.array([0, 1, 0]) - level * level[:, 1:2]
    length = np.linalg.norm(flat, axis=1)
    off_poles = length > 1e-3
    assert off_poles.sum() > 0.9 * len(level)
    np.testing.assert_allclose(
        np.asarray(mesh.tangent)[off_poles], (flat / np.maximum(length, 1e-3)[:, None])[off_poles], atol=1e-4
    )


def test_every_vertex_may_be_brushed_along_its_own_direction(close):
    mesh = builtin.sphere(rings=9, sectors=12)
    along = (
        np.random.default_rng(0).normal(size=mesh.position.shape)
        * np.geomspace(1e-12, 1e12, len(mesh.position))[:, None]
    )
    along[5] = 0
    brushed = brush(mesh, along)
    assert_frames(brushed)
    one = brush(mesh, along[7])
    close(brushed.tangent[7], one.tangent[7], tolerance=1e-5)
    close(brushed.tangent[5], directions.tangent(mesh.normal[5:6])[0], tolerance=1e-5)
    along[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"direction must be finite, got 1 of .* at vertex 3"):
        brush(mesh, along)
    with pytest.raises(ValueError, match=r"direction must be real numbers \[.*, 3\], got float64 \[4, 3\]"):
        brush(mesh, along[:4])


@pytest.mark.parametrize("name", FILES)
def test_every_file_loads_whole_with_a_right_handed_frame_at_every_vertex(data, name):
    mesh = load_mesh(data / name)
    assert (len(mesh.position), len(mesh.face), np.asarray(mesh.region).max() + 1) == FILES[name]
    normal, tangent = np.asarray(mesh.normal, np.float64), np.asarray(mesh.tangent, np.float64)
    frame = np.stack([tangent, np.cross(normal, tangent), normal], 1)
    assert np.abs(frame @ frame.swapaxes(1, 2) - np.eye(3)).max() < 1e-5
    assert np.abs(np.linalg.det(frame) - 1).max() < 1e-5
    face = np.asarray(mesh.face)
    assert 0 <= face.min() <= face.max() < len(mesh.position)
    assert sum(len(part.face) for part in split(mesh)) == len(mesh.face)


def test_every_file_of_the_data_is_in_the_table(data):
    found = {f"{path.parent.name}/{path.name}" for path in data.glob("meshes*/*") if path.suffix != ".mtl"}
    assert found == {*FILES, "meshes_awkward/empty.obj"}


@pytest.mark.parametrize("name", ["meshes/stanford_bunny.ply", "meshes/cow.obj"])
def test_computed_normals_are_trimeshs_angle_weighted_ones(data, name, close):
    mesh = load_mesh(data / name)
    surface = trimesh.Trimesh(mesh.position, mesh.face, process=False)
    weight = trimesh.geometry.weighted_vertex_normals(
        len(surface.vertices), surface.faces, surface.face_normals, surface.face_angles
    )
    used = np.unique(mesh.face)
    close(np.asarray(mesh.normal)[used], weight[used], tolerance=1e-4)


def test_normals_in_the_file_keep_their_direction_and_become_unit(data, close):
    path = data / "meshes_awkward/dragon_vrip_res3.ply"
    lines = path.read_text().split("end_header\n")[1].splitlines()[:22998]
    field = path.read_text().split("end_header")[0].split("property float ")[1:]
    column = [i for i, name in enumerate(field) if name.split()[0] in ("nx", "ny", "nz")]
    given = np.array([line.split() for line in lines], float)[:, column]
    length = np.linalg.norm(given, axis=1, keepdims=True)
    assert abs(length - 1).max() > 0.1
    sound = length[:, 0] > 0
    close(np.asarray(load_mesh(path).normal)[sound], (given / np.where(length > 0, length, 1))[sound], tolerance=1e-5)


def test_one_normal_for_all_vertices_is_taken(data):
    np.testing.assert_array_equal(load_mesh(data / "meshes_awkward/singlevn.obj").normal, [[0, 1, 0]] * 4)


@pytest.fixture(scope="module")
def small_ball():
    return trimesh.creation.icosphere(subdivisions=1)


@pytest.mark.parametrize("suffix", ["ply", "stl", "off", "glb", "obj"])
@pytest.mark.parametrize("content", ["", "hello world\nthis is text\n", "other"])
def test_damaged_and_mislabeled_files_are_refused_by_name(tmp_path, small_ball, suffix, content):
    whole = tmp_path / f"whole.{suffix}"
    small_ball.export(whole)
    other = tmp_path / ("whole.glb" if suffix != "glb" else "whole.ply")
    small_ball.export(other)
    broken = tmp_path / f"broken.{suffix}"
    broken.write_bytes(other.read_bytes() if content == "other" else content.encode())
    with pytest.raises(ValueError, match=rf"broken\.{suffix} must (be an undamaged|hold vertices)"):
        load_mesh(broken)


def test_tangents_of_loaded_meshes_are_wangs(data):
    mesh = load_mesh(data / "meshes/suzanne.obj")
    np.testing.assert_allclose(mesh.tangent, directions.tangent(mesh.normal), atol=1e-6)
