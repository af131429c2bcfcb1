"""The separable system: degenerate input gives finite, bounded radiance."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import bright_texels, reference, separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment, builtin
from jaxprt.scene.mesh import join
from jaxprt.sphere import directions
from jaxprt.systems.separable import SeparableBrdf, factor, precompute
from jaxprt.systems.separable.sparse import project
from jaxprt.visibility import members
from jaxprt.visibility import precompute as see

SIZE = 8
ALL = 6 * SIZE**2
EYE = jnp.array([1.0, 2.0, 3.0])
# All coefficients are kept: what is left is rounding, relative to the largest radiance, and for Lambert alone the
# one term of a factorization in float32.
HORIZON = 1e-3  # Texels of 8 x 8 faces that the horizon cuts, by 2 x 2 points in each: measured 7.5e-4 at worst.
EXACT = 2e-4


@pytest.fixture(scope="module")
def lambert():
    return factor(Lambert([0.8, 0.5, 0.2]), terms=1, resolution=12)


@pytest.fixture(scope="module")
def light():
    return builtin.daylight(size=SIZE)


def sphere():
    return builtin.sphere(rings=5, sectors=8)


def moved(mesh, *, scale=1.0, shift=0.0):
    position = np.asarray(mesh.position) * np.float32(scale) + np.float32(shift)
    return eqx.tree_at(lambda m: m.position, mesh, jax.device_put(position))


def repeated(mesh, vertex):
    """Vertices again and again, all of them if None, up to a number that all tests share: compiling takes the time."""
    vertex = np.arange(len(mesh.position)) if vertex is None else vertex
    return len(vertex), np.resize(vertex, 64 if len(vertex) <= 64 else 128)


def relight(mesh, brdf, light, *, keep=24, eye=EYE, vertex=None):
    """Radiance, checked to be finite."""
    count, vertex = repeated(mesh, vertex)
    transport = precompute(mesh, brdf, keep=keep, size=SIZE, vertex=vertex)
    color = np.asarray(prt.radiance(separable.SeparableSystem(transport, brdf), light, eye=eye))
    assert color.shape == (len(vertex), 3)
    assert np.isfinite(color).all()
    return color[:count]


def exact_radiance(mesh, brdf, light, *, eye=EYE, vertex=None, error=1e-5):
    count, vertex = repeated(mesh, vertex)
    return np.asarray(reference.radiance(mesh, brdf, light, eye=eye, vertex=vertex, error=error))[:count]


def known_error(mesh, color, light, *, albedo=(0.8, 0.5, 0.2), keep=24, eye=EYE, vertex=None):
    """Largest deviation from exact radiance, checked to be no more than the coefficients that were dropped can make."""
    exact = exact_radiance(mesh, Lambert(list(albedo)), light, eye=eye, vertex=vertex)
    error = np.abs(color - exact).max()
    assert (color >= -error - 1e-6).all()
    return error / max(np.abs(exact).max(), 1e-30)


def sun(strength):
    """Half of the light, or so, in one texel."""
    radiance = np.ones((6, SIZE, SIZE, 3), np.float32)
    radiance[2, 3, 4] = strength
    return Environment(jax.device_put(radiance))


@pytest.mark.parametrize("strength", [384.0, 1e30])
def test_a_sun_in_one_texel_is_that_of_the_reference(lambert, strength):
    mesh, light = sphere(), sun(strength)
    color = relight(mesh, lambert, light, keep=ALL)
    exact = exact_radiance(mesh, Lambert([0.8, 0.5, 0.2]), light)
    np.testing.assert_allclose(color / strength, exact / strength, atol=1e-5)


def test_the_error_falls_as_more_is_kept(lambert, light):
    mesh = join([sphere(), moved(builtin.plane(cells=3), scale=2.0, shift=[0, -1.2, 0])])
    error = [known_error(mesh, relight(mesh, lambert, light, keep=keep), light) for keep in (1, 24, ALL)]
    assert error[0] > error[1] > error[2]
    assert error[2] < EXACT


@pytest.fixture(scope="module")
def seen():
    """Visibility from the 38 vertices of a sphere that lies on a ground."""
    return see(join([moved(sphere(), shift=[0, 1, 0]), builtin.plane(cells=1)]), size=SIZE)


# Two clusters of ten vertices, two of nine. All is kept, so that what is left is the rounding of half precision.
KEPT = {"clusters": 4, "components": 10, "modes": 30, "keep": ALL}
HALF = 2e-3


def clustered_radiance(seen, brdf, light, **options):
    """Radiance by clustered transport, every number of which is checked to be finite."""
    transport = separable.clustered.precompute(seen, brdf, **KEPT | options)
    for name in ("mode", "core", "weight", "rms"):
        assert np.isfinite(np.asarray(getattr(transport, name), np.float64)).all(), name
    color = np.asarray(prt.radiance(separable.SeparableSystem(transport, brdf), light, eye=EYE))
    assert np.isfinite(color).all()
    return color


def all_texels(seen, brdf, light):
    """Radiance of a BRDF, factored or not, with the same visibility and no compression."""
    level = jnp.asarray(seen.seen(np.arange(len(seen.position))))
    if not isinstance(brdf, SeparableBrdf):
        return np.asarray(reference.integrate(level, seen.position, seen.frame, brdf, light, EYE, error=1e-5))
    met = np.einsum("vdrl,dc->vrc", project(level, seen.frame, brdf), separable.system.project(light))
    return np.sum(met * np.asarray(brdf.view(directions.view(seen.frame, seen.position, EYE))), 1)


def blind(seen, vertex):
    """The same where some vertices see nothing."""
    level = np.asarray(seen.level).copy()
    for each in vertex:
        block, place = divmod(int(each), 64)
        level[block, :, place % 32] &= 0xF0 if place < 32 else 0x0F
    dark = eqx.tree_at(lambda t: t.level, seen, jnp.asarray(level))
    assert not dark.seen(np.asarray(vertex)).any()
    return dark


@pytest.mark.parametrize("exponents", [(0, 0), (1, 1000)])
def test_clusters_hold_dull_sharp_and_brushed_brdfs(seen, light, close, exponents):
    brdf = AshikhminShirley(diffuse=[0.3, 0.2, 0.1], specular=0.5, nu=exponents[0], nv=exponents[1])
    factored = factor(brdf, terms=3, resolution=12)
    expected = all_texels(seen, factored, light)
    close(clustered_radiance(seen, factored, light), expected, tolerance=HALF)
    assert expected.any()


def test_clusters_of_one_vertex_are_that_vertex(seen, light, close):
    count, glossy = (
        len(seen.position),
        factor(AshikhminShirley(diffuse=0.3, specular=0.5, nu=20), terms=3, resolution=12),
    )
    color = clustered_radiance(seen, glossy, light, clusters=count, components=1, modes=3)
    close(color, all_texels(seen, glossy, light), tolerance=HALF)


@pytest.mark.parametrize("which", ["one vertex", "a cluster"])
def test_vertices_that_see_nothing_are_black_and_the_others_as_they_were(seen, light, close, which):
    brdf = factor(AshikhminShirley(diffuse=[0.3, 0.2, 0.1], specular=0.5), terms=3, resolution=12)
    member = members.cluster(seen.position, seen.frame[:, 2], clusters=4)
    vertex = {"one vertex": member[1, :1], "a cluster": member[1]}[which]
    color = clustered_radiance(blind(seen, vertex), brdf, light)
    expected = all_texels(seen, brdf, light).copy()
    expected[vertex] = 0
    close(color, expected, tolerance=HALF)
    if which != "one vertex":  # Alone in its cluster it is as black as half precision has it.
        assert not color[vertex].any()


def test_a_sun_by_its_texel_and_the_rest_by_clusters_are_the_reference(seen, close):
    brdf, light = Lambert([0.8, 0.5, 0.2]), sun(1e6)
    texel, excess, rest = bright_texels.split(light, count=1)
    assert np.asarray(rest.radiance).max() < 3
    bright = np.asarray(bright_texels.radiance(seen, brdf, texel, excess, eye=EYE))
    color = bright + clustered_radiance(seen, factor(brdf, terms=3, resolution=12), rest)
    expected = all_texels(seen, brdf, light)
    # What is compressed is off by half precision, the sun is not.
    close(color, expected, tolerance=HALF * np.linalg.norm(expected - bright) / np.linalg.norm(expected) + 1e-5)
    assert bright.any()


# Holes, colors of NaN, indices from the end, polygons, one normal for many vertices, triangles alone.
AWKWARD = ["busted.STL", "nancolor.obj", "negative_indices.obj", "polygonfaces.obj", "singlevn.obj", "soup.stl"]


@pytest.mark.parametrize("name", AWKWARD)
def test_awkward_meshes_are_lit_like_the_reference(data, lambert, light, name):
    mesh = prt.scene.load_mesh(data / "meshes_awkward" / name)
    count = len(mesh.position)
    # One number of vertices for all, so that they are compiled once.
    vertex = np.resize(np.random.default_rng(0).permutation(count), 64)
    low, high = prt.scene.mesh.bounds(mesh)
    eye = jnp.asarray((low + high) / 2 + np.linalg.norm(high - low) * np.array([0.5, 0.7, 1.1]), jnp.float32)
    color = relight(mesh, lambert, light, keep=ALL, eye=eye, vertex=vertex)
    error = known_error(mesh, color, light, eye=eye, vertex=vertex)
    assert error < HORIZON
    assert color.any()
