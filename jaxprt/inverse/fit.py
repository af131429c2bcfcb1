"""Light, material, or both, that explain pictures best."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxprt.inverse import numbers, pictures, solve
from jaxprt.inverse.pictures import Pixels
from jaxprt.inverse.solve import Fit


def light(
    radiance: Callable,
    start: PyTree,
    pixels: Pixels,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    prior: Callable[[PyTree], Float[Array, ""]] | None = None,
    error: float = 0.05,
    steps: int = 200,
) -> Fit:
    """The light under which an object looks as in pictures, painted ones perhaps.

    Few numbers without bounds or a prior, as spherical harmonics are, are solved for at once, in the space of what the
    pictures determine; what they do not stays as it is at the start. Others are found by projected gradients,
    accelerated, each number in units of what it changes; or by L-BFGS without bounds.

    Args:
        radiance: Of the light and an eye, of every vertex; linear in the light.
        start: An `Environment`, spherical harmonics, or any arrays.
        pixels: From `observe`.
        lower: Bounds: one number for all, or a pytree like the start, with None where there is no bound.
        upper: The same from above.
        prior: Added to half the squared residual; as `smoothness` of the texels or their sum, times a weight.
        error: Largest relative L2 error at which a combination of numbers counts as determined, estimated from how much
            parts of the pictures disagree about it. A smaller error keeps fewer combinations. Only for
            numbers that are solved for at once.
        steps: At most so many.

    Raises:
        TypeError: The start has what are no numbers; radiance or a prior that is no function; pixels that are not from
            `observe`; steps that are no whole number; or a call inside `jax.jit`, `jax.vmap` or `jax.grad`.
        ValueError: Bounds of another structure, that exclude the start, or each other; steps below 1; a prior that is
            not one number; radiance of another shape than the mesh and the pictures have, that is not finite, or, where
            it is solved for at once, not linear.

    Reference: Nocedal and Wright 2006, chapters 10 and 16.
    """
    _check(radiance, pixels)
    first, unravel = numbers.raveled(start, steps)
    if not (isinstance(error, float | int | np.number) and 0 < error < np.inf):
        raise ValueError(f"the error must be a positive number, got {error!r}")
    low, high = (numbers.bound(each, start, none) for each, none in ((lower, -np.inf), (upper, np.inf)))
    numbers.check(first, low, high)
    if prior is not None:
        _check_prior(prior, unravel, first)

    function = pictures.Residual(radiance, unravel(first), pixels)
    if len(first) <= solve.DENSE and prior is None and not (np.isfinite(low) | np.isfinite(high)).any():
        return solve.at_once(function, first, unravel, error)
    return solve.descend(function, first, unravel, (low, high), prior, steps)


def material(
    radiance: Callable,
    start: PyTree,
    pixels: Pixels,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    steps: int = 50,
) -> Fit:
    """The material that looks as in pictures under a known light: parameters of a model, coordinates, weights.

    Levenberg and Marquardt's steps, of numbers that are free: those between bounds are sines, those beyond one bound
    hyperbolas; numbers whose bounds are positive and more than 100 times apart go by their logarithm. A start at a
    bound is moved inside, by a hundredth of the range.

    Args:
        radiance: Of the material and an eye, of every vertex; differentiable in the material.
        start: A pytree of numbers, as a model is: a few hundred at most.
        pixels: From `observe`.
        lower: Bounds: one number for all, or a pytree like the start, with None where there is no bound.
        upper: The same from above.
        steps: At most so many.

    Raises:
        TypeError: The start has what are no numbers; radiance that is no function; pixels that are not from `observe`;
            steps that are no whole number; or a call inside `jax.jit`, `jax.vmap` or `jax.grad`.
        ValueError: Bounds of another structure, that exclude the start, or each other; more than 512 numbers; steps
            below 1; or radiance of another shape than the mesh and the pictures have, or that is not finite.

    Reference: Madsen, Nielsen, Tingleff 2004, "Methods for non-linear least squares problems".
    """
    _check(radiance, pixels)
    first, unravel = numbers.raveled(start, steps)
    if len(first) > solve.DENSE:
        raise ValueError(f"at most {solve.DENSE} numbers can be fitted so, got {len(first)}: use light for many")
    low, high = (numbers.bound(each, start, none) for each, none in ((lower, -np.inf), (upper, np.inf)))
    numbers.check(first, low, high)
    free, bounded, pinned = numbers.freed(first, low, high)

    def function(u):
        return pictures.residual(radiance, unravel(bounded(u)), pixels)

    return solve.marquardt(function, free, bounded, pinned, unravel, steps)


def jointly(
    radiance: Callable,
    start: tuple[PyTree, PyTree],
    pixels: Pixels,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    scale: bool = True,
    steps: int = 50,
) -> Fit:
    """Light and material: the light for the start's material, as by `light`, and then both, as by `material`.

    A light twice as bright and a material half as bright look alike: pictures do not determine which. So the light is
    held at the norm of the start's, unless something in the scene is known.

    Args:
        radiance: Of the light, the material and an eye; linear in the light.
        start: Light and material, of 512 numbers at most together.
        pixels: From `observe`.
        lower: Bounds of the material, as in `material`.
        upper: The same from above.
        scale: Whether to hold the light's norm; not where the radiance has a part that is known, as a color patch.
        steps: At most so many.

    Returns:
        The value is light and material. Deviations are those with the light's norm held, if it is.

    Raises:
        TypeError: As in `light` and `material`; or the start is no pair.
        ValueError: As in `light` and `material`; or the start's light is black.
    """
    _check(radiance, pixels)
    if not isinstance(start, tuple | list) or len(start) != 2:
        raise TypeError(f"the start must be a light and a material, a pair, got {type(start).__name__}")
    dark, made = start
    first = light(lambda each, eye: radiance(each, made, eye), dark, pixels)
    (lit, of_light), (own, of_material) = numbers.raveled(first.value, steps), numbers.raveled(made, steps)
    if len(lit) + len(own) > solve.DENSE:
        raise ValueError(f"at most {solve.DENSE} numbers can be fitted so, got {len(lit)} and {len(own)}")
    norm, found = (float(jnp.linalg.norm(each)) for each in (numbers.raveled(dark, steps)[0], lit))
    if not (norm > 0 and found > 0):
        raise ValueError(f"the light must not be black, got one of norm {norm} at the start, and {found} then")
    low, high = (numbers.bound(each, made, none) for each, none in ((lower, -np.inf), (upper, np.inf)))
    numbers.check(own, low, high)
    free, bounded, pinned = numbers.freed(own, low, high)
    size = norm if scale else found

    def whole(u: Array) -> Array:
        return jnp.concatenate([size * u[: len(lit)], bounded(u[len(lit) :])])

    def at_bounds(u: Array) -> np.ndarray:
        return np.concatenate([np.zeros(len(lit), bool), pinned(u[len(lit) :])])

    def unravel(x: Array) -> tuple[PyTree, PyTree]:
        return of_light(x[: len(lit)]), of_material(x[len(lit) :])

    def function(u: Array) -> Array:
        left = pictures.residual(lambda both, eye: radiance(*both, eye), unravel(whole(u)), pixels)
        held = jnp.linalg.norm(u[: len(lit)]) - 1
        return jnp.append(left, held) if scale else left

    return solve.marquardt(
        function, jnp.concatenate([lit / found, free]), whole, at_bounds, unravel, steps, held=int(scale)
    )


def _check(radiance: Callable, pixels: Pixels) -> None:
    """Refuses what is no function or not from `observe`."""
    if not callable(radiance):
        raise TypeError(f"the radiance must be a function, got {type(radiance).__name__}")
    if not isinstance(pixels, Pixels):
        raise TypeError(f"pixels must be from jaxprt.inverse.observe, got {type(pixels).__name__}")
    numbers.outside(pixels)


def _check_prior(prior: Callable, unravel: Callable, first: Array) -> None:
    """Refuses a prior that is not one number."""
    if not callable(prior):
        raise TypeError(f"the prior must be a function, got {type(prior).__name__}")
    found = jax.eval_shape(lambda x: prior(unravel(x)), first)
    if getattr(found, "shape", None) != () or not jnp.issubdtype(found.dtype, jnp.floating):
        raise ValueError(f"the prior must be one number of floating point, got {found}")
