"""Transport of scenes whose materials change: for each region of a mesh, what its set of BRDFs requires.

Direct light is projected on the light factors of a region's set, which all BRDFs of the set share, and on a constant
factor for the diffuse part. Visibility for lobes and single texels does not depend on the BRDF. A region with one fixed
BRDF uses the light factors of that BRDF, and stores only the visibility bits for single texels.
"""

import os
import pathlib
from collections.abc import Sequence
from concurrent.futures import Executor

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxprt import require, visibility
from jaxprt.scene.mesh import Mesh
from jaxprt.systems import lobe, separable
from jaxprt.systems.dynamic.brdf_set import BrdfSet
from jaxprt.systems.lobe import LobeTransport, pyramid
from jaxprt.systems.separable import ClusteredTransport, SeparableBrdf
from jaxprt.visibility import StoredVisibility
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

_MEMBERS = 230  # number of vertices of a cluster in a large region
_CLUSTERS = 64  # number of clusters of a smaller region, if each then has at least
_FEWEST = 32  # vertices


class RegionTransport(eqx.Module):
    """Transport of the vertices of one region, in the mesh's order.

    Attributes:
        terms: Transport of the light factors. If the BRDF can change, the last term is the constant one of the diffuse
            part.
        seen: Visibility of each vertex: bits of all texels, and pyramids if the BRDFs have lobes.
        vertex: Index of each vertex in the mesh.
    """

    terms: ClusteredTransport
    seen: LobeTransport
    vertex: Int[Array, " w"]

    @property
    def nbytes(self) -> int:
        """Bytes of the transport."""
        return self.terms.nbytes + self.seen.nbytes


class SetTransport(eqx.Module):
    """Transport of all regions of a mesh.

    Attributes:
        region: Transport of each region, in the order of their numbers.
        place: Index of each vertex of the mesh among the vertices of all regions, concatenated.
        mesh: Fingerprint of the mesh. Bounces of another mesh are refused. Empty if the transport was made by hand.
    """

    region: tuple[RegionTransport, ...]
    place: Int[Array, " v"]
    mesh: str = eqx.field(static=True, default="")

    @property
    def size(self) -> int:
        """Edge of the light's cubemap faces in texels."""
        return self.region[0].seen.size

    @property
    def nbytes(self) -> int:
        """Bytes of all regions."""
        return sum(each.nbytes for each in self.region)


@require.arguments(**PRECOMPUTE)
def precompute_sets(
    mesh: Mesh,
    brdfs: Sequence[BrdfSet | SeparableBrdf],
    *,
    components: int = 24,
    modes: int = 128,
    keep: int = 1024,
    size: int = 64,
    occluder: Mesh | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> SetTransport:
    """Traces the visibility of each vertex, and compresses the transport of the light factors of its region.

    Args:
        mesh: Mesh with the vertices to light.
        brdfs: For each region, in the order of their numbers: a set of BRDFs, or one factored BRDF that cannot change.
        components: Number of principal components over the vertices of a cluster, limited by the number of vertices.
        modes: Number of principal components over the light, shared by all components and terms of a cluster; limited
            by `keep` and by the number of components times terms.
        keep: Number of wavelet coefficients of each cluster.
        size: Edge of the light's cubemap faces in texels, a power of two, at least 8.
        occluder: Mesh that casts shadows: the whole scene, or a simplified one. If None, the mesh itself.
        path: Folder in which finished work is stored. A call that was interrupted resumes from there.
        executor: Executor that computes the blocks of work; all cores of this machine if None.
        progress: Whether to show progress bars.

    Returns:
        The transport: 3 kB of bits for each vertex, another 3 kB of pyramids if there are lobes, and the terms.

    Raises:
        TypeError: `brdfs` is not a sequence, or a BRDF is neither a set nor factored.
        ValueError: There is not one BRDF for each region, light maps differ by color, or for the reasons that
            `jaxprt.visibility.precompute` gives.

    Reference: Sun et al. 2007, sections 3.3 and 4.3, direct lighting.
    """
    if not isinstance(brdfs, Sequence):
        raise TypeError(f"brdfs must be a sequence, one for each region, got {type(brdfs).__name__}")
    numbers = np.unique(np.asarray(mesh.region))
    if len(brdfs) != len(numbers):
        raise ValueError(f"brdfs must be one for each of the regions {numbers.tolist()}, got {len(brdfs)}")
    for brdf in brdfs:
        if not isinstance(brdf, BrdfSet | SeparableBrdf):
            raise TypeError(
                f"each BRDF must be made by jaxprt.dynamic.factor or jaxprt.separable.factor, got {type(brdf).__name__}"
            )
    pyramid.scales(size)
    regions = []
    for number, brdf in zip(numbers.tolist(), brdfs, strict=True):
        vertex = np.flatnonzero(np.asarray(mesh.region) == number)
        folder = None if path is None else pathlib.Path(path) / f"region_{number}"
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        run = Run(folder and folder / "visibility.prt", executor, progress)
        visible = visibility.precompute(mesh, size=size, occluder=occluder, vertex=vertex, run=run)
        at = folder and folder / "clusters.prt"
        each = compress(visible, brdf, components, modes, keep, path=at, executor=executor, progress=progress)
        regions.append(RegionTransport(each.terms, each.seen, jnp.asarray(vertex, jnp.int32)))
    place = np.argsort(np.concatenate([each.vertex for each in regions]))
    return SetTransport(tuple(regions), jnp.asarray(place, jnp.int32), visibility.blocks.scene_key(mesh))


def compress(
    visible: StoredVisibility,
    brdf: BrdfSet | SeparableBrdf,
    components: int,
    modes: int,
    keep: int,
    *,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> RegionTransport:
    """Compresses the transport of one region from its visibility. `vertex` of the result numbers the given vertices.

    Args:
        visible: Visibility of the region's vertices.
        brdf: The region's set of BRDFs, or its one factored BRDF.
        components: Number of principal components over the vertices of a cluster.
        modes: Number of principal components over the light.
        keep: Number of wavelet coefficients of each cluster.
        path: Folder in which finished work is stored.
        executor: Executor that computes the blocks of work; all cores of this machine if None.
        progress: Whether to show progress bars.
    """
    count = len(visible.position)
    factors = light_factors(brdf)
    clusters = max(1, round(count / _MEMBERS), min(_CLUSTERS, count // _FEWEST))
    components = min(components, count // clusters)
    keep = min(keep, visible.texels)
    terms = separable.clustered.precompute(
        visible,
        factors,
        clusters=clusters,
        components=components,
        modes=min(modes, keep, components * factors.terms),
        keep=keep,
        run=Run(path, executor, progress),
    )
    seen = lobe.compress(visible)
    # The diffuse part is a term, so transfer vectors are not needed. Only lobes read the pyramid's means.
    lobes = isinstance(brdf, BrdfSet) and brdf.lobe is not None
    pyramid = seen.pyramid if lobes else seen.pyramid[:, : 6 * seen.size**2 // 8]
    seen = LobeTransport(pyramid, seen.vector[:0], seen.position, seen.frame, seen.size)
    return RegionTransport(terms, seen, jnp.arange(count))


def light_factors(brdf: BrdfSet | SeparableBrdf) -> SeparableBrdf:
    """The light factors that a region's transport is made for. For a set, a constant factor 1 / pi follows them.

    The view maps are all ones, because transport does not depend on them.
    """
    if isinstance(brdf, SeparableBrdf):
        return brdf
    light = jnp.concatenate([brdf.light_map, jnp.full((1, *brdf.light_map.shape[1:]), 1 / np.pi, brdf.light_map.dtype)])
    light = light[..., None]
    return SeparableBrdf(light, jnp.ones_like(light), brdf.error, brdf.coordinates)
