"""The lobe system where something degenerates: nothing may become NaN, infinite or absurd."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import AshikhminShirley, BlinnPhong, CookTorrance, lobe, lobe_em
from jaxprt.brdf.published import mirror_lobes
from jaxprt.sphere import hemisphere

RESOLUTION = 8
ENERGY = 2e-3  # At nodes: another quadrature, and what the horizon cuts of a lobe.
BETWEEN = 0.03  # Between eight nodes of the view, up to 60 degrees from the normal.
GRAZING = 0.15  # At 75 degrees, where the reflectance grows fourfold from one node to the next.

BRDF = {
    "sharp": CookTorrance(diffuse=0.2, specular=0.5, roughness=0.01),
    "rough": CookTorrance(diffuse=0.2, specular=0.5, roughness=1.0),
    "diffuse": CookTorrance(diffuse=0.5, specular=0.0),
    "mirror": CookTorrance(diffuse=0.0, specular=0.5, roughness=0.001),
    "zero": CookTorrance(diffuse=0.0, specular=0.0),
    "power": BlinnPhong(diffuse=0.1, specular=0.6, exponent=1e4),
    "flat": BlinnPhong(diffuse=0.1, specular=0.6, exponent=0.0),
    "fresnel": AshikhminShirley(diffuse=0.3, specular=0.4, nu=1e4, nv=1e4),
    "brushed": AshikhminShirley(diffuse=0.3, specular=0.4, nu=10.0, nv=1e4),
}
EXTREME = jnp.array(
    [[0, 0, 1], [1e-30, 0, 1], [0, 1e-6, 1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 1e-7], [0.8, 0.6, 1e-30], [0, 0, -1]],
    jnp.float32,
)


@pytest.fixture(scope="module")
def tables():
    """Tables without the error, which is tested by itself."""

    @functools.cache
    def make(name):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(lobe, "_natural_error", lambda brdf, table: 0.0)
            return lobe.tabulate(BRDF[name], lobes=2, resolution=RESOLUTION)

    return make


def view(*angle):
    return jnp.asarray(np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], -1), jnp.float32)


@jax.jit
def energies(brdf, table, wo):
    """Integrals of the BRDF times cosine, and of the table, by a quadrature other than the one of the fit."""

    def one(wo):
        wi, area = hemisphere.arcs(lobe_em.mirror(wo), rings=80, sectors=128)
        wo = jnp.broadcast_to(wo, wi.shape)
        return area @ (brdf(wi, wo) * wi[:, 2:]), area @ table(wi, wo)

    return jax.lax.map(one, wo)


@jax.jit
def value(brdf, wi, wo):
    return brdf(wi, wo)


@pytest.mark.parametrize("name", BRDF)
def test_tables_are_finite_in_range_and_no_brighter_than_the_brdf(tables, name):
    table = tables(name)
    assert table.isotropic == (name != "brushed")
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(table))
    assert jnp.min(table.weight) >= 0
    assert jnp.min(table.diffuse) >= 0
    assert jnp.max(jnp.sum(table.weight, 1) + table.diffuse) < 2
    assert jnp.min(table.scale) >= 0
    assert jnp.max(table.scale) < np.log(1.01 * lobe_em.FINEST)
    np.testing.assert_allclose(jnp.linalg.norm(table.mean, axis=0), 1, rtol=1e-5)


@pytest.mark.parametrize("name", [name for name in BRDF if name != "brushed"])
def test_energy_is_kept_at_nodes_and_nearly_between(tables, name):
    node = view(*(2 * np.arctan(np.linspace(0, 1, RESOLUTION)[:-1])))
    exact, actual = energies(BRDF[name], tables(name), node)
    np.testing.assert_allclose(actual, exact, rtol=ENERGY, atol=1e-6)
    exact, actual = energies(BRDF[name], tables(name), view(0.1, 0.4, 0.7, 1.0, 1.3))
    np.testing.assert_allclose(actual[:-1], exact[:-1], rtol=BETWEEN, atol=1e-6)
    np.testing.assert_allclose(actual[-1], exact[-1], rtol=GRAZING, atol=1e-6)


def test_energy_of_brushed_metal_is_kept_at_nodes(tables):
    texel = hemisphere.parabolic_texel_direction(resolution=RESOLUTION // 2)[1:3, 1:3].reshape(-1, 3)
    exact, actual = energies(BRDF["brushed"], tables("brushed"), texel)
    np.testing.assert_allclose(actual, exact, rtol=ENERGY)


@pytest.mark.parametrize("name", BRDF)
def test_views_at_the_normal_and_at_the_horizon_are_finite(tables, name):
    table = tables(name)
    found = table.lookup(EXTREME)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(found))
    np.testing.assert_allclose(jnp.linalg.norm(found.mean, axis=0), 1, rtol=1e-5)
    wi, wo = (jnp.asarray(each) for each in (np.repeat(EXTREME, len(EXTREME), 0), np.tile(EXTREME, (len(EXTREME), 1))))
    lit = np.asarray((wi[:, 2] > 0) & (wo[:, 2] > 0))
    for brdf in (table, lobe.Remainder(BRDF[name], table)):
        assert np.isfinite(np.asarray(value(brdf, wi, wo))).all()
    actual = np.asarray(value(table, wi, wo))
    assert np.all(actual >= 0)
    np.testing.assert_array_equal(actual[~lit], 0)
    gradient = jax.vmap(jax.grad(lambda wo: jnp.sum(table.lookup(wo[None]).weight)))(EXTREME)
    assert np.isfinite(np.asarray(gradient)).all()


def test_a_brdf_of_zero_has_no_weight_and_no_error():
    table = lobe.tabulate(BRDF["zero"], error=1e-6, resolution=RESOLUTION)
    assert table.lobes == 2
    assert table.error == 0
    np.testing.assert_array_equal(table.weight, 0)
    np.testing.assert_array_equal(table.diffuse, 0)


def test_what_is_diffuse_is_nearly_all_in_the_diffuse_part(tables):
    assert np.min(tables("diffuse").diffuse) > 0.95 * 0.5


def test_a_mirror_has_no_diffuse_part_and_its_lobes_are_the_finest_in_its_direction(tables):
    table, wo = tables("mirror"), view(0.0, 0.5, 1.0)
    np.testing.assert_allclose(table.diffuse, 0, atol=1e-4)
    np.testing.assert_allclose(jnp.exp(table.scale), lobe_em.FINEST, rtol=1e-3)
    mean = jnp.sum(table.lookup(wo).mean * table.lookup(wo).weight, 1) / jnp.sum(table.lookup(wo).weight, 1)
    # Between nodes a mean is on the chord, of 20 degrees, not on the arc.
    np.testing.assert_allclose(mean.T, lobe_em.mirror(wo), atol=0.01)


@pytest.mark.parametrize(("name", "share"), [("zero", 0), ("mirror", 1)])
def test_published_lobes_of_a_mirror_are_the_sharpest_and_of_nothing_nothing(name, share):
    table = mirror_lobes(BRDF[name], resolution=RESOLUTION)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in (table.mean, table.scale, table.weight))
    whole = np.sum(table.weight[0], 0)
    np.testing.assert_allclose(table.weight[0, 0], whole, rtol=0.01)
    assert np.all((whole > 0) == share)
