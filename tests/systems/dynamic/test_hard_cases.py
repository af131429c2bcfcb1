"""The dynamic system: degenerate input gives finite, bounded radiance."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, dynamic, lobe, reference
from jaxprt.brdf import CookTorrance, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.scene import Environment, builtin

SIZE = 8
HORIZON = 1e-3  # 2 x 2 points in each texel that the horizon cuts, against the integral: measured 4.5e-4.
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


@pytest.mark.parametrize("specular", [[0.0, 0.5, 1.0], [0.0, 0.0]])
def test_sets_of_low_rank(specular):
    """Multiples of one BRDF and black ones: of rank one or less, whatever is asked for."""
    models = tuple(CookTorrance(diffuse=0.0, specular=weight, roughness=0.3) for weight in specular)
    many, one = (
        dynamic.tabulate(Channels(brdfs, jnp.ones(len(brdfs))), lobes=0, ranks=(2, 4, 4), resolution=RESOLUTION)
        for brdfs in (models, models[-1:])
    )
    arrays = many.core, many.factor, many.view_map, many.light_map, many.error, many.lobe.diffuse
    assert all(np.isfinite(array).all() for array in arrays)
    wi, wo = directions(0.3, 0.7, 0.99)
    np.testing.assert_allclose(many(wi, wo)[..., -1:], one(wi, wo), rtol=1e-4, atol=1e-5)


def test_a_constant_tensor():
    flat = dynamic.tabulate(lambda wi, wo: 0 * wi[..., 2:] + 0.25, lobes=0, ranks=(1, 3, 3), resolution=RESOLUTION)
    wi, wo = directions(0.3, 0.7, 0.99)
    np.testing.assert_allclose(flat(wi, wo), 0.25, rtol=1e-5)
    assert flat.error < 1e-5


def test_a_sun_in_one_texel_is_exact(mesh, system):
    """All of the light is lit by one by one, with the BRDF at the center of the texel."""
    sun = jnp.zeros((6 * SIZE * SIZE, 3)).at[77].set(100.0).reshape(6, SIZE, SIZE, 3)
    model = CookTorrance(diffuse=0.2, specular=1.0, roughness=1.0, f0=0.5)
    exact = reference.radiance(mesh, model, Environment(sun), eye=jnp.asarray(EYE), error=np.inf)
    lit = color(system, 0.0, Environment(sun))
    assert np.linalg.norm(lit - exact) < 1e-6 * np.linalg.norm(exact)


def test_a_furnace_of_diffuse_parts_is_white(mesh, system):
    """Constant light, and no specular part; what a vertex of a coarse sphere does not see are its own faces."""
    white = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    radiance = color(system, -2.3, white, diffuse=1.0, specular=0.0)[:, 0]
    exact = np.asarray(reference.radiance(mesh, Lambert(1.0), white, eye=jnp.asarray(EYE), error=1e-5))[:, 0]
    assert (exact > 0.9).sum() > 5
    np.testing.assert_allclose(radiance, exact, atol=HORIZON)


@pytest.mark.parametrize("place", [-50.0, 50.0])
def test_roughness_outside_of_the_table_is_that_of_its_end(system, place):
    light = builtin.daylight(size=SIZE)
    end = float(np.clip(place, *KNOTS[0][[0, -1]]))
    rest, clamped = (color(system.system, at, light) for at in (place, end))
    np.testing.assert_allclose(rest, clamped, rtol=1e-5, atol=1e-6)
