"""Shadow rays in packets, traced by the Embree library that embreex ships.

embreex traces rays one at a time. Rays with nearby origins and similar directions visit the same nodes of Embree's BVH.
Traced as a packet they are faster and give identical results.

`jaxprt.visibility.picture_rays` explains the method. The loops run over sixteen points at a time, on every processor.
`trace` gives Embree their rays in packets of the processor's own width: 16 with AVX-512, 8 with AVX, 4 otherwise.
Embree traces wider ones ray by ray.
"""

import ctypes
import math
import weakref
from collections.abc import Callable
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import llvmlite.ir
import numba
import numpy as np
from jaxtyping import Bool, Float32, Integer
from numba.core import types
from numba.core.ccallback import CFunc
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic

from jaxprt.compile import numba_loop
from jaxprt.programs import loops

WIDTH = 16
_NATIVE = {16: 34, 8: 33, 4: 32}  # widths of packets, and the properties that tell whether Embree traces them as such
_ROWS = 24  # RTCRayHit has 21 values for each ray
# From embree4/include/embree4/rtcore_*.h.
_ROBUST = 1 << 2
_TRIANGLES = 0
_INDEX, _VERTEX = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
COHERENT = 1 << 16
EVERY_FEATURE = 0xFFFFFFFF
_NONE = 0xFFFFFFFF  # stands for "no geometry" and "no instance"
_OUT_OF_MEMORY = 4
_ORIGINS = np.array([[-3, -1], [1, -3], [3, 1], [-1, 3]]) / 8  # places of ray origins in a pixel, from its center
_GOLDEN = 0.618  # share of all rays between two turns
_ENOUGH = 48  # rays of a packet that tell, if they agree, that others would agree with them
_POINTER, _INT, _UINT, _SIZE = ctypes.c_void_p, ctypes.c_int, ctypes.c_uint, ctypes.c_size_t
_PROTOTYPES = {
    "rtcNewDevice": (_POINTER, [ctypes.c_char_p]),
    "rtcGetDeviceProperty": (_SIZE, [_POINTER, _INT]),
    "rtcNewScene": (_POINTER, [_POINTER]),
    "rtcSetSceneFlags": (None, [_POINTER, _INT]),
    "rtcNewGeometry": (_POINTER, [_POINTER, _INT]),
    "rtcSetNewGeometryBuffer": (_POINTER, [_POINTER, _INT, _UINT, _INT, _SIZE, _SIZE]),
    "rtcSetGeometryUserData": (None, [_POINTER, _POINTER]),
    "rtcSetGeometryIntersectFilterFunction": (None, [_POINTER, _POINTER]),
    "rtcSetGeometryOccludedFilterFunction": (None, [_POINTER, _POINTER]),
    "rtcCommitGeometry": (None, [_POINTER]),
    "rtcAttachGeometry": (_UINT, [_POINTER, _POINTER]),
    "rtcReleaseGeometry": (None, [_POINTER]),
    "rtcCommitScene": (None, [_POINTER]),
    "rtcReleaseScene": (None, [_POINTER]),
    "rtcGetDeviceError": (_INT, [_POINTER]),
}
_CLOSE = 6.0  # smallest distance to a place, in radii of a disk of its area
_NEAR = 1e-3  # share of the distance to a place, before it, in which hits count as hits of the lamp itself
_QUARTERS = 4  # of a stratum
_STEP = 25  # of 64 places: about the golden ratio
_TINY = 1e-36  # smallest squared distance


class Packets:
    """An Embree scene of triangles, for shadow rays.

    Args:
        position: Vertex positions.
        face: Three vertex indices for each triangle.
    """

    def __init__(self, position: Float32[np.ndarray, "v 3"], face: Integer[np.ndarray, "f 3"]):
        embree = library()
        assert embree is not None
        self._occluded = embree.occluded
        self._scene = new_scene(self)
        attach(self._scene, position, face)
        commit(self._scene, f"{len(position)} vertices and {len(face)} triangles")
        self._context = np.full(WIDTH, _NONE, np.uint32)
        # RTCOccludedArguments: flags and features, 32 bits each; context; filter; callback.
        self._arguments = np.array([COHERENT | EVERY_FEATURE << 32, self._context.ctypes.data, 0, 0], np.uint64)

    @property
    def query(self) -> tuple[tuple[int, int], int, np.ndarray, np.ndarray, np.ndarray]:
        """Embree's function for shadow rays, the scene, the arguments, their context, and sixteen numbers.

        Filter functions multiply the number of a ray by the share of light that surfaces on it let pass. Opaque ones
        leave it as it is. Each thread needs a query of its own.
        """
        arrays = self._arguments.view(np.int64), self._context.view(np.int64)
        return self._occluded, int(self._scene), *arrays, np.ones(WIDTH, np.float32)

    def blocked(
        self,
        origin: Float32[np.ndarray, "m 3"],
        direction: Float32[np.ndarray, "d 3"],
        point: Integer[np.ndarray, " n"],
        way: Integer[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray hits a triangle. `Occluder.blocked` explains the arguments."""
        result = np.empty(len(point), np.bool_)
        _trace_blocked(self._occluded, self._scene, self._arguments.ctypes.data, origin, direction, point, way, result)
        return result


class Embree(NamedTuple):
    """The Embree library that embreex ships.

    Attributes:
        functions: The library.
        device: A device.
        occluded: Address of `rtcOccluded4`, `rtcOccluded8` or `rtcOccluded16`, and the number of rays that it takes.
        intersect: The same for `rtcIntersect4`, `rtcIntersect8` or `rtcIntersect16`.
    """

    functions: ctypes.CDLL
    device: int
    occluded: tuple[int, int]
    intersect: tuple[int, int]

    @classmethod
    def on(cls, functions: ctypes.CDLL, config: bytes | None = None) -> "Embree | None":
        """A new device; None if there is no memory for one.

        Args:
            functions: The library.
            config: Embree's options, such as `b"isa=avx2"`.
        """
        device = functions.rtcNewDevice(config)
        if device is None:
            return None
        width = next((width for width, name in _NATIVE.items() if functions.rtcGetDeviceProperty(device, name)), 4)
        queries = (getattr(functions, f"{query}{width}") for query in ("rtcOccluded", "rtcIntersect"))
        occluded, intersect = ((ctypes.cast(query, _POINTER).value or 0, width) for query in queries)
        return cls(functions, device, occluded, intersect)


def new_scene(owner: object) -> int:
    """An empty Embree scene, which is released together with an object."""
    embree = library()
    assert embree is not None
    scene = embree.functions.rtcNewScene(embree.device)
    weakref.finalize(owner, embree.functions.rtcReleaseScene, scene)
    embree.functions.rtcSetSceneFlags(scene, _ROBUST)
    return scene


def attach(
    scene: int,
    position: Float32[np.ndarray, "v 3"],
    face: Integer[np.ndarray, "f 3"],
    *,
    filter_function: int | None = None,
    data: int | None = None,
) -> None:
    """Adds triangles to an Embree scene.

    Args:
        scene: The scene.
        position: Vertex positions.
        face: Three vertex indices for each triangle.
        filter_function: Address of a function that may refuse hits.
        data: Address that this function gets.
    """
    embree = library()
    assert embree is not None
    functions = embree.functions
    geometry = functions.rtcNewGeometry(embree.device, _TRIANGLES)
    for kind, form, array in (
        (_VERTEX, _FLOAT3, np.ascontiguousarray(position, np.float32)),
        (_INDEX, _UINT3, np.ascontiguousarray(face, np.uint32)),
    ):
        buffer = functions.rtcSetNewGeometryBuffer(geometry, kind, 0, form, array.strides[0], len(array))
        if buffer is not None:
            ctypes.memmove(buffer, array.ctypes.data, array.nbytes)
    if filter_function is not None:
        functions.rtcSetGeometryUserData(geometry, data)
        functions.rtcSetGeometryIntersectFilterFunction(geometry, filter_function)
        functions.rtcSetGeometryOccludedFilterFunction(geometry, filter_function)
    functions.rtcCommitGeometry(geometry)
    functions.rtcAttachGeometry(scene, geometry)
    functions.rtcReleaseGeometry(geometry)


def commit(scene: int, content: str) -> None:
    """Builds the tree of an Embree scene.

    Args:
        scene: The scene.
        content: What it holds, for error messages.
    """
    embree = library()
    assert embree is not None
    embree.functions.rtcCommitScene(scene)
    if code := embree.functions.rtcGetDeviceError(embree.device):
        failure = MemoryError if code == _OUT_OF_MEMORY else RuntimeError
        raise failure(f"Embree failed for a scene of {content}, error code {code}")


def available() -> bool:
    """Whether embreex ships an Embree 4 library with packet tracing where this module looks for it."""
    return library() is not None


@cache
def library() -> Embree | None:
    """The Embree library; None if none can be used."""
    for file in metadata.files("embreex") or ():
        if not Path(str(file)).name.startswith(("libembree4", "embree4")):
            continue
        try:
            functions = ctypes.CDLL(str(file.locate()))
            for name, (result, arguments) in _PROTOTYPES.items():
                function = getattr(functions, name)
                function.restype, function.argtypes = result, arguments
            embree = Embree.on(functions)
        except (OSError, AttributeError):
            continue
        if embree is not None:
            return embree
    return None


@no_type_check
@intrinsic
def _call(typing, address, valid, scene, ray, arguments):
    """Calls void (*)(const int*, RTCScene, RTCRayN*, RTCOccludedArguments*), or `rtcIntersectN`, at an address."""

    def generate(context, builder, signature, values):
        byte = llvmlite.ir.IntType(8).as_pointer()
        kind = llvmlite.ir.FunctionType(llvmlite.ir.VoidType(), [byte] * 4)
        # The address is an argument, not a ctypes function, so that numba can cache the compiled code on disk.
        function = builder.inttoptr(values[0], kind.as_pointer())
        builder.call(function, [builder.inttoptr(value, byte) for value in values[1:]])
        return context.get_dummy_value()

    return types.none(*[types.intp] * 5), generate


def callback(signature: Any, function: Callable) -> Any:
    """A function that C calls, compiled by numba as `numba_loop` compiles; its address is `address`."""
    compiled = loops.keep(CFunc(function, normalize_signature(signature), {}, {}))
    compiled.compile()
    return compiled


@no_type_check  # Run-time type checks would wrap the function, and numba could not cache it on disk.
@numba_loop
def ray_buffers():
    """Memory of sixteen rays, aligned to 64 bytes: rows of sixteen values, which rays are valid, and of one packet.

    The packet always has room for RTCRayHit, also where the function takes RTCRay, which has 12 values for each ray.
    For a width that is not native to the processor Embree's `rtcOccluded16` reads and writes back all 21: with room for
    12 it undoes what other threads have written behind them meanwhile.
    """
    memory = np.empty(2 * (_ROWS + 1) * 16 + 16, np.float32)
    first = (-memory.ctypes.data // 4) % 16
    ray = memory[first : first + _ROWS * 16].reshape(_ROWS, 16)
    valid = memory[first + _ROWS * 16 : first + (_ROWS + 1) * 16].view(np.int32)
    return ray, valid, memory[first + (_ROWS + 1) * 16 : first + 2 * (_ROWS + 1) * 16]


@no_type_check
@numba_loop
def trace(entry, scene, arguments, buffers, rows):
    """Traces the valid ones of sixteen rays.

    Args:
        entry: Address of one of Embree's functions, and the number of rays that it takes.
        scene: The scene.
        arguments: Address of the function's arguments.
        buffers: The rays, from `ray_buffers`.
        rows: Number of values of each ray: 12 for RTCRay, 24 for RTCRayHit.
    """
    address, width = entry
    ray, valid, packet = buffers
    if width == 16:
        _call(address, valid.ctypes.data, scene, ray.ctypes.data, arguments)
    elif width == 8:
        _trace_parts(address, scene, arguments, ray, valid, packet, rows, 8)
    else:
        _trace_parts(address, scene, arguments, ray, valid, packet, rows, 4)


@no_type_check
@numba.njit(inline="always")
def _trace_parts(address, scene, arguments, ray, valid, packet, rows, width):
    chosen = packet[_ROWS * width :].view(np.int32)
    for first in range(0, 16, width):
        some = 0
        for lane in range(width):
            chosen[lane] = valid[first + lane]
            some |= chosen[lane]
        if some == 0:
            continue
        for row in range(rows):
            for lane in range(width):
                packet[row * width + lane] = ray[row, first + lane]
        _call(address, chosen.ctypes.data, scene, packet.ctypes.data, arguments)
        for row in range(8, rows):  # before it stand the origin and the direction
            for lane in range(width):
                ray[row, first + lane] = packet[row * width + lane]


@no_type_check
@numba_loop
def _trace_blocked(entry, scene, arguments, origin, direction, point, way, result):
    buffers = ray_buffers()
    ray, valid, _ = buffers
    for packet in range(0, len(point), 16):
        count = min(16, len(point) - packet)
        for lane in range(16):
            at = packet + min(lane, count - 1)
            valid[lane] = -1 if lane < count else 0
            for axis in range(3):
                ray[axis, lane] = origin[point[at], axis]
                ray[4 + axis, lane] = direction[way[at], axis]
        whole_ray(ray)
        trace(entry, scene, arguments, buffers, 12)
        for lane in range(count):
            result[packet + lane] = ray[8, lane] < 0


@no_type_check
@numba_loop
def start(surface, points, point, lane, origin, facing):
    """Places of a lane's ray origins in a pixel, and the unit normal of its triangle on the side of the shading normal.

    The normal is zero in padding and for triangles without an area, which have no side to start from.
    """
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
    for place in range(4):
        right, down = _ORIGINS[place, 0], _ORIGINS[place, 1]
        first = max(barycentric[point, 0] + right * slope[point, 0, 0] + down * slope[point, 1, 0], 0.0)
        second = max(barycentric[point, 1] + right * slope[point, 0, 1] + down * slope[point, 1, 1], 0.0)
        third = max(barycentric[point, 2] + right * slope[point, 0, 2] + down * slope[point, 1, 2], 0.0)
        whole = max(first + second + third, 1e-30)
        for axis in range(3):
            on_triangle = (first * position[a, axis] + second * position[b, axis] + third * position[c, axis]) / whole
            origin[place, axis, lane] = on_triangle + offset[number] * facing[axis, lane]


@no_type_check
@numba_loop
def _edge_vector(position, first, last):
    """The vector from one vertex to another in float64."""
    return (
        np.float64(position[last, 0]) - np.float64(position[first, 0]),
        np.float64(position[last, 1]) - np.float64(position[first, 1]),
        np.float64(position[last, 2]) - np.float64(position[first, 2]),
    )


@no_type_check
@numba_loop
def trace_shares(query, surface, points, texels, first, last, share):
    """Visible shares of texels at points of a picture; `jaxprt.visibility.picture_rays.shares` explains the method.

    Args:
        query: What packets of rays need; see `Packets.query`.
        surface: Positions and normals of vertices, triangles, and the distance from each at which rays start.
        points: Triangle, barycentric coordinates, their slopes, and the number in the dither pattern of each point.
        texels: Directions of the places in each texel, of its middle, number of rays, and first place.
        first: Index of the first point.
        last: Index after the last point.
        share: The result, in 255ths [t, p].
    """
    entry, scene, arguments, _, passed = query
    pattern = points[3]
    direction, middle, count, shift = texels
    strata = direction.shape[1]
    buffers = ray_buffers()
    ray, valid, _ = buffers
    origin, facing = np.zeros((4, 3, 16), np.float32), np.zeros((3, 16), np.float32)
    above, visible = np.empty(16, np.bool_), np.empty(16)
    step = np.empty(len(count), np.int64)  # between turns, so that the first ones are spread over the texel
    for texel in range(len(count)):
        step[texel] = max(1, int(_GOLDEN * count[texel]))
        while np.gcd(step[texel], count[texel]) > 1:
            step[texel] += 1
    for packet in range(first, last, 16):
        lanes = min(16, last - packet)
        for lane in range(lanes):
            start(surface, points, packet + lane, lane, origin, facing)
        for texel in range(len(count)):
            visible[:] = 0
            for lane in range(16):
                way = middle[texel]
                cosine = facing[0, lane] * way[0] + facing[1, lane] * way[1] + facing[2, lane] * way[2]
                above[lane] = lane < lanes and cosine > 0
            traced = 0
            while traced < count[texel] and above.any():
                if 4 * traced >= count[texel] and _agree(above, visible, traced):
                    break
                turn = traced * step[texel] % count[texel]
                for lane in range(16):
                    here = min(lane, lanes - 1)
                    base = pattern[packet + here]
                    stratum = ((base + turn * strata) // count[texel] + shift[texel]) % strata
                    place = (base // 4 + base + texel + turn) % 4
                    valid[lane] = -1 if above[lane] else 0
                    for axis in range(3):
                        ray[axis, lane] = origin[place, axis, here]
                        ray[4 + axis, lane] = direction[texel, stratum, axis]
                whole_ray(ray)
                passed[:] = 1.0
                trace(entry, scene, arguments.ctypes.data, buffers, 12)
                for lane in range(lanes):
                    visible[lane] += passed[lane] if above[lane] and ray[8, lane] > 0 else 0.0
                traced += 1
            for lane in range(lanes):
                share[texel, packet + lane] = np.uint8(np.floor(255 * visible[lane] / max(traced, 1) + 0.5))


@no_type_check
@numba_loop
def _agree(above, visible, traced):
    """Whether enough rays have been traced, and all of all points have passed, or none."""
    clear, count = 0.0, 0
    for lane in range(16):
        if above[lane]:
            clear += visible[lane]
            count += traced
    return count >= _ENOUGH and (clear == 0 or clear == count)


@no_type_check
@numba_loop
def begin(ray, lane, slot, far):
    """Sets the fields of a ray besides its origin and direction.

    Args:
        ray: The packet.
        lane: Index of the ray in the packet.
        slot: Number of the ray, for filter functions.
        far: Where the ray ends; Embree sets it to minus infinity after a hit.
    """
    number = ray.view(np.uint32)
    ray[3, lane] = 0.0  # near
    ray[7, lane] = 0.0  # time
    ray[8, lane] = far
    number[9, lane] = 0xFFFFFFFF  # mask
    number[10, lane] = slot
    number[11, lane] = 0  # flags


@no_type_check
@numba_loop
def whole_ray(ray):
    """Sets these fields of sixteen rays without an end, which are numbered by their place in the packet."""
    for lane in range(16):
        begin(ray, lane, lane, 1e37)


@no_type_check  # Run-time type checks would wrap the function, and numba could not cache it on disk.
@partial(numba_loop, error_model="numpy")  # Checks of divisors would keep the loop over lanes from being vectorized.
def _sums(place, area, begin, count, center, normal, least, total, room):
    """Adds integrals of places of one piece to `total`, for sixteen points; False if a point is too close to one."""
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
            # The integrals are of 1 and of the direction, over the solid angle above the horizon of the normal.
            total[0, lane] += solid
            total[1, lane] += along * dx
            total[2, lane] += along * dy
            total[3, lane] += along * dz
            room[lane] = min(room[lane], square - close)
    return room.min() >= 0


@no_type_check
@numba_loop
def _lit_share(lamp, lamps, center, normal, least, total, room):
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
@partial(numba_loop, error_model="numpy")
def _cast(query, memory, lamps, aim, origin, sight, weight, free):
    """Traces one ray of each of sixteen points, to its own place on a lamp; the number of rays, and of free ones."""
    number, spot, piece = aim
    entry, scene, arguments, _, passed = query
    buffers, cosine, goal = memory
    ray, valid, _ = buffers
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
        trace(entry, scene, arguments.ctypes.data, buffers, 12)
    rays, open_ = 0, 0
    for lane in range(16):
        seen = valid[lane] != 0 and ray[8, lane] > zero
        weight[piece[lane], lane] += cosine[lane]  # irradiance from each place
        free[piece[lane], lane] += cosine[lane] * passed[lane] if seen else zero  # that from visible places
        rays += 1 if cosine[lane] > zero else 0
        open_ += 1 if seen else 0
    return rays, open_


@no_type_check
@numba_loop
def _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free):
    """Replaces `free` by the visible share of each piece of a lamp at sixteen points."""
    first, count, pieces, strata = lamps[2][lamp, -1], lamps[3][lamp, -1], lamps[4][lamp], lamps[5][lamp]
    weight[:], free[:] = 0, 0
    number, spot, piece = np.empty(16, np.int64), np.empty(16, np.int64), np.empty(16, np.int64)
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
                # With other places in the next part, edges of shadows meet all places one after another.
                within = (2 * (base + _STEP * cell + 37 * lamp & 63) + 1) * width >> 7
                number[lane] = first + cell * width + within
                spot[lane] = (base >> 2) + base + corner + turn & 3
                piece[lane] = cell * pieces // (strata * _QUARTERS)
            new = _cast(query, memory, lamps, (number, spot, piece), origin, sight, weight, free)
            rays, open_ = rays + new[0], open_ + new[1]
    for lane in range(16):
        whole = weight[:, lane].sum()
        mean = free[:, lane].sum() / whole if whole > 0 else 0.0
        for part in range(pieces):
            sent = weight[part, lane]
            free[part, lane] = free[part, lane] / sent if sent > 0 else mean


@no_type_check
@numba_loop
def _light_point(surface, points, fields, packet, lanes, origin, sight, pattern):
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
@numba_loop
def trace_lamps(query, surface, points, fields, lamps, first, last, result):
    """Integrals of the visible parts of lamps at some points; see `jaxprt.visibility.picture_rays.moments`.

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
    memory = ray_buffers(), np.zeros(16, np.float32), np.zeros((6, 16), np.float32)
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
            _lit_share(lamp, lamps, center, normal, least, total, room)
            lit = total[:count, 0].max() > 0
            if lit:
                _visible(query, memory, lamp, lamps, pattern, origin, sight, total, weight, free)
            else:
                free[:] = 0
            for piece in range(count):
                _write(total[piece], free[piece], normal, row + piece, packet, lanes, result)
            row += count


@no_type_check
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
