"""The published lobes against a BRDF that is such lobes; the rest of a BRDF."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published.lobes import BrdfSet, Remainder, SetMember, mirror_lobes
from jaxprt import lobe
from jaxprt.brdf import AshikhminShirley, CookTorrance
from tests.upper import directions, nodes, upper

RESOLUTION = 8
GLOSSY = CookTorrance(diffuse=0.2, specular=0.5, roughness=0.2)
COLORED = AshikhminShirley(diffuse=[0.5, 0.2, 0.1], specular=[0.2, 0.4, 0.6], nu=10.0, nv=100.0)


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


@jax.jit
def value(table, wi, wo):
    return table(wi, wo)


ANGLES = (3.0, 7.0, 21.0)


class MirrorLobes(eqx.Module):
    """A BRDF whose product with the cosine is Gaussian lobes around the mirror direction."""

    weight: jax.Array

    def __call__(self, wi, wo):
        away = jnp.sum((wi - lobe.em.mirror(wo)) ** 2, -1, keepdims=True) / 2
        k = 1 / (np.radians(np.array(ANGLES)) / 3) ** 2
        density = jnp.exp(-k * away) * (k / (2 * np.pi))
        return jnp.sum(density * self.weight, -1, keepdims=True) / jnp.maximum(wi[..., 2:], 1e-6)


def test_published_lobes_are_in_the_mirror_direction_and_have_the_given_widths():
    table = mirror_lobes(GLOSSY, angles=(0.0, 7.0, 21.0), resolution=RESOLUTION)
    expected = np.array([lobe.em.FINEST, *(1 / (np.radians([7, 21]) / 3) ** 2)])
    np.testing.assert_allclose(np.exp(table.scale), np.outer(expected, np.ones(RESOLUTION)), rtol=1e-4)
    np.testing.assert_array_equal(table.diffuse, 0)
    wo = nodes(RESOLUTION)
    found = table.lookup(wo).mean
    np.testing.assert_allclose(found, np.asarray(lobe.em.mirror(wo)).T[:, None] * np.ones((3, 3, 1)), atol=1e-6)


@pytest.mark.parametrize("weight", [[0.5, 0, 0], [0, 0.3, 0], [0.2, 0, 0.6]])
def test_published_lobes_find_a_brdf_that_is_such_lobes_also_where_the_horizon_cuts_them(weight):
    table = mirror_lobes(MirrorLobes(jnp.array(weight)), angles=ANGLES, resolution=RESOLUTION)
    # The other lobes part from these as EM goes on.
    np.testing.assert_allclose(table.weight[0], np.outer(weight, np.ones(RESOLUTION)), atol=0.01)


def test_published_lobes_of_anisotropic_brdfs_are_maps_with_colors():
    table = mirror_lobes(COLORED, resolution=8)
    assert table.weight.shape == (3, 4, 4, 4)
    assert not table.isotropic
    for angles in ((), (7.0, -1.0)):
        with pytest.raises(ValueError, match="angles must be at least one, none below 0, got"):
            mirror_lobes(GLOSSY, angles=angles)


@pytest.mark.parametrize(("specular", "glossy"), [(0.0, 0), (0.5, 1)])
def test_published_lobes_of_a_mirror_are_the_sharpest_and_of_nothing_nothing(specular, glossy):
    table = mirror_lobes(CookTorrance(diffuse=0.0, specular=specular, roughness=0.001), resolution=RESOLUTION)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in (table.mean, table.scale, table.weight))
    whole = np.sum(table.weight[0], 0)
    np.testing.assert_allclose(table.weight[0, 0], whole, rtol=0.01)
    assert np.all((whole > 0) == glossy)


def test_lobes_and_their_remainder_are_the_brdf(close):
    table = lobe.tabulate(COLORED, lobes=2, resolution=RESOLUTION)
    wi, wo = upper(6, 300, least=0.01), upper(7, 300)
    rest = Remainder(COLORED, table)
    close(np.asarray(value(rest, wi, wo)) + value(table, wi, wo) / np.asarray(wi)[:, 2:], value(COLORED, wi, wo))
    grazing = directions((np.pi / 2 - 1e-6, 0.3), (np.pi / 2, 0.1))
    assert np.isfinite(np.asarray(value(rest, grazing, np.asarray(wo)[:2]))).all()


def test_a_set_has_the_values_and_the_lobes_of_each_of_its_brdfs():
    models = [CookTorrance(diffuse=0.0, specular=1.0, roughness=m, f0=0.3) for m in (0.25, 0.4, 0.6)]
    brdfs = BrdfSet.of(models)
    wi, wo = upper(5, 20), upper(6, 20)
    for number, model in enumerate(models):
        np.testing.assert_allclose(
            value(SetMember(brdfs, jnp.asarray(number)), wi, wo), value(model, wi, wo), rtol=1e-5
        )
    lobes = mirror_lobes(brdfs, resolution=RESOLUTION)
    assert lobes.weight.shape[:2] == (3, 4)
