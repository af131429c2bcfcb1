"""The reference on BRDFs that vary over a texel, against Gauss rules in float64 and against Mitsuba 3."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bright_texels, reference
from jaxprt.brdf import AshikhminShirley, CookTorrance
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap, directions
from jaxprt.visibility import StoredVisibility

SIZE = 8
STATED = 1e-3
SLOPE = 1e-2  # Differences over a fiftieth of the roughness, of a BRDF in float32.
SUN = (2, 3, 5)  # a texel that the first vertices mirror
HEIGHT = np.array([0.9, 0.5, 0.12, 0.06])  # cosines of the views

# At edges of 8, texels are eleven degrees wide.
SHARP = {
    "m = 0.05": CookTorrance(diffuse=0.0, specular=0.5, roughness=0.05, f0=0.3),
    "m = 0.02": CookTorrance(diffuse=[0.0, 0.1, 0.2], specular=0.5, roughness=0.02, f0=0.3),
    "anisotropic": AshikhminShirley(nu=20.0, nv=1000.0),
}


@pytest.fixture(scope="module")
def scene():
    """Vertices in one place, of which some mirror the sun to the eye; random light and visibility."""
    random = np.random.default_rng(0)
    eye = np.array([3.0, 4.0, 12.0])
    wo = np.broadcast_to(eye / np.linalg.norm(eye), (4, 3))
    side = np.cross(wo, random.normal(size=(4, 3)))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    sine = np.sqrt(1 - HEIGHT**2)
    normal = HEIGHT[:, None] * wo + sine[:, None] * side
    sun = np.asarray(cubemap.direction(size=SIZE)[SUN], np.float64)
    normal[0] = (sun + wo[0]) / np.linalg.norm(sun + wo[0])
    frame = directions.frame(jnp.asarray(normal, jnp.float32), jnp.asarray(random.normal(size=(4, 3)), jnp.float32))
    light = np.stack([random.uniform(0.2, 1, (6, SIZE, SIZE, 3)), np.zeros((6, SIZE, SIZE, 3))])
    light[1][SUN] = [300.0, 200.0, 100.0]
    seen = random.choice([0, 7, 16, 16], (4, 6 * SIZE**2)).astype(np.uint8)
    seen[0] = 16
    return jnp.asarray(seen), jnp.zeros((4, 3)), frame, Environment(jnp.asarray(light, jnp.float32)), jnp.asarray(eye)


def by_gauss_points(seen, position, frame, brdf, light, eye, *, points=48):
    """Sums over Gauss points in every texel; float64 but for the BRDF."""
    place, weight = np.polynomial.legendre.leggauss(points)
    center = (2 * np.arange(SIZE) + 1) / SIZE - 1
    at, much = (center[:, None] + place / SIZE).ravel(), np.tile(weight / SIZE, SIZE)
    evaluate = jax.jit(lambda wi, wo: brdf(wi, jnp.broadcast_to(wo, wi.shape)))
    table = np.asarray(light.radiance, np.float64)
    result = np.zeros((len(table), len(seen), 3))
    for vertex, axes in enumerate(np.asarray(frame, np.float64)):
        wo = axes @ np.asarray(eye, np.float64)
        wo /= np.linalg.norm(wo)
        for face, (s, t, n) in enumerate(cubemap.axes()):
            point = at[:, None] * s + at[:, None, None] * t + n
            length = np.linalg.norm(point, axis=-1)
            local = point / length[..., None] @ axes.T
            if local[..., 2].max() <= 0:
                continue
            value = evaluate(jnp.asarray(local.reshape(-1, 3), jnp.float32), jnp.asarray(wo, jnp.float32))
            sent = np.asarray(value, np.float64).reshape(*length.shape, -1)
            sent = sent * (np.maximum(local[..., 2], 0) * much[:, None] * much / length**3)[..., None]
            sent = sent.reshape(SIZE, points, SIZE, points, -1).sum((1, 3))
            clear = np.asarray(seen, np.float64)[vertex].reshape(6, SIZE, SIZE, 1)[face] / 16
            result[:, vertex] += (table[:, face] * sent * clear).sum((1, 2))
    return result


@pytest.mark.parametrize("name", ["m = 0.02", "anisotropic"])
def test_every_vertex_keeps_the_stated_error_under_every_light_at_grazing_views_too(scene, name):
    exact = by_gauss_points(*scene[:3], SHARP[name], *scene[3:])
    norm = np.linalg.norm(exact, axis=-1)
    assert (norm > 0).sum() >= 5
    for error in (np.inf, STATED):
        found = reference.integrate(*scene[:3], SHARP[name], *scene[3:], error=error)
        off = np.max(np.linalg.norm(found - exact, axis=-1)[norm > 1e-3 * norm.max()] / norm[norm > 1e-3 * norm.max()])
        assert off > 0.02 if error == np.inf else off < 3 * STATED


def test_the_slope_by_roughness_is_that_of_the_integral(scene):
    def total(roughness, rule=reference.integrate):
        value = rule(*scene[:3], CookTorrance(0.0, 0.5, roughness, 0.3), *scene[3:])[0]
        return (value[0] - value[1]).sum()  # of unlike signs, so that the slopes do not cancel

    coarser = partial(by_gauss_points, points=16)
    slope = float(jax.jit(jax.grad(total))(0.1))
    difference = float(total(0.101, coarser) - total(0.099, coarser)) / 0.002
    assert abs(slope - difference) < SLOPE * abs(difference)
    _, along = jax.jvp(total, (jnp.asarray(0.1),), (jnp.asarray(1.0),))
    assert float(along) == pytest.approx(slope, rel=1e-3)


def test_single_texels_by_as_many_points_as_their_brdf_needs_are_the_integral(scene):
    seen, position, frame, light, eye = scene
    level = np.zeros((1, 6 * SIZE**2, 32), np.uint8)
    level[0, :, :4] = np.asarray(seen - (seen > 8)).T
    transport = StoredVisibility(jnp.asarray(level), position, frame)
    sun = jax.tree.map(lambda each: each[1], light)
    texel, excess, _ = bright_texels.split(sun, count=1)
    brdf = SHARP["m = 0.05"]
    exact = by_gauss_points(jnp.asarray(transport.seen(np.arange(4))), position, frame, brdf, light, eye)[1]
    needed = bright_texels.samples_for(brdf, size=SIZE, error=0.01)
    one, more = (bright_texels.radiance(transport, brdf, texel, excess, eye=eye, samples=n) for n in (1, needed))
    assert np.linalg.norm(one - exact) > 0.05 * np.linalg.norm(exact)
    assert np.linalg.norm(more - exact) < 0.01 * np.linalg.norm(exact)


def test_rough_brdfs_need_one_point_and_mirrors_many():
    needed = [bright_texels.samples_for(CookTorrance(0.0, 0.5, m, 0.3)) for m in (0.5, 0.05, 0.02)]
    assert needed[0] == 1
    assert needed == sorted(needed)
    assert needed[-1] > 2
    with pytest.raises(ValueError, match=r"error must be above 0 .* got 0"):
        bright_texels.samples_for(AshikhminShirley(), error=0.0)
