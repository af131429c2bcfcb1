"""Clusters of vertices that lie and face alike, which are decomposed together."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.decompose import clustering
from jaxprt.visibility import blocks

_CLUSTERS = 0.84  # for one vertex: 160 for 36,000


def cluster(
    position: Float[Array | np.ndarray, "v 3"], normal: Float[Array | np.ndarray, "v 3"], *, clusters: int
) -> Int[np.ndarray, "p m"]:
    """Vertices of each cluster, alike in position and normal, by `jaxprt.decompose.clustering.bisect`."""
    return clustering.bisect(coordinates(position, normal), clusters=clusters)


def coordinates(
    position: Float[Array | np.ndarray, "v 3"], normal: Float[Array | np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 6"]:
    """Positions and normals in comparable units: each with a mean square of one."""
    coordinate = []
    for each in (np.asarray(position, np.float64), np.asarray(normal, np.float64)):
        offset = each - each.mean(0)
        coordinate.append(offset / (np.sqrt(np.mean(offset**2)) or 1.0))
    return np.concatenate(coordinate, 1)


def places(member: Int[np.ndarray, "p m"]) -> Int[np.ndarray, " v"]:
    """A row of each vertex among the members of all clusters, one after another; those in several are in the last."""
    row = member.ravel()
    result = np.zeros(row.max() + 1, np.int32)
    result[row] = np.arange(row.size)
    return result


def clusters_for(vertices: int) -> int:
    """How many clusters suit a number of vertices: as many as its square root, about.

    On finer meshes there are both more of them, and more vertices in each. The error then stays the same with equal
    components: fewer vertices in the clusters of coarse meshes make up for how far apart they are.
    """
    return max(1, round(_CLUSTERS * vertices**0.5))


class ClusterJob(blocks.Job):
    """A job whose blocks are clusters.

    Attributes:
        member: Vertices of each cluster.
    """

    member: np.ndarray

    @property
    def vertices(self) -> int:
        """Number of members of all clusters."""
        return self.member.size

    @property
    def step(self) -> int:
        """Number of members of a cluster."""
        return self.member.shape[1]
