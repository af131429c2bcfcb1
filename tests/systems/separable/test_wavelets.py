"""Projection with visibility made by hand, and precomputation's own checks; no oracle here traces rays."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import jaxprt as prt
from benchmarks.published.factorization import factor_symmetric
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.systems.separable import SparseTransport, precompute
from jaxprt.systems.separable.sparse import compress, project

EXACT = 1e-4  # Two orders of summing a thousand float32 products of both signs.
COLORED = AshikhminShirley(diffuse=[0.6, 0.2, 0.1], specular=[0.2, 0.3, 0.7], nu=20, nv=20)


@pytest.fixture
def random():
    return np.random.default_rng(3)


@pytest.fixture(scope="module")
def factored():
    """Three terms, gray light maps."""
    return separable.factor(COLORED, terms=3, resolution=12)


def frames(random, count):
    normal = directions.normalize(random.normal(size=(count, 3)).astype(np.float32))
    return directions.frame(normal, np.zeros((count, 3), np.float32))


def visible(random, count, size):
    return jnp.asarray(random.integers(17, size=(count, 6 * size * size)), jnp.uint8)


def direct_sum(seen, frame, brdf, light, size):
    """Sum over 2 x 2 Gauss points of light x light map x visibility x cosine, in float64 and by SciPy's lookup."""
    seen, frame, light = (np.asarray(each, np.float64) for each in (seen, frame, light))
    light_map = np.asarray(brdf.light_map, np.float64)
    result = np.zeros((len(seen), brdf.terms, light.shape[-1]))
    offset = np.sqrt(1 / 3) / size
    for right, down in itertools.product((-offset, offset), repeat=2):
        point = np.asarray(cubemap.point(size=size), np.float64)
        s, t = cubemap.axes()[:, None, None, 0], cubemap.axes()[:, None, None, 1]
        point = (point + right * s + down * t).reshape(-1, 3)
        length = np.linalg.norm(point, axis=1, keepdims=True)
        for vertex, axes in enumerate(frame):
            local = point / length @ axes.T
            coordinates = np.asarray(brdf.coordinates(jnp.asarray(local, jnp.float32)), np.float64)
            place = coordinates[:, ::-1].T * light_map.shape[1] - 0.5
            flux = np.maximum(local[:, 2], 0) / length[:, 0] ** 3 / size**2 * seen[vertex] / 16
            for term, color in np.ndindex(brdf.terms, light_map.shape[-1]):
                value = scipy.ndimage.map_coordinates(light_map[term, ..., color], place, order=1, mode="nearest")
                own = slice(None) if light_map.shape[-1] == 1 else slice(color, color + 1)
                result[vertex, term, own] += (value * flux) @ light[:, own]
    return result


def transport_of(seen, frame, brdf, *, keep, position):
    index, value = compress(seen, frame, brdf, keep=keep)
    return SparseTransport(index, value, position, frame, separable.sparse.rms(index, value, seen.shape[1]))


def test_each_coefficient_comes_back_to_its_texel(random, factored, close):
    seen, frame = visible(random, 6, 8), frames(random, 6)
    coefficient = project(seen, frame, factored)
    texel = np.asarray(haar.inverse(np.asarray(coefficient).reshape(36, 8, 8, 3))).reshape(6, 384, 3)
    close(texel.swapaxes(1, 2), direct_sum(seen, frame, factored, np.eye(384), 8))


@pytest.mark.parametrize("per_color", [False, True], ids=["joint colors", "published, per color"])
def test_all_coefficients_and_the_view_maps_make_the_radiance_of_a_sum_in_float64(random, factored, close, per_color):
    brdf = factor_symmetric(COLORED, terms=3, resolution=12) if per_color else factored
    seen, frame = visible(random, 6, 8), frames(random, 6)
    position = jnp.asarray(random.normal(size=(6, 3)), jnp.float32)
    transport = transport_of(seen, frame, brdf, keep=384, position=position)
    assert transport.value.shape == (384, 6, 3, 3 if per_color else 1)
    light = Environment(jnp.asarray(random.uniform(size=(6, 8, 8, 3)), jnp.float32))
    eye = jnp.array([3.0, 5, -2])
    wo = directions.view(frame, position, eye)
    met = direct_sum(seen, frame, brdf, light.radiance.reshape(-1, 3), 8)
    expected = np.sum(met * np.asarray(brdf.view(wo), np.float64), 1)
    close(prt.radiance(prt.separable.SeparableSystem(transport, brdf), light, eye=eye), expected, tolerance=EXACT)
    assert np.count_nonzero(np.asarray(expected)) > 3


@pytest.mark.usefixtures("unchecked")
def test_impossible_sizes_and_brdfs_that_are_not_factored_are_refused(factored):
    for keep in (25, 0):
        with pytest.raises(ValueError, match=f"keep must be at most 24 and at least 1, got {keep}"):
            precompute(prt.scene.builtin.plane(cells=1), factored, size=2, keep=keep)
    with pytest.raises(TypeError, match=r"must be factored, by jaxprt.separable.factor, got Lambert"):
        precompute(prt.scene.builtin.plane(cells=1), prt.brdf.Lambert(0.5), keep=4, size=2)


def test_transport_refuses_factors_that_it_was_not_made_of_wherever_values_are_known(factored):
    known = precompute(prt.scene.builtin.plane(cells=1), factored, keep=9, size=8)
    maps = np.asarray(factored.light_map)
    turned = separable.SeparableBrdf(
        jnp.asarray(maps * np.float32([1, -1, 1])[:, None, None, None]), factored.view_map, factored.error
    )
    for transport in (known, known.with_transpose(), known.truncate(5)):
        separable.SeparableSystem(transport, factored)
        with pytest.raises(ValueError, match=r"the BRDF must be the one that .* differ from the transport's by \d"):
            separable.SeparableSystem(transport, turned)
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        separable.SeparableSystem(known, factored.truncate(2))
    traced = jax.eval_shape(lambda brdf: separable.SeparableSystem(known, brdf), turned)  # Its values are not known.
    assert traced.brdf.terms == 3


@pytest.mark.usefixtures("unchecked")
def test_only_one_light_of_six_square_faces_is_taken(factored):
    system = separable.SeparableSystem(precompute(prt.scene.builtin.plane(cells=1), factored, keep=9, size=8), factored)
    needed = r"(must be one environment \[6, (8, 8|n, n), c\]|'s radiance must be \[\.\.\., 6, n, n, c\]), got"
    for shape in ((5, 8, 8, 3), (6, 8, 4, 3), (2, 6, 8, 8, 3), (384, 3)):
        with pytest.raises(ValueError, match="the light ?" + needed):
            system.light(Environment(jnp.asarray(np.ones(shape, np.float32))))
