import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.image import tonemap


def test_a_stop_doubles_the_radiance():
    radiance = jnp.asarray([[0.0, 0.25, 3.0]])
    np.testing.assert_allclose(tonemap.expose(radiance, stops=1.0), 2 * radiance, rtol=1e-6)
    np.testing.assert_allclose(tonemap.expose(radiance, stops=-2.0), radiance / 4, rtol=1e-6)


@pytest.mark.usefixtures("unchecked")
def test_pictures_of_integers_are_exposed_by_parts_of_stops():
    np.testing.assert_allclose(tonemap.expose(jnp.array([1, 2]), stops=0.5), np.sqrt(2) * np.array([1, 2]), rtol=1e-6)
    image = jnp.arange(1, 61).reshape(4, 5, 3)
    assert tonemap.automatic_exposure(image) == tonemap.automatic_exposure(image.astype(jnp.float32))


def test_srgb_equals_the_published_values():
    # IEC 61966-2-1: the end of the linear part, middle gray (encoded 0.5 is linear 0.21404114), white.
    linear = jnp.asarray([0.0, 0.0031308, 0.21404114, 1.0])
    np.testing.assert_allclose(tonemap.encode_srgb(linear), [0, 0.0404499, 0.5, 1], atol=1e-5)


def test_decoding_undoes_encoding_also_outside_the_display_range():
    linear = jnp.concatenate([jnp.linspace(-0.5, 4, 1001), jnp.asarray([1e-7, 0.0031, 0.0032])])
    np.testing.assert_allclose(tonemap.decode_srgb(tonemap.encode_srgb(linear)), linear, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("function", [tonemap.encode_srgb, tonemap.decode_srgb])
def test_the_srgb_gradient_is_finite_everywhere(function):
    at = jnp.asarray([-1.0, 0.0, 1e-30, 0.0031308, 0.04045, 0.5, 1.0, 100.0])
    slope = jax.vmap(jax.grad(function))(at)
    assert np.all(np.isfinite(slope))
    assert np.all(slope > 0)
    high, low = function(at + 1e-2), function(at - 1e-2)
    np.testing.assert_allclose(slope[5:7], ((high - low) / 2e-2)[5:7], rtol=2e-3)


def test_the_gradient_of_encoding_at_zero_is_that_of_the_linear_part():
    assert jax.grad(tonemap.encode_srgb)(0.0) == pytest.approx(12.92)


def test_display_is_clamped_and_increasing():
    shown = np.asarray(tonemap.display(jnp.linspace(-1, 2, 301)))
    assert shown.min() == 0
    assert shown.max() == pytest.approx(1, abs=1e-6)
    assert shown.max() <= 1
    assert np.all(np.diff(shown) >= 0)


def test_automatic_exposure_brings_the_percentile_of_lit_pixels_to_white():
    image = np.zeros((20, 30, 3), np.float32)
    image[:10] = np.random.default_rng(0).exponential(7.0, (10, 30, 1))
    image = jnp.asarray(image)
    shown = tonemap.expose(image, stops=tonemap.automatic_exposure(image, percentile=95.0, white=0.8))
    assert np.percentile(np.asarray(shown)[:10, :, 0], 95) == pytest.approx(0.8, rel=1e-4)


def test_automatic_exposure_cancels_a_scale_of_the_image():
    image = jnp.asarray(np.random.default_rng(0).random((9, 8, 3)), jnp.float32)
    difference = tonemap.automatic_exposure(image) - tonemap.automatic_exposure(8 * image)
    assert difference == pytest.approx(3, abs=1e-5)


def test_automatic_exposure_of_black_is_zero_stops():
    assert tonemap.automatic_exposure(jnp.zeros((4, 5, 3))) == 0
    assert tonemap.automatic_exposure(-jnp.ones((4, 5, 3))) == 0
