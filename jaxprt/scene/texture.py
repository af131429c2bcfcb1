"""Texture lookup, and the derivatives and handedness of texture coordinates on a mesh."""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxprt.compile import jit
from jaxprt.scene.mesh import Mesh

WRAPS = ("repeat", "mirror", "clamp")  # beyond the edges: the image again, its mirror image, or its border texels


@functools.partial(jit, static_argnames="wrap")
def lookup(
    image: Float[Array, "h w c"], coordinate: Float[Array, "*b 2"], *, wrap: tuple[str, str] = ("repeat", "repeat")
) -> Float[Array, "*b c"]:
    """Bilinear interpolation of a texture.

    Coordinates follow the convention of OBJ files: (0, 0) is the lower left corner of the image and (1, 1) the upper
    right one. Centers of texels lie half a texel inside.

    A lookup at a vertex samples the texture at one point, so details finer than the mesh's edges are missed, not
    averaged. To show them in a picture, look up each pixel:
    `lookup(image, interpolate(fragments, mesh.face, mesh.texture))`.

    With "repeat", opposite edges of the image are blended: the value at u = 0 and at u = 1 is the mean of both edges.

    The result is linear in the image. It is differentiable in the coordinates except at centers of rows and columns.

    Args:
        image: The texture, first row on top. Albedo textures must be linear, not sRGB-encoded.
        coordinate: Texture coordinates with u to the right and v up, as in `Mesh.texture`.
        wrap: Wrap mode along u and along v, each one of ``WRAPS``.

    Returns:
        Values of the image at the coordinates, for example weights of a `jaxprt.Blend`.

    Raises:
        ValueError: The image has no axis of colors, coordinates are not pairs, or a wrap mode is unknown.
    """
    if image.ndim != 3 or coordinate.shape[-1:] != (2,):
        got = f"{list(image.shape)} and {list(coordinate.shape)}"
        raise ValueError(f"image must be [h, w, c] and coordinates [..., 2], got {got}")
    if not set(wrap) <= set(WRAPS):
        raise ValueError(f"wrap must be two of {', '.join(WRAPS)}, got {wrap}")
    parts = [
        image[place] * weight[..., None]
        for place, weight in bilinear(coordinate, (image.shape[0], image.shape[1]), wrap)
    ]
    return sum(parts[1:], start=parts[0])


def bilinear(
    coordinate: Float[Array, "*b 2"],
    shape: tuple[int | Int[Array, "*b"], int | Int[Array, "*b"]],
    wrap: tuple[str, str],
) -> list[tuple[tuple[Int[Array, "*b"], Int[Array, "*b"]], Float[Array, "*b"]]]:
    """Row, column and weight of the four texels around each coordinate, in an image of a given height and width."""
    height, width = shape
    # Reduced to one period first, because large coordinates times the width would lose precision.
    x = _reduced(coordinate[..., 0], wrap[0]) * width - 0.5
    y = (1 - _reduced(coordinate[..., 1], wrap[1])) * height - 0.5
    column, row = jnp.floor(x), jnp.floor(y)
    right, down = x - column, y - row
    result = []
    for below, v in ((0, 1 - down), (1, down)):
        line = _inside(row.astype(jnp.int32) + below, height, wrap[1])
        for beside, u in ((0, 1 - right), (1, right)):
            result.append(((line, _inside(column.astype(jnp.int32) + beside, width, wrap[0])), v * u))
    return result


def _reduced(place: Float[Array, "*b"], wrap: str) -> Float[Array, "*b"]:
    """Coordinates reduced to one period: the image, or the image followed by its mirror image."""
    if wrap == "clamp":
        return jnp.clip(place, 0, 1)
    return place - jnp.floor(place) if wrap == "repeat" else place - 2 * jnp.floor(place / 2)


def _inside(index: Int[Array, "*b"], size: int | Int[Array, "*b"], wrap: str) -> Int[Array, "*b"]:
    """Indices of the texels that replace those beyond the edges."""
    if wrap == "clamp":
        return jnp.clip(index, 0, size - 1)
    if wrap == "repeat":
        return index % size
    index = index % (2 * size)
    return jnp.minimum(index, 2 * size - 1 - index)


def dpdu(mesh: Mesh) -> Float[np.ndarray, "v 3"]:
    """Derivative of the position by the texture coordinate u at each vertex, in world units, for `mesh.brush`.

    It is the mean over the adjacent faces, weighted by their area in the texture, and zero if that area is zero. Faces
    whose derivative points the opposite way, beyond a seam at which the texture is mirrored, count with the opposite
    sign, because brushing has no sign.

    Raises:
        ValueError: The mesh has no texture coordinates.

    Reference: Pharr, Jakob, Humphreys 2023, "Physically Based Rendering", section 6.5.
    """
    if mesh.texture is None:
        raise ValueError("the mesh must have texture coordinates, got none: give them to `jaxprt.scene.mesh.make_mesh`")
    face = np.asarray(mesh.face)
    corner, place = (np.asarray(each, np.float64)[face] for each in (mesh.position, mesh.texture))
    edge, step = corner[:, 1:] - corner[:, :1], place[:, 1:] - place[:, :1]
    covered = np.linalg.det(step)
    # Differences within the rounding of float32 coordinates are not meaningful.
    least = 4 * np.finfo(np.float32).eps * np.abs(place).max((1, 2)) * np.abs(step).max((1, 2))
    covered = np.where(np.abs(covered) > least, covered, 0)
    weighted = np.sign(covered)[:, None] * (edge[:, 0] * step[:, 1, 1:] - edge[:, 1] * step[:, 0, 1:])
    vertex, weight, along = face.ravel(), np.repeat(np.abs(covered), 3), np.repeat(weighted, 3, axis=0)
    order = np.argsort(weight, kind="stable")
    first = np.zeros((len(mesh.position), 3))
    first[vertex[order]] = along[order]  # the last one written covers most
    along = np.where(np.sum(along * first[vertex], 1, keepdims=True) < 0, -along, along)
    total = np.bincount(vertex, weight, len(first))
    mean = np.stack([np.bincount(vertex, along[:, axis], len(first)) for axis in range(3)], -1)
    return mean / np.where(total > 0, total, 1)[:, None]


def handedness(mesh: Mesh) -> Float[np.ndarray, " v"]:
    """Handedness of the texture coordinates at each vertex: 1, or -1 where the texture is mirrored.

    Where it is -1, the bitangent of the texture is -cross(normal, tangent).

    Raises:
        ValueError: The mesh has no texture coordinates.
    """
    if mesh.texture is None:
        raise ValueError("the mesh must have texture coordinates, got none: give them to `jaxprt.scene.mesh.make_mesh`")
    face = np.asarray(mesh.face)
    place = np.asarray(mesh.texture, np.float64)[face]
    covered = np.linalg.det(place[:, 1:] - place[:, :1])
    total = np.bincount(face.ravel(), np.repeat(covered, 3), len(mesh.position))
    return np.where(total < 0, -1.0, 1.0)
