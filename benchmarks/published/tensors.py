"""Tensors as in Sun et al. 2007: sets of BRDFs by a decomposition of their samples, and the iteration behind it."""

from collections.abc import Callable, Sequence
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from benchmarks.published.factorization import texels
from jaxprt.compile import jit
from jaxprt.decompose import tucker
from jaxprt.decompose.tucker import Tucker
from jaxprt.sphere import hemisphere
from jaxprt.systems.dynamic import brdf_set, reflected
from jaxprt.systems.separable.factorization import tabulate


def factor_tensor(
    brdfs: Sequence[Callable], *, ranks: tuple[int, int, int] = (4, 8, 8), resolution: int = 48
) -> brdf_set.BrdfSet:
    """Decomposes a set of BRDFs, sampled at the texels of the orthographic disk.

    The result is optimal in the Frobenius norm over the disk. This norm is dominated by the largest values, in sharp
    lobes and at grazing angles: prefer `jaxprt.dynamic.factor` unless you need the published form. Lobes are narrower
    than the texels, so they cannot be subtracted from these samples; use `jaxprt.dynamic.factor` for sets with lobes.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr on local directions, without diffuse parts.
        ranks: Ranks of the set, the view and the light.
        resolution: Edge of the square maps in texels.

    Returns:
        The set. Its error is relative, in the same norm.

    Raises:
        ValueError: There are no BRDFs; a BRDF is negative or not finite; BRDFs have different numbers of colors; a rank
            is below 1 or above the size of the tensor; or `resolution` is below 4.

    Reference: Sun et al. 2007, section 3.2, equation 2.
    """
    brdf_set.check(brdfs, None, resolution=resolution)
    direction, area = texels(resolution, hemisphere.disk_coordinates)
    # Texels outside the disk are needed for bilinear lookup at the rim. They get a very small weight.
    flux = jnp.sqrt(jnp.maximum(area, 1e-6 * jnp.max(area)))
    tensor = jnp.asarray(np.stack([np.asarray(tabulate(brdf, direction) * flux) for brdf in brdfs]))
    reflected.check_values([jnp.min(tensor, (1, 2, 3))])
    whole = jnp.sum(jnp.sum(tensor**2, (0, 1, 3)) * area)
    rest = (None, reflected.stacked(brdfs))
    return brdf_set.decompose(
        tensor, jnp.diag(1 / flux), jnp.sqrt(area), whole, ranks, rest, hemisphere.disk_coordinates
    )


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
