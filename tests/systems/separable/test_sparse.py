from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt import separable
from jaxprt.systems.separable import SparseTransport

VERTICES, COUNT, TERMS, KEPT = 40, 24, 3, 7  # of all transport here, so that programs are shared


@pytest.fixture
def random():
    return np.random.default_rng(0)


def some(random, colors):
    return random.normal(size=(VERTICES, COUNT, TERMS, colors)) * (
        random.uniform(size=(VERTICES, COUNT, TERMS, 1)) < 0.4
    )


def make(coefficient, keep=KEPT):
    """Transport from dense coefficients [v d r l]."""
    index, value = separable.sparse.largest(jnp.asarray(coefficient, jnp.float32), keep=keep)
    vertices, count = coefficient.shape[:2]
    position, frame = np.zeros((vertices, 3), np.float32), np.tile(np.eye(3, dtype=np.float32), (vertices, 1, 1))
    same = jnp.asarray(position), jnp.asarray(frame)
    return SparseTransport(index, value, *same, separable.sparse.rms(index, value, count))


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
    coefficient = random.normal(size=(VERTICES, COUNT, TERMS, colors))
    transport = make(coefficient)
    size = np.linalg.norm(coefficient, axis=-1)
    np.testing.assert_array_equal(np.moveaxis(transport.index, 0, 1), np.argsort(-size, axis=1)[:, :KEPT])
    kept = np.linalg.norm(transport.value, axis=-1)
    assert np.all(np.diff(kept, axis=0) <= 0)
    expected = np.where(size < np.sort(size, axis=1)[:, -KEPT, None], 0, 1)[..., None] * coefficient
    np.testing.assert_allclose(dense(transport), expected, rtol=1e-6)


def test_rows_with_few_coefficients_are_padded_with_index_zero_and_value_zero_and_equal_ones_keep_their_order():
    coefficient = np.zeros((VERTICES, COUNT, TERMS, 1))
    coefficient[0, 5, 0], coefficient[1, 23, 1] = 3, -2
    coefficient[2] = np.where(np.arange(COUNT) % 2, 1, -1)[:, None, None]
    index, value = (np.asarray(each).copy() for each in (make(coefficient).index, make(coefficient).value))
    np.testing.assert_array_equal(index[:, 2], np.tile(np.arange(KEPT)[:, None], (1, TERMS)))
    np.testing.assert_array_equal(value[:, 2, 0, 0], [-1, 1, -1, 1, -1, 1, -1])
    index[:, 2], value[:, 2] = 0, 0
    assert (index[0, 0, 0], value[0, 0, 0, 0]) == (5, 3)
    assert (index[0, 1, 1], value[0, 1, 1, 0]) == (23, -2)
    assert np.count_nonzero(index) == np.count_nonzero(value) == 2


def test_indices_are_as_small_as_they_can_be():
    for count, dtype in ((6, "uint16"), (1 << 16, "uint16"), (6 * 128 * 128, "uint32")):
        coefficient = np.zeros((1, count, 1, 1), np.float32)
        coefficient[0, -1] = 1
        index = np.asarray(separable.sparse.largest(coefficient, keep=2)[0])
        assert index.dtype == dtype
        assert index[0, 0, 0] == count - 1


@pytest.mark.parametrize(("colors", "light_colors"), [(1, 1), (1, 3), (3, 3)])
def test_apply_is_the_dense_product_and_rms_that_of_its_rows(random, close, colors, light_colors):
    transport = make(some(random, colors))
    light = random.normal(size=(COUNT, light_colors)).astype(np.float32)
    whole = np.broadcast_to(dense(transport), (VERTICES, COUNT, TERMS, light_colors))
    close(transport.apply(jnp.asarray(light)), np.einsum("vdrc,dc->vrc", whole, light))
    close(transport.rms, np.sqrt(np.mean(whole**2, (0, 2, 3))))


def test_kept_prefixes_are_what_the_smaller_number_would_have_kept(random):
    coefficient = some(random, 1)
    fewer, expected = make(coefficient).truncate(3, terms=2), make(coefficient[:, :, :2], 3)
    for field in ("index", "value", "rms", "position", "frame"):
        np.testing.assert_array_equal(getattr(fewer, field), getattr(expected, field))
    assert fewer.nbytes == VERTICES * 3 * 2 * (2 + 4)


def test_numbers_that_do_not_fit_are_refused(random):
    """Numbers that a light lacks were once read from its last coefficient."""
    transport = make(some(random, 1))
    for keep in (0, 25):
        with pytest.raises(ValueError, match=f"keep must be between 1 and 24, got {keep}"):
            make(some(random, 1), keep)
    for count in (0, 8):
        with pytest.raises(ValueError, match=f"count must be between 1 and 7, got {count}"):
            transport.truncate(count)
    for terms in (-1, 0, 4):
        with pytest.raises(ValueError, match=f"terms must be between 1 and 3, got {terms}"):
            transport.truncate(6, terms=terms)
    for count in (6, 96):
        with pytest.raises(ValueError, match=f"the light's coefficients must be 24, got {count}"):
            transport.apply(jnp.ones((count, 3)))


@pytest.fixture(params=[(1, 3), (3, 3), (3, 1)], ids=lambda p: f"transport {p[0]}, light {p[1]}")
def prepared(request, random):
    """Transport with and without its transpose, and a light."""
    colors, light_colors = request.param
    transport = make(some(random, colors))
    return transport, transport.with_transpose(), jnp.asarray(random.normal(size=(COUNT, light_colors)), jnp.float32)


def squared(coefficient, transport):
    return jnp.sum(jnp.sin(transport.apply(coefficient)) ** 2)


def test_with_its_transpose_transport_is_the_same_and_every_kept_coefficient_is_in_it_once(prepared):
    transport, with_transpose, light = prepared
    np.testing.assert_array_equal(with_transpose.apply(light), transport.apply(light))
    assert with_transpose.nbytes > transport.nbytes
    assert with_transpose.truncate(3).transpose is None
    each = with_transpose.transpose
    found = np.zeros((COUNT, VERTICES * TERMS, transport.value.shape[3]))
    np.add.at(found, (np.broadcast_to(each.number, each.row.shape), np.asarray(each.row)), np.asarray(each.value))
    expected = np.moveaxis(dense(transport), 1, 0).reshape(found.shape)
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
    transport = make(np.zeros((VERTICES, COUNT, TERMS, 1))).with_transpose()
    np.testing.assert_array_equal(jax.jit(jax.grad(squared))(jnp.ones((COUNT, 1)), transport), 0)
