"""Silhouettes in pictures: vertices look away from the eye where triangles around them are seen.

What systems make of such eyes is in tests/systems/test_protocol.py; texels and the reference are not among them.
"""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

import jaxprt as prt
from jaxprt.sphere import directions

ALBEDO = 0.5
QUADRATURE = 0.01  # Texels of 8 x 8 faces that the horizon cuts.
WHITE = prt.scene.Environment(jnp.ones((6, 8, 8, 1)))


@pytest.fixture(scope="module")
def scene():
    ball = trimesh.creation.icosphere(subdivisions=2)
    mesh = prt.scene.mesh.make_mesh(ball.vertices, ball.faces, normal=ball.vertices)
    camera = prt.scene.camera.orbit(mesh, elevation=0.3, width=48, height=48)
    return mesh, camera, prt.visibility.precompute(mesh, size=8)


def texels(mesh, visible, eye):
    texel, white = jnp.arange(384), jnp.ones((384, 1))
    return prt.bright_texels.radiance(visible, prt.brdf.Lambert(ALBEDO), texel, white, eye=eye)


def reference(mesh, visible, eye):
    seen = jnp.asarray(visible.seen(np.arange(len(visible.position))))
    return prt.reference.integrate(seen, visible.position, visible.frame, prt.brdf.Lambert(ALBEDO), WHITE, eye)


@pytest.mark.parametrize("system", [texels, reference])
def test_a_diffuse_ball_in_white_light_has_no_dark_rim(scene, system):
    mesh, camera, visible = scene
    color = system(mesh, visible, camera.eye)
    picture = np.asarray(prt.image.render(mesh, color, camera))[..., 0]
    coverage = np.mean(np.asarray(prt.image.rasterize(mesh, camera, samples=4).triangle) >= 0, -1)
    np.testing.assert_allclose(picture, ALBEDO * coverage, rtol=QUADRATURE)
    assert (coverage > 0).mean() > 0.5


def test_views_above_the_horizon_stay_and_those_below_are_raised_in_their_own_azimuth(close):
    frame = directions.frame(jnp.array([[0.0, 0.6, 0.8]] * 5), jnp.array([[1.0, 0, 0]] * 5))
    local = np.array([[0.6, 0, 0.8], [0, 1, 0], [0.6, 0, -0.8], [-0.36, 0.48, -0.8], [0, 0, -1]])
    position = -3 * jnp.einsum("vij,vi->vj", frame, jnp.asarray(local, jnp.float32))
    flat = np.sqrt(1 - 1e-4)
    expected = [[0.6, 0, 0.8], [0, flat, 0.01], [flat, 0, 0.01], [-0.6 * flat, 0.8 * flat, 0.01], [flat, 0, 0.01]]
    close(directions.view(frame, position, jnp.zeros(3)), np.array(expected))
