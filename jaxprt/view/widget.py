"""The viewer in a notebook, by anywidget."""

import base64
import pathlib
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import anywidget
import traitlets

from jaxprt import files
from jaxprt.view.server import MODULE
from jaxprt.view.session import Session


class Viewer(anywidget.AnyWidget):
    """A viewer in a cell.

    Answers are made in threads of its own, so that a picture at rest does not keep looks waiting, nor the kernel. Of
    pictures at rest there is one at a time.

    Attributes:
        session: What it shows.
        height: Of the viewer in the page's pixels.
    """

    _esm = MODULE
    height = traitlets.Int(480, min=1).tag(sync=True)

    def __init__(self, session: Session, *, height: int = 480):
        """Shows a session."""
        super().__init__(height=height)
        self.session = session
        self._looks, self._rests = (ThreadPoolExecutor(1, thread_name_prefix="jaxprt-view") for _ in range(2))
        self.on_msg(self._heard)

    def close(self) -> None:
        """Takes the viewer out of the notebook."""
        for each in (self._looks, self._rests):
            each.shutdown(wait=False, cancel_futures=True)
        super().close()

    def __repr__(self) -> str:
        """The names of what it shows, the same in every run."""
        return f"Viewer of {', '.join(part.name for part in self.session.stages.scene.scene.parts)}"

    def _repr_mimebundle_(self, **options: Any) -> tuple[dict, dict] | None:
        """The widget, and a picture for where there is no kernel: a saved notebook, or its page on the web."""
        found = super()._repr_mimebundle_(**options)
        if found is None:
            return None
        data, more = found
        with tempfile.TemporaryDirectory() as folder:
            path = pathlib.Path(folder) / "picture.png"
            files.write_png(path, self.session.picture())
            picture = base64.b64encode(path.read_bytes()).decode()
        return {**data, "image/png": picture}, more

    def _heard(self, widget: Any, message: Any, buffers: Sequence[Any]) -> None:
        if isinstance(message, dict) and isinstance(message.get("content"), dict):
            threads = self._rests if message["content"].get("kind") in ("still", "exact") else self._looks
            threads.submit(self._answer, message, [bytes(each) for each in buffers])

    def _answer(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        content, arrays = self.session.answer(message["content"], buffers)
        self.send({"id": message.get("id"), "content": content}, arrays)
