"""Relighting by harmonics: all ways to the same radiance, closed forms without shadows, and probes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published.harmonics import transferred_view, unshadowed_radiance, world_view
from jaxprt import harmonic
from jaxprt.scene import builtin
from jaxprt.scene.mesh import make_mesh
from jaxprt.sphere import directions, harmonics
from jaxprt.systems.harmonic import HarmonicBrdf, TransferMatrix, TransferVector

EYE = jnp.array([2.0, 3.0, 4.0])


def relight(transport, table, light, *, eye):
    return prt.radiance(harmonic.HarmonicSystem(transport, table), light, eye=eye)


def diffuse(transport, albedo, light):
    return prt.radiance(harmonic.DiffuseSystem(transport, albedo), light, eye=jnp.zeros(3))


@pytest.fixture
def random():
    return np.random.default_rng(11)


def made(random, *, vertices=5, transported=1, colors=3, terms=9):
    """Random transport and a random table."""
    frame = np.linalg.qr(random.normal(size=(vertices, 3, 3)))[0]
    frame = frame * np.sign(np.linalg.det(frame))[:, None, None]
    array = [random.normal(size=(vertices, transported, terms, terms)), random.normal(size=(vertices, 3)), frame]
    matrix = TransferMatrix(*(jnp.asarray(each, jnp.float32) for each in array))
    table = jnp.asarray(random.normal(size=(terms, colors, 4, 4)), jnp.float32)
    return matrix, HarmonicBrdf(table, (), jnp.zeros(()))


def normal(random, *shape):
    return jnp.asarray(random.normal(size=shape), jnp.float32)


@pytest.mark.parametrize(
    ("transported", "colors", "lights"), [(1, 1, (3,)), (1, 3, (1, 5)), (3, 1, (1, 5)), (3, 3, (3,))]
)
def test_all_ways_with_transfer_give_the_same_radiance(random, close, transported, colors, lights):
    matrix, brdf = made(random, transported=transported, colors=colors)
    light = normal(random, 9, *lights)
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    several = light if light.ndim == 3 else jnp.broadcast_to(light[..., None], (*light.shape, 5))
    expected = np.einsum(
        "vcoi,icv,ocv->vc",
        *np.broadcast_arrays(np.zeros((5, 3, 9, 9)), matrix.matrix)[1:],
        np.broadcast_to(several, (9, 3, 5)),
        np.broadcast_to(view, (9, 3, 5)),
    )
    expected = expected[:, : max(transported, colors, lights[0])]
    assert np.abs(expected).max() > 0.1
    close(relight(matrix, brdf, light, eye=EYE), expected)
    close(harmonic.system.combine(harmonic.system.transferred_light(matrix, light), view), expected)
    close(harmonic.system.combine(light, transferred_view(matrix, view)), expected)


@pytest.mark.parametrize("lights", [(3,), (1, 61)])
def test_all_ways_without_transfer_give_the_same_radiance(random, close, lights):
    mesh = builtin.sphere(rings=6, sectors=10)
    vertices = len(mesh.position)
    lights = lights[:1] if len(lights) == 1 else (lights[0], vertices)
    brdf, light = made(random)[1], normal(random, 9, *lights)
    frame = directions.frame(mesh.normal, mesh.tangent)
    view = harmonic.system.view_coefficients(brdf, mesh.position, frame, eye=EYE)
    expected = unshadowed_radiance(mesh, brdf, light, eye=EYE)
    assert expected.shape == (vertices, 3)
    close(harmonic.system.combine(harmonic.system.local_light(frame, light), view), expected)
    close(harmonic.system.combine(light, world_view(frame, view)), expected)
    # An open vertex's transfer is the rotation.
    seen = jnp.full((vertices, 6), 16, jnp.uint8)
    matrix = harmonic.transfer.transfer(seen, frame, degree=2)[:, None]
    close(relight(TransferMatrix(matrix, mesh.position, frame), brdf, light, eye=EYE), expected, tolerance=2e-5)


def test_unshadowed_radiance_is_the_integral_of_light_times_table(random):
    """By a product rule that is exact for both: nothing of ours but evaluation and lookup is between."""
    matrix, brdf = made(random)
    light = normal(random, 9, 3)
    mesh = make_mesh(matrix.position, np.array([[0, 1, 2]]), normal=matrix.frame[:, 2], tangent=matrix.frame[:, 0])
    node, weight = np.polynomial.legendre.leggauss(6)
    angle = 2 * np.pi * np.arange(9) / 9
    radius = np.sqrt(1 - node**2)[:, None]
    wi = np.stack([radius * np.cos(angle), radius * np.sin(angle), node[:, None] + 0 * angle], -1).reshape(-1, 3)
    arriving = np.asarray(harmonics.reconstruct(light, jnp.asarray(wi, jnp.float32)))
    wo = directions.view(harmonic.transfer.right_handed(matrix.frame), mesh.position, EYE)
    color = unshadowed_radiance(mesh, brdf, light, eye=EYE)
    for vertex in range(5):
        local = jnp.asarray(wi @ np.asarray(matrix.frame[vertex]).T, jnp.float32)
        value = brdf(local, jnp.broadcast_to(wo[vertex], local.shape))
        expected = (np.repeat(weight, 9) * 2 * np.pi / 9) @ (arriving * value)
        np.testing.assert_allclose(color[vertex], expected, atol=1e-4)


def test_light_at_probes_is_exact_and_equal_probes_are_constant(random, close):
    probe, value = normal(random, 4, 3), normal(random, 4, 9, 3)
    close(harmonic.probe_light(probe, probe, value), jnp.moveaxis(value, 0, -1))
    place = normal(random, 50, 3)
    same = jnp.broadcast_to(value[0], value.shape)
    close(harmonic.probe_light(place, probe, same), jnp.broadcast_to(value[0][..., None], (9, 3, 50)))
    close(harmonic.probe_light(place, probe[:1], value[:1]), jnp.broadcast_to(value[0][..., None], (9, 3, 50)))


def test_light_between_probes_is_a_mean_of_theirs(random):
    probe, value = normal(random, 4, 3), normal(random, 4, 4, 1)
    between = np.asarray(harmonic.probe_light(normal(random, 100, 3), probe, value))
    assert (between >= np.min(value, 0)[..., None] - 1e-5).all()
    assert (between <= np.max(value, 0)[..., None] + 1e-5).all()
    middle = harmonic.probe_light((probe[:1] + probe[1:2]) / 2, probe[:2], value[:2])
    np.testing.assert_allclose(middle[..., 0], (value[0] + value[1]) / 2, atol=1e-5)


def test_light_next_to_a_probe_is_its_own_and_far_away_the_mean(random, close):
    probe, value = normal(random, 4, 3), normal(random, 4, 4, 1)
    for distance in (1e-30, 1e-12, 1e-4):
        close(harmonic.probe_light(probe + distance, probe, value), jnp.moveaxis(value, 0, -1), tolerance=1e-3)
    far = harmonic.probe_light(jnp.full((1, 3), 1e12), probe, value)
    close(far[..., 0], jnp.mean(value, 0), tolerance=1e-3)


def test_gradients_at_probes_are_finite(random):
    probe, value = normal(random, 3, 3), normal(random, 3, 4, 1)
    twice = jnp.concatenate([probe, probe[:1]])
    for where in (probe, twice):
        gradient = jax.grad(lambda p, where=where: jnp.sum(harmonic.probe_light(p, where, value[: len(where)]) ** 2))
        if len(where) == 3:
            assert np.isfinite(np.asarray(gradient(probe))).all()
    doubled = jnp.concatenate([value, value[:1] + 2])
    middle = harmonic.probe_light(probe[:1], twice, doubled)
    np.testing.assert_allclose(middle[..., 0], value[0] + 1, rtol=1e-5)


def test_left_handed_frames_count_as_right_handed(random, close):
    matrix, brdf = made(random)
    left = matrix.frame * jnp.array([1.0, -1, 1])[:, None]
    light, seen = normal(random, 9, 3), jnp.asarray(random.integers(17, size=(5, 24)), jnp.uint8)
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    close(harmonic.system.view_coefficients(brdf, matrix.position, left, eye=EYE), view)
    close(harmonic.system.local_light(left, light), harmonic.system.local_light(matrix.frame, light))
    close(world_view(left, view), world_view(matrix.frame, view))
    close(*(harmonic.transfer.transfer(seen, each, degree=2) for each in (left, matrix.frame)))
    mirrored = TransferMatrix(matrix.matrix, matrix.position, left)
    close(relight(mirrored, brdf, light, eye=EYE), relight(matrix, brdf, light, eye=EYE))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("terms", [3, 10, 24])
def test_counts_of_coefficients_that_are_no_square_are_refused(random, terms):
    matrix, brdf = made(random)
    light, message = normal(random, terms, 3), f"must be a square number, got {terms}"
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    mesh = builtin.sphere(rings=3, sectors=3)
    vector = TransferVector(normal(random, 9, 1, 5), matrix.position)
    for refused in (
        lambda: relight(matrix, brdf, light, eye=EYE),
        lambda: unshadowed_radiance(mesh, brdf, light, eye=EYE),
        lambda: harmonic.system.transferred_light(matrix, light),
        lambda: harmonic.system.local_light(matrix.frame, light),
        lambda: harmonic.system.combine(light, view),
        lambda: diffuse(vector, jnp.ones(1), light),
    ):
        with pytest.raises(ValueError, match=message):
            refused()


@pytest.mark.usefixtures("unchecked")
def test_degrees_that_differ_are_refused(random):
    matrix, brdf = made(random)
    light = normal(random, 25, 3)
    mesh = builtin.sphere(rings=3, sectors=3)
    vector = TransferVector(normal(random, 9, 1, 5), matrix.position)
    _, high = made(random, terms=16)
    for refused in (
        lambda: relight(matrix, brdf, light, eye=EYE),
        lambda: unshadowed_radiance(mesh, brdf, light, eye=EYE),
        lambda: harmonic.system.transferred_light(matrix, light),
        lambda: diffuse(vector, jnp.ones(1), light),
    ):
        with pytest.raises(
            ValueError, match=r"the light must have the (same degree as .*, 2|transport's degree 2), got 4"
        ):
            refused()
    with pytest.raises(ValueError, match="the BRDF must have the transport's degree 2, got 3"):
        relight(matrix, high, normal(random, 9, 3), eye=EYE)


@pytest.mark.usefixtures("unchecked")
def test_numbers_of_colors_that_differ_are_refused(random):
    matrix, brdf = made(random)
    with pytest.raises(
        ValueError, match="must have the same number of colors, or one of them a single color, got 2 and 3"
    ):
        harmonic.system.combine(normal(random, 9, 2), normal(random, 9, 3, 5))
    with pytest.raises(
        ValueError, match="must have the same number of colors, or one of them a single color, got 2 and 3"
    ):
        relight(matrix, brdf, normal(random, 9, 2), eye=EYE)
    colored = made(random, transported=3)[0]
    with pytest.raises(
        ValueError, match="must have the same number of colors, or one of them a single color, got 2 and 3"
    ):
        harmonic.system.transferred_light(colored, normal(random, 9, 2))
    with pytest.raises(ValueError, match="Incompatible types for broadcasting"):
        transferred_view(colored, normal(random, 9, 2, 5))


@pytest.mark.usefixtures("unchecked")
def test_lights_of_other_vertices_are_refused(random):
    matrix, brdf = made(random)
    light = normal(random, 9, 3, 4)
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    for refused in (
        lambda: relight(matrix, brdf, light, eye=EYE),
        lambda: harmonic.system.transferred_light(matrix, light),
        lambda: harmonic.system.local_light(matrix.frame, light),
        lambda: harmonic.system.combine(light, view),
    ):
        with pytest.raises((ValueError, TypeError)):
            refused()
