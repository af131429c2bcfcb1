"""Pixels that the browser's GPU shades are those of the scene as the page holds it, and nearly those of the scene."""

import base64
import dataclasses
import re
from collections import Counter

import equinox as eqx
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import image
from jaxprt.compile import put
from jaxprt.relit.build import shaded as shaded_parts
from jaxprt.relit.groups import Layout
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, Part, Scene, Texture, TexturedMaterial, builtin
from jaxprt.scene.environment import environment_from_image, rotate
from jaxprt.view import Server, Session, messages, stages
from jaxprt.view import browser as modules
from jaxprt.view.content import page_content
from jaxprt.view.reduced import PageScene
from tests.view.hand import CANVAS, TOLD, Hand

SIZE = 8  # texels along a face's edge of lights
WIDTH, HEIGHT = 96, 72
SAME = 0.01  # of the mean of a picture, between the shader and Python
COARSE = 0.25  # between a first frame of 12 x 9 colors and the picture at rest
SAVED = 0.015  # between pictures of nine samples and of one

LINE = "document.querySelector('#viewer').shadowRoot.querySelector('.line').textContent"
UNSHADOWED = 0.05  # of the mean, for the horizon and the irradiance that are blurred

SHADES = """async ({ module, data, sky, message, angle, radius, backs, size }) => {
  const { Camera, Drawing, Piece, Pixels, unpack } = await import(module);
  const bytes = Uint8Array.from(atob(data), (each) => each.charCodeAt(0));
  const { content, buffers } = unpack(bytes.buffer), canvas = document.createElement("canvas");
  Object.assign(canvas, size);
  const drawing = new Drawing(canvas), { gl } = drawing, piece = new Piece(content, buffers);
  await piece.expand();
  const pixels = new Pixels(gl, piece, backs);
  if (sky) {
    const half = new Uint16Array(Uint8Array.from(atob(sky.data), (byte) => byte.charCodeAt(0)).buffer);
    drawing.setSky(half, sky.content, JSON.stringify([message.light, message.lamps]));
    pixels.see(drawing.seen);
  }
  const camera = new Camera({ eye: message.eye, target: message.target, radius, field_of_view: angle });
  const matrix = camera.matrix(size.width / size.height, [0, 0, 0]);
  pixels.change({ ...message, field_of_view: angle });
  pixels.work(0, matrix, size.width, size.height, false);
  const first = new Float32Array(4 * size.width * size.height), edge = pixels.stats.level;
  if (pixels.sharpens) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, pixels.shown.frame);
    gl.readPixels(0, 0, size.width, size.height, gl.RGBA, gl.FLOAT, first);
  }
  for (let now = 1000; ; now += 1000) {
    if (pixels.busy) { await new Promise((resolve) => setTimeout(resolve, 5)); continue; }
    if (!pixels.work(now, matrix, size.width, size.height, false) || pixels.stats.samples > 0) break;
  }
  const read = pixels.read(), saved = new Float32Array(read.data.length);
  if (piece.blends) {
    gl.bindFramebuffer(gl.FRAMEBUFFER, (await pixels.whole(matrix, size.width, size.height)).frame);
    gl.readPixels(0, 0, size.width, size.height, gl.RGBA, gl.FLOAT, saved);
    pixels.dispose();
  }
  for (let frame = 0; frame < 8; frame++) pixels.learn(3000, true);
  const error = gl.getError(), slow = pixels.slow;
  pixels.close();
  const { blends } = piece, listed = (data, there) => (there ? Array.from(data) : null);
  const shown = { data: listed(read.data, true), first: listed(first, !blends), saved: listed(saved, blends) };
  return { error, slow, edge, ...shown };
}"""


# Expands visibility by a clock that stands still, and by one on which each step takes a second. `between` counts the
# tasks of the page that ran meanwhile.
EXPANDS = """async ({ module, data }) => {
  const { Piece, unpack } = await import(module);
  const { content, buffers } = unpack(Uint8Array.from(atob(data), (each) => each.charCodeAt(0)).buffer), result = [];
  for (const step of [0, 1000]) {
    const { port1, port2 } = new MessageChannel(), piece = new Piece(content, buffers);
    let time = 0, between = 0;
    performance.now = () => (time += step);
    port1.onmessage = () => { between++; port2.postMessage(null); };
    port2.postMessage(null);
    const before = piece.pyramid.length;
    await piece.expand();
    port1.close();
    result.push({ between, before, after: Array.from(piece.pyramid) });
  }
  return result;
}"""


@pytest.fixture(scope="module")
def shaded(browser):
    """A function from a scene of a page, a light and a look to the pixels that the browser shades."""
    tab = browser.new_page()
    module = "data:text/javascript;base64," + base64.b64encode(modules.module().encode()).decode()

    def shade(page, mesh, lights, camera, sky=None, **changes):
        content, arrays = page_content(page, lights)
        face = stages.counterclockwise(mesh)
        places = np.asarray(mesh.position, "<f4").tobytes(), face.tobytes()
        data = base64.b64encode(messages.pack(content, [*places, *arrays])).decode()
        message = {"light": 0, "turn": 0.0, "lamps": [], "materials": {}} | changes
        message |= {"eye": np.asarray(camera.eye, float).tolist(), "target": np.asarray(camera.target, float).tolist()}
        size = {"width": camera.width, "height": camera.height}
        asked = {"module": module, "data": data, "message": message, "angle": float(camera.field_of_view)}
        if sky is not None:
            asked["sky"] = {"content": sky.content, "data": base64.b64encode(sky.buffers[0]).decode()}
        result = tab.evaluate(SHADES, asked | {"radius": 5.0, "backs": 3 * len(face), "size": size})
        assert result["error"] == 0
        assert result["slow"]  # frames of three seconds are left to Python
        shape = camera.height, camera.width, 4
        names = "data", "saved", "first"
        image, saved, first = (result[name] and np.reshape(result[name], shape)[::-1] for name in names)
        if first is not None and sky is None:  # pixels of 8 x 8, with edges of surfaces as fine as at rest
            assert result["edge"] == 8
            assert np.abs(first[..., 3] - image[..., 3]).mean() < 0.01
            assert np.abs(first - image)[..., :3].mean() < COARSE * image[..., :3].mean()
        if saved is not None:  # a picture of nine samples, with layers at each
            assert np.abs(saved - image).mean() < SAVED * np.abs(image).mean()
        return image

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
    sphere = builtin.sphere(rings=12, sectors=24)
    sphere = dataclasses.replace(sphere, texture=np.asarray(sphere.position)[:, :2] * 0.7 + 0.4)
    return Scene([Part("ball", sphere, ball), Part("ground", mesh, ground)])


def inside(covered):
    """Pixels whose neighbors show a surface as they do."""
    result = covered.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            result &= np.roll(covered, step, axis)
    return result


def textured():
    """A material whose colors and roughness are images."""
    rng = np.random.default_rng(3)
    colors, shares = rng.uniform(0.2, 0.9, (8, 16, 3)), rng.uniform(0.5, 1.0, (8, 16, 1))
    images = {"base_color_texture": Texture(colors, wrap=("repeat", "clamp")), "roughness_texture": Texture(shares)}
    return TexturedMaterial(base_color=(0.9, 0.8, 0.7), metallic=0.3, roughness=0.8, **images)


def bumps(amplitude):
    """A normal map of waves along both axes."""
    wave = amplitude * np.sin(2 * np.pi * np.arange(16) / 16)
    slope = np.stack(np.broadcast_arrays(wave[None], wave[:, None], np.ones((16, 16))), -1)
    return Texture((slope / np.linalg.norm(slope, axis=-1, keepdims=True) + 1) / 2)


def clear(mode):
    """A material with holes, or one that hides a share of what is behind it, by an image of large squares."""
    squares = np.kron([[1.0, 0.2], [0.3, 0.8]], np.ones((4, 4)))[..., None]
    image = Texture(squares, wrap=("repeat", "mirror"))
    options = {"metallic": 0.0, "roughness": 0.5, "alpha_mode": mode, "alpha_texture": image}
    return TexturedMaterial(base_color=(0.9, 0.4, 0.2), **options)


def glass():
    """Thin glass without a tint, whose roughness is an image."""
    shares = Texture(np.random.default_rng(5).uniform(0.5, 1.0, (8, 16, 1)))
    return TexturedMaterial(metallic=0.0, roughness=0.7, transmission=0.8, roughness_texture=shares)


def mapped(**parameters):
    """A material with a normal map, whose image of emission no other texture shares."""
    glow = Texture(np.random.default_rng(4).uniform(0, 1, (8, 8, 3)))
    return TexturedMaterial(
        normal_texture=bumps(0.5), normal_scale=0.8, emissive=(0.5, 0.2, 0.8), emissive_texture=glow, **parameters
    )


CASES = {
    "normal map": (
        mapped(base_color=(0.9, 0.7, 0.3), metallic=0.5, roughness=0.4),
        MATTE,
        prt.relit.Lobes(8, texels=2),
    ),
    "textured": (textured(), MATTE, prt.relit.Lobes(8, texels=2)),
    "metal": (METAL, GLOSSY, prt.relit.Lobes(8, texels=2)),
    "harmonic": (GLOSSY, MATTE, prt.relit.Harmonics(2)),
    "holes": (clear("mask"), MATTE, prt.relit.Lobes(8, texels=2)),
    "translucent": (clear("blend"), MATTE, prt.relit.Lobes(8, texels=2)),
    "glass": (glass(), MATTE, prt.relit.Lobes(8, texels=2)),
}


@pytest.mark.parametrize("case", CASES)
def test_pixels_of_the_browser_are_those_of_python(case, shaded):
    ball, ground, recipe = CASES[case]
    relit = prt.precompute(scene_of(ball, ground), refine=False, system=recipe, size=SIZE, progress=False)
    page = PageScene.for_gpu(relit)
    found = shaded(page, relit.mesh, [light()], CAMERA, turn=np.pi / 2)
    turned = rotate(light(), stages.about(np.pi / 2))
    options = {"samples": 1, "shadows": "vertices"}
    true = np.asarray(page.relit().picture(turned, CAMERA, **options))
    same = inside(np.asarray(relit.coverage(CAMERA, samples=1)) == 1) & inside(found[..., 3] == 1)
    assert np.mean(same) > 0.3
    off = np.abs(found[..., :3] - true)[same]
    assert off.mean() < SAME * true[same].mean()


def test_smooth_metals_show_the_picture_of_a_light(shaded):
    """By texels a fourth as large as the light's, without what its brightest texels are summed for one by one."""
    rows = np.full((256, 512, 3), 0.2)
    rows[:, (np.arange(512) // 16) % 2 == 0] = [0.8, 0.5, 0.2]  # stripes of half a texel
    rows[60:90, 60:90] = 40.0
    light = environment_from_image(rows, size=SIZE)
    scene = scene_of(dataclasses.replace(METAL, roughness=0.05), MATTE)
    recipe = prt.relit.Lobes(8, texels=2)
    relit = prt.precompute(scene, refine=False, system=recipe, size=SIZE, progress=False)
    page, sky = PageScene.for_gpu(relit), Session(relit, environments={"light": light}).sky(0, rows=256)
    true, coarse = (
        np.asarray(page.relit().picture(shown, CAMERA, samples=1, shadows="vertices"))
        for shown in (light, Environment(light.radiance))
    )
    found = shaded(page, relit.mesh, [light], CAMERA, sky=sky)[..., :3]
    ball = np.asarray(relit.picture(light, CAMERA, samples=1, layers=("part",))["part"]) == 0
    off, without = (np.abs(image - true)[inside(ball)].mean() / true[inside(ball)].mean() for image in (found, coarse))
    assert off < 0.04
    assert without > 3 * off


def test_every_browser_has_as_many_textures_as_the_shader_of_pixels_reads():
    module = modules.module()
    texts = [module.split(f"const {name} = `")[1].split("`;")[0] for name in ("SHADE", "BRIGHT")]
    names = [
        name for text in texts for row in re.findall(r"uniform \w?sampler2D ([^;]+);", text) for name in row.split(",")
    ]
    assert {"place", "bright", "normalImage"} <= {name.strip() for name in names}
    assert len(names) <= 16  # the least that WebGL2 promises


def test_diffuse_light_follows_normal_maps(shaded):
    material = TexturedMaterial(base_color=0.8, metallic=0.0, roughness=1.0, normal_texture=bumps(0.6))
    scene = scene_of(material, MATTE)
    options = {"refine": False, "system": prt.relit.Lobes(8, texels=0), "size": SIZE, "progress": False}
    relit = prt.precompute(scene, **options)
    found = shaded(PageScene.for_gpu(relit), relit.mesh, [light()], CAMERA)
    true = np.asarray(relit.picture(light(), CAMERA, samples=1, shadows="vertices"))
    ball = np.asarray(relit.picture(light(), CAMERA, samples=1, layers=("part",))["part"]) == 0
    same = inside(ball) & inside(found[..., 3] == 1)
    off = np.abs(found[..., :3] - true)[same].mean() / true[same].mean()
    smooth = scene_of(dataclasses.replace(material, normal_texture=None), MATTE)
    flat = np.asarray(prt.precompute(smooth, **options).picture(light(), CAMERA, samples=1, shadows="vertices"))
    assert off < 0.5 * np.abs(flat - true)[same].mean() / true[same].mean()


@pytest.mark.parametrize("material", [GLOSSY, MATTE])
def test_unshadowed_pixels_are_nearly_those_of_a_ball_that_nothing_shadows(material, shaded):
    scene = Scene([Part("ball", builtin.sphere(rings=12, sectors=24), material)])
    relit = prt.precompute(scene, refine=False, system=prt.relit.Lobes(8, texels=2), size=SIZE, progress=False)
    page = PageScene.without_visibility(scene.parts, shaded_parts(scene.parts, [prt.relit.Lobes()]), SIZE)
    found = shaded(page, scene.mesh, [light()], CAMERA)
    true = np.asarray(relit.picture(light(), CAMERA, samples=1, shadows="vertices"))
    same = inside(np.asarray(relit.coverage(CAMERA, samples=1)) == 1) & inside(found[..., 3] == 1)
    assert np.mean(same) > 0.1
    off = np.abs(found[..., :3] - true)[same].mean() / true[same].mean()
    assert off < UNSHADOWED


class Counted(Session):
    """A session that counts the messages of each kind."""

    def answer(self, message, buffers=()):
        self.asked = getattr(self, "asked", Counter())
        self.asked[message.get("kind")] += 1
        return super().answer(message, buffers)


def test_visibility_is_expanded_in_slices_between_which_the_page_goes_on(browser, systems, lights):
    content, arrays = page_content(PageScene.for_gpu(systems["lobes"]), list(lights.values()))
    mesh = systems["lobes"].mesh
    places = np.asarray(mesh.position, "<f4").tobytes(), stages.counterclockwise(mesh).tobytes()
    data = base64.b64encode(messages.pack(content, [*places, *arrays])).decode()
    tab = browser.new_page()
    module = "data:text/javascript;base64," + base64.b64encode(modules.module().encode()).decode()
    still, sliced = tab.evaluate(EXPANDS, {"module": module, "data": data})
    tab.close()
    assert still["between"] == 0
    assert sliced["between"] > 20
    assert still["before"] < len(still["after"]) == len(sliced["after"])
    assert still["after"] == sliced["after"]
    assert 0 < np.mean(np.asarray(still["after"]) > 0) <= 1


def by_gpu(browser, url):
    """A tab whose pictures are the GPU's alone."""
    hand = Hand(browser, url)
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels?.()")
    hand.page.evaluate(f"() => ({CANVAS}).pixels().patient = true")  # however slow it is
    hand.page.locator("canvas.canvas").focus()
    hand.page.keyboard.press("p")  # no pictures by Python
    hand.settle()
    return hand


def camera_of(hand):
    """The camera of what a tab shows."""
    camera, (height, width) = hand.camera(), hand.pixels().shape[:2]
    return Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], width, height)


def test_the_sky_is_seen_through_translucent_surfaces(browser, lights):
    # Light adds up before it is displayed: dark glass would be half as clear if displayed colors were mixed.
    dark = TexturedMaterial(base_color=0.02, metallic=0.0, roughness=0.5, alpha_mode="blend", alpha=0.25)
    options = {"refine": False, "system": prt.relit.Lobes(8, texels=2), "size": SIZE, "progress": False}
    relit = prt.precompute(scene_of(dark, MATTE), **options)
    server = Server(Session(relit, environments=lights))
    hand = by_gpu(browser, server.url)
    hand.drag((100, 100), (130, 80))
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels().stats.samples === 9", timeout=120_000)
    stops = float(hand.state()["stops"])
    page = PageScene.for_gpu(relit).relit()
    true = page.picture(lights["lamp"], camera_of(hand), shadows="vertices")
    off = np.abs(hand.pixels() - np.asarray(image.display(image.expose(true, stops=stops)))).max(-1)
    assert np.quantile(off, 0.98) < 2 / 255  # half floats; the ball fills a 25th of the picture
    server.close()
    hand.page.close()
    assert not hand.errors


def test_light_view_and_material_change_without_python(browser, systems, lights):
    bare = systems["lobes"].without_bounces()
    server = Server(session := Counted(bare, environments=lights))
    hand = by_gpu(browser, server.url)
    hand.pictured()  # by Python, once
    before = session.asked["look"]
    hand.drag((100, 100), (160, 130))
    hand.page.keyboard.press("l")
    changed = {"ball": {"roughness": 0.7, "diffuse": [0.1, 0.4, 0.3]}}
    hand.page.evaluate(f"(materials) => {{ Object.assign(({CANVAS}).state, {{ materials }}); }}", changed)
    hand.page.keyboard.press("l")
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels().stats.samples > 1", timeout=120_000)
    assert session.asked["look"] == before
    assert "GPU" in hand.page.evaluate(LINE)
    state, view, found = hand.state(), camera_of(hand), hand.pixels()
    assert state["materials"] == changed
    materials = {"ball": stages.change_material(bare.scene.parts[0].material, "ball", changed["ball"])}
    page = PageScene.for_gpu(bare).relit()
    true = page.picture(lights["lamp"], view, materials=materials, shadows="vertices")
    off = np.abs(found - np.asarray(image.display(image.expose(true, stops=state["stops"])))).max(-1)
    assert np.quantile(off, 0.95) < 4 / 255  # edges aside, and half floats
    context = f"({CANVAS}).getContext('webgl2').getExtension('WEBGL_lose_context')"
    hand.page.evaluate(f"() => {{ window.loses = {context}; window.loses.loseContext(); }}")
    hand.page.wait_for_function(f"() => {TOLD}.includes('context was lost')")
    hand.page.evaluate("() => window.loses.restoreContext()")
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels().stats.samples > 1", timeout=120_000)
    assert np.quantile(np.abs(hand.pixels() - found), 0.95) < 2 / 255
    server.close()
    hand.page.close()
    assert not hand.errors


def test_what_the_gpu_does_not_hold_comes_from_python_by_name(browser, systems, lights):
    server = Server(Session(systems["lobes"], environments=lights))
    hand = Hand(browser, server.url)
    hand.settle()
    assert "colors from Python: reflected light" in hand.page.evaluate(LINE)
    server.close()
    hand.page.close()


def test_why_a_scene_is_not_shaded_by_the_gpu_is_said(systems, lights, look):
    bare = systems["lobes"].without_bounces()
    skewed = systems["harmonics"]
    matrix = put(skewed.part_system(0)).transport.matrix
    ball = eqx.tree_at(lambda system: system.transport.matrix, put(skewed.part_system(0)), 2 * matrix + matrix[::-1])
    others = RelitScene(
        skewed.scene, skewed.shading, Layout.apart(skewed.layout.counts), (ball, put(skewed.part_system(1)))
    )
    metal = mapped(metallic=1.0, roughness=0.4)
    lit = prt.precompute(scene_of(metal, MATTE), refine=False, system=CASES["metal"][2], size=SIZE, progress=False)
    with pytest.raises(ValueError, match="lamps shine on these parts by highlights: 'ball'"):
        PageScene.for_gpu(lit)
    lamp = TexturedMaterial(metallic=0.0, emissive=2.0)
    rough = prt.precompute(scene_of(lamp, GLOSSY), refine=False, system=CASES["harmonic"][2], size=SIZE, progress=False)
    with pytest.raises(ValueError, match="lamps light these parts through transfer matrices: 'ball', 'ground'"):
        PageScene.for_gpu(rough)
    session = Session({"lobes": bare, "others": others}, environments=lights)
    content, buffers = session.answer({"kind": "page", "system": "lobes"})
    assert (content["kind"], content["visibility"], len(buffers)) == ("page", True, 11 + len(content["rims"]) + 2)
    content, buffers = session.answer({"kind": "page", "system": "others"})
    assert "part 'ball' must have the transfer matrices of direct light" in content["missing"]
    assert not buffers
    content, _ = session.answer({"kind": "page", "system": "none"})
    assert "the system must be one of lobes, others, got 'none'" in content["message"]
