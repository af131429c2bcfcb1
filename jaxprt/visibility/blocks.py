"""The block loop: independent blocks, computed anywhere, stored as they come, resumed where they stopped."""

import abc
import hashlib
import os
import uuid
from collections.abc import Mapping
from concurrent.futures import BrokenExecutor, Executor, ThreadPoolExecutor, as_completed
from typing import Any

import numpy as np
import tqdm
from threadpoolctl import threadpool_limits

from jaxprt.files.arrays import BlockStore, Layout
from jaxprt.scene.mesh import Mesh


class Job(abc.ABC):
    """What a block loop computes. Travels to workers by pickle, once to each."""

    @property
    @abc.abstractmethod
    def header(self) -> Mapping[str, Any]:
        """What the result depends on, as JSON values; equal headers mean equal results, up to what `near` tells.

        With the name of a `system` belongs the version of its `algorithm`, which a release raises when results change.
        """

    @property
    def near(self) -> Mapping[str, list[float]]:
        """Sketches, by `jaxprt.files.arrays.sketch`, of what the result depends on and rounding may change."""
        return {}

    @property
    @abc.abstractmethod
    def layout(self) -> Mapping[str, Layout]:
        """Per result array, the shape of one block."""

    @property
    @abc.abstractmethod
    def vertices(self) -> int:
        """Number of vertices; the last block is padded beyond them."""

    @property
    def step(self) -> int:
        """Vertices in a block: the extent of the first result array along its axis, unless a job says otherwise."""
        at = next(iter(self.layout.values()))
        return at.shape[at.axis]

    @abc.abstractmethod
    def run(self, block: int) -> tuple[Mapping[str, np.ndarray], int]:
        """One block of every result array, and the number of rays that it took."""


def compute(
    job: Job,
    *,
    path: str | os.PathLike | None = None,
    executor: Executor | None = None,
    progress: bool = True,
    label: str = "precompute",
) -> dict[str, np.ndarray]:
    """Computes all blocks of a job.

    Args:
        job: What to compute.
        path: Folder in which finished blocks are kept; blocks found there are not computed again.
        executor: Where blocks are computed; threads on this machine's cores if None.
        progress: Whether to show a progress bar.
        label: Its text.

    Returns:
        The result arrays; those that have a place for each vertex are cut to the number of vertices.

    Raises:
        ValueError: The store at `path` was made from something else.
        BlockingIOError: Another process is writing to it.
        RuntimeError: A worker died; finished blocks are kept in the store.
    """
    blocks = -(-job.vertices // job.step)
    store = None if path is None else BlockStore(path, job.header, job.layout, blocks, job.near)
    result = {name: np.zeros(_whole(at, blocks), at.dtype) for name, at in job.layout.items()}
    with tqdm.tqdm(total=job.vertices, desc=label, unit="vertex", unit_scale=True, disable=not progress) as bar:
        todo = [block for block in range(blocks) if not _load(store, block, result, job)]
        bar.update(job.vertices - sum(_count(job, block) for block in todo))
        if todo and store is not None:
            with store.writing():
                # Another process may have finished some of them before this one got the lock.
                _run(job, [b for b in todo if not _load(store, b, result, job)], store, executor, result, bar)
        elif todo:
            _run(job, todo, store, executor, result, bar)
        bar.update(bar.total - bar.n)
    return {name: _cut(result[name], at, job) for name, at in job.layout.items()}


def fingerprint(*array: Any) -> str:
    """SHA-256 of arrays: their shapes, types and bytes."""
    digest = hashlib.sha256()
    for each in array:
        each = np.ascontiguousarray(np.asarray(each))
        digest.update(f"{each.shape}{each.dtype}".encode() + each.tobytes())
    return digest.hexdigest()


def scene_key(mesh: Mesh) -> str:
    """Fingerprint of a mesh's surfaces and regions, by which results for it know each other.

    Tangents do not count, and neither do the types in which arrays are held.
    """
    single = [np.asarray(each, np.float32) for each in (mesh.position, mesh.normal)]
    return fingerprint(*single, *(np.asarray(each, np.int32) for each in (mesh.face, mesh.region)))


def _run(job, todo, store, executor, result, bar) -> None:
    key = uuid.uuid4().hex
    _jobs[key] = job
    own = None if executor is not None else ThreadPoolExecutor(os.cpu_count())
    pool: Executor = executor or own  # pyright: ignore[reportAssignmentType]
    # Where each core has a block, LAPACK's own threads wait by spinning: beside two busy processes clusters took three
    # times as long. An executor that the caller brings has its own setting.
    limit = None if own is None else threadpool_limits(limits=1, user_api="blas")
    future = {}
    rays = 0
    try:
        future = {pool.submit(_work, key, None, block): block for block in todo}
        while future:
            again = []
            for done in as_completed(future):
                block, answer = future[done], done.result()
                if answer is None:
                    again.append(block)
                    continue
                array, count = answer
                if store is not None:
                    store.write(block, array)
                _place(result, block, array, job)
                rays += count
                bar.update(_count(job, block))
                if rays:
                    speed = rays / max(bar.format_dict["elapsed"], 1e-9)
                    bar.set_postfix_str(f"{speed / 1e6:.1f} Mrays/s", refresh=False)
            # Workers that did not know the job get it with their next block.
            future = {pool.submit(_work, key, job, block): block for block in again}
    except BrokenExecutor as error:
        kept = "they are lost" if store is None else f"they are kept in {store.path}: call again to go on"
        raise RuntimeError(f"a worker died after {bar.n} of {job.vertices} vertices; {kept}") from error
    finally:
        for each in future:
            each.cancel()
        _jobs.pop(key, None)
        try:
            if own is not None:
                own.shutdown(wait=True, cancel_futures=True)
        finally:
            if limit is not None:
                limit.restore_original_limits()


_jobs: dict[str, Job] = {}  # per process: the jobs that it was sent, the last two at most


def _work(key: str, job: Job | None, block: int) -> tuple[Mapping[str, np.ndarray], int] | None:
    """Runs in a worker: one block, or None where the worker has not been sent the job yet."""
    if job is not None and key not in _jobs:
        while len(_jobs) > 1:
            _jobs.pop(next(iter(_jobs)))
        _jobs[key] = job
    known = _jobs.get(key, job)
    return None if known is None else known.run(block)


def _load(store: BlockStore | None, block: int, result: dict[str, np.ndarray], job: Job) -> bool:
    array = None if store is None else store.read(block)
    if array is not None:
        _place(result, block, array, job)
    return array is not None


def _place(result: dict[str, np.ndarray], block: int, array: Mapping[str, np.ndarray], job: Job) -> None:
    for name, at in job.layout.items():
        size = at.shape[at.axis]
        place = (slice(None),) * at.axis + (slice(block * size, (block + 1) * size),)
        result[name][place] = array[name]


def _cut(array: np.ndarray, at: Layout, job: Job) -> np.ndarray:
    whole = at.shape[at.axis] != job.step or array.shape[at.axis] == job.vertices
    return array if whole else np.take(array, np.arange(job.vertices), at.axis)


def _count(job: Job, block: int) -> int:
    return min(job.step, job.vertices - block * job.step)


def _whole(at: Layout, blocks: int) -> tuple[int, ...]:
    return (*at.shape[: at.axis], at.shape[at.axis] * blocks, *at.shape[at.axis + 1 :])
