"""Mitsuba 3 judges the reference on sharp lobes at grazing views, where a texel's center tells little of the texel."""

import importlib.util

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import plugins
from jaxprt import reference
from jaxprt.brdf import CookTorrance
from jaxprt.scene.environment import environment_from_image
from jaxprt.sphere import directions

SIZE = 32
TOLERANCE = 0.02  # Constant light over texels against a smooth sky; three standard errors are added.
SAMPLES, RENDERINGS = 1 << 11, 8
HEIGHT = np.array([0.7, 0.25, 0.1])  # cosines of the views


def sky(latitude):
    """A smooth sky, as wide as twice the rows: center column +z, a quarter of the width +x."""
    longitude = np.pi * (1 - 2 * (np.arange(2 * len(latitude)) + 0.5) / (2 * len(latitude)))
    latitude, longitude = np.meshgrid(latitude, longitude, indexing="ij")
    x, y, z = np.sin(longitude) * np.cos(latitude), np.sin(latitude), np.cos(longitude) * np.cos(latitude)
    lobes = [np.exp(4 * (x - 1)), np.exp(3 * (0.6 * y - 0.8 * z - 1)), np.exp(5 * (z - 1))]
    return (0.1 + np.stack(lobes, -1)).astype(np.float32)


# Ours are boxes that fill the sphere, Mitsuba's are samples of which the first and last rows are poles.
OURS, THEIRS = sky(np.pi * (0.5 - (np.arange(64) + 0.5) / 64)), sky(np.linspace(np.pi / 2, -np.pi / 2, 128))


def by_mitsuba(brdf, wo):
    """Radiance of a plane towards some directions: mean and standard error, [v, 3]."""
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    up = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(100)
    common = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(THEIRS)},
        "plane": {"type": "rectangle", "to_world": up, "material": plugins.bsdf(brdf)},
    }
    result = []
    for each in wo:
        meter = {"type": "radiancemeter", "origin": each.tolist(), "direction": (-each).tolist(), "film": film}
        world = mi.load_dict({**common, "sensor": meter})
        result.append([np.array(mi.render(world, spp=SAMPLES, seed=n))[0, 0] for n in range(RENDERINGS)])
    return np.mean(result, 1), np.std(result, 1, ddof=1) / np.sqrt(RENDERINGS)


@pytest.mark.skipif(importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed")
@pytest.mark.parametrize("roughness", [0.05, 0.02])
def test_sharp_lobes_at_grazing_views_are_those_of_mitsuba(roughness):
    brdf = CookTorrance(diffuse=0.0, specular=0.5, roughness=roughness, f0=0.3)
    wo = np.stack([np.sqrt(1 - HEIGHT**2) * 0.6, HEIGHT, -np.sqrt(1 - HEIGHT**2) * 0.8], -1)
    normal = jnp.broadcast_to(jnp.array([0.0, 1, 0]), (len(wo), 3))
    frame = directions.frame(normal, jnp.zeros((len(wo), 3)))
    seen = jnp.full((len(wo), 6 * SIZE**2), 16, jnp.uint8)
    light = environment_from_image(OURS, size=SIZE)
    eye = jnp.zeros(3)
    mean, error = by_mitsuba(brdf, wo)
    place = jnp.asarray(-wo, jnp.float32)
    found = reference.integrate(seen, place, frame, brdf, light, eye)
    assert np.all(np.abs(found - mean) < TOLERANCE * mean + 3 * error), (found, mean, error)
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(mean)
    centers = reference.integrate(seen, place, frame, brdf, light, eye, error=np.inf)
    assert np.any(np.abs(centers - mean) > TOLERANCE * mean + 3 * error)
