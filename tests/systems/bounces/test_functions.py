"""Functions that stand for BRDFs along light paths, and the error with which they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.brdf.models import CookTorrance
from jaxprt.sphere import harmonics, hemisphere

RESOLUTION = 16
UP = jnp.array([0.0, 0.0, 1.0])
MEMBERS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.3, 0.4, 0.6)]


@jax.jit
def sent(members, terms, weight):
    """Harmonics of what BRDFs reflect of natural light, and of what functions with their weights do."""
    wi, area = hemisphere.arcs(UP, rings=32, sectors=64)
    wo = hemisphere.parabolic_texel_direction(resolution=RESOLUTION).reshape(-1, 3)
    over = hemisphere.parabolic_texel_area(resolution=RESOLUTION).ravel()
    light = harmonics.convolve(harmonics.evaluate(wi, degree=12).T, harmonics.natural(degree=12)).T
    light = light * (wi[:, 2] * area)[:, None]
    smooth = (harmonics.evaluate(wo, degree=5) * over[:, None]).T

    def exact(brdf):
        return smooth @ jax.lax.map(lambda each: brdf(wi, jnp.broadcast_to(each, wi.shape))[:, 0] @ light, wo)

    arriving = terms.light(wi)[..., 0].T @ light
    by_functions = jnp.einsum("sd,dkp,mp,kb->msb", smooth, terms.view(wo), weight[:, 0], arriving)
    return jnp.stack([exact(each) for each in members]), by_functions


def test_the_error_of_functions_is_that_of_what_they_send():
    """Relative L2 error of the light that each BRDF sends, over all BRDFs."""
    shared, weight = bounces.functions.shared(MEMBERS, functions=2, terms=6, resolution=RESOLUTION)
    exact, by_functions = sent(MEMBERS, shared, weight)
    size = np.linalg.norm(exact, axis=(1, 2))
    missed = np.linalg.norm(np.asarray(by_functions) - exact, axis=(1, 2)) / size
    assert float(shared.error) == pytest.approx(np.sqrt(np.mean(missed**2)), rel=0.02)


def test_functions_are_followed_by_a_diffuse_one_and_as_few_as_the_brdfs():
    shared, weight = bounces.functions.shared(MEMBERS[:1], functions=4, terms=8, resolution=8)
    assert weight.shape == (1, 1, 2)
    np.testing.assert_array_equal(weight[..., -1], 0)
    assert np.max(np.abs(weight)[..., 0]) == pytest.approx(1)
    np.testing.assert_allclose(np.asarray(bounces.functions.albedo(shared))[-1], 1, rtol=2e-3)


@pytest.mark.parametrize(
    ("brdf", "functions"), [(Lambert(0.3), 1), (Lambert([0.9, 0.3, 0.1]), 1), (Lambert([0.0, 0.0, 0.0]), 0)]
)
def test_one_brdf_has_as_few_functions_as_its_colors_need(brdf, functions):
    factored = separable.factor(brdf, terms=1, resolution=8)
    weight = bounces.functions.fixed_weights(factored)
    assert weight.shape == (functions, factored.view_map.shape[-1])
    assert bounces.functions.basis(factored).view_map.shape[-1] == functions


def test_colors_of_their_own_are_functions_of_their_own():
    glossy = separable.factor(AshikhminShirley(diffuse=[0.5, 0.2, 0.4], specular=0.3), terms=4, resolution=8)
    weight = bounces.functions.fixed_weights(glossy)
    assert weight.shape == (2, 3)  # Diffuse color and white gloss.
    wi = wo = jnp.array([[0.6, 0.0, 0.8], [0.0, 0.3, np.sqrt(0.91)]], jnp.float32)
    np.testing.assert_allclose(bounces.functions.basis(glossy)(wi, wo) @ weight, glossy(wi, wo), rtol=1e-5)
