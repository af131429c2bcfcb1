"""Patches that exchange diffuse light, for all bounces after the second and for textures in the first two.

    b_3 = rho (e_2 + F d_2),    b = b_3 + rho F b_3 + (rho F)^2 b_3 + ... = (1 - rho F)^-1 b_3

A patch is a part of a cluster of a `jaxprt.bounces.TransferTensor`, within one region. F holds the form factors between
patches, from the rays of the bounces, and rho is the current albedo of each patch. e_0 is the irradiance over pi of the
patches from the light itself; e_1 and e_2 are those that the tensor gives after one bounce and two. In the tensor, a
surface reflects with the mean albedo of its region, rho - delta. Patches send the difference:

    d_1 = delta e_0,    d_2 = delta e_1 + rho F d_1

A vertex receives light from the patches by its own form factors, distributed over the directions in which it sees
surfaces.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float16, Int

from jaxprt import visibility
from jaxprt.decompose import clustering
from jaxprt.files.arrays import Header, Layout
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, areas
from jaxprt.sphere import cubemap
from jaxprt.systems.bounces import gather
from jaxprt.visibility import members

MOST = 0.9999  # largest albedo in the sum of all bounces, which must converge in a closed room
LEAST = 2  # smallest average number of vertices of a patch


class Patches(eqx.Module):
    """Parts of surfaces that exchange diffuse light.

    Attributes:
        factor: Form factors from patches to vertices: the fraction of each vertex's irradiance that each patch sends.
        spread: Directional distribution of light from patches at each vertex: SH coefficients, in world directions, of
            radiance with an irradiance of pi that is equal from all surfaces that the vertex sees.
        patch: Index of the patch of each vertex.
        region: Region of each patch.
        cluster: Cluster of the tensor that contains each patch.
        between: Form factors from patches (columns) to patches (rows).
        light: Irradiance over pi of each patch under unit radiance of each texel of the light.
        first: Irradiance over pi of each patch for each component and harmonic of its cluster, for one bounce.
        second: The same for two bounces; None without a second bounce.
        strength: Hemispherical albedo of the functions of each region; zero for functions that the tensor omits.
        bounces: Total number of bounces; None for as many as contribute.
        lamp: Irradiance over pi of each patch from each lamp of radiance 1; None without lamps.
    """

    factor: Float16[Array, "v j"]
    spread: Float[Array, "v s"]
    patch: Int[Array, " v"]
    region: Int[Array, " j"]
    cluster: Int[Array, " j"]
    between: Float[Array, "j j"]
    light: Float[Array, "j l"]
    first: Float[Array, "j _ s"]
    second: Float[Array, "j _ s"] | None
    strength: tuple[Float[Array, " _"], ...]
    bounces: int | None = eqx.field(static=True)
    lamp: Float[Array, "j i"] | None = None

    def albedo(self, function: Int[Array, " q"], weight: Float[Array, "q d"]) -> Float[Array, "j d"]:
        """Mean albedo of the region of each patch, given the weights of the functions that the tensor keeps."""
        owner = np.repeat(np.arange(len(self.strength)), [len(strength) for strength in self.strength])
        strength = jnp.concatenate(self.strength)[function, None] * weight
        of_region = jnp.zeros((len(self.strength), weight.shape[1]), weight.dtype)
        return of_region.at[jnp.asarray(owner)[function]].add(strength)[self.region]

    def means(self, value: Float[Array, "v d"], area: Float[Array, " v"]) -> Float[Array, "j d"]:
        """Means of a value of the vertices over the area of each patch."""
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
        """Radiance that each patch sends in addition to the light of the tensor.

        Args:
            mean: Albedo of each patch in the tensor, the mean of its region.
            change: The patch's own albedo minus this mean; None for zero.
            lit: Irradiance over pi from the light itself.
            once: Irradiance over pi of light after one bounce.
            twice: Irradiance over pi of light after two bounces; None without a second bounce.
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
        """SH coefficients, in world directions, of light that arrives at each vertex in addition to that of the tensor.

        Args:
            mean: Albedo of each patch in the tensor, the mean of its region.
            change: The patch's own albedo minus this mean; None for zero.
            lit: Irradiance over pi from the light itself.
            once: Components and harmonics of each cluster after one bounce.
            twice: Components and harmonics of each cluster after two bounces; None without a second bounce.
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
        """The sum of all terms: the solution of b = start + rho F b."""
        matrix = jnp.eye(len(rho), dtype=rho.dtype) - rho.T[:, :, None] * self.between
        if len(matrix) == 1:
            return jnp.linalg.solve(matrix[0], start)
        right = jnp.broadcast_to(start, (len(rho), len(matrix))).T[..., None]
        return jnp.linalg.solve(matrix, right)[..., 0].T

    def received(self, sent: Float[Array, "j e"]) -> Float[Array, "s e v"]:
        """SH coefficients, in world directions, of the light that arrives at each vertex from all patches."""
        # Convert in parts, so that the whole matrix is never in memory in single precision.
        step = max(1, len(self.factor) // 16)
        rows = [
            self.factor[first : first + step].astype(sent.dtype) @ sent for first in range(0, len(self.patch), step)
        ]
        return self.spread.T[:, None] * jnp.concatenate(rows).T


@dataclass(frozen=True)
class PatchJob(visibility.rays.VisibilityJob):
    """Form factors of blocks of vertices; see `blocks.Job`.

    Attributes:
        patch: Index of the patch of each vertex.
        edge: Edge of the light's faces.
    """

    patch: np.ndarray
    edge: int
    algorithm: ClassVar[dict[str, int]] = {"visibility": visibility.rays.ALGORITHM, "patches": 1}

    @property
    def header(self) -> Header:
        """What the result depends on."""
        patch = visibility.blocks.fingerprint(np.asarray(self.patch, np.int64))
        return self.made_by("patches", self.algorithm, patch=patch, edge=self.edge)

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
        point, texel, corner, weight, count = visibility.rays.hemisphere_hits(
            self.rays, self.start[part], normal, size=self.size
        )
        share = gather.shares(normal, size=self.size)
        way = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)
        front = visibility.rays.hits_front(self.rays, self.frame[:, 2], corner, way[texel])
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
    """Means over the area of patches, in NumPy.

    Attributes:
        patch: Index of the patch of each vertex.
        area: Area of each vertex.
        patches: Number of patches.
    """

    patch: np.ndarray
    area: np.ndarray
    patches: int

    def of(self, value: Float[np.ndarray, "v k"]) -> Float[np.ndarray, "j k"]:
        """Means of values of the vertices."""
        return self._over(lambda vertex, share: share @ np.asarray(value[vertex], np.float32), (value.shape[1],))

    def product(self, one: Float[np.ndarray, "v n"], other: Float[np.ndarray, "v s"]) -> Float[np.ndarray, "j n s"]:
        """Means of the products of two kinds of values."""
        shape = one.shape[1], other.shape[1]
        return self._over(
            lambda vertex, share: np.einsum("v,vn,vs->ns", share, one[vertex], other[vertex], optimize=True), shape
        )

    def _over(self, mean: Callable, shape: tuple[int, ...]) -> np.ndarray:
        result = np.zeros((self.patches, *shape), np.float32)
        order = np.argsort(self.patch, kind="stable")
        ends = np.searchsorted(self.patch[order], np.arange(1, self.patches))
        for number, vertex in enumerate(np.split(order, ends)):
            area = self.area[vertex]
            result[number] = mean(vertex, area / area.sum() if area.sum() > 0 else area)
        return result.astype(np.float32)


class DiffuseExchange(NamedTuple):
    """Diffuse light between patches, in NumPy: an estimate of what surfaces reflect onto each other.

    Attributes:
        factor: Form factors from patches to vertices.
        light: Irradiance over pi of each vertex under unit radiance of each texel of the light.
        mean: Means over the patches.
        region: Region of each patch.
    """

    factor: Float[np.ndarray, "v j"]
    light: Float[np.ndarray, "v l"]
    mean: "Means"
    region: Int[np.ndarray, " j"]

    def lit(self, environment: Environment) -> Float[np.ndarray, "v c"]:
        """Irradiance over pi of each vertex from an environment."""
        return self.light @ np.asarray(cubemap.coarse(environment.radiance, edge=math.isqrt(self.light.shape[1] // 6)))

    def reflected(
        self, source: Float[np.ndarray, "v c"], albedo: Float[np.ndarray, "j c"], *, bounces: int
    ) -> list[Float[np.ndarray, "v c"]]:
        """Irradiance over pi of each vertex: the given one, and what arrives after each bounce.

        Args:
            source: Irradiance over pi from the light itself.
            albedo: Albedo of each patch.
            bounces: Number of bounces.
        """
        result = [source]
        for _ in range(bounces):
            result.append(self.factor @ (albedo * self.mean.of(result[-1])))
        return result


def exchange(mesh: Mesh, *, patches: int, size: int, edge: int) -> DiffuseExchange:
    """Traces the light that patches of a mesh exchange.

    Args:
        mesh: The whole scene.
        patches: Approximate number of patches.
        size: Edge of the cubemap faces through whose texels rays are traced.
        edge: Edge of the light's faces, a divisor of `size`.
    """
    position, normal = (np.asarray(column, np.float64) for column in (mesh.position, mesh.normal))
    region = np.searchsorted(np.unique(mesh.region), mesh.region)
    whole = np.arange(len(position))[None]
    count = min(patches, max(1, len(position) // LEAST))
    patch, of_region, _ = divide(position, normal, region, whole, patches=count)
    job = PatchJob.make(mesh, None, None, size, patch=patch, edge=edge)
    traced = visibility.blocks.compute(job, visibility.Run(progress=False), label="patches")
    factor, light = (traced[name].astype(np.float32) for name in ("factor", "light"))
    return DiffuseExchange(factor, light, Means(patch, areas(mesh), len(of_region)), of_region)


def divide(
    position: Float[np.ndarray, "v 3"],
    normal: Float[np.ndarray, "v 3"],
    region: Int[np.ndarray, " v"],
    member: Int[np.ndarray, "p m"],
    *,
    patches: int,
) -> tuple[Int[np.ndarray, " v"], Int[np.ndarray, " j"], Int[np.ndarray, " j"]]:
    """Divides clusters of vertices into patches of neighboring vertices with similar normals, each within one region.

    Args:
        position: Positions of the vertices.
        normal: Normals of the vertices.
        region: Regions of the vertices.
        member: Vertices of each cluster.
        patches: Approximate number of patches. Each region has at least one in each cluster.

    Returns:
        The patch of each vertex, and the region and the cluster of each patch.
    """
    coordinate = members.coordinates(position, normal)
    patch, of_region, of_cluster = np.zeros(len(region), np.int32), [], []
    for number, vertex in enumerate(member):
        vertex = np.unique(vertex)
        for owner in np.unique(region[vertex]).tolist():
            inside = vertex[region[vertex] == owner]
            count = min(len(inside), max(1, round(patches * len(inside) / len(region))))
            for part in clustering.bisect(coordinate[inside], clusters=count):
                patch[inside[part]] = len(of_region)
                of_region.append(owner)
                of_cluster.append(number)
    return patch, np.asarray(of_region, np.int32), np.asarray(of_cluster, np.int32)
