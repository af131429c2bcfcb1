"""Procedural scenes and lights: chess pieces on a board, a sphere, a plane, a clear day, a studio.

A turned piece (surface of revolution) is a list of runs. Each run is a smooth curve (radius, height) through control
points. Two successive runs meet in an edge. At a convex edge vertices are doubled, each with its own normal, so that
it is sharp. In a groove they are not doubled, so that each vertex sees out between both sides.

A part is a triple of positions, faces and normals (of any length), in float64.
"""

import itertools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxprt.scene.environment import Environment
from jaxprt.scene.mesh import Mesh, grid_face, join, make_mesh
from jaxprt.sphere import cubemap

# Sizes are unnamed, because named sizes would have to be equal in all parts of a list.
SurfacePatch = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]]
_SECTORS = 40
_FINE = {"step": 0.085, "turn": 0.7}  # resolution of curves, in squares of the board and radians
# Curves of (radius relative to that of the base, height), from the board up.
_BASE = [[(0.87, 0), (0.9, 0.03), (0.87, 0.075)], [(0.87, 0.075), (0.78, 0.085)]]
_PAWN = [
    *_BASE,
    [(0.78, 0.085), (0.83, 0.115), (0.79, 0.155), (0.6, 0.205), (0.44, 0.27), (0.35, 0.36), (0.31, 0.46), (0.33, 0.54)],
    [(0.33, 0.54), (0.53, 0.555)],
    [(0.53, 0.555), (0.58, 0.575), (0.53, 0.595)],
    [(0.53, 0.595), (0.33, 0.615)],
    [(0.33, 0.615), (0.4855, 0.681), (0.5088, 0.761), (0.3958, 0.8336), (0.2184, 0.8745), (0, 0.889)],
]
_BISHOP = [
    *_BASE,
    [(0.78, 0.085), (0.84, 0.12), (0.8, 0.165), (0.58, 0.225), (0.4, 0.32), (0.31, 0.45), (0.28, 0.58), (0.32, 0.68)],
    [(0.32, 0.68), (0.56, 0.7)],
    [(0.56, 0.7), (0.61, 0.722), (0.56, 0.745)],
    [(0.56, 0.745), (0.37, 0.765)],
    [(0.37, 0.765), (0.43, 0.788), (0.37, 0.81)],
    [(0.37, 0.81), (0.48, 0.86), (0.51, 0.93), (0.45, 1.03), (0.28, 1.13), (0.11, 1.19)],
    [(0.11, 1.19), (0.17, 1.225), (0.11, 1.268), (0, 1.282)],
]
_ROOK = [
    *_BASE,
    [(0.78, 0.085), (0.84, 0.12), (0.8, 0.17), (0.64, 0.23), (0.54, 0.33), (0.49, 0.46), (0.49, 0.57), (0.54, 0.65)],
    [(0.54, 0.65), (0.68, 0.665)],
    [(0.68, 0.665), (0.72, 0.684), (0.68, 0.703)],
    [(0.68, 0.703), (0.61, 0.715)],
    [(0.61, 0.715), (0.63, 0.75), (0.71, 0.8)],
    [(0.71, 0.8), (0.71, 0.87)],
    [(0.48, 0.87), (0, 0.87)],
]
_QUEEN = [
    *_BASE,
    [(0.78, 0.085), (0.84, 0.13), (0.8, 0.185), (0.58, 0.26), (0.42, 0.38), (0.32, 0.56), (0.28, 0.76), (0.33, 0.98)],
    [(0.33, 0.98), (0.56, 1.0)],
    [(0.56, 1.0), (0.61, 1.022), (0.56, 1.045)],
    [(0.56, 1.045), (0.38, 1.065)],
    [(0.38, 1.065), (0.44, 1.088), (0.37, 1.11)],
    [(0.37, 1.11), (0.38, 1.19), (0.46, 1.28), (0.61, 1.38)],
    [(0.61, 1.38), (0.52, 1.375)],
    [(0.52, 1.375), (0.46, 1.3)],
    [(0.46, 1.3), (0.38, 1.37), (0.22, 1.415), (0.1, 1.43)],
    [(0.1, 1.43), (0.16, 1.468), (0.11, 1.51), (0, 1.528)],
]
_KING = [
    *_BASE,
    [(0.78, 0.085), (0.84, 0.13), (0.8, 0.19), (0.59, 0.27), (0.44, 0.4), (0.34, 0.6), (0.3, 0.82), (0.35, 1.07)],
    [(0.35, 1.07), (0.57, 1.09)],
    [(0.57, 1.09), (0.62, 1.113), (0.57, 1.137)],
    [(0.57, 1.137), (0.4, 1.158)],
    [(0.4, 1.158), (0.46, 1.182), (0.39, 1.205)],
    [(0.39, 1.205), (0.4, 1.29), (0.47, 1.4), (0.55, 1.49)],
    [(0.55, 1.49), (0.53, 1.515)],
    [(0.53, 1.515), (0.4, 1.56), (0.22, 1.585), (0.13, 1.59)],
    [(0.13, 1.59), (0.115, 1.625)],
    [(0.115, 1.625), (0, 1.625)],
]
# Radius of the base, curves, and position on the board in squares from its center.
_PIECES = [
    (0.39, _KING, (0.5, -0.5)),
    (0.37, _QUEEN, (-0.5, -1.5)),
    (0.33, _BISHOP, (1.5, 0.5)),
    (0.34, _ROOK, (-1.5, -0.5)),
    (0.3, _PAWN, (-0.5, 0.5)),
    (0.3, _PAWN, (0.5, 1.5)),
]
_CORONET = range(7, 10), 1.3, 1.38, 0.035  # the queen's: curves with teeth, lowest and highest point, depth
_MERLON, _NOTCH, _TOP = 5, 3, 0.99  # widths of the rook's merlons and notches in sectors, and height of its top
_SQUARES = 6
_CELLS = 12  # cells along the edge of a square of the board
_THICKNESS = 0.25
_GAP = 0.004  # gap below pieces and below the king's cross; larger than the offset of ray origins

_SUN = (-0.62, 0.62, 0.48)
_SUN_RADIUS = np.radians(2.0)
# Azimuth and elevation of the center, half width and half height, all in degrees; color and radiance.
_LAMPS = [
    (-50, 42, 24, 17, (1.0, 0.93, 0.82), 10.0),
    (152, 28, 14, 20, (0.72, 0.84, 1.0), 9.0),
    (78, 22, 4, 38, (1.0, 1.0, 1.0), 12.0),
    (15, 80, 26, 12, (0.9, 0.95, 1.0), 2.5),
]


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
) -> SurfacePatch:
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


def patch(corner: list, *, rows: int, columns: int) -> SurfacePatch:
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


def assemble(parts: list[SurfacePatch]) -> Mesh:
    """Joins several parts into one mesh with a single region 0."""
    start = np.cumsum([0, *(len(position) for position, _, _ in parts)])
    position, face, normal = zip(*parts, strict=True)
    face = np.concatenate([part + first for part, first in zip(face, start[:-1], strict=True)])
    return make_mesh(np.concatenate(position), face, normal=np.concatenate(normal))


def chess() -> Mesh:
    """Procedural chess pieces: king, queen, bishop, rook and two pawns on a corner of a chessboard.

    The unit is the edge of a square. The top of the board is at y = 0 and its center at the origin. Each piece is a
    closed surface that stands 0.004 above the board. Vertices are doubled at sharp edges and between squares.

    Returns:
        A mesh of 16,778 vertices in three regions: 0 the pieces, 1 the light squares, 2 the dark squares and the side
        of the board.
    """
    pieces = []
    for radius, curves, (x, z) in _PIECES:
        place = np.array([x, _GAP, z])
        pieces += [(position + place, face, normal) for position, face, normal in _piece(radius, curves)]
    return join([assemble(parts) for parts in (pieces, *_board())])


def sphere(*, rings: int = 32, sectors: int = 64) -> Mesh:
    """A unit sphere at the origin, divided by latitude and longitude. Each pole is one vertex.

    Args:
        rings: Number of bands of latitude.
        sectors: Number of sectors of longitude.

    Returns:
        A closed mesh of (rings - 1) sectors + 2 vertices with exact normals.

    Raises:
        ValueError: Fewer than 2 rings or 3 sectors.
    """
    if rings < 2 or sectors < 3:
        raise ValueError(f"rings must be at least 2 and sectors at least 3, got {rings} and {sectors}")
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    radius = np.where(np.arange(rings + 1) % rings == 0, 0, np.cos(latitude))
    height = np.sin(latitude)
    return assemble([sweep(np.stack([radius, height], -1), np.stack([-height, radius], -1), sectors=sectors)])


def plane(*, cells: int = 16) -> Mesh:
    """A square from -1 to 1 in x and z at y = 0, facing up.

    Args:
        cells: Number of cells along each edge.

    Returns:
        A mesh of (cells + 1)^2 vertices.
    """
    if cells < 1:
        raise ValueError(f"cells must be at least 1, got {cells}")
    return assemble([patch([[[-1, 0, -1], [1, 0, -1]], [[-1, 0, 1], [1, 0, 1]]], rows=cells, columns=cells)])


def daylight(*, size: int = 64) -> Environment:
    """A clear sky with a warm sun of 2 degrees radius at 38 degrees elevation, on the left of a viewer facing -z.

    A white diffuse plane that faces up has a radiance of 1, averaged over the colors; half of it comes from the sun.

    Args:
        size: Texels along the edge of a cube face.

    Returns:
        Light in three colors.

    Raises:
        ValueError: The size is below 1.
    """
    direction = _fine_direction(size)
    up = direction[..., 1:2]
    sun = np.array(_SUN) / np.linalg.norm(_SUN)
    angle = np.arctan2(np.linalg.norm(np.cross(direction, sun), axis=-1), direction @ sun)[..., None]
    zenith, horizon, ground = np.array([[0.2, 0.42, 1.0], [0.85, 0.95, 1.1], [0.3, 0.26, 0.21]])
    sky = zenith + (horizon - zenith) * np.exp(-4 * np.maximum(up, 0))
    sky = sky + np.array([1.0, 0.85, 0.6]) * (0.9 * np.exp(-angle / 0.25))
    # The ground fades into the horizon's haze.
    sky = np.where(up > 0, sky, ground + (0.5 * horizon - ground) * np.exp(12 * np.minimum(up, 0)))
    texel = np.pi / 2 / direction.shape[1]
    disk = np.clip((_SUN_RADIUS - angle) / texel + 0.5, 0, 1) * np.array([1.15, 1.0, 0.85])
    return Environment(jnp.asarray(_expose(sky, size) / 2 + _expose(disk, size) / 2, jnp.float32))


def studio(*, size: int = 64) -> Environment:
    """A dark room with four soft boxes: a warm key light, a cold rim light behind, a white strip, a weak fill above.

    A white diffuse plane that faces up has a radiance of 1, averaged over the colors.

    Args:
        size: Texels along the edge of a cube face.

    Returns:
        Light in three colors.

    Raises:
        ValueError: The size is below 1.
    """
    direction = _fine_direction(size)
    radiance = np.full_like(direction, 0.03) * (1 + 0.5 * direction[..., 1:2])
    for azimuth, elevation, *half, color, strength in _LAMPS:
        a, e = np.radians([azimuth, elevation])
        right = np.array([np.cos(a), 0, -np.sin(a)])
        center = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        depth = direction @ center
        inside = (depth > 0).astype(float)
        for axis, limit in zip((right, np.cross(center, right)), np.tan(np.radians(half)), strict=True):
            # A rectangle in the plane across the direction, with an edge that fades over about three degrees.
            place = np.abs(direction @ axis) / np.maximum(depth, 1e-9)
            edge = np.clip((limit - place) / 0.05 + 0.5, 0, 1)
            inside = inside * edge**2 * (3 - 2 * edge)
        radiance = radiance + inside[..., None] * strength * np.array(color)
    return Environment(jnp.asarray(_expose(radiance, size), jnp.float32))


def _fine_direction(size: int) -> np.ndarray:
    """Directions of at least 4 x 4 samples per texel, and at least 256 along a face."""
    if size < 1:
        raise ValueError(f"size must be at least 1, got {size}")
    return np.asarray(cubemap.direction(size=size * max(4, -(-256 // size))), np.float64)


def _expose(radiance: np.ndarray, size: int) -> np.ndarray:
    """Means over texels, scaled so that the irradiance on a plane that faces up is pi, averaged over the colors."""
    part = radiance.shape[1] // size
    shape = (6, size, part, size, part, -1)
    weight = np.asarray(cubemap.solid_angle(size=size * part), np.float64).reshape(shape)
    mean = (radiance.reshape(shape) * weight).sum((2, 4)) / weight.sum((2, 4))
    cosine = np.maximum(np.asarray(cubemap.vector_area(size=size), np.float64)[..., 1:2], 0)
    return mean * np.pi / (mean * cosine).sum((0, 1, 2)).mean()


def _piece(radius: float, curves: list) -> list[SurfacePatch]:
    """The parts of a turned piece at the origin."""
    bottom = np.array([[0, 0], [radius * curves[0][0][0], 0]])
    parts = [sweep(bottom, np.array([[1.0, 0], [1, 0]]), sectors=_SECTORS)]
    chains = []
    for number, control in enumerate(curves):
        point, slope = curve([(radius * r, y) for r, y in control], **_FINE)
        teeth = np.full(len(point), float(curves is _QUEEN and number in _CORONET[0]))
        if chains and np.cross([*chains[-1][1][-1], 0], [*slope[0], 0])[2] < 0:
            before = chains.pop()
            slope[0] += before[1][-1]
            chains.append([np.concatenate([a[:-1], b]) for a, b in zip(before, (point, slope, teeth), strict=True)])
        else:
            chains.append([point, slope, teeth])
    parts += [
        sweep(point, slope, sectors=_SECTORS, lift=_lift(point, slope, teeth), waves=_SECTORS // 4)
        for point, slope, teeth in chains
    ]
    if curves is _ROOK:
        parts += _battlement(radius)
    if curves is _KING:
        parts += _cross(curves[-1][-1][1] + _GAP)
    return parts


def _lift(point: np.ndarray, slope: np.ndarray, teeth: np.ndarray) -> np.ndarray:
    """Height of the crests of the coronet's teeth, and its derivative along the curve; zero elsewhere."""
    _, low, high, depth = _CORONET
    above = teeth * np.maximum(point[:, 1] - low, 0) / (high - low)
    return depth * np.stack([above**2, 2 * above / (high - low) * slope[:, 1]], -1)


def _battlement(radius: float) -> list[SurfacePatch]:
    """The rook's merlons and the floor between them, around the platform."""
    (outer, floor), (inner, _) = _ROOK[-2][-1], _ROOK[-1][0]
    edge = [(radius * r, y) for r, y in ((outer, floor), (outer, _TOP), (inner, _TOP), (inner, floor))]
    front, top, back = (curve(list(ends), **_FINE) for ends in itertools.pairwise(edge))
    notch = curve([edge[0], edge[3]], **_FINE)
    parts = []
    for first in range(0, _SECTORS, _MERLON + _NOTCH):
        last = first + _MERLON
        parts += [sweep(*run, sectors=_SECTORS, first=first, last=last) for run in (front, top, back)]
        parts.append(sweep(*notch, sectors=_SECTORS, first=last, last=last + _NOTCH))
        for column, order in ((first, -1), (last, 1)):
            turn = 2 * np.pi * column / _SECTORS
            (a, b), (d, c) = edge[1:3][::order], edge[::3][::order]
            corner = [[[r * np.cos(turn), y, r * np.sin(turn)] for r, y in row] for row in ((b, a), (c, d))]
            parts.append(patch(corner, rows=len(front[0]) - 1, columns=len(top[0]) - 1))
    return parts


def _cross(height: float) -> list[SurfacePatch]:
    """The king's cross with flared arms, standing at a height."""
    narrow, wide, arm, depth, parts = 0.019, 0.036, 0.105, 0.02, 2
    result = []
    for turn in range(4):
        c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][turn]
        rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])  # about z, by quarter turns

        def add(corner, rotation=rotation):
            position, face, normal = patch(corner, rows=parts, columns=parts)
            result.append((position @ rotation.T + np.array([0, height + arm, 0]), face, normal @ rotation.T))

        for z in (depth, -depth):
            upper, lower = [[narrow, narrow, z], [arm, wide, z]], [[narrow, -narrow, z], [arm, -wide, z]]
            add([upper, lower] if z > 0 else [lower, upper])
            if turn == 0:
                middle = [[[x, y, z] for x in (-narrow, narrow)] for y in (narrow, -narrow)]
                add(middle if z > 0 else middle[::-1])
        for sign in (1, -1):
            flank = [[[x, sign * y, z] for x, y in ((narrow, narrow), (arm, wide))] for z in (-depth, depth)]
            add(flank[::sign])
        add([[[arm, wide, depth], [arm, wide, -depth]], [[arm, -wide, depth], [arm, -wide, -depth]]])
    return result


def _board() -> tuple[list[SurfacePatch], list[SurfacePatch]]:
    """Parts of the light squares, and parts of the dark squares and the side of the board."""
    light, dark = color = [], []
    line = np.arange(_SQUARES + 1) - _SQUARES / 2
    for i in range(_SQUARES):
        for j in range(_SQUARES):
            corner = [[[x, 0, z] for x in line[j : j + 2]] for z in line[i : i + 2]]
            color[(i + j) % 2].append(patch(corner, rows=_CELLS, columns=_CELLS))
    half = _SQUARES / 2
    around = [(-half, half), (half, half), (half, -half), (-half, -half), (-half, half)]
    for (x0, z0), (x1, z1) in itertools.pairwise(around):
        corner = [[[x0, y, z0], [x1, y, z1]] for y in (0, -_THICKNESS)]
        dark.append(patch(corner, rows=1, columns=_SQUARES * _CELLS))
    return light, dark
