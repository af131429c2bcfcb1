"""Look-ups in textures: interpolation, mip maps, derivatives by the coordinates, and normal maps.

Mip maps average unit normals. The direction of a mean is the normal of its pixel. Its length says how far the normals
are apart: for a von Mises-Fisher distribution of normals it determines the concentration k, and the variance along one
axis is 1 / k. A microfacet distribution of width alpha has the variance alpha^2 / 2. Variances add, so that

    alpha'^2 = alpha^2 + 2 / k

Reference: Toksvig 2005, "Mipmapping normal maps", for the length of the mean; Han et al. 2007, "Frequency domain normal
map filtering", for the distribution.
"""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int, Num

from jaxprt.compile import jit
from jaxprt.scene.mesh import Mesh
from jaxprt.sphere import directions

WRAPS = ("repeat", "mirror", "clamp")  # beyond the edges: the image again, its mirror image, or its border texels
_LOWEST = 0.1  # least ratio of a normal's height to its slope: lower normals are raised to it
_FLAT = 1e-3  # Below this, slopes may be rounding errors: a normal without height is then that of the surface.


def mipmap(image: Float[Array | np.ndarray, "h w c"]) -> list[Array | np.ndarray]:
    """The levels of an image's mip map, finest first; in NumPy unless JAX traces the image.

    Each level averages the level before over texels of twice the edge. Odd sizes are halved and rounded up. Texels at
    the border are then weighted by the area that they cover.
    """
    result: list[Array | np.ndarray] = [image if isinstance(image, Tracer) else np.asarray(image)]
    while max(result[-1].shape[:2]) > 1:
        result.append(_halve(_halve(result[-1], 0), 1))
    return result


def _halve(image: Array | np.ndarray, axis: int) -> Array | np.ndarray:
    size = image.shape[axis]
    count = -(-size // 2)
    if size == 2 * count:
        pairs = image.reshape(*image.shape[:axis], count, 2, *image.shape[axis + 1 :])
        return pairs.mean(axis + 1)
    step = size / count
    edge = np.arange(count + 1) * step
    first = np.floor(edge[:-1] + 1e-9).astype(np.int64)
    total: Any = 0.0
    for tap in range(3):
        texel = np.minimum(first + tap, size - 1)
        covered = np.minimum(first + tap + 1, edge[1:]) - np.maximum(first + tap, edge[:-1])
        weight = np.maximum(covered, 0) / step
        wide = [-1 if number == axis else 1 for number in range(image.ndim)]
        total = total + image.take(texel, axis) * weight.reshape(wide).astype(image.dtype)
    return total


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
    x = _wrap(coordinate[..., 0], wrap[0]) * width - 0.5
    y = (1 - _wrap(coordinate[..., 1], wrap[1])) * height - 0.5
    column, row = jnp.floor(x), jnp.floor(y)
    right, down = x - column, y - row
    result = []
    for below, v in ((0, 1 - down), (1, down)):
        line = _inside(row.astype(jnp.int32) + below, height, wrap[1])
        for beside, u in ((0, 1 - right), (1, right)):
            result.append(((line, _inside(column.astype(jnp.int32) + beside, width, wrap[0])), v * u))
    return result


def _wrap(place: Float[Array, "*b"], wrap: str) -> Float[Array, "*b"]:
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
    corner, place = (np.asarray(value, np.float64)[face] for value in (mesh.position, mesh.texture))
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
    """
    if mesh.texture is None:
        raise ValueError("the mesh must have texture coordinates, got none: give them to `jaxprt.scene.mesh.make_mesh`")
    face = np.asarray(mesh.face)
    place = np.asarray(mesh.texture, np.float64)[face]
    covered = np.linalg.det(place[:, 1:] - place[:, :1])
    total = np.bincount(face.ravel(), np.repeat(covered, 3), len(mesh.position))
    return np.where(total < 0, -1.0, 1.0)


def unit_normals(image: Any) -> Any:
    """A normal map with all normals scaled to unit length; zero normals become that of the surface.

    Args:
        image: Texels [h w c] with (normal + 1) / 2 in their first three channels. Maps of fewer channels are returned
            as they are. In NumPy unless JAX traces the image.
    """
    xp: Any = jnp if isinstance(image, Tracer) else np
    texel = xp.asarray(image)
    if texel.shape[2] < 3:
        return texel
    normal = 2 * texel[..., :3] - 1
    square = xp.sum(normal**2, -1, keepdims=True)
    zero = square < np.finfo(np.float32).eps
    unit = xp.where(zero, xp.asarray([0.0, 0.0, 1.0], texel.dtype), normal / xp.sqrt(xp.where(zero, 1, square)))
    return (unit + 1) / 2


def tilt_normals(
    frame: Float[Array | np.ndarray, "p 3 3"],
    handedness: Num[Array | np.ndarray, " p"],
    mean: Float[Array | np.ndarray, "p 3"],
    scale: Float[Array | np.ndarray, " p"],
) -> Float[Array, "p 3"]:
    """Unit normals in world space.

    Normals that point along the surface or below it are raised to about six degrees above it, so that they are lit.

    Args:
        frame: Shading frames of the smooth surface; rows are tangent, bitangent, normal.
        handedness: -1 where the bitangent of the texture coordinates is opposite to that of the frame, 1 elsewhere.
        mean: Mean normals of the map in the frame of the texture coordinates, of any length.
        scale: Factor of the first two components.
    """
    x, y = mean[:, 0] * scale, mean[:, 1] * scale * handedness
    square = x**2 + y**2
    flat = square < _FLAT**2
    slope = jnp.where(flat, 0, jnp.sqrt(jnp.where(flat, 1, square)))
    height = jnp.maximum(mean[:, 2], _LOWEST * slope)
    height = jnp.where(flat & (height < _FLAT), 1, height)
    local = jnp.stack([x, y, height], -1)
    return directions.normalize(sum(local[:, i, None] * frame[:, i] for i in range(3)))


def normal_variance(
    mean: Float[Array | np.ndarray, "p 3"],
    scale: Float[Array | np.ndarray, " p"],
    footprint: Float[Array | np.ndarray, " p"],
) -> Float[Array, " p"]:
    """Variance along one axis, in squared radians, of the normals that a pixel averages.

    Between texels of a map that is seen magnified, the mean of their normals is shorter too, although the pixel sees
    one normal. The variance is therefore reduced where a pixel covers less than a texel.

    Args:
        mean: Mean of the unit normals of the map.
        scale: Factor of the slopes of the map.
        footprint: Longest edge of the footprint with which the map is read, in texels.
    """
    square = jnp.clip(jnp.sum(mean**2, -1), 1e-4, 1)
    length = jnp.sqrt(square)
    inverse = (1 - square) / (length * (3 - square))  # 1 / k, as of Banerjee et al. 2005
    return inverse * scale**2 * jnp.minimum(footprint, 1) ** 2


def widen_roughness(
    roughness: Float[Array | np.ndarray, " p"], variance: Float[Array | np.ndarray, " p"]
) -> Float[Array, " p"]:
    """Roughness, the square root of alpha, of a surface whose normals have a variance along one axis; at most 1."""
    spread = variance > 0
    wide = jnp.where(spread, roughness, 1) ** 4 + 2 * variance
    return jnp.where(spread, jnp.minimum(jnp.sqrt(jnp.sqrt(wide)), jnp.maximum(roughness, 1)), roughness)
