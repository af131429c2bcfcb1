"""Functions that stand for BRDFs along light paths, and the error with which they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, Lambert, dynamic, paths, separable
from jaxprt.brdf.models import CookTorrance
from jaxprt.sphere import harmonics, hemisphere

RESOLUTION = 24
UP = jnp.array([0.0, 0.0, 1.0])
MEMBERS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.3, 0.4, 0.6)]


@jax.jit
def sent(brdf):
    """What is reflected of natural light, as harmonics of the direction, by one quadrature of light for all."""
    wi, area = hemisphere.arcs(UP, rings=48, sectors=96)
    wo = hemisphere.parabolic_texel_direction(resolution=RESOLUTION).reshape(-1, 3)
    over = hemisphere.parabolic_texel_area(resolution=RESOLUTION).ravel()
    light = harmonics.convolve(harmonics.evaluate(wi, degree=12).T, harmonics.natural(degree=12)).T
    light = light * (wi[:, 2] * area)[:, None]
    met = jax.lax.map(lambda each: brdf(wi, jnp.broadcast_to(each, wi.shape))[:, 0] @ light, wo)
    return (harmonics.evaluate(wo, degree=5) * over[:, None]).T @ met


def error(table, members=MEMBERS):
    """Of all members of a set, each by its own share."""
    shares = np.eye(len(members), dtype=np.float32)
    exact = np.stack([sent(each) for each in members])
    found = np.stack([sent(table.at(jnp.asarray(share))) for share in shares])
    return np.linalg.norm(found - exact) / np.linalg.norm(exact)


@pytest.mark.parametrize(("functions", "terms"), [(2, 6), (3, 12)])
def test_the_error_of_a_set_is_that_of_what_it_sends(functions, terms):
    table = paths.factor(MEMBERS, functions=functions, terms=terms, resolution=RESOLUTION)
    assert float(table.error) == pytest.approx(error(table), rel=0.02)


def test_terms_do_more_where_what_is_sent_is_smoothed():
    """Beside factors that are chosen for pictures of each direction."""
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.15, 0.25)]
    smooth = paths.factor(members, functions=2, terms=16, resolution=RESOLUTION)
    sharp = dynamic.factor(members, None, ranks=(2, 32, 16), resolution=RESOLUTION)
    assert error(smooth, members) < 0.7 * error(sharp, members)


def test_a_set_of_three_has_three_functions_and_terms_bring_more():
    errors = [float(paths.factor(MEMBERS, functions=3, terms=n, resolution=12).error) for n in (4, 8, 16, 36)]
    assert errors == sorted(errors, reverse=True)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"functions": 4}, r"from 1 to the tensor's size \(3, "),
        ({"terms": 0}, "from 1"),
        ({"resolution": 2}, "resolution must be at least 4, got 2"),
    ],
)
def test_what_a_set_does_not_have_is_refused(options, reason):
    with pytest.raises(ValueError, match=reason):
        paths.factor(MEMBERS, **{"functions": 2, "terms": 4, "resolution": 8, **options})


@pytest.mark.parametrize("count", [1, 2])
def test_sets_of_fewer_than_four_brdfs_have_as_many_functions(count):
    table = paths.factor(MEMBERS[:count], resolution=8)
    assert table.factor.shape == (count, 1, count)
    assert paths.basis(table).view_map.shape[-1] == count + 1
    assert table.error < 0.01


def test_functions_of_a_set_make_its_brdfs():
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.4, 0.6)]
    table = paths.factor(members, functions=2, terms=8, resolution=12)
    share, diffuse, specular = jnp.array([0.3, 0.7]), jnp.array([0.1, 0.2, 0.3]), jnp.array([0.5, 0.4, 0.3])
    random = np.random.default_rng(0).normal(size=(2, 50, 3))
    random[..., 2] = np.abs(random[..., 2]) + 0.2
    wi, wo = jnp.asarray(random / np.linalg.norm(random, axis=-1, keepdims=True), jnp.float32)
    value = paths.basis(table)(wi, wo) @ paths.weights(table.factor, share, diffuse, specular)
    np.testing.assert_allclose(value, table.at(share)(wi, wo) * specular + diffuse / np.pi, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("brdf", "functions"), [(Lambert(0.3), 1), (Lambert([0.9, 0.3, 0.1]), 1), (Lambert([0.0, 0.0, 0.0]), 0)]
)
def test_one_brdf_has_as_few_functions_as_its_colors_need(brdf, functions):
    factored = separable.factor(brdf, terms=1, resolution=8)
    weight = paths.fixed_weights(factored)
    assert weight.shape == (functions, factored.view_map.shape[-1])
    assert paths.basis(factored).view_map.shape[-1] == functions


def test_colors_of_their_own_are_functions_of_their_own():
    glossy = separable.factor(AshikhminShirley(diffuse=[0.5, 0.2, 0.4], specular=0.3), terms=4, resolution=12)
    weight = paths.fixed_weights(glossy)
    assert weight.shape == (2, 3)  # Diffuse color and white gloss.
    wi = wo = jnp.array([[0.6, 0.0, 0.8], [0.0, 0.3, np.sqrt(0.91)]], jnp.float32)
    np.testing.assert_allclose(paths.basis(glossy)(wi, wo) @ weight, glossy(wi, wo), rtol=1e-5)


@pytest.mark.parametrize(("ranks", "found"), [(None, "none"), ((1, 1, 1), "those of what its lobes leave")])
def test_a_set_without_terms_of_whole_brdfs_makes_no_functions(ranks, found):
    members = [Lambert(0.5)]
    table = dynamic.factor(members, dynamic.separate(members, lobes=1), ranks=ranks, resolution=8)
    with pytest.raises(ValueError, match=f"without lobes, got {found}"):
        paths.basis(table)
