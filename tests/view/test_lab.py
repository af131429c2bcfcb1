"""The viewer in JupyterLab: the same module as on the page of its own, its questions sent as messages of a widget.

A real JupyterLab, of the extra `notebook`, and headless Chromium; skipped where one of them is missing.
JAXPRT_BROWSER_REQUIRED asks for Chromium alone: JupyterLab is no part of the extra `test`.
"""

import contextlib
import importlib.util
import json
import os
import pathlib
import subprocess
import sys
import time
import urllib.request

import pytest

TOKEN = "of-this-test"
PATIENCE = 120  # seconds: a busy machine compiles the kernel's programs anew
SOURCE = """
import jaxprt as prt
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
import numpy as np

material = TexturedMaterial(base_color=(0.6, 0.2, 0.1), metallic=0.0, specular=0.0)
scene = Scene([Part("ball", builtin.sphere(rings=8, sectors=16), material)])
relit = prt.precompute(scene, system=prt.relit.Harmonics(2), size=8, progress=False)
gradient = np.linspace(0.1, 1, 8)[:, None, None] * np.ones((6, 8, 8, 3))
prt.view.view(relit, environments={"gradient": Environment(gradient)}, height=300)
"""

if importlib.util.find_spec("jupyterlab") is None:
    pytest.skip("no jupyterlab: pip install 'jaxprt[notebook]'", allow_module_level=True)


@pytest.fixture
def lab(tmp_path):
    """JupyterLab's address, with settings and files of its own."""
    (tmp_path / "files").mkdir()
    cell = {"cell_type": "code", "id": "only", "metadata": {}, "source": SOURCE, "outputs": [], "execution_count": None}
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    notebook = {"cells": [cell], "metadata": {"kernelspec": kernel}, "nbformat": 4, "nbformat_minor": 5}
    (tmp_path / "files" / "play.ipynb").write_text(json.dumps(notebook))
    names = ["JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"]
    names += ["JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR"]
    own = {name: str(tmp_path / name) for name in names}
    root = str(pathlib.Path(__file__).parents[2])
    found = os.environ.get("PYTHONPATH")
    own["PYTHONPATH"] = root if not found else os.pathsep.join([root, found])
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root", "--port=0"]
    command += [f"--IdentityProvider.token={TOKEN}", f"--ServerApp.root_dir={tmp_path / 'files'}"]
    with (tmp_path / "log").open("w") as log:
        server = subprocess.Popen(command, env=os.environ | own, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield _url(server, pathlib.Path(own["JUPYTER_RUNTIME_DIR"]), tmp_path / "log")
    finally:
        server.terminate()  # which ends its kernels
        try:
            server.wait(20)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


def _url(server, folder, log):
    """Where the server listens, once it does."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        assert server.poll() is None, log.read_text()
        for path in folder.glob("jpserver-*.json"):
            try:
                url = json.loads(path.read_text())["url"]
                ask(url, "api/status")
                return url
            except (OSError, ValueError):
                continue  # half written, or not yet listening
        time.sleep(0.1)
    raise AssertionError(f"JupyterLab did not start: {log.read_text()}")


def ask(url, path):
    """What JupyterLab's interface answers."""
    request = urllib.request.Request(url + path, headers={"Authorization": f"token {TOKEN}"})
    with urllib.request.urlopen(request, timeout=30) as response:
        return json.loads(response.read() or "null")


@pytest.fixture
def page(browser, lab):
    """The notebook, opened and run."""
    page = browser.new_page(viewport={"width": 1100, "height": 800})
    page.set_default_timeout(1000 * PATIENCE)
    page.goto(f"{lab}doc/tree/play.ipynb?token={TOKEN}")
    from playwright.sync_api import TimeoutError as Late

    # A key that comes before the kernel does is lost on a busy machine.
    for _ in range(4):
        page.locator(".jp-Notebook .cm-content").first.click()
        page.keyboard.press("Shift+Enter")
        with contextlib.suppress(Late):
            page.locator("canvas.canvas").wait_for(timeout=250 * PATIENCE)
            break
    page.locator("canvas.canvas").wait_for()
    yield page
    page.close()


def stats(page):
    return page.locator("canvas.canvas").evaluate("canvas => canvas.stats")


def until(condition):
    """Waits for something to become true."""
    last = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < last, "waited in vain"
        time.sleep(0.1)


def drag(page):
    """Drags over the canvas from its middle."""
    box = page.locator("canvas.canvas").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 60, y + 20, steps=5)
    page.mouse.up()


def reopened(page, lab, browser, path):
    """The notebook, saved, closed and opened again by another browser; its kernel, restarted, knows no widget."""

    def saved():
        try:
            return json.loads(path.read_text())["cells"][0]["outputs"]
        except ValueError:  # half written
            return False

    page.keyboard.press("Control+s")
    until(saved)
    page.close()
    page = browser.new_context(viewport={"width": 1100, "height": 800}).new_page()
    page.set_default_timeout(1000 * PATIENCE)
    page.goto(f"{lab}doc/tree/play.ipynb?token={TOKEN}")
    return page


def test_a_drag_in_jupyterlab_is_answered_and_a_restarted_kernel_is_told_and_a_saved_notebook_shows_its_picture(
    page, lab, browser, tmp_path
):
    until(lambda: stats(page)["shown"] == stats(page)["seq"] > 0)
    assert not page.locator("img.jaxprt-picture").is_visible()  # the viewer has taken its place
    before = stats(page)
    drag(page)
    until(lambda: stats(page)["shown"] == stats(page)["seq"] > before["seq"])
    # A slow machine counts as a far kernel, which is asked a second time for what the eye cannot see.
    until(lambda: stats(page)["got"] == stats(page)["sent"] > before["got"])
    assert stats(page)["errors"] == 0
    until(lambda: stats(page)["stills"] > before["stills"])
    after = stats(page)

    page.get_by_role("menuitem", name="Kernel", exact=True).click()
    page.locator(".lm-Menu-itemLabel", has_text="Restart Kernel…").first.click()
    page.locator(".jp-Dialog .jp-mod-accept").click()
    until(lambda: ask(lab, "api/kernels")[0]["execution_state"] == "idle")
    drag(page)
    told = page.locator(".told", has_text="no answer from Python: the kernel was restarted; run the cell again")
    told.wait_for()
    drag(page)  # the page goes on
    assert stats(page)["seq"] > after["seq"]
    assert stats(page)["got"] == after["got"]

    page = reopened(page, lab, browser, tmp_path / "files" / "play.ipynb")
    words = page.get_by_text("Error displaying widget")
    words.wait_for(state="attached")
    assert not words.is_visible()
    picture = page.locator("img.jaxprt-picture")
    assert picture.is_visible()
    assert picture.evaluate("image => [image.naturalWidth, image.naturalHeight]") == [480, 360]
    page.context.close()
