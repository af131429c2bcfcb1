"""Irradiance by hat functions against the sum over all texels, and against harmonics."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import harmonic, lobe
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap
from tests.systems.scenes import SIZE, pyramids_on_ground, seen_on_ground

pytestmark = pytest.mark.usefixtures("coarse")

STEP = 2e-3  # of vectors in bytes: 386 roundings by half a byte at random
SMOOTH, LAMPS = 0.01, 0.03  # of hat functions, under soft light and beside bright texels
COLORS = 3


@pytest.fixture(scope="module")
def visible():
    return seen_on_ground()


@pytest.fixture(scope="module")
def seen(visible):
    return visible.seen(np.arange(len(visible.position)))


def exact(seen, visible, radiance):
    """Irradiance / pi by the sum over all texels, in float64."""
    area = np.asarray(cubemap.vector_area(size=SIZE), np.float64).reshape(-1, 3)
    flux = np.maximum(np.asarray(visible.frame, np.float64)[:, 2] @ area.T, 0) * seen / 16 / np.pi
    return (flux @ np.asarray(radiance, np.float64).reshape(-1, COLORS)).T


def error(value, expected):
    return np.linalg.norm(value - expected) / np.linalg.norm(expected)


def lit(seen, visible, radiance):
    vector = lobe.diffuse.vectors(jnp.asarray(seen), visible.frame)
    return np.asarray(lobe.diffuse.irradiance(lobe.diffuse.coefficients(radiance), vector))


def test_under_white_light_irradiance_is_the_visible_cosine_to_the_precision_of_bytes(seen, visible):
    white = jnp.ones((6, SIZE, SIZE, COLORS))
    np.testing.assert_allclose(lit(seen, visible, white), exact(seen, visible, white), atol=STEP)


def test_a_surface_that_sees_all_uses_the_whole_byte():
    frame = jnp.eye(3)[None]
    vector = np.asarray(lobe.diffuse.vectors(jnp.full((1, 6 * SIZE**2), 16, jnp.uint8), frame))
    assert vector.max() == 255
    assert vector.dtype == np.uint8
    assert vector.shape == (lobe.diffuse.count(SIZE), 1) == (386, 1)


@pytest.mark.parametrize(("lamps", "most"), [(0, SMOOTH), (8, LAMPS)])
def test_irradiance_is_the_sum_over_all_texels_better_than_by_harmonics(seen, visible, lamps, most):
    direction = np.asarray(cubemap.direction(size=SIZE), np.float64)
    radiance = 1 + 0.6 * np.sin(3 * direction) * np.cos(2 * direction[..., ::-1])
    radiance.reshape(-1, 3)[np.random.default_rng(0).permutation(6 * SIZE**2)[:lamps]] += 30
    light = jnp.asarray(radiance, jnp.float32)
    expected = exact(seen, visible, radiance)
    vectors = harmonic.transfer.transfer_diffuse(jnp.asarray(seen), visible.frame, degree=6)
    other = np.asarray(harmonic.project(Environment(light), degree=6)).T @ np.asarray(vectors)
    assert error(lit(seen, visible, light), expected) < min(most, error(other, expected) / 2)


def test_vectors_in_harmonics_are_those_of_the_harmonic_system(seen, visible):
    vector = lobe.diffuse.vectors(jnp.asarray(seen), visible.frame)
    expected = harmonic.transfer.transfer_diffuse(jnp.asarray(seen), visible.frame, degree=4)
    found = lobe.diffuse.harmonics_of(vector, size=SIZE, degree=4)
    assert error(np.asarray(found), np.asarray(expected)) < SMOOTH


def test_a_matte_system_has_the_irradiance_times_the_albedo(seen, visible, close):
    light = Environment(jnp.asarray(np.random.default_rng(1).uniform(size=(6, SIZE, SIZE, COLORS)), jnp.float32))
    transport = lobe.matte_transport(pyramids_on_ground())
    system = lobe.MatteSystem(transport, jnp.array([0.2, 0.5, 0.9]))
    expected = lit(seen, visible, light.radiance).T * np.array([0.2, 0.5, 0.9])
    arriving, view = system.light(light), system.view(jnp.array([0.0, 5.0, 0.0]))
    close(system.combine(system.shade(arriving), view), expected)


def test_the_vector_irradiance_is_that_of_tilted_normals(seen, visible):
    random = np.random.default_rng(4)
    sky = np.maximum(np.asarray(cubemap.direction(size=SIZE)) @ np.float32([0.5, 0.6, -0.3]), 0)[..., None]
    radiance = jnp.asarray(0.2 + sky * [1.0, 0.8, 0.6], jnp.float32)
    vector, normal = lobe.diffuse.vectors(jnp.asarray(seen), visible.frame), np.asarray(visible.frame)[:, 2]
    coefficient = lobe.diffuse.coefficients(radiance)
    flux = np.asarray(lobe.diffuse.flux(coefficient, vector, jnp.asarray(normal), size=SIZE))
    np.testing.assert_allclose(
        np.einsum("cav,va->cv", flux, normal), lobe.diffuse.irradiance(coefficient, vector), atol=1e-5
    )
    # By the sum over all texels above the horizon of the vertices, with normals 20 degrees away.
    way = np.asarray(cubemap.direction(size=SIZE), np.float64).reshape(-1, 3)
    axis = np.cross(normal, random.normal(size=normal.shape))
    tilted = normal + np.tan(np.radians(20)) * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    tilted = np.asarray(tilted / np.linalg.norm(tilted, axis=1, keepdims=True), np.float64)
    area = np.asarray(cubemap.solid_angle(size=SIZE), np.float64).ravel()
    share = np.where(normal @ way.T > 0, seen, 0) / 16 * area / np.pi
    expected = ((np.maximum(tilted @ way.T, 0) * share) @ np.asarray(radiance, np.float64).reshape(-1, COLORS)).T
    found = np.einsum("cav,va->cv", flux, tilted)
    flat = lobe.diffuse.irradiance(coefficient, vector)
    assert error(found, expected) < 0.04 < 0.12 < error(flat, expected)
