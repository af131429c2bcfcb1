"""How soon does the viewer answer a hand, and how soon does a stored scene show its first picture?

    python -m benchmarks.view [--quick] [--output FILE]

First a process of `jaxprt view`, asked over HTTP as the browser's page asks: from the command to the page, to what a
browser's GPU needs for colors without shadows, with coarse shadows, and of full quality, and to the end of what is
compiled ahead. `cold` has neither programs nor precomputation of earlier processes, `programs` has programs, and
`stored` has both. What the browser itself takes is not included. Without --quick the scene is a file, if
JAXPRT_DATA names a folder of files; then its first frame on the screen of Chromium follows, without a graphics card,
of three starts the middle one.

Then pages without Python, where JAXPRT_DATA and Chromium are there: `error` is that of what the browser draws at rest,
nine samples a pixel, beside `RelitScene.picture`; `stated` is what the page says of itself, `judged` is the browser's
error beside Mitsuba 3 with the original light file, and `picture` that of `RelitScene.picture`. Direct light.

Then looks, for browsers whose GPU does not shade: the embedded scene by lobes, with direct light, one bounce and two.
Each time is from the question to the last byte of the answer. `bytes` are those of an answer, whose half floats the
error is of. The quick case has no bounce.
"""

import contextlib
import dataclasses
import http.client
import os
import pathlib
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.parse
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxprt as prt
from benchmarks import accuracy, asset_files, assets, denoised, harness
from jaxprt import image, view
from jaxprt.cli.inputs import example_scene
from jaxprt.scene import TexturedMaterial, builtin
from jaxprt.scene.environment import rotate
from jaxprt.view import messages

_FOREIGN, _STARTS = "foreign/craft_speederD.gltf", 3  # and how often it is started
# Meshes and materials of `benchmarks.accuracy`, and a file: as pages in a light.
_PAGES = {
    "spot, textured": "courtyard",
    "rocker arm, plastic": "sunrise",
    "suzanne, metal 0.15": "studio",
    "cakeBirthday.glb": "uffizi",
}
_EDGE = 384  # of their pictures
_CANVAS = "document.querySelector('#viewer')?.shadowRoot?.querySelector('.canvas')"
_FILES = "scenes/Duck.glb", "env/uffizi_latlong_256x128.hdr"  # in JAXPRT_DATA


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


class Preparation:
    """A process of `jaxprt view`, and when the page gets what."""

    def __init__(self, arguments: Sequence[str], folder: str):
        self.began = time.perf_counter()
        environment = {**os.environ, "XDG_CACHE_HOME": folder, "JAXPRT_KEEP_PROGRAMS": "1"}
        command = [sys.executable, "-m", "jaxprt", "view", "--no-browser", *arguments]
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=environment
        )
        assert self._process.stdout is not None
        self.url = self._process.stdout.readline().split()[1]

    def processor_seconds(self) -> float | None:
        """Seconds that the process has computed, on all cores; None where the system does not tell."""
        try:
            fields = pathlib.Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return None
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """Ends the process."""
        self._process.terminate()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()

    def events(self) -> Generator[tuple[str, float, int], None, None]:
        """What the page has got, after how many seconds, and bytes of the answers."""
        place = urllib.parse.urlsplit(self.url)
        connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=600)

        def ask(content: dict[str, Any]) -> tuple[dict[str, Any], list[bytes]]:
            connection.request("POST", place.path + "ask", messages.pack(content, []))
            return messages.unpack(connection.getresponse().read())

        with contextlib.closing(connection):
            connection.request("GET", place.path)
            size = len(connection.getresponse().read())
            yield "page", time.perf_counter() - self.began, size
            version, previews = 0, ["no shadows", "coarse shadows", "coarse shadows at all vertices", "no bounces"]
            while True:
                state, _ = ask({"kind": "progress"})
                if state["version"] > version:
                    scene, arrays = ask({"kind": "scene"})
                    _, more = ask({"kind": "page", "system": next(iter(scene["systems"]))})
                    preview, version = not scene["rests"], scene["version"]
                    name = previews[min(version, len(previews)) - 1] if preview else "full quality"
                    yield name, time.perf_counter() - self.began, sum(map(len, arrays + more))
                elif state["finished"]:
                    yield "programs of first changes", time.perf_counter() - self.began, 0
                    return
                time.sleep(0.05)


def preparations(*, quick: bool) -> Iterator[dict[str, Any]]:
    """From the command to each better scene: cold, with programs, and with stored precomputation too."""
    data = None if quick else os.environ.get("JAXPRT_DATA")
    files = [] if data is None else [os.path.join(data, name) for name in _FILES]
    small = ["--light-size", "8", "--texels", "2"] if quick else []
    with tempfile.TemporaryDirectory() as folder:
        store = ["--output", f"{folder}/store"]
        cases = {"programs": []} if quick else {"cold": [], "programs": store, "stored": store}
        for case, more in cases.items():
            process = Preparation([*files, *small, *more], folder)
            events = process.events()
            try:
                for name, seconds, size in events:
                    yield {
                        "benchmark": "view",
                        "case": f"{case}: {name}",
                        "seconds": seconds,
                        "processor_seconds": process.processor_seconds(),
                        "compile_seconds": 0.0,
                        "error": None,
                        "bytes": size,
                    }
                    if quick and name == "no shadows":
                        break
            finally:
                events.close()
                process.close()


@contextlib.contextmanager
def browsing() -> Iterator[Any]:
    """Chromium without a graphics card; None where it or the data is not there."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if "JAXPRT_DATA" not in os.environ or chromium is None:
        yield None
        return
    from playwright.sync_api import sync_playwright

    switches = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=switches)
        yield browser
        browser.close()


def first_frames(browser: Any) -> Iterator[dict[str, Any]]:
    """The first frame of a foreign file in a browser that is already open: cold, and with programs."""
    file = str(harness.data() / _FOREIGN)
    with tempfile.TemporaryDirectory() as kept:
        for case in ("cold", "programs"):
            spent = []
            for _ in range(_STARTS + (case == "programs")):
                with tempfile.TemporaryDirectory() as folder:
                    process = Preparation([file], folder if case == "cold" else kept)
                    page = browser.new_page(viewport={"width": 1100, "height": 700})
                    page.goto(process.url)
                    page.wait_for_function(
                        f"() => {_CANVAS}?.stats?.draws > 0 && {_CANVAS}.pixels?.()?.message", polling=50
                    )
                    page.screenshot()  # waits for the renderer
                    spent.append(time.perf_counter() - process.began)
                    page.close()
                    process.close()
            times = np.sort(spent[case == "programs" :])  # the first one compiles
            yield {
                "benchmark": "view",
                "case": f"{case}: first frame on the screen",
                "seconds": float(np.median(times)),
                "spread": float(np.ptp(times) / np.median(times)),
                "compile_seconds": 0.0,
                "error": None,
                "bytes": 0,
            }


def pages(browser: Any, folder: pathlib.Path | None) -> Iterator[dict[str, Any]]:
    """What a browser draws of exported pages. Pictures are written into a folder: the browser's, ours, Mitsuba's."""
    for name, light_name in _PAGES.items():
        path = harness.data() / "env" / accuracy.LIGHTS[light_name]
        scene, surfaces = _subject(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of negative pixels of lights
            light = prt.load_environment(path)
            made = prt.precompute(scene, system="lobe", progress=False)
            relit = made.centered()
            with tempfile.TemporaryDirectory() as temporary:
                piece = view.export(relit, f"{temporary}/page.html", environments={light_name: light})
                drawn, seconds = _drawn(browser, piece.path)
        height, width = drawn.shape[:2]
        camera = dataclasses.replace(relit.camera, width=width, height=height)
        picture = np.asarray(relit.picture(light, camera, background=None))[..., :3]
        camera = dataclasses.replace(made.camera, width=width, height=height)
        request = {"camera": camera, "samples": accuracy.SAMPLES, "model": "gltf", "bounces": 0}
        total, blocks, sides = assets.rendered(surfaces, path, request, picture, None)
        halves = np.where(sides[1][..., None], 0, total / blocks)
        truth = denoised.Truth(halves, 2 * blocks * accuracy.SAMPLES)
        inside = truth.inside & (drawn[..., 3] > 0.999)
        if folder is not None:
            sheets = [assets.sheet(shown, halves.mean(0), truth.inside)[0] for shown in (drawn[..., :3], picture)]
            assets.write(folder / f"{name.replace(', ', '_').replace(' ', '-')}.png", np.concatenate(sheets))
        yield {
            "benchmark": "view",
            "case": f"page: {name}, {light_name}",
            "seconds": seconds,
            "compile_seconds": 0.0,
            "error": float(image.relative_l2(drawn[inside][:, :3], picture[inside])),
            "bytes": piece.nbytes,
            "stated": piece.error,
            "judged": truth.error(drawn[..., :3]),
            "picture": truth.error(picture),
        }


def _subject(name: str) -> tuple[prt.Scene, Sequence[asset_files.Surface]]:
    """A mesh and a material of the table of errors, or a file, for jaxprt and for the judge."""
    if ", " not in name:
        path = harness.data() / "foreign" / name
        return prt.load_scene(path), asset_files.read(path)
    mesh, material = name.split(", ")
    subject = accuracy.subject_of(mesh, material, _EDGE)
    return dataclasses.replace(subject.scene, cameras=[subject.camera]), subject.surfaces


def _drawn(browser: Any, path: pathlib.Path) -> tuple[np.ndarray, float]:
    """Radiance and coverage of the picture at rest of a page, and seconds until it was there."""
    page = browser.new_page(viewport={"width": _EDGE + 264, "height": _EDGE})
    began = time.perf_counter()
    page.goto(path.as_uri())
    page.wait_for_function(f"() => {_CANVAS}?.pixels?.()?.stats.samples === 9", timeout=300_000)
    seconds = time.perf_counter() - began
    found = page.evaluate(
        f"() => {{ const r = {_CANVAS}.pixels().read(); return {{ ...r, data: Array.from(r.data) }}; }}"
    )
    page.close()
    return np.reshape(found["data"], (found["height"], found["width"], 4))[::-1], seconds


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--pictures", type=pathlib.Path, metavar="FOLDER", help="write pictures of pages beside others")
    arguments = parser.parse_args(options)
    for line in preparations(quick=arguments.quick):
        harness.report(line, arguments.output)
    with browsing() as browser:
        for line in () if arguments.quick or browser is None else first_frames(browser):
            harness.report(line, arguments.output)
        for line in () if arguments.quick or browser is None else pages(browser, arguments.pictures):
            harness.report(line, arguments.output)
    for bounces in (0,) if arguments.quick else (0, 1, 2):
        for line in hands(bounces, quick=arguments.quick):
            harness.report(line, arguments.output)


if __name__ == "__main__":
    main()
