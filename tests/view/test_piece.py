"""Pages that relight without Python: what the browser's GPU makes is the radiance of the reduced scene."""

import dataclasses
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jaxprt as prt
from jaxprt import image, view
from jaxprt.brdf import BlinnPhong
from jaxprt.compile import put
from jaxprt.relit.groups import Layout
from jaxprt.relit.scene import RelitScene
from jaxprt.scene import Camera, Environment, Part, PointLight, Scene, Texture, TexturedMaterial, builtin
from jaxprt.scene.environment import resized, rotate
from jaxprt.sphere import cubemap, harmonics
from jaxprt.systems.lobe import exported
from jaxprt.view import messages, stages
from jaxprt.view.content import scene_content
from jaxprt.view.reduced import PageScene
from tests.view.hand import CANVAS, Hand

pytestmark = pytest.mark.filterwarnings("ignore:the page has light of bounces in part")

LEFT_OUT = "light of bounces in part: these parts reflect it diffusely, without highlights: 'ball'$"
SHOWN = 'mount(document.getElementById("viewer"), answers(content, buffers), { addressed: true });'
ASKED = """async (message) => {
  const { content, buffers } = await window.ask(message, message.file ? [Uint8Array.from(message.file).buffer] : []);
  return { content, data: buffers.length ? Array.from(new Uint16Array(buffers[0].buffer)) : [] };
}"""


DISK = 6e-3  # At 6 x 8 x 8 a texel is .4 % off the disk that the page takes it for.
HALF = 2e-3  # of what arrives, in half floats, and of colors


@pytest.fixture(scope="module")
def made(systems, lights, tmp_path_factory):
    path = tmp_path_factory.mktemp("piece") / "ball.html"
    with pytest.warns(UserWarning, match=LEFT_OUT):
        return view.export(systems["lobes"], path, environments=lights)


class Page:
    """The page's answers, without its viewer."""

    def __init__(self, browser, path):
        text = path.read_text()
        assert SHOWN in text
        path = path.with_name(f"asked_{path.name}")
        text = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", text)  # which knows the script
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


MATERIALS = {"roughness": 0.7, "metallic": 0.3, "f0": 0.2, "specular": [1.0, 0.5, 0.2], "diffuse": [0.1, 0.4, 0.3]}
LAMPS = [{"direction": [0.2, 1.0, 0.5], "angle": 0.4, "radiance": [5.0, 4.0, 3.0]}]


def reduced_radiance(scene, lights, message, **sizes):
    """What Python makes of a scene that has been reduced as a page has it."""
    known = messages.look(message, systems=["lobes"], lights=2)
    made = stages.Stages({"lobes": PageScene.of(scene).reduced(2, **sizes).relit()}, lights)
    light = made.unturned(known.light, known.lamps)
    if known.turn:
        light = rotate(light, stages.about(known.turn))
    return np.asarray(made.scene.radiance(light, eye=jnp.asarray(known.eye), materials=made.materials(known)))


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
    true = reduced_radiance(systems["lobes"], lights, message, texels=True)
    assert off(page.color(message), true) < DISK


def caused(piece, name):
    """The error that something causes alone."""
    return next(cause.error for cause in piece.causes if cause.name == name)


def test_page_makes_the_radiance_of_transfer_matrices(browser, systems, lights, look, tmp_path):
    scene = systems["harmonics"]
    whole = view.export(scene, tmp_path / "whole.html", environments=lights)
    small = view.export(scene, tmp_path / "small.html", environments=lights, most=whole.nbytes - 5000)
    assert (whole.degree, small.degree) == (2, 1)
    assert caused(whole, "visibility") < 5e-3  # of bytes
    assert caused(small, "visibility") > 2e-2
    changes = {"turn": np.pi / 2}, {"eye": [-1.0, 3.0, -2.0], "materials": {"ball": MATERIALS}}, {"lamps": LAMPS}
    for piece in (whole, small):
        page = Page(browser, piece.path)
        for change in changes:
            message = look | change
            true = reduced_radiance(scene, lights, message, texels=False, degree=piece.degree)
            assert off(page.color(message), true) < HALF
        page.page.close()


@pytest.fixture(scope="module")
def mixed(lights, tmp_path_factory):
    """Two balls whose exponents are free, by lobes and by harmonics of a light with a window, over a matte plane."""
    ball = builtin.sphere(rings=8, sectors=16)
    beside = eqx.tree_at(lambda mesh: mesh.position, ball, ball.position + np.array([2.2, 0.0, 0.0], np.float32))
    ground = prt.scene.mesh.make_mesh(
        np.array([[-3, -1, -3], [-3, -1, 3], [5, -1, 3], [5, -1, -3]], float), np.array([[0, 1, 2], [0, 2, 3]])
    )
    parts = [
        Part("shiny", ball, BlinnPhong([0.4, 0.1, 0.05], 0.3, 20.0)),
        Part("soft", beside, BlinnPhong(0.2, [0.3, 0.5, 0.2], 10.0)),
        Part("ground", ground, TexturedMaterial(base_color=(0.4, 0.5, 0.4), metallic=0.0, specular=0.0)),
    ]
    lobes = prt.relit.Lobes(12, texels=2)
    recipes = {"shiny": lobes, "soft": prt.relit.Harmonics(2, laplacian=0.4), "ground": lobes}
    made = prt.precompute(Scene(parts), refine=False, system=recipes, size=8, progress=False)
    return made, view.export(made, tmp_path_factory.mktemp("mixed") / "mixed.html", environments=lights)


def test_lobes_and_matrices_share_a_page_and_exponents_change(browser, mixed, lights, look):
    scene, piece = mixed
    assert piece.texels
    assert piece.degree == 2
    page = Page(browser, piece.path)
    head, _ = page.ask({"kind": "scene"})
    least, most = head["parts"][0]["free"]["exponent_range"]
    assert least < 10 < 40 < most
    shiny = {"exponent": 40.0, "f0": 0.5, "specular": [1.0, 0.8, 0.3], "diffuse": [0.1, 0.2, 0.3]}
    soft = {"exponent": 30.0, "diffuse": [0.0, 0.1, 0.2]}
    changed = {"shiny": shiny | {"exponent": 12.0}, "soft": soft}
    before = None
    for change in {}, {"materials": changed}, {"materials": changed | {"shiny": shiny}, "light": 1}:
        # Under gray light no texel is brighter than others, so nothing but half floats is off.
        lamp = HALF if "light" in change else DISK
        message = look | {"turn": np.pi / 2} | change
        found = page.color(message)
        true = reduced_radiance(scene, lights, message, texels=True)
        for part, most in zip(np.split(np.arange(len(true)), [114, 228]), (lamp, HALF, lamp), strict=True):
            assert off(found[part], true[part]) < most
        assert before is None or off(found, before) > 0.1
        before = found
    page.page.close()


def picture_error(scene, page, light, *, edge):
    """Relative L2 error of pictures of a reduced scene from four sides, at pixels that show surfaces."""
    apart = norm = 0.0
    for quarter in range(4):
        eye = stages.about(quarter * np.pi / 2) @ scene.camera.eye  # the camera looks at the origin
        camera = dataclasses.replace(scene.camera, eye=eye, width=edge, height=edge)
        shown = np.asarray(scene.coverage(camera, samples=1))[..., None]
        full = scene.picture(light, camera, samples=1)
        approximate = page.picture(light, camera, samples=1, shadows="vertices")
        apart += float(np.sum(shown * (approximate - full) ** 2))
        norm += float(np.sum(shown * np.asarray(full) ** 2))
    return np.sqrt(apart / norm)


SMALLER = 0.03  # Pictures of 64 x 64 pixels have other edges than those of 96 x 96.


def test_error_is_of_pictures_in_the_light_with_the_largest(made, systems, lights):
    scene, page = systems["lobes"], PageScene.of(systems["lobes"]).reduced(2, texels=True).relit()
    errors = {name: picture_error(scene, page, light, edge=64) for name, light in lights.items()}
    assert made.light == max(errors, key=errors.get)
    assert made.error == pytest.approx(errors[made.light], rel=SMALLER)
    assert made.edge == 2
    assert made.nbytes == made.path.stat().st_size


def test_larger_errors_and_sizes_than_accepted_are_refused_with_their_causes(systems, lights, made, tmp_path):
    causes = {cause.name: cause for cause in made.causes}
    assert list(causes) == sorted(causes, key=lambda name: -causes[name].error)
    assert set(causes) == {"shadows", "bounces", "visibility"}
    # The ground has four vertices, none in the shadow of the ball.
    assert made.causes[0].name == "shadows"
    assert causes["shadows"].part == "ground"
    assert causes["shadows"].error == pytest.approx(made.error, rel=0.1)
    assert "shadows that lie between vertices" in str(causes["shadows"])
    for options, refusal in (
        ({"error": 0.05}, r"error must be at least 0\.\d+ for this page, got 0\.05: .*'lamp'[^$]*on part 'ground'"),
        ({"error": -1.0}, r"error must be at least 0 .*, got -1.0"),
        ({"most": 1000}, "the size of the page with the coarsest visibility, got 1000"),
    ):
        with pytest.raises(ValueError, match=refusal):
            view.export(systems["lobes"], tmp_path / "a.html", environments=lights, **options)
        assert not (tmp_path / "a.html").exists()


def test_size_that_is_asked_for_is_kept_and_bounces_that_are_none_cause_no_error(systems, lights, tmp_path):
    scene = systems["lobes"].without_bounces()
    lobes = [put(scene.part_system(number)).system for number in range(2)]  # without single texels
    bare = RelitScene(scene.scene, scene.shading, Layout.apart(scene.layout.counts), lobes)
    whole = view.export(bare, tmp_path / "a.html", environments={"lamp": lights["lamp"]})
    assert {cause.name for cause in whole.causes} == {"shadows", "visibility"}
    most = whole.nbytes - 2000
    smaller = view.export(bare, tmp_path / "b.html", environments={"lamp": lights["lamp"]}, most=most)
    assert (whole.edge, smaller.edge) == (2, 1)


def test_page_whose_lobes_read_fewer_texels_than_the_light_has_is_measured(systems, lights, tmp_path, monkeypatch):
    recipe, light = prt.relit.Lobes(8, texels=0), {"lamp": resized(lights["lamp"], size=16)}
    bare = prt.precompute(systems["lobes"].scene, refine=False, system=recipe, size=16, progress=False)
    whole = view.export(bare, tmp_path / "a.html", environments=light)
    monkeypatch.setattr(exported, "_LIGHT", 8)
    coarse = view.export(bare, tmp_path / "b.html", environments=light)
    assert whole.error < coarse.error < 2 * whole.error


def test_page_asks_for_nothing(made):
    assert not re.search(r"(?:src|href)=\"(?!data:)|https?://", made.path.read_text())


def radiance_hdr(rng, *, coding):
    """A picture of blocks, 128 x 64, in one of the three codings of lines, at exposure 1/2, and with less green."""
    mantissa = rng.integers(40, 256, (16, 32, 3))
    pixel = np.concatenate([mantissa, np.full((16, 32, 1), 129)], -1).repeat(4, 0).repeat(4, 1).astype(np.uint8)
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\nEXPOSURE= 0.25\nCOLORCORR=1 2 1\n\n-Y 64 +X 128\n"
    for line in pixel:
        if coding == "flat":
            data += line.tobytes()
            continue
        if coding == "old runs":
            data += b"".join(value.tobytes() + bytes([1, 1, 1, 3]) for value in line[::4])
            continue
        data += bytes([2, 2, 0, 128])
        for channel in line.T:  # half in runs of four, half as they are
            data += b"".join(bytes([132, value]) for value in channel[:64:4]) + bytes([64]) + channel[64:].tobytes()
    return data


@pytest.mark.parametrize("coding", ["flat", "old runs", "runs"])
def test_dropped_hdr_lights_the_page_as_it_lights_python(coding, page, systems, look, tmp_path):
    path = tmp_path / "soft.hdr"
    path.write_bytes(radiance_hdr(np.random.default_rng(1), coding=coding))
    content, _ = page.ask({"kind": "drop", "name": path.name, "file": list(path.read_bytes())})
    assert content["lights"][-1] == "soft"
    found = page.color(look | {"light": content["light"]})
    light = prt.load_environment(path, size=8)
    true = PageScene.of(systems["lobes"]).reduced(2, texels=True).relit().radiance(light, eye=jnp.asarray(look["eye"]))
    assert off(found, np.asarray(true)) < 0.02


def test_dropped_file_that_is_none_is_told(page, look):
    for name, data in (("a.hdr", b"no picture"), ("b.exr", b"v/1\x01"), ("c.hdr", b"\0")):
        content, _ = page.ask({"kind": "drop", "name": name, "file": list(data)})
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


def test_the_page_shows_its_scene_small_in_each_light(browser, made, systems, lights):
    hand = Hand(browser, made.path.as_uri())
    hand.pictured()
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels().stats.samples === 9")
    scene, camera = PageScene.of(systems["lobes"]).reduced(2, texels=True).relit(), hand.camera()
    eye = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], 72, 54)
    cover = np.asarray(scene.coverage(eye)) == 1
    for pixel, light in zip(hand.small(), lights.values(), strict=True):
        picture = scene.picture(light, eye, shadows="vertices")
        shown = np.asarray(image.display(picture, stops=scene.exposure(picture, eye)))
        assert np.abs(pixel[..., :3] / 255 - shown)[cover].mean() < 0.007
    before = hand.pixels()  # in the light of the moment
    hand.page.keyboard.press("l")
    hand.finish()
    assert np.abs(hand.pixels() - before).max() > 0.05
    hand.page.get_by_role("button", name=f"light: {next(iter(lights))}").click()
    hand.finish()
    assert np.abs(hand.pixels() - before).mean() < 0.001
    hand.page.close()
    assert not hand.errors


def test_parts_with_one_kind_of_material_share_a_table():
    plane = builtin.plane(cells=1)
    matte = TexturedMaterial(metallic=0.0, specular=0.0)
    rough = [TexturedMaterial(metallic=metallic, roughness=0.5 + 0.2 * metallic) for metallic in (0.0, 1.0)]
    materials = {"first": rough[0], "shiny": BlinnPhong(0.3, 0.2, 20.0), "second": rough[1], "matte": matte}
    meshes = [
        eqx.tree_at(lambda mesh: mesh.position, plane, plane.position + k * np.ones(3, np.float32)) for k in range(4)
    ]
    pairs = zip(meshes, materials.items(), strict=True)
    scene = Scene([Part(name, mesh, material) for mesh, (name, material) in pairs])
    made = prt.precompute(scene, refine=False, system=prt.relit.Lobes(8, texels=2), size=8, progress=False)
    content, arrays = scene_content(PageScene.of(made).reduced(2, texels=False))
    first, shiny, second, matte = content["parts"]
    assert first["tableStart"] == second["tableStart"] == 0
    sizes = [part["entries"] * part["nodes"] * max(len(part["knot"]), 1) for part in (first, shiny, matte)]
    assert (shiny["tableStart"], matte["tableStart"]) == (sizes[0], sizes[0] + sizes[1])
    assert len(arrays[3]) == 16 * sum(sizes)  # four channels of four bytes


def test_matte_scene_needs_no_visibility(browser, lights, look, tmp_path):
    matte = TexturedMaterial(base_color=(0.4, 0.5, 0.4), metallic=0.0, specular=0.0)
    scene = Scene([Part("ball", builtin.sphere(rings=8, sectors=16), matte)])
    made = prt.precompute(scene, refine=False, system=prt.relit.Harmonics(3), size=8, progress=False)
    piece = view.export(made, tmp_path / "matte.html", environments=lights)
    assert piece.edge == 0
    assert caused(piece, "visibility") < 0.01
    page = Page(browser, piece.path)
    true = made.radiance(lights["lamp"], eye=jnp.asarray(look["eye"]))
    assert off(page.color(look), np.asarray(true)) < 0.01
    page.page.close()


def test_what_a_page_does_not_have_is_refused(systems, tmp_path):
    scene = systems["harmonics"]
    ball, ground = (put(scene.part_system(number)) for number in range(2))
    layout = Layout.apart(scene.layout.counts)

    def refused(system, told):
        changed = RelitScene(scene.scene, scene.shading, layout, (system, ground))
        with pytest.raises(ValueError, match=f"part 'ball' must {told}"):
            view.export(changed, tmp_path / "a.html")

    refused(prt.total(ball, ball), "have a system with the method `exported` to be exported, as .*, got")
    matrix = ball.transport.matrix
    reflected = eqx.tree_at(lambda each: each.transport.matrix, ball, matrix.at[:, 0, 0, 1].add(0.5))
    refused(reflected, "have the transfer matrices of direct light")
    colored = eqx.tree_at(lambda each: each.transport.matrix, ball, jnp.concatenate([matrix] * 3, 1))
    refused(colored, "have gray transfer matrices to be exported, got 3 colors")
    skewed = eqx.tree_at(lambda each: each.brdf.table, ball, ball.brdf.table.at[1].add(ball.brdf.table[3]))
    refused(skewed, "have a BRDF that is symmetric about the plane of the view")
    with pytest.raises(ValueError, match=r"path must end in \.html, .* got '.*a\.htm'"):
        view.export(systems["lobes"], tmp_path / "a.htm")


@pytest.fixture(scope="module")
def lit():
    """A matte ball over a matte plane under a point light, with a bounce."""
    ball, ground = builtin.sphere(rings=8, sectors=16), builtin.plane(cells=8)
    ground = eqx.tree_at(lambda mesh: mesh.position, ground, ground.position * 3 - np.array([0, 1, 0], np.float32))
    matte = [TexturedMaterial(base_color=color, metallic=0.0, specular=0.0) for color in ((0.8, 0.3, 0.2), 0.7)]
    parts = [Part(*row) for row in zip(("ball", "ground"), (ball, ground), matte, strict=True)]
    bulb = PointLight("bulb", [1.5, 2.0, 1.0], [9.0, 8.0, 7.0])
    scene = Scene(parts, point_lights=[bulb])
    return prt.precompute(scene, refine=False, system=prt.relit.Lobes(8), bounces=1, size=8, progress=False)


LOW = 0.015  # of bytes, and of harmonics by texels of a light of 6 x 8 x 8


def test_matte_scenes_have_their_bounces_and_lamps_in_pages(browser, lit, lights, look, tmp_path):
    value = np.full(25, 0.1)
    value[0] = 2.0
    soft = harmonics.evaluate(cubemap.direction(size=8), degree=4) @ jnp.asarray(value, jnp.float32)
    soft = {"soft": Environment(jnp.stack([soft, 2 * soft, soft], -1))}
    eye = jnp.asarray(look["eye"])
    true = np.asarray(lit.radiance(soft["soft"], eye=eye))
    whole = PageScene.of(lit).reduced(2, texels=True)
    variants = {
        (bounces, lamps): off(
            np.asarray(whole.with_reflected(bounces=bounces, lamps=lamps).relit().radiance(soft["soft"], eye=eye)), true
        )
        for bounces in (True, False)
        for lamps in (True, False)
    }
    assert variants[True, True] < LOW
    assert min(error for kept, error in variants.items() if kept != (True, True)) > 0.05
    piece = view.export(lit, tmp_path / "lit.html", environments=soft)
    page = Page(browser, piece.path)
    assert off(page.color(look), true) < LOW
    turned = np.asarray(lit.radiance(rotate(soft["soft"], stages.about(np.pi / 2)), eye=eye))
    assert off(page.color(look | {"turn": np.pi / 2}), turned) < LOW
    page.page.close()


@pytest.mark.parametrize(("most", "bound"), [(1 << 23, DISK), (0, 0.015)])
def test_images_of_a_page_are_files_which_are_exact_if_small(browser, lights, look, tmp_path, monkeypatch, most, bound):
    monkeypatch.setattr("jaxprt.view.piece._MOST_EXACT", most)
    place = np.linspace(0, 2 * np.pi, 192, endpoint=False)
    color = 0.5 + 0.3 * np.sin(place[:, None, None] + place[None, :, None] * [1.0, 2.0, 3.0])
    rough = 0.6 + 0.3 * np.random.default_rng(2).uniform(-1, 1, (160, 160, 1))
    material = TexturedMaterial(base_color_texture=Texture(color), roughness_texture=Texture(rough), metallic=0.0)
    sphere = builtin.sphere(rings=12, sectors=24)
    sphere = dataclasses.replace(sphere, texture=np.asarray(sphere.position)[:, :2] * 0.4 + 0.5)
    scene = prt.Scene([Part("ball", sphere, material)])
    made = prt.precompute(scene, refine=False, system=prt.relit.Lobes(8, texels=2), size=8, progress=False)
    piece = view.export(made, tmp_path / "page.html", environments=lights)
    page = Page(browser, piece.path)
    names = page.page.evaluate(
        "async () => (await window.ask({ kind: 'page' })).content.images.map((image) => image.file)"
    )
    assert names == [True, True]
    assert off(page.color(look), reduced_radiance(made, lights, look, texels=True)) < bound
    page.page.close()
