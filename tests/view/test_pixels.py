"""Pixels that the browser's GPU shades are those of the scene as the page holds it, and nearly those of the scene."""

import base64

import equinox as eqx
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.scene import Camera, Environment, Part, Scene, TexturedMaterial, builtin
from jaxprt.scene.environment import rotate
from jaxprt.view import browser as modules
from jaxprt.view import messages, stages
from jaxprt.view.content import page_content
from jaxprt.view.reduced import PageScene

SIZE = 8  # texels along a face's edge of lights
WIDTH, HEIGHT = 96, 72
SAME = 0.01  # of the mean of a picture, between the shader and Python

SHADES = """async ({ module, data, message, angle, radius, backs, size }) => {
  const { Camera, Piece, Pixels, unpack } = await import(module);
  const bytes = Uint8Array.from(atob(data), (each) => each.charCodeAt(0));
  const { content, buffers } = unpack(bytes.buffer), canvas = document.createElement("canvas");
  Object.assign(canvas, size);
  const gl = canvas.getContext("webgl2"), pixels = new Pixels(gl, new Piece(content, buffers), backs);
  const camera = new Camera({ eye: message.eye, target: message.target, radius, field_of_view: angle });
  const matrix = camera.matrix(size.width / size.height, [0, 0, 0]);
  pixels.change(message);
  for (let now = 0; ; now += 1000) {
    if (pixels.busy) { await new Promise((resolve) => setTimeout(resolve, 5)); continue; }
    if (!pixels.work(now, matrix, size.width, size.height, false) || pixels.stats.samples > 0) break;
  }
  const error = gl.getError(), read = pixels.read();
  pixels.close();
  return { error, data: Array.from(read.data) };
}"""


@pytest.fixture(scope="module")
def shaded(browser):
    """A function from a scene of a page, a light and a look to the pixels that the browser shades."""
    tab = browser.new_page()
    module = "data:text/javascript;base64," + base64.b64encode(modules.module().encode()).decode()

    def shade(page, mesh, lights, camera, **changes):
        content, arrays = page_content(page, lights)
        face = stages.counterclockwise(mesh)
        places = np.asarray(mesh.position, "<f4").tobytes(), face.tobytes()
        data = base64.b64encode(messages.pack(content, [*places, *arrays])).decode()
        message = {"light": 0, "turn": 0.0, "lamps": [], "materials": {}} | changes
        message |= {"eye": np.asarray(camera.eye, float).tolist(), "target": np.asarray(camera.target, float).tolist()}
        size = {"width": camera.width, "height": camera.height}
        asked = {"module": module, "data": data, "message": message, "angle": float(camera.field_of_view)}
        result = tab.evaluate(SHADES, asked | {"radius": 5.0, "backs": 3 * len(face), "size": size})
        assert result["error"] == 0
        return np.array(result["data"]).reshape(camera.height, camera.width, 4)[::-1]

    yield shade
    tab.close()


def light():
    """A sky with a lamp of few texels."""
    sky = np.full((6, SIZE, SIZE, 3), 0.3)
    sky[2, 2:4, 5:7] = [30, 25, 20]
    sky[4] += np.linspace(0, 1, SIZE)[:, None, None] * [0.2, 0.5, 1.0]
    return Environment(sky)


CAMERA = Camera([2.0, 1.5, 4.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.7, WIDTH, HEIGHT)
GLOSSY = TexturedMaterial(base_color=(0.6, 0.2, 0.1), metallic=0.0, roughness=0.5)
METAL = TexturedMaterial(base_color=(0.9, 0.7, 0.3), metallic=1.0, roughness=0.4)
MATTE = TexturedMaterial(base_color=(0.4, 0.5, 0.4), metallic=0.0, specular=0.0)


def scene_of(ball, ground):
    mesh = builtin.plane(cells=8)
    mesh = eqx.tree_at(lambda plane: plane.position, mesh, 3 * mesh.position - np.array([0, 1, 0], np.float32))
    return Scene([Part("ball", builtin.sphere(rings=12, sectors=24), ball), Part("ground", mesh, ground)])


def inside(covered):
    """Pixels whose neighbors show a surface as they do."""
    result = covered.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            result &= np.roll(covered, step, axis)
    return result


CASES = {
    "glossy": (GLOSSY, MATTE, prt.relit.Lobes(8, texels=2)),
    "matte": (MATTE, MATTE, prt.relit.Lobes(8, texels=2)),
    "metal": (METAL, GLOSSY, prt.relit.Lobes(8, texels=2)),
    "harmonic": (GLOSSY, MATTE, prt.relit.Harmonics(2)),
}


@pytest.mark.parametrize("case", CASES)
def test_pixels_of_the_browser_are_those_of_python(case, shaded):
    ball, ground, recipe = CASES[case]
    relit = prt.precompute(scene_of(ball, ground), refine=False, system=recipe, size=SIZE, progress=False)
    page = PageScene.for_gpu(relit)
    found = shaded(page, relit.mesh, [light()], CAMERA, turn=np.pi / 2)
    turned = rotate(light(), stages.about(np.pi / 2))
    options = {"samples": 1, "shadows": "vertices"}
    true, whole = (np.asarray(scene.picture(turned, CAMERA, **options)) for scene in (page.relit(), relit))
    same = inside(np.asarray(relit.coverage(CAMERA, samples=1)) == 1) & inside(found[..., 3] == 1)
    assert np.mean(same) > 0.3
    off = np.abs(found[..., :3] - true)[same]
    print(
        case,
        "mean",
        off.mean() / true[same].mean(),
        "max",
        off.max() / true[same].mean(),
        "whole",
        np.abs(found[..., :3] - whole)[same].mean() / whole[same].mean(),
    )
    assert off.mean() < SAME * true[same].mean()
