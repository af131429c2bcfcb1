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
    "matte": CookTorrance(diffuse=0.5, specular=0.0, roughness=0.2),
    "gold": gold,
    "bright": CookTorrance(diffuse=20.0, specular=50.0, roughness=0.2),
    "varying": lambda roughness: CookTorrance(diffuse=0.2, specular=0.5, roughness=roughness),
    **{f"rough {r}": CookTorrance(diffuse=0.2, specular=0.5, roughness=r) for r in ROUGHNESS},
}


def test_an_error_chooses_the_fewest_lobes_and_falls_with_more(told, quick, close, monkeypatch):
    tables = told(error=0.05), told(lobes=4)
    assert [table.lobes for table in tables] == [2, 4]
    error = [float(table.error) for table in tables]
    assert 0 < error[1] < 0.8 * error[0] < 0.8 * 0.05
    for name in ("mean", "scale", "weight", "diffuse"):
        close(getattr(tables[0], name), getattr(quick("glossy"), name))
    wi, wo = upper(0, 300), upper(1, 300, least=0.3)
    exact = np.asarray(value(GLOSSY, wi, wo)) * np.asarray(wi)[:, 2:]
    off = [np.linalg.norm(value(table, wi, wo) - exact) / np.linalg.norm(exact) for table in tables]
    assert off[1] < 0.8 * off[0]
    assert off[1] < 0.12  # Point by point; under natural light it is the table's error, much less.
    monkeypatch.setattr(lobe.table, "_COUNTS", (2,))
    with pytest.raises(ValueError, match=f"error must be at least {error[0]:.3g}, which 2 lobes reach; got 1e-05"):
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


@jax.jit
def far_from_the_mirror(table, brdf, wo):
    """Albedos of a table and of its BRDF farther than 45 degrees from the mirror direction."""
    wi, area = hemisphere.arcs(lobe.em.mirror(wo), rings=128, sectors=192)
    far = jnp.where(wi @ lobe.em.mirror(wo) < np.cos(np.pi / 4), area, 0)[:, None]
    wo = jnp.broadcast_to(wo, wi.shape)
    return jnp.sum(far * table(wi, wo), 0), jnp.sum(far * brdf(wi, wo) * jnp.maximum(wi[:, 2:], 0), 0)


def test_lobes_send_of_a_sharp_metal_what_is_far_from_the_mirror_direction():
    metal = MetallicRoughness(np.ones(3, np.float32), metallic=1.0, roughness=0.15)
    table = lobe.tabulate(metal, lobes=8)
    for tilt in np.radians([10.0, 40.0, 60.0]):
        # With one wide lobe of four it was four to seven times as much.
        found, exact = far_from_the_mirror(table, metal, np.float32([np.sin(tilt), 0.0, np.cos(tilt)]))
        np.testing.assert_allclose(found, exact, rtol=0.2)


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


def test_weights_are_as_many_as_the_colors_and_as_large_as_the_brdf(quick, close):
    gray, colored = quick("glossy"), quick("gold")
    assert gray.weight.shape[0] == gray.diffuse.shape[0] == 1
    assert colored.weight.shape[0] == colored.diffuse.shape[0] == 3
    color = np.array([1.0, 0.6, 0.2], np.float32)[:, None]
    close(colored.weight, np.asarray(gray.weight) * color[..., None], tolerance=EM)
    close(colored.diffuse, np.asarray(gray.diffuse) * color, tolerance=EM)
    bright = quick("bright")
    close(bright.weight, 100 * np.asarray(gray.weight), tolerance=EM)
    close(bright.diffuse, 100 * np.asarray(gray.diffuse), tolerance=EM)
    close(bright.mean, gray.mean, tolerance=EM)
    close(bright.scale, gray.scale, tolerance=EM)
    matte = quick("matte")
    np.testing.assert_allclose(matte.diffuse, 0.5, atol=0.03)


def test_values_are_sums_of_densities_by_scipy(quick, close):
    table, count = quick("gold"), 6
    wi, wo = (np.asarray(upper(seed, count)) for seed in (9, 10))
    actual = value(table, *(each.reshape(2, 3, 3) for each in (wi, wo)))
    assert actual.shape == (2, 3, 3)
    found = jax.tree.map(np.asarray, looked_up(table, wo))
    each = [
        sum(
            found.weight[:, l, v] * scipy.stats.vonmises_fisher(m / np.linalg.norm(m), k).pdf(w)
            for l, (m, k) in enumerate(
                zip(found.mean[:, :, v].T.astype(float), found.concentration[:, v].astype(float), strict=True)
            )
        )
        + found.diffuse[:, v] * w[2] / np.pi
        for v, w in enumerate(wi.astype(float))
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
    for place, low, high in ((0.15, 0, 0.5), (0.25, 1, 0.25), (0.0, 0, 0), (np.inf, 1, 1)):
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


@pytest.mark.parametrize("name", ["glossy", "anisotropic"])
def test_gradients_in_the_view_are_finite_differences(quick, name):
    table, wo, step = quick(name), np.asarray(directions((0.9, -2.0)))[0], np.float32(1e-3)
    axes = np.eye(3, dtype=np.float32)
    expected = [
        (float(outcome(table, wo + step * axis)) - float(outcome(table, wo - step * axis))) / 2e-3 for axis in axes
    ]
    gradient = outcome_slope(table, wo)
    np.testing.assert_allclose(gradient, expected, atol=DIFFERENCE * np.linalg.norm(expected))


def test_gradients_in_the_parameter_are_finite_differences(quick):
    varying, wo = quick("varying", resolution=4), np.float32([0.48, -0.36, 0.8])
    function = jax.jit(jax.value_and_grad(lambda roughness: outcome(varying.at(roughness), wo)))
    for roughness in (0.13, 0.33):
        expected = (float(function(roughness + 2e-3)[0]) - float(function(roughness - 2e-3)[0])) / 4e-3
        np.testing.assert_allclose(function(roughness)[1], expected, rtol=DIFFERENCE)
    for roughness in (0.05, 0.2, 3.0):
        assert np.isfinite(function(roughness)[1])
    assert function(3.0)[1] == 0


def test_a_wrong_number_of_parameters_is_refused(quick):
    with pytest.raises(ValueError, match="the table needs 0 parameters, got 1"):
        quick("glossy").at(jnp.asarray(1.0))
    with pytest.raises(ValueError, match="the table needs 1 parameters, got 0"):
        quick("varying", resolution=4).at()
    with pytest.raises(ValueError, match="the table needs 1 parameters for each view, or `at` to choose"):
        quick("varying", resolution=4).lookup(upper(0, 2))
