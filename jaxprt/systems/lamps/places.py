"""Places on lamps for rays from the points of a picture, and the transport at these points."""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Array, Float, Float32, Int

from jaxprt.scene.mesh import Mesh
from jaxprt.scene.scene import PointLight
from jaxprt.systems.lamps import outline
from jaxprt.systems.lamps.transport import LampTransport, sample_surface
from jaxprt.visibility.picture_rays import LampPlaces

_PLACES = 4096  # places on a surface to which rays may go
_LEVELS = (64, 256, 1024, _PLACES)  # places whose light is added up, from far lamps to close ones
_FLAT = 0.99  # smallest length of the sum of normals around a place, relative to their number
_OPEN = 0.5  # smallest length of the sum of all normals of an open surface, relative to their number
_CUTS = 16  # most pieces of a surface
_RAYS = 16  # first rays from each point, which all lamps share
_FEWEST, _MOST = 4, 8  # of these for each lamp


def places(lamps: Sequence[Mesh | PointLight], power: Float[np.ndarray, " n"], *, pieces: int = 4) -> LampPlaces:
    """Places on lamps.

    Args:
        lamps: Emitting surfaces and point lights, in the coordinates of the points that they light.
        power: The power of each lamp, in any unit. Stronger lamps get more rays, if there are many.
        pieces: Number of pieces into which each surface is cut: 1, 4 or 16. Surfaces that turn to all sides have twice
            as many, up to 16.
    """
    rows, first, count, cut, sides, total = [], [], [], [], [], 0
    for lamp in lamps:
        levels = _levels(lamp)
        # Points see half of a lamp that turns to all sides: a closed surface, or a sheet with two sides.
        sides.append(2 if _is_closed(levels[-1][1]) else 1)
        cut.append(min(pieces * sides[-1], _CUTS) if isinstance(lamp, Mesh) else 1)
        size = np.array([len(place) for place, _ in levels])
        first.append(total + np.cumsum(size) - size)
        count.append(size // cut[-1])
        rows += levels
        total += int(size.sum())
    place, area = (np.concatenate(column).astype(np.float32) for column in zip(*rows, strict=True))
    share = np.asarray(power, np.float64) / max(float(np.sum(power)), np.finfo(float).tiny)
    rays = 2 ** np.round(np.log2(np.maximum(_RAYS * share, 1)))
    strata = sides * np.clip(rays, _FEWEST, [_MOST if isinstance(lamp, Mesh) else _FEWEST for lamp in lamps])
    return LampPlaces(place, area, *(np.asarray(column, np.int64) for column in (first, count, cut, strata)))


def outlines(
    lamps: Sequence[Mesh | PointLight], on_lamps: LampPlaces
) -> tuple[Float[Array, "f q k 3"] | None, tuple[int, ...]]:
    """Outlines of flat lamps and of their pieces, and which lamps these are.

    Args:
        lamps: The lamps.
        on_lamps: Places on them, from `places`.
    """
    first, count = on_lamps.first[:, -1], on_lamps.per_piece[:, -1] * on_lamps.pieces
    finest = [on_lamps.place[start : start + size] for start, size in zip(first, count, strict=True)]
    return outline.of_lamps(lamps, finest, on_lamps.pieces.tolist())


def _levels(lamp: Mesh | PointLight) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and areas at each level. Levels too coarse for the curvature of a lamp are empty."""
    empty = np.zeros((0, 3))
    if isinstance(lamp, PointLight):
        alone = np.asarray(lamp.position, np.float64)[None], np.zeros((1, 3))
        return [(empty, empty)] * (len(_LEVELS) - 1) + [alone]
    place, area = sample_surface(lamp, count=_PLACES)
    # Places on the two sides of a sheet are as far apart as places on opposite ends of it.
    side = area / np.linalg.norm(area, axis=1, keepdims=True) * np.ptp(place, axis=0).max()
    order = _order(np.concatenate([place, side], 1))
    place, area = place[order], area[order]
    whole, levels = np.linalg.norm(area, axis=1).sum(), []
    for count in _LEVELS[:-1]:
        middle, total = place.reshape(count, -1, 3).mean(1), area.reshape(count, -1, 3).sum(1)
        flat = np.linalg.norm(total, axis=1).sum() >= _FLAT * whole
        levels.append((middle, total) if flat else (empty, empty))
    return [*levels, (place, area)]


def _is_closed(area: Float[np.ndarray, "s 3"]) -> bool:
    """Whether a surface turns to all sides, so that its areas times normals cancel."""
    whole = np.linalg.norm(area, axis=1).sum()
    return bool(whole > 0 and np.linalg.norm(area.sum(0)) < _OPEN * whole)


def _order(place: Float[np.ndarray, "s k"]) -> Int[np.ndarray, " s"]:
    """Order of places, a power of two of them, by repeated halving across the longest extent."""
    order = np.arange(len(place))[None]
    while order.shape[1] > 1:
        axis = np.argmax(np.ptp(place[order], axis=1), 1)
        along = np.take_along_axis(place[order], axis[:, None, None], 2)[..., 0]
        order = np.take_along_axis(order, np.argsort(along, axis=1, kind="stable"), 1).reshape(2 * len(order), -1)
    return order[:, 0]


def at_points(
    moment: tuple[Float32[np.ndarray, "m p"], Float32[np.ndarray, "m p"], Float32[np.ndarray, "m 3 p"]],
    position: Float[Array, "p 3"],
    frame: Float[Array, "p 3 3"],
    lamps: Sequence[Mesh | PointLight],
    pieces: Int[np.ndarray, " n"],
    outlines: tuple[Float[Array, "f q k 3"] | None, tuple[int, ...]],
) -> LampTransport:
    """The transport of lamps to the points of a picture.

    Args:
        moment: The result of `jaxprt.visibility.picture_rays.moments`. That of spots is changed in place.
        position: Positions of the points.
        frame: Their shading frames; rows are tangent, bitangent, normal.
        lamps: The lamps.
        pieces: Number of pieces of each.
        outlines: The result of `outlines`.
    """
    where = np.asarray(position)
    for row, lamp in zip(np.cumsum(pieces) - pieces, lamps, strict=True):
        if isinstance(lamp, PointLight) and lamp.axis is not None:
            way = where - np.asarray(lamp.position, where.dtype)
            way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), np.finfo(where.dtype).tiny)
            share = lamp.share(way)
            for integral in moment:
                integral[row] *= share
    number = tuple(np.repeat(np.arange(len(lamps)), pieces).tolist())
    solid, cosine, direction = (jax.device_put(row.astype(where.dtype, copy=False)) for row in moment)
    return LampTransport(solid, cosine, direction, position, frame, number, *outlines)
