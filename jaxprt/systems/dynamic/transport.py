"""Transport for BRDFs that change: the light factors, compressed by clusters of vertices, and visibility for lobes."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxprt import require, visibility
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import hemisphere
from jaxprt.systems import lobe, separable
from jaxprt.systems.dynamic.table import DynamicBrdf
from jaxprt.systems.lobe import LobeTransport
from jaxprt.systems.separable import ClusteredTransport, SeparableBrdf
from jaxprt.visibility import StoredVisibility
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

_MEMBERS = 230  # number of vertices of a cluster in a large mesh
_CLUSTERS = 64  # number of clusters of a smaller mesh, if each then has at least
_FEWEST = 32  # vertices


class DynamicTransport(eqx.Module):
    """Transport of vertices whose BRDF may change.

    Attributes:
        terms: Transport of the light factors. The last term is the constant one, for the diffuse part.
        pyramid: Visibility pyramids for the lobes.
    """

    terms: ClusteredTransport
    pyramid: LobeTransport

    @property
    def position(self) -> Float[Array, "v 3"]:
        """Vertex positions in world units."""
        return self.pyramid.position

    @property
    def frame(self) -> Float[Array, "v 3 3"]:
        """Shading frame of each vertex; rows are tangent, bitangent, normal."""
        return self.pyramid.frame

    @property
    def size(self) -> int:
        """Edge of the light's cubemap faces in texels."""
        return self.pyramid.size

    @property
    def nbytes(self) -> int:
        """Bytes of the terms and of the visibility."""
        return self.terms.nbytes + self.pyramid.nbytes


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    brdf: DynamicBrdf,
    *,
    components: int = 24,
    modes: int = 128,
    keep: int = 1024,
    size: int = 64,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    run: Run = Run(),
) -> DynamicTransport:
    """Traces the visibility of each vertex, and compresses the transport of the light factors of a BRDF.

    Args:
        mesh: Mesh with the vertices to light.
        brdf: The BRDF, from `tabulate`. Without a tensor, the transport serves any other one without a tensor.
        components: Number of principal components over the vertices of a cluster, limited by the number of vertices.
        modes: Number of principal components over the light, shared by all components and terms of a cluster; limited
            by `keep` and by the number of components times terms.
        keep: Number of wavelet coefficients of each cluster.
        size: Edge of the light's cubemap faces in texels, a power of two, at least 8.
        occluder: Mesh that casts shadows: the whole scene, or a simplified one. If None, the mesh itself.
        vertex: Indices of the vertices to precompute; all if None.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        The transport: 6 kB of pyramids for each vertex, and the terms.

    Raises:
        TypeError: The BRDF was not made by `tabulate`.
        ValueError: For the reasons that `jaxprt.visibility.precompute` gives.

    Reference: Sun et al. 2007, sections 3.3 and 4.3, direct lighting.
    """
    require.kind("the BRDF", brdf, DynamicBrdf, source="jaxprt.dynamic.tabulate")
    lobe.pyramid.scales(size)
    where = {"size": size, "occluder": occluder, "vertex": vertex}
    visible = visibility.precompute(mesh, **where, run=run.within("visibility.prt"))
    sizes: Any = {"components": components, "modes": modes, "keep": keep}
    return compress(visible, brdf, **sizes, run=run.within("clusters.prt"))


@require.arguments(**PRECOMPUTE)
def compress(
    visible: StoredVisibility,
    brdf: DynamicBrdf,
    *,
    components: int = 24,
    modes: int = 128,
    keep: int = 1024,
    pyramid: LobeTransport | None = None,
    run: Run = Run(),
) -> DynamicTransport:
    """Compresses the transport of some vertices from their visibility; see `precompute`.

    Args:
        visible: Visibility of the vertices.
        brdf: The BRDF.
        components: Number of principal components over the vertices of a cluster.
        modes: Number of principal components over the light.
        keep: Number of wavelet coefficients of each cluster.
        pyramid: The visibility pyramids, if they exist already.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.
    """
    factors = light_factors(brdf)
    clusters, sizes = clustering(len(visible.position), factors.terms, visible.texels, components, modes, keep)
    terms = separable.clustered.precompute(visible, factors, clusters=clusters, **sizes, run=run)
    return DynamicTransport(terms, lobe.compress(visible) if pyramid is None else pyramid)


def clustering(
    vertices: int, terms: int, texels: int, components: int, modes: int, keep: int
) -> tuple[int, dict[str, Any]]:
    """Number of clusters, and sizes of the compression, limited by what there is."""
    clusters = max(1, round(vertices / _MEMBERS), min(_CLUSTERS, vertices // _FEWEST))
    components, keep = min(components, vertices // clusters), min(keep, texels)
    return clusters, {"components": components, "modes": min(modes, keep, components * terms), "keep": keep}


def light_factors(brdf: DynamicBrdf) -> SeparableBrdf:
    """The light factors that the transport is made for, followed by the constant 1 / pi of the diffuse part.

    The view maps are all ones, because transport does not depend on them.
    """
    constant = jnp.full((1, *brdf.light_map.shape[1:]), 1 / np.pi, brdf.light_map.dtype)
    light = jnp.concatenate([brdf.light_map, constant])[..., None]
    return SeparableBrdf(light, jnp.ones_like(light), brdf.error, hemisphere.parabolic_coordinates)
