"""Precomputed transfer tensors: the light that arrives at every vertex after one bounce and two.

    I1_x(s) = sum_l L(l) sum_q H(q) T1_x(l, q, s)
    I2_x(s) = sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)

The tensors hold for any light and any BRDFs. For one bounce the light has 6 x 8 x 8 texels l. It arrives as 16
harmonics s in world directions. q counts the functions of all regions, from `jaxprt.bounces.functions`, and H are their
current weights. For two bounces, off functions q and then p, the light is reduced to 6 x 2 x 2 texels. It arrives
as 16 harmonics too, whereas the paper treats it as uniform over direction. Vertices are clustered, and
the tensor of each cluster is decomposed along vertices and light. `light_side` is recomputed when the light changes,
and `collect` when the light or the materials change.

A third bounce of this kind would cost as many times the second as there are functions. Bounces after the second are
therefore diffuse light between patches; see `jaxprt.bounces.patches`. The effect of textures on the first two is also
computed by patches.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Float16, Int

from jaxprt.compile import isolated, mapped
from jaxprt.scene.environment import Environment
from jaxprt.sphere import cubemap
from jaxprt.systems import protocol
from jaxprt.systems.bounces.patches import Patches

_FEWER = 2  # ratio of the numbers of components of one bounce and of two
_LEAST = 0.01  # smallest scale of a function, relative to the largest


class SecondBounce(eqx.Module):
    """Light that arrives after two bounces, by clusters of vertices. `weight` carries the scale.

    Attributes:
        weight: Weights of the components of a vertex's cluster, for each row: those of `core`, then those of `lamp`.
        core: For each cluster: texels of the light, components, harmonics, functions of the first and second bounce.
        error: Relative L2 error of each cluster's tensor due to the truncation to components.
        lamp: As `core`, with lamps of radiance 1 in place of texels; None without lamps.
    """

    weight: Float[Array, "g m _"]
    core: Float16[Array, "g l o s q q"]
    error: Float[Array, " g"]
    lamp: Float16[Array, "g i o s q q"] | None = None


class TransferTensor(eqx.Module):
    """Light that arrives after one bounce and two, by clusters of vertices.

    `weight` carries the scale, so that half precision is enough for `core`.

    Attributes:
        weight: Weights of the components of a vertex's cluster, for each row: those of `core`, then those of `lamp`.
        core: For each cluster: modes of the light, components, harmonics and functions.
        mode: Modes of the light of each cluster, over the light's texels.
        place: Row of each vertex.
        region: Number of the region of each vertex.
        area: Surface area that each vertex represents, a third of that of the triangles around it.
        function: Indices of the functions that are kept, among those of all regions.
        factor: For each region, the weights of its functions for each channel of its BRDF.
        second: Two bounces; None if not requested, or omitted.
        error: Relative L2 error of each cluster's tensor due to the decomposition, with each function at its largest
            possible weight, and without what the modes by which light is gathered leave out. It is computed as a
            difference of squares: values below 5e-4 are rounding.
        worth: Contribution of each bounce under uniform light: RMS irradiance relative to the irradiance of an
            unoccluded surface. With "all" bounces, the last value
            is that of all bounces after the second together.
        patches: Patches that exchange diffuse light, for textures and for bounces after the second; None without.
        lamp: For each cluster: lamps of radiance 1, components, harmonics and functions; None without lamps.
    """

    weight: Float[Array, "g m _"]
    core: Float16[Array, "g e n s q"]
    mode: Float[Array, "g l e"]
    place: Int[Array, " v"]
    region: Int[Array, " v"]
    area: Float[Array, " v"]
    function: Int[Array, " q"]
    factor: tuple[Float[Array, "_ _"], ...]
    second: SecondBounce | None
    error: Float[Array, " g"]
    worth: Float[Array, " _"]
    patches: Patches | None = None
    lamp: Float16[Array, "g i n s q"] | None = None

    @property
    def lamps(self) -> int:
        """Number of lamps whose light is reflected."""
        return 0 if self.lamp is None else self.lamp.shape[1]

    @property
    def light_step(self) -> int:
        """Number that divides the edge of the faces of lights: they are made coarser for each part of the tensor."""
        texels = [self.mode.shape[1]]
        texels += [] if self.second is None else [self.second.core.shape[1]]
        texels += [] if self.patches is None else [self.patches.light.shape[1]]
        return math.lcm(*(math.isqrt(count // 6) for count in texels))

    @property
    def nbytes(self) -> int:
        """Bytes of the tensors."""
        held = self.weight, self.core, self.mode, self.second, self.patches, self.lamp
        return sum(leaf.nbytes for leaf in jax.tree.leaves(held))


def twice(components: int) -> int:
    """Number of components of two bounces, given that of one bounce."""
    return max(1, components // _FEWER)


def scales(factor: Sequence[Array]) -> Float[Array, " q"]:
    """Largest weight of each function, at least a hundredth of the largest of all: half precision holds both."""
    whole = jnp.concatenate([jnp.max(jnp.abs(weight), 1) for weight in factor])
    return jnp.maximum(whole, _LEAST * jnp.max(whole, initial=0))


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


def light_side(tensor: TransferTensor, light: Environment) -> LitTransfer:
    """Applies the tensor to a light: everything that depends on the light only."""
    return _lit(tensor, protocol.one_light(light).radiance)


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
        weight: Weights of the functions that the tensor keeps, region after region.
        change: Albedo of each vertex minus the mean of its region; None for zero.
        lamp: Radiance of each lamp; None for lamps that are off, and without lamps.
    """
    if lamp is None and tensor.lamps:
        lamp = jnp.zeros((tensor.lamps, 1), weight.dtype)
    # Multiply and sum along the last axes: for an einsum, XLA on CPUs would transpose the large operands first.
    sent, row, matte = jnp.sum(light.first * weight.T[:, None, None], -1), tensor.weight, light.matte
    if lamp is not None and tensor.lamp is not None:
        sent = _beside(sent, jnp.einsum("ginsq,iqc->gcns", tensor.lamp.astype(sent.dtype), lamp[:, None] * weight))
        if matte is not None and tensor.patches is not None and tensor.patches.lamp is not None:
            matte = matte + tensor.patches.lamp @ lamp
    once, twice = sent, None
    if light.second is not None and tensor.second is not None:
        both = weight.T[:, :, None] * weight.T[:, None]
        twice = jnp.sum(light.second * both[:, None, None], (-2, -1))
        if lamp is not None and tensor.second.lamp is not None:
            core = tensor.second.lamp.astype(twice.dtype)
            paths = lamp[:, None, None] * weight[:, None] * weight  # [i q p c]
            twice = _beside(twice, jnp.einsum("giosqp,iqpc->gcos", core, paths))
        sent, row = _beside(sent, twice), jnp.concatenate([row, tensor.second.weight], -1)
    clusters, colors, components, harmonic = sent.shape
    rows = row @ jnp.moveaxis(sent, 2, 1).reshape(clusters, components, colors * harmonic)
    whole = rows.reshape(-1, colors, harmonic)[tensor.place].transpose(2, 1, 0)
    patches = tensor.patches
    if patches is None or matte is None or (change is None and (twice is None or patches.bounces == 2)):
        return whole
    mean = patches.albedo(tensor.function, weight)
    off = None if change is None else patches.means(change, tensor.area)
    return whole + patches.arriving(mean, off, matte, once, twice)


def _beside(first: Float[Array, "g c n s"], second: Float[Array, "g d m s"]) -> Float[Array, "g e _ s"]:
    """Components one after another. Gray ones are repeated to the colors of the others."""
    colors = max(first.shape[1], second.shape[1])
    return jnp.concatenate([jnp.broadcast_to(x, (len(x), colors, *x.shape[2:])) for x in (first, second)], 2)


@isolated
def _lit(tensor: TransferTensor, radiance: Array) -> LitTransfer:
    light = cubemap.coarse(radiance, edge=math.isqrt(tensor.mode.shape[1] // 6))
    first = _met(jnp.einsum("gle,lc->gce", tensor.mode, light), tensor.core)
    matte = None
    if tensor.patches is not None:
        matte = tensor.patches.light @ cubemap.coarse(radiance, edge=math.isqrt(tensor.patches.light.shape[1] // 6))
    if tensor.second is None:
        return LitTransfer(first, None, matte)
    again = cubemap.coarse(radiance, edge=math.isqrt(tensor.second.core.shape[1] // 6)).T
    return LitTransfer(first, _met(jnp.broadcast_to(again, (len(first), *again.shape)), tensor.second.core), matte)


def _met(light: Float[Array, "g c e"], core: Float[Array, "g e *f"]) -> Float[Array, "g c *f"]:
    """Applies cores to light, cluster by cluster. Converting all half-precision cores at once is slower."""
    clusters, kinds, *shape = core.shape

    def one(argument):
        light, core = argument
        return light @ core.reshape(kinds, math.prod(shape)).astype(light.dtype)

    return mapped(one, (light, core)).reshape(clusters, light.shape[1], *shape)
