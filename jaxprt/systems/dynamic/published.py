"""Sets of BRDFs as in the paper: a Tucker decomposition of BRDF samples."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np

from jaxprt.sphere import hemisphere
from jaxprt.systems.dynamic import brdf_set, reflected
from jaxprt.systems.separable.factorization import tabulate
from jaxprt.systems.separable.published import texels


def factor_tensor(
    brdfs: Sequence[Callable], *, ranks: tuple[int, int, int] = (4, 8, 8), resolution: int = 48
) -> brdf_set.DynamicBrdf:
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
