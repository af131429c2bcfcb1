"""Functions that stand for BRDFs along light paths, and the error with which they do."""

import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, dynamic, separable
from jaxprt.brdf import AshikhminShirley, Lambert, navigation
from jaxprt.brdf.models import CookTorrance
from jaxprt.brdf.places import Line
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.lobe import LobeBrdf, tabulate
from jaxprt.systems.lobe.table import mean

RESOLUTION = 24
UP = jnp.array([0.0, 0.0, 1.0])
FIRST, INTEGRATED = dynamic.reflected.reflect, {}
MEMBERS = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.3, 0.4, 0.6)]


@jax.jit
def sent(members, weights, tables):
    """Harmonics of what BRDFs reflect of natural light, and of what tables with some weights do, by one quadrature.

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

    return (
        jnp.stack([exact(each) for each in members]),
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
    reflect = functools.cache(lambda count: FIRST(INTEGRATED[count], None, resolution=RESOLUTION))
    INTEGRATED.clear()

    def once(brdfs, lobe, *, resolution):
        """What is integrated once for all tables."""
        INTEGRATED.setdefault(len(brdfs), brdfs)
        return reflect(len(brdfs))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dynamic.reflected, "reflect", once)
        tables = factored()
    exact, found = sent(MEMBERS, jnp.eye(len(MEMBERS)), list(tables.values()))
    missed = [np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in found]
    return {name: (float(table.error), e) for (name, table), e in zip(tables.items(), missed, strict=True)}


@pytest.mark.parametrize("size", ["2 functions, 6 terms", "3 functions, 12 terms"])
def test_the_error_of_a_set_is_that_of_what_it_sends(errors, size):
    said, missed = errors[size]
    assert said == pytest.approx(missed, rel=0.02)


def test_terms_do_more_where_what_is_sent_is_smoothed(errors):
    """Beside factors that are chosen for pictures of each direction."""
    assert errors["smooth"][1] < 0.7 * errors["sharp"][1]


def model(f0, m):
    return CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=f0)


class Own(eqx.Module):
    """A BRDF whose parameters have no mean."""

    model: CookTorrance
    number: jax.Array

    def __call__(self, wi, wo):
        return self.model(wi, wo)


def test_between_its_brdfs_a_set_sends_what_the_brdf_there_does():
    """The error there is at most twice that at BRDFs of the set. Mixed linearly it would be several times that."""
    rough = (0.15, 0.3, 0.6)
    family = navigation.cook_torrance(point=np.array(list(itertools.product((0.0, 1.0), rough))))
    inside = [(f0, m) for f0 in (0.4, 0.7, 1.0) for m in (0.18, 0.21, 0.26, 0.36, 0.42, 0.5)]
    known = [(f0, m) for f0 in (0.0, 1.0) for m in rough]
    weights = jax.vmap(family.navigation.weight)(jnp.array(known + inside))
    whole = bounces.factor(family.brdf, navigation=family.navigation, functions=6, resolution=RESOLUTION)
    linear = eqx.tree_at(lambda each: each.factor, whole, jnp.einsum("mmch->mch", whole.factor))
    exact, found = sent([model(*each) for each in known + inside], weights, [whole, linear])
    error, mixed = (np.linalg.norm(each - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2)) for each in found)
    assert np.max(error[6:]) < 2 * np.max(error[:6])
    assert np.sqrt(np.mean(error[6:] ** 2)) < 1.1 * np.sqrt(np.mean(error[:6] ** 2))
    for low in (0, 1):  # In each interval of the column of F0 of 1, beside its ends.
        between = slice(18 + 3 * low, 21 + 3 * low)
        ends = np.max(error[3 + low : 5 + low])
        assert np.max(error[between]) < ends
        assert np.max(mixed[between]) > (1, 3)[low] * ends


def test_where_only_lobes_are_known_a_set_sends_what_these_do_half_way():
    """What the lobes leave of each BRDF is mixed."""
    own = [Own(model(0.5, m), jnp.arange(1)) for m in (0.3, 0.6)]
    lobe = dynamic.separate(own, separator=lambda each: tabulate(each, lobes=2, resolution=8))
    half = jnp.full((1, 2), 0.5)
    tables = [bounces.factor(own, lobe=each, resolution=RESOLUTION) for each in (lobe, None)]
    assert [each.factor.shape for each in tables] == [(2, 2, 1, 3), (2, 2, 1, 2)]
    moved, *ends = (bounces.between.Moved(mean(lobe, each)) for each in (half[0], *jnp.eye(2)))

    def there(wi, wo):
        return moved(wi, wo) + sum(each(wi, wo) - end(wi, wo) for each, end in zip(own, ends, strict=True)) / 2

    exact, found = sent([jax.tree_util.Partial(there)], half, tables)
    error, mixed = (np.linalg.norm(each - exact) / np.linalg.norm(exact) for each in found)
    assert error < 0.015  # Of 32 terms on these maps; the same with the model in the middle.
    assert mixed > 2 * error


def test_a_set_of_three_has_three_functions_and_terms_bring_more():
    tables = [bounces.factor(MEMBERS, functions=3, terms=n, resolution=8) for n in (4, 36)]
    assert [each.factor.shape for each in tables] == [(3, 3, 1, 3)] * 2
    assert tables[1].error < tables[0].error


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"functions": 7}, "functions must be a whole number from 1 to 6 for these BRDFs, got 7"),
        ({"functions": 1.5}, "functions must be a whole number from 1 to 6 for these BRDFs, got 1.5"),
        ({"terms": 0}, "terms must be a whole number from 1 to 625 for these BRDFs, got 0"),
        ({"navigation": Line(jnp.arange(4.0))}, "navigation must be for the set's 3 BRDFs, got one for 4"),
        ({"resolution": 2}, "resolution must be at least 4, got 2"),
    ],
)
def test_what_a_set_does_not_have_is_refused(options, reason, unchecked):
    with pytest.raises(ValueError, match=reason):
        bounces.factor(MEMBERS, **{"functions": 2, "terms": 4, "resolution": 8, **options})


@pytest.mark.parametrize(("count", "functions"), [(1, 1), (2, 3)])
def test_sets_of_one_brdf_and_of_two_have_functions_for_these_and_the_middle(count, functions):
    table = bounces.factor(MEMBERS[:count], resolution=8)
    assert table.factor.shape == (count, count, 1, functions)
    assert bounces.functions.basis(table).view_map.shape[-1] == functions + 1
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


@pytest.mark.parametrize(("ranks", "found"), [(None, "no terms"), ((1, 1, 1), "terms of the residual of its lobes")])
def test_a_set_without_terms_of_whole_brdfs_makes_no_functions(ranks, found):
    row, up = np.ones((1, 1, 1, 4), np.float32), np.reshape([0, 0, 1], (3, 1, 1, 1)) * np.float32([1, 1, 1, 1])
    lobes = LobeBrdf(*map(jnp.asarray, (up, row[0], row, row[0])), (jnp.zeros(1),), jnp.zeros(()))
    table = dynamic.factor([Lambert(0.5)], lobes, ranks=ranks, resolution=8)
    with pytest.raises(
        ValueError, match=f"terms of whole BRDFs, got {found}: factor the set with ranks and without lobes"
    ):
        bounces.functions.basis(table)
