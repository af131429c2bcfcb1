"""The shipped tables: their errors, energy and columns, against BRDFs by quadrature and tables of one roughness."""

import functools
import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.standard import descent, fit
from jaxprt import Blend, bright_texels, harmonic, lobe
from jaxprt.brdf import MetallicRoughness
from jaxprt.relit import curvature, paths
from jaxprt.relit.channels import Shading
from jaxprt.scene import builtin
from jaxprt.sphere import hemisphere
from jaxprt.systems import bounces, standard
from jaxprt.systems.bounces import traced
from jaxprt.systems.harmonic import HarmonicSystem
from jaxprt.systems.lobe import LobeSystem
from jaxprt.systems.standard import BLINN_PHONG, COOK_TORRANCE, METALLIC_ROUGHNESS, SHEEN

BOTH = pytest.mark.parametrize("table", [METALLIC_ROUGHNESS, BLINN_PHONG, COOK_TORRANCE], ids=lambda table: table.name)
EVERY = pytest.mark.parametrize(
    "table", [METALLIC_ROUGHNESS, BLINN_PHONG, COOK_TORRANCE, SHEEN], ids=lambda table: table.name
)
SHARE = 0.6  # a roughness between the smallest and the largest, as a part of the way in the logarithm
FURNACE = 0.01  # of the albedo, in a white furnace; of the largest channel where a channel is dark
HARMONICS = 0.02
GROOVES = 0.03  # of Cook-Torrance, whose lobe grows steeply towards grazing views
CURVATURE = 0.03  # of the logarithm between knots
MEASURED = 0.02  # The error was measured with other compiler options.
DARK = 5e-4  # of the rim of a smooth surface, whose albedo is .004
ALBEDO = 0.02  # of path functions between knots, and of half precision


def between(table, *shares):
    """Logarithms of roughness, given as parts of the way from the smallest to the largest."""
    low, high = table.range
    return [float(np.float32(low + (high - low) * share)) for share in shares]


@jax.jit
def at(table, place):
    """The table at one roughness."""
    return table.at(place)


@jax.jit
def albedos(brdf, table, view):
    """Integrals of the BRDF times cosine, and of the table, by a quadrature other than the one of the fit."""

    def one(wo):
        wi, area = hemisphere.arcs(lobe.em.mirror(wo), rings=80, sectors=128)
        wo = jnp.broadcast_to(wo, wi.shape)
        return area @ (brdf(wi, wo) * wi[:, 2:]), area @ table(wi, wo)

    return jax.lax.map(one, view)


def views(*degrees):
    theta = np.radians(degrees)
    turn = np.arange(len(degrees))
    each = np.sin(theta) * np.cos(turn), np.sin(theta) * np.sin(turn), np.cos(theta)
    return jnp.asarray(np.stack(each, -1), jnp.float32)


@functools.cache
def ball():
    return builtin.sphere(rings=3, sectors=4)


def shading(table, place, weight):
    """A part of one roughness."""
    mesh = ball()
    count = len(mesh.position)
    whole = jnp.broadcast_to(jnp.asarray(weight, jnp.float32)[:, None], (count, len(weight), 3))
    return Shading(mesh, table.family(place), table.family(place), (), Blend(whole, ()))


@EVERY
def test_reading_compiles_no_program(table, caplog):
    standard.tables.forget()
    with caplog.at_level(logging.DEBUG, logger="jax"), jax.log_compiles(True):
        table.lobes()
        table.harmonics(2)
        table.family  # noqa: B018
        table.curvature(-1.0, np.ones(len(table.scale)))
        if table is not SHEEN:
            table.samples(-1.0, 64)
            table.tensor()
        table.is_sharp(-1.0)
        if table is METALLIC_ROUGHNESS:
            table.paths()
    assert not [record for record in caplog.records if "ompil" in record.getMessage()]


def test_a_table_is_read_once_and_not_traced_when_it_is_read_inside_jit():
    table = METALLIC_ROUGHNESS
    standard.tables.forget()

    @jax.jit
    def peak(place):
        return jnp.max(table.lobes().at(place).scale)

    assert np.isfinite(peak(-1.0))
    assert isinstance(table.lobes().scale, jax.Array)
    assert not isinstance(table.lobes().scale, jax.core.Tracer)
    assert table.lobes() is table.lobes()
    assert hash(table) == hash(standard.StandardTable(table.name))


def test_arrays_have_the_default_precision(x64):
    table = METALLIC_ROUGHNESS
    assert table.lobes().scale.dtype == jnp.float64
    assert table.harmonics().table.dtype == jnp.float64
    assert table.family.scale.dtype == jnp.float64


@EVERY
def test_the_stated_errors_are_the_measured_ones(table):
    found, stated = table.lobes(), table.errors()
    places = fit.between(np.asarray(found.knot[0], np.float64))
    assert len(stated) == len(places)
    assert float(found.error) == pytest.approx(stated.max())
    some = np.array([14, int(np.argmax(stated))])
    np.testing.assert_allclose(fit.errors(found, table.family, places[some]), stated[some], rtol=MEASURED)


def test_a_knot_is_about_as_exact_as_a_table_of_its_roughness_alone():
    table = METALLIC_ROUGHNESS
    found = table.lobes()
    place = found.knot[0][-4]
    own = lobe.tabulate(table.family(place), lobes=found.lobes)
    shipped = lobe.table.measured_error(table.family(place), at(found, place))
    assert shipped <= 1.1 * float(own.error)


@EVERY
def test_more_lobes_are_more_exact(table):
    assert standard.tables.LOBES in table.counts
    mean = [table.errors(count).mean() for count in table.counts]
    assert mean == sorted(mean, reverse=True)
    for count in table.counts:
        assert table.lobes(count).lobes == count


@EVERY
def test_each_channel_reflects_the_energy_of_its_brdf(table):
    wo = views(10, 35, 60, 80)
    for place in between(table, 0.3, 0.97):
        exact, found = albedos(table.family(place), at(table.lobes(), jnp.float32(place)), wo)
        np.testing.assert_allclose(found, exact, rtol=FURNACE, atol=FURNACE * float(jnp.max(exact)))


@EVERY
def test_harmonics_are_the_projection_of_the_brdf(table):
    found, wo = table.harmonics(), views(5, 25, 45, 65, 80)
    assert float(found.error) <= (GROOVES if table == COOK_TORRANCE else HARMONICS)
    for place in between(table, 0.1, SHARE):
        exact = harmonic.table.project(table.family(place), wo, degree=4, rings=64, sectors=640)
        value = found.coefficients(wo, jnp.full(len(wo), place, jnp.float32))
        assert np.linalg.norm(value - exact) <= float(found.error) * np.linalg.norm(exact)
    low = table.harmonics(2)
    assert low.degree == 2
    np.testing.assert_array_equal(low.table, found.table[:9])


class FourthDegree(HarmonicSystem):
    """A system of which only the degree is asked for."""

    degree = 4


MIXTURES = {"dielectric": (5.0, 0.04, 0.96, 0.0), "metal": (0.0, 0.9, 0.1, 0.0)}


@pytest.mark.parametrize("name", MIXTURES)
def test_curvatures_are_those_of_the_brdf_between_knots(name):
    weight = np.array(MIXTURES[name])
    for place in between(METALLIC_ROUGHNESS, 0.28, 0.93):
        part = shading(METALLIC_ROUGHNESS, place, weight)
        exact = curvature.of_part(part, object.__new__(LobeSystem))
        assert METALLIC_ROUGHNESS.curvature(place, weight) == pytest.approx(exact, rel=CURVATURE)
        low = curvature.of_part(part, object.__new__(FourthDegree))
        assert METALLIC_ROUGHNESS.curvature(place, weight, 4) == pytest.approx(low, rel=CURVATURE)


@EVERY
def test_a_smaller_roughness_than_the_smallest_is_treated_as_the_smallest(table):
    low, _ = table.range
    weight = np.ones(len(table.scale))
    assert table.curvature(low - 1, weight) == table.curvature(low, weight)
    if table is not SHEEN:
        assert table.samples(low - 1) == table.samples(low)
    assert table.is_sharp(low - 1) == table.is_sharp(low)


@BOTH
def test_numbers_of_samples_are_those_of_the_brdf_or_the_next_larger(table):
    order, size = (1, 2, 3, 4, 6, 8, 12, 16), 32
    for place in between(table, 0.15, SHARE, 0.9):
        exact = bright_texels.samples_for(table.family(place), size=size)
        assert 0 <= order.index(table.samples(place, size)) - order.index(exact) <= 1


@EVERY
def test_lobes_are_sharp_where_those_of_the_table_are(table):
    places = between(table, *np.linspace(0, 1, 5))
    found = [table.is_sharp(place) for place in places]
    assert found == [traced.is_sharp(at(table.lobes(), jnp.float32(place))) for place in places]
    assert found[0]
    assert not found[-1]
    if table is not SHEEN:
        assert not table.is_sharp(places[0], np.eye(len(table.scale))[0])


def test_path_functions_have_the_albedo_of_each_channel():
    brdf, sent = METALLIC_ROUGHNESS.paths()
    value = np.asarray(bounces.functions.albedo(brdf))
    weight = jnp.broadcast_to(jnp.eye(4, dtype=jnp.float32), (1, 4, 4))
    for place in between(METALLIC_ROUGHNESS, 0.2, SHARE, 0.97):
        each = np.asarray(sent.weights(Blend(weight, (jnp.full(1, place, jnp.float32),))))[0]
        found = value @ each
        exact = paths.channels(METALLIC_ROUGHNESS.family(place))
        np.testing.assert_allclose(found, exact, rtol=ALBEDO, atol=DARK)


def test_channels_are_the_terms_of_the_material():
    material = MetallicRoughness(base_color=[0.8, 0.5, 0.3], metallic=0.3, specular=0.5, roughness=0.4)
    wi, wo = views(20, 50, 70), views(30, 40, 10)
    value = METALLIC_ROUGHNESS.family(jnp.log(0.4))(wi, wo)
    weight = np.asarray(material.coefficient()) / METALLIC_ROUGHNESS.scale[:, None]
    np.testing.assert_allclose(value @ weight.astype(np.float32), material(wi, wo), rtol=1e-5)


def test_other_numbers_of_lobes_are_fitted_and_kept(monkeypatch):
    asked = []

    def tabulate(family, *, lobes, knot):
        asked.append(lobes)
        return METALLIC_ROUGHNESS.lobes()

    monkeypatch.setattr(lobe, "tabulate", tabulate)
    for _ in range(2):
        METALLIC_ROUGHNESS.lobes(5)
    assert asked == [5]
    standard.tables.forget()


def test_impossible_sizes_are_refused():
    with pytest.raises(ValueError, match="degree must be between 0 and the table's 4, got 5"):
        METALLIC_ROUGHNESS.harmonics(5)
    with pytest.raises(ValueError, match="count"):
        METALLIC_ROUGHNESS.lobes(0)
    with pytest.raises(ValueError, match="light paths"):
        BLINN_PHONG.paths()


def test_descent_lowers_the_error_between_knots_and_keeps_smaller_roughness(monkeypatch):
    for name, value in {"_VIEWS": 12, "_RINGS": 12, "_SECTORS": 16, "_CHUNK": 20}.items():
        monkeypatch.setattr(descent, name, value)
    family, knot = BLINN_PHONG.family, np.log([0.15, 0.3, 0.6])
    table = lobe.tabulate(family, lobes=4, resolution=8, knot=(knot,))
    least = np.full(table.scale.shape, 1.0)
    weight = np.random.default_rng(0).uniform(0.1, 1, (8, 2))
    better = descent.improve(table, family, weight, least, first=float(np.log(0.25)), steps=60)
    np.testing.assert_array_equal(better.mean[:, :, 0], table.mean[:, :, 0])
    np.testing.assert_allclose(np.linalg.norm(better.mean, axis=0), 1, atol=1e-5)
    before, after = (fit.errors(each, family, np.log([0.4, 0.5])) for each in (table, better))
    assert np.all(after < before)
