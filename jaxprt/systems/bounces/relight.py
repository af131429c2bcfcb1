"""Relighting with light that has been reflected; light, view and materials are free.

    B(x, wo) = sum_s E_x(s, wo) [sum_l L(l) sum_q H(q) T1_x(l, q, s) + sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)]

`light_side` is recomputed when the light changes, `arriving` when the light or the materials change, and `view_side`
when the view or the materials change. `combine` computes radiance. Harmonics of the lobes and terms of a BRDF are
exact: von Mises-Fisher lobes are zonal, so the width of a lobe is one factor for each band.
"""

import math
from collections.abc import Sequence
from functools import partial, reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require
from jaxprt.compile import isolated, jit, mapped
from jaxprt.decompose import mixture
from jaxprt.scene.environment import Environment
from jaxprt.scene.points import Points, placed
from jaxprt.sphere import directions, harmonics, rotation
from jaxprt.systems import dynamic, protocol
from jaxprt.systems.bounces import functions, gather
from jaxprt.systems.bounces.jobs import DEGREE
from jaxprt.systems.bounces.tensor import TransferTensor
from jaxprt.systems.dynamic import BrdfSet, Material, RegionBrdf, SetTransport
from jaxprt.systems.separable import SeparableBrdf


class LitTransfer(eqx.Module):
    """The tensor applied to a light, before materials are known.

    Attributes:
        first: One bounce. For each cluster and color: components, harmonics and functions.
        second: Two bounces: components, harmonics, and functions of both bounces; None without a second bounce.
        matte: Irradiance over pi of each patch from the light itself; None without patches.
    """

    first: Float[Array, "g c n s q"]
    second: Float[Array, "g c o s q q"] | None
    matte: Float[Array, "j c"] | None = None


class Arriving(eqx.Module):
    """Reflected light that arrives at the vertices of a region.

    Attributes:
        local: SH coefficients of its radiance, in the frame of each vertex.
        irradiance: Irradiance over pi: the radiance of a white diffuse surface.
    """

    local: Float[Array, "s c q"]
    irradiance: Float[Array, "c q"]


class ReflectedView(eqx.Module):
    """How a region reflects arriving light to the eye.

    Attributes:
        coefficient: Coefficients of each harmonic of the arriving light, in the frame of each vertex or point.
        specular: Factor of these.
        diffuse: Factor of irradiance over pi.
    """

    coefficient: Float[Array, "s e q"]
    specular: Float[Array, "d _"]
    diffuse: Float[Array, "f q"]


def radiance(
    transport: SetTransport,
    tensor: TransferTensor,
    brdfs: Sequence[BrdfSet | SeparableBrdf],
    materials: Sequence[Material | None],
    light: Environment,
    *,
    eye: Float[Array, "3"],
    texels: int = 16,
    samples: int = 1,
) -> Float[Array, "v c"]:
    """Radiance that each vertex sends to the eye, from direct light and from light that other surfaces reflect.

    Args:
        transport: Precomputed transport of direct light.
        tensor: Precomputed bounces on the same mesh.
        brdfs: For each region, the BRDF that the transport was made for.
        materials: For each region, its current material; None for a region with one fixed BRDF. A textured region
            reflects light to others with its mean material; patches add the differences in albedo.
        light: The environment. Reflected light uses it at a lower resolution.
        eye: Position of the viewer in world units.
        texels: Number of brightest texels that are summed one by one, in direct light.
        samples: Number of points along the edge of each of them at which the BRDF is evaluated.

    Returns:
        Linear radiance of each vertex in the units of the light. Differentiable in the light, the eye and the
        materials.

    Raises:
        TypeError: For the reasons that `jaxprt.dynamic.radiance` gives.
        ValueError: The tensor is for another mesh than the transport, or for another number of BRDFs; or for the
            reasons that `jaxprt.dynamic.radiance` gives.

    Reference: Sun et al. 2007, equations 3 and 4.
    """
    view = dynamic.view_side(transport, brdfs, materials, eye=eye)
    lit = dynamic.light_side(transport, light, texels=texels)
    direct = dynamic.combine(transport, lit, view, samples=samples)
    arrived = arriving(transport, tensor, light_side(tensor, light), materials)
    return direct + combine(transport, arrived, view_side(transport, dynamic.mix(transport, brdfs, materials), eye=eye))


def light_side(tensor: TransferTensor, light: Environment) -> LitTransfer:
    """Applies the tensor to a light: everything that depends on the light only.

    Raises:
        TypeError: `light` is not an `Environment`.
        ValueError: The light is a batch or not finite, or the edge of its faces is not a multiple of that of the
            tensor's.
    """
    return _lit(tensor, protocol.one_light(light).radiance)


def arriving(
    transport: SetTransport, tensor: TransferTensor, light: LitTransfer, materials: Sequence[Material | None]
) -> tuple[Arriving, ...]:
    """Reflected light that arrives at the vertices of each region, given the light and all materials, for any view.

    `radiance` describes the materials, and gives the errors.
    """
    weight, change = weights(tensor, materials), changes(tensor, materials)
    if len(tensor.place) != len(transport.place):
        raise ValueError(
            f"the tensor must have the transport's {len(transport.place)} vertices, got {len(tensor.place)}"
        )
    if tensor.mesh and transport.mesh and tensor.mesh != transport.mesh:
        raise ValueError(
            "the tensor must be made for the transport's mesh and regions, got one for others with as many vertices"
        )
    return _arriving(transport, tensor, light, weight, change)


@jit
def _arriving(
    transport: SetTransport, tensor: TransferTensor, light: LitTransfer, weight, change
) -> tuple[Arriving, ...]:
    whole = collect(tensor, light, weight, change=change)
    return tuple(_turned(whole, each.vertex, each.seen.frame) for each in transport.region)


def weights(tensor: TransferTensor, materials: Sequence[Material | None]) -> Float[Array, "q c"]:
    """Weights of all functions that the tensor keeps, region after region. `radiance` gives the errors."""
    if len(materials) != len(tensor.factor):
        raise ValueError(f"there must be a material for each of {len(tensor.factor)} regions, got {len(materials)}")
    rows = []
    for number, (factor, material) in enumerate(zip(tensor.factor, materials, strict=True)):
        if (factor.ndim > 2) != (material is not None):
            needs = "needs a material" if factor.ndim > 2 else "has a BRDF that cannot change: give None"
            raise ValueError(f"region {number} {needs}")
        if material is None:
            rows.append(factor)
            continue
        dynamic.set_relight.check_material(number, material, len(factor), len(tensor.place))
        area = jnp.where(tensor.region == number, tensor.area, 0)
        diffuse, specular = (
            each if each.ndim == 1 else area_mean(each, area) for each in (material.diffuse, material.specular)
        )
        rows.append(functions.weights(factor, material.weight, diffuse, specular))
    return gathered(tensor, rows)


def changes(tensor: TransferTensor, materials: Sequence[Material | None]) -> Float[Array, "v d"] | None:
    """Albedo of each vertex minus the mean of its region; None without textures or patches.

    The arguments are those of `weights`, which checks them.
    """
    if tensor.patches is None:
        return None
    result = None
    for number, (factor, material) in enumerate(zip(tensor.factor, materials, strict=True)):
        if material is None or (material.diffuse.ndim == 1 and material.specular.ndim == 1):
            continue
        strength = tensor.patches.strength[number]
        sharp = jnp.einsum("m,mch,h->c", material.weight, factor, strength[:-1], precision="highest")
        own = tensor.region == number
        albedo = strength[-1] * material.diffuse + sharp * material.specular
        off = jnp.where(own[:, None], albedo - area_mean(albedo, jnp.where(own, tensor.area, 0)), 0)
        result = off if result is None else result + off
    return result


def gathered(tensor: TransferTensor, rows: Sequence[Float[Array, "_ _"]]) -> Float[Array, "q c"]:
    """Weights of the functions that the tensor keeps, given those of all functions of each region."""
    return _gathered(tensor.function, rows)


@jit
def _gathered(function: Array, rows: Sequence[Array]) -> Array:
    colors = max(each.shape[1] for each in rows)
    return jnp.concatenate([jnp.broadcast_to(each, (len(each), colors)) for each in rows])[function]


@jit
def area_mean(value: Float[Array, "v *c"], area: Float[Array, " v"]) -> Float[Array, "*c"]:
    """Mean of a value over a surface, given the area of each vertex; zero if the area is zero."""
    whole = jnp.sum(area)
    return jnp.tensordot(area, value, 1) / jnp.where(whole > 0, whole, 1)


@isolated
def collect(
    tensor: TransferTensor,
    light: LitTransfer,
    weight: Float[Array, "q d"],
    *,
    change: Float[Array, "v e"] | None = None,
    lamp: Float[Array, "i c"] | None = None,
) -> Float[Array, "s _ v"]:
    """SH coefficients, in world directions, of the reflected radiance that arrives at each vertex.

    Args:
        tensor: The transfer tensor.
        light: Result of `light_side`.
        weight: Result of `weights`.
        change: Result of `changes`; None for zero.
        lamp: Radiance of each lamp; None for lamps that are off, and without lamps.
    """
    if lamp is None and tensor.lamps:
        lamp = jnp.zeros((tensor.lamps, 1), weight.dtype)
    # Multiply and sum along the last axes: for an einsum, XLA on CPUs would transpose the large operands first.
    met, row, matte = jnp.sum(light.first * weight.T[:, None, None], -1), tensor.weight, light.matte
    if lamp is not None and tensor.lamp is not None:
        met = _beside(met, jnp.einsum("ginsq,iqc->gcns", tensor.lamp.astype(met.dtype), lamp[:, None] * weight))
        if matte is not None and tensor.patches is not None and tensor.patches.lamp is not None:
            matte = matte + tensor.patches.lamp @ lamp
    once, twice = met, None
    if light.second is not None and tensor.second is not None:
        both = weight.T[:, :, None] * weight.T[:, None]
        twice = jnp.sum(light.second * both[:, None, None], (-2, -1))
        if lamp is not None and tensor.second.lamp is not None:
            core = tensor.second.lamp.astype(twice.dtype)
            paths = lamp[:, None, None] * weight[:, None] * weight  # [i q p c]
            twice = _beside(twice, jnp.einsum("giosqp,iqpc->gcos", core, paths))
        met, row = _beside(met, twice), jnp.concatenate([row, tensor.second.weight], -1)
    clusters, colors, components, harmonic = met.shape
    rows = row @ jnp.moveaxis(met, 2, 1).reshape(clusters, components, colors * harmonic)
    whole = rows.reshape(-1, colors, harmonic)[tensor.place].transpose(2, 1, 0)
    no_more = tensor.patches is None or twice is None or tensor.patches.bounces == 2
    if matte is None or (change is None and no_more):
        return whole
    assert tensor.patches is not None
    mean = tensor.patches.albedo(tensor.function, weight)
    off = None if change is None else tensor.patches.means(change, tensor.area)
    return whole + tensor.patches.arriving(mean, off, matte, once, twice)


def _beside(first: Float[Array, "g c n s"], second: Float[Array, "g d m s"]) -> Float[Array, "g e _ s"]:
    """Components one after another. Gray ones are repeated to the colors of the others."""
    colors = max(first.shape[1], second.shape[1])
    return jnp.concatenate([jnp.broadcast_to(x, (len(x), colors, *x.shape[2:])) for x in (first, second)], 2)


def view_side(
    transport: SetTransport,
    surfaces: Sequence[RegionBrdf],
    *,
    eye: Float[Array, "3"],
    points: Sequence[Points] | None = None,
) -> tuple[ReflectedView, ...]:
    """Everything that depends on the view and the materials.

    Args:
        transport: Precomputed transport of direct light.
        surfaces: Current BRDF of each region, from `jaxprt.dynamic.mix`.
        eye: Position of the viewer in world units.
        points: Points of each region; None for the vertices.
    """
    eye = require.position("the eye", eye)
    return _view_side(transport, surfaces, eye, points)


@jit
def _view_side(transport: SetTransport, surfaces, eye: Array, points) -> tuple[ReflectedView, ...]:
    result = []
    for own, each, at in zip(transport.region, surfaces, points or [None] * len(surfaces), strict=True):
        position, frame = placed(own.seen.position, own.seen.frame, at)
        if isinstance(each.brdf, SeparableBrdf):
            one = jnp.ones((1, 1), position.dtype)
            result.append(ReflectedView(_by_terms(each.brdf, position, frame, eye), one, 0 * position[:, :1].T))
            continue
        assert each.diffuse is not None
        assert each.specular is not None
        coefficient, base = _by_lobes(each.brdf.lobe, position, frame, eye)
        if each.brdf.terms.terms:
            coefficient = coefficient + _by_terms(each.brdf.terms, position, frame, eye)
        specular = each.specular.T
        result.append(ReflectedView(coefficient, specular, each.diffuse.T + base * specular))
    return tuple(result)


@isolated
def combine(
    transport: SetTransport,
    arriving: tuple[Arriving, ...],
    view: tuple[ReflectedView, ...],
    *,
    points: Sequence[Points] | None = None,
) -> Float[Array, "v c"]:
    """Radiance of reflected light alone.

    Args:
        transport: The transport that both were made with.
        arriving: Result of `arriving`.
        view: Result of `view_side`.
        points: Points of each region that `view_side` was given.
    """
    rows = []
    for light, seen, at in zip(arriving, view, points or [None] * len(view), strict=True):
        light = light if at is None else jax.tree.map(partial(at.carry, axis=-1), light)
        glossy = reduce(jnp.add, (a * b for a, b in zip(light.local, seen.coefficient, strict=True)))
        rows.append(glossy * seen.specular + light.irradiance * seen.diffuse)
    colors = max(len(each) for each in rows)
    whole = jnp.concatenate([jnp.broadcast_to(each, (colors, each.shape[1])) for each in rows], 1)
    return (whole if points is not None else whole[:, transport.place]).T


@isolated
def _lit(tensor: TransferTensor, radiance: Array) -> LitTransfer:
    light = gather.coarse(radiance, edge=math.isqrt(tensor.mode.shape[1] // 6))
    first = _met(jnp.einsum("gle,lc->gce", tensor.mode, light), tensor.core)
    matte = None
    if tensor.patches is not None:
        matte = tensor.patches.light @ gather.coarse(radiance, edge=math.isqrt(tensor.patches.light.shape[1] // 6))
    if tensor.second is None:
        return LitTransfer(first, None, matte)
    again = gather.coarse(radiance, edge=math.isqrt(tensor.second.core.shape[1] // 6)).T
    return LitTransfer(first, _met(jnp.broadcast_to(again, (len(first), *again.shape)), tensor.second.core), matte)


def _met(light: Float[Array, "g c e"], core: Float[Array, "g e *f"]) -> Float[Array, "g c *f"]:
    """Applies cores to light, cluster by cluster. Converting all half-precision cores at once is slower."""
    clusters, kinds, *shape = core.shape

    def one(argument):
        light, core = argument
        return light @ core.reshape(kinds, math.prod(shape)).astype(light.dtype)

    return mapped(one, (light, core)).reshape(clusters, light.shape[1], *shape)


@isolated
def _turned(whole: Float[Array, "s c v"], vertex: Array, frame: Array) -> Arriving:
    local = rotation.rotate_each(whole[..., vertex], frame)
    cosine = harmonics.cosine(degree=DEGREE) / np.pi
    # A function that is symmetric about the normal has m = 0 only, in row l (l + 1).
    parts = (local[l * (l + 1)] * (cosine[l] * np.sqrt((2 * l + 1) / (4 * np.pi))) for l in range(DEGREE))
    return Arriving(local, reduce(jnp.add, parts))


@isolated
def _by_lobes(lobe, position: Array, frame: Array, eye: Array) -> tuple[Array, Array]:
    """Coefficients of the lobes at each vertex or point, and the albedo of their diffuse part."""
    if lobe is None:
        return jnp.zeros(((DEGREE + 1) ** 2, 1, len(position)), position.dtype), jnp.zeros_like(position[:, :1].T)
    each = lobe.lookup(directions.view(frame, position, eye))
    band = mixture.bands(each.concentration, degree=DEGREE)
    basis = jnp.moveaxis(harmonics.evaluate(jnp.moveaxis(each.mean, 0, -1), degree=DEGREE), -1, 0)
    # One lobe at a time: a reduction over the middle axis is ten times as slow with XLA on CPUs.
    lobes = range(lobe.lobes)
    strong = [[each.weight[:, i] * band[l, i] for i in lobes] for l in range(DEGREE + 1)]
    rows = [reduce(jnp.add, (strong[math.isqrt(s)][i] * basis[s, i] for i in lobes)) for s in range(len(basis))]
    return jnp.stack(rows), each.diffuse


@isolated
def _by_terms(brdf: SeparableBrdf, position: Array, frame: Array, eye: Array) -> Array:
    """Coefficients of a factored BRDF at each vertex or point."""
    view = brdf.view(directions.view(frame, position, eye))
    return jnp.einsum("sk,qke->seq", functions.project(brdf, degree=DEGREE), view)
