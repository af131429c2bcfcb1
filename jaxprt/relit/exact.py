"""Pixels of the exact picture: the sum over all texels at several points of each, with rays of their own."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxprt.image import front, raster, rasterize
from jaxprt.relit.channels import Shading, exact_at
from jaxprt.scene import Camera, Environment, Scene
from jaxprt.scene.environment import background
from jaxprt.scene.points import on_triangles
from jaxprt.systems import reference

_SIDE = 4  # places along the edge of a pixel


class ExactPixels(NamedTuple):
    """Some pixels of the exact picture in direct light.

    Attributes:
        pixel: Numbers of the pixels, row * width + column.
        part: Number of the part in its middle.
        color: Linear radiance under each light.
        error: Relative L2 under each light that the number of points may leave, by halves of them.
    """

    pixel: Int[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    color: Float[np.ndarray, "l n c"]
    error: Float[np.ndarray, " l"]


def exact_pixels(
    scene: Scene,
    shadings: Sequence[Shading],
    environments: Sequence[Environment],
    camera: Camera,
    *,
    pixels: int | None = None,
    points: int = 4,
    progress: bool = False,
) -> ExactPixels:
    """Pixels of a picture, exact but for the number of points: the yardstick of pictures.

    What a pixel shows is found at 4 x 4 places. Of each surface some of these are shaded, with rays of their own.

    Args:
        scene: The scene.
        shadings: What its parts are to systems.
        environments: Lights of one size.
        camera: From where.
        pixels: How many of those that show the scene, by chance and of each part alike; all if None.
        points: Of each pixel and part that are shaded, by chance. One costs some milliseconds.
        progress: Whether to show progress bars.
    """
    mesh, lights = scene.mesh, Environment(jnp.stack([each.radiance for each in environments]))
    fine = dataclasses.replace(camera, width=_SIDE * camera.width, height=_SIDE * camera.height)
    fragments = rasterize(mesh, fine)
    every = fragments.triangle, fragments.barycentric, front(fragments, mesh, fine)
    triangle, weight, seen = (_squares(np.asarray(each)) for each in every)
    region = np.asarray(mesh.region)[np.asarray(mesh.face)[:, 0]]
    owner = np.where(triangle >= 0, region[triangle], -1)
    shown = owner[:, owner.shape[1] // 2 + _SIDE // 2]
    pixel = _chosen(shown, len(scene.parts), pixels)
    triangle, weight, seen, owner = triangle[pixel], weight[pixel], seen[pixel], owner[pixel]
    way = raster.ray_direction(fine)
    sky = np.stack([_squares(np.asarray(background(each, way)))[pixel] for each in environments])
    mean = np.where((owner < 0)[..., None], sky, 0).mean(2)
    half = np.zeros_like(mean)
    first = 0
    for number, (part, shading) in enumerate(zip(scene.parts, shadings, strict=True)):
        own = (owner == number) & seen
        row, place = np.nonzero(_some(own, points))
        face = np.asarray(mesh.face) - first
        first += len(part.mesh.position)
        if not len(row):
            continue
        where = on_triangles(face, triangle[row, place], weight[row, place])
        brdf, emitted = exact_at(part, shading, where)
        options = {"eye": camera.eye, "occluder": mesh, "points": where, "progress": progress}
        value = np.asarray(reference.radiance(shading.mesh, brdf, lights, **options), np.float64)
        value = value if emitted is None else value + np.asarray(emitted)
        share = own.mean(1)[:, None]
        rank = np.arange(len(row)) - np.searchsorted(row, row)
        both = [share * _mean(value[:, rank % 2 == side], row[rank % 2 == side], len(pixel)) for side in (0, 1)]
        whole = share * _mean(value, row, len(pixel))
        mean = mean + whole
        alone = np.bincount(row, minlength=len(pixel))[:, None] < 2
        half = half + np.where(alone, whole * (own.sum(1) > 1)[:, None], (both[0] - both[1]) / 2)
    norm = np.sqrt(np.sum(mean**2, (1, 2)))
    error = np.sqrt(np.sum(half**2, (1, 2))) / np.where(norm > 0, norm, 1)
    return ExactPixels(pixel, shown[pixel], mean, error)


def _some(own: np.ndarray, count: int) -> np.ndarray:
    """At most so many in each row, by chance, and as far apart as their quarters of the pixel let them be."""
    random = np.random.default_rng(1)
    half = _SIDE // 2
    turn = random.random((len(own), 2, 2, half * half)).argsort(-1).reshape(len(own), 2, 2, half, half)
    order = turn.swapaxes(2, 3).reshape(own.shape) + random.random(own.shape)
    order = np.where(own, order, np.inf)
    least = np.sort(order, 1)[:, min(count, own.shape[1]) - 1]
    return own & (order <= least[:, None])


def _mean(value: Float[np.ndarray, "l m c"], row: np.ndarray, rows: int) -> Float[np.ndarray, "l n c"]:
    """Means of values that belong to the same row; zero of none."""
    total = np.stack(
        [np.stack([np.bincount(row, each, rows) for each in light.T], -1) for light in np.asarray(value, np.float64)]
    )
    return total / np.maximum(np.bincount(row, minlength=rows), 1)[:, None]


def _squares(fine: np.ndarray) -> np.ndarray:
    """Values of a picture [h w *c] side by side for each coarse pixel: [pixel, place, *c]."""
    rows, columns = fine.shape[0] // _SIDE, fine.shape[1] // _SIDE
    each = fine.reshape(rows, _SIDE, columns, _SIDE, *fine.shape[2:]).swapaxes(1, 2)
    return each.reshape(rows * columns, _SIDE**2, *fine.shape[2:])


def _chosen(shown: np.ndarray, parts: int, count: int | None) -> np.ndarray:
    """Pixels of each part, alike many as far as it has them."""
    if count is None:
        return np.flatnonzero(shown >= 0)
    random = np.random.default_rng(0)
    each = [random.permutation(np.flatnonzero(shown == number))[: -(-count // parts)] for number in range(parts)]
    return np.sort(np.concatenate(each))
