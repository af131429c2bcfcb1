"""A small scene, made ready by two systems, and a session of it."""

import os
import shutil

import numpy as np
import pytest

import jaxprt as prt
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.view import Server, Session
from tests.view.hand import Hand

SIZE = 8
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SWITCHES = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


@pytest.fixture(scope="session")
def browser():
    """Headless Chromium; tests of it are skipped where there is none, unless JAXPRT_BROWSER_REQUIRED is set."""
    if CHROMIUM is None and not os.environ.get("JAXPRT_BROWSER_REQUIRED"):
        pytest.skip("no chromium on this machine")
    assert CHROMIUM, "JAXPRT_BROWSER_REQUIRED is set, and there is no chromium"
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        made = playwright.chromium.launch(executable_path=CHROMIUM, args=SWITCHES)
        yield made
        made.close()


@pytest.fixture
def second(browser):
    """Another browser, in processes of its own."""
    made = browser.browser_type.launch(executable_path=CHROMIUM, args=SWITCHES)
    yield made
    made.close()


@pytest.fixture(scope="session")
def systems():
    """A glossy ball over a matte plane, by lobes with a bounce, and by harmonics."""
    glossy = TexturedMaterial(base_color=(0.6, 0.2, 0.1), metallic=0.0, roughness=0.5)
    matte = TexturedMaterial(base_color=(0.4, 0.5, 0.4), metallic=0.0, specular=0.0)
    ground = prt.scene.mesh.make_mesh(
        np.array([[-3, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3]], float), np.array([[0, 1, 2], [0, 2, 3]])
    )
    parts = [Part("ball", builtin.sphere(rings=8, sectors=16), glossy), Part("ground", ground, matte)]
    eye = Camera([2.0, 1.5, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.7, 64, 64)
    scene = Scene(parts, cameras=[eye])
    options = {"size": SIZE, "progress": False}
    return {
        "lobes": prt.precompute(scene, refine=False, system=prt.relit.Lobes(8, texels=2), bounces=1, **options),
        "harmonics": prt.precompute(scene, refine=False, system=prt.relit.Harmonics(2), **options),
    }


@pytest.fixture(scope="session")
def lights():
    """A bright sky with a lamp, and a gray one."""
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 5:7] = [30, 25, 20]
    return {"lamp": Environment(sky), "gray": Environment(np.full((6, SIZE, SIZE, 3), 0.5))}


@pytest.fixture
def session(systems, lights):
    """A session of its own for each test; what is compiled is shared."""
    return Session(systems, environments=lights)


@pytest.fixture
def look():
    """A look, as the browser's module sends it."""
    return {
        "kind": "look",
        "seq": 1,
        "system": "lobes",
        "light": 0,
        "turn": 0.0,
        "lamps": [],
        "eye": [2.0, 1.5, 4.0],
        "target": [0.0, 0.0, 0.0],
        "field_of_view": 0.7,
        "bounces": False,
        "materials": {},
        "stops": None,
    }


@pytest.fixture
def server(session):
    made = Server(session)
    yield made
    made.close()


@pytest.fixture
def hand(browser, server):
    made = Hand(browser, server.url)
    yield made
    made.page.close()
    assert not made.errors
