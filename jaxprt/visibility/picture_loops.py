"""Loops over the points of pictures, sixteen at a time. `jaxprt.visibility.picture_rays` explains the methods."""

import math
from functools import partial

import numpy as np

from jaxprt.compile import numba_loop
from jaxprt.visibility import embree

_ORIGINS = np.array([[-3, -1], [1, -3], [3, 1], [-1, 3]]) / 8  # ray origins in a pixel, from its center
_ENOUGH = 48  # rays of a packet that tell, if they agree, that others would agree with them
_BLOCK = 128  # points whose rays to a texel are traced one packet after another
_APART = 60  # 240ths by which corners of a triangle differ, above which what points between them see is traced
_CLOSE = 6.0  # smallest distance to a sample of a lamp, in radii of a disk of its area
_NEAR = 1e-3  # share of the distance to a sample, before it, in which hits count as hits of the lamp itself
_QUARTERS = 4  # of a stratum
_STEP = 25  # of 64 samples: about the golden ratio
_TINY = 1e-36  # smallest squared distance
# Checks of divisors would keep loops over lanes from being vectorized.
_unchecked = partial(numba_loop, error_model="numpy")


@numba_loop
def _start(surface, points, point, lane, origin, facing):
    """Sets ray origins in a pixel, and its triangle's normal on the shading normal's side: zero if it has no side."""
    position, normal, face, offset = surface
    triangle, barycentric, slope, _ = points
    number = max(triangle[point], 0)
    a, b, c = face[number, 0], face[number, 1], face[number, 2]
    # Arrays would be allocated for each point, which takes longer than the rays.
    along = _edge_vector(position, a, b)
    other = _edge_vector(position, a, c)
    across = (
        along[1] * other[2] - along[2] * other[1],
        along[2] * other[0] - along[0] * other[2],
        along[0] * other[1] - along[1] * other[0],
    )
    square, side = 0.0, 0.0
    for axis in range(3):
        square += across[axis] * across[axis]
        side += across[axis] * (normal[a, axis] + normal[b, axis] + normal[c, axis])
    length = np.sqrt(square)
    scale = 0.0 if length == 0 or triangle[point] < 0 else (-1 / length if side < 0 else 1 / length)
    for axis in range(3):
        facing[axis, lane] = scale * across[axis]
    for spot in range(4):
        right, down = _ORIGINS[spot, 0], _ORIGINS[spot, 1]
        first = max(barycentric[point, 0] + right * slope[point, 0, 0] + down * slope[point, 1, 0], 0.0)
        second = max(barycentric[point, 1] + right * slope[point, 0, 1] + down * slope[point, 1, 1], 0.0)
        third = max(barycentric[point, 2] + right * slope[point, 0, 2] + down * slope[point, 1, 2], 0.0)
        whole = max(first + second + third, 1e-30)
        for axis in range(3):
            on_triangle = (first * position[a, axis] + second * position[b, axis] + third * position[c, axis]) / whole
            origin[spot, axis, lane] = on_triangle + offset[number] * facing[axis, lane]


@numba_loop
def _edge_vector(position, first, last):
    """The vector from one vertex to another in float64."""
    return (
        np.float64(position[last, 0]) - np.float64(position[first, 0]),
        np.float64(position[last, 1]) - np.float64(position[first, 1]),
        np.float64(position[last, 2]) - np.float64(position[first, 2]),
    )


@numba_loop
def trace_shares(query, surface, points, first, last, texels, stored, share, memory):
    """Visible shares of texels at points of a picture.

    Args:
        query: What shadow rays need; see `Packets.query`.
        surface: Positions and normals of vertices, triangles, and the distance from each at which rays start.
        points: Triangle, barycentric coordinates, their slopes, and the number in the dither pattern of each point.
        first: Index of the first point.
        last: Index after the last point.
        texels: Directions of the samples in each texel, of its middle, number of rays, first sample, and step.
        stored: Shares at vertices, which are interpolated where the corners of a point's triangle have about the same
            [v, t], and the corners [3, p]; no vertices to trace all.
        share: The result, in 240ths [t, p].
        memory: Arrays from `share_memory`: numba would compile for a second to make them.
    """
    middle, count = texels[1], texels[2]
    origin, facing, value, apart, lane, visible, even = memory
    for texel in range(len(count)):
        even[texel] = _APART if count[texel] > 0 else 255
    for block in range(first, last, _BLOCK):
        size = min(_BLOCK, last - block)
        for number in range(size):
            if not len(stored[0]) or _interpolate(stored, points, block + number, even, value[number], apart[number]):
                _start(surface, points, block + number, number, origin, facing)
        for texel in range(len(count)):
            way, some = middle[texel], 0
            for number in range(size):
                share[texel, block + number] = value[number, texel]
                if not apart[number, texel]:
                    continue
                cosine = facing[0, number] * way[0] + facing[1, number] * way[1] + facing[2, number] * way[2]
                if cosine > 0:
                    lane[some] = number
                    some += 1
                else:
                    share[texel, block + number] = 0
            for packet in range(0, some, 16):
                here = lane[packet : min(packet + 16, some)]
                traced = _trace_texel(query, origin, points[3][block:], here, texel, texels, visible)
                for number in range(len(here)):
                    share[texel, block + here[number]] = np.uint8(np.floor(240 * visible[number] / traced + 0.5))


def share_memory(texels: int) -> tuple[np.ndarray, ...]:
    """What `trace_shares` keeps of a block: ray origins and normals; shares and if rays decide; points, and hits.

    The last array is the largest difference of corners between which shares of a texel are interpolated.
    """
    origin, facing = np.zeros((4, 3, _BLOCK), np.float32), np.zeros((3, _BLOCK), np.float32)
    value, apart = np.zeros((_BLOCK, texels), np.uint8), np.ones((_BLOCK, texels), np.bool_)
    return origin, facing, value, apart, np.empty(_BLOCK, np.int64), np.empty(16), np.empty(texels, np.int32)


@numba_loop
def _interpolate(stored, points, point, even, value, apart):
    """Sets shares that a point sees, between those of the corners of its triangle; and if and where these are apart."""
    seen, corner = stored
    first, second, third = seen[corner[0, point]], seen[corner[1, point]], seen[corner[2, point]]
    weight = points[1][point]
    x, y, z = weight[0], weight[1], weight[2]
    for texel in range(len(value)):  # vectorized
        a, b, c = np.int32(first[texel]), np.int32(second[texel]), np.int32(third[texel])
        apart[texel] = max(max(a, b), c) - min(min(a, b), c) > even[texel]
        between = np.float32(a) * x + np.float32(b) * y + np.float32(c) * z + np.float32(0.5)
        value[texel] = np.uint8(np.int32(between if between > np.float32(0) else np.float32(0)))
    return apart.any()


@numba_loop
def _trace_texel(query, origin, pattern, lane, texel, texels, visible):
    """Number of rays from each of at most sixteen points of a block to a texel, and how many of them pass."""
    ray, valid, passed, _ = query
    direction, _, count, shift, step = texels
    strata, lanes = direction.shape[1], len(lane)
    for number in range(16):
        valid[number], visible[number] = -1 if number < lanes else 0, 0
    traced = 0
    while traced < count[texel]:
        if 4 * traced >= count[texel] and _agree(visible, lanes, traced):
            break
        turn = traced * step[texel] % count[texel]
        for number in range(16):
            here = lane[min(number, lanes - 1)]
            base = pattern[here]
            stratum = ((base + turn * strata) // count[texel] + shift[texel]) % strata
            spot = (base // 4 + base + texel + turn) % 4
            for axis in range(3):
                ray[embree.ORIGIN + axis, number] = origin[spot, axis, here]
                ray[embree.DIRECTION + axis, number] = direction[texel, stratum, axis]
            ray[embree.FAR, number], passed[number] = embree.ENDLESS, 1
        embree.trace(query, embree.RAY)
        for number in range(lanes):
            visible[number] += passed[number] if ray[embree.FAR, number] > 0 else 0.0
        traced += 1
    return traced


@numba_loop
def _agree(visible, lanes, traced):
    """Whether enough rays have been traced, and all of all points have passed, or none."""
    clear = visible[:lanes].sum()
    return lanes * traced >= _ENOUGH and (clear == 0 or clear == lanes * traced)


@_unchecked
def _sums(samples, areas, begin, count, center, normal, least, total, room):
    """Adds integrals of samples of one piece to `total`, for sixteen points; False if a point is too close to one."""
    room[:] = np.inf
    for index in range(begin, begin + count):
        x, y, z = samples[index, 0], samples[index, 1], samples[index, 2]
        a, b, c = areas[index, 0], areas[index, 1], areas[index, 2]
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
            # The integrals are of 1 and of the direction, over the solid angle above the horizon of the normal.
            total[0, lane] += solid
            total[1, lane] += along * dx
            total[2, lane] += along * dy
            total[3, lane] += along * dz
            room[lane] = min(room[lane], square - close)
    return room.min() >= 0


@numba_loop
def _unshadowed(lamp, lamps, sight, total, room):
    """The integrals of all pieces of a lamp without shadows, from the fewest samples that are not too close."""
    samples, areas, first, count, pieces, _ = lamps
    center, normal, _, least = sight
    last = first.shape[1] - 1
    for level in range(last + 1):
        number = count[lamp, level]
        if number == 0:
            continue
        total[: pieces[lamp]] = 0
        far = True
        for piece in range(pieces[lamp]):
            begin = first[lamp, level] + piece * number
            far = _sums(samples, areas, begin, number, center, normal, least, total[piece], room) and far
            if not far and level < last:
                break
        if far:
            break


@_unchecked
def _cast(query, memory, lamps, aim, origin, sight, weight, free):
    """Traces one ray of each of sixteen points, to its own sample of a lamp; the number of rays, and of free ones."""
    sample, spot, piece = aim
    ray, valid, passed, _ = query
    cosine, goal = memory
    center, normal, facing, least = sight
    for lane in range(16):
        for axis in range(3):
            goal[axis, lane], goal[3 + axis, lane] = lamps[0][sample[lane], axis], lamps[1][sample[lane], axis]
            ray[embree.ORIGIN + axis, lane] = origin[spot[lane], axis, lane]
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
        ray[embree.DIRECTION, lane], ray[embree.DIRECTION + 1, lane], ray[embree.DIRECTION + 2, lane] = x, y, z
        ray[embree.FAR, lane] = np.float32(1 - _NEAR)
        above = x * facing[0, lane] + y * facing[1, lane] + z * facing[2, lane]
        valid[lane] = -1 if cosine[lane] > zero and above > zero else 0
    passed[:] = 1
    if valid.min() < 0:
        embree.trace(query, embree.RAY)
    rays, open_ = 0, 0
    for lane in range(16):
        seen = valid[lane] != 0 and ray[embree.FAR, lane] > zero
        weight[piece[lane], lane] += cosine[lane]  # irradiance from each sample
        free[piece[lane], lane] += cosine[lane] * passed[lane] if seen else zero  # that from visible samples
        rays += 1 if cosine[lane] > zero else 0
        open_ += 1 if seen else 0
    return rays, open_


@numba_loop
def _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free):
    """Replaces `free` by the visible share of each piece of a lamp at sixteen points."""
    first, count, pieces, strata = lamps[2][lamp, -1], lamps[3][lamp, -1], lamps[4][lamp], lamps[5][lamp]
    weight[:], free[:] = 0, 0
    sample, spot, piece = np.empty(16, np.int64), np.empty(16, np.int64), np.empty(16, np.int64)
    width = count * pieces // (strata * _QUARTERS)  # 0 for a point light
    rays, open_ = 0, 0
    # The first rays go to one quarter of each stratum. If they differ in what they meet, the others follow.
    for turn in range(_QUARTERS):
        if turn > 0 and (width == 0 or open_ == 0 or open_ == rays):
            break
        for stratum in range(strata):
            if pieces <= strata and total[stratum * pieces // strata, 0].max() == 0:
                continue  # The sixteen points see the back of this piece.
            corner = lamp + stratum * 4 // strata
            for lane in range(16):
                base = pattern[lane]
                cell = stratum * _QUARTERS + ((base >> 4) + stratum + turn & 3)
                # With other samples in the next cell, edges of shadows meet all samples one after another.
                within = (2 * (base + _STEP * cell + 37 * lamp & 63) + 1) * width >> 7
                sample[lane] = first + cell * width + within
                spot[lane] = (base >> 2) + base + corner + turn & 3
                piece[lane] = cell * pieces // (strata * _QUARTERS)
            new = _cast(query, memory, lamps, (sample, spot, piece), origin, sight, weight, free)
            rays, open_ = rays + new[0], open_ + new[1]
    for lane in range(16):
        whole = weight[:, lane].sum()
        mean = free[:, lane].sum() / whole if whole > 0 else 0.0
        for index in range(pieces):
            sent = weight[index, lane]
            free[index, lane] = free[index, lane] / sent if sent > 0 else mean


@numba_loop
def _light_point(surface, points, fields, packet, lanes, origin, sight, pattern):
    """Sets what does not depend on lamps for sixteen points. Padding has no normal, and nothing above its horizon."""
    position, normals = fields
    center, normal, facing, least = sight
    for lane in range(16):
        point = packet + min(lane, lanes - 1)
        _start(surface, points, point, lane, origin, facing)
        drawn = lane < lanes and (facing[0, lane] != 0 or facing[1, lane] != 0 or facing[2, lane] != 0)
        offset = surface[3][max(points[0][point], 0)]
        least[lane], pattern[lane] = max(offset * offset, np.float32(_TINY)), points[3][point]
        for axis in range(3):
            center[axis, lane] = position[point, axis]
            normal[axis, lane] = normals[point, axis] if drawn else 0.0


@numba_loop
def trace_lamps(query, surface, points, first, last, fields, lamps, result):
    """Integrals of the visible parts of lamps at points of a picture.

    Args:
        query: What shadow rays need; see `Packets.query`.
        surface: Positions and normals of vertices, triangles, and the distance from each at which rays start.
        points: Triangle, barycentric coordinates, their slopes, and the number in the dither pattern of each point.
        first: Index of the first point.
        last: Index after the last point.
        fields: Position and shading normal of each point.
        lamps: The fields of `jaxprt.visibility.picture_rays.LampPlaces`.
        result: The integrals of 1, of the cosine, and of the direction.
    """
    pieces, most = lamps[4], lamps[4].max()
    memory = np.zeros(16, np.float32), np.zeros((6, 16), np.float32)
    origin, pattern = np.zeros((4, 3, 16), np.float32), np.zeros(16, np.int64)
    center, normal = np.zeros((3, 16), np.float32), np.zeros((3, 16), np.float32)
    facing = np.zeros((3, 16), np.float32)
    least, room = np.zeros(16, np.float32), np.zeros(16, np.float32)
    sight = center, normal, facing, least
    total = np.zeros((most, 4, 16), np.float32)
    weight, free = np.zeros((most, 16), np.float32), np.zeros((most, 16), np.float32)
    for packet in range(first, last, 16):
        lanes = min(16, last - packet)
        _light_point(surface, points, fields, packet, lanes, origin, sight, pattern)
        row = 0
        for lamp in range(len(pieces)):
            count = pieces[lamp]
            _unshadowed(lamp, lamps, sight, total, room)
            if total[:count, 0].max() > 0:
                _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free)
            else:
                free[:] = 0
            for piece in range(count):
                _write(total[piece], free[piece], normal, row + piece, packet, lanes, result)
            row += count


@numba_loop
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
