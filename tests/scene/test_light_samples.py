import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from jaxprt.scene import Environment, light_samples
from jaxprt.sphere import cubemap


def unoccluded(samples, normal) -> np.ndarray:
    """Radiance of a white diffuse surface that sees all of its hemisphere."""
    cosine = np.maximum(normal @ samples.direction.T.astype(np.float64), 0)
    return np.einsum("vd,dlc->vlc", cosine, samples.weight.astype(np.float64))


def normals(count=12) -> np.ndarray:
    normal = np.random.default_rng(1).normal(size=(count, 3))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def exact(light, normal, parts=24) -> np.ndarray:
    """The same by many points in every texel, with the closed form of the solid angle's density."""
    radiance = np.asarray(light.radiance, np.float64)
    edge = parts * radiance.shape[1]
    center = (2 * np.arange(edge) + 1) / edge - 1
    t, s = np.meshgrid(center, center, indexing="ij")
    place = np.stack([s, t, np.ones_like(s)], -1)
    length = np.linalg.norm(place, axis=-1)
    solid = (2 / edge) ** 2 / length**3
    each = np.repeat(np.repeat(radiance, parts, 1), parts, 2)
    total = 0
    for face, axes in enumerate(cubemap.axes()):
        direction = (place / length[..., None]) @ axes
        cosine = np.maximum(np.einsum("ijx,vx->vij", direction, normal), 0)
        total = total + np.einsum("vij,ij,ijc->vc", cosine, solid, each[face], optimize=True)
    return total / np.pi


@pytest.fixture(scope="module")
def light() -> Environment:
    """Dim light in three colors with a sun of one texel that holds half of the power."""
    radiance = np.random.default_rng(0).random((6, 4, 4, 3)) + 0.1
    radiance[2, 1, 2] = 60 * np.array([1, 0.8, 0.5])
    return Environment(jnp.asarray(radiance, jnp.float32))


def test_samples_light_a_diffuse_surface_as_all_texels_do(light, close):
    normal = normals()
    expected = exact(light, normal)
    for count, tolerance in ((1 << 10, 1e-2), (1 << 14, 1e-3)):  # Horizons cut between directions.
        samples = light_samples.importance([light], count=count)
        close(unoccluded(samples, normal)[:, 0], expected, tolerance=tolerance)


def test_half_of_the_directions_go_to_a_sun_that_has_half_of_the_power(light):
    samples = light_samples.importance([light], count=1000)
    power = np.asarray(light.radiance).mean(-1) * np.asarray(cubemap.solid_angle(size=4))
    share = power[2, 1, 2] / power.sum()
    assert 0.4 < share < 0.8
    x, y, z = samples.direction.T
    with np.errstate(divide="ignore"):
        inside = (y > 0) & (x / y > 0) & (x / y < 0.5) & (z / y > -0.5) & (z / y < 0)
    assert abs(inside.mean() - share) < 2e-3
    # Spread over the texel's area.
    s = (x / y)[inside]
    assert np.histogram(s, 5, (0, 0.5))[0].min() > 0.17 * inside.sum()
    np.testing.assert_allclose(np.linalg.norm(samples.direction, axis=1), 1, rtol=1e-6)


def test_each_light_has_its_own_directions(light, close):
    gray = Environment(jnp.ones((6, 3, 3, 1)))
    samples = light_samples.importance([light, gray], count=512)
    assert samples.weight.shape == (1024, 2, 3)
    made = unoccluded(samples, normals())
    close(made[:, 0], unoccluded(light_samples.importance([light], count=512), normals())[:, 0], tolerance=1e-6)
    # A white furnace; the gray light has no other colors.
    close(made[:, 1, 0], np.ones(12), tolerance=1e-2)
    assert not made[:, 1, 1:].any()


def test_a_black_light_weighs_nothing():
    samples = light_samples.importance([Environment(jnp.zeros((6, 2, 2, 3)))], count=8)
    assert not samples.weight.any()
    np.testing.assert_allclose(np.linalg.norm(samples.direction, axis=1), 1)


def test_natural_light_has_the_mean_square_of_its_spectrum():
    samples = light_samples.natural(size=16, degree=6)
    square = np.sum(unoccluded(samples, normals())[:, 0] ** 2, -1)
    # By the theorem of Funk and Hecke: the cosine lobe's bands, over pi for a white surface, times the light's.
    expected = 0.0
    for band in range(7):
        legendre = np.polynomial.legendre.Legendre.basis(band)
        lobe = 2 * scipy.integrate.quad(lambda c, legendre=legendre: c * legendre(c), 0, 1)[0]
        expected += (2 * band + 1) / (4 * np.pi) * (lobe / (band + 0.5)) ** 2
    np.testing.assert_allclose(square, expected, rtol=5e-3)


def test_lights_that_cannot_be_sampled_are_refused(light, unchecked):
    with pytest.raises(TypeError, match="environments must be a list of lights, got one Environment"):
        light_samples.importance(light, count=4)
    with pytest.raises(TypeError, match="environment 1 must be of class Environment"):
        light_samples.importance([light, light.radiance], count=4)
    with pytest.raises(ValueError, match="environments must be at least one, got none"):
        light_samples.importance([], count=4)
    with pytest.raises(ValueError, match=r"the radiance of environment 0 must be an array \[6, n, n, c\]"):
        light_samples.importance([Environment(light.radiance[None])], count=4)
    with pytest.raises(ValueError, match="count must be at least 1, got 0"):
        light_samples.importance([light], count=0)
