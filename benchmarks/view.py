"""How soon does the viewer answer a hand, and how soon does a stored scene show its first picture?

    python -m benchmarks.view [--quick] [--output FILE]

The embedded scene of 16,778 vertices by 6 lobes with roughness free from .25 to .8, and with one bounce. Each time is from
the question to the last byte of the answer, over HTTP as the browser's page asks: what Python and the socket take, without
what the browser needs to draw. `bytes` are those of an answer. `first` is a new process that loads the kept precomputation,
from its start to its first answer, with programs that an earlier process has compiled.
"""

import http.client
import os
import subprocess
import sys
import tempfile
import time
import urllib.parse
from typing import Any

import jaxprt as prt
from benchmarks import harness
from jaxprt import view
from jaxprt.cli.play import embedded
from jaxprt.scene import builtin
from jaxprt.view import messages

_FIRST = """
import sys, time
from jaxprt.cli import play
play.keep_programs()
options = play._parser().parse_args(["--no-browser", "--output", sys.argv[1]])
server = play.shown(options)
print(server.url, flush=True)
server.wait()
"""


class Page:
    """What the browser's page asks, without the browser."""

    def __init__(self, url: str):
        place = urllib.parse.urlsplit(url)
        self._path = place.path + "ask"
        self._connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=600)
        self.scene, _ = self.ask({"kind": "scene"})
        names = ("eye", "target", "field_of_view")
        self.state: dict[str, Any] = {name: self.scene[name] for name in names}
        self.state |= {"system": next(iter(self.scene["systems"])), "light": 0, "turn": 0.0, "lamps": []}
        self.state |= {"bounces": True, "materials": {}, "stops": None, "seq": 0}

    def ask(self, content: dict[str, Any]) -> tuple[dict[str, Any], list[bytes]]:
        """One question and its answer."""
        self._connection.request("POST", self._path, messages.pack(content))
        return messages.unpack(self._connection.getresponse().read())

    def look(self, **change: Any) -> int:
        """Colors for a changed state; their bytes."""
        self.state |= change | {"seq": self.state["seq"] + 1}
        content, buffers = self.ask({"kind": "look", **self.state})
        if content["kind"] != "color":
            raise RuntimeError(content)
        return len(buffers[0])


def hands(bounces: int, *, quick: bool, repeats: int) -> list[dict[str, Any]]:
    """Looks in which one thing is new."""
    recipe = prt.relit.Lobes(1 if quick else 6, texels=2 if quick else 16)
    made = prt.precompute(
        embedded(), system=recipe, roughness=(0.25, 0.8), bounces=bounces, size=8 if quick else 64, progress=False
    )
    size = 8 if quick else 64
    server = view.serve(made, {"daylight": builtin.daylight(size=size), "studio": builtin.studio(size=size)})
    page, result = Page(server.url), []
    x, y, z = page.state["eye"]
    changes = {
        "light": lambda k: {"turn": 0.01 * k},
        "view": lambda k: {"eye": [x + 0.01 * k, y, z]},
        "material": lambda k: {"materials": {"pieces": {"roughness": 0.3 + 0.01 * (k % 40), "f0": 0.1}}},
    }
    for name, change in changes.items():
        spent = []
        for k in range(repeats + 2):
            began = time.perf_counter()
            count = page.look(**change(k + 1))
            spent.append(time.perf_counter() - began)
        times = sorted(spent[2:])
        case = f"{name}, {page.scene['vertices']} vertices, {bounces} bounces"
        line = {"benchmark": "view", "case": case, "seconds": times[len(times) // 2], "compile_seconds": spent[0]}
        result.append(line | {"error": None, "spread": (times[-1] - times[0]) / times[len(times) // 2], "bytes": count})
    server.close()
    return result


def first() -> dict[str, Any]:
    """A new process with kept precomputation and programs, until its first colors are there."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": folder}
        for _ in range(2):  # the first one computes and compiles
            began = time.perf_counter()
            command = [sys.executable, "-c", _FIRST, f"{folder}/store"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
            assert process.stdout is not None
            page = Page(process.stdout.readline().strip())
            count = page.look()
            spent = time.perf_counter() - began
            process.terminate()
            process.wait()
    case = f"first colors of a stored scene, {page.scene['vertices']} vertices"
    return {"benchmark": "view", "case": case, "seconds": spent, "compile_seconds": 0.0, "error": None, "bytes": count}


def main() -> None:
    """Runs the benchmark."""
    options = harness.options(__doc__)
    for bounces in (0, 1):
        for line in hands(bounces, quick=options.quick, repeats=3 if options.quick else 15):
            harness.write(line, options)
    if not options.quick:
        harness.write(first(), options)


if __name__ == "__main__":
    main()
