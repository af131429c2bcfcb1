"""Real files, sound and awkward, and files that are broken."""

import numpy as np
import pytest
import trimesh

from jaxprt.scene.formats.scene_file import load_mesh
from jaxprt.scene.mesh import split
from jaxprt.sphere import directions

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
# Closed surfaces in one consistent winding, on which normals must point outward.
CLOSED = ["meshes/dragon_100k.ply", "meshes/rocker_arm.ply", "meshes/cow.obj", "meshes/spot.obj"]


@pytest.mark.parametrize("name", FILES)
def test_every_file_loads_whole_with_a_right_handed_frame_at_every_vertex(data, name):
    mesh = load_mesh(data / name)
    assert (len(mesh.position), len(mesh.face), np.max(mesh.region) + 1) == FILES[name]
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


def test_a_file_without_geometry_is_refused(data):
    with pytest.raises(ValueError, match=r"empty\.obj must hold vertices and faces, got no faces"):
        load_mesh(data / "meshes_awkward/empty.obj")


@pytest.mark.parametrize("name", CLOSED)
def test_normals_of_closed_surfaces_agree_with_their_faces(data, name):
    mesh = load_mesh(data / name)
    surface = trimesh.Trimesh(mesh.position, mesh.face, process=False)
    assert surface.volume > 0
    agreement = (surface.face_normals[:, None] * np.asarray(mesh.normal)[np.asarray(mesh.face)]).sum(2)
    assert np.average(agreement.min(1) > 0, weights=surface.area_faces) > 0.995


@pytest.mark.parametrize("name", ["meshes/stanford_bunny.ply", "meshes/cow.obj"])
def test_computed_normals_are_trimeshs_angle_weighted_ones(data, name, close):
    mesh = load_mesh(data / name)
    surface = trimesh.Trimesh(mesh.position, mesh.face, process=False)
    weight = trimesh.geometry.weighted_vertex_normals(
        len(surface.vertices), surface.faces, surface.face_normals, surface.face_angles
    )
    used = np.unique(mesh.face)
    close(mesh.normal[used], weight[used], tolerance=1e-4)


def test_normals_in_the_file_keep_their_direction_and_become_unit(data, close):
    path = data / "meshes_awkward/dragon_vrip_res3.ply"
    lines = path.read_text().split("end_header\n")[1].splitlines()[:22998]
    field = path.read_text().split("end_header")[0].split("property float ")[1:]
    column = [i for i, name in enumerate(field) if name.split()[0] in ("nx", "ny", "nz")]
    given = np.array([line.split() for line in lines], float)[:, column]
    length = np.linalg.norm(given, axis=1, keepdims=True)
    assert abs(length - 1).max() > 0.1
    sound = length[:, 0] > 0
    close(load_mesh(path).normal[sound], (given / np.where(length > 0, length, 1))[sound], tolerance=1e-5)


def test_one_normal_for_all_vertices_is_taken(data):
    np.testing.assert_array_equal(load_mesh(data / "meshes_awkward/singlevn.obj").normal, [[0, 1, 0]] * 4)


def test_texture_seams_leave_no_trace_in_the_normals(data):
    mesh = load_mesh(data / "meshes/spot.obj")
    _, place = np.unique(mesh.position, axis=0, return_inverse=True)
    place = place.reshape(-1)
    assert len(np.unique(place)) < len(place)
    first = np.unique(place, return_index=True)[1]
    np.testing.assert_array_equal(mesh.normal, mesh.normal[first][place])


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(subdivisions=1)


@pytest.mark.parametrize("suffix", ["ply", "stl", "off", "glb", "obj"])
@pytest.mark.parametrize("content", ["", "hello world\nthis is text\n", "half", "noise", "other"])
def test_damaged_and_mislabeled_files_are_refused_by_name(tmp_path, ball, suffix, content):
    whole = tmp_path / f"whole.{suffix}"
    ball.export(whole)
    other = tmp_path / ("whole.glb" if suffix != "glb" else "whole.ply")
    ball.export(other)
    broken = tmp_path / f"broken.{suffix}"
    binary = whole.read_bytes()
    broken.write_bytes(
        {
            "half": binary[: len(binary) // 2],
            "noise": np.random.default_rng(0).bytes(3000),
            "other": other.read_bytes(),
        }.get(content, content.encode())
    )
    with pytest.raises(ValueError, match=rf"broken\.{suffix} must (be an undamaged|hold vertices)"):
        load_mesh(broken)


def test_a_missing_file_and_an_unknown_kind_are_told_apart(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"absent\.ply must be a mesh file, and there is no such file"):
        load_mesh(tmp_path / "absent.ply")
    for suffix in (".ply", ".obj", ".glb"):
        with pytest.raises(ValueError, match=r"a' must be the path of a .* file, got one with File name too long"):
            load_mesh(tmp_path / ("a" * 300 + suffix))
    with pytest.raises(ValueError, match=r"hat\.blend must end in one of \.ply, \.obj, .*, got '\.blend'"):
        load_mesh(tmp_path / "hat.blend")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("far.obj", "f 1 2 3\nf 1 2 9\n", r"far\.obj: faces .* the vertices 1 to 3, got 1 of 2 .* 'f 1 2 9' in line 5"),
        ("zero.obj", "f 0 1 2\n", r"zero\.obj: faces .* got 1 of 1 .* 'f 0 1 2' in line 4"),
        ("back.obj", "f -1 -2 -4\n", r"back\.obj: .* 'f -1 -2 -4' in line 4"),
        ("cut.obj", "f 1 2 3\nf 1 2", r"cut\.obj: faces must refer to three or more .* 'f 1 2' in line 5"),
        ("word.obj", "f 1 2 x\n", r"word\.obj: .* 'f 1 2 x' in line 4"),
        ("nan.obj", "v nan 0 0\nf 1 2 4\n", r"nan\.obj: positions must be finite, got 1 of 3 .* at vertex 2"),
        ("points.obj", "", r"points\.obj must hold vertices and faces, got no faces"),
    ],
)
def test_broken_objs_are_refused_with_count_and_first_offender(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + text)
    with pytest.raises(ValueError, match=message):
        load_mesh(path)


def test_a_ply_whose_faces_name_missing_vertices_is_refused(tmp_path):
    path = tmp_path / "far.ply"
    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 1 7\n"
    )
    with pytest.raises(ValueError, match=r"far\.ply: faces must refer to vertices 0 to 2, got 1 of 2 .* \[0, 1, 7\]"):
        load_mesh(path)


def test_tangents_of_loaded_meshes_are_wangs(data):
    mesh = load_mesh(data / "meshes/suzanne.obj")
    np.testing.assert_allclose(mesh.tangent, directions.tangent(mesh.normal), atol=1e-6)
