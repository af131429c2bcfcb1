"""Pictures of meshes: the points that a picture shades, and how their colors make its pixels.

Coverage is measured at all samples of a pixel, radiance at one point for each surface that the pixel shows.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from jaxprt.image import raster
from jaxprt.image.raster import SAMPLES, Fragments
from jaxprt.scene.camera import Camera
from jaxprt.scene.mesh import Mesh

SMOOTH = math.cos(math.radians(10))  # Cosine between mean normals of triangles that may share a point.
SAME_DEPTH = 1e-4  # Relative difference in depth that rounding may make.
STEEPEST = 1e6  # Slopes are clamped to it: those of a triangle a millionth of a pixel wide.


class Pixels(eqx.Module):
    """The points that a picture shades.

    Points are in the order of their pixels. Padding follows them.

    Attributes:
        triangle: Number of the triangle that each point lies on, -1 in padding.
        barycentric: Perspective-correct weights of its three vertices at the point, none negative; they sum to 1, or are
            0 in padding.
        slope: Change of the weights per pixel to the right, and per pixel down.
        pixel: Number of the point's pixel, row * width + column.
        coverage: Share of the pixel's samples that see the surface of the point, 0 in padding.
        background: Share of each pixel's samples that see no triangle. What coverage and background leave of a pixel
            are backs of surfaces, which are black.
    """

    triangle: Int[Array, " p"]
    barycentric: Float[Array, "p 3"]
    slope: Float[Array, "p 2 3"]
    pixel: Int[Array, " p"]
    coverage: Float[Array, " p"]
    background: Float[Array, "h w"]


def shading_points(fragments: Fragments, mesh: Mesh, camera: Camera) -> Pixels:
    """One point for each pixel and each surface that it shows.

    Samples of one triangle share a point. So do samples of different triangles that are plainly one smooth surface:
    of one region, with mean shading normals within ten degrees, and no further apart in depth than their slopes
    explain. Hence a mesh finer than the pixels has one point in a pixel, not four. The point is at the mean position
    of its samples, or as near to it as the triangle of the first sample reaches. What is seen from behind, see
    `raster.front`, has no point. The result is constant for derivatives.

    Outside of `jax.jit` and `jax.vmap` there are as many points as needed and at most a sixteenth more of padding, so
    that programs compiled for one view mostly fit the next. Inside, where the number is unknown, there are as many
    as samples.

    Args:
        fragments: What `rasterize` found.
        mesh: The mesh that it was given.
        camera: The camera that it was given.

    Raises:
        ValueError: The fragments are of a picture of another size, or of triangles that the mesh does not have.
    """
    shape = fragments.triangle.shape
    if shape[:2] != (camera.height, camera.width) or shape[2:] not in ((), (4,)):
        raise ValueError(
            f"the fragments must be [{camera.height}, {camera.width}] or [{camera.height}, {camera.width}, 4] "
            f"as the camera has it, got {list(shape)}"
        )
    members, background = _surfaces(fragments, mesh, camera)
    if isinstance(members, jax.core.Tracer):
        index = _used_first(members)
    else:
        highest = int(np.max(fragments.triangle))
        if highest >= len(mesh.face):
            raise ValueError(f"the fragments must be of the mesh's {len(mesh.face)} triangles, got triangle {highest}")
        used = np.flatnonzero(np.asarray(members))
        index = jnp.asarray(np.pad(used, (0, _room(len(used)) - len(used)), constant_values=-1), jnp.int32)
    return Pixels(*_points(index, members, fragments.triangle, mesh, camera), background)


@jax.jit
def interpolate(
    fragments: Fragments | Pixels, face: Int[Array, "f 3"], attribute: Float[Array, "v *c"]
) -> Float[Array, "..."]:
    """Carries an attribute of the vertices to the pixels, or to the points that are shaded.

    Zero where nothing is seen. Linear, hence differentiable, in the attribute; the derivative with respect to a
    vertex is the weight that the pixels give it.

    Raises:
        ValueError: The fragments have several samples in a pixel, hence no weights.
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


@jax.jit
def resolve(
    pixels: Pixels, color: Float[Array, "p c"], *, background: Float[Array, "h w c"] | None = None
) -> Float[Array, "h w c"]:
    """Puts a picture together: the sum of the points' colors times their coverage, and the background past them.

    This is the box filter of the samples, in linear radiance: tone mapping comes after it. Linear, hence
    differentiable, in the colors and the background.

    Args:
        pixels: The points.
        color: Linear radiance of each point towards the camera; that of padding does not count.
        background: What is seen past the mesh; black if not given.

    Raises:
        ValueError: There is not one color per point.
    """
    if color.shape[:1] != pixels.triangle.shape or color.ndim != 2:
        raise ValueError(f"color must be [{len(pixels.triangle)}, c], one per point, got {list(color.shape)}")
    height, width = pixels.background.shape
    if not jnp.issubdtype(color.dtype, jnp.inexact):
        color = color.astype(pixels.coverage.dtype)
    coverage = pixels.coverage.astype(color.dtype)[:, None]
    image = jnp.zeros((height * width, color.shape[1]), color.dtype)
    image = image.at[pixels.pixel].add(
        jnp.where(coverage > 0, coverage * color, 0), indices_are_sorted=True, mode="promise_in_bounds"
    )
    image = image.reshape(height, width, -1)
    if background is None:
        return image
    share = pixels.background.astype(color.dtype)[..., None]
    return image + jnp.where(share > 0, share * background, 0)


def render(
    mesh: Mesh,
    color: Float[Array, "v c"],
    camera: Camera,
    *,
    background: Float[Array, "h w c"] | None = None,
    samples: int = 4,
) -> Float[Array, "h w c"]:
    """Draws a mesh whose vertices have colors.

    Differentiable in the colors and the background, constant in the geometry and the camera. Callers that draw one
    view many times keep the result of `shading_points` and call `interpolate` and `resolve`.

    Args:
        mesh: What is drawn. Its back, see `front`, is black.
        color: Linear radiance of each vertex towards the camera.
        camera: From where.
        background: What is seen past the mesh; black if not given.
        samples: 4 for edges without steps, 1 for what the pixels' centers show.

    Raises:
        ValueError: There is not one color per vertex, or as in `rasterize`.
    """
    if color.shape[:1] != mesh.position.shape[:1] or color.ndim != 2:
        raise ValueError(f"color must be [{mesh.position.shape[0]}, c], one per vertex, got {list(color.shape)}")
    pixels = shading_points(raster.rasterize(mesh, camera, samples=samples), mesh, camera)
    return resolve(pixels, interpolate(pixels, mesh.face, color), background=background)


def _room(count: int) -> int:
    """The next number that is a small multiple of a power of two: at most a sixteenth more."""
    unit = 1 << max(count.bit_length() - 5, 0)
    return max(-(-count // unit) * unit, 1)


@jax.jit
def _used_first(members: UInt8[Array, "h w s"]) -> Int[Array, " p"]:
    """Numbers of the samples that stand for a surface, in order, then -1."""
    used = members.ravel() > 0
    place = jnp.where(used, jnp.cumsum(used, dtype=jnp.int32) - 1, used.size)
    return jnp.full(used.size, -1, jnp.int32).at[place].set(jnp.arange(used.size, dtype=jnp.int32), mode="drop")


@jax.jit
def _surfaces(fragments: Fragments, mesh: Mesh, camera: Camera) -> tuple[UInt8[Array, "h w s"], Float[Array, "h w"]]:
    """Which samples of each pixel are one surface, and the share of its samples that see none.

    The first sample of a surface stands for it. It has a bit for each sample of the surface; other samples have 0.
    """
    mesh, camera, fragments = jax.lax.stop_gradient((mesh, camera, fragments))
    height, width, *_ = fragments.triangle.shape
    triangle = fragments.triangle.reshape(height, width, -1)
    samples = triangle.shape[-1]
    background = jnp.mean(triangle < 0, -1, dtype=mesh.position.dtype)
    shown = raster.front_faces(mesh, camera)[triangle] & (triangle >= 0)
    if samples == 1:
        return shown.astype(jnp.uint8), background
    same = _smooth(triangle, fragments.depth, mesh, camera)
    first = []
    for j in range(samples):
        leader = jnp.full((height, width), j)
        for i in reversed(range(j)):
            leader = jnp.where(same[i, j] & (first[i] == i), i, leader)
        first.append(jnp.where(shown[..., j], leader, -1))
    members = [sum((first[j] == i) << j for j in range(i, samples)) for i in range(samples)]
    return jnp.stack(members, -1).astype(jnp.uint8), background


def _smooth(triangle: Int[Array, "h w s"], depth: Float[Array, "h w s"], mesh: Mesh, camera: Camera) -> dict:
    """Whether two samples of a pixel are of one surface, for each pair (i, j) of samples with i < j.

    The inverse depth is linear on a triangle's picture. Between samples of two triangles it changes by the mean of both
    gradients, give or take what either explains.
    """
    normal = sum(mesh.normal[mesh.face[:, i]] for i in range(3))
    size = jnp.sum(normal**2, -1, keepdims=True)
    normal = normal / jnp.sqrt(jnp.where(size > 0, size, 1))
    region = mesh.region[mesh.face[:, :1]].astype(normal.dtype)
    column, row = _inverse_depth_gradient(*(axis[mesh.face.T] for axis in raster.project(mesh.position, camera)))
    table = jnp.concatenate([normal, region, column[:, None], row[:, None]], -1)[triangle]
    each = [table[..., i, :] for i in range(triangle.shape[-1])]
    inverse = 1 / depth
    offset = SAMPLES[triangle.shape[-1]]
    same = {}
    for j in range(len(each)):
        for i in range(j):
            right, down = offset[j] - offset[i]
            step = [right * one[..., 4] + down * one[..., 5] for one in (each[i], each[j])]
            near, far = inverse[..., i], inverse[..., j]
            jump = jnp.abs(far - near - (step[0] + step[1]) / 2)
            explained = (jnp.abs(step[0]) + jnp.abs(step[1])) / 2 + SAME_DEPTH * near
            alike = sum(each[i][..., axis] * each[j][..., axis] for axis in range(3)) >= SMOOTH
            joined = alike & (each[i][..., 3] == each[j][..., 3]) & (jump <= explained)
            same[i, j] = joined | (triangle[..., i] == triangle[..., j])
    return same


def _inverse_depth_gradient(x, y, q) -> tuple[Float[Array, " f"], Float[Array, " f"]]:
    """Change of 1 / depth on each triangle per pixel to the right, and per pixel down; 0 without area."""
    s = jnp.sign(q)
    value, column, row = _affine(x, y, q, s[0] * x[0], s[0] * y[0])
    area = sum(value[i] * s[i] for i in range(3))
    inverse = jnp.where(area == 0, 0, 1 / jnp.where(area == 0, 1, area))
    weight = jnp.abs(q)
    return tuple(sum(part[i] * weight[i] for i in range(3)) * inverse for part in (column, row))


def _affine(x, y, q, column, row):
    """The three determinants of `raster.rasterize` at points of the picture, and their change to the right and down."""
    s = [jnp.sign(q[i]) for i in range(3)]
    a = [x[i] - s[i] * column for i in range(3)]
    b = [y[i] - s[i] * row for i in range(3)]
    pairs = ((1, 2), (2, 0), (0, 1))
    value = [a[i] * b[j] - a[j] * b[i] for i, j in pairs]
    return value, [s[j] * b[i] - s[i] * b[j] for i, j in pairs], [s[i] * a[j] - s[j] * a[i] for i, j in pairs]


@jax.jit
def _points(index: Int[Array, " p"], members: UInt8[Array, "h w s"], triangle, mesh: Mesh, camera: Camera):
    """Triangles, weights, slopes, pixels and coverage of the surfaces that the samples `index` stand for."""
    mesh, camera = jax.lax.stop_gradient((mesh, camera))
    samples, dtype = members.shape[-1], mesh.position.dtype
    used, sample = index >= 0, jnp.maximum(index, 0)
    pixel = jnp.where(used, sample // samples, camera.width * camera.height - 1)
    triangle = jnp.where(used, triangle.ravel()[sample], -1)
    member = jnp.where(used, members.ravel()[sample], 0)
    middle, coverage = (jnp.asarray(each, dtype)[member] for each in _subsets(samples))
    start = jnp.asarray(SAMPLES[samples], dtype)[sample % samples]
    vertex = mesh.face[jnp.maximum(triangle, 0)]
    projected = jnp.stack(raster.project(mesh.position, camera), -1)[vertex]
    x, y, q = ([projected[:, i, axis] for i in range(3)] for axis in range(3))
    column = (pixel % camera.width).astype(dtype) + (1 - camera.width) / 2 + start[:, 0]
    row = (pixel // camera.width).astype(dtype) + (1 - camera.height) / 2 + start[:, 1]

    value, right, down = _affine(x, y, q, column, row)
    turned = jnp.sign(sum(value[i] * jnp.sign(q[i]) for i in range(3)))
    scale = [turned * jnp.abs(q[i]) for i in range(3)]
    value, right, down = ([scale[i] * part[i] for i in range(3)] for part in (value, right, down))
    step = middle - start
    change = [step[:, 0] * right[i] + step[:, 1] * down[i] for i in range(3)]
    leaves = [value[i] + change[i] < 0 for i in range(3)]
    reach = [jnp.where(leaves[i], -value[i] / jnp.where(leaves[i], change[i], 1), 1) for i in range(3)]
    reach = jnp.clip(jnp.minimum(jnp.minimum(reach[0], reach[1]), reach[2]), 0, 1)
    weight = jnp.stack([jnp.maximum(value[i] + reach * change[i], 0) for i in range(3)], -1)
    total = jnp.sum(weight, -1, keepdims=True)
    some = total > 0
    total = jnp.where(some, total, 1)
    weight = jnp.where(some, weight / total, 1 / 3)
    slope = jnp.stack([jnp.stack(right, -1), jnp.stack(down, -1)], 1)
    slope = (slope - weight[:, None] * jnp.sum(slope, -1, keepdims=True)) / total[:, None]
    slope = jnp.where(some[:, None] & used[:, None, None], jnp.clip(slope, -STEEPEST, STEEPEST), 0)
    return triangle, jnp.where(used[:, None], weight, 0), slope, pixel, coverage


@functools.cache
def _subsets(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean position of each subset of the samples, and its share of them. Bit i of a subset's number is sample i."""
    member = (np.arange(1 << samples)[:, None] >> np.arange(samples)) & 1
    count = member.sum(1)
    return member @ SAMPLES[samples] / np.maximum(count, 1)[:, None], count / samples
