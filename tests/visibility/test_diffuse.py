from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxprt import brdf, reference
from jaxprt.scene import Environment, builtin, light_samples, subdivision
from jaxprt.scene.builtin import assemble, patch
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.scene.subdivision import Edges
from jaxprt.visibility.diffuse import DiffuseTracer


@pytest.fixture
def pool():
    with ThreadPoolExecutor(2) as made:
        yield made


@pytest.fixture(scope="module")
def light() -> Environment:
    return Environment(jnp.asarray(np.random.default_rng(0).random((6, 8, 8, 3)) + 0.1, jnp.float32))


def turned_cube():
    """A cube with creases that stands on a corner, its faces with vertices of their own."""
    box = trimesh.creation.box(extents=[1, 1, 1], transform=trimesh.transformations.euler_matrix(0.6, 0.7, 0.2))
    return make_mesh(np.asarray(box.vertices)[np.asarray(box.faces)].reshape(-1, 3), np.arange(36).reshape(-1, 3))


def plane(height):
    return assemble(
        [patch([[[-2, height, -2], [2, height, -2]], [[-2, height, 2], [2, height, 2]]], rows=2, columns=3)]
    )


def sheet():
    """Two surfaces on the same places, back to back."""
    upper = plane(0.7)
    return join([upper, make_mesh(np.asarray(upper.position), np.asarray(upper.face)[:, ::-1])])


def test_light_at_vertices_is_the_exact_sum(light, pool, close):
    mesh = join([builtin.sphere(rings=4, sectors=6), plane(-1.3)])
    tracer = DiffuseTracer(mesh, mesh, light_samples.importance([light], count=1 << 13), pool)
    exact = reference.radiance(mesh, brdf.Lambert(1.0), light, eye=jnp.array([0.0, 3, 0]))
    close(tracer.at_vertices()[:, 0], np.asarray(exact), tolerance=1e-2)


@pytest.mark.parametrize(
    "mesh",
    [join([turned_cube(), plane(-0.5)]), join([sheet(), plane(-0.5)]), builtin.sphere(rings=4, sectors=6)],
    ids=["creases and contact", "sheet", "seam"],
)
def test_light_in_the_middle_of_edges_is_what_a_vertex_there_gets(mesh, light, pool, close):
    samples = light_samples.importance([light], count=300)
    tracer = DiffuseTracer(mesh, mesh, samples, pool)
    edges = Edges(mesh.position, mesh.face)
    division = edges.divide(edges.closed(np.ones(len(edges.length), bool)))
    divided = subdivision.subdivide(mesh, [division])
    count = len(mesh.position)
    position = np.asarray(divided.position)
    normal = np.concatenate([mesh.normal, subdivision.middle_normal(np.asarray(mesh.normal), division.parent)])
    offset = tracer.offset[division.origin]
    found, _ = tracer.at(position, normal, division.face, offset, division.face, np.arange(count, len(position)))
    close(found, DiffuseTracer(divided, divided, samples, pool).at_vertices()[count:], tolerance=1e-3)


def test_an_occluder_may_have_the_surface_or_not_or_a_part_of_it(light, pool):
    samples = light_samples.importance([light], count=8)
    ground, cube = plane(-0.5), turned_cube()
    both = join([ground, cube])
    made = DiffuseTracer(both, both, samples, pool)
    assert made.casts.all()
    assert not made.double.any()
    made = DiffuseTracer(both, cube, samples, pool)
    np.testing.assert_array_equal(made.casts, np.arange(len(both.face)) >= len(ground.face))
    assert not DiffuseTracer(ground, cube, samples, pool).casts.any()
    made = DiffuseTracer(join([sheet(), cube]), both, samples, pool)
    np.testing.assert_array_equal(made.double, np.arange(24 + 12) < 24)
    np.testing.assert_array_equal(made.casts, np.arange(24 + 12) >= 24)


def test_no_points_have_no_light(light, pool):
    tracer = DiffuseTracer(plane(0), plane(0), light_samples.importance([light, light], count=8), pool)
    none = np.zeros((0, 3), int)
    found, buried = tracer.at(np.zeros((0, 3)), np.zeros((0, 3)), none, tracer.offset[:0], none, none[:, 0])
    assert (found.shape, buried.shape) == ((0, 2, 3), (0,))
