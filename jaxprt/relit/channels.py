"""Converts parts of a scene to the input of the systems: a mesh with shading frames, and a BRDF with weights.

A metallic-roughness material is a sum of four fixed gray BRDFs whose weights are textures; see
`jaxprt.brdf.MetallicRoughness.terms`. The fixed BRDFs are the channels of one BRDF, whose table over roughness all
such materials share (`jaxprt.systems.standard`). An ideally diffuse material has one channel and no table. Parts of one
`Kind` can share a system. A clear coat or a sheen adds five channels, and its roughness as a second parameter.
"""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.brdf import BlinnPhong, ClearCoat, CookTorrance, Lambert, MetallicRoughness, Sheen, grid
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import jit, known
from jaxprt.scene import Mesh, Part, material_table
from jaxprt.scene.material import MaterialValues, TexturedMaterial
from jaxprt.scene.material_table import SMOOTHEST, MaterialLook
from jaxprt.scene.points import Points
from jaxprt.sphere import directions
from jaxprt.systems import standard
from jaxprt.systems.protocol import Blend
from jaxprt.systems.standard import LayeredTable, StandardTable
from jaxprt.systems.standard.families import RoughnessFamily

_STEP = 1.5  # largest ratio of neighboring tabulated roughnesses
_TINY = 1e-12
_EQUAL = 1e-3  # tolerance for equal roughness, anisotropy and normals
_RARE = 0.02  # smallest scale of a channel, relative to the largest
_NAMES = ("diffuse", "mirror", "rim", "bare diffuse")  # names of the terms of MetallicRoughness
_BARE = (3,)  # the only term of a Lambertian material
_MODELS: dict[StandardTable, type] = {standard.BLINN_PHONG: BlinnPhong, standard.COOK_TORRANCE: CookTorrance}
_MATTE = "; a specular of 1e-6 is enough for a Lambertian part that is to become glossy"


Changeable = TexturedMaterial | BlinnPhong | CookTorrance  # materials that may change after precomputation


class Shading(eqx.Module):
    """A part of a scene, or several parts of one kind, as input of the systems.

    Attributes:
        mesh: The mesh, with tangents along the anisotropy. Normal maps tilt normals at points only.
        brdf: The BRDF, with one channel for each weight of `blend`. If `knot` is not empty, it is a function from the
            logarithm of roughness to a BRDF.
        exact: The BRDF at every vertex, for the exact sum over all texels.
        knot: Logarithms of roughness at which the BRDF is tabulated; empty if roughness does not vary.
        blend: Weights of the channels at each vertex, and the logarithm of roughness there if it varies. None for a
            part with a BRDF that cannot change.
        emitted: Radiance that the surface emits; None if it does not emit.
        term: Indices of the channels among the coefficients of a `MaterialLook`.
        scale: Factor of each channel. The weights of `blend` are divided by it.
        table: The standard tables of the BRDF; None for a BRDF with tables of its own.
    """

    mesh: Mesh
    brdf: Callable
    exact: Callable
    knot: tuple[np.ndarray, ...] = ()
    blend: Blend | None = None
    emitted: Float[Array | np.ndarray, "v 3"] | None = None
    term: tuple[int, ...] = eqx.field(static=True, default=())
    scale: Float[Array | np.ndarray, " k"] | None = None
    table: StandardTable | None = eqx.field(static=True, default=None)

    @property
    def appearance(self) -> "Appearance":
        """The material at the vertices."""
        return Appearance(self.blend, self.emitted)

    @property
    def matte(self) -> bool:
        """Whether the surface is ideally diffuse."""
        return getattr(self.brdf, "matte", False)

    @property
    def albedo(self) -> Array:
        """Albedo of an ideally diffuse surface."""
        brdf: Any = self.brdf
        return brdf.albedo

    @property
    def layered(self) -> bool:
        """Whether there is a clear coat or a sheen."""
        return isinstance(self.table, standard.LayeredTable)

    @property
    def smoothest(self) -> Any:
        """Logarithm of the smallest roughness, as the standard table takes it: with that of a layer if any."""
        return self._roughness(np.min)

    @property
    def roughest(self) -> Any:
        """Logarithm of the largest roughness, as the standard table takes it: with that of the base for a layer."""
        chosen = self._roughness(np.max)
        return (chosen[0], chosen[0]) if self.layered else chosen

    def _roughness(self, of_vertices: Callable) -> Any:
        """One logarithm of the roughness of all vertices, as the standard table takes it."""
        chosen = tuple(float(of_vertices(np.asarray(row))) for row in self.weighted.parameter)
        return chosen if self.layered else chosen[0]

    @property
    def weighted(self) -> Blend:
        """The blend, which a part with a BRDF that cannot change does not have."""
        return require.kind("the weights of the part", self.blend, Blend, source="a material that may change")

    @property
    def metallic(self) -> MetallicRoughness:
        """The metallic-roughness BRDF of every vertex, which a part with another model does not have."""
        model = self.exact.model if isinstance(self.exact, PerVertex) else self.exact
        return require.kind("the BRDF of the part", model, MetallicRoughness, source="a TexturedMaterial")

    def blend_at(self, look: MaterialLook) -> Blend:
        """The weights of the channels at points with given materials."""
        if self.scale is None:
            raise TypeError("the part must have a material that may change, got a BRDF that cannot")
        return blend(look, self.term, self.scale, varies=bool(self.knot))


class Appearance(eqx.Module):
    """A material evaluated at vertices or points, in the form that systems take.

    Attributes:
        blend: Weights of the BRDF's channels; None for a part with a BRDF that cannot change.
        emitted: Radiance that the surface emits; None if it does not emit.
    """

    blend: Blend | None
    emitted: Float[Array | np.ndarray, "v 3"] | None = None


def blend(look: MaterialLook, term: tuple[int, ...], scale: Float[Array | np.ndarray, " k"], *, varies: bool) -> Blend:
    """The weights of a system's channels at points with given materials.

    Args:
        look: The materials at the points.
        term: Indices of the channels among the coefficients.
        scale: Factor of each channel.
        varies: Whether the system takes the roughness of each point.
    """
    weight, columns = look.coefficient[:, np.asarray(term)] / scale[:, None], look.coefficient.shape[1]
    if rest := [column for column in range(len(_NAMES), columns) if column not in term]:
        # A layer that was not precomputed: `_replace_material` refuses it where it is known.
        xp = np if known(look) else jnp
        weight = xp.where(xp.any(look.coefficient[:, np.asarray(rest)] != 0, (1, 2))[:, None, None], xp.nan, weight)
    if len(term) > len(_NAMES):
        return Blend(weight, (look.log_roughness, look.log_layer))
    return Blend(weight, (look.log_roughness,) if varies else ())


def _any_table(_: StandardTable) -> bool:
    return True


def of_part(
    part: Part, *, look: MaterialLook | None = None, takes: Callable[[StandardTable], bool] = _any_table
) -> Shading:
    """Converts a part of a scene to a `Shading`, the input of the systems.

    A texture of anisotropy is replaced by its mean, with a warning.

    Args:
        part: The part.
        look: The material at the vertices, in NumPy; evaluated here if None.
        takes: Function that says whether the system reads a standard table. If it does not, the channels are the terms
            that the material needs, and the system is made for the roughness that it has.
    """
    material = part.material
    if isinstance(material, PerVertex):
        raise TypeError(
            f"the material of part {part.name!r} must be one BRDF for all vertices or a TexturedMaterial, "
            "got a BRDF for each vertex"
        )
    if isinstance(material, BlinnPhong | CookTorrance):
        return _of_model(part, material, look, takes)
    if not isinstance(material, TexturedMaterial):
        brdf = grid.as_argument(material)
        return Shading(part.mesh, brdf, brdf)
    look = _look(part) if look is None else look
    mesh, anisotropy = _anisotropic_mesh(part)
    emitted = look.emitted if np.any(look.emitted) else None
    if np.any(look.coefficient[:, len(_NAMES) :]):
        table = _table_of_layer(part)
        if anisotropy <= _EQUAL and takes(table):
            exact = PerVertex(_layered(part.name, look, table))
            weights = blend(look, table.term, table.scale, varies=True)
            return Shading(mesh, table.family, exact, table.knots, weights, emitted, table.term, table.scale, table)
        look = _without_layer(part.name, look, table)
    exact = PerVertex(_metallic(look, anisotropy))
    needed = tuple(k for k in range(len(_NAMES)) if np.any(look.coefficient[:, k])) or _BARE
    if needed == _BARE:
        scale = np.ones(1, look.coefficient.dtype)
        return Shading(mesh, Lambert(1.0), exact, (), blend(look, _BARE, scale, varies=False), emitted, _BARE, scale)
    table = standard.METALLIC_ROUGHNESS
    if anisotropy > _EQUAL or not takes(table):
        return _with_own_table(mesh, exact, look, emitted, needed, anisotropy)
    weights = blend(look, table.term, table.scale, varies=True)
    return Shading(mesh, table.family, exact, (table.knot,), weights, emitted, table.term, table.scale, table)


def _with_own_table(
    mesh: Mesh, exact: PerVertex, look: MaterialLook, emitted: Any, term: tuple[int, ...], anisotropy: float
) -> Shading:
    """A part with a table of its own, over the roughness that it has."""
    knot = _knots(np.asarray(look.log_roughness))
    scale = np.mean(np.abs(look.coefficient[:, np.asarray(term)]), (0, 2))
    scale = np.maximum(scale, _RARE * np.max(scale)).astype(look.coefficient.dtype)
    brdf: Any = RoughnessFamily(term, jnp.asarray(scale), jnp.asarray(anisotropy, scale.dtype))
    if not knot:
        brdf = brdf(jnp.asarray(np.mean(look.log_roughness)))
    return Shading(mesh, brdf, exact, knot, blend(look, term, scale, varies=bool(knot)), emitted, term, scale)


def _of_model(
    part: Part, brdf: BlinnPhong | CookTorrance, look: MaterialLook | None, takes: Callable[[StandardTable], bool]
) -> Shading:
    """A part with an analytic model. One outside of the range of the standard tables keeps a table of its own."""
    table = next(table for table, model in _MODELS.items() if isinstance(brdf, model))
    if not takes(table) or not _in_range(brdf, table):
        return Shading(part.mesh, brdf, brdf)
    look = _look(part) if look is None else look
    weights = blend(look, table.term, table.scale, varies=True)
    return Shading(part.mesh, table.family, brdf, (table.knot,), weights, None, table.term, table.scale, table)


def _in_range(brdf: BlinnPhong | CookTorrance, table: StandardTable) -> bool:
    """Whether a standard table has the exponent or the roughness of a model, which is one number."""
    low, high = np.exp(table.range)
    if isinstance(brdf, BlinnPhong):
        return not np.ndim(brdf.exponent) and 0 <= float(brdf.exponent) <= table.most_exponent * (1 + _EQUAL)
    return not np.ndim(brdf.roughness) and bool(low * (1 - _EQUAL) <= float(brdf.roughness) <= high * (1 + _EQUAL))


def looks(parts: Sequence[Part]) -> list[MaterialLook]:
    """The materials at the vertices of each part, by one program for all."""
    columns, result, first = tuple(material_table.of_parts(parts).at_vertices()), [], 0
    for part in parts:
        vertex = slice(first, first + len(part.mesh.position))
        result.append(MaterialLook(*jax.tree.map(lambda column, vertex=vertex: column[vertex], columns)))
        first = vertex.stop
    return result


def _look(part: Part) -> MaterialLook:
    """The material at the vertices of a part. Its roughness is known if JAX does not trace it."""
    (look,) = looks([part])
    if known(look) or not known(plain := dataclasses.replace(part, material=rough(part.material))):
        return look
    with jax.ensure_compile_time_eval():
        return look._replace(log_roughness=looks([plain])[0].log_roughness)


def rough(material: Any) -> Any:
    """A material of the same roughness and layer as another, with everything else as by default."""
    if not isinstance(material, TexturedMaterial):
        return material
    layer: dict[str, Any] = {}
    if material_table.may_be(material.clearcoat):
        layer["clearcoat"] = 1.0
    elif material_table.may_be(material.sheen_color):
        layer["sheen_color"] = 1.0
    return TexturedMaterial(
        roughness=material.roughness,
        roughness_texture=material.roughness_texture,
        clearcoat_roughness=material.clearcoat_roughness,
        clearcoat_roughness_texture=material.clearcoat_roughness_texture,
        sheen_roughness=material.sheen_roughness,
        sheen_roughness_texture=material.sheen_roughness_texture,
        **layer,
        **_normal_map(material),
    )


def _normal_map(material: TexturedMaterial) -> dict[str, Any]:
    """The normal map of a material, whose variance adds roughness. Nothing if JAX traces it."""
    if not known(material.normal_texture, material.normal_scale):
        return {}
    return {"normal_texture": material.normal_texture, "normal_scale": material.normal_scale}


def _metallic(look: MaterialLook, anisotropy: Any) -> MetallicRoughness:
    """The BRDF of each vertex or point."""
    values = {name: value for name, value in look.values._asdict().items() if name != "emissive"}
    zero = 0 * values["roughness"]
    return MetallicRoughness(**values, anisotropy=zero + anisotropy, rotation=zero)


def _table_of_layer(part: Part) -> LayeredTable:
    """The tables of a part with a clear coat or a sheen. With a coat it loses its sheen, with a warning."""
    material = textured(part)
    if not material_table.may_be(material.clearcoat):
        return standard.SHEENED
    if material_table.may_be(material.sheen_color):
        warnings.warn(f"the sheen of part {part.name!r} is left out: it has a clear coat", stacklevel=3)
    return standard.COATED


def _layered(name: str, look: MaterialLook, table: LayeredTable) -> ClearCoat | Sheen:
    """The BRDF of each vertex or point of a part with a clear coat or a sheen."""
    layer, roughness = look.coefficient[:, table.term[-1]], jnp.exp(jnp.asarray(look.log_layer))
    try:
        if table == standard.COATED:
            return ClearCoat(_metallic(look, 0.0), layer[:, 0], roughness)
        return Sheen(_metallic(look, 0.0), layer, roughness)
    except ValueError as error:  # the factors are right, so it is a texture
        raise ValueError(f"part {name!r}, factor times texture: {error}") from error


def _model(name: str, look: MaterialLook, shading: Shading) -> Any:
    """The BRDF of each vertex or point of a part."""
    if isinstance(shading.table, standard.LayeredTable):
        return _layered(name, look, shading.table)
    return _metallic(look, _anisotropy(shading))


def _without_layer(name: str, look: MaterialLook, table: LayeredTable) -> MaterialLook:
    """The materials without their clear coats or sheens, with a warning."""
    warnings.warn(
        f"the {table.over} of part {name!r} is left out: anisotropic materials, and systems without the standard "
        "tables, have none",
        stacklevel=3,
    )
    under = np.asarray(table.term)[len(_NAMES) : -1]
    base = look.coefficient[:, : len(_NAMES)] + look.coefficient[:, under]
    return look._replace(coefficient=np.concatenate([base, 0 * look.coefficient[:, len(_NAMES) :]], 1))


def as_shaded(part: Part, shading: Shading) -> Part:
    """The part with the material that its system shows: without a clear coat or a sheen that was left out."""
    material = part.material
    if not isinstance(material, TexturedMaterial):
        return part
    coat, fibers = (material_table.may_be(factor) for factor in (material.clearcoat, material.sheen_color))
    if not shading.layered and (coat or fibers):
        material = without_layers(material)
    elif shading.table == standard.COATED and fibers:
        material = dataclasses.replace(material, sheen_color=0.0)
    return part if material is part.material else dataclasses.replace(part, material=material)


def without_layers(material: TexturedMaterial) -> TexturedMaterial:
    """The material without clear coat and sheen."""
    none: dict[str, Any] = {"clearcoat": 0.0, "clearcoat_texture": None}
    return dataclasses.replace(material, **none, sheen_color=0.0, sheen_color_texture=None)


def appearance(part: Part, shading: Shading, material: Changeable, *, look: MaterialLook | None = None) -> Appearance:
    """Evaluates a new material at the vertices of a precomputed part.

    Textures may have any values. Parts with the standard tables take any material of their model. Other parts take what
    their own tables hold. Inside `jax.jit`, where values are unknown, vertices that need something that was not
    precomputed get NaN. Derivatives ignore terms that were not precomputed.

    Args:
        part: The part.
        shading: The `Shading` of the part, from `of_part`.
        material: The new material.
        look: The new material at the vertices; evaluated here if None.
    """
    new = _replace_material(part, shading, material)
    look = _look(new) if look is None else look
    weights = shading.blend_at(look)
    emitted = None if known(look.emitted) and not np.any(look.emitted) else look.emitted
    if isinstance(material, BlinnPhong | CookTorrance):
        return Appearance(weights)
    fits = _fits(part.name, shading, look)
    weight = weights.weight if known(fits) else jnp.where(fits[:, None, None], weights.weight, jnp.nan)
    return Appearance(Blend(weight, weights.parameter), emitted)


def _replace_material(part: Part, shading: Shading, material: Changeable) -> Part:
    """The part with a new material. Refuses materials that its system cannot have; `appearance` gives the errors."""
    model = TexturedMaterial if shading.table is None else _MODELS.get(shading.table, TexturedMaterial)
    for table, name in ((standard.COATED, "clearcoat"), (standard.SHEENED, "sheen_color")):
        value = getattr(material, name, 0.0)
        if shading.table != table and not isinstance(value, Tracer) and np.any(np.asarray(value)):
            raise ValueError(
                f"part {part.name!r} was precomputed without a {table.over}, got a material with {name}={value}: "
                f"precompute it with a {table.over}, of a {name} of 1e-6 at least"
            )
    if not isinstance(material, model):
        raise TypeError(f"the material of part {part.name!r} must be a {model.__name__}, got {type(material).__name__}")
    if isinstance(material, BlinnPhong | CookTorrance):
        if shading.table is not None and known(material) and not _in_range(material, shading.table):
            _refuse_range(part.name, material, shading.table)
        return dataclasses.replace(part, material=material)
    new = dataclasses.replace(part, material=material)
    if known(material, shading):
        _check_frames(part, shading, new)
        _check_opacity(part, material)
    return new


def _refuse_range(name: str, material: BlinnPhong | CookTorrance, table: StandardTable) -> None:
    if isinstance(material, BlinnPhong):
        allowed, value = f"exponent of part {name!r} must be at most {table.most_exponent:.3g}", material.exponent
    else:
        low, high = np.exp(table.range)
        allowed, value = f"roughness of part {name!r} must be from {low:.3g} to {high:.3g}", material.roughness
    raise ValueError(f"the {allowed}, got {float(value):.3g}: precompute the scene with it")


def _check_opacity(part: Part, material: TexturedMaterial) -> None:
    """Refuses another transmission than the precomputed one, and holes or opacity where there were none."""
    before = textured(part)
    old, new = float(before.transmission), float(material.transmission)
    if abs(old - new) > _EQUAL:
        raise ValueError(
            f"part {part.name!r} was precomputed with a transmission of {old:g}, got a material of {new:g}: precompute "
            "the scene with it, because light passes through"
        )
    same = material.alpha_mode == before.alpha_mode and abs(float(material.alpha) - float(before.alpha)) <= _EQUAL
    if material.alpha_mode != "opaque" and not same:
        raise ValueError(
            f"part {part.name!r} was precomputed with the alpha mode {before.alpha_mode!r} and an alpha of "
            f"{float(before.alpha):g}, got a material of {material.alpha_mode!r} and {float(material.alpha):g}: "
            "precompute the scene with it, because light passes through"
        )


def materials_at(parts: Sequence[Part], shading: Shading, points: Points) -> tuple[Blend | None, Callable]:
    """The materials of several parts of one kind at points on all of them: weights of the channels, and the BRDF.

    Args:
        parts: The parts.
        shading: One `Shading` for all of them.
        points: Points on the joined mesh of the parts.
    """
    if shading.blend is None:
        return None, shading.exact
    look = material_table.of_parts(parts).at(points)
    weights = shading.blend_at(look)
    values = look.values
    if isinstance(parts[0].material, BlinnPhong):
        exponent = 2 / values.roughness**2 - 2
        return weights, PerVertex(BlinnPhong(values.base_color, values.specular_color, exponent))
    if isinstance(parts[0].material, CookTorrance):
        mirror, rim = look.coefficient[:, 1], look.coefficient[:, 2]
        f0 = mirror / jnp.maximum(mirror + rim, _TINY)
        return weights, PerVertex(CookTorrance(values.base_color, mirror + rim, values.roughness, f0))
    return weights, PerVertex(_model(parts[0].name, look, shading))


def exact_at(part: Part, shading: Shading, points: Points) -> tuple[Callable, Array | np.ndarray | None, Points]:
    """The BRDF at points of a part for the exact sum over all texels, the radiance that they emit, and the points.

    Textures are averaged over the pixel of each point. At points that do not belong to a picture they are sampled.
    Normal maps tilt the normals of the points.
    """
    if not isinstance(part.material, TexturedMaterial):
        return shading.exact, None, points
    look = material_table.of_parts([part]).at(points)
    brdf = Lambert(look.coefficient[:, _BARE[0]]) if shading.matte else _model(part.name, look, shading)
    return PerVertex(brdf), look.emitted, points.tilted(look.normal)


def _fits(name: str, shading: Shading, look: MaterialLook) -> Any:
    """Whether the terms and the roughness of each vertex were precomputed. If values are known, refuses others."""
    if shading.table is not None:
        return np.ones(len(look.log_roughness), bool)
    missing = np.setdiff1d(np.arange(len(_NAMES)), shading.term)
    xp = np if known(look) else jnp
    needed = xp.any(look.coefficient[:, missing] != 0, (0, 2))
    if known(needed) and np.any(needed):
        names = [_NAMES[k] for k in missing[needed]]
        raise ValueError(
            f"part {name!r} was precomputed without the terms that the new material needs ({', '.join(names)}): "
            f"precompute it with a material that has them{_MATTE if shading.matte else ''}"
        )
    fits = ~xp.any(look.coefficient[:, missing] != 0, (1, 2))
    if shading.matte:
        return fits
    low, high = _log_range(shading)
    inside = (look.log_roughness >= low - _EQUAL) & (look.log_roughness <= high + _EQUAL)
    if known(inside) and not np.all(inside):
        roughness = jnp.exp(jax.lax.stop_gradient(look.log_roughness))
        raise ValueError(
            f"part {name!r} was precomputed for roughness from {np.exp(low):.3f} to {np.exp(high):.3f}, got a "
            f"material from {jnp.min(roughness):.3f} to {jnp.max(roughness):.3f}: precompute it with a material that "
            "covers both ranges"
        )
    return fits & inside


def roughness_range(shading: Shading) -> tuple[float, float]:
    """Smallest and largest roughness that the material of a part may have."""
    if shading.table is not None:
        return 0.0, 1.0
    low, high = _log_range(shading)
    return float(np.exp(low)), float(np.exp(high))


def _log_range(shading: Shading) -> tuple[float, float]:
    """Logarithms of the smallest and the largest roughness of a part with a table of its own."""
    if shading.knot:
        return float(shading.knot[0][0]), float(shading.knot[0][-1])
    value = np.log(np.maximum(np.asarray(shading.metallic.roughness), SMOOTHEST))
    return float(value.min()), float(value.max())


def _check_frames(part: Part, shading: Shading, new: Part) -> None:
    """Refuses an anisotropy that differs from the precomputed one, and normal maps where there was none."""
    before, material = _anisotropy(shading), part.material
    mesh, now = _anisotropic_mesh(new)
    if getattr(new.material, "normal_texture", None) is not None and getattr(material, "normal_texture", None) is None:
        raise ValueError(
            f"part {part.name!r} was precomputed without a normal map, got a material with one: precompute it with a "
            "normal map, of a normal_scale of 0 if it is to be flat at first"
        )
    if abs(before - now) > _EQUAL and not shading.matte:
        raise ValueError(
            f"part {part.name!r} was precomputed for an anisotropy of {before:.3f}, got a material of {now:.3f}"
        )
    if mesh is shading.mesh or before <= _EQUAL or shading.matte:
        return
    if np.abs(np.asarray(shading.mesh.tangent) - np.asarray(mesh.tangent)).max() > _EQUAL:
        raise ValueError(
            f"part {part.name!r} was precomputed with another direction of anisotropy, or with none: precompute it "
            "with the new one"
        )


def _anisotropy(shading: Shading) -> float:
    """The anisotropy that a part was precomputed with."""
    if shading.layered:
        return 0.0
    return float(shading.metallic.anisotropy[0])


def textured(part: Part) -> TexturedMaterial:
    """The material of a part that has a TexturedMaterial."""
    return require.kind(f"the material of part {part.name!r}", part.material, TexturedMaterial, source="jaxprt.scene")


def _anisotropic_mesh(part: Part) -> tuple[Mesh, float]:
    """The mesh with tangents along the anisotropy, and the mean anisotropy."""
    material = textured(part)
    if not float(material.anisotropy):
        return part.mesh, 0.0
    surface = part.surface()
    strength = np.asarray(surface.anisotropy)
    if np.ptp(strength) > _EQUAL:
        warnings.warn(
            f"the anisotropy of part {part.name!r} varies from {strength.min():.2f} to {strength.max():.2f} over its "
            f"texture, which is not supported: its mean {strength.mean():.2f} is used everywhere",
            stacklevel=3,
        )
    return _rotate_tangents(part.mesh, surface), float(strength.mean())


def _knots(log_roughness: Float[np.ndarray, " v"]) -> tuple[np.ndarray, ...]:
    """Logarithms of roughness between the smallest and the largest; none if these are equal."""
    low, high = float(np.min(log_roughness)), float(np.max(log_roughness))
    if np.exp(high) - np.exp(low) <= _EQUAL:
        return ()
    return (np.linspace(low, high, 1 + int(np.ceil((high - low) / np.log(_STEP)))),)


def _rotate_tangents(mesh: Mesh, surface: MaterialValues) -> Mesh:
    """The mesh with tangents along the anisotropy."""
    straight = bool(np.all(np.asarray(surface.direction) == [1, 0])) or not np.any(np.asarray(surface.anisotropy))
    return (
        mesh
        if straight
        else eqx.tree_at(lambda mesh: mesh.tangent, mesh, _tangents(mesh.normal, mesh.tangent, surface))
    )


@jit
def _tangents(normal: Array, tangent: Array, surface: MaterialValues) -> Array:
    frame = directions.frame(normal, tangent)
    along = jnp.einsum("vi,vij->vj", surface.direction, frame[:, :2], precision="highest")
    return directions.frame(normal, along)[:, 0]


def check_blend(name: str, shading: Shading, blend: Blend | None) -> None:
    """Refuses weights of other vertices or channels, and other parameters, than a part has."""
    before = shading.weighted
    if blend is None or len(blend.parameter) != len(before.parameter):
        got = "no weights" if blend is None else f"{len(blend.parameter)} parameters"
        raise ValueError(f"the material of part {name!r} must have {len(before.parameter)} parameters, got {got}")
    blend.check(len(before.weight), before.weight.shape[1])
