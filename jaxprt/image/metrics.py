"""How far an image is from its reference: relative L2, PSNR and FLIP."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.compile import jit


@jit
def relative_l2(image: Float[Array, "*b"], reference: Float[Array, "*b"]) -> Float[Array, ""]:
    """Norm of the difference over the norm of the reference.

    0 for two images without light, infinite if only the reference has none. Differentiable except where the
    difference is zero; there the derivative is zero.

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


@jit
def psnr(
    image: Float[Array, "*b"], reference: Float[Array, "*b"], *, peak: Float[Array, ""] | float = 1.0
) -> Float[Array, ""]:
    """Peak signal-to-noise ratio in decibels; infinite for equal images.

    Args:
        image: Values to judge.
        reference: What they should be.
        peak: The largest value that the medium holds; 1 for display values.

    Raises:
        ValueError: The images differ in shape.
    """
    image, reference = _pair(image, reference)
    return 10 * (2 * jnp.log10(jnp.asarray(peak, image.dtype)) - jnp.log10(jnp.mean((image - reference) ** 2)))


def flip(image: Float[Array, "h w 3"], reference: Float[Array, "h w 3"]) -> float:
    """Mean FLIP error of linear radiance, 0 to 1: how much a viewer who flips between the two images sees change.

    This is HDR-FLIP, deliberately: images here are linear radiance without an exposure of their own, and the metric
    takes its range of exposures from the reference. Its viewing conditions are the package's defaults. It runs on the
    CPU by NumPy arrays and has no derivative. Negative radiance, which an approximation may hold, is seen as black.

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
    # A fresh dict: the package keeps what it adds to the default one, hence the first reference's exposures, for later.
    _, mean, _ = flip_evaluator.evaluate(true, seen, "HDR", inputsRGB=False, applyMagma=False, parameters={})
    return float(mean)


def _pair(image: Array, reference: Array) -> tuple[Array, Array]:
    """Two images of one shape, integers as floating-point numbers."""
    if image.shape != reference.shape:
        raise ValueError(f"images must have one shape, got {list(image.shape)} and {list(reference.shape)}")
    image, reference = (
        x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(jnp.result_type(float)) for x in (image, reference)
    )
    return image, reference
