"""Anisotropic BRDFs of surfaces with parallel cylinders or grooves, including self-shadowing (Poulin and Fournier).

The profile repeats along the bitangent y and is constant along the tangent x, the direction of brushing. Each point
of the profile reflects like a diffuse base with a Blinn-Phong lobe, f(n) = diffuse / pi + specular c (n.h)^e, where c
is the normalization of `BlinnPhong`. The single-scattering BRDF of the whole surface is the mean over one period,

    f(wi, wo) = 1 / (distance cos_i cos_o) integral of f(n) (n.wi) (n.wo) over what is both lit and visible.

In the cross-section a direction is described by the angle theta = atan(y / z) alone, because (n.w) / cos =
cos(angle - theta) / cos(theta) for the normal at `angle`. A direction sees one interval of angles of an arc and one
interval of y of the plane. The part that is both lit and visible is the intersection of two such intervals. The
integral over it uses Gauss-Legendre quadrature with fixed nodes; the integral of the lobe covers only the lobe's range.

Both models are reciprocal and conserve energy for diffuse + specular <= 1. Light that hits the surface more than once
is lost. Values and gradients are finite everywhere: cosines below 1e-4 are replaced by 1e-4. Gradients of parameters
include those of the limits of integration.

Reference: Poulin and Fournier 1990, "A model for anisotropic reflection", for the surfaces and the integral over the
lit and visible part. They integrate the lobe by Chebyshev polynomials. The division by both cosines, which makes the
result a reciprocal BRDF, and the closed forms of the limits are derived here.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt.brdf.models import Model, color, scalar

_GRAZING = 1e-4  # smallest cosine
_DIFFUSE_NODES = 8  # The integrand is a trigonometric polynomial of degree 2: exact to 1e-9 over pi.
_LOBE_NODES = 24  # exact to 1e-10 over twice _LOBE_WIDTH
_LOBE_WIDTH = 6.0  # in 1 / sqrt(exponent); farther out the lobe is below exp(-18) of its peak


def _inside(cosine: Array) -> Array:
    """A cosine clipped so that the derivatives of its arcus functions are finite."""
    bound = 1 - 8 * jnp.finfo(cosine.dtype).eps
    return jnp.clip(cosine, -bound, bound)


def _nodes(low: Array, high: Array, count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes between two limits [*b], and their weights [*b n]; zero weights if low is above high."""
    node, weight = np.polynomial.legendre.leggauss(count)
    half = jnp.maximum(high - low, 0)[..., None] / 2
    return low[..., None] + half * jnp.asarray(1 + node, low.dtype), half * jnp.asarray(weight, low.dtype)


def _overlap(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    return jnp.maximum(one[0], other[0]), jnp.minimum(one[1], other[1])


def _reflect(brdf, wi: Array, wo: Array, arc: Callable, plane: Callable) -> Array:
    """The BRDF as a mean over one period; `arc` and `plane` give the intervals that a direction theta sees."""
    lit = (wi[..., 2] > 0) & (wo[..., 2] > 0)
    least = jnp.asarray([-2, -2, _GRAZING], wi.dtype)
    wi, wo = (jnp.maximum(jnp.where(lit[..., None], w, jnp.asarray([0, 0, 1], w.dtype)), least) for w in (wi, wo))
    half = wi + wo
    theta_i, theta_o, theta_h = (jnp.arctan2(w[..., 1], w[..., 2]) for w in (wi, wo, half))
    cos_i, cos_o = (w[..., 2] / jnp.sqrt(w[..., 1] ** 2 + w[..., 2] ** 2) for w in (wi, wo))
    n = brdf.exponent

    def facing(angle):
        # (n.wi) (n.wo), negative by rounding at most.
        one, other = (jnp.maximum(jnp.cos(angle - theta[..., None]), 0) for theta in (theta_i, theta_o))
        return one * other

    def lobe(angle):
        # cos^n(x). Using 1 - cos(x) = 2 sin^2(x / 2) avoids the cancellation that a large n would amplify.
        return jnp.exp(n * jnp.log1p(-jnp.minimum(2 * jnp.sin(angle / 2) ** 2, 1 - _GRAZING)))

    # `arc` gives normal angles seen of an arc, `plane` y of the plane between two arcs with axes at 0 and `distance`.
    limits = _overlap(arc(theta_i), arc(theta_o))
    angle, weight = _nodes(*limits, _DIFFUSE_NODES)
    diffuse = jnp.sum(weight * facing(angle), -1) / (cos_i * cos_o)
    width = jnp.minimum(_LOBE_WIDTH / jnp.sqrt(jnp.maximum(n, 1)), jnp.pi / 2)
    angle, weight = _nodes(*_overlap(limits, (theta_h - width, theta_h + width)), _LOBE_NODES)
    specular = jnp.sum(weight * facing(angle) * lobe(angle - theta_h[..., None]), -1) / (cos_i * cos_o)
    low, high = _overlap(plane(theta_i), plane(theta_o))
    stretch = jnp.maximum(high - low, 0)

    # (n.h)^e = cos^e(angle - theta_h) |h_yz|^e. The last factor is computed from 1 - |h_yz|^2 where that is small.
    along, across = half[..., 0] ** 2, half[..., 1] ** 2 + half[..., 2] ** 2
    near = along < across
    log_across = jnp.where(
        near, jnp.log1p(-jnp.where(near, along / (along + across), 0)), jnp.log(across / (along + across))
    )
    peak = (n + 2) * (n + 4) / (8 * jnp.pi * (jnp.exp2(-n / 2) + n))
    diffuse, specular = diffuse + stretch, peak * jnp.exp(n / 2 * log_across) * (specular + stretch * lobe(theta_h))
    value = brdf.diffuse / jnp.pi * diffuse[..., None] + brdf.specular * specular[..., None]
    return jnp.where(lit[..., None], value / brdf.distance, 0)


def _mirror(theta: Array, low: Array, high: Array, period: Array | float = 0) -> tuple[Array, Array]:
    """Limits that hold for directions from the right, mirrored for directions from the left."""
    right = theta >= 0
    return jnp.where(right, low, period - high), jnp.where(right, high, period - low)


class PoulinFournier(Model):
    """Cylinders of radius 1 parallel to the tangent, lying side by side on a plane or partly sunk into it.

    Attributes:
        diffuse: Reflectance of the material's base, not of the surface; gray or a color.
        specular: Reflectance of its lobe at normal incidence; gray or a color.
        exponent: Exponent of the lobe around the half vector, from 0.
        distance: Distance between neighboring axes, in radii, above 0. Cylinders less than 2 apart intersect.
        height: Height of the axes above the plane, in radii: 1 for whole cylinders, 0 for half cylinders, -1 for a flat
            plane.
    """

    lobe_width: ClassVar = {"exponent": -2}
    least: ClassVar = {"distance": _GRAZING, "height": -jnp.inf}

    diffuse: Float[Array, " c"] = eqx.field(converter=color, default=0.3)
    specular: Float[Array, " c"] = eqx.field(converter=color, default=0.5)
    exponent: Float[Array, ""] = eqx.field(converter=scalar, default=100.0)
    distance: Float[Array, ""] = eqx.field(converter=scalar, default=2.0)
    height: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        return _reflect(self, wi, wo, self._arc, self._plane)

    def _edge(self) -> Array:
        """Angle at which an arc ends: at the plane, or where it meets its neighbor."""
        plane = jnp.arccos(_inside(-self.height))
        neighbor = jnp.arcsin(_inside(jnp.minimum(self.distance / 2, 1)))
        return jnp.where(self.distance < 2, jnp.minimum(plane, neighbor), plane)

    def _arc(self, theta: Array) -> tuple[Array, Array]:
        # Seen from the right (theta > 0), the left limit is where the arc faces away. The right limit is where the ray
        # just passes the neighbor's silhouette, at sin(angle - theta) = distance cos(theta) - 1, if that is exposed.
        edge, turn = self._edge(), jnp.abs(theta)
        reach = jnp.arcsin(_inside(self.distance * jnp.cos(theta) - 1))
        reach = jnp.where(jnp.pi / 2 - turn < edge, reach, jnp.pi / 2)
        return _mirror(theta, jnp.maximum(turn - jnp.pi / 2, -edge), jnp.minimum(turn + reach, edge))

    def _plane(self, theta: Array) -> tuple[Array, Array]:
        # The ray passes the silhouettes of the left and right cylinders, or their feet if the silhouettes are buried.
        edge, turn = self._edge(), jnp.abs(theta)
        sine, cosine = jnp.sin(turn), jnp.cos(turn)
        left = jnp.where(edge > jnp.pi / 2 + turn, (1 - self.height * sine) / cosine, jnp.sin(edge))
        right = jnp.where(edge > jnp.pi / 2 - turn, (1 + self.height * sine) / cosine, jnp.sin(edge))
        return _mirror(theta, left, self.distance - right, self.distance)


class PoulinFournierGrooves(PoulinFournier):
    """Grooves that cylinders of radius 1, parallel to the tangent, cut into a plane.

    Attributes:
        diffuse: Reflectance of the material's base, not of the surface; gray or a color.
        specular: Reflectance of its lobe at normal incidence; gray or a color.
        exponent: Exponent of the lobe around the half vector, from 0.
        distance: Distance between neighboring axes, in radii, above 0. Grooves wider than this intersect.
        height: Height of the axes above the plane, in radii: 0 for half cylinders, 1 for a flat plane.
    """

    def _edge(self) -> Array:
        """Angle at which an arc ends: at the plane, or where it meets its neighbor."""
        plane = jnp.arccos(_inside(jnp.maximum(self.height, 0)))
        return jnp.minimum(plane, jnp.arcsin(_inside(jnp.minimum(self.distance / 2, 1))))

    def _arc(self, theta: Array) -> tuple[Array, Array]:
        # Normals right of the axis point left. Seen from the right, the right rim hides the part of the arc between
        # itself and the point where the ray through the rim meets the arc again.
        edge, turn = jnp.broadcast_to(self._edge(), theta.shape), jnp.abs(theta)
        return _mirror(theta, jnp.maximum(edge + 2 * turn - jnp.pi, -edge), edge)

    def _plane(self, theta: Array) -> tuple[Array, Array]:
        foot = jnp.broadcast_to(jnp.sin(self._edge()), theta.shape)
        return foot, self.distance - foot
