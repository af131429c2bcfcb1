"""Scenes at the numbers of vertices and points at which a compiler once summed wrongly (jax-ml/jax#39103).

`make test-long` runs these with the optimization that users get.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import inverse
from jaxprt.image import rasterize, render
from jaxprt.scene import Camera, Environment, Part, PointLight, Scene, TexturedMaterial
from jaxprt.scene.mesh import grid_face, make_mesh

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("coarse")]

SIDES = (181, 200)  # 32,761 and 40,000 vertices
LIGHT = Environment(jnp.asarray(np.random.default_rng(0).uniform(0.2, 2.0, (6, 8, 8, 3)), jnp.float32))


def hills(side: int) -> Scene:
    """A hilly ground of side x side vertices under a lamp and a camera of as many pixels."""
    x, z = np.meshgrid(*[np.linspace(-2, 2, side)] * 2)
    position = np.stack([x, 0.2 * np.sin(5 * x) * np.cos(4 * z), z], -1).reshape(-1, 3)
    ground = make_mesh(position, grid_face(rows=side, columns=side))
    camera = Camera([1.0, 3.0, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.8, side, side)
    material = TexturedMaterial(base_color=(0.6, 0.5, 0.4), metallic=0.0, roughness=0.5)
    return Scene([Part("ground", ground, material)], [camera], point_lights=[PointLight("lamp", [0.5, 1.0, 0.5], 2.0)])


def exact(value: Any) -> Any:
    """An array of floating point in float64; other leaves unchanged."""
    floating = isinstance(value, jax.Array | np.ndarray) and jnp.issubdtype(value.dtype, jnp.floating)
    return value.astype(jnp.float64) if floating else value


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("system", ["harmonic", "lobe"])
def test_scenes_with_lamps_agree_with_float64_at_vertices_and_pixels(system, side):
    relit = prt.precompute(hills(side), refine=False, system=system, size=8, progress=False)
    eye = relit.camera.eye
    single, picture = relit.radiance(LIGHT, eye=eye), relit.picture(LIGHT)
    assert single.dtype == picture.dtype == jnp.float32
    with jax.enable_x64(True):
        double, light, view = jax.tree.map(exact, (relit, LIGHT, eye))
        expected, fine = np.asarray(double.radiance(light, eye=view)), np.asarray(double.picture(light))
    assert expected.dtype == np.float64
    assert np.abs(np.asarray(single) - expected).max() < 1e-4 * np.abs(expected).max()
    # Rounding moves edges of triangles by parts of a pixel.
    off = np.abs(np.asarray(picture) - fine).max(-1)
    assert np.mean(off > 1e-3 * np.abs(fine).max()) < 2e-3


@pytest.mark.parametrize("side", SIDES)
def test_the_rasterizer_and_interpolation_agree_with_float64(side):
    scene = hills(side)
    mesh, camera = scene.parts[0].mesh, scene.cameras[0]
    color = jnp.asarray(np.random.default_rng(1).uniform(0, 1, (side**2, 3)), jnp.float32)
    triangle, picture = rasterize(mesh, camera).triangle, render(mesh, color, camera)
    with jax.enable_x64(True):
        mesh, camera, color = jax.tree.map(exact, (mesh, camera, color))
        same = np.asarray(triangle) == np.asarray(rasterize(mesh, camera).triangle)
        fine = np.asarray(render(mesh, color, camera))
    assert np.mean(~same) < 2e-3
    assert np.mean(np.abs(picture - fine).max(-1) > 1e-2) < 5e-3


@pytest.mark.parametrize("side", SIDES)
def test_light_from_a_picture_of_as_many_pixels_agrees_with_float64(side):
    mesh = hills(side).parts[0].mesh
    transport = prt.harmonic.precompute_diffuse(mesh, degree=2, size=8)
    camera = hills(side).cameras[0]
    true = prt.harmonic.project(LIGHT, degree=2)

    def radiance(light, eye):
        return prt.radiance(prt.harmonic.DiffuseSystem(transport, jnp.full(1, 0.5)), light, eye=eye)

    image = np.asarray(render(mesh, radiance(true, camera.eye), camera, samples=1))
    found = inverse.light(radiance, jnp.zeros_like(true), inverse.observe(mesh, [inverse.Picture(image, camera)]))
    assert np.linalg.norm(found.determined @ np.ravel(found.value - true)) < 1e-2 * np.linalg.norm(true)
