"""The block loop of precomputation: computes independent blocks in any executor, stores each, and can resume."""

import abc
import collections
import contextlib
import hashlib
import operator
import os
import pickle
import queue
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import tqdm
from threadpoolctl import threadpool_limits

from jaxprt import require
from jaxprt.files import arrays
from jaxprt.files.arrays import BlockStore, Header, Layout

_HELD = 1 << 28  # bytes of results, and of copies of a job, that may be in flight at once
_MOST = 4096  # blocks that may be in flight at once
_PAUSE = 0.1  # seconds between calls of a function that is told of progress

Progress = bool | Callable[[str, float], None]  # see `Run.progress`
Item = TypeVar("Item")


class Job(abc.ABC):
    """A computation in blocks. Each worker receives it once, by pickle."""

    @property
    @abc.abstractmethod
    def header(self) -> Header:
        """Everything that the result depends on, as JSON values. Equal headers and `near` mean equal results.

        It holds the name of the `system` and the version of its `algorithm`, which a release raises if results change.
        """

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches (see `jaxprt.files.arrays.sketch`) of input arrays that may differ by rounding."""
        return {}

    @property
    @abc.abstractmethod
    def layout(self) -> Mapping[str, Layout]:
        """Shape of one block of each result array."""

    @property
    @abc.abstractmethod
    def vertices(self) -> int:
        """Number of vertices. The last block is padded."""

    @property
    def step(self) -> int:
        """Vertices per block: by default the extent of the first result array along its block axis."""
        at = next(iter(self.layout.values()))
        return at.shape[at.axis]

    @abc.abstractmethod
    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """Computes one block of every result array. Also returns the number of rays that it traced."""

    def with_texels(self, texels: int) -> "Job":
        """The job with fewer rays, as `Run.texels` says; the same job if it has no such choice."""
        return self


class Shard(ThreadPoolExecutor):
    """An executor that computes only the k-th of n equal parts of a job's blocks, on this machine.

    With it several machines can share a job; they need only a shared folder. Pass it as `executor`, with the same
    `path` on every machine. A call whose part is finished while others are not raises `UnfinishedError`. The call that
    finishes the last part, or a later call without a part, returns the whole result.

    Args:
        number: Number of the part, starting at 1.
        count: Number of parts.

    Raises:
        TypeError: `number` or `count` is not an integer.
        ValueError: `number` is not between 1 and `count`.
    """

    def __init__(self, number: int, count: int):
        number, count = operator.index(number), operator.index(count)
        if not 1 <= number <= count:
            raise ValueError(f"the part must be from 1/{count} to {count}/{count}, got {number}/{count}")
        super().__init__(cores())
        self.number, self.count = number, count

    def of(self, blocks: int) -> range:
        """The blocks that this part computes. They are contiguous, so that two writers rarely use the same file."""
        return range((self.number - 1) * blocks // self.count, self.number * blocks // self.count)


class UnfinishedError(RuntimeError):
    """This part of the job is finished, but other parts are not."""


def cores() -> int:
    """Number of cores that this process may use. A batch system may have assigned fewer than the machine has."""
    affinity = getattr(os, "sched_getaffinity", None)  # only on Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _check_context(executor: Executor | None) -> None:
    """Refuses process pools that fork."""
    context = getattr(executor, "_mp_context", None) if isinstance(executor, ProcessPoolExecutor) else None
    # A forked process has the locks of JAX's threads but not the threads, and waits forever for a lock that one held.
    if context is not None and context.get_start_method() == "fork":
        raise ValueError(
            'executor must not fork this process, got a ProcessPoolExecutor with the context "fork": JAX runs threads, '
            "and forked workers would hang; make it by ProcessPoolExecutor(n, "
            'mp_context=multiprocessing.get_context("spawn"))'
        )


@dataclass(frozen=True)
class Run:
    """Where a precomputation stores its work, what computes it, and whether it shows progress.

    Attributes:
        path: Folder in which finished blocks of work are stored; it is made with its parents. A call that was
            interrupted continues from there. None stores nothing.
        executor: A `concurrent.futures.Executor` that computes the blocks; if None, the cores of this machine.
            A `Shard` computes only its own blocks. A `ProcessPoolExecutor` must have the context "spawn" or
            "forkserver".
        progress: Whether to show progress bars. A function is called in place of them, from the thread that waits for
            the blocks, with the name of the work and the share of it that is done, from 0 to 1. If it raises an error,
            the work ends with that error.
        texels: Largest number of texels along the edge of a face for which rays are traced. Finer texels get the
            visibility of the coarse texel that contains them, so a preview has the arrays of the whole result. If None,
            all texels are traced, and those on a boundary of visibility by 16 more rays.

    Raises:
        TypeError: `path` is not a path, or `executor` has no method `submit`.
        ValueError: `executor` forks this process, or is a `Shard` without a path; or `texels` is below 1, or given
            with a path, which stores whole results only.
    """

    path: str | os.PathLike | None = None
    executor: Executor | None = None
    progress: Progress = True
    texels: int | None = None

    def __post_init__(self):
        """Checks the path and the executor."""
        if self.path is not None:
            require.path("path", self.path)
        require.executor(self.executor)
        _check_context(self.executor)
        part = self.executor
        if isinstance(part, Shard) and self.path is None:
            raise ValueError(
                f"part {part.number}/{part.count} must have a path, the folder that all parts share, got None"
            )
        if self.texels is not None:
            require.count("texels", self.texels, least=1)
            if self.path is not None:
                raise ValueError(f"texels must be None with a path, which stores whole results, got {self.texels}")

    def within(self, name: str) -> "Run":
        """The same, with a folder of this name inside of the folder."""
        return self if self.path is None else replace(self, path=os.path.join(self.path, name))


def compute(job: Job, run: Run, *, label: str = "precompute") -> dict[str, np.ndarray]:
    """Computes all blocks of a job.

    With a path, the worker that computes a block also writes it, if it can access the folder.

    Args:
        job: The computation.
        run: Folder of the store, executor and progress bar. Blocks found in the folder are not computed again.
        label: Text of the progress bar.

    Returns:
        The result arrays. Arrays with one entry per vertex are cut to the number of vertices. With a path, arrays
        whose first axis is that of the blocks are memory-mapped: pages are read when they are first used.
    """
    executor = run.executor
    job = job if run.texels is None else job.with_texels(run.texels)
    blocks = -(-job.vertices // job.step)
    part = executor if isinstance(executor, Shard) else None
    store = None if run.path is None else BlockStore(run.path, job.header, job.layout, blocks, job.near)
    counts = {name: _entries(at, job, blocks) for name, at in job.layout.items()}
    chosen = range(blocks) if part is None else part.of(blocks)
    total = sum(_count(job, block) for block in chosen)
    with ProgressBar(run.progress, label, total=total) as bar:
        if store is None:
            memory = _Memory(job, counts)
            _run(job, chosen, memory.place, None, executor, bar)
            return memory.array
        todo = _missing_blocks(store, chosen)
        bar.update(total - sum(_count(job, block) for block in todo))
        if todo:
            with store.writing((1, 1) if part is None else (part.number, part.count)):
                # Another process may have finished some blocks before this one acquired the lock.
                _run(job, _missing_blocks(store, todo), store.write, store, executor, bar)
        bar.update(total - bar.count)
    if part is not None:
        left = int(np.sum(~store.written())) or len(_missing_blocks(store, set(range(blocks)) - set(chosen)))
        if left:
            raise UnfinishedError(
                f"part {part.number}/{part.count} of {store.path} is done; {left} of its {blocks} blocks are missing: "
                "run the other parts, then run again without a part"
            )
    return {name: store.whole(name, count) for name, count in counts.items()}


class ProgressBar(contextlib.AbstractContextManager):
    """A progress bar in the terminal, or a function that is called in place of it; see `Run.progress`.

    Attributes:
        count: How many vertices are done.
    """

    def __init__(self, progress: Progress, label: str, *, total: int | None = None, unit: str = "vertex"):
        """Starts at 0. Without a total, `update` says which share is done."""
        self._call = progress if callable(progress) else None
        hidden = self._call is not None or not progress
        self._bar = tqdm.tqdm(total=total, desc=label, unit=unit, unit_scale=True, disable=hidden)
        self._label, self._total = label, total
        self.count = 0
        self._told = -np.inf
        self.update(0)

    def __exit__(self, *error: object) -> None:
        """Ends the line of the terminal."""
        self._bar.close()

    def update(self, count: int, *, share: float | None = None, words: str = "", rays: int = 0) -> None:
        """Adds a number of vertices.

        Args:
            count: Number of vertices that were done since the last call.
            share: Share of all work that is done; if None, that of the total.
            words: Text after the bar.
            rays: Number of rays that were traced so far, for their speed after the bar.
        """
        self.count += count
        if self._call is not None:
            done = self.count / self._total if share is None and self._total else share or 0.0
            now = time.monotonic()
            if now - self._told >= _PAUSE or done >= 1:
                self._told = now
                self._call(self._label, min(done, 1.0))
            return
        self._bar.update(count)
        if rays and not self._bar.disable:
            words = f"{rays / max(self._bar.format_dict['elapsed'], 1e-9) / 1e6:.1f} Mrays/s"
        if words:
            self._bar.set_postfix_str(words, refresh=False)


def tracked(items: Sequence[Item], progress: Progress, label: str, *, unit: str) -> Iterator[Item]:
    """Yields items, and shows how many are done."""
    with ProgressBar(progress, label, total=len(items), unit=unit) as bar:
        for item in items:
            yield item
            bar.update(1)


class _Memory:
    """Results that are held in memory only, without a store."""

    def __init__(self, job: Job, counts: Mapping[str, int]):
        self._job = job
        self.array = {
            name: arrays.empty((*at.shape[: at.axis], counts[name], *at.shape[at.axis + 1 :]), at.dtype)
            for name, at in job.layout.items()
        }

    def place(self, block: int, array: Mapping[str, np.ndarray]) -> None:
        """Copies one block of every array to its place."""
        for name, at in self._job.layout.items():
            first = block * at.shape[at.axis]
            before = (slice(None),) * at.axis
            into = self.array[name][(*before, slice(first, first + at.shape[at.axis]))]
            into[...] = array[name][(*before, slice(into.shape[at.axis]))]


def fingerprint(*array: Any) -> str:
    """SHA-256 of the shapes, types and bytes of some arrays."""
    digest = hashlib.sha256()
    for value in array:
        value = np.ascontiguousarray(np.asarray(value))
        digest.update(f"{value.shape}{value.dtype}".encode() + value.tobytes())
    return digest.hexdigest()


def _run(job, todo, keep, store, executor, bar) -> None:
    """Computes blocks and passes each to `keep`, unless the worker has already written it to the store."""
    key = uuid.uuid4().hex
    threads = ThreadPoolExecutor(cores()) if executor is None else None
    pool: Executor = executor or threads  # pyright: ignore[reportAssignmentType]
    here = threads is not None or isinstance(executor, Shard)
    _jobs[key] = job, store
    # Every core already computes a block, and the additional threads of LAPACK would wait by spinning: beside two
    # busy processes clusters took three times as long. An executor that the caller passes has its own setting.
    limit = threadpool_limits(limits=1, user_api="blas") if here else None
    flow = _Flow(pool, key, (job, store), ahead=_ahead(job, here))
    rays = 0
    try:
        for block, (array, count) in flow.results(todo):
            if array is not None:
                keep(block, array)
            elif not here and store.read(block) is None:
                raise OSError(
                    f"{store.path} lacks block {block} that a worker wrote: "
                    "the path must be the same shared folder for all workers"
                )
            rays += count
            bar.update(_count(job, block), rays=rays)
    except (BrokenExecutor, CancelledError) as error:
        outcome = "they are lost" if store is None else f"they are kept in {store.path}: call again to go on"
        raise RuntimeError(f"a worker died after {bar.count} of {job.vertices} vertices; {outcome}") from error
    finally:
        flow.cancel()
        _jobs.pop(key, None)
        try:
            if threads is not None:
                threads.shutdown(wait=True, cancel_futures=True)
        finally:
            if limit is not None:
                limit.restore_original_limits()


class _Flow:
    """Submits blocks to an executor, a bounded number at a time, so that results do not accumulate in memory."""

    def __init__(self, pool: Executor, key: str, work: tuple[Job, BlockStore | None], *, ahead: int):
        self._pool, self._key, self._work, self._ahead = pool, key, work, ahead
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._flying: dict[int, Future] = {}
        self._carrying: set[int] = set()
        self._asked = 0
        self._pickle: bytes | None = None

    def results(self, todo) -> Iterator[tuple[int, tuple[Mapping[str, np.ndarray] | None, int]]]:
        """Yields each block with its result, in order of completion."""
        waiting = collections.deque(todo)
        while waiting or self._flying:
            while waiting and len(self._flying) < self._ahead:
                self._submit(waiting.popleft())
            block = self._done.get()
            answer = self._flying.pop(block).result()
            self._carrying.discard(block)
            if answer is None:  # The worker did not have the job: a later block carries it.
                self._asked += 1
                waiting.appendleft(block)
            else:
                yield block, answer

    def cancel(self) -> None:
        """Cancels the blocks that have not started."""
        for future in self._flying.values():
            future.cancel()

    def _submit(self, block: int) -> None:
        sent = None
        # The job is sent to each worker that does not have it yet, also in a bounded number of copies.
        if self._asked:
            if self._pickle is None:
                self._pickle = pickle.dumps(self._work)
            if not self._carrying or len(self._carrying) < _HELD // len(self._pickle):
                sent = self._pickle
                self._asked -= 1
                self._carrying.add(block)
        future = self._flying[block] = self._pool.submit(_work, self._key, sent, block)
        future.add_done_callback(lambda _: self._done.put(block))


# The at most two latest jobs that this process has received, each with its store if the process can write to it.
_jobs: dict[str, tuple[Job, BlockStore | None]] = {}


def _work(key: str, sent: bytes | None, block: int) -> tuple[Mapping[str, np.ndarray] | None, int] | None:
    """Computes one block in a worker; None if it has not received the job yet, and no arrays if the store has them."""
    if sent is not None and key not in _jobs:
        while len(_jobs) > 1:
            _jobs.pop(next(iter(_jobs)))
        job, store = pickle.loads(sent)
        _jobs[key] = job, store if store is not None and store.here else None
    if key not in _jobs:
        return None
    job, store = _jobs[key]
    array, rays = job.run(block)
    if store is None:
        return array, rays
    store.write(block, array)
    return None, rays


def _ahead(job: Job, here: bool) -> int:
    """Largest number of blocks in flight: two per core on this machine, elsewhere some hundred megabytes of results."""
    size = sum(int(np.prod(at.shape)) * np.dtype(at.dtype).itemsize for at in job.layout.values())
    return 2 * cores() if here else max(2 * cores(), min(_HELD // max(1, size), _MOST))


def _missing_blocks(store: BlockStore, blocks: Iterable[int]) -> list[int]:
    """The blocks that are missing from the store. All cores check checksums."""
    written = store.written()
    with ThreadPoolExecutor(cores()) as pool:
        blocks = list(blocks)
        there = pool.map(lambda block: written[block] and store.read(block) is not None, blocks)
        return [block for block, written in zip(blocks, there, strict=True) if not written]


def _entries(at: Layout, job: Job, blocks: int) -> int:
    """Entries of a whole array along its block axis: one per vertex, or the entries of all blocks."""
    return job.vertices if at.shape[at.axis] == job.step else at.shape[at.axis] * blocks


def _count(job: Job, block: int) -> int:
    return min(job.step, job.vertices - block * job.step)
