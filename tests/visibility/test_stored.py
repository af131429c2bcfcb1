"""Stored visibility against what is traced, level by level."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import visibility
from jaxprt.scene import builtin
from jaxprt.scene.mesh import join
from jaxprt.visibility import precompute

SIZE = 8
ALL = 6 * SIZE**2
STORED = np.arange(17) - (np.arange(17) == 9)  # Of the seventeen levels nine becomes eight.


@pytest.fixture(scope="module")
def mesh():
    """A sphere on a ground, 39 vertices: an odd number, less than a block."""
    return join([builtin.sphere(rings=5, sectors=7), builtin.plane(cells=2)])


@pytest.fixture(scope="module")
def transport(mesh):
    return precompute(mesh, size=SIZE)


def traced(mesh, *, occluder=None, size=SIZE):
    """Visibility of all vertices in sixteenths, without the package's block loop and storage."""
    rays = visibility.Occluder(mesh if occluder is None else occluder)
    start, normal = visibility.start_points(mesh, rays), np.asarray(mesh.normal, np.float32)
    return visibility.fractional(rays, start, normal, size=size)[0]


def test_what_is_kept_is_what_is_traced_but_for_one_level(mesh, transport):
    level = traced(mesh)
    assert set(np.unique(level)) == set(range(17)), "the scene must have vertices that see every share of a texel"
    assert len(level) % 2
    np.testing.assert_array_equal(transport.seen(np.arange(len(level))), STORED[level])
    np.testing.assert_array_equal(transport.visible(jnp.asarray(np.arange(ALL))), STORED[level].T / 16)
    np.testing.assert_allclose(np.asarray(transport.frame)[:, 2], mesh.normal, atol=1e-6)
    axes = np.asarray(transport.frame)
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), np.tile(np.eye(3), (39, 1, 1)), atol=1e-6)


def test_any_texels_of_any_vertices_are_read(mesh, transport):
    level = STORED[traced(mesh)]
    vertex, texel = np.array([5, 5, 0, 38, 31]), np.array([383, 0, 17, 17])
    seen = transport.seen(vertex)
    np.testing.assert_array_equal(seen, level[vertex])
    assert seen.dtype == np.uint8
    assert seen.flags.c_contiguous
    np.testing.assert_array_equal(transport.visible(jnp.array(texel)), level[:, texel].T / 16)


def test_the_size_is_that_of_the_light_and_two_vertices_take_a_byte(transport):
    assert transport.size == SIZE
    # Vertices are stored by blocks of 64.
    assert transport.nbytes == ALL * visibility.rays.BLOCK // 2 == transport.level.size
    small = precompute(builtin.plane(cells=1), size=1)
    assert (small.size, small.texels) == (1, 6)
    # From a plane that faces up, +y is seen whole, -y not at all.
    np.testing.assert_array_equal(small.visible(jnp.array([2, 3])), [[1] * 4, [0] * 4])


def test_another_occluder_casts_the_shadows(mesh):
    sheet = builtin.plane(cells=1)
    some = precompute(mesh, size=SIZE, occluder=sheet)
    np.testing.assert_array_equal(some.seen(np.arange(39)), STORED[traced(mesh, occluder=sheet)])
