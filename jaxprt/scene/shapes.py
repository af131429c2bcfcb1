"""Building blocks of procedural scenes: curves, surfaces of revolution, flat quadrilaterals.

A part is a triple of positions, faces and normals (of any length), in float64.
"""

import numpy as np
from jaxtyping import Float, Int

from jaxprt.scene.mesh import Mesh, grid_face, make_mesh

# Sizes are unnamed, because named sizes would have to be equal in all parts of a list.
Part = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]


def curve(control: list, *, step: float, turn: float) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Points and unit tangents of a smooth curve through control points, denser where it bends.

    The curve is a Hermite spline over chord length, and straight for two control points. It is horizontal where it
    meets the axis, so that the surface is smooth there.

    Args:
        control: Two or more points (radius, height); only the last may be on the axis.
        step: Largest distance between points along a straight part of the curve.
        turn: Largest change of direction between points, in radians. Between two points, length / step + bend / turn is
            at most 1.
    """
    point = np.array(control, float)
    if point[-1, 0] == 0:
        point = np.concatenate([point, point[-2:-1] * [-1, 1]])
    chord = np.linalg.norm(np.diff(point, axis=0), axis=1)
    slope = np.diff(point, axis=0) / chord[:, None]
    inner = (slope[:-1] * chord[1:, None] + slope[1:] * chord[:-1, None]) / (chord[1:] + chord[:-1])[:, None]
    ends = (slope[[0, -1]] * 3 - inner[[0, -1]]) / 2 if len(inner) else slope[[0, -1]]
    derivative = np.concatenate([ends[:1], inner, ends[1:]])
    segments = len(control) - 1

    def hermite(place):
        k = np.minimum(place.astype(int), segments - 1)
        t, h = (place - k)[:, None], chord[k, None]
        a, b, m, n = point[k], point[k + 1], derivative[k] * h, derivative[k + 1] * h
        value = a + t**2 * (3 - 2 * t) * (b - a) + t * (1 - t) * ((1 - t) * m - t * n)
        speed = 6 * t * (1 - t) * (b - a) + (1 - t) * (1 - 3 * t) * m + t * (3 * t - 2) * n
        return value, speed / np.linalg.norm(speed, axis=1, keepdims=True)

    place = np.linspace(0, segments, 64 * segments + 1)
    value, tangent = hermite(place)
    bend = np.abs(np.diff(np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))))
    effort = np.cumsum(np.linalg.norm(np.diff(value, axis=0), axis=1) / step + bend / turn)
    effort = np.concatenate([[0], effort])
    steps = max(1, int(np.ceil(effort[-1] - 1e-9)))
    return hermite(np.interp(np.linspace(0, effort[-1], steps + 1), effort, place))


def sweep(
    point: Float[np.ndarray, "n 2"],
    slope: Float[np.ndarray, "n 2"],
    *,
    sectors: int,
    first: int = 0,
    last: int | None = None,
    lift: Float[np.ndarray, "n 2"] | None = None,
    waves: int = 0,
) -> Part:
    """Revolves a curve about y, all around or between two sector borders.

    The outside is on the right of the curve. Where the curve starts or ends on the axis there is one vertex.

    Args:
        point: Points (radius, height), such as those of `curve`.
        slope: Tangents of the curve at the points.
        sectors: Number of sectors of the full turn.
        first: Sector border at which the surface starts.
        last: Sector border at which it ends; None closes the surface.
        lift: Height of the crests of waves around the axis above each point, and its derivative along the curve; None
            for no waves.
        waves: Number of waves around the axis.
    """
    columns = sectors if last is None else last - first + 1
    turn = 2 * np.pi * (first + np.arange(columns)) / sectors
    cosine, sine = np.cos(turn), np.sin(turn)
    radius, height = point[:, :1], point[:, 1:]
    crest, growth = (0 * radius, 0 * radius) if lift is None else (lift[:, :1], lift[:, 1:])
    wave = np.cos(waves * turn)
    around_crest = -crest * waves * np.sin(waves * turn) / np.maximum(radius, 1e-9)
    position = np.stack(np.broadcast_arrays(radius * cosine, height + crest * wave, radius * sine), -1)
    climb = slope[:, 1:] + growth * wave
    along = np.stack(np.broadcast_arrays(slope[:, :1] * cosine, climb, slope[:, :1] * sine), -1)
    around = np.stack(np.broadcast_arrays(-sine, around_crest, cosine), -1)
    normal = np.cross(along, around)

    index = np.arange(len(point) * columns).reshape(-1, columns)
    index = np.where(radius == 0, index[:, :1], index)
    index = np.concatenate([index, index[:, :1]], 1) if last is None else index
    face = index.ravel()[grid_face(rows=len(index), columns=index.shape[1])]
    face = face[(face != np.roll(face, 1, 1)).all(1)]
    used, face = np.unique(face, return_inverse=True)
    return position.reshape(-1, 3)[used], face.reshape(-1, 3), normal.reshape(-1, 3)[used]


def patch(corner: list, *, rows: int, columns: int) -> Part:
    """A flat quadrilateral. The front is the side to which (next row) x (next column) points.

    Args:
        corner: Corners as an array [row column 3] of two rows and two columns.
        rows: Number of cells from one row of corners to the other.
        columns: Number of cells along a row.
    """
    (a, b), (c, d) = np.array(corner, float)
    v, u = np.meshgrid(np.arange(rows + 1) / rows, np.arange(columns + 1) / columns, indexing="ij")
    v, u = v.reshape(-1, 1), u.reshape(-1, 1)
    position = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    normal = np.cross(c - a + d - b, b - a + d - c)
    return position, grid_face(rows=rows + 1, columns=columns + 1), np.broadcast_to(normal, position.shape)


def assemble(parts: list[Part]) -> Mesh:
    """Joins several parts into one mesh with a single region 0."""
    start = np.cumsum([0, *(len(position) for position, _, _ in parts)])
    position, face, normal = zip(*parts, strict=True)
    face = np.concatenate([part + first for part, first in zip(face, start[:-1], strict=True)])
    return make_mesh(np.concatenate(position), face, normal=np.concatenate(normal))
