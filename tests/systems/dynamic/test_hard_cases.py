"""The dynamic system: degenerate input gives finite, bounded radiance."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, dynamic, lobe, reference
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.scene import Environment, builtin

SIZE = 8
RESOLUTION = 8
EYE = (0.5, 1.0, 3.0)
KNOTS = [np.log([0.01, 1.0])]


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Lobes without their error, which no test here asks for and which takes longer than the fit."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lobe.table, "_natural_error", lambda brdf, table: 0.0)
        yield


def family(log_roughness):
    """A base, and lobes from a mirror's to a rough surface's."""
    return Channels((Lambert(1.0), CookTorrance(0.0, 1.0, jnp.exp(log_roughness), 0.5)), jnp.ones(2))


def directions(*height):
    """Views at some heights, and incident directions in front, behind and at the same place."""
    sine = [np.sqrt(1 - h**2) for h in height]
    wo = np.array([[x, 0, h] for x, h in zip(sine, height, strict=True)])
    wi = wo[:, None] * np.array([[1, 1, 1], [-1, 1, 1]])
    return jnp.asarray(wi, jnp.float32), jnp.asarray(np.repeat(wo[:, None], 2, 1), jnp.float32)


@pytest.fixture(scope="module")
def mesh():
    return builtin.sphere(rings=6, sectors=8)


@pytest.fixture(scope="module")
def table():
    lobes = lobe.tabulate(family, lobes=2, resolution=8, knot=KNOTS)
    return dynamic.tabulate(family, lobes=lobes, ranks=None, knot=KNOTS)


@pytest.fixture(scope="module")
def system(mesh, table):
    transport = dynamic.precompute(mesh, table, size=SIZE)
    return bright_texels.BrightTexels(dynamic.DynamicSystem(transport, table), transport.pyramid, family, count=4)


def color(system, place, light, eye=EYE, diffuse=0.2, specular=1.0):
    weight = np.broadcast_to(np.array([[diffuse], [specular]], np.float32), (system.vertices, 2, 1))
    blend = prt.Blend(weight, (np.full(system.vertices, place, np.float32),))
    return np.asarray(prt.radiance(system, light, eye=jnp.asarray(eye), materials=blend))


def test_sets_of_low_rank():
    """Multiples of one BRDF and a black one: of rank one, whatever is asked for."""
    models = tuple(CookTorrance(diffuse=0.0, specular=weight, roughness=0.3) for weight in (0.0, 0.5, 1.0))
    many, one = (
        dynamic.tabulate(Channels(brdfs, jnp.ones(len(brdfs))), lobes=0, ranks=(2, 4, 4), resolution=RESOLUTION)
        for brdfs in (models, models[-1:])
    )
    arrays = many.core, many.factor, many.view_map, many.light_map, many.error, many.lobe.diffuse
    assert all(np.isfinite(array).all() for array in arrays)
    wi, wo = directions(0.3, 0.7, 0.99)
    found, expected = (np.asarray(jax.jit(lambda table: table(wi, wo))(table)) for table in (many, one))
    np.testing.assert_allclose(found[..., -1:], expected, rtol=1e-4, atol=1e-5)


def test_a_sun_in_one_texel_is_exact(mesh, system):
    """All of the light is lit by one by one, with the BRDF at the center of the texel."""
    sun = np.zeros((6 * SIZE * SIZE, 3), np.float32)
    sun[77] = 100
    sun = jax.device_put(sun.reshape(6, SIZE, SIZE, 3))
    model = CookTorrance(diffuse=0.2, specular=1.0, roughness=1.0, f0=0.5)
    exact = reference.radiance(mesh, model, Environment(sun), eye=jnp.asarray(EYE), error=np.inf)
    lit = color(system, 0.0, Environment(sun))
    assert np.linalg.norm(lit - exact) < 1e-6 * np.linalg.norm(exact)


@pytest.mark.parametrize("place", [-50.0, 50.0])
def test_roughness_outside_of_the_table_is_that_of_its_end(system, place):
    light = builtin.daylight(size=SIZE)
    end = float(np.clip(place, *KNOTS[0][[0, -1]]))
    rest, clamped = (color(system.system, at, light) for at in (place, end))
    np.testing.assert_allclose(rest, clamped, rtol=1e-5, atol=1e-6)
