"""Analytic BRDFs. Each is a callable (wi, wo) -> value in 1/sr on local directions; its parameters are leaves.

Values carry a trailing channel axis: one channel where the parameters are gray, three where any is a color. Both
directions must be above the horizon; elsewhere the value is zero. Values and gradients are finite at grazing angles
and where the half vector is the normal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_GRAZING = 1e-4


def _color(value) -> Array:
    """A scalar or a color as an array [1] or [3]."""
    return jnp.atleast_1d(jnp.asarray(value, jnp.result_type(float)))


def _scalar(value) -> Array:
    return jnp.asarray(value, jnp.result_type(float))


def _lit(wi: Array, wo: Array) -> Array:
    return (wi[..., 2:] > 0) & (wo[..., 2:] > 0)


class Lambert(eqx.Module):
    """Ideal diffuse reflection, albedo / pi.

    Attributes:
        albedo: Share of the light that is reflected; gray or a color.
    """

    albedo: Float[Array, " c"] = eqx.field(converter=_color, default=0.5)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        return jnp.where(_lit(wi, wo), self.albedo / jnp.pi, 0)


class AshikhminShirley(eqx.Module):
    """Anisotropic Phong model: Fresnel-weighted specular lobe over a diffuse base that gives way to it.

    Reciprocal, and energy conserving for diffuse + specular <= 1.

    Attributes:
        diffuse: Reflectance R_d of the base; gray or a color.
        specular: Reflectance R_s at normal incidence; gray or a color.
        nu: Phong exponent along the tangent.
        nv: Phong exponent along the bitangent.

    Reference: Ashikhmin and Shirley 2000, equations 4 to 6.
    """

    diffuse: Float[Array, " c"] = eqx.field(converter=_color, default=0.5)
    specular: Float[Array, " c"] = eqx.field(converter=_color, default=0.75)
    nu: Float[Array, ""] = eqx.field(converter=_scalar, default=10.0)
    nv: Float[Array, ""] = eqx.field(converter=_scalar, default=100.0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        lit = _lit(wi, wo)
        cos_i, cos_o = (jnp.where(lit, w[..., 2:], 1) for w in (wi, wo))
        # The guard only acts where both directions graze and the model itself has no limit.
        half = jnp.where(lit, wi + wo, jnp.array([0.0, 0.0, 1.0]))
        square = jnp.maximum(jnp.sum(half**2, -1, keepdims=True), _GRAZING**2)
        half = half * jax.lax.rsqrt(square)
        # |wi + wo| = 2 cos(theta_d) for unit directions, so no difference of nearly equal numbers is needed.
        cos_d = jnp.sqrt(square) / 2
        fresnel = self.specular + (1 - self.specular) * (1 - jnp.minimum(cos_d, 1)) ** 5
        slope = jnp.sum(half[..., :2] ** 2, -1, keepdims=True)
        tilt = self.nu * half[..., :1] ** 2 + self.nv * half[..., 1:2] ** 2
        # (n.h)^e = exp(e log(n.h)); next to the normal log(n.h) = log1p(-slope) / 2, and tilt / slope is guarded.
        near = slope < 0.5
        log_cos = jnp.where(
            near,
            jnp.log1p(-jnp.where(near, slope, 0)) / 2,
            jnp.log(jnp.where(near, 1, jnp.maximum(half[..., 2:], _GRAZING))),
        )
        small = slope < _GRAZING**2
        exponent = jnp.where(small, -tilt / 2, tilt / jnp.where(small, 1, slope) * log_cos)
        peak = jnp.sqrt((self.nu + 1) * (self.nv + 1)) / (8 * jnp.pi)
        lobe = peak * jnp.exp(exponent) / (cos_d * jnp.maximum(jnp.maximum(cos_i, cos_o), _GRAZING))
        base = 28 / (23 * jnp.pi) * self.diffuse * (1 - self.specular)
        base = base * (1 - (1 - cos_i / 2) ** 5) * (1 - (1 - cos_o / 2) ** 5)
        return jnp.where(lit, lobe * fresnel + base, 0)
