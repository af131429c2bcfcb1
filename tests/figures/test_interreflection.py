"""Bounces: form factors and radiosity in closed form, the white furnace, and agreement of matrices with vectors."""

import shutil

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published.interreflection import interreflect, interreflect_diffuse
from jaxprt import harmonic
from jaxprt.brdf import Lambert
from jaxprt.scene import builtin
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.systems.harmonic import (
    HarmonicBrdf,
    TransferVector,
    precompute,
    precompute_diffuse,
    tabulate,
)

SIZE = 8
EYE = jnp.array([1.0, 3.0, 4.0])
WHITE = jnp.zeros((25, 1)).at[0].set(np.sqrt(4 * np.pi))
# One ray through the center of each texel: edges of what it meets are told to a texel's width.
TEXELS = 0.02
# Transport by sixteenths of texels and bounces by whole ones do not add to exactly one.
FURNACE = 0.015  # of 167 vertices and faces of 16 x 16
# What of a bounce's light, which one side of a vertex may see and not the other, lies above degree 4.
CARRIED = 0.03


def relight(transport, table, light, *, eye):
    return prt.radiance(harmonic.HarmonicSystem(transport, table), light, eye=eye)


def diffuse(transport, albedo, light):
    return prt.radiance(harmonic.DiffuseSystem(transport, albedo), light, eye=jnp.zeros(3))


def sheet(corner, first, second, cells):
    """A parallelogram from a corner along two edges, its front where their cross product points."""
    step = np.linspace(0, 1, cells + 1)
    s, t = (each.ravel() for each in np.meshgrid(step, step, indexing="ij"))
    position = np.array(corner) + s[:, None] * np.array(first) + t[:, None] * np.array(second)
    start = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()[:, None]
    a, b, c, d = start, start + cells + 1, start + cells + 2, start + 1
    face = np.concatenate([np.concatenate([a, b, c], 1), np.concatenate([a, c, d], 1)])
    return make_mesh(position, face)


def vector_of(mesh, value):
    """Transfer of the mean of the light alone, with a value at each vertex."""
    return TransferVector(jnp.zeros((1, 1, len(value))).at[0, 0].set(jnp.asarray(value)), mesh.position)


def bounce(mesh, value, albedo, *, size=64, bounces=1):
    transport = vector_of(mesh, value)
    total = interreflect_diffuse(mesh, transport, albedo, bounces=bounces, size=size)
    return np.asarray(total.vector - transport.vector)[0, 0]


def ball_and_ground(rings, sectors, cells):
    """A sphere above a ground, each a region."""
    return join([builtin.sphere(rings=rings, sectors=sectors), sheet([-3, -1.3, -3], [0, 0, 6], [6, 0, 0], cells)])


@pytest.fixture(scope="module")
def mesh():
    """One block of vertices."""
    return ball_and_ground(5, 8, 4)


@pytest.fixture(scope="module")
def matrix(mesh):
    return precompute(mesh, size=SIZE)


@pytest.fixture(scope="module")
def vector(mesh):
    return precompute_diffuse(mesh, size=SIZE)


@pytest.fixture(scope="module")
def lambert():
    return [tabulate(Lambert(albedo), resolution=8) for albedo in ([1.0, 0.5, 0.25], [0.2, 0.6, 0.9])]


ALBEDO = np.array([[1.0, 0.5, 0.25], [0.2, 0.6, 0.9]])


def test_parallel_plates_have_the_form_factor_in_closed_form():
    floor = sheet([-0.05, 0, -0.05], [0, 0, 0.1], [0.1, 0, 0], 2)
    ceiling = sheet([-1, 1, -1.5], [2, 0, 0], [0, 0, 3], 2)
    mesh = join([floor, ceiling])
    assert mesh.normal[0, 1] > 0 > mesh.normal[-1, 1]
    value = np.where(np.arange(18) < 9, 0.0, 0.7)
    a, b = 1.0, 1.5  # Half edges over the distance: four corners.
    root_a, root_b = np.sqrt(1 + a * a), np.sqrt(1 + b * b)
    factor = 4 / (2 * np.pi) * (a / root_a * np.arctan(b / root_a) + b / root_b * np.arctan(a / root_b))
    center = 4
    np.testing.assert_allclose(bounce(mesh, value, np.ones((2, 1)))[center], 0.7 * factor, rtol=TEXELS)
    # The albedo is that of what reflects, not of what receives: that comes when the light leaves.
    np.testing.assert_allclose(bounce(mesh, value, np.full((2, 1), 0.5))[center], 0.35 * factor, rtol=TEXELS)


def test_perpendicular_plates_have_the_form_factor_in_closed_form():
    floor = sheet([0.95, 0, -0.05], [0, 0, 0.1], [0.1, 0, 0], 2)
    wall = sheet([0, 0, -2], [0, 1.5, 0], [0, 0, 4], 2)
    mesh = join([floor, wall])
    assert mesh.normal[-1, 0] > 0
    value = np.where(np.arange(18) < 9, 0.0, 1.0)
    y, x = 1 / 2.0, 1.5 / 2.0  # Distance and height over half of the width; twice a half.
    factor = 2 / (2 * np.pi) * (np.arctan(1 / y) - y / np.hypot(x, y) * np.arctan(1 / np.hypot(x, y)))
    np.testing.assert_allclose(bounce(mesh, value, np.ones((2, 1)))[4], factor, rtol=TEXELS)


def test_backs_of_surfaces_send_no_light():
    floor = sheet([-0.05, 0, -0.05], [0, 0, 0.1], [0.1, 0, 0], 2)
    ceiling = sheet([-1, 1, -1], [0, 0, 2], [2, 0, 0], 2)  # It faces up.
    mesh = join([floor, ceiling])
    np.testing.assert_array_equal(bounce(mesh, np.where(np.arange(18) < 9, 0.0, 1.0), np.ones((2, 1))), 0)


def test_light_is_interpolated_across_a_triangle():
    """A ceiling that brightens along x sends its mean to the point below its middle, and more to where it is bright."""
    floor = sheet([-0.9, 0, -0.05], [0, 0, 0.1], [1.8, 0, 0], 2)
    ceiling = sheet([-1, 1, -1], [2, 0, 0], [0, 0, 2], 1)
    mesh = join([floor, ceiling])
    slope = np.where(np.arange(13) < 9, 0.0, 1 + np.asarray(mesh.position)[:, 0])
    even = np.where(np.arange(13) < 9, 0.0, 1.0)
    sloped, flat = bounce(mesh, slope, np.ones((2, 1))), bounce(mesh, even, np.ones((2, 1)))
    np.testing.assert_allclose(sloped[4], flat[4], rtol=TEXELS)
    right, left = np.argmax(np.asarray(mesh.position)[:9, 0]), np.argmin(np.asarray(mesh.position)[:9, 0])
    assert sloped[right] > 1.3 * flat[right]
    assert sloped[left] < 0.7 * flat[left]


def test_a_groove_of_constant_light_sums_the_geometric_series():
    """In an endless right angle all points see half of the sky and half of the other wall: sum of (a / 2)^k / 2."""
    far = 400.0
    step = np.concatenate([[0], np.geomspace(1e-2, far, 24)])
    z = np.concatenate([-step[:0:-1], step])
    across, along = (each.ravel() for each in np.meshgrid(step, z, indexing="ij"))
    face = grid_faces(len(step), len(z))
    floor = make_mesh(np.stack([across, 0 * across, along], -1), face[:, ::-1])
    wall = make_mesh(np.stack([0 * across, across, along], -1), face)
    mesh = join([floor, wall])
    assert mesh.normal[0, 1] > 0.99
    assert mesh.normal[-1, 0] > 0.99
    asked = np.flatnonzero(np.hypot(*np.asarray(mesh.position)[:, :2].T) == np.float32(step[12]))
    asked = asked[np.abs(np.asarray(mesh.position)[asked, 2]) == 0]
    assert len(asked) == 2
    for bounces in (1, 2, 4):
        value = np.full(len(mesh.position), 0.5)
        total = 0.5 + bounce(mesh, value, np.full((2, 1), 0.8), size=8, bounces=bounces)[asked]
        expected = 0.5 * sum(0.4**k for k in range(bounces + 1))
        np.testing.assert_allclose(total, expected, rtol=TEXELS)


def grid_faces(rows, columns):
    start = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()[:, None]
    a, b, c, d = start, start + columns, start + columns + 1, start + 1
    return np.concatenate([np.concatenate([a, b, c], 1), np.concatenate([a, c, d], 1)])


def test_white_surfaces_in_a_white_furnace_vanish_as_bounces_grow():
    mesh, size, before = ball_and_ground(8, 12, 8), 16, None
    vector = precompute_diffuse(mesh, size=size)
    for bounces in (0, 1, 2, 15):
        total = interreflect_diffuse(mesh, vector, np.ones((2, 1)), bounces=bounces, size=size)
        color = np.asarray(diffuse(total, jnp.ones(1), WHITE))[:, 0]
        assert color.max() < 1 + FURNACE
        if before is not None:
            assert (color >= before - 1e-6).all()
        before = color
    assert np.asarray(diffuse(vector, jnp.ones(1), WHITE)).min() < 0.7
    assert before.min() > 1 - FURNACE


def test_a_white_furnace_is_as_white_through_matrices(mesh, matrix, vector):
    white = [tabulate(Lambert([1.0, 1, 1]), resolution=8)] * 2
    total = interreflect(mesh, matrix, white, bounces=3, size=SIZE)
    first, color = (np.asarray(relight(each, white[0], WHITE, eye=EYE))[:, 0] for each in (matrix, total))
    expected = interreflect_diffuse(mesh, vector, np.ones((2, 1)), bounces=3, size=SIZE)
    expected = np.asarray(diffuse(expected, jnp.ones(1), WHITE))[:, 0]
    seen = first > 0
    assert seen.sum() > 30
    assert (color[seen] >= first[seen]).all()
    assert color.max() < 1 + CARRIED
    np.testing.assert_allclose(color[seen], expected[seen], atol=2 * CARRIED)


def test_no_bounces_change_nothing(mesh, matrix, vector, lambert):
    same = interreflect_diffuse(mesh, vector, np.ones((2, 1)), bounces=0, size=SIZE)
    np.testing.assert_array_equal(same.vector, vector.vector)
    same = interreflect(mesh, matrix, lambert, bounces=0, size=SIZE)
    np.testing.assert_array_equal(same.matrix, np.broadcast_to(matrix.matrix, same.matrix.shape))


def test_bounces_add_up(mesh, vector, close):
    """Two bounces are one, and one of what it added."""
    one, two = (interreflect_diffuse(mesh, vector, ALBEDO, bounces=n, size=SIZE).vector for n in (1, 2))
    added = TransferVector(one - vector.vector, vector.position)
    again = interreflect_diffuse(mesh, added, ALBEDO, bounces=1, size=SIZE).vector
    close(two, vector.vector + again)
    assert np.linalg.norm(two - one) > 0.01 * np.linalg.norm(one)


def test_surfaces_color_each_other_and_not_themselves(mesh, vector):
    """A red sphere over a black ground reddens the ground; the sphere itself gets nothing."""
    albedo = np.array([[1.0, 0, 0], [0, 0, 0]])
    added = np.asarray(interreflect_diffuse(mesh, vector, albedo, size=SIZE).vector - vector.vector)
    color = np.einsum("ilv,i->vl", added, np.asarray(WHITE)[:, 0])
    ball = np.asarray(mesh.region) == 0
    np.testing.assert_array_equal(color[ball], 0)
    np.testing.assert_array_equal(color[:, 1:], 0)
    below = np.argmin(np.linalg.norm(np.asarray(mesh.position) - [0, -1.3, 0], axis=1))
    far = np.abs(np.asarray(mesh.position)[:, [0, 2]]).min(1) > 2.9
    assert color[below, 0] > 0.02
    assert color[~ball].min() >= 0
    assert color[far, 0].max() < 0.5 * color[below, 0]


def test_diffuse_matrices_agree_with_vectors(mesh, matrix, vector, lambert):
    light = jnp.asarray(np.random.default_rng(2).normal(size=(25, 3)), jnp.float32)
    light = light.at[9:].multiply(0.3).at[0].set(4)
    by_matrix = interreflect(mesh, matrix, lambert, bounces=2, size=SIZE)
    by_vector = interreflect_diffuse(mesh, vector, ALBEDO, bounces=2, size=SIZE)
    assert by_matrix.matrix.shape[1] == by_vector.vector.shape[1] == 3
    view = np.stack([np.asarray(each.coefficients(jnp.array([[0.0, 0, 1]])))[..., 0] for each in lambert])
    ours = np.einsum("vco,vcoi,ic->vc", view.swapaxes(1, 2)[np.asarray(mesh.region)], by_matrix.matrix, light)
    expected = diffuse(by_vector, jnp.ones(1), light) * ALBEDO[np.asarray(mesh.region)]
    assert np.linalg.norm(ours - expected) < CARRIED * np.linalg.norm(expected)


def test_every_region_sends_what_its_own_brdf_reflects(mesh, matrix, lambert):
    gray = HarmonicBrdf(lambert[0].table[:, :1], (), lambert[0].error)
    mixed, only, other = (
        np.asarray(interreflect(mesh, matrix, brdf, size=SIZE).matrix)
        for brdf in ([gray, lambert[1]], [gray, gray], [lambert[1], lambert[1]])
    )
    ball = np.asarray(mesh.region) == 0
    assert only.shape[1] == 1
    # The ball meets the ground alone, the ground the ball alone.
    np.testing.assert_allclose(mixed[ball], other[ball], atol=1e-6)
    np.testing.assert_allclose(mixed[~ball], np.broadcast_to(only, mixed.shape)[~ball], atol=1e-6)
    assert np.abs(only - other).max() > 0.01


def test_bounces_are_linear_in_the_transport(mesh, vector, close):
    def added(value):
        transport = TransferVector(value, vector.position)
        return interreflect_diffuse(mesh, transport, ALBEDO, size=SIZE).vector - value

    other = vector.vector[::-1]
    close(added(2 * vector.vector - other), 2 * added(vector.vector) - added(other))


def test_transport_of_some_vertices_is_refused(mesh, matrix, vector, lambert):
    some = precompute_diffuse(mesh, size=2, vertex=np.arange(5))
    with pytest.raises(ValueError, match=r"must have all \d+ vertices of the mesh, got 5"):
        interreflect_diffuse(mesh, some, ALBEDO)
    some = eqx.tree_at(lambda t: (t.matrix, t.position), matrix, (matrix.matrix[:5], matrix.position[:5]))
    with pytest.raises(ValueError, match=r"must have all \d+ vertices of the mesh, got 5"):
        interreflect(mesh, some, lambert)


def test_regions_without_a_material_are_refused(mesh, matrix, vector, lambert):
    with pytest.raises(ValueError, match="each of the mesh's 2 regions must have a material, got 1"):
        interreflect_diffuse(mesh, vector, ALBEDO[:1])
    for brdf in (lambert[:1], []):
        with pytest.raises(ValueError, match=f"2 regions must have a material, got {len(brdf)}"):
            interreflect(mesh, matrix, brdf)


def test_tables_of_another_degree_or_with_parameters_are_refused(mesh, matrix, lambert):
    low = lambert[0].truncate(degree=2)
    with pytest.raises(ValueError, match=r"must have the transport's degree 4 and no parameters, got degrees \[2\]"):
        interreflect(mesh, matrix, [lambert[0], low])
    varying = HarmonicBrdf(jnp.zeros((25, 1, 2, 4, 4)), (jnp.array([0.1, 0.9]),), jnp.zeros(()))
    with pytest.raises(ValueError, match="no parameters"):
        interreflect(mesh, matrix, [lambert[0], varying])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("options", [{"bounces": -1}, {"bounces": 1.5}, {"size": 12}])
def test_bounces_and_sizes_out_of_range_are_refused(mesh, matrix, vector, lambert, options):
    message = "bounces must be a whole number of at least 0" if "bounces" in options else "size a power of two"
    with pytest.raises(ValueError, match=message):
        interreflect_diffuse(mesh, vector, ALBEDO, **options)
    with pytest.raises(ValueError, match=message):
        interreflect(mesh, matrix, lambert, **options)


@pytest.mark.parametrize("albedo", [np.nan, np.inf])
def test_albedos_that_are_not_finite_are_refused(mesh, vector, albedo):
    with pytest.raises(ValueError, match="albedos must be finite"):
        interreflect_diffuse(mesh, vector, np.full((2, 1), albedo))


def test_bounces_go_on_from_their_folders_which_know_what_they_are_of(mesh, matrix, vector, lambert, tmp_path, close):
    options = {"bounces": 2, "size": 4}
    for number in (1, 2):
        found = interreflect(mesh, matrix, lambert, run=prt.Run(tmp_path / "matrix"), **options).matrix
        shutil.rmtree(tmp_path / "matrix" / "bounce_2")
        if number == 1:
            first = found
    close(found, first)
    albedo = np.array([[0.5], [0.25]])
    kept = interreflect_diffuse(mesh, vector, albedo, run=prt.Run(tmp_path / "vector"), **options).vector
    close(kept, interreflect_diffuse(mesh, vector, albedo, **options).vector)
    with pytest.raises(ValueError, match=r"bounce_1 holds arrays that were computed from other inputs .*brdf"):
        interreflect(mesh, matrix, lambert[::-1], run=prt.Run(tmp_path / "matrix"), **options)
    with pytest.raises(ValueError, match=r"bounce_1 holds arrays that were computed from other inputs .*albedo"):
        interreflect_diffuse(mesh, vector, albedo / 2, run=prt.Run(tmp_path / "vector"), **options)
