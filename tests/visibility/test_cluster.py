"""A cluster: dask workers that die, dawdle and lose their scheduler, and machines that share nothing but a folder."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import dataclass

import numpy as np
import pytest

import jaxprt as prt
from jaxprt import visibility
from jaxprt.files.arrays import BlockStore
from jaxprt.visibility.stored import _Job

distributed = pytest.importorskip("distributed")

# Dask's event loops end after the test that used them; that is theirs to tidy.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore:.*:UserWarning:distributed.*"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning:distributed.*"),
]
WORKERS = 4


@dataclass(frozen=True)
class Dawdling(_Job):
    """Visibility; the first worker of all takes half a second for each block."""

    turtle: str = ""

    def run(self, block):
        try:
            with open(self.turtle, "x") as file:
                file.write(str(os.getpid()))
        except FileExistsError:
            pass
        time.sleep(0.5 if pathlib.Path(self.turtle).read_text() == str(os.getpid()) else 0.02)
        return super().run(block)


def started():
    """Four worker processes, and a client."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Dask warns of ports, and of packages that it would like.
        cluster = distributed.LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, dashboard_address=None, memory_limit=0, silence_logs=50
        )
        return cluster, distributed.Client(cluster)


def after(store, blocks, action):
    """Does something when a store has so many blocks, in a thread."""

    def wait():
        while store.written().sum() < blocks:
            time.sleep(0.01)
        action()

    thread = threading.Thread(target=wait)
    thread.start()
    return thread


@pytest.mark.long
def test_a_killed_worker_a_slow_one_and_a_scheduler_that_starts_again_leave_the_bits_of_a_run_alone(tmp_path):
    mesh = prt.scene.builtin.sphere(rings=60, sectors=100)
    alone = visibility.precompute(mesh, size=16, progress=False)
    job = Dawdling.make(mesh, None, None, 16, turtle=str(tmp_path / "turtle"))
    path, blocks = tmp_path / "a.prt", -(-job.vertices // job.step)
    store = BlockStore(path, job.header, job.layout, blocks, job.near)

    cluster, client = started()
    try:
        victim = next(iter(cluster.workers.values())).pid
        killing = after(store, blocks // 4, lambda: os.kill(victim, signal.SIGKILL))
        dropping = after(store, blocks // 2, client.restart)
        told = None
        try:
            visibility.blocks.compute(job, path=path, executor=client.get_executor(), progress=False)
        except RuntimeError as error:
            told = str(error)
        killing.join()
        dropping.join()
        assert told is None or f"they are kept in {path}: call again to go on" in told
    finally:
        client.close()
        cluster.close()

    kept = int(store.written().sum())
    assert kept >= blocks // 2
    cluster, client = started()
    try:
        result = visibility.blocks.compute(job, path=path, executor=client.get_executor(), progress=False)
    finally:
        client.close()
        cluster.close()
    np.testing.assert_array_equal(result["level"], alone.level)
    assert (tmp_path / "turtle").exists()


PART = """
import sys
import jaxprt as prt
from jaxprt import visibility
mesh = prt.scene.builtin.sphere(rings=20, sectors=30)
with visibility.Part(int(sys.argv[2]), 3) as part:
    try:
        visibility.precompute(mesh, size=8, path=sys.argv[1], executor=part, progress=False)
    except visibility.UnfinishedError:
        print("unfinished")
"""


@pytest.mark.long
def test_processes_that_share_nothing_but_a_folder_make_the_whole(tmp_path):
    path = tmp_path / "a.prt"
    command = [sys.executable, "-W", "ignore", "-c", PART, str(path)]
    running = [subprocess.Popen([*command, str(k)], stdout=subprocess.PIPE, text=True) for k in (1, 2, 3)]
    running[1].kill()
    told = [each.communicate()[0] for each in running]
    assert [each.returncode for each in running] == [0, -signal.SIGKILL, 0]
    assert told == ["unfinished\n", "", "unfinished\n"]
    assert subprocess.run([*command, "2"], check=True, capture_output=True, text=True).stdout == ""
    mesh = prt.scene.builtin.sphere(rings=20, sectors=30)
    alone = visibility.precompute(mesh, size=8, progress=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Job, "run", None)  # Nothing is computed again.
        found = visibility.precompute(mesh, size=8, path=path, progress=False)
    np.testing.assert_array_equal(found.level, alone.level)
