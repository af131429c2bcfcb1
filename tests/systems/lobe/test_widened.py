"""Lobes as reflection rays read them: widened lobes against averages over directions, and the sums that they enter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bright_texels, lobe, total, visibility
from jaxprt.brdf import CookTorrance
from jaxprt.scene import Environment, builtin
from jaxprt.scene.points import VERTICES, Points
from jaxprt.systems.lobe import widened
from jaxprt.systems.lobe.table import LobeMixture
from jaxprt.visibility import Run
from tests.systems.scenes import SIZE, ball_on_ground, pyramids_on_ground, seen_on_ground

pytestmark = pytest.mark.usefixtures("few_samples")
EYE = jnp.array([1.2, 1.5, 2.5])
BRDF = CookTorrance(diffuse=[0.3, 0.2, 0.1], roughness=0.2)
LOBES = 0.03  # of all radiance: what lobes change of the BRDF of the brightest texels, and a texel's width as a lobe
CELLS = 0.04  # the same with cells of 11 degrees as lobes, of which the BRDF is summed at the middle alone
ENERGY = 0.04  # of all radiance in white light: what falls below the horizon or onto other surfaces


@pytest.fixture(scope="module")
def seen():
    return seen_on_ground()


@pytest.fixture(scope="module")
def systems(seen):
    return both(seen, BRDF)


def both(seen, brdf):
    """The lobe system alone, and with the brightest texels apart."""
    plain = lobe.LobeSystem(pyramids_on_ground(), lobe.tabulate(brdf, lobes=6, resolution=16))
    return plain, bright_texels.BrightTexels(plain, seen, brdf, count=8, samples=2)


def lit(system, light, variance, points=VERTICES):
    seen = widened.view(system, EYE, None, points, jnp.full(points.count(system.vertices), variance))
    return np.asarray(widened.combine(system, system.shade(system.light(light)), seen, points))


def test_a_widened_lobe_is_the_mean_over_directions():
    rng, variance, concentration = np.random.default_rng(0), 0.02, 60.0
    mean = np.array([0.3, 0.2, 0.93]) / np.linalg.norm([0.3, 0.2, 0.93])
    turned = mean + variance**0.5 * rng.standard_normal((20_000, 3))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    wi = mean + np.linspace(0, 0.5, 9)[:, None] * np.cross(mean, [0, 0, 1.0]) + [0, 0, 1e-3]
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    expected = np.exp(concentration * (wi @ turned.T - 1)).mean(1) * concentration / (2 * np.pi)
    ones = jnp.ones((1, 1, 1))
    one = LobeMixture(jnp.asarray(mean)[:, None, None], concentration * ones[0], ones, 0 * ones[0])
    value = jax.jit(lambda lobes, wi: lobes.widened(jnp.full(1, variance)).evaluate(wi)[0])
    np.testing.assert_allclose(value(one, jnp.asarray(wi)), expected, atol=0.02 * expected.max())


def test_unwidened_lobes_give_the_radiance_of_the_system(systems, close):
    light, (plain, bright) = builtin.daylight(size=SIZE), systems
    exact = [np.asarray(each.combine(each.shade(each.light(light)), each.view(EYE))) for each in systems]
    close(lit(plain, light, 0.0), exact[0], tolerance=1e-5)
    found = lit(bright, light, 0.0)
    assert np.linalg.norm(found - exact[1]) < LOBES * np.linalg.norm(exact[1])


@pytest.mark.parametrize("by_lobes", [False, True])
def test_cells_of_the_light_are_seen_by_widened_lobes_as_by_the_system(by_lobes):
    """At 6 x 16 x 16 texels, which have cells of 6 x 8 x 8."""
    brdf, light = CookTorrance(diffuse=[0.3, 0.2, 0.1], roughness=0.5), builtin.studio(size=16)
    stored = visibility.precompute(ball_on_ground(), size=16, run=Run(progress=False))
    system = lobe.LobeSystem(lobe.compress(stored), lobe.tabulate(brdf, lobes=6, resolution=16))
    both = bright_texels.BrightTexels(system, system.transport, brdf, count=8, samples=2, cells=True, by_lobes=by_lobes)
    exact = np.asarray(both.combine(both.shade(both.light(light)), both.view(EYE)))
    assert np.any(np.asarray(both.light(light).excess)[8:])
    assert np.linalg.norm(lit(both, light, 0.0) - exact) < CELLS * np.linalg.norm(exact)


def test_widening_keeps_energy_and_makes_highlights_wide(seen):
    white = Environment(jnp.ones((6, SIZE, SIZE, 3)))
    sun = Environment(jnp.zeros((6, SIZE, SIZE, 3)).at[2, SIZE // 2, SIZE // 2].set(100.0))
    for system in both(seen, CookTorrance(diffuse=[0.0, 0.0, 0.0], roughness=0.2)):
        sharp, wide = (lit(system, white, variance) for variance in (0.0, 0.1))
        assert wide.sum() == pytest.approx(sharp.sum(), rel=ENERGY)
        sharp, wide, widest = (lit(system, sun, variance) for variance in (0.0, 0.3, 3e8))
        assert wide.max() < 0.5 * sharp.max()
        assert np.all(np.isfinite(widest))


def test_points_have_what_vertices_have(systems, close):
    system, light = systems[1], builtin.daylight(size=SIZE)
    corner = np.asarray(ball_on_ground().face)[::7].T
    weight = np.zeros(corner.shape, np.float32)
    weight[0] = 1
    points = Points(*map(jnp.asarray, (corner, weight, np.zeros((2, *corner.shape), np.float32))))
    close(lit(system, light, 0.1, points), lit(system, light, 0.1)[corner[0]], tolerance=1e-4)


def test_only_systems_with_lobes_can_be_widened(systems):
    plain, bright = systems
    assert widened.can_widen(plain)
    assert widened.can_widen(bright)
    assert not widened.can_widen(total(plain, bright))
