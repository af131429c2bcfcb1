"""What the harmonics of a light tell at once: irradiance, and the directional light that fits best.

Coefficients are those of `jaxprt.sphere.harmonics`: of radiance, orthonormal, in l(l+1)+m order. Nothing is clamped.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.sphere import harmonics

_LUMINANCE = (0.2126, 0.7152, 0.0722)  # of Rec. 709


@jit
def irradiance(coefficient: Float[Array, "lm *c"], normal: Float[Array, "*b 3"]) -> Float[Array, "..."]:
    """Irradiance of surfaces without shadows, by their normals: the light convolved with the clamped cosine.

    Times albedo / pi it is the radiance of an ideal diffuse surface. Nine coefficients hold almost all of it, because
    the clamped cosine has no odd bands beyond 1 and its even ones fall as l^(-5/2).

    Args:
        coefficient: Coefficients of the light, gray or in colors.
        normal: Unit normals, in the frame of the light.

    Returns:
        Irradiance [*b, *c], in the light's units times sr.

    Raises:
        ValueError: The number of coefficients is not a square.

    Reference: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment maps".
    """
    kernel = harmonics.cosine(degree=harmonics.degree_of(coefficient.shape[0]))
    return harmonics.reconstruct(harmonics.convolve(coefficient, kernel.astype(coefficient.dtype)), normal)


@jit
def dominant_direction(coefficient: Float[Array, "lm *c"]) -> Float[Array, "3"]:
    """The direction that most light comes from: the mean of directions, weighted by radiance, scaled to length 1.

    It is the direction of the linear band, of the luminance where there are three colors, of the mean otherwise.

    Args:
        coefficient: Coefficients of the light, of degree 1 or more.

    Returns:
        A unit vector; zero where the linear band is exactly zero, as without light, and then its derivatives are zero
        too. Of light that is the same from everywhere but for rounding, the direction means nothing.

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
    """The directional light that fits best: its direction, and the color that brings it nearest to the light.

    The light E delta(s - d) has coefficients E y_i(d). The color E is what minimizes their squared difference to the
    coefficients that are given, which is the difference of the two lights up to their degree; E is in closed form,
    4 pi / (degree + 1)^2 times the light's reconstruction at d.

    Args:
        coefficient: Coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the light, of `dominant_direction`, and the irradiance that it makes on a surface which
        faces it. Both are zero where the direction is.

    Raises:
        ValueError: The degree is below 1, or the number of coefficients is not a square.

    Reference: Sloan 2008, "Stupid spherical harmonics tricks". His normalization, radiance of a white surface that
    faces the light, is E = 16 pi / 17 at degree 2.
    """
    direction = dominant_direction(coefficient)
    there = _where_directed(direction, harmonics.reconstruct(coefficient, direction))
    return direction, there * (4 * jnp.pi / coefficient.shape[0])


@jit
def directional_and_ambient(
    coefficient: Float[Array, "lm *c"],
) -> tuple[Float[Array, "3"], Float[Array, "*c"], Float[Array, "*c"]]:
    """The directional light and the constant light whose sum fits best: `directional_light` with a second color.

    With n = (degree + 1)^2 coefficients, m the mean radiance and r the light's reconstruction in the direction, the
    irradiance is 4 pi (r - m) / (n - 1), and the constant radiance (n m - r) / (n - 1).

    Args:
        coefficient: Coefficients of the light, of degree 1 or more.

    Returns:
        The unit direction to the directional light, of `dominant_direction`; the irradiance that it makes on a surface
        which faces it; and the radiance of the constant light, which makes pi times that. A color may be negative
        where light comes from several sides. Without a direction the constant light is the mean, and the other zero.

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
    """Zero without a direction."""
    return jnp.where(jnp.any(direction != 0), value, 0)


def _check(coefficient: Array) -> None:
    degree = harmonics.degree_of(coefficient.shape[0])
    if degree < 1:
        raise ValueError(f"the light must have degree 1 or more to have a direction, got degree {degree}")
