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
    return tabulate(lobes=0, ranks=(3, 24, 24))


def test_the_values_at_the_knots_are_those_of_the_brdf(whole):
    wi, wo = directions()
    for place in ROUGH:
        assert off(whole.at(jnp.asarray(place))(wi, wo), family(place)(wi, wo)) < VALUE
    assert float(whole.error) < ERROR


@pytest.mark.parametrize("ranks", [(1, 4, 4), (3, 24, 24)])
def test_the_error_of_a_tensor_is_that_of_what_it_reflects(ranks):
    """Under a few harmonics, by a quadrature of its own. The BRDFs of the set are the channels."""
    brdf = Channels(tuple(CookTorrance(0.0, 1.0, m, 0.3) for m in (0.25, 0.4, 0.6)), jnp.ones(3))
    table, height = dynamic.tabulate(brdf, lobes=0, ranks=ranks, resolution=16), np.array([0.35, 0.6, 0.9])
    exact, found = reflected(
        brdf, table, jnp.asarray(np.stack([np.sqrt(1 - height**2), 0 * height, height], 1), jnp.float32)
    )
    assert off(found, exact) < 0.65 * float(table.error)


@jax.jit
def reflected(brdf, table, view):
    """What a BRDF and its table send to views, of light of a few harmonics."""

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


def test_brdfs_that_are_negative_are_refused_by_their_number():
    members = [Lambert(0.5), lambda wi, wo: -wi[:, 2:]]
    with pytest.raises(ValueError, match="1 of 2 BRDFs that are not, the first is number 1"):
        dynamic.reflected.reflect(members, None, resolution=8)


def test_the_diffuse_channel_needs_no_tensor(whole):
    np.testing.assert_allclose(np.asarray(whole.lobe.diffuse)[0], 1, atol=0.01)
    np.testing.assert_allclose(np.asarray(whole.factor)[:, 0], 0, atol=0.01 * np.abs(whole.factor).max())


def test_a_tensor_lowers_the_error_that_lobes_leave(lobes):
    wi, wo = directions()
    alone, both = dynamic.table.without_tensor(lobes), tabulate(lobes=lobes, ranks=(3, 12, 12))
    for place in ROUGH:
        true = family(place)(wi, wo)
        assert off(both.at(jnp.asarray(place))(wi, wo), true) < off(alone.at(jnp.asarray(place))(wi, wo), true)


def test_a_blend_weights_the_channels_at_its_parameters(whole):
    _, wo = directions(6)
    place, weight = jnp.asarray(np.linspace(ROUGH[0], ROUGH[-1], 6, dtype=np.float32)), np.ones((6, 2, 3), np.float32)
    weight[:, 1] *= [0.2, 0.5, 2.0]
    found = whole.view(wo, Blend(jnp.asarray(weight), (place,)))
    for row in range(6):
        one = whole.at(place[row]).view(wo[row : row + 1])[0]
        np.testing.assert_allclose(found[row], one @ weight[row], rtol=1e-3, atol=1e-5)


def test_factors_between_knots_are_interpolated(whole):
    _, wo = directions(4)
    low, high = (whole.at(jnp.asarray(place)).view(wo) for place in ROUGH[:2])
    np.testing.assert_allclose(whole.at(jnp.asarray(ROUGH[:2].mean())).view(wo), (low + high) / 2, rtol=1e-4, atol=1e-6)


def test_views_below_the_horizon_are_black(whole):
    wo = jnp.asarray([[0.6, 0.0, -0.8]])
    assert not np.any(whole.at(jnp.asarray(ROUGH[0])).view(wo))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lobes": 0, "ranks": None}, "needs lobes, or ranks of a tensor, or both"),
        ({"ranks": (0, 2, 2)}, "ranks must be three whole numbers of at least 1"),
        ({"resolution": 3}, "resolution must be"),
    ],
)
def test_impossible_sizes_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        dynamic.tabulate(Lambert(0.5), **options)


def test_parameters_are_required_and_no_more(whole):
    with pytest.raises(ValueError, match="needs 1 parameters"):
        whole.view(directions(2)[1])
