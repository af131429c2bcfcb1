"""The viewer in a notebook: questions of the browser's module come as messages, answers go back with their numbers."""

import base64
import io
import threading

import numpy as np
import pytest
from PIL import Image

from jaxprt import view


@pytest.fixture
def viewer(systems, lights):
    made = view.view(systems, environments=lights, height=300)
    yield made
    made.close()


@pytest.fixture
def heard(viewer, monkeypatch):
    """What the viewer sends, and an event that is set with it."""
    sent, event = [], threading.Event()

    def send(content, buffers=None):
        sent.append((content, buffers))
        event.set()

    monkeypatch.setattr(viewer, "send", send)
    return sent, event


def test_an_answer_has_the_number_of_its_question(viewer, heard, look):
    sent, event = heard
    viewer._heard(viewer, {"id": "q7", "content": look}, [])
    assert event.wait(60)
    ((content, buffers),) = sent
    assert content["id"] == "q7"
    assert content["content"] == viewer.session.answer(look).content | {"ms": content["content"]["ms"]}
    assert buffers == viewer.session.answer(look).buffers


def test_what_is_no_question_is_not_answered(viewer, heard, look):
    sent, event = heard
    for message in ("hello", {"id": "q"}, {"id": "q", "content": 3}):
        viewer._heard(viewer, message, [])
    viewer._heard(viewer, {"id": "last", "content": look}, [memoryview(b"")])
    assert event.wait(60)
    assert [content["id"] for content, _ in sent] == ["last"]


def test_a_saved_notebook_has_a_picture_and_a_widget_after_it(viewer, monkeypatch):
    shown = []
    monkeypatch.setattr("jaxprt.view.widget.display", lambda data, **options: shown.append(data))
    viewer._ipython_display_()
    picture, widget = shown
    assert list(widget) == ["application/vnd.jupyter.widget-view+json"]
    assert picture["text/plain"] == "Viewer of ball, ground"
    assert picture["image/png"] in picture["text/html"]
    color = np.asarray(Image.open(io.BytesIO(base64.b64decode(picture["image/png"]))))
    assert color.shape == (360, 480, 3)
    assert np.ptp(color) > 100
    ball = color[180, 240].astype(int)
    assert ball[0] > ball[2]  # which is red


def test_without_anywidget_the_error_says_what_to_install(systems, lights, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "jaxprt.view.widget", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxprt\[view\]'"):
        view.view(systems, environments=lights)
