"""What every precomputation that traces rays promises: which vertices are lit, stores, and what is refused.

To add one, add a line to ``TRACED``.
"""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import harmonic, lamps, lobe, separable, visibility
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import builtin
from jaxprt.scene.mesh import join
from jaxprt.systems import axes

SIZE = 8


@functools.cache
def factored() -> separable.SeparableBrdf:
    return separable.factor(AshikhminShirley(nu=20, nv=20), terms=3, resolution=12)


def sparse(mesh, **options):
    return separable.precompute(mesh, factored(), keep=9, **options)


def lit(mesh, *, size, **options):
    ball = builtin.sphere(rings=3, sectors=4)
    lamp = dataclasses.replace(ball, position=ball.position + jnp.array([0.2, 3.0, -0.3]))
    return lamps.precompute(mesh, [lamp], samples=size, pieces=1, **options)


TRACED = {
    "visibility": visibility.precompute,
    "harmonic": functools.partial(harmonic.precompute, degree=1),
    "harmonic, diffuse": functools.partial(harmonic.precompute_diffuse, degree=1),
    "lobe": lobe.precompute,
    "separable": sparse,
    "lamps": lit,
}
each_precompute = pytest.mark.parametrize("name", TRACED)


@pytest.fixture(scope="module")
def mesh():
    """A sphere in a ground, 77 vertices: a block and a part of one."""
    return join([builtin.sphere(rings=6, sectors=10), builtin.plane(cells=4)])


def rows(transport, vertex=None):
    """Arrays of a transport with an axis of vertices, at some of them."""
    if isinstance(transport, visibility.StoredVisibility):
        vertex = np.arange(len(transport.position)) if vertex is None else vertex
        return [transport.seen(vertex), transport.position[vertex], transport.frame[vertex]]
    arrays = [(np.asarray(array), names.index("v")) for names, array in axes.leaves(transport) if "v" in names]
    return [array if vertex is None else np.take(array, vertex, axis) for array, axis in arrays]


def same(first, second):
    assert len(first) == len(second) > 1
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


@each_precompute
def test_any_selection_of_vertices_is_lit_in_any_order_while_all_cast_shadows(name, mesh):
    whole, numbers = TRACED[name](mesh, size=SIZE), np.arange(len(mesh.position))
    for vertex in (np.array([30, 3, 3, -1]), numbers % 3 == 0, np.zeros(0, int)):
        same(rows(TRACED[name](mesh, size=SIZE, vertex=vertex)), rows(whole, numbers[vertex]))


@each_precompute
def test_a_stopped_call_goes_on_where_it_was_and_stores_of_anything_else_are_refused(name, mesh, tmp_path):
    options = {"size": SIZE, "run": prt.Run(tmp_path / "deep" / "a.prt")}
    whole = rows(TRACED[name](mesh, **options))
    same(rows(TRACED[name](mesh, size=SIZE)), whole)
    checksum = np.load(tmp_path / "deep" / "a.prt" / "checksum.npy", mmap_mode="r+")
    both = checksum.tolist()
    assert len(both) == np.count_nonzero(both) == 2
    checksum[1] = 0
    same(rows(TRACED[name](mesh, **options)), whole)
    assert checksum.tolist() == both
    other = dataclasses.replace(mesh, position=mesh.position.at[5, 1].add(1e-2))
    changes = [{"size": 2 * SIZE}, {"vertex": np.arange(76)}, {"occluder": builtin.plane(cells=1)}]
    refused = [(name, mesh, options | change) for change in changes] + [(name, other, options)]
    refused += [(another, mesh, options) for another in TRACED if another != name]
    for another, given, changed in refused:
        with pytest.raises(ValueError, match=r"a\.prt holds arrays that were computed from other inputs"):
            TRACED[another](given, **changed)


@each_precompute
def test_meshes_that_are_not_finite_and_vertices_that_are_not_there_are_refused(name, mesh):
    for field in ("position", "normal", "tangent"):
        broken = dataclasses.replace(mesh, **{field: getattr(mesh, field).at[1, 0].set(jnp.nan)})
        with pytest.raises(ValueError, match="finite"):
            TRACED[name](broken, size=SIZE)
    for vertex in (np.array([0, 77]), np.array([-78]), np.array([0.5]), np.ones(38, bool)):
        with pytest.raises(ValueError, match=r"vertex must be a mask \[77\] or a 1-D array of indices below 77"):
            TRACED[name](mesh, size=SIZE, vertex=vertex)


@pytest.mark.parametrize("name", [name for name in TRACED if name != "lamps"])
def test_sizes_that_are_no_powers_of_two_are_refused(name, mesh):
    for size in (0, -8, 12):
        with pytest.raises(ValueError, match=f"size (must be )?a power of two.* got .*{size}"):
            TRACED[name](mesh, size=size)
