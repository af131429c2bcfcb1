"""A sheen over a material, as KHR_materials_sheen has it: fibers that stand up from the surface, as of velvet.

With C the color of the sheen, alpha = sheen_roughness^2, h the half vector and s its sine to the normal,

    value = C D V + (1 - max_c(C) E(wo)) base,
    D = (2 + 1 / alpha) s^(1 / alpha) / (2 pi),    V = 1 / (4 cos_i cos_o (1 + L(cos_i) + L(cos_o))).

L is the masking of the fibers: L(x) = exp(l(x)) up to x = 0.5 and exp(2 l(0.5) - l(1 - x)) beyond, with
l(x) = a / (1 + b x^c) + d x + e, whose coefficients depend on alpha. E(wo) is the albedo of D V towards the view, at
most 1. As in the simplified form of the extension's text, the base is dimmed by the view alone, so the value is not
reciprocal.

An alpha below 0.01 (a roughness below 0.1) is replaced by 0.01: such a sheen is seen in the last six degrees above the
horizon only.

References: KHR_materials_sheen, sections "Sheen distribution", "Sheen visibility" and "Albedo-scaling technique";
Estevez and Kulla 2017, "Production friendly microfacet sheen BRDF", for D and L.
"""

import functools
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.microfacet import MetallicRoughness
from jaxprt.brdf.models import Model, both_above, color, half_vector, scalar

Numbers = Float[Array | np.ndarray, "..."]

SMOOTHEST = 0.1  # smaller roughness is treated as this one
_TINY = 1e-20
# Coefficients a to e of l, each where alpha is 1 and where it is 0. Between, they are linear in (1 - alpha)^2.
_MASKING = (
    (21.5473, 25.3245),
    (3.82987, 3.32435),
    (0.19823, 0.16801),
    (-1.97760, -1.27393),
    (-4.32054, -4.85967),
)
_ANGLES, _ROUGHNESSES = 65, 33  # of the table of albedos
_RINGS, _SECTORS = 48, 48  # of its quadrature; half of the sectors are computed
_LOWEST = 0.991  # tan(theta / 2) of the last view, half a degree above the horizon and used as if it were on it


def _masking(cosine: Numbers, alpha: Numbers | float) -> Numbers:
    """L of the module's equation."""
    xp = np if isinstance(cosine, np.ndarray) else jnp
    smooth = (1 - alpha) ** 2
    a, b, c, d, e = (rough + (other - rough) * smooth for rough, other in _MASKING)

    def exponent(x):
        return a / (1 + b * x**c) + d * x + e

    near = cosine < 0.5
    low, high = xp.where(near, cosine, 0.5), xp.where(near, 0.5, xp.minimum(cosine, 1 - 1e-6))
    return xp.exp(xp.where(near, exponent(low), 2 * exponent(0.5 + 0 * high) - exponent(1 - high)))


def _value(sine2: Numbers, cos_i: Numbers, cos_o: Numbers, roughness: Numbers | float) -> Numbers:
    """D V, given the squared sine of the half vector to the normal."""
    xp = np if isinstance(sine2, np.ndarray) else jnp
    alpha = xp.maximum(roughness, SMOOTHEST) ** 2
    power = xp.exp(xp.log(xp.clip(sine2, _TINY, 1)) / (2 * alpha))
    visibility = 0.25 / (cos_i * cos_o * (1 + _masking(cos_i, alpha) + _masking(cos_o, alpha)))
    return (2 + 1 / alpha) * power / (2 * np.pi) * visibility


class Charlie(Model):
    """The fibers of a sheen alone, of color 1: D V of the module's equation.

    Attributes:
        roughness: Perceptual roughness of the sheen; alpha is its square. One number, or one for each direction.
    """

    lobe_width: ClassVar = {"roughness": 0.5}

    roughness: Float[Array, "*#b"] = eqx.field(converter=scalar, default=0.3)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b 1"]:
        """Value of the BRDF in 1/sr."""
        (x, y, _), _, cos_i, cos_o = half_vector(wi, wo)
        return jnp.where(both_above(wi, wo), _value(x**2 + y**2, cos_i, cos_o, self.roughness[..., None]), 0)


@functools.cache
def _albedos() -> Float[np.ndarray, "r v"]:
    """Albedo of `Charlie` at even steps of the logarithm of roughness and of tan(theta / 2) of the view."""
    tangent = np.linspace(0, 1, _ANGLES)
    tangent[-1] = _LOWEST
    cos_o = (1 - tangent**2) / (1 + tangent**2)
    # Rings are close to one another near the horizon, where narrow sheens are.
    place, share = np.polynomial.legendre.leggauss(_RINGS)
    place, share = (place + 1) / 2, share / 2
    cos_i, area = place**2, 2 * place * share
    turn = np.cos((np.arange(_SECTORS // 2) + 0.5) / _SECTORS * 2 * np.pi)
    cos_i, cos_o = cos_i[:, None], cos_o[:, None, None]
    along = cos_i * cos_o + np.sqrt((1 - cos_i**2) * (1 - cos_o**2)) * turn
    sine2 = np.maximum(1 - (cos_i + cos_o) ** 2 / np.maximum(2 + 2 * along, _TINY), 0)
    rows = []
    for roughness in np.geomspace(SMOOTHEST, 1, _ROUGHNESSES):
        value = _value(sine2, cos_i, cos_o, np.float64(roughness)).mean(-1)
        rows.append(2 * np.pi * value @ (cos_i[:, 0] * area))
    return np.stack(rows)


def sheen_albedo(cosine: Float[Array | np.ndarray, "*b"], roughness: Numbers | float) -> Any:
    """E of the module's equation: albedo of a sheen of color 1, at most 1.

    Args:
        cosine: Cosines of the views to the normal.
        roughness: Perceptual roughness of the sheen; one number, or an array that broadcasts.

    Returns:
        The albedo [*b], interpolated in a table: .009 off at most, half a degree above the horizon.
    """
    xp = np if isinstance(cosine, np.ndarray) else jnp
    table = xp.asarray(_albedos(), cosine.dtype)
    cosine = xp.clip(cosine, 0, 1)
    across = xp.sqrt(xp.maximum((1 - cosine) / (1 + cosine), _TINY)) * (_ANGLES - 1)
    down = (1 - xp.log(xp.clip(roughness, SMOOTHEST, 1)) / np.log(SMOOTHEST)) * (_ROUGHNESSES - 1)
    across, down = xp.broadcast_arrays(across, down)
    column = xp.clip(across.astype(int), 0, _ANGLES - 2)
    row = xp.clip(down.astype(int), 0, _ROUGHNESSES - 2)
    right, below = across - column, down - row
    upper, lower = (table[row + step, column] * (1 - right) + table[row + step, column + 1] * right for step in (0, 1))
    return xp.minimum(upper * (1 - below) + lower * below, 1)


class UnderSheen(eqx.Module):
    """A BRDF times what a white sheen leaves of it, 1 - E(wo).

    Attributes:
        model: The BRDF.
        roughness: Perceptual roughness of the sheen.
    """

    model: Any
    roughness: Float[Array, ""]

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr."""
        return self.model(wi, wo) * (1 - sheen_albedo(wo[..., 2], self.roughness))[..., None]


class Sheen(eqx.Module):
    """A metallic-roughness material under a sheen; see the module for its equation.

    Attributes:
        base: The material.
        sheen_color: Linear color of the sheen, from 0 to 1; [c] or [*b c].
        sheen_roughness: Perceptual roughness of the sheen; alpha is its square.

    Raises:
        TypeError: The base is no `MetallicRoughness`.
        ValueError: The color or the roughness is not from 0 to 1.
    """

    base: MetallicRoughness
    sheen_color: Float[Array, "*#b #c"] = eqx.field(converter=color, default=1.0)
    sheen_roughness: Float[Array, "*#b"] = eqx.field(converter=scalar, default=0.3)

    def __check_init__(self):
        require.kind("the base of Sheen", self.base, MetallicRoughness, source="jaxprt.brdf.MetallicRoughness")
        require.within("sheen_color of Sheen", self.sheen_color, 0, 1)
        require.within("sheen_roughness of Sheen", self.sheen_roughness, 0, 1)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        most = jnp.max(self.sheen_color, -1)
        transmitted = 1 - most * sheen_albedo(wo[..., 2], self.sheen_roughness)
        return transmitted[..., None] * self.base(wi, wo) + self.sheen_color * Charlie(self.sheen_roughness)(wi, wo)
