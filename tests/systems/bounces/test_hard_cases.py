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
from jaxprt.sphere import cubemap
from tests.systems.bounces.reflected import of_regions, radiance

SIZE = 8
REGION = 64  # vertices
OPTIONS = {"components": 16, "modes": 24, "edge": 2, "size": 8}
ONES = Environment(jax.device_put(np.ones((6, SIZE, SIZE, 1), np.float32)))
EYE = jnp.array([1.0, 4.0, 3.0])


@functools.cache
def lambert(albedo):
    return separable.factor(Lambert(albedo), terms=1, resolution=8)


def ball(*, height=0.0, flip=False):
    mesh = builtin.sphere(rings=6, sectors=8)
    position = mesh.position + jnp.array([0.0, height, 0.0])
    face = mesh.face[:, ::-1] if flip else mesh.face
    return make_mesh(position, face, normal=-mesh.normal if flip else mesh.normal)


def floor(cells=6, half=2.0):
    mesh = builtin.plane(cells=cells)
    return make_mesh(mesh.position * half, mesh.face, normal=mesh.normal)


def scene(*parts):
    """Regions of as many vertices in every scene, so that they are compiled once; the first of each comes again."""
    every = []
    for each in parts:
        index = np.pad(np.arange(len(each.position)), (0, REGION - len(each.position)))
        every.append(make_mesh(np.asarray(each.position)[index], each.face, normal=np.asarray(each.normal)[index]))
    return join(every)


def bounced(mesh, albedos, light=ONES):
    """Direct and reflected radiance of regions with given albedos."""
    models = [Lambert(albedo) for albedo in albedos]
    tensor = bounces.precompute(mesh, [lambert(albedo) for albedo in albedos], **OPTIONS)
    first = reference.radiance(mesh, Lambert(1.0), light, eye=EYE, error=np.inf)
    first = np.asarray(first) * np.asarray(albedos)[np.asarray(mesh.region)][:, None]
    more = np.asarray(radiance(of_regions(mesh, models, tensor), light, EYE))
    assert np.isfinite(more).all()
    return first, more, tensor


# Below the ground, through it, touching it, and above.
@pytest.mark.parametrize("height", [0.3, 0.9999, 1.0, 1.2])
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
    down = make_mesh(down.position - jnp.array([0.0, 0.5, 0.0]), down.face[:, ::-1], normal=-down.normal)
    _, more, tensor = bounced(scene(floor(), down), [1.0, 1.0])
    np.testing.assert_array_equal(more, 0)
    np.testing.assert_array_equal(tensor.worth, 0)
    assert np.isfinite(tensor.error).all()
    few = bounces.precompute(scene(floor(), down), [lambert(1.0)] * 2, **OPTIONS | {"bounces": 1}, least=0.01)
    assert few.function.size == 0


def test_black_surfaces_send_nothing_and_black_light_makes_nothing():
    mesh = scene(ball(height=1.2), floor())
    _, more, _ = bounced(mesh, [0.0, 0.0])
    np.testing.assert_array_equal(more, 0)
    first, more, _ = bounced(mesh, [1.0, 1.0], Environment(0 * ONES.radiance))
    np.testing.assert_array_equal(first + more, 0)


def test_backs_of_surfaces_send_nothing():
    """Inside a sphere whose front is outside: rays meet backs alone."""
    small = ball()
    inner = make_mesh(small.position * 0.3, small.face, normal=small.normal)
    hollow = scene(inner, ball())
    _, more, _ = bounced(hollow, [1.0, 1.0])
    assert np.abs(more[:REGION]).max() < 1e-6


def test_hits_on_degenerate_triangles_are_finite():
    """A floor with a triangle of no area, one of a point, and a vertex that no face uses.

    In place of the latter the other floor has one that looks down and sees nothing either, so that as many share what
    the components hold.
    """
    plain = floor()
    face = jnp.concatenate([plain.face, jnp.array([[0, 1, 1], [3, 3, 3], [0, 1, 2]])])
    position = jnp.concatenate([plain.position, jnp.array([[9.0, 9.0, 9.0]])])
    normal = jnp.concatenate([plain.normal, jnp.array([[0.0, 1.0, 0.0]])])
    broken = make_mesh(position, face, normal=normal)
    position, normal = position.at[-1].set(plain.position[0]), normal.at[-1].multiply(-1)
    plain = make_mesh(position, plain.face, normal=normal)
    _, more, _ = bounced(scene(ball(height=1.2), broken), [1.0, 1.0])
    _, exact, _ = bounced(scene(ball(height=1.2), plain), [1.0, 1.0])
    np.testing.assert_allclose(more, exact, atol=1e-4)


def test_a_sun_in_one_texel_reaches_no_vertex_twice_over():
    """Bounces have coarse texels: the light of one is spread over those around it, and its flux kept."""
    mesh = scene(ball(height=1.2), floor())
    sun = jnp.zeros((6, SIZE, SIZE, 1)).at[2, 3, 4].set(1e4)
    first, more, tensor = bounced(mesh, [1.0, 1.0], Environment(sun))
    soft = cubemap.coarse(sun, edge=2)
    flux = (float(jnp.sum(each.ravel() * cubemap.solid_angle(size=n).ravel())) for each, n in ((soft, 2), (sun, SIZE)))
    assert next(flux) == pytest.approx(next(flux), rel=1e-5)
    lit, again = (bounces.tensor.light_side(tensor, Environment(x)) for x in (sun, soft.reshape(6, 2, 2, 1)))
    for one, other in zip(jax.tree.leaves(lit), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-5 * np.abs(other).max())
    assert np.abs(more).max() < first.max()


def test_one_vertex_alone_in_a_region():
    """A region of a single triangle, far from all others."""
    up = jnp.tile(jnp.array([[0.0, 1.0, 0.0]]), (3, 1))
    far = make_mesh(jnp.array([[50.0, 0, 0], [51.0, 0, 0], [50.0, 0, -1.0]]), jnp.array([[0, 1, 2]]), normal=up)
    near = join([ball(height=1.2), floor(cells=3)])
    _, more, _ = bounced(scene(near, far), [1.0, 1.0])
    assert more[:REGION].max() > 0.05
    assert np.abs(more[REGION:]).max() < 1e-3
