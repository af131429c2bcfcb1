"""Ranges of vertices: each gives the rows that the whole gives, and what is mapped is read by ranges."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import harmonic, lobe, separable, visibility
from jaxprt.scene import Environment, builtin
from jaxprt.systems import ranges

SIZE = 8
EYE = jnp.array([0.3, 0.8, 3.0])


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """Visibility of two blocks of vertices, mapped from its store."""
    path = tmp_path_factory.mktemp("ranges") / "a.prt"
    return visibility.precompute(builtin.sphere(rings=10, sectors=14), size=SIZE, run=prt.Run(path))


@pytest.fixture(scope="module")
def brdf():
    return separable.factor(prt.brdf.AshikhminShirley(), terms=2, resolution=8)


@pytest.fixture(scope="module")
def sparse(brdf):
    return separable.precompute(builtin.sphere(rings=10, sectors=14), brdf, keep=9, size=SIZE)


def pieces(value, function):
    """Rows of two ranges, one after another."""
    cut = (0, 64, len(value.position))
    return [function(ranges.take(value, *each)) for each in itertools.pairwise(cut)]


def test_ranges_of_a_saved_transport_relight_to_the_rows_of_the_whole(sparse, brdf, tmp_path):
    prt.files.save(tmp_path / "a.prt", sparse)
    mapped = prt.files.load(tmp_path / "a.prt")
    light = builtin.daylight(size=SIZE)
    rows = pieces(mapped, lambda part: prt.radiance(separable.SeparableSystem(part, brdf), light, eye=EYE))
    whole = prt.radiance(separable.SeparableSystem(sparse, brdf), light, eye=EYE)
    np.testing.assert_allclose(np.concatenate(rows), whole, rtol=1e-5, atol=1e-6)


def test_ranges_of_every_kind_of_transport_are_the_rows_of_its_arrays(sparse, seen):
    mesh = builtin.sphere(rings=10, sectors=14)
    matrices = harmonic.precompute(mesh, degree=1, size=SIZE)
    vectors = harmonic.precompute_diffuse(mesh, degree=1, size=SIZE)
    pyramids = lobe.compress(seen)
    for value, field, axis in (
        (sparse, "value", 1),
        (matrices, "matrix", 0),
        (vectors, "vector", 2),
        (pyramids, "pyramid", 0),
        (pyramids, "vector", 1),
    ):
        rows = np.concatenate(pieces(value, lambda part, field=field: getattr(part, field)), axis)
        np.testing.assert_array_equal(rows, getattr(value, field))
    texel = jnp.asarray(np.arange(5, dtype=np.int32))
    np.testing.assert_array_equal(
        np.concatenate(pieces(seen, lambda part: part.visible(texel)), 1), seen.visible(texel)
    )


def test_ranges_beyond_the_vertices_empty_or_within_a_block_are_refused(sparse, seen):
    for start, stop in ((0, 129), (5, 5), (-1, 4), (9, 3)):
        with pytest.raises(ValueError, match=f"the range must be within 128 vertices, got {start} to {stop}"):
            ranges.take(sparse, start, stop)
    with pytest.raises(ValueError, match="must begin at a multiple of 64 vertices, got 5"):
        ranges.take(seen, 5, 70)
    assert ranges.take(sparse, 5, 70).position.shape == (65, 3)


def test_what_has_no_vertices_or_clusters_of_them_is_refused(seen, brdf):
    clustered = separable.clustered.precompute(seen, brdf, keep=20)
    for value, name in ((brdf, "SeparableBrdf"), (clustered, "ClusteredTransport")):
        with pytest.raises(TypeError, match=f"value must .*, got (a )?{name}"):
            ranges.take(value, 0, 3)


def test_ranges_of_a_part_of_a_scene_are_rows_of_the_part(close):
    ball, floor = builtin.sphere(rings=8, sectors=12), builtin.plane(cells=8)
    parts = [prt.Part("ball", ball, prt.brdf.Lambert(0.5)), prt.Part("floor", floor, prt.brdf.Lambert(0.5))]
    relit = prt.precompute(prt.Scene(parts), refine=False, system="harmonic", size=SIZE, progress=False)
    light = builtin.daylight(size=SIZE)
    whole, system = relit.radiance(light, eye=EYE), relit.part_system(1)
    assert system.vertices == len(floor.position)
    rows = prt.radiance(ranges.take(system, 3, 70), light, eye=EYE)
    close(rows, np.asarray(whole)[len(ball.position) :][3:70], tolerance=1e-5)
    for value in (ball, relit, prt.total(system, system)):  # no systems of one mesh
        with pytest.raises(TypeError, match="value must be a"):
            ranges.take(value, 0, 2)


def test_ranges_of_transport_with_its_transpose_have_the_gradients_of_their_rows(sparse, brdf, close):
    light = builtin.daylight(size=SIZE)

    def slope(transport, rows):
        system = separable.SeparableSystem(transport, brdf)
        total = jax.jit(jax.grad(lambda r: jnp.sum(prt.radiance(system, Environment(r), eye=EYE)[rows] ** 2)))
        return total(light.radiance)

    part = ranges.take(sparse.with_transpose(), 64, 128)
    close(slope(part, slice(None)), slope(sparse, slice(64, 128)), tolerance=1e-4)
