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


@pytest.mark.parametrize(("transported", "colors", "lights"), [(1, 3, (1, 5)), (3, 3, (3,))])
def test_all_ways_with_transfer_give_the_same_radiance(random, close, transported, colors, lights):
    matrix, brdf = made(random, transported=transported, colors=colors)
    light = normal(random, 9, *lights)
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    several = light if light.ndim == 3 else np.asarray(light)[..., None]
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


def test_all_ways_without_transfer_give_the_same_radiance(random, close):
    mesh = builtin.sphere(rings=6, sectors=10)
    vertices = len(mesh.position)
    brdf, light = made(random)[1], normal(random, 9, 1, vertices)
    frame = directions.frame(mesh.normal, mesh.tangent)
    view = harmonic.system.view_coefficients(brdf, mesh.position, frame, eye=EYE)
    expected = unshadowed_radiance(mesh, brdf, light, eye=EYE)
    assert expected.shape == (vertices, 3)
    close(harmonic.system.combine(harmonic.system.local_light(frame, light), view), expected)
    close(harmonic.system.combine(light, world_view(frame, view)), expected)
    # An open vertex's transfer is the rotation.
    seen = np.full((vertices, 6), 16, np.uint8)
    matrix = jnp.asarray(np.asarray(harmonic.transfer.transfer(seen, frame, degree=2))[:, None])
    close(relight(TransferMatrix(matrix, mesh.position, frame), brdf, light, eye=EYE), expected, tolerance=2e-5)


def test_unshadowed_radiance_is_the_integral_of_light_times_table(random):
    """By a product rule that is exact for both: nothing of ours but evaluation and lookup is between."""
    matrix, brdf = made(random)
    light = normal(random, 9, 3)
    axes = np.asarray(matrix.frame)
    mesh = make_mesh(matrix.position, np.array([[0, 1, 2]]), normal=axes[:, 2], tangent=axes[:, 0])
    node, weight = np.polynomial.legendre.leggauss(6)
    angle = 2 * np.pi * np.arange(9) / 9
    radius = np.sqrt(1 - node**2)[:, None]
    wi = np.stack([radius * np.cos(angle), radius * np.sin(angle), node[:, None] + 0 * angle], -1).reshape(-1, 3)
    arriving = np.asarray(harmonics.reconstruct(light, jnp.asarray(wi, jnp.float32)))
    wo = np.asarray(directions.view(harmonic.transfer.right_handed(matrix.frame), mesh.position, EYE))
    color, value = np.asarray(unshadowed_radiance(mesh, brdf, light, eye=EYE)), jax.jit(lambda wi, wo: brdf(wi, wo))
    for vertex in range(5):
        local = (wi @ axes[vertex].T).astype(np.float32)
        sent = arriving * np.asarray(value(local, np.broadcast_to(wo[vertex], local.shape)))
        expected = (np.repeat(weight, 9) * 2 * np.pi / 9) @ sent
        np.testing.assert_allclose(color[vertex], expected, atol=1e-4)


def test_light_is_that_of_a_probe_next_to_it_a_mean_between_probes_and_their_mean_far_away(random, close):
    probe, value = (random.normal(size=shape).astype(np.float32) for shape in ((4, 3), (4, 9, 3)))

    def at(position, probe=probe, value=value):
        return np.asarray(harmonic.probe_light(*map(jnp.asarray, (position, probe, value))))

    each = np.moveaxis(value, 0, -1)
    close(at(probe), each)
    for distance in (1e-30, 1e-12, 1e-4):
        close(at(probe + np.float32(distance)), each, tolerance=1e-3)
    position = random.normal(size=(4, 3)).astype(np.float32)
    assert (at(position) >= value.min(0)[..., None] - 1e-5).all()
    assert (at(position) <= value.max(0)[..., None] + 1e-5).all()
    close(at(np.full((4, 3), 1e12, np.float32))[..., 0], value.mean(0), tolerance=1e-3)
    # Shepard's weights, which fall with the fourth power of distance.
    weight = np.sum((position[:, None] - probe) ** 2, -1, dtype=float) ** -2
    expected = np.einsum("vp,plc->lcv", weight / weight.sum(1, keepdims=True), value)
    close(at(position), expected)
    # Two probes in one place share their weight; gradients are finite at probes.
    twice = probe[[0, 1, 2, 0]]
    close(at(twice, twice)[..., 0], (value[0] + value[3]) / 2)
    probes = jnp.asarray(twice), jnp.asarray(value)
    slope = jax.jit(jax.grad(lambda p: jnp.sum(harmonic.probe_light(p, *probes) ** 2)))(probes[0])
    assert np.isfinite(slope).all()


def test_left_handed_frames_count_as_right_handed(random, close):
    matrix, brdf = made(random)
    left = jnp.asarray(np.asarray(matrix.frame) * np.float32([1, -1, 1])[:, None])
    light, seen = normal(random, 9, 3), random.integers(17, size=(5, 24)).astype(np.uint8)
    view = harmonic.system.view_coefficients(brdf, matrix.position, matrix.frame, eye=EYE)
    close(harmonic.system.view_coefficients(brdf, matrix.position, left, eye=EYE), view)
    close(harmonic.system.local_light(left, light), harmonic.system.local_light(matrix.frame, light))
    close(world_view(left, view), world_view(matrix.frame, view))
    close(*(harmonic.transfer.transfer(seen, each, degree=2) for each in (left, matrix.frame)))
    mirrored = TransferMatrix(matrix.matrix, matrix.position, left)
    close(relight(mirrored, brdf, light, eye=EYE), relight(matrix, brdf, light, eye=EYE))


SAME = "must have the same number of colors, or one of them a single color, got 2 and 3"
DEGREES = r"the light must have the (same degree as .*, 2|transport's degree 2), got 4"


@pytest.mark.usefixtures("unchecked")
def test_coefficients_degrees_colors_and_vertices_that_do_not_fit_are_refused(random):
    matrix, brdf = made(random)
    view = normal(random, 9, 3, 5)
    vector = TransferVector(normal(random, 9, 1, 5), matrix.position)
    mesh = builtin.sphere(rings=3, sectors=3)
    verbs = {
        "relight": lambda light: relight(matrix, brdf, light, eye=EYE),
        "unshadowed": lambda light: unshadowed_radiance(mesh, brdf, light, eye=EYE),
        "transferred": lambda light: harmonic.system.transferred_light(matrix, light),
        "local": lambda light: harmonic.system.local_light(matrix.frame, light),
        "combine": lambda light: harmonic.system.combine(light, view),
        "diffuse": lambda light: diffuse(vector, jnp.ones(1), light),
    }
    others = ("relight", "transferred", "local", "combine")
    for shape, names, message in (
        ((10, 3), verbs, "must be a square number, got 10"),
        ((25, 3), ("relight", "unshadowed", "transferred", "diffuse"), DEGREES),
        ((9, 2), ("relight", "combine"), SAME),
        ((9, 3, 4), others, None),
    ):
        for name in names:
            with pytest.raises((ValueError, TypeError) if len(shape) == 3 else ValueError, match=message):
                verbs[name](normal(random, *shape))
    with pytest.raises(ValueError, match="the BRDF must have the transport's degree 2, got 3"):
        relight(matrix, made(random, terms=16)[1], normal(random, 9, 3), eye=EYE)
    colored = made(random, transported=3)[0]
    with pytest.raises(ValueError, match=SAME):
        harmonic.system.transferred_light(colored, normal(random, 9, 2))
    with pytest.raises(ValueError, match="Incompatible types for broadcasting"):
        transferred_view(colored, normal(random, 9, 2, 5))
