"""Cubemaps: functions on the sphere as six square faces. Texel geometry and seamless lookup.

Faces are +x, -x, +y, -y, +z, -z, with rows and columns as in OpenGL. A point on a face has a column coordinate s and a
row coordinate t, both from -1 at the outer edge of the first texel to 1 at that of the last. They increase in these
directions:

    face   +x           -x            +y          -y            +z           -z
    s      -z           +z            +x          +x            +x           -x
    t      -y           -y            +z          -z            -y           -y

A direction is proportional to s S + t T + N, where S and T are these directions and N is the face's normal.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Int32

from jaxprt.compile import jit

_FRAME = np.array(
    [
        [[0, 0, -1], [0, -1, 0], [1, 0, 0]],
        [[0, 0, 1], [0, -1, 0], [-1, 0, 0]],
        [[1, 0, 0], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 0, -1], [0, -1, 0]],
        [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
        [[-1, 0, 0], [0, -1, 0], [0, 0, -1]],
    ],
    dtype=np.float64,
)  # The axes S, T and N of each face.


def direction(*, size: int) -> Float[Array, "6 n n 3"]:
    """Unit directions through the centers of the texels.

    Args:
        size: Edge of a face in texels.

    Returns:
        Unit directions in the world, one per texel.

    Raises:
        ValueError: `size` is below 1.
    """
    return _constant(_direction(size))


def point(*, size: int) -> Float[Array, "6 n n 3"]:
    """Centers of the texels on the surface of the cube [-1, 1]^3.

    Args:
        size: Edge of a face in texels.

    Returns:
        Points in the axes of the world, one per texel. They are directions that are not normalized.
    """
    return _constant(_point(size))


def _constant(value: Float[np.ndarray, "..."]) -> Array:
    """An array of the host in the default type, put on the device without a program."""
    return jax.device_put(value.astype(jnp.result_type(float)))


def axes() -> Float[np.ndarray, "6 3 3"]:
    """The axes S, T and N of each face: s S + t T + N is the point (s, t) on the face."""
    return _FRAME.copy()


def solid_angle(*, size: int) -> Float[Array, "6 n n"]:
    """Exact solid angles of the texels, in steradians; they sum to 4 pi.

    A rectangle from the center of a face to the point (s, t) covers arctan(s t / sqrt(1 + s^2 + t^2)).

    Args:
        size: Edge of a face in texels.

    Returns:
        Solid angles, in sr.

    Raises:
        ValueError: `size` is below 1.
    """
    return _constant(_solid_angle(size))


def vector_area(*, size: int) -> Float[Array, "6 n n 3"]:
    """Exact integral of the unit direction over the solid angle of each texel.

    Its dot product with a normal is the exact integral of the cosine over a texel that lies entirely above the normal's
    horizon. It is Lambert's formula for the irradiance of a polygon, in closed form.

    Args:
        size: Edge of a face in texels.

    Returns:
        Vectors in sr, slightly shorter than the solid angle.
    """
    return _constant(_vector_area(size))


@jit
def coordinates(direction: Float[Array, "*b 3"]) -> tuple[Int[Array, "*b"], Float[Array, "*b 2"]]:
    """The cubemap face that a direction hits, and the point on it.

    On an edge or a corner of the cube, it is the first of the faces that meet there. A zero direction gives the center
    of face +x, with finite gradients.

    Args:
        direction: Directions of any length.

    Returns:
        Index of the face, and the column and row coordinates (s, t) on it, in [-1, 1].
    """
    face, s, t = project(direction[..., 0], direction[..., 1], direction[..., 2])
    return face, jnp.stack([s, t], -1)


@jit
def project(
    x: Float[Array, "*b"], y: Float[Array, "*b"], z: Float[Array, "*b"]
) -> tuple[Int[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """`coordinates` for directions given by their components, which XLA fuses with the code that uses the result.

    Args:
        x: First component of the directions, of any length.
        y: Second component.
        z: Third component.

    Returns:
        Index of the face, column coordinate s and row coordinate t.
    """
    right, up, near = jnp.abs(x), jnp.abs(y), jnp.abs(z)
    along_x = (right >= up) & (right >= near)
    along_y = ~along_x & (up >= near)
    forward = jnp.where(along_x, x, jnp.where(along_y, y, z))
    back = forward < 0
    s = jnp.where(along_x, jnp.where(back, z, -z), jnp.where(along_y | ~back, x, -x))
    t = jnp.where(along_y, jnp.where(back, -z, z), -y)
    length = jnp.abs(forward)
    length = jnp.where(length > 0, length, 1)
    face = jnp.where(along_x, 0, jnp.where(along_y, 2, 4)) + back
    return face, s / length, t / length


def unproject(
    face: Int[Array, "*b"], s: Float[Array, "*b"], t: Float[Array, "*b"]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"], Float[Array, "*b"]]:
    """Directions, not normalized, from points on faces or beyond their edges: the inverse of `project`.

    Args:
        face: Index of the face.
        s: Column coordinate.
        t: Row coordinate.

    Returns:
        The components x, y and z.
    """
    along_x, along_y = face < 2, (face >= 2) & (face < 4)
    side = jnp.where(face % 2 == 1, -1, 1).astype(s.dtype)
    x = jnp.where(along_x, side, jnp.where(along_y, s, side * s))
    y = jnp.where(along_y, side, -t)
    z = jnp.where(along_x, -side * s, jnp.where(along_y, side * t, side))
    return x, y, z


@functools.partial(jit, static_argnames="sharpness")
def lookup(
    cubemap: Float[Array, "6 n n *c"], direction: Float[Array, "*b 3"], *, sharpness: int = 1
) -> Float[Array, "..."]:
    """Looks a cubemap up in given directions: bilinear, and continuous over the edges and corners of the cube.

    Beyond a face's outermost texel centers, texels of the neighboring face are used. At a corner of the cube, where
    only three texels meet, their mean replaces the fourth. Constants are reproduced exactly. Smooth functions are
    reproduced to second order, and to first order within half a texel of the cube's edges.

    Differentiable in both arguments. On the lines between texel centers the gradient with respect to direction is that
    of one side; with a sharpness above 1 it is the mean of both sides where a transition begins or ends.

    Args:
        cubemap: Texels with any trailing axes.
        direction: Directions of any length.
        sharpness: Values change between adjacent texels within 1 / sharpness of their distance. 1 is bilinear lookup.

    Returns:
        Values [*b, *c], in the data type of the cubemap.

    Raises:
        ValueError: `sharpness` is below 1.
    """
    if sharpness < 1:
        raise ValueError(f"sharpness must be at least 1, got {sharpness}")
    n = cubemap.shape[1]
    padded = pad(cubemap)
    face, place = coordinates(direction)
    place = (place.astype(cubemap.dtype) + 1) * (n / 2) + 0.5  # in texels; the border's first center is at 0
    corner = jnp.clip(jnp.floor(place), 0, n)
    weight = place - jax.lax.stop_gradient(corner)
    if sharpness > 1:
        weight = jnp.minimum(jnp.maximum((weight - 0.5) * sharpness + 0.5, 0), 1)
    column, row = jnp.moveaxis(corner.astype(jnp.int32), -1, 0)
    u, v = (weight[..., i].reshape(face.shape + (1,) * (cubemap.ndim - 3)) for i in range(2))

    def along_row(r):
        return _mix(padded[face, r, column], padded[face, r, column + 1], u)

    return _mix(along_row(row), along_row(row + 1), v)


def border_index(*, size: int) -> Int32[np.ndarray, "6 m m"]:
    """For every face with a border of one texel, the index of the texel that each texel copies.

    The border copies the texels of the neighboring faces along the edge. Its four corners, where a cube has no texel,
    copy the adjacent border texel of the face on the left or right.

    Args:
        size: Edge of a face in texels.

    Returns:
        Indices into the 6 size^2 texels in their order, with m = size + 2.
    """
    return _border_index(size).copy()


def _mix(first: Array, second: Array, weight: Array) -> Array:
    """Linear interpolation that is exact at both ends and for constants."""
    step = second - first
    return jnp.where(weight < 0.5, first + weight * step, second - (1 - weight) * step)


def pad(cubemap: Float[Array, "6 n n *c"]) -> Float[Array, "6 m m *c"]:
    """Adds a border of one texel from the neighboring faces to each face. Its corners are means of three texels."""
    n = cubemap.shape[1]
    texel, index = cubemap.reshape(6 * n * n, *cubemap.shape[3:]), _border_index(n)
    outer, inner = np.array([0, n + 1]), np.array([1, n])
    inside, beside, above = (
        texel[index[:, i[:, None], j]] for i, j in ((inner, inner), (inner, outer), (outer, inner))
    )
    corner = inside + ((beside - inside) + (above - inside)) / 3
    return texel[index].at[:, outer[:, None], outer].set(corner, unique_indices=True)


@functools.partial(jit, static_argnames="size")
def reduced(cubemap: Float[Array, "6 n n c"], *, size: int) -> Float[Array, "6 m m c"]:
    """A cubemap at lower resolution: means over groups of texels, weighted by their solid angles.

    Args:
        cubemap: Values at texels.
        size: Edge of the faces of the result in texels, a divisor of n.
    """
    large = cubemap.shape[1]
    if size < 1 or large % size:
        raise ValueError(f"size must be a divisor of {large}, got {size}")
    area = solid_angle(size=large)[..., None].astype(cubemap.dtype)
    folded = (6, size, large // size, size, large // size, -1)
    value, whole = (values.reshape(folded).sum((2, 4)) for values in (cubemap * area, area))
    return value / whole


def _check(size: int) -> None:
    if size < 1:
        raise ValueError(f"size must be at least 1, got {size}")


def _freeze(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def _mixed_difference(function, size: int) -> np.ndarray:
    """Integral over each texel of one face, from the antiderivative in s and t."""
    edge = np.linspace(-1, 1, size + 1)
    return np.diff(np.diff(function(edge[None, :], edge[:, None]), axis=0), axis=1)


@functools.lru_cache(maxsize=16)
def _point(size: int) -> np.ndarray:
    _check(size)
    center = (2 * np.arange(size) + 1) / size - 1
    t, s = np.meshgrid(center, center, indexing="ij")
    local = np.stack([s, t, np.ones_like(s)], axis=-1)
    return _freeze(np.einsum("ija,fac->fijc", local, _FRAME))


@functools.lru_cache(maxsize=16)
def _direction(size: int) -> np.ndarray:
    point = _point(size)
    return _freeze(point / np.linalg.norm(point, axis=-1, keepdims=True))


@functools.lru_cache(maxsize=16)
def _solid_angle(size: int) -> np.ndarray:
    _check(size)
    face = _mixed_difference(lambda s, t: np.arctan2(s * t, np.sqrt(1 + s**2 + t**2)), size)
    return _freeze(np.repeat(face[None], 6, axis=0))


@functools.lru_cache(maxsize=16)
def _vector_area(size: int) -> np.ndarray:
    _check(size)

    def tangential(s, t):  # antiderivative of s / (1 + s^2 + t^2)^2, the s component times solid angle per area
        length = np.sqrt(1 + s**2)
        return -np.arctan(t / length) / length / 2

    def forward(s, t):  # antiderivative of 1 / (1 + s^2 + t^2)^2
        return -(s * tangential(s, t) + t * tangential(t, s))

    parts = [tangential, lambda s, t: tangential(t, s), forward]
    local = np.stack([_mixed_difference(part, size) for part in parts], axis=-1)
    return _freeze(np.einsum("ija,fac->fijc", local, _FRAME))


@functools.lru_cache(maxsize=16)
def _border_index(size: int) -> np.ndarray:
    _check(size)
    half = 1 / size
    center = (2 * np.arange(-1, size + 1) + 1) / size - 1
    t, s = np.meshgrid(center, center, indexing="ij")
    # Fold texels beyond an edge onto the neighboring face, columns first: their centers are half a texel past the edge.
    past_column, past_row = np.abs(s) > 1, np.abs(t) > 1
    folded = past_column | past_row
    limit = 1 - half
    s = np.where(past_column, np.sign(s), s)
    t = np.where(past_column, np.clip(t, -limit, limit), np.where(past_row, np.sign(t), t))
    local = np.stack([s, t, np.where(folded, limit, 1)], axis=-1)
    world = np.einsum("ija,fac->fijc", local, _FRAME)

    # Inside a face neither s nor t reaches 1, so N is the largest axis; in the border S or T is the only one at 1.
    axis = np.abs(world).argmax(axis=-1)
    forward = np.take_along_axis(world, axis[..., None], axis=-1)[..., 0]
    face = 2 * axis + (forward < 0)
    place = np.einsum("fijac,fijc->fija", _FRAME[face][..., :2, :], world)
    column, row = np.moveaxis(np.clip(np.floor((place + 1) * size / 2).astype(np.int32), 0, size - 1), -1, 0)
    return _freeze(((face * size + row) * size + column).astype(np.int32))


@functools.partial(jit, static_argnames=("edge",))
def coarse(radiance: Float[Array, "6 n n c"], *, edge: int) -> Float[Array, "l c"]:
    """Radiance of the texels of coarser faces. Each texel is distributed bilinearly to four coarse texels around it.

    A small sun thus keeps its position to second order; nearest-texel averaging would move it to a texel's center.
    Constant light is preserved exactly, and flux approximately.

    Args:
        radiance: Radiance of the fine texels.
        edge: Edge of the coarse faces in texels.
    """
    size = radiance.shape[1]
    if edge < 1 or size % edge:
        raise ValueError(f"the edge of coarse faces must divide the edge of the light's faces, {size}, got {edge}")
    area, way = solid_angle(size=size)[..., None], direction(size=size)
    flux = jnp.concatenate([radiance * area, jnp.broadcast_to(area, radiance[..., :1].shape)], -1)
    shape = jax.ShapeDtypeStruct((6, edge, edge, flux.shape[-1]), flux.dtype)
    (total,) = jax.linear_transpose(lambda faces: lookup(faces, way), shape)(flux)
    return (total[..., :-1] / total[..., -1:]).reshape(6 * edge * edge, -1)
