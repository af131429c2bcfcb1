import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published import maps
from jaxprt.sphere import hemisphere

MAPS = {
    "disk": (hemisphere.disk_coordinates, maps.disk_direction),
    "polar": (hemisphere.polar_coordinates, maps.polar_direction),
    "parabolic": (hemisphere.parabolic_coordinates, hemisphere.parabolic_direction),
}


def _upper(count=500):
    direction = np.random.default_rng(1).standard_normal((count, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 1e-3
    return jnp.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True), jnp.float32)


@pytest.mark.parametrize("name", MAPS)
def test_direction_undoes_coordinates(name):
    coordinates, direction = MAPS[name]
    # Near the horizon z = sqrt(1 - x^2 - y^2) loses half the digits of float32.
    np.testing.assert_allclose(direction(coordinates(_upper())), _upper(), atol=2e-4)


@pytest.mark.parametrize("name", MAPS)
def test_normal_and_tangent_have_their_places(name):
    coordinates, _ = MAPS[name]
    place = {"disk": ([0.5, 0.5], [1, 0.5]), "polar": ([0, 0], [0.25, 1]), "parabolic": ([0.5, 0.5], [1, 0.5])}
    for direction, expected in zip(([0.0, 0, 1], [1.0, 0, 0]), place[name], strict=True):
        np.testing.assert_allclose(coordinates(jnp.array(direction)), expected, atol=1e-6)


@pytest.mark.parametrize("name", MAPS)
def test_gradients_are_finite_at_normal_and_horizon(name):
    coordinates, direction = MAPS[name]
    for local in ([0.0, 0, 1], [1.0, 0, 0], [0, -1.0, 0], [0.6, 0.8, 0]):
        place = coordinates(jnp.array(local))
        assert jnp.all(jnp.isfinite(jax.jacobian(coordinates)(jnp.array(local))))
        assert jnp.all(jnp.isfinite(jax.jacobian(direction)(place)))


def test_disk_points_outside_give_unit_horizontal_directions():
    direction = maps.disk_direction(jnp.array([[1.0, 1.0], [0.0, 0.5], [1.5, 0.5]]))
    np.testing.assert_allclose(jnp.linalg.norm(direction, axis=-1), 1, rtol=1e-6)
    np.testing.assert_allclose(direction[:, 2], 0, atol=1e-3)


def test_lookup_reproduces_bilinear_functions_between_texel_centers():
    n = 16
    center = (np.arange(n) + 0.5) / n
    x, y = np.meshgrid(center, center)
    place = np.random.default_rng(2).uniform(0.5 / n, 1 - 0.5 / n, (100, 2))
    expected = 1 + 2 * place[:, 0] - 3 * place[:, 1] + 4 * place[:, 0] * place[:, 1]
    found = hemisphere.lookup(jnp.asarray(1 + 2 * x - 3 * y + 4 * x * y), jnp.asarray(place, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_lookup_is_constant_beyond_the_outermost_centers():
    texel = jnp.arange(9.0).reshape(3, 3)
    outside = jnp.array([[-1.0, -1], [0, 0], [1, 1], [2, 0.5], [0.5, 7]])
    np.testing.assert_allclose(hemisphere.lookup(texel, outside), [0, 0, 8, 5, 7])


def test_lookup_in_a_single_texel_returns_it():
    np.testing.assert_allclose(hemisphere.lookup(jnp.full((1, 1, 2), 3.0), jnp.array([0.2, 0.9])), [3, 3])


def test_lookup_at_the_rim_of_a_disk_map_reads_the_rim():
    n = 48
    direction = maps.texel_direction(resolution=n)
    angle = jnp.linspace(0, 2 * jnp.pi, 200)
    for tilt in (0.9, 0.97, 1.0):
        sine = jnp.sin(tilt * jnp.pi / 2)
        rim = jnp.stack([sine * jnp.cos(angle), sine * jnp.sin(angle), jnp.full(200, jnp.cos(tilt * jnp.pi / 2))], -1)
        found = hemisphere.lookup(direction[..., :2], hemisphere.disk_coordinates(rim))
        # Half a texel is the most that the constant continuation can be off.
        assert float(jnp.max(jnp.abs(found - rim[:, :2]))) < 1 / n


def test_texel_area_integrates_the_cosine():
    weight = maps.texel_area(resolution=48)
    assert jnp.sum(weight) == pytest.approx(np.pi, rel=5e-3)
    assert int(jnp.sum(weight > 0)) == 1804
    z = maps.texel_direction(resolution=48)[..., 2]
    # The integral of cos^2 over the hemisphere.
    assert jnp.sum(weight * z) == pytest.approx(2 * np.pi / 3, rel=5e-3)


def test_polar_texels_are_the_directions_that_their_centers_stand_for():
    n = 9
    direction = maps.polar_texel_direction(resolution=n)
    np.testing.assert_allclose(jnp.linalg.norm(direction, axis=-1), 1, rtol=1e-6)
    center = (np.arange(n) + 0.5) / n
    expected = np.stack(np.meshgrid(center, center), -1)
    np.testing.assert_allclose(hemisphere.polar_coordinates(direction), expected, atol=1e-5)
    assert jnp.all(direction[..., 2] > 0)


def test_parabolic_texel_area_is_the_solid_angle():
    direction = hemisphere.parabolic_texel_direction(resolution=48)
    weight = hemisphere.parabolic_texel_area(resolution=48)
    np.testing.assert_allclose(jnp.sum(weight), 2 * jnp.pi, rtol=5e-3)
    np.testing.assert_allclose(jnp.sum(weight * direction[..., 2]), jnp.pi, rtol=5e-3)
    np.testing.assert_allclose(jnp.sum(weight * direction[..., 2] ** 2), 2 * jnp.pi / 3, rtol=5e-3)


def test_polar_texel_area_integrates_the_cosine():
    weight = maps.polar_texel_area(resolution=48)
    assert jnp.sum(weight) == pytest.approx(np.pi, rel=1e-5)
    z = maps.polar_texel_direction(resolution=48)[..., 2]
    assert jnp.sum(weight * z) == pytest.approx(2 * np.pi / 3, rel=1e-3)
    # The integral of cos(theta) d omega up to the angle of the row's outer edge is pi sin^2(theta).
    cosine = 1 - (np.arange(1, 49) / 48) ** 2
    np.testing.assert_allclose(np.cumsum(np.sum(weight, 1)), np.pi * (1 - cosine**2), rtol=1e-4)


@pytest.mark.parametrize("n", [48, 49])
def test_polar_lookup_is_right_across_the_seam_and_the_normal(n):
    texel = maps.polar_texel_direction(resolution=n)[..., :2]
    height = jnp.array([0.0, 1e-3, 0.3 / n, 0.5, 0.9])
    turn = jnp.array([0.0, 1e-4, 0.2 / n, 0.49 / n, 0.51 / n, 0.3, 1 - 0.3 / n, 1.0])
    place = jnp.stack(jnp.meshgrid(turn, height), -1)
    found = hemisphere.polar_lookup(texel, place)
    np.testing.assert_allclose(found, maps.polar_direction(place)[..., :2], atol=5e-3)
    np.testing.assert_allclose(found[:, 0], found[:, -1], atol=1e-6)


def test_polar_lookup_reproduces_texels_at_their_centers():
    texel = jnp.asarray(np.random.default_rng(3).normal(size=(9, 9)), jnp.float32)
    center = (jnp.arange(9) + 0.5) / 9
    place = jnp.stack(jnp.meshgrid(center, center), -1)
    np.testing.assert_allclose(hemisphere.polar_lookup(texel, place), texel, atol=1e-5)
