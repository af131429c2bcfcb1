"""Microfacet BRDFs with the GGX distribution, and the metallic-roughness material of glTF 2.0.

The surface consists of small mirrors. For directions with the half vector h, the BRDF is

    F D V,    D = 1 / (pi a_x a_y ((h_x / a_x)^2 + (h_y / a_y)^2 + h_z^2)^2),
              V = 1 / (2 (cos_o |(a_x x_i, a_y y_i, z_i)| + cos_i |(a_x x_o, a_y y_o, z_o)|)).

D is the distribution of normals of Trowbridge and Reitz, named GGX by Walter et al. V = G / (4 cos_i cos_o) contains
the height-correlated masking and shadowing G of Smith's model. F is the Fresnel reflectance at the mirrors.

In this file `roughness` is the perceptual roughness of glTF: alpha = roughness^2, where alpha is the parameter `alpha`
of Mitsuba's `roughconductor`. An alpha below 0.001 (a roughness below 0.0316) is replaced by 0.001; the gradient in
roughness is zero there.

Multiple scattering is not included: with F = 1 and roughness 1 the surface reflects only 31 % at normal incidence.

References: Walter, Marschner, Li, Torrance 2007, "Microfacet models for refraction through rough surfaces", for D;
Heitz 2014, "Understanding the masking-shadowing function in microfacet-based BRDFs", equations 85, 86 and 99, for the
anisotropic D and G; Burley 2012, "Physically based shading at Disney", for alpha = roughness^2.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf.models import Lambert, Model, both_above, color, half_vector, scalar
from jaxprt.compile import jit

_SMOOTHEST = 1e-3  # smallest alpha, because a perfect mirror has no density


_both_axes = partial(require.repeated, length=2)  # one number for both tangent axes, or two numbers


def _alpha(roughness: Array) -> Array:
    return jnp.maximum(roughness**2, _SMOOTHEST)


def _lobe(wi: Array, wo: Array, along: Array, across: Array, rotation: Array | float) -> tuple[Array, Array]:
    """D V, [*b 1], for alpha along a tangent axis and across it, and the cosine between half vector and directions."""
    # Computed component by component, for the same reason as `half_vector`.
    (x, y, z), cos_d, cos_i, cos_o = half_vector(wi, wo)
    cosine, sine = jnp.cos(rotation), jnp.sin(rotation)

    def turned(x, y):
        return cosine * x + sine * y, cosine * y - sine * x

    def stretched(w, cosine):
        x, y = turned(w[..., 0:1], w[..., 1:2])
        return jnp.sqrt((along * x) ** 2 + (across * y) ** 2 + cosine**2)

    x, y = turned(x, y)
    # This form avoids the cancellation of 1 + (alpha^2 - 1) cos^2 at small alpha such as 0.001.
    tilt = (x / along) ** 2 + (y / across) ** 2 + z**2
    distribution = 1 / (jnp.pi * along * across * tilt**2)
    visibility = 0.5 / (cos_o * stretched(wi, cos_i) + cos_i * stretched(wo, cos_o))
    return distribution * visibility, cos_d


def _schlick_weight(cos_d: Array) -> Array:
    """Schlick's (1 - v.h)^5, clamped so that rounding cannot make it negative."""
    return (1 - jnp.minimum(cos_d, 1)) ** 5


def _fresnel(cos_d: Array, eta: Array, k: Array) -> Array:
    """Fresnel's reflectance of unpolarized light for the complex index of refraction eta + i k."""
    cos_d = jnp.minimum(cos_d, 1)
    cosine, sine = cos_d**2, 1 - cos_d**2
    # a + i b is the square root of (eta + i k)^2 - sine. If a^2 - b^2 is negative, a = eta k / b avoids cancellation.
    real, cross = eta**2 - k**2 - sine, eta * k
    size = jnp.sqrt(jnp.maximum(real**2 + 4 * cross**2, 1e-24))
    larger = jnp.sqrt((size + jnp.abs(real)) / 2)
    twice = 2 * cos_d * jnp.where(real < 0, cross / larger, larger)
    parallel = size * cosine + sine**2
    s_polarized = (size + cosine - twice) / (size + cosine + twice)
    p_polarized = s_polarized * (parallel - twice * sine) / (parallel + twice * sine)
    return (s_polarized + p_polarized) / 2


class GGX(Model):
    """GGX with Schlick's Fresnel term, for metals with the color f0 at normal incidence. Conserves energy for f0 <= 1.

    F = f0 + (1 - f0) (1 - v.h)^5. For a dielectric over a diffuse base use `MetallicRoughness` with metallic 0.

    Attributes:
        f0: Fresnel reflectance at normal incidence; gray or a color.
        roughness: Roughness along the tangent and along the bitangent; one number stands for both.
        rotation: Angle in radians from the tangent, counterclockwise about the normal, to the first of the two axes
            that `roughness` is given for.
    """

    lobe_width: ClassVar = {"roughness": 0.5}
    least: ClassVar = {"rotation": -jnp.inf}

    f0: Float[Array, " c"] = eqx.field(converter=color, default=0.9)
    roughness: Float[Array, "2"] = eqx.field(converter=_both_axes, default=0.4)
    rotation: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        return _of_f0([self], wi, wo)[0]


def values(
    models: Sequence[Callable], wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]
) -> list[Float[Array, "*b _"]]:
    """Values of several models. Neighboring lobes of `GGX` with the same arrays but f0 share what they compute.

    Args:
        models: BRDFs (wi, wo) -> value [*b c] in 1/sr.
        wi: Unit directions to the light.
        wo: Unit directions to the viewer.
    """
    result, rest = [], list(models)
    while rest:
        alike = 1 + sum(1 for _ in itertools.takewhile(partial(_differ_in_f0, rest[0]), rest[1:]))
        result += _of_f0(rest[:alike], wi, wo) if alike > 1 else [rest[0](wi, wo)]
        del rest[:alike]
    return result


def _differ_in_f0(one: Callable, other: Callable) -> bool:
    if not (isinstance(one, GGX) and isinstance(other, GGX)):
        return False
    return one.roughness is other.roughness and one.rotation is other.rotation


def _of_f0(lobes: Sequence[Any], wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> list[Float[Array, "*b _"]]:
    """Values of lobes that differ in f0."""
    along, across = _alpha(lobes[0].roughness)
    lobe, cos_d = _lobe(wi, wo, along, across, lobes[0].rotation)
    above, rise = both_above(wi, wo), _schlick_weight(cos_d)
    return [jnp.where(above, lobe * (model.f0 + (1 - model.f0) * rise), 0) for model in lobes]


class GGXInterface(Model):
    """GGX with Fresnel's equations: the interface between air and a conductor or a dielectric. Conserves energy.

    Dielectrics have k = 0. Transmitted light is lost.

    Attributes:
        eta: Real part of the index of refraction relative to air; gray or a color.
        k: Extinction coefficient, the imaginary part of the index of refraction.
        roughness: Roughness along the tangent and along the bitangent; one number stands for both.

    Reference: Born and Wolf, "Principles of optics", sections 1.5.2 and 14.2, for Fresnel's equations.
    """

    lobe_width: ClassVar = {"roughness": 0.5}

    eta: Float[Array, " c"] = eqx.field(converter=color, default=1.5)
    k: Float[Array, " c"] = eqx.field(converter=color, default=0.0)
    roughness: Float[Array, "2"] = eqx.field(converter=_both_axes, default=0.4)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        along, across = _alpha(self.roughness)
        lobe, cos_d = _lobe(wi, wo, along, across, 0.0)
        return jnp.where(both_above(wi, wo), lobe * _fresnel(cos_d, self.eta, self.k), 0)


class SchlickDiffuse(Model):
    """Diffuse base under a layer with Schlick's Fresnel term: albedo (1 - (1 - v.h)^5) / pi. Conserves energy.

    Attributes:
        albedo: Albedo of the base where the layer reflects nothing; gray or a color.
    """

    albedo: Float[Array, " c"] = eqx.field(converter=color, default=0.5)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        _, cos_d, _, _ = half_vector(wi, wo)
        return jnp.where(both_above(wi, wo), self.albedo / jnp.pi * (1 - _schlick_weight(cos_d)), 0)


class MetallicRoughness(Model):
    """The metallic-roughness material of glTF 2.0, with its extensions for ior, specular and anisotropy.

    With w = (1 - v.h)^5, F0 = min(((1 - ior) / (1 + ior))^2 specular_color, 1), and D and V as defined in this module,

        dielectric = specular (F0 + (1 - F0) w) D V + (1 - specular max_c(F0 + (1 - F0) w)) base_color / pi,
        metal = (base_color + (1 - base_color) w) D V,
        value = (1 - metallic) dielectric + metallic metal,

    where max_c is the maximum over colors. G is height-correlated. Appendix B of the specification notes that this is
    more accurate than its sample implementation, which multiplies the masking of one direction by that of the other.

    The metal conserves energy for base_color <= 1. The specification's coupling of the dielectric to its diffuse base
    does not: a smooth white dielectric reflects 1.93 times the light that arrives from the horizon.

    Parameters may have leading axes that broadcast against those of the directions. For example, base_color [v 3] and
    roughness [v] give each of v pairs of directions its own material. At the kinks of min and max_c, derivatives are
    those of one side or the mean of both.

    Attributes:
        base_color: Albedo of the dielectric, and reflectance of the metal at normal incidence; [c] or [*b c], linear.
        metallic: Fraction of metal, from 0 to 1; [] or [*b]. All further parameters except specular_color have this
            shape.
        roughness: Perceptual roughness; alpha = roughness^2.
        ior: Index of refraction of the dielectric. 0 makes F0 = specular_color.
        specular: Weight of the dielectric's reflection, from 0 to 1.
        specular_color: Color of the dielectric's reflection at normal incidence; [c] or [*b c].
        anisotropy: Strength from 0 to 1. Along the axis, alpha becomes alpha + (1 - alpha) anisotropy^2.
        rotation: Angle in radians from the tangent, counterclockwise about the normal, to the axis along which
            highlights are stretched.

    Raises:
        ValueError: A color has neither 1 nor 3 channels, or the leading axes of the parameters do not broadcast.

    Reference: glTF 2.0 specification, appendix B; KHR_materials_ior, KHR_materials_specular,
    KHR_materials_anisotropy.
    """

    lobe_width: ClassVar = {"roughness": 0.5}
    least: ClassVar = {"rotation": -jnp.inf}

    base_color: Float[Array, "*#b #c"] = eqx.field(converter=color, default=1.0)
    metallic: Float[Array, "*#b"] = eqx.field(converter=scalar, default=1.0)
    roughness: Float[Array, "*#b"] = eqx.field(converter=scalar, default=1.0)
    ior: Float[Array, "*#b"] = eqx.field(converter=scalar, default=1.5)
    specular: Float[Array, "*#b"] = eqx.field(converter=scalar, default=1.0)
    specular_color: Float[Array, "*#b #c"] = eqx.field(converter=color, default=1.0)
    anisotropy: Float[Array, "*#b"] = eqx.field(converter=scalar, default=0.0)
    rotation: Float[Array, "*#b"] = eqx.field(converter=scalar, default=0.0)

    def __check_init__(self):
        for name, value in vars(self).items():
            require.real(f"{name} of MetallicRoughness", value)
        for name in ("metallic", "specular", "anisotropy"):
            require.within(f"{name} of MetallicRoughness", getattr(self, name), 0, 1)
        shape = {name: value.shape for name, value in vars(self).items()}
        for name in ("base_color", "specular_color"):
            if shape[name][-1] not in (1, 3):
                raise ValueError(f"{name} of MetallicRoughness must have 1 or 3 channels, got shape {shape[name]}")
            shape[name] = shape[name][:-1]
        try:
            np.broadcast_shapes(*shape.values())
        except ValueError as error:
            leading = ", ".join(f"{name} {sizes}" for name, sizes in shape.items() if sizes)
            raise ValueError(f"leading axes of MetallicRoughness must broadcast, got {leading}") from error

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        along, across = self._alphas()
        lobe, cos_d = _lobe(wi, wo, along[..., None], across[..., None], self.rotation[..., None])
        weight = _schlick_weight(cos_d)
        under, mirror, rim, bare = self._coefficients()
        diffuse = (under * (1 - weight) + bare) / jnp.pi
        return jnp.where(both_above(wi, wo), diffuse + lobe * (mirror + rim * weight), 0)

    def terms(self) -> tuple[Model, Model, Model, Model]:
        """Four gray BRDFs that depend on roughness, anisotropy and rotation only.

        Their sum with the weights `coefficient()` is the whole material:

            K1 = (1 - w) / pi    SchlickDiffuse(1), the diffuse base under a full dielectric layer
            K2 = D V             GGX(1), the specular lobe with a Fresnel reflectance of 1
            K3 = D V w           GGX(0), the part of the lobe that is due to Schlick's rise at grazing angles
            K4 = 1 / pi          Lambert(1), the diffuse base as far as `specular` < 1 removes the layer

        One table per term therefore serves all textures of color, metallic, ior and specular. `needed` tells which
        terms can be left out.
        """
        for name in ("roughness", "anisotropy", "rotation"):
            if (shape := getattr(self, name).shape) != ():
                raise ValueError(
                    f"{name} of MetallicRoughness must be one number for all vertices, got an array of shape "
                    f"{list(shape)}; split the vertices into groups of one {name} each"
                )
        axes = jnp.sqrt(jnp.stack(self._alphas()))
        return SchlickDiffuse(1.0), GGX(1.0, axes, self.rotation), GGX(0.0, axes, self.rotation), Lambert(1.0)

    def coefficient(self) -> Float[Array, "*b 4 c"]:
        """Weights of the four `terms`. They are not negative for colors up to 1."""
        return _stack(self)

    def needed(self) -> tuple[int, ...]:
        """Indices of the `terms` whose weight is not zero everywhere; all four while JAX traces the values.

        A metal needs no diffuse terms, and a material with `specular` 1 needs no Lambert term:

            keep = material.needed()
            term = [material.terms()[k] for k in keep]
            weight = material.coefficient()[..., keep, :]
        """
        weights = enumerate(_separate(self))
        return tuple(k for k, weight in weights if isinstance(weight, Tracer) or np.any(np.asarray(weight)))

    def _alphas(self) -> tuple[Array, Array]:
        """Alpha along the axis of anisotropy and across it."""
        alpha = _alpha(self.roughness)
        return alpha + (1 - alpha) * self.anisotropy**2, alpha

    def _coefficients(self) -> tuple[Array, Array, Array, Array]:
        base, metallic, specular = self.base_color, self.metallic[..., None], self.specular[..., None]
        f0 = jnp.minimum(((1 - self.ior) / (1 + self.ior))[..., None] ** 2 * self.specular_color, 1)
        dielectric = 1 - metallic
        layer = dielectric * specular
        # For every w, the largest color of F0 + (1 - F0) w is that of F0.
        under = layer * base * (1 - jnp.max(f0, -1, keepdims=True))
        mirror = layer * f0 + metallic * base
        rim = layer * (1 - f0) + metallic * (1 - base)
        return under, mirror, rim, dielectric * (1 - specular) * base


@jit
def _separate(material: MetallicRoughness) -> tuple[Array, ...]:
    return material._coefficients()


@jit
def _stack(material: MetallicRoughness) -> Array:
    return jnp.stack(jnp.broadcast_arrays(*material._coefficients()), -2)
