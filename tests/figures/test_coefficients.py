"""Choosing and rounding coefficients of the light against sorting in NumPy; relighting with those that are chosen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.published.coefficients import choose_by_area, choose_by_magnitude, choose_by_transport, quantize
from jaxprt.brdf import AshikhminShirley
from jaxprt.scene import Environment
from jaxprt.sphere import haar
from jaxprt.systems.separable import SeparableSystem, SparseTransport, factor
from jaxprt.systems.separable.sparse import compress, rms
from jaxprt.systems.separable.system import project

SIZE = 8
EYE = jnp.array([2.0, 3.0, 4.0])


@pytest.fixture
def random():
    return np.random.default_rng(5)


@pytest.fixture(scope="module")
def factored():
    return factor(
        AshikhminShirley(diffuse=[0.6, 0.2, 0.1], specular=[0.2, 0.3, 0.7], nu=20, nv=60), terms=3, resolution=12
    )


@pytest.fixture(scope="module")
def transport(factored):
    """Transport of seven vertices with random frames and visibility."""
    random = np.random.default_rng(4)
    frame, _ = np.linalg.qr(random.normal(size=(7, 3, 3)))
    frame = array(frame * np.linalg.det(frame)[:, None, None])
    seen = jnp.asarray(random.integers(17, size=(7, 6 * SIZE**2)), jnp.uint8)
    index, value = compress(seen, frame, factored, keep=40)
    return SparseTransport(index, value, array(random.normal(size=(7, 3))), frame, rms(index, value, 6 * SIZE**2))


def array(value):
    """Values of NumPy in float32; operations of JAX outside of `jit` would be a program each."""
    return jnp.asarray(np.asarray(value), jnp.float32)


def some_light(random):
    return Environment(array(random.uniform(0, 2, size=(6, SIZE, SIZE, 3))))


def relight(transport, factored, light, *, count=None):
    """Radiance under the light's coefficients that matter most for the transport."""
    coefficient = project(light)
    if count is not None:
        coefficient = choose_by_transport(coefficient, transport.rms, count=count)
    system = SeparableSystem(transport, factored)
    return system.combine(transport.apply(coefficient), system.view(EYE))


def test_the_error_falls_with_the_coefficients_that_are_chosen_and_the_others_have_no_part(
    transport, factored, random, close
):
    light = some_light(random)
    whole, all_of_them, *fewer = (
        np.asarray(relight(transport, factored, light, count=k)) for k in (None, 384, 9, 100, 200)
    )
    np.testing.assert_array_equal(all_of_them, whole)
    error = [np.linalg.norm(color - whole) for color in fewer]
    assert error[0] > error[1] > error[2]
    # Nor does it matter to drop what no vertex keeps.
    used = int(np.count_nonzero(np.asarray(transport.rms)))
    close(relight(transport, factored, light, count=used), whole)
    gradient = jax.grad(lambda e: jnp.sum(relight(transport, factored, e, count=9)))(light)
    coefficient = np.asarray(project(gradient))
    assert np.count_nonzero(np.abs(coefficient).max(1) > 1e-4 * np.abs(coefficient).max()) <= 9


def coefficients(random):
    value = random.normal(size=(6 * SIZE**2, 3)) * random.uniform(size=(6 * SIZE**2, 1)) ** 4
    return array(value)


def kept(coefficient, chosen):
    """Rows that were kept, after a check that they are unchanged and all others are zero."""
    chosen = np.asarray(chosen)
    assert not chosen[chosen != np.asarray(coefficient)].any()
    return np.flatnonzero(chosen.any(1))


@pytest.mark.parametrize("count", [17, 384])
def test_choosing_by_area_or_by_transport_keeps_the_largest_products_with_it(random, count):
    coefficient, rms = coefficients(random), array(random.uniform(0.1, 1, size=384))
    chosen = choose_by_transport(coefficient, rms, count=count)
    order = np.argsort(-np.linalg.norm(np.asarray(coefficient, np.float64), axis=1) * np.asarray(rms, np.float64))
    np.testing.assert_array_equal(kept(coefficient, chosen), np.sort(order[:count]))
    chosen = choose_by_area(coefficient, count=count)
    # What a basis function covers, from the function itself.
    impulse = haar.inverse(array(np.eye(SIZE**2).reshape(SIZE**2, SIZE, SIZE, 1)))
    area = np.tile(np.mean(np.abs(np.asarray(impulse)) > 1e-6, axis=(1, 2, 3)), 6)
    weight = np.linalg.norm(np.asarray(coefficient, np.float64), axis=1) * area
    np.testing.assert_array_equal(kept(coefficient, chosen), np.sort(np.argsort(-weight)[:count]))


def test_choosing_by_magnitude_drops_each_color_below_the_threshold(random):
    coefficient = array(np.asarray(coefficients(random)) * [1.0, 10.0, 0.0])
    chosen = np.asarray(choose_by_magnitude(coefficient, threshold=1024))
    size = np.abs(np.asarray(coefficient, np.float64))
    level = np.round(size / size.max(0).clip(1e-30) * 32767)
    np.testing.assert_array_equal(chosen, np.where(level >= 1024, coefficient, 0))
    assert 1 < np.count_nonzero(chosen[:, 0]) < 384
    np.testing.assert_array_equal(choose_by_magnitude(coefficient, threshold=0), coefficient)
    # A threshold is relative: it does not know the light's units.
    larger = array(np.asarray(coefficient) * 1024)
    np.testing.assert_array_equal(choose_by_magnitude(larger, threshold=1024), chosen * 1024)


def test_quantizing_rounds_each_color_to_multiples_of_its_largest(random, close):
    coefficient = array(np.asarray(coefficients(random)) * [1.0, 1e6, 0.0])
    wide = np.asarray(coefficient, np.float64)
    quantum = np.abs(wide).max(0) / 32767
    rounded = np.asarray(quantize(coefficient), np.float64)
    level = rounded[:, :2] / quantum[:2]
    np.testing.assert_allclose(level, np.round(level), atol=0.004)
    assert np.all(np.abs(rounded - wide)[:, :2].max(0) > 0.4 * quantum[:2])
    assert np.all(np.abs(rounded - wide) <= 0.504 * quantum)
    assert not rounded[:, 2].any()
    close(quantize(rounded.astype(np.float32)), rounded)
    # Twice the light is twice the levels' worth: a quantum is relative.
    larger = array(np.asarray(coefficient) * 1024)
    np.testing.assert_array_equal(quantize(larger), np.asarray(quantize(coefficient)) * 1024)


@pytest.mark.parametrize("count", [0, 385, -1])
def test_impossible_numbers_to_choose_are_refused(random, count):
    coefficient = coefficients(random)
    with pytest.raises(ValueError, match=f"count must be between 1 and 384, got {count}"):
        choose_by_transport(coefficient, array(np.ones(384)), count=count)
    with pytest.raises(ValueError, match=f"count must be between 1 and 384, got {count}"):
        choose_by_area(coefficient, count=count)
