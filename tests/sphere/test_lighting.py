"""Irradiance against sums over texels and published numbers; directional lights against least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.scene import Environment, irradiance, load_environment
from jaxprt.sphere import cubemap, harmonics, low_frequency

RNG = np.random.default_rng(4)
# Grace Cathedral's coefficients as Ramamoorthi and Hanrahan published them with their 2001 paper:
# L00, L1-1, L10, L11, L2-2, L2-1, L20, L21, L22.
GRACE = np.array(
    [
        [0.78908, 0.43710, 0.54161],
        [0.39499, 0.34989, 0.60488],
        [-0.33974, -0.18236, -0.26940],
        [-0.29213, -0.05562, 0.00944],
        [-0.11141, -0.05090, -0.12231],
        [-0.26240, -0.22401, -0.47479],
        [-0.15570, -0.09471, -0.14733],
        [0.56014, 0.21444, 0.13915],
        [0.21205, -0.05432, -0.30374],
    ]
)
PUBLISHED = 0.03  # They projected another resolution of the map.


def unit(count):
    direction = RNG.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def summed(light, normal):
    """Irradiance by the sum over texels: another discretization, which knows no harmonics."""
    radiance = np.asarray(light.radiance, np.float64).repeat(4, 1).repeat(4, 2)  # texels are constant
    size = radiance.shape[1]
    way = np.asarray(cubemap.direction(size=size), np.float64).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=size), np.float64).reshape(-1, 1)
    return np.maximum(normal @ way.T, 0) @ (area * radiance.reshape(-1, 3))


def published(sh, normal):
    """Equation 13 of the paper, with its constants."""
    x, y, z = normal.T[..., None]
    c1, c2, c3, c4, c5 = 0.429043, 0.511664, 0.743125, 0.886227, 0.247708
    return (
        c1 * sh[8] * (x**2 - y**2)
        + c3 * sh[6] * z**2
        + c4 * sh[0]
        - c5 * sh[6]
        + 2 * c1 * (sh[4] * x * y + sh[7] * x * z + sh[5] * y * z)
        + 2 * c2 * (sh[3] * x + sh[1] * y + sh[2] * z)
    )


def test_nine_coefficients_give_the_published_quadratic_form(close):
    normal = unit(30)
    found = low_frequency.irradiance(jnp.asarray(GRACE, jnp.float32), jnp.asarray(normal, jnp.float32))
    close(found, published(GRACE, normal), tolerance=5e-6)  # Its constants have six digits.


def test_irradiance_of_an_environment_approaches_the_sum_over_texels():
    light = Environment(jnp.asarray(RNG.lognormal(sigma=2, size=(6, 16, 16, 3)), jnp.float32))
    normal = unit(40)
    exact = summed(light, normal)
    error = [
        np.linalg.norm(np.asarray(irradiance(light, normal, degree=degree)) - exact) / np.linalg.norm(exact)
        for degree in (0, 1, 2, 4, 16)
    ]
    assert np.all(np.diff(error) < 0)
    assert error[2] < 0.02
    assert error[-1] < 1.5e-3  # White noise has much in its high bands.
    white = irradiance(Environment(jnp.ones((6, 4, 4, 1))), [0.0, 1.0, 0.0])
    np.testing.assert_allclose(white, [np.pi], rtol=1e-5)


def test_grace_cathedral_has_the_published_coefficients(data):
    light = load_environment(data / "env" / "grace_cross.hdr")
    found = np.asarray(harmonics.project(light.radiance, degree=2))
    mirrored = GRACE * np.array([1, 1, -1, 1, 1, -1, 1, -1, 1])[:, None]  # Their z is our -z; the file's unit differs.
    scale = np.vdot(found, mirrored) / np.vdot(mirrored, mirrored)
    assert np.linalg.norm(found / scale - mirrored) < PUBLISHED * np.linalg.norm(mirrored)
    normal = unit(50)
    exact = summed(light, normal)
    error = np.linalg.norm(np.asarray(irradiance(light, normal, degree=2)) - exact) / np.linalg.norm(exact)
    assert error < 0.05  # The paper: under 1 % in the mean of its maps, at most 5 % anywhere.


@pytest.mark.usefixtures("unchecked")
def test_lights_that_are_no_lights_are_refused():
    light = Environment(jnp.ones((6, 4, 4, 3)))
    with pytest.raises(TypeError, match="light must be of class Environment"):
        irradiance(np.ones((6, 4, 4, 3)), [0.0, 0, 1])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match=r"normals must be \[\.\., 3\], got \[4\]"):
        irradiance(light, np.ones(4))
    with pytest.raises(ValueError, match="normals must be finite"):
        irradiance(light, [np.nan, 0, 0])
    with pytest.raises(ValueError, match=r"got \[2, 6, 4, 4, 3\]"):
        irradiance(Environment(jnp.ones((2, 6, 4, 4, 3))), [0.0, 0, 1])


@pytest.mark.parametrize("degree", [1, 4])
def test_a_directional_light_is_found_again_and_of_others_the_least_squares(degree, x64, close):
    way, color = unit(1)[0], np.array([3.0, 2.0, 0.5])
    sharp = np.asarray(harmonics.evaluate(jnp.asarray(way), degree=degree))[:, None] * color
    direction, found = low_frequency.directional_light(jnp.asarray(sharp))
    close(direction, way)
    close(found, color)
    sharp[0] += np.sqrt(4 * np.pi) * 0.7  # and with constant light of 0.7
    direction, found, ambient = low_frequency.directional_and_ambient(jnp.asarray(sharp))
    close(direction, way)
    close(found, color)
    close(ambient, np.full(3, 0.7))
    light = sharp + RNG.normal(size=sharp.shape)
    direction, found = low_frequency.directional_light(jnp.asarray(light))
    basis = np.asarray(harmonics.evaluate(direction, degree=degree))
    close(found, np.linalg.lstsq(basis[:, None], light, rcond=None)[0][0])
    direction, found, ambient = low_frequency.directional_and_ambient(jnp.asarray(light))
    constant = np.sqrt(4 * np.pi) * (np.arange(len(light)) == 0)
    close(np.stack([found, ambient]), np.linalg.lstsq(np.stack([basis, constant], 1), light, rcond=None)[0])


def test_sloans_normalization_of_nine_coefficients(x64, close):
    """A white surface that faces the light has radiance 1 where the light's coefficients are 16 pi / 17 y_i(d)."""
    way = jnp.asarray(unit(1)[0])
    light = harmonics.evaluate(way, degree=2)[:, None] * (16 * np.pi / 17)
    close(low_frequency.irradiance(light, way) / np.pi, np.ones(1))
    close(low_frequency.directional_light(light)[1], np.full(1, 16 * np.pi / 17))


def test_the_direction_is_where_the_sun_is(close):
    way = unit(1)[0]
    sun = harmonics.disc(jnp.asarray(way, jnp.float32), jnp.asarray(0.3, jnp.float32), degree=4)
    close(low_frequency.dominant_direction(sun[:, None] * jnp.array([0.1, 1.0, 2.0])), way, tolerance=1e-5)
    blue, red = np.zeros((4, 3)), np.zeros((4, 3))
    red[3, 0], blue[1, 2] = 1.0, 1.0
    seen = np.asarray(low_frequency.dominant_direction(jnp.asarray(red + blue, jnp.float32)))
    np.testing.assert_allclose(seen, np.array([0.2126, 0.0722, 0]) / np.hypot(0.2126, 0.0722), rtol=1e-5)
    tiny = low_frequency.dominant_direction(jnp.asarray((red + blue) * 1e-30, jnp.float32))  # squares underflow
    np.testing.assert_allclose(tiny, seen, rtol=1e-5)


def test_light_without_direction_has_none_and_finite_gradients():
    for light, mean in ((np.zeros((9, 3)), 0.0), (np.eye(9)[:, :1] * np.sqrt(4 * np.pi) * np.ones(3), 1.0)):
        coefficient = jnp.asarray(light, jnp.float32)
        direction, color, ambient = low_frequency.directional_and_ambient(coefficient)
        assert not np.any(direction)
        assert not np.any(color)
        assert not np.any(low_frequency.directional_light(coefficient)[1])
        np.testing.assert_allclose(ambient, np.full(3, mean), rtol=1e-6)
        slope = jax.jacobian(low_frequency.directional_and_ambient)(coefficient)
        assert all(np.isfinite(each).all() for each in slope)
        assert not np.any(slope[0])
    with pytest.raises(ValueError, match="degree 1 or more to have a direction, got degree 0"):
        low_frequency.dominant_direction(jnp.ones((1, 3)))
