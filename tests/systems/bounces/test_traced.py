"""Lobes that are traced: energy, the harmonics that are taken out for them, and no jumps over their width."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import Blend, harmonic, lobe
from jaxprt.brdf import BlinnPhong, Lambert
from jaxprt.brdf.varying import Channels
from jaxprt.sphere import directions, harmonics
from jaxprt.systems.bounces import ReflectingPart, traced
from jaxprt.systems.lobe import table

pytestmark = pytest.mark.usefixtures("coarse")

KNOT = np.log(np.array([0.06, 0.12, 0.24, 0.48]))
POINTS = 2000
EYE = jnp.array([0.3, 3.0, 0.2])


def shiny(log_roughness):
    return Channels((Lambert(1.0), BlinnPhong(0.0, 1.0, 2 * jnp.exp(-2 * log_roughness) - 2)), jnp.ones(2))


@functools.cache
def part(count: int = 8) -> ReflectingPart:
    """Points of a ball, seen from above, of all roughness."""
    way = np.random.default_rng(0).normal(size=(POINTS, 3))
    way[:, 1] = np.abs(way[:, 1]) + 0.5
    way = jnp.asarray(way / np.linalg.norm(way, axis=1, keepdims=True), jnp.float32)
    knot = (KNOT,)
    tables = (
        harmonic.tabulate(shiny, degree=3, knot=knot, error=0.5),
        lobe.tabulate(shiny, lobes=6, knot=knot, resolution=12),
    )
    return ReflectingPart(way, directions.frame(way, jnp.zeros_like(way)), tables[0], lobe=tables[1], count=count)


def blend(roughness: float) -> Blend:
    weight = jnp.asarray([[0.5, 0.4, 0.3], [0.2, 0.5, 0.9]])
    return Blend(jnp.broadcast_to(weight, (POINTS, 2, 3)), (jnp.full(POINTS, np.log(roughness), jnp.float32),))


@functools.cache
def both(roughness: float):
    """Rays, their weights, and the harmonics that are taken out for them."""
    own = part()
    rays = own.rays(EYE, blend(roughness).parameter)
    return rays, own.weights(rays, EYE, blend(roughness)), own.carried(EYE, blend(roughness))


@pytest.mark.parametrize("roughness", [0.06, 0.2, 0.3])
def test_rays_hold_the_energy_that_is_taken_out_of_the_harmonics(roughness, close):
    rays, weight, carried = both(roughness)
    close(jnp.sum(weight, 0).T, np.sqrt(4 * np.pi) * carried[0], tolerance=1e-4)
    assert np.all(np.asarray(weight) > -1e-6)
    # No color moves a ray, and none goes below the horizon.
    assert np.all(np.einsum("jvi,vi->jv", rays.direction, part().position) > -1e-5)
    close(np.linalg.norm(rays.direction, axis=-1), np.ones((8, POINTS)), tolerance=1e-5)


def test_rays_read_smooth_light_as_the_harmonics_do(close):
    rays, weight, carried = both(0.2)
    light = np.eye(16, dtype=np.float32)[:, :9]
    local = harmonic.system.local_light(part().frame, light)
    expected = jnp.mean(jnp.einsum("lbv,ldv->vbd", local, carried), 0)
    read = jnp.einsum("jvd,jvb->bd", weight, harmonics.evaluate(rays.direction, degree=3) @ light) / POINTS
    # Few rays at each point, whose noise falls out over points. What of a lobe is below the horizon is turned up.
    close(read, expected, tolerance=0.03)


def test_what_is_traced_changes_smoothly_with_the_width():
    concentration = jnp.logspace(-1, 5, 4001)
    share = np.asarray(table.traced_share(concentration))
    assert np.all(share[concentration <= table.WIDE] == 0)
    assert np.all(share[concentration >= table.NARROW] == 1)
    assert np.all(np.diff(share) >= 0)
    assert np.max(np.diff(share)) < 0.01
    whole = np.stack([np.asarray(both(float(r))[2])[0, :, 0] for r in np.geomspace(0.06, 0.48, 25)])
    assert np.max(np.abs(np.diff(whole, axis=0))) < 0.12 * np.max(whole)
    # All of a narrow one, little of a wide one, which some lobes towards the horizon are narrow of.
    full = np.sqrt(4 * np.pi) * whole[0]
    np.testing.assert_allclose(
        full / full[2], np.array([0.2, 0.5, 0.9]) / 0.9, rtol=0.02
    )  # The diffuse channel has lobes too.
    assert np.all(whole[-1] < 0.25 * whole[0])


def test_what_the_eye_cannot_see_stays_with_the_harmonics(close):
    own, half = part(), jnp.asarray(np.arange(POINTS) % 2, jnp.float32)
    rays = own.rays(EYE, blend(0.06).parameter, seen=half)
    assert np.all(np.asarray(rays.chance)[:, ::2] == 0)
    weight = own.weights(rays, EYE, blend(0.06), seen=half)
    assert np.all(np.asarray(weight)[:, ::2] == 0)
    view = own.view(EYE, blend(0.06), seen=half)
    close(view[..., ::2], own.harmonics_alone.view(EYE, blend(0.06))[..., ::2])
    close(view[..., 1::2], own.view(EYE, blend(0.06))[..., 1::2])


def test_an_eye_for_each_point_is_the_eye_of_all(close):
    own, each = part(), jnp.broadcast_to(EYE, (POINTS, 3))
    close(own.view(each, blend(0.2)), own.view(EYE, blend(0.2)))
    close(
        own.harmonics_alone.view(each.at[0].set(2 * EYE), blend(0.2))[..., 1:],
        own.harmonics_alone.view(EYE, blend(0.2))[..., 1:],
    )


def test_points_scatter_evenly_and_places_alike(close):
    place = jnp.asarray(np.random.default_rng(3).normal(size=(4000, 3)), jnp.float32)
    for each in traced._scattered(place):
        histogram = np.histogram(np.asarray(each), 8, (0, 1))[0]
        assert np.all(np.abs(histogram - 500) < 120)
    one, other = jax.jit(traced._scattered)(place), traced._scattered(place)
    np.testing.assert_array_equal(one[0], other[0])
    assert abs(np.corrcoef(one[0], one[1])[0, 1]) < 0.06
