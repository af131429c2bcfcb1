"""Relighting with transport made by hand, and with traced transport under symmetries."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import separable
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.scene import Environment
from jaxprt.systems.separable import SparseTransport, factor
from jaxprt.systems.separable.factorization import mark_of
from jaxprt.systems.separable.sparse import compress

SIZE = 8
EYE = jnp.array([2.0, 3.0, 4.0])
COLORED = AshikhminShirley(diffuse=[0.6, 0.2, 0.1], specular=[0.2, 0.3, 0.7], nu=20, nv=60)


@pytest.fixture
def random():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def factored():
    return factor(COLORED, terms=3, resolution=12)


@pytest.fixture(scope="module")
def transport(factored):
    """Transport of seven vertices with random frames and visibility."""
    random = np.random.default_rng(4)
    frame, _ = np.linalg.qr(random.normal(size=(7, 3, 3)))
    frame = array(frame * np.linalg.det(frame)[:, None, None])
    seen = jnp.asarray(random.integers(17, size=(7, 6 * SIZE**2)), jnp.uint8)
    index, value = compress(seen, frame, factored, keep=40)
    position = array(random.normal(size=(7, 3)))
    return SparseTransport(index, value, position, frame, separable.sparse.rms(index, value, 6 * SIZE**2))


def array(value):
    """Values of NumPy in float32; operations of JAX outside of `jit` would be a program each."""
    return jnp.asarray(np.asarray(value), jnp.float32)


def some_light(random, colors=3):
    return Environment(array(random.uniform(0, 2, size=(6, SIZE, SIZE, colors))))


def white_light(*shape):
    return Environment(array(np.ones(shape or (6, SIZE, SIZE, 3))))


def unit(random):
    """Forty unit vectors."""
    vector = random.normal(size=(40, 3))
    return array(vector / np.linalg.norm(vector, axis=1, keepdims=True))


def relight(transport, factored, light, **options):
    return prt.radiance(separable.SeparableSystem(transport, factored), light, **({"eye": EYE} | options))


def test_gray_light_serves_a_brdf_in_color(transport, factored, close, random):
    gray = some_light(random, colors=1)
    color = Environment(array(np.repeat(gray.radiance, 3, axis=-1)))
    close(relight(transport, factored, gray), relight(transport, factored, color))


def test_view_tuples_are_the_view_maps_at_the_direction_to_the_eye(transport, factored, close):
    offset = np.asarray(EYE, np.float64) - np.asarray(transport.position, np.float64)
    local = np.einsum("vij,vj->vi", transport.frame, offset / np.linalg.norm(offset, axis=1, keepdims=True))
    above = local[:, 2] > 0.01
    expected = np.asarray(factored.view(array(local)))
    close(np.asarray(separable.SeparableSystem(transport, factored).view(EYE))[above], expected[above])


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", [(5, 8, 8, 3), (7, 8, 8, 3), (6, 8, 4, 3), (6, 4, 8, 3), (2, 6, 8, 8, 3), (384, 3)])
def test_only_one_light_of_six_square_faces_is_taken(transport, factored, shape):
    needed = r"(must be one environment \[6, (8, 8|n, n), c\]|'s radiance must be \[\.\.\., 6, n, n, c\]), got"
    with pytest.raises(ValueError, match="the light ?" + needed):
        separable.SeparableSystem(transport, factored).light(white_light(*shape))


def test_brdfs_with_another_number_of_terms_are_refused(transport, factored):
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        relight(transport, factored.truncate(2), white_light())


def test_transport_refuses_factors_that_it_was_not_made_of_wherever_values_are_known(transport, factored, random):
    known = eqx.tree_at(
        lambda t: t.mark, transport, jnp.asarray(mark_of(factored.light_map)), is_leaf=lambda x: x is None
    )
    light = some_light(random)
    expected = relight(transport, factored, light)
    maps = np.asarray(factored.light_map)
    rounded, turned = (
        eqx.tree_at(lambda b: b.light_map, factored, array(each))
        for each in (np.nextafter(maps, np.float32(np.inf)), maps * np.array([1, -1, 1])[:, None, None, None])
    )
    wrong = [turned, factor(Lambert(0.5), terms=3, resolution=12)]
    for each in (known, known.with_transpose(), known.truncate(40)):
        assert each.mark is not None
        for right in (factored, rounded):
            np.testing.assert_allclose(relight(each, right, light), expected, rtol=0.1, atol=0.1)
        for other in wrong:
            with pytest.raises(ValueError, match=r"the BRDF must be the one that .* differ from the transport's by \d"):
                relight(each, other, light)
    np.testing.assert_array_equal(
        relight(known.truncate(40, terms=2), factored.truncate(2), light).shape, expected.shape
    )
    traced = jax.jit(lambda brdf: relight(known, brdf, light))(turned)
    np.testing.assert_array_equal(traced.shape, expected.shape)
    slope = jax.grad(lambda value: jnp.sum(relight(eqx.tree_at(lambda t: t.value, known, value), factored, light)))
    assert np.isfinite(slope(known.value)).all()
