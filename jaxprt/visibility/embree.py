"""The Embree library that embreex ships: scenes of triangles, and rays in packets.

embreex traces rays one at a time. Rays with nearby origins and similar directions visit the same nodes of Embree's BVH.
Traced as a packet they are faster and give identical results.

Loops fill sixteen rays at a time. `trace` gives them to Embree in packets of the processor's own width: 16 with
AVX-512, 8 with AVX, 4 otherwise. Embree traces wider ones ray by ray.
"""

import ctypes
import inspect
import weakref
from collections.abc import Callable
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple, no_type_check

import llvmlite.ir
import numpy as np
from jaxtyping import Float32, Integer
from numba.core import types
from numba.core.ccallback import CFunc
from numba.core.sigutils import normalize_signature
from numba.extending import intrinsic

from jaxprt.compile import numba_loop
from jaxprt.programs import loops

WIDTH = 16
_NATIVE = {16: 34, 8: 33, 4: 32}  # widths of packets, and the properties that tell whether Embree traces them as such
# From embree4/include/embree4/rtcore_*.h. Rows of RTCRayHit, with one value for each ray; RTCRay ends before NORMAL.
ORIGIN, DIRECTION, FAR, MASK, ID = 0, 4, 8, 9, 10
NORMAL, U, V, PRIMITIVE, GEOMETRY = 12, 15, 16, 17, 18
RAY, RAY_HIT = 12, 21  # numbers of rows
NONE = 0xFFFFFFFF  # stands for "no geometry" and "no instance"
ENDLESS = 1e37  # where rays without an end stop
_ROWS = 24  # rows that rays have room for
_ROBUST = 1 << 2
_TRIANGLES = 0
_INDEX, _VERTEX = 0, 1
_UINT3, _FLOAT3 = 0x5003, 0x9003
_COHERENT, _EVERY_FEATURE = 1 << 16, 0xFFFFFFFF
_OUT_OF_MEMORY = 4
# RTCOccludedArguments and RTCIntersectArguments.
_ARGUMENTS = np.dtype([("flags", "u4"), ("features", "u4"), ("context", "u8"), ("filter", "u8"), ("callback", "u8")])
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


@cache
def library() -> Embree | None:
    """The Embree 4 library with packets of rays; None where embreex ships none, or not where this module looks."""
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


class Triangles:
    """An Embree scene of triangles, which is released together with this object.

    Args:
        embree: The library.
    """

    def __init__(self, embree: Embree):
        self._embree = embree
        self._scene = embree.functions.rtcNewScene(embree.device)
        weakref.finalize(self, embree.functions.rtcReleaseScene, self._scene)
        embree.functions.rtcSetSceneFlags(self._scene, _ROBUST)

    def attach(
        self,
        position: Float32[np.ndarray, "v 3"],
        face: Integer[np.ndarray, "f 3"],
        *,
        hit_filter: int | None = None,
        data: int | None = None,
    ) -> None:
        """Adds triangles.

        Args:
            position: Vertex positions.
            face: Three vertex indices for each triangle.
            hit_filter: Address of a function that may refuse hits.
            data: Address that this function gets.
        """
        functions = self._embree.functions
        geometry = functions.rtcNewGeometry(self._embree.device, _TRIANGLES)
        for kind, form, array in (
            (_VERTEX, _FLOAT3, np.ascontiguousarray(position, np.float32)),
            (_INDEX, _UINT3, np.ascontiguousarray(face, np.uint32)),
        ):
            buffer = functions.rtcSetNewGeometryBuffer(geometry, kind, 0, form, array.strides[0], len(array))
            if buffer is not None:
                ctypes.memmove(buffer, array.ctypes.data, array.nbytes)
        if hit_filter is not None:
            functions.rtcSetGeometryUserData(geometry, data)
            functions.rtcSetGeometryIntersectFilterFunction(geometry, hit_filter)
            functions.rtcSetGeometryOccludedFilterFunction(geometry, hit_filter)
        functions.rtcCommitGeometry(geometry)
        functions.rtcAttachGeometry(self._scene, geometry)
        functions.rtcReleaseGeometry(geometry)

    def commit(self, content: str) -> None:
        """Builds the tree.

        Args:
            content: What the scene holds, for error messages.
        """
        self._embree.functions.rtcCommitScene(self._scene)
        if code := self._embree.functions.rtcGetDeviceError(self._embree.device):
            failure = MemoryError if code == _OUT_OF_MEMORY else RuntimeError
            raise failure(f"Embree failed for a scene of {content}, error code {code}")

    def rays(self, context: np.ndarray, share: Float32[np.ndarray, " n"], *, hits: bool, coherent: bool) -> tuple:
        """What loops need to trace rays: sixteen rays, which of them are valid, `share`, and the arguments of Embree.

        Each thread needs rays of its own.

        Args:
            context: RTCRayQueryContext, and what filter functions read behind it.
            share: The array in which filter functions note the shares of light that pass.
            hits: Whether rays find what they hit, and not only whether they hit something.
            coherent: Whether the directions of sixteen rays are similar.
        """
        function = self._embree.intersect if hits else self._embree.occluded
        arguments = np.array((_COHERENT * coherent, _EVERY_FEATURE, context.ctypes.data, 0, 0), _ARGUMENTS)
        ray, valid, packet = ray_buffers()
        return ray, valid, share, (*function, int(self._scene), arguments, context, packet)


def ray_buffers() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Memory of sixteen rays, aligned to 64 bytes: rows of sixteen values, which rays are valid, and of one packet.

    The packet always has room for RTCRayHit, also where the function takes RTCRay. For a width that is not native to
    the processor Embree's `rtcOccluded16` reads and writes back all of its rows: with room for RTCRay alone it undoes
    what other threads have written behind them meanwhile.
    """
    memory = np.zeros((2 * (_ROWS + 1) + 1) * WIDTH, np.float32)
    first = -memory.ctypes.data // 4 % WIDTH
    ray, packet = memory[first : first + 2 * (_ROWS + 1) * WIDTH].reshape(2, _ROWS + 1, WIDTH)
    number = ray.view(np.uint32)
    number[MASK], number[ID], number[PRIMITIVE:_ROWS] = NONE, np.arange(WIDTH), NONE
    return ray[:_ROWS], ray[_ROWS].view(np.int32), packet.reshape(-1)


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


@no_type_check
@intrinsic
def pointer(typing, address):
    """An integer as a pointer."""

    def generate(context, builder, signature, values):
        return builder.inttoptr(values[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


def callback(signature: Any, function: Callable) -> Any:
    """A function that C calls, compiled by numba as `numba_loop` compiles; its address is `address`."""
    compiled = loops.keep(CFunc(inspect.unwrap(function), normalize_signature(signature), {}, {}))
    compiled.compile()
    return compiled


@numba_loop
def trace(query, rows):
    """Traces the valid ones of sixteen rays, from `Triangles.rays`, which have `RAY` or `RAY_HIT` rows."""
    ray, valid, _, (address, width, scene, arguments, _, _) = query
    if width == 16:
        _call(address, valid.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)  # pyright: ignore[reportCallIssue]
    elif width == 8:
        _trace_parts(query, rows, 8)
    else:
        _trace_parts(query, rows, 4)


@partial(numba_loop, inline="always")  # so that the width is a constant
def _trace_parts(query, rows, width):
    ray, valid, _, (address, _, scene, arguments, _, packet) = query
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
        _call(address, chosen.ctypes.data, scene, packet.ctypes.data, arguments.ctypes.data)  # pyright: ignore[reportCallIssue]
        for row in range(FAR, rows):  # before it stand the origin and the direction
            for lane in range(width):
                ray[row, first + lane] = packet[row * width + lane]
