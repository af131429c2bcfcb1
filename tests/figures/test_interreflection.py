"""Bounces: a form factor in closed form, the white furnace, and agreement of matrices with vectors."""

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
WHITE = jnp.asarray(np.sqrt(4 * np.pi) * np.eye(25, 1), jnp.float32)
# One ray through the center of each texel: edges of what it meets are told to a texel's width.
TEXELS = 0.02
# Transport by sixteenths of texels and bounces by whole ones do not add to exactly one.
FURNACE = 0.015  # of 167 vertices and faces of 16 x 16
# What of a bounce's light, which one side of a vertex may see and not the other, lies above degree 4.
CARRIED = 0.03


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


def bounce(mesh, value, albedo):
    """What one bounce adds to the mean of the light, given at each vertex."""
    transport = TransferVector(jnp.asarray(np.float32(value)[None, None]), mesh.position)
    total = interreflect_diffuse(mesh, transport, albedo, bounces=1, size=64)
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
    # Backs send nothing.
    upward = join([floor, sheet([-1, 1, -1.5], [0, 0, 3], [2, 0, 0], 2)])
    np.testing.assert_array_equal(bounce(upward, value, np.ones((2, 1))), 0)


def test_white_surfaces_in_a_white_furnace_vanish_as_bounces_grow():
    mesh, size, before = ball_and_ground(8, 12, 8), 16, None
    vector = precompute_diffuse(mesh, size=size)
    for bounces in (0, 1, 15):
        total = interreflect_diffuse(mesh, vector, np.ones((2, 1)), bounces=bounces, size=size)
        color = np.asarray(diffuse(total, jnp.ones(1), WHITE))[:, 0]
        assert color.max() < 1 + FURNACE
        if before is not None:
            assert (color >= before - 1e-6).all()
        before = color
    assert np.asarray(diffuse(vector, jnp.ones(1), WHITE)).min() < 0.7
    assert before.min() > 1 - FURNACE


def test_diffuse_matrices_agree_with_vectors(mesh, matrix, vector, lambert):
    light = np.random.default_rng(2).normal(size=(25, 3)).astype(np.float32)
    light[9:] *= 0.3
    light[0] = 4
    by_matrix = interreflect(mesh, matrix, lambert, bounces=2, size=SIZE)
    by_vector = interreflect_diffuse(mesh, vector, ALBEDO, bounces=2, size=SIZE)
    assert by_matrix.matrix.shape[1] == by_vector.vector.shape[1] == 3
    view = np.stack([np.asarray(each.coefficients(jnp.array([[0.0, 0, 1]])))[..., 0] for each in lambert])
    ours = np.einsum("vco,vcoi,ic->vc", view.swapaxes(1, 2)[np.asarray(mesh.region)], by_matrix.matrix, light)
    expected = np.asarray(diffuse(by_vector, jnp.ones(1), jnp.asarray(light))) * ALBEDO[np.asarray(mesh.region)]
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


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused(mesh, matrix, vector, lambert):
    some = precompute_diffuse(mesh, size=2, vertex=np.arange(5))
    few = eqx.tree_at(lambda t: (t.matrix, t.position), matrix, (matrix.matrix[:5], matrix.position[:5]))
    varying = HarmonicBrdf(jnp.zeros((25, 1, 2, 4, 4)), (jnp.array([0.1, 0.9]),), jnp.zeros(()))

    def vectors(transport, albedo=ALBEDO, **options):
        return interreflect_diffuse(mesh, transport, albedo, **options)

    def matrices(transport, brdf=lambert, **options):
        return interreflect(mesh, transport, brdf, **options)

    for refused, message in (
        (lambda: vectors(some), r"must have all \d+ vertices of the mesh, got 5"),
        (lambda: matrices(few), r"must have all \d+ vertices of the mesh, got 5"),
        (lambda: vectors(vector, ALBEDO[:1]), "each of the mesh's 2 regions must have a material, got 1"),
        (lambda: matrices(matrix, []), "2 regions must have a material, got 0"),
        (lambda: matrices(matrix, [lambert[0], lambert[0].truncate(degree=2)]), r"degree 4 .* got degrees \[2\]"),
        (lambda: matrices(matrix, [lambert[0], varying]), "no parameters"),
        (lambda: vectors(vector, np.full((2, 1), np.nan)), "albedos must be finite"),
        (lambda: vectors(vector, bounces=1.5), "bounces must be a whole number of at least 0"),
        (lambda: matrices(matrix, bounces=-1), "bounces must be a whole number of at least 0"),
        (lambda: vectors(vector, size=12), "size a power of two"),
    ):
        with pytest.raises(ValueError, match=message):
            refused()
