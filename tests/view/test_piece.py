"""Pages that relight without Python: what the browser's GPU makes is the radiance of the reduced scene."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import view
from jaxprt.scene import Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.environment import rotate
from jaxprt.view import messages, stages
from jaxprt.view.reduced import coarse

SHOWN = 'mount(document.getElementById("viewer"), answers(content, buffers));'
ASKED = """async (message) => {
  const { content, buffers } = await window.ask(message, message.file ? [Uint8Array.from(message.file).buffer] : []);
  return { content, data: buffers.length ? Array.from(new Uint16Array(buffers[0].buffer)) : [] };
}"""


@pytest.fixture(scope="module")
def made(systems, lights, tmp_path_factory):
    path = tmp_path_factory.mktemp("piece") / "ball.html"
    return view.export(systems["lobes"], path, environments=lights)


class Page:
    """The page's answers, without its viewer."""

    def __init__(self, browser, path):
        text = path.read_text()
        assert SHOWN in text
        path = path.with_name(f"asked_{path.name}")
        path.write_text(text.replace(SHOWN, "window.ask = answers(content, buffers);"))
        self.page = browser.new_page()
        self.page.goto(path.as_uri())
        self.page.wait_for_function("() => window.ask")

    def ask(self, message):
        found = self.page.evaluate(ASKED, message)
        return found["content"], np.array(found["data"], np.uint16).view(np.float16).astype(float)

    def color(self, message):
        content, data = self.ask(message)
        assert content["kind"] == "color", content
        return content["scale"] * data.reshape(-1, 3)


@pytest.fixture(scope="module")
def page(browser, made):
    found = Page(browser, made.path)
    yield found
    found.page.close()


def off(found, true):
    return np.linalg.norm(found - true) / np.linalg.norm(true)


MATERIALS = {"roughness": 0.7, "f0": 0.2, "specular": [1.0, 0.5, 0.2], "diffuse": [0.1, 0.4, 0.3]}
LAMPS = [{"direction": [0.2, 1.0, 0.5], "angle": 0.4, "radiance": [5.0, 4.0, 3.0]}]


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"light": 1},
        {"turn": np.pi / 2},
        {"eye": [-1.0, 3.0, -2.0]},
        {"materials": {"ball": {"roughness": 0.4}}},
        {"materials": {"ball": MATERIALS, "ground": {"diffuse": [0.2, 0.3, 0.4]}}},
        {"lamps": LAMPS},
    ],
)
def test_page_makes_the_radiance_of_the_reduced_scene(change, page, systems, lights, look):
    message = look | change
    known = messages.look(message, systems=["lobes"], lights=2)
    made = stages.Stages({"lobes": coarse(systems["lobes"], 2, texels=True)}, lights)
    light = made.unturned(known.light, known.lamps)
    if known.turn:
        light = rotate(light, stages.about(known.turn))
    true = made.scene.radiance(light, eye=jnp.asarray(known.eye), materials=made.materials(known))
    assert (
        off(page.color(message), np.asarray(true)) < 5e-3
    )  # at 6 x 8 x 8 a texel is .4 % off the disk that the page takes it for


def test_error_is_told_against_the_whole_scene(made, systems, lights):
    scene, reduced = systems["lobes"], coarse(systems["lobes"], 2, texels=True)
    apart = norm = 0.0
    for quarter in range(4):
        turn = stages.about(quarter * np.pi / 2)
        eye = turn @ scene.camera.eye  # the camera looks at the origin
        full, found = (np.asarray(each.radiance(lights["lamp"], eye=eye)) for each in (scene, reduced))
        apart, norm = apart + np.sum((found - full) ** 2), norm + np.sum(full**2)
    assert made.error >= 0.99 * np.sqrt(apart / norm)
    assert made.edge == 2
    assert made.nbytes == made.path.stat().st_size


def test_page_asks_for_nothing(made):
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?://", made.path.read_text())


def radiance_hdr(rng, *, by_runs):
    """A picture of blocks, 128 x 64, in one of the two forms of lines."""
    mantissa = rng.integers(40, 256, (16, 32, 3))
    pixel = np.concatenate([mantissa, np.full((16, 32, 1), 129)], -1).repeat(4, 0).repeat(4, 1).astype(np.uint8)
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 64 +X 128\n"
    for line in pixel:
        if not by_runs:
            data += line.tobytes()
            continue
        data += bytes([2, 2, 0, 128])
        for channel in line.T:  # half in runs of four, half as they are
            data += b"".join(bytes([132, value]) for value in channel[:64:4]) + bytes([64]) + channel[64:].tobytes()
    return data


@pytest.mark.parametrize("by_runs", [False, True])
def test_dropped_hdr_lights_the_page_as_it_lights_python(by_runs, page, systems, look, tmp_path):
    path = tmp_path / "soft.hdr"
    path.write_bytes(radiance_hdr(np.random.default_rng(1), by_runs=by_runs))
    content, _ = page.ask({"kind": "drop", "name": path.name, "file": list(path.read_bytes())})
    assert content["lights"][-1] == "soft"
    found = page.color(look | {"light": content["light"]})
    light = prt.load_environment(path, size=8)
    true = coarse(systems["lobes"], 2, texels=True).radiance(light, eye=jnp.asarray(look["eye"]))
    assert off(found, np.asarray(true)) < 0.02


@pytest.mark.parametrize(("name", "data"), [("a.hdr", b"no picture"), ("b.exr", b"v/1\x01"), ("c.hdr", b"")])
def test_dropped_file_that_is_none_is_told(page, name, data, look):
    content, _ = page.ask({"kind": "drop", "name": name, "file": list(data) or [0]})
    assert content["kind"] == "error"
    assert name in content["message"]
    assert page.color(look).any()


def test_viewer_of_the_page_draws_and_follows_hands(browser, made):
    tab = browser.new_page(viewport={"width": 496, "height": 320})
    told = []
    tab.on("pageerror", lambda error: told.append(str(error)))
    tab.goto(made.path.as_uri())
    canvas = "document.querySelector('#viewer').shadowRoot?.querySelector('.canvas')"
    settled = f"() => {{ const s = ({canvas})?.stats; return s && s.shown >= 0 && s.shown === s.seq; }}"
    tab.wait_for_function(settled)
    before = tab.evaluate(f"() => ({canvas}).stats.seq")
    tab.mouse.move(100, 100)
    tab.mouse.down()
    tab.mouse.move(180, 120, steps=5)
    tab.mouse.up()
    tab.keyboard.press("l")
    tab.wait_for_function(settled)
    assert tab.evaluate(f"() => ({canvas}).stats.seq") > before
    assert tab.evaluate(f"() => ({canvas}).state.light") == 1
    assert f"{100 * made.error:.1f} % off" in tab.evaluate(
        "() => document.querySelector('#viewer').shadowRoot.querySelector('.line').textContent"
    )
    assert not told
    tab.close()


def test_matte_scene_needs_no_visibility(browser, lights, look, tmp_path):
    matte = TexturedMaterial(base_color=(0.4, 0.5, 0.4), metallic=0.0, specular=0.0)
    scene = Scene([Part("ball", builtin.sphere(rings=8, sectors=16), matte)])
    made = prt.precompute(scene, system=prt.relit.Harmonics(3), size=8, progress=False)
    piece = view.export(made, tmp_path / "matte.html", environments=lights)
    assert piece.edge == 0
    assert piece.error < 0.01
    page = Page(browser, piece.path)
    true = made.radiance(lights["lamp"], eye=jnp.asarray(look["eye"]))
    assert off(page.color(look), np.asarray(true)) < 0.01
    page.page.close()


def test_size_that_is_asked_for_is_kept(systems, lights, made, tmp_path):
    smaller = view.export(systems["lobes"], tmp_path / "a.html", environments=lights, most=made.nbytes - 2000)
    assert smaller.edge == 1
    with pytest.raises(ValueError, match="bytes of the scene with its coarsest visibility, got 1000"):
        view.export(systems["lobes"], tmp_path / "b.html", environments=lights, most=1000)


def test_what_a_page_does_not_have_is_refused(systems, tmp_path):
    with pytest.raises(ValueError, match=r"part 'ball' must be ideally diffuse or made by the system 'lobe'"):
        view.export(systems["harmonics"], tmp_path / "a.html")
    with pytest.raises(ValueError, match=r"path must end in \.html, got 'a\.htm'"):
        view.export(systems["lobes"], tmp_path / "a.htm")


def test_environments_of_gray_are_lights_too(systems, tmp_path):
    made = view.export(
        systems["lobes"], tmp_path / "gray.html", environments={"gray": Environment(np.ones((6, 8, 8, 1)))}
    )
    assert made.error < 1
