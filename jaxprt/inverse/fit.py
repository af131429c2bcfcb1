"""Fits of light, material, or both to pictures."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxprt.inverse import pictures, solve
from jaxprt.inverse.pictures import Observations
from jaxprt.inverse.solve import Fit


def light(
    radiance: Callable,
    start: PyTree,
    pixels: Observations,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    prior: Callable[[PyTree], Float[Array, ""]] | None = None,
    error: float = 0.05,
    steps: int = 200,
) -> Fit:
    """Finds the light under which an object looks as it does in the pictures. The pictures may be paintings.

    At most 512 parameters without bounds and prior, such as spherical harmonics, are found by one linear solve.
    It changes only the combinations of parameters that the pictures determine; the others keep their starting values.
    More parameters, or parameters with a prior, are found iteratively: by projected gradients with momentum where there
    are bounds, otherwise by L-BFGS. Each parameter is scaled by how much it changes the pictures.

    Args:
        radiance: Function (light, eye) -> radiance of every vertex. It must be linear in the light.
        start: An `Environment`, spherical harmonics, or any pytree of arrays.
        pixels: The result of `observe`.
        lower: Lower bounds: one number for all, or a pytree like the start with None where there is no bound.
        upper: Upper bounds, in the same form.
        prior: Function of the light that is added to half the squared residual, such as a weight times `smoothness`.
        error: Largest relative L2 error at which a combination of parameters counts as determined. It is estimated by
            leaving out blocks of pixels. A smaller value keeps fewer combinations. Only for the linear solve.
        steps: Largest number of iterations.

    Raises:
        TypeError: The start holds something other than numbers; `radiance` or `prior` is not a function; `pixels` is
            not from `observe`; `steps` is not a whole number; or the call is inside `jax.jit`, `jax.vmap` or
            `jax.grad`.
        ValueError: Bounds have another structure than the start, exclude it, or cross each other; `steps` is below 1;
            the prior is not one number; the radiance has another shape than the mesh and the pictures require, is not
            finite, or is not linear in the light.

    Reference: Nocedal and Wright 2006, chapters 10 and 16.
    """
    _check(radiance, pixels)
    first, unravel = solve.ravel(start, steps)
    if not (isinstance(error, float | int | np.number) and 0 < error < np.inf):
        raise ValueError(f"the error must be a positive number, got {error!r}")
    low, high = (solve.bound(limits, start, none) for limits, none in ((lower, -np.inf), (upper, np.inf)))
    solve.check(first, low, high)
    if prior is not None:
        _check_prior(prior, unravel, first)

    function = pictures.Residual(radiance, unravel(first), pixels)
    if len(first) <= solve.DENSE and prior is None and not (np.isfinite(low) | np.isfinite(high)).any():
        return solve.at_once(function, first, unravel, error)
    return solve.descend(function, first, unravel, (low, high), prior, steps)


def material(
    radiance: Callable,
    start: PyTree,
    pixels: Observations,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    steps: int = 50,
) -> Fit:
    """Finds the material that looks as it does in the pictures, under a known light.

    The material may be the parameters of a BRDF model, coordinates in a family of BRDFs, or weights. The method is that
    of Levenberg and Marquardt in unbounded variables: a parameter between two bounds is the sine of its variable, and a
    parameter with one bound a hyperbola of it. Parameters whose bounds are positive and more than 100 times apart are
    fitted by their logarithm. A start at a bound is moved inside by a hundredth of the range.

    Args:
        radiance: Function (material, eye) -> radiance of every vertex, differentiable in the material.
        start: A pytree of at most 512 numbers, such as a BRDF model.
        pixels: The result of `observe`.
        lower: Lower bounds: one number for all, or a pytree like the start with None where there is no bound.
        upper: Upper bounds, in the same form.
        steps: Largest number of iterations.

    Raises:
        TypeError: The start holds something other than numbers; `radiance` is not a function; `pixels` is not from
            `observe`; `steps` is not a whole number; or the call is inside `jax.jit`, `jax.vmap` or `jax.grad`.
        ValueError: Bounds have another structure than the start, exclude it, or cross each other; there are more than
            512 numbers; `steps` is below 1; or the radiance has another shape than the mesh and the pictures require,
            or is not finite.

    Reference: Madsen, Nielsen, Tingleff 2004, "Methods for non-linear least squares problems".
    """
    _check(radiance, pixels)
    first, unravel = solve.ravel(start, steps)
    if len(first) > solve.DENSE:
        required = f"at most {solve.DENSE} parameters can be fitted by this method"
        raise ValueError(f"{required}, got {len(first)}: use light for more")
    low, high = (solve.bound(limits, start, none) for limits, none in ((lower, -np.inf), (upper, np.inf)))
    solve.check(first, low, high)
    free, bounded, pinned = solve.unbound(first, low, high)

    def function(u):
        return pictures.residual(radiance, unravel(bounded(u)), pixels)

    return solve.marquardt(function, free, bounded, pinned, unravel, steps)


def jointly(
    radiance: Callable,
    start: tuple[PyTree, PyTree],
    pixels: Observations,
    *,
    lower: PyTree = None,
    upper: PyTree = None,
    scale: bool = True,
    steps: int = 50,
) -> Fit:
    """Finds light and material together.

    It first finds the light for the starting material, by the method of `light`, and then both, by that of `material`.
    Pictures cannot tell a light twice as bright from a material half as bright. The norm of the light is therefore held
    at its starting value, unless the radiance of some part of the scene is known.

    Args:
        radiance: Function (light, material, eye) -> radiance of every vertex. It must be linear in the light.
        start: The pair (light, material), of at most 512 numbers together.
        pixels: The result of `observe`.
        lower: Lower bounds of the material, in the form that `material` takes.
        upper: Upper bounds of the material, in the same form.
        scale: Whether to hold the norm of the light. Give False where a part is known, such as a color chart.
        steps: Largest number of iterations.

    Returns:
        A fit whose value is the pair (light, material). Its deviations assume the norm of the light where that is held.

    Raises:
        TypeError: The start is not a pair, or for the reasons that `light` and `material` give.
        ValueError: The light of the start is black, or for the reasons that `light` and `material` give.
    """
    _check(radiance, pixels)
    if not isinstance(start, tuple | list) or len(start) != 2:
        raise TypeError(f"the start must be a light and a material, a pair, got {type(start).__name__}")
    dark, surface = start
    first = light(lambda trial, eye: radiance(trial, surface, eye), dark, pixels)
    (lit, of_light), (parameters, of_material) = solve.ravel(first.value, steps), solve.ravel(surface, steps)
    if len(lit) + len(parameters) > solve.DENSE:
        required = f"light and material may have at most {solve.DENSE} parameters together"
        raise ValueError(f"{required}, got {len(lit)} and {len(parameters)}")
    norm, brightness = (float(jnp.linalg.norm(vector)) for vector in (solve.ravel(dark, steps)[0], lit))
    if not (norm > 0 and brightness > 0):
        raise ValueError(
            f"the light must not be black, got norm {norm} at the start and {brightness} after the first fit"
        )
    low, high = (solve.bound(limits, surface, none) for limits, none in ((lower, -np.inf), (upper, np.inf)))
    solve.check(parameters, low, high)
    free, bounded, pinned = solve.unbound(parameters, low, high)
    size = norm if scale else brightness

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
        function, jnp.concatenate([lit / brightness, free]), whole, at_bounds, unravel, steps, held=int(scale)
    )


def _check(radiance: Callable, pixels: Observations) -> None:
    """Refuses a radiance that is not a function, and pixels that are not from `observe`."""
    if not callable(radiance):
        raise TypeError(f"the radiance must be a function, got {type(radiance).__name__}")
    if not isinstance(pixels, Observations):
        raise TypeError(f"pixels must be from jaxprt.inverse.observe, got {type(pixels).__name__}")
    solve.outside(pixels)


def _check_prior(prior: Callable, unravel: Callable, first: Array) -> None:
    """Refuses a prior that is not one number."""
    if not callable(prior):
        raise TypeError(f"the prior must be a function, got {type(prior).__name__}")
    result = jax.eval_shape(lambda x: prior(unravel(x)), first)
    if getattr(result, "shape", None) != () or not jnp.issubdtype(result.dtype, jnp.floating):
        raise ValueError(f"the prior must be one number of floating point, got {result}")
