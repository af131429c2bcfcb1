"""Quantized transport against plain rounding in NumPy, bit fields packed by hand, and transport in floating point."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published.quantized import dequantize, quantize
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import builtin
from jaxprt.systems.separable import SeparableSystem, SparseTransport, factor, precompute

COLORS = pytest.mark.parametrize("colors", [1, 3])
LAST = {1: np.array([32767]), 3: np.array([1023, 1023, 511])}
KEPT, VERTICES, TERMS, SIZE = 9, 6, 3, 24


@pytest.fixture
def random():
    return np.random.default_rng(0)


def make(value):
    """Transport of some values [k v r l] at random places."""
    index = np.random.default_rng(1).integers(SIZE, size=value.shape[:3], dtype=np.uint16)
    frame = jnp.broadcast_to(jnp.eye(3), (value.shape[1], 3, 3))
    value = jnp.asarray(value, jnp.result_type(float))
    return SparseTransport(jnp.asarray(index), value, frame[:, 1], frame, jnp.linspace(0, 1, SIZE))


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
    quantized = quantize(make(value))
    quantum = np.abs(value.astype(np.float64)).max(0) / LAST[colors]
    close(quantized.quantum, quantum)
    # Quotients near a half may go either way: float32 has 32,767 to .002.
    assert np.abs(levels(quantized) - value / quantum).max() < 0.5 + 0.004
    np.testing.assert_array_equal(np.abs(levels(quantized)).max(0), np.broadcast_to(LAST[colors], quantum.shape))
    assert quantized.level.dtype == ("int16" if colors == 1 else "uint32")


@COLORS
def test_no_coefficient_is_off_by_more_than_half_a_quantum(random, colors):
    transport = make(some(random, colors))
    quantized = quantize(transport)
    error = np.abs(np.asarray(dequantize(quantized).value, np.float64) - np.asarray(transport.value, np.float64))
    largest = np.abs(np.asarray(transport.value, np.float64)).max(0)
    assert np.all(error <= largest * (0.5 / LAST[colors] + 1e-6))
    assert np.all(error.max(0) > largest * 0.05 / LAST[colors])  # It is rounded at all.


@COLORS
def test_rounding_again_changes_nothing(random, colors, close):
    once = quantize(make(some(random, colors)))
    twice = quantize(dequantize(once))
    np.testing.assert_array_equal(twice.level, once.level)
    close(twice.quantum, once.quantum)


@pytest.mark.parametrize(("colors", "light_colors"), [(1, 1), (1, 3), (3, 3)])
def test_apply_is_the_dense_product_of_the_rounded_coefficients(random, close, colors, light_colors):
    quantized = quantize(make(some(random, colors)))
    light = random.normal(size=(SIZE, light_colors)).astype(np.float32)
    close(quantized.apply(jnp.asarray(light)), np.sum(values(quantized) * light[np.asarray(quantized.index)], 0))


def test_float64_stays_float64(x64, random, close):
    quantized, light = quantize(make(some(random, 3))), random.normal(size=(SIZE, 3))
    result = quantized.apply(jnp.asarray(light))
    assert result.dtype == "float64"
    close(result, np.sum(values(quantized) * light[np.asarray(quantized.index)], 0))


@COLORS
def test_a_large_row_does_not_coarsen_the_others(random, colors):
    value = some(random, colors)
    huge = value.copy()
    huge[2, 1, 2] *= 1e12
    plain, spoiled = (quantize(make(each)) for each in (value, huge))
    other = np.ones((VERTICES, TERMS), bool)
    other[1, 2] = False
    np.testing.assert_array_equal(levels(spoiled)[:, other], levels(plain)[:, other])
    np.testing.assert_array_equal(spoiled.quantum[other], plain.quantum[other])


def test_sign_and_power_of_two_pass_through(random):
    value = some(random, 3)
    plain, scaled = quantize(make(value)), quantize(make(-8 * value))
    np.testing.assert_array_equal(levels(scaled), -levels(plain))
    np.testing.assert_array_equal(scaled.quantum, 8 * plain.quantum)


@COLORS
def test_what_rounds_to_zero_is_padding(random, colors):
    value = some(random, colors)
    value[4] = value[0] * 1e-6
    value[:, 3, 1] = 0
    quantized = quantize(make(value))
    gone = np.all(levels(quantized) == 0, -1)
    assert gone[4].all()
    assert gone[:, 3, 1].all()
    np.testing.assert_array_equal(np.asarray(quantized.index)[gone], 0)
    np.testing.assert_array_equal(np.asarray(quantized.index)[~gone], np.asarray(make(value).index)[~gone])


@pytest.mark.parametrize("size", [1e-45, 1e-38, 1e38])
def test_extreme_sizes_give_finite_levels_and_radiance(size):
    pattern = np.array([1, -1, 0.5, 0, 0.25, 1, 0, 0, -0.125])[:, None, None, None]
    value = np.broadcast_to(pattern * size, (KEPT, VERTICES, TERMS, 3))
    quantized = quantize(make(value))
    assert np.all(np.abs(levels(quantized)) <= LAST[3])
    result = quantized.apply(jnp.full((SIZE, 3), 1e-3))
    assert np.isfinite(np.asarray(result)).all()
    if size > 1:
        np.testing.assert_allclose(np.asarray(result) / size, 1.625e-3, rtol=2e-3)


@COLORS
def test_bytes_are_those_of_the_bit_fields_the_indices_and_the_quanta(random, colors):
    quantized = quantize(make(some(random, colors)))
    rows = VERTICES * TERMS
    assert quantized.nbytes == KEPT * rows * (2 + (2 if colors == 1 else 4)) + rows * colors * 4


@COLORS
def test_kept_prefixes_are_prefixes_of_the_same_levels(random, colors, close):
    quantized = quantize(make(some(random, colors)))
    fewer = quantized.truncate(5, terms=2)
    np.testing.assert_array_equal(fewer.index, np.asarray(quantized.index)[:5, :, :2])
    np.testing.assert_array_equal(fewer.level, np.asarray(quantized.level)[:5, :, :2])
    total = np.zeros(SIZE)
    np.add.at(total, np.asarray(fewer.index).ravel(), (values(fewer) ** 2).mean(-1).ravel())
    close(fewer.rms, np.sqrt(total / (2 * VERTICES)))
    with pytest.raises(ValueError, match="count must be between 1 and 9, got 10"):
        quantized.truncate(10)


def test_vertices_keep_their_places_and_the_light_its_gradient(random, close):
    transport = make(some(random, 3))
    quantized = quantize(transport)
    for field in ("position", "frame", "rms"):
        np.testing.assert_array_equal(getattr(quantized, field), getattr(transport, field))
    light, weight = (jnp.asarray(random.normal(size=shape), jnp.float32) for shape in ((SIZE, 3), (VERTICES, TERMS, 3)))
    gradient = jax.grad(lambda x: jnp.sum(quantized.apply(x) * weight))(light)
    # The transposed product, by scattering.
    expected = np.zeros((SIZE, 3))
    value = values(quantized) * np.asarray(weight, np.float64)
    np.add.at(expected, np.asarray(quantized.index).ravel(), value.reshape(-1, 3))
    close(gradient, expected)


@pytest.mark.usefixtures("unchecked")
def test_other_numbers_of_colors_are_refused(random):
    with pytest.raises(ValueError, match="the transport must have 1 or 3 colors, got 2"):
        quantize(make(some(random, 3)[..., :2]))


@pytest.fixture(scope="module")
def glossy():
    return factor(AshikhminShirley(diffuse=0.3, specular=0.5, nu=20, nv=80), terms=4, resolution=12)


@pytest.fixture(scope="module")
def traced(glossy):
    return precompute(builtin.sphere(rings=5, sectors=8), glossy, keep=24, size=8)


def relight(transport, brdf):
    light = builtin.daylight(size=8)
    return np.asarray(prt.radiance(SeparableSystem(transport, brdf), light, eye=jnp.array([1.0, 2.0, 3.0])))


def test_one_huge_coefficient_erases_no_others(traced, glossy, close):
    spoiled = eqx.tree_at(lambda t: t.value, traced, traced.value.at[0, 5, 1].multiply(1e6))
    color, expected = (relight(quantize(transport), glossy) for transport in (spoiled, traced))
    assert np.isfinite(color).all()
    others = np.arange(len(color)) != 5
    np.testing.assert_array_equal(color[others], expected[others])
    # 32,767 levels for each vertex and term.
    close(expected, relight(traced, glossy), tolerance=1e-4)
    close(color[5], relight(spoiled, glossy)[5], tolerance=1e-4)


def test_transport_of_zeros_is_quantized_to_zeros(traced, glossy):
    dark = eqx.tree_at(lambda t: t.value, traced, 0 * traced.value)
    assert not relight(quantize(dark), glossy).any()


def test_factors_that_the_transport_was_not_made_of_are_refused(traced, glossy):
    quantized = quantize(traced)
    other = factor(AshikhminShirley(), terms=4, resolution=12)
    for transport in (quantized, dequantize(quantized), quantized.truncate(20)):
        with pytest.raises(ValueError, match="the BRDF must be the one that"):
            SeparableSystem(transport, other)
    with pytest.raises(ValueError, match="the BRDF must have the transport's 4 terms, got 2"):
        SeparableSystem(quantized, glossy.truncate(2))


@pytest.mark.parametrize("terms", [-1, 0, 4])
def test_keeping_an_impossible_number_of_terms_is_refused(random, terms):
    with pytest.raises(ValueError, match=f"terms must be between 1 and 3, got {terms}"):
        quantize(make(some(random, 3))).truncate(6, terms=terms)


def test_lights_of_another_number_of_coefficients_are_refused(random):
    for count in (6, 96):
        with pytest.raises(ValueError, match=f"the light's coefficients must be 24, got {count}"):
            quantize(make(some(random, 3))).apply(jnp.ones((count, 3)))
