"""A tab of a real browser that shows a viewer, and the gestures of a hand in it."""

import base64
import io
import time

import numpy as np
from PIL import Image

CANVAS = "document.querySelector('#viewer').shadowRoot.querySelector('.canvas')"
TOLD = "document.querySelector('#viewer').shadowRoot.querySelector('.told').textContent"
SMALL = f"""[...{CANVAS}.getRootNode().querySelectorAll('.gallery canvas')].map((canvas) =>
  Array.from(canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data))"""
WIDTH = 584  # 320 for the picture, and the panel


class Hand:
    """A tab that shows a viewer."""

    def __init__(self, browser, url):
        # The camera stops where the hand lets it go.
        self.page = browser.new_page(viewport={"width": WIDTH, "height": 320}, reduced_motion="reduce")
        self.page.set_default_timeout(180_000)  # two workers may take all cores; a picture at rest compiles for 40 s
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda said: "Security Policy" in said.text and self.errors.append(said.text))
        self.page.goto(url)
        self.wait("shown >= 0 && stats.shown === stats.seq")

    def stats(self):
        return self.page.evaluate(f"() => ({CANVAS}).stats")

    def state(self):
        return self.page.evaluate(f"() => ({CANVAS}).state")

    def camera(self):
        return self.page.evaluate(f"() => {{ const c = ({CANVAS}).camera(); return {{ ...c, eye: c.eye }}; }}")

    def wait(self, condition, seconds=180):
        """Until something is true of the counters."""
        self.page.wait_for_function(
            f"() => {{ const stats = ({CANVAS})?.stats; return stats && stats.{condition}; }}", timeout=1000 * seconds
        )

    def settle(self):
        self.wait("shown === stats.seq")

    def still(self):
        """Until the picture at rest has faded in."""
        before = self.stats()["stills"]
        self.settle()
        self.wait(f"stills > {before}")
        self.finish()

    def finish(self):
        """Until the newest state is shown, and nothing more is drawn."""
        self.settle()
        drawn = -1
        while drawn != (now := self.stats()["draws"]):
            drawn = now
            time.sleep(0.5)

    def pictured(self):
        """Until the panel shows the scene small in each light."""
        self.page.wait_for_function(f"() => {SMALL}.every((pixel) => pixel.some(Boolean))")

    def small(self):
        """These pictures, rows of RGBA in bytes."""
        return [np.reshape(pixel, (54, 72, 4)) for pixel in self.page.evaluate(f"() => {SMALL}")]

    def drag(self, start, end, steps=5, button="left"):
        self.page.mouse.move(*start)
        self.page.mouse.down(button=button)
        self.page.mouse.move(*end, steps=steps)
        self.page.mouse.up(button=button)
        self.settle()

    def drop(self, files):
        """Drops files, whose bytes are given by their names."""
        self.page.evaluate(
            f"""(files) => {{
                const data = new DataTransfer();
                for (const [name, bytes] of files) data.items.add(new File([new Uint8Array(bytes)], name));
                const fields = {{ dataTransfer: data, bubbles: true, composed: true }};
                ({CANVAS}).dispatchEvent(new DragEvent("drop", fields));
            }}""",
            [[name, list(data)] for name, data in files.items()],
        )

    def pixels(self):
        """What the canvas shows, in [0, 1], read from its drawing."""
        text = self.page.evaluate(f"() => ({CANVAS}).toDataURL('image/png')")
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB")) / 255
