import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published import maps
from benchmarks.published.factorization import (
    brown_plastic,
    factor_normalized,
    factor_symmetric,
    red_plastic,
    sample_error,
)
from jaxprt.brdf import AshikhminShirley, Lafortune
from jaxprt.sphere import hemisphere

WANG = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100)
MAPS = {
    "disk": (hemisphere.disk_coordinates, maps.texel_direction, maps.texel_area),
    "polar": (hemisphere.polar_coordinates, maps.polar_texel_direction, maps.polar_texel_area),
}
each_map = pytest.mark.parametrize("name", MAPS)


def _texels(name, resolution):
    """Directions of the texels inside a map, and their areas in float64."""
    _, direction, area = MAPS[name]
    area = np.asarray(area(resolution=resolution), np.float64).ravel()
    inside = np.flatnonzero(area)
    return np.asarray(direction(resolution=resolution)).reshape(-1, 3)[inside], area[inside]


def _pairs(direction):
    light, view = np.meshgrid(np.arange(len(direction)), np.arange(len(direction)))
    return direction[light.ravel()], direction[view.ravel()]


def _weighted(name, resolution, brdf):
    """The matrix whose eigenvectors are sought, in float64."""
    direction, area = _texels(name, resolution)
    value = np.asarray(evaluate(brdf, *_pairs(direction)), np.float64)[:, 0].reshape(len(area), -1)
    return value * np.sqrt(area * area[:, None])


@jax.jit
def evaluate(brdf, wi, wo):
    return brdf(wi, wo)


@each_map
def test_all_terms_reproduce_every_texel(name):
    direction, _ = _texels(name, 8)
    wi, wo = _pairs(direction)
    factored = factor_symmetric(WANG, terms=len(direction), resolution=8, coordinates=MAPS[name][0])
    expected = np.asarray(evaluate(WANG, wi, wo))
    # The last eigenvalues lie below single precision of the first, and with them their share of the norm.
    assert np.linalg.norm(evaluate(factored, wi, wo) - expected) < 1e-2 * np.linalg.norm(expected)
    assert factored.error < 2e-3


@each_map
def test_error_is_the_optimum_of_its_rank(name):
    matrix = _weighted(name, 16, WANG)
    value = np.sort(np.linalg.eigvalsh(matrix) ** 2)[::-1]
    factored = factor_symmetric(WANG, terms=8, resolution=16, coordinates=MAPS[name][0])
    assert factored.error == pytest.approx(np.sqrt(np.sum(value[8:]) / np.sum(value)), rel=1e-4)
    direction, area = _texels(name, 16)
    found = np.asarray(evaluate(factored, *_pairs(direction)), np.float64).reshape(matrix.shape) * np.sqrt(
        area * area[:, None]
    )
    assert np.linalg.norm(found - matrix) / np.linalg.norm(matrix) == pytest.approx(float(factored.error), rel=1e-3)


def test_published_spectrum_of_the_published_brdf():
    factored = factor_symmetric(WANG, terms=16)
    # |light map inside the disk|^2 is the eigenvalue's magnitude.
    area = maps.texel_area(resolution=48)
    light, view = (np.asarray(each)[..., 0] for each in (factored.light_map, factored.view_map))
    value = np.sum(np.where(np.asarray(area) > 0, light**2, 0), (1, 2))
    sign = np.sign(np.sum(light * view, (1, 2)))
    expected = [390.6, -311.3, 296.9, -281.1, 260.1, -242.0, 242.0, -239.8]
    np.testing.assert_allclose(np.sort(value[:8]), np.sort(np.abs(expected)), atol=0.06)
    np.testing.assert_array_equal(sign[:5], np.sign(expected[:5]))
    assert factored.error == pytest.approx(0.64, abs=0.006)


def test_lafortune_and_plastics_are_reciprocal_and_factored_per_color():
    # Clay's first two lobes as published, of which the first sends light past the mirror direction at grazing angles.
    clay = Lafortune(
        diffuse=np.array([0.383626, 0.260749, 0.274207]),
        cx=(cx := np.array([[-1.089701, -1.102701, -1.107603], [-0.733381, -0.79332, -0.848206]])),
        cy=cx,
        cz=np.array([[-1.354682, -2.714801, -1.569866], [0.676108, 0.679314, 0.726031]]),
        exponent=np.array([[17.968505, 11.024489, 21.270282], [8.219745, 9.055139, 11.261951]]),
    )
    for brdf in (clay, red_plastic(), brown_plastic()):
        factored = factor_symmetric(brdf, terms=8, resolution=16)
        assert factored.light_map.shape == (8, 16, 16, 3)
        assert np.isfinite(factored.light_map).all()
        error, fewer = (sample_error(brdf, each)[1] for each in (factored, factored.truncate(1)))
        assert factored.error < 1
        assert error < fewer < 1


@each_map
def test_normalized_term_of_a_product_is_exact(name):
    color = jnp.array([0.5, 0.2, 0.1])
    direction, _ = _texels(name, 8)
    wi, wo = _pairs(direction)

    def product(wi, wo):
        return (0.2 + wi[..., 2:] ** 2) * (0.1 + wo[..., :1] ** 2) * color

    factored = factor_normalized(product, resolution=8, coordinates=MAPS[name][0])
    assert factored.light_map.shape == (1, 8, 8, 1)
    assert factored.view_map.shape == (1, 8, 8, 3)
    assert factored.error < 1e-5
    np.testing.assert_allclose(evaluate(factored, wi, wo), product(wi, wo), rtol=1e-4)


@each_map
def test_normalized_term_has_the_reflectance_of_every_view(name):
    brdf = AshikhminShirley(diffuse=[0.9, 0.2, 0.1], specular=0.3)
    direction, area = _texels(name, 16)
    wi, wo = _pairs(direction)
    factored = factor_normalized(brdf, resolution=16, coordinates=MAPS[name][0])
    count = len(direction)
    expected, found = (
        np.einsum("oic,i->oc", np.asarray(evaluate(f, wi, wo)).reshape(count, count, -1), area)
        for f in (brdf, factored)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4)


def test_polar_maps_are_read_across_the_seam_and_after_pickling():
    coordinates = hemisphere.polar_coordinates
    factored = factor_symmetric(WANG, terms=8, resolution=16, coordinates=coordinates)
    again = pickle.loads(pickle.dumps(factored))
    assert again.coordinates is coordinates
    # The seam is where x = 0 and y > 0.
    seam = np.float32([[x, 0.6, 0.8] for x in (-1e-4, 0.0, 1e-4)])
    view = np.tile(np.float32([0.0, -0.6, 0.8]), (3, 1))
    value = np.asarray(evaluate(again, seam, view))
    np.testing.assert_allclose(value, value[1] * np.ones((3, 1)), rtol=1e-2)
    np.testing.assert_array_equal(value, evaluate(factored, seam, view))


@pytest.mark.parametrize(
    "factor",
    [
        factor_normalized,
        lambda brdf, **options: factor_symmetric(brdf, terms=1, **options),
    ],
)
def test_bad_options_are_refused(factor):
    with pytest.raises(ValueError, match="resolution must be at least 2, got 1"):
        factor(WANG, resolution=1)
    with pytest.raises(ValueError, match="coordinates must be hemisphere"):
        factor(WANG, coordinates=hemisphere.parabolic_coordinates)
    with pytest.raises(ValueError, match="must be finite above the horizon"):
        factor(lambda wi, wo: jnp.full((*wi.shape[:-1], 1), jnp.nan), resolution=8)


def test_more_terms_than_texels_and_other_than_reciprocal_brdfs_are_refused():
    with pytest.raises(ValueError, match="terms must be between 1 and 52, got 53"):
        factor_symmetric(WANG, terms=53, resolution=8)
    with pytest.raises(ValueError, match="must be reciprocal"):
        factor_symmetric(lambda wi, wo: wi[..., 2:] + 0 * wo[..., 2:], terms=1, resolution=8)


def _constant(value):
    return lambda wi, wo: jnp.full((*wi.shape[:-1], 1), value) * jnp.ones_like(wi)


def test_sample_error_of_closed_forms():
    error, relative = sample_error(_constant(0.5), _constant(0.3))
    np.testing.assert_allclose([error, relative], [0.2, 0.4], rtol=1e-5)
    # sqrt(mean of cos_i^3 / mean of cos_i) = sqrt(1/2), and views weigh alike: sqrt(mean of cos_o^2) = sqrt(1/3).
    samples = 5e-3
    incident = sample_error(lambda wi, wo: wi[..., 2:], _constant(0.0))
    assert incident[0] == pytest.approx(np.sqrt(0.5), rel=samples)
    assert incident[1] == pytest.approx(1)
    view = sample_error(lambda wi, wo: wo[..., 2:], _constant(0.0))
    assert view[0] == pytest.approx(np.sqrt(1 / 3), rel=samples)


def test_sample_error_is_the_same_at_each_call_and_finite_for_nothing():
    first, second = (sample_error(WANG, _constant(0.0), samples=1000) for _ in range(2))
    assert first == second
    assert sample_error(_constant(0.0), _constant(0.0), samples=1000) == (0, 0)
    with pytest.raises(ValueError, match="samples must be at least 1, got 0"):
        sample_error(WANG, WANG, samples=0)
