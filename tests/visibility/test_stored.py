"""Stored visibility against what is traced, level by level."""

from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import visibility
from jaxprt.scene import builtin
from jaxprt.scene.mesh import join
from jaxprt.visibility import Run, StoredVisibility, precompute

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


class Counting(ThreadPoolExecutor):
    """Counts what it is asked to do."""

    def __init__(self):
        super().__init__(1)
        self.count = 0

    def submit(self, *arguments, **options):
        """As the pool does."""
        self.count += 1
        return super().submit(*arguments, **options)


def forget(path, block):
    """Takes a block's checksum away."""
    checksum = np.load(path / "checksum.npy", mmap_mode="r+")
    checksum[block] = 0


def same(first, second):
    for field in ("level", "position", "frame"):
        np.testing.assert_array_equal(getattr(first, field), getattr(second, field))


def test_what_is_kept_is_what_is_traced_but_for_one_level(mesh, transport):
    level = traced(mesh)
    assert set(np.unique(level)) == set(range(17)), "the scene must have vertices that see every share of a texel"
    assert len(level) % 2
    np.testing.assert_array_equal(transport.seen(np.arange(len(level))), STORED[level])
    np.testing.assert_array_equal(transport.visible(jnp.arange(ALL)), STORED[level].T / 16)


def test_any_texels_of_any_vertices_are_read(mesh, transport):
    level = STORED[traced(mesh)]
    vertex, texel = np.array([5, 5, 0, 38, 31]), np.array([383, 0, 17, 17])
    seen = transport.seen(vertex)
    np.testing.assert_array_equal(seen, level[vertex])
    assert seen.dtype == np.uint8
    assert seen.flags.c_contiguous
    np.testing.assert_array_equal(transport.visible(jnp.array(texel)), level[:, texel].T / 16)


@pytest.mark.parametrize(
    "vertex",
    [
        np.array([30, 3, 3, -1]),
        np.arange(39) % 3 == 0,
        np.resize(np.arange(39)[::-1], 65),
        np.zeros(0, int),
    ],
    ids=["named", "mask", "a block and one more", "none"],
)
def test_any_selection_of_vertices_is_lit_while_all_cast_shadows(mesh, transport, vertex):
    some = precompute(mesh, size=SIZE, vertex=vertex)
    number = np.arange(39)[vertex]
    np.testing.assert_array_equal(some.seen(np.arange(len(number))), transport.seen(number))
    assert some.visible(jnp.arange(5)).shape == (5, len(number))
    np.testing.assert_array_equal(some.position, mesh.position[number])
    np.testing.assert_array_equal(some.frame, transport.frame[number])


def test_frames_are_orthonormal_with_the_normal_last(mesh, transport, close):
    np.testing.assert_allclose(transport.frame[:, 2], mesh.normal, atol=1e-6)
    close(np.einsum("vij,vkj->vik", transport.frame, transport.frame), np.tile(np.eye(3), (39, 1, 1)))


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


def test_a_store_is_resumed_and_only_what_is_missing_is_traced(mesh, tmp_path):
    path, vertex = tmp_path / "a.prt", np.resize(np.arange(39), 150)
    whole = precompute(mesh, size=SIZE, vertex=vertex)
    same(precompute(mesh, size=SIZE, vertex=vertex, run=Run(path)), whole)
    for lost, count in (((), 0), ((1,), 1), ((0, 2), 2)):
        for block in lost:
            forget(path, block)
        with Counting() as executor:
            same(precompute(mesh, size=SIZE, vertex=vertex, run=Run(path, executor)), whole)
            assert executor.count == count


def test_it_is_a_pytree_whose_leaves_are_its_arrays(transport):
    leaves, form = jax.tree.flatten(transport)
    assert len(leaves) == 3
    same(jax.tree.unflatten(form, leaves), transport)
    assert isinstance(transport, StoredVisibility)
