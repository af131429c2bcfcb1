"""Procedural scenes with strong interreflection: two sides of chess, a room, a corner, a ring and a watch on a table.

Light is distant, so each scene is open somewhere. Three rules avoid artifacts of lighting that is computed at vertices.
First, objects that stand on others leave a gap. Second, vertices lie just outside of the foot of an object, not below
it, where they would spread its shadow over their triangles. Third, grooves between regions are rounded or slanted: a
vertex in the plane of another region's faces would start its rays inside of them when the regions are relit separately.

Reference: Sun, Zhou, Chen, Lin, Shi, Guo 2007, section 5, shows such scenes.
"""

import itertools
from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxprt.scene import builtin
from jaxprt.scene.builtin import SurfacePatch, assemble, curve, patch, sweep
from jaxprt.scene.mesh import Mesh, bounds, grid_face, ground_plane, join, split

_CELL = 0.1  # spacing of the room's vertices; floor and walls share vertices where they meet
_GAP = 0.003  # gap between objects in the room and on the table, about 5e-4 of the diagonals
_DIGITS = 9  # coordinates are rounded, so that equal positions are equal numbers
_CLEAR = 0.01  # distance of objects from the lines of the grid
_ROUND = 0.01  # radius of the rounding between floor, walls and ceiling
_WALLS = np.array([[-2, 0, -2], [2, 2.5, 2]])
_WINDOW = (0.8, -0.4), (2.1, 1.2)  # lowest and highest (y, z), in the wall at -x
_REVEAL = 0.2  # depth of the window
_RUG = (-1.3, -0.8), (1.3, 0.6)  # lowest and highest (x, z)
_PILE = 0.02  # height of the rug, and width of its slanted hem
_VASE = [(0.042, 0), (0.062, 0.03), (0.105, 0.12), (0.085, 0.21), (0.045, 0.27), (0.058, 0.32)]
_VASE_INSIDE = [(0.05, 0.32), (0.037, 0.27), (0.076, 0.205), (0.096, 0.12), (0.054, 0.035), (0, 0.02)]

_CORNER_GAP = 5e-4  # gap below the object, relative to its diagonal, as in `ground_plane`
_CORNER_ROUND = 5e-3  # radius of the rounding between floor and walls, relative to the object's longest side
_NEAR, _FAR = 0.3, 0.9  # distances from the object to walls and to open edges, relative to its longest side
_ABOVE = 0.4  # height of the walls above the object's top, relative to its longest side

_RING = 0.93, 1.0, 0.5  # inner and outer radius, height
INSIDE = _RING[0] - _CLEAR  # radius of the table's vertices inside of the ring
_RING_SECTORS, _RING_STEP = 96, 0.042
_TABLE = 2.4, 0.12  # radius and thickness
_SHELLS = 24, 18  # circles of vertices inside of the ring and around it

_CASE = [(0.98, 0.02), (0.98, 0.2), (0.86, 0.31), (0.8, 0.31), (0.77, 0.22)]  # (radius, height) of a watch's side
_DIAL = 0.76, 0.22  # radius and height of the dial
_HANDS = (0.42, 0.055, -0.9), (0.62, 0.035, 0.75)  # length, width, and angle from twelve o'clock
_LOOP = 1.25, 1.5  # half axes of the bracelet, up and towards the viewer
_LEAN = 0.95  # angle of the dial above the horizon, as seen from the middle of the bracelet
_ROWS, _OPEN = 17, 0.72  # rows of links, and half of the arc that the case takes, both along the bracelet
_LINKS = [(-0.5, -0.21), (-0.19, 0.19), (0.21, 0.5)]  # the ends of the links of a row

_Sides = Sequence[tuple[int, int]]  # sides of a box: axis, and 0 for the lower end or 1 for the higher


def chess_sides() -> Mesh:
    """The scene of `builtin.chess`, with separate regions for the pieces on the two sides of the board's diagonal.

    Returns:
        A mesh of 16,778 vertices in four regions: 0 the pieces of one side (king, queen, bishop), 1 those of the other
        side (rook, two pawns), 2 the light squares, 3 the dark squares and the side of the board.
    """
    pieces, light, dark = split(builtin.chess())
    x, _, z = np.asarray(pieces.position).T
    side = jnp.asarray(z > x, jnp.int32)  # no piece stands on the diagonal
    return join([Mesh(pieces.position, pieces.face, pieces.normal, pieces.tangent, side), light, dark])


def room() -> Mesh:
    """A furnished room, 4 x 4 and 2.5 high, open to +z, with a window in the wall at -x.

    Floor, walls and ceiling are visible from inside only, but block light from both sides. Their cells are 0.1 wide.
    The sun of `builtin.daylight` shines through the window onto rug, table and sofa.

    Returns:
        A mesh of 14,364 vertices in twelve regions: 0 floor and 1 sofa, whose materials are meant to change; 2 the wall
        with the window, 3 the back wall, 4 the wall at +x, 5 ceiling, 6 rug, 7 table, 8 lamp, 9 vase, 10 picture, 11
        cushions.
    """
    floor, wall, back, right, ceiling = _shell(_WALLS, _ROUND, _CELL, ((1, 0), (0, 0), (2, 0), (0, 1), (1, 1)))
    rug, sofa, table = _rug(), _sofa(), _table()
    picture = [_block((-0.69, 1.31, -2 + _GAP), (0.69, 1.99, -1.95), 0.01)]
    vase = [_moved(part, (0.3, 0.42 + _GAP, -0.1)) for part in _vase()]
    lamp = [_moved(part, (1.55, _GAP, -1.55)) for part in _lamp()]
    shell = [_without(floor, (0, 2), *_RUG)], [_without(wall, (1, 2), *_WINDOW), *_reveal()], [back], [right], [ceiling]
    parts = [shell[0], sofa, *shell[1:], rug, table, lamp, vase, picture, _cushions()]
    return join([assemble(each) for each in parts])


def corner(mesh: Mesh, *, cells: int = 64) -> Mesh:
    """Places an object in a corner: on a floor, in front of a wall at -z and a wall at +x.

    Floor and walls are scaled to the longest side of the object's bounding box. The floor lies below the object's
    lowest face, by 5e-4 of its diagonal. It extends farther to -x and +z, where the corner is open.

    Args:
        mesh: The object. Vertices without faces do not count for its bounding box.
        cells: Number of cells along the floor's longer edge. The cells of the walls have about the same size.

    Returns:
        A mesh with the object's vertices first. Its regions are 0 the object, 1 the floor, 2 the wall at -z and 3 the
        wall at +x.

    Raises:
        ValueError: Fewer than 1 cell.
    """
    if cells < 1:
        raise ValueError(f"cells must be at least 1, got {cells}")
    low, high = bounds(mesh)
    unit = float(max(high - low)) or 1.0
    low = low - unit * np.array([_FAR, 0, _NEAR]) - [0, _CORNER_GAP * float(np.linalg.norm(high - low)), 0]
    high = high + unit * np.array([_NEAR, _ABOVE, _FAR])
    cell = max(high[0] - low[0], high[2] - low[2]) / cells
    sides = _shell(np.stack([low, high]), _CORNER_ROUND * unit, cell, ((1, 0), (2, 0), (0, 1)))
    whole = eqx.tree_at(lambda each: each.region, mesh, jnp.zeros_like(mesh.region))
    return join([whole, *(assemble([side]) for side in sides)])


def ring(*, spacing: float = 1.0) -> Mesh:
    """A metal ring on a round table. Its inside reflects light into a caustic on the table.

    The ring has a radius of 1 and a height of 0.5, the table a radius of 2.4. The vertices of the table's top lie on
    circles, none of them below the ring. Inside of the ring their spacing is 0.038.

    Args:
        spacing: Spacing of the vertices, relative to the default.

    Returns:
        A mesh of 10,969 vertices in two regions: 0 the closed ring, and 1 the top and side of the table. Other
        spacings change the number of vertices.

    Raises:
        ValueError: The spacing is not from 0.25 to 4.
    """
    if not 0.25 <= spacing <= 4:
        raise ValueError(f"spacing must be from 0.25 to 4, got {spacing}")
    inner, outer, height = _RING
    profile = [(inner, _GAP), (outer, _GAP), (outer, _GAP + height), (inner, _GAP + height)]
    inside, around = (round(each / spacing) for each in _SHELLS)
    edge, thickness = _TABLE
    growth = np.linspace(0, 1, around) ** 1.3  # finest beside the ring
    clear = outer + _CLEAR
    radius = [np.linspace(0, inner - _CLEAR, inside + 1), clear + (edge - clear) * growth]
    side, slope = curve([(edge, -thickness), (edge, 0)], step=thickness, turn=1.0)
    table = [_disk(np.concatenate(radius)), sweep(side, slope, sectors=8 * (inside + around))]
    return join([assemble(_band(profile, round(_RING_SECTORS / spacing), _RING_STEP * spacing)), assemble(table)])


def watch(*, step: float = 0.07) -> Mesh:
    """A wristwatch whose closed bracelet stands on a table, with the dial towards the viewer and upward.

    The case has a radius of 1. The bracelet has 17 rows of three links with gaps between them.

    Args:
        step: Spacing of the vertices of case and dial; that of links is 1.6 times as large.

    Returns:
        A mesh of 12,325 vertices in four regions: 0 the case with crown, hands and marks, 1 the bracelet, 2 the dial
        and 3 the table. Other steps change the number of vertices.

    Raises:
        ValueError: The step is not from 0.03 to 0.5.
    """
    if not 0.03 <= step <= 0.5:
        raise ValueError(f"step must be from 0.03 to 0.5, got {step}")
    sectors, (radius, height) = round(2 * np.pi / step), _DIAL
    corners = [(0.0, 0.02), *_CASE]
    case = [sweep(*curve(list(ends), step=step, turn=1.0), sectors=sectors) for ends in itertools.pairwise(corners[1:])]
    back = sweep(np.array(corners[:2]), np.array([[1.0, 0], [1, 0]]), sectors=sectors)
    crown = _block((1.0, 0.04, -0.1), (1.16, 0.2, 0.1), 0.03, step=step)
    mark = _block((-0.03, height + 0.005, -0.72), (0.03, height + 0.03, -0.58), 0.008, step=2 * step)
    marks = [_turned_about_y(mark, hour) for hour in 2 * np.pi * np.arange(12) / 12]
    hands = []
    for (length, width, turn), low in zip(_HANDS, (height + 0.035, height + 0.06), strict=True):
        hand = _block((-width, low, -length), (width, low + 0.02, 0.1), 0.008, step=step)
        hands.append(_turned_about_y(hand, turn))
    dial = _disk(np.linspace(0, radius, max(2, round(radius / step)) + 1))
    dial = _moved(dial, (0.0, height, 0.0))
    place = partial(_on_loop, angle=_LEAN)
    links = []
    for angle in _LEAN + np.linspace(_OPEN, 2 * np.pi - _OPEN, _ROWS):
        long = 0.42 * _loop_speed(angle) * (2 * np.pi - 2 * _OPEN) / (_ROWS - 1)
        for low, high in _LINKS:
            links.append(_on_loop(_block((low, -0.07, -long), (high, 0.07, long), 0.035, step=1.6 * step), angle=angle))
    parts = [assemble([place(part) for part in [*case, back, crown, *marks, *hands]]), assemble(links)]
    whole = join([*parts, assemble([place(dial)])])
    return join([whole, ground_plane(whole, vertices=round(18 / step**2), extent=2.6)])


def _loop_speed(angle: float) -> float:
    """Length along the bracelet for each radian of its parameter."""
    up, forward = _LOOP
    return float(np.hypot(up * np.cos(angle), forward * np.sin(angle)))


def _on_loop(part: SurfacePatch, *, angle: float) -> SurfacePatch:
    """A part on the bracelet: its y axis points outward, its z axis along the bracelet, downward in front."""
    up, forward = _LOOP
    place = np.array([0, up * np.sin(angle), forward * np.cos(angle)])
    outward = np.array([0, np.sin(angle) / up, np.cos(angle) / forward])
    outward /= np.linalg.norm(outward)
    axes = np.stack([[1.0, 0, 0], outward, np.cross([1.0, 0, 0], outward)])
    position, face, normal = part
    return position @ axes + place, face, normal @ axes


def _turned_about_y(part: SurfacePatch, angle: float) -> SurfacePatch:
    """A part turned clockwise, as seen from above."""
    position, face, normal = part
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return position @ rotation, face, normal @ rotation


def _reveal() -> list[SurfacePatch]:
    """The four sides of the window's reveal."""
    (y0, z0), (y1, z1) = _WINDOW
    inside = np.array([[_WALLS[0][0], y, z] for y, z in ((y0, z0), (y0, z1), (y1, z1), (y1, z0))])
    return _between(inside, inside - [_REVEAL, 0, 0])


def _rug() -> list[SurfacePatch]:
    """The rug with its hem, whose rim has the same positions as the floor's vertices."""
    (x0, z0), (x1, z1) = _RUG
    rim = np.array([[x0, 0, z1], [x1, 0, z1], [x1, 0, z0], [x0, 0, z0]])
    top = rim + _PILE * np.array([[1, 1, -1], [-1, 1, -1], [-1, 1, 1], [1, 1, 1]])
    return [_panel([[top[3], top[2]], [top[0], top[1]]]), *_between(top, rim)]


def _sofa() -> list[SurfacePatch]:
    """The sofa's base, arms, back and two seats, against the back wall."""
    inner = 0.9 - _CLEAR
    arms = [_block((x, _GAP, -1.89), (x + 0.2 - 2 * _CLEAR, 0.58, -1.01), 0.04) for x in (-1.09, 0.91)]
    seats = [_block((x, 0.263, -1.65), (x + inner - _GAP / 2, 0.45, -0.99), 0.05) for x in (-inner, _GAP / 2)]
    base = _block((-inner, 0.06, -1.87), (inner, 0.26, -1.02), 0.02)
    back = _block((-inner, 0.263, -1.87), (inner, 0.86, -1.65 - _GAP), 0.06)
    return [base, back, *arms, *seats]


def _cushions() -> list[SurfacePatch]:
    """Two cushions that lean against the sofa's back."""
    parts = []
    for x, lean, turn in ((-0.6, 0.3, 0.25), (0.58, 0.24, -0.2)):
        position, face, normal = _block((-0.2, -0.2, -0.07), (0.2, 0.2, 0.07), 0.07, step=0.06)
        # About z, then backward about x.
        c, s, d, t = np.cos(turn), np.sin(turn), np.cos(lean), np.sin(lean)
        rotation = np.array([[1, 0, 0], [0, d, t], [0, -t, d]]) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        position = position @ rotation.T
        low = position.min(0)
        place = (x, 0.45 + _GAP - low[1], -1.65 + _GAP - low[2])
        parts.append(_moved((position, face, normal @ rotation.T), place))
    return parts


def _table() -> list[SurfacePatch]:
    """A low table on the rug, its legs between the rug's vertices."""
    legs = [
        _block((x - 0.025, _PILE + _GAP, z - 0.025), (x + 0.025, 0.36 - _GAP, z + 0.025), 0.01)
        for x in (-0.45 - _CLEAR, 0.45 + _CLEAR)
        for z in (-0.35, 0.15)
    ]
    return [_block((-0.55, 0.36, -0.45), (0.55, 0.42, 0.25), 0.015), *legs]


def _lamp() -> list[SurfacePatch]:
    """A floor lamp: a foot with a pole, a bulb and a shade."""
    pole = [[(0.13, 0), (0.13, 0.025)], [(0.13, 0.025), (0.018, 0.035)], [(0.018, 0.035), (0.018, 1.3)]]
    bulb = [(0.02, 1.31), (0.055, 1.36), (0.045, 1.41), (0, 1.44)]
    runs = [[(0.13, 0), (0, 0)][::-1], *pole, [(0.018, 1.3), (0, 1.3)], [(0, 1.31), (0.02, 1.31)], bulb]
    shade = [(0.19, 1.25), (0.2, 1.25), (0.15, 1.6), (0.14, 1.6)]
    return [_turned(run, 20) for run in runs] + _band(shade, 32, 0.06)


def _vase() -> list[SurfacePatch]:
    """A hollow vase with a foot and a lip."""
    lip = [_VASE[-1], _VASE_INSIDE[0]]
    return [_turned(run, 32, step=0.025) for run in ([(0, 0), _VASE[0]], _VASE, lip, _VASE_INSIDE)]


def _turned(control: list, sectors: int, *, step: float = 0.07) -> SurfacePatch:
    """A smooth surface of revolution."""
    if control[0][0] == 0:
        point = np.array(control, float)
        return sweep(point, np.array([[1.0, 0], [1, 0]]), sectors=sectors)
    return sweep(*curve(control, step=step, turn=0.5), sectors=sectors)


def _band(profile: list, sectors: int, step: float) -> list[SurfacePatch]:
    """A profile of four corners revolved about y, sharp at each corner. The corners run outward at the bottom."""
    around = itertools.pairwise([*profile, profile[0]])
    return [sweep(*curve(list(ends), step=step, turn=1.0), sectors=sectors) for ends in around]


def _disk(radius: np.ndarray) -> SurfacePatch:
    """A disk that faces up. Its vertices lie on circles around one in the center, with eight more on each circle.

    It is a square grid whose concentric squares have become circles, so all cells have about the same size.
    """
    count = len(radius) - 1
    z, x = np.meshgrid(*[np.arange(-count, count + 1)] * 2, indexing="ij")
    shell = np.maximum(np.abs(x), np.abs(z))
    # Position along the square, from 0 to 8 times its index, starting at the center of the side at +x, towards +z.
    along = np.select([(x == shell) & (z > -shell), z == shell, x == -shell], [z, 2 * shell - x, 4 * shell - z])
    along = np.where((z == -shell) & (x > -shell), 6 * shell + x, along)
    turn = np.pi / 4 * along / np.maximum(shell, 1)
    position = np.stack([radius[shell] * np.cos(turn), 0 * turn, radius[shell] * np.sin(turn)], -1).reshape(-1, 3)
    up = np.broadcast_to([0.0, 1, 0], position.shape)
    return position, grid_face(rows=2 * count + 1, columns=2 * count + 1), up


def _between(first: np.ndarray, second: np.ndarray) -> list[SurfacePatch]:
    """Four panels from one rectangle to another."""
    edges = (itertools.pairwise([*corner, corner[0]]) for corner in (first, second))
    return [_panel([above, below]) for above, below in zip(*edges, strict=True)]


def _panel(corner: list) -> SurfacePatch:
    """A flat quadrilateral of the room, divided into cells. Positions do not depend on which corner comes first."""
    (a, b), (c, _) = np.array(corner, float)
    rows, columns = (max(1, round(float(np.linalg.norm(edge)) / _CELL)) for edge in (c - a, b - a))
    position, face, normal = patch(corner, rows=rows, columns=columns)
    return np.round(position, _DIGITS), face, normal


def _without(
    part: SurfacePatch, axes: tuple[int, int], low: tuple[float, float], high: tuple[float, float]
) -> SurfacePatch:
    """A part without the faces inside of a rectangle in the plane of two axes."""
    position, face, normal = part
    middle = position[face].mean(1)[:, axes]
    used, face = np.unique(face[~((middle > low) & (middle < high)).all(1)], return_inverse=True)
    return position[used], face.reshape(-1, 3), normal[used]


def _block(low: tuple, high: tuple, radius: float, *, step: float = _CELL) -> SurfacePatch:
    """A closed box with rounded edges and smooth normals."""
    sides = _sides(np.array([low, high], float), np.full((2, 3), radius), step, list(np.ndindex(3, 2)))
    start = np.cumsum([0, *(len(position) for position, _, _ in sides)])
    position, face, normal = zip(*sides, strict=True)
    face = np.concatenate([part + first for part, first in zip(face, start[:-1], strict=True)])
    position, first, place = np.unique(np.concatenate(position), axis=0, return_index=True, return_inverse=True)
    return position, place.reshape(-1)[face], np.concatenate(normal)[first]


def _shell(box: np.ndarray, radius: float, cell: float, sides: _Sides) -> list[SurfacePatch]:
    """Some sides of a box, facing inward. Edges between them are rounded, other edges straight."""
    rounding = np.zeros((2, 3))
    for axis, end in sides:
        rounding[end, axis] = radius
    parts = _sides(box, rounding, cell, sides)
    return [(position, face[:, ::-1], -normal) for position, face, normal in parts]


def _sides(box: np.ndarray, radius: np.ndarray, cell: float, sides: _Sides) -> list[SurfacePatch]:
    """Some sides of a box, facing outward, with a line of vertices on both sides of the rounding at each end."""
    line = []
    for (a, b), (r, s) in zip(box.T, radius.T, strict=True):
        inner = np.linspace(a, b, max(1, round((b - a) / cell)) + 1)
        line.append(np.unique(np.round([a + r, b - s, *inner], _DIGITS)))
    parts = []
    for axis, end in sides:
        row, column = [(axis + 1) % 3, (axis + 2) % 3][:: 2 * end - 1]
        position = np.empty((len(line[row]), len(line[column]), 3))
        position[..., axis] = line[axis][-end]
        position[..., row], position[..., column] = line[row][:, None], line[column]
        core = np.clip(position, box[0] + radius[0], box[1] - radius[1])
        normal = position - core
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        face = grid_face(rows=len(line[row]), columns=len(line[column]))
        parts.append(((core + radius.max() * normal).reshape(-1, 3), face, normal.reshape(-1, 3)))
    return parts


def _moved(part: SurfacePatch, place: tuple[float, float, float]) -> SurfacePatch:
    """A translated part."""
    position, face, normal = part
    return position + np.array(place), face, normal
