"""Published lobes: fixed widths around the mirror direction; and the rest of a BRDF, for low-rank terms."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.compile import jit
from jaxprt.decompose import mixture
from jaxprt.systems.lobe import em
from jaxprt.systems.lobe import table as lobe_table
from jaxprt.systems.lobe.table import LobeBrdf

_GRAZING = 1e-3


def mirror_lobes(brdf: Callable, *, angles: tuple[int | float, ...] = (0, 7, 14, 21), resolution: int = 32) -> LobeBrdf:
    """Fits lobes of fixed widths around the mirror direction to BRDF x cosine.

    A lobe of k degrees is a Gaussian with three standard deviations in k degrees. 0 degrees is the perfect mirror,
    represented by a lobe of an eighth of a degree. EM finds the weights of the lobes for each view and color, together
    with that of a uniform density above the horizon, which represents the rest and is not part of the table. Samples
    are those of `lobe.tabulate`, dense around the mirror direction and only above the horizon, so EM compares the parts
    of lobes above the horizon. Weights in the table are those of whole lobes, as in all tables.

    Args:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        angles: Angle of each lobe in degrees.
        resolution: Number of view angle nodes. Anisotropic BRDFs have maps with half this edge.

    Returns:
        A table of lobes without a diffuse part. `Remainder` is the rest of the BRDF, which may be negative.

    Raises:
        ValueError: There are no angles, an angle is negative, or the BRDF returns values that are negative or not
            finite.

    Reference: Sun et al. 2007, section 4.1.
    """
    if not angles or min(angles) < 0:
        raise ValueError(f"angles must be at least one, none below 0, got {angles}")
    wo, (sample, mass, _, extent) = lobe_table.brdf_samples(brdf, resolution=resolution)
    width = np.radians(np.asarray(angles, np.float64)) / 3
    concentration = (1 / np.maximum(width**2, 1 / em.FINEST)).astype(wo.dtype)
    mean, scale, weight, diffuse = _mirror_lobes(wo, sample, mass, extent, concentration)
    return LobeBrdf(mean, scale, weight, diffuse, (), jax.device_put(np.asarray(np.nan, wo.dtype)))


@jit
def _mirror_lobes(
    wo: Array, sample: Array, mass: Array, extent: Array, concentration: Array
) -> tuple[Array, Array, Array, Array]:
    """Directions, logarithms of concentrations, weights, and zero diffuse albedos at the view nodes `wo` [*q 3]."""
    nodes, mean, count = wo.shape[:-1], em.mirror(wo.reshape(-1, 3)), len(concentration)

    def one(argument):
        sample, mass, extent, mean = argument
        every = jnp.broadcast_to(mean, (count, 3))
        rest = jnp.full((len(sample), 1), -np.log(2 * np.pi), sample.dtype)
        density = mixture.log_density(sample, every, concentration)
        above = 4 * np.pi * extent @ jnp.exp(density)  # part above the horizon; at least half of each lobe
        density = jnp.concatenate([density - jnp.log(above), rest], 1)
        start = jnp.ones(count + 1, sample.dtype)
        found = jax.vmap(lambda m: mixture.weigh(density, m, start, steps=200)[0], in_axes=1)(mass)
        return found[:, :-1] / above

    weight = jnp.moveaxis(jax.lax.map(one, (sample, mass, extent, mean)), 0, -1)
    table = jnp.broadcast_to(mean.T[:, None], (3, count, len(mean))).reshape(3, -1, *nodes)
    scale = jnp.broadcast_to(jnp.log(concentration)[:, None], (count, len(mean))).reshape(-1, *nodes)
    weight = weight.reshape(*weight.shape[:2], *nodes)
    return table, scale, weight, 0 * weight[:, 0]


class Remainder(eqx.Module):
    """The difference of a BRDF and its lobes, for low-rank terms. It is a BRDF whose values may be negative.

    Attributes:
        brdf: BRDF (wi, wo) -> value [*b c] in 1/sr on local directions.
        lobe: Table of its lobes, including the diffuse part.
    """

    brdf: Callable
    lobe: LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value in 1/sr: the BRDF minus the lobes divided by the cosine of wi, which is clamped to at least 0.001."""
        return self.brdf(wi, wo) - self.lobe(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


class BrdfSet(eqx.Module):
    """A set of gray BRDFs of one model, as the channels of one BRDF.

    Attributes:
        model: The model; its parameters have a leading axis along the set.
    """

    model: Callable

    @classmethod
    def of(cls, brdfs: Sequence[Callable]) -> "BrdfSet":
        """The set of some BRDFs of one class."""
        return cls(jax.tree.map(lambda *leaf: jnp.stack(leaf), *brdfs))

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b m"]:
        """Values in 1/sr, one for each BRDF of the set."""
        return jnp.moveaxis(jax.vmap(lambda brdf: brdf(wi, wo))(self.model)[..., 0], 0, -1)


class SetMember(eqx.Module):
    """One channel of a BRDF, as a gray BRDF.

    Attributes:
        brdf: BRDF (wi, wo) -> value [*b m].
        number: Index of the channel.
    """

    brdf: Callable
    number: Int[Array, ""]

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b 1"]:
        """Value in 1/sr."""
        return self.brdf(wi, wo)[..., self.number, None]
