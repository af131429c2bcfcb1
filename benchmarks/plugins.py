"""Materials of jaxprt as plugins of Mitsuba 3: the formulas in the docstrings of `jaxprt.brdf`, with none of its code.

Directions are drawn by the cosine, or as mirrored at a half vector of the model's own distribution (of GGX: at a normal
that is visible from the eye), in about the shares of the light that both reflect. Denoisers get the color of all that
is reflected as albedo.

Parameters are Mitsuba's, so that `mitsuba.traverse` finds them and its gradients reach them. Those of
metallic-roughness materials are Mitsuba's textures: constants, or attributes of the vertices.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxprt.brdf import AshikhminShirley, BlinnPhong, CookTorrance, Lambert, MetallicRoughness
from jaxprt.brdf.varying import PerVertex

_SMOOTHEST = 1e-3  # least roughness, and least alpha of GGX, as jaxprt.brdf has it
_GLOSSY = 0.5  # least share of samples by half vectors: a faint highlight is bright where it is
TANGENT = "vertex_tangent"  # attribute of shapes


def bsdf(material: CookTorrance | AshikhminShirley | BlinnPhong | Lambert | MetallicRoughness | PerVertex) -> Any:
    """Mitsuba's material, or what loads as one; a variant must be set.

    A material of each vertex takes its parameters from the attributes of its shape, see `attributes`.

    Raises:
        ValueError: A material of another kind.
    """
    if isinstance(material, PerVertex):
        parameters = _parameters(material.model)
        return _metallic_roughness()(
            {name: {"type": "mesh_attribute", "name": f"vertex_{name}"} for name in parameters}
        )
    if isinstance(material, MetallicRoughness):
        return _metallic_roughness()({name: _constant(value) for name, value in _parameters(material).items()})
    if isinstance(material, Lambert):
        albedo = np.broadcast_to(material.albedo, 3).tolist()
        return {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
    if isinstance(material, CookTorrance):
        return _cook_torrance()(material)
    if isinstance(material, BlinnPhong):
        return _blinn_phong()(material)
    if isinstance(material, AshikhminShirley):
        return _ashikhmin_shirley()(material)
    kinds = "CookTorrance, AshikhminShirley, BlinnPhong, Lambert, MetallicRoughness or PerVertex"
    raise ValueError(f"materials must be {kinds}, got {type(material).__name__}")


def metallic_roughness(textures: dict[str, Any]) -> Any:
    """Mitsuba's metallic-roughness material whose parameters are textures, or dictionaries that load as such.

    Args:
        textures: By the names of `jaxprt.brdf.MetallicRoughness`, with `f0` in place of `ior` and `specular_color`.
            The shape then needs the attribute `TANGENT`.
    """
    return _metallic_roughness()(textures)


def attributes(material: Any) -> dict[str, np.ndarray]:
    """Attributes [v c] that a shape needs for its material: the parameters of its vertices, if they have their own."""
    if not isinstance(material, PerVertex):
        return {}
    return {f"vertex_{name}": value for name, value in _parameters(material.model).items()}


def _parameters(model: Any) -> dict[str, np.ndarray]:
    """Parameters [*b c] of a metallic-roughness material as Mitsuba interpolates them.

    Raises:
        ValueError: A material of another kind.
    """
    if not isinstance(model, MetallicRoughness):
        raise ValueError(f"materials of vertices must be MetallicRoughness, got {type(model).__name__}")
    ior = np.asarray(model.ior, np.float32)[..., None]
    f0 = np.minimum(((1 - ior) / (1 + ior)) ** 2 * np.asarray(model.specular_color), 1)
    colors = {"base_color": np.asarray(model.base_color), "f0": f0}
    wide = {name: np.broadcast_to(value, (*value.shape[:-1], 3)) for name, value in colors.items()}
    scalars = ("metallic", "roughness", "specular", "anisotropy", "rotation")
    return wide | {name: np.asarray(getattr(model, name))[..., None] for name in scalars}


def _constant(value: np.ndarray) -> dict[str, Any]:
    """Mitsuba's texture of one value."""
    if len(value) == 1:
        return {"type": "uniform", "value": float(value[0])}
    return {"type": "srgb", "color": [float(each) for each in value]}


def modules() -> tuple[Any, Any]:
    """Dr.Jit and Mitsuba, imported when used: not every machine has them, and the variant decides what they hold."""
    import drjit
    import mitsuba

    return drjit, mitsuba


def per_variant(make: Callable[[], Any]) -> Callable[[], Any]:
    """Has a function make a class when it is first used, once for each variant of Mitsuba, of which it inherits."""
    made: dict[str, Any] = {}

    @functools.wraps(make)
    def get() -> Any:
        _, mitsuba = modules()
        variant = mitsuba.variant()
        if variant not in made:
            made[variant] = make()
        return made[variant]

    return get


@per_variant
def _glossy() -> Any:
    """The class of all models."""
    drjit, mitsuba = modules()

    class Glossy(mitsuba.BSDF):
        colors: tuple[str, ...]
        scalars: tuple[str, ...]

        def __init__(self, material):
            super().__init__(mitsuba.Properties())
            for name in self.colors:
                setattr(self, name, mitsuba.Color3f(np.broadcast_to(getattr(material, name), 3).tolist()))
            for name in self.scalars:
                setattr(self, name, mitsuba.Float(float(getattr(material, name))))
            # Else they would be constants of the program, and other materials compile anew.
            drjit.make_opaque(*(getattr(self, name) for name in self.colors + self.scalars))
            self.m_components = [
                mitsuba.BSDFFlags.GlossyReflection | mitsuba.BSDFFlags.DiffuseReflection | mitsuba.BSDFFlags.FrontSide
            ]
            self.m_flags = self.m_components[0]

        def at(self, si) -> Any:
            """The material at a point: an object with the methods below, up to `value`."""
            return self

        def albedos(self, wi):
            """Colors of the gloss and of the matte base seen from a direction, about."""
            raise NotImplementedError

        def half(self, u, wi):
            """A half vector of its distribution."""
            raise NotImplementedError

        def density(self, half, wi, cos_d):
            """Of half vectors, by solid angle."""
            raise NotImplementedError

        def value(self, wi, wo, half, cos_d):
            """In 1/sr."""
            raise NotImplementedError

        def frame(self, si):
            """Directions to the frame of the tangent, and back."""
            return (lambda w: w), (lambda w: w)

        def sample(self, ctx, si, sample1, sample2, active=True):
            to, back = self.frame(si)
            wi, here = to(si.wi), self.at(si)
            half, matte = here.half(sample2, wi), mitsuba.warp.square_to_cosine_hemisphere(sample2)
            result = drjit.zeros(mitsuba.BSDFSample3f)
            result.wo = back(drjit.select(sample1 < chance(here, wi), 2 * drjit.dot(half, wi) * half - wi, matte))
            result.eta, result.sampled_component = 1.0, 0
            result.sampled_type = mitsuba.UInt32(+mitsuba.BSDFFlags.GlossyReflection)
            value, result.pdf = self.eval_pdf(ctx, si, result.wo, active)
            # In scalar variants both branches are computed.
            return result, drjit.select(result.pdf > 0, value / drjit.select(result.pdf > 0, result.pdf, 1), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            (to, _), here = self.frame(si), self.at(si)
            wi, wo = to(si.wi), to(wo)
            lit = active & (wi.z > 0) & (wo.z > 0)
            half = drjit.normalize(wi + wo)
            cos_d = drjit.dot(half, wo)
            value = here.value(wi, wo, half, cos_d) * wo.z
            pdf = drjit.lerp(wo.z / drjit.pi, here.density(half, wi, cos_d) / (4 * cos_d), chance(here, wi))
            return drjit.select(lit, value, 0), drjit.select(lit, pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx, si, wo, active=True):
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_diffuse_reflectance(self, si, active=True):
            gloss, base = self.at(si).albedos(mitsuba.Vector3f(0, 0, 1))
            return drjit.minimum(gloss + base, 1)

        def traverse(self, callback):
            for name in self.colors + self.scalars:
                callback.put(name, getattr(self, name), mitsuba.ParamFlags.Differentiable)

        def to_string(self):
            return type(self).__name__

    def chance(here, wi):
        """Share of samples by half vectors."""
        gloss, base = (drjit.mean(each) for each in here.albedos(wi))
        return drjit.maximum(gloss / drjit.maximum(gloss + base, 1e-6), _GLOSSY)

    return Glossy


def _schlick(f0, cosine):
    """Fresnel reflectance towards 1 at grazing angles."""
    drjit, _ = modules()
    return f0 + (1 - f0) * (1 - drjit.clip(cosine, 0, 1)) ** 5


def _tangent_frame(si, rotation=0.0) -> tuple[Any, Any]:
    """Directions from the shading frame to that of the tangent, turned counterclockwise about the normal, and back."""
    drjit, mitsuba = modules()
    # Interpolated as the attribute of vertices is, and square to the normal.
    tangent = si.shape.eval_attribute_3(TANGENT, si)
    x = si.to_local(mitsuba.Vector3f(tangent.x, tangent.y, tangent.z))
    length = drjit.sqrt(x.x**2 + x.y**2)
    flat = length > 1e-6  # Interpolated tangents may cancel, and a lone interaction has none.
    length = drjit.select(flat, length, 1)
    c, s = drjit.select(flat, x.x / length, 1), drjit.select(flat, x.y / length, 0)
    turned_s, turned_c = drjit.sincos(rotation)
    c, s = c * turned_c - s * turned_s, s * turned_c + c * turned_s
    return (
        lambda w: mitsuba.Vector3f(c * w.x + s * w.y, c * w.y - s * w.x, w.z),
        lambda w: mitsuba.Vector3f(c * w.x - s * w.y, s * w.x + c * w.y, w.z),
    )


def along_tangents(inner: Any) -> Any:
    """Mitsuba's material whose tangents, such as those of its normal map, are the attribute `TANGENT` of its shape."""
    return _along_tangents()(inner)


@per_variant
def _along_tangents() -> Any:
    _, mitsuba = modules()

    class AlongTangents(mitsuba.BSDF):
        def __init__(self, inner):
            super().__init__(mitsuba.Properties())
            self.inner = inner
            self.m_components = [inner.flags(number) for number in range(inner.component_count())]
            self.m_flags = inner.flags()

        def turned(self, si):
            """The interaction in the frame of the tangent, and directions to it and back."""
            to, back = _tangent_frame(si)
            result = mitsuba.SurfaceInteraction3f(si)
            result.wi = to(si.wi)
            result.dp_du = si.to_world(back(mitsuba.Vector3f(1, 0, 0)))
            result.sh_frame = mitsuba.Frame3f(result.dp_du, si.to_world(back(mitsuba.Vector3f(0, 1, 0))), si.sh_frame.n)
            return result, to, back

        def sample(self, ctx, si, sample1, sample2, active=True):
            turned, _, back = self.turned(si)
            result, weight = self.inner.sample(ctx, turned, sample1, sample2, active)
            result.wo = back(result.wo)
            return result, weight

        def eval(self, ctx, si, wo, active=True):
            turned, to, _ = self.turned(si)
            return self.inner.eval(ctx, turned, to(wo), active)

        def pdf(self, ctx, si, wo, active=True):
            turned, to, _ = self.turned(si)
            return self.inner.pdf(ctx, turned, to(wo), active)

        def eval_pdf(self, ctx, si, wo, active=True):
            turned, to, _ = self.turned(si)
            return self.inner.eval_pdf(ctx, turned, to(wo), active)

        def eval_diffuse_reflectance(self, si, active=True):
            return self.inner.eval_diffuse_reflectance(self.turned(si)[0], active)

        def traverse(self, callback):
            callback.put("inner", self.inner, mitsuba.ParamFlags.Differentiable)

        def to_string(self):
            return "AlongTangents"

    return AlongTangents


@per_variant
def _cook_torrance() -> Any:
    drjit, mitsuba = modules()

    class Model(_glossy()):
        colors, scalars = ("diffuse", "specular", "f0"), ("roughness",)

        def __init__(self, material: CookTorrance):
            super().__init__(material)
            self.roughness = drjit.maximum(self.roughness, _SMOOTHEST)
            drjit.make_opaque(self.roughness)

        def albedos(self, wi):
            return self.specular * _schlick(self.f0, wi.z), self.diffuse

        def half(self, u, wi):
            # Half vectors with tan^2 = -m^2 log(u) have the density D times their cosine.
            tangent = self.roughness * drjit.safe_sqrt(-drjit.log(1 - u.x))
            sine, cosine = drjit.sincos(2 * drjit.pi * u.y)
            return drjit.normalize(mitsuba.Vector3f(tangent * cosine, tangent * sine, 1))

        def distribution(self, half):
            tilt = (half.x**2 + half.y**2) / (self.roughness * half.z) ** 2
            return drjit.exp(-tilt) / (drjit.pi * self.roughness**2 * half.z**4)

        def density(self, half, wi, cos_d):
            return self.distribution(half) * half.z

        def value(self, wi, wo, half, cos_d):
            g = drjit.minimum(1, 2 * half.z * drjit.minimum(wi.z, wo.z) / cos_d)
            lobe = self.distribution(half) * g / (wi.z * wo.z) * _schlick(self.f0, cos_d)
            return (self.diffuse + self.specular * lobe) / drjit.pi

    return Model


@per_variant
def _blinn_phong() -> Any:
    drjit, mitsuba = modules()

    class Model(_glossy()):
        colors, scalars = ("diffuse", "specular"), ("exponent",)

        def albedos(self, wi):
            return self.specular, self.diffuse

        def half(self, u, wi):
            # Cosines u^(1 / (n + 1)) have the density (n + 1) cos^n / (2 pi).
            cosine = drjit.power(drjit.maximum(u.x, 1e-7), 1 / (self.exponent + 1))
            radius = drjit.safe_sqrt(1 - cosine**2)
            sine, across = drjit.sincos(2 * drjit.pi * u.y)
            return mitsuba.Vector3f(radius * across, radius * sine, cosine)

        def density(self, half, wi, cos_d):
            return (self.exponent + 1) / (2 * drjit.pi) * drjit.power(half.z, self.exponent)

        def value(self, wi, wo, half, cos_d):
            n = self.exponent
            peak = (n + 2) * (n + 4) / (8 * drjit.pi * (drjit.exp2(-n / 2) + n))
            return self.diffuse / drjit.pi + self.specular * peak * drjit.power(half.z, n)

    return Model


@per_variant
def _ashikhmin_shirley() -> Any:
    drjit, mitsuba = modules()

    class Model(_glossy()):
        colors, scalars = ("diffuse", "specular"), ("nu", "nv")

        def frame(self, si):
            return _tangent_frame(si)

        def albedos(self, wi):
            return _schlick(self.specular, wi.z), self.diffuse * (1 - self.specular)

        def half(self, u, wi):
            # Equations 9 and 10, over all four quadrants at once.
            sine, cosine = drjit.sincos(2 * drjit.pi * u.x)
            x, y = cosine * drjit.sqrt(self.nv + 1), sine * drjit.sqrt(self.nu + 1)
            length = drjit.sqrt(x**2 + y**2)
            x, y = x / length, y / length
            z = drjit.power(1 - u.y, 1 / (self.nu * x**2 + self.nv * y**2 + 1))
            flat = drjit.safe_sqrt(1 - z**2)
            return mitsuba.Vector3f(flat * x, flat * y, z)

        def density(self, half, wi, cos_d):
            return self.distribution(half)

        def distribution(self, half):
            slope = half.x**2 + half.y**2
            exponent = (self.nu * half.x**2 + self.nv * half.y**2) / drjit.maximum(slope, 1e-12)
            peak = drjit.sqrt((self.nu + 1) * (self.nv + 1)) / (2 * drjit.pi)
            # Next to the normal 1 - z has no digits, and the sine has.
            log = drjit.select(slope < 0.01, -slope / 2 - slope**2 / 4, drjit.log(drjit.maximum(half.z, 1e-6)))
            return peak * drjit.exp(exponent * log)

        def value(self, wi, wo, half, cos_d):
            lobe = self.distribution(half) / (4 * cos_d * drjit.maximum(wi.z, wo.z)) * _schlick(self.specular, cos_d)
            base = (1 - (1 - wi.z / 2) ** 5) * (1 - (1 - wo.z / 2) ** 5)
            return lobe + 28 / (23 * drjit.pi) * self.diffuse * (1 - self.specular) * base

    return Model


@per_variant
def _metallic_roughness() -> Any:
    drjit, mitsuba = modules()

    class Point:
        """The material at the points of a surface interaction."""

        def __init__(self, parameter, si):
            self.base, self.f0 = (parameter[name].eval(si) for name in ("base_color", "f0"))
            self.metallic, self.specular = (parameter[name].eval_1(si) for name in ("metallic", "specular"))
            self.across = drjit.maximum(parameter["roughness"].eval_1(si) ** 2, _SMOOTHEST)
            self.along = self.across + (1 - self.across) * parameter["anisotropy"].eval_1(si) ** 2

        def albedos(self, wi):
            layer = _schlick(self.f0, wi.z)
            under = (1 - self.specular * drjit.max(layer)) * self.base
            gloss = drjit.lerp(self.specular * layer, _schlick(self.base, wi.z), self.metallic)
            return gloss, (1 - self.metallic) * under

        def half(self, u, wi):
            # Dupuy and Benyoub 2023, "Sampling visible GGX normals with spherical caps".
            eye = drjit.normalize(mitsuba.Vector3f(self.along * wi.x, self.across * wi.y, wi.z))
            z = drjit.fma(1 - u.y, 1 + eye.z, -eye.z)
            flat = drjit.safe_sqrt(1 - z**2)
            sine, cosine = drjit.sincos(2 * drjit.pi * u.x)
            x, y, z = flat * cosine + eye.x, flat * sine + eye.y, z + eye.z
            return drjit.normalize(mitsuba.Vector3f(self.along * x, self.across * y, drjit.maximum(z, 1e-7)))

        def distribution(self, half):
            tilt = (half.x / self.along) ** 2 + (half.y / self.across) ** 2 + half.z**2
            return 1 / (drjit.pi * self.along * self.across * tilt**2)

        def stretched(self, w):
            return drjit.sqrt((self.along * w.x) ** 2 + (self.across * w.y) ** 2 + w.z**2)

        def density(self, half, wi, cos_d):
            return 2 * cos_d * self.distribution(half) / (wi.z + self.stretched(wi))

        def value(self, wi, wo, half, cos_d):
            visible = 0.5 / (wo.z * self.stretched(wi) + wi.z * self.stretched(wo))
            lobe = self.distribution(half) * visible
            layer = _schlick(self.f0, cos_d)
            under = 1 - self.specular * drjit.max(layer)
            dielectric = self.specular * layer * lobe + under * self.base / drjit.pi
            return (1 - self.metallic) * dielectric + self.metallic * _schlick(self.base, cos_d) * lobe

    class Model(_glossy()):
        colors, scalars = (), ()

        def __init__(self, textures: dict[str, Any]):
            super().__init__(None)
            self.parameter = {
                name: mitsuba.load_dict(each) if isinstance(each, dict) else each for name, each in textures.items()
            }

        def at(self, si):
            return Point(self.parameter, si)

        def frame(self, si):
            return _tangent_frame(si, self.parameter["rotation"].eval_1(si))

        def traverse(self, callback):
            for name, each in self.parameter.items():
                callback.put(name, each, mitsuba.ParamFlags.Differentiable)

    return Model
