"""Errors of an image against a reference: relative L2, PSNR and FLIP."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import jit
from jaxprt.image.arguments import numbers

_peak = functools.partial(require.number, "peak", low=1e-15, high=1e15)


@require.arguments(image=numbers("the image"), reference=numbers("the reference"))
@jit
def relative_l2(image: Float[Array, "*b"], reference: Float[Array, "*b"]) -> Float[Array, ""]:
    """L2 norm of the difference divided by the L2 norm of the reference.

    The result is 0 if both images are black, and infinite if only the reference is. It is differentiable except where
    the difference is zero; the derivative there is defined as zero.

    Raises:
        ValueError: The images differ in shape.
    """
    image, reference = _pair(image, reference)
    scale = jnp.maximum(jnp.max(jnp.abs(reference), initial=0), jnp.max(jnp.abs(image), initial=0))
    scale = jax.lax.stop_gradient(jnp.where(scale > 0, scale, 1))
    error = jnp.sum(((image - reference) / scale) ** 2)
    size = jnp.sum((reference / scale) ** 2)
    same = error == 0
    ratio = jnp.sqrt(jnp.where(same, 1, error)) / jnp.sqrt(jnp.where(same & (size == 0), 1, size))
    return jnp.where(same, 0, ratio)


@require.arguments(image=numbers("the image"), reference=numbers("the reference"), peak=_peak)
@jit
def psnr(
    image: Float[Array, "*b"], reference: Float[Array, "*b"], *, peak: Float[Array, ""] | float = 1.0
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio in decibels; infinite for equal images.

    Args:
        image: The image to evaluate.
        reference: The reference image.
        peak: Largest possible value; 1 for display values.

    Raises:
        ValueError: The images differ in shape.
    """
    image, reference = _pair(image, reference)
    return 10 * (2 * jnp.log10(jnp.asarray(peak, image.dtype)) - jnp.log10(jnp.mean((image - reference) ** 2)))


@require.arguments(image=numbers("the image", "h w 3"), reference=numbers("the reference", "h w 3"))
def flip(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> float:
    """Mean FLIP error of linear radiance, 0 to 1: the difference that a viewer sees when flipping between the images.

    This is HDR-FLIP, because the images are linear radiance without an exposure; the metric takes its range of
    exposures from the reference. The viewing conditions are the defaults of flip-evaluator. It runs on the CPU in NumPy
    and has no derivative. Negative radiance, which an approximation may contain, counts as black.

    Raises:
        ImportError: The package flip-evaluator is missing.
        ValueError: The images differ in shape.

    Reference: Andersson et al. 2021, "Visualizing and communicating errors in rendered images".
    """
    try:
        import flip_evaluator
    except ImportError as error:
        raise ImportError("flip needs the package flip-evaluator: pip install 'jaxprt[bench]'") from error
    image, reference = _pair(image, reference)
    true, seen = (np.maximum(np.ascontiguousarray(x, np.float32), 0) for x in (reference, image))
    # A new dict: the package modifies its default argument, so exposures of the first reference would be used again.
    _, mean, _ = flip_evaluator.evaluate(true, seen, "HDR", inputsRGB=False, applyMagma=False, parameters={})
    return float(mean)


def _pair(image: Array, reference: Array) -> tuple[Array, Array]:
    """Two images of equal shape."""
    if image.shape != reference.shape:
        raise ValueError(f"images must have one shape, got {list(image.shape)} and {list(reference.shape)}")
    if not image.size:
        raise ValueError(f"the image and the reference must have pixels, got {list(image.shape)}")
    return image, reference
