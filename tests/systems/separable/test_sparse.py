from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import separable
from jaxprt.systems.separable import SparseTransport


@pytest.fixture
def random():
    return np.random.default_rng(0)


def make(coefficient, keep):
    """Transport from dense coefficients [v d r l]."""
    index, value = separable.sparse.largest(jnp.asarray(coefficient, jnp.float32), keep=keep)
    vertices, count = coefficient.shape[:2]
    frame = jnp.broadcast_to(jnp.eye(3), (vertices, 3, 3))
    return SparseTransport(index, value, jnp.zeros((vertices, 3)), frame, separable.sparse.rms(index, value, count))


def dense(transport):
    """[v d r l] again, by plain loops over what is stored."""
    index, value = np.asarray(transport.index), np.asarray(transport.value, np.float64)
    kept, vertices, terms = index.shape
    result = np.zeros((vertices, transport.rms.shape[0], terms, value.shape[3]))
    for place in np.ndindex(kept, vertices, terms):
        _, vertex, term = place
        result[vertex, index[place], term] += value[place]
    return result


@pytest.mark.parametrize("colors", [1, 3])
def test_the_largest_are_kept_in_falling_order(random, colors):
    coefficient = random.normal(size=(5, 24, 2, colors))
    transport = make(coefficient, 7)
    size = np.linalg.norm(coefficient, axis=-1)
    np.testing.assert_array_equal(np.moveaxis(transport.index, 0, 1), np.argsort(-size, axis=1)[:, :7])
    kept = np.linalg.norm(transport.value, axis=-1)
    assert np.all(np.diff(kept, axis=0) <= 0)
    expected = np.where(size < np.sort(size, axis=1)[:, -7, None], 0, 1)[..., None] * coefficient
    np.testing.assert_allclose(dense(transport), expected, rtol=1e-6)


def test_rows_with_few_coefficients_are_padded_with_index_zero_and_value_zero():
    coefficient = np.zeros((2, 24, 2, 1))
    coefficient[0, 5, 0], coefficient[1, 23, 1] = 3, -2
    transport = make(coefficient, 4)
    index, value = np.asarray(transport.index), np.asarray(transport.value)
    assert (index[0, 0, 0], value[0, 0, 0, 0]) == (5, 3)
    assert (index[0, 1, 1], value[0, 1, 1, 0]) == (23, -2)
    assert np.count_nonzero(index) == np.count_nonzero(value) == 2


def test_of_equal_coefficients_the_first_come_first():
    coefficient = np.ones((4, 24, 1, 1)) * np.where(np.arange(24) % 2, 1, -1)[:, None, None]
    index, value = separable.sparse.largest(jnp.asarray(coefficient), keep=9)
    np.testing.assert_array_equal(index[..., 0], np.tile(np.arange(9)[:, None], (1, 4)))
    np.testing.assert_array_equal(value[:, 0, 0, 0], [-1, 1, -1, 1, -1, 1, -1, 1, -1])


def test_indices_are_as_small_as_they_can_be():
    for count, dtype in ((6, "uint16"), (1 << 16, "uint16"), (6 * 128 * 128, "uint32")):
        coefficient = jnp.zeros((1, count, 1, 1)).at[0, -1].set(1)
        index, _ = separable.sparse.largest(coefficient, keep=2)
        assert index.dtype == dtype
        assert index[0, 0, 0] == count - 1


@pytest.mark.parametrize("keep", [0, 25])
def test_an_impossible_number_to_keep_is_refused(keep):
    with pytest.raises(ValueError, match=f"keep must be between 1 and 24, got {keep}"):
        separable.sparse.largest(jnp.zeros((1, 24, 1, 1)), keep=keep)


@pytest.mark.parametrize(("colors", "light_colors"), [(1, 1), (1, 3), (3, 3)])
def test_apply_is_the_dense_product(random, close, colors, light_colors):
    transport = make(random.normal(size=(6, 24, 3, colors)), 9)
    light = random.normal(size=(24, light_colors)).astype(np.float32)
    expected = np.einsum("vdrc,dc->vrc", np.broadcast_to(dense(transport), (6, 24, 3, light_colors)), light)
    close(transport.apply(jnp.asarray(light)), expected)


def test_kept_prefixes_are_what_the_smaller_number_would_have_kept(random):
    coefficient = random.normal(size=(5, 24, 4, 1))
    fewer, expected = make(coefficient, 20).truncate(6, terms=3), make(coefficient[:, :, :3], 6)
    for field in ("index", "value", "rms", "position", "frame"):
        np.testing.assert_array_equal(getattr(fewer, field), getattr(expected, field))
    assert fewer.nbytes == 5 * 6 * 3 * (2 + 4)


@pytest.mark.parametrize("count", [0, 21])
def test_keeping_more_than_there_are_is_refused(random, count):
    with pytest.raises(ValueError, match=f"count must be between 1 and 20, got {count}"):
        make(random.normal(size=(2, 24, 1, 1)), 20).truncate(count)


@pytest.mark.parametrize("terms", [-1, 0, 5])
def test_keeping_an_impossible_number_of_terms_is_refused(random, terms):
    transport = make(random.normal(size=(2, 24, 4, 3)), 20)
    with pytest.raises(ValueError, match=f"terms must be between 1 and 4, got {terms}"):
        transport.truncate(6, terms=terms)


def test_lights_of_another_number_of_coefficients_are_refused(random):
    """Numbers that the light lacks were read from its last coefficient."""
    transport = make(random.normal(size=(2, 24, 4, 3)), 20)
    for count in (6, 96):
        with pytest.raises(ValueError, match=f"the light's coefficients must be 24, got {count}"):
            transport.apply(jnp.ones((count, 3)))


@pytest.mark.parametrize("colors", [1, 3])
def test_rms_is_that_of_the_dense_rows(random, close, colors):
    transport = make(random.normal(size=(6, 24, 3, colors)), 9)
    close(transport.rms, np.sqrt(np.mean(dense(transport) ** 2, (0, 2, 3))))
    assert np.all(np.asarray(make(np.zeros((2, 24, 1, 1)), 3).rms) == 0)


@pytest.fixture(params=[(1, 3), (3, 3), (3, 1)], ids=lambda p: f"transport {p[0]}, light {p[1]}")
def prepared(request, random):
    """Transport of 40 vertices with and without its transpose, and a light."""
    colors, light_colors = request.param
    coefficient = random.normal(size=(40, 24, 3, colors)) * (random.uniform(size=(40, 24, 3, 1)) < 0.4)
    transport = make(coefficient, 7)
    return transport, transport.with_transpose(), jnp.asarray(random.normal(size=(24, light_colors)), jnp.float32)


def squared(coefficient, transport):
    return jnp.sum(jnp.sin(transport.apply(coefficient)) ** 2)


def test_with_its_transpose_transport_is_the_same(prepared):
    transport, with_transpose, light = prepared
    np.testing.assert_array_equal(with_transpose.apply(light), transport.apply(light))
    assert with_transpose.nbytes > transport.nbytes


def test_every_kept_coefficient_is_in_the_transpose_once(prepared):
    transport, with_transpose, _ = prepared
    each = with_transpose.transpose
    found = np.zeros((24, 120, transport.value.shape[3]))
    np.add.at(found, (np.broadcast_to(each.number, each.row.shape), np.asarray(each.row)), np.asarray(each.value))
    expected = np.moveaxis(dense(transport), 1, 0).reshape(24, 120, -1)
    np.testing.assert_allclose(found, expected, rtol=1e-7)
    assert np.count_nonzero(np.any(np.asarray(each.value), -1)) == np.count_nonzero(np.any(expected, -1))


def hessian_product(function):
    return lambda light, transport: jax.jvp(jax.grad(partial(function, transport=transport)), (light,), (light + 1,))[1]


def batched(function):
    return lambda light, transport: jax.vmap(jax.grad(function), (0, None))(jnp.stack([light, -2 * light]), transport)


def by_values(function):
    """Of the function, and mixed with the light."""

    def at(value, light, transport):
        return function(light, eqx.tree_at(lambda t: t.value, transport, value))

    def both(light, transport):
        slope = jax.grad(at)(transport.value, light, transport)
        mixed = jax.jvp(lambda value: jax.grad(at, 1)(value, light, transport), (transport.value,), (slope,))[1]
        return jnp.concatenate([slope.ravel(), mixed.ravel()])

    return both


@pytest.mark.parametrize("change", [jax.grad, hessian_product, batched, by_values])
def test_derivatives_by_the_transpose_are_those_without(prepared, change, close):
    transport, with_transpose, light = prepared
    found = jax.jit(change(squared))
    close(found(light, with_transpose), found(light, transport))


def test_an_empty_transport_has_a_transpose():
    transport = make(np.zeros((2, 24, 1, 1)), 3).with_transpose()
    slope = jax.grad(squared)(jnp.ones((24, 1)), transport)
    np.testing.assert_array_equal(slope, 0)


def test_a_shorter_transport_has_no_transpose(prepared):
    _, with_transpose, light = prepared
    shorter = with_transpose.truncate(3)
    assert shorter.transpose is None
    assert np.all(np.isfinite(jax.grad(squared)(light, shorter)))
