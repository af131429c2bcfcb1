import builtins

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.image import metrics


def _pair(seed=0):
    rng = np.random.default_rng(seed)
    image = rng.random((32, 40, 3)).astype(np.float32)
    return jnp.asarray(image), jnp.asarray(image + 0.1 * rng.standard_normal(image.shape).astype(np.float32))


def test_relative_l2_is_the_ratio_of_norms():
    image, reference = _pair()
    a, b = np.asarray(image, np.float64), np.asarray(reference, np.float64)
    expected = np.linalg.norm(a - b) / np.linalg.norm(b)
    assert metrics.relative_l2(image, reference) == pytest.approx(expected, rel=1e-5)


def test_relative_l2_does_not_change_with_the_scale_of_both():
    image, reference = _pair()
    expected = float(metrics.relative_l2(image, reference))
    for scale in (1e-30, 1e30):
        assert metrics.relative_l2(scale * image, scale * reference) == pytest.approx(expected, rel=1e-5)


def test_relative_l2_of_two_black_images_is_zero_and_of_light_against_black_infinite():
    black, image = jnp.zeros((3, 4, 3)), jnp.ones((3, 4, 3))
    assert metrics.relative_l2(black, black) == 0
    assert metrics.relative_l2(image, image) == 0
    assert metrics.relative_l2(image, black) == np.inf
    assert metrics.relative_l2(black, image) == 1


def test_the_gradient_of_relative_l2_is_zero_at_equality():
    image, _ = _pair()
    np.testing.assert_array_equal(jax.grad(metrics.relative_l2)(image, image), 0)
    np.testing.assert_array_equal(jax.grad(metrics.relative_l2)(0 * image, 0 * image), 0)


def test_psnr_of_a_constant_difference_is_known():
    image, _ = _pair()
    assert metrics.psnr(image, image + 0.01) == pytest.approx(40, abs=1e-3)
    assert metrics.psnr(image, image + 0.01, peak=10.0) == pytest.approx(60, abs=1e-3)
    assert metrics.psnr(image, image) == np.inf


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("metric", [metrics.relative_l2, metrics.psnr, metrics.flip])
def test_images_of_different_shapes_are_refused(metric):
    with pytest.raises(ValueError, match=r"images must have one shape, got \[4, 1, 3\] and \[1, 4, 3\]"):
        metric(jnp.ones((4, 1, 3)), jnp.ones((1, 4, 3)))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("metric", [metrics.relative_l2, metrics.psnr])
def test_images_of_small_integers_are_compared_as_numbers(metric):
    dark, light = jnp.array([1, 250], jnp.uint8), jnp.array([3, 240], jnp.uint8)
    assert metric(dark, light) == metric(jnp.array([1.0, 250]), jnp.array([3.0, 240]))


def test_flip_does_not_remember_the_reference_before():
    pytest.importorskip("flip_evaluator")
    image, reference = _pair()
    first = metrics.flip(image, reference)
    metrics.flip(1000 * image, 1000 * reference)
    assert metrics.flip(image, reference) == first


def test_flip_without_its_package_names_the_extra(monkeypatch):
    original = builtins.__import__

    def refuse(name, *arguments, **options):
        if name == "flip_evaluator":
            raise ImportError(name)
        return original(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match=r"jaxprt\[bench\]"):
        metrics.flip(*_pair())
