"""Transport of the harmonic system: self-shadowing and interreflection as linear maps of the light's SH coefficients.

A transfer matrix maps SH coefficients of distant light in the world to those of the light that arrives at a vertex, in
the vertex's frame. The dot product of these with a BRDF's coefficients is radiance, for any view. A transfer vector is
the same for an ideal diffuse surface of albedo 1: its dot product with the light is radiance.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from jaxprt import require, visibility
from jaxprt.compile import jit
from jaxprt.files.arrays import Header, Layout
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import cubemap, directions, haar, harmonics, rotation
from jaxprt.visibility.blocks import Run
from jaxprt.visibility.rays import PRECOMPUTE

# Versions of the algorithms. A release that changes their results raises one.
ALGORITHM = {"visibility": visibility.rays.ALGORITHM, "harmonic": 1}


class TransferMatrix(eqx.Module):
    """Light that arrives at each vertex, as a linear map of the distant light.

    Attributes:
        matrix: Transfer matrices [v, color, row, column]. Rows are coefficients of the arriving light in the local
            frame, columns those of the distant light in the world. The color axis is 1 (gray), or one per color with
            interreflection between colored surfaces. Vertices come first, so that each matrix is contiguous in memory.
        position: Vertex positions in world units.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
    """

    matrix: Float[Array, "v l lm lm"]
    position: Float[Array, "v 3"]
    frame: Float[Array, "v 3 3"]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.matrix.nbytes


class TransferVector(eqx.Module):
    """Radiance that each vertex would reflect if it were ideal diffuse with albedo 1, as a linear map of distant light.

    Attributes:
        vector: Factor for each SH coefficient of the light in the world; the color axis is 1 (gray) or one per color.
        position: Vertex positions in world units.
    """

    vector: Float[Array, "lm l v"]
    position: Float[Array, "v 3"]

    @property
    def nbytes(self) -> int:
        """Bytes of the coefficients."""
        return self.vector.nbytes


@require.arguments(**PRECOMPUTE)
def precompute(
    mesh: Mesh,
    *,
    degree: int = 4,
    size: int = 32,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    apart: bool = False,
    run: Run = Run(),
) -> TransferMatrix:
    """Precomputes transfer matrices with self-shadowing, for any BRDF.

    Args:
        mesh: The mesh to light.
        degree: Highest degree of the harmonics.
        size: Edge of the cubemap faces of visibility, in texels; a power of two.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        apart: Whether the regions of the mesh are separate surfaces: rays start off the faces of their own region.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Raises:
        ValueError: The degree or the size is out of range, positions or normals are not finite, or the folder holds
            results of other inputs.
        MemoryError: The matrices do not fit into memory. This is checked before rays are traced. With `path`, on a CPU,
            the matrices stay in memory-mapped files and there is only a warning.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.

    Reference: Kautz, Sloan, Snyder 2002, section 5.
    """
    check(degree, size)
    check_memory(len(visibility.rays.vertex_indices(mesh, vertex)), degree, in_files=run.path is not None)
    job = _Job.make(mesh, occluder, vertex, size, apart=apart, degree=degree, diffuse=False)
    result = visibility.blocks.compute(job, run)
    position = visibility.rays.place(mesh, vertex)
    return TransferMatrix(jax.device_put(result["matrix"]), position, jax.device_put(job.frame))


@require.arguments(**PRECOMPUTE)
def precompute_diffuse(
    mesh: Mesh,
    *,
    degree: int = 4,
    size: int = 32,
    occluder: Mesh | None = None,
    vertex: np.ndarray | None = None,
    apart: bool = False,
    run: Run = Run(),
) -> TransferVector:
    """Precomputes transfer vectors with self-shadowing, for ideal diffuse surfaces.

    Args:
        mesh: The mesh to light.
        degree: Highest degree of the harmonics.
        size: Edge of the cubemap faces of visibility, in texels; a power of two.
        occluder: Mesh that casts shadows, such as the whole scene or a simplified one; the mesh itself if None.
        vertex: Indices of the vertices to light, or a mask; all if None. The rest of the mesh still casts shadows.
        apart: Whether the regions of the mesh are separate surfaces: rays start off the faces of their own region.
        run: Folder of finished work, executor and progress bars. A call that was interrupted continues from the folder.

    Raises:
        ValueError: The degree or the size is out of range, positions or normals are not finite, or the folder holds
            results of other inputs.
        BlockingIOError: Another process is writing to the folder.
        RuntimeError: A worker of the executor died.

    Reference: Sloan, Kautz, Snyder 2002, section 4.
    """
    check(degree, size)
    job = _Job.make(mesh, occluder, vertex, size, apart=apart, degree=degree, diffuse=True)
    result = visibility.blocks.compute(job, run)
    return TransferVector(jax.device_put(result["vector"]), visibility.rays.place(mesh, vertex))


@partial(jit, static_argnames="degree")
def transfer(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "b lm lm"]:
    """Transfer matrices of shadowed light: M_oi = ∫ V y_o (in the local frame) y_i (in the world).

    Below the horizon, where BRDF x cosine is zero, visibility V is set to its mean above the horizon; an edge at the
    horizon would cause ringing. The matrix of an unoccluded vertex is therefore the rotation to its frame, and that of
    a vertex that sees nothing is zero. V is projected to twice the degree, because products of two harmonics have no
    higher bands.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal. See `right_handed`.
        degree: Highest degree of the harmonics.

    Raises:
        ValueError: d is not 6 n n for a power of two n.

    Reference: Kautz, Sloan, Snyder 2002, section 5.
    """
    return from_visibility(visible(seen, frame, degree=2 * degree), frame, degree=degree)


@partial(jit, static_argnames="degree")
def visible(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "k b"]:
    """SH coefficients of each vertex's visibility, in the world. Below the horizon it is the mean of that above.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        degree: Highest degree of the harmonics. Transfer matrices need twice their own degree.
    """
    flux = _flux(seen, frame)
    clear = seen.astype(frame.dtype) / visibility.LEVELS
    mean = jnp.sum(clear * flux, -1, keepdims=True) / jnp.sum(flux, -1, keepdims=True)
    return _project(jnp.where(flux > 0, clear, mean), degree=degree)


@partial(jit, static_argnames="degree")
def from_visibility(
    coefficient: Float[Array, "k b"], frame: Float[Array, "b 3 3"], *, degree: int
) -> Float[Array, "b lm lm"]:
    """Transfer matrices from SH coefficients of visibility V: M_oi = ∫ V y_o (in the local frame) y_i (in the world).

    The (2 degree + 1)^2 coefficients and the frame determine the matrix, and `to_visibility` recovers them from it.

    Args:
        coefficient: SH coefficients of visibility in the world, up to twice the degree.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal. See `right_handed`.
        degree: Highest degree of the matrices.
    """
    node, weight = (jnp.asarray(array, frame.dtype) for array in harmonics.quadrature(4 * degree))
    basis = harmonics.evaluate(node, degree=degree)
    value = weight[:, None] * (harmonics.evaluate(node, degree=2 * degree) @ coefficient)
    world = jax.lax.map(lambda value: (basis * value[:, None]).T @ basis, value.T)
    return jnp.moveaxis(rotation.rotate_each(jnp.moveaxis(world, 0, -1), right_handed(frame)), -1, 0)


@jit
def to_visibility(matrix: Float[Array, "b lm lm"], frame: Float[Array, "b 3 3"]) -> Float[Array, "k b"]:
    """SH coefficients of visibility, in the world, from transfer matrices: the inverse of `from_visibility`.

    For other matrices, such as those with interreflection, the result is the visibility whose matrices are nearest.
    With M rotated to the world, sum_oi y_o(s) M_oi y_i(s) is the visibility convolved with the square of the kernel
    sum_i y_i(s) y_i(t). This kernel is zonal, so the convolution is undone by one division per band.

    Args:
        matrix: Transfer matrices.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal. See `right_handed`.
    """
    degree = harmonics.degree_of(matrix.shape[-1])
    back = right_handed(frame).swapaxes(1, 2)
    world = jnp.moveaxis(rotation.rotate_each(jnp.moveaxis(matrix, 0, -1), back), -1, 0)
    node, weight = (jnp.asarray(array, frame.dtype) for array in harmonics.quadrature(4 * degree))
    basis = harmonics.evaluate(node, degree=degree)
    convolved = jax.lax.map(lambda matrix: jnp.sum((basis @ matrix) * basis, -1), world)
    coefficient = (weight[:, None] * harmonics.evaluate(node, degree=2 * degree)).T @ convolved.T
    return harmonics.convolve(coefficient, jnp.asarray(1 / _squared_kernel(degree), frame.dtype))


@partial(jit, static_argnames="degree")
def transfer_diffuse(seen: UInt8[Array, "b d"], frame: Float[Array, "b 3 3"], *, degree: int) -> Float[Array, "lm b"]:
    """Transfer vectors of shadowed light, t_i = 1/pi ∫ V y_i cos, with y_i in the world.

    Args:
        seen: Visible share of each cubemap texel in sixteenths.
        frame: Shading frame of each vertex; rows are tangent, bitangent, normal.
        degree: Highest degree of the harmonics.
    Reference: Sloan, Kautz, Snyder 2002, section 4.
    """
    size = haar.face_edge(seen.shape[1])
    cosine = _flux(seen, frame) / cubemap.solid_angle(size=size).reshape(-1)
    return _project(seen.astype(frame.dtype) * (cosine / (visibility.LEVELS * np.pi)), degree=degree)


@jit
def right_handed(frame: Float[Array, "v 3 3"]) -> Float[Array, "v 3 3"]:
    """Replaces the bitangent of each frame by normal x tangent, which makes the frame a proper rotation.

    Frames made by jaxprt are proper already. Frames from elsewhere may have a mirrored bitangent, as mirrored texture
    coordinates do; rotations of harmonics would then be wrong.
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
    """Zonal factors of (sum_i y_i(s) y_i(t))^2, up to band 2 degree; the sum is over all harmonics up to the degree."""
    height, weight = np.polynomial.legendre.leggauss(2 * degree + 1)
    kernel = np.polynomial.legendre.legval(height, (2 * np.arange(degree + 1) + 1) / (4 * np.pi))
    return 2 * np.pi * (weight * kernel**2) @ np.polynomial.legendre.legvander(height, 2 * degree)


@dataclass(frozen=True)
class _Job(visibility.rays.VisibilityJob):
    """Job that computes blocks of shadowed transfer matrices or transfer vectors; see `blocks.Job`."""

    degree: int
    diffuse: bool

    @property
    def header(self) -> Header:
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
        value = function(seen, self.frame[self.part(block)], degree=self.degree)
        return {name: np.asarray(value)[:, None]}, count.rays


def check_memory(vertices: int, degree: int, *, copies: int = 1, colors: int = 1, in_files: bool = False) -> None:
    """Refuses matrices that do not fit into memory.

    Args:
        vertices: Number of vertices.
        degree: Highest degree of the harmonics.
        copies: Number of copies held at the same time.
        colors: Number of colors of each matrix.
        in_files: Whether the matrices stay in memory-mapped files. On a CPU, too little memory then causes a warning
            instead of the error.
    """
    size = 4 * (degree + 1) ** 4 * colors
    require.memory(
        f"transfer matrices of degree {degree} for {vertices:,} vertices, {size:,} bytes each,",
        copies * vertices * size,
        "take a lower degree, or fewer vertices (vertex=)",
        in_files=in_files,
    )


def check(degree: int, size: int) -> None:
    """Refuses a degree or a size that is out of range."""
    require.whole("degree", degree)
    require.whole("size", size)
    if not 0 <= degree <= 25 or size < 1 or size & (size - 1):
        raise ValueError(f"degree must be 0 to 25 and size a power of two, got {degree} and {size}")
