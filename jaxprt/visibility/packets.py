"""Rays in packets, through holes and translucent surfaces too.

Embree calls a filter function for each hit on a surface that is not opaque. The filter looks up the opacity where the
ray hits and refuses hits where light passes. Opaque scenes have no filter.
"""

import functools
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, Int32, Integer
from numba import carray  # pyright: ignore[reportPrivateImportUsage]
from numba.core import types

from jaxprt.compile import numba_loop
from jaxprt.scene import texture
from jaxprt.scene.mesh import BLEND, CLEAR, Opacity
from jaxprt.scene.subdivision import orientations
from jaxprt.visibility import embree

LAYERS = 8  # translucent surfaces that a ray collects: the nearest ones
_PASSED, _FIRST, _LAYERS = 0, 1, 2  # what the filter does with a hit
_CLAMP, _MIRROR = texture.WRAPS.index("clamp"), texture.WRAPS.index("mirror")
_BLEND, _CLEAR = np.float32(BLEND), np.float32(CLEAR)
_HIT = np.dtype([("distance", "f4"), ("weight", "f4", 3), ("primitive", "u4"), ("geometry", "u4")])
_LAYER = np.dtype([("distance", "f4"), ("alpha", "f4"), ("face", "i4")])
# What the filter reads of the opacity: of each triangle, of each of its layers, and where these arrays are.
_CORNERS = np.dtype([("coordinate", "f4", (3, 2)), ("factor", "f4", 3), ("layer", "i4")])
_IMAGE = np.dtype([("start", "i8"), ("shape", "i4", 2), ("wrap", "i4", 2), ("cutoff", "f4")], align=True)
_TABLE = np.dtype([("corners", "i8"), ("image", "i8"), ("texel", "i8")])
# RTCRayQueryContext, with room, and the arrays that the filter reads and writes. Those of rays stand in their order.
_CONTEXT = np.dtype(
    [("embree", "i4", 16), ("mode", "i8"), ("share", "i8"), ("count", "i8"), ("layer", "i8"), ("hidden", "i8")]
)
_FILTER = np.dtype(  # RTCFilterFunctionNArguments
    [("valid", "i8"), ("table", "i8"), ("context", "i8"), ("ray", "i8"), ("hit", "i8"), ("count", "u4")], align=True
)
_NO_SHARE, _NO_HIT = np.ones(0, np.float32), np.zeros(0, _HIT)
_ENDLESS = np.full(1, embree.ENDLESS, np.float32)
_inline = partial(numba_loop, inline="always")


class Packets(embree.Triangles):
    """An Embree scene of triangles, for rays in packets.

    The two sides of a sheet (`jaxprt.scene.sides`) that is not opaque stop light once: a reversed copy of an earlier
    triangle is left out.

    Args:
        position: Vertex positions.
        face: Three vertex indices for each triangle.
        opacity: Opacity of the vertices; None if all are opaque.
        clear_only: Whether to leave out the opaque triangles, and to keep both sides of sheets, for `layers`.

    Raises:
        RuntimeError: embreex ships no Embree 4 library with packets of rays.
    """

    def __init__(
        self,
        position: Float32[np.ndarray, "v 3"],
        face: Integer[np.ndarray, "f 3"],
        *,
        opacity: Opacity | None = None,
        clear_only: bool = False,
    ):
        library = embree.library()
        if library is None:
            raise RuntimeError("rays from pixels and surfaces with holes need embreex with Embree 4, which has packets")
        super().__init__(library)
        layer = np.zeros(len(face), np.int32) if opacity is None else np.asarray(opacity.layer)[face[:, 0]]
        opaque, clear = np.flatnonzero((layer == 0) & (not clear_only)), np.flatnonzero(layer > 0)
        if len(clear) and not clear_only:
            clear = clear[~_is_reverse(position, face[clear])]
        # Geometry 0 holds the opaque triangles if there are any, and the next one the others.
        self._clear, self._triangle, self._first = clear, np.concatenate([opaque, clear]), np.array([0, len(opaque)])
        if len(opaque):
            self.attach(position, face[opaque])
        if opacity is not None and len(clear):
            self._table, self._arrays = _table(face[clear], layer[clear], opacity)
            vertex, corner = np.unique(face[clear], return_inverse=True)
            self._filter = _compiled_filter()
            options = {"hit_filter": self._filter.address, "data": self._table.ctypes.data}
            self.attach(position[vertex], corner.reshape(-1, 3), **options)
        self.commit(f"{len(position)} vertices and {len(face)} triangles")

    def passed(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Float32[np.ndarray, " n"]:
        """Share of light that passes along each ray. `Occluder.blocked` explains the arguments."""
        share = np.ones(len(point), np.float32)
        _trace_rays(self.query(share=share), origin, direction, point, way, _ENDLESS, _NO_HIT)
        return share

    def blocked(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray is stopped: with the probability that its light is, by a hash of the ray."""
        share = self.passed(origin, direction, point, way)
        if not len(self._clear):
            return share == 0
        return _is_stopped(origin.view(np.uint32), direction.view(np.uint32), point, way, share)

    def hit(self, origin: Float32[np.ndarray, "m 3"], direction: Float32[np.ndarray, "m 3"]):
        """The first triangle that stops each ray (-1 for none), its distance, and the barycentric coordinates.

        A translucent surface stops a ray with the probability of its opacity, by a hash of the ray.
        """
        ray, hit = np.arange(len(origin)), np.zeros(len(origin), _HIT)
        _trace_rays(self.query(_FIRST), origin, direction, ray, ray, _ENDLESS, hit)
        face, stopped = np.full(len(origin), -1), np.flatnonzero(hit["geometry"] != embree.NONE)
        geometry, primitive = (hit[name][stopped] for name in ("geometry", "primitive"))
        face[stopped] = self._triangle[self._first[geometry] + primitive]
        return face, hit["distance"].copy(), hit["weight"].copy()

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
        ray, hit, hidden = np.arange(len(direction)), np.zeros(len(direction), _HIT), hidden[self._clear]
        count, layer = np.zeros(len(ray), np.int32), np.zeros((len(ray), LAYERS + 1), _LAYER)
        layer["distance"] = np.inf
        query = self.query(_LAYERS, count=count, layer=layer, hidden=hidden)
        _trace_rays(query, origin[None], direction, 0 * ray, ray, far, hit)
        # The surface that lets no light pass comes last.
        stopped = np.flatnonzero(hit["geometry"] != embree.NONE)
        last = count[stopped] = np.sum(layer["distance"][stopped, :LAYERS] <= hit["distance"][stopped, None], 1)
        for name, value in {"distance": hit["distance"], "face": hit["primitive"], "alpha": np.ones(len(ray))}.items():
            layer[name][stopped, last] = value[stopped]
        count[stopped] += 1
        return count, self._clear[layer["face"]], layer["distance"], layer["alpha"]

    def query(self, mode: int = _PASSED, share: Float32[np.ndarray, " n"] = _NO_SHARE, **array: np.ndarray) -> tuple:
        """What loops need to trace rays, by default shadow rays; see `Triangles.rays`.

        Args:
            mode: What the filter does with a hit.
            share: Shares of light, which the filter multiplies by what surfaces on the rays let pass.
            array: Other arrays that the filter reads or writes.
        """
        context = np.zeros(1, _CONTEXT)
        context["embree"], context["mode"] = -1, mode
        for name, value in {"share": share, **array}.items():
            context[name] = value.ctypes.data
        # Embree passes coherent packets once for each octant of their directions, and may filter a hit each time.
        # Shares of light are products, so that hits must be filtered once.
        coherent = mode != _PASSED or not len(self._clear)
        return self.rays(context, share, hits=mode != _PASSED, coherent=coherent)


def _is_reverse(position: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Whether an earlier face has the same corners in the opposite order."""
    alike, odd, _ = orientations(position, face)
    first = np.full((len(face), 2), len(face))
    np.minimum.at(first, (alike, odd), np.arange(len(face)))
    return first[alike, 1 - odd] < first[alike, odd]


def _table(face: np.ndarray, layer: np.ndarray, opacity: Opacity) -> tuple[np.ndarray, list[np.ndarray]]:
    """Where the filter finds the opacity of some triangles, and the arrays there."""
    corners, image = np.zeros(len(face), _CORNERS), np.zeros(len(opacity.cutoff), _IMAGE)
    corners["coordinate"], corners["factor"] = np.asarray(opacity.coordinate)[face], np.asarray(opacity.factor)[face]
    corners["layer"] = layer
    for name in ("start", "shape", "wrap", "cutoff"):
        image[name] = getattr(opacity, name)
    arrays = [corners, image, np.ascontiguousarray(opacity.texel, np.float32)]
    return np.array([tuple(array.ctypes.data for array in arrays)], _TABLE), arrays


@numba_loop
def _trace_rays(query, origin, direction, point, way, far, hit):
    """Traces rays, with one end or an end for each. Finds what they hit, or without room for it sets shares to 0."""
    ray, valid, share, _ = query
    number = ray.view(np.uint32)
    for first in range(0, len(point), 16):
        count = min(16, len(point) - first)
        for lane in range(16):
            index = first + min(lane, count - 1)
            valid[lane] = -1 if lane < count else 0
            for axis in range(3):
                ray[embree.ORIGIN + axis, lane] = origin[point[index], axis]
                ray[embree.DIRECTION + axis, lane] = direction[way[index], axis]
            ray[embree.FAR, lane] = far[min(index, len(far) - 1)]
            number[embree.ID, lane], number[embree.GEOMETRY, lane] = index, embree.NONE
        embree.trace(query, embree.RAY_HIT if len(hit) else embree.RAY)
        for lane in range(count):
            if len(hit):
                stop = hit[first + lane]
                stop.distance, stop.geometry = ray[embree.FAR, lane], number[embree.GEOMETRY, lane]
                if stop.geometry != embree.NONE:
                    u, v = ray[embree.U, lane], ray[embree.V, lane]
                    stop.weight[0], stop.weight[1], stop.weight[2] = np.float32(1) - u - v, u, v
                    stop.primitive = number[embree.PRIMITIVE, lane]
            elif ray[embree.FAR, lane] < 0:
                share[first + lane] = 0


@numba_loop
def _is_stopped(origin, direction, point, way, share):
    """Whether each ray is stopped, by a hash of its origin and direction, which are given as bits."""
    result = share == 0
    for ray in range(len(point)):
        if 0 < share[ray] < 1:
            state = np.uint32(0x9E3779B9)
            for axis in range(3):
                state = _mix_bits(state, origin[point[ray], axis])
            for axis in range(3):
                state = _mix_bits(state, direction[way[ray], axis])
            result[ray] = _fraction(state) >= share[ray]
    return result


@_inline
def _mix_bits(state, value):
    """A step of a hash of 32-bit integers."""
    state = np.uint32(state ^ value) * np.uint32(0x85EBCA6B)
    state ^= state >> np.uint32(13)
    state = np.uint32(state) * np.uint32(0xC2B2AE35)
    return np.uint32(state ^ (state >> np.uint32(16)))


@_inline
def _fraction(state):
    """A hash as a number from 0 to below 1."""
    return np.float32(state >> np.uint32(8)) * np.float32(2.0**-24)


@_inline
def _texel_index(index, size, mode):
    """The texel that an index of at most one period outside shows."""
    if mode == _CLAMP:
        return min(max(index, 0), size - 1)
    if mode == _MIRROR:
        index = index % (2 * size)
        return min(index, 2 * size - 1 - index)
    return index % size


@_inline
def _wrap(coordinate, mode):
    """A coordinate within the first period of its wrap mode."""
    if mode == _CLAMP:
        return min(max(coordinate, np.float32(0)), np.float32(1))
    period = np.float32(2 if mode == _MIRROR else 1)
    return coordinate - period * np.floor(coordinate / period)


@numba_loop
def _alpha(address, face, u, v):
    """The opacity of a point: 0 or 1 for a surface with holes, the share of light that it stops for others."""
    table = carray(embree.pointer(address), 1, _TABLE)[0]  # pyright: ignore[reportCallIssue]
    corner = carray(embree.pointer(table.corners), face + 1, _CORNERS)[face]
    image = carray(embree.pointer(table.image), corner.layer + 1, _IMAGE)[corner.layer]
    coordinate, factor, wrap = corner.coordinate, corner.factor, image.wrap
    w = np.float32(1) - u - v
    alpha = w * factor[0] + u * factor[1] + v * factor[2]
    if image.start >= 0:
        height, width = image.shape[0], image.shape[1]
        texel = carray(embree.pointer(table.texel + 4 * image.start), height * width, np.float32)
        across = _wrap(w * coordinate[0, 0] + u * coordinate[1, 0] + v * coordinate[2, 0], wrap[0])
        up = _wrap(w * coordinate[0, 1] + u * coordinate[1, 1] + v * coordinate[2, 1], wrap[1])
        x, y = across * width - np.float32(0.5), (np.float32(1) - up) * height - np.float32(0.5)
        left, top = int(np.floor(x)), int(np.floor(y))
        right, down = x - np.float32(left), y - np.float32(top)
        near, far = _texel_index(left, width, wrap[0]), _texel_index(left + 1, width, wrap[0])
        upper = width * _texel_index(top, height, wrap[1])
        lower = width * _texel_index(top + 1, height, wrap[1])
        first = texel[upper + near] + right * (texel[upper + far] - texel[upper + near])
        second = texel[lower + near] + right * (texel[lower + far] - texel[lower + near])
        alpha *= first + down * (second - first)
    if image.cutoff != _BLEND:
        return np.float32(1) if alpha >= image.cutoff else np.float32(0)
    if alpha > np.float32(1) - _CLEAR:
        return np.float32(1)
    return alpha if alpha > _CLEAR else np.float32(0)


@numba_loop
def _insert(layer, count, distance, face, alpha):
    """Adds a hit to the layers of a ray, sorted by distance and triangle, and returns their new number."""
    for index in range(count):
        if layer[index].face == face and layer[index].distance == distance:
            return count
    rank = count
    while rank > 0 and (layer[rank - 1].distance, layer[rank - 1].face) > (distance, face):
        rank -= 1
    if rank == LAYERS:
        return count
    count = min(count + 1, LAYERS)
    for later in range(count - 1, rank, -1):
        layer[later] = layer[later - 1]
    layer[rank].distance, layer[rank].face, layer[rank].alpha = distance, face, alpha
    return count


def _filter_hits(argument):
    """Refuses hits where light passes: the function that Embree calls."""
    call = carray(argument, 1, _FILTER)[0]
    context, lanes = carray(embree.pointer(call.context), 1, _CONTEXT)[0], np.int64(call.count)  # pyright: ignore[reportCallIssue]
    valid = carray(embree.pointer(call.valid), lanes, np.int32)
    ray = carray(embree.pointer(call.ray), (embree.RAY, lanes), np.float32)
    number = carray(embree.pointer(call.ray), (embree.RAY, lanes), np.uint32)
    hit = carray(embree.pointer(call.hit), (embree.GEOMETRY - embree.NORMAL, lanes), np.float32)
    primitive = carray(embree.pointer(call.hit), (embree.GEOMETRY - embree.NORMAL, lanes), np.uint32)
    for lane in range(lanes):
        if valid[lane] == 0:
            continue
        face, index = np.int64(primitive[embree.PRIMITIVE - embree.NORMAL, lane]), np.int64(number[embree.ID, lane])
        if context.mode == _LAYERS and carray(embree.pointer(context.hidden + face), 1, np.uint8)[0] != 0:
            valid[lane] = 0
            continue
        alpha = _alpha(call.table, face, hit[embree.U - embree.NORMAL, lane], hit[embree.V - embree.NORMAL, lane])
        if alpha == 0:
            valid[lane] = 0
        elif context.mode == _PASSED:
            share = carray(embree.pointer(context.share), index + 1, np.float32)
            share[index] *= np.float32(1) - alpha
            if share[index] > _CLEAR:
                valid[lane] = 0
        elif context.mode == _FIRST:
            state = np.uint32(face)
            for row in (0, 1, 2, 4, 5, 6):
                state = _mix_bits(state, number[row, lane])
            if _fraction(state) >= alpha:
                valid[lane] = 0
        elif alpha < 1:
            count = carray(embree.pointer(context.count), index + 1, np.int32)
            layer = carray(embree.pointer(context.layer), (index + 1, LAYERS + 1), _LAYER)[index]
            count[index] = _insert(layer, count[index], ray[embree.FAR, lane], face, alpha)
            valid[lane] = 0


@functools.cache
def _compiled_filter() -> Any:
    """The filter, which only scenes that are not opaque wait for."""
    return embree.callback(types.void(types.voidptr), _filter_hits)
