"""What one run of a figure is given, and where its pictures and lines go."""

import json
import pathlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from benchmarks import harness
from jaxprt import files
from jaxprt.scene import Environment, Mesh, builtin, load_environment, load_mesh

LIGHTS = {
    "grace": "grace_cross.hdr",
    "eucalyptus": "eucalyptus_rnl_cross.hdr",
    "st_peters": "stpeters_cross.hdr",
    "uffizi": "uffizi_latlong_256x128.hdr",
}


class Run(NamedTuple):
    """Sizes and folders of a run.

    Attributes:
        quick: Embedded scenes and small sizes, for the tests.
        store: Where precomputed transport is kept, so that a run that was stopped goes on.
        docs: The folder of the pages; pictures and lines go below it.
    """

    quick: bool
    store: pathlib.Path
    docs: pathlib.Path

    def picture(self, name: str) -> pathlib.Path:
        """Where a picture goes."""
        path = self.docs / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def keep(self, name: str) -> pathlib.Path:
        """Where precomputed transport goes."""
        self.store.mkdir(parents=True, exist_ok=True)
        return self.store / name

    def kept(self, name: str, make: Callable[[], Any]) -> Any:
        """What is in the store by a name; made and put there where it is not. Quick runs keep nothing."""
        path = self.keep(f"{name}.prt")
        if self.quick or not path.exists():
            made = make()
            if not self.quick:
                files.save(path, made)
            return made
        return files.load(path)

    def mesh(self, name: str) -> Mesh:
        """A mesh of JAXPRT_DATA; a sphere in a quick run."""
        return builtin.sphere(rings=8, sectors=16) if self.quick else load_mesh(harness.data() / "meshes" / name)

    def light(self, name: str, *, size: int = 64) -> Environment:
        """A light of JAXPRT_DATA by its short name; the embedded studio in a quick run."""
        if self.quick:
            return builtin.studio(size=8)
        return load_environment(harness.data() / "env" / LIGHTS[name], size=size)


def record(run: Run, name: str, figure: Callable[[Run], Iterator[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Runs a figure, and replaces its lines once all of them are there.

    Raises:
        ValueError: A number is NaN or infinite.
    """
    lines = []
    for line in figure(run):
        lines.append({"figure": name, **line})
        print(json.dumps(lines[-1], allow_nan=False), flush=True)
    path = run.docs / "lines" / f"{name}.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return lines


class Clock:
    """Seconds since it was made."""

    def __init__(self):
        """Starts the clock."""
        self._began = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds so far."""
        return time.perf_counter() - self._began
