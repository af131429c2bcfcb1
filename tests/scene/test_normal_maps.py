"""Normal maps: tilted normals, and the variance that mean normals tell, against samples of scipy's distribution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from jaxprt.scene import texture

UP = np.float32([[0, 0, 1]])
FRAME = np.eye(3, dtype=np.float32)[None]
ONE = np.ones(1, np.float32)


def tilted(mean, *, scale: float = 1.0, handedness: float = 1.0) -> np.ndarray:
    mean = np.float32([mean])
    return np.asarray(texture.tilt_normals(FRAME, handedness * ONE, mean, scale * ONE))[0]


def test_texels_become_unit_normals_and_zero_becomes_the_surface():
    normal = np.float32([[[0.3, -0.2, 0.8], [0, 0, 0], [0, 0, -0.4]]])
    unit = 2 * texture.unit_normals((normal + 1) / 2) - 1
    np.testing.assert_allclose(np.linalg.norm(unit, axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(unit[0, 0], normal[0, 0] / np.linalg.norm(normal[0, 0]), rtol=1e-5)
    np.testing.assert_allclose(unit[0, 1:], [[0, 0, 1], [0, 0, -1]], atol=1e-6)
    gray = np.full((2, 2, 1), 0.3, np.float32)
    assert texture.unit_normals(gray) is gray


def test_the_scale_and_the_handedness_change_slopes():
    np.testing.assert_allclose(tilted([0.6, 0.0, 0.8]), [0.6, 0, 0.8], rtol=1e-6)
    expected = np.float32([0.5 * 0.2, -0.5 * 0.4, 0.6])
    found = tilted([0.2, 0.4, 0.6], scale=0.5, handedness=-1.0)
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), rtol=1e-6)


@pytest.mark.parametrize("mean", [[0.5, 0, -0.7], [0.9, 0, 0], [0, 0, -1], [0, 0, 0], [1e-30, 0, -1e-30]])
def test_normals_below_the_surface_are_raised_above_it(mean):
    normal = tilted(mean)
    np.testing.assert_allclose(np.linalg.norm(normal), 1, rtol=1e-5)
    assert normal[2] > 0.09
    slope = jax.grad(lambda each: jnp.sum(texture.tilt_normals(FRAME, ONE, each, ONE)))(jnp.float32([mean]))
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("concentration", [8.0, 30.0, 400.0])
def test_the_length_of_a_mean_tells_the_variance_of_its_normals(concentration):
    samples = stats.vonmises_fisher(UP[0], concentration, seed=1).rvs(200_000)
    mean = samples.mean(0, keepdims=True).astype(np.float32)
    variance = float(texture.normal_variance(mean, ONE, 3 * ONE)[0])
    np.testing.assert_allclose(variance, 1 / concentration, rtol=0.05)
    # A rough surface of such normals is as rough as samples of both slopes together, for narrow distributions.
    if concentration > 100:
        random = np.random.default_rng(2)
        alpha = 0.2**2  # of Beckmann's distribution: slopes have the variance alpha^2 / 2 along each axis
        slope = samples[:, :2] / samples[:, 2:] + random.normal(0, alpha / 2**0.5, (len(samples), 2))
        rough = float(texture.widen_roughness(np.float32([0.2]), np.float32([variance]))[0])
        np.testing.assert_allclose(rough**4, 2 * np.var(slope), rtol=0.02)


def test_magnified_texels_and_equal_normals_add_no_roughness():
    mean = np.float32([[0.3, 0, 0.8], [0.6, 0, 0.8]])
    variance = np.asarray(texture.normal_variance(mean, np.ones(2, np.float32), np.float32([0.0, 5.0])))
    np.testing.assert_allclose(variance, 0, atol=1e-6)
    rough = np.float32([0.0, 0.5])
    none = np.zeros(2, np.float32)
    np.testing.assert_array_equal(texture.widen_roughness(rough, none), rough)
    slope = jax.grad(lambda each: jnp.sum(texture.widen_roughness(each, none)))(rough)
    np.testing.assert_array_equal(slope, 1)
