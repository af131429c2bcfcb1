"""Rasterization: which triangle every pixel sees, and attributes carried from vertices to pixels.

Triangles are drawn in homogeneous coordinates (Olano and Greer 1997): nothing is clipped, a pixel is inside where the
three determinants of the pixel and two vertices have one sign. With every vertex scaled to w = +1 or -1 a determinant's
sign is the comparison of two products that a shared edge computes alike from both sides, in any precision.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from jaxprt.scene.camera import Camera
from jaxprt.scene.mesh import Mesh

FACES = (1 << 24) - 1  # Triangles whose numbers a float32 holds exactly.
PATCH = 3  # Pixels along the edge of the square patches that triangles are cut into.
CHUNK = 1 << 13  # Patches drawn at once; CHUNK * (CHUNK + 1) must fit in an int32.
TILE = 8  # Pixels along the edge of the tiles whose farthest depth hides what lies behind.


class Fragments(eqx.Module):
    """What every pixel sees.

    Attributes:
        triangle: Number of the nearest triangle at the pixel's center, -1 where there is none.
        barycentric: Perspective-correct weights of its three vertices; they sum to 1, or are 0 where nothing is seen.
        depth: Distance along the view axis in world units, infinite where nothing is seen.
    """

    triangle: Int[Array, "h w"]
    barycentric: Float[Array, "h w 3"]
    depth: Float[Array, "h w"]


@jax.jit
def rasterize(mesh: Mesh, camera: Camera) -> Fragments:
    """Finds the nearest triangle at every pixel's center.

    Both sides of a triangle are drawn, and triangles may reach behind the camera. A center on a shared edge or vertex
    belongs to exactly one of the triangles around it: as if it lay a hair's breadth to the right, and a hair's of that
    further down. Among equal depths the triangle with the lowest number wins. Triangles without area or with vertices
    that are not finite draw nothing. The result is constant for derivatives. In
    float32 depths of triangles a thousand times larger than their distance are good to four digits.

    Raises:
        ValueError: The mesh has no triangle or more than 2^24 - 1, or the picture has no pixel.

    Reference: Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".
    """
    if not 0 < mesh.face.shape[0] <= FACES or camera.width < 1 or camera.height < 1:
        raise ValueError(
            f"rasterize needs 1 to {FACES} triangles and at least one pixel, got "
            f"{mesh.face.shape[0]} triangles and {camera.height} x {camera.width} pixels"
        )
    mesh, camera = jax.lax.stop_gradient((mesh, camera))
    x, y, q = (axis[mesh.face.T] for axis in _project(mesh.position, camera))
    depth, triangle = _nearest(x, y, q, camera.height, camera.width)
    return Fragments(triangle, _barycentric(triangle, x, y, q, camera), depth)


@jax.jit
def interpolate(
    fragments: Fragments, face: Int[Array, "f 3"], attribute: Float[Array, "v *c"]
) -> Float[Array, "h w *c"]:
    """Carries an attribute of the vertices to the pixels.

    Zero where nothing is seen. Linear, hence differentiable, in the attribute; the derivative with respect to a
    vertex is the weight that the pixels give it.
    """
    seen = fragments.triangle >= 0
    vertex = face[jnp.maximum(fragments.triangle, 0)]
    wide = (*seen.shape, *(1,) * (attribute.ndim - 1))
    floating = jnp.issubdtype(attribute.dtype, jnp.floating)
    weight = fragments.barycentric.astype(attribute.dtype) if floating else fragments.barycentric
    total = sum(weight[..., i].reshape(wide) * attribute[vertex[..., i]] for i in range(3))
    return jnp.where(seen.reshape(wide), total, 0)


@jax.jit
def render(
    mesh: Mesh, color: Float[Array, "v c"], camera: Camera, *, background: Float[Array, "h w c"] | None = None
) -> Float[Array, "h w c"]:
    """Draws a mesh whose vertices have colors.

    Differentiable in the colors and the background, constant in the geometry and the camera. Callers that draw one
    view many times keep the result of `rasterize` and call `interpolate`.

    Args:
        mesh: What is drawn. Its back, see `front`, is black.
        color: Linear radiance of each vertex towards the camera.
        camera: From where.
        background: What is seen past the mesh; black if not given.

    Raises:
        ValueError: There is not one color per vertex, or as in `rasterize`.
    """
    if color.shape[:1] != mesh.position.shape[:1] or color.ndim != 2:
        raise ValueError(f"color must be [{mesh.position.shape[0]}, c], one per vertex, got {list(color.shape)}")
    fragments = rasterize(mesh, camera)
    image = jnp.where(front(fragments, mesh, camera)[..., None], interpolate(fragments, mesh.face, color), 0)
    if background is None:
        return image
    return jnp.where((fragments.triangle >= 0)[..., None], image, background)


@jax.jit
def front(fragments: Fragments, mesh: Mesh, camera: Camera) -> Bool[Array, "h w"]:
    """Whether each pixel shows the front of a surface: not all three vertices of its triangle look away from the eye.

    At silhouettes normals of a triangle point to both sides, and it counts as front. The back of a surface is black.
    """
    away = jnp.sum(mesh.normal * (camera.eye - mesh.position), -1) < 0
    return ~jnp.all(away[mesh.face], -1)[fragments.triangle] & (fragments.triangle >= 0)


@jax.jit
def ray_direction(camera: Camera) -> Float[Array, "h w 3"]:
    """Unit directions in the world from the eye through the center of every pixel."""
    column, row = _centers(camera)
    x, y = jnp.broadcast_arrays(column / _focal(camera), -row / _focal(camera))
    direction = jnp.stack([x, y, jnp.ones_like(x)], axis=-1) @ view_axes(camera)
    return direction / jnp.linalg.norm(direction, axis=-1, keepdims=True)


def view_axes(camera: Camera) -> Float[Array, "3 3"]:
    """Right, up and forward of the camera as rows of unit vectors in the world.

    Where `up` is parallel to the view or zero, the axis of the world that is farthest from the view takes its place.
    """
    forward = _unit(camera.target - camera.eye)
    fallback = jnp.eye(3, dtype=forward.dtype)[jnp.argmin(jnp.abs(forward))]
    right = jnp.cross(forward, _unit(camera.up))
    parallel = jnp.sum(right**2) < jnp.finfo(forward.dtype).eps
    right = _unit(jnp.where(parallel, jnp.cross(forward, fallback), right))
    return jnp.stack([right, jnp.cross(right, forward), forward])


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """A vector at unit length; zero stays zero."""
    square = jnp.sum(vector**2)
    return vector / jnp.sqrt(jnp.where(square > 0, square, 1))


def _focal(camera: Camera) -> Float[Array, ""]:
    """Distance of the picture plane in pixels."""
    return camera.height / (2 * jnp.tan(camera.field_of_view / 2))


def _centers(camera: Camera) -> tuple[Float[Array, "1 w"], Float[Array, "h 1"]]:
    """Pixels' centers to the right and down from the picture's middle."""
    column = jnp.arange(camera.width, dtype=camera.eye.dtype)[None] + (1 - camera.width) / 2
    row = jnp.arange(camera.height, dtype=camera.eye.dtype)[:, None] + (1 - camera.height) / 2
    return column, row


def _project(position: Float[Array, "v 3"], camera: Camera) -> tuple[Float[Array, " v"], ...]:
    """Vertices as (x, y, q): homogeneous pixel coordinates scaled to w = +1 or -1, and q = 1 / (w before that).

    Pixels are counted to the right and down from the picture's middle, so that vertices near it keep their digits.
    A vertex whose w is next to nothing is moved off the plane of the eye by a millionth of its distance, the same
    way for all of its triangles, so that nothing overflows and no edge opens.
    """
    relative = position - camera.eye
    right, up, w = jnp.einsum("vi,ji->jv", relative, view_axes(camera), precision="highest")
    least = 1e-6 * jnp.sqrt(right**2 + up**2 + w**2) + jnp.finfo(w.dtype).tiny
    w = jnp.where(w < 0, jnp.minimum(w, -least), jnp.maximum(w, least))
    q = 1 / w
    focal = _focal(camera) * jnp.abs(q)
    return right * focal, -up * focal, q


def _determinants(x, y, q, column, row):
    """Twice the signed areas between a pixel and the sides opposite each vertex, and their signs.

    Each is the difference of two products that trade places where the neighbor runs along the same side in the other
    direction. The sign comes from comparing the products, which no contraction to a fused multiply-add can change. A
    tie is decided as if the pixel were moved to the right by very little, and down by very little of that.
    """
    s = [jnp.sign(q[i]) for i in range(3)]
    a = [x[i] - s[i] * column for i in range(3)]
    b = [y[i] - s[i] * row for i in range(3)]
    value, positive = [], []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        left, right = a[i] * b[j], a[j] * b[i]
        along_x, against_x = y[i] * s[j], y[j] * s[i]
        along_y, against_y = x[j] * s[i], x[i] * s[j]
        tie = (along_x > against_x) | ((along_x == against_x) & (along_y > against_y))
        value.append(left - right)
        positive.append((left > right) | ((left == right) & tie))
    return value, positive


def _barycentric(triangle: Int[Array, "h w"], x, y, q, camera: Camera) -> Float[Array, "h w 3"]:
    """Perspective-correct weights of the triangle that each pixel sees; 0 where it sees none."""
    index = jnp.maximum(triangle, 0)
    # A map, since XLA would else fuse the gathers into their uses and repeat them for each of the weights.
    x, y, q = jax.lax.map(lambda axes: tuple(axis[index] for axis in axes), (x, y, q))
    column, row = _centers(camera)
    value, _ = _determinants(x, y, q, column, row)
    weight = jnp.stack([jnp.abs(value[i] * q[i]) for i in range(3)], axis=-1)
    return jnp.where((triangle >= 0)[..., None], weight / jnp.sum(weight, axis=-1, keepdims=True), 0)


def _cover(x, y, q, column, row):
    """Depths of triangles at pixels, infinite where the pixel is outside."""
    value, positive = _determinants(x, y, q, column, row)
    above = sum(v * jnp.sign(q[i]) for i, v in enumerate(value))
    below = sum(v * jnp.abs(q[i]) for i, v in enumerate(value))
    ahead = jnp.where(positive[0], above > 0, above < 0)
    inside = (positive[0] == positive[1]) & (positive[1] == positive[2]) & ahead
    return jnp.where(inside, above / below, jnp.inf)


def _bounds(x, y, q, height: int, width: int):
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
        first = jnp.where(ahead, jnp.clip(jnp.ceil(low + middle), 0, size), 0).astype(jnp.int32)
        last = jnp.where(ahead, jnp.clip(jnp.floor(high + middle), -1, size - 1), size - 1).astype(jnp.int32)
        finite = jnp.isfinite(low) & jnp.isfinite(high)
        return first, jnp.where(drawn & finite & ~outside, jnp.maximum(last - first + 1, 0), 0)

    column, columns = span(x, width)
    row, rows = span(y, height)
    return column, row, columns, rows


def _nearest(x, y, q, height: int, width: int) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Depth and number of the nearest triangle at every pixel.

    Draws the triangles that face the camera, then those of the others that are not plainly behind what is drawn.
    """
    bounds = _bounds(x, y, q, height, width)
    some = (bounds[2] > 0) & (bounds[3] > 0)
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    front = area < 0  # Rows go down, so that counter-clockwise is negative. Where w < 0 the guess does not matter.
    nothing = jax.lax.complex(jnp.array(jnp.inf, x.dtype), jnp.array(-1, x.dtype))
    nearest = _draw(jnp.full(height * width, nothing), some & front, x, y, q, bounds, width)
    hidden = _hidden(nearest.real.reshape(height, width), q, bounds)
    nearest = _draw(nearest, some & ~front & ~hidden, x, y, q, bounds, width)
    nearest = nearest.reshape(height, width)
    return nearest.real, nearest.imag.astype(jnp.int32)


def _hidden(depth: Float[Array, "h w"], q, bounds) -> Bool[Array, " f"]:
    """Triangles that lie behind all that is drawn on the tiles they touch; large ones are not asked."""
    column, row, columns, rows = bounds
    height, width = depth.shape
    padded = jnp.pad(depth, ((0, -height % TILE), (0, -width % TILE)))
    high, wide = padded.shape[0] // TILE, padded.shape[1] // TILE
    far = padded.reshape(high, TILE, wide, TILE).max((1, 3)).ravel()
    left, right = column // TILE, jnp.maximum(column + columns - 1, 0) // TILE
    top, bottom = row // TILE, jnp.maximum(row + rows - 1, 0) // TILE
    farthest = [far[i * wide + j] for i in (top, bottom) for j in (left, right)]
    farthest = jnp.maximum(jnp.maximum(farthest[0], farthest[1]), jnp.maximum(farthest[2], farthest[3]))
    nearest = 1 / jnp.maximum(jnp.maximum(q[0], q[1]), q[2])
    ahead = jnp.minimum(jnp.minimum(q[0], q[1]), q[2]) > 0
    small = (right - left <= 1) & (bottom - top <= 1)
    return ahead & small & (farthest < nearest * (1 - 1e-4))


def _draw(nearest: Complex[Array, " p"], drawn: Bool[Array, " f"], x, y, q, bounds, width: int):
    """Draws some of the triangles over what is nearest so far: the complex numbers depth + i number.

    The minimum of complex numbers goes by the real part, then by the imaginary one, so that one scatter finds both.
    Cuts the pixels' box of every triangle into patches, and draws the patches of all triangles in order, CHUNK at a
    time: each step looks at the next CHUNK triangles and draws the first CHUNK of their patches that are still to do.
    """
    faces = q.shape[1]
    chunk = min(CHUNK, -(-faces // 1024) * 1024)
    height = nearest.shape[0] // width
    column, row, columns, rows = bounds
    rank = _running_sum(drawn)
    number = jnp.zeros(faces + chunk, jnp.int32)
    number = number.at[jnp.where(drawn, rank - 1, faces + chunk)].set(jnp.arange(faces, dtype=jnp.int32), mode="drop")
    slot = jnp.arange(chunk, dtype=jnp.int32)

    def step(state):
        start, done, nearest = state
        t = jax.lax.dynamic_slice(number, (start,), (chunk,))
        across = jax.lax.div(columns[t] + (PATCH - 1), jnp.int32(PATCH))
        count = jnp.where(start + slot < rank[-1], across * jax.lax.div(rows[t] + (PATCH - 1), jnp.int32(PATCH)), 0)
        count = jnp.minimum(count.at[0].add(-done), chunk + 1)  # One more, to tell that some are left over.
        last = _running_sum(count)
        first = last - count
        begins = jnp.zeros(chunk, jnp.int32).at[jnp.where(count > 0, first, chunk)].set(1, mode="drop")
        owner = _running_sum(begins) - (count[0] > 0)  # The first may have been finished by the step before.

        part = slot - first[owner] + jnp.where(owner == 0, done, 0)
        t, wide = t[owner], jnp.maximum(across[owner], 1)
        left, top = column[t] + jax.lax.rem(part, wide) * PATCH, row[t] + jax.lax.div(part, wide) * PATCH
        right, bottom = jnp.where(slot < last[-1], column[t] + columns[t], 0), row[t] + rows[t]
        corner = [[axis[i][t] for i in range(3)] for axis in (x, y, q)]
        identity = t.astype(x.dtype)

        def pixel(nearest, k):
            i, j = top + jax.lax.div(k, jnp.int32(PATCH)), left + jax.lax.rem(k, jnp.int32(PATCH))
            at = j.astype(x.dtype) + (1 - width) / 2, i.astype(x.dtype) + (1 - height) / 2
            d = _cover(corner[0], corner[1], corner[2], *at)
            d = jnp.where((i < bottom) & (j < right), d, jnp.inf)
            place = jnp.minimum(i, height - 1) * width + jnp.minimum(j, width - 1)
            return nearest.at[place].min(jax.lax.complex(d, identity), mode="promise_in_bounds"), None

        # A scan, since XLA would else compute what belongs to a patch anew for each of its pixels.
        nearest, _ = jax.lax.scan(pixel, nearest, jnp.arange(PATCH * PATCH, dtype=jnp.int32))

        over = last[-1] > chunk
        part = jnp.where(over, part[-1] + 1, 0)
        return start + jnp.where(over, owner[-1], chunk), part, nearest

    return jax.lax.while_loop(lambda state: state[0] < rank[-1], step, (jnp.int32(0), jnp.int32(0), nearest))[2]


def _running_sum(count: Int[Array, " n"] | Bool[Array, " n"]) -> Int[Array, " n"]:
    """Inclusive sums of counts by products with triangular matrices, four times faster than XLA's on the CPU.

    Exact to 2^24; sums beyond are rounded, but stay beyond.
    """
    n = count.shape[0]
    block = jnp.pad(count.astype(jnp.float32), (0, -n % 128)).reshape(-1, 128)
    total = jnp.matmul(block, jnp.triu(jnp.ones((128, 128), jnp.float32)), precision="highest").astype(jnp.int32)
    if n > 128:
        total = total + (_running_sum(total[:, -1]) - total[:, -1])[:, None]
    return total.ravel()[:n]
