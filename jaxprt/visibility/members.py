"""Clusters of vertices with similar positions and normals, whose transport is factored together."""

import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.decompose import clustering
from jaxprt.visibility import blocks

_CLUSTERS = 0.84  # times the square root of the number of vertices: 160 clusters for 36,000 vertices


def cluster(
    position: Float[Array | np.ndarray, "v 3"], normal: Float[Array | np.ndarray, "v 3"], *, clusters: int
) -> Int[np.ndarray, "p m"]:
    """Indices of each cluster's vertices, by `jaxprt.decompose.clustering.bisect` in position and normal."""
    return clustering.bisect(coordinates(position, normal), clusters=clusters)


def coordinates(
    position: Float[Array | np.ndarray, "v 3"], normal: Float[Array | np.ndarray, "v 3"]
) -> Float[np.ndarray, "v 6"]:
    """Positions and normals of vertices as one array, each centered and scaled to a mean square of one."""
    coordinate = []
    for feature in (np.asarray(position, np.float64), np.asarray(normal, np.float64)):
        offset = feature - feature.mean(0)
        coordinate.append(offset / (np.sqrt(np.mean(offset**2)) or 1.0))
    return np.concatenate(coordinate, 1)


def places(member: Int[np.ndarray, "p m"]) -> Int[np.ndarray, " v"]:
    """Row of each vertex in the concatenation of all clusters. A vertex of several clusters gets its last row."""
    row = member.ravel()
    result = np.zeros(row.max() + 1, np.int32)
    result[row] = np.arange(row.size)
    return result


def clusters_for(vertices: int) -> int:
    """A suitable number of clusters, proportional to the square root of the number of vertices.

    A finer mesh gets more clusters and more vertices in each. With an equal number of components the error then stays
    the same: the clusters of a coarse mesh have fewer vertices, but these are farther apart.
    """
    return max(1, round(_CLUSTERS * vertices**0.5))


class ClusterJob(blocks.Job):
    """A job in which each block is a cluster of vertices.

    Attributes:
        member: Indices of each cluster's vertices.
    """

    member: np.ndarray

    @property
    def vertices(self) -> int:
        """Total number of members of all clusters."""
        return self.member.size

    @property
    def step(self) -> int:
        """Number of members of each cluster."""
        return self.member.shape[1]
