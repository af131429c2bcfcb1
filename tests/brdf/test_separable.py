import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, Lambert, separable
from jaxprt.sphere import hemisphere

WANG = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100)


def _texels(resolution):
    direction = hemisphere.texel_direction(resolution=resolution).reshape(-1, 3)
    inside = np.flatnonzero(np.asarray(hemisphere.texel_area(resolution=resolution)).ravel())
    wi, wo = jnp.meshgrid(inside, inside)
    return direction[wi.ravel()], direction[wo.ravel()]


def test_lambert_needs_one_term():
    factored = separable.factor(Lambert([0.5, 0.2, 0.1]), terms=1)
    wi, wo = _texels(12)
    np.testing.assert_allclose(factored(wi, wo), jnp.array([[0.5, 0.2, 0.1]]) / np.pi * jnp.ones((len(wi), 1)), 1e-4)
    assert separable.factor(Lambert(0.5), error=0.01).terms == 1


def test_light_maps_are_gray_and_color_is_in_the_view_maps():
    factored = separable.factor(AshikhminShirley(diffuse=[0.9, 0.2, 0.1], specular=0.3), terms=3, resolution=16)
    assert factored.light_map.shape == (3, 16, 16, 1)
    assert factored.view_map.shape == (3, 16, 16, 3)


def _parabolic_texels(resolution):
    """Texel centers of a parabolic map, without those so near the rim that they stand for directions inside it."""
    center = (np.arange(resolution) + 0.5) / resolution
    place = np.stack(np.meshgrid(center, center), -1).reshape(-1, 2).astype(np.float32)
    place = place[np.linalg.norm(2 * place - 1, axis=1) <= 1 - 0.5 / resolution]
    wi, wo = np.meshgrid(np.arange(len(place)), np.arange(len(place)))
    direction = hemisphere.parabolic_direction(jnp.asarray(place))
    return direction[wi.ravel()], direction[wo.ravel()]


@pytest.mark.parametrize(
    ("factor", "texels"), [(separable.factor, _parabolic_texels), (separable.factor_symmetric, _texels)]
)
def test_all_terms_reproduce_every_texel(factor, texels):
    resolution = 8
    wi, wo = texels(resolution)
    inside = int(jnp.sum(hemisphere.texel_area(resolution=resolution) > 0))
    factored = factor(WANG, terms=inside, resolution=resolution)
    expected = WANG(wi, wo)
    # The last eigenvalues lie below single precision of the first, and with them their share of the norm.
    assert jnp.linalg.norm(factored(wi, wo) - expected) < 1e-2 * jnp.linalg.norm(expected)
    assert factored.error < 2e-3


def test_published_spectrum_of_the_published_brdf():
    factored = separable.factor_symmetric(WANG, terms=16)
    # |light map inside the disk|^2 is the eigenvalue's magnitude; the errata's table.
    area = hemisphere.texel_area(resolution=48)
    value = jnp.sum(jnp.where(area > 0, factored.light_map[..., 0] ** 2, 0), (1, 2))
    sign = jnp.sign(jnp.sum(factored.light_map * factored.view_map, (1, 2, 3)))
    expected = [390.6, -311.3, 296.9, -281.1, 260.1, -242.0, 242.0, -239.8]
    np.testing.assert_allclose(np.sort(value[:8]), np.sort(np.abs(expected)), atol=0.06)
    np.testing.assert_array_equal(sign[:5], np.sign(expected[:5]))
    errors = [float(separable.factor_symmetric(WANG, terms=k).error) for k in (1, 4, 16)]
    np.testing.assert_allclose(errors, [0.96, 0.87, 0.64], atol=0.006)


def test_error_falls_with_the_terms_and_names_them():
    errors = [float(separable.factor(WANG, terms=k, resolution=24).error) for k in (1, 4, 16)]
    assert errors[0] > errors[1] > errors[2]
    factored = separable.factor(WANG, error=errors[1], resolution=24)
    assert factored.terms == 4
    assert factored.error <= errors[1]


def test_kept_terms_are_the_leading_ones():
    factored = separable.factor(WANG, terms=8, resolution=16)
    fewer = factored.keep(3)
    np.testing.assert_array_equal(fewer.light_map, factored.light_map[:3])
    assert jnp.isnan(fewer.error)
    with pytest.raises(ValueError, match="terms must be between 1 and 8, got 9"):
        factored.keep(9)


def test_maps_are_finite_and_continue_beyond_the_rim():
    for texel in jax.tree.leaves(separable.factor(WANG, terms=16, resolution=32)):
        assert jnp.all(jnp.isfinite(texel))
    factored = separable.factor(Lambert(0.5), terms=1)
    angle = jnp.linspace(0, 6.28, 50)
    rim = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.full(50, 1e-3)], -1)
    zenith = jnp.broadcast_to(jnp.array([0.0, 0, 1]), rim.shape)
    np.testing.assert_allclose(factored(rim, zenith), 0.5 / np.pi, rtol=1e-4)
    np.testing.assert_allclose(factored(zenith, rim), 0.5 / np.pi, rtol=1e-4)


def test_prior_is_a_covariance():
    direction = hemisphere.texel_direction(resolution=10).reshape(-1, 3)
    covariance = separable.light_covariance(direction, degree=36)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-5)
    assert np.linalg.eigvalsh(np.asarray(covariance, np.float64)).min() > -1e-3
    np.testing.assert_allclose(jnp.diag(covariance), np.sum(2 / (np.arange(37) + 0.5)) / (4 * np.pi), rtol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "either terms or error"),
        ({"terms": 2, "error": 0.1}, "either terms or error"),
        ({"error": 0.0}, "error must be positive"),
        ({"terms": 0}, "terms must be between 1 and"),
        ({"terms": 1000, "resolution": 8}, "terms must be between 1 and 52, got 1000"),
        ({"terms": 1, "resolution": 1}, "resolution must be at least 2"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        separable.factor(WANG, **options)


def test_bad_brdfs_are_refused():
    with pytest.raises(ValueError, match="must be finite above the horizon"):
        separable.factor(lambda wi, wo: jnp.full((*wi.shape[:-1], 1), jnp.nan), terms=1, resolution=8)
    with pytest.raises(ValueError, match=r"\[b 1\] or \[b 3\]"):
        separable.factor(lambda wi, wo: wi[..., 0], terms=1, resolution=8)
    with pytest.raises(ValueError, match="must be reciprocal"):
        separable.factor_symmetric(lambda wi, wo: wi[..., 2:] + 0 * wo[..., 2:], terms=1, resolution=8)


def test_black_brdf_gives_zero_without_nan():
    factored = separable.factor(Lambert(0.0), terms=2, resolution=8)
    wi, wo = _texels(8)
    assert jnp.all(factored(wi, wo) == 0)
    assert factored.error == 0
    assert separable.factor(Lambert(0.0), error=0.1, resolution=8).error == 0
