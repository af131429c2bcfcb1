"""Sheets of pictures with captions, radiance at the pixels of a mesh without shadows, and its exact value."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from jaxprt import image, reference, visibility
from jaxprt.image.pixels import Pixels
from jaxprt.scene import Camera, Environment, Mesh
from jaxprt.sphere import directions

MOST = 295_000  # bytes of a picture
_LINE = 22  # pixels of a line of a caption
_BLOCK = 512  # points integrated at once


def sheet(
    path: pathlib.Path, rows: Sequence[Sequence[np.ndarray]], captions: Sequence[Sequence[str]], *, gap: int = 6
) -> None:
    """Writes rows of pictures with a caption above each, as a JPEG of at most 300 kB.

    Args:
        path: The file.
        rows: Pictures [h, w, 3] of display values from 0 to 1; those of a row have the same height.
        captions: A caption for each, of one line or several; empty rows of captions take no room.
        gap: Pixels between pictures.
    """
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 16)
    strips = []
    for pictures, names in zip(rows, captions, strict=True):
        lines = max((name.count("\n") + 1 for name in names if name), default=0)
        tiles = []
        for picture, name in zip(pictures, names, strict=True):
            body = Image.fromarray((255 * np.clip(np.asarray(picture), 0, 1) + 0.5).astype(np.uint8))
            tile = Image.new("RGB", (body.width + gap, body.height + lines * _LINE + gap), "white")
            tile.paste(body, (0, lines * _LINE))
            ImageDraw.Draw(tile).multiline_text((3, 1), name, fill="black", font=font, spacing=3)
            tiles.append(np.asarray(tile))
        strips.append(np.concatenate(tiles, 1))
    width = max(strip.shape[1] for strip in strips)
    strips = [np.pad(s, ((0, 0), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    whole = Image.fromarray(np.concatenate(strips, 0))
    for quality in (92, 88, 84, 78, 70, 60, 50, 40):
        whole.save(path, quality=quality, optimize=True, progressive=True)
        if path.stat().st_size <= MOST:
            return
    raise ValueError(f"{path}: must have at most {MOST} bytes, got {path.stat().st_size} at the lowest quality")


def shown(radiance: Any, *, like: Any = None) -> np.ndarray:
    """Display values of a picture, exposed as itself or as another one."""
    stops = image.automatic_exposure(jnp.asarray(radiance if like is None else like))
    return np.asarray(image.display(image.expose(jnp.asarray(radiance), stops=stops)))


class Shaded(eqx.Module):
    """The points that a picture of a mesh shades, as a mesh without triangles.

    Attributes:
        pixels: Their pixels and coverage.
        point: Position, normal and tangent of each.
    """

    pixels: Pixels
    point: Mesh

    def picture(self, color: Any, *, white: bool = True) -> np.ndarray:
        """The picture that colors of the points make; NaN where no surface is, for `on_white`."""
        drawn = np.asarray(image.resolve(self.pixels, color))
        if not white:
            return drawn
        return np.concatenate([drawn, 1 - np.asarray(self.pixels.background)[..., None]], -1)


def on_white(drawn: np.ndarray, *, stops: Any) -> np.ndarray:
    """Display values of a picture with coverage [h, w, 4], over white."""
    color = np.asarray(image.expose(jnp.asarray(drawn[..., :3]), stops=stops)) + (1 - drawn[..., 3:])
    return np.asarray(image.display(jnp.asarray(color)))


def shaded(mesh: Mesh, camera: Camera) -> Shaded:
    """The points of a picture with four samples in each pixel."""
    pixels = image.shading_points(image.rasterize(mesh, camera, samples=4), mesh, camera)
    place, normal, tangent = (
        image.interpolate(pixels, mesh.face, each) for each in (mesh.position, mesh.normal, mesh.tangent)
    )
    axes = directions.frame(directions.normalize(normal), tangent)
    region = jnp.zeros(len(place), jnp.int32)
    return Shaded(pixels, Mesh(place, mesh.face[:0], axes[:, 2], axes[:, 0], region))


def unshadowed(point: Mesh, brdf: Callable, light: Environment, eye: Any, number: np.ndarray) -> np.ndarray:
    """Exact radiance of some points without shadows: the integral over all texels.

    Args:
        point: Position and frame of the points.
        brdf: A BRDF that is a pytree.
        light: One environment.
        eye: The viewer.
        number: Numbers of the points.
    """
    texels = light.radiance.shape[-2] ** 2 * 6
    frame = directions.frame(point.normal, point.tangent)
    seen = jnp.full((_BLOCK, texels), visibility.LEVELS, jnp.uint8)
    batch, result = Environment(light.radiance[None]), []
    for first in range(0, len(number), _BLOCK):
        part = jnp.asarray(np.resize(number[first : first + _BLOCK], _BLOCK))
        color = reference.integrate(seen, point.position[part], frame[part], brdf, batch, eye)
        result.append(np.asarray(jax.block_until_ready(color))[0, : len(number) - first])
    return np.concatenate(result)


def some(point: Mesh, eye: Any, count: int) -> np.ndarray:
    """Numbers of random points that face the eye."""
    facing = np.sum(np.asarray(point.normal) * (np.asarray(eye) - np.asarray(point.position)), 1) > 0
    known = np.flatnonzero(facing & np.all(np.isfinite(np.asarray(point.normal)), 1))
    return np.sort(np.random.default_rng(0).permutation(known)[:count])
