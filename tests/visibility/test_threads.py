"""Rays from several threads change no memory of others, and give the bits of one thread, on each instruction set."""

import ctypes
import re
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import embreex
import numpy as np
import pytest

from jaxprt import visibility
from jaxprt.scene import Part, Scene, TexturedMaterial
from jaxprt.scene.mesh import make_mesh
from jaxprt.visibility import Occluder, blocks, embree, picture_rays, rays
from jaxprt.visibility.picture_rays import LampPlaces, PicturePoints, TexelRays

COUNT = 4000  # rays of each path
PATHS = ("blocked", "stopped", "passed", "hit", "layers", "shares", "lamps", "visibility")
SETS = ("sse2", "avx", "avx512")
LENGTH = 0.7  # seconds of rays for each path; in version 0.3 twice that left 72 to 96 values wrong on most paths
ROUNDED = 1e-4  # share of rays that pass an edge on its other side where products and sums are rounded apart


def soup(count: int, low: float, high: float):
    """Random small triangles between two heights."""
    random = np.random.default_rng(count)
    center = random.uniform([-1, low, -1], [1, high, 1], (count, 1, 3))
    corner = center + random.uniform(-0.1, 0.1, (count, 3, 3))
    return make_mesh(corner.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def tracers() -> dict[str, Callable[[], bytes]]:
    """The ways to trace rays, each as a function that gives the bytes of its results."""
    stone, glass = soup(1500, 0.2, 0.6), soup(300, 0.7, 0.9)
    alpha = TexturedMaterial(alpha=0.4, alpha_mode="blend")
    mixed = Scene([Part("stone", stone, TexturedMaterial()), Part("glass", glass, alpha)]).mesh
    opaque, clear = Occluder(stone), Occluder(mixed)
    random = np.random.default_rng(0)
    origin = random.uniform([-1, 0, -1], [1, 0.1, 1], (COUNT, 3)).astype(np.float32)
    way = random.normal(size=(COUNT, 3)).astype(np.float32)
    way[:, 1] = np.abs(way[:, 1])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    index, far = np.arange(COUNT), np.full(COUNT, 1e30, np.float32)
    triangle = index % len(stone.face)
    points = PicturePoints(triangle, random.dirichlet([1, 1, 1], COUNT), np.zeros((COUNT, 2, 3)), *np.divmod(index, 64))
    texel = TexelRays(np.repeat(way[:2, None], picture_rays.PLACES, 1), np.array([16, 16]))
    position = np.einsum("pk,pki->pi", points.barycentric, np.asarray(stone.position)[np.asarray(stone.face)[triangle]])
    bulb = LampPlaces(
        np.array([[0.1, 3, 0]], np.float32),
        np.zeros((1, 3), np.float32),
        *np.array([[[0]], [[1]]]),
        *np.array([[1], [4]]),
    )
    normal = np.asarray(stone.normal)[np.asarray(stone.face)[triangle, 0]]
    start = visibility.start_points(stone, opaque)[:64]

    def flat(*arrays: np.ndarray) -> bytes:
        return b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)

    return {
        "blocked": lambda: flat(opaque.blocked(origin, way, index, index)),
        "stopped": lambda: flat(clear.blocked(origin, way, index, index)),
        "passed": lambda: flat(clear.passed(origin, way, index, index)),
        "hit": lambda: flat(*clear.hit(origin, way)),
        "layers": lambda: flat(*clear.translucent.layers(origin[0], way, far, np.zeros(len(mixed.face), bool))),
        "shares": lambda: flat(picture_rays.shares(picture_rays.triangles(mixed), clear, points, texel)),
        "lamps": lambda: flat(
            *picture_rays.moments(picture_rays.triangles(stone), opaque, points, position, normal, bulb)
        ),
        "visibility": lambda: flat(rays.fractional(opaque, start, np.asarray(stone.normal)[:64], size=16)[0]),
    }


def library(config: str, width: int | None = None) -> embree.Embree:
    """The library with a device for an instruction set, and with packets of a width that it may not trace as such."""
    installed = embree.library()
    assert installed is not None
    found = embree.Embree.on(installed.functions, config.encode())
    if found is None:
        pytest.skip(f"this processor has not what {config} asks for")
    if width is None:
        return found
    named = {"occluded": f"rtcOccluded{width}", "intersect": f"rtcIntersect{width}"}
    query = {
        field: (ctypes.cast(getattr(installed.functions, name), ctypes.c_void_p).value, width)
        for field, name in named.items()
    }
    return found._replace(**query)


class Inline(ThreadPoolExecutor):
    """Does everything in the thread that asks for it."""

    def submit(self, function, /, *arguments, **options):
        done = Future()
        done.set_result(function(*arguments, **options))
        return done


def undone_writes(trace: Callable[[], bytes], seconds: float) -> int:
    """Number of values that this thread counts up while another one traces rays, and that are not what they should be.

    They stand in the tracing thread's part of the heap, between holes of about the size that memory for rays has.
    """
    ready, stop, kept = threading.Event(), time.monotonic() + seconds, []

    def work() -> None:
        array = [np.zeros(size // 4, np.uint32) for size in (960, 976, 992, 1760, 3200) for _ in range(400)]
        kept.extend(array[::2])
        del array
        ready.set()
        while time.monotonic() < stop:
            trace()

    thread = threading.Thread(target=work)
    thread.start()
    ready.wait()
    turns = 0
    while thread.is_alive():
        for values in kept:
            values += 1
        turns += 1
    thread.join()
    return sum(int(np.count_nonzero(values != turns)) for values in kept)


@pytest.mark.parametrize("packet", ["the processor's own", "ray by ray"])
def test_tracing_undoes_no_writes_of_another_thread(packet, monkeypatch):
    monkeypatch.setattr(picture_rays, "ThreadPoolExecutor", Inline)
    if packet == "ray by ray":  # what Embree does where 16 rays are no packet of the processor
        other = library("isa=avx2", 16)
        monkeypatch.setattr(embree, "library", lambda: other)
    interval = sys.getswitchinterval()
    try:
        sys.setswitchinterval(1e-4)
        lost = {name: undone_writes(trace, LENGTH) for name, trace in tracers().items()}
    finally:
        sys.setswitchinterval(interval)
    assert lost == dict.fromkeys(PATHS, 0)


def test_memory_for_rays_holds_all_that_embree_writes():
    ray, valid, packet = embree.ray_buffers()
    assert packet.nbytes >= 16 * 21 * 4 + 16 * 4  # RTCRayHit16 and which rays are valid
    assert ray.nbytes >= 16 * 21 * 4
    assert all(array.ctypes.data % 64 == 0 for array in (ray, valid, packet))


def test_rows_of_rays_are_those_of_the_declarations_that_embreex_ships():
    text = (Path(embreex.__file__).parent / "rtcore_ray.pxd").read_text()
    order = re.findall(r"(?:float|unsigned int) (\w+)", text)  # RTCRay, then RTCHit
    names = ["org_x", "dir_x", "tfar", "mask", "id", "Ng_x", "u", "v", "primID", "geomID"]
    rows = [embree.ORIGIN, embree.DIRECTION, embree.FAR, embree.MASK, embree.ID]
    rows += [embree.NORMAL, embree.U, embree.V, embree.PRIMITIVE, embree.GEOMETRY]
    assert [order.index(name) for name in names] == rows


def run_beside(trace: dict[str, Callable[[], bytes]], threads: int, seconds: float) -> list[dict[str, bytes]]:
    """Results of each path from several threads, while another one does arithmetic with arrays."""
    stop = threading.Event()

    def churn() -> None:
        random = np.random.default_rng(0)
        while not stop.is_set():
            rows = int(random.integers(1, 400))
            values = np.ones((rows, 192)).reshape(-1, 2, 96) @ np.ones((96, 49))
            assert values.shape == (rows, 2, 49)

    def work(number: int) -> list[dict[str, bytes]]:
        end, found = time.monotonic() + seconds, []
        while not found or time.monotonic() < end:
            found.append({name: trace[name]() for name in np.roll(list(trace), number)})
            if found[-1] == found[0]:
                del found[1:]
        return found

    beside = threading.Thread(target=churn)
    beside.start()
    try:
        with ThreadPoolExecutor(threads) as pool:
            return [result for found in pool.map(work, range(threads)) for result in found]
    finally:
        stop.set()
        beside.join()


@pytest.mark.parametrize("threads", [1, 8])
def test_rays_of_several_threads_are_those_of_one(threads, monkeypatch):
    trace = tracers()
    monkeypatch.setattr(blocks, "cores", lambda: 1)
    alone = {name: function() for name, function in trace.items()}
    monkeypatch.setattr(blocks, "cores", lambda: threads)
    assert all(found == alone for found in run_beside(trace, threads, seconds=0.5))


def test_stored_visibility_does_not_depend_on_the_number_of_threads(monkeypatch):
    mesh, found = soup(200, 0.2, 0.6), []
    for threads in (1, 8):
        monkeypatch.setattr(blocks, "cores", lambda threads=threads: threads)
        found.append(np.asarray(visibility.precompute(mesh, size=8).level).tobytes())
    assert found[0] == found[1]


@pytest.mark.parametrize("name", SETS)
def test_instruction_sets_see_the_same(name, monkeypatch):
    alone = {name: function() for name, function in tracers().items()}
    other = library(f"isa={name}")
    monkeypatch.setattr(embree, "library", lambda: other)
    found = {name: function() for name, function in tracers().items()}
    for path, kind in {"blocked": np.uint8, "visibility": np.uint8, "shares": np.uint8, "passed": np.float32}.items():
        other, own = (np.frombuffer(side[path], kind) for side in (found, alone))
        assert np.mean(~np.isclose(other, own, rtol=1e-5, atol=0)) <= ROUNDED, path


@pytest.mark.long
def test_ten_minutes_of_rays_from_more_threads_than_cores_are_those_of_one():
    trace = tracers()
    alone = {name: function() for name, function in trace.items()}
    assert all(found == alone for found in run_beside(trace, 2 * blocks.cores() + 6, seconds=600))
