import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, Lambert

MODELS = {
    "lambert": Lambert(0.7),
    "wang": AshikhminShirley(diffuse=0.5, specular=0.75, nu=10, nv=100),
    "colored": AshikhminShirley(diffuse=[0.5, 0.3, 0.1], specular=0.05, nu=1000, nv=1000),
    "anisotropic": AshikhminShirley(diffuse=0.0, specular=[1.0, 0.8, 0.3], nu=1, nv=10000),
}


def _pairs(count=4000, seed=0):
    direction = np.random.default_rng(seed).standard_normal((2, count, 3))
    direction[..., 2] = np.abs(direction[..., 2])
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return jnp.asarray(direction, jnp.float32)


def _published(wi, wo, diffuse, specular, nu, nv):
    """Ashikhmin and Shirley 2000, equations 4 to 6, in float64, as they stand there."""
    h = wi + wo
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    hk, hn = np.sum(h * wi, -1), h[:, 2]
    power = (nu * h[:, 0] ** 2 + nv * h[:, 1] ** 2) / (1 - hn**2)
    fresnel = specular + (1 - specular) * (1 - hk) ** 5
    lobe = np.sqrt((nu + 1) * (nv + 1)) / (8 * np.pi) * hn**power / (hk * np.maximum(wi[:, 2], wo[:, 2]))
    base = 28 * diffuse / (23 * np.pi) * (1 - specular)
    return lobe * fresnel + base * (1 - (1 - wi[:, 2] / 2) ** 5) * (1 - (1 - wo[:, 2] / 2) ** 5)


@pytest.mark.parametrize("name", MODELS)
def test_reciprocity(name):
    wi, wo = _pairs()
    np.testing.assert_allclose(MODELS[name](wi, wo), MODELS[name](wo, wi), rtol=2e-5)


@pytest.mark.parametrize("name", MODELS)
def test_values_are_not_negative_and_vanish_below_the_horizon(name):
    wi, wo = _pairs()
    below = jnp.array([1.0, 1, -1])
    assert jnp.all(MODELS[name](wi, wo) >= 0)
    assert jnp.all(MODELS[name](wi * below, wo) == 0)
    assert jnp.all(MODELS[name](wi, wo * below) == 0)


def test_ashikhmin_shirley_equals_the_published_formula():
    wi, wo = np.asarray(_pairs(), np.float64)
    expected = _published(wi, wo, 0.5, 0.75, 10, 100)
    found = MODELS["wang"](jnp.float32(wi), jnp.float32(wo))[:, 0]
    # float32 directions are unit to 1e-7, which the exponent multiplies by a hundred.
    assert np.linalg.norm(found - expected) < 1e-4 * np.linalg.norm(expected)


@pytest.mark.parametrize("name", ["lambert", "wang", "colored"])
@pytest.mark.parametrize("tilt", [0.0, 0.6, 1.2, 1.5])
def test_energy_is_conserved(name, tilt):
    n = 600
    u, v = np.meshgrid((np.arange(n) + 0.5) / n, (np.arange(n) + 0.5) / n)
    radius, angle = np.sqrt(u.ravel()), 2 * np.pi * v.ravel()
    wi = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u.ravel())], -1)
    wo = np.array([np.sin(tilt) * 0.8, np.sin(tilt) * 0.6, np.cos(tilt)])
    value = MODELS[name](jnp.float32(wi), jnp.broadcast_to(jnp.float32(wo), wi.shape))
    assert jnp.all(jnp.mean(value, 0) * np.pi < 1.005)


def test_lambert_reflects_its_albedo():
    wi, wo = _pairs()
    np.testing.assert_allclose(MODELS["lambert"](wi, wo) * np.pi, 0.7, rtol=1e-6)


HARD = {
    "at the normal": ([0.0, 0, 1], [0.0, 0, 1]),
    "half vector at the normal": ([0.6, 0, 0.8], [-0.6, 0, 0.8]),
    "grazing apart": ([1.0, 0, 1e-7], [-1.0, 0, 1e-7]),
    "grazing together": ([1.0, 0, 1e-7], [1.0, 0, 1e-7]),
    "at the horizon": ([1.0, 0, 0], [0.0, 1, 0]),
    "one grazing": ([0.0, 1, 1e-9], [0.0, 0, 1]),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("case", HARD)
def test_values_and_gradients_are_finite(name, case):
    wi, wo = (jnp.array(w) for w in HARD[case])
    value, pull = jax.vjp(lambda model, wi, wo: model(wi, wo), MODELS[name], wi, wo)
    assert jnp.all(jnp.isfinite(value))
    for leaf in jax.tree.leaves(pull(jnp.ones_like(value))):
        assert jnp.all(jnp.isfinite(leaf))


def test_parameter_gradient_equals_finite_difference(x64):
    wi, wo = (jnp.asarray(w, jnp.float64) for w in _pairs(50))

    def total(nu):
        return jnp.sum(AshikhminShirley(diffuse=0.5, specular=0.75, nu=nu, nv=100.0)(wi, wo))

    step = 1e-4
    expected = (total(10 + step) - total(10 - step)) / (2 * step)
    assert jax.grad(total)(10.0) == pytest.approx(float(expected), rel=1e-6)


def test_swapping_the_exponents_turns_the_lobe():
    wi, wo = _pairs()
    turn = jnp.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    swapped = AshikhminShirley(diffuse=0.5, specular=0.75, nu=100, nv=10)
    np.testing.assert_allclose(swapped(wi @ turn, wo @ turn), MODELS["wang"](wi, wo), rtol=1e-4)
