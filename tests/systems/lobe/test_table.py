"""BRDFs as tables of lobes: their errors, energy, frames and parameters."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from jaxprt import lobe
from jaxprt.brdf import AshikhminShirley, CookTorrance, Lambert, MetallicRoughness
from jaxprt.sphere import hemisphere
from tests.upper import directions, upper

RESOLUTION = 8
EM = 1e-2  # Rounding in another order, through seventy steps that do not converge.
SMOOTHED = 0.05  # Rounds of EM also average with the lobes of the neighboring knots.
DIFFERENCE = 2e-2  # Central differences in float32 of what varies over a tenth of a radian.

GLOSSY = CookTorrance(diffuse=0.2, specular=0.5, roughness=0.2)
COLORED = AshikhminShirley(diffuse=[0.5, 0.2, 0.1], specular=[0.2, 0.4, 0.6], nu=10.0, nv=100.0)
ROUGHNESS = np.array([0.1, 0.2, 0.4])


@jax.jit
def value(table, wi, wo):
    return table(wi, wo)


@jax.jit
def looked_up(table, wo):
    """Lobes for some views."""
    return table.lookup(wo)


@jax.jit
def chosen(table, *parameter):
    """The table for given parameters."""
    return table.at(*parameter)


@jax.jit
def outcome(table, vector):
    """Something smooth of all that a lookup gives, for a vector that need not be a unit one."""
    wo = vector / jnp.linalg.norm(vector)
    found = table.lookup(wo[None])
    along = jnp.tensordot(jnp.array([0.3, -0.5, 0.8]), found.mean, 1)
    return jnp.sum(found.weight * (2 + along) * jnp.log(found.concentration)) + jnp.sum(found.diffuse)


@pytest.fixture(scope="module", autouse=True)
def fewer():
    """A quarter of the samples; the program holds the numbers that it was compiled with."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lobe.em, "RINGS", 32)
        patch.setattr(lobe.em, "SECTORS", 48)
        for program in (lobe.em.samples, lobe.table._natural_error):
            program.clear_cache()
        yield
    for program in (lobe.em.samples, lobe.table._natural_error):
        program.clear_cache()


outcome_slope = jax.jit(jax.grad(outcome, argnums=1))


@pytest.fixture(scope="module")
def quick():
    """Tables without the error, which costs more than the rest and is tested by itself."""

    @functools.cache
    def make(name, lobes=2, resolution=RESOLUTION):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
            knot = (ROUGHNESS,) if name == "varying" else ()
            return lobe.tabulate(BRDF[name], lobes=lobes, resolution=resolution, knot=knot)

    return make


@pytest.fixture(scope="module")
def told():
    """Tables with their errors."""
    return functools.lru_cache(maxsize=None)(lambda **options: lobe.tabulate(GLOSSY, resolution=RESOLUTION, **options))


def gold(wi, wo):
    return GLOSSY(wi, wo) * jnp.array([1.0, 0.6, 0.2])


BRDF = {
    "glossy": GLOSSY,
    "anisotropic": COLORED,
    "matte": Lambert(0.5),
    "gold": gold,
    "bright": CookTorrance(diffuse=20.0, specular=50.0, roughness=0.2),
    "varying": lambda roughness: CookTorrance(diffuse=0.2, specular=0.5, roughness=roughness),
    **{f"rough {r}": CookTorrance(diffuse=0.2, specular=0.5, roughness=r) for r in ROUGHNESS},
}


def test_errors_are_small_and_fall_with_the_lobes(told):
    error = [float(told(**options).error) for options in ({"error": 0.05}, {"lobes": 4})]
    assert 0 < error[1] < 0.8 * error[0] < 0.8 * 0.05
    assert told(lobes=4).lobes == 4


def test_an_error_to_be_reached_chooses_the_fewest_lobes(told, quick, close):
    table = told(error=0.05)
    assert table.lobes == 2
    for name in ("mean", "scale", "weight", "diffuse"):
        close(getattr(table, name), getattr(quick("glossy"), name))


def test_an_error_out_of_reach_is_refused_and_the_best_named(told, monkeypatch):
    monkeypatch.setattr(lobe.table, "_COUNTS", (2,))
    best = f"{float(told(error=0.05).error):.3g}"
    with pytest.raises(ValueError, match=f"error must be at least {best}, which 2 lobes reach; got 1e-05"):
        lobe.tabulate(GLOSSY, error=1e-5, resolution=RESOLUTION)


def test_the_tail_of_a_sharp_metal_is_not_diffuse():
    metal = MetallicRoughness([0.8, 0.6, 0.4], metallic=1.0, roughness=0.05**0.5)  # GGX, alpha = .05
    table = lobe.tabulate(metal, lobes=12)
    tilt = np.radians([0.0, 30.0, 60.0])
    wo = jnp.asarray(np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], -1), jnp.float32)
    # Farther than 60 degrees from the mirror direction are .3 to .4 % of the light. With lobes of like widths alone the
    # diffuse albedo is .04 to .06.
    diffuse = jax.jit(lambda table, wo: table.lookup(wo).diffuse)(table, wo)
    assert np.all(diffuse[0] < 0.02)


def test_diffuse_brdfs_have_nearly_no_error_and_the_albedo():
    table = lobe.tabulate(CookTorrance(diffuse=0.5, specular=0.0, roughness=0.2), lobes=2, resolution=RESOLUTION)
    assert float(table.error) < 0.01
    np.testing.assert_allclose(table.diffuse, 0.5, atol=0.03)


def test_tables_resemble_the_brdf_times_cosine(told):
    wi, wo = upper(0, 1000), upper(1, 1000, least=0.3)
    exact = np.asarray(value(GLOSSY, wi, wo)) * np.asarray(wi)[:, 2:]
    tables = told(error=0.05), told(lobes=4)
    error = [np.linalg.norm(value(each, wi, wo) - exact) / np.linalg.norm(exact) for each in tables]
    assert error[1] < 0.8 * error[0]
    assert error[1] < 0.12  # Point by point; under natural light it is the table's error, much less.


def test_isotropic_tables_are_over_the_view_angle_and_turn_with_the_view(quick, close):
    table = quick("glossy")
    assert table.isotropic
    assert table.mean.shape == (3, 2, RESOLUTION)
    assert table.nbytes == (3 + 1 + 1) * 2 * RESOLUTION * 4 + RESOLUTION * 4
    wi, wo, angle = np.asarray(upper(3, 300)), np.asarray(upper(4, 300)), 2.1
    turn = np.float32([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    close(
        value(table, wi @ turn.T, wo @ turn.T), value(table, wi, wo), tolerance=1e-4
    )  # Float32, times the sharpness of lobes.


def test_at_the_normal_lobes_are_those_next_to_it(quick, close):
    wi, zero = upper(5, 300), np.zeros((300, 1), np.float32)
    table = quick("glossy", lobes=4)
    at, near = (value(table, wi, np.concatenate([zero + np.float32(x), zero, zero + 1], 1)) for x in (0, 2e-6))
    close(at, near, tolerance=1e-4)


def test_anisotropic_tables_are_maps(quick, close):
    table = quick("anisotropic")
    assert not table.isotropic
    assert table.mean.shape == (3, 2, 4, 4)
    assert table.weight.shape == (3, 2, 4, 4)
    row, column = np.array([[1, 2, 0, 1], [1, 2, 1, 3]])
    found = looked_up(table, np.asarray(hemisphere.parabolic_texel_direction(resolution=4))[row, column])
    close(found.weight, np.asarray(table.weight)[:, :, row, column])
    close(np.log(found.concentration), np.asarray(table.scale)[:, row, column])


def test_gray_brdfs_have_one_weight_and_colored_ones_one_per_color(quick, close):
    gray, colored = quick("glossy"), quick("gold")
    assert gray.weight.shape[0] == gray.diffuse.shape[0] == 1
    assert colored.weight.shape[0] == colored.diffuse.shape[0] == 3
    color = np.array([1.0, 0.6, 0.2], np.float32)[:, None]
    close(colored.weight, np.asarray(gray.weight) * color[..., None], tolerance=EM)
    close(colored.diffuse, np.asarray(gray.diffuse) * color, tolerance=EM)


def test_brighter_brdfs_have_weights_as_much_larger(quick, close):
    dark, bright = quick("glossy"), quick("bright")
    close(bright.weight, 100 * np.asarray(dark.weight), tolerance=EM)
    close(bright.diffuse, 100 * np.asarray(dark.diffuse), tolerance=EM)
    close(bright.mean, dark.mean, tolerance=EM)
    close(bright.scale, dark.scale, tolerance=EM)


@pytest.mark.parametrize("shape", [(), (7,), (2, 3), (0,)])
def test_values_come_in_any_batch(quick, close, shape):
    table = quick("gold")
    count = int(np.prod(shape))
    wi, wo = (np.asarray(upper(seed, 7)) for seed in (9, 10))
    actual = value(table, *(each[:count].reshape(*shape, 3) for each in (wi, wo)))
    assert actual.shape == (*shape, 3)
    found = jax.tree.map(np.asarray, looked_up(table, wo))
    each = [
        sum(
            found.weight[:, l, v] * scipy.stats.vonmises_fisher(m / np.linalg.norm(m), k).pdf(w)
            for l, (m, k) in enumerate(
                zip(found.mean[:, :, v].T.astype(float), found.concentration[:, v].astype(float), strict=True)
            )
        )
        + found.diffuse[:, v] * w[2] / np.pi
        for v, w in enumerate(wi[:count].astype(float))
    ]
    # Sharp lobes, in float32.
    close(np.asarray(actual).reshape(-1, 3), np.array(each).reshape(-1, 3), tolerance=1e-4)


def test_knots_have_the_tables_of_their_brdfs_but_for_the_smoothing_between_knots(quick, close):
    varying = quick("varying", resolution=4)
    assert varying.mean.shape == (3, 2, 3, 4)
    assert varying.isotropic
    close(varying.knot[0], ROUGHNESS)
    for number, roughness in enumerate(ROUGHNESS[:2]):
        single = quick(f"rough {roughness}", resolution=4)
        found = chosen(varying, np.float32(roughness))
        assert found.knot == ()
        close(np.asarray(varying.mean)[:, :, number], single.mean, tolerance=SMOOTHED)
        close(found.weight, single.weight, tolerance=SMOOTHED)
        close(found.scale, single.scale, tolerance=SMOOTHED)
        close(found.mean, single.mean, tolerance=SMOOTHED)
        close(found.diffuse, single.diffuse, tolerance=SMOOTHED)


def test_weights_are_linear_between_knots_and_places_means_by_weight_and_both_clamped_outside(quick, close):
    varying = quick("varying", resolution=4)
    for place, low, high in ((0.15, 0, 0.5), (0.25, 1, 0.25), (0.4, 1, 1), (0.0, 0, 0), (7.0, 1, 1), (np.inf, 1, 1)):
        found = chosen(varying, np.float32(place))
        part = np.array([1 - high, high])[:, None]
        weight = np.asarray(varying.weight)[:, :, low : low + 2]
        close(found.weight, np.sum(weight * part, 2))
        close(found.diffuse, np.sum(np.asarray(varying.diffuse)[:, low : low + 2] * part, 1))
        # Places and widths are means by weight.
        power = np.sum(weight, 0) * part
        power = power / power.sum(1, keepdims=True)
        close(found.mean, np.sum(np.asarray(varying.mean)[:, :, low : low + 2] * power, 2))
        close(found.scale, np.sum(np.asarray(varying.scale)[:, low : low + 2] * power, 1))
    wi, wo = upper(11, 200), upper(12, 200, least=0.3)
    sharp, middle, wide = (
        np.asarray(looked_up(chosen(varying, np.float32(r)), wo).concentration) for r in (0.2, 0.3, 0.4)
    )
    assert np.all((wide - middle) * (sharp - middle) < 0)
    assert np.isfinite(np.asarray(value(chosen(varying, np.float32(0.3)), wi, wo))).all()


def test_lobes_without_light_have_no_say_between_knots(quick):
    varying = quick("varying", resolution=4)
    weight, (low, high) = np.array(varying.weight), ROUGHNESS[:2]
    weight[:, :, 1] = 0
    dark = eqx.tree_at(lambda x: x.weight, varying, jnp.asarray(weight))
    found = chosen(dark, np.float32(low * 0.4 + high * 0.6))
    np.testing.assert_allclose(found.mean, np.asarray(varying.mean)[:, :, 0], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.weight, 0.4 * weight[:, :, 0], rtol=1e-4)


def test_two_parameters_have_two_axes_and_gray_knots_share_the_colors(quick, close, monkeypatch):
    monkeypatch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
    table = lobe.tabulate(
        lambda bright, tint: Lambert(bright) if tint < 0.5 else Lambert(bright * jnp.array([1.0, 0.5, 0.1])),
        lobes=2,
        resolution=4,
        knot=(np.array([0.4, 0.8]), np.array([0.0, 1.0])),
    )
    assert table.weight.shape == (3, 2, 2, 2, 4)
    albedo = chosen(table, np.float32(0.6), np.float32(0.5))
    close(np.sum(albedo.weight, 1) + albedo.diffuse, np.outer([0.6, 0.45, 0.33], np.ones(4)), tolerance=5e-3)


@pytest.mark.parametrize("polar", [(0.4, 0.7), (0.9, -2.0), (1.2, 3.0)])
@pytest.mark.parametrize("name", ["glossy", "anisotropic"])
def test_gradients_in_the_view_are_finite_differences(quick, name, polar):
    table, wo, step = quick(name), np.asarray(directions(polar))[0], np.float32(1e-3)
    axes = np.eye(3, dtype=np.float32)
    expected = [
        (float(outcome(table, wo + step * axis)) - float(outcome(table, wo - step * axis))) / 2e-3 for axis in axes
    ]
    gradient = outcome_slope(table, wo)
    np.testing.assert_allclose(gradient, expected, atol=DIFFERENCE * np.linalg.norm(expected))


@pytest.mark.parametrize("name", ["glossy", "anisotropic"])
def test_gradients_are_finite_at_the_normal_the_horizon_and_below(quick, name):
    view = [[0, 0, 1], [1e-7, 0, 1], [1e-5, 0, 1], [1, 0, 0], [0, 1, 1e-7], [0, 0, -1], [0.6, 0, -0.8]]
    gradient = jax.jit(jax.vmap(jax.grad(outcome, argnums=1), (None, 0)))(quick(name), np.array(view, np.float32))
    assert np.isfinite(np.asarray(gradient)).all()


def test_gradients_in_the_parameter_are_finite_differences(quick):
    varying, wo = quick("varying", resolution=4), np.float32([0.48, -0.36, 0.8])
    function = jax.jit(jax.value_and_grad(lambda roughness: outcome(varying.at(roughness), wo)))
    for roughness in (0.13, 0.33):
        expected = (float(function(roughness + 2e-3)[0]) - float(function(roughness - 2e-3)[0])) / 4e-3
        np.testing.assert_allclose(function(roughness)[1], expected, rtol=DIFFERENCE)
    for roughness in (0.05, 0.1, 0.2, 0.4, 3.0):
        assert np.isfinite(function(roughness)[1])
    assert function(3.0)[1] == 0


@pytest.mark.parametrize("options", [{}, {"lobes": 2, "error": 0.1}])
def test_either_lobes_or_error_must_be_given(options):
    with pytest.raises(ValueError, match="give either lobes or error, got lobes="):
        lobe.tabulate(GLOSSY, **options)


@pytest.mark.parametrize(
    "options", [{"lobes": 0}, {"lobes": 2, "resolution": 3}, {"error": 0.0}, {"error": float("nan")}]
)
def test_options_out_of_range_are_refused(options):
    with pytest.raises(
        ValueError,
        match=r"needs at least one lobe or an error above 0, and a resolution of at least 4|error must be finite",
    ):
        lobe.tabulate(GLOSSY, **options)


@pytest.mark.parametrize("knot", [[1.0], [1.0, 1.0], [2.0, 1.0], [0.0, np.nan], [0.0, np.inf], [[0.0, 1.0]]])
def test_knots_that_do_not_increase_are_refused(knot):
    with pytest.raises(ValueError, match="knots of parameter 1 must be at least two finite increasing numbers, got"):
        lobe.tabulate(lambda a, b: Lambert(a), lobes=1, knot=(np.array([0.0, 1.0]), np.array(knot)))


def test_three_parameters_are_refused():
    with pytest.raises(ValueError, match="at most two parameters can be tabulated, got 3"):
        lobe.tabulate(lambda a, b, c: Lambert(a), lobes=1, knot=(np.array([0.0, 1.0]),) * 3)


def flat(albedo):
    """A Lambert BRDF with any albedo, even one that the model refuses."""
    return eqx.tree_at(lambda brdf: brdf.albedo, Lambert(0.5), jnp.array([albedo]))


@pytest.mark.parametrize("albedo", [-0.1, np.nan, np.inf])
def test_brdfs_that_are_negative_or_not_finite_are_refused_and_the_directions_named(albedo):
    with pytest.raises(
        ValueError, match=r"finite and not negative, got \d+ pairs .* first is wi = \[.+\], wo = \[.+\]"
    ):
        lobe.tabulate(flat(albedo), lobes=1, resolution=4)
    with pytest.raises(ValueError, match=r"not negative at parameters \(2\.0,\), got "):
        lobe.tabulate(lambda a: flat(0.5 if a < 1.5 else albedo), lobes=1, resolution=4, knot=(np.arange(3.0),))


def test_brdfs_without_an_axis_of_colors_are_refused():
    with pytest.raises(ValueError, match=r"the BRDF must return \[\d+, c\] for \d+ directions, got \[\d+\]"):
        lobe.tabulate(lambda wi, wo: jnp.maximum(wi[..., 2], 0), lobes=1, resolution=4)


def test_a_wrong_number_of_parameters_is_refused(quick):
    with pytest.raises(ValueError, match="the table needs 0 parameters, got 1"):
        quick("glossy").at(jnp.asarray(1.0))
    with pytest.raises(ValueError, match="the table needs 1 parameters, got 0"):
        quick("varying", resolution=4).at()
    with pytest.raises(ValueError, match="the table needs 1 parameters for each view, or `at` to choose"):
        quick("varying", resolution=4).lookup(upper(0, 2))
