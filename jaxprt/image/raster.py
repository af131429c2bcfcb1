"""Rasterization: finds the triangle that each pixel, or each of its samples, sees.

Triangles are drawn in homogeneous coordinates (Olano and Greer 1997), without clipping. A pixel is inside if the three
determinants of the pixel and two vertices have the same sign. Every vertex is scaled to w = +1 or -1. The sign of a
determinant is then a comparison of two products, and both triangles at a shared edge compute the same two products, in
any precision.
"""

import functools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from jaxprt import require
from jaxprt.compile import jit, kept
from jaxprt.image import arguments
from jaxprt.scene.camera import Camera, in_common_coordinates
from jaxprt.scene.mesh import Mesh

CHUNK = 1 << 13  # patches per step on CPUs
WIDE = 1 << 18  # patches per step on GPUs, where few large steps are fastest
FACES = (1 << 24) - 1  # largest number of triangles whose indices float32 represents exactly
PATCH = {1: 3, 2: 4}  # edge of the square patches that triangles are cut into, in cells, by cells per pixel edge
EDGE_ON = 1e-3  # sine of the angle between triangle and view direction below which both sides count as front
TILE = 8  # edge in cells (one per sample) of the tiles whose farthest depth culls hidden triangles


# Positions of a pixel's samples, in pixels to the right and down from its center. The four samples lie on a rotated
# grid: each has its own column and row. They are the cells of a grid twice as fine, whose centers are shifted by SHIFT
# cells: to the right in even rows, to the left in odd rows, up in even columns and down in odd columns.
SHIFT = 0.25
SAMPLES = {1: np.zeros((1, 2)), 4: np.array([[-1, -3], [3, -1], [-3, 1], [1, 3]]) / 8}


class Narrow(eqx.Module):
    """Depth buffer for CPUs. It draws one pixel of all patches after another, so that data stays in the cache.

    Entries are complex numbers, depth + i * triangle index. Their minimum compares real parts first and imaginary
    parts second, so that one scatter finds both depth and index.
    """

    nearest: Complex[Array, " p"]

    @staticmethod
    def blank(count: int, dtype) -> "Narrow":
        """Samples that show nothing."""
        return Narrow(jnp.full(count, jax.lax.complex(jnp.array(jnp.inf, dtype), jnp.array(-1, dtype))))

    @staticmethod
    def chunk(faces: int) -> int:
        """How many patches are drawn at once."""
        return min(CHUNK, -(-faces // 1024) * 1024)

    def depth(self, dtype) -> Float[Array, " p"]:
        """Depths, infinite where nothing is seen."""
        return self.nearest.real.astype(dtype)

    def triangle(self) -> Int[Array, " p"]:
        """Numbers of triangles, -1 where nothing is seen."""
        return self.nearest.imag.astype(jnp.int32)

    def drawn(self, pixel: Callable, count: int, number: Int[Array, " n"]) -> "Narrow":
        """A buffer in which patches of some triangles have been drawn.

        Args:
            pixel: Function from the index of a pixel within a patch to the sample of this pixel in each patch, and its
                depth.
            count: Number of pixels of a patch.
            number: Index of the triangle that each patch belongs to.
        """

        def one(nearest, k):
            place, depth = pixel(k)
            key = jax.lax.complex(depth, number.astype(depth.dtype))
            return nearest.at[place].min(key, mode="promise_in_bounds"), None

        # A scan, because XLA would otherwise recompute the values of a patch for each of its pixels.
        return Narrow(jax.lax.scan(one, self.nearest, jnp.arange(count, dtype=jnp.int32))[0])


class Wide(eqx.Module):
    """Depth buffer for GPUs. It draws all pixels of many patches at once, first depths, then triangle indices.

    Depths are positive, so their bits as integers have the same order, and GPUs compute the minimum of integers in
    hardware. The methods are those of `Narrow`.
    """

    bits: Int[Array, " p"]
    number: Int[Array, " p"]

    @staticmethod
    def blank(count: int, dtype) -> "Wide":
        """Samples that show nothing."""
        return Wide(_bits(jnp.full(count, jnp.inf, dtype)), jnp.full(count, -1, jnp.int32))

    @staticmethod
    def chunk(faces: int) -> int:
        """How many patches are drawn at once."""
        return WIDE

    def depth(self, dtype) -> Float[Array, " p"]:
        """Depths, infinite where nothing is seen."""
        return jax.lax.bitcast_convert_type(self.bits, dtype)

    def triangle(self) -> Int[Array, " p"]:
        """Numbers of triangles, -1 where nothing is seen."""
        return self.number

    def drawn(self, pixel: Callable, count: int, number: Int[Array, " n"]) -> "Wide":
        """A buffer in which patches of some triangles have been drawn."""
        place, depth = jax.vmap(pixel)(jnp.arange(count, dtype=jnp.int32))
        bits = self.bits.at[place].min(_bits(depth), mode="promise_in_bounds")
        most = jnp.iinfo(jnp.int32).max
        hidden = jnp.where(bits < self.bits, most, self.number)  # the previous nearest triangle is hidden
        wins = jnp.isfinite(depth) & (_bits(depth) == bits[place])
        return Wide(bits, hidden.at[place].min(jnp.where(wins, number, most), mode="promise_in_bounds"))


def _bits(depth: Float[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.bitcast_convert_type(depth, jnp.int32 if depth.dtype == jnp.float32 else jnp.int64)


class Fragments(eqx.Module):
    """What each pixel sees, or each of its samples. With several samples per pixel, fields have an axis of samples.

    Attributes:
        triangle: Index of the nearest triangle; -1 where there is none.
        barycentric: Perspective-correct barycentric coordinates. They sum to 1, or are 0 where nothing is seen. None
            with several samples per pixel: `shading_points` returns those of the shading points.
        depth: Distance along the view axis in world units, infinite where nothing is seen.
    """

    triangle: Int[Array, "h w *s"]
    barycentric: Float[Array, "h w 3"] | None
    depth: Float[Array, "h w *s"]


@require.arguments(mesh=arguments.a_mesh, camera=arguments.a_camera, samples=arguments.samples)
@in_common_coordinates
@functools.partial(kept, static=("samples",), quick=True)
def rasterize(mesh: Mesh, camera: Camera, *, samples: int = 1) -> Fragments:
    """Finds the nearest triangle at the center of each pixel, or at four samples of each pixel.

    Both sides of a triangle are drawn, and triangles may extend behind the camera. A sample on a shared edge or vertex
    belongs to exactly one of the adjacent triangles: the tie is broken as if the sample were moved to the right by an
    infinitesimal amount, and down by a much smaller one. Among equal depths the triangle with the lowest index wins.
    Degenerate triangles, and those with vertices that are not finite, are not drawn. The result has zero derivatives.
    In float32, depths of triangles a thousand times larger than their distance have four correct digits.

    Args:
        mesh: The mesh to draw.
        camera: The camera.
        samples: Samples per pixel: 1 for centers, with fields [h, w], or 4 for a rotated grid, with fields [h, w, 4].

    Raises:
        ValueError: The mesh has no triangle or more than 2^24 - 1, or `samples` is neither 1 nor 4.

    Reference: Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".
    """
    if not isinstance(samples, int) or samples not in SAMPLES:
        raise ValueError(f"samples must be 1 or 4, got {samples!r}")
    if not 0 < mesh.face.shape[0] <= FACES:
        raise ValueError(f"rasterize needs 1 to {FACES} triangles, got {mesh.face.shape[0]} triangles")
    mesh, camera = jax.lax.stop_gradient((mesh, camera))
    x, y, q = (axis[mesh.face.T] for axis in project(mesh.position, camera))
    depth, triangle = _nearest(x, y, q, camera.height, camera.width, samples)
    if samples > 1:
        return Fragments(triangle, None, depth)
    depth, triangle = depth[..., 0], triangle[..., 0]
    return Fragments(triangle, _barycentric(triangle, x, y, q, camera), depth)


@in_common_coordinates
@jit
def barycentric(triangle: Int[Array, "h w"], mesh: Mesh, camera: Camera) -> Float[Array, "h w 3"]:
    """Barycentric coordinates of pixel centers in given triangles, perspective-correct; 0 where there is none (-1)."""
    x, y, q = (axis[mesh.face.T] for axis in project(mesh.position, camera))
    return _barycentric(triangle, x, y, q, camera)


@in_common_coordinates
@jit
def front(fragments: Fragments, mesh: Mesh, camera: Camera) -> Bool[Array, "h w *s"]:
    """Whether each pixel or sample shows the front of a surface; backs are black. `front_faces` defines the front."""
    return front_faces(mesh, camera)[fragments.triangle] & (fragments.triangle >= 0)


@in_common_coordinates
@jit
def front_faces(mesh: Mesh, camera: Camera) -> Bool[Array, " f"]:
    """Whether the camera sees the front of each triangle: the side to which its shading normals point.

    Visibility of a side is decided by the triangle's plane. Shading normals of a coarse mesh may face away from the eye
    although the triangle does not; they only determine which of its two sides is the front. If the mean shading normal
    is zero, both sides are fronts.
    """
    mesh, camera = jax.lax.stop_gradient((mesh, camera))
    vertex = jnp.concatenate([mesh.position - camera.eye, mesh.normal], -1)
    x, y, z, *normal = jax.lax.map(lambda axis: axis[mesh.face.T], vertex.T)
    middle, edge, other = (
        [op(coordinate) for coordinate in (x, y, z)] for op in (sum, lambda c: c[1] - c[0], lambda c: c[2] - c[0])
    )
    plane = [edge[i - 2] * other[i - 1] - edge[i - 1] * other[i - 2] for i in range(3)]
    side = sum(plane[i] * sum(normal[i]) for i in range(3))
    distance = -sum(plane[i] * middle[i] for i in range(3))
    # Rounding may flip triangles that are seen edge-on.
    plain = EDGE_ON * jnp.sqrt(sum(component**2 for component in plane) * sum(component**2 for component in middle))
    return (jnp.sign(side) * distance >= -plain) | (side == 0)


@in_common_coordinates
@jit
def ray_direction(camera: Camera) -> Float[Array, "h w 3"]:
    """Unit directions in world coordinates from the eye through the center of every pixel."""
    column, row = _centers(camera)
    x, y, axis = column / _focal(camera), -row / _focal(camera), view_axes(camera)
    length = jnp.sqrt(x**2 + y**2 + 1)
    return jnp.stack([(x * axis[0, i] + y * axis[1, i] + axis[2, i]) / length for i in range(3)], -1)


@in_common_coordinates
@jit
def view_axes(camera: Camera) -> Float[Array, "3 3"]:
    """The camera's right, up and forward directions in world coordinates, as rows of unit vectors.

    If `up` is zero or parallel to the view, the world axis farthest from the view direction is used instead.
    """
    forward = _unit(jnp.asarray(camera.target) - camera.eye)
    fallback = jnp.eye(3, dtype=forward.dtype)[jnp.argmin(jnp.abs(forward))]
    right = jnp.cross(forward, _unit(camera.up))
    parallel = jnp.sum(right**2) < jnp.finfo(forward.dtype).eps
    right = _unit(jnp.where(parallel, jnp.cross(forward, fallback), right))
    return jnp.stack([right, jnp.cross(right, forward), forward])


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """The vector scaled to unit length; zero stays zero."""
    square = jnp.sum(vector**2)
    return vector / jnp.sqrt(jnp.where(square > 0, square, 1))


def _focal(camera: Camera) -> Float[Array, ""]:
    """Distance of the image plane in pixels."""
    return camera.height / (2 * jnp.tan(camera.field_of_view / 2))


def _centers(camera: Camera) -> tuple[Float[Array, "1 w"], Float[Array, "h 1"]]:
    """Coordinates of pixel centers, to the right and down from the center of the picture."""
    column = jnp.arange(camera.width, dtype=camera.eye.dtype)[None] + (1 - camera.width) / 2
    row = jnp.arange(camera.height, dtype=camera.eye.dtype)[:, None] + (1 - camera.height) / 2
    return column, row


def project(position: Float[Array, "v 3"], camera: Camera) -> tuple[Float[Array, " v"], ...]:
    """Vertices as (x, y, q): homogeneous pixel coordinates scaled to w = +1 or -1, and q = 1 / (w before that).

    Pixels are counted to the right and down from the center of the picture, where coordinates are then most accurate.
    A vertex with w close to zero is moved off the plane of the eye by a millionth of its distance. All of its triangles
    use the moved vertex, so nothing overflows and no gap opens.
    """
    relative = position - camera.eye
    right, up, w = jnp.einsum("vi,ji->jv", relative, view_axes(camera), precision="highest")
    least = 1e-6 * jnp.sqrt(right**2 + up**2 + w**2) + jnp.finfo(w.dtype).tiny
    w = jnp.where(w < 0, jnp.minimum(w, -least), jnp.maximum(w, least))
    q = 1 / w
    scale = _focal(camera) * jnp.abs(q)
    return right * scale, -up * scale, q


def _determinants(x, y, q, column, row):
    """Twice the signed areas of a pixel and the edge opposite each vertex, and their signs."""
    s = [jnp.sign(q[i]) for i in range(3)]
    a = [x[i] - s[i] * column for i in range(3)]
    b = [y[i] - s[i] * row for i in range(3)]
    value, positive = [], []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        left, right = a[i] * b[j], a[j] * b[i]
        along_x, against_x = y[i] * s[j], y[j] * s[i]
        along_y, against_y = x[j] * s[i], x[i] * s[j]
        # A tie is broken as if the pixel were moved right by an infinitesimal amount, and down by a much smaller one.
        tie = (along_x > against_x) | ((along_x == against_x) & (along_y > against_y))
        value.append(left - right)
        # Comparing the products, rather than subtracting, gives signs that fused multiply-adds cannot change.
        positive.append((left > right) | ((left == right) & tie))
    return value, positive


def _barycentric(triangle: Int[Array, "h w"], x, y, q, camera: Camera) -> Float[Array, "h w 3"]:
    """Perspective-correct barycentric coordinates in the triangle that each pixel sees; 0 where it sees none."""
    index = jnp.maximum(triangle, 0)
    # A map, because XLA would otherwise fuse the gathers into their uses and repeat them for each coordinate.
    x, y, q = jax.lax.map(lambda axes: tuple(axis[index] for axis in axes), (x, y, q))
    column, row = _centers(camera)
    value, _ = _determinants(x, y, q, column, row)
    weight = jnp.stack([jnp.abs(value[i] * q[i]) for i in range(3)], axis=-1)
    return jnp.where((triangle >= 0)[..., None], weight / jnp.sum(weight, axis=-1, keepdims=True), 0)


def _cover(x, y, q, column, row):
    """Depths of triangles at pixels; infinite where the pixel is outside the triangle."""
    value, positive = _determinants(x, y, q, column, row)
    above = sum(v * jnp.sign(q[i]) for i, v in enumerate(value))
    below = sum(v * jnp.abs(q[i]) for i, v in enumerate(value))
    ahead = jnp.where(positive[0], above > 0, above < 0)
    inside = (positive[0] == positive[1]) & (positive[1] == positive[2]) & ahead
    return jnp.where(inside, above / below, jnp.inf)


def _bounds(x, y, q, height: int, width: int, shift: float):
    """First column, first row, and numbers of columns and rows of the pixels that triangles may cover."""
    s = jnp.sign(q)
    ahead = (q[0] > 0) & (q[1] > 0) & (q[2] > 0)
    drawn = (q[0] > 0) | (q[1] > 0) | (q[2] > 0)

    def span(c, size: int):
        low, high = jnp.minimum(jnp.minimum(c[0], c[1]), c[2]), jnp.maximum(jnp.maximum(c[0], c[1]), c[2])
        left = [c[i] + s[i] * size / 2 for i in range(3)]
        right = [c[i] - s[i] * size / 2 for i in range(3)]
        outside = jnp.maximum(jnp.maximum(left[0], left[1]), left[2]) < 0
        outside |= jnp.minimum(jnp.minimum(right[0], right[1]), right[2]) > 0
        middle = (size - 1) / 2
        # Samples lie up to `shift` from the center of their pixel.
        first = jnp.where(ahead, jnp.clip(jnp.ceil(low + (middle - shift)), 0, size), 0).astype(jnp.int32)
        last = jnp.where(ahead, jnp.clip(jnp.floor(high + (middle + shift)), -1, size - 1), size - 1).astype(jnp.int32)
        finite = jnp.isfinite(low) & jnp.isfinite(high)
        return first, jnp.where(drawn & finite & ~outside, jnp.maximum(last - first + 1, 0), 0)

    column, columns = span(x, width)
    row, rows = span(y, height)
    return column, row, columns, rows


def _nearest(x, y, q, height: int, width: int, samples: int) -> tuple[Float[Array, "h w s"], Int[Array, "h w s"]]:
    """Depth and index of the nearest triangle at every sample. Triangles that face the camera are drawn first."""
    fine = math.isqrt(samples)
    # Samples are drawn as the pixels, here called cells, of a picture of higher resolution.
    x, y = fine * x, fine * y
    bounds = _bounds(x, y, q, fine * height, fine * width, SHIFT if fine > 1 else 0.0)
    some = (bounds[2] > 0) & (bounds[3] > 0)
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    front = area < 0  # Rows go down, so counterclockwise areas are negative. For w < 0 either order is correct.
    shape = height, width, samples

    def drawn(form: type[Narrow] | type[Wide]):
        nearest = form.blank(math.prod(shape), x.dtype)
        nearest = _draw(nearest, some & front, x, y, q, bounds, fine * width, fine)
        hidden = _hidden_triangles(jnp.max(nearest.depth(x.dtype).reshape(shape), -1), q, bounds, TILE // fine)
        nearest = _draw(nearest, some & ~front & ~hidden, x, y, q, bounds, fine * width, fine)
        return nearest.depth(x.dtype).reshape(shape), nearest.triangle().reshape(shape)

    return jax.lax.platform_dependent(cpu=lambda: drawn(Narrow), default=lambda: drawn(Wide))


def _hidden_triangles(depth: Float[Array, "h w"], q, bounds, tile: int) -> Bool[Array, " f"]:
    """Triangles that lie behind everything drawn on the tiles that they touch. Large triangles are not tested."""
    # A tile's edge has TILE cells, which are `tile` pixels.
    column, row, columns, rows = bounds
    height, width = depth.shape
    padded = jnp.pad(depth, ((0, -height % tile), (0, -width % tile)))
    high, wide = padded.shape[0] // tile, padded.shape[1] // tile
    far = padded.reshape(high, tile, wide, tile).max((1, 3)).ravel()
    left, right = column // TILE, jnp.maximum(column + columns - 1, 0) // TILE
    top, bottom = row // TILE, jnp.maximum(row + rows - 1, 0) // TILE
    farthest = [far[i * wide + j] for i in (top, bottom) for j in (left, right)]
    farthest = jnp.maximum(jnp.maximum(farthest[0], farthest[1]), jnp.maximum(farthest[2], farthest[3]))
    nearest = 1 / jnp.maximum(jnp.maximum(q[0], q[1]), q[2])
    ahead = jnp.minimum(jnp.minimum(q[0], q[1]), q[2]) > 0
    small = (right - left <= 1) & (bottom - top <= 1)
    return ahead & small & (farthest < nearest * (1 - 1e-4))


def _draw(nearest: Narrow | Wide, drawn: Bool[Array, " f"], x, y, q, bounds, width: int, fine: int):
    """Draws some triangles into a depth buffer, by patches of their bounding boxes, in order, one chunk at a time."""
    faces, patch = q.shape[1], PATCH[fine]
    chunk = nearest.chunk(faces)
    height = len(jax.tree.leaves(nearest)[0]) // width
    column, row, columns, rows = bounds
    rank = _running_sum(drawn)
    number = jnp.zeros(faces + chunk, jnp.int32)
    number = number.at[jnp.where(drawn, rank - 1, faces + chunk)].set(jnp.arange(faces, dtype=jnp.int32), mode="drop")
    slot = jnp.arange(chunk, dtype=jnp.int32)

    def step(state):
        start, done, nearest = state
        # A step considers as many triangles as a chunk has patches, and draws the first of their remaining patches.
        t = jax.lax.dynamic_slice(number, (start,), (chunk,))
        across = jax.lax.div(columns[t] + (patch - 1), jnp.int32(patch))
        count = jnp.where(start + slot < rank[-1], across * jax.lax.div(rows[t] + (patch - 1), jnp.int32(patch)), 0)
        count = jnp.minimum(count.at[0].add(-done), chunk + 1)  # One more, to detect that some are left over.
        last = _running_sum(count)
        first = jnp.pad(last[:-1], (1, 0))
        begins = jnp.zeros(chunk, jnp.int32).at[jnp.where(count > 0, first, chunk)].set(1, mode="drop")
        owner = _running_sum(begins) - (count[0] > 0)  # The previous step may have finished the first triangle.

        part = slot - first[owner] + jnp.where(owner == 0, done, 0)
        t, wide = t[owner], jnp.maximum(across[owner], 1)
        left, top = column[t] + jax.lax.rem(part, wide) * patch, row[t] + jax.lax.div(part, wide) * patch
        right, bottom = jnp.where(slot < last[-1], column[t] + columns[t], 0), row[t] + rows[t]
        corner = [[axis[i][t] for i in range(3)] for axis in (x, y, q)]

        def pixel(k):
            i, j = top + jax.lax.div(k, jnp.int32(patch)), left + jax.lax.rem(k, jnp.int32(patch))
            at = j.astype(x.dtype) + (1 - width) / 2, i.astype(x.dtype) + (1 - height) / 2
            inside = (i < bottom) & (j < right)
            i, j = jnp.minimum(i, height - 1), jnp.minimum(j, width - 1)
            place = i * width + j
            if fine > 1:
                lower, later = i & 1, j & 1
                at = at[0] + SHIFT * (1 - 2 * lower).astype(x.dtype), at[1] + SHIFT * (2 * later - 1).astype(x.dtype)
                place = (i >> 1) * (2 * width) + (j >> 1) * 4 + 2 * lower + later
            return place, jnp.where(inside, _cover(corner[0], corner[1], corner[2], *at), jnp.inf)

        nearest = nearest.drawn(pixel, patch * patch, t)

        over = last[-1] > chunk
        part = jnp.where(over, part[-1] + 1, 0)
        return start + jnp.where(over, owner[-1], chunk), part, nearest

    return jax.lax.while_loop(lambda state: state[0] < rank[-1], step, (jnp.int32(0), jnp.int32(0), nearest))[2]


def _running_sum(count: Int[Array, " n"] | Bool[Array, " n"]) -> Int[Array, " n"]:
    """Inclusive prefix sums of counts by products with triangular matrices, which are faster than XLA's on the CPU."""
    n = count.shape[0]
    block = jnp.pad(count.astype(jnp.float32), (0, -n % 128)).reshape(-1, 128)
    # Sums are exact to 2^24. Larger sums may be rounded or too small, but stay above 2^24.
    total = jnp.matmul(block, jnp.triu(jnp.ones((128, 128), jnp.float32)))
    total = jnp.minimum(total, 2.0**29).astype(jnp.int32)  # the sum of two still fits in an int32
    if n > 128:
        total = total + jnp.pad(_running_sum(total[:, -1])[:-1], (1, 0))[:, None]
    return total.ravel()[:n]
