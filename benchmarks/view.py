"""How soon does the viewer answer a hand, and how soon does a stored scene show its first picture?

    python -m benchmarks.view [--quick] [--output FILE]

The embedded scene of 16,778 vertices by 6 lobes with roughness free from .25 to .8, and with one bounce. Each time is
from the question to the last byte of the answer, over HTTP as the browser's page asks: what Python and the socket take,
without what the browser needs to draw. `bytes` are those of an answer, whose half floats the error is of. `first` is a
new process that loads the kept precomputation, from its start to its first answer, with programs that an earlier
process has compiled. The quick case has no bounce.
"""

import dataclasses
import http.client
import os
import subprocess
import sys
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import harness
from jaxprt import image, view
from jaxprt.cli.inputs import example_scene
from jaxprt.scene import TexturedMaterial, builtin
from jaxprt.scene.environment import rotate
from jaxprt.view import messages

_FIRST = """
import sys, time
from jaxprt.cli import play
made, lights = play.ready(play.chosen(["--output", sys.argv[1]]))
server = play.serve(made, environments=lights)
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

    def close(self) -> None:
        """Gives the connection back."""
        self._connection.close()

    def ask(self, content: dict[str, Any]) -> tuple[dict[str, Any], list[bytes]]:
        """One question and its answer."""
        self._connection.request("POST", self._path, messages.pack(content, []))
        return messages.unpack(self._connection.getresponse().read())

    def look(self, **change: Any) -> np.ndarray:
        """Colors for a changed state, in half floats."""
        self.state |= change | {"seq": self.state["seq"] + 1}
        content, buffers = self.ask({"kind": "look", **self.state})
        if content["kind"] != "color":
            raise RuntimeError(content)
        return content["scale"] * np.frombuffer(buffers[0], "<f2").reshape(-1, 3)


def hands(bounces: int, *, quick: bool) -> Iterator[dict[str, Any]]:
    """Looks in which one thing is new."""
    size, repeats = (8, 3) if quick else (64, 15)
    recipe = prt.relit.Lobes(8, texels=2) if quick else prt.relit.Lobes(8)
    made = prt.precompute(
        example_scene(playable=True), refine=False, system=recipe, bounces=bounces, size=size, progress=False
    )
    lights = {"daylight": builtin.daylight(size=size), "studio": builtin.studio(size=size)}
    server = view.serve(made, environments=lights)
    page = Page(server.url)
    x, y, z = page.state["eye"]
    changes: dict[str, Callable[[int], dict[str, Any]]] = {
        "material": lambda k: {"materials": {"pieces": {"roughness": 0.3 + 0.001 * k}}},
        "light": lambda k: {"turn": 0.01 * k, "materials": {}},
        "view": lambda k: {"eye": [x + 0.01 * k, y, z], "turn": 0.0},
    }
    for name, change in changes.items():
        spent, color = [], np.zeros(0)
        for k in range(repeats + 2):
            began = time.perf_counter()
            color = page.look(**change(k + 1))
            spent.append(time.perf_counter() - began)
        times, right = np.sort(spent[2:]), radiance(made, lights["daylight"], page.state)
        yield {
            "benchmark": "view",
            "case": f"{name}, {page.scene['vertices']} vertices, {bounces} bounces",
            "seconds": float(np.median(times)),
            "compile_seconds": spent[0],
            "spread": float(np.ptp(times) / np.median(times)),
            "error": float(image.relative_l2(color, right)),
            "bytes": 2 * color.size,
        }
    page.close()
    server.close()


def radiance(made: prt.RelitScene, light: prt.Environment, state: dict[str, Any]) -> np.ndarray:
    """What the colors of a look should be, without the viewer."""
    c, s = np.cos(state["turn"]), np.sin(state["turn"])
    turned = rotate(light, jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    old = made.scene["pieces"].material
    assert isinstance(old, TexturedMaterial)
    new = {name: dataclasses.replace(old, **values) for name, values in state["materials"].items()}
    return np.asarray(made.radiance(turned, eye=jnp.asarray(state["eye"]), materials=new))


def first() -> dict[str, Any]:
    """A new process with kept precomputation and programs, until its first colors are there."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "XDG_CACHE_HOME": folder, "JAXPRT_KEEP_PROGRAMS": "1"}
        spent, color = 0.0, np.zeros(0)
        for _ in range(2):  # the first one computes and compiles
            began = time.perf_counter()
            command = [sys.executable, "-c", _FIRST, f"{folder}/store"]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
            assert process.stdout is not None
            page = Page(process.stdout.readline().strip())
            color = page.look()
            spent = time.perf_counter() - began
            page.close()
            process.terminate()
            process.wait()
            process.stdout.close()
    case = f"first colors of a stored scene, {len(color)} vertices"
    return {
        "benchmark": "view",
        "case": case,
        "seconds": spent,
        "compile_seconds": 0.0,
        "error": None,
        "bytes": 2 * color.size,
    }


def main(options: Sequence[str] | None = None) -> None:
    arguments = harness.parser(str(__doc__).splitlines()[0]).parse_args(options)
    for bounces in (0,) if arguments.quick else (0, 1):
        for line in hands(bounces, quick=arguments.quick):
            harness.report(line, arguments.output)
    if not arguments.quick:
        harness.report(first(), arguments.output)


if __name__ == "__main__":
    main()
