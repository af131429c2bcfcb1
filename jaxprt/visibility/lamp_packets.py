"""Light of lamps at points of a picture: sums over places on the lamps, and shadow rays in packets of sixteen.

`jaxprt.visibility.lamp_rays` explains the method. The loops run over sixteen points at a time.
"""

import math
from functools import partial
from typing import no_type_check

import numpy as np

from jaxprt.visibility import packets
from jaxprt.visibility.packets import call, compiled, start, whole_ray

_CLOSE = 6.0  # smallest distance to a place, in radii of a disk of its area
_NEAR = 1e-3  # share of the distance to a place, before it, in which hits count as hits of the lamp itself
_QUARTERS = 4  # of a stratum
_STEP = 25  # of 64 places: about the golden ratio
_TINY = 1e-36  # smallest squared distance


@no_type_check  # Run-time type checks would wrap the function, and numba could not cache it on disk.
@partial(compiled, error_model="numpy")  # Checks of divisors would keep the loop over lanes from being vectorized.
def _sums(place, area, begin, count, center, normal, least, total, room):
    """Adds the integrals of places of one piece to `total`, for sixteen points; False if a point is too close to one.

    The integrals are of 1 and of the direction, over the solid angle above the horizon of the normal.
    """
    room[:] = np.inf
    for number in range(begin, begin + count):
        x, y, z = place[number, 0], place[number, 1], place[number, 2]
        a, b, c = area[number, 0], area[number, 1], area[number, 2]
        size = np.sqrt(a * a + b * b + c * c)
        disk, close = size * np.float32(1 / math.pi), size * np.float32(_CLOSE**2 / math.pi)
        zero = np.float32(0)
        lowest = zero if size > 0 else np.float32(1)  # A point light has no area and emits in all directions.
        for lane in range(16):
            dx, dy, dz = x - center[0, lane], y - center[1, lane], z - center[2, lane]
            square = max(dx * dx + dy * dy + dz * dz, least[lane])
            inverse = np.float32(1) / np.sqrt(square)
            height = dx * normal[0, lane] + dy * normal[1, lane] + dz * normal[2, lane]
            facing = max(-(dx * a + dy * b + dz * c) * inverse, lowest)
            solid = (facing if height > zero else zero) / (square + disk)
            along = solid * inverse
            total[0, lane] += solid
            total[1, lane] += along * dx
            total[2, lane] += along * dy
            total[3, lane] += along * dz
            room[lane] = min(room[lane], square - close)
    return room.min() >= 0


@no_type_check
@compiled
def _lit(lamp, lamps, center, normal, least, total, room):
    """The integrals of all pieces of a lamp without shadows, from the fewest places that are not too close."""
    place, area, first, count, pieces, _ = lamps
    last = first.shape[1] - 1
    for level in range(last + 1):
        number = count[lamp, level]
        if number == 0:
            continue
        total[: pieces[lamp]] = 0
        far = True
        for piece in range(pieces[lamp]):
            begin = first[lamp, level] + piece * number
            fits = _sums(place, area, begin, number, center, normal, least, total[piece], room)
            far = far and fits
            if not far and level < last:
                break
        if far:
            break


@no_type_check
@partial(compiled, error_model="numpy")
def _cast(query, memory, lamps, aim, origin, sight, weight, free):
    """Traces one ray of each of sixteen points, to its own place on a lamp; the number of rays, and of free ones.

    Adds the irradiance from each place to `weight` of its piece, and to `free` that from visible places.
    """
    number, spot, piece = aim
    address, scene, arguments, _, passed = query
    ray, valid, cosine, goal = memory
    center, normal, facing, least = sight
    place, area = lamps[0], lamps[1]
    whole_ray(ray)
    for lane in range(16):
        at, begin = number[lane], spot[lane]
        for axis in range(3):
            goal[axis, lane], goal[3 + axis, lane] = place[at, axis], area[at, axis]
            ray[axis, lane] = origin[begin, axis, lane]
    zero = np.float32(0)
    for lane in range(16):  # vectorized
        x, y, z = goal[0, lane] - center[0, lane], goal[1, lane] - center[1, lane], goal[2, lane] - center[2, lane]
        square = max(x * x + y * y + z * z, least[lane])
        a, b, c = goal[3, lane], goal[4, lane], goal[5, lane]
        toward = -(x * a + y * b + z * c)
        toward = np.sqrt(square) if a * a + b * b + c * c == zero else toward
        height = x * normal[0, lane] + y * normal[1, lane] + z * normal[2, lane]
        cosine[lane] = max(toward, zero) * max(height, zero) / (square * square)
        x, y, z = goal[0, lane] - ray[0, lane], goal[1, lane] - ray[1, lane], goal[2, lane] - ray[2, lane]
        ray[4, lane], ray[5, lane], ray[6, lane] = x, y, z
        ray[8, lane] = np.float32(1 - _NEAR)
        above = x * facing[0, lane] + y * facing[1, lane] + z * facing[2, lane]
        valid[lane] = -1 if cosine[lane] > zero and above > zero else 0
    passed[:] = 1
    if valid.min() < 0:
        call(address, valid.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)
    rays, open_ = 0, 0
    for lane in range(16):
        seen = valid[lane] != 0 and ray[8, lane] > zero
        weight[piece[lane], lane] += cosine[lane]
        free[piece[lane], lane] += cosine[lane] * passed[lane] if seen else zero
        rays += 1 if cosine[lane] > zero else 0
        open_ += 1 if seen else 0
    return rays, open_


@no_type_check
@compiled
def _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free):
    """Replaces `free` by the visible share of each piece of a lamp at sixteen points.

    The first rays go to one quarter of each stratum of the lamp. If they differ in what they meet, rays to the other
    quarters follow.
    """
    first, count, pieces, strata = lamps[2][lamp, -1], lamps[3][lamp, -1], lamps[4][lamp], lamps[5][lamp]
    weight[:], free[:] = 0, 0
    number, spot, piece = np.empty(16, np.int64), np.empty(16, np.int64), np.empty(16, np.int64)
    width = count * pieces // (strata * _QUARTERS)  # 0 for a point light
    rays, open_ = 0, 0
    for turn in range(_QUARTERS):
        if turn > 0 and (width == 0 or open_ == 0 or open_ == rays):
            break
        for stratum in range(strata):
            if pieces <= strata and total[stratum * pieces // strata, 0].max() == 0:
                continue  # The sixteen points see the back of this piece.
            corner = lamp + stratum * 4 // strata
            for lane in range(16):
                base = pattern[lane]
                own = stratum * _QUARTERS + ((base >> 4) + stratum + turn & 3)
                # With other places in the next part, edges of shadows meet all places one after another.
                within = (2 * (base + _STEP * own + 37 * lamp & 63) + 1) * width >> 7
                number[lane] = first + own * width + within
                spot[lane] = (base >> 2) + base + corner + turn & 3
                piece[lane] = own * pieces // (strata * _QUARTERS)
            new = _cast(query, memory, lamps, (number, spot, piece), origin, sight, weight, free)
            rays, open_ = rays + new[0], open_ + new[1]
    for lane in range(16):
        whole = weight[:, lane].sum()
        mean = free[:, lane].sum() / whole if whole > 0 else 0.0
        for part in range(pieces):
            sent = weight[part, lane]
            free[part, lane] = free[part, lane] / sent if sent > 0 else mean


@no_type_check
@compiled
def _placed(surface, points, fields, packet, lanes, origin, sight, pattern):
    """Sets what does not depend on lamps for sixteen points. Padding has no normal, and nothing above its horizon."""
    position, normals = fields
    center, normal, facing, least = sight
    for lane in range(16):
        point = packet + min(lane, lanes - 1)
        start(surface, points, point, lane, origin, facing)
        drawn = lane < lanes and (facing[0, lane] != 0 or facing[1, lane] != 0 or facing[2, lane] != 0)
        offset = surface[3][max(points[0][point], 0)]
        least[lane], pattern[lane] = max(offset * offset, np.float32(_TINY)), points[3][point]
        for axis in range(3):
            center[axis, lane] = position[point, axis]
            normal[axis, lane] = normals[point, axis] if drawn else 0.0


@no_type_check
@compiled
def trace(query, surface, points, fields, lamps, first, last, result):
    """Integrals of the visible parts of lamps at some points; see `jaxprt.visibility.lamp_rays.moments`.

    Args:
        query: What packets of rays need; see `packets.Packets.query`.
        surface: Positions and normals of vertices, triangles, and the distance from each at which rays start.
        points: Triangle, barycentric coordinates, their slopes, and the number in the dither pattern of each point.
        fields: Position and shading normal of each point.
        lamps: The fields of `lamp_rays.LampPlaces`.
        first: Index of the first point.
        last: Index after the last point.
        result: The integrals of 1, of the cosine, and of the direction.
    """
    pieces, most = lamps[4], lamps[4].max()
    ray, valid = packets.room(12)
    memory = ray, valid, np.zeros(16, np.float32), np.zeros((6, 16), np.float32)
    origin, pattern = np.zeros((4, 3, 16), np.float32), np.zeros(16, np.int64)
    center, normal = np.zeros((3, 16), np.float32), np.zeros((3, 16), np.float32)
    facing = np.zeros((3, 16), np.float32)
    least, room = np.zeros(16, np.float32), np.zeros(16, np.float32)
    sight = center, normal, facing, least
    total = np.zeros((most, 4, 16), np.float32)
    weight, free = np.zeros((most, 16), np.float32), np.zeros((most, 16), np.float32)
    for packet in range(first, last, 16):
        lanes = min(16, last - packet)
        _placed(surface, points, fields, packet, lanes, origin, sight, pattern)
        row = 0
        for lamp in range(len(pieces)):
            own = pieces[lamp]
            _lit(lamp, lamps, center, normal, least, total, room)
            lit = total[:own, 0].max() > 0
            if lit:
                _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free)
            else:
                free[:] = 0
            for piece in range(own):
                _write(total[piece], free[piece], normal, row + piece, packet, lanes, result)
            row += own


@no_type_check
@compiled
def _write(total, free, normal, row, packet, lanes, result):
    """Writes the integrals of the visible part of a piece."""
    solid, cosine, direction = result
    for lane in range(lanes):
        above = np.float32(0)
        for axis in range(3):
            value = total[1 + axis, lane] * free[lane]
            direction[row, axis, packet + lane] = value
            above += value * normal[axis, lane]
        # All of the solid angle lies above the horizon, where the cosine is linear in the direction.
        cosine[row, packet + lane] = max(above, np.float32(0))
        solid[row, packet + lane] = total[0, lane] * free[lane]
