"""Transfer tensors: what is decomposed is what arrives, linear in the light and in the weights of all functions."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, Lambert, paths, separable
from jaxprt.scene import builtin
from jaxprt.scene.mesh import ground_plane, join
from jaxprt.sphere import cubemap, harmonics
from jaxprt.transport import harmonic, interreflection, transfer

EDGE, SIZE = 4, 16


@pytest.fixture(scope="module")
def mesh():
    ball = builtin.sphere(rings=8, sectors=10)
    return join([ball, ground_plane(ball, vertices=64)])


@pytest.fixture(scope="module")
def bases():
    glossy = separable.factor(AshikhminShirley(diffuse=0.3, specular=0.5, nu=6, nv=6), terms=4, resolution=12)
    return [paths.basis(glossy), paths.basis(separable.factor(Lambert(1.0), terms=1, resolution=8))]


@pytest.fixture(scope="module")
def whole(mesh, bases):
    """Nothing left out but by half precision."""
    return transfer.precompute(mesh, bases, components=10**6, modes=10**6, edge=EDGE, size=SIZE, progress=False)


def relative(value, exact):
    return float(np.linalg.norm(value - exact) / np.linalg.norm(exact))


def test_what_arrives_under_constant_light_is_the_harmonic_systems_bounce(mesh):
    """Irradiance of the harmonics that arrive: all but what lies beyond degree three."""
    white = paths.basis(separable.factor(Lambert(1.0), terms=1, resolution=8))
    albedo = np.array([[0.9, 0.5, 0.2], [0.3, 0.6, 0.8]], np.float32)
    tensor = transfer.precompute(mesh, [white, white], components=10**6, modes=10**6, edge=EDGE, progress=False)
    assert tensor.error.max() < 1e-3
    light = jnp.ones((6 * EDGE**2, 3))
    arriving = tensor.arriving(light, jnp.asarray(albedo))
    cosine = np.pi * np.array([1, 2 / 3, 1 / 4, 0])[[0, *[1] * 3, *[2] * 5, *[3] * 7]]
    at = np.asarray(harmonics.evaluate(mesh.normal, degree=3)) * cosine / np.pi
    found = np.einsum("vs,vsc->vc", at, arriving)
    plain = harmonic.precompute_diffuse(mesh, degree=0, size=SIZE, progress=False)
    once = interreflection.interreflect_diffuse(mesh, plain, albedo, bounces=1, size=SIZE, progress=False)
    exact = np.asarray(once.vector - plain.vector)[0].T * np.sqrt(4 * np.pi)
    assert relative(found, exact) < 0.014


def test_linear_in_the_light_and_in_the_weights(whole):
    random = np.random.default_rng(0)
    light = jnp.asarray(random.uniform(size=(2, 6 * EDGE**2, 3)), jnp.float32)
    weight = jnp.asarray(random.uniform(size=(2, 2, 3)), jnp.float32)
    both = whole.arriving(light[0] + 2 * light[1], weight[0])
    np.testing.assert_allclose(
        both, whole.arriving(light[0], weight[0]) + 2 * whole.arriving(light[1], weight[0]), atol=1e-6
    )
    both = whole.arriving(light[0], weight[0] - weight[1])
    np.testing.assert_allclose(
        both, whole.arriving(light[0], weight[0]) - whole.arriving(light[0], weight[1]), atol=1e-6
    )


def test_fewer_components_and_modes_err_as_they_say(mesh, bases, whole):
    cut = transfer.precompute(mesh, bases, components=20, modes=24, edge=EDGE, size=SIZE, progress=False)
    assert cut.nbytes < whole.nbytes / 10
    wrong = total = 0.0
    for texel in range(6 * EDGE**2):
        light = jnp.zeros((6 * EDGE**2, 1)).at[texel].set(1.0)
        for function in range(2):
            weight = jnp.zeros((2, 1)).at[function].set(1.0)
            exact, found = (np.asarray(each.arriving(light, weight)) for each in (whole, cut))
            wrong, total = wrong + np.sum((found - exact) ** 2), total + np.sum(exact**2)
    assert float(cut.error[0]) > 0.01
    np.testing.assert_allclose(np.sqrt(wrong / total), float(cut.error[0]), rtol=1e-3)


def test_a_coarse_light_has_the_flux_of_the_light():
    light = jnp.asarray(np.random.default_rng(1).uniform(size=(6, 16, 16, 3)), jnp.float32)
    small = transfer.coarse(light, edge=4)
    fine, rough = (np.asarray(cubemap.solid_angle(size=n)).reshape(-1, 1) for n in (16, 4))
    np.testing.assert_allclose(np.sum(small * rough, 0), np.sum(light.reshape(-1, 3) * fine, 0), rtol=1e-5)
    with pytest.raises(ValueError, match="must divide the light's 16, got 5"):
        transfer.coarse(light, edge=5)


def test_a_stopped_precomputation_goes_on(mesh, bases, tmp_path):
    options = {"components": 8, "modes": 8, "edge": 2, "size": 8, "progress": False, "path": tmp_path / "bounce"}
    first, again = (transfer.precompute(mesh, bases, **options) for _ in range(2))
    np.testing.assert_array_equal(first.core, again.core)
    with pytest.raises(ValueError, match="something else"):
        transfer.precompute(mesh, bases[::-1], **options)


def test_regions_without_functions_are_refused(mesh, bases):
    with pytest.raises(ValueError, match=r"one for each of the regions \[0, 1\], got 1"):
        transfer.precompute(mesh, bases[:1], progress=False)
    with pytest.raises(ValueError, match="a power of two, got 0, 64, 8 and 16"):
        transfer.precompute(mesh, bases, components=0, progress=False)
    with pytest.raises(ValueError, match="a power of two, got 32, 64, 6 and 16"):
        transfer.precompute(mesh, bases, edge=6, progress=False)
