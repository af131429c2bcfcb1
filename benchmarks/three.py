"""What error has a picture of three.js with transfer, beside plain image based light? The judge is Mitsuba 3.

    JAXPRT_NODE_MODULES=.. python -m benchmarks.three [--quick] [--only TEXT] [--edge N] [--samples N] [--store FOLDER]
        [--pictures FOLDER] [--output FILE]

JAXPRT_NODE_MODULES names a folder of npm packages: three, and where they are to be measured @google/model-viewer and
babylonjs with babylonjs-loaders. Without Chromium or three only jaxprt's own pictures are measured.

All renderers draw one scene in one light file from one camera, in linear radiance without a tone curve, with 4 x 4
samples a pixel. `error` is relative L2 in direct light over the pixels that surfaces fill, `bounces_error` is against
light that surfaces reflect too, and `bias` says how much brighter the picture is than Mitsuba's. `bytes` are those of
the file, and `seconds` of a frame of as many samples until its pixels can be read, in Chromium's software renderer.
"""

import base64
import contextlib
import functools
import http.server
import os
import pathlib
import shutil
import statistics
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

import jaxprt as prt
from benchmarks import asset_files, asset_scenes, assets, denoised, harness
from jaxprt import view
from jaxprt.scene import Camera, Part, Scene, TexturedMaterial, builtin, load_environment, load_mesh
from jaxprt.scene.camera import orbit
from jaxprt.scene.mesh import ground_plane, make_mesh

EDGE, SAMPLES, PER_PIXEL = 256, 256, 4
GROUND = 10_000  # vertices
FRAMES = 5
GOLD = 0.8, 0.6, 0.4
FIGURES = {
    "gold": TexturedMaterial(base_color=GOLD, metallic=1.0, roughness=0.3),
    "matte": TexturedMaterial(base_color=GOLD, metallic=0.0, specular=0.0),
}
FILES = {"cake": "foreign/cakeBirthday.glb", "truck": "scenes/CesiumMilkTruck.glb"}
STUDIO, COURTYARD = "polyhaven_studio_1k.exr", "polyhaven_courtyard_1k.exr"
DEGREES = 3, 5
SWITCHES = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
PAGES = pathlib.Path(__file__).with_name("three_pages")
PEERS = {"model-viewer": "@google/model-viewer", "babylon": "babylonjs-loaders"}


class Case(NamedTuple):
    """What is seen: a scene, the file of its light, and the camera."""

    name: str
    scene: Scene
    light: pathlib.Path
    camera: Camera


def main(options: Sequence[str] | None = None) -> None:
    parser = harness.parser(str(__doc__).splitlines()[0])
    parser.add_argument("--only", metavar="TEXT", default="", help="scenes whose names have TEXT")
    parser.add_argument("--edge", type=int, metavar="N", default=EDGE, help="pixels along an edge")
    parser.add_argument("--samples", type=int, metavar="N", default=SAMPLES, help="of each of Mitsuba's two pictures")
    parser.add_argument("--store", type=pathlib.Path, metavar="FOLDER", help="keep what is precomputed, and files")
    parser.add_argument(
        "--pictures", type=pathlib.Path, metavar="FOLDER", help="write theirs, Mitsuba's, 4 x difference"
    )
    arguments = parser.parse_args(options)
    edge, samples = (32, 64) if arguments.quick else (arguments.edge, arguments.samples)
    with tempfile.TemporaryDirectory() as temporary:
        store = arguments.store or pathlib.Path(temporary)
        store.mkdir(parents=True, exist_ok=True)
        for case in cases(store, arguments.only, edge, quick=arguments.quick):
            for line in measure(case, store, samples, arguments.pictures, size=16 if arguments.quick else 64):
                harness.report(line, arguments.output)


def cases(store: pathlib.Path, only: str, edge: int, *, quick: bool) -> Iterator[Case]:
    """What is measured; the quick case needs no data."""
    if quick:
        light = store / "light.exr"
        radiance = np.full((16, 32, 3), 0.2, np.float32)
        radiance[3:5, 18:22] = 20.0
        prt.files.write_exr(light, radiance)
        yield standing("ball", [Part("ball", builtin.sphere(rings=8, sectors=12), FIGURES["gold"])], light, edge, 100)
        return
    data = harness.data()
    for name, material in FIGURES.items():
        if only in name:
            mesh = load_mesh(data / "meshes/stanford_bunny.ply")
            yield standing(name, [Part("bunny", mesh, material)], data / "env" / STUDIO, edge, GROUND)
    for name, path in FILES.items():
        if only in name:
            yield standing(name, prt.load_scene(data / path).parts, data / "env" / COURTYARD, edge, GROUND)


def standing(name: str, parts: Sequence[Part], light: pathlib.Path, edge: int, vertices: int) -> Case:
    """Parts on a matte ground."""
    counts = np.cumsum([0, *(len(part.mesh.position) for part in parts)])
    position = np.concatenate([np.asarray(part.mesh.position) + np.asarray(part.mesh.origin) for part in parts])
    face = np.concatenate([np.asarray(part.mesh.face) + first for part, first in zip(parts, counts, strict=False)])
    mesh = make_mesh(position, face)
    matte = TexturedMaterial(base_color=(0.5, 0.5, 0.5), metallic=0.0, specular=0.0)
    ground = Part("ground", ground_plane(mesh, vertices=vertices), matte)
    return Case(name, Scene([*parts, ground]), light, orbit(mesh, azimuth=0.35, elevation=0.3, width=edge, height=edge))


def measure(
    case: Case, store: pathlib.Path, samples: int, pictures: pathlib.Path | None, *, size: int
) -> Iterator[dict[str, Any]]:
    """The lines of a scene."""
    name = case.name.replace(" ", "_")
    path, light = store / f"{name}.prt", load_environment(case.light, size=size)
    relit = prt.precompute(case.scene, system="lobe", size=size, path=path, refine=False, progress=False)
    plain = store / f"{name}.glb"
    view.export_gltf(relit, plain, degree=None)
    files = {"plain": plain} | {degree: store / f"{name}_{degree}.glb" for degree in DEGREES}
    for degree in DEGREES:
        view.export_gltf(relit, files[degree], environments={"light": light}, degree=degree)
    halves, undefined = truths(plain, case, samples, store / f"{name}_{case.camera.width}_{samples}.npz")

    def line(renderer: str, drawn: np.ndarray, seconds: float, held: int) -> dict[str, Any]:
        left_out = undefined | (drawn[..., 3] < 0.999)
        direct, bounces = (denoised.Truth(np.where(left_out[..., None], 0, half), 2 * samples) for half in halves)
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            sheet, _ = assets.sheet(drawn, direct.mean, direct.inside)
            assets.write(pictures / f"{name}_{renderer.replace(' ', '_')}.png", sheet)
        errors = {"error": direct.error(drawn), "bounces_error": bounces.error(drawn), "bias": direct.bias(drawn)}
        return {
            **{"benchmark": "three", "case": f"{case.name}, {renderer}", "seconds": seconds, "compile_seconds": 0.0},
            **{**errors, "noise": direct.noise, "bytes": held, "vertices": relit.vertices},
        }

    for renderer, file, drawn, seconds in browsers(files, case, store):
        yield line(renderer, drawn, seconds, file.stat().st_size)
    start = time.perf_counter()
    drawn = np.asarray(relit.picture(light, case.camera, background=None))
    yield line("jaxprt", drawn, time.perf_counter() - start, prt.memory(relit))


def truths(path: pathlib.Path, case: Case, samples: int, known: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Mitsuba's pictures of a file [2 2 h w 4], in direct and in all light, and the pixels that it does not define."""
    if not known.is_file():
        surfaces, halves, undefined = asset_files.read(path), [], np.zeros(())
        for bounces in (0, assets.BOUNCES):
            seen = asset_scenes.View(surfaces, case.light, case.camera, model="gltf", bounces=bounces)
            halves.append([seen.picture(samples, seed) for seed in (1, 2)])
            undefined = seen.sides()[1]
        np.savez(known, halves=np.array(halves), undefined=undefined)
    with np.load(known) as stored:
        return stored["halves"], stored["undefined"]


def browsers(
    files: dict[Any, pathlib.Path], case: Case, store: pathlib.Path
) -> Iterator[tuple[str, pathlib.Path, np.ndarray, float]]:
    """Name, file, picture, and seconds of a frame of each renderer that can be had."""
    modules = pathlib.Path(os.environ.get("JAXPRT_NODE_MODULES", "."))
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None or not (modules / "three").is_dir():
        return
    runs = [("three.js", "three.html", files["plain"], {})]
    runs += [(f"three.js, transfer of degree {k}", "three.html", files[k], {"transfer": True}) for k in DEGREES]
    runs += [
        (name, f"{name}.html", files["plain"], {}) for name, folder in PEERS.items() if (modules / folder).is_dir()
    ]
    light = store / f"{case.light.stem}.hdr"
    import OpenImageIO

    OpenImageIO.ImageBuf(str(case.light)).write(str(light))
    shot = {"edge": PER_PIXEL * case.camera.width, "frames": FRAMES, "light": f"/store/{light.name}"}
    shot |= {name: np.asarray(getattr(case.camera, name), float).tolist() for name in ("eye", "target", "up")}
    shot["angle"] = float(np.degrees(case.camera.field_of_view))
    folders = {"": PAGES, "node_modules": modules, "store": store, "jaxprt-three": pathlib.Path(view.__file__).parent}
    folders["jaxprt-three"] /= "browser"
    from playwright.sync_api import sync_playwright

    with served(folders) as address, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=SWITCHES)
        for name, page, file, options in runs:
            tab = browser.new_page()
            tab.set_default_timeout(300_000)
            tab.goto(f"{address}/{page}")
            tab.wait_for_function("() => window.picture")
            drawn = tab.evaluate("(shot) => window.picture(shot)", shot | options | {"file": f"/store/{file.name}"})
            tab.close()
            samples = np.frombuffer(base64.b64decode(drawn["data"]), "<f4")
            edge = case.camera.width
            mean = samples.reshape(edge, PER_PIXEL, edge, PER_PIXEL, 4).mean((1, 3))[::-1]
            yield name, file, mean, statistics.median(drawn["milliseconds"]) / 1000
        browser.close()


@contextlib.contextmanager
def served(folders: dict[str, pathlib.Path]) -> Iterator[str]:
    """Address of a server that has folders, each below its name."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            first, _, rest = path.lstrip("/").partition("?")[0].partition("/")
            return str(folders[first] / rest if first in folders else folders[""] / first)

        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


if __name__ == "__main__":
    main()
