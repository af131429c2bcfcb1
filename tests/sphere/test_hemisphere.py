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
    return (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)


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
    forth, back = (jax.jit(jax.vmap(jax.jacobian(function))) for function in (coordinates, direction))
    local = np.float32([[0, 0, 1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 0]])
    assert np.isfinite(forth(local)).all()
    assert np.isfinite(back(coordinates(local))).all()


def test_lookup_reproduces_bilinear_functions_between_texel_centers():
    n = 16
    center = (np.arange(n) + 0.5) / n
    x, y = np.meshgrid(center, center)
    place = np.random.default_rng(2).uniform(0.5 / n, 1 - 0.5 / n, (100, 2))
    expected = 1 + 2 * place[:, 0] - 3 * place[:, 1] + 4 * place[:, 0] * place[:, 1]
    found = hemisphere.lookup(jnp.asarray(1 + 2 * x - 3 * y + 4 * x * y), jnp.asarray(place, jnp.float32))
    np.testing.assert_allclose(found, expected, atol=1e-5)


AREAS = {  # texel areas, directions, and the integrals of the weight and of its products with cosines
    "disk": (maps.texel_area, maps.texel_direction, (np.pi, 2 * np.pi / 3)),
    "polar": (maps.polar_texel_area, maps.polar_texel_direction, (np.pi, 2 * np.pi / 3)),
    "parabolic": (
        hemisphere.parabolic_texel_area,
        hemisphere.parabolic_texel_direction,
        (2 * np.pi, np.pi, 2 * np.pi / 3),
    ),
}


@pytest.mark.parametrize("name", AREAS)
def test_texel_areas_integrate_cosines(name):
    area, direction, integrals = AREAS[name]
    weight, z = np.asarray(area(resolution=48)), np.asarray(direction(resolution=48))[..., 2]
    for power, expected in enumerate(integrals):
        assert np.sum(weight * z**power) == pytest.approx(expected, rel=5e-3)
    if name == "disk":
        assert np.sum(weight > 0) == 1804
    if name == "polar":
        # The integral of cos(theta) d omega up to the angle of the row's outer edge is pi sin^2(theta).
        cosine = 1 - (np.arange(1, 49) / 48) ** 2
        np.testing.assert_allclose(np.cumsum(np.sum(weight, 1)), np.pi * (1 - cosine**2), rtol=1e-4)


def test_polar_texels_are_the_directions_that_their_centers_stand_for():
    n = 9
    direction = maps.polar_texel_direction(resolution=n)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, rtol=1e-6)
    center = (np.arange(n) + 0.5) / n
    expected = np.stack(np.meshgrid(center, center), -1)
    np.testing.assert_allclose(hemisphere.polar_coordinates(direction), expected, atol=1e-5)
    assert np.all(np.asarray(direction)[..., 2] > 0)


@pytest.mark.parametrize("n", [48, 49])
def test_polar_lookup_is_right_across_the_seam_and_the_normal(n):
    texel = np.asarray(maps.polar_texel_direction(resolution=n))[..., :2]
    height = np.float32([0.0, 1e-3, 0.3 / n, 0.5, 0.9])
    turn = np.float32([0.0, 1e-4, 0.2 / n, 0.49 / n, 0.51 / n, 0.3, 1 - 0.3 / n, 1.0])
    place = np.stack(np.meshgrid(turn, height), -1)
    found = hemisphere.polar_lookup(texel, place)
    np.testing.assert_allclose(found, maps.polar_direction(place)[..., :2], atol=5e-3)
    np.testing.assert_allclose(found[:, 0], found[:, -1], atol=1e-6)
