"""Relit scenes at reduced resolution, as exported pages contain them."""

import dataclasses
import warnings
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt.brdf import ClearCoat, Sheen
from jaxprt.brdf.varying import PerVertex
from jaxprt.compile import put
from jaxprt.relit import channels
from jaxprt.relit.channels import Shading
from jaxprt.relit.groups import Place
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Environment, Part, TexturedMaterial
from jaxprt.sphere import cubemap, harmonics
from jaxprt.systems import axes, bright_texels, dynamic, harmonic, lobe, standard
from jaxprt.systems.harmonic.transfer import from_visibility, to_visibility
from jaxprt.systems.lobe import diffuse, pyramid
from jaxprt.systems.lobe.blurred_light import LobeLight
from jaxprt.systems.protocol import Blend, System
from jaxprt.systems.standard.layered import BASE

_LIGHT = 32  # texels along a face's edge of the light that lobes are looked up in
_TEXELS = 64  # number of brightest texels that are summed one by one
_DEGREE = 6  # of the harmonics by which diffuse parts are lit
_GRAZING = 1e-3
_KNOTS = 64  # most knots of a table's parameter

Exported = lobe.LobeSystem | harmonic.DiffuseSystem | harmonic.HarmonicSystem
_EQUAL = 1e-3  # largest relative error at which matrices count as products of a visibility, and tables as symmetric
_MATRIX_KNOTS = 64  # most knots of the roughness
_CHANNELS = 4


def without_layers(scene: RelitScene) -> RelitScene:
    """A relit scene in direct light with the bases of its parts under layers, with one warning that names these parts.

    A scene without clear coats and sheens is returned as it is.
    """
    layered = [shading.layered for shading in scene.shading]
    if not any(layered):
        return scene
    old = scene.scene
    names = ", ".join(repr(part.name) for part, has in zip(old.parts, layered, strict=True) if has)
    warnings.warn(f"the page shows these parts without their clear coats and sheens: {names}", stacklevel=3)
    parts = [_bare(part) if has else part for part, has in zip(old.parts, layered, strict=True)]
    shadings = [_base_shading(shading) if has else shading for shading, has in zip(scene.shading, layered, strict=True)]
    systems = [scene.part_system(number) for number in range(len(parts))]
    systems = [_base_system(system) if has else system for system, has in zip(systems, layered, strict=True)]
    counts, alone = [len(part.mesh.position) for part in parts], [[number] for number in range(len(parts))]
    place = Place.of(counts, alone, [False] * len(counts))
    return RelitScene(dataclasses.replace(old, parts=parts), shadings, place, systems)


def _bare(part: Part) -> Part:
    """The part with the base of its material."""
    assert isinstance(part.material, TexturedMaterial)
    return dataclasses.replace(part, material=channels.without_layers(part.material))


def _base_shading(shading: Shading) -> Shading:
    """The base of a part under a layer."""
    table, blend, exact = standard.METALLIC_ROUGHNESS, shading.blend, shading.exact
    assert blend is not None
    assert isinstance(exact, PerVertex)
    assert isinstance(exact.model, ClearCoat | Sheen)
    weight = jnp.asarray(blend.weight[:, :BASE] + blend.weight[:, BASE : 2 * BASE])
    return dataclasses.replace(
        shading,
        brdf=table.family,
        exact=PerVertex(exact.model.base),
        knot=table.knots,
        blend=Blend(weight, blend.parameter[:1]),
        term=table.term,
        scale=table.scale,
        table=table,
    )


def _base_system(system: Any) -> Any:
    """The system of a part under a layer with the tables of its base."""
    table = standard.METALLIC_ROUGHNESS
    if isinstance(system, bright_texels.BrightTexels):
        return dataclasses.replace(system, system=_base_system(system.system), brdf=table.family)
    if isinstance(system, harmonic.HarmonicSystem):
        return dataclasses.replace(system, brdf=table.harmonics(system.brdf.degree))
    assert isinstance(system, lobe.LobeSystem)
    return dataclasses.replace(system, brdf=table.lobes(system.brdf.lobes // 2))


class CoarseMatrix(harmonic.TransferMatrix):
    """Transfer matrices that are computed from the harmonics of a quantized visibility.

    Attributes:
        visible: Harmonics of the visibility in world coordinates, of twice the degree of the matrices.
    """

    visible: Float[Array, "k v"]


def check_matrices(name: str, system: harmonic.HarmonicSystem) -> None:
    """Refuses parts that an exported page does not support."""
    table, knots = system.brdf.table, [len(knot) for knot in system.brdf.knot]
    if not system.brdf.isotropic:
        raise ValueError(f"part {name!r} must have an isotropic BRDF to be exported, got an anisotropic one")
    if len(knots) > 1 or table.shape[1] > _CHANNELS or any(knot > _MATRIX_KNOTS for knot in knots):
        raise ValueError(
            f"part {name!r} must have a table of at most {_CHANNELS} channels and one parameter of {_MATRIX_KNOTS} "
            f"knots to be exported, got {table.shape[1]} and {knots}"
        )
    if system.transport.matrix.shape[1] != 1:
        raise ValueError(
            f"part {name!r} must have gray transfer matrices to be exported, "
            f"got {system.transport.matrix.shape[1]} colors"
        )


def system_visibility(name: str, system: harmonic.HarmonicSystem) -> Float[np.ndarray, "k v"]:
    """Harmonics of the visibility from which a part's transfer matrices were computed, of twice their degree.

    Raises:
        ValueError: The matrices do not come from a visibility, for example because they include interreflection.
    """
    transport = system.transport
    if isinstance(transport, CoarseMatrix):
        return np.asarray(transport.visible, np.float64)
    matrix = transport.matrix[:, 0]
    visibility = to_visibility(matrix, transport.frame)
    again = from_visibility(visibility, transport.frame, degree=system.degree)
    if not float(jnp.linalg.norm(again - matrix)) <= _EQUAL * float(jnp.linalg.norm(matrix)):
        raise ValueError(
            f"part {name!r} must have the transfer matrices of direct light to be exported, got others, as with "
            "interreflection"
        )
    return np.asarray(visibility, np.float64)


def truncate(visible: Float[np.ndarray, "k v"], degree: int | None) -> Float[np.ndarray, "m v"]:
    """Harmonics of visibility that matrices of a degree need; all if None."""
    return visible if degree is None else visible[: (2 * degree + 1) ** 2]


def with_visibility(system: harmonic.HarmonicSystem, visible: Float[np.ndarray, "k v"]) -> harmonic.HarmonicSystem:
    """The system with its visibility replaced by another one, which may have a lower degree."""
    old, degree = system.transport, harmonics.degree_of(len(visible)) // 2
    coefficient = jnp.asarray(visible, old.matrix.dtype)
    matrix = from_visibility(coefficient, old.frame, degree=degree)[:, None]
    transport = CoarseMatrix(matrix, old.position, old.frame, coefficient)
    return harmonic.HarmonicSystem(transport, system.brdf.truncate(degree=degree), system.laplacian)


def plane_table(name: str, brdf: harmonic.HarmonicBrdf) -> Float[np.ndarray, "h q e 4"]:
    """Table of a BRDF by zonal harmonics: for each knot, view node, band and each of `degree + 1` directions.

    A BRDF that is symmetric about the plane of the view direction and the normal can be written, in each band, as a sum
    of zonal harmonics about directions in this plane. Its dot product with the light is then the sum of the light's
    bands, evaluated in these directions, times the entries. The page therefore does not need to rotate harmonics.

    Raises:
        ValueError: The BRDF is not symmetric.
    """
    value = np.asarray(brdf.table, np.float64)
    value = value if brdf.knot else value[:, :, None]
    bands = brdf.degree + 1
    angle = np.pi * (np.arange(bands) + 0.5) / bands
    way = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], -1)
    basis = np.asarray(harmonics.evaluate(jnp.asarray(way, jnp.result_type(float)), degree=brdf.degree), np.float64)
    result = np.zeros((*value.shape[2:], bands, bands, _CHANNELS))
    missed = 0.0
    for band in range(bands):
        rows = slice(band**2, (band + 1) ** 2)
        factor = np.einsum("jm,mchq->hqjc", np.linalg.pinv(basis[:, rows].T), value[rows])
        missed += float(np.sum((np.einsum("jm,hqjc->mchq", basis[:, rows], factor) - value[rows]) ** 2))
        result[:, :, band, :, : value.shape[1]] = factor
    if not np.sqrt(missed) <= _EQUAL * np.linalg.norm(value):
        raise ValueError(f"part {name!r} must have a BRDF that is symmetric about the plane of the view to be exported")
    return result.reshape(*value.shape[2:], bands**2, _CHANNELS)


def matrix_words(system: harmonic.HarmonicSystem) -> int:
    """Number of 4-byte words for the visibility of a vertex."""
    return -(-((2 * system.degree + 1) ** 2) // 4)


def matrix_bytes(system: harmonic.HarmonicSystem, degree: int) -> int:
    """Size in bytes of the visibility of all vertices, for matrices of a degree."""
    return system.vertices * (2 * min(system.degree, degree) + 1) ** 2


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
        light = super().light(resize(environment, size=self.transport.size))
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
    systems = [_exportable(part.name, system) for part, system in zip(scene.scene.parts, whole, strict=True)]
    vectors = [vectors_of(system) for system in systems]
    visible = [truncate(matrix, degree) for matrix in visibility_of(scene)]
    unit, visible_unit = vector_unit(vectors), vector_unit(visible)
    coarse_systems: list[System] = []
    for system, vector, seen_in_part in zip(systems, vectors, visible, strict=True):
        part_unit = visible_unit[: len(seen_in_part), None]
        if isinstance(system, harmonic.HarmonicSystem):
            coarse_systems.append(with_visibility(system, np.round(seen_in_part / part_unit) * part_unit))
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


def resize(light: Environment, *, size: int) -> Environment:
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
    return [_exportable(part.name, system) for part, system in zip(scene.scene.parts, _systems(scene), strict=True)]


def _exportable(name: str, system: System) -> Exported:
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
        check_matrices(name, inner)
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
        system_visibility(part.name, system)
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
