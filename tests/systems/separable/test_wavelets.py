"""Projection with visibility made by hand, and precomputation's own checks; no oracle here traces rays."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.ndimage

import jaxprt as prt
from benchmarks.published.factorization import factor_symmetric
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap, directions, haar
from jaxprt.systems.separable import SparseTransport, precompute
from jaxprt.systems.separable.sparse import compress, project

# The texels that the horizon cuts count with what of them is above in sum, not each ray: measured 7.7e-5 at worst.
HORIZON = 2e-4
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
    normal = random.normal(size=(count, 3))
    return directions.frame(directions.normalize(jnp.asarray(normal, jnp.float32)), jnp.zeros((count, 3)))


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


def transport_of(seen, frame, brdf, *, keep, position=None):
    index, value = compress(seen, frame, brdf, keep=keep)
    position = jnp.zeros((len(seen), 3)) if position is None else position
    return SparseTransport(index, value, position, frame, separable.sparse.rms(index, value, seen.shape[1]))


@pytest.mark.parametrize("size", [1, 2])
def test_products_with_light_equal_a_direct_sum_in_float64(random, factored, close, size):
    seen, frame = visible(random, 5, size), frames(random, 5)
    light = random.uniform(0, 3, size=(6, size, size, 3)).astype(np.float32)
    coefficient = separable.system.project(Environment(jnp.asarray(light)))
    product = jnp.einsum("bdr,dc->brc", project(seen, frame, factored)[..., 0], coefficient)
    close(product, direct_sum(seen, frame, factored, light.reshape(-1, 3), size))


def test_each_coefficient_comes_back_to_its_texel(random, factored, close):
    seen, frame = visible(random, 2, 8), frames(random, 2)
    coefficient = project(seen, frame, factored)
    texel = haar.inverse(coefficient.reshape(12, 8, 8, 3)).reshape(2, 384, 3)
    close(jnp.swapaxes(texel, 1, 2), direct_sum(seen, frame, factored, np.eye(384), 8))


def test_blocked_and_half_blocked_vertices_have_none_and_half_the_transport(random, factored):
    frame = frames(random, 3)
    whole, half, none = (project(jnp.full((3, 384), level, jnp.uint8), frame, factored) for level in (16, 8, 0))
    np.testing.assert_array_equal(none, 0)
    np.testing.assert_array_equal(half * 2, whole)


def test_unoccluded_lambert_under_constant_light_reflects_its_albedo(random):
    size, albedo = 64, np.array([1.0, 0.5, 0.0])
    frame = frames(random, 30)
    brdf = separable.factor(Lambert(albedo), terms=1, resolution=12)
    seen = jnp.full((30, 6 * size * size), 16, jnp.uint8)
    light = separable.system.project(Environment(jnp.ones((6, size, size, 3))))
    view = brdf.view(directions.normalize(jnp.asarray(np.abs(random.normal(size=(30, 3))), jnp.float32)))
    reflected = jnp.einsum("bdr,dc->brc", project(seen, frame, brdf)[..., 0], light)
    np.testing.assert_allclose(jnp.sum(reflected * view, 1), np.tile(albedo, (30, 1)), rtol=HORIZON, atol=1e-12)


def test_six_means_carry_all_of_constant_light():
    mean = np.zeros((6, 8, 8), bool)
    mean[:, 0, 0] = True
    light = separable.system.project(Environment(jnp.ones((6, 8, 8, 3))))
    np.testing.assert_array_equal(np.abs(light[:, 0]) > 1e-6, mean.ravel())


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


def test_kept_coefficients_are_the_best_approximation_of_their_number(random, factored):
    seen, frame = visible(random, 3, 8), frames(random, 3)
    dense = np.asarray(project(seen, frame, factored), np.float64)
    index, value = compress(seen, frame, factored, keep=50)
    lost = np.sum(dense**2, (1, 3)) - np.sum(np.asarray(value, np.float64) ** 2, (0, 3))
    smallest = np.sum(np.sort(dense[..., 0] ** 2, axis=1)[:, :-50], axis=1)
    np.testing.assert_allclose(lost, smallest, rtol=1e-4)
    assert index.shape == (50, 3, 3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": 2, "keep": 25}, "keep must be at most 24 and at least 1, got 25"),
        ({"size": 2, "keep": 0}, "keep must be at most 24 and at least 1, got 0"),
    ],
)
def test_impossible_sizes_are_refused(factored, options, message):
    with pytest.raises(ValueError, match=message):
        precompute(prt.scene.builtin.plane(cells=1), factored, **options)


@pytest.mark.usefixtures("unchecked")
def test_a_brdf_that_is_not_factored_is_refused():
    with pytest.raises(TypeError, match=r"must be factored, by jaxprt.separable.factor, got Lambert"):
        precompute(prt.scene.builtin.plane(cells=1), prt.brdf.Lambert(0.5), keep=4, size=2)
