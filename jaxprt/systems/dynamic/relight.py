"""Relighting with materials that change: light, view and the BRDF of every region are free.

    B(x, wo) = sum_ijk D(i, j, k) U^h(h, i) U^wo(wo, j) sum_l C_l U_x^I(l, k) + lobes + diffuse

A change of light redoes `light_side`, a change of view or of materials `view_side`; the caller keeps the other, and
`combine` makes radiance of both.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float, Int

from jaxprt import require
from jaxprt.compile import isolated, jit
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.systems import bright_texels, lobe, separable
from jaxprt.systems.dynamic.brdf_set import DynamicBrdf, Mixed
from jaxprt.systems.dynamic.transport import DynamicTransport, RegionTransport
from jaxprt.systems.lobe import LobeLight, LobeView
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.separable.factorization import check_mark
from jaxprt.visibility.points import PointVisibility

_ROUNDED = 1e-4  # By which a sum of weights is off where they are in single precision.


def _floating(value: ArrayLike) -> Array:
    return jnp.atleast_1d(jnp.asarray(value, jnp.result_type(float)))


class Material(eqx.Module):
    """What a region is made of at present. Numbers, lists and NumPy arrays become arrays.

    Relighting refuses weights that are negative or do not sum to one, negative colors, and values that are not finite.
    Inside `jax.jit`, `jax.grad` and the like values are not known, and nothing is refused: weights that sum to two make
    twice as bright lobes, and a NaN in one region reaches every vertex to which that region sends light.

    Attributes:
        weight: The weight of each BRDF in the region's set; `jaxprt.brdf.navigation` makes weights from coordinates.
        diffuse: Albedo of the diffuse part: gray, a color, or a texture of one for each vertex of the mesh.
        specular: What the BRDF of the set is multiplied by; the same.
    """

    weight: Float[Array, " m"] = eqx.field(converter=_floating)
    diffuse: Float[Array, "*v c"] = eqx.field(converter=_floating)
    specular: Float[Array, "*w d"] = eqx.field(converter=_floating)


class DynamicLight(eqx.Module):
    """What a light is for all regions.

    Attributes:
        met: What each row and term of each region takes of it.
        blurred: The same light for lobes; None where no region has any.
        texel: Its brightest texels, which are lit by one by one.
        excess: Their radiance.
        matte: What white diffuse rows make of them.
    """

    met: tuple[Float[Array, "_ _ c"], ...]
    blurred: LobeLight | None
    texel: Int[Array, " t"]
    excess: Float[Array, "t c"]
    matte: tuple[Float[Array, "_ c"], ...]


class RegionBrdf(eqx.Module):
    """What a region reflects with at present: the BRDF that its material makes of its set.

    Attributes:
        brdf: The BRDF.
        diffuse: Albedo of each row or of all; None in a region that does not change.
        specular: What all but the diffuse part is multiplied by, of each row or of all; None likewise.
    """

    brdf: Mixed | SeparableBrdf
    diffuse: Float[Array, "_ d"] | None
    specular: Float[Array, "_ e"] | None


class RegionView(eqx.Module):
    """What a view and a material are for one region.

    Attributes:
        surface: What the region reflects with.
        factor: Of each row and term without the diffuse one, if there are others.
        looked: Where rows read the light for their lobes, if there are any.
        points: Whose rows these are, numbered as the region's vertices are; None for these.
    """

    surface: RegionBrdf
    factor: Float[Array, "q r c"] | None
    looked: LobeView | None
    points: Points | None = None


class DynamicView(eqx.Module):
    """What a view and all materials are.

    Attributes:
        eye: Position of the viewer in world units.
        region: Of each region.
    """

    eye: Float[Array, "3"]
    region: tuple[RegionView, ...]


def radiance(
    transport: DynamicTransport,
    brdfs: Sequence[DynamicBrdf | SeparableBrdf],
    materials: Sequence[Material | None],
    light: Environment,
    *,
    eye: Float[Array, "3"],
    texels: int = 16,
    samples: int = 1,
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye.

    Args:
        transport: Precomputed transport.
        brdfs: Of each region, those that the transport was made for.
        materials: Of each region, what it is made of at present; None where that does not change.
        light: The environment.
        eye: Position of the viewer in world units.
        texels: How many of the brightest texels light the vertices one by one.
        samples: Points along the edge of each at which the BRDF is taken; `jaxprt.bright_texels.samples_for` of the
            sharpest material tells how many it needs.

    Returns:
        Linear radiance per vertex in the light's units; slightly negative values occur at shadow boundaries.
        Differentiable in the light, the eye and the materials.

    Raises:
        TypeError: The light is no Environment, a BRDF is neither dynamic nor factored, or a material is no Material.
        ValueError: Not one BRDF and material for each region, a material where none can change or none where one must
            be, weights of another number of BRDFs, colors of two or more than three channels, values that `Material`
            refuses, an eye that is not one position, a light of another size, or an eye or a light that is not finite.
            Inside `jax.jit` values are not known: NaN then reaches the vertices that read it.

    Reference: Sun et al. 2007, equation 3 with direct lighting, and section 4.1.
    """
    lit = light_side(transport, light, texels=texels)
    return combine(transport, lit, view_side(transport, brdfs, materials, eye=eye), samples=samples)


def light_side(transport: DynamicTransport, light: Environment, *, texels: int = 16) -> DynamicLight:
    """What changes with the light.

    Arguments and errors are those of `radiance`.
    """
    size = transport.size
    if not isinstance(light, Environment):
        raise TypeError(f"the light must be an Environment, got {type(light).__name__}")
    if light.radiance.shape[:-1] != (6, size, size):
        raise ValueError(f"the light must be one environment [6, {size}, {size}, c], got {list(light.radiance.shape)}")
    require.finite("the light", light.radiance)
    texel, excess, rest = bright_texels.split(light, count=texels)
    met = tuple(each.terms.apply(separable.project(rest)) for each in transport.region)
    blurred = None
    if any(_has_pyramid(each) for each in transport.region):
        blurred = lobe.prefilter(rest)
        blurred = LobeLight(blurred.pyramid, blurred.coefficient[:0], blurred.size)
    matte = tuple(bright_texels.irradiance(each.seen, texel, excess) for each in transport.region)
    return DynamicLight(met, blurred, texel, excess, matte)


def view_side(
    transport: DynamicTransport,
    brdfs: Sequence[DynamicBrdf | SeparableBrdf],
    materials: Sequence[Material | None],
    *,
    eye: Float[Array, "3"],
    points: Sequence[Points] | None = None,
) -> DynamicView:
    """What changes with the view and the materials, at the vertices or at points of each region.

    Arguments and errors are those of `radiance`.
    """
    eye = jnp.asarray(eye, transport.region[0].seen.position.dtype)
    require.position("the eye", eye)
    _check_all(transport, brdfs, materials)
    return _view_side(transport, brdfs, materials, eye, points)


@jit
def _view_side(transport: DynamicTransport, brdfs, materials, eye: Array, points) -> DynamicView:
    region = []
    several = [None] * len(transport.region) if points is None else points
    for own, surface, at in zip(transport.region, _mix(transport, brdfs, materials, several), several, strict=True):
        brdf = surface.brdf
        place = placed(own.seen.position, own.seen.frame, at)
        if isinstance(brdf, SeparableBrdf):
            region.append(RegionView(surface, separable.view_factors(brdf, *place, eye), None, at))
            continue
        looked = None if brdf.lobe is None else lobe.view_lobes(own.seen, brdf.lobe, eye=eye, points=at)
        factor = separable.view_factors(brdf.terms, *place, eye) if brdf.terms.terms else None
        region.append(RegionView(surface, factor, looked, at))
    return DynamicView(eye, tuple(region))


def mix(
    transport: DynamicTransport,
    brdfs: Sequence[DynamicBrdf | SeparableBrdf],
    materials: Sequence[Material | None],
    *,
    points: Sequence[Points] | None = None,
) -> tuple[RegionBrdf, ...]:
    """What each region reflects with, at its vertices or at points: what changes with the materials alone.

    Arguments and errors are those of `radiance`.
    """
    _check_all(transport, brdfs, materials)
    return _mix(transport, brdfs, materials, [None] * len(transport.region) if points is None else points)


def _mix(transport: DynamicTransport, brdfs, materials, points: Sequence[Points | None]) -> tuple[RegionBrdf, ...]:
    result = []
    for own, brdf, material, at in zip(transport.region, brdfs, materials, points, strict=True):
        if isinstance(brdf, SeparableBrdf):
            result.append(RegionBrdf(brdf, None, None))
            continue
        assert material is not None
        diffuse, specular = (_by_row(each, own.vertex, at) for each in (material.diffuse, material.specular))
        result.append(RegionBrdf(_mixed(brdf, material.weight), diffuse, specular))
    return tuple(result)


@partial(jit, static_argnames=("samples",))
def combine(
    transport: DynamicTransport, light: DynamicLight, view: DynamicView, *, samples: int = 1
) -> Float[Array, "v c"]:
    """Radiance of a view under a light.

    Args:
        transport: The transport of both.
        light: From `light_side`.
        view: From `view_side`.
        samples: As in `radiance`.
    """
    result = []
    for own, met, matte, each in zip(transport.region, light.met, light.matte, view.region, strict=True):
        brdf, diffuse, specular = each.surface.brdf, each.surface.diffuse, each.surface.specular
        model = brdf.brdf if isinstance(brdf, Mixed) and brdf.brdf is not None else brdf
        seen: bright_texels.Visibility = own.seen
        if each.points is not None:
            seen = PointVisibility(own.seen, each.points)
            met, matte = (each.points.carry(light) for light in (met, matte))
        single = bright_texels.radiance(seen, model, light.texel, light.excess, eye=view.eye, samples=samples)
        if isinstance(brdf, SeparableBrdf):
            result.append(separable.combine(met, each.factor) + single)
            continue
        glossy = None
        if each.looked is not None:
            glossy = lobe.combine(light.blurred, _glossy(each.looked)), each.looked.diffuse.T
        result.append(_sum(met, each.factor, glossy, single, matte, diffuse, specular))
    return _gathered(tuple(result), None if view.region[0].points is not None else transport.place)


@isolated
def _mixed(brdf: DynamicBrdf, weight: Array) -> Mixed:
    return brdf.at(weight)


def _glossy(view: LobeView) -> LobeView:
    """Lobes alone: their diffuse part is lit by the diffuse term."""
    return eqx.tree_at(lambda each: each.diffuse, view, jnp.zeros_like(view.diffuse))


@isolated
def _sum(met, factor, glossy, single, matte, diffuse, specular) -> Array:
    irradiance, result = met[:, -1], single
    if factor is not None:
        result = result + separable.combine(met[:, :-1], factor)
    if glossy is not None:
        lobes, base = glossy
        result = result + lobes + irradiance * base
    return result * specular + (irradiance + matte) * diffuse


@jit
def _gathered(rows: tuple[Array, ...], place: Array | None) -> Array:
    """Rows of all regions in the mesh's order of vertices; those of points one region after the other."""
    colors = max(each.shape[1] for each in rows)
    whole = jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])
    return whole if place is None else whole[place]


def _by_row(value: Array, vertex: Array, points: Points | None) -> Array:
    if value.ndim == 1:
        return value[None]
    return value[vertex] if points is None else points.carry(value[vertex])


def _has_pyramid(region: RegionTransport) -> bool:
    return region.seen.pyramid.shape[1] > 6 * region.seen.size**2 // 8


def _check_all(transport: DynamicTransport, brdfs: Sequence, materials: Sequence) -> None:
    """Refuses BRDFs and materials that do not fit the regions."""
    count = len(transport.region)
    if len(brdfs) != count or len(materials) != count:
        raise ValueError(
            f"there must be a BRDF and a material for each of {count} regions, got {len(brdfs)} and {len(materials)}"
        )
    for number, (own, brdf, material) in enumerate(zip(transport.region, brdfs, materials, strict=True)):
        _check(number, own, brdf, material, len(transport.place))


def _check(number: int, own: RegionTransport, brdf, material: Material | None, vertices: int) -> None:
    """Refuses what does not fit a region."""
    source = "jaxprt.dynamic.factor or jaxprt.separable.factor"
    require.kind(f"the BRDF of region {number}", brdf, DynamicBrdf, SeparableBrdf, source=source)
    changes = isinstance(brdf, DynamicBrdf)
    terms = brdf.light_map.shape[0] + changes
    if terms != own.terms.terms or (changes and brdf.lobe is not None) != _has_pyramid(own):
        raise ValueError(f"the BRDF of region {number} must be the one that its transport was made for")
    light = brdf.light_map[..., None] if changes else brdf.light_map
    check_mark(own.terms.mark, light, name=f"the BRDF of region {number}")
    if changes != (material is not None):
        raise ValueError(f"region {number} {'needs a material' if changes else 'has one BRDF for good: give None'}")
    if material is not None:
        check_material(number, material, brdf.size, vertices)


def check_material(number: int, material: Material, brdfs: int, vertices: int) -> None:
    """Refuses a material that does not fit its region, or has values that no material has.

    Args:
        number: Of the region, for the message.
        material: What the region is made of. Inside `jax.jit` only its shapes are checked.
        brdfs: How many the region's set has.
        vertices: Of the mesh.

    Raises:
        TypeError: It is no Material.
        ValueError: As `Material` and `radiance` have it.
    """
    if not isinstance(material, Material):
        raise TypeError(f"the material of region {number} must be a Material, got {type(material).__name__}")
    if material.weight.shape != (brdfs,):
        shape = list(material.weight.shape)
        raise ValueError(f"the weights of region {number} must be one for each of its {brdfs} BRDFs, got {shape}")
    require.at_least(f"the weights of region {number}", material.weight, 0.0, slack=_ROUNDED)
    if not isinstance(material.weight, Tracer):
        total = float(np.sum(np.asarray(material.weight, np.float64)))
        if abs(total - 1) > _ROUNDED:
            raise ValueError(
                f"the weights of region {number} must sum to 1, got {material.weight}, whose sum is {total}"
            )
    for name in ("diffuse", "specular"):
        shape = getattr(material, name).shape
        if len(shape) > 2 or (len(shape) == 2 and shape[0] != vertices) or shape[-1] not in (1, 3):
            raise ValueError(
                f"{name} of region {number} must be gray [1], a color [3] or one of either for each of {vertices} "
                f"vertices, got {list(shape)}"
            )
        require.at_least(f"{name} of region {number}", getattr(material, name), 0.0)
