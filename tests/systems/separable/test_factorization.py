import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published import maps
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley, CookTorrance, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.scene import Environment
from jaxprt.sphere import hemisphere
from jaxprt.systems.separable import light_errors

WANG = AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100)


@jax.jit
def evaluate(brdf, wi, wo):
    return brdf(wi, wo)


def _texels(resolution):
    direction = np.asarray(maps.texel_direction(resolution=resolution)).reshape(-1, 3)
    inside = np.flatnonzero(np.asarray(maps.texel_area(resolution=resolution)).ravel())
    wi, wo = np.meshgrid(inside, inside)
    return direction[wi.ravel()], direction[wo.ravel()]


def test_lambert_needs_one_term():
    factored = separable.factor(Lambert([0.5, 0.2, 0.1]), terms=1, resolution=16)
    wi, wo = _texels(8)
    expected = np.array([[0.5, 0.2, 0.1]]) / np.pi * np.ones((len(wi), 1))
    np.testing.assert_allclose(evaluate(factored, wi, wo), expected, 1e-4)
    assert separable.factor(Lambert(0.5), error=0.01, resolution=16).terms == 1
    # Maps continue beyond the rim.
    angle = np.linspace(0, 6.28, len(wi))
    rim = np.stack([np.cos(angle), np.sin(angle), np.full(len(wi), 1e-3)], -1).astype(np.float32)
    zenith = np.broadcast_to(np.float32([0.0, 0, 1]), rim.shape)
    for pair in ((rim, zenith), (zenith, rim)):
        np.testing.assert_allclose(evaluate(factored, *pair), expected, rtol=1e-4)


def test_gray_brdfs_of_any_number_are_factored_together():
    both = Channels((Lambert(0.4), CookTorrance(roughness=0.5)), jnp.ones(2))
    factored = separable.factor(both, terms=52, resolution=8)
    wi, wo = _parabolic_texels(8)
    expected = np.asarray(evaluate(both, wi, wo))
    assert expected.shape[1] == 2
    assert np.linalg.norm(evaluate(factored, wi, wo) - expected) < 1e-2 * np.linalg.norm(expected)


def _parabolic_texels(resolution):
    """Texel centers of a parabolic map, without those so near the rim that they stand for directions inside it."""
    center = (np.arange(resolution) + 0.5) / resolution
    place = np.stack(np.meshgrid(center, center), -1).reshape(-1, 2).astype(np.float32)
    place = place[np.linalg.norm(2 * place - 1, axis=1) <= 1 - 0.5 / resolution]
    wi, wo = np.meshgrid(np.arange(len(place)), np.arange(len(place)))
    direction = np.asarray(hemisphere.parabolic_direction(jnp.asarray(place)))
    return direction[wi.ravel()], direction[wo.ravel()]


def test_all_terms_reproduce_every_texel():
    resolution = 8
    wi, wo = _parabolic_texels(resolution)
    inside = np.count_nonzero(maps.texel_area(resolution=resolution))
    factored = separable.factor(WANG, terms=int(inside), resolution=resolution)
    expected = np.asarray(evaluate(WANG, wi, wo))
    # The last eigenvalues lie below single precision of the first, and with them their share of the norm.
    assert np.linalg.norm(evaluate(factored, wi, wo) - expected) < 1e-2 * np.linalg.norm(expected)
    assert factored.error < 2e-3


def test_error_falls_with_the_terms_and_names_them():
    errors = [float((factored := separable.factor(WANG, terms=k, resolution=16)).error) for k in (1, 4, 16)]
    fewer = factored.truncate(3)
    np.testing.assert_array_equal(fewer.light_map, np.asarray(factored.light_map)[:3])
    assert np.isnan(fewer.error)
    with pytest.raises(ValueError, match="terms must be between 1 and 16, got 17"):
        factored.truncate(17)
    assert errors[0] > errors[1] > errors[2]
    asked = 1.001 * errors[1]  # Iterations for other numbers of terms round otherwise.
    factored = separable.factor(WANG, error=asked, resolution=16)
    assert factored.terms == 4
    assert factored.error <= asked


def test_prior_is_a_covariance():
    direction = np.asarray(maps.texel_direction(resolution=8)).reshape(-1, 3)
    covariance = np.asarray(separable.factorization.light_covariance(jnp.asarray(direction), degree=36))
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-5)
    assert np.linalg.eigvalsh(np.asarray(covariance, np.float64)).min() > -1e-3
    np.testing.assert_allclose(np.diag(covariance), np.sum(2 / (np.arange(37) + 0.5)) / (4 * np.pi), rtol=1e-4)


def test_bad_brdfs_are_refused():
    with pytest.raises(ValueError, match="must be finite above the horizon"):
        separable.factor(lambda wi, wo: jnp.full((*wi.shape[:-1], 1), jnp.nan), terms=1, resolution=8)
    with pytest.raises(ValueError, match=r"values \[b c\], got \(64,\) for \(64, 3\)"):
        separable.factor(lambda wi, wo: wi[..., 0], terms=1, resolution=8)


def test_black_brdf_gives_zero_without_nan():
    factored = separable.factor(Lambert(0.0), terms=2, resolution=8)
    wi, wo = _texels(8)
    assert not np.any(evaluate(factored, wi, wo))
    assert factored.error == 0
    assert separable.factor(Lambert(0.0), error=0.1, resolution=8).error == 0


def test_terms_chosen_for_a_light_meet_the_error_under_it_and_the_prior_alone_does_not():
    sun = Environment(jnp.full((6, 8, 8, 3), 0.1).at[2, 3, 5].set(30.0))
    brdf = AshikhminShirley(nu=10, nv=10)
    by_prior = separable.factor(brdf, error=0.4, resolution=24)
    assert light_errors(brdf, by_prior, sun)[-1] > 2 * by_prior.error
    chosen = separable.factor(brdf, error=0.4, light=[sun], resolution=24)
    assert chosen.error <= 0.4
    assert chosen.terms > by_prior.terms
    errors = light_errors(brdf, chosen, sun, frames=50, views=20)  # others than it was chosen by
    assert errors.shape == (chosen.terms,)
    assert errors[-1] < 0.5
    with pytest.raises(
        ValueError, match=r"lights must be at least one, and error must be given with them, got 1 lights and terms=3"
    ):
        separable.factor(brdf, terms=3, light=[sun])


def test_factoring_again_with_other_rounding_finds_the_same_factors_in_the_same_order_and_signs():
    # Isotropic, so that singular values come in equal pairs, one of which the last term cuts.
    brdf = CookTorrance(diffuse=0.3, roughness=0.3)
    first = separable.factor(brdf, terms=5, resolution=12)
    again = separable.factor(
        lambda wi, wo: brdf(wi, wo) * (1 + 1e-6 * jnp.sin(1e4 * wi[..., :1])), terms=5, resolution=12
    )
    one, other = (np.asarray(each.light_map) for each in (first, again))
    assert np.linalg.norm(other - one) < 1e-3 * np.linalg.norm(one)
    separable.factorization.check_mark(jnp.asarray(separable.factorization.mark_of(first.light_map)), again.light_map)
    with pytest.raises(ValueError, match="the ball must be the one that the transport was made for, got another"):
        separable.factorization.check_mark(
            jnp.asarray(separable.factorization.mark_of(first.light_map)), jnp.asarray(1.01 * other), name="the ball"
        )
