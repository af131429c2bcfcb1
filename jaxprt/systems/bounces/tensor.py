"""Precomputed transfer tensors: the light that arrives at every vertex after one bounce and two.

    I1_x(s) = sum_l L(l) sum_q H(q) T1_x(l, q, s)
    I2_x(s) = sum_l L(l) sum_qp H(q) H(p) T2_x(l, q, p, s)

The tensors hold for any light and any BRDFs. For one bounce the light has 6 x 8 x 8 texels l. It arrives as 16
harmonics s in world directions. q counts the functions of all regions, from `jaxprt.bounces.functions`, and H are their
current weights. For two bounces, off functions q and then p, the light is reduced to 6 x 2 x 2 texels. It arrives
as 16 harmonics too, whereas the paper treats it as uniform over direction. Vertices are clustered, and
the tensor of each cluster is decomposed along vertices and light. `jaxprt.bounces.radiance` computes radiance from it.

A third bounce of this kind would cost as many times the second as there are functions. Bounces after the second are
therefore diffuse light between patches; see `jaxprt.bounces.patches`. The effect of textures on the first two is also
computed by patches.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int

from jaxprt.compile import jit
from jaxprt.systems.bounces.patches import Patches

_FEWER = 2  # ratio of the numbers of components of one bounce and of two
_LEAST = 0.01  # smallest scale of a function, relative to the largest


class SecondBounce(eqx.Module):
    """Light that arrives after two bounces, by clusters of vertices. `weight` carries the scale.

    Attributes:
        weight: Weights of the components of a vertex's cluster, for each row.
        core: For each cluster: texels of the light, components, harmonics, functions of the first and second bounce.
        error: Relative L2 error of each cluster's tensor due to the truncation to components.
    """

    weight: Float[Array, "g m o"]
    core: Float16[Array, "g l o s q q"]
    error: Float[Array, " g"]

    def truncate(self, components: int, *, scale: Float[Array, " q"]) -> "SecondBounce":
        """Keeps the first components. `scale` weights the functions in the new error."""
        core = self.core * (scale[:, None] * scale)
        energy = jnp.sum(core**2, (1, 3, 4, 5)) * jnp.sum(self.weight**2, 1)
        whole = jnp.sum(energy, 1) / jnp.maximum(1 - self.error**2, jnp.finfo(energy.dtype).eps)
        kept = jnp.sum(energy[:, :components], 1)
        error = jnp.where(whole > 0, jnp.sqrt(jnp.maximum(1 - kept / jnp.where(whole > 0, whole, 1), 0)), 0)
        return SecondBounce(self.weight[..., :components], self.core[:, :, :components], error)


class TransferTensor(eqx.Module):
    """Light that arrives after one bounce and two, by clusters of vertices.

    `weight` carries the scale, so that half precision is enough for `core`.

    Attributes:
        weight: Weights of the components of a vertex's cluster, for each row.
        core: For each cluster: modes of the light, components, harmonics and functions.
        mode: Modes of the light of each cluster, over the light's texels.
        place: Row of each vertex.
        region: Number of the region of each vertex.
        area: Surface area that each vertex represents, a third of that of the triangles around it.
        function: Indices of the functions that are kept, among those of all regions.
        factor: For each region, what determines the weights of its functions: the factors of its set, or the weights of
            its one BRDF.
        second: Two bounces; None if not requested, or omitted.
        error: Relative L2 error of each cluster's tensor due to the decomposition, with each function at its largest
            possible weight. It is computed as a difference of squares: values below 5e-4 are rounding.
        worth: Contribution of each bounce for white surfaces under uniform light: RMS irradiance relative to the
            irradiance of an unoccluded surface. Regions with one BRDF use that BRDF. With "all" bounces, the last value
            is that of all bounces after the second together.
        mesh: Fingerprint of the mesh. Transport of another mesh is refused. Empty if the tensor was made by hand.
        patches: Patches that exchange diffuse light, for textures and for bounces after the second; None without.
    """

    weight: Float[Array, "g m n"]
    core: Float16[Array, "g e n s q"]
    mode: Float[Array, "g l e"]
    place: Int[Array, " v"]
    region: Int[Array, " v"]
    area: Float[Array, " v"]
    function: Int[Array, " q"]
    factor: tuple[Float[Array, "..."], ...]
    second: SecondBounce | None
    error: Float[Array, " g"]
    worth: Float[Array, " _"]
    mesh: str = eqx.field(static=True, default="")
    patches: Patches | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the tensors."""
        held = self.weight, self.core, self.mode, self.second, self.patches
        return sum(each.nbytes for each in jax.tree.leaves(held))

    def truncate(self, components: int, *, modes: int) -> "TransferTensor":
        """Keeps the first components and modes of one bounce, and half as many components of two.

        The errors grow accordingly.

        Args:
            components: Number of components to keep.
            modes: Number of modes to keep.

        Raises:
            ValueError: A number is below 1, or above that of the tensor.
        """
        most = self.core.shape[2], self.core.shape[1]
        if not (1 <= components <= most[0] and 1 <= modes <= most[1]):
            raise ValueError(f"components and modes must be at least 1 and at most {most}, got {components}, {modes}")
        weight, core = self.weight[..., :components], self.core[:, :modes, :components]
        energy, whole = _energy(self)
        kept = jnp.sum(energy[:, :modes, :components], (1, 2))
        error = jnp.sqrt(jnp.maximum(1 - kept / jnp.where(whole > 0, whole, 1), 0))
        second = self.second and self.second.truncate(twice(components), scale=scales(self.factor)[self.function])
        same = (self.place, self.region, self.area, self.function, self.factor, second)
        error = jnp.where(whole > 0, error, 0)
        patches = self.patches and self.patches.truncate(components, twice(components))
        return TransferTensor(weight, core, self.mode[..., :modes], *same, error, self.worth, self.mesh, patches)

    def shorten(self, *, error: float | None = None, nbytes: int | None = None) -> "TransferTensor":
        """The smallest tensor within an RMS error, or the most accurate one within a number of bytes.

        Args:
            error: Largest RMS of the clusters' errors. Give this or `nbytes`.
            nbytes: Largest number of bytes.

        Raises:
            ValueError: Neither or both are given, or no numbers of components and modes reach the given one.
        """
        if (error is None) == (nbytes is None):
            raise ValueError(f"give either error or nbytes, got error={error} and nbytes={nbytes}")
        energy, whole = (np.asarray(each, np.float64) for each in _energy(self))
        fraction = energy / np.where(whole > 0, whole, 1)[:, None, None]
        left = np.where(whole[:, None, None] > 0, 1 - fraction.cumsum(1).cumsum(2), 0)
        wrong = np.sqrt(np.maximum(left, 0).mean(0))  # [e, n]
        modes, components = (np.arange(1, n + 1) for n in wrong.shape)
        clusters, _, _, *shape = self.core.shape
        size = 2 * clusters * math.prod(shape) * modes[:, None] * components
        size = size + 4 * self.weight[..., 0].size * components + 4 * self.mode[..., 0].size * modes[:, None]
        if self.second is not None:
            each = self.second.core[:, :, 0].nbytes + self.second.weight[..., 0].nbytes
            held = np.minimum([twice(int(count)) for count in components], self.second.core.shape[2])
            size = size + each * held + self.second.error.nbytes
        if self.patches is not None:
            most = self.core.shape[2]
            size = size + np.array([_patch_bytes(self.patches, int(count), most) for count in components])
        fits = wrong <= error if error is not None else size <= nbytes
        if not fits.any():
            reached = (
                f"error must be at least {wrong.min():.3g}"
                if nbytes is None
                else f"nbytes must be at least {size.min()}"
            )
            raise ValueError(f"{reached}, got {error if nbytes is None else nbytes}")
        cost = np.where(fits, size if nbytes is None else wrong, np.inf)
        mode, component = np.unravel_index(np.argmin(cost), cost.shape)
        return self.truncate(int(component) + 1, modes=int(mode) + 1)


@jit
def _energy(tensor: TransferTensor) -> tuple[Float[Array, "g e n"], Float[Array, " g"]]:
    """Squared norm of each mode and component of a cluster's tensor under natural light, and of the whole tensor."""
    size = jnp.sum(tensor.weight**2, 1)
    energy = jnp.sum((tensor.core * scales(tensor.factor)[tensor.function]) ** 2, (3, 4)) * size[:, None]
    return energy, jnp.sum(energy, (1, 2)) / jnp.maximum(1 - tensor.error**2, jnp.finfo(size.dtype).eps)


def _patch_bytes(patches: Patches, components: int, most: int) -> int:
    """Bytes of the patches with fewer components."""
    if components == most:
        return sum(each.nbytes for each in jax.tree.leaves(patches))
    shape = jax.eval_shape(lambda each: each.truncate(components, twice(components)), patches)
    return sum(each.size * each.dtype.itemsize for each in jax.tree.leaves(shape))


def twice(components: int) -> int:
    """Number of components of two bounces, given that of one bounce."""
    return max(1, components // _FEWER)


def scales(factor: Sequence[Array]) -> Float[Array, " q"]:
    """Largest weight of each function, at least a hundredth of the largest of all: half precision holds both."""
    largest = []
    for each in factor:
        size = jnp.abs(each)
        largest += [jnp.max(size, range(each.ndim - 1)), jnp.ones(1)] if each.ndim > 2 else [jnp.max(size, 1)]
    whole = jnp.concatenate(largest)
    return jnp.maximum(whole, _LEAST * jnp.max(whole, initial=0))
