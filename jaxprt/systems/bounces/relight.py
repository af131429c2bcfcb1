"""The light that arrives after bounces: light and materials are free.

    I_x(s) = sum_l L(l) sum_q H(q) T1_x(l, q, s) + sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)

`light_side` is recomputed when the light changes, and `collect` when the light or the materials change.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import isolated, mapped
from jaxprt.scene.environment import Environment
from jaxprt.systems import protocol
from jaxprt.systems.bounces import gather
from jaxprt.systems.bounces.tensor import TransferTensor


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
    """Applies the tensor to a light: everything that depends on the light only.

    Raises:
        TypeError: `light` is not an `Environment`.
        ValueError: The light is a batch or not finite, or the edge of its faces is not a multiple of that of the
            tensor's.
    """
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
