"""Layers of pictures besides color: coverage, geometry, materials, and light by its way.

Layers that a compositor or a denoiser averages are averaged over the samples of each pixel, as the color is: where
surfaces cover a part of a pixel, these layers hold that part of their values. Depth, position and part cannot be
averaged. They are those of the surface that covers most of the pixel.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxprt import require
from jaxprt.files.outputs import LAYERS
from jaxprt.image import raster
from jaxprt.image.pixels import Pixels
from jaxprt.relit import canvas
from jaxprt.relit.groups import Stage
from jaxprt.scene import Camera

LIGHT = ("color", "direct", "reflected")  # layers that depend on the light
_NEAREST = ("depth", "position", "part")  # those of one surface for each pixel
_SHARE = 1e-3  # of a pixel that a surface must cover to have a depth, a position and a part


def check(names: Any) -> tuple[str, ...]:
    """The names of layers, checked.

    Raises:
        TypeError: The names are not a list of words.
        ValueError: There are none, one is unknown, or one comes twice.
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not all(isinstance(name, str) for name in names):
        raise TypeError(f'layers must be a list of names such as ["color", "alpha"], got {require.shown(names)}')
    unknown = [name for name in names if name not in LAYERS]
    if unknown or not names or len(set(names)) < len(names):
        got = f"{unknown[0]!r}" if unknown else require.shown(list(names))
        raise ValueError(f"layers must be different ones of {', '.join(LAYERS)}, got {got}")
    return tuple(names)


def of_points(
    stage: Stage,
    pixels: Pixels,
    rows: Sequence[tuple[int, Any]],
    camera: Camera,
    names: Sequence[str],
    *,
    fold: int,
) -> dict[str, Array]:
    """The layers of a picture that do not depend on the light.

    Args:
        stage: The scene and its materials.
        pixels: The points of the picture.
        rows: Group and indices of the points that are evaluated together; -1 in padding.
        camera: The camera of the drawn pixels, relative to the origin of the scene.
        names: Names of layers, without those of light and alpha.
        fold: Edge in drawn pixels of the squares that are averaged to one pixel of the picture.
    """
    if isinstance(pixels.triangle, Tracer):
        raise TypeError("layers besides light need a known camera and mesh: make the picture outside of jax.jit")
    height, width, dtype = camera.height, camera.width, np.asarray(pixels.barycentric).dtype
    averaged = {name: jnp.zeros((height, width, len(LAYERS[name])), dtype) for name in names if name not in _NEAREST}
    gray = _gray(pixels)
    for group, index in rows if averaged else ():
        values = _materials(stage, pixels, group, index)
        drawn = {
            name: jnp.broadcast_to(values[name], (len(index), image.shape[-1])) for name, image in averaged.items()
        }
        averaged = {name: canvas.draw(image, gray, index, drawn[name]) for name, image in averaged.items()}
    result: dict[str, Any] = {name: _mean(image, fold) for name, image in averaged.items()}
    if any(name in _NEAREST for name in names):
        result |= _nearest(stage, pixels, camera, names, fold=fold)
    return {name: image[..., 0] if image.shape[-1] == 1 else image for name, image in result.items()}


def _gray(pixels: Pixels) -> Pixels:
    """The points with one coverage for all colors, as layers of materials have it."""
    if np.ndim(pixels.coverage) == 1:
        return pixels
    return dataclasses.replace(pixels, coverage=np.asarray(pixels.coverage).mean(-1))


def _materials(stage: Stage, pixels: Pixels, group: int, index: Int[np.ndarray, " p"]) -> dict[str, Any]:
    """Normals, base colors and roughness at points of a row."""
    points, on_group = canvas.points_of(stage, pixels, index)
    look = stage.table.at(points)
    surface = stage.surfaces[group]
    normal, albedo = on_group.tilted(look.normal).frame(surface.frame)[:, 2], look.values.base_color
    if surface.scale is None and surface.matte:  # of a BRDF that cannot change
        albedo = surface.system.view(jnp.zeros(3, normal.dtype), None)
    return {"normal": normal, "albedo": albedo, "roughness": jnp.exp(look.log_roughness)[:, None]}


def _mean(image: Float[Array, "h w c"], fold: int) -> Float[Array, "_ _ c"]:
    """Means over squares of `fold` x `fold` pixels."""
    height, width, channels = image.shape
    return jnp.mean(image.reshape(height // fold, fold, width // fold, fold, channels), (1, 3))


def _nearest(stage: Stage, pixels: Pixels, camera: Camera, names: Sequence[str], *, fold: int) -> dict[str, Any]:
    """The part that covers most of each pixel, and depth and position of its point nearest to the pixel's middle."""
    width, rows, columns = camera.width, camera.height // fold, camera.width // fold
    triangle, coverage = np.asarray(pixels.triangle), np.asarray(_gray(pixels).coverage)
    real = np.flatnonzero((triangle >= 0) & (coverage > _SHARE))
    at = np.asarray(pixels.pixel)[real].astype(np.int64)
    at = at // width // fold * columns + at % width // fold
    corner = stage.face[triangle[real]]
    part = stage.part[corner[:, 0]]
    weight = np.asarray(pixels.barycentric, np.float64)[real]
    position = np.einsum("pk,pkc->pc", weight, np.asarray(stage.whole.position)[corner])
    way = position - np.asarray(camera.eye)
    middle = raster.ray_direction(dataclasses.replace(camera, width=columns, height=rows)).reshape(-1, 3)
    apart = np.linalg.norm(way / np.linalg.norm(way, axis=1, keepdims=True) - np.asarray(middle)[at], axis=1)
    _, same = np.unique(at * len(stage.layout.counts) + part, return_inverse=True)
    order = np.lexsort([-apart, np.bincount(same, coverage[real])[same]])
    shown, place = np.full(rows * columns, -1, np.int32), np.zeros((rows * columns, 3))
    shown[at[order]], place[at[order]] = part[order], position[order]  # of equal indices the last one is written
    seen, result = shown >= 0, {}
    if "depth" in names:
        eye, target = np.asarray(camera.eye), np.asarray(camera.target)
        ahead = (target - eye) / np.linalg.norm(target - eye)
        result["depth"] = np.where(seen, (place - eye) @ ahead, np.inf)
    if "part" in names:
        result["part"] = shown
    if "position" in names:
        world = place + np.asarray(stage.whole.origin)
        result["position"] = np.where(seen[:, None], world, 0)
    return {name: jnp.asarray(value.reshape(rows, columns, -1)) for name, value in result.items()}
