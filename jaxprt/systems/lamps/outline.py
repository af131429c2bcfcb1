"""Flat lamps as polygons: outlines of meshes, and integrals of lobes over polygons on the sphere.

A von Mises-Fisher lobe of mean m and concentration k has 1 - exp(-k (1 - cos t)) of what it has in all within an angle
t of its mean. Its integral over a polygon is therefore a sum of integrals along edges, over the azimuth about m:

    ∫ p(wi; m, k) dwi = 1 / (2 pi (1 - exp(-2 k))) sum_edges ∫ 1 - exp(-k (1 - cos t)) dψ

As a function of the length along the edge's great circle the integrand has no peaks narrower than the lobe. Far from
the lobe's mean it is 1, and the integral is an angle.
"""

import math
from collections.abc import Sequence
from functools import reduce

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxprt.compile import jit, put, total
from jaxprt.scene.mesh import Mesh
from jaxprt.scene.scene import PointLight

_CORNERS = 8  # most corners of an outline
_FLAT = 1e-3  # largest height above the plane, and area beside or on other triangles, relative to a lamp's own
_STRAIGHT = 1e-6  # area that a corner adds, relative to that of the polygon, below which it is none
_REACH = 3.5  # distance along an edge from which on all of a lobe is nearer, in standard deviations
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_SMALL = 0.02  # exponents whose exponential is a series
_SHORT = 3e-7  # length of edges, in radians, that may be rounding
_TINY = 1e-12


def of_lamps(
    lamps: Sequence[Mesh | PointLight], places: Sequence[np.ndarray], pieces: Sequence[int]
) -> tuple[Float[Array, "f q k 3"] | None, tuple[int, ...]]:
    """Outlines of the flat and convex lamps and of their pieces, for a `LampTransport`, and the indices of these lamps.

    Args:
        lamps: The lamps.
        places: Places [s 3] on each, in the order of its pieces.
        pieces: Number of pieces of each surface, a power of two.
    """
    polygons = {
        number: [whole, *_cut(whole, np.asarray(place, np.float64), count)]
        for number, (lamp, place, count) in enumerate(zip(lamps, places, pieces, strict=True))
        if isinstance(lamp, Mesh) and (whole := _of(lamp)) is not None
    }
    if not polygons:
        return None, ()
    corners = max(len(polygon) for row in polygons.values() for polygon in row)
    rows = np.stack([_stacked(row, corners) for row in polygons.values()])
    return put(rows.astype(jnp.result_type(float))), tuple(polygons)


def triangles(lamp: Mesh) -> tuple[Float[np.ndarray, "f 3 3"], Float[np.ndarray, "f 3"]]:
    """Corners of a lamp's triangles, and the area of each times the normal of the side that shines."""
    corner, normal = (np.asarray(row, np.float64)[np.asarray(lamp.face)] for row in (lamp.position, lamp.normal))
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]) / 2
    return corner, across * np.where(np.sum(across * normal.sum(1), 1) < 0, -1, 1)[:, None]


def _of(lamp: Mesh) -> Float[np.ndarray, "k 3"] | None:
    """Outline of a flat and convex lamp, counterclockwise for those on whom it shines; None for other lamps."""
    corner, across = triangles(lamp)
    area, whole = np.linalg.norm(across, axis=1), np.linalg.norm(across.sum(0))
    if not whole >= (1 - _FLAT) * area.sum() > 0:
        return None
    place = corner[area > 0].reshape(-1, 3)
    place = place - place.mean(0)
    # What is lit sees the plane from its front, where directions to corners turn the other way round.
    up = -across.sum(0) / whole
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    plane = np.stack([place @ side, place @ np.cross(up, side)], 1)
    if np.ptp(place @ up) > _FLAT * np.sqrt(whole):
        return None
    try:
        hull = scipy.spatial.ConvexHull(plane)
    except scipy.spatial.QhullError:  # the lamp is as narrow as rounding
        return None
    number = list(hull.vertices)
    while len(number) > 3:  # Qhull keeps corners on straight edges.
        before, here, after = (plane[np.roll(number, shift)] for shift in (1, 0, -1))
        (ax, ay), (bx, by) = (here - before).T, (after - here).T
        adds = np.abs(ax * by - ay * bx) / 2
        if adds.min() > _STRAIGHT * whole:
            break
        number.pop(int(np.argmin(adds)))
    if len(number) > _CORNERS or abs(hull.volume - whole) > _FLAT * whole:  # or triangles that overlap
        return None
    return corner[area > 0].reshape(-1, 3)[number]


def _cut(
    outline: Float[np.ndarray, "k 3"], place: Float[np.ndarray, "s 3"], count: int
) -> list[Float[np.ndarray, "_ 3"]]:
    """Pieces of equal area of an outline, cut about as places on it are: by halving across the longest extent."""
    if count == 1:
        return [outline]
    extent, half = np.ptp(place, axis=0), len(place) // 2
    axis = int(np.argmax(extent if extent.any() else np.ptp(outline, axis=0)))
    along, area = outline[:, axis], _area(outline)
    middle = scipy.optimize.brentq(
        lambda height: _area(_below(outline, along - height)) - area / 2, along.min(), along.max()
    )
    return [
        part
        for sign, rows in ((1, place[:half]), (-1, place[half:]))
        for part in _cut(_below(outline, sign * (along - middle)), rows, count // 2)
    ]


def _area(outline: Float[np.ndarray, "k 3"]) -> float:
    return float(np.linalg.norm(np.cross(outline, np.roll(outline, -1, 0)).sum(0)) / 2) if len(outline) else 0.0


def _below(outline: Float[np.ndarray, "k 3"], height: Float[np.ndarray, " k"]) -> Float[np.ndarray, "_ 3"]:
    """The part of a convex polygon whose heights are not above 0."""
    result = []
    for start, end, low, high in zip(outline, np.roll(outline, -1, 0), height, np.roll(height, -1), strict=True):
        if low <= 0:
            result.append(start)
        if low * high < 0:
            result.append(start + low / (low - high) * (end - start))
    return np.asarray(result)


def _stacked(polygons: Sequence[Float[np.ndarray, "_ 3"]], corners: int) -> Float[np.ndarray, "n k 3"]:
    """Polygons with equally many corners: those with fewer get more of them on their longest edges."""
    rows = []
    for polygon in polygons:
        while len(polygon) < corners:
            step = np.roll(polygon, -1, 0) - polygon
            longest = int(np.argmax(np.linalg.norm(step, axis=1)))
            polygon = np.insert(polygon, longest + 1, polygon[longest] + step[longest] / 2, axis=0)
        rows.append(polygon)
    return np.stack(rows)


@jit
def solid_angle(corner: Float[Array, "k 3 v"]) -> Float[Array, " v"]:
    """Solid angles of convex polygons on the sphere.

    Args:
        corner: Unit directions of the corners, counterclockwise.

    Reference: Van Oosterom, Strackee, "The solid angle of a plane triangle", 1983.
    """
    start, second, third = corner[:1], corner[1:-1], corner[2:]
    # Differences keep the digits of small polygons.
    beyond = jnp.stack(_cross(*(jnp.moveaxis(at - start, 1, 0) for at in (second, third))), 1)
    beside = 1 + sum(jnp.sum(a * b, 1) for a, b in ((start, second), (second, third), (third, start)))
    return jnp.sum(2 * jnp.arctan2(jnp.sum(start * beyond, 1), beside), 0)


@jit
def disk(corner: Float[Array, "k 3 v"]) -> tuple[list[Array], Float[Array, " v"]]:
    """Direction of the middle of small polygons on the sphere, and squared chord of a disk of the same variance.

    Args:
        corner: Unit directions of the corners.
    """
    start = corner[:1]
    sides = [jnp.moveaxis(at - start, 1, 0) for at in (corner[1:-1], corner[2:])]
    area = jnp.sqrt(jnp.maximum(sum(axis**2 for axis in _cross(*sides)), _TINY**3))
    share = area / jnp.sum(area, 0)
    middle = [at + jnp.sum(share * (a + b) / 3, 0) for at, a, b in zip(corner[0], *sides, strict=True)]
    ends = [[at - place for at in (corner[0, i], corner[1:-1, i], corner[2:, i])] for i, place in enumerate(middle)]
    square = sum(sum(at**2 for at in axis) + sum(axis) ** 2 for axis in ends) / 12
    length = jnp.sqrt(jnp.maximum(sum(axis**2 for axis in middle), _TINY))
    return [axis / length for axis in middle], 2 * jnp.sum(share * square, 0)


@jit
def above_horizon(corner: Float[Array, "k 3 v"]) -> Float[Array, "n 3 v"]:
    """The parts of convex polygons above the horizon, z = 0: twice as many corners, of which some coincide.

    Args:
        corner: Unit directions of the corners, counterclockwise.
    """
    after = jnp.roll(corner, -1, 0)
    low, high = corner[:, 2:], after[:, 2:]
    down, up = (low >= 0) & (high < 0), (low < 0) & (high >= 0)
    crosses = down | up
    point = corner + low / jnp.where(crosses, low - high, 1) * (after - corner)
    point = point * jnp.array([[1], [1], [0]], corner.dtype)
    point = point / jnp.sqrt(jnp.maximum(jnp.sum(point**2, 1, keepdims=True), _TINY))
    # Corners below the horizon lie where the outline goes below. Polygons that are below lie in one direction.
    none = jnp.array([[1], [0], [0]], corner.dtype)
    left = jnp.where(jnp.any(down, 0), jnp.sum(jnp.where(down, point, 0), 0), none)
    start = jnp.where(low >= 0, corner, left)
    return jnp.stack([start, jnp.where(crosses, point, start)], 1).reshape(-1, *corner.shape[1:])


@jit
def lobe_integral(
    mean: Float[Array, "3 l v"], concentration: Float[Array, "l v"], corner: Float[Array, "k 3 v"]
) -> Float[Array, "l v"]:
    """Integrals of von Mises-Fisher lobes over convex polygons on the sphere, with an absolute error of about 1e-3.

    Args:
        mean: Unit directions of the lobes.
        concentration: Concentrations of the lobes.
        corner: Unit directions of the corners, counterclockwise; less than a half of the sphere lies within.
    """
    reach = jnp.minimum(_REACH / jnp.sqrt(concentration), np.pi)
    sine_of_reach, cosine_of_reach = jnp.sin(reach), jnp.cos(reach)

    def edge(row: tuple[Array, ...]) -> Array:
        start, end, normal, angle = row
        # Lengths along the great circle of the edge begin where it is closest to the mean.
        sine = _dot(mean, normal)
        cosine = jnp.sqrt(jnp.maximum(1 - sine**2, _TINY))
        ends = [_place(_dot(mean, jnp.stack(_cross(at, normal))), _dot(mean, at), cosine) for at in (start, end)]
        first = jnp.arctan2(*ends[0])
        first = jnp.where(first + angle / 2 > np.pi, first - 2 * np.pi, first)
        length = first, first + angle
        low, high = (jnp.clip(at, -reach, reach) for at in length)
        half, middle, near = (high - low) / 2, (high + low) / 2, jnp.zeros_like(sine)
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            away = sine**2 / (1 + cosine) + cosine * _versed((middle + half * node) ** 2)
            near += weight * concentration * _share(concentration * away) / jnp.maximum(2 - away, 1e-6)
        # Less what all of the lobe within reach would be, the difference of two azimuths about the mean.
        low_sine, low_cosine, high_sine, high_cosine = (
            jnp.where(at == cut, here, there)
            for (across, along), at, cut in zip(ends, length, (low, high), strict=True)
            for here, there in ((across, jnp.where(at > 0, sine_of_reach, -sine_of_reach)), (along, cosine_of_reach))
        )
        flat = jnp.maximum(jnp.abs(sine), _TINY)
        whole = jnp.arctan2(
            flat * (high_sine * low_cosine - high_cosine * low_sine),
            flat**2 * high_cosine * low_cosine + high_sine * low_sine,
        )
        return sine * half * near - jnp.where(sine < 0, -whole, whole)

    normal, angle = _edges(corner, jnp.roll(corner, -1, 0))
    inside = reduce(jnp.logical_and, (_dot(mean, side) >= 0 for side in normal))
    edges = corner, jnp.roll(corner, -1, 0), normal, angle
    within = jnp.where(inside & jnp.any(angle > 0, 0), 2 * np.pi, 0) + total(edge, edges)
    return jnp.clip(within / (-2 * np.pi * jnp.expm1(-2 * concentration)), 0, 1)


def _place(across: Array, along: Array, length: Array) -> tuple[Array, Array]:
    """Sine and cosine of a length along a great circle; of 0 for poles of the circle and edges without length."""
    none = across**2 + along**2 < length**2 / 2
    return jnp.where(none, 0, across / length), jnp.where(none, 1, along / length)


def _versed(square: Array) -> Array:
    """1 - cos x from the square of x, to 1e-4 at pi and to rounding at 0."""
    terms = [(-1) ** (n + 1) / math.factorial(2 * n) for n in range(7, 0, -1)]
    return square * reduce(lambda value, term: value * square + term, terms[1:], jnp.full_like(square, terms[0]))


def _share(x: Array) -> Array:
    """(1 - exp(-x)) / x."""
    small = x < _SMALL
    return jnp.where(small, 1 - x / 2 + x**2 / 6, (1 - jnp.exp(-x)) / jnp.where(small, 1, x))


def _edges(start: Float[Array, "k 3 v"], end: Float[Array, "k 3 v"]) -> tuple[Array, Array]:
    """Unit normals of the planes of edges, which point inside, and lengths of the edges; 0 for edges without length."""
    across, along = jnp.stack(_cross(jnp.moveaxis(start, 1, 0), jnp.moveaxis(end, 1, 0)), 1), jnp.sum(start * end, 1)
    square = jnp.sum(across**2, 1)
    long = square > _SHORT**2
    length = jnp.sqrt(jnp.where(long, square, 1))
    return jnp.where(long[:, None], across / length[:, None], 0), jnp.where(long, jnp.arctan2(length, along), 0)


def _cross(first: Array, second: Array) -> tuple[Array, Array, Array]:
    """Components of cross products; components are the first axis."""
    (ax, ay, az), (bx, by, bz) = first, second
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _dot(mean: Float[Array, "3 l v"], direction: Float[Array, "3 v"]) -> Float[Array, "l v"]:
    return mean[0] * direction[0] + mean[1] * direction[1] + mean[2] * direction[2]
