"""Rays through surfaces with holes and translucent ones, in packets, by filter functions of Embree.

Embree calls the filter for each hit on a surface that is not opaque. The filter looks up the opacity where the ray hits
and refuses hits where light passes.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Integer
from numba import carray  # pyright: ignore[reportPrivateImportUsage]
from numba.core import types
from numba.extending import intrinsic

from jaxprt.compile import numba_loop
from jaxprt.scene import texture
from jaxprt.scene.mesh import BLEND, CLEAR, Opacity
from jaxprt.scene.subdivision import places
from jaxprt.visibility import packets

LAYERS = 8  # translucent surfaces that a ray collects: the nearest ones
_ROOM = LAYERS + 1  # places for these and an opaque one
_PASSED, _FIRST, _LAYERS = 0, 1, 2  # what the filter does with a hit
_CLAMP, _MIRROR = texture.WRAPS.index("clamp"), texture.WRAPS.index("mirror")
_MODE, _FIELD = 8, 9  # places in the context of a ray, after what Embree keeps there
_BLEND, _CLEAR = np.float32(BLEND), np.float32(CLEAR)
# `no_type_check`, here as in `packets`: run-time type checks would wrap functions, and numba could not compile them.


class AlphaPackets:
    """An Embree scene of triangles, some of which have an opacity.

    The two sides of a sheet (`jaxprt.scene.sides`) stop light once: a reversed copy of an earlier triangle is left out.

    Args:
        position: Vertex positions.
        face: Three vertex indices for each triangle.
        opacity: Opacity of the vertices.
        clear_only: Whether to leave out the opaque triangles, and to keep both sides of sheets, for `layers`.
    """

    def __init__(
        self,
        position: Float32[np.ndarray, "v 3"],
        face: Integer[np.ndarray, "f 3"],
        opacity: Opacity,
        *,
        clear_only: bool = False,
    ):
        embree = packets.library()
        if embree is None:
            raise RuntimeError("surfaces with holes need the Embree library of embreex 4, with packets of rays")
        self._occluded, self._intersect = embree.occluded, embree.intersect
        layer = np.asarray(opacity.layer)[face[:, 0]]
        opaque, clear = np.flatnonzero((layer == 0) & (not clear_only)), np.flatnonzero(layer > 0)
        if not clear_only:
            clear = clear[~_is_reverse(position, face[clear])]
        self._scene, self._index = packets.new_scene(self), [faces for faces in (opaque, clear) if len(faces)]
        if len(opaque):
            packets.attach(self._scene, position, face[opaque])
        self._table, self._kept = _table(face[clear], layer[clear], opacity)
        if len(clear):
            vertex, corner = np.unique(face[clear], return_inverse=True)
            options = {"filter_function": _filter.address, "data": self._table.ctypes.data}
            packets.attach(self._scene, position[vertex], corner.reshape(-1, 3), **options)
        self._clear = clear
        packets.commit(self._scene, f"{len(position)} vertices and {len(face)} triangles")

    def passed(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Float32[np.ndarray, " n"]:
        """Share of light that passes along each ray. `Occluder.blocked` explains the arguments."""
        share = np.ones(len(point), np.float32)
        _trace_shares(self._occluded, self._scene, origin, direction, point, way, share)
        return share

    def blocked(self, origin, direction, point, way) -> Bool[np.ndarray, " n"]:
        """Whether each ray is stopped: with the probability that its light is, by a hash of the ray."""
        share = self.passed(origin, direction, point, way)
        return _trace_blocked(origin, direction, point, way, share)

    @property
    def query(self) -> tuple[tuple[int, int], int, np.ndarray, np.ndarray, np.ndarray]:
        """What queries of shares need; see `packets.Packets.query`."""
        passed, context, arguments = np.ones(packets.WIDTH, np.float32), np.empty(16, np.int64), np.empty(4, np.int64)
        _empty_context(context, arguments, _PASSED)
        context[_FIELD] = passed.ctypes.data
        return self._occluded, self._scene, arguments, context, passed

    def hit(self, origin: Float32[np.ndarray, "m 3"], direction: Float32[np.ndarray, "m 3"]):
        """The first triangle that stops each ray (-1 for none), its distance, and the barycentric coordinates.

        A translucent surface stops a ray with the probability of its opacity, by a hash of the ray.
        """
        count = len(origin)
        face, part = np.full(count, -1, np.int64), np.zeros(count, np.int32)
        distance, weight = np.empty(count, np.float32), np.zeros((count, 3), np.float32)
        _first(self._intersect, self._scene, origin, direction, face, part, distance, weight)
        hit = face >= 0
        for number, index in enumerate(self._index):
            of_part = hit & (part == number)
            face[of_part] = index[face[of_part]]
        return face, distance, weight

    def layers(
        self,
        origin: Float32[np.ndarray, "3"],
        direction: Float32[np.ndarray, "n 3"],
        far: Float32[np.ndarray, " n"],
        hidden: Bool[np.ndarray, " f"],
    ) -> tuple[Int32[np.ndarray, " n"], Int[np.ndarray, "n k"], Float32[np.ndarray, "n k"], Float32[np.ndarray, "n k"]]:
        """The surfaces that are not opaque everywhere, on rays from one point.

        These are the nearest `LAYERS` translucent ones, and the first one that lets no light pass.

        Args:
            origin: Origin of all rays.
            direction: Directions, of any length.
            far: Where each ray ends, in lengths of its direction.
            hidden: Triangles that these rays pass.

        Returns:
            For each ray the number of surfaces, and for each of these the triangle, where the ray hits it, and the
            opacity.
        """
        count, shape = np.zeros(len(direction), np.int32), (len(direction), _ROOM)
        place, face = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int64)
        alpha, skipped = np.zeros(shape, np.float32), np.ascontiguousarray(hidden[self._clear], np.uint8)
        _collect(self._intersect, self._scene, origin, direction, far, skipped, count, place, face, alpha)
        return count, self._clear[face], place, alpha


def _is_reverse(position: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Whether an earlier face has the same corners in the opposite order."""
    corner = places(position)[face]
    order = np.argsort(corner, axis=1)
    odd = ((order[:, 0] > order[:, 1]) ^ (order[:, 0] > order[:, 2]) ^ (order[:, 1] > order[:, 2])).astype(int)
    _, row = np.unique(np.take_along_axis(corner, order, 1), axis=0, return_inverse=True)
    row = row.reshape(-1)
    first = np.full((len(face), 2), len(face))
    np.minimum.at(first, (row, odd), np.arange(len(face)))
    return first[row, 1 - odd] < first[row, odd]


def _table(face: np.ndarray, layer: np.ndarray, opacity: Opacity) -> tuple[np.ndarray, list[np.ndarray]]:
    """Addresses of the arrays that the filter reads, and the arrays: corner by corner, for the triangles given."""
    arrays = [
        np.ascontiguousarray(np.asarray(opacity.coordinate)[face], np.float32),
        np.ascontiguousarray(np.asarray(opacity.factor)[face], np.float32),
        layer.astype(np.int32),
        np.ascontiguousarray(opacity.cutoff, np.float32),
        np.ascontiguousarray(opacity.wrap, np.int32),
        np.ascontiguousarray(opacity.start, np.int64),
        np.ascontiguousarray(opacity.shape, np.int32),
        np.ascontiguousarray(opacity.texel, np.float32),
    ]
    return np.array([array.ctypes.data for array in arrays], np.int64), arrays


@no_type_check
@intrinsic
def _pointer(typing, address):
    """An integer as a pointer."""

    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


@no_type_check
@numba.njit(inline="always")
def _texel_index(index, size, mode):
    """The texel that an index of at most one period outside shows."""
    if mode == _CLAMP:
        return min(max(index, 0), size - 1)
    if mode == _MIRROR:
        index = index % (2 * size)
        return min(index, 2 * size - 1 - index)
    return index % size


@no_type_check
@numba.njit(inline="always")
def _wrap(place, mode):
    """A coordinate within the first period of its wrap mode."""
    if mode == _CLAMP:
        return min(max(place, np.float32(0)), np.float32(1))
    period = np.float32(2 if mode == _MIRROR else 1)
    return place - period * np.floor(place / period)


@no_type_check
@numba_loop
def _alpha(table, face, u, v):
    """The opacity of a point: 0 or 1 for a surface with holes, the share of light that it stops for others."""
    coordinate = carray(_pointer(table[0] + 24 * face), 6, np.float32)
    factor = carray(_pointer(table[1] + 12 * face), 3, np.float32)
    layer = carray(_pointer(table[2] + 4 * face), 1, np.int32)[0]
    cutoff = carray(_pointer(table[3] + 4 * layer), 1, np.float32)[0]
    start = carray(_pointer(table[5] + 8 * layer), 1, np.int64)[0]
    w = np.float32(1) - u - v
    alpha = w * factor[0] + u * factor[1] + v * factor[2]
    if start >= 0:
        wrap = carray(_pointer(table[4] + 8 * layer), 2, np.int32)
        shape = carray(_pointer(table[6] + 8 * layer), 2, np.int32)
        height, width = shape[0], shape[1]
        texel = carray(_pointer(table[7] + 4 * start), height * width, np.float32)
        across = _wrap(w * coordinate[0] + u * coordinate[2] + v * coordinate[4], wrap[0])
        up = _wrap(w * coordinate[1] + u * coordinate[3] + v * coordinate[5], wrap[1])
        x, y = across * width - np.float32(0.5), (np.float32(1) - up) * height - np.float32(0.5)
        left, top = int(np.floor(x)), int(np.floor(y))
        right, down = x - np.float32(left), y - np.float32(top)
        near, far = _texel_index(left, width, wrap[0]), _texel_index(left + 1, width, wrap[0])
        upper = width * _texel_index(top, height, wrap[1])
        lower = width * _texel_index(top + 1, height, wrap[1])
        first = texel[upper + near] + right * (texel[upper + far] - texel[upper + near])
        second = texel[lower + near] + right * (texel[lower + far] - texel[lower + near])
        alpha *= first + down * (second - first)
    if cutoff != _BLEND:
        return np.float32(1) if alpha >= cutoff else np.float32(0)
    if alpha > np.float32(1) - _CLEAR:
        return np.float32(1)
    return alpha if alpha > _CLEAR else np.float32(0)


@no_type_check
@numba.njit(inline="always")
def _mix_bits(state, value):
    """A step of a hash of 32-bit integers."""
    state = np.uint32(state ^ value) * np.uint32(0x85EBCA6B)
    state ^= state >> np.uint32(13)
    state = np.uint32(state) * np.uint32(0xC2B2AE35)
    return np.uint32(state ^ (state >> np.uint32(16)))


@no_type_check
@numba.njit(inline="always")
def _fraction(state):
    """A hash as a number from 0 to below 1."""
    return np.float32(state >> np.uint32(8)) * np.float32(2.0**-24)


@no_type_check
def _veil(argument):
    # RTCFilterFunctionNArguments: valid, user's pointer, context, ray, hit, number of rays.
    head = carray(argument, 6, np.int64)
    n = np.int64(head[5] & 0xFFFFFFFF)
    valid = carray(_pointer(head[0]), n, np.int32)
    table = carray(_pointer(head[1]), 8, np.int64)
    context = carray(_pointer(head[2]), 16, np.int64)
    ray = carray(_pointer(head[3]), 12 * n, np.float32)
    number = carray(_pointer(head[3]), 12 * n, np.uint32)
    hit = carray(_pointer(head[4]), 7 * n, np.float32)
    primitive = carray(_pointer(head[4]), 7 * n, np.uint32)
    mode = context[_MODE]
    for lane in range(n):
        if valid[lane] == 0:
            continue
        face, slot = np.int64(primitive[5 * n + lane]), np.int64(number[10 * n + lane])
        if mode == _LAYERS and carray(_pointer(context[_FIELD + 4] + face), 1, np.uint8)[0] != 0:
            valid[lane] = 0
            continue
        alpha = _alpha(table, face, hit[3 * n + lane], hit[4 * n + lane])
        if alpha == 0:
            valid[lane] = 0
        elif mode == _PASSED:
            share = carray(_pointer(context[_FIELD] + 4 * slot), 1, np.float32)
            share[0] *= np.float32(1) - alpha
            if share[0] > _CLEAR:
                valid[lane] = 0
        elif mode == _FIRST:
            state = np.uint32(face)
            for row in (0, 1, 2, 4, 5, 6):
                state = _mix_bits(state, number[row * n + lane])
            if _fraction(state) >= alpha:
                valid[lane] = 0
        elif alpha < 1:
            _insert(context, slot, ray[8 * n + lane], face, alpha)
            valid[lane] = 0


@no_type_check
@numba_loop
def _insert(context, slot, distance, face, alpha):
    """Adds a hit to the list of a ray, which is sorted by distance, and by triangle where several coincide."""
    count = carray(_pointer(context[_FIELD] + 4 * slot), 1, np.int32)
    place = carray(_pointer(context[_FIELD + 1] + 4 * _ROOM * slot), LAYERS, np.float32)
    faces = carray(_pointer(context[_FIELD + 2] + 8 * _ROOM * slot), LAYERS, np.int64)
    alphas = carray(_pointer(context[_FIELD + 3] + 4 * _ROOM * slot), LAYERS, np.float32)
    for at in range(count[0]):
        if faces[at] == face and place[at] == distance:
            return
    at = count[0]
    while at > 0 and (place[at - 1] > distance or (place[at - 1] == distance and faces[at - 1] > face)):
        at -= 1
    if at == LAYERS:
        return
    count[0] = min(count[0] + 1, LAYERS)
    for later in range(count[0] - 1, at, -1):
        place[later], faces[later], alphas[later] = place[later - 1], faces[later - 1], alphas[later - 1]
    place[at], faces[at], alphas[at] = distance, face, alpha


_filter = packets.callback(types.void(types.voidptr), _veil)


@no_type_check
@numba_loop
def _empty_context(context, arguments, mode):
    """Fills the context of rays and the arguments of a query: flags and features, context, filter, callback."""
    context[:] = -1
    context[_MODE] = mode
    # Embree passes coherent packets once for each octant of their directions, and may filter a hit each time. Shares of
    # light are products, so that hits must be filtered once.
    arguments[0] = packets.EVERY_FEATURE << 32 | (0 if mode == _PASSED else packets.COHERENT)
    arguments[1] = context.ctypes.data
    arguments[2] = arguments[3] = 0


@no_type_check
@numba_loop
def _no_hit(ray):
    """Sets the fields of RTCRayHit16 that tell that nothing is hit."""
    number = ray.view(np.uint32)
    for row in range(17, 24):
        for lane in range(16):
            number[row, lane] = 0xFFFFFFFF


@no_type_check
@numba_loop
def _trace_shares(entry, scene, origin, direction, point, way, share):
    context, arguments = np.empty(16, np.int64), np.empty(4, np.int64)
    _empty_context(context, arguments, _PASSED)
    context[_FIELD] = share.ctypes.data
    buffers = packets.ray_buffers()
    ray, valid, _ = buffers
    for packet in range(0, len(point), 16):
        count = min(16, len(point) - packet)
        for lane in range(16):
            at = packet + min(lane, count - 1)
            valid[lane] = -1 if lane < count else 0
            for axis in range(3):
                ray[axis, lane] = origin[point[at], axis]
                ray[4 + axis, lane] = direction[way[at], axis]
            packets.begin(ray, lane, at, 1e37)
        packets.trace(entry, scene, arguments.ctypes.data, buffers, 12)
        for lane in range(count):
            if ray[8, lane] < 0:
                share[packet + lane] = 0.0


@no_type_check
@numba_loop
def _trace_blocked(origin, direction, point, way, share):
    result = np.empty(len(point), np.bool_)
    for at in range(len(point)):
        if share[at] == 0 or share[at] == 1:
            result[at] = share[at] == 0
            continue
        state, bits = np.uint32(0x9E3779B9), np.empty(6, np.float32)
        for axis in range(3):
            bits[axis], bits[3 + axis] = origin[point[at], axis], direction[way[at], axis]
        for value in bits.view(np.uint32):
            state = _mix_bits(state, value)
        result[at] = _fraction(state) >= share[at]
    return result


@no_type_check
@numba_loop
def _first(entry, scene, origin, direction, face, part, distance, weight):
    context, arguments = np.empty(16, np.int64), np.empty(4, np.int64)
    _empty_context(context, arguments, _FIRST)
    buffers = packets.ray_buffers()
    ray, valid, _ = buffers
    number = ray.view(np.uint32)
    for packet in range(0, len(origin), 16):
        count = min(16, len(origin) - packet)
        for lane in range(16):
            at = packet + min(lane, count - 1)
            valid[lane] = -1 if lane < count else 0
            for axis in range(3):
                ray[axis, lane] = origin[at, axis]
                ray[4 + axis, lane] = direction[at, axis]
            packets.begin(ray, lane, at, 1e37)
        _no_hit(ray)
        packets.trace(entry, scene, arguments.ctypes.data, buffers, 24)
        for lane in range(count):
            at = packet + lane
            distance[at] = ray[8, lane]
            if number[18, lane] != np.uint32(0xFFFFFFFF):
                face[at], part[at] = number[17, lane], number[18, lane]
                u, v = ray[15, lane], ray[16, lane]
                weight[at, 0], weight[at, 1], weight[at, 2] = np.float32(1) - u - v, u, v


@no_type_check
@numba_loop
def _collect(entry, scene, origin, direction, far, hidden, count, place, face, alpha):
    context, arguments = np.empty(16, np.int64), np.empty(4, np.int64)
    _empty_context(context, arguments, _LAYERS)
    context[_FIELD], context[_FIELD + 1] = count.ctypes.data, place.ctypes.data
    context[_FIELD + 2], context[_FIELD + 3] = face.ctypes.data, alpha.ctypes.data
    context[_FIELD + 4] = hidden.ctypes.data
    buffers = packets.ray_buffers()
    ray, valid, _ = buffers
    number = ray.view(np.uint32)
    for packet in range(0, len(direction), 16):
        rays = min(16, len(direction) - packet)
        for lane in range(16):
            at = packet + min(lane, rays - 1)
            valid[lane] = -1 if lane < rays else 0
            for axis in range(3):
                ray[axis, lane] = origin[axis]
                ray[4 + axis, lane] = direction[at, axis]
            packets.begin(ray, lane, at, far[at])
        _no_hit(ray)
        packets.trace(entry, scene, arguments.ctypes.data, buffers, 24)
        for lane in range(rays):
            at = packet + lane
            if number[18, lane] == np.uint32(0xFFFFFFFF):
                continue
            while count[at] > 0 and place[at, count[at] - 1] > ray[8, lane]:  # behind a surface that hides all
                count[at] -= 1
            last = count[at]
            place[at, last], face[at, last], alpha[at, last] = ray[8, lane], number[17, lane], 1.0
            count[at] += 1
