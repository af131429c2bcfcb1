"""Irradiance and approximating directional lights, from the SH coefficients of a light.

Coefficients are those of radiance in the orthonormal basis of `jaxprt.sphere.harmonics`, in l(l+1)+m order. Results are
not clamped.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import harmonics

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # weights of Rec. 709


@jit
def irradiance(coefficient: Float[Array, "lm *c"], normal: Float[Array, "*b 3"]) -> Float[Array, "..."]:
    """Irradiance without shadows for given normals: the light convolved with the clamped cosine.

    Irradiance times albedo / pi is the radiance of an ideal diffuse surface. Nine coefficients determine almost all of
    it, because the clamped cosine has no odd bands above 1 and its even bands fall as l^(-5/2).

    Args:
        coefficient: SH coefficients of the light, gray or with any trailing axes such as colors.
        normal: Unit normals, in the same frame as the light.

    Returns:
        Irradiance [*b, *c], in units of radiance times sr.

    Raises:
        ValueError: The number of coefficients is not a square.

    Reference: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment maps".
    """
    kernel = harmonics.cosine(degree=harmonics.degree_of(coefficient.shape[0]))
    return harmonics.reconstruct(harmonics.convolve(coefficient, kernel.astype(coefficient.dtype)), normal)


@jit
def dominant_direction(coefficient: Float[Array, "lm *c"]) -> Float[Array, "3"]:
    """Dominant direction of a light: the mean of directions weighted by radiance, normalized.

    It is the direction of the linear band (l = 1). With three colors, their luminance is used, otherwise their mean.

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        A unit vector. It is zero, with zero derivatives, where the linear band is exactly zero, for example without
        light. If light is uniform up to rounding, the direction is meaningless.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on extracting directional lights.
    """
    _check(coefficient)
    linear = coefficient[1:4].reshape(3, -1)
    colors = linear.shape[1]
    weight = jnp.asarray(_LUMINANCE if colors == 3 else (1 / colors,) * colors, coefficient.dtype)
    mean = (linear @ weight)[jnp.array([2, 0, 1])]  # functions y, z, x
    largest = lax.stop_gradient(jnp.max(jnp.abs(mean)))
    some = largest > 0
    scaled = jnp.where(some, mean / jnp.where(some, largest, 1), jnp.array([1, 0, 0], coefficient.dtype))
    return jnp.where(some, scaled / jnp.sqrt(jnp.sum(scaled**2)), 0)


@jit
def directional_light(coefficient: Float[Array, "lm *c"]) -> tuple[Float[Array, "3"], Float[Array, "*c"]]:
    """The directional light in the dominant direction that approximates a light best by least squares.

    A directional light E delta(s - d) has SH coefficients E y_i(d). The irradiance E minimizes their squared difference
    from the given coefficients. In closed form, E is 4 pi / (degree + 1)^2 times the light's reconstruction at d.

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the light, from `dominant_direction`; and its irradiance on a surface that faces it. Both
        are zero if there is no dominant direction.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks". He normalizes by the radiance of a white surface that
    faces the light, for which E is 16 pi / 17 at degree 2.
    """
    direction = dominant_direction(coefficient)
    there = _where_directed(direction, harmonics.reconstruct(coefficient, direction))
    return direction, there * (4 * jnp.pi / coefficient.shape[0])


@jit
def directional_and_ambient(
    coefficient: Float[Array, "lm *c"],
) -> tuple[Float[Array, "3"], Float[Array, "*c"], Float[Array, "*c"]]:
    """The sum of a directional and a constant (ambient) light that approximates a light best by least squares.

    Let n = (degree + 1)^2 be the number of coefficients, m the mean radiance, and r the light's reconstruction in the
    dominant direction. The irradiance of the directional light is 4 pi (r - m) / (n - 1), and the radiance of the
    constant light is (n m - r) / (n - 1).

    Args:
        coefficient: SH coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the directional light, from `dominant_direction`; its irradiance on a surface that faces
        it; and the radiance of the constant light, whose irradiance is pi times that. Either may be negative where
        light comes from several sides. Without a dominant direction, the constant light is the mean and the directional
        light is zero.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks", section on ambient and directional lights.
    """
    direction = dominant_direction(coefficient)
    terms = coefficient.shape[0]
    mean = coefficient[0] / jnp.sqrt(4 * jnp.pi).astype(coefficient.dtype)
    excess = _where_directed(direction, (harmonics.reconstruct(coefficient, direction) - mean) / (terms - 1))
    return direction, 4 * jnp.pi * excess, mean - excess


def _where_directed(direction: Array, value: Array) -> Array:
    """The value, or zero if there is no dominant direction."""
    return jnp.where(jnp.any(direction != 0), value, 0)


def _check(coefficient: Array) -> None:
    degree = harmonics.degree_of(coefficient.shape[0])
    if degree < 1:
        raise ValueError(f"the light must have degree 1 or more to have a direction, got degree {degree}")
