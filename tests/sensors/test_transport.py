"""Light at any points as a matrix, against closed forms and exact sums of the same points."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import sensors
from jaxprt.brdf import Lambert, Phong
from jaxprt.scene import Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sensors.build import transmittance
from jaxprt.sensors.matrix import Quantized, Sparse
from jaxprt.sphere import patches

POINT = np.random.default_rng(0).uniform(-3, 3, (60, 3)) * [1, 0, 1] + [0, -1.5, 0]
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])
UP = np.tile([0.0, 1.0, 0.0], (60, 1))
DISTANCE = np.linalg.norm(POINT, axis=1)
HIDDEN = 1.5 / DISTANCE**3  # form factor of the unit sphere from a horizontal element below it


@pytest.fixture(scope="module")
def ball():
    return Scene([Part("ball", builtin.sphere(rings=48, sectors=96), Lambert([0.5, 0.5, 0.5]))])


def received(scene, point=POINT, normal: Any = UP, **options):
    return sensors.transport(scene, point, normal, **{"progress": False, "size": 32} | options)


def constant(basis):
    """Coefficients of a uniform light of radiance 1."""
    if isinstance(basis, sensors.Harmonics):
        return np.eye(basis.count, dtype=np.float32)[0] * 2 * np.sqrt(np.pi)
    return np.ones(basis.count, np.float32)


@pytest.mark.parametrize("basis", [sensors.Patches(), sensors.Harmonics(2), sensors.Texels(8)])
def test_irradiance_under_a_uniform_light_is_that_of_the_form_factor(ball, basis):
    transport = received(ball, basis=basis)
    assert np.max(np.abs(np.asarray(transport.apply(constant(basis))) / np.pi - (1 - HIDDEN))) < 2e-3
    assert 0 < transport.error < 0.05


def test_scalar_light_is_the_solid_angle_that_is_not_hidden(ball):
    basis = sensors.Texels(8)
    scalar = received(ball, normal=None, kind="scalar", basis=basis).apply(constant(basis))
    visible = 2 * np.pi * (1 + np.sqrt(1 - 1 / DISTANCE**2))
    np.testing.assert_allclose(scalar, visible, rtol=2e-3)


def test_one_bounce_on_a_gray_ball_adds_half_of_what_it_hides(ball):
    basis = sensors.Patches()
    transport = received(ball, basis=basis, bounces=1)
    reflected = np.asarray(transport.reflected) @ constant(basis) / np.pi
    assert np.linalg.norm(reflected - HIDDEN / 2) < 0.02 * np.linalg.norm(HIDDEN / 2)
    whole = np.asarray(transport.matrix) @ constant(basis)
    np.testing.assert_allclose(transport.apply(constant(basis)), whole, rtol=1e-5)


def test_bounces_have_the_colors_of_the_materials():
    red = TexturedMaterial(base_color=[0.6, 0.2, 0.1], metallic=0.0)
    scene = Scene([Part("ball", builtin.sphere(rings=12, sectors=24), red)])
    transport = received(scene, bounces=1, basis=sensors.Harmonics(1), size=16)
    color = np.asarray(transport.reflected)[:, 0].mean(0)
    np.testing.assert_allclose(color / color[0], [1, 1 / 3, 1 / 6], rtol=1e-5)
    gray = transport.luminance()
    light = np.array([1, 0, 0, 0], np.float32)
    np.testing.assert_allclose(
        gray.apply(light), np.asarray(transport.apply(np.tile(light[:, None], 3))) @ [0.2126, 0.7152, 0.0722], rtol=1e-5
    )


def test_both_sides_of_a_wall_reflect():
    square = np.array([[-9, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]], float)
    scene = Scene([Part("wall", make_mesh(square, SQUARE), Lambert([0.5] * 3))])
    point, normal = np.array([[0, 0, 0.1], [0, 0, -0.1]]), np.array([[0, 0, -1.0], [0, 0, 1]])
    transport = received(scene, point, normal, bounces=1, basis=sensors.Patches())
    np.testing.assert_allclose(np.asarray(transport.reflected) @ constant(transport.basis), np.pi / 2, rtol=0.02)


def test_radiance_with_a_material_is_the_sum_over_texels(ball):
    brdf, basis = Phong(), sensors.Texels(32)
    view = np.tile([0.6, 0.8, 0.0], (60, 1))
    transport = received(ball, brdf=brdf, view=view, basis=basis)
    light = builtin.daylight(size=32)
    way, area = prt.sphere.cubemap.direction(size=32).reshape(-1, 3), prt.sphere.cubemap.vector_area(size=32)
    visible = np.asarray(received(ball, basis=basis).direct) / np.maximum(area.reshape(-1, 3) @ UP[0], 1e-9)
    frame = prt.sphere.directions.frame(jnp.asarray(UP), prt.sphere.directions.tangent(jnp.asarray(UP)))
    wi = prt.sphere.directions.to_local(frame, way)
    wo = jnp.broadcast_to(jnp.einsum("bij,bj->bi", frame, view)[:, None], wi.shape)
    weight = visible * np.maximum(np.asarray(area).reshape(-1, 3) @ UP[0], 0)
    expected = np.einsum("pd,pdc,dc->pc", weight, np.asarray(brdf(wi, wo)), light.radiance.reshape(-1, 3))
    np.testing.assert_allclose(transport.apply(light), expected, rtol=2e-3)


def test_light_passes_a_pane_less_what_it_reflects_and_absorbs():
    square = np.array([[-9, 0, -9], [9, 0, -9], [9, 0, 9], [-9, 0, 9]], float)
    pane = Part("pane", make_mesh(1e3 * square + [0, 1, 0], SQUARE), Lambert([0.5] * 3))
    floor = Part("floor", make_mesh(square, SQUARE[:, ::-1]), Lambert([0.2] * 3))
    transport = received(Scene([pane, floor]), np.array([[0, 0.5, 0.0]]), UP[:1], glass={"pane": 0.9})
    cosine = np.sqrt((np.arange(4000) + 0.5) / 4000)
    expected = np.pi * np.mean(transmittance(cosine, 0.9))
    np.testing.assert_allclose(np.asarray(transport.matrix).sum(), expected, rtol=3e-3)
    # One surface of index 1.52 reflects 4.26 % at normal incidence: two let 91.8 % pass without absorption.
    np.testing.assert_allclose(transmittance(np.ones(1), 1.0), (1 - 0.04258) / (1 + 0.04258), rtol=1e-4)


@pytest.mark.parametrize(("error", "kind"), [(1e-5, Sparse), (3e-2, Quantized)])
def test_a_compressed_transport_stays_within_the_error(ball, error, kind):
    transport = received(ball, basis=sensors.Texels(8))
    smaller, light = transport.compressed(error), builtin.daylight(size=8)
    assert isinstance(smaller.direct, kind)
    exact = np.asarray(transport.apply(light))
    assert np.linalg.norm(np.asarray(smaller.apply(light)) - exact) <= max(error, 1e-7) * np.linalg.norm(exact)
    assert smaller.nbytes <= transport.nbytes


def test_a_spiky_transport_is_stored_sparsely():
    row, light = np.zeros((7, 384), np.float32), np.arange(384, dtype=np.float32)
    row[np.arange(7), np.arange(7) * 50] = 1
    smaller = sensors.PointTransport(jnp.asarray(row - 1e-9), None, sensors.Texels(8)).compressed(1e-3)
    assert isinstance(smaller.direct, Sparse)
    np.testing.assert_allclose(smaller.apply(light), row @ light, atol=1e-3)


def test_apply_is_linear_and_differentiable(ball):
    transport = received(ball, basis=sensors.Harmonics(2))
    slope = jax.grad(lambda light: jnp.sum(transport.apply(light)))(jnp.zeros(9))
    np.testing.assert_allclose(slope, np.asarray(transport.matrix).sum(0), rtol=1e-5)


def test_slits_narrower_than_texels_let_their_share_of_light_in():
    edge = np.arange(-4, 4, 0.02)
    strip = np.stack([np.stack([[x, 1, -4], [x + 0.015, 1, -4], [x + 0.015, 1, 4], [x, 1, 4]]) for x in edge])
    first = 4 * np.arange(len(edge))[:, None]
    face = np.concatenate([first + [0, 1, 2], first + [0, 2, 3]])
    scene = Scene([Part("slats", make_mesh(strip.reshape(-1, 3), face), Lambert([0.5] * 3))])
    point = np.random.default_rng(1).uniform(-0.3, 0.3, (40, 3)) * [1, 0, 1]
    open_share = np.asarray(received(scene, point, UP[:40], size=16).matrix)[:, -1].mean()
    assert abs(open_share / patches.projected_solid_angles(subdivision=1)[-1] - 0.25) < 0.02


def test_points_inside_of_solids_get_nothing_and_are_counted(ball):
    point = np.array([[0, 0, 0.0], [0, 3, 0]])
    with pytest.warns(UserWarning, match="1 of 2 points get no light, first point 0"):
        transport = received(ball, point, UP[:2])
    assert transport.dark == (0,)
    assert not np.asarray(transport.matrix)[0].any()


def test_a_stopped_job_array_goes_on_and_writes_the_same_bytes(ball, tmp_path):
    point = np.tile(POINT, (4, 1))
    options = {"normal": np.tile(UP, (4, 1)), "path": str(tmp_path / "shared"), "size": 16}
    with pytest.raises(prt.visibility.UnfinishedError):
        received(ball, point, executor=prt.visibility.Shard(1, 2), **options)
    before = {path.name: path.read_bytes() for path in (tmp_path / "shared").rglob("*.npy")}
    with pytest.raises(prt.visibility.UnfinishedError):
        received(ball, point, executor=prt.visibility.Shard(1, 2), **options)
    assert before == {path.name: path.read_bytes() for path in (tmp_path / "shared").rglob("*.npy")}
    both = received(ball, point, executor=prt.visibility.Shard(2, 2), **options)
    whole = received(ball, point, options["normal"], size=16)
    np.testing.assert_array_equal(both.matrix, whole.matrix)


def test_a_transport_is_saved_and_loaded(ball, tmp_path):
    transport = received(ball, basis=sensors.Harmonics(1), size=16)
    prt.files.save(tmp_path / "kept", transport)
    again = prt.files.load(tmp_path / "kept")
    np.testing.assert_array_equal(again.matrix, transport.matrix)
    assert again.basis == transport.basis


def test_points_far_from_zero_are_in_the_coordinates_of_the_file():
    sphere = builtin.sphere(rings=24, sectors=48)
    far = np.array([4e6, 100.0, -5e6])
    moved = make_mesh(np.asarray(sphere.position, np.float64) + far, np.asarray(sphere.face))
    near = received(
        Scene(
            [
                Part(
                    "ball",
                    make_mesh(np.asarray(sphere.position, np.float64), np.asarray(sphere.face)),
                    Lambert([0.5] * 3),
                )
            ]
        )
    )
    np.testing.assert_allclose(
        received(Scene([Part("ball", moved, Lambert([0.5] * 3))]), POINT + far).matrix, near.matrix, atol=0.02
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normal": None}, "the normals must be given, one for each point, got None"),
        ({"normal": UP * 0}, "the normals must have a length, got 60 without one, first"),
        ({"kind": "luminance"}, "kind must be 'irradiance' or 'scalar', got 'luminance'"),
        ({"brdf": Phong()}, "a BRDF needs the directions of view of the points"),
        ({"glass": {"window": 0.9}}, "glass must name parts of the scene, got 'window'; parts are ball"),
        ({"glass": {"ball": 0.9}}, "the scene must have parts that are not of glass"),
        ({"basis": sensors.Texels(64), "size": 32}, "rays must be traced through 64 texels along an edge"),
        ({"point": POINT * np.nan}, "the points must be finite"),
    ],
)
def test_bad_input_is_refused(ball, options, message):
    with pytest.raises(ValueError, match=message):
        received(ball, **options)


def test_a_wanted_error_chooses_the_rays(ball):
    coarse, fine = (received(ball, basis=sensors.Harmonics(2), error=error) for error in (0.1, 3e-4))
    assert fine.error <= 3e-4
    assert coarse.error <= 0.1
