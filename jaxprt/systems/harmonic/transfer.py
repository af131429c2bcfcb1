"""Transport of the harmonic system: how an object shadows and lights itself, as linear maps of the light's SH.

A transfer matrix takes coefficients of distant light in the world to those of the light that arrives at a vertex, in
the vertex's own frame; with a BRDF's coefficients it gives radiance for any view. A transfer vector is what remains
of it for an ideal diffuse surface of albedo 1.
"""

import os
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit
from jaxprt.files.arrays import Layout
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar, harmonics, products, rotation

# Versions of what makes the results; a release that changes them raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "harmonic": 1}


class TransferMatrix(eqx.Module):
    """Light that arrives at each vertex, as a linear map of the distant light.

    Attributes:
        matrix: To each coefficient of the arriving light in the local frame (third axis) from those of the light in
            the world (last axis); gray, or one per color where colored surfaces light each other. Vertices come
            first, so that a view's coefficients meet a matrix in one place.
        position: Vertex positions in world units.
        frame: Rows are tangent, bitangent, normal.
    """

    matrix: Float[Array, "v l lm lm"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.matrix.nbytes


class TransferVector(eqx.Module):
    """Radiance that leaves each vertex, were it ideally diffuse with albedo 1, as a linear map of the distant light.

    Attributes:
        vector: For each coefficient of the light in the world; gray, or one per color.
        position: Vertex positions in world units.
    """

    vector: Float[Array, "lm l v"]
    position: Float[Array, "v 3"]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.vector.nbytes


def precompute(
    mesh: Mesh,
    *,
    degree: int = 4,
    size: int = 32,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> TransferMatrix:
    """Precomputes transfer matrices with self-shadowing, for any BRDF.

    Args:
        mesh: The vertices to light.
        degree: Highest degree of the harmonics.
        size: Edge of the visibility's cubemap faces in texels.
        occluder: What casts shadows: the whole scene, or a simplified one; the mesh itself if None.
        vertex: Numbers of the vertices to light, or a mask; the rest of the mesh still casts shadows.
        path: Folder that keeps finished blocks; a call that was stopped, or killed, goes on from there.
        executor: Where blocks are computed, any `concurrent.futures.Executor`; this machine's cores if None.
        progress: Whether to show a progress bar.

    Raises:
        ValueError: Sizes out of range, positions or normals that are not finite, or a store made from something else.
        MemoryError: The matrices do not fit into memory, which is known before any ray is traced. With a path they stay
            in files on processors, which is a warning.
        BlockingIOError: The store is being written by another process.
        RuntimeError: A worker of the executor died.

    Reference: Kautz, Sloan, Snyder 2002, section 5.
    """
    check(degree, size)
    check_memory(len(visibility.rays.chosen(mesh, vertex)), degree, in_files=path is not None)
    job = _Job.make(mesh, occluder, vertex, size, degree=degree, diffuse=False)
    result = visibility.blocks.compute(job, path=path, executor=executor, progress=progress)
    position = visibility.rays.place(mesh, vertex)
    return TransferMatrix(jax.device_put(result["matrix"]), position, jax.device_put(job.frame))


def precompute_diffuse(
    mesh: Mesh,
    *,
    degree: int = 4,
    size: int = 32,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
) -> TransferVector:
    """Precomputes transfer vectors with self-shadowing, for ideal diffuse surfaces; options as of `precompute`."""
    check(degree, size)
    job = _Job.make(mesh, occluder, vertex, size, degree=degree, diffuse=True)
    result = visibility.blocks.compute(job, path=path, executor=executor, progress=progress)
    return TransferVector(jax.device_put(result["vector"]), visibility.rays.place(mesh, vertex))


@partial(jit, static_argnames="degree")
def transfer(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "b lm lm"]:
    """Transfer matrices of shadowed light: M_oi = ∫ V y_o (in the local frame) y_i (in the world).

    Below the horizon, where no BRDF meets it, the light counts as dimmed by the mean visibility, and not as dark: an
    edge there would only ring. So an open vertex has the rotation to its frame, and one that sees nothing zero.
    Visibility is projected to twice the degree, which is all of it that products of two harmonics meet.

    Args:
        seen: Visibility of each cubemap texel in sixteenths.
        frame: Rows are tangent, bitangent, normal; see `right_handed`.
        degree: Highest degree of the harmonics.

    Raises:
        ValueError: d is not 6 n n for a power of two n.

    Reference: Kautz, Sloan, Snyder 2002, section 5.
    """
    return from_visibility(visible(seen, frame, degree=2 * degree), frame, degree=degree)


@partial(jit, static_argnames="degree")
def visible(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "k b"]:
    """Harmonics of what vertices see, in the world: 1 where light is clear, the mean visibility below the horizon.

    Args:
        seen: Visibility of each cubemap texel in sixteenths.
        frame: Rows are tangent, bitangent, normal.
        degree: Highest degree of the harmonics; transfer matrices need twice theirs.

    Raises:
        ValueError: d is not 6 n n for a power of two n.
    """
    flux = _flux(seen, frame)
    clear = seen.astype(frame.dtype) / visibility.LEVELS
    mean = jnp.sum(clear * flux, -1, keepdims=True) / jnp.sum(flux, -1, keepdims=True)
    return _project(jnp.where(flux > 0, clear, mean), degree=degree)


@partial(jit, static_argnames="degree")
def from_visibility(
    coefficient: Float[Array, "k b"], frame: Float[Array, "b 3 3"], *, degree: int
) -> Float[Array, "b lm lm"]:
    """Transfer matrices of a visibility that is given by its harmonics: M_oi = ∫ V y_o (in the local frame) y_i.

    A matrix has no more in it than these (2 degree + 1)^2 numbers and the frame: `to_visibility` is the inverse.

    Args:
        coefficient: Coefficients of the visibility in the world, of twice the degree.
        frame: Rows are tangent, bitangent, normal; see `right_handed`.
        degree: Highest degree of the matrices.
    """
    node, weight = (jnp.asarray(each, frame.dtype) for each in products.quadrature(4 * degree))
    basis = harmonics.evaluate(node, degree=degree)
    value = weight[:, None] * (harmonics.evaluate(node, degree=2 * degree) @ coefficient)
    world = jax.lax.map(lambda each: (basis * each[:, None]).T @ basis, value.T)
    return jnp.moveaxis(rotation.rotate_each(jnp.moveaxis(world, 0, -1), right_handed(frame)), -1, 0)


@jit
def to_visibility(matrix: Float[Array, "b lm lm"], frame: Float[Array, "b 3 3"]) -> Float[Array, "k b"]:
    """Coefficients of the visibility that matrices were made of, in the world: the inverse of `from_visibility`.

    Of other matrices, such as those with interreflection, it is the visibility whose matrices are nearest to them.
    Turned to the world on both sides, the function sum_oi y_o(s) M_oi y_i(s) is the visibility convolved with the
    square of the kernel sum_i y_i(s) y_i(t), which is zonal: a division for each band undoes that.

    Args:
        matrix: Transfer matrices.
        frame: Rows are tangent, bitangent, normal; see `right_handed`.
    """
    degree = harmonics.degree_of(matrix.shape[-1])
    back = right_handed(frame).swapaxes(1, 2)
    world = jnp.moveaxis(rotation.rotate_each(jnp.moveaxis(matrix, 0, -1), back), -1, 0)
    node, weight = (jnp.asarray(each, frame.dtype) for each in products.quadrature(4 * degree))
    basis = harmonics.evaluate(node, degree=degree)
    convolved = jax.lax.map(lambda each: jnp.sum((basis @ each) * basis, -1), world)
    coefficient = (weight[:, None] * harmonics.evaluate(node, degree=2 * degree)).T @ convolved.T
    return harmonics.convolve(coefficient, jnp.asarray(1 / _squared_kernel(degree), frame.dtype))


@partial(jit, static_argnames="degree")
def transfer_diffuse(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "lm b"]:
    """Transfer vectors of shadowed light, t_i = 1/pi ∫ V y_i cos, with i in the world.

    Args:
        seen: Visibility of each cubemap texel in sixteenths.
        frame: Rows are tangent, bitangent, normal.
        degree: Highest degree of the harmonics.

    Raises:
        ValueError: d is not 6 n n for a power of two n.

    Reference: Sloan, Kautz, Snyder 2002, section 4.
    """
    size = haar.face_edge(seen.shape[1])
    cosine = _flux(seen, frame) / cubemap.solid_angle(size=size).reshape(-1)
    return _project(seen.astype(frame.dtype) * (cosine / (visibility.LEVELS * np.pi)), degree=degree)


@jit
def right_handed(frame: Float[Array, "v 3 3"]) -> Float[Array, "v 3 3"]:
    """Frames with the bitangent that belongs to their tangent and normal: a proper rotation whatever it was.

    Frames that the package makes are so already. Those made by hand may have mirrored bitangents, as texture
    coordinates have, of which rotations of harmonics would make nonsense.
    """
    return jnp.stack([frame[:, 0], jnp.cross(frame[:, 2], frame[:, 0]), frame[:, 2]], 1)


def _flux(seen: Array, frame: Array) -> Float[Array, "b d"]:
    """Integral of the cosine over each texel; zero below the horizon."""
    area = cubemap.vector_area(size=haar.face_edge(seen.shape[1])).reshape(-1, 3)
    return jnp.maximum(directions.to_local(frame, area)[..., 2], 0)


def _project(value: Float[Array, "b d"], *, degree: int) -> Float[Array, "lm b"]:
    size = haar.face_edge(value.shape[1])
    return harmonics.project(value.T.reshape(6, size, size, -1), degree=degree)


def _squared_kernel(degree: int) -> np.ndarray:
    """Factors of the zonal function (sum_i y_i(s) y_i(t))^2, whose sum goes up to a degree, for twice as many bands."""
    height, weight = np.polynomial.legendre.leggauss(2 * degree + 1)
    kernel = np.polynomial.legendre.legval(height, (2 * np.arange(degree + 1) + 1) / (4 * np.pi))
    return 2 * np.pi * (weight * kernel**2) @ np.polynomial.legendre.legvander(height, 2 * degree)


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Blocks of shadowed transfer matrices, or of the vectors of ideal diffuse surfaces; see `blocks.Job`."""

    degree: int
    diffuse: bool

    @property
    def header(self) -> Mapping[str, Any]:
        return self.made_by("harmonic diffuse" if self.diffuse else "harmonic", ALGORITHM, degree=self.degree)

    @property
    def layout(self) -> Mapping[str, Layout]:
        terms, step = (self.degree + 1) ** 2, visibility.rays.BLOCK
        if self.diffuse:
            return {"vector": Layout((terms, 1, step), 2, "float32")}
        return {"matrix": Layout((step, 1, terms, terms), 0, "float32")}

    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        seen, count = self.seen(block)
        name, function = ("vector", transfer_diffuse) if self.diffuse else ("matrix", transfer)
        made = function(seen, self.frame[self.part(block)], degree=self.degree)
        return {name: np.asarray(made)[:, None]}, count.rays


def check_memory(vertices: int, degree: int, *, copies: int = 1, colors: int = 1, in_files: bool = False) -> None:
    """Refuses matrices that do not fit into memory.

    Args:
        vertices: Number of vertices.
        degree: Highest degree of the harmonics.
        copies: How many of them are held at once.
        colors: Number of colors of each.
        in_files: Whether they stay in files that are mapped, which is a warning where JAX computes on the processor.

    Raises:
        MemoryError: They do not fit.
    """
    each = 4 * (degree + 1) ** 4 * colors
    require.memory(
        f"transfer matrices of degree {degree} for {vertices:,} vertices, {each:,} bytes each,",
        copies * vertices * each,
        "take jaxprt.harmonic.precompute_clustered, a lower degree, or fewer vertices (vertex=)",
        in_files=in_files,
    )


def check(degree: int, size: int) -> None:
    """Refuses degrees and sizes that are out of range."""
    if not 0 <= degree <= 25 or size < 1 or size & (size - 1):
        raise ValueError(f"degree must be 0 to 25 and size a power of two, got {degree} and {size}")
