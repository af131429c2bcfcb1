"""Shadows of the brightest texels of a light in pictures, by rays from the points of the picture.

The radiance by which a few texels exceed the rest of the light is taken out of it. The systems of the scene relight the
rest, with visibility that is interpolated between vertices. What the texels add is the product of radiance, BRDF and
cosine at the point itself, times the share of the texel that rays from the point see.

Cells of the light, which the systems `lobe` and `dynamic` sum too, are many. The shares of those with the most flux are
traced where the corners of a triangle differ, and those of all others are interpolated.

Rays are cast on the host. They are constants of all derivatives.
"""

import collections
import threading
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8

from jaxprt.compile import compile_time, known, put
from jaxprt.image.pixels import Pixels
from jaxprt.relit import canvas
from jaxprt.relit.casting import caster
from jaxprt.relit.groups import Stage
from jaxprt.scene import Environment, Mesh, light_samples
from jaxprt.scene import environment as environments
from jaxprt.scene.panorama import Panorama
from jaxprt.sphere import cubemap
from jaxprt.systems import bright_texels
from jaxprt.systems.bright_texels import BrightLight, BrightTexels, Squares
from jaxprt.systems.lobe import blurred_light
from jaxprt.systems.lobe.blurred_light import LobeLight
from jaxprt.visibility import picture_rays

TEXELS = 16  # number of traced texels
_RANK = 2 * TEXELS  # What exceeds the flux of so many texels is traced; the systems sum about as many texels again.
_LEAST = 1e-3  # smallest share of the light's flux of a traced texel
_MORE = 32  # rays of a point beyond one for each texel, if they had all of the light's flux
_FINE = 256  # edge of the cubemap whose flux draws the places of rays within texels
_CELLS = 48  # number of traced texels and cells of the light that arrives at a group
_CELL_RAYS = 128  # rays of a point to these beyond one for each, in proportion to their flux
_FEWER = 0.7  # share of the wanted rays with which a texel that was traced before is not traced again
_KEPT, _MOST = 4, 4 * TEXELS  # number of views whose traced texels are kept, and of texels of each

_FINER: weakref.WeakKeyDictionary[Panorama, dict[int, np.ndarray]] = weakref.WeakKeyDictionary()


class TexelShares(eqx.Module):
    """Texels of the light that were traced for the points of a view.

    Attributes:
        texel: Indices of the texels.
        share: Share of each texel that each point of the picture sees, in 240ths.
        spot: Where in each texel the light of its file comes from; see `light_samples.spots_in_texels`.
    """

    texel: Int[Array, " t"]
    share: UInt8[Array | np.ndarray, "t p"]
    spot: Float[Array, "t 4"]


class TracedLight(eqx.Module):
    """A light whose brightest texels are traced.

    Attributes:
        rest: The light without what is taken out of these texels.
        excess: The radiance that is taken out of each.
        shares: The texels, and what the points of the picture see of them.
    """

    rest: Environment
    excess: Float[Array, "t c"]
    shares: TexelShares


def of_points(light: TracedLight, index: Any) -> tuple[Array, Array, Array, Array]:
    """The traced texels, what is taken out of them, their shares at some points, and places; -1 is padding."""
    shares = light.shares
    if known(shares.share, index):  # The number of points depends on the view.
        row = put(np.asarray(shares.share)[:, np.maximum(index, 0)])
    else:
        row = jnp.asarray(shares.share)[:, jnp.maximum(index, 0)]
    return shares.texel, light.excess, row, shares.spot


def trace(mesh: Mesh, pixels: Pixels, width: int, environment: Environment, *, keep: bool) -> TracedLight | None:
    """Traces the brightest texels of a light from the points of a picture.

    Args:
        mesh: The mesh of all parts of the scene.
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
        environment: The light.
        keep: Whether to keep the shares for other lights of the same view.

    Returns:
        The light, or None if no texel stands out of it, or JAX traces the light, the mesh or the points.
    """
    if not known(mesh, pixels, environment):
        return None
    with compile_time(environment):
        texel, excess, rest = bright_texels.brightest(environment, count=TEXELS, rank=_RANK, least=_LEAST)
    size = environment.radiance.shape[-2]
    number = np.asarray(texel)
    flux = np.asarray(excess, np.float64).sum(-1) * np.asarray(cubemap.solid_angle(size=size)).ravel()[number]
    bright = np.flatnonzero(flux > 0)
    if not len(bright):
        return None
    whole = np.sum(np.asarray(environment.radiance, np.float64).sum(-1) * np.asarray(cubemap.solid_angle(size=size)))
    count = _counts(_MORE * flux[bright] / whole)
    fine = finer(environment, size=_FINE)
    direction = light_samples.in_texels(number[bright], fine, size=size, count=picture_rays.PLACES)
    share = np.zeros((len(number), len(pixels.triangle)), np.uint8)
    rays = picture_rays.TexelRays(direction, count)
    share[bright] = _shares(mesh, pixels, width, number[bright], rays) if keep else _cast(mesh, pixels, width, rays)
    spot = light_samples.spots_in_texels(number, fine, size=size)
    return TracedLight(rest, excess, TexelShares(texel, share, put(spot.astype(environment.radiance.dtype))))


class CellLight(NamedTuple):
    """The texels and cells of the light that arrives at a group, and the points of a picture.

    Attributes:
        stage: The scene.
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
        seen: Visible shares of texels and cells at the vertices of the group, in 240ths.
        rays: Rays to even places in them.
    """

    stage: Stage
    pixels: Pixels
    width: int
    seen: UInt8[np.ndarray, "v t"]
    rays: picture_rays.TexelRays

    def row(self, index: Int[np.ndarray, " p"]) -> UInt8[Array, "t p"]:
        """Visible shares at some points of the group, in 240ths, by rays where the corners of a triangle differ.

        Args:
            index: Indices of the points; -1 in padding.
        """
        points, cast = canvas.traced(self.pixels, self.width, index), caster(self.stage.whole)
        corner = np.asarray(self.stage.face)[np.maximum(points.triangle, 0)].T
        stored = self.seen, corner - np.asarray(self.stage.shift)[corner]
        return put(picture_rays.shares(cast.triangles, cast.occluder, points, self.rays, stored=stored))


def _rays_to(light: BrightLight, squares: Sequence[Squares]) -> picture_rays.TexelRays:
    """Rays to even places in the texels and cells with the most flux, more to those with more of it."""
    ends = np.cumsum([square.number for square in squares])[:-1]
    texel = np.split(np.asarray(light.texel), ends)
    edges = [square.edge for square in squares]
    area = [np.asarray(cubemap.solid_angle(size=edge)).ravel()[at] for edge, at in zip(edges, texel, strict=True)]
    flux = np.abs(np.asarray(light.excess, np.float64).sum(1)) * np.concatenate(area)
    strong = np.argsort(-flux, kind="stable")[:_CELLS]
    strong = strong[flux[strong] > 0]
    count = np.zeros(len(flux), int)
    count[strong] = _counts(_CELL_RAYS * flux[strong] / flux[strong].sum())
    direction = np.zeros((len(flux), picture_rays.PLACES, 3), np.float32)
    for edge, at, part, traced in zip(edges, texel, np.split(direction, ends), np.split(count > 0, ends), strict=True):
        if not traced.any():
            continue
        even = np.broadcast_to(np.float32(0), (6, 8 * edge, 8 * edge, 1))
        part[traced] = light_samples.in_texels(at[traced], even, size=edge, count=picture_rays.PLACES)
    return picture_rays.TexelRays(direction, count)


def _counts(more: Float[np.ndarray, " t"]) -> Int[np.ndarray, " t"]:
    """Numbers of rays to texels or cells: one each, and more of them."""
    return np.clip(1 + np.round(more).astype(int), 1, picture_rays.PLACES)


def cells(stage: Stage, pixels: Pixels, width: int, direct: Sequence[Any]) -> Iterator[CellLight | None]:
    """Cells of the light that arrives at each group; None without, or if JAX traces the light, the mesh or the points.

    Args:
        stage: The scene.
        pixels: The points of the picture.
        width: Width of the picture in drawn pixels.
        direct: Direct light at each group, in the form of its system.
    """
    for surface, light in zip(stage.surfaces, direct, strict=True):
        system = surface.system
        if (
            not isinstance(system, BrightTexels)
            or not system.cells
            or not known(stage.whole, pixels, light)
            or not np.asarray(light.excess).any()
        ):
            yield None
        else:
            seen = np.ascontiguousarray(np.asarray(light.seen).T)
            yield CellLight(stage, pixels, width, seen, _rays_to(light, system.squares))


def untraced(environment: Environment) -> Environment:
    """A light without what pictures trace of it."""
    return bright_texels.brightest(environment, count=TEXELS, rank=_RANK, least=_LEAST)[2]


def fixed(environment: Environment, shares: TexelShares) -> TracedLight:
    """A light, known or traced by JAX, with texels that were traced before."""
    excess, rest = bright_texels.without(environment, shares.texel, rank=_RANK, least=_LEAST)
    return TracedLight(rest, excess, shares)


def sharpened(stage: Stage, direct: tuple[PyTree, ...], environment: Environment) -> tuple[PyTree, ...]:
    """The result of `groups.direct`, in groups with very narrow lobes with the finer texels of an environment."""

    def with_texels(light: Any) -> Any:
        if not isinstance(light, LobeLight):
            return light
        texels = None
        if environment.panorama is not None and light.size == environment.radiance.shape[-2]:
            texels = put(finer(environment, size=blurred_light.FINER * light.size))
        return blurred_light.sharpened(light, texels)

    return tuple(
        jax.tree.map(with_texels, light, is_leaf=lambda part: isinstance(part, LobeLight))
        if stage.finer(group)
        else light
        for group, light in enumerate(direct)
    )


def finer(light: Environment, *, size: int) -> Float[np.ndarray, "6 m m c"]:
    """The light in faces with an edge of so many texels; its own texels if it knows no finer ones."""
    edge, panorama = light.radiance.shape[-2], light.panorama
    if panorama is None or edge >= size or size % edge:
        return np.asarray(light.radiance)
    known = _FINER.setdefault(panorama, {})
    if size not in known:
        with compile_time():  # also while JAX traces the camera
            known[size] = np.asarray(environments.finer(light, size=size).radiance)
    return known[size]


def _cast(mesh: Mesh, pixels: Pixels, width: int, rays: picture_rays.TexelRays) -> UInt8[np.ndarray, "t p"]:
    cast = caster(mesh)
    points = canvas.traced(pixels, width, np.arange(len(pixels.triangle)))
    return picture_rays.shares(cast.triangles, cast.occluder, points, rays)


# For each view, the traced texels: number of rays, a direction of each, and the shares.
_VIEWS: collections.OrderedDict[int, tuple[Any, dict]] = collections.OrderedDict()
_LOCK = threading.Lock()


def _shares(
    mesh: Mesh, pixels: Pixels, width: int, texel: Int[np.ndarray, " t"], rays: picture_rays.TexelRays
) -> UInt8[np.ndarray, "t p"]:
    """The shares of texels, of which only those are traced that were not traced before."""
    rows = _rows_of(pixels.triangle)
    share = np.empty((len(texel), len(pixels.triangle)), np.uint8)
    new = []
    for number, (index, direction, count) in enumerate(zip(texel, rays.direction, rays.per_texel, strict=True)):
        before = rows.get(int(index))
        if before is None or before[0] < _FEWER * count or not np.array_equal(before[1], direction):
            new.append(number)
        else:
            share[number] = before[2]
    if new:
        share[new] = _cast(mesh, pixels, width, picture_rays.TexelRays(rays.direction[new], rays.per_texel[new]))
    with _LOCK:
        for number in new:
            rows[int(texel[number])] = int(rays.per_texel[number]), rays.direction[number], share[number]
        for index in list(rows)[: max(len(rows) - _MOST, 0)]:
            del rows[index]
    return share


def _rows_of(triangle: Any) -> dict[int, tuple[int, np.ndarray, np.ndarray]]:
    """The traced texels of a view, which its array of triangles identifies."""
    key = id(triangle)
    with _LOCK:
        alive, rows = _VIEWS.get(key, (lambda: None, None))
        if rows is None or alive() is not triangle:
            rows = {}
            _VIEWS[key] = weakref.ref(triangle), rows
        _VIEWS.move_to_end(key)
        while len(_VIEWS) > _KEPT:
            _VIEWS.popitem(last=False)
        return rows
