"""Makes pictures of the viewer in headless Chromium: `python -m docs.make_viewer` plays it for pictures/viewer.webp.

`JAXPRT_DATA=FOLDER python -m docs.make_viewer stills` makes those at rest of docs/guides/viewer.md, on screens of
three sizes, with the bust of docs/make_gallery.py.

Each frame is shown for a fixed share of what the viewer took for it, from the gesture to the picture, on the machine
that ran it. `SPEED` says how much faster that is, and README names it beside the picture.
Needs the extra `test`, for playwright, and Chromium as `chromium`. Takes some minutes on two cores.
"""

import io
import math
import pathlib
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

import jaxprt as prt
from docs import make_gallery
from jaxprt.scene import builtin

PICTURE = pathlib.Path(__file__).parents[1] / "pictures" / "viewer.webp"
SIZE = (640, 400)
SHOWN = (960, 600)  # the page, which is drawn larger and then reduced
MOST_BYTES = 2_500_000
STILLS = {"laptop": (1100, 700), "large": (3840, 2000), "phone": (390, 844)}  # pages
WIDEST = 1280  # pixels of a still in its file
SPEED = 6  # frames are shown so many times as fast as they were made
LEAST, RESTING = 40, 1200  # milliseconds that a frame is shown at least, and that a picture at rest is
QUALITY = 82  # of the frames, which keep their own colors
_SWITCHES = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_ROOT = "document.querySelector('#viewer').shadowRoot"


def relit(folder: str) -> prt.RelitScene:
    """Chess pieces of metal on a board, and a floor below, by eight lobes."""
    pieces, light, dark = prt.scene.mesh.split(builtin.chess())
    metal = prt.scene.TexturedMaterial(base_color=(0.9, 0.62, 0.3), metallic=1.0, roughness=0.3)
    colors = {"light squares": (0.6, 0.55, 0.45), "dark squares": (0.12, 0.08, 0.06), "floor": (0.35, 0.37, 0.4)}
    matte = {
        name: prt.scene.TexturedMaterial(base_color=color, metallic=0.0, specular=0.0) for name, color in colors.items()
    }
    square = builtin.plane(cells=24)
    floor = prt.scene.mesh.make_mesh(8 * np.asarray(square.position) - [0, 0.26, 0], square.face)
    meshes = {"light squares": light, "dark squares": dark, "floor": floor}
    parts = [prt.Part("pieces", pieces, metal), *(prt.Part(name, mesh, matte[name]) for name, mesh in meshes.items())]
    camera = prt.Camera([5.2, 4.4, 7.0], [0.0, 0.3, 0.0], [0.0, 1.0, 0.0], 0.6, *SIZE)
    return prt.precompute(prt.Scene(parts, cameras=[camera]), system=prt.relit.Lobes(8), path=folder)


class Film:
    """Frames of a page, with the milliseconds for which each is shown."""

    def __init__(self, page: Page):
        """Starts with no frames."""
        self.page, self.frames, self.milliseconds, self.stills = page, [], [], 0

    def settle(self) -> None:
        """Waits until the newest look is shown."""
        stats = f"{_ROOT}.querySelector('.canvas')?.stats"
        shown = f"() => {{ const s = {stats}; return s && s.shown >= 0 && s.shown === s.seq; }}"
        self.page.wait_for_function(shown, polling="raf")

    def take(self, milliseconds: float) -> None:
        """Adds what the page shows."""
        shown = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        self.frames.append(shown.resize(SIZE, Image.Resampling.LANCZOS))
        self.milliseconds.append(milliseconds)

    def rest(self) -> None:
        """Adds the picture at rest, once it has come: nothing has been drawn for two seconds."""
        stats = f"{_ROOT}.querySelector('.canvas').stats"
        self.page.wait_for_function(f"(known) => {stats}.stills > known", arg=self.stills)
        draws, before = f"() => {stats}.draws", -1
        while before != (now := self.page.evaluate(draws)):
            before = now
            self.page.wait_for_timeout(2000)
        self.stills = self.page.evaluate(f"() => {stats}.stills")
        self.take(RESTING)

    def drag(self, start: tuple[float, float], places: Sequence[tuple[float, float]]) -> None:
        """Adds a frame for each place of a drag."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        for place in places:
            began = time.perf_counter()
            self.page.mouse.move(*place)
            self.settle()
            self.page.evaluate(
                "() => new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))"
            )
            self.take(max(1000 * (time.perf_counter() - began) / SPEED, LEAST))
        self.page.mouse.up()
        self.settle()


def play(page: Page) -> Film:
    """Orbits, turns the light by its slider, and drags the metal to a plastic and through roughness and reflectance."""
    film = Film(page)
    film.settle()
    page.locator("select", has=page.locator("option", has_text="agx")).select_option(label="agx")
    page.get_by_text("View", exact=True).click()  # folds what the film does not use
    film.rest()
    middle = (SHOWN[0] * 0.35, SHOWN[1] * 0.55)
    film.drag(middle, [(middle[0] + 9 * k, middle[1] + 30 * math.sin(k / 4)) for k in range(1, 11)])
    film.rest()

    def slide(name: str, start: float, end: float, steps: int) -> None:
        slider = page.get_by_label(name, exact=True).first
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        assert box is not None
        across = [box["x"] + 8 + (box["width"] - 16) * (start + (end - start) * k / steps) for k in range(steps + 1)]
        film.drag((across[0], box["y"] + box["height"] / 2), [(x, box["y"] + box["height"] / 2) for x in across[1:]])

    slide("rotation °", 0.5, 0.85, 10)
    film.rest()
    slide("roughness", 0.3, 0.6, 5)
    slide("metallic", 1.0, 0.0, 6)
    plane = page.locator("canvas.plane").first
    plane.scroll_into_view_if_needed()
    box = plane.bounding_box()
    assert box is not None
    path = [(0.6 - 0.45 * k / 8, 0.2 + 0.35 * k / 8) for k in range(9)]
    places = [(box["x"] + x * box["width"], box["y"] + (1 - y) * box["height"]) for x, y in path]
    film.drag(places[0], places[1:])
    film.rest()
    return film


def write(frames: list[Image.Image], milliseconds: list[float]) -> int:
    """Writes the frames; the number of bytes."""
    lasting = [round(each) for each in milliseconds]
    frames[0].save(
        PICTURE, save_all=True, append_images=frames[1:], duration=lasting, loop=0, quality=QUALITY, method=6
    )
    return PICTURE.stat().st_size


@contextmanager
def viewer(
    scene: prt.RelitScene, size: tuple[int, int], environments: Mapping[str, prt.Environment] | None = None
) -> Iterator[Page]:
    """A page of some size that shows a scene in the viewer."""
    with sync_playwright() as playwright:
        server = prt.view.serve(scene, environments=environments)
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=_SWITCHES)
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(600_000)
        page.goto(server.url)
        yield page
        browser.close()
        server.close()


def stills() -> None:
    """Writes what the viewer shows at rest on screens of three sizes."""
    shot, scene = make_gallery.small_bust()
    for name, size in STILLS.items():
        with viewer(scene, size, {"studio": shot.light}) as page:
            film = Film(page)
            film.settle()
            tone = page.locator("select", has=page.locator("option", has_text="agx"))
            if tone.is_visible():  # the panel of a phone is folded
                tone.select_option(label="agx")
            film.rest()
            image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        image.thumbnail((WIDEST, WIDEST), Image.Resampling.LANCZOS)
        path = make_gallery.FOLDER / f"viewer_{name}.jpg"
        image.save(path, quality=QUALITY)
        print(path, f"{path.stat().st_size:,} bytes", flush=True)


def main() -> None:
    """Makes the picture.

    Raises:
        ValueError: It is too large.
    """
    with tempfile.TemporaryDirectory() as folder, viewer(relit(f"{folder}/scene.prt"), SHOWN) as page:
        film = play(page)
    count = write(film.frames, film.milliseconds)
    moving = sorted(each for each in film.milliseconds if each != RESTING)
    middle = SPEED * moving[len(moving) // 2]
    print(f"{PICTURE}: {len(film.frames)} frames, half of them made in {middle:.0f} ms at most, {count:,} bytes")
    if count > MOST_BYTES:
        raise ValueError(f"the picture must have at most {MOST_BYTES:,} bytes, got {count:,}")


if __name__ == "__main__":
    stills() if sys.argv[1:] == ["stills"] else main()
