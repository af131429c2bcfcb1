"""Relit scenes at reduced resolution, as exported pages contain them."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt.compile import put
from jaxprt.relit.channels import Shading
from jaxprt.relit.groups import Place
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment
from jaxprt.sphere import cubemap
from jaxprt.systems import axes, bright_texels, dynamic, harmonic, lobe
from jaxprt.systems.lobe import diffuse, pyramid
from jaxprt.systems.lobe.blurred_light import LobeLight
from jaxprt.systems.protocol import System
from jaxprt.view import matrices

_LIGHT = 32  # texels along a face's edge of the light that lobes are looked up in
_TEXELS = 64  # number of brightest texels that are summed one by one
_DEGREE = 6  # of the harmonics by which diffuse parts are lit
_GRAZING = 1e-3
_KNOTS = 64  # most knots of a table's parameter

Exported = lobe.LobeSystem | harmonic.DiffuseSystem | harmonic.HarmonicSystem


class CoarseTransport(lobe.LobeTransport):
    """Visibility without its finest scales, for a light of another size.

    Attributes:
        vector: Transfer vectors in spherical harmonics.
        edge: Texels along a face's edge of the visibility.
        spread: Width of the finest remaining scale.
    """

    vector: Float[Array, "lm v"]
    edge: int = eqx.field(static=True)
    spread: float = eqx.field(static=True)

    def lobe_visibility(self, face, s, t, spread, points=None):
        """Visible fraction of each vertex's lobes, from the remaining scales."""
        none = jnp.zeros((0, len(self.position)), jnp.uint8)
        whole = lobe.LobeTransport(self.pyramid, none, self.position, self.frame, self.edge)
        return whole.lobe_visibility(face, s, t, jnp.maximum(spread, self.spread), points)


class CoarseSystem(lobe.LobeSystem):
    """A lobe system that reduces the resolution of its light, and lights diffuse parts by harmonics."""

    def light(self, environment: Environment) -> LobeLight:
        """The light at reduced resolution, blurred for lobes."""
        light = super().light(resized(environment, size=self.transport.size))
        coefficient = harmonic.project(environment, degree=_DEGREE)
        return dataclasses.replace(light, coefficient=coefficient)


class CentralTexels(bright_texels.BrightTexels):
    """A system that samples bright texels at their centers, also for a BRDF that varies over a texel."""

    def combine(self, light: bright_texels.BrightLight, view: bright_texels.BrightView) -> Float[Array, "v c"]:
        """Radiance: that of the underlying system plus that of the bright texels."""
        return bright_texels.BrightTexels.combine(dataclasses.replace(self, samples=1), light, view)


class LobesAlone(eqx.Module):
    """The part of a BRDF that its lobes represent, in 1/sr.

    Attributes:
        table: Table of the lobes.
    """

    table: lobe.LobeBrdf

    def __call__(self, wi: Float[Array, "*b 3"], wo: Float[Array, "*b 3"]) -> Float[Array, "*b c"]:
        """Value of the lobes divided by the cosine, which is at least 0.001."""
        return self.table(wi, wo) / jnp.maximum(wi[..., 2:], _GRAZING)


def coarse(scene: RelitScene, level: int, *, texels: bool, degree: int | None = None) -> RelitScene:
    """A scene as an exported page contains it: no bounces, coarser visibility, and vectors and matrices as bytes.

    Args:
        scene: The scene.
        level: Finest scale of visibility, as `jaxprt.systems.lobe.pyramid.scales` numbers them.
        texels: Whether the brightest texels of the light are summed one by one, on the parts that support it.
        degree: Highest degree of the transfer matrices; None keeps their degree.
    """
    whole = [axes.mapped(system, lambda _, leaf: put(leaf)) for system in _systems(scene)]
    systems = [_exported(part.name, system) for part, system in zip(scene.scene.parts, whole, strict=True)]
    vectors = [vectors_of(system) for system in systems]
    visible = [matrices.truncated(matrix, degree) for matrix in visibility_of(scene)]
    unit, visible_unit = vector_unit(vectors), vector_unit(visible)
    coarse_systems: list[System] = []
    for system, vector, seen_in_part in zip(systems, vectors, visible, strict=True):
        part_unit = visible_unit[: len(seen_in_part), None]
        if isinstance(system, harmonic.HarmonicSystem):
            coarse_systems.append(matrices.reduced(system, np.round(seen_in_part / part_unit) * part_unit))
            continue
        step = unit[: len(vector), None]
        rounded = jnp.asarray(np.round(vector / step) * step, jnp.result_type(float))
        if isinstance(system, harmonic.DiffuseSystem):
            coarse_systems.append(eqx.tree_at(lambda s: s.transport.vector, system, rounded[:, None]))
            continue
        old = system.transport
        size, least = min(_LIGHT, old.size), float(pyramid.scales(old.size).spread[level])
        seen = CoarseTransport(old.pyramid, rounded, old.position, old.frame, size, old.size, least)
        coarse_systems.append(CoarseSystem(seen, system.brdf))
    bits = bits_of(scene) if texels else None
    if bits is not None:
        pairs = zip(coarse_systems, whole, scene.shading, bits, strict=True)
        coarse_systems = [
            system if words is None else _with_texels(system, full, shading) for system, full, shading, words in pairs
        ]
    counts = [len(part.mesh.position) for part in scene.scene.parts]
    alone = [[number] for number in range(len(counts))]
    return RelitScene(scene.scene, scene.shading, Place.of(counts, alone, [False] * len(counts)), coarse_systems)


def _systems(scene: RelitScene) -> list[System]:
    """The system of each part."""
    return [scene.part_system(number) for number in range(len(scene.scene.parts))]


def _with_texels(system: System, full: System, shading: Shading) -> System:
    """A system that sums the brightest texels of the light one by one, each at its center."""
    assert isinstance(full, bright_texels.BrightTexels)
    brdf = shading.brdf
    if isinstance(system, lobe.LobeSystem) and shading.blend is None:
        brdf = LobesAlone(system.brdf)
    return CentralTexels(system, full.visibility, brdf, count=texels_of(full.visibility.size))


def texels_of(size: int) -> int:
    """Number of texels of a light that are summed one by one."""
    return min(_TEXELS, 6 * size**2 - 1)


def bits_of(scene: RelitScene) -> list[UInt8[np.ndarray, "v n"] | None] | None:
    """Visibility of single texels for each part, None for parts without; None if a lobe part or every part lacks it."""
    result = [_bits(system) for system in _systems(scene)]
    lobes = [isinstance(system, lobe.LobeSystem) for system in systems_of(scene)]
    missing = [words is None for words in result]
    if all(missing) or any(np.logical_and(missing, lobes)):
        return None
    return result


def _bits(system: System) -> UInt8[np.ndarray, "v n"] | None:
    if not isinstance(system, bright_texels.BrightTexels) or isinstance(system.system, harmonic.HarmonicSystem):
        return None
    seen = system.visibility
    if isinstance(seen, pyramid.TexelBits):
        return np.asarray(seen.bit).T
    if isinstance(seen, lobe.LobeTransport):
        return np.asarray(seen.pyramid)[:, : 6 * seen.size**2 // 8]
    return None


def resized(light: Environment, *, size: int) -> Environment:
    """A light at reduced resolution: means over groups of texels.

    Args:
        light: The light.
        size: Texels along a face's edge, a divisor of the light's own.
    """
    large = light.radiance.shape[-2]
    area = jnp.asarray(cubemap.solid_angle(size=large))[..., None]
    folded = (6, size, large // size, size, large // size, -1)
    value, whole = (values.reshape(folded).sum((2, 4)) for values in (light.radiance * area, area))
    return Environment(value / whole)


def systems_of(scene: RelitScene) -> list[Exported]:
    """The systems of the parts without single texels. Refuses systems that an exported page does not support."""
    return [_exported(part.name, system) for part, system in zip(scene.scene.parts, _systems(scene), strict=True)]


def _exported(name: str, system: System) -> Exported:
    inner = system.system if isinstance(system, bright_texels.BrightTexels) else system
    if isinstance(inner, lobe.MatteSystem):
        matte = inner.transport
        vector = diffuse.harmonics_of(matte.vector, size=matte.size, degree=_DEGREE)
        transport = harmonic.TransferVector(vector[:, None], put(matte.position))
        inner = harmonic.DiffuseSystem(transport, put(inner.albedo))
    if isinstance(inner, dynamic.DynamicSystem):
        inner = inner.lobes
    if not isinstance(inner, Exported):
        raise ValueError(
            f"part {name!r} must be ideally diffuse or made by the system 'lobe', 'dynamic' or 'harmonic' to be "
            f"exported, got {type(inner).__name__}"
        )
    if isinstance(inner, harmonic.HarmonicSystem):
        matrices.check(name, inner)
    if isinstance(inner, lobe.LobeSystem):
        _check(name, inner.brdf)
    return inner


def _check(name: str, brdf: lobe.LobeBrdf) -> None:
    if not brdf.isotropic:
        raise ValueError(f"part {name!r} must have an isotropic BRDF to be exported, got an anisotropic one")
    if len(brdf.knot) > 1 or len(brdf.weight) > 4 or any(len(knot) > _KNOTS for knot in brdf.knot):
        raise ValueError(
            f"part {name!r} must have a table of at most 4 channels and one parameter of {_KNOTS} knots to be "
            f"exported, got {len(brdf.weight)} and {[len(knot) for knot in brdf.knot]}"
        )


def scale_of(scene: RelitScene) -> pyramid.Scales | None:
    """Scales of the visibility of the scene's glossy parts; None without glossy parts."""
    transports = [system.transport for system in systems_of(scene) if isinstance(system, lobe.LobeSystem)]
    if not transports:
        return None
    return pyramid.scales(edge_of(transports[0]))


def edge_of(transport: lobe.LobeTransport) -> int:
    """Texels along a face's edge of the visibility."""
    return transport.edge if isinstance(transport, CoarseTransport) else transport.size


def light_size(scene: RelitScene) -> int:
    """Texels along a face's edge of the light in which a reduced scene looks up its lobes; 0 without lobes."""
    return max(
        (system.transport.size for system in systems_of(scene) if isinstance(system, lobe.LobeSystem)), default=0
    )


def vectors_of(system: Exported) -> Float[np.ndarray, "lm v"]:
    """Transfer vectors of a part's vertices; empty for a part with transfer matrices."""
    if isinstance(system, harmonic.HarmonicSystem):
        return np.zeros((0, system.vertices))
    vector = system.transport.vector
    if isinstance(system, lobe.LobeSystem) and not isinstance(system.transport, CoarseTransport):
        vector = diffuse.harmonics_of(vector, size=system.transport.size, degree=_DEGREE)
    if isinstance(system, harmonic.DiffuseSystem):
        if vector.shape[1] != 1:
            raise ValueError(f"transfer vectors must be gray to be exported, got {vector.shape[1]} colors")
        vector = vector[:, 0]
    return np.asarray(vector, np.float64)


def visibility_of(scene: RelitScene) -> list[Float[np.ndarray, "k v"]]:
    """Harmonics of visibility at the vertices of each part; empty for parts without transfer matrices."""
    return [
        matrices.visibility_of(part.name, system)
        if isinstance(system, harmonic.HarmonicSystem)
        else np.zeros((0, system.vertices))
        for part, system in zip(scene.scene.parts, systems_of(scene), strict=True)
    ]


def vector_unit(vectors: list[np.ndarray]) -> Float[np.ndarray, " lm"]:
    """Quantization step of the signed bytes for each harmonic."""
    largest = np.zeros(max(map(len, vectors)))
    for rows in vectors:
        largest[: len(rows)] = np.maximum(largest[: len(rows)], np.abs(rows).max(1, initial=0))
    return np.maximum(largest, 1e-12) / 127
