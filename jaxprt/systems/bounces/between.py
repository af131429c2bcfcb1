"""Path functions for BRDFs between those of a set: the true BRDF there, projected on the functions.

Weights w of the set's BRDFs determine weights H of the functions by a quadratic form. It is exact at each BRDF, and
halfway between each pair of BRDFs:

    H(w) = sum_m w_m H_m + sum_m<n w_m w_n 4 (H_mn - (H_m + H_n) / 2)

H_mn is the projection of the BRDF halfway between m and n. If the BRDFs are of one model, this is the model with the
mean parameters, as in `jaxprt.dynamic.BrdfSet.at`. Otherwise their lobes are moved halfway, and the residuals of
the lobes are averaged. Light that is sent to other surfaces thus has the material that is seen.
"""

import itertools
from collections.abc import Callable, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.brdf.places import Columns, Line, Plane
from jaxprt.compile import jit
from jaxprt.systems.dynamic import brdf_set, reflected
from jaxprt.systems.lobe import LobeBrdf
from jaxprt.systems.lobe.table import mean

_ALL = 64  # largest set in which, without a navigation, all pairs count
_GRAZING = 1e-3  # smallest cosine in a division


class Moved(eqx.Module):
    """The BRDF that lobes represent, in 1/sr.

    Attributes:
        lobe: A table of lobes without parameters.
    """

    lobe: LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        return self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


def pairs(count: int, navigation: Line | Plane | Columns | None) -> Int[np.ndarray, "p 2"]:
    """Pairs of a set's BRDFs that have a BRDF halfway between them: those that a navigation connects.

    Args:
        count: Number of BRDFs in the set.
        navigation: The navigation through the set. If None, all pairs; or no pairs if the set has more than 64 BRDFs.

    Raises:
        ValueError: The navigation is for another number of BRDFs.
    """
    if navigation is None:
        every = itertools.combinations(range(count), 2) if count <= _ALL else ()
        return np.array([*every], int).reshape(-1, 2)
    known = len(navigation.knot if isinstance(navigation, Line) else navigation.point)
    if known != count:
        raise ValueError(f"navigation must be for the set's {count} BRDFs, got one for {known}")
    return navigation.pairs


def middles(
    brdfs: Sequence[Callable], lobe: LobeBrdf | None, pair: Int[np.ndarray, "p 2"]
) -> tuple[list[Callable], list[Callable]]:
    """The BRDF halfway between each pair of BRDFs.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr.
        lobe: Lobes of the BRDFs, along the single parameter of the table.
        pair: Indices of the two BRDFs of each pair.

    Returns:
        Two lists. The first has the BRDF of each pair; if the BRDFs are not of one model, it represents their lobes
        only, and without lobes it is empty. The second has the part of each given BRDF that its lobes represent; it is
        empty if the BRDFs are of one model, or have no lobes.
    """
    together, count = reflected.stacked(brdfs), len(brdfs)
    half = np.zeros((len(pair), count), np.float32)
    half[np.arange(len(pair))[:, None], pair] = 0.5
    if together is not None:
        found = _models(together, jnp.asarray(half, jnp.result_type(float)))
        return [jax.tree.map(lambda leaf, n=n: leaf[n], found) for n in range(len(pair))], []
    if lobe is None:
        return [], []
    half, whole = (jnp.asarray(each, lobe.scale.dtype) for each in (half, np.eye(count)))
    return [Moved(mean(lobe, each)) for each in half], [Moved(mean(lobe, each)) for each in whole]


@jit
def _models(together: Callable, weight: Float[Array, "p m"]) -> Callable:
    return jax.vmap(lambda each: jax.tree.map(lambda x: brdf_set.between(x, each), together))(weight)


@partial(jit, static_argnames=("count",))
def quadratic(factor: Float[Array, "n c h"], pair: Int[Array, "p 2"], *, count: int) -> Float[Array, "m m c h"]:
    """Factors of pairs of BRDFs, such that equal weights of a pair give the BRDF halfway; for `brdf_set.combined`.

    Args:
        factor: Factors of each BRDF, followed by those of the BRDF halfway between each pair.
        pair: Indices of the two BRDFs of each pair. Other pairs are interpolated linearly.
        count: Number of BRDFs.
    """
    own, middle = factor[:count], factor[count:]
    mixed = (own[:, None] + own) / 2
    first, second = pair.T
    value = 2 * middle - mixed[first, second]
    return mixed.at[first, second].set(value).at[second, first].set(value)
