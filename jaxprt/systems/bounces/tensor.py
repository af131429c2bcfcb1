"""Precomputed transfer tensors: the light that arrives at every vertex after one bounce and two.

    I1_x(s) = sum_l L(l) sum_q H(q) T1_x(l, q, s)
    I2_x(s) = sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)

The tensors hold for any light and any BRDFs. For one bounce the light has 6 x 8 x 8 texels l. It arrives as 16
harmonics s in world directions. q counts the functions of all regions, from `jaxprt.bounces.functions`, and H are their
current weights. For two bounces, off functions q and then p, the light is reduced to 6 x 2 x 2 texels. It arrives
as 16 harmonics too, whereas the paper treats it as uniform over direction. Vertices are clustered, and
the tensor of each cluster is decomposed along vertices and light.

A third bounce of this kind would cost as many times the second as there are functions. Bounces after the second are
therefore diffuse light between patches; see `jaxprt.bounces.patches`. The effect of textures on the first two is also
computed by patches.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Float16, Int

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
    def nbytes(self) -> int:
        """Bytes of the tensors."""
        held = self.weight, self.core, self.mode, self.second, self.patches, self.lamp
        return sum(each.nbytes for each in jax.tree.leaves(held))


def twice(components: int) -> int:
    """Number of components of two bounces, given that of one bounce."""
    return max(1, components // _FEWER)


def scales(factor: Sequence[Array]) -> Float[Array, " q"]:
    """Largest weight of each function, at least a hundredth of the largest of all: half precision holds both."""
    whole = jnp.concatenate([jnp.max(jnp.abs(weight), 1) for weight in factor])
    return jnp.maximum(whole, _LEAST * jnp.max(whole, initial=0))
