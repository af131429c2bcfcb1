"""Recipes: a system and its parameters, and the calls that precompute the system for one part of a scene."""

import abc
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt import require, visibility
from jaxprt.relit.channels import Shading
from jaxprt.scene import Mesh
from jaxprt.systems import axes, bright_texels, dynamic, harmonic, light_cells, lobe, separable, standard
from jaxprt.systems.lobe import LobeTransport, diffuse, pyramid
from jaxprt.systems.protocol import System
from jaxprt.systems.separable import SeparableBrdf
from jaxprt.systems.standard import StandardTable
from jaxprt.visibility import Run, StoredVisibility

_HARMONIC_SIZE = 32  # edge of the visibility's faces in texels: enough for low degrees
_STEPS = 4  # number of intervals of a harmonic table for each interval of a lobe table
_VARYING = 0.02  # error of harmonic tables over roughness
_WIDE = 2  # most places along the edge of a bright texel for the roughest material that has cells
_PAIRS = 256  # pairs of directions at which BRDFs are tried
_HALF = {"normal_texture": "turn highlights by half of its angle, and diffuse light not at all"}


class Known:
    """Intermediate results that several recipes for one part share. Each is computed when it is first needed.

    Attributes:
        visible: Visibility of the vertices.
    """

    def __init__(self, visible: StoredVisibility):
        """Stores the visibility."""
        self.visible = visible
        self._factored: dict[int, SeparableBrdf] = {}

    @functools.cached_property
    def pyramid(self) -> LobeTransport:
        """The visibility pyramids of the vertices."""
        return lobe.compress(self.visible)

    def factored(self, brdf: Callable, terms: int, resolution: int) -> SeparableBrdf:
        """The BRDF of the part, factored into terms. An earlier factorization is truncated if it has enough terms."""
        longest = self._factored.get(resolution)
        if longest is None or longest.terms < terms:
            longest = self._factored[resolution] = separable.factor(brdf, terms=terms, resolution=resolution)
        return longest.truncate(terms)


@dataclasses.dataclass(frozen=True)
class Target:
    """What a recipe needs besides the part itself: occluders, vertices, and where and how to compute.

    Attributes:
        occluder: Mesh that casts shadows: all parts of the scene.
        size: Edge of the light's cubemap faces in texels.
        vertex: Indices of the vertices to precompute; all if None.
        known: Intermediate results that exist already. `Lobes` and `Clusters` then trace no rays; other recipes ignore
            it.
        run: Folder of the results of the part, executor and progress bars.
    """

    occluder: Mesh
    size: int = 64
    vertex: np.ndarray | None = None
    known: "Known | None" = None
    run: Run = Run()

    def traced(self, name: str) -> dict:
        """Keyword arguments of the `precompute` functions that trace rays, with a folder of the given name."""
        return {"occluder": self.occluder, "vertex": self.vertex, "run": self.run.within(f"{name}.prt")}


class Recipe(eqx.Module):
    """The parameters of a system, and the method that precomputes it for parts of one kind.

    A system of another package has a recipe too: a subclass with `make`, and with what else differs from here.

    Attributes:
        joins: Whether parts with one BRDF share a system. Otherwise each part has a system for its BRDF alone.
        classes: Further data classes of another package that files of its systems and recipes hold.
    """

    joins: ClassVar[bool] = True
    classes: ClassVar[tuple[type, ...]] = ()

    @abc.abstractmethod
    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of all vertices of the shading's mesh, padded to a number of vertices.

        Args:
            shading: The parts as one mesh, with their BRDF.
            target: Occluders, and where and how to compute.
            vertices: Number of vertices of the result, of which those after the mesh's repeat the last one; None for
                the mesh's. `jaxprt.systems.axes.pad` pads transport.
        """

    def coarse(self) -> "Recipe | None":
        """The recipe of a preview, which takes little longer than its rays; None if there is none."""
        return None

    def takes(self, table: StandardTable) -> bool:
        """Whether the system reads a standard table; otherwise parts have BRDFs of their own."""
        return False

    def check(self, shading: Shading) -> None:
        """Refuses a part that the system does not support, before rays are traced.

        Raises:
            ValueError: The system does not support the part.
        """

    def omits(self, shading: Shading) -> Mapping[str, str]:
        """Fields of `TexturedMaterial` that the system does not show as they are, and what it shows in their place.

        `precompute` warns of parts that have them. The coat, the sheen and the anisotropy that a part loses are named
        by `jaxprt.relit.channels.of_part`, which takes them out of its material.
        """
        return {}

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Smallest number of bytes of the system for a number of vertices and an edge of the light's faces."""
        return 0

    def steps(self, shading: Shading) -> Sequence["Recipe"]:
        """Recipes of increasing size that the planner tries for a part; none if it is not to try any."""
        return (self,)


class Lobes(Recipe):
    """Recipe of the lobe system. Single texels of the light are summed exactly, and cells for rough and matte parts.

    Attributes:
        lobes: Number of lobes of the BRDF.
        texels: Number of brightest texels that are summed one by one; 0 for none, and for no cells.
    """

    lobes: int = 8
    texels: int = 16

    def coarse(self) -> Recipe:
        """The recipe itself."""
        return self

    def takes(self, table: StandardTable) -> bool:
        """Whether a table with this number of lobes is shipped."""
        return self.lobes in table.counts

    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of all vertices of the shading's mesh, padded to a number of vertices."""
        transport = axes.pad(_pyramid(shading.mesh, target), vertices)
        if shading.matte:
            matte = lobe.MatteSystem(lobe.matte_transport(transport), shading.albedo)
            return _bright(matte, lobe.texel_bits(transport), shading, self.texels, transport.size, cells=True)
        table = lobe_table(shading, self.lobes)
        system = lobe.LobeSystem(transport, table)
        return _bright(system, transport, shading, self.texels, transport.size, cells=True)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Smallest number of bytes: transfer vectors, and visibility as pyramids, or as bits for a Lambertian part."""
        if shading.matte:
            return vertices * (6 * size**2 // 8 + diffuse.count(size))
        return vertices * (pyramid.scales(size).total + diffuse.count(size))

    def steps(self, shading: Shading) -> Sequence[Recipe]:
        """More lobes and texels from step to step; none for a Lambertian part, for which harmonics take fewer bytes."""
        return () if shading.matte else _LOBES


class Harmonics(Recipe):
    """Recipe of the harmonic system: transfer vectors for Lambertian parts, transfer matrices for all others.

    The system named "harmonic" is `Harmonics(laplacian=0.4)`. Visibility is traced at no more than 6 x 32 x 32 texels.

    Attributes:
        degree: Highest degree of the spherical harmonics.
        laplacian: Fraction of the light's squared Laplacian that windowing keeps, to reduce ringing. 1 means no window.
            Not used for Lambertian parts.
    """

    degree: int = 4
    laplacian: float = 1.0

    def coarse(self) -> Recipe:
        """The recipe itself."""
        return self

    def takes(self, table: StandardTable) -> bool:
        """Whether a table of this degree is shipped."""
        return self.degree <= standard.tables.DEGREE

    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of all vertices of the shading's mesh, padded to a number of vertices."""
        matte = shading.matte
        trace = harmonic.precompute_diffuse if matte else harmonic.precompute
        store = f"{'vectors' if matte else 'matrices'}_{self.degree}"
        size, options = min(target.size, _HARMONIC_SIZE), target.traced(store)
        whole: Any = trace(shading.mesh, degree=self.degree, size=size, apart=True, **options)
        transport = axes.pad(whole, vertices)
        if shading.matte:
            return harmonic.DiffuseSystem(transport, shading.albedo)
        return harmonic.HarmonicSystem(transport, harmonic_table(shading, degree=self.degree), self.laplacian)

    def omits(self, shading: Shading) -> Mapping[str, str]:
        """Half of the angle of normal maps of glossy parts; ideally diffuse ones show all of it."""
        return {} if shading.matte else _HALF

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Number of bytes of the transfer vectors or matrices."""
        terms = (self.degree + 1) ** 2
        return 4 * vertices * (terms if shading.matte else terms**2)

    def steps(self, shading: Shading) -> Sequence[Recipe]:
        """Higher degrees from step to step."""
        return _DIFFUSE if shading.matte else _HARMONIC


class _OneBrdf(Recipe):
    """A recipe that factors a single BRDF."""

    joins: ClassVar = False

    def check(self, shading: Shading) -> None:
        """Refuses a part whose roughness varies."""
        if shading.knot:
            low, high = np.exp([shading.knot[0][0], shading.knot[0][-1]])
            raise ValueError(
                f"the separable system must have one roughness for all vertices, got a texture from {low:.2f} to "
                f"{high:.2f}: use the lobe or the harmonic system"
            )

    def omits(self, shading: Shading) -> Mapping[str, str]:
        """Normal maps of ideally diffuse parts, and half of their angle of glossy ones."""
        return {"normal_texture": "look flat"} if shading.matte else _HALF


class Terms(_OneBrdf):
    """Recipe of the separable system with sparse wavelet transport.

    Attributes:
        terms: Number of BRDF terms; a Lambertian part has one.
        keep: Number of wavelet coefficients of each vertex and term.
        resolution: Edge of the maps of the terms in texels.
    """

    terms: int = 4
    keep: int = 96
    resolution: int = 48

    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of a part."""
        check(self, shading)
        terms = 1 if shading.matte else self.terms
        factored = separable.factor(shading.brdf, terms=terms, resolution=self.resolution)
        keep = min(self.keep, 6 * target.size**2)
        options = {"keep": keep, "size": target.size, **target.traced("separable")}
        return separable.SeparableSystem(separable.precompute(shading.mesh, factored, **options), factored)

    def steps(self, shading: Shading) -> Sequence[Recipe]:
        """Those of the system that is compressed over clusters."""
        return () if shading.matte else _CLUSTERS


class Clusters(_OneBrdf):
    """Recipe of the separable system, compressed over clusters of vertices. The brightest texels are summed exactly.

    Attributes:
        terms: Number of BRDF terms.
        resolution: Edge of the maps of the terms in texels.
        components: Number of principal components over the vertices of a cluster.
        modes: Number of principal components over the light.
        keep: Number of wavelet coefficients of each cluster.
        texels: Number of brightest texels that are summed one by one.
        members: Approximate number of vertices of a cluster.
    """

    terms: int = 32
    resolution: int = 64
    components: int = 16
    modes: int = 80
    keep: int = 768
    texels: int = 16
    members: int = 225

    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of a part."""
        check(self, shading)
        known = target.known
        if known is None:
            known = Known(visibility.precompute(shading.mesh, size=target.size, **target.traced("visibility")))
        visible = known.visible
        clusters, terms, sizes = self._sizes(shading, len(visible.position), visible.size)
        factored = known.factored(shading.brdf, terms, self.resolution)
        options = {**sizes, "run": target.run.within("clusters.prt")}
        transport = separable.clustered.precompute(visible, factored, clusters=clusters, **options)
        system = separable.SeparableSystem(transport, factored)
        return _bright(system, pyramid.bits(known.pyramid), shading, self.texels, visible.size)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Number of bytes of the texels' visibility, the weights, cores and modes, and the maps of a gray BRDF."""
        clusters, terms, sizes = self._sizes(shading, vertices, size)
        components, modes, keep = sizes.values()
        bits = 6 * size**2 // 8 if self.texels else 0
        maps = 2 * 4 * terms * self.resolution**2
        return vertices * (bits + 4 * components) + 2 * clusters * modes * (keep + components * terms) + maps

    def _sizes(self, shading: Shading, vertices: int, size: int) -> tuple[int, int, dict[str, int]]:
        """Number of clusters, number of terms, and options of the compression, limited by the vertices and texels."""
        clusters = max(1, round(vertices / self.members))
        terms = 1 if shading.matte else self.terms
        components, keep = min(self.components, vertices // clusters), min(self.keep, 6 * size**2)
        modes = min(self.modes, keep, components * terms)
        return clusters, terms, {"components": components, "modes": modes, "keep": keep}


class Dynamic(Recipe):
    """Recipe of the dynamic system: lobes, and a tensor for what they leave. The brightest texels are summed exactly.

    A Lambertian part has the system of `Lobes`.

    Attributes:
        lobes: Number of lobes of the BRDF; 0 for none.
        ranks: Ranks of the tensor: of the BRDFs, the view and the light; None for no tensor. Transport grows with the
            last one.
        components: Number of principal components over the vertices of a cluster.
        modes: Number of principal components over the light.
        keep: Number of wavelet coefficients of each cluster.
        texels: Number of brightest texels that are summed one by one.
    """

    lobes: int = 12
    ranks: tuple[int, int, int] | None = eqx.field(default=standard.tables.RANKS, converter=lambda x: x and tuple(x))
    components: int = 24
    modes: int = 128
    keep: int = 1024
    texels: int = 16

    def __check_init__(self):
        """Refuses numbers that no system has."""
        require.count("lobes", self.lobes, least=0)
        if self.ranks is not None:
            if len(self.ranks) != 3:
                raise ValueError(f"ranks must be three, of the BRDFs, the view and the light, got {self.ranks}")
            for rank in self.ranks:
                require.count("each rank", rank, least=1)
        elif not self.lobes:
            raise ValueError("the dynamic system needs lobes, or ranks of a tensor, or both; got neither")
        for name in ("components", "modes", "keep"):
            require.count(name, getattr(self, name), least=1)
        require.count("texels", self.texels, least=0)

    def coarse(self) -> Recipe | None:
        """The same lobes without the tensor."""
        return Lobes(self.lobes, self.texels) if self.lobes else None

    def takes(self, table: StandardTable) -> bool:
        """Whether tables with this number of lobes and these ranks are shipped."""
        return table.has_tensor(self.lobes, self.ranks)

    def make(self, shading: Shading, target: Target, *, vertices: int | None = None) -> System:
        """Precomputes the system of all vertices of the shading's mesh, padded to a number of vertices."""
        if shading.matte:
            return Lobes(texels=self.texels).make(shading, target, vertices=vertices)
        known = target.known
        if known is None:
            known = Known(visibility.precompute(shading.mesh, size=target.size, **target.traced("visibility")))
        brdf = dynamic_table(shading, self.lobes, self.ranks)
        sizes = {"components": self.components, "modes": self.modes, "keep": self.keep}
        name = "" if self.ranks is None else "_" + "_".join(map(str, (self.lobes, *self.ranks)))
        options = {**sizes, "run": target.run.within(f"dynamic{name}.prt")}
        transport = axes.pad(dynamic.compress(known.visible, brdf, pyramid=known.pyramid, **options), vertices)
        system = dynamic.DynamicSystem(transport, brdf)
        return _bright(system, transport.pyramid, shading, self.texels, target.size, cells=True)

    def least_bytes(self, shading: Shading, *, vertices: int, size: int) -> int:
        """Number of bytes of the visibility, the weights of the components, the cores and the modes."""
        if shading.matte:
            return Lobes(texels=self.texels).least_bytes(shading, vertices=vertices, size=size)
        terms = 1 + (self.ranks[2] if self.ranks else 0)
        sizes = self.components, self.modes, self.keep
        clusters, most = dynamic.transport.clustering(vertices, terms, 6 * size**2, *sizes)
        shared = 2 * clusters * most["modes"] * (most["keep"] + most["components"] * terms)
        seen = pyramid.scales(size).total + diffuse.count(size)
        return vertices * (seen + 4 * most["components"]) + shared

    def steps(self, shading: Shading) -> Sequence[Recipe]:
        """None: the planner chooses among systems of fewer bytes."""
        return ()


# What the planner tries, by increasing size. The parameters of each step contribute errors of similar size.
_DIFFUSE = tuple(Harmonics(degree=degree) for degree in (2, 3, 4, 6, 8))
_HARMONIC = tuple(Harmonics(degree=degree) for degree in (2, 3, 4))
_LOBES = tuple(Lobes(*step) for step in ((2, 4), (4, 8), (8, 16), (12, 16), (16, 32), (24, 64)))
_CLUSTERS = tuple(
    Clusters(*step)
    for step in (
        (2, 64, 4, 8, 192, 2),
        (4, 64, 8, 24, 256, 4),
        (8, 64, 8, 32, 384, 4),
        (16, 64, 12, 48, 512, 8),
        (32, 64, 16, 80, 768, 16),
        (48, 64, 16, 96, 1024, 16),
        (64, 64, 24, 128, 1024, 32),
        (96, 96, 32, 192, 1536, 64),
        (128, 96, 48, 256, 1536, 64),
        (192, 96, 64, 384, 2048, 128),
    )
)


def _pyramid(mesh: Mesh, target: Target) -> LobeTransport:
    """The visibility pyramids of a mesh."""
    if target.known is not None:
        return target.known.pyramid
    return lobe.precompute(mesh, size=target.size, apart=True, **target.traced("lobe"))


def _bright(system: System, visible: Any, shading: Shading, texels: int, size: int, *, cells: bool = False) -> System:
    """The system with an exact sum over the brightest texels, if there are any, and over cells of the light."""
    texels = min(texels, 6 * size * size - 1)
    if not texels:
        return system
    samples, cells = samples_of(shading, size), cells and size > light_cells.WIDEST
    by_lobes = cells and samples > 1  # Lobes narrower than cells read light and visibility within them.
    if by_lobes and not (isinstance(system, lobe.LobeSystem) and samples_of(shading, size, roughest=True) <= _WIDE):
        cells = by_lobes = False
    options = {"samples": samples, "cells": cells, "by_lobes": by_lobes}
    return bright_texels.BrightTexels(system, visible, shading.brdf, count=texels, **options)


def samples_of(shading: Shading, size: int, *, roughest: bool = False) -> int:
    """Number of points along the edge of a bright texel at which the BRDF of a part is evaluated.

    Args:
        shading: The part.
        size: Edge of the light's faces in texels.
        roughest: Whether that is for the largest roughness of the part, not for the smallest one.
    """
    if shading.matte:
        return 1
    if shading.table is not None:
        return shading.table.samples(shading.roughest if roughest else shading.smoothest, size)
    end = -1 if roughest else 0
    chosen: Callable = shading.brdf(jnp.asarray(shading.knot[0][end])) if shading.knot else shading.brdf
    return bright_texels.samples_for(chosen, size=size)


def lobe_table(shading: Shading, lobes: int, *, system: System | None = None) -> lobe.LobeBrdf:
    """The BRDF of a part as a table of lobes, over roughness if that varies: that of its system where it has one."""
    rest = system.system if isinstance(system, bright_texels.BrightTexels) else system
    if isinstance(rest, lobe.LobeSystem):
        return rest.brdf
    if shading.table is not None:
        counts = shading.table.counts
        return shading.table.lobes(lobes if lobes in counts else min(counts, key=lambda count: abs(count - lobes)))
    return lobe.tabulate(shading.brdf, lobes=lobes, knot=shading.knot)


def dynamic_table(shading: Shading, lobes: int, ranks: tuple[int, int, int] | None) -> dynamic.DynamicBrdf:
    """The BRDF of a part as lobes and a tensor, over roughness if that varies."""
    if shading.table is not None:
        return shading.table.tensor(lobes, ranks)
    return dynamic.tabulate(shading.brdf, lobes=lobes, ranks=ranks, knot=shading.knot)


def harmonic_table(shading: Shading, *, degree: int) -> harmonic.HarmonicBrdf:
    """The BRDF of a part as a table of harmonics, over roughness if that varies."""
    if shading.table is not None:
        return shading.table.harmonics(degree)
    if not shading.knot:
        return harmonic.tabulate(shading.brdf, degree=degree)
    # Lobes are moved and widened between knots. Harmonics are interpolated linearly, so they need more knots.
    return harmonic.tabulate(shading.brdf, degree=degree, knot=tuple(map(_finer, shading.knot)), error=_VARYING)


def _finer(knot: np.ndarray) -> np.ndarray:
    """Evenly spaced knots over the same range, with `_STEPS` intervals in place of one."""
    return np.linspace(knot[0], knot[-1], _STEPS * (len(knot) - 1) + 1)


def check(recipe: Recipe, shading: Shading) -> None:
    """Refuses a part that a recipe does not support.

    Raises:
        ValueError: The recipe refuses the part, or the part has a BRDF that returns values that are negative, not
            finite, or without an axis of colors.
    """
    if shading.blend is None:
        _check_values(shading.exact)
    recipe.check(shading)


def _check_values(brdf: Callable) -> None:
    """Refuses a BRDF by its values at some pairs of directions."""
    random = np.random.default_rng(0).normal(size=(2, _PAIRS, 3))
    random[..., 2] = np.abs(random[..., 2])
    wi, wo = jnp.asarray(random / np.linalg.norm(random, axis=-1, keepdims=True), jnp.result_type(float))
    value = np.asarray(brdf(wi, wo))
    require.real("the values of the BRDF", value)
    if value.ndim != 2 or len(value) != _PAIRS:
        raise ValueError(f"the BRDF must return [{_PAIRS}, c] for {_PAIRS} directions, got {list(value.shape)}")
    if value.shape[1] not in (1, 3):
        raise ValueError(f"the BRDF of a part must have 1 or 3 colors, got {value.shape[1]}")
    wrong = np.flatnonzero(~(np.isfinite(value) & (value >= 0)).all(1))
    if wrong.size:
        raise ValueError(
            f"the BRDF must be finite and not negative, got {value[wrong[0]]} for wi = {np.asarray(wi)[wrong[0]]}, "
            f"wo = {np.asarray(wo)[wrong[0]]}"
        )
