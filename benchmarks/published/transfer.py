"""Shorter decompositions of a transfer tensor, as Figures 9 and 10 of Sun et al. 2007 compare them."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.systems.bounces.tensor import SecondBounce, TransferTensor, scales, twice


def truncate(tensor: TransferTensor, components: int, *, modes: int) -> TransferTensor:
    """Keeps the first components and modes of one bounce, and half as many components of two.

    The errors grow accordingly.

    Args:
        tensor: A tensor without lamps.
        components: Number of components to keep.
        modes: Number of modes to keep.

    Raises:
        ValueError: A number is below 1, or above that of the tensor; or the tensor has lamps.
    """
    most = tensor.core.shape[2], tensor.core.shape[1]
    if tensor.lamps or not (1 <= components <= most[0] and 1 <= modes <= most[1]):
        raise ValueError(
            f"components and modes must be at least 1 and at most {most}, and lamps none, got {components}, {modes} "
            f"and {tensor.lamps} lamps"
        )
    energy, whole = _energy(tensor)
    rest = 1 - jnp.sum(energy[:, :modes, :components], (1, 2)) / jnp.where(whole > 0, whole, 1)
    patches = tensor.patches
    if patches is not None:
        second = None if patches.second is None else patches.second[:, : twice(components)]
        patches = dataclasses.replace(patches, first=patches.first[:, :components], second=second)
    return dataclasses.replace(
        tensor,
        weight=tensor.weight[..., :components],
        core=tensor.core[:, :modes, :components],
        mode=tensor.mode[..., :modes],
        second=tensor.second and _shorter(tensor.second, twice(components), scales(tensor.factor)[tensor.function]),
        error=jnp.where(whole > 0, jnp.sqrt(jnp.maximum(rest, 0)), 0),
        patches=patches,
    )


def _shorter(second: SecondBounce, components: int, scale: Float[Array, " q"]) -> SecondBounce:
    """Keeps the first components of two bounces. `scale` weights the functions in the new error."""
    core = second.core * (scale[:, None] * scale)
    energy = jnp.sum(core**2, (1, 3, 4, 5)) * jnp.sum(second.weight**2, 1)
    whole = jnp.sum(energy, 1) / jnp.maximum(1 - second.error**2, jnp.finfo(energy.dtype).eps)
    rest = 1 - jnp.sum(energy[:, :components], 1) / jnp.where(whole > 0, whole, 1)
    error = jnp.where(whole > 0, jnp.sqrt(jnp.maximum(rest, 0)), 0)
    return SecondBounce(second.weight[..., :components], second.core[:, :, :components], error)


@jit
def _energy(tensor: TransferTensor) -> tuple[Float[Array, "g e n"], Float[Array, " g"]]:
    """Squared norm of each mode and component of a cluster's tensor under natural light, and of the whole tensor."""
    size = jnp.sum(tensor.weight**2, 1)
    energy = jnp.sum((tensor.core * scales(tensor.factor)[tensor.function]) ** 2, (3, 4)) * size[:, None]
    return energy, jnp.sum(energy, (1, 2)) / jnp.maximum(1 - tensor.error**2, jnp.finfo(size.dtype).eps)
