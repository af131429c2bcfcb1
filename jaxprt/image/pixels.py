"""Anti-aliased pictures of meshes: shading points, interpolation, and resolving to pixels.

As in multisample anti-aliasing, coverage is measured at all samples of a pixel, but radiance at only one point for each
surface that the pixel shows. Where it varies within a pixel, it is measured at each sample, or at four points in place
of each, which rays find.

Opaque surfaces are rasterized. Rays through the samples collect the surfaces with an opacity in front of them. Each
sample then sees a list of surfaces, from front to back, of which each hides the share `opacity` of the next ones. Glass
colors what it lets through, and is itself seen whole.
"""

import dataclasses
import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Float32, Int, UInt8

from jaxprt import require
from jaxprt.compile import Between, finished, jit, known
from jaxprt.image import arguments, raster
from jaxprt.image.raster import SAMPLES, Fragments, ray_direction
from jaxprt.scene import environment as environments
from jaxprt.scene.camera import Camera, in_common_coordinates
from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, Opacity
from jaxprt.visibility import Occluder

SMOOTH = math.cos(math.radians(10))  # smallest cosine between mean normals of triangles that may share a point
BLOCK = 1 << 15  # points and pixels per step, so that compiled programs fit any number of them
SAME_DEPTH = 1e-4  # relative difference in depth that rounding may cause
STEEPEST = 1e6  # slopes are clamped to that of a triangle a millionth of a pixel wide
FACET = 4  # of `detail`
_PLANE = math.cos(math.radians(1))  # in place of SMOOTH, for facets
_RAYS = 1 << 16  # rays whose lists are held at once


class Pixels(eqx.Module):
    """The shading points of a picture.

    Points are ordered by pixel, followed by padding.

    Attributes:
        triangle: Index of the triangle that each point lies on; -1 in padding.
        barycentric: Perspective-correct barycentric coordinates, not negative. They sum to 1, or to 0 in padding.
        slope: Change of the barycentric coordinates per pixel to the right, and per pixel down.
        pixel: Index of each point's pixel, row * width + column.
        coverage: Fraction of the pixel that the point stands for, for each color if it is seen through glass; 0 in
            padding.
        background: Fraction of each pixel's samples that see no triangle, for each color if they look through glass.
            The remaining samples see backs of surfaces, which are black.
    """

    triangle: Int[Array | np.ndarray, " p"]
    barycentric: Float[Array | np.ndarray, "p 3"]
    slope: Float[Array | np.ndarray, "p 2 3"]
    pixel: Int[Array | np.ndarray, " p"]
    coverage: Float[Array | np.ndarray, " p *c"]
    background: Float[Array, "h w *c"]


@in_common_coordinates
def shading_points(
    fragments: Fragments,
    mesh: Mesh,
    camera: Camera,
    *,
    detail: UInt8[Array, " f"] | None = None,
    share: Float[Array, "h w s *c"] | None = None,
    occluder: Occluder | None = None,
) -> Pixels:
    """Finds one shading point for each pixel and each surface that the pixel shows.

    Samples of one triangle share a point. Samples of different triangles share a point if the triangles clearly form
    one smooth surface: they have the same region, mean shading normals within ten degrees (one degree for facets), and
    depths that differ by no more than their slopes explain. A mesh finer than the pixels therefore has one point per
    pixel, not four. The point lies at the mean position of its samples, or as close to it as the triangle of the first
    sample reaches. Surfaces seen from behind (see `raster.front`) have no points. The result has zero derivatives.

    Outside of `jax.jit` and `jax.vmap` the points are in NumPy, because their number depends on the view. At most an
    eighth of them is padding, so that programs compiled for one view often fit the next. Inside of `jax.jit` the number
    is not known, so there are as many points as samples.

    Args:
        fragments: The result of `rasterize`.
        mesh: The rasterized mesh.
        camera: The camera of the rasterization.
        detail: How much the radiance of each triangle varies within a pixel: 0 if one point is enough for a surface, 1
            if each sample becomes a point, 2 if each becomes four; 0 for all if None. With `FACET` added the triangle
            is flat, and its reflection is sharp: in pixels that several such surfaces fill each sample becomes four.
        share: Share from 0 to 1 of each sample that sees its triangle, or the background; all of it if None. Coverage
            and background count it.
        occluder: The triangles of the mesh in its coordinates, to find four points of a sample by rays. Without it, or
            inside of `jax.jit`, samples remain one point.

    Raises:
        ValueError: The fragments are of a picture of another size, or refer to triangles that the mesh does not have.
    """
    shape = fragments.triangle.shape
    if shape[:2] != (camera.height, camera.width) or shape[2:] not in ((), (4,)) or 0 in shape:
        raise ValueError(
            f"the fragments must have the camera's {camera.height} x {camera.width} pixels, with 1 or 4 samples each, "
            f"got {list(shape)}"
        )
    concrete = not isinstance(fragments.triangle, Tracer)
    if concrete and (highest := int(np.max(fragments.triangle))) >= len(mesh.face):
        raise ValueError(f"the fragments must refer to the mesh's {len(mesh.face)} triangles, got triangle {highest}")
    projected, block = _project(mesh, camera), min(BLOCK, 1 << (shape[0] * shape[1] - 1).bit_length())
    facing = raster.front_faces(mesh, camera)
    uneven = jnp.zeros(len(mesh.face), bool) if detail is None else detail % FACET > 0
    members, mixed, background = _uniform(fragments, facing, uneven)
    if len(shape) == 3:
        face = facing, *_faces(mesh, projected), uneven, jnp.zeros_like(uneven) if detail is None else detail >= FACET
        for row in _numbers(mixed, block):
            shown, samples = _samples(row, fragments, face)
            members = _merge(row, members, shown, _same(samples))
    parts = []
    if detail is not None and len(shape) == 3 and occluder is not None and known(detail, members):
        members, *divided = _divided(members, fragments, np.asarray(detail), share, mesh, camera, facing, occluder)
        for first in range(0, len(divided[0]), block):
            sample, triangle, across, down = (values[first : first + block] for values in divided)
            room = (0, block - len(sample))
            pixel, triangle = np.pad(sample // 4, room), np.pad(triangle, room, constant_values=-1)
            linear = _linear(*_corners(triangle, np.pad(across, room), np.pad(down, room), mesh.face, projected))
            weight, rate = _weights(*linear, *np.zeros((2, block), projected.dtype))
            coverage = np.full((block, *(() if share is None else share.shape[3:])), 1 / 16, projected.dtype)
            parts.append((triangle, *_pack(triangle, weight, rate, *linear[1:]), pixel, coverage))
    for sample in _numbers(members.ravel(), block):
        triangle, pixel, coverage, corner, step = _points(sample, members, fragments, mesh.face, projected)
        if share is not None:
            coverage = _sample_share(sample, members, share)
        linear = _linear(*corner)
        weight, rate = _weights(*linear, *step)
        parts.append((triangle, *_pack(triangle, weight, rate, *linear[1:]), pixel, coverage))
    triangle, barycentric, slope, pixel, coverage = _joined(parts)
    if share is not None:
        background = _empty_share(fragments, share)
    return Pixels(triangle, barycentric, slope, pixel, coverage, background)


@jit
def interpolate(
    fragments: Fragments | Pixels, face: Int[Array, "f 3"], attribute: Float[Array, " v *c"]
) -> Float[Array, "..."]:
    """Interpolates a vertex attribute to pixels or to shading points.

    The result is zero where nothing is seen. It is linear in the attribute and therefore differentiable in it; the
    derivatives are the barycentric coordinates.

    Raises:
        ValueError: The fragments have several samples per pixel and therefore no barycentric coordinates.
    """
    if fragments.barycentric is None:
        raise ValueError("fragments must have one sample per pixel; for several, interpolate at their shading_points")
    seen = fragments.triangle >= 0
    vertex = face[jnp.maximum(fragments.triangle, 0)]
    wide = (*seen.shape, *(1,) * (attribute.ndim - 1))
    floating = jnp.issubdtype(attribute.dtype, jnp.floating)
    weight = fragments.barycentric.astype(attribute.dtype) if floating else fragments.barycentric
    total = sum(weight[..., i].reshape(wide) * attribute[vertex[..., i]] for i in range(3))
    return jnp.where(seen.reshape(wide), total, 0)


@jit
def resolve(
    pixels: Pixels, color: Float[Array, "p c"], *, background: Float[Array, "h w c"] | None = None
) -> Float[Array, "h w c"]:
    """Resolves a picture: sums the points' colors times their coverage, and adds the background where it is visible.

    This is a box filter over the samples, in linear radiance, so tone mapping comes after it. The result is linear in
    the colors and the background and therefore differentiable in them.

    Args:
        pixels: The shading points.
        color: Linear radiance of each point towards the camera. Values in padding are ignored.
        background: Linear radiance behind the mesh; black if None.

    Raises:
        ValueError: The number of colors is not the number of points.
    """
    if color.shape[:1] != pixels.triangle.shape or color.ndim != 2:
        raise ValueError(f"color must be [{len(pixels.triangle)}, c], one per point, got {list(color.shape)}")
    height, width = pixels.background.shape[:2]
    if not jnp.issubdtype(color.dtype, jnp.inexact):
        color = color.astype(pixels.coverage.dtype)
    coverage = by_color(pixels.coverage, color.shape[1]).astype(color.dtype)
    image = jnp.zeros((height * width, color.shape[1]), color.dtype)
    image = image.at[pixels.pixel].add(
        jnp.where(coverage > 0, coverage * color, 0), indices_are_sorted=True, mode="promise_in_bounds"
    )
    image = image.reshape(height, width, -1)
    if background is None:
        return image
    share = by_color(pixels.background, color.shape[1], axes=2).astype(color.dtype)
    return image + jnp.where(share > 0, share * background, 0)


def by_color(
    share: Float[Array | np.ndarray, "..."], colors: int, *, axes: int = 1
) -> Float[Array | np.ndarray, "..."]:
    """Shares of points or pixels with a last axis that broadcasts to the colors of a picture.

    Shares without colors get an axis of one. Shares of three colors are averaged if the picture has another number.

    Args:
        share: Shares [p] or [h w], with an axis of colors or without.
        colors: Number of colors of the picture.
        axes: Number of axes of the shares besides that of colors: 1 for points, 2 for pixels.
    """
    if share.ndim == axes:
        return share[..., None]
    return share if share.shape[-1] == colors else share.mean(-1, keepdims=True)


@require.arguments(
    mesh=arguments.a_mesh,
    camera=arguments.a_camera,
    samples=arguments.samples,
    color=arguments.color,
    background=arguments.background,
)
def render(
    mesh: Mesh,
    color: Float[Array, "v c"],
    camera: Camera,
    *,
    background: Float[Array, "h w c"] | None = None,
    samples: int = 4,
) -> Float[Array, "h w c"]:
    """Renders a mesh with a color at each vertex.

    The picture is differentiable in the colors and the background; its derivatives in the geometry and the camera are
    zero. To render one view many times, keep the result of `shading_points` and call `interpolate` and `resolve`.

    Args:
        mesh: The mesh to render. Its back (see `front`) is black.
        color: Linear radiance of each vertex towards the camera.
        camera: The camera.
        background: Linear radiance behind the mesh; black if None.
        samples: Samples per pixel: 4 for anti-aliased edges, 1 for pixel centers only.

    Raises:
        ValueError: The number of colors is not the number of vertices, the mesh has no triangle or more than 2^24 - 1,
            or `samples` is neither 1 nor 4.
    """
    if color.shape[:1] != mesh.position.shape[:1] or color.ndim != 2:
        raise ValueError(f"color must be [{mesh.position.shape[0]}, c], one per vertex, got {list(color.shape)}")
    arguments.check_background(background, camera, color.shape[1])
    pixels = shading_points(raster.rasterize(mesh, camera, samples=samples), mesh, camera)
    return resolve(pixels, interpolate(pixels, mesh.face, color), background=background)


def _numbers(flag: Bool[Array, " n"] | UInt8[Array, " n"], block: int) -> list[Int[Array, " m"]]:
    """Indices of the set flags in order, then -1: in blocks, or inside of jax.jit in one block of n."""
    if isinstance(flag, Tracer):
        place = jnp.where(flag > 0, jnp.cumsum(flag > 0, dtype=jnp.int32) - 1, flag.size)
        index = jnp.arange(flag.size, dtype=jnp.int32)
        return [jnp.full(flag.size, -1, jnp.int32).at[place].set(index, mode="drop")]
    number = np.flatnonzero(np.asarray(flag)).astype(np.int32)
    blocks = max(-(-len(number) // block), 1)
    number = np.pad(number, (0, blocks * block - len(number)), constant_values=-1)
    return [jax.device_put(row) for row in number.reshape(-1, block)]


def _joined(parts: list[tuple[Array | np.ndarray, ...]]) -> list[Array | np.ndarray]:
    """Fields of all points; outside of jax.jit in NumPy, ordered by pixel, and with at most an eighth of padding."""
    if isinstance(parts[0][0], Tracer):
        return list(parts[0])
    fields = [np.concatenate([np.asarray(values) for values in same]) for same in zip(*parts, strict=True)]
    triangle, _, _, pixel, _ = fields
    used = np.flatnonzero(triangle >= 0)
    order = used[np.argsort(pixel[used], kind="stable")]
    unit = 1 << max(len(order).bit_length() - 4, 0)
    room = max(-(-len(order) // unit) * unit, 1) - len(order)
    padding = (
        np.full((room, *values.shape[1:]), value, values.dtype)
        for values, value in zip(fields, (-1, 0, 0, pixel.max(), 0), strict=True)
    )
    return [np.concatenate([values[order], rest]) for values, rest in zip(fields, padding, strict=True)]


# The following is split into several programs, because XLA would fuse all computations of one program into each of its
# results and repeat them for each.


@jit
def _uniform(fragments: Fragments, facing: Bool[Array, " f"], uneven: Bool[Array, " f"]):
    """Member masks of pixels with one triangle, a mask of pixels with several points, and background fractions."""
    height, width, *_ = fragments.triangle.shape
    triangle = fragments.triangle.reshape(height * width, -1).T
    shown = facing[triangle] & (triangle >= 0)
    same = functools.reduce(jnp.logical_and, [sample == triangle[0] for sample in triangle])
    same &= ~uneven[triangle[0]] | (len(triangle) == 1)
    mixed = ~same & functools.reduce(jnp.logical_or, list(shown))
    # A surface's first sample represents it: its mask has a bit for each sample of the surface, other masks are empty.
    whole = jnp.where(same & shown[0], (1 << len(triangle)) - 1, 0).astype(jnp.uint8)
    members = jnp.pad(whole[:, None], ((0, 0), (0, len(triangle) - 1)))
    empty = functools.reduce(jnp.add, [(sample < 0).astype(fragments.depth.dtype) for sample in triangle])
    return members, mixed, (empty / len(triangle)).reshape(height, width)


@jit
def _project(mesh: Mesh, camera: Camera) -> Float[Array, "3 v"]:
    """Vertices projected by `raster.project`, as one array."""
    return jnp.stack(raster.project(*jax.lax.stop_gradient((mesh.position, camera))))


@jit
def _faces(mesh: Mesh, projected: Float[Array, "3 v"]):
    """Region and normal of each triangle, and the change of 1 / depth per pixel to the right and down."""
    face = mesh.face.T
    normal = jax.lax.map(lambda axis: axis[face], jax.lax.stop_gradient(mesh.normal.T))
    x, y, q = jax.lax.map(lambda axis: axis[face], projected)
    s = jnp.sign(q)
    # 1 / depth is linear in the image plane of a triangle.
    value, right, down = _affine(x - s * s[0] * x[0], y - s * s[0] * y[0], q)
    area = sum(value[i] * s[i] for i in range(3))
    scale = [jnp.where(area == 0, 0, jnp.abs(component) / jnp.where(area == 0, 1, area)) for component in q]
    change = [sum(part[i] * scale[i] for i in range(3)) for part in (right, down)]
    return mesh.region[face[0]], *(component[0] + component[1] + component[2] for component in normal), *change


@jit
def _samples(row: Int[Array, " m"], fragments: Fragments, face: tuple[Array, ...]):
    """Whether samples of some pixels see a front, and the values that `_same` compares, as arrays [s, m]."""
    shape = (fragments.depth.shape[0] * fragments.depth.shape[1], -1)
    triangle, depth = (values.reshape(shape)[row].T for values in (fragments.triangle, fragments.depth))
    facing, *rest = (values[triangle] for values in face)
    return facing & (triangle >= 0), (triangle, 1 / depth, *rest)


@jit
def _same(samples: tuple[Array, ...]) -> dict[tuple[int, int], Bool[Array, " m"]]:
    """Whether two samples see the same surface, for each pair (i, j) of the samples of a pixel with i < j."""
    triangle, inverse, region, x, y, z, right, down, uneven, facet = samples
    offset = SAMPLES[len(triangle)]
    same = {}
    for j in range(len(triangle)):
        for i in range(j):
            step = [(offset[j] - offset[i]) @ jnp.stack([right[k], down[k]]) for k in (i, j)]
            # Where two triangles meet between the samples, 1 / depth changes by a mean of the two triangles' slopes.
            jump = jnp.abs(inverse[j] - inverse[i] - (step[0] + step[1]) / 2)
            near = jump <= (jnp.abs(step[0]) + jnp.abs(step[1])) / 2 + SAME_DEPTH * inverse[i]
            dot, *square = (x[a] * x[b] + y[a] * y[b] + z[a] * z[b] for a, b in ((i, j), (i, i), (j, j)))
            least = jnp.where(facet[i] | facet[j], _PLANE, SMOOTH)
            alike = (dot >= 0) & (dot**2 >= least**2 * square[0] * square[1])
            one = (triangle[i] == triangle[j]) | (near & alike & (region[i] == region[j]))
            same[i, j] = one & ~uneven[i] & ~uneven[j]
    return same


@jit
def _merge(row: Int[Array, " m"], members: UInt8[Array, "n s"], shown, same) -> UInt8[Array, "n s"]:
    """Member masks in which, at the pixels `row`, samples of one surface have been merged into the first of them."""
    first = []
    for j in range(len(shown)):
        leader = jnp.full(row.shape, j)
        for i in reversed(range(j)):
            leader = jnp.where(same[i, j] & (first[i] == i), i, leader)
        first.append(jnp.where(shown[j], leader, -1))
    sets = [sum((first[j] == i) << j for j in range(i, len(first))) for i in range(len(first))]
    row = jnp.where(row < 0, len(members), row)
    return members.at[row].set(jnp.stack(sets, -1).astype(members.dtype), mode="drop")


@jit
def _points(
    sample: Int[Array, " p"],
    members: UInt8[Array, "n s"],
    fragments: Fragments,
    face: Int[Array, "f 3"],
    projected: Float[Array, "3 v"],
):
    """Shading points of the surfaces that samples represent; vertices and mean positions are relative to the sample."""
    height, width, *_ = fragments.depth.shape
    samples, dtype = members.shape[1], projected.dtype
    used, sample = sample >= 0, jnp.maximum(sample, 0)
    pixel = jnp.where(used, sample // samples, height * width - 1)
    triangle = jnp.where(used, fragments.triangle.ravel()[sample], -1)
    member = jnp.where(used, members.ravel()[sample], 0)
    middle, coverage = (jnp.asarray(table, dtype)[member] for table in _subsets(samples))
    start = jnp.asarray(SAMPLES[samples], dtype)[sample % samples]
    column = (pixel % width).astype(dtype) + (1 - width) / 2 + start[:, 0]
    row = (pixel // width).astype(dtype) + (1 - height) / 2 + start[:, 1]
    step = (middle - start).T
    return triangle, pixel, coverage, _corners(triangle, column, row, face, projected), (step[0], step[1])


@jit
def _corners(triangle: Int[Array, " p"], column, row, face: Int[Array, "f 3"], projected: Float[Array, "3 v"]):
    """Vertices of triangles relative to places in the picture, which are given from its middle."""
    vertex = face[jnp.maximum(triangle, 0)].T
    x, y, q = jax.lax.map(lambda axis: axis[vertex], projected)
    s = jnp.sign(q)
    return x - s * column, y - s * row, q


def _divided(
    members: UInt8[Array, "n 4"],
    fragments: Fragments,
    detail: UInt8[np.ndarray, " f"],
    share: Array | None,
    mesh: Mesh,
    camera: Camera,
    facing: Bool[Array, " f"],
    occluder: Occluder,
) -> tuple[Any, ...]:
    """Member masks without samples that become four points; and of each point its sample, triangle, column and row."""
    member, triangle = np.array(members), np.asarray(fragments.triangle).reshape(members.shape)
    # Pixels of which a sample shows a surface that is flat or needs four points; four flags are one number.
    near = np.flatnonzero((detail > 1)[triangle].view(np.uint32))
    shown = triangle[near]
    flat = (detail[shown] == FACET) & (shown >= 0) & np.asarray(facing)[shown]
    here = np.where(member[near] > 0, detail[shown] % FACET, 0)
    if share is not None:
        whole = np.all(np.asarray(share).reshape(*member.shape, -1)[near] == 1, -1)
        here, flat = np.where(whole, here, 0), flat & whole
    apart = np.all(flat, 1) & (np.count_nonzero(member[near], 1) > 1)
    chosen = np.flatnonzero(np.any(here > 1, 1) | apart)
    if len(chosen) > len(member) // 2:  # what is kept of a view holds a kilobyte for each point
        pixel = near[chosen]
        chosen = chosen[(pixel // camera.width + pixel % camera.width) % 2 == 0]
    # All single samples of a pixel or none: their distances from the middles of their quarters cancel.
    row, number = np.nonzero((here[chosen] > 0) | apart[chosen, None])
    sample = np.repeat((4 * near[chosen[row]] + number).astype(np.int32), 4)
    chunks = [sample[first : first + _RAYS] for first in range(0, len(sample), _RAYS)]
    parts = [_places(chunk, triangle.ravel(), mesh, camera, np.asarray(facing), occluder) for chunk in chunks]
    if not parts:
        return members, sample, sample, *np.zeros((2, 0), np.float32)
    triangle, place, same = (np.concatenate(values) for values in zip(*parts, strict=True))
    # Pixels in which no ray finds a place, as behind backs that are hidden, keep their samples.
    some = np.bincount(sample // 4, same) > 0
    used = some[sample // 4]
    member.reshape(-1)[sample[used]] = 0
    return jnp.asarray(member), sample[used], triangle[used], *place[used].T


def _places(
    sample: Int[np.ndarray, " p"],
    triangle: Int[np.ndarray, " s"],
    mesh: Mesh,
    camera: Camera,
    facing: Bool[np.ndarray, " f"],
    occluder: Occluder,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles and places of four points of each sample, and whether rays found them; else a point is the sample."""
    camera = jax.lax.stop_gradient(camera)
    middle, offset, seen = _pixel_middles(camera, sample // 4), SAMPLES[4][sample % 4], triangle[sample]
    finer = np.sign(offset) / 4 + SAMPLES[4][np.arange(len(sample)) % 4] / 2
    origin = np.tile(np.asarray(camera.eye, np.float32), (len(sample), 1))
    hit = occluder.facing_hit(origin, _directions(camera, middle + finer))[0]
    face, region = np.asarray(mesh.face), np.asarray(mesh.region)
    same = (hit >= 0) & facing[hit] & (region[face[hit, 0]] == region[face[seen, 0]])
    place = middle + np.where(same[:, None], finer, offset)
    return np.where(same, hit, seen).astype(np.int32), place.astype(np.float32), same


@jit
def _sample_share(sample: Int[Array, " p"], members: UInt8[Array, "n s"], share: Float[Array, "h w s *c"]) -> Array:
    """Coverage of the surfaces that some samples represent, by the shares of their samples."""
    samples = members.shape[1]
    used, sample = sample >= 0, jnp.maximum(sample, 0)
    member = jnp.where(used, members.ravel()[sample], 0)
    shares = share.reshape(-1, samples, *share.shape[3:])[sample // samples]
    member = member.reshape(-1, *(1,) * (share.ndim - 3))
    bits = [jnp.where((member >> number) & 1, shares[:, number], 0) for number in range(samples)]
    return functools.reduce(jnp.add, bits) / samples


@jit
def _empty_share(fragments: Fragments, share: Float[Array, "h w s *c"]) -> Float[Array, "h w *c"]:
    """Share of each pixel that sees no triangle."""
    empty = fragments.triangle.reshape(*share.shape[:3], *(1,) * (share.ndim - 3)) < 0
    return jnp.mean(jnp.where(empty, share, 0), 2)


def _affine(x, y, q):
    """The determinants of `raster.rasterize` at x = y = 0, and their change per pixel to the right and down."""
    s, pairs = jnp.sign(q), ((1, 2), (2, 0), (0, 1))
    value = [x[i] * y[j] - x[j] * y[i] for i, j in pairs]
    return value, [s[j] * y[i] - s[i] * y[j] for i, j in pairs], [s[i] * x[j] - s[j] * x[i] for i, j in pairs]


@jit
def _linear(x, y, q):
    """Barycentric coordinates up to a common factor, which makes them linear in the image plane, and their changes."""
    value, right, down = _affine(x, y, q)
    side = jnp.sign(sum(value[i] * jnp.sign(q[i]) for i in range(3)))
    return [[side * jnp.abs(q[i]) * part[i] for i in range(3)] for part in (value, right, down)]


@jit
def _weights(value, right, down, across, along):
    """Perspective-correct barycentric coordinates after a step that stays in the triangle, and 1 / their raw sum."""
    change = [across * right[i] + along * down[i] for i in range(3)]
    leaves = [value[i] + change[i] < 0 for i in range(3)]
    reach = [jnp.where(leaves[i], -value[i] / jnp.where(leaves[i], change[i], 1), 1) for i in range(3)]
    reach = jnp.clip(jnp.minimum(jnp.minimum(reach[0], reach[1]), reach[2]), 0, 1)
    weight = [jnp.maximum(value[i] + reach * change[i], 0) for i in range(3)]
    total = sum(weight)
    rate = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)
    return [jnp.where(total > 0, term * rate, 1 / 3) for term in weight], rate


@jit
def _pack(triangle: Int[Array, " p"], weight, rate, *change) -> tuple[Float[Array, "p 3"], Float[Array, "p 2 3"]]:
    """Barycentric coordinates and their slopes; zero in padding."""
    slope = [[(part[i] - weight[i] * sum(part)) * rate for i in range(3)] for part in change]
    slope = jnp.stack([jnp.stack(component, -1) for component in slope], 1)
    used = (triangle >= 0)[:, None]
    slope = jnp.where(used[..., None], jnp.clip(slope, -STEEPEST, STEEPEST), 0)
    return jnp.where(used, jnp.stack(weight, -1), 0), slope


@functools.cache
def _subsets(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean position and fraction of the samples for each subset of them. Bit i of a subset's index is sample i."""
    member = (np.arange(1 << samples)[:, None] >> np.arange(samples)) & 1
    count = member.sum(1)
    return member @ SAMPLES[samples] / np.maximum(count, 1)[:, None], count / samples


def visible_points(
    mesh: Mesh,
    camera: Camera,
    *,
    samples: int,
    hidden: Bool[np.ndarray, " _"] | None = None,
    occluder: Occluder | None = None,
    detail: UInt8[Array, " f"] | None = None,
    between: Between = None,
) -> Pixels:
    """The shading points of a picture, and how much each adds to its pixel.

    A point on a translucent surface covers the share of its samples that it hides; what lies behind it covers the rest.
    At most eight translucent surfaces in front of an opaque one are drawn; those behind the eighth are omitted.

    Args:
        mesh: The mesh, whose opacity is ignored.
        camera: The camera, in the coordinates of the mesh.
        samples: Samples of each pixel, 1 or 4.
        hidden: Triangles that cameras do not see from behind, without padding of the mesh; none if None.
        occluder: The same triangles with their opacity; None if all of them are opaque and none has a `detail` of 2.
        detail: How much the radiance of each triangle varies within a pixel; see `shading_points`.
        between: Function that is called between steps of the work.
    """
    if occluder is None or occluder.opacity is None:
        shown = seen_from_front(mesh, camera, hidden)
        fragments = finished(raster.rasterize(shown, camera, samples=samples), between)
        return finished(shading_points(fragments, mesh, camera, detail=detail, occluder=occluder), between)
    slots = _slots(mesh, camera, samples, hidden, occluder, occluder.opacity)
    result = []
    for triangle, depth, share in slots:
        triangle, depth = (values[..., 0] if samples == 1 else values for values in (triangle, depth))
        fragments = Fragments(jnp.asarray(triangle), None, jnp.asarray(depth))
        points = shading_points(fragments, mesh, camera, detail=detail, share=jnp.asarray(share), occluder=occluder)
        result.append(finished(points, between))
    parts = [(layer.triangle, layer.barycentric, layer.slope, layer.pixel, layer.coverage) for layer in result]
    background = functools.reduce(jnp.add, [layer.background for layer in result])
    return Pixels(*_joined(parts), background=background)


def coverage(
    mesh: Mesh, camera: Camera, *, samples: int, hidden: Bool[np.ndarray, " f"] | None, occluder: Occluder | None
) -> Float[Array, "h w"]:
    """Share of each pixel that surfaces hide of the background; `visible_points` has the arguments and errors."""
    if occluder is None or occluder.opacity is None:
        fragments = raster.rasterize(seen_from_front(mesh, camera, hidden), camera, samples=samples)
        seen = jnp.asarray(fragments.triangle >= 0, jnp.result_type(float))
        return seen if seen.ndim == 2 else jnp.mean(seen, -1)
    slots = _slots(mesh, camera, samples, hidden, occluder, occluder.opacity)
    empty = sum(np.mean(np.where(triangle < 0, _gray(share), 0), -1) for triangle, _, share in slots)
    return jnp.asarray(1 - empty, jnp.result_type(float))


def nearest_fragments(
    mesh: Mesh,
    camera: Camera,
    *,
    hidden: Bool[np.ndarray, " f"] | None = None,
    occluder: Occluder | None = None,
) -> Fragments:
    """What each pixel's center sees. A translucent surface is seen with the probability of its opacity.

    The choice is random and the same in every run. Means over pixels are those of translucent surfaces.
    The arguments are those of `visible_points`.
    """
    if occluder is None or occluder.opacity is None:
        return raster.rasterize(seen_from_front(mesh, camera, hidden), camera)
    slots = _slots(mesh, camera, 1, hidden, occluder, occluder.opacity)
    random = np.random.default_rng(0).random(slots[0][0].shape)
    triangle, depth, total = np.full(random.shape, -1, np.int32), np.full(random.shape, np.inf, np.float32), 0.0
    for one, where, share in slots:
        share = _gray(share)
        chosen = (random >= total) & (random < total + share)
        triangle, depth, total = np.where(chosen, one, triangle), np.where(chosen, where, depth), total + share
    triangle, depth = jnp.asarray(triangle[..., 0]), jnp.asarray(depth[..., 0])
    return Fragments(triangle, raster.barycentric(triangle, mesh, camera), depth)


def seen_from_front(mesh: Mesh, camera: Camera, hidden: Bool[Array | np.ndarray, " f"] | None) -> Mesh:
    """The mesh without the triangles that the camera sees from behind and that are hidden there, `hidden`."""
    if hidden is None or (known(hidden) and not np.any(hidden)):
        return mesh
    away = _hidden_now(mesh, camera, hidden)
    xp = np if known(away, mesh.face) else jnp
    return dataclasses.replace(mesh, face=xp.where(away[:, None], 0, xp.asarray(mesh.face)))


def _hidden_now(mesh: Mesh, camera: Camera, hidden: Bool[Array | np.ndarray, " f"]) -> Any:
    """Triangles of which the camera sees a back that is hidden. Padding of the mesh is not."""
    front = raster.front_faces(mesh, camera)
    xp = np if known(front, hidden) else jnp
    return xp.pad(hidden, (0, len(mesh.face) - len(hidden))) & ~xp.asarray(front)


def _slots(
    mesh: Mesh,
    camera: Camera,
    samples: int,
    hidden: Bool[Array | np.ndarray, " f"] | None,
    occluder: Occluder,
    opacity: Opacity,
) -> list[tuple[Int[np.ndarray, "h w s"], Float[np.ndarray, "h w s"], Float[np.ndarray, "h w s *c"]]]:
    """Triangles, depths and shares of the surfaces that samples see, from front to back; triangle -1 is background."""
    if not known(camera, mesh):
        raise ValueError(
            "pictures of surfaces with holes or translucent ones need concrete values, but the camera or the scene is "
            "traced by JAX: make the picture outside of jax.jit, or close the jitted function over them"
        )
    count = len(occluder.face)
    clear = np.zeros(len(mesh.face), bool)
    layer = np.asarray(opacity.layer)[occluder.face[:, 0]]
    clear[:count] = layer > 0
    passing, glass = np.asarray(opacity.passing), np.asarray(opacity.glass)
    passing = passing[layer, : 1 if np.all(passing == 1) else 3]  # shares are by color if there is colored glass
    away = np.zeros(len(mesh.face), bool) if hidden is None else _hidden_now(mesh, camera, hidden)
    opaque = dataclasses.replace(mesh, face=np.where((clear | away)[:, None], 0, np.asarray(mesh.face)))
    base = raster.rasterize(opaque, camera, samples=samples)
    behind = [np.asarray(values).reshape(-1) for values in (base.triangle, base.depth)]
    shape = (camera.height, camera.width, samples)
    chunks = []
    for first in range(0, len(behind[0]), _RAYS):
        span = slice(first, first + _RAYS)
        pixel, number = np.divmod(np.arange(len(behind[0]))[span], samples)
        direction = _directions(camera, _pixel_middles(camera, pixel) + SAMPLES[samples][number])
        far = np.minimum(behind[1][span], 1e30).astype(np.float32)
        eye = np.asarray(camera.eye, np.float32)
        number, face, place, alpha = occluder.translucent.layers(eye, direction, far, away[:count])
        pair = np.where(glass[layer[face]], 1, alpha), (1 - alpha)[..., None] * passing[face]
        chunks.append(_chunk(number, face, place, *pair, behind[0][span], behind[1][span]))
    most = max(len(chunk[0]) for chunk in chunks)
    nothing = -1, np.inf, 0
    columns = []
    for value, rows in zip(nothing, zip(*chunks, strict=True), strict=True):
        wide = [((0, most - len(row)), *((0, 0),) * (row.ndim - 1)) for row in rows]
        filled = [np.pad(row, width, constant_values=value) for row, width in zip(rows, wide, strict=True)]
        columns.append(np.concatenate(filled, 1).reshape(most, *shape, *filled[0].shape[2:]))
    return list(zip(*columns, strict=True))


def _gray(share: Float[np.ndarray, "h w s *c"]) -> Float[np.ndarray, "h w s"]:
    """Shares without their colors."""
    return share if share.ndim == 3 else share.mean(-1)


def _chunk(count, face, place, cover, through, triangle, depth) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Triangles, depths and shares [k, n, c] of the surfaces on some rays, with those behind all layers."""
    listed = np.arange(face.shape[1]) < count[:, None]
    # `cover` is the share of a view of a layer that shows the layer itself, `through` what is behind, for each color.
    left = np.cumprod(np.where(listed[..., None], through, 1), 1)
    before = np.concatenate([np.ones_like(left[:, :1]), left[:, :-1]], 1)
    rows, ends = np.arange(len(count)), count.copy()
    width = face.shape[1] + 1
    triangles, depths = np.full((len(count), width), -1, np.int32), np.full((len(count), width), np.inf, np.float32)
    shares = np.zeros((len(count), width, left.shape[2]), np.float32)
    triangles[:, :-1], depths[:, :-1] = np.where(listed, face, -1), np.where(listed, place, np.inf)
    shares[:, :-1] = np.where(listed[..., None], before * cover[..., None], 0)
    triangles[rows, ends], depths[rows, ends] = triangle, depth
    shares[rows, ends] = np.where(count[:, None] > 0, left[rows, np.maximum(count - 1, 0)], 1)
    # Nothing is seen behind what hides everything.
    some = np.any(shares > 0, 2)
    triangles = np.where(some, triangles, -1)
    used = max(1, int(np.max(np.where(np.any(some, 0), np.arange(1, width + 1), 0))))
    shares = shares[..., 0] if left.shape[2] == 1 else shares
    return triangles.T[:used], depths.T[:used], np.swapaxes(shares, 0, 1)[:used]


def _directions(camera: Camera, place: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    """Directions from the eye through places in pixels from the middle of the picture, one unit along the view axis."""
    x, y = place.T * (2 * np.tan(float(camera.field_of_view) / 2) / camera.height)
    right, up, forward = np.asarray(raster.view_axes(camera), np.float64)
    return (x[:, None] * right - y[:, None] * up + forward).astype(np.float32)


def _pixel_middles(camera: Camera, pixel: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
    """Middles of pixels from the middle of the picture."""
    row, column = np.divmod(pixel, camera.width)
    return np.stack([column + (1 - camera.width) / 2, row + (1 - camera.height) / 2], 1)


def sky(environment: Environment, camera: Camera) -> Float[Array, "h w c"]:
    """The environment as the pixels of a camera see it where nothing hides it.

    It comes from the pixels of the environment's file, averaged over the pixels of the picture, as
    `jaxprt.scene.environment.sky` says.

    Args:
        environment: One light, not a batch.
        camera: The camera.

    Returns:
        Linear radiance.
    """
    ray = ray_direction(camera)
    return environments.sky(environment, ray, angle=pixel_angle(camera) if known(camera) else 0.0)


def pixel_angle(camera: Camera) -> Float32[np.ndarray, "h w"]:
    """Width of each pixel in radians: the square root of the solid angle that it covers around its center.

    Args:
        camera: A camera with known values.
    """
    return _pixel_angle(camera.width, camera.height, float(camera.field_of_view))


@functools.lru_cache(maxsize=4)
def _pixel_angle(width: int, height: int, field_of_view: float) -> Float32[np.ndarray, "h w"]:
    focal = height / (2 * np.tan(field_of_view / 2))
    column = (np.arange(width) + (1 - width) / 2) / focal
    row = (np.arange(height)[:, None] + (1 - height) / 2) / focal
    angle = ((1 + column**2 + row**2) ** -0.75 / focal).astype(np.float32)
    angle.flags.writeable = False
    return angle
