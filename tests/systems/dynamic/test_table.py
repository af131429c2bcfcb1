"""BRDFs over their parameters as lobes, a diffuse part and a tensor: what it holds, and between knots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import dynamic, lobe
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.sphere import hemisphere
from jaxprt.systems.protocol import Blend

ROUGH = np.log(np.array([0.3, 0.42, 0.6], np.float32))
RESOLUTION = 16
RANKS = 3, 24, 24
ERROR = 0.05  # of a tensor without lobes: its lobes are about as narrow as the harmonics by which it is fitted
VALUE = 0.25  # the same of single values


def family(log_roughness):
    """A base, and a lobe of an F0 of .3."""
    return Channels((Lambert(1.0), CookTorrance(0.0, 1.0, jnp.exp(log_roughness), 0.3)), jnp.ones(2))


def directions(count=40, seed=0):
    random = np.random.default_rng(seed).normal(size=(2, count, 3)).astype(np.float32)
    random[..., 2] = np.abs(random[..., 2]) + 0.3
    return jnp.asarray(random / np.linalg.norm(random, axis=-1, keepdims=True))


def off(found, true):
    return float(np.linalg.norm(np.asarray(found) - np.asarray(true)) / np.linalg.norm(np.asarray(true)))


def tabulate(**options):
    return dynamic.tabulate(family, resolution=RESOLUTION, knot=(ROUGH,), **options)


@pytest.fixture(scope="module")
def lobes():
    return lobe.tabulate(family, lobes=3, resolution=8, knot=(ROUGH,))


@pytest.fixture(scope="module")
def whole():
    """A tensor of nearly full ranks, without lobes."""
    return tabulate(lobes=0, ranks=RANKS)


@jax.jit
def value(table, place, wi, wo):
    return table.at(place)(wi, wo)


@jax.jit
def exact(place, wi, wo):
    return family(place)(wi, wo)


@jax.jit
def seen(table, place, wo):
    return table.at(place).view(wo)


def test_the_values_at_the_knots_are_those_of_the_brdf_and_so_is_what_it_reflects(whole):
    wi, wo = directions()
    height = np.array([0.35, 0.6, 0.9])
    view = jnp.asarray(np.stack([np.sqrt(1 - height**2), 0 * height, height], 1), jnp.float32)
    assert float(whole.error) < ERROR
    both = []
    for place in map(jnp.asarray, ROUGH):
        assert off(value(whole, place, wi, wo), exact(place, wi, wo)) < VALUE
        both.append(reflected(whole, place, view))
    # Under a few harmonics, by a quadrature of its own, the error of the table is larger than what it sends is off.
    true, found = np.stack([np.stack(pair) for pair in both], 1)
    assert off(found, true) < 0.65 * float(whole.error)


@jax.jit
def reflected(table, place, view):
    """What a BRDF and its table send to views, of light of a few harmonics."""
    brdf, table = family(place), table.at(place)

    def one(wo):
        wi, area = hemisphere.arcs(wo * jnp.array([-1, -1, 1]), rings=32, sectors=48)
        basis = jnp.concatenate([jnp.ones_like(wi[:, :1]), wi, wi[:, :1] * wi[:, 2:]], 1) * (wi[:, 2:] * area[:, None])
        wo = jnp.broadcast_to(wo, wi.shape)
        return basis.T @ brdf(wi, wo), basis.T @ table(wi, wo)

    return jax.lax.map(one, view)


def test_turned_views_equal_views_one_by_one(monkeypatch):
    members = [family(place) for place in ROUGH]
    fast = dynamic.reflected.reflect(members, None, resolution=6)
    monkeypatch.setattr(dynamic.reflected, "is_isotropic", lambda brdf: False)
    slow = dynamic.reflected.reflect(members, None, resolution=6)
    np.testing.assert_allclose(fast.whole, slow.whole, rtol=1e-4)
    assert off(fast.tensor, slow.tensor) < 1e-4


def test_the_diffuse_channel_needs_no_tensor(whole):
    np.testing.assert_allclose(np.asarray(whole.lobe.diffuse)[0], 1, atol=0.01)
    np.testing.assert_allclose(np.asarray(whole.factor)[:, 0], 0, atol=0.01 * np.abs(whole.factor).max())


def test_a_tensor_lowers_the_error_that_lobes_leave(lobes):
    wi, wo = directions()
    alone, both = dynamic.table.without_tensor(lobes), tabulate(lobes=lobes, ranks=RANKS)
    for place in map(jnp.asarray, ROUGH):
        true = exact(place, wi, wo)
        assert off(value(both, place, wi, wo), true) < off(value(alone, place, wi, wo), true)


def test_a_blend_weights_the_channels_at_its_parameters(whole):
    _, wo = directions(6)
    place, weight = jnp.asarray(np.linspace(ROUGH[0], ROUGH[-1], 6, dtype=np.float32)), np.ones((6, 2, 3), np.float32)
    weight[:, 1] *= [0.2, 0.5, 2.0]
    found = np.asarray(whole.view(wo, Blend(jnp.asarray(weight), (place,))))
    for row in range(6):
        one = np.asarray(seen(whole, place[row], wo))[row]
        np.testing.assert_allclose(found[row], one @ weight[row], rtol=1e-3, atol=1e-5)


def test_factors_between_knots_are_interpolated_and_black_below_the_horizon(whole):
    wo = np.asarray(directions(6)[1])
    low, high, middle = (np.asarray(seen(whole, place, wo)) for place in (*ROUGH[:2], ROUGH[:2].mean()))
    np.testing.assert_allclose(middle, (low + high) / 2, rtol=1e-4, atol=1e-6)
    assert not np.any(seen(whole, ROUGH[0], wo * np.float32([1, 1, -1])))  # below the horizon
    with pytest.raises(ValueError, match="needs 1 parameters"):
        whole.view(jnp.asarray(wo))
