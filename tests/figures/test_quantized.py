"""Quantized transport against plain rounding in NumPy, bit fields packed by hand, and transport in floating point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published.quantized import dequantize, quantize
from jaxprt.brdf import AshikhminShirley, Lambert
from jaxprt.systems.separable import SeparableSystem, SparseTransport, factor
from jaxprt.systems.separable.factorization import mark_of

COLORS = pytest.mark.parametrize("colors", [1, 3])
LAST = {1: np.array([32767]), 3: np.array([1023, 1023, 511])}
KEPT, VERTICES, TERMS, SIZE = 9, 6, 3, 24


@pytest.fixture
def random():
    return np.random.default_rng(0)


def make(value, mark=None):
    """Transport of some values [k v r l] at random places."""
    index = np.random.default_rng(1).integers(SIZE, size=value.shape[:3], dtype=np.uint16)
    frame = jnp.asarray(np.tile(np.eye(3), (value.shape[1], 1, 1)), jnp.result_type(float))
    arrays = (
        jnp.asarray(each, jnp.result_type(float)) for each in (value, frame[:, 1], frame, np.linspace(0, 1, SIZE))
    )
    return SparseTransport(jnp.asarray(index), *arrays, mark=mark)


def some(random, colors):
    """Values of which each color of each row has another size."""
    scale = 10.0 ** random.uniform(-4, 4, size=(VERTICES, TERMS, colors))
    return random.normal(size=(KEPT, VERTICES, TERMS, colors)) * scale


def levels(quantized):
    """What is stored, as plain integers: 11 bits of red above 11 of green above 10 of blue, in two's complement."""
    stored = np.asarray(quantized.level)
    if stored.dtype == np.int16:
        return stored[..., None].astype(int)
    word = stored.astype(np.int64)
    field = np.stack([word >> 21, word >> 10 & 0x7FF, word & 0x3FF], -1)
    return np.where(field > LAST[3], field - 2 * LAST[3] - 2, field)


def values(quantized):
    """What that stands for, in float64."""
    return levels(quantized) * np.asarray(quantized.quantum, np.float64)


@COLORS
def test_levels_are_rounded_multiples_of_the_largest_of_each_row_and_color(random, colors, close):
    value = np.asarray(some(random, colors), np.float32)
    value[4] = value[0] * 1e-6
    value[:, 3, 1] = 0
    transport = make(value)
    quantized = quantize(transport)
    quantum = np.abs(value.astype(np.float64)).max(0) / LAST[colors]
    close(quantized.quantum, quantum)
    # Quotients near a half may go either way: float32 has 32,767 to .002.
    ratio = value / np.where(quantum > 0, quantum, 1)
    assert np.abs(levels(quantized) - ratio).max() < 0.5 + 0.004
    assert np.abs(levels(quantized) - ratio).max() > 0.4  # It is rounded at all.
    expected = np.broadcast_to(LAST[colors], quantum.shape) * (quantum > 0)
    np.testing.assert_array_equal(np.abs(levels(quantized)).max(0), expected)
    # What rounds to zero is padding.
    gone = np.all(levels(quantized) == 0, -1)
    assert gone[4].all()
    assert gone[:, 3, 1].all()
    np.testing.assert_array_equal(np.asarray(quantized.index)[gone], 0)
    np.testing.assert_array_equal(np.asarray(quantized.index)[~gone], np.asarray(transport.index)[~gone])
    for field in ("position", "frame", "rms"):
        np.testing.assert_array_equal(getattr(quantized, field), getattr(transport, field))
    rows = VERTICES * TERMS
    assert quantized.level.dtype == ("int16" if colors == 1 else "uint32")
    assert quantized.nbytes == KEPT * rows * (2 + (2 if colors == 1 else 4)) + rows * colors * 4
    # Rounding again changes nothing.
    close(dequantize(quantized).value, values(quantized))
    twice = quantize(dequantize(quantized))
    np.testing.assert_array_equal(twice.level, quantized.level)
    close(twice.quantum, quantized.quantum)


@COLORS
def test_a_large_row_does_not_coarsen_the_others_and_signs_and_powers_of_two_pass_through(random, colors):
    value = some(random, colors)
    huge = value.copy()
    huge[2, 1, 2] *= 1e12
    plain, spoiled, scaled = (quantize(make(each)) for each in (value, huge, -8 * value))
    other = np.ones((VERTICES, TERMS), bool)
    other[1, 2] = False
    np.testing.assert_array_equal(levels(spoiled)[:, other], levels(plain)[:, other])
    np.testing.assert_array_equal(np.asarray(spoiled.quantum)[other], np.asarray(plain.quantum)[other])
    np.testing.assert_array_equal(levels(scaled), -levels(plain))
    np.testing.assert_array_equal(scaled.quantum, 8 * np.asarray(plain.quantum))


@pytest.mark.parametrize(("colors", "light_colors"), [(1, 1), (1, 3), (3, 3)])
def test_apply_is_the_dense_product_of_the_rounded_coefficients_and_so_is_its_gradient(
    random, close, colors, light_colors
):
    quantized = quantize(make(some(random, colors)))
    light = random.normal(size=(SIZE, light_colors)).astype(np.float32)
    weight = random.normal(size=(VERTICES, TERMS, light_colors)).astype(np.float32)
    (_, color), gradient = jax.jit(
        jax.value_and_grad(lambda x: (jnp.sum((y := quantized.apply(x)) * weight), y), has_aux=True)
    )(light)
    index, dense = (
        np.asarray(quantized.index),
        np.broadcast_to(values(quantized), (*quantized.index.shape, light_colors)),
    )
    close(color, np.sum(dense * light[index], 0))
    expected = np.zeros((SIZE, light_colors))  # the transposed product, by scattering
    np.add.at(expected, index.ravel(), (dense * weight).reshape(-1, light_colors))
    close(gradient, expected)


def test_float64_stays_float64(x64, random, close):
    quantized, light = quantize(make(some(random, 3))), random.normal(size=(SIZE, 3))
    result = quantized.apply(jnp.asarray(light))
    assert result.dtype == "float64"
    close(result, np.sum(values(quantized) * light[np.asarray(quantized.index)], 0))


def test_extreme_sizes_give_finite_levels_and_radiance():
    pattern = np.array([1, -1, 0.5, 0, 0.25, 1, 0, 0, -0.125])[:, None, None, None]
    for size in (0.0, 1e-45, 1e-38, 1e38):
        quantized = quantize(make(np.broadcast_to(pattern * size, (KEPT, VERTICES, TERMS, 3))))
        assert np.all(np.abs(levels(quantized)) <= LAST[3])
        result = np.asarray(quantized.apply(jnp.full((SIZE, 3), 1e-3)))
        assert np.isfinite(result).all()
        if size > 1:
            np.testing.assert_allclose(result / size, 1.625e-3, rtol=2e-3)
    assert not np.any(np.asarray(quantize(make(0 * np.ones((KEPT, VERTICES, TERMS, 3)))).level))


@COLORS
def test_kept_prefixes_are_prefixes_of_the_same_levels(random, colors, close):
    quantized = quantize(make(some(random, colors)))
    fewer = quantized.truncate(5, terms=2)
    np.testing.assert_array_equal(fewer.index, np.asarray(quantized.index)[:5, :, :2])
    np.testing.assert_array_equal(fewer.level, np.asarray(quantized.level)[:5, :, :2])
    total = np.zeros(SIZE)
    np.add.at(total, np.asarray(fewer.index).ravel(), (values(fewer) ** 2).mean(-1).ravel())
    close(fewer.rms, np.sqrt(total / (2 * VERTICES)))


@pytest.mark.usefixtures("unchecked")
def test_what_does_not_fit_is_refused(random):
    with pytest.raises(ValueError, match="the transport must have 1 or 3 colors, got 2"):
        quantize(make(some(random, 3)[..., :2]))
    quantized = quantize(make(some(random, 3)))
    with pytest.raises(ValueError, match="count must be between 1 and 9, got 10"):
        quantized.truncate(10)
    for terms in (-1, 0, 4):
        with pytest.raises(ValueError, match=f"terms must be between 1 and 3, got {terms}"):
            quantized.truncate(6, terms=terms)
    for count in (6, 96):
        with pytest.raises(ValueError, match=f"the light's coefficients must be 24, got {count}"):
            quantized.apply(jnp.ones((count, 3)))
    glossy, other = (factor(brdf, terms=TERMS, resolution=12) for brdf in (AshikhminShirley(), Lambert(0.5)))
    quantized = quantize(make(some(random, 1), mark=jnp.asarray(mark_of(glossy.light_map))))
    for transport in (quantized, dequantize(quantized), quantized.truncate(5)):
        with pytest.raises(ValueError, match="the BRDF must be the one that"):
            SeparableSystem(transport, other)
    with pytest.raises(ValueError, match="the BRDF must have the transport's 3 terms, got 2"):
        SeparableSystem(quantized, glossy.truncate(2))
