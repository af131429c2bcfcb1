"""Patches that exchange diffuse light: all bounces after the second, and what textures change in the first two.

    b_3 = rho (e_2 + F d_2),    b = b_3 + rho F b_3 + (rho F)^2 b_3 + ... = (1 - rho F)^-1 b_3

Patches are parts of the clusters of a `jaxprt.bounces.TransferTensor`, each of one region. F holds form factors between
them, from the rays of the bounces; rho is their albedo at present, e_1 and e_2 the irradiance over pi that the tensor
brings them after one bounce and two, e_0 that of the light itself. The tensor has light sent with the mean albedo of a
region. Patches have their own, rho + delta, and send the difference:

    d_1 = delta e_0,    d_2 = delta e_1 + rho F d_1

A vertex receives from the patches what its own form factors say, spread over the directions in which it sees surfaces.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int

from jaxprt import visibility
from jaxprt.decompose import clustering
from jaxprt.files.arrays import Layout
from jaxprt.sphere import cubemap
from jaxprt.systems import separable
from jaxprt.systems.bounces import gather

MOST = 0.9999  # albedo that a sum of all bounces counts, so that it ends in a closed room
LEAST = 2  # vertices of a patch, on the average


class Patches(eqx.Module):
    """Parts of surfaces that exchange diffuse light.

    Attributes:
        factor: Form factors: the share of each vertex's irradiance that each patch sends.
        spread: How light from patches arrives at each vertex: SH coefficients in world directions of radiance that has
            an irradiance of pi, and is the same from all surfaces that the vertex sees.
        patch: The patch of each vertex.
        region: The region of each patch.
        cluster: The cluster of the tensor that each patch is part of.
        between: Form factors from the patches (columns) to the patches (rows).
        light: Irradiance over pi of each patch under radiance of each texel of the light.
        first: Irradiance over pi of each patch, of the components and harmonics that its cluster has of one bounce.
        second: The same of two bounces; None without a second bounce.
        strength: Albedo of the functions of each region, under constant light and over all views. Zero for functions
            that the tensor leaves out.
        bounces: How many there are in all; None for all that bring light.
    """

    factor: Float16[Array, "v j"]
    spread: Float[Array, "v s"]
    patch: Int[Array, " v"]
    region: Int[Array, " j"]
    cluster: Int[Array, " j"]
    between: Float[Array, "j j"]
    light: Float[Array, "j l"]
    first: Float[Array, "j n s"]
    second: Float[Array, "j o s"] | None
    strength: tuple[Float[Array, " _"], ...]
    bounces: int | None = eqx.field(static=True)

    def truncate(self, components: int, again: int) -> "Patches":
        """For the first components of the tensor alone, of one bounce and of two."""
        second = None if self.second is None else self.second[:, :again]
        return eqx.tree_at(
            lambda each: (each.first, each.second), self, (self.first[:, :components], second), is_leaf=_is_none
        )

    def albedo(self, function: Int[Array, " q"], weight: Float[Array, "q d"]) -> Float[Array, "j d"]:
        """Mean albedo of the region of each patch, given the weights of the functions that the tensor keeps."""
        owner = np.repeat(np.arange(len(self.strength)), [len(each) for each in self.strength])
        strength = jnp.concatenate(self.strength)[function, None] * weight
        of_region = jnp.zeros((len(self.strength), weight.shape[1]), weight.dtype)
        return of_region.at[jnp.asarray(owner)[function]].add(strength)[self.region]

    def means(self, value: Float[Array, "v d"], area: Float[Array, " v"]) -> Float[Array, "j d"]:
        """Means over the area of each patch."""
        whole = jnp.zeros(len(self.region), value.dtype).at[self.patch].add(area)
        total = jnp.zeros((len(self.region), value.shape[1]), value.dtype).at[self.patch].add(area[:, None] * value)
        return total / jnp.where(whole > 0, whole, 1)[:, None]

    def sent(
        self,
        mean: Float[Array, "j d"],
        change: Float[Array, "j _"] | None,
        lit: Float[Array, "j c"],
        once: Float[Array, "j e"],
        twice: Float[Array, "j e"] | None,
    ) -> Float[Array, "j e"]:
        """Radiance of each patch that the tensor does not have.

        Args:
            mean: Albedo that the tensor has light sent with.
            change: What the patch's own albedo is more than that; None for none.
            lit: Irradiance over pi by the light itself.
            once: By what has been reflected once.
            twice: By what has been reflected twice; None without a second bounce.
        """
        rho = mean if change is None else mean + change
        result = jnp.zeros_like(once) if change is None else change * lit
        if twice is None:
            return result
        arriving = twice
        if change is not None:
            again = change * once + rho * (self.between @ result)
            result, arriving = result + again, twice + self.between @ again
        if self.bounces is None:
            return result + self.settled(jnp.minimum(rho, MOST), rho * arriving)
        if self.bounces == 2:
            return result
        return result + self.series(rho, rho * arriving, terms=self.bounces - 2)

    def arriving(
        self,
        mean: Float[Array, "j d"],
        change: Float[Array, "j _"] | None,
        lit: Float[Array, "j c"],
        once: Float[Array, "g e n s"],
        twice: Float[Array, "g e o s"] | None,
    ) -> Float[Array, "s _ v"]:
        """SH coefficients, in world directions, of what arrives at each vertex and the tensor does not have.

        Args:
            mean: As in `sent`, and so are `change` and `lit`.
            change: The change of albedo.
            lit: Irradiance over pi by the light itself.
            once: Components and harmonics that each cluster of the tensor has of one bounce.
            twice: The same of two.
        """
        first = jnp.sum(self.first[:, None] * once[self.cluster], (-2, -1))
        second = None
        if twice is not None and self.second is not None:
            second = jnp.sum(self.second[:, None] * twice[self.cluster], (-2, -1))
        return self.received(self.sent(mean, change, lit, first, second))

    def series(self, rho: Float[Array, "j d"], start: Float[Array, "j e"], *, terms: int) -> Float[Array, "j e"]:
        """The first terms of start + rho F start + (rho F)^2 start + ..."""

        def step(carry, _):
            total, last = carry
            last = rho * (self.between @ last)
            return (total + last, last), None

        return jax.lax.scan(step, (start, start), length=terms - 1)[0][0]

    def settled(self, rho: Float[Array, "j d"], start: Float[Array, "j e"]) -> Float[Array, "j e"]:
        """All terms: the solution of b = start + rho F b."""
        matrix = jnp.eye(len(rho), dtype=rho.dtype) - rho.T[:, :, None] * self.between
        if len(matrix) == 1:
            return jnp.linalg.solve(matrix[0], start)
        each = jnp.broadcast_to(start, (len(rho), len(matrix))).T[..., None]
        return jnp.linalg.solve(matrix, each)[..., 0].T

    def received(self, sent: Float[Array, "j e"]) -> Float[Array, "s e v"]:
        """SH coefficients, in world directions, of what arrives at each vertex."""
        # Converted by parts: all at once would be held in single precision.
        step = max(1, len(self.factor) // 16)
        rows = [
            self.factor[first : first + step].astype(sent.dtype) @ sent for first in range(0, len(self.patch), step)
        ]
        return self.spread.T[:, None] * jnp.concatenate(rows).T


def _is_none(value: Any) -> bool:
    return value is None


@dataclass(frozen=True)
class PatchJob(visibility.rays.VisibilityJob):
    """Form factors of blocks of vertices; see `blocks.Job`.

    Attributes:
        patch: The patch of each vertex.
        edge: Edge of the light's faces.
    """

    patch: np.ndarray
    edge: int
    algorithm: ClassVar[dict[str, int]] = {"visibility": visibility.rays.ALGORITHM, "patches": 1}

    @property
    def header(self) -> dict[str, Any]:
        """What the result depends on."""
        made = visibility.blocks.fingerprint(np.asarray(self.patch, np.int64))
        return self.made_by("patches", self.algorithm, patch=made, edge=self.edge)

    @property
    def layout(self) -> dict[str, Layout]:
        """Shapes of one block."""
        block = visibility.rays.BLOCK
        return {
            "factor": Layout((block, int(self.patch.max()) + 1), 0, "float16"),
            "spread": Layout((block, (gather.DEGREE + 1) ** 2), 0, "float32"),
            "light": Layout((block, 6 * self.edge**2), 0, "float16"),
        }

    def run(self, block: int) -> tuple[dict[str, np.ndarray], int]:
        """One block."""
        part = self.part(block)
        normal = self.frame[part, 2]
        point, texel, corner, weight, count = visibility.hits.hits(self.rays, self.start[part], normal, size=self.size)
        share = gather.shares(normal, size=self.size)
        way = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)
        front = visibility.hits.front(self.rays, self.frame[:, 2], corner, way[texel])
        patches = int(self.patch.max()) + 1
        place = point[:, None] * patches + self.patch[corner]
        sent = weight * (front * share[point, texel])[:, None]
        factor = np.bincount(place.ravel(), sent.ravel(), len(part) * patches).reshape(len(part), patches)
        clear = share.copy()
        clear[point, texel] = 0
        fold = self.size // self.edge
        light = clear.reshape(len(part), 6, self.edge, fold, self.edge, fold).sum((3, 5))
        seen = np.flatnonzero(front)
        at, through = point[seen], texel[seen]
        cosine = gather.cosines(normal)
        measure = gather.measures(cosine[at], through, share[at, through], size=self.size)
        spread = np.zeros_like(cosine)
        np.add.at(spread, at, measure)
        whole = factor.sum(1, keepdims=True)
        spread = spread / np.where(whole > 0, whole, 1)
        return {"factor": factor, "spread": spread, "light": light.reshape(len(part), -1)}, count


class Means(NamedTuple):
    """Means over the area of patches, on the host.

    Attributes:
        patch: The patch of each vertex.
        area: Area of each vertex.
        patches: How many there are.
    """

    patch: np.ndarray
    area: np.ndarray
    patches: int

    def of(self, value: Float[np.ndarray, "v k"]) -> Float[np.ndarray, "j k"]:
        """Means of some values."""
        return self._each(lambda own, share: share @ np.asarray(value[own], np.float32), (value.shape[1],))

    def product(self, one: Float[np.ndarray, "v n"], other: Float[np.ndarray, "v s"]) -> Float[np.ndarray, "j n s"]:
        """Means of the products of two kinds of values."""
        shape = one.shape[1], other.shape[1]
        return self._each(
            lambda own, share: np.einsum("v,vn,vs->ns", share, one[own], other[own], optimize=True), shape
        )

    def _each(self, mean: Callable, shape: tuple[int, ...]) -> np.ndarray:
        result = np.zeros((self.patches, *shape), np.float32)
        order = np.argsort(self.patch, kind="stable")
        for number, own in enumerate(np.split(order, np.searchsorted(self.patch[order], np.arange(1, self.patches)))):
            whole = self.area[own].sum()
            result[number] = mean(own, self.area[own] / whole if whole > 0 else self.area[own])
        return result.astype(np.float32)


def divide(
    position: Float[np.ndarray, "v 3"],
    normal: Float[np.ndarray, "v 3"],
    region: Int[np.ndarray, " v"],
    member: Int[np.ndarray, "p m"],
    *,
    patches: int,
) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, " j"], Int[np.ndarray, " j"]]:
    """Divides clusters of vertices into patches, each of one region, whose vertices lie and face alike.

    Args:
        position: Positions of the vertices.
        normal: Their normals.
        region: Their regions.
        member: Vertices of each cluster.
        patches: How many, about: each region has at least one in each cluster.

    Returns:
        The patch of each vertex, and the region and the cluster of each patch.
    """
    coordinate = separable.members.coordinates(position, normal)
    patch, of_region, of_cluster = np.zeros(len(region), np.int32), [], []
    for number, members in enumerate(member):
        members = np.unique(members)
        for each in np.unique(region[members]).tolist():
            own = members[region[members] == each]
            count = min(len(own), max(1, round(patches * len(own) / len(region))))
            for part in clustering.bisect(coordinate[own], clusters=count):
                patch[own[part]] = len(of_region)
                of_region.append(each)
                of_cluster.append(number)
    return patch, np.asarray(of_region, np.int32), np.asarray(of_cluster, np.int32)
