"""Clustered transfer against uncompressed matrices, and NumPy's singular values of these."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import harmonic, require
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join
from jaxprt.sphere import harmonics
from jaxprt.systems.harmonic import clustered
from jaxprt.visibility import members

DEGREE, SIZE, CLUSTERS = 3, 8, 5
EYE = jnp.array([1.5, 2.0, 2.5])
SINGLE = 2e-5  # Matrices of sixteen harmonics, whose visibility has forty-nine, in single precision.
pytestmark = pytest.mark.usefixtures("coarse")


@functools.cache
def mesh():
    """A sphere above a ground, whose vertices shadow each other."""
    ball, floor = builtin.sphere(rings=6, sectors=10), builtin.plane(cells=5)
    below = eqx.tree_at(lambda m: m.position, floor, floor.position * 2 - jnp.array([0.0, 1.01, 0.0]))
    return join([ball, below])


@functools.cache
def whole():
    return harmonic.precompute(mesh(), degree=DEGREE, size=SIZE, progress=False)


@functools.cache
def made(components=6):
    options = {"degree": DEGREE, "size": SIZE, "clusters": CLUSTERS, "progress": False}
    return harmonic.precompute_clustered(mesh(), components=components, **options)


def in_world(matrix):
    """Matrices turned from the frames of their vertices to the world, in float64, by quadrature."""
    node, weight = harmonic_rule()
    basis = np.asarray(harmonics.evaluate(jnp.asarray(node), degree=DEGREE), np.float64)
    result = []
    for each, frame in zip(np.asarray(matrix.matrix, np.float64)[:, 0], np.asarray(matrix.frame), strict=True):
        local = np.asarray(harmonics.evaluate(jnp.asarray(node @ frame.T), degree=DEGREE), np.float64)
        result.append((basis.T * weight) @ local @ each)
    return np.stack(result)


def harmonic_rule():
    height, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(15) / 15
    radius = np.sqrt(1 - height**2)[:, None]
    node = np.stack([radius * np.cos(angle), radius * np.sin(angle), height[:, None] + 0 * angle], -1)
    return node.reshape(-1, 3).astype(np.float32), np.repeat(weight * 2 * np.pi / 15, 15)


def natural():
    """Root mean square of each harmonic of natural light."""
    return np.repeat(1 / (np.arange(DEGREE + 1) + 0.5), 2 * np.arange(DEGREE + 1) + 1)


def test_all_components_are_the_uncompressed_matrices(close):
    count = len(mesh().position)
    member = members.cluster(mesh().position, mesh().normal, clusters=CLUSTERS)
    full = made(member.shape[1])
    close(full.matrices(np.arange(count)).matrix, whole().matrix, tolerance=SINGLE)
    assert full.error < 1e-5
    assert full.degree == DEGREE


def test_components_leave_what_singular_values_of_the_matrices_leave():
    """The principal components of whole matrices, by another route: matrices, turned, weighted, decomposed by NumPy."""
    member = members.cluster(mesh().position, mesh().normal, clusters=CLUSTERS)
    rows = (in_world(whole()) * natural()).reshape(len(mesh().position), -1)
    few = made()
    found, total = np.asarray(few.left), np.asarray(few.total)
    for number, own in enumerate(member):
        offset = rows[own] - rows[own].mean(0)
        value = np.linalg.svd(offset, compute_uv=False)
        np.testing.assert_allclose(total[number], np.sum(rows[own] ** 2), rtol=1e-4)
        np.testing.assert_allclose(found[number], np.sum(value[6:] ** 2), rtol=2e-3, atol=1e-6 * total[number])
    assert 1e-3 < few.error < 0.2


def test_the_error_is_that_of_the_matrices_and_grows_as_components_go():
    expected = in_world(whole()) * natural()
    member = np.concatenate(members.cluster(mesh().position, mesh().normal, clusters=CLUSTERS))
    last = 0.0
    for components in (6, 4, 2, 1):
        few = made().truncate(components=components)
        off = (in_world(few.matrices(np.arange(len(mesh().position)))) * natural() - expected)[member]
        np.testing.assert_allclose(few.error, np.linalg.norm(off) / np.linalg.norm(expected[member]), rtol=1e-3)
        assert few.error > last
        assert few.component.shape[1] == few.weight.shape[2] == components
        last = few.error


def test_radiance_is_that_of_uncompressed_matrices():
    table = harmonic.tabulate(AshikhminShirley(nu=12, nv=4), degree=DEGREE, error=0.5)
    light = Environment(jnp.asarray(np.random.default_rng(0).uniform(size=(6, SIZE, SIZE, 3)), jnp.float32))
    exact, *found = (
        np.asarray(prt.radiance(system, light, eye=EYE))
        for system in (
            harmonic.HarmonicSystem(whole(), table, 0.4),
            harmonic.ClusteredSystem(made(len(mesh().position) // CLUSTERS + 1), table, 0.4),
            harmonic.ClusteredSystem(made(), table, 0.4),
        )
    )
    error = [np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in found]
    assert error[0] < SINGLE
    assert error[1] < 0.03


def test_bytes_are_those_of_components_and_weights():
    few = made()
    terms, rows = (2 * DEGREE + 1) ** 2, few.weight.shape[1] * CLUSTERS
    assert few.nbytes == 4 * (7 * CLUSTERS * terms + 6 * rows)
    assert few.nbytes < whole().nbytes / 5


def test_light_of_arrays_in_programs_is_the_same_and_has_gradients(close):
    light = jnp.asarray(np.random.default_rng(1).normal(size=(16, 2)), jnp.float32)
    arriving = harmonic.clustered_light(made(), light)
    matrices = made().matrices(np.arange(3))
    close(arriving[..., :3], np.einsum("voi,ic->ocv", in_world(matrices), light), tolerance=SINGLE)
    weight = jnp.asarray(np.random.default_rng(2).normal(size=arriving.shape), jnp.float32)
    slope = jax.jit(jax.grad(lambda x: jnp.vdot(weight, harmonic.clustered_light(made(), x))))(light)
    close(jnp.vdot(slope, light), jnp.vdot(weight, arriving), tolerance=1e-4)


def test_some_vertices_are_theirs_in_the_whole_and_a_store_resumes(tmp_path, close):
    chosen = np.array([50, 3, 7, 4, 20, 33])
    options = {"degree": DEGREE, "size": SIZE, "clusters": 2, "components": 3, "progress": False, "vertex": chosen}
    first = harmonic.precompute_clustered(mesh(), path=tmp_path / "store", **options)
    close(first.matrices(np.arange(6)).matrix, np.asarray(whole().matrix)[chosen], tolerance=SINGLE)
    again = harmonic.precompute_clustered(mesh(), path=tmp_path / "store", **options)
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    with pytest.raises(ValueError, match="store"):
        harmonic.precompute_clustered(mesh(), path=tmp_path / "store", **{**options, "components": 2})


def test_matrices_that_do_not_fit_are_refused_with_their_bytes(monkeypatch, tmp_path):
    exact = np.asarray(whole().matrix)
    monkeypatch.setattr(require, "_host_memory", lambda: 50_000)
    words = rf"degree 3 for {len(mesh().position)} vertices, 1,024 bytes each, take .*; take .*precompute_clustered"
    with pytest.raises(MemoryError, match=words):
        harmonic.precompute(mesh(), degree=DEGREE, size=SIZE, progress=False)
    harmonic.precompute(mesh(), degree=DEGREE, size=SIZE, vertex=np.arange(20), progress=False)
    with pytest.warns(
        UserWarning, match="they stay in files, and each new light reads all of them. To avoid this, take"
    ):
        mapped = harmonic.precompute(mesh(), degree=DEGREE, size=SIZE, path=tmp_path / "store", progress=False)
    np.testing.assert_array_equal(mapped.matrix, exact)
    monkeypatch.setattr(require, "_host_memory", lambda: 7_000_000_000)
    with pytest.raises(MemoryError, match=r"36,000 vertices, 202,500 bytes each, take 7\.3 GB, and 7\.0 GB are free"):
        harmonic.transfer.check_memory(36_000, 14)
    monkeypatch.setattr(require, "_host_memory", lambda: None)
    harmonic.transfer.check_memory(36_000, 25)  # What is free is not known.


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_together_is_refused():
    options = {"degree": DEGREE, "size": SIZE, "progress": False}
    with pytest.raises(ValueError, match="components must be between 1 and the 18 vertices of a cluster, got 21"):
        harmonic.precompute_clustered(mesh(), clusters=CLUSTERS, components=21, **options)
    count = len(mesh().position)
    with pytest.raises(ValueError, match=f"clusters must be between 1 and the {count} points, got {count + 1}"):
        harmonic.precompute_clustered(mesh(), clusters=count + 1, **options)
    with pytest.raises(ValueError, match="light must have the degree of the transport, 3, got 2"):
        harmonic.clustered_light(made(), jnp.ones((9, 3)))
    with pytest.raises(ValueError, match="components must be between 1 and 6, got 7"):
        made().truncate(components=7)
    table = harmonic.tabulate(AshikhminShirley(nu=12, nv=4), degree=2, error=0.5)
    with pytest.raises(ValueError, match="the BRDF must have the transport's degree 3, got 2"):
        harmonic.ClusteredSystem(made(), table)
    with pytest.raises(TypeError, match="transport must be of class ClusteredTransfer"):
        harmonic.ClusteredSystem(whole(), table)


def test_a_cluster_whose_vertices_see_alike_needs_no_components():
    ball = builtin.sphere(rings=6, sectors=10)
    flat = builtin.plane(cells=4)
    for alike in (flat, eqx.tree_at(lambda m: m.position, ball, ball.position * 3)):
        few = harmonic.precompute_clustered(alike, degree=2, size=SIZE, clusters=1, components=1, progress=False)
        assert np.isfinite(few.error)
    assert (
        harmonic.precompute_clustered(flat, degree=2, size=SIZE, clusters=1, components=1, progress=False).error < 1e-5
    )
    made_alone = clustered.compress(
        jnp.full((3, 6 * SIZE**2), 16, jnp.uint8), jnp.tile(jnp.eye(3), (3, 1, 1)), degree=2, components=2
    )
    assert all(np.isfinite(np.asarray(each)).all() for each in made_alone)
