"""How to make a part of a scene ready for a system: the sizes, and the calls that they take."""

import dataclasses
import functools
import os
import pathlib
from collections.abc import Callable
from concurrent.futures import Executor
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt import visibility
from jaxprt.brdf import Lambert
from jaxprt.relit.channels import Shading
from jaxprt.relit.kept import kept
from jaxprt.scene import Mesh
from jaxprt.systems import bright_texels, harmonic, lobe, separable
from jaxprt.systems.lobe import LobeTransport
from jaxprt.systems.protocol import System
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.visibility import StoredVisibility

_HARMONIC_SIZE = 32  # texels along an edge of the visibility: as many as low degrees need
_STEPS = 4  # of harmonics for one of lobes, from knot to knot
_VARYING = 0.02  # error of tables of harmonics of which roughness varies
_DIFFUSE = 32  # times as many single texels for what is ideally diffuse


class Known:
    """What several recipes for one part share, made when one of them needs it first.

    Attributes:
        visible: What the vertices see.
    """

    def __init__(self, visible: StoredVisibility):
        """Keeps the visibility."""
        self.visible = visible
        self._factored: dict[int, SeparableBrdf] = {}

    @functools.cached_property
    def pyramid(self) -> LobeTransport:
        """The pyramids of the visibility."""
        return lobe.compress(self.visible)

    def factored(self, brdf: Callable, terms: int, resolution: int) -> SeparableBrdf:
        """The part's BRDF in terms: the first of those that were made already, if these are enough."""
        made = self._factored.get(resolution)
        if made is None or made.terms < terms:
            made = self._factored[resolution] = separable.factor(brdf, terms=terms, resolution=resolution)
        return made.truncate(terms)


@dataclasses.dataclass(frozen=True)
class Target:
    """What a part is made ready for, and where that is done.

    Attributes:
        occluder: What casts shadows: all parts.
        size: Edge of the light's cubemap faces in texels.
        vertex: Numbers of the vertices to light; all if None.
        known: What is known already. `Lobes` and `Clusters` then trace no rays; others do.
        path: What the names of folders begin with; None keeps nothing.
        executor: Where blocks are computed; this machine's cores if None.
        progress: Whether to show progress bars.
    """

    occluder: Mesh
    size: int = 64
    vertex: np.ndarray | None = None
    known: "Known | None" = None
    path: str | os.PathLike | None = None
    executor: Executor | None = None
    progress: bool = True

    def options(self, name: str) -> dict:
        """Options of every `precompute`, for a folder of a name."""
        path = None if self.path is None else pathlib.Path(f"{self.path}_{name}.prt")
        return {"path": path, "executor": self.executor, "progress": self.progress}

    def traced(self) -> dict:
        """Options of those that trace rays."""
        return {"occluder": self.occluder, "vertex": self.vertex}


@runtime_checkable
class Recipe(Protocol):
    """Sizes for one system, and how a part is made ready with them."""

    def make(self, shading: Shading, target: Target) -> System:
        """The system of a part."""
        ...


class Lobes(eqx.Module):
    """The lobe system, with the brightest texels summed exactly.

    Attributes:
        lobes: Lobes of the BRDF.
        texels: Brightest texels that are summed one by one; 0 for none. What is ideally diffuse, for which a texel
            costs a thirtieth, has 32 times as many: shadows of all lamps.
    """

    lobes: int = 12
    texels: int = 16

    def make(self, shading: Shading, target: Target) -> System:
        """The system of a part."""
        if target.known is None:
            transport = lobe.precompute(shading.mesh, size=target.size, **target.traced(), **target.options("lobe"))
        else:
            transport = target.known.pyramid
        if isinstance(shading.brdf, Lambert):
            vectors = harmonic.TransferVector(transport.vector[:, None], transport.position)
            matte = harmonic.DiffuseSystem(vectors, shading.brdf.albedo)
            return _bright(matte, lobe.texel_bits(transport), shading, _DIFFUSE * self.texels, transport.size)
        path = None if target.path is None else pathlib.Path(f"{target.path}_table_{self.lobes}.prt")
        table = lobe_table(shading, self.lobes, path)
        return _bright(lobe.LobeSystem(transport, table), transport, shading, self.texels, transport.size)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Bytes of the pyramids, or of bits and vectors."""
        if isinstance(shading.brdf, Lambert):
            return vertices * (6 * size**2 // 8 + 4 * (lobe.pyramid.DEGREE + 1) ** 2)
        return vertices * lobe.pyramid.scales(size).total


class Harmonics(eqx.Module):
    """The harmonic system: transfer vectors for what is ideally diffuse, matrices for all else.

    The name "harmonic" stands for `laplacian=0.4`. Visibility is traced at 6 x 32 x 32 texels at most.

    Attributes:
        degree: Highest degree of the harmonics.
        laplacian: Share of the light's squared Laplacian that is kept for what is not diffuse; 1 for no window.
    """

    degree: int = 4
    laplacian: float = 1.0

    def make(self, shading: Shading, target: Target) -> System:
        """The system of a part."""
        options = {"degree": self.degree, "size": min(target.size, _HARMONIC_SIZE), **target.traced()}
        if isinstance(shading.brdf, Lambert):
            vectors = harmonic.precompute_diffuse(shading.mesh, **options, **target.options(f"vectors_{self.degree}"))
            return harmonic.DiffuseSystem(vectors, shading.brdf.albedo)
        table = harmonic_table(shading, degree=self.degree)
        matrices = harmonic.precompute(shading.mesh, **options, **target.options(f"matrices_{self.degree}"))
        return harmonic.HarmonicSystem(matrices, table, self.laplacian)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Bytes of the vectors or matrices."""
        terms = (self.degree + 1) ** 2
        return 4 * vertices * (terms if isinstance(shading.brdf, Lambert) else terms**2)


class Terms(eqx.Module):
    """The separable system with sparse transport.

    Attributes:
        terms: BRDF terms; what is ideally diffuse has one.
        keep: Wavelet coefficients of each vertex and term.
        resolution: Edge of the terms' maps in texels.
    """

    terms: int = 4
    keep: int = 96
    resolution: int = 48

    def make(self, shading: Shading, target: Target) -> System:
        """The system of a part."""
        check(self, shading)
        terms = 1 if isinstance(shading.brdf, Lambert) else self.terms
        factored = separable.factor(shading.brdf, terms=terms, resolution=self.resolution)
        keep = min(self.keep, 6 * target.size**2)
        options = {"keep": keep, "size": target.size, **target.traced(), **target.options("separable")}
        return separable.SeparableSystem(separable.precompute(shading.mesh, factored, **options), factored)


class Clusters(eqx.Module):
    """The separable system compressed over clusters of vertices, with the brightest texels summed exactly.

    Attributes:
        terms: BRDF terms.
        resolution: Edge of their maps in texels.
        components: Principal components along the vertices of a cluster.
        modes: Principal components along the light.
        keep: Wavelet coefficients of each cluster.
        texels: Brightest texels that are summed one by one.
        members: Vertices of a cluster, about.
    """

    terms: int = 32
    resolution: int = 64
    components: int = 16
    modes: int = 80
    keep: int = 768
    texels: int = 16
    members: int = 225

    def make(self, shading: Shading, target: Target) -> System:
        """The system of a part."""
        check(self, shading)
        known = target.known
        if known is None:
            options = {**target.traced(), **target.options("visibility")}
            known = Known(visibility.precompute(shading.mesh, size=target.size, **options))
        visible = known.visible
        clusters, terms, sizes = self._sizes(shading, len(visible.position), visible.size)
        factored = known.factored(shading.brdf, terms, self.resolution)
        options = {**sizes, **target.options("clusters")}
        transport = separable.clustered.precompute(visible, factored, clusters=clusters, **options)
        system = separable.SeparableSystem(transport, factored)
        return _bright(system, lobe.bits(known.pyramid), shading, self.texels, visible.size)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Bytes of the visibility of single texels, weights, cores, modes, and gray maps."""
        clusters, terms, sizes = self._sizes(shading, vertices, size)
        components, modes, keep = sizes.values()
        bits = 6 * size**2 // 8 if self.texels else 0
        maps = 2 * 4 * terms * self.resolution**2
        return vertices * (bits + 4 * components) + 2 * clusters * modes * (keep + components * terms) + maps

    def _sizes(self, shading: Shading, vertices: int, size: int) -> tuple[int, int, dict[str, int]]:
        """Clusters, terms, and options of the compression, as far as vertices and texels allow them."""
        clusters = max(1, round(vertices / self.members))
        terms = 1 if isinstance(shading.brdf, Lambert) else self.terms
        components, keep = min(self.components, vertices // clusters), min(self.keep, 6 * size**2)
        modes = min(self.modes, keep, components * terms)
        return clusters, terms, {"components": components, "modes": modes, "keep": keep}


SYSTEMS: dict[str, Recipe] = {
    "harmonic": Harmonics(laplacian=0.4),
    "lobe": Lobes(),
    "separable": Terms(),
}


def _bright(system: System, visible, shading: Shading, texels: int, size: int) -> System:
    """A system with single texels, if any are asked for."""
    texels = min(texels, 6 * size * size - 1)
    if not texels:
        return system
    sharpest: Callable = shading.brdf(jnp.asarray(shading.knot[0][0])) if shading.knot else shading.brdf
    samples = bright_texels.samples_for(sharpest, size=size)
    return bright_texels.BrightTexels(system, visible, shading.brdf, count=texels, samples=samples)


def lobe_table(shading: Shading, lobes: int, path: pathlib.Path | None) -> lobe.LobeBrdf:
    """The BRDF of a part in lobes, over its roughness if that varies; kept in a folder if one is given."""
    key = shading.brdf, shading.knot, lobes
    return kept(path, key, lambda: lobe.tabulate(shading.brdf, lobes=lobes, knot=shading.knot))


def harmonic_table(shading: Shading, *, degree: int) -> harmonic.HarmonicBrdf:
    """The BRDF of a part in harmonics, over its roughness if that varies."""
    if not shading.knot:
        return harmonic.tabulate(shading.brdf, degree=degree)
    # Lobes between knots move and widen; harmonics are interpolated linearly, and need more knots.
    return harmonic.tabulate(shading.brdf, degree=degree, knot=tuple(map(_finer, shading.knot)), error=_VARYING)


def _finer(knot: np.ndarray) -> np.ndarray:
    """Evenly spaced knots, with as many steps in place of one as harmonics need."""
    return np.linspace(knot[0], knot[-1], _STEPS * (len(knot) - 1) + 1)


def check(recipe: Recipe, shading: Shading) -> None:
    """Refuses a part that a recipe cannot make.

    Raises:
        ValueError: The roughness of the part varies, and the recipe factors one BRDF.
    """
    if shading.knot and isinstance(recipe, Terms | Clusters):
        low, high = np.exp([shading.knot[0][0], shading.knot[0][-1]])
        raise ValueError(
            f"the separable system must have one roughness for all vertices, got a texture from {low:.2f} to "
            f"{high:.2f}: take the lobe or the harmonic system"
        )
