"""Thin glass: what is seen through it, and the light that passes it, by the formula of KHR_materials_transmission."""

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.image.pixels import by_color
from jaxprt.scene import Environment, Texture, TexturedMaterial
from jaxprt.scene.mesh import make_mesh

pytestmark = pytest.mark.usefixtures("coarse")

TINT = np.array([1.0, 0.5, 0.25])
PASSED = 0.96  # at normal incidence, with an index of refraction of 1.5
LUMINANCE = float(TINT @ [0.2126, 0.7152, 0.0722])
GLASS = TexturedMaterial(TINT, 0.0, 0.1, transmission=1.0, back="hidden")


def square(size, depth):
    """A square that faces the z axis."""
    corner = size * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) + [0, 0, depth]
    return make_mesh(corner, np.array([[0, 1, 2], [0, 2, 3]]), texture=(corner[:, :2] / size + 1) / 2)


def seen(parts, radiance, *, shadows="rays"):
    """The middle of a picture from the z axis, in light from everywhere."""
    relit = prt.precompute(prt.Scene(parts), system="lobe", size=8, refine=False, progress=False)
    camera = prt.Camera([0.0, 0, 5], [0.0, 0, 0], [0.0, 1, 0], 0.3, 16, 16)
    light = Environment(jnp.full((6, 8, 8, 3), radiance))
    return np.asarray(relit.picture(light, camera, shadows=shadows))[4:12, 4:12]


def test_what_is_seen_through_panes_is_tinted_by_each(close):
    wall = prt.Part("wall", square(9, -1), TexturedMaterial(0.0, 0.0, 1.0, specular=0.0, emissive=[0.5, 0.5, 0.8]))
    panes = [prt.Part(f"pane {n}", square(3, n / 4), GLASS) for n in range(2)]
    for count in (1, 2):
        expected = np.array([0.5, 0.5, 0.8]) * (PASSED * TINT) ** count
        close(seen([wall, *panes[:count]], 0.0), np.broadcast_to(expected, (8, 8, 3)), tolerance=1e-3)


def test_the_sky_is_seen_through_a_pane_and_the_pane_reflects_it_whole():
    pane = prt.Part("pane", square(3, 0), GLASS)
    found = seen([pane], 1.0)
    reflected = found - PASSED * TINT
    np.testing.assert_allclose(reflected, 0.04, atol=0.006)  # Lobes are a few thousandths off.
    np.testing.assert_allclose(np.ptp(reflected, axis=-1), 0, atol=1e-3)


def test_a_texture_says_where_light_passes(close):
    half = np.zeros((2, 64, 1), np.float32)
    half[:, 32:] = 1
    material = TexturedMaterial(1.0, 0.0, 0.1, transmission=1.0, transmission_texture=Texture(half), back="hidden")
    wall = prt.Part("wall", square(9, -1), TexturedMaterial(0.0, 0.0, 1.0, specular=0.0, emissive=[0.5, 0.5, 0.5]))
    found = seen([wall, prt.Part("pane", square(3, 0), material)], 0.0)
    close(found[:, :3], np.zeros((8, 3, 3)), tolerance=1e-6)
    close(found[:, 5:], np.full((8, 3, 3), 0.5 * PASSED), tolerance=1e-3)


def test_light_behind_a_pane_is_dimmed_by_its_luminance():
    wall = prt.Part("wall", square(9, -1), TexturedMaterial(0.5, 0.0, 1.0, specular=0.0))
    cover = prt.Part("pane", square(500, 0.1), GLASS)
    found = seen([wall, cover], 1.0, shadows="vertices")
    expected = 0.04 + 0.5 * PASSED * LUMINANCE * PASSED * TINT
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=0.03)


def test_pictures_of_other_numbers_of_colors_have_the_mean_of_the_tint():
    np.testing.assert_array_equal(by_color(np.tile(TINT, (2, 1)), 1), np.full((2, 1), TINT.mean()))


def test_metals_and_alpha_are_no_glass():
    metal = TexturedMaterial(TINT, 1.0, 0.1, transmission=1.0)
    hole = TexturedMaterial(TINT, 0.0, 0.1, transmission=1.0, alpha=0.5, alpha_mode="blend")
    parts = [prt.Part("metal", square(1, 0), metal), prt.Part("hole", square(1, 1), hole)]
    opacity = prt.Scene(parts).mesh.opacity
    assert not opacity.glass.any()
    np.testing.assert_array_equal(opacity.layer, [0] * 4 + [1] * 4)
    assert prt.Scene(parts[:1]).mesh.opacity is None
