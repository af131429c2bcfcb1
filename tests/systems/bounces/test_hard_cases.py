"""Reflected light where it is hard: touching and crossing surfaces, degenerate triangles, nothing to reflect."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import bounces, reference, separable
from jaxprt.brdf import Lambert
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join, make_mesh
from tests.systems.bounces.reflected import of_regions, radiance, repeated

SIZE = 8
REGION = 64  # vertices
OPTIONS = {"components": 16, "modes": 24, "edge": 2, "size": 8}
EYE = jnp.array([1.0, 4.0, 3.0])
ONES = Environment(jax.device_put(np.ones((6, SIZE, SIZE, 1), np.float32)))


@functools.cache
def lambert(albedo):
    return separable.factor(Lambert(albedo), terms=1, resolution=8)


def ball(*, height=0.0):
    mesh = builtin.sphere(rings=6, sectors=8)
    return make_mesh(np.asarray(mesh.position) + np.float32([0, height, 0]), mesh.face, normal=mesh.normal)


def floor(cells=6, half=2.0):
    mesh = builtin.plane(cells=cells)
    return make_mesh(np.asarray(mesh.position) * np.float32(half), mesh.face, normal=mesh.normal)


def scene(*parts):
    """Regions of as many vertices in every scene, so that they are compiled once."""
    return join([repeated(part, REGION) for part in parts])


@jax.jit
def reflected(system, light):
    return radiance(system, light, EYE)


def bounced(mesh, albedos, light=ONES):
    """Direct and reflected radiance of regions with given albedos."""
    models = [Lambert(albedo) for albedo in albedos]
    tensor = bounces.precompute(mesh, [lambert(albedo) for albedo in albedos], **OPTIONS)
    first = reference.radiance(mesh, Lambert(1.0), light, eye=EYE, error=np.inf)
    first = np.asarray(first) * np.asarray(albedos)[np.asarray(mesh.region)][:, None]
    more = np.asarray(reflected(of_regions(mesh, models, tensor), light))
    assert np.isfinite(more).all()
    return first, more, tensor


# Below the ground, through it, touching it, and above.
@pytest.mark.parametrize("height", [0.3, 1.0, 1.2])
def test_touching_and_interpenetrating_meshes_gain_no_energy(height):
    """With albedo 1 everywhere nothing shines brighter than the constant light."""
    mesh = scene(ball(height=height), floor())
    first, more, tensor = bounced(mesh, [1.0, 1.0])
    assert more.max() > 0.05
    assert (first + more).max() < 1.03  # Of 49 coarse vertices, whose harmonics ring.
    assert more.min() > -1e-6
    assert float(tensor.worth[0]) > float(tensor.worth[1]) > 0


def test_a_region_without_visible_neighbor_gets_nothing():
    """Two floors back to back: none sees the other, nor itself."""
    down = floor()
    below = np.asarray(down.position) - np.float32([0, 0.5, 0])
    down = make_mesh(below, np.asarray(down.face)[:, ::-1], normal=-np.asarray(down.normal))
    _, more, tensor = bounced(scene(floor(), down), [1.0, 1.0])
    np.testing.assert_array_equal(more, 0)
    np.testing.assert_array_equal(tensor.worth, 0)
    assert np.isfinite(tensor.error).all()


def test_black_surfaces_send_nothing_and_black_light_makes_nothing():
    mesh = scene(ball(height=1.2), floor())
    _, more, _ = bounced(mesh, [0.0, 0.0])
    np.testing.assert_array_equal(more, 0)
    first, more, _ = bounced(mesh, [1.0, 1.0], Environment(0 * ONES.radiance))
    np.testing.assert_array_equal(first + more, 0)


def test_backs_of_surfaces_send_nothing():
    """Inside a sphere whose front is outside: rays meet backs alone."""
    small = ball()
    inner = make_mesh(np.asarray(small.position) * np.float32(0.3), small.face, normal=small.normal)
    hollow = scene(inner, ball())
    _, more, _ = bounced(hollow, [1.0, 1.0])
    assert np.abs(more[:REGION]).max() < 1e-6


def test_hits_on_degenerate_triangles_are_finite():
    """A floor with a triangle of no area, one of a point, and a vertex that no face uses.

    In place of the latter the other floor has one that looks down and sees nothing either, so that as many share what
    the components hold.
    """
    plain = floor()
    face = np.concatenate([plain.face, [[0, 1, 1], [3, 3, 3], [0, 1, 2]]])
    position = np.concatenate([plain.position, np.float32([[9, 9, 9]])])
    normal = np.concatenate([plain.normal, np.float32([[0, 1, 0]])])
    broken = make_mesh(position, face, normal=normal)
    position[-1], normal[-1] = plain.position[0], [0, -1, 0]
    plain = make_mesh(position, plain.face, normal=normal)
    _, more, _ = bounced(scene(ball(height=1.2), broken), [1.0, 1.0])
    _, exact, _ = bounced(scene(ball(height=1.2), plain), [1.0, 1.0])
    np.testing.assert_allclose(more, exact, atol=1e-4)


def test_one_vertex_alone_in_a_region():
    """A region of a single triangle, far from all others."""
    far = make_mesh(np.array([[50.0, 0, 0], [51, 0, 0], [50, 0, -1]]), np.array([[0, 1, 2]]))
    near = join([ball(height=1.2), floor(cells=3)])
    _, more, _ = bounced(scene(near, far), [1.0, 1.0])
    assert more[:REGION].max() > 0.05
    assert np.abs(more[REGION:]).max() < 1e-3
