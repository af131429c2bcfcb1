"""Loops over directions and pixels of panoramas, compiled by numba.

A panorama is stored as levels of half precision in one array, `half`. Level k has `height[k]` x `width[k]` pixels if it
is a latlong picture, or six such faces if it is a cube. `first[k]` is the index of its first pixel. `radiance` holds
the value of each bit pattern of half precision, in the units of the file.
"""

import math
from functools import partial
from typing import no_type_check

from jaxprt.compile import numba_loop

FINE = 8  # pieces along the edge of a bright pixel, at least
_loop = partial(numba_loop, error_model="numpy")


@no_type_check  # Run-time type checks would wrap the function, and numba could not cache it on disk.
@_loop
def _project(x, y, z):
    """Face of the cube and the coordinates (s, t) on it, as in `cubemap.project`."""
    right, up, near = abs(x), abs(y), abs(z)
    if right >= up and right >= near:
        face, length = (1, right) if x < 0 else (0, right)
        s, t = (z, -y) if x < 0 else (-z, -y)
    elif up >= near:
        face, length = (3, up) if y < 0 else (2, up)
        s, t = (x, -z) if y < 0 else (x, z)
    else:
        face, length = (5, near) if z < 0 else (4, near)
        s, t = (-x, -y) if z < 0 else (x, -y)
    inverse = 1.0 / length if length > 0 else 1.0
    return face, s * inverse, t * inverse


@no_type_check
@_loop
def _unproject(face, s, t):
    """A direction, not normalized, from a point on a face or beyond its edges, as in `cubemap.unproject`."""
    side = -1.0 if face % 2 else 1.0
    if face < 2:
        return side, -t, -side * s
    if face < 4:
        return s, side, side * t
    return side * s, -t, side


@no_type_check
@_loop
def _pixel(cube, height, width, face, row, column):
    """Index of a pixel in its level, which may lie one pixel beyond the edge of its face."""
    if not cube:
        if row < 0:  # beyond the pole
            row, column = -1 - row, column + width // 2
        elif row >= height:
            row, column = 2 * height - 1 - row, column + width // 2
        column += width if column < 0 else 0
        return row * width + (column % width if column >= width else column)
    n = height
    if row < 0 or row >= n or column < 0 or column >= n:
        x, y, z = _unproject(face, (2 * column + 1) / n - 1, (2 * row + 1) / n - 1)
        face, s, t = _project(x, y, z)
        row = min(max(int((t + 1) * n / 2), 0), n - 1)
        column = min(max(int((s + 1) * n / 2), 0), n - 1)
    return (face * n + row) * n + column


@no_type_check
@_loop
def _radiance(half, radiance, pixel):
    return radiance[half[pixel, 0]], radiance[half[pixel, 1]], radiance[half[pixel, 2]]


@no_type_check
@_loop
def _bilinear(half, radiance, first, cube, height, width, face, down, right):
    """Radiance of a level at a point, from 0 to 1 down and to the right of a face."""
    row, column = down * height - 0.5, right * width - 0.5
    top, left = math.floor(row), math.floor(column)
    row, column = row - top, column - left
    total = (0.0, 0.0, 0.0)
    for i in range(2):
        for j in range(2):
            share = (row if i else 1 - row) * (column if j else 1 - column)
            red, green, blue = _radiance(half, radiance, first + _pixel(cube, height, width, face, top + i, left + j))
            total = total[0] + share * red, total[1] + share * green, total[2] + share * blue
    return total


@no_type_check
@_loop
def sample(half, radiance, first, height, width, cube, turn, direction, angle, color):
    """Radiance from some directions: bilinear within a level and linear between two levels.

    `angle` is the width of the pixel around each direction in radians: the level is the one whose pixels are as wide.
    """
    last = len(first) - 1
    for ray in range(len(direction)):
        right, up, near = direction[ray, 0], direction[ray, 1], direction[ray, 2]
        x = turn[0, 0] * right + turn[1, 0] * up + turn[2, 0] * near
        y = turn[0, 1] * right + turn[1, 1] * up + turn[2, 1] * near
        z = turn[0, 2] * right + turn[1, 2] * up + turn[2, 2] * near
        if cube:
            face, s, t = _project(x, y, z)
            across, down = (s + 1) / 2, (t + 1) / 2
            wide = angle[ray] * height[0] / 2 * (1 + s * s + t * t) ** 0.75
        else:
            face = 0
            across = 0.5 - math.atan2(x, z) / (2 * math.pi)
            down = 0.5 - math.atan2(y, math.sqrt(x * x + z * z)) / math.pi
            wide = angle[ray] * height[0] / math.pi
        level = min(math.log2(wide), float(last)) if wide > 1 else 0.0
        k = int(level)
        share = level - k
        fine = _bilinear(half, radiance, first[k], cube, height[k], width[k], face, down, across)
        if share > 0:
            k += 1
            coarse = _bilinear(half, radiance, first[k], cube, height[k], width[k], face, down, across)
            for c in range(3):
                color[ray, c] = (1 - share) * fine[c] + share * coarse[c]
        else:
            for c in range(3):
                color[ray, c] = fine[c]


@no_type_check
@_loop
def add_disks(disk, direction, angle, color):
    """Adds the radiance of round lamps to `color`, with edges as soft as the pixel around each direction is wide.

    A row of `disk` is a unit direction, an angular radius in radians, and three colors of radiance.
    """
    for ray in range(len(direction)):
        x, y, z = direction[ray, 0], direction[ray, 1], direction[ray, 2]
        length = math.sqrt(x * x + y * y + z * z)
        for k in range(len(disk)):
            toward = (disk[k, 0] * x + disk[k, 1] * y + disk[k, 2] * z) / length
            reach = disk[k, 3] + angle[ray]
            if toward > 1 - reach * reach / 2:  # at most the cosine of the reach
                off = math.acos(min(toward, 1.0)) - disk[k, 3]
                cover = 1.0 if off <= 0 else 0.0
                if angle[ray] > 0:
                    cover = min(max(0.5 - off / angle[ray], 0.0), 1.0)
                for c in range(3):
                    color[ray, c] += cover * disk[k, 4 + c]


@no_type_check
@_loop
def _add_flux(total, size, matrix, x, y, z, area, red, green, blue):
    """Adds the flux and area of a small part of the sphere to the texel of a cubemap that it lies in after a turn."""
    face, s, t = _project(
        matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z,
        matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z,
        matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z,
    )
    middle = 0.5 * size
    row = min(int((t + 1) * middle), size - 1)
    column = min(int((s + 1) * middle), size - 1)
    texel = (face * size + row) * size + column
    total[texel, 0] += area * red
    total[texel, 1] += area * green
    total[texel, 2] += area * blue
    total[texel, 3] += area


@no_type_check
@_loop
def latlong_flux(half, radiance, height, width, parts, bright, matrix, size, total, excess):
    """Adds flux and solid angle of a latlong level to the texels of a cubemap.

    `total` gets radiance up to `bright`, in parts x parts pieces of each pixel, and `excess` what is above it, in
    `FINE` x `FINE` pieces at least. The pieces of a pixel lie on a sheared lattice: on a regular one, all pieces along
    a texel's edge would fall on the same side of it.
    """
    step, across = math.pi / height, 2 * math.pi / width
    cosine, sine = math.cos(across), math.sin(across)  # of the turn from one column to the next
    for row in range(height):
        for i in range(parts):
            top = math.pi / 2 - (row + i / parts) * step
            area = (math.sin(top) - math.sin(top - step / parts)) * across / parts
            for j in range(parts):
                latitude = top - (j + 0.5) / parts * step / parts
                ring, y = math.cos(latitude), math.sin(latitude)
                longitude = math.pi - (j + (i + 0.5) / parts) / parts * across
                x, z = ring * math.sin(longitude), ring * math.cos(longitude)
                for column in range(width):
                    red, green, blue = _radiance(half, radiance, row * width + column)
                    red, green, blue = min(red, bright), min(green, bright), min(blue, bright)
                    _add_flux(total, size, matrix, x, y, z, area, red, green, blue)
                    x, z = x * cosine - z * sine, z * cosine + x * sine
    parts = max(parts, FINE)
    for row in range(height):
        for column in range(width):
            red, green, blue = _radiance(half, radiance, row * width + column)
            if max(red, green, blue) <= bright:
                continue
            red, green, blue = max(red - bright, 0.0), max(green - bright, 0.0), max(blue - bright, 0.0)
            for i in range(parts):
                top = math.pi / 2 - (row + i / parts) * step
                area = (math.sin(top) - math.sin(top - step / parts)) * across / parts
                for j in range(parts):
                    latitude = top - (j + 0.5) / parts * step / parts
                    longitude = math.pi - (column + (j + (i + 0.5) / parts) / parts) * across
                    ring, y = math.cos(latitude), math.sin(latitude)
                    x, z = ring * math.sin(longitude), ring * math.cos(longitude)
                    _add_flux(excess, size, matrix, x, y, z, area, red, green, blue)


@no_type_check
@_loop
def _add_pieces(total, size, matrix, face, row, column, n, parts, red, green, blue):
    """Adds the flux and area of a pixel of a cube to the texels of a cubemap, in pieces."""
    piece = (2 / (n * parts)) ** 2
    for i in range(parts):
        for j in range(parts):
            s = 2 * (column + (j + (i + 0.5) / parts) / parts) / n - 1
            t = 2 * (row + (i + (j + 0.5) / parts) / parts) / n - 1
            x, y, z = _unproject(face, s, t)
            square = 1 + s * s + t * t
            _add_flux(total, size, matrix, x, y, z, piece / (square * math.sqrt(square)), red, green, blue)


@no_type_check
@_loop
def cube_flux(half, radiance, n, _, parts, bright, matrix, size, total, excess):
    """Adds flux and solid angle of a cube's level to the texels of a cubemap, as `latlong_flux` does."""
    for face in range(6):
        for row in range(n):
            for column in range(n):
                red, green, blue = _radiance(half, radiance, (face * n + row) * n + column)
                low = min(red, bright), min(green, bright), min(blue, bright)
                _add_pieces(total, size, matrix, face, row, column, n, parts, low[0], low[1], low[2])
                if max(red, green, blue) > bright:
                    red, green, blue = red - low[0], green - low[1], blue - low[2]
                    _add_pieces(excess, size, matrix, face, row, column, n, max(parts, FINE), red, green, blue)
