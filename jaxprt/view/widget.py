"""The viewer in a notebook, as an anywidget."""

import base64
import html
import pathlib
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import anywidget
import traitlets
from IPython.display import display

from jaxprt import files
from jaxprt.files.inputs import JsonObject
from jaxprt.view import browser
from jaxprt.view.session import Session

# JupyterLab stacks the outputs of a cell. The static picture disappears when the viewer has received its first answer.
# Without a kernel there is no viewer, and the style hides the text that JupyterLab shows in its place.
_STYLE = """<style>
.jp-OutputArea-child:has(.jaxprt-picture):has(+ .jp-OutputArea-child .jaxprt-live),
.jp-OutputArea-child:has(.jaxprt-picture) + .jp-OutputArea-child .jp-OutputArea-output.jupyter-widgets:not(:has(*))
{ display: none }
</style>"""


class Viewer(anywidget.AnyWidget):
    """A viewer in a notebook cell.

    Threads of the widget compute the answers. Full-quality pictures and files therefore block neither looks nor the
    kernel. At most one full-quality picture is computed at a time.

    Attributes:
        session: The session that it shows.
        height: Height of the viewer in pixels of the page.
    """

    _esm = browser.module()
    height = traitlets.Int(480, min=1).tag(sync=True)

    def __init__(self, session: Session, *, height: int = 480):
        """Makes a viewer of a session."""
        super().__init__(height=height)
        self.session = session
        self._looks, self._rests, self._files = (
            ThreadPoolExecutor(1, thread_name_prefix="jaxprt-view") for _ in range(3)
        )
        self.on_msg(self._heard)

    def close(self) -> None:
        """Removes the viewer from the notebook."""
        for executor in (self._looks, self._rests, self._files):
            executor.shutdown(wait=False, cancel_futures=True)
        super().close()

    def __repr__(self) -> str:
        """The names of the systems and lights; the same in every run."""
        return f"Viewer of {', '.join(self.session.stages.scene.scene.names)}"

    def _ipython_display_(self, **options: Any) -> None:
        """Displays a picture and the widget that replaces it. A saved notebook shows the picture without a kernel."""
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "picture.png"
            files.write_png(path, self.session.picture())
            picture = base64.b64encode(path.read_bytes()).decode()
        words = repr(self)
        page = f'<img class="jaxprt-picture" alt="{html.escape(words)}" src="data:image/png;base64,{picture}">{_STYLE}'
        display({"text/html": page, "image/png": picture, "text/plain": words}, raw=True)
        bundle = super()._repr_mimebundle_(**options)
        if bundle is not None:
            data, more = bundle
            data.pop("text/plain")  # pages would show it below the picture
            display(data, metadata=more, raw=True)

    def _heard(self, widget: Any, message: Any, buffers: Sequence[Any]) -> None:
        if isinstance(message, dict) and isinstance(message.get("content"), dict):
            kinds = {"still": self._rests, "exact": self._rests, "picture": self._rests, "drop": self._files}
            threads = kinds.get(str(message["content"].get("kind")), self._looks)
            threads.submit(self._answer, message, [bytes(buffer) for buffer in buffers])

    def _answer(self, message: JsonObject, buffers: list[bytes]) -> None:
        content, arrays = self.session.answer(message["content"], buffers)
        self.send({"id": message.get("id"), "content": content}, arrays)
