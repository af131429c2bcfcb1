"""Transport of scenes whose materials change: what each region of a mesh needs for the BRDFs that it can have.

Direct light meets the light factors of a region's set of BRDFs, which all of the set share, and a constant one for its
diffuse part; what the vertices see, for lobes and single texels, serves any BRDF. A region with one BRDF that does not
change has the light factors of that one, and of visibility only the bits that single texels are lit by.
"""

import os
import pathlib
from collections.abc import Sequence
from concurrent.futures import Executor

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxprt import visibility
from jaxprt.scene.mesh import Mesh
from jaxprt.systems import lobe, separable
from jaxprt.systems.dynamic.brdf_set import DynamicBrdf
from jaxprt.systems.lobe import LobeTransport
from jaxprt.systems.separable import ClusteredTransport, SeparableBrdf
from jaxprt.visibility import StoredVisibility

_MEMBERS = 230  # vertices of a cluster in a large region
_CLUSTERS = 64  # of a smaller one, as long as they have
_FEWEST = 32  # vertices


class RegionTransport(eqx.Module):
    """Transport of the vertices of one region, in the mesh's order.

    Attributes:
        terms: Of the light factors; the last term is constant, for the diffuse part, where BRDFs change.
        seen: What each vertex sees: bits of all texels, and pyramids where the BRDFs have lobes.
        vertex: Number of each vertex in the mesh.
    """

    terms: ClusteredTransport
    seen: LobeTransport
    vertex: Int[Array, " w"]

    @property
    def nbytes(self) -> int:
        """Bytes of the transport."""
        return self.terms.nbytes + self.seen.nbytes


class DynamicTransport(eqx.Module):
    """Transport of all regions of a mesh.

    Attributes:
        region: Transport of each region, in the order of their numbers.
        place: Of each vertex of the mesh, its number among the vertices of all regions one after another.
        mesh: Fingerprint of the mesh, by which bounces of another one are refused; empty if made by hand.
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


def precompute(
    mesh: Mesh,
    brdfs: Sequence[DynamicBrdf | SeparableBrdf],
    *,
    components: int = 24,
    modes: int = 128,
    keep: int = 1024,
    size: int = 64,
    occluder: Mesh | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> DynamicTransport:
    """Traces what each vertex sees, and compresses what that makes of the light factors of its region.

    Args:
        mesh: The vertices to light.
        brdfs: Of each region, in the order of their numbers: a set, or the one BRDF that it has for good, factored.
        components: Principal components along the vertices of a cluster, or as many as it has.
        modes: Principal components along the light, which all components and terms of a cluster share; likewise.
        keep: Wavelets of each cluster.
        size: Edge of the light's cubemap faces in texels, a power of two, at least 8.
        occluder: What casts shadows: the whole scene, or a simplified one; the mesh itself if None.
        path: Folder that keeps what is finished; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show progress bars.

    Returns:
        The transport; 3 kB of bits a vertex, 3 kB more of pyramids where there are lobes, and the terms.

    Raises:
        TypeError: `brdfs` is no sequence, or one of them neither a set nor factored.
        ValueError: Not one BRDF for each region, light maps per color, or as in `jaxprt.visibility.precompute`.

    Reference: Sun et al. 2007, sections 3.3 and 4.3, direct lighting.
    """
    if not isinstance(brdfs, Sequence):
        raise TypeError(f"brdfs must be a sequence, one for each region, got {type(brdfs).__name__}")
    numbers = np.unique(np.asarray(mesh.region))
    if len(brdfs) != len(numbers):
        raise ValueError(f"brdfs must be one for each of the regions {numbers.tolist()}, got {len(brdfs)}")
    for brdf in brdfs:
        if not isinstance(brdf, DynamicBrdf | SeparableBrdf):
            raise TypeError(
                "each BRDF must be a set, by jaxprt.dynamic.factor, or factored, by "
                f"jaxprt.separable.factor, got {type(brdf).__name__}"
            )
    lobe.pyramid.scales(size)
    regions = []
    for number, brdf in zip(numbers.tolist(), brdfs, strict=True):
        vertex = np.flatnonzero(np.asarray(mesh.region) == number)
        folder = None if path is None else pathlib.Path(path) / f"region_{number}"
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        visible = visibility.precompute(
            mesh,
            size=size,
            occluder=occluder,
            vertex=vertex,
            path=folder and folder / "visibility.prt",
            executor=executor,
            progress=progress,
        )
        at = folder and folder / "clusters.prt"
        each = compress(visible, brdf, components, modes, keep, path=at, executor=executor, progress=progress)
        regions.append(RegionTransport(each.terms, each.seen, jnp.asarray(vertex, jnp.int32)))
    place = np.argsort(np.concatenate([each.vertex for each in regions]))
    return DynamicTransport(tuple(regions), jnp.asarray(place, jnp.int32), visibility.blocks.scene_key(mesh))


def compress(
    visible: StoredVisibility,
    brdf: DynamicBrdf | SeparableBrdf,
    components: int,
    modes: int,
    keep: int,
    *,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> RegionTransport:
    """The same of one region whose visibility is known; `vertex` then counts the vertices of that.

    The arguments are those of `precompute`.
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
        path=path,
        executor=executor,
        progress=progress,
    )
    seen = lobe.compress(visible)
    # The diffuse part is a term: no transfer vectors. Without lobes nothing reads means.
    lobes = isinstance(brdf, DynamicBrdf) and brdf.lobe is not None
    pyramid = seen.pyramid if lobes else seen.pyramid[:, : 6 * seen.size**2 // 8]
    seen = LobeTransport(pyramid, seen.vector[:0], seen.position, seen.frame, seen.size)
    return RegionTransport(terms, seen, jnp.arange(count))


def light_factors(brdf: DynamicBrdf | SeparableBrdf) -> SeparableBrdf:
    """What a region's transport is made for: the light factors of its BRDFs; of a set's, with a constant 1 / pi last.

    The view maps are ones: no transport depends on them.
    """
    if isinstance(brdf, SeparableBrdf):
        return brdf
    light = jnp.concatenate([brdf.light_map, jnp.full((1, *brdf.light_map.shape[1:]), 1 / np.pi, brdf.light_map.dtype)])
    light = light[..., None]
    return SeparableBrdf(light, jnp.ones_like(light), brdf.error, brdf.coordinates)
