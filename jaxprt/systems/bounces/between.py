"""Path functions of BRDFs between those of a set: the BRDF that is really there, projected on the functions.

Weights w of a set's BRDFs make weights H of functions by a quadratic form, which is exact at each BRDF and in the
middle of each pair of them:

    H(w) = sum_m w_m H_m + sum_m<n w_m w_n 4 (H_mn - (H_m + H_n) / 2)

H_mn is the projection of the BRDF in the middle of m and n. That is the model with the mean of their parameters, as
`jaxprt.dynamic.DynamicBrdf.at` has it; where BRDFs are of no one model, their lobes are moved half way and what the
lobes leave is mixed. So light that is sent to other surfaces is of the material that is seen.
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

_ALL = 64  # BRDFs of a set all of whose pairs count where nothing says which do
_GRAZING = 1e-3  # least cosine that a product with it is divided by


class Moved(eqx.Module):
    """The BRDF in 1/sr that lobes are of.

    Attributes:
        lobe: A table without parameters.
    """

    lobe: LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the BRDF in 1/sr."""
        return self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


def pairs(count: int, navigation: Line | Plane | Columns | None) -> Int[np.ndarray, "p 2"]:
    """Pairs of a set's BRDFs in whose middle there is one: those that a navigation joins.

    Args:
        count: Number of BRDFs in the set.
        navigation: The way through the set. None for all pairs, or none where the set has more than 64 BRDFs.

    Raises:
        ValueError: The navigation is of another number of BRDFs.
    """
    if navigation is None:
        every = itertools.combinations(range(count), 2) if count <= _ALL else ()
        return np.array([*every], int).reshape(-1, 2)
    known = len(navigation.knot if isinstance(navigation, Line) else navigation.point)
    if known != count:
        raise ValueError(f"navigation must be through the set's {count} BRDFs, got one through {known}")
    return navigation.pairs


def middles(
    brdfs: Sequence[Callable], lobe: LobeBrdf | None, pair: Int[np.ndarray, "p 2"]
) -> tuple[list[Callable], list[Callable]]:
    """The BRDF in the middle of each pair; and of lobes also what each BRDF of the set has of them.

    Args:
        brdfs: BRDFs (wi, wo) -> value [*b c] in 1/sr.
        lobe: Their lobes, along the one parameter of the table.
        pair: Numbers of the BRDFs.

    Returns:
        As many as pairs, or none where BRDFs are of no one model and there are no lobes; and as many as BRDFs, where
        they are of no one model and there are lobes.
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
    """Factors of each pair of BRDFs, such that half and half make what is in the middle: `brdf_set.combined`.

    Args:
        factor: Of each BRDF, and of the middle of each pair.
        pair: Numbers of the BRDFs; pairs that are missing are mixed linearly.
        count: Number of BRDFs.
    """
    own, middle = factor[:count], factor[count:]
    mixed = (own[:, None] + own) / 2
    first, second = pair.T
    value = 2 * middle - mixed[first, second]
    return mixed.at[first, second].set(value).at[second, first].set(value)
