"""Higher-order orthogonal iteration, with which Sun et al. 2007 decompose their tensors."""

from collections.abc import Sequence
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.decompose.tucker import Tucker


@partial(jit, static_argnames=("ranks", "sweeps"))
def hooi(tensor: Float[Array, "*n"], *, ranks: tuple[int, ...], sweeps: int = 2) -> tuple[Tucker, Float[Array, " s"]]:
    """Higher-order orthogonal iteration: finds the best factor of each mode in turn, given the other factors.

    Args:
        tensor: A tensor with at least two modes.
        ranks: Rank of each mode.
        sweeps: Number of sweeps over all modes. The iteration starts from the result of `truncated`.

    Returns:
        The decomposition, differentiable in the same sense as that of `jaxprt.decompose.tucker.hosvd`; and the relative
        L2 error at the start and after each sweep. The error never grows, apart from rounding. It is computed
        from a difference of squares, so in float32 it is inaccurate below about 3e-4.

    Raises:
        ValueError: `sweeps` is negative, the number of ranks is not the number of modes, or a rank is not between 1 and
            its mode's size.

    Reference: De Lathauwer, De Moor, Vandewalle 2000, "On the best rank-1 and rank-(R1, ..., RN) approximation".
    """
    if sweeps < 0:
        raise ValueError(f"sweeps must not be negative, got {sweeps}")
    now = tucker.truncated(tensor, ranks=ranks)
    whole = jnp.vdot(tensor, tensor)

    def error(core):
        left = jnp.maximum(whole - jnp.vdot(core, core), 0)
        left = jnp.where(whole > 0, left / jnp.where(whole > 0, whole, 1), 0)
        return jnp.where(left > 0, jnp.sqrt(jnp.where(left > 0, left, 1)), 0)

    errors, factor, core = [error(now.core)], list(now.factor), now.core
    for _ in range(sweeps):
        for mode in range(tensor.ndim):
            others = _all_but(mode, tensor, factor)
            factor[mode] = tucker.dominant(tucker.gram(others, mode=mode), ranks[mode])
            core = tucker.multiply(others, factor[mode], mode=mode)
        errors.append(error(core))
    return Tucker(core, tuple(factor)), jnp.stack(errors)


def _all_but(mode: int, tensor: Array, factor: Sequence[Array]) -> Array:
    """The tensor times the factors of all other modes. Factors that shrink the tensor most come first."""
    others = {other: matrix.shape[1] / matrix.shape[0] for other, matrix in enumerate(factor) if other != mode}
    for other in sorted(others, key=lambda other: others[other]):
        tensor = tucker.multiply(tensor, factor[other], mode=other)
    return tensor
