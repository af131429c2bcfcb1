"""Sets of BRDFs as published: a Tucker decomposition of their samples."""

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

    Optimal in the Frobenius norm of the disk, which the largest values, those of sharp lobes and at grazing angles,
    dominate: prefer `jaxprt.dynamic.factor` unless the published form itself is wanted. Lobes are
    narrower than its texels and cannot be taken out of these samples; with lobes, too, take the other. The error is
    relative, in the same norm.

    Arguments, result and errors as of `jaxprt.dynamic.factor`.

    Reference: Sun et al. 2007, section 3.2, equation 2.
    """
    brdf_set.check(brdfs, None, resolution=resolution)
    direction, area = texels(resolution, hemisphere.disk_coordinates)
    # Texels outside the disk, which bilinear lookup needs at the rim, count next to nothing.
    flux = jnp.sqrt(jnp.maximum(area, 1e-6 * jnp.max(area)))
    tensor = jnp.asarray(np.stack([np.asarray(tabulate(brdf, direction) * flux) for brdf in brdfs]))
    reflected.check_values([jnp.min(tensor, (1, 2, 3))])
    whole = jnp.sum(jnp.sum(tensor**2, (0, 1, 3)) * area)
    rest = (None, reflected.stacked(brdfs))
    return brdf_set.decompose(
        tensor, jnp.diag(1 / flux), jnp.sqrt(area), whole, ranks, rest, hemisphere.disk_coordinates
    )
