"""A cluster: dask workers that die, dawdle and lose their scheduler, and machines that share nothing but a folder."""

import os
import pathlib
import signal
import subprocess
import sys
import threading
import time
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
ROOT = pathlib.Path(__file__).parents[2]


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


class Cluster:
    """A scheduler and four workers, each a process, and a client."""

    def __init__(self, folder):
        self.file = str(folder / "scheduler.json")
        place = ["--scheduler-file", self.file, "--no-dashboard"]
        self.scheduler = self._start("scheduler", *place, "--port", "0")
        worker = [*place, "--nthreads", "1", "--no-nanny", "--local-directory", str(folder), "--death-timeout", "10"]
        self.workers = [self._start("worker", *worker) for _ in range(WORKERS)]
        while not os.path.exists(self.file):
            time.sleep(0.05)
        self.client = distributed.Client(scheduler_file=self.file)
        self.client.wait_for_workers(WORKERS)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for each in (*self.workers, self.scheduler):
            each.kill()
            each.wait()
        self.client.close(timeout=1)
        os.unlink(self.file)

    def _start(self, kind, *options):
        command = [sys.executable, "-W", "ignore", "-m", f"distributed.cli.dask_{kind}", *options]
        return subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)


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
    alone = visibility.precompute(mesh, size=16)
    job = Dawdling.make(mesh, None, None, 16, turtle=str(tmp_path / "turtle"))
    path, blocks = tmp_path / "a.prt", -(-job.vertices // job.step)
    store = BlockStore(path, job.header, job.layout, blocks, job.near)

    with Cluster(tmp_path) as cluster:
        accidents = [
            after(store, blocks // 4, cluster.workers[0].kill),
            after(store, blocks // 2, cluster.scheduler.kill),
        ]
        with pytest.raises(
            RuntimeError, match=r"a worker died after .* they are kept in .*a\.prt: call again to go on"
        ):
            visibility.blocks.compute(job, prt.Run(path, cluster.client.get_executor()))
        for each in accidents:
            each.join()
    assert blocks // 2 <= store.written().sum() < blocks
    with Cluster(tmp_path) as cluster:
        result = visibility.blocks.compute(job, prt.Run(path, cluster.client.get_executor()))
    np.testing.assert_array_equal(result["level"], alone.level)
    assert (tmp_path / "turtle").exists()


PART = """
import sys
import jaxprt as prt
from jaxprt import visibility
mesh = prt.scene.builtin.sphere(rings=20, sectors=30)
with visibility.Shard(int(sys.argv[2]), 3) as part:
    try:
        visibility.precompute(mesh, size=8, run=prt.Run(sys.argv[1], part))
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
    alone = visibility.precompute(mesh, size=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_Job, "run", None)  # Nothing is computed again.
        found = visibility.precompute(mesh, size=8, run=prt.Run(path))
    np.testing.assert_array_equal(found.level, alone.level)


OBJ = "v 0 1 0\nv -1 -0.5 1\nv 1 -0.5 1\nv 0 -0.5 -1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.mark.long
def test_the_examples_run_here(tmp_path):
    (tmp_path / "mesh.obj").write_text(OBJ)
    (tmp_path / "sbatch").write_text('#!/bin/bash\necho "${@: -1}" > wrapped\n')  # Slurm would run its last word.
    (tmp_path / "sbatch").chmod(0o755)
    folders = [str(tmp_path), str(pathlib.Path(sys.executable).parent), os.environ["PATH"]]
    path = {**os.environ, "PATH": ":".join(folders), "PYTHONPATH": str(ROOT)}
    both = {"cwd": tmp_path, "check": True, "capture_output": True, "text": True}
    for task in ("2", "1"):
        slurm = {"SLURM_ARRAY_TASK_ID": task, "SLURM_ARRAY_TASK_COUNT": "2", "SLURM_ARRAY_JOB_ID": "7"}
        command = ["bash", str(ROOT / "examples" / "slurm_array.sh"), "mesh.obj", "shared"]
        done = subprocess.run(command, env=path | slurm, **both)
    assert "all parts are done" in done.stdout
    assert (tmp_path / "wrapped").read_text() == "python -m jaxprt relight mesh.obj --output shared --system lobe \n"
    command = ["python", str(ROOT / "examples" / "cluster.py"), "mesh.obj", "scene"]
    subprocess.run([sys.executable, *command[1:]], env=path, **both)
    assert len(prt.files.load(tmp_path / "scene.saved").scene.parts) == 1
