"""Functions that stand for BRDFs along light paths, and the error with which they do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, dynamic, separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.brdf.models import CookTorrance
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.lobe import LobeBrdf

RESOLUTION = 24
UP = jnp.array([0.0, 0.0, 1.0])
MEMBERS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.3, 0.4, 0.6)]


@jax.jit
def sent(tables):
    """What the members reflect of natural light, and what tables of them do, by one quadrature: harmonics of the view.

    A table of products meets the light once for each light factor.
    """
    wi, area = hemisphere.arcs(UP, rings=32, sectors=64)
    wo = hemisphere.parabolic_texel_direction(resolution=RESOLUTION).reshape(-1, 3)
    over = hemisphere.parabolic_texel_area(resolution=RESOLUTION).ravel()
    light = harmonics.convolve(harmonics.evaluate(wi, degree=12).T, harmonics.natural(degree=12)).T
    light = light * (wi[:, 2] * area)[:, None]
    smooth = (harmonics.evaluate(wo, degree=5) * over[:, None]).T

    def exact(brdf):
        return smooth @ jax.lax.map(lambda each: brdf(wi, jnp.broadcast_to(each, wi.shape))[:, 0] @ light, wo)

    def found(terms):
        return smooth @ (terms.view(wo)[..., 0] @ (terms.light(wi)[..., 0].T @ light))

    weights = jnp.eye(len(MEMBERS))
    return (
        jnp.stack([exact(each) for each in MEMBERS]),
        [jnp.stack([found(each.at(weight).terms) for weight in weights]) for each in tables],
    )


def factored():
    return {
        "2 functions, 6 terms": bounces.factor(MEMBERS, functions=2, terms=6, resolution=RESOLUTION),
        "3 functions, 12 terms": bounces.factor(MEMBERS, functions=3, terms=12, resolution=RESOLUTION),
        "smooth": bounces.factor(MEMBERS, functions=3, terms=16, resolution=RESOLUTION),
        "sharp": dynamic.factor(MEMBERS, None, ranks=(3, 32, 16), resolution=RESOLUTION),
    }


@pytest.fixture(scope="module")
def errors():
    """What tables say of their error, and what they miss: of all members of a set, each by its own weight."""
    tensor = dynamic.reflected.reflect(MEMBERS, None, resolution=RESOLUTION)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dynamic.reflected, "reflect", lambda *_, **__: tensor)  # Integrated once for all tables.
        tables = factored()
    exact, found = sent(list(tables.values()))
    missed = [np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in found]
    return {name: (float(table.error), e) for (name, table), e in zip(tables.items(), missed, strict=True)}


@pytest.mark.parametrize("size", ["2 functions, 6 terms", "3 functions, 12 terms"])
def test_the_error_of_a_set_is_that_of_what_it_sends(errors, size):
    said, missed = errors[size]
    assert said == pytest.approx(missed, rel=0.02)


def test_terms_do_more_where_what_is_sent_is_smoothed(errors):
    """Beside factors that are chosen for pictures of each direction."""
    assert errors["smooth"][1] < 0.7 * errors["sharp"][1]


def test_a_set_of_three_has_three_functions_and_terms_bring_more():
    tables = [bounces.factor(MEMBERS, functions=3, terms=n, resolution=8) for n in (4, 36)]
    assert [each.factor.shape for each in tables] == [(3, 1, 3)] * 2
    assert tables[1].error < tables[0].error


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
        bounces.factor(MEMBERS, **{"functions": 2, "terms": 4, "resolution": 8, **options})


@pytest.mark.parametrize("count", [1, 2])
def test_sets_of_fewer_than_four_brdfs_have_as_many_functions(count):
    table = bounces.factor(MEMBERS[:count], resolution=8)
    assert table.factor.shape == (count, 1, count)
    assert bounces.functions.basis(table).view_map.shape[-1] == count + 1
    assert table.error < 0.01


def test_functions_of_a_set_make_its_brdfs():
    members = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.4, 0.6)]
    table = bounces.factor(members, functions=2, terms=4, resolution=8)
    weight, diffuse, specular = jnp.array([0.3, 0.7]), jnp.array([0.1, 0.2, 0.3]), jnp.array([0.5, 0.4, 0.3])
    random = np.random.default_rng(0).normal(size=(2, 50, 3))
    random[..., 2] = np.abs(random[..., 2]) + 0.2
    wi, wo = jnp.asarray(random / np.linalg.norm(random, axis=-1, keepdims=True), jnp.float32)
    value = bounces.functions.basis(table)(wi, wo) @ bounces.functions.weights(table.factor, weight, diffuse, specular)
    np.testing.assert_allclose(value, table.at(weight)(wi, wo) * specular + diffuse / np.pi, rtol=1e-5, atol=1e-6)


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


@pytest.mark.parametrize(("ranks", "found"), [(None, "none"), ((1, 1, 1), "those of what its lobes leave")])
def test_a_set_without_terms_of_whole_brdfs_makes_no_functions(ranks, found):
    row, up = np.ones((1, 1, 1, 4), np.float32), np.reshape([0, 0, 1], (3, 1, 1, 1)) * np.float32([1, 1, 1, 1])
    lobes = LobeBrdf(*map(jnp.asarray, (up, row[0], row, row[0])), (jnp.zeros(1),), jnp.zeros(()))
    table = dynamic.factor([Lambert(0.5)], lobes, ranks=ranks, resolution=8)
    with pytest.raises(ValueError, match=f"without lobes, got {found}"):
        bounces.functions.basis(table)
