"""The block loop: the same bits from every executor, after every accident."""

import json
import os
import resource
import signal
import subprocess
import sys
import weakref
import zlib
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from benchmarks.published import interreflection
from jaxprt import bounces, harmonic, lobe, separable, visibility
from jaxprt.files.arrays import BlockStore, Layout
from jaxprt.scene.mesh import join, make_mesh
from jaxprt.systems.separable import precompute
from jaxprt.visibility import Shard, UnfinishedError

SIZE = 4  # Vertices to a block.


@dataclass(frozen=True)
class Squares(visibility.blocks.Job):
    """Numbers that depend on the vertex; may kill the process that computes a block, once."""

    vertices: int = 30
    name: str = "squares"
    trap: str | None = None  # A file; who meets it at block 3 removes it and dies.

    @property
    def header(self):
        return {"name": self.name, "vertices": self.vertices}

    @property
    def layout(self):
        return {"index": Layout((2, SIZE, 3), 1, "uint16"), "value": Layout((2, SIZE), 1, "float32")}

    def run(self, block):
        if block == 3 and self.trap and os.path.exists(self.trap):
            os.unlink(self.trap)
            os.kill(os.getpid(), signal.SIGKILL)
        vertex = np.arange(block * SIZE, (block + 1) * SIZE)
        index = (vertex[None, :, None] * [[[7]], [[11]]] + np.arange(3)).astype(np.uint16)
        return {"index": index, "value": np.sqrt(vertex + np.array([[1.0], [2.0]])).astype(np.float32)}, 10

    def expected(self):
        vertex = np.arange(self.vertices)
        index = (vertex[None, :, None] * [[[7]], [[11]]] + np.arange(3)).astype(np.uint16)
        return {"index": index, "value": np.sqrt(vertex + np.array([[1.0], [2.0]])).astype(np.float32)}


@dataclass(frozen=True)
class Counting(Squares):
    """Notes which blocks were computed, in this process."""

    log: list = field(default_factory=list)

    def run(self, block):
        self.log.append(block)
        return super().run(block)


def check(result, job=None):
    job = job or Squares()
    for name, expected in job.expected().items():
        np.testing.assert_array_equal(result[name], expected)
        assert result[name].dtype == expected.dtype


def finished(path):
    checksum = (path / "checksum.npy").read_bytes()[128:]
    return np.flatnonzero(np.frombuffer(checksum, np.uint32)).tolist()


@pytest.fixture(scope="module")
def pool():
    """Two processes that do not share this one's memory."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        yield pool


@pytest.fixture(scope="module")
def sphere():
    """A mesh of three blocks, and a BRDF for it."""
    brdf = prt.separable.factor(prt.brdf.AshikhminShirley(), terms=2, resolution=8)
    return prt.scene.builtin.sphere(rings=12, sectors=14), brdf


def relit(sphere, **options):
    mesh, brdf = sphere
    transport = precompute(mesh, brdf, **({"keep": 12, "size": 8} | options))
    return [np.asarray(each) for each in (transport.index, transport.value, transport.rms, transport.frame)]


@pytest.fixture(scope="module")
def expected(sphere):
    return relit(sphere)


def same(first, second):
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("vertices", [1, 4, 30])
def test_results_are_cut_to_the_vertices(vertices):
    job = Squares(vertices)
    check(visibility.blocks.compute(job, prt.Run()), job)


def test_a_progress_bar_ends_full_and_tells_the_rays(capsys):
    visibility.blocks.compute(Squares(), prt.Run(), label="squares")
    told = capsys.readouterr().err
    assert "squares: 100%" in told
    assert "30.0/30.0" in told
    assert "Mrays/s" in told


def test_threads_and_processes_give_the_same_bits_as_none(sphere, expected, pool, tmp_path):
    with ThreadPoolExecutor(3) as threads:
        same(relit(sphere, run=prt.Run(executor=threads)), expected)
    same(relit(sphere, run=prt.Run(tmp_path / "a.prt", pool)), expected)
    same(relit(sphere, run=prt.Run(tmp_path / "a.prt")), expected)
    check(visibility.blocks.compute(Squares(), prt.Run(executor=pool)))


@pytest.mark.parametrize("stored", [True, False])
def test_a_killed_worker_process_is_told_and_a_second_call_goes_on(tmp_path, stored):
    trap, path = tmp_path / "trap", tmp_path / "a.prt" if stored else None
    trap.touch()
    job = Squares(trap=str(trap))
    message = r"a worker died after \d+ of 30 vertices; they are kept in .*a\.prt: call again" if stored else "lost"
    with (
        ProcessPoolExecutor(1, mp_context=get_context("spawn")) as mortal,
        pytest.raises(RuntimeError, match=message),
    ):
        visibility.blocks.compute(job, prt.Run(path, mortal))
    assert not trap.exists()
    check(visibility.blocks.compute(job, prt.Run(path)))


def test_two_parts_write_at_once_and_the_same_part_twice_is_refused(tmp_path):
    job, path = Counting(), tmp_path / "a.prt"
    store = BlockStore(path, job.header, job.layout, 8)
    with store.writing((2, 3)), Shard(1, 3) as one, Shard(2, 3) as two, Shard(1, 2) as half:
        with pytest.raises(UnfinishedError):
            visibility.blocks.compute(job, prt.Run(path, one))
        for executor in (two, half, None):
            with pytest.raises(BlockingIOError, match=r"a\.prt is being written by another process"):
                visibility.blocks.compute(job, prt.Run(path, executor))
    assert sorted(job.log) == [0, 1]
    for number, count in ((0, 4), (5, 4), (1, 0), (-1, -1)):
        with pytest.raises(ValueError, match=f"the part must be from 1/.*, got {number}/{count}"):
            Shard(number, count)
    with Shard(1, 2) as part, pytest.raises(ValueError, match="part 1/2 must have a path"):
        prt.Run(executor=part)


def test_parts_in_any_order_make_the_whole_and_the_last_of_them_returns_it(tmp_path):
    path, log = tmp_path / "a.prt", []
    for number, left in ((2, 5), (3, 2)):
        with (
            Shard(number, 3) as part,
            pytest.raises(UnfinishedError, match=rf"part {number}/3 .*; {left} of its 8 blocks"),
        ):
            visibility.blocks.compute(Counting(log=log), prt.Run(path, part))
    with Shard(1, 3) as part:
        check(visibility.blocks.compute(Counting(log=log), prt.Run(path, part)))
    assert sorted(log) == list(range(8))
    assert [list(Shard(number, 3).of(8)) for number in (1, 2, 3)] == [[0, 1], [2, 3, 4], [5, 6, 7]]


class Slow(ThreadPoolExecutor):
    """Counts the blocks that are on their way."""

    most = now = 0

    def submit(self, *arguments, **options):
        self.now += 1
        self.most = max(self.most, self.now)
        future = super().submit(*arguments, **options)
        future.add_done_callback(lambda _: setattr(self, "now", self.now - 1))
        return future


@pytest.mark.parametrize("stored", [True, False])
def test_blocks_on_their_way_are_few_and_dropped_when_they_have_arrived(tmp_path, monkeypatch, stored):
    living, most = [0], [0]

    class Traced(Squares):
        def run(self, block):
            array, count = super().run(block)
            living[0] += 1
            most[0] = max(most[0], living[0])
            weakref.finalize(array["index"], lambda: living.__setitem__(0, living[0] - 1))
            return array, count

    monkeypatch.setattr(visibility.blocks, "_HELD", 1)
    job = Traced(vertices=400)
    with Slow(1) as executor:
        path = tmp_path / "a.prt" if stored else None
        check(visibility.blocks.compute(job, prt.Run(path, executor)), job)
        assert executor.most <= 2 * visibility.blocks.cores()
    assert 0 < most[0] <= 2 * visibility.blocks.cores() + 2


def test_workers_write_their_blocks_themselves_where_they_see_the_folder(tmp_path, monkeypatch, pool):
    path = tmp_path / "a.prt"

    def write(*_):
        raise AssertionError("the workers should have written this block")

    monkeypatch.setattr(BlockStore, "write", write)
    check(visibility.blocks.compute(Squares(), prt.Run(path, pool)))
    monkeypatch.undo()
    # Workers that see another folder, or none, send their blocks.
    monkeypatch.setattr(BlockStore, "__getstate__", lambda self: {**vars(self), "_key": "another"}, raising=False)
    check(visibility.blocks.compute(Squares(), prt.Run(tmp_path / "b.prt", pool)))


def test_a_full_disk_is_told_and_a_second_call_goes_on(tmp_path):
    path, job = tmp_path / "a.prt", Squares(name="full", vertices=4000)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"a\.prt cannot grow \(.*\); finished blocks are kept: call again"):
            visibility.blocks.compute(job, prt.Run(path))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    kept = finished(path)
    assert 100 < len(kept) < 1000
    again = Counting(name="full", vertices=4000)
    check(visibility.blocks.compute(again, prt.Run(path)), job)
    assert sorted({*again.log, *kept}) == list(range(1000))
    assert len(again.log) == 1000 - len(kept)


# Forks before any thread of JAX runs, so that many deaths cost one start of Python.
MOMENTS = """
import os, signal, sys, time
from jaxprt.files import arrays
from jaxprt.files.arrays import BlockStore
from tests.visibility.test_blocks import Squares
from jaxprt.visibility import blocks

path, kind = sys.argv[1:3]
for moment in map(float, sys.argv[3:]):
    child = os.fork()
    if not child:
        if kind == "time":
            signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
            signal.setitimer(signal.ITIMER_REAL, moment)
        else:
            calls = [0]
            owner, name = {"write": (BlockStore, "_put"), "create": (arrays, "write_header")}[kind]
            original = getattr(owner, name)

            def counted(*arguments, **options):
                calls[0] += 1
                if calls[0] == moment:
                    os.kill(os.getpid(), signal.SIGKILL)
                return original(*arguments, **options)

            setattr(owner, name, counted)
        blocks.compute(Squares(), blocks.Run(path, progress=False))
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.parametrize(
    ("kind", "moments"),
    [
        ("create", [1, 2, 3]),
        # Before the first array of the first block, its second, its checksum, and later ones.
        ("write", [1, 2, 3, 4, 6, 11]),
        ("time", [0.002, 0.005, 0.01, 0.015, 0.02, 0.03]),
    ],
)
def test_a_process_killed_at_any_moment_leaves_a_store_that_goes_on_to_the_same_bits(tmp_path, kind, moments):
    path = tmp_path / "a.prt"
    command = [sys.executable, "-W", "ignore", "-c", MOMENTS, str(path), kind, *map(str, moments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    codes = [int(line) for line in done.stdout.split()]
    assert len(codes) == len(moments)
    assert set(codes) <= {-9, 0}
    assert codes[0] == -9
    check(visibility.blocks.compute(Squares(), prt.Run(path)))
    check(visibility.blocks.compute(Counting(log=(log := [])), prt.Run(path)))
    assert not log


@pytest.mark.parametrize("name", ["checksum", "value"])
def test_damaged_blocks_and_no_others_are_computed_again(tmp_path, name):
    path = tmp_path / "a.prt"
    visibility.blocks.compute(Squares(), prt.Run(path))
    array = np.load(path / f"{name}.npy", mmap_mode="r+")
    array[5] = ~array[5] if name == "checksum" else -array[5]
    del array
    for again in ([5], []):
        job = Counting()
        check(visibility.blocks.compute(job, prt.Run(path)))
        assert job.log == again


def test_finished_stores_are_read_without_computing_and_while_another_process_writes(tmp_path):
    path, first = tmp_path / "a.prt", Counting()
    check(visibility.blocks.compute(first, prt.Run(path)))
    assert sorted(first.log) == list(range(8))
    job = Counting()
    with BlockStore(path, job.header, job.layout, 8).writing():
        check(visibility.blocks.compute(job, prt.Run(path)))
    assert not job.log


def test_files_that_are_no_stores_are_refused(tmp_path):
    (tmp_path / "file").write_text("precious")
    visibility.blocks.compute(Squares(), prt.Run(tmp_path / "a.prt"))
    (tmp_path / "a.prt" / "store.json").write_text("{")  # As a machine leaves it that stops while it writes.
    for name in ("file", "a.prt"):
        with pytest.raises(ValueError, match=f"{name} exists but is not a readable store"):
            visibility.blocks.compute(Squares(), prt.Run(tmp_path / name))


def rounded(tree):
    """The same up to the last bit of every number, as another kind of processor computes it."""

    def last_bit(leaf):
        floating = getattr(leaf, "dtype", np.dtype(int)).kind == "f"
        return np.nextafter(np.asarray(leaf), np.inf, dtype=leaf.dtype) if floating else leaf

    return jax.tree.map(last_bit, tree)


def test_a_store_opens_with_the_floats_that_another_processor_computes_and_not_with_other_parameters(
    sphere, expected, tmp_path, monkeypatch
):
    mesh, brdf = sphere
    path = tmp_path / "a.prt"
    relit(sphere, run=prt.Run(path))
    starts, frames = visibility.start_points, visibility.rays.frames
    monkeypatch.setattr(visibility.rays, "start_points", lambda *meshes, **options: rounded(starts(*meshes, **options)))
    monkeypatch.setattr(visibility.rays, "frames", lambda *each: rounded(frames(*each)))
    monkeypatch.setattr(separable.sparse, "compress", None)  # Nothing is computed again.
    other = eqx.tree_at(lambda b: b.light_map, brdf, jnp.asarray(rounded(brdf.light_map)))
    same(relit((mesh, other), run=prt.Run(path))[:2], expected[:2])
    other = eqx.tree_at(lambda b: b.view_map, brdf, jnp.asarray(2 * np.asarray(brdf.view_map)))  # does not matter
    same(relit((mesh, other), run=prt.Run(path))[:2], expected[:2])
    again = prt.separable.factor(prt.brdf.AshikhminShirley(nu=10.5), terms=2, resolution=8)
    with pytest.raises(
        ValueError, match=r"\(brdf: stored and given values differ by .* of the norm\).* jaxprt\.files\.save"
    ):
        relit((mesh, again), run=prt.Run(path))
    monkeypatch.setattr(separable.sparse, "ALGORITHM", {"visibility": 2, "separable": 2})
    with pytest.raises(
        ValueError, match=r"a\.prt was made by version .*'separable': 1}.*'separable': 2}.*other results"
    ):
        relit(sphere, run=prt.Run(path))


def test_regions_that_touch_start_their_rays_apart_and_have_a_store_of_their_own(tmp_path):
    floor = prt.scene.builtin.plane(cells=2)
    wall = make_mesh(np.asarray(floor.position)[:, [0, 2, 1]] * [1, -1, 1] + [0, 1, -1], floor.face)
    whole = join([floor, wall])
    rays = visibility.Occluder(whole)
    alone = [visibility.start_points(surface, rays) for surface in (floor, wall)]
    np.testing.assert_array_equal(visibility.start_points(whole, rays, apart=True), np.concatenate(alone))
    assert np.any(visibility.start_points(whole, rays) != np.concatenate(alone))
    options = {"degree": 1, "size": 4, "run": prt.Run(tmp_path / "store")}
    harmonic.precompute_diffuse(whole, apart=True, **options)
    with pytest.raises(ValueError, match="computed from other inputs"):
        harmonic.precompute_diffuse(whole, **options)


def test_headers_of_all_traced_systems_name_versions_and_no_computed_float(sphere, monkeypatch):
    mesh, brdf = sphere
    rows, white = np.ones((156, 1, 4, 4), np.float32), np.ones(1, np.float32)
    more = {"region": np.zeros(156, int), "member": np.arange(156)[None], "white": white, "scale": white}
    more |= {
        "bases": (brdf,),
        "basis": np.zeros(1, int),
        "lamps": 0,
        "response": (np.ones((156, 6, 2), np.float32),),
        "components": 1,
        "modes": 1,
        "function": np.arange(1),
    }
    kinds = [
        (separable.sparse._Job, {"brdf": brdf, "keep": 3}),
        (visibility.stored._Job, {}),
        (lobe.pyramid._Job, {}),
        (harmonic.transfer._Job, {"degree": 1, "diffuse": False}),
        (harmonic.transfer._Job, {"degree": 1, "diffuse": True}),
        (interreflection._BounceJob, {"brdf": (), "rows": rows}),
        (interreflection._DiffuseBounceJob, {"rows": rows[:, 0], "albedo": np.ones((1, 1), int)}),
        (bounces.jobs.ResponseJob, {"basis": brdf, "edge": 1}),
        (bounces.jobs.TransferJob, more),
        (bounces.jobs.AgainJob, more),
    ]
    before = [kind.make(mesh, None, None, 8, **fields) for kind, fields in kinds]
    starts = visibility.start_points
    monkeypatch.setattr(visibility.rays, "start_points", lambda *meshes, **options: rounded(starts(*meshes, **options)))
    turned = eqx.tree_at(lambda m: m.face, mesh, mesh.face[::-1])
    for job, (kind, fields) in zip(before, kinds, strict=True):
        again = kind.make(mesh, None, None, 8, **rounded(fields))
        assert json.dumps(again.header) == json.dumps(job.header)
        assert job.header["algorithm"]["visibility"] == visibility.rays.ALGORITHM
        assert len(job.header["algorithm"]) == 2
        assert kind.make(turned, None, None, 8, **fields).header["mesh"] != job.header["mesh"]
        for name, told in again.near.items():
            assert np.linalg.norm(np.subtract(told, job.near[name])[2:]) < 0.1 * told[0] * told[1]
    assert len({json.dumps(job.header) for job in before}) == len(before)


def test_fingerprints_tell_values_shapes_and_types_apart():
    array = np.arange(6, dtype=np.float32)
    different = [array, array.reshape(2, 3), array.astype(np.float64), array + 1, array[:5], array[::-1]]
    assert len({visibility.blocks.fingerprint(each) for each in different}) == len(different)
    assert visibility.blocks.fingerprint(array, array) != visibility.blocks.fingerprint(array)
    assert visibility.blocks.fingerprint(array[::2]) == visibility.blocks.fingerprint(array[::2].copy())
    assert zlib.crc32(b"") == 0  # The checksum that stands for nothing written is also that of no bytes.


def test_process_pools_that_fork_are_refused_by_the_remedy():
    with ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool:
        with pytest.raises(ValueError, match=r'must not fork .* mp_context=multiprocessing.get_context\("spawn"\)'):
            prt.Run(executor=pool)
        assert not pool._processes  # nothing was forked
