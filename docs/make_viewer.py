"""Makes pictures/viewer.gif: plays the viewer in headless Chromium, `python docs/make_viewer.py`.

Needs the extra `test`, for playwright, and Chromium as `chromium`. Takes some minutes on two cores.
"""

import io
import math
import pathlib
import shutil
import tempfile

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import jaxprt as prt
from jaxprt.scene import builtin

PICTURE = pathlib.Path(__file__).parents[1] / "pictures" / "viewer.gif"
SIZE = (480, 300)
SHOWN = (768, 480)  # the page, which is drawn larger and then reduced
MOST_BYTES = 1_500_000
MILLISECONDS = 110  # of a frame
COLORS = 96
_SWITCHES = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_ROOT = "document.querySelector('#viewer').shadowRoot"


def relit(folder: str) -> prt.RelitScene:
    """Chess pieces of red plastic on a board, by eight lobes."""
    pieces, light, dark = prt.scene.mesh.split(builtin.chess())
    plastic = prt.scene.TexturedMaterial(base_color=(0.4, 0.1, 0.08), metallic=0.0, roughness=0.4)
    squares = [
        prt.scene.TexturedMaterial(base_color=color, metallic=0.0, specular=0.0)
        for color in ((0.6, 0.55, 0.45), (0.12, 0.08, 0.06))
    ]
    parts = zip(("pieces", "light squares", "dark squares"), (pieces, light, dark), (plastic, *squares), strict=True)
    scene = prt.Scene([prt.Part(*each) for each in parts])
    return prt.precompute(scene, system=prt.relit.Lobes(8), path=folder)


def settle(page: Page, *, rest: bool = False) -> None:
    """Waits until the newest look is shown, or the picture at rest as well."""
    stats, more = f"{_ROOT}.querySelector('.canvas')?.stats", "&& s.stills > 0" if rest else ""
    page.wait_for_function(f"() => {{ const s = {stats}; return s && s.shown >= 0 && s.shown === s.seq {more}; }}")


def frame(page: Page) -> Image.Image:
    """What the page shows."""
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB").resize(SIZE, Image.Resampling.LANCZOS)


def play(page: Page) -> list[Image.Image]:
    """Orbits, turns the light, and drags a material through roughness and reflectance: 36 frames."""
    frames = []
    settle(page, rest=True)
    page.evaluate(f"() => {{ {_ROOT}.querySelector('.line').style.visibility = 'hidden'; }}")
    middle = (SHOWN[0] * 0.35, SHOWN[1] * 0.55)

    def drag(start, places) -> None:
        page.mouse.move(*start)
        page.mouse.down()
        for place in places:
            page.mouse.move(*place)
            settle(page)
            frames.append(frame(page))
        page.mouse.up()
        settle(page)

    drag(middle, [(middle[0] + 9 * k, middle[1] + 30 * math.sin(k / 4)) for k in range(1, 13)])
    page.keyboard.down("Shift")
    drag(middle, [(middle[0] + 24 * k, middle[1]) for k in range(1, 13)])
    page.keyboard.up("Shift")
    plane = page.locator("canvas.plane").first
    plane.scroll_into_view_if_needed()
    box = plane.bounding_box()
    assert box is not None

    def place(x: float, y: float) -> tuple[float, float]:
        return box["x"] + x * box["width"], box["y"] + (1 - y) * box["height"]

    path = [(0.3 + 0.6 * k / 4, 0.25) for k in range(5)] + [
        (0.9 - 0.8 * k / 7, 0.25 + 0.65 * k / 7) for k in range(1, 8)
    ]
    drag(place(*path[0]), [place(*each) for each in path])
    return frames


def write(frames: list[Image.Image]) -> int:
    """Writes the frames with one palette for all; the number of bytes."""
    sheet = Image.new("RGB", (SIZE[0], SIZE[1] * 3))
    for row, number in enumerate((0, len(frames) // 2, len(frames) - 1)):
        sheet.paste(frames[number], (0, row * SIZE[1]))
    palette = sheet.quantize(COLORS)
    reduced = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    reduced[0].save(
        PICTURE, save_all=True, append_images=reduced[1:], duration=MILLISECONDS, loop=0, optimize=True, disposal=1
    )
    return PICTURE.stat().st_size


def main() -> None:
    """Makes the picture.

    Raises:
        ValueError: It is too large.
    """
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        server = prt.view.serve(relit(f"{folder}/scene.prt"))
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=_SWITCHES)
        page = browser.new_page(viewport={"width": SHOWN[0], "height": SHOWN[1]})
        page.set_default_timeout(120_000)
        page.goto(server.url)
        frames = play(page)
        browser.close()
        server.close()
    count = write(frames)
    print(f"{PICTURE}: {len(frames)} frames, {count:,} bytes")
    if count > MOST_BYTES:
        raise ValueError(f"the picture must have at most {MOST_BYTES:,} bytes, got {count:,}")


if __name__ == "__main__":
    main()
