"""Gaussian splats on a plane and on a sphere above it, relit past meshes of both."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from jaxprt.cli.splats import command
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sensors.splats import (
    albedo_guess,
    load_splats,
    nearest_points,
    relit,
    splat_normals,
    splat_transport,
    white_radiance,
    write_splats,
)

FIELDS = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{number}" for number in range(9))]
FIELDS += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
CONSTANT = 0.28209479177387814
RADIUS, HEIGHT = 0.5, 0.9  # of the sphere, and of its center above the plane
COUNT = 200  # splats on each
TRANSPORT_ERROR = 0.02  # of single splats, by eight texels along an edge
FACET = 3  # degrees between the sphere and its faces, whose edges turn by 3.75
WHITE = Environment(jnp.ones((6, 1, 1, 1)))
SUN = Environment(jnp.zeros((6, 8, 8, 3)).at[2, 3:5, 3:5].set(jnp.array([40.0, 20.0, 10.0])))


def header(fields=FIELDS, count=2 * COUNT, form="binary_little_endian", more=""):
    lines = ["ply", f"format {form} 1.0", "comment made here", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in fields), f"{more}end_header\n"]).encode()


def turn_of_z(normal):
    """Quaternions w x y z of turns of +z to unit vectors."""
    turn = np.stack([1 + normal[:, 2], -normal[:, 1], normal[:, 0], 0 * normal[:, 0]], -1)
    return turn / np.linalg.norm(turn, axis=1, keepdims=True)


def rows(random, *, thin=0.1):
    """Splats on the plane, then on the sphere: positions, normals, and rows of the file."""
    ground = random.uniform(-0.9, 0.9, (COUNT, 3)) * [1, 0, 1]
    out = random.normal(size=(COUNT, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    position = np.concatenate([ground, [0, HEIGHT, 0] + RADIUS * out])
    normal = np.concatenate([np.tile([0.0, 1.0, 0.0], (COUNT, 1)), out])
    record = np.zeros(2 * COUNT, [(name, "<f4") for name in FIELDS])
    for name in FIELDS[6:]:
        record[name] = random.normal(size=2 * COUNT)
    turn = turn_of_z(normal * random.choice([-1, 1], (2 * COUNT, 1)))
    columns = {"xyz"[axis]: position[:, axis] for axis in range(3)} | {f"rot_{k}": 3 * turn[:, k] for k in range(4)}
    columns |= {"scale_0": np.log(0.02), "scale_1": np.log(0.03), "scale_2": np.log(0.02 * thin)}
    for name, value in columns.items():
        record[name] = value
    return position, normal, record


def proxy():
    ball = builtin.sphere(rings=48, sectors=96)
    ball = make_mesh(np.asarray(ball.position) * RADIUS + [0, HEIGHT, 0], np.asarray(ball.face))
    matte = TexturedMaterial(base_color=0.5, metallic=0.0, specular=0.0)
    return Scene([Part("plane", builtin.plane(), matte), Part("ball", ball, matte)])


def written(path, record, head=None):
    path.write_bytes((head or header(record.dtype.names, len(record))) + record.tobytes())
    return path


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    position, normal, record = rows(np.random.default_rng(3))
    splats = load_splats(written(tmp_path_factory.mktemp("splats") / "cloud.ply", record))
    return splats, position, normal


@pytest.fixture(scope="module")
def transport(cloud):
    return splat_transport(cloud[0], proxy(), progress=False)


def degrees(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, 1), -1, 1)))


def test_files_are_written_to_the_bit(cloud, tmp_path):
    path = tmp_path / "again.ply"
    write_splats(path, cloud[0])
    assert path.read_bytes() == cloud[0].header + cloud[0].record.tobytes()
    write_splats(path, load_splats(path))
    assert path.read_bytes() == header() + cloud[0].record.tobytes()


def test_axes_are_the_columns_of_the_rotation(cloud):
    axes, normal = cloud[0].axes, cloud[2]
    np.testing.assert_allclose(np.abs(np.sum(axes[:, 2] * normal, 1)), 1, atol=1e-5)
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.tile(np.eye(3), (2 * COUNT, 1, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(axes), 1, atol=1e-6)


def test_quaternions_turn_as_scipy_says(cloud):
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    record = cloud[0].record.copy()
    for number in range(4):
        record[f"rot_{number}"] = np.random.default_rng(number).normal(size=len(record))
    turn = np.stack([record[f"rot_{number}"] for number in (1, 2, 3, 0)], -1)
    axes = dataclasses.replace(cloud[0], record=record).axes
    np.testing.assert_allclose(axes.swapaxes(1, 2), rotation.from_quat(turn).as_matrix(), atol=1e-6)


def test_normals_are_shortest_axes_on_the_side_of_the_proxy(cloud):
    assert degrees(splat_normals(cloud[0], proxy().mesh), cloud[2]).max() < 0.1


def test_splats_that_are_no_disks_have_the_normal_of_the_proxy(tmp_path):
    _, normal, record = rows(np.random.default_rng(5), thin=0.9)
    record["rot_0"], record["rot_1"] = 1, -1
    splats = load_splats(written(tmp_path / "balls.ply", record))
    angle = degrees(splat_normals(splats, proxy().mesh), normal)
    assert angle[:COUNT].max() < 0.1
    assert angle.max() < FACET


def test_nearest_points_are_exact_on_a_large_triangle(cloud):
    mesh = make_mesh(np.array([[-9, 0.2, -9], [0, 0.2, 30], [9, 0.2, -9]]), np.array([[0, 1, 2]]))
    nearest = nearest_points(cloud[0], mesh)
    position = cloud[0].position
    np.testing.assert_allclose(nearest.point, position * [1, 0, 1] + [0, 0.2, 0], atol=1e-6)
    np.testing.assert_allclose(nearest.height, position[:, 1] - 0.2, atol=1e-6)


def test_uniform_light_on_a_plane_below_a_sphere_has_the_closed_form(cloud, transport):
    position = cloud[1][:COUNT]
    distance = np.linalg.norm([0, HEIGHT, 0] - position, axis=1)
    expected = 1 - (RADIUS / distance) ** 2 * HEIGHT / distance
    radiance = white_radiance(transport, WHITE)[:COUNT, 0]
    np.testing.assert_allclose(radiance, expected, atol=TRANSPORT_ERROR)
    assert abs(radiance.mean() - expected.mean()) < TRANSPORT_ERROR / 8
    assert transport.error < TRANSPORT_ERROR


def test_splats_just_below_the_surface_see_and_deep_ones_do_not(cloud, transport, tmp_path):
    record = cloud[0].record.copy()
    for axis, name in enumerate("xyz"):
        record[name] -= (np.where(np.arange(2 * COUNT) % 2, 0.01, 0.25) * cloud[2][:, axis]).astype(np.float32)
    splats = load_splats(written(tmp_path / "below.ply", record))
    with pytest.warns(UserWarning, match="get no light"):
        below = np.asarray(splat_transport(splats, proxy(), progress=False).matrix)[COUNT:]
    exact = np.asarray(transport.matrix)[COUNT:]
    assert not below[::2].any()
    assert np.linalg.norm(below[1::2] - exact[1::2]) < 0.03 * np.linalg.norm(exact[1::2])


def test_relighting_by_the_captured_light_returns_its_colors(cloud, transport):
    random = np.random.default_rng(7)
    albedo = random.uniform(0.1, 0.9, (2 * COUNT, 3)).astype(np.float32)
    lit = relit(cloud[0], transport, albedo, SUN, stops=-3.0)
    radiance = albedo * white_radiance(transport, SUN) / 8
    np.testing.assert_allclose(lit.color, np.minimum(radiance, 1), atol=1e-5)
    captured = Environment(SUN.radiance / 8)
    shown = (radiance < 1).all(1) & (white_radiance(transport, captured).min(1) > 0.02)
    assert shown.sum() > COUNT / 2
    np.testing.assert_allclose(albedo_guess(lit, transport, captured)[shown], albedo[shown], atol=1e-4)


def test_relit_splats_change_in_color_alone(cloud, transport):
    lit = relit(cloud[0], transport, albedo_guess(cloud[0], transport, None), SUN)
    for name in FIELDS:
        if name.startswith("f_rest_"):
            assert not lit.record[name].any()
        elif not name.startswith("f_dc_"):
            assert lit.record[name].tobytes() == cloud[0].record[name].tobytes()
    assert lit.header == cloud[0].header


def test_without_a_captured_light_the_brightest_albedo_is_that_of_paper(cloud, transport):
    albedo = albedo_guess(cloud[0], transport, None)
    assert np.percentile(albedo, 99) == pytest.approx(0.8, rel=1e-3)
    assert albedo.max() <= 1


def test_other_counts_are_refused(cloud, transport):
    with pytest.raises(ValueError, match="rows of the albedo must be 400, got 3"):
        relit(cloud[0], transport, np.ones((3, 3), np.float32), SUN)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"form": "ascii"}, "must be binary_little_endian, got text"),
        ({"form": "binary_big_endian"}, "must be binary_little_endian, got big-endian"),
        ({"fields": [*FIELDS[:-1], "packed_position"]}, "must not be compressed"),
        ({"fields": [*FIELDS[:-2], "a", "b"]}, "missing are rot_2, rot_3"),
        ({"count": 2 * COUNT - 1}, "got 399 splats and 104 more bytes"),
        (
            {"more": "element face 0\nproperty list uchar int vertex_indices\n"},
            "one element 'vertex', got vertex, face",
        ),
        ({"fields": [*FIELDS, FIELDS[0]], "count": 300}, "'x' occurs more than once"),
    ],
)
def test_other_files_are_refused(cloud, tmp_path, change, message):
    path = written(tmp_path / "other.ply", cloud[0].record, header(**change))
    with pytest.raises(ValueError, match=message):
        load_splats(path)


def test_broken_values_are_refused(cloud, tmp_path):
    for name, value, message in (("y", np.nan, "centers of .* must be finite"), ("rot", 0, "must not be zero, got 1")):
        record = cloud[0].record.copy()
        for field in FIELDS:
            if field == name or field.startswith(name):
                record[field][17] = value
        with pytest.raises(ValueError, match=message):
            load_splats(written(tmp_path / "broken.ply", record))


@pytest.mark.parametrize("option", [[], ["--up", "-z", "--stops", "0", "--bounces", "1", "--degree", "1"]])
def test_command_writes_a_relit_cloud(cloud, tmp_path, option):
    path = written(tmp_path / "cloud.ply", cloud[0].record)
    mesh = builtin.plane(cells=2)
    lines = [f"v {x} {y} {z}" for x, y, z in np.asarray(mesh.position)]
    lines += ["f " + " ".join(str(vertex + 1) for vertex in face) for face in np.asarray(mesh.face)]
    (tmp_path / "proxy.obj").write_text("\n".join(lines) + "\n")
    output = tmp_path / "relit.ply"
    arguments = [str(path), str(tmp_path / "proxy.obj"), "--output", str(output), *option]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0
    assert "400 splats" in result.output
    assert load_splats(output).position.tobytes() == cloud[0].position.tobytes()
