"""Relighting with materials that change: the light, the view and the BRDF of every region are free.

    B(x, wo) = sum_ijk D(i, j, k) U^h(h, i) U^wo(wo, j) sum_l C_l U_x^I(l, k) + lobes + diffuse

`light_side` is recomputed when the light changes, and `view_side` when the view or the materials change. The caller
keeps the other result. `combine` computes radiance from both.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.compile import isolated, jit
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.systems import bright_texels, protocol
from jaxprt.systems.dynamic.brdf_set import BrdfSet, Mixed
from jaxprt.systems.dynamic.set_transport import RegionTransport, SetTransport
from jaxprt.systems.lobe import system as lobe
from jaxprt.systems.lobe.blurred_light import LobeLight
from jaxprt.systems.lobe.system import LobeView
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.separable import system as separable
from jaxprt.systems.separable.factorization import check_mark
from jaxprt.visibility.starts import PointVisibility

_ROUNDED = 1e-4  # tolerance for the sum of weights in single precision


def _floating(value: Any) -> Any:
    """Numbers as an array with at least one axis. What is not of numbers is left for `Material` to refuse."""
    value = require.floating(value, dtype=jnp.result_type(float))
    return jnp.atleast_1d(value) if isinstance(value, jax.Array) else value


class Material(eqx.Module):
    """The current material of a region. Numbers, lists and NumPy arrays are converted to JAX arrays.

    Relighting refuses weights that are negative or do not sum to one, negative colors, and values that are not finite.
    Inside `jax.jit`, `jax.grad` and other transformations, values are unknown and not checked: weights that sum to two
    make the lobes twice as bright, and a NaN in one region reaches every vertex that receives light from it.

    Attributes:
        weight: Weight of each BRDF in the region's set. `jaxprt.brdf.navigation` makes weights from coordinates.
        diffuse: Albedo of the diffuse part: gray [1], a color [3], or one of these for each vertex of the mesh (a
            texture).
        specular: Factor of the set's BRDF, in the same form.
    """

    weight: Float[Array, " m"] = eqx.field(converter=_floating)
    diffuse: Float[Array, "*v c"] = eqx.field(converter=_floating)
    specular: Float[Array, "*w d"] = eqx.field(converter=_floating)

    def __check_init__(self):
        """Refuses anything but real numbers."""
        for name in ("weight", "diffuse", "specular"):
            require.real(f"{name} of the material", getattr(self, name))


class SetLight(eqx.Module):
    """The light, projected for all regions.

    Attributes:
        met: Projection on the transport of each vertex and term, for each region.
        blurred: The light, prefiltered for lobes; None if no region has lobes.
        texel: Indices of the brightest texels, which are summed one by one.
        excess: Their radiance.
        matte: Their irradiance over pi at the vertices of each region.
    """

    met: tuple[Float[Array, "_ _ c"], ...]
    blurred: LobeLight | None
    texel: Int[Array, " t"]
    excess: Float[Array, "t c"]
    matte: tuple[Float[Array, "_ c"], ...]


class RegionBrdf(eqx.Module):
    """The current BRDF of a region: the one that its material selects from its set.

    Attributes:
        brdf: The BRDF without its diffuse part, or the fixed BRDF.
        diffuse: Albedo of the diffuse part, at each vertex or point, or one for all; None for a fixed BRDF.
        specular: Factor of the BRDF without its diffuse part, in the same form; None for a fixed BRDF.
    """

    brdf: Mixed | SeparableBrdf
    diffuse: Float[Array, "_ d"] | None
    specular: Float[Array, "_ e"] | None


class RegionView(eqx.Module):
    """What depends on the view and the material, for one region.

    Attributes:
        surface: The current BRDF of the region.
        factor: View factors of each vertex or point and term, without the diffuse term; None if there is no other term.
        looked: Where each vertex or point reads the prefiltered light for its lobes; None without lobes.
        points: The points, whose corners are indices within the region; None for the vertices.
    """

    surface: RegionBrdf
    factor: Float[Array, "q r c"] | None
    looked: LobeView | None
    points: Points | None = None


class SetView(eqx.Module):
    """What depends on the view and all materials.

    Attributes:
        eye: Position of the viewer in world units.
        region: View of each region.
    """

    eye: Float[Array, "3"]
    region: tuple[RegionView, ...]


def radiance(
    transport: SetTransport,
    brdfs: Sequence[BrdfSet | SeparableBrdf],
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
        brdfs: For each region, the BRDF that the transport was made for.
        materials: For each region, its current material; None for a region with one fixed BRDF.
        light: The environment.
        eye: Position of the viewer in world units.
        texels: Number of brightest texels that are summed one by one.
        samples: Number of points along the edge of each of them at which the BRDF is evaluated.
            `jaxprt.bright_texels.samples_for` computes the number that a BRDF needs; use the sharpest material.

    Returns:
        Linear radiance of each vertex in the units of the light. Slightly negative values occur at shadow boundaries.
        Differentiable in the light, the eye and the materials.

    Raises:
        TypeError: `light` is not an `Environment`, a BRDF is neither a set nor factored, or a material is not a
            `Material`.
        ValueError: There is not one BRDF and one material for each region; a material is given for a fixed BRDF, or
            missing for a set; the number of weights differs from that of the set's BRDFs; a color does not have one or
            three channels; a material has values that `Material` refuses; the light has another size; or the eye or the
            light has a wrong shape or is not finite. Inside `jax.jit` values are unknown: NaN then reaches the vertices
            that read it.

    Reference: Sun et al. 2007, equation 3 with direct lighting, and section 4.1.
    """
    lit = light_side(transport, light, texels=texels)
    return combine(transport, lit, view_side(transport, brdfs, materials, eye=eye), samples=samples)


def light_side(transport: SetTransport, light: Environment, *, texels: int = 16) -> SetLight:
    """Computes everything that depends on the light only.

    Args:
        transport: Precomputed transport.
        light: The environment.
        texels: Number of brightest texels that are summed one by one.

    Raises:
        TypeError: `light` is not an `Environment`.
        ValueError: The light is a batch, has another size than the transport requires, or is not finite.
    """
    light = protocol.one_light(light, size=transport.size)
    texel, excess, rest = bright_texels.split(light, count=texels)
    met = tuple(each.terms.apply(separable.project(rest)) for each in transport.region)
    blurred = None
    if any(_has_pyramid(each) for each in transport.region):
        blurred = lobe.prefilter(rest)
        blurred = LobeLight(blurred.pyramid, blurred.coefficient[:0], blurred.size)
    matte = tuple(bright_texels.irradiance(each.seen, texel, excess) for each in transport.region)
    return SetLight(met, blurred, texel, excess, matte)


def view_side(
    transport: SetTransport,
    brdfs: Sequence[BrdfSet | SeparableBrdf],
    materials: Sequence[Material | None],
    *,
    eye: Float[Array, "3"],
    points: Sequence[Points] | None = None,
) -> SetView:
    """Computes everything that depends on the view and the materials, at the vertices or at points of each region.

    `radiance` gives the errors.

    Args:
        transport: Precomputed transport.
        brdfs: For each region, the BRDF that the transport was made for.
        materials: For each region, its current material; None for a region with one fixed BRDF.
        eye: Position of the viewer in world units.
        points: Points of each region; None for the vertices.
    """
    eye = require.position("the eye", eye).astype(transport.region[0].seen.position.dtype)
    _check_all(transport, brdfs, materials)
    return _view_side(transport, brdfs, materials, eye, points)


@jit
def _view_side(transport: SetTransport, brdfs, materials, eye: Array, points) -> SetView:
    region = []
    several = [None] * len(transport.region) if points is None else points
    for own, surface, at in zip(transport.region, _mix(transport, brdfs, materials, several), several, strict=True):
        brdf = surface.brdf
        place = placed(own.seen.position, own.seen.frame, at)
        if isinstance(brdf, SeparableBrdf):
            region.append(RegionView(surface, separable.view_tuple(brdf, *place, eye), None, at))
            continue
        looked = None if brdf.lobe is None else lobe.view_lobes(own.seen, brdf.lobe, eye=eye, points=at)
        factor = separable.view_tuple(brdf.terms, *place, eye) if brdf.terms.terms else None
        region.append(RegionView(surface, factor, looked, at))
    return SetView(eye, tuple(region))


def mix(
    transport: SetTransport,
    brdfs: Sequence[BrdfSet | SeparableBrdf],
    materials: Sequence[Material | None],
    *,
    points: Sequence[Points] | None = None,
) -> tuple[RegionBrdf, ...]:
    """Computes the current BRDF of each region, at its vertices or at points. It depends on the materials only.

    `radiance` gives the errors.

    Args:
        transport: Precomputed transport.
        brdfs: For each region, the BRDF that the transport was made for.
        materials: For each region, its current material; None for a region with one fixed BRDF.
        points: Points of each region; None for the vertices.
    """
    _check_all(transport, brdfs, materials)
    return _mix(transport, brdfs, materials, [None] * len(transport.region) if points is None else points)


def _mix(transport: SetTransport, brdfs, materials, points: Sequence[Points | None]) -> tuple[RegionBrdf, ...]:
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
def combine(transport: SetTransport, light: SetLight, view: SetView, *, samples: int = 1) -> Float[Array, "v c"]:
    """Radiance of a view under a light.

    Args:
        transport: The transport that both were made with.
        light: Result of `light_side`.
        view: Result of `view_side`.
        samples: Number of points along the edge of each bright texel at which the BRDF is evaluated.
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
def _mixed(brdf: BrdfSet, weight: Array) -> Mixed:
    return brdf.at(weight)


def _glossy(view: LobeView) -> LobeView:
    """The lobes without their diffuse part, which the diffuse term lights instead."""
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
    """Values of all regions in the mesh's order of vertices; values at points are concatenated region by region."""
    colors = max(each.shape[1] for each in rows)
    whole = jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])
    return whole if place is None else whole[place]


def _by_row(value: Array, vertex: Array, points: Points | None) -> Array:
    if value.ndim == 1:
        return value[None]
    return value[vertex] if points is None else points.carry(value[vertex])


def _has_pyramid(region: RegionTransport) -> bool:
    return region.seen.pyramid.shape[1] > 6 * region.seen.size**2 // 8


def _check_all(transport: SetTransport, brdfs: Sequence, materials: Sequence) -> None:
    """Refuses BRDFs and materials that do not fit the regions."""
    count = len(transport.region)
    if len(brdfs) != count or len(materials) != count:
        raise ValueError(
            f"there must be a BRDF and a material for each of {count} regions, got {len(brdfs)} and {len(materials)}"
        )
    for number, (own, brdf, material) in enumerate(zip(transport.region, brdfs, materials, strict=True)):
        _check(number, own, brdf, material, len(transport.place))


def _check(number: int, own: RegionTransport, brdf, material: Material | None, vertices: int) -> None:
    """Refuses a BRDF and a material that do not fit a region."""
    source = "jaxprt.dynamic.factor or jaxprt.separable.factor"
    require.kind(f"the BRDF of region {number}", brdf, BrdfSet, SeparableBrdf, source=source)
    changes = isinstance(brdf, BrdfSet)
    terms = brdf.light_map.shape[0] + changes
    if terms != own.terms.terms or (changes and brdf.lobe is not None) != _has_pyramid(own):
        raise ValueError(
            f"the BRDF of region {number} must be the one that its transport was made for, got another one"
        )
    light = brdf.light_map[..., None] if changes else brdf.light_map
    check_mark(own.terms.mark, light, name=f"the BRDF of region {number}")
    if changes != (material is not None):
        raise ValueError(
            f"region {number} {'needs a material' if changes else 'has a BRDF that cannot change: give None'}"
        )
    if material is not None:
        check_material(number, material, brdf.size, vertices)


def check_material(number: int, material: Material, brdfs: int, vertices: int) -> None:
    """Refuses a material that does not fit its region, or has invalid values.

    Args:
        number: Number of the region, for the message.
        material: Material of the region. Inside `jax.jit` only its shapes are checked.
        brdfs: Number of BRDFs in the region's set.
        vertices: Number of vertices of the mesh.

    Raises:
        TypeError: `material` is not a `Material`.
        ValueError: The number of weights or the shape of a color is wrong, or a value is one that `Material` refuses.
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
