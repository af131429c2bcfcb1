"""The product table of a BRDF times cosine: closed forms, independent quadrature, lookup by SciPy, and its errors."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.ndimage

from jaxprt import harmonic
from jaxprt.brdf import AshikhminShirley, CookTorrance, Lambert, Phong
from jaxprt.sphere import harmonics, hemisphere
from jaxprt.systems.harmonic import HarmonicBrdf, tabulate
from jaxprt.systems.harmonic.table import project

RESOLUTION = 16
QUADRATURE = 1e-4  # What the independent quadrature is accurate to, where the horizon cuts it.
NODES = 240  # In each direction of the independent quadrature.
LOOKUP = 2e-5  # Coordinates of a texel in float32, times the sixteen texels between which they tell.
COLORED = AshikhminShirley(diffuse=[0.5, 0.2, 0.1], specular=[0.2, 0.4, 0.6], nu=10.0, nv=100.0)


@pytest.fixture
def random():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def table(tables):
    return tables("anisotropic")


def upper(random, *shape, least=0.0):
    """Unit vectors at least so high above the horizon."""
    height, angle = random.uniform(least, 1, shape), random.uniform(0, 2 * np.pi, shape)
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1).astype(np.float32)


@jax.jit
def value(table, wi, wo):
    return table(wi, wo)


@jax.jit
def looked_up(table, wo, *parameter):
    return table.coefficients(wo, *parameter)


@pytest.fixture(scope="module", autouse=True)
def fewer():
    """A third of the views at which errors are measured."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(harmonic.table, "_PROBES", 16)
        yield


@jax.jit
def by_half_vectors(brdf, view):
    """Coefficients by a quadrature over half vectors, in float64: d wi = 4 (wo.h) dh; [lm, c, v]."""
    node, weight = np.polynomial.legendre.leggauss(NODES)
    t = (node + 1) / 2
    drop, weight = t**4, 2 * t**3 * weight  # 1 - cos(theta_h), crowded around the normal
    angle = 2 * np.pi * (np.arange(NODES) + 0.5) / NODES
    radius = np.sqrt(drop * (2 - drop))
    half = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle)), np.outer(1 - drop, angle**0)])
    weight = np.repeat(weight * 2 * np.pi / NODES, NODES)

    def one(wo):
        axis = jnp.asarray(half.reshape(3, -1).T)
        cosine = axis @ wo
        wi = 2 * cosine[:, None] * axis - wo
        area = weight * 4 * jnp.maximum(cosine, 0) * jnp.maximum(wi[:, 2], 0)
        return harmonics.evaluate(wi, degree=4).T @ (brdf(wi, jnp.broadcast_to(wo, wi.shape)) * area[:, None])

    return jnp.moveaxis(jax.lax.map(one, view), 0, -1)


@pytest.fixture(scope="module")
def tables():
    return functools.lru_cache(maxsize=None)(lambda name: tabulate(SHARPNESS[name], resolution=RESOLUTION))


def test_lambert_is_the_cosine_kernel_in_closed_form(tables):
    table = tables("matte")
    expected = np.zeros(25)
    expected[[0, 2, 6, 20]] = np.sqrt(np.pi) / 2, np.sqrt(np.pi / 3), np.sqrt(5 * np.pi) / 8, -np.sqrt(np.pi) / 16
    expected = expected[:, None, None] / np.pi * np.array([1, 0.5, 0])[:, None] * np.ones(RESOLUTION)
    error = np.linalg.norm(table.table - expected, axis=(0, 1)) / np.linalg.norm(expected[..., 0])
    assert error.max() < 1e-3
    assert float(table.error) < 2e-4
    assert table.degree == 4
    assert table.isotropic
    assert table.nbytes == 25 * 3 * RESOLUTION * 4


SHARPNESS = {
    "matte": Lambert([1.0, 0.5, 0.0]),
    "glossy": Phong(diffuse=0.2, specular=0.6, exponent=20.0),
    "anisotropic": COLORED,
    "sharp": CookTorrance(diffuse=0.1, specular=0.6, roughness=0.05),
}


def texels(table):
    """Five nodes of a table, and their views in float64."""
    if table.isotropic:
        node = np.array([0, 3, 7, 11, 14])
        radius = node / (RESOLUTION - 1) * (1 - 0.25 / RESOLUTION)
        view = np.stack([2 * radius, 0 * radius, 1 - radius**2], -1) / (1 + radius**2)[:, None]
        return np.asarray(table.table)[..., node], view
    row, column = np.array([[8, 8], [5, 10], [12, 6], [9, 14], [1, 7]]).T
    view = np.asarray(hemisphere.parabolic_texel_direction(resolution=RESOLUTION), float)[row, column]
    return np.asarray(table.table)[..., row, column], view


@pytest.mark.parametrize("name", SHARPNESS)
def test_tables_agree_with_another_quadrature_at_nodes_and_between_them_as_well_as_they_say(tables, random, name):
    table = tables(name)
    actual, node = texels(table)
    height, angle = (np.arange(16) + random.uniform(size=16)) / 16, random.uniform(0, 2 * np.pi, 16)
    radius = np.sqrt(1 - height**2)
    between = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], -1)
    with jax.enable_x64(True):
        brdf = jax.tree.map(lambda leaf: np.asarray(leaf, float), SHARPNESS[name])
        expected = np.asarray(by_half_vectors(brdf, np.concatenate([node, between])))
    single = np.linalg.norm(actual - expected[..., :5], axis=(0, 1)) / np.linalg.norm(expected[..., :5], axis=(0, 1))
    assert single.max() < 2e-3 + QUADRATURE, f"{single}"
    found, expected = np.asarray(looked_up(table, between.astype(np.float32))), expected[..., 5:]
    missed = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    said = float(table.error)
    assert missed < 1.5 * said + QUADRATURE, f"{missed:.2e}, said {said:.2e}"
    assert said < 2 * missed + QUADRATURE, f"{missed:.2e}, said {said:.2e}"


def test_sizes_are_chosen_by_the_error_and_a_missed_error_warns_and_is_told(tables):
    table = tabulate(SHARPNESS["glossy"])
    assert 16 < table.table.shape[-1] <= 96
    assert float(table.error) <= 1e-3 < float(tables("glossy").error)
    with pytest.warns(UserWarning, match=r"must be at most 0.001, got 0.0\d+: give a resolution above 16"):
        short = tabulate(COLORED, error=1e-3, resolution=RESOLUTION)
    assert float(short.error) == float(tables("anisotropic").error) > 1e-2
    assert tabulate(COLORED, error=0.1).table.shape == short.table.shape


def test_the_error_of_a_brdf_that_varies_counts_parameters_between_knots():
    def made(exponent):
        return Phong(diffuse=0.0, specular=0.6, exponent=exponent)

    with pytest.warns(UserWarning, match="give knots that are closer to each other"):
        table = tabulate(made, degree=1, error=1e-2, knot=(np.array([2.0, 50.0]),))
    view = np.random.default_rng(2).normal(size=(48, 3))
    view = np.abs(view / np.linalg.norm(view, axis=1, keepdims=True)).astype(np.float32)
    exact = project(made(jnp.asarray(26.0)), view, degree=1, rings=32, sectors=160)
    missed = np.linalg.norm(looked_up(table, view, np.full(48, 26.0, np.float32)) - exact) / np.linalg.norm(exact)
    np.testing.assert_allclose(table.error, missed, rtol=0.3)


def test_a_brdf_that_is_anisotropic_at_one_pair_of_parameters_has_maps():
    options = {"degree": 0, "resolution": 4, "knot": (np.array([1.0, 30.0]),) * 2}
    assert not tabulate(lambda nu, nv: AshikhminShirley(diffuse=0.0, nu=nu, nv=nv), **options).isotropic
    assert tabulate(lambda nu, nv: AshikhminShirley(diffuse=nu / 90, nu=nv, nv=nv), **options).isotropic


def test_gradients_of_an_isotropic_table_are_those_of_finite_differences_at_the_normal_too(x64, random):
    value = random.normal(size=(9, 1, 5))
    value[[1, 3, 4, 5, 7, 8], :, 0] = 0  # All orders but m = 0 vanish at the normal.
    table = HarmonicBrdf(jnp.asarray(value), (), jnp.zeros(()))
    weight = jnp.asarray(random.normal(size=9))

    @jax.jit
    def along(x, y, turn):
        place = jnp.stack([x, y, jnp.sqrt(1 - x**2 - y**2)])
        return weight @ table.coefficients((turn @ place)[None])[:, 0, 0]

    slope = jax.jit(jax.grad(along, (0, 1)))
    for turn in (np.eye(3), np.array([[0.6, 0, 0.8], [0, 1, 0], [-0.8, 0, 0.6]])):
        gradient = slope(0.0, 0.0, turn)
        step = 1e-4
        numeric = [
            (along(step, 0.0, turn) - along(-step, 0.0, turn)) / (2 * step),
            (along(0.0, step, turn) - along(0.0, -step, turn)) / (2 * step),
        ]
        np.testing.assert_allclose(gradient, numeric, rtol=1e-6)


def test_an_error_that_no_rule_reaches_is_told():
    mirror = CookTorrance(diffuse=0.0, specular=1.0, roughness=0.001)
    with pytest.warns(UserWarning, match="the BRDF is too sharp for the finest quadrature"):
        table = tabulate(mirror, degree=0, resolution=2, error=1e-9)
    assert 1e-9 < float(table.error) < 1


def test_lookup_between_texels_is_bilinear(table, random):
    view = upper(random, 300, least=1e-3)
    place = (np.asarray(view, float)[:, :2] / (1 + np.asarray(view, float)[:, 2:]) + 1) / 2 * RESOLUTION - 0.5
    flat = np.asarray(table.table, float).reshape(75, RESOLUTION, RESOLUTION)
    expected = [scipy.ndimage.map_coordinates(each, place[:, ::-1].T, order=1, mode="nearest") for each in flat]
    actual = np.asarray(looked_up(table, view)).reshape(75, -1)
    assert np.linalg.norm(actual - np.array(expected)) < LOOKUP * np.linalg.norm(expected)


def test_views_below_the_horizon_and_on_it_see_nothing_and_gradients_are_finite(table):
    view = np.float32([[0.6, 0, -0.8], [0, 0, -1], [1, 0, 0], [0, 1, -1e-7], [0, 0, 1], [0, 1, 1e-7]])
    found = np.asarray(looked_up(table, view))
    np.testing.assert_array_equal(found[..., :4], 0)
    assert np.all(np.linalg.norm(found[..., 4:], axis=(0, 1)) > 0.01)
    gradient = jax.jit(jax.grad(lambda v: jnp.sum(table.coefficients(v) ** 2)))(view)
    assert np.isfinite(np.asarray(gradient)).all()


def test_values_are_the_sum_of_coefficients_times_harmonics_for_any_batch(table, random, close):
    wi, wo = upper(random, 2, 3), upper(random, 2, 3, least=0.1)
    found = np.asarray(value(table, wi, wo))
    assert found.shape == (2, 3, 3)
    wi, wo = (each.reshape(6, 3) for each in (wi, wo))
    row, basis = np.asarray(looked_up(table, wo)), np.asarray(harmonics.evaluate(wi, degree=4))
    expected = [row[:, :, n].T @ basis[n] for n in range(found.size // 3)]
    close(found.reshape(-1, 3), np.reshape(expected, (-1, 3)))


def test_more_bands_carry_more_of_the_brdf(tables, random):
    table = tables("glossy")
    texel = np.asarray(hemisphere.parabolic_texel_direction(resolution=RESOLUTION))[4:12, 4:12].reshape(-1, 3)
    wo = np.repeat(texel, 20, 0)
    wi = upper(random, len(wo))
    exact = value(SHARPNESS["glossy"], wi, wo) * wi[:, 2:]
    error = [np.linalg.norm(value(table.truncate(degree=n), wi, wo) - exact) / np.linalg.norm(exact) for n in (0, 2, 4)]
    assert (np.diff(error) < -0.1).all()
    assert table.truncate(degree=2).degree == 2
    np.testing.assert_array_equal(table.truncate(degree=2).table, table.table[:9])
    assert np.isnan(table.truncate(degree=2).error)
    assert table.truncate(degree=4).error == table.error
    for degree in (-1, 5):
        with pytest.raises(ValueError, match=f"degree must be between 0 and the table's 4, got {degree}"):
            table.truncate(degree=degree)


@pytest.fixture(scope="module")
def varying():
    return tabulate(
        lambda exponent, specular: Phong(diffuse=0.3, specular=specular, exponent=exponent),
        degree=1,
        resolution=6,
        knot=(np.array([2.0, 5.0, 20.0]), np.array([0.0, 0.6])),
    )


def test_knots_have_the_tables_of_their_brdfs(varying, close):
    assert varying.table.shape == (4, 1, 3, 2, 6)
    view = np.float32([[0.2, -0.3, 0.93], [0.6, 0, 0.8]])
    for i, exponent in ((0, 2.0), (2, 20.0)):
        single = tabulate(Phong(diffuse=0.3, specular=0.6, exponent=exponent), degree=1, resolution=6)
        close(np.asarray(varying.table)[:, :, i, 1], single.table, tolerance=2e-3)  # Each has a rule of its own.
        parameter = np.full(2, exponent, np.float32), np.full(2, 0.6, np.float32)
        close(looked_up(varying, view, *parameter), looked_up(single, view), tolerance=2e-3)


def test_parameters_interpolate_linearly_and_clamp_to_their_knots(varying, random, close):
    view = upper(random, 8, least=0.2)
    exponent = np.float32([2.0, 3.5, 5.0, 12.5, 20.0, 1.0, -np.inf, 1e9])
    specular = np.float32([0.0, 0.3, 0.6, 0.15, 0.45, -5.0, 0.7, np.inf])
    low, first = np.array([0, 0, 1, 1, 1, 0, 0, 1]), np.array([0, 0.5, 0, 0.5, 1, 0, 0, 1])
    second = np.array([0, 0.5, 1, 0.25, 0.75, 0, 1, 1])
    table = np.asarray(varying.table)
    every = np.array(
        [
            [looked_up(HarmonicBrdf(jnp.asarray(table[:, :, i, j]), (), varying.error), view) for j in (0, 1)]
            for i in (0, 1, 2)
        ]
    )

    def corner(i, j):
        return np.stack([every[a, j][..., n] for n, a in enumerate(i)], -1)

    expected = sum(
        corner(low + a, b) * np.where(a, first, 1 - first) * np.where(b, second, 1 - second)
        for a in (0, 1)
        for b in (0, 1)
    )
    clipped = (np.clip(each, -1e30, 1e30) for each in (exponent, specular))
    close(looked_up(varying, view, *clipped), expected)
    close(looked_up(varying, view, exponent, specular), expected)


def test_a_wrong_number_of_parameters_is_refused(table, varying):
    view = jnp.array([[0.0, 0, 1]])
    with pytest.raises(ValueError, match="the table needs 0 parameters, got 1"):
        table.coefficients(view, jnp.ones(1))
    with pytest.raises(ValueError, match="the table needs 2 parameters, got 0"):
        varying.coefficients(view)
