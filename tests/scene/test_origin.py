"""Meshes at map coordinates: float32 keeps their digits, and everything speaks the coordinates of the file."""

import base64
import dataclasses
import json
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from jaxprt.files import objects
from jaxprt.scene import builtin, origin
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import bounds, ground_plane, join, make_mesh, relative, rotate, split
from jaxprt.visibility import Occluder, start_points

FAR = np.array([512345.25, 150.5, 4987654.75])
SKY = prt.Environment(np.random.default_rng(0).uniform(0, 2, (6, 8, 8, 3)).astype(np.float32))
MATTE = prt.scene.TexturedMaterial(base_color=(0.6, 0.4, 0.3), metallic=0.0, specular=0.0)


def ball():
    return trimesh.creation.icosphere(subdivisions=2, radius=3.0)


def written(path, shift):
    """A PLY file of a ball in double precision, and the right positions."""
    mesh = ball()
    position = np.asarray(mesh.vertices) + shift
    head = "ply\nformat binary_little_endian 1.0\n"
    head += f"element vertex {len(position)}\n" + "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    row = np.zeros(len(mesh.faces), [("count", "u1"), ("corner", "<i4", 3)])
    row["count"], row["corner"] = 3, mesh.faces
    path.write_bytes(head.encode() + position.astype("<f8").tobytes() + row.tobytes())
    return position


def in_file(mesh):
    """Positions of a mesh in the coordinates of its file, in float64."""
    return np.asarray(mesh.position, np.float64) + mesh.origin


@pytest.mark.parametrize("shift", [FAR, [0, 0, 1e7], FAR * 1e-3])
def test_a_file_far_from_zero_keeps_its_digits_and_normals(tmp_path, shift):
    position = written(tmp_path / "ball.ply", shift)
    for mesh in (prt.load_mesh(tmp_path / "ball.ply"), prt.load_scene(tmp_path / "ball.ply").parts[0].mesh):
        assert np.abs(np.asarray(mesh.position)).max() < 100
        np.testing.assert_allclose(in_file(mesh), position, rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.asarray(mesh.normal), ball().vertices / 3, atol=1e-2)
        np.testing.assert_allclose(bounds(mesh), [position.min(0), position.max(0)], rtol=0, atol=1e-6)


def test_stray_vertices_do_not_move_the_origin_away_from_the_mesh():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=3.0)
    place = ball.vertices + FAR
    stray = np.eye(3)
    face = np.concatenate([ball.faces, [[len(place), len(place) + 1, len(place) + 2]]])
    mesh = make_mesh(np.concatenate([place, stray]), face)
    np.testing.assert_allclose(in_file(mesh)[:-3], place, atol=1e-6, rtol=0)
    np.testing.assert_allclose(mesh.normal[:-3], ball.vertices / 3, atol=0.03)


def test_a_mesh_too_wide_for_float32_is_named_and_keeps_normals_from_before_rounding():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=3.0)
    place = np.concatenate([ball.vertices + FAR, ball.vertices])
    face = np.concatenate([ball.faces, ball.faces + len(ball.vertices)])
    with pytest.warns(
        UserWarning,
        match=r"two\.obj: 1280 of 2560 triangles lose their shape.* triangle 0 are rounded to steps of 0\.5",
    ):
        mesh = make_mesh(place, face, name="two.obj")
    # Faces that float32 cannot tell from lines do not count in them. From rounded positions they turn by 33 degrees.
    np.testing.assert_allclose(mesh.normal, np.tile(ball.vertices / 3, (2, 1)), atol=0.1)
    near, far = make_mesh(ball.vertices, ball.faces), make_mesh(ball.vertices + FAR, ball.faces)
    with pytest.warns(UserWarning, match="the mesh, joined with others: 1280 of 1280 triangles lose"):
        join([near, far])


def test_moves_joins_and_splits_leave_the_coordinates_of_the_file():
    mesh = make_mesh(np.asarray(ball().vertices) + FAR, ball().faces)
    other = make_mesh(np.asarray(ball().vertices) + FAR + [100, 0, 0], ball().faces)
    both = join([mesh, other, ground_plane(mesh, vertices=9)])
    expected = np.concatenate([in_file(mesh), in_file(other)])
    np.testing.assert_allclose(in_file(both)[: 2 * len(mesh.position)], expected, rtol=0, atol=1e-4)
    np.testing.assert_allclose(in_file(split(both)[1]), in_file(other), rtol=0, atol=1e-4)
    np.testing.assert_allclose(in_file(both)[-9:, 1], FAR[1] - 3 - 5e-4 * np.sqrt(108), rtol=0, atol=1e-4)
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    np.testing.assert_allclose(in_file(rotate(mesh, turn)), in_file(mesh) @ turn.T, rtol=0, atol=1e-5)


def test_a_camera_keeps_large_coordinates_and_small_ones_are_arrays_of_jax():
    camera = orbit(make_mesh(np.asarray(ball().vertices) + FAR, ball().faces))
    np.testing.assert_allclose(np.linalg.norm(np.asarray(camera.eye) - FAR), 3 / np.sin(0.3), rtol=1e-4)
    near = camera.local(tuple(FAR.tolist()))
    assert isinstance(near.eye, jax.Array)
    np.testing.assert_allclose(near.target, 0, atol=1e-6)
    assert isinstance(orbit(builtin.sphere()).eye, jax.Array)
    far = prt.image.ray_direction(prt.Camera(FAR + [0, 0, 5], FAR, [0.0, 1, 0], 0.5, 4, 4))
    near = prt.image.ray_direction(prt.Camera([0.0, 0, 5], [0.0, 0, 0], [0.0, 1, 0], 0.5, 4, 4))
    np.testing.assert_allclose(far, near, atol=1e-6)


def test_visibility_of_a_moved_scene_is_the_same():
    near = join([make_mesh(ball().vertices, ball().faces), builtin.plane(cells=4)])
    far = make_mesh(np.asarray(near.position, np.float64) + np.round(FAR), np.asarray(near.face))
    start, moved = (start_points(mesh, Occluder(mesh)).astype(np.float64) for mesh in (near, far))
    np.testing.assert_allclose(moved + far.origin, start + np.round(FAR), rtol=0, atol=2e-5)  # four steps of rounding


def scene(shift):
    """A ball on a ground under a point light, seen by a camera, all moved."""
    mesh = make_mesh(np.asarray(ball().vertices) + shift, ball().faces)
    ground = ground_plane(mesh, vertices=49, extent=3.0)
    light = prt.scene.PointLight("bulb", shift + np.array([5.0, 6.0, 1.0]), 20.0)
    camera = prt.Camera(shift + np.array([2.0, 5.0, 14.0]), shift, [0.0, 1, 0], 0.7, 48, 48)
    return prt.Scene([prt.Part("ball", mesh, MATTE), prt.Part("ground", ground, MATTE)], [camera], point_lights=[light])


@pytest.fixture(scope="module")
def relit():
    return [
        prt.precompute(scene(shift), refine=False, system=prt.relit.Harmonics(degree=2), size=8, progress=False)
        for shift in (np.zeros(3), FAR)
    ]


@pytest.mark.usefixtures("unchecked")
def test_a_scene_at_map_coordinates_looks_the_same_as_at_zero(relit, tmp_path):
    near, far = relit
    assert far.mesh.origin != origin.ZERO
    assert {part.mesh.origin for part in far.scene.parts} == {far.mesh.origin}
    eye = np.array([2.0, 5.0, 14.0])
    np.testing.assert_allclose(far.radiance(SKY, eye=eye + FAR), near.radiance(SKY, eye=eye), rtol=2e-3, atol=2e-3)
    pictures = [np.asarray(each.picture(SKY)) for each in relit]
    assert np.linalg.norm(pictures[1] - pictures[0]) < 5e-3 * np.linalg.norm(pictures[0])
    probes = [
        prt.relit.probes.sample(each, SKY, [shift + np.array([0, 4.0, 0])], size=4)
        for each, shift in zip(relit, (np.zeros(3), FAR), strict=True)
    ]
    np.testing.assert_allclose(probes[1][0].radiance, probes[0][0].radiance, rtol=0.02, atol=0.02)
    objects.save(tmp_path / "scene", far.scene)
    kept = objects.load(tmp_path / "scene")
    assert kept.parts[0].mesh.origin == far.mesh.origin
    np.testing.assert_array_equal(np.asarray(kept.cameras[0].eye), FAR + eye)
    np.testing.assert_array_equal(np.asarray(kept.point_lights[0].position), FAR + [5, 6, 1])


@pytest.mark.usefixtures("unchecked")
def test_eyes_inside_of_jit_are_relative_to_the_origin(relit):
    near, far = relit
    eye = jnp.asarray([2.0, 5.0, 14.0])
    with pytest.raises(ValueError, match=r"the eye must be relative to the scene inside of jax\.jit"):
        jax.jit(lambda eye: far.view(eye).part[1])(eye)
    local = np.asarray(eye, np.float64) + FAR - far.mesh.origin
    moved = far.centered()
    assert moved.mesh.origin == origin.ZERO
    np.testing.assert_allclose(
        moved.radiance(SKY, eye=jnp.asarray(local, jnp.float32)), near.radiance(SKY, eye=eye), rtol=2e-3, atol=2e-3
    )


@pytest.mark.usefixtures("unchecked")
def test_sums_of_far_scenes_take_the_same_eyes(relit):
    near, far = relit
    eye = np.array([2.0, 5.0, 14.0]) + FAR
    expected = far.radiance(SKY, eye=eye)
    np.testing.assert_allclose(prt.radiance(prt.total(far, far), SKY, eye=eye), 2 * expected, rtol=1e-5)
    with pytest.raises(ValueError, match="systems must have one origin"):
        prt.total(near, far)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("eye", [5.0, [1.0, 2.0], "front"])
def test_eyes_that_are_no_position_are_refused_far_from_zero_too(relit, eye):
    with pytest.raises((ValueError, TypeError), match=r"the eye must be (one position|real numbers)"):
        relit[1].radiance(SKY, eye=eye)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("wrong", ["x", (1.0, 2.0), [1.0, 2.0, 3.0], (np.nan, 0.0, 0.0)])
def test_origins_that_are_no_place_are_refused(wrong):
    with pytest.raises(
        ValueError, match="origin of a mesh must be a tuple of three finite numbers of class float, got"
    ):
        dataclasses.replace(builtin.sphere(), origin=wrong)


def test_cameras_of_gltf_files_keep_their_digits(tmp_path):
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")
    place = [512345.35, 10.7, 4987658.495]
    data = base64.b64encode(corner.tobytes()).decode()
    scene = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, "translation": FAR.tolist()}, {"camera": 0, "translation": place}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 0}}]}],
        "cameras": [{"type": "perspective", "perspective": {"yfov": 0.7, "znear": 0.1}}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": "DATA:application/octet-stream;BASE64," + data}],
    }
    (tmp_path / "far.gltf").write_text(json.dumps(scene))
    np.testing.assert_array_equal(np.asarray(prt.load_scene(tmp_path / "far.gltf").cameras[0].eye), place)


@pytest.mark.usefixtures("unchecked")
def test_exports_speak_the_coordinates_of_the_file(relit, tmp_path):
    far = relit[1]
    prt.view.export_baked(far, tmp_path / "baked.glb", SKY)
    content = (tmp_path / "baked.glb").read_bytes()
    head = json.loads(content[20 : 20 + struct.unpack_from("<I", content, 12)[0]])
    assert all(tuple(node["translation"]) == far.mesh.origin for node in head["nodes"])
    np.testing.assert_allclose(head["asset"]["extras"]["eye"], FAR + [2, 5, 14])
    with pytest.warns(UserWarning, match="KHR_materials_unlit"):
        back = prt.load_scene(tmp_path / "baked.glb")
    np.testing.assert_allclose(bounds(back.mesh), bounds(far.mesh), rtol=0, atol=1e-4)


@pytest.mark.usefixtures("unchecked")
def test_the_reference_takes_eyes_and_occluders_in_the_coordinates_of_the_file():
    brdf, eye, vertex = prt.brdf.GGX(roughness=jnp.asarray(0.5)), np.array([2.0, 5.0, 14.0]), np.arange(0, 60, 20)
    wall = np.array([[-9.0, 9, 0], [9, 9, 0], [0, 9, 9]])
    values = []
    for shift in (np.zeros(3), FAR):
        mesh = make_mesh(np.asarray(ball().vertices) + shift, ball().faces)
        occluder = join([mesh, make_mesh(wall + shift, [[0, 1, 2]])])
        occluder = relative(occluder, origin.ZERO if not shift.any() else tuple((FAR // 1000 * 1000).tolist()))
        values.append(prt.reference.radiance(mesh, brdf, SKY, eye=eye + shift, vertex=vertex, occluder=occluder))
    np.testing.assert_allclose(values[1], values[0], rtol=2e-3)


def test_systems_of_far_meshes_say_that_eyes_are_relative():
    mesh = make_mesh(np.asarray(ball().vertices) + FAR, ball().faces)
    with pytest.warns(UserWarning, match=r"positions are relative to mesh\.origin, \(512352"):
        prt.visibility.precompute(mesh, size=4, vertex=np.array([0]))


def test_one_number_stands_for_three_coordinates_also_where_float32_rounds_it():
    for number in (1.5, 100.1):
        np.testing.assert_array_equal(prt.scene.PointLight("bulb", number).position, [number] * 3)


def test_a_mesh_near_zero_has_its_origin_there():
    for shift in (0.0, 30.0, [0.0, 200.0, 0.0]):
        assert make_mesh(np.asarray(ball().vertices) + shift, ball().faces).origin == origin.ZERO
