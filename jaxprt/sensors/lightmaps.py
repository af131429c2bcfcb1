"""Texels of lightmaps as points: where a part's texture coordinates put them, and images of what they receive."""

import dataclasses
import os
import pathlib
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int
from scipy import ndimage

from jaxprt import require
from jaxprt.files import outputs
from jaxprt.scene import Part
from jaxprt.scene.mesh import make_mesh
from jaxprt.sensors.matrix import PointTransport
from jaxprt.visibility.occluder import Occluder

_OVERLAP, _ROUNDING = 1.02, 6.0  # texels that triangles may have more than they cover: relative, and of their root


@dataclasses.dataclass(frozen=True)
class Lightmap:
    """The texels of a square image that a part covers.

    Attributes:
        size: Texels along an edge.
        texel: Row and column of each covered texel, from the top left.
        position: Its place on the part, in the coordinates of the file.
        normal: Unit normal there.
    """

    size: int
    texel: Int[np.ndarray, "p 2"]
    position: Float[np.ndarray, "p 3"]
    normal: Float[np.ndarray, "p 3"]

    def image(self, value: Float[Array | np.ndarray, " p *k"]) -> Float[np.ndarray, " n n *k"]:
        """An image of what the texels receive. Others take the value of the nearest, so that seams do not show."""
        value = np.asarray(value)
        result, empty = np.zeros((self.size, self.size, *value.shape[1:]), value.dtype), np.ones((self.size,) * 2, bool)
        result[tuple(self.texel.T)], empty[tuple(self.texel.T)] = value, False
        nearest: Any = ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True)
        return result[nearest[0], nearest[1]]

    def write(self, path: str | os.PathLike, transport: PointTransport) -> None:
        """Writes the coefficients of a transport, such as those in harmonics, as layers `b0`, `b1`, ... of an EXR."""
        matrix = self.image(transport.matrix)
        layers = {f"b{number}": matrix[:, :, number] for number in range(matrix.shape[2])}
        outputs.write_exr(pathlib.Path(path), layers)


def lightmap(part: Part, *, size: int = 256) -> Lightmap:
    """The texels that a part covers in its second set of texture coordinates, or in its first if there is no second.

    Args:
        part: A part whose triangles do not overlap in the texture, as xatlas or Blender's lightmap unwrapping makes it.
        size: Texels along an edge.

    Raises:
        ValueError: The part has no texture coordinates, they overlap, or they leave the square from 0 to 1.
    """
    require.kind("the part", part, Part, source="jaxprt.Part")
    require.count("size", size, least=1, most=1 << 13)
    mesh, place = part.mesh, part.mesh.texture if part.second is None else part.second
    if place is None:
        raise ValueError(
            f"the part {part.name!r} must have texture coordinates, got none: unwrap it with xatlas or Blender"
        )
    uv, face = np.asarray(place, np.float64), np.asarray(mesh.face)
    used = uv[face.ravel()]
    if used.min() < -1e-4 or used.max() > 1 + 1e-4:
        raise ValueError(f"texture coordinates must be from 0 to 1, got {used.min():.3g} to {used.max():.3g}")
    flat = Occluder(make_mesh(np.concatenate([uv, np.zeros((len(uv), 1))], 1), face))
    row, column = np.divmod(np.arange(size * size), size)
    center = np.stack([column + 0.5, size - row - 0.5, np.full(size * size, size)], -1).astype(np.float32) / size
    down = np.tile(np.array([0, 0, -1], np.float32), (size * size, 1))
    triangle, _, weight = flat.hit(center, down)
    covered = np.flatnonzero(triangle >= 0)
    if not covered.size:
        raise ValueError(f"the triangles of {part.name!r} must cover texels, got none of {size} x {size}")
    a, b, c = (uv[face[:, corner]] for corner in range(3))
    (right, up), (across, over) = (b - a).T, (c - a).T
    area = size**2 * np.abs(right * over - up * across).sum() / 2  # of all triangles, in texels
    if area > _OVERLAP * len(covered) + _ROUNDING * np.sqrt(len(covered) + 1):
        raise ValueError(f"triangles must not overlap in the texture, got {area:.0f} texels on {len(covered)}")
    corner, share = face[triangle[covered]], weight[covered][..., None]
    position = np.sum(np.asarray(mesh.position, np.float64)[corner] * share, 1) + np.asarray(mesh.origin)
    normal = np.sum(np.asarray(mesh.normal, np.float64)[corner] * share, 1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    return Lightmap(size, np.stack([row[covered], column[covered]], -1), position, normal)
