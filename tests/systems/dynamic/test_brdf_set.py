"""Sets of BRDFs: what lobes and tensors carry of each, and of those between them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, dynamic, lobe, separable
from jaxprt.brdf import BlinnPhong, CookTorrance, Lambert
from jaxprt.sphere import hemisphere

ROUGH = [0.25, 0.4, 0.6]
RESOLUTION = 8


def lobe_of(roughness, f0=0.3):
    return CookTorrance(diffuse=0.0, specular=1.0, roughness=roughness, f0=f0)


SET = [lobe_of(m) for m in ROUGH]


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Lobes without their error, which no test here asks for, of fewer samples; each set is integrated once."""
    reflect, done = dynamic.reflected.reflect, {}

    def once(brdfs, lobes, *, resolution):
        if brdfs is not SET:
            return reflect(brdfs, lobes, resolution=resolution)
        key = id(lobes), resolution, dynamic.reflected.is_isotropic
        if key not in done:
            done[key] = lobes, reflect(brdfs, lobes, resolution=resolution)
        return done[key][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
        patch.setattr(lobe.em, "RINGS", 20)
        patch.setattr(lobe.em, "SECTORS", 28)
        patch.setattr(dynamic.reflected, "reflect", once)
        lobe.em.samples.clear_cache()  # The program holds the numbers that it was compiled with.
        yield
    lobe.em.samples.clear_cache()
    FITTED.clear()


FITTED = {}


def fit(brdf):
    """Fewer lobes and nodes than the default: the same code in a fraction of the time; each model once."""
    key = type(brdf), *(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(brdf))
    if key not in FITTED:
        FITTED[key] = lobe.tabulate(brdf, lobes=3, resolution=8)
    return FITTED[key]


@pytest.fixture(scope="module")
def lobes():
    return dynamic.separate(SET, separator=fit)


@pytest.fixture(scope="module")
def pairs():
    """Directions well above the horizon."""
    random = np.random.default_rng(0)
    vector = random.normal(size=(2, 400, 3))
    vector[..., 2] = np.abs(vector[..., 2]) + 0.3
    return jnp.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True), jnp.float32)


def relative(value, exact):
    return float(np.linalg.norm(np.asarray(value) - exact) / np.linalg.norm(exact))


@jax.jit
def value(brdf, wi, wo):
    return brdf(wi, wo)


@jax.jit
def mixed_value(table, weight, wi, wo):
    """Value of a set's BRDF at some place."""
    return table.at(weight)(wi, wo)


@jax.jit
def seen(brdfs, table, view):
    """What each BRDF of a set and its table send to views, of light of a few harmonics."""

    def one(wo):
        wi, area = hemisphere.arcs(wo * jnp.array([-1, -1, 1]), rings=32, sectors=48)
        basis = jnp.concatenate([jnp.ones_like(wi[:, :1]), wi, wi[:, :1] * wi[:, 2:]], 1) * (wi[:, 2:] * area[:, None])
        wo = jnp.broadcast_to(wo, wi.shape)
        found = [table.at(weight)(wi, wo) for weight in jnp.eye(len(brdfs))]
        return [basis.T @ jnp.stack(each) for each in ([brdf(wi, wo) for brdf in brdfs], found)]

    return jax.lax.map(one, view)


def test_tables_of_a_set_are_those_of_its_brdfs(lobes):
    for number, brdf in enumerate(SET):
        alone = fit(brdf)
        np.testing.assert_allclose(lobes.scale[:, number], alone.scale, rtol=1e-5)
        np.testing.assert_allclose(lobes.weight[:, :, number], alone.weight, rtol=1e-5, atol=1e-7)
    assert lobes.knot[0].tolist() == [0, 1, 2]


def test_a_member_of_the_set_is_its_own_table(lobes, pairs):
    table = dynamic.factor(SET, lobes)
    wi, wo = pairs
    for number, brdf in enumerate(SET):
        mixed = mixed_value(table, np.eye(3, dtype=np.float32)[number], wi, wo)
        alone = value(fit(brdf), wi, wo)
        np.testing.assert_allclose(mixed, np.asarray(alone) / wi[:, 2:], rtol=1e-5, atol=1e-7)


def test_between_members_lobes_are_those_of_the_model_there(lobes, pairs):
    """Halfway in the logarithm of the roughness: 1.13 times as far off as at the sharper member."""
    model = lobe_of(np.sqrt(ROUGH[0] * ROUGH[1]))
    wi, wo = pairs
    mixed = mixed_value(dynamic.factor(SET, lobes), jnp.array([0.5, 0.5, 0.0]), wi, wo)
    member = relative(value(fit(SET[0]), wi, wo), value(SET[0], wi, wo) * wi[:, 2:])
    assert relative(mixed * wi[:, 2:], value(model, wi, wo) * wi[:, 2:]) < 1.2 * member


def test_between_fresnel_reflectances_lobes_without_light_have_no_say(pairs):
    """A reflectance of zero has lobes at grazing angles alone; their places must not draw the others away."""
    ends = [lobe_of(0.2, 0.0), lobe_of(0.2, 1.0)]
    wi, wo = pairs
    mixed = mixed_value(dynamic.factor(ends, dynamic.separate(ends, separator=fit)), jnp.array([0.7, 0.3]), wi, wo)
    steep = wo[:, 2] > 0.6
    exact = np.asarray(value(lobe_of(0.2, 0.3), wi, wo))[steep]
    alone = np.asarray(value(fit(lobe_of(0.2, 0.3)), wi, wo) / wi[:, 2:])[steep]
    assert relative(np.asarray(mixed)[steep], exact) < 1.05 * relative(alone, exact)


def test_the_model_between_members_is_as_wide_as_the_lobes_there_and_reflects_the_mean():
    weight = np.array([0.5, 0.25, 0.25])
    members = [lobe_of(m, f0) for m, f0 in zip(ROUGH, (0.1, 0.5, 0.9), strict=True)]
    mixed = dynamic.factor(members, None, ranks=(1, 1, 1), resolution=8).at(jnp.asarray(weight))
    assert isinstance(mixed.brdf, CookTorrance)
    np.testing.assert_allclose(mixed.brdf.roughness, np.exp(weight @ np.log(ROUGH)), rtol=1e-5)
    np.testing.assert_allclose(mixed.brdf.f0, weight @ [0.1, 0.5, 0.9], rtol=1e-6)


@pytest.mark.parametrize("ranks", [(1, 4, 4), (2, 8, 8), (3, 24, 24)])
def test_the_error_of_a_tensor_is_that_of_what_it_reflects(ranks):
    """Under a few harmonics, by a quadrature of its own."""
    table = dynamic.factor(SET, None, ranks=ranks, resolution=16)
    height = np.array([0.35, 0.6, 0.9])
    wo = jnp.asarray(np.stack([np.sqrt(1 - height**2), 0 * height, height], 1), jnp.float32)
    exact, found = seen(SET, table, wo)
    assert np.linalg.norm(found - exact) / np.linalg.norm(exact) < 0.65 * float(table.error)


def test_errors_fall_with_ranks():
    errors = [float(dynamic.factor(SET, None, ranks=r, resolution=RESOLUTION).error) for r in [(1, 2, 2), (2, 8, 8)]]
    assert errors[1] < 0.6 * errors[0]


def test_lobes_leave_less_than_a_coarse_tensor(lobes):
    both = dynamic.factor(SET, lobes, ranks=(2, 4, 4), resolution=RESOLUTION)
    tensor = dynamic.factor(SET, None, ranks=(3, 16, 16), resolution=RESOLUTION)
    assert both.error < 0.45 * tensor.error


def test_turned_views_equal_views_one_by_one(monkeypatch):
    fast = dynamic.factor(SET, None, ranks=(2, 4, 4), resolution=6)
    monkeypatch.setattr(dynamic.reflected, "is_isotropic", lambda brdf: False)
    slow = dynamic.factor(SET, None, ranks=(2, 4, 4), resolution=6)
    np.testing.assert_allclose(fast.error, slow.error, rtol=1e-4)
    weight = jnp.array([0.2, 0.5, 0.3])
    view, other = (each.at(weight).terms for each in (fast, slow))
    both = [np.einsum("kxyl,kuvl->xyuv", each.light_map, each.view_map, optimize=True) for each in (view, other)]
    assert relative(*both) < 1e-4


def test_sets_of_unlike_functions_are_factored_one_by_one(pairs):
    mixed = [lobe_of(0.4), BlinnPhong(diffuse=0.0, specular=0.5, exponent=20.0), lambda wi, wo: 0 * wi[:, 2:] + 0.2]
    table = dynamic.factor(mixed, None, ranks=(3, 16, 16), resolution=16)
    assert table.brdf is None
    assert table.at(jnp.eye(3)[0]).brdf is None
    wi, wo = pairs
    assert relative(mixed_value(table, np.float32([0, 0, 1]), wi, wo), np.full((400, 1), 0.2)) < 0.011


def test_colors_of_a_set_are_members_of_their_own(pairs):
    colored = [Lambert([0.9, 0.3, 0.1]), Lambert([0.2, 0.2, 0.8])]
    table = dynamic.factor(colored, None, ranks=(2, 1, 1), resolution=RESOLUTION)
    assert table.factor.shape == (2, 3, 2)
    wi, wo = pairs
    found = mixed_value(table, jnp.array([0.5, 0.5]), wi, wo)
    np.testing.assert_allclose(found, np.broadcast_to(np.array([0.55, 0.25, 0.45]) / np.pi, found.shape), rtol=0.025)


def test_lobes_alone_take_more_directions_than_a_block_has(lobes, pairs, monkeypatch):
    member = dynamic.factor(SET, lobes).at(jnp.array([0.2, 0.3, 0.5]))
    whole = value(member, *pairs)
    monkeypatch.setattr(separable.factorization, "_BLOCK", 8)  # Of 2,048 directions otherwise.
    np.testing.assert_allclose(value(member, *pairs[:, :37]), whole[:37], rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("count", [1, 2])
def test_weights_of_another_number_of_brdfs_are_refused(lobes, count, unchecked):
    """One weight would else count for all."""
    with pytest.raises(ValueError, match=rf"weights must be one for each of 3 BRDFs, got \[{count}\]"):
        dynamic.factor(SET, lobes).at(jnp.ones(count))
    with pytest.raises(ValueError, match=rf"weights must be one for each of 3 BRDFs, got \[{count}\]"):
        lobe.table.mean(lobes, jnp.ones(count))
    with pytest.raises(ValueError, match=rf"weights must be one for each of 3 BRDFs, got \[{count}\]"):
        bounces.functions.weights(jnp.ones((3, 1, 2)), jnp.ones(count), jnp.ones(1), jnp.ones(1))


def test_weights_of_either_sign_are_finite(lobes, pairs):
    assert np.isfinite(mixed_value(dynamic.factor(SET, lobes), jnp.array([-1.0, 1.0, 1.0]), *pairs)).all()


@pytest.mark.parametrize("brdfs", [SET[0], dynamic.factor])
def test_what_is_no_sequence_is_refused(brdfs, unchecked):
    with pytest.raises(TypeError, match="must be a sequence of BRDFs"):
        dynamic.separate(brdfs)
    with pytest.raises(TypeError, match="must be a sequence of BRDFs"):
        dynamic.factor(brdfs, None, ranks=(1, 1, 1))


@pytest.mark.parametrize("ranks", [(2.0, 1, 1), (1, 1)])
def test_ranks_that_are_not_three_whole_numbers_are_refused(ranks, unchecked):
    with pytest.raises(ValueError, match=r"three whole numbers, from 1 to the tensor's size \(3, 52, 625"):
        dynamic.factor(SET, None, ranks=ranks, resolution=8)


def test_derivatives_by_weights(lobes, pairs):
    table = dynamic.factor(SET, lobes, ranks=(2, 4, 4), resolution=RESOLUTION)
    wi, wo = pairs

    @jax.jit
    def total(weight):
        return jnp.mean(table.at(weight)(wi, wo))

    weight, step = np.float32([0.5, 0.3, 0.2]), np.float32([0.02, -0.02, 0.0])
    slope = np.asarray(jax.grad(total)(weight)) @ step
    np.testing.assert_allclose(slope, (total(weight + step) - total(weight - step)) / 2, rtol=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda _: dynamic.factor([], None, ranks=(1, 1, 1)), "at least one, got none"),
        (lambda _: dynamic.separate([]), "at least one, got none"),
        (lambda _: dynamic.factor(SET, None), "lobes, or ranks of a tensor"),
        (lambda each: dynamic.factor(SET[:2], each), "made for the 2 BRDFs"),
        (lambda _: dynamic.factor(SET, None, ranks=(4, 1, 1), resolution=8), r"from 1 to the tensor's size \(3, "),
        (lambda _: dynamic.factor(SET, None, ranks=(0, 1, 1), resolution=8), "from 1"),
        (lambda _: dynamic.factor(SET, None, ranks=(1, 1, 1), resolution=2), "resolution must be at least 4"),
        (lambda _: dynamic.factor(SET, None, ranks=(1, 1, 1), resolution=0), "resolution must be at least 4"),
        (lambda _: dynamic.factor([SET[0], Lambert([1.0, 0, 0])], None, ranks=(1, 1, 1)), r"\[b 1\], or all to"),
        (
            lambda _: dynamic.factor([SET[0], lambda wi, wo: -wi[:, 2:]], None, ranks=(1, 1, 1), resolution=8),
            "1 of 2 BRDFs that are not, the first is number 1",
        ),
        (
            lambda each: dynamic.separate(
                [Lambert(0.1), SET[0]],
                separator=lambda brdf: eqx.tree_at(lambda x: x.knot, each, each.knot[: isinstance(brdf, CookTorrance)]),
            ),
            "all isotropic or none, got anisotropic, isotropic",
        ),
    ],
)
def test_what_cannot_be_a_set_is_refused(lobes, make, message):
    with pytest.raises(ValueError, match=message):
        make(lobes)
