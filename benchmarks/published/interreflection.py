"""Interreflection for the harmonic system: adds bounces to transfer matrices and vectors, for fixed BRDFs.

Each bounce traces a ray from every vertex through every cubemap texel above its horizon. Where the ray hits a triangle,
the radiance that its corners reflect towards the vertex is interpolated; it comes from the transfer of the previous
bounce. See Sloan, Kautz and Snyder 2002, section 5.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt import require, visibility
from jaxprt.compile import jit
from jaxprt.files.arrays import Layout, sketch
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, haar, harmonics, rotation
from jaxprt.systems.harmonic.table import HarmonicBrdf
from jaxprt.systems.harmonic.transfer import TransferMatrix, TransferVector, check, check_memory
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "bounce": 1}
_RAYS = 1 << 12  # number of hits shaded at once


@require.arguments(**PRECOMPUTE)
def interreflect(
    mesh: Mesh,
    transport: TransferMatrix,
    brdf: Sequence[HarmonicBrdf],
    *,
    bounces: int = 1,
    size: int = 16,
    run: Run = Run(),
) -> TransferMatrix:
    """Adds light reflected between surfaces to transfer matrices. The BRDFs that reflect it are fixed here.

    Args:
        mesh: Mesh of the whole scene.
        transport: Shadowed transfer of all vertices of the mesh.
        brdf: BRDF table of each region of the mesh, of the same degree as the transport and without parameters.
        bounces: Number of reflections before light arrives at a vertex.
        size: Edge of the cubemap faces through whose texels rays are traced, in texels.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Returns:
        Transfer that includes the bounces. It has colors if a BRDF has.

    Raises:
        ValueError: The transport has other vertices, a BRDF has another degree, a region has no BRDF, or `bounces` is
            negative.
        MemoryError: The matrices of two bounces do not fit into memory.

    Reference: Kautz, Sloan, Snyder 2002, section 5; Sloan, Kautz, Snyder 2002, section 5.
    """
    check(harmonics.degree_of(transport.matrix.shape[-1]), size)
    _check(mesh, len(transport.position), len(brdf), bounces)
    wrong = [model.degree for model in brdf if model.table.shape[0] != transport.matrix.shape[-1] or model.knot]
    if wrong:
        degree = harmonics.degree_of(transport.matrix.shape[-1])
        raise ValueError(f"BRDFs must have the transport's degree {degree} and no parameters, got degrees {wrong}")
    colors = max(transport.matrix.shape[1], *(model.table.shape[1] for model in brdf))
    check_memory(len(transport.matrix), harmonics.degree_of(transport.matrix.shape[-1]), copies=2, colors=colors)
    shape = (len(transport.matrix), colors, *transport.matrix.shape[2:])
    total = last = np.broadcast_to(np.asarray(transport.matrix), shape)
    for number in range(bounces):
        job = _BounceJob.make(mesh, None, None, size, brdf=tuple(brdf), rows=np.ascontiguousarray(last))
        label = f"bounce {number + 1}"
        last = visibility.blocks.compute(job, run.within(f"bounce_{number + 1}"), label=label)["matrix"]
        total = total + last
    return TransferMatrix(jnp.asarray(total), transport.position, transport.frame)


@require.arguments(**PRECOMPUTE)
def interreflect_diffuse(
    mesh: Mesh,
    transport: TransferVector,
    albedo: Float[np.ndarray | Array, "r l"],
    *,
    bounces: int = 1,
    size: int = 16,
    run: Run = Run(),
) -> TransferVector:
    """Adds light reflected between diffuse surfaces to transfer vectors.

    Args:
        mesh: Mesh of the whole scene.
        transport: Shadowed transfer of all vertices of the mesh.
        albedo: Albedo of each region r of the mesh, gray or per color.
        bounces: Number of reflections before light arrives at a vertex.
        size: Edge of the cubemap faces through whose texels rays are traced, in texels.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Raises:
        ValueError: The transport has other vertices, a region has no albedo, an albedo is not finite, or `bounces` is
            negative.

    Reference: Sloan, Kautz, Snyder 2002, section 5.
    """
    check(harmonics.degree_of(transport.vector.shape[0]), size)
    albedo = np.asarray(albedo, transport.vector.dtype)
    _check(mesh, len(transport.position), len(albedo), bounces)
    if not np.all(np.isfinite(albedo)):
        raise ValueError(f"albedos must be finite, got {albedo.tolist()}")
    colors = max(transport.vector.shape[1], albedo.shape[1])
    total = last = np.broadcast_to(
        np.asarray(transport.vector), (transport.vector.shape[0], colors, transport.vector.shape[2])
    )
    for number in range(bounces):
        rows = np.ascontiguousarray((last * albedo[np.asarray(mesh.region)].T).transpose(2, 1, 0))
        job = _DiffuseBounceJob.make(mesh, None, None, size, rows=rows, albedo=albedo)
        label = f"bounce {number + 1}"
        last = visibility.blocks.compute(job, run.within(f"bounce_{number + 1}"), label=label)["vector"]
        total = total + last
    return TransferVector(jnp.asarray(total), transport.position)


@jit
def _shade(
    rows: Float[Array, "v l lm lm"],
    frame: Float[Array, "v 3 3"],
    region: Int[Array, " v"],
    brdf: tuple[HarmonicBrdf, ...],
    corner: Int[Array, "m 3"],
    barycentric: Float[Array, "m 3"],
    direction: Float[Array, "m 3"],
) -> Float[Array, "m l lm"]:
    """Radiance that hit points reflect back along the rays, as a linear map of the light."""

    def one(total, k):
        vertex, weight = corner[:, k], barycentric[:, k]
        wo = jnp.sum(frame[vertex] * -direction[:, None], -1)
        view = sum(
            jnp.where(region[vertex] == number, model.coefficients(wo), 0).swapaxes(0, 2)
            for number, model in enumerate(brdf)
        )
        view = jnp.broadcast_to(view, (len(wo), *rows.shape[1:3])) * weight[:, None, None]
        return total + jnp.einsum("mlo,mloi->mli", view, rows[vertex]), None

    start = jnp.zeros((corner.shape[0], rows.shape[1], rows.shape[3]), rows.dtype)
    return jax.lax.scan(one, start, jnp.arange(3))[0]


@jit
def _arriving(leaving: Float[Array, "b d l lm"], frame: Float[Array, "b 3 3"]) -> Float[Array, "b l lm lm"]:
    """Light that arrives through all texels, as SH coefficients in the local frame."""
    count, texels, colors, terms = leaving.shape
    size = haar.face_edge(texels)
    direction, area = cubemap.direction(size=size).reshape(-1, 3), cubemap.solid_angle(size=size).reshape(-1, 1)
    basis = harmonics.evaluate(direction, degree=harmonics.degree_of(terms)) * area
    world = jnp.moveaxis(basis.T @ leaving.reshape(count, texels, -1), 0, -1)
    local = rotation.rotate_each(world, frame).reshape(terms, colors, terms, count)
    return local.transpose(3, 1, 0, 2)


@dataclass(frozen=True)
class _BounceJob(visibility.rays.VisibilityJob):
    """Job that computes what one bounce adds to transfer matrices, in blocks of vertices."""

    brdf: tuple[HarmonicBrdf, ...]
    rows: np.ndarray  # [v, l, o, i] transfer of the previous bounce

    @cached_property
    def shading(self) -> tuple[Array, Array, Array, tuple[HarmonicBrdf, ...]]:
        """Arguments of `_shade`, copied to the device once for all blocks."""
        return jnp.asarray(self.rows), jnp.asarray(self.frame), jnp.asarray(self.occluder.region), self.brdf

    @property
    def header(self) -> Mapping[str, Any]:
        return self.made_by(
            "bounce", ALGORITHM, region=visibility.blocks.fingerprint(np.asarray(self.occluder.region, np.int64))
        )

    @property
    def near(self) -> Mapping[str, list[float]]:
        tables = {f"brdf {number}": sketch(model.table) for number, model in enumerate(self.brdf)}
        return {**super().near, "rows": sketch(self.rows), **tables}

    @property
    def layout(self) -> Mapping[str, Layout]:
        _, colors, terms, _ = self.rows.shape
        return {"matrix": Layout((visibility.rays.BLOCK, colors, terms, terms), 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        part = self.part(block)
        vertex, texel, corner, barycentric, count = visibility.rays.hemisphere_hits(
            self.rays, self.start[part], self.frame[part, 2], size=self.size
        )
        direction = np.asarray(cubemap.direction(size=self.size), np.float32).reshape(-1, 3)
        leaving = np.zeros((len(part), len(direction), self.rows.shape[1], self.rows.shape[3]), np.float32)
        for first in range(0, len(vertex), _RAYS):
            # Padded with copies of the last hit, so that all calls have one shape and share one compiled program.
            at = np.minimum(np.arange(first, first + _RAYS), len(vertex) - 1)
            shaded = _shade(*self.shading, corner[at], barycentric[at], direction[texel[at]])
            leaving[vertex[at], texel[at]] = shaded
        return {"matrix": np.asarray(_arriving(leaving, self.frame[part]))}, count


@dataclass(frozen=True)
class _DiffuseBounceJob(visibility.rays.VisibilityJob):
    """Job that computes what one bounce adds to transfer vectors, in blocks of vertices."""

    rows: np.ndarray  # [v, l, i] albedo times the transfer of the previous bounce
    albedo: np.ndarray  # [r, l] albedo of each region

    @property
    def header(self) -> Mapping[str, Any]:
        region = visibility.blocks.fingerprint(np.asarray(self.occluder.region, np.int64))
        return self.made_by("diffuse bounce", ALGORITHM, region=region, albedo=self.albedo.tolist())

    @property
    def near(self) -> Mapping[str, list[float]]:
        return {**super().near, "rows": sketch(self.rows)}

    @property
    def layout(self) -> Mapping[str, Layout]:
        _, colors, terms = self.rows.shape
        return {"vector": Layout((terms, colors, visibility.rays.BLOCK), 2, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        part = self.part(block)
        vertex, texel, corner, barycentric, count = visibility.rays.hemisphere_hits(
            self.rays, self.start[part], self.frame[part, 2], size=self.size
        )
        area = np.asarray(cubemap.vector_area(size=self.size), np.float32).reshape(-1, 3)
        flux = np.sum(self.frame[part][vertex, 2] * area[texel], -1) / np.float32(np.pi)
        seen = visibility.rays.hits_front(self.rays, self.frame[:, 2], corner, area[texel])
        leaving = np.einsum("mk,mkli->mli", barycentric * (seen * flux)[:, None], self.rows[corner])
        total = np.zeros((len(part), *self.rows.shape[1:]), np.float32)
        np.add.at(total, vertex, leaving)
        return {"vector": total.transpose(2, 1, 0)}, count


def _check(mesh: Mesh, vertices: int, materials: int, bounces: int) -> None:
    """Refuses transport of other vertices, regions without a material, and bounces that are not a whole number >= 0."""
    if not isinstance(bounces, int | np.integer) or bounces < 0:
        raise ValueError(f"bounces must be a whole number of at least 0, got {bounces}")
    if vertices != len(mesh.position):
        raise ValueError(f"the transport must have all {len(mesh.position)} vertices of the mesh, got {vertices}")
    regions = int(np.max(mesh.region, initial=0)) + 1
    if materials < regions:
        raise ValueError(f"each of the mesh's {regions} regions must have a material, got {materials}")
