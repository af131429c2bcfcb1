"""The viewer's interface: each state shows its controls within the page, and what is typed or clicked acts.

`pytest --basetemp=FOLDER` keeps the screenshots.
"""

import base64
import io
import json
import time

import numpy as np
import pytest
from PIL import Image

import jaxprt as prt
from jaxprt import image, view
from jaxprt.image.pixels import seen_from_front
from jaxprt.scene import Camera, Part, Scene, TexturedMaterial, builtin, sides
from jaxprt.scene.environment import rotate
from jaxprt.sphere import cubemap
from jaxprt.view import Server, Session, stages
from tests.view.hand import CANVAS, Hand

ROOT = "document.querySelector('#viewer').shadowRoot"
EXPOSURE = 0.15  # stops: bytes, and the viewer's samples of a pixel
# Controls that leave the page or the picture, texts that are cut off, and boxes over the picture that overlap.
MISPLACED = f"""() => {{
  const root = {ROOT}, bad = [], shown = (each) => each.checkVisibility({{ visibilityProperty: true }});
  const texts = "button, select, input, summary, span, td, h2, .note, .told, .stagetext, .hint, .line";
  for (const each of root.querySelectorAll(texts)) {{
    const box = each.getBoundingClientRect();
    if (!shown(each) || !box.width) continue;
    const name = each.getAttribute("aria-label") ?? each.textContent ?? each.type;
    if (box.left < -0.5 || box.right > innerWidth + 0.5) bad.push(`${{name}} leaves the page`);
    if (each.clientWidth && each.scrollWidth > each.clientWidth + 1) bad.push(`${{name}} is cut off`);
  }}
  const boxes = [...root.querySelectorAll(".words > :not([hidden]), .tools, .hint, .line")];
  const over = boxes.filter((each) => shown(each) && each.textContent + each.children.length !== "0");
  for (const [i, one] of over.entries()) for (const other of over.slice(i + 1)) {{
    const a = one.getBoundingClientRect(), b = other.getBoundingClientRect();
    const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
    if (wide > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1)
      bad.push(`${{one.className}} lies over ${{other.className}}`);
  }}
  return bad;
}}"""
UNNAMED = f"""() => [...{ROOT}.querySelectorAll("button, select, input:not([hidden]), canvas:not([aria-hidden])")]
  .filter((each) => !(each.getAttribute("aria-label") || each.labels?.[0]?.textContent || each.textContent))
  .map((each) => each.outerHTML)"""
FOCUSED = f"""() => {{
  const each = {ROOT}.activeElement;
  return each && (each.ariaLabel ?? each.labels?.[0]?.textContent ?? each.textContent);
}}"""
OPENED = f"""() => [...{ROOT}.querySelectorAll('details.part[open]')]
  .map((part) => part.querySelector('summary').textContent)"""


@pytest.fixture
def shoot(tmp_path):
    """Takes a screenshot of a state, in which nothing is misplaced."""

    def shot(hand, name):
        hand.page.screenshot(path=str(tmp_path / f"{name}.png"))
        assert hand.page.evaluate(MISPLACED) == [], name

    return shot


def resized(hand, width, height):
    hand.page.set_viewport_size({"width": width, "height": height})
    hand.page.wait_for_timeout(300)
    hand.settle()


def typed(hand, label, text):
    """Types into the number of a slider."""
    field = hand.page.get_by_label(f"{label}, typed").filter(visible=True).first
    field.fill(text)
    field.press("Enter")
    hand.settle()


def test_each_state_shows_its_controls_within_the_page(hand, session, monkeypatch, shoot):
    page = hand.page
    resized(hand, 900, 560)
    page.get_by_text("for all keys").wait_for()
    shoot(hand, "start")
    typed(hand, "roughness", "0.25")
    hand.still()
    shoot(hand, "typed")
    assert page.locator("canvas.plane").is_visible()
    assert hand.state()["materials"]["ball"]["roughness"] == 0.25
    typed(hand, "rotation °", "90")
    page.wait_for_timeout(300)
    shoot(hand, "rotated")
    page.get_by_role("button", name="help (H)").click()
    assert page.get_by_role("dialog", name="help").is_visible()
    shoot(hand, "help")
    page.keyboard.press("Escape")
    assert page.get_by_role("dialog", name="help").is_hidden()
    page.get_by_role("button", name="dark or light").click()
    shoot(hand, "other theme")
    page.get_by_role("button", name="save a picture").click()
    page.get_by_label("width in pixels").wait_for()
    shoot(hand, "dialog")
    page.get_by_role("button", name="cancel").click()
    answer = session.answer

    def refused(message, buffers=()):
        message = message | {"turn": "east"} if message["kind"] == "look" else message
        return answer(message, buffers)

    monkeypatch.setattr(session, "answer", refused)
    page.locator("canvas.canvas").focus()
    page.keyboard.press("]")
    page.get_by_text("turn must be a finite number, got 'east'").wait_for()
    shoot(hand, "message")
    page.set_viewport_size({"width": 390, "height": 700})
    page.wait_for_timeout(300)
    assert page.get_by_role("region", name="controls").is_hidden()
    shoot(hand, "narrow with a message")
    monkeypatch.setattr(session, "answer", answer)
    page.keyboard.press("]")
    hand.settle()
    page.get_by_role("button", name="controls").click()
    assert page.get_by_role("region", name="controls").is_visible()
    shoot(hand, "narrow")


def test_every_control_has_a_name_and_is_reached_by_keys(hand):
    assert hand.page.evaluate(UNNAMED) == []
    hand.page.locator("canvas.canvas").focus()
    reached = set()
    for _ in range(60):
        hand.page.keyboard.press("Tab")
        reached.add(hand.page.evaluate(FOCUSED))
    for name in (
        "save a picture, a video or the state",
        "reset the view, the light, the materials and the display (R)",
        "rotation °",
        "rotation °, typed",
    ):
        assert name in reached
    for name in ("background", "metallic, typed", "roughness across and F0 up; arrows move the point"):
        assert name in reached
    plane = hand.page.locator("canvas.plane")
    plane.focus()
    before = hand.state()["materials"]
    hand.page.keyboard.press("ArrowRight")
    hand.settle()
    assert before == {}
    assert hand.state()["materials"]["ball"]["roughness"] == pytest.approx(0.55)
    hand.page.locator("canvas.sky").focus()
    hand.page.keyboard.press("Enter")
    hand.settle()
    assert len(hand.state()["lamps"]) == 1


def test_typed_numbers_change_the_scene_and_the_sliders(hand):
    before = hand.pixels()
    typed(hand, "rotation °", "90")
    assert hand.state()["turn"] == pytest.approx(np.pi / 2)
    assert np.abs(hand.pixels() - before).max() > 0.05
    field = hand.page.get_by_label("rotation °, typed")
    field.fill("270")  # once around
    hand.page.evaluate(f"() => ({CANVAS}).closest('.frame').dispatchEvent(new Event('theme'))")  # shows all anew
    field.press("Enter")
    hand.settle()
    assert hand.state()["turn"] == pytest.approx(-np.pi / 2)
    assert hand.page.get_by_label("rotation °", exact=True).input_value() == "-90"
    typed(hand, "metallic", "7")  # as much as there is
    assert hand.state()["materials"]["ball"]["metallic"] == 1
    typed(hand, "metallic", "")
    assert hand.state()["materials"]["ball"]["metallic"] == 1
    assert hand.page.get_by_label("metallic, typed").input_value() == "1"
    assert hand.page.locator("canvas.plane").is_hidden()  # of a metal the base color is the reflectance
    assert hand.page.get_by_label("specular F0, typed").is_disabled()
    typed(hand, "metallic", "0.5")
    assert hand.page.locator("canvas.plane").is_visible()
    typed(hand, "specular F0", "0.2")
    assert hand.state()["materials"]["ball"] == {"metallic": 0.5, "f0": 0.2}
    typed(hand, "exposure", "-2.5")
    assert hand.state()["stops"] == -2.5
    assert not hand.page.get_by_label("automatic exposure").is_checked()
    hand.page.get_by_role("button", name="as it was").first.click()
    hand.settle()
    assert hand.state()["materials"] == {}


def test_a_picture_at_rest_has_no_background_where_there_is_none(hand, systems, lights):
    hand.page.locator("canvas.canvas").focus()
    hand.page.evaluate(f"() => ({CANVAS}).camera().zoom(2)")
    hand.page.get_by_label("background", exact=True).select_option(label="none")
    hand.still()
    state, camera, shown = hand.state(), hand.camera(), hand.pixels()
    height, width = shown.shape[:2]
    eye = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], width, height)
    cover = np.asarray(systems["lobes"].coverage(eye))
    assert 0.1 < np.mean(cover == 0) < 0.9
    np.testing.assert_allclose(shown[cover == 0], 0.1, atol=1 / 255)
    inside = image.display(systems["lobes"].picture(lights["lamp"], eye), stops=state["stops"])
    off = np.abs(shown - inside)[cover == 1]
    assert np.quantile(off, 0.997) < 2.5 / 255  # rays of a few pixels pass an edge on the other side


def test_a_matte_part_has_a_base_color_alone(hand):
    ground = hand.page.locator("details.part").nth(1)
    assert ground.locator("summary").text_content() == "ground"
    assert ground.locator("label, .row > span, canvas").all_text_contents() == ["base color", "base color"]


def strip(hand):
    """The strip of the light, in bytes."""
    text = hand.page.evaluate(f"() => {ROOT}.querySelector('.sky').toDataURL('image/png')")
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(text.partition(",")[2]))).convert("RGB")).astype(float)


def test_a_sun_lands_where_the_mouse_is_in_the_turned_light_and_a_drag_paints(hand):
    typed(hand, "rotation °", "-135")
    hand.page.wait_for_timeout(500)
    before = strip(hand)
    box = hand.page.locator("canvas.sky").bounding_box()
    u, v = 0.3, 0.4
    painted = hand.stats()["sky"]
    hand.page.mouse.click(box["x"] + u * box["width"], box["y"] + v * box["height"])
    hand.settle()
    (lamp,) = hand.state()["lamps"]
    turned = np.asarray(stages.about(np.radians(-135))) @ lamp["direction"]
    lon, lat = np.pi * (1 - 2 * u), np.pi * (0.5 - v)
    there = np.array([np.cos(lat) * np.sin(lon), np.sin(lat), np.cos(lat) * np.cos(lon)])
    assert np.dot(turned, there) > np.cos(0.02)
    assert painted
    for _ in range(40):
        brighter = (strip(hand) - before).mean(-1)
        if brighter.max() > 10:
            break
        time.sleep(0.1)
    row, column = np.unravel_index(np.argmax(brighter), brighter.shape)
    height, width = brighter.shape
    assert abs((column + 0.5) / width - u) < 0.05
    assert abs((row + 0.5) / height - v) < 0.08
    hand.drag((box["x"] + 20, box["y"] + 40), (box["x"] + 120, box["y"] + 40), steps=10)
    assert len(hand.state()["lamps"]) > 3
    hand.page.get_by_role("button", name="remove suns").click()
    hand.settle()
    assert hand.state()["lamps"] == []


def test_the_hint_goes_away_at_first_use_and_every_key_of_the_help_acts(hand):
    page = hand.page
    assert page.locator(".hint").is_visible()
    page.locator("canvas.canvas").focus()
    page.keyboard.press("g")
    assert page.locator(".hint").is_hidden()
    keys = page.evaluate(f"() => [...{ROOT}.querySelectorAll('.help kbd')].map((each) => each.textContent)")
    names = {"←": "ArrowLeft", "→": "ArrowRight", "↑": "ArrowUp", "↓": "ArrowDown"}
    acting = [names.get(key, key) for key in keys if key not in ("Shift", "Ctrl", "Alt")]
    assert len(acting) > 20
    ignored = page.evaluate(
        f"""(keys) => keys.filter((key) => ({CANVAS}).dispatchEvent(
            new KeyboardEvent("keydown", {{ key, bubbles: true, composed: true, cancelable: true }})))""",
        acting,
    )
    assert ignored == []
    page.get_by_label("exposure, typed").focus()  # where letters are typed, they do nothing else
    state = hand.state()
    page.keyboard.press("g")
    assert hand.state()["background"] == state["background"]


def test_keys_that_change_nothing_leave_the_picture_at_rest(browser, systems, lights):
    server = Server(Session({"harmonics": systems["harmonics"]}, environments={"lamp": lights["lamp"]}))
    hand = Hand(browser, server.url)
    hand.still()
    before, asked = hand.stats(), hand.state()
    hand.page.locator("canvas.canvas").focus()
    for key in "clsb":
        hand.page.keyboard.press(key)
    hand.page.wait_for_timeout(500)
    assert {name: hand.stats()[name] for name in ("seq", "sent", "stills")} == {
        name: before[name] for name in ("seq", "sent", "stills")
    }
    assert hand.state() == asked
    hand.page.close()
    server.close()


def test_the_background_is_the_light_blurred_or_a_color(hand, systems, lights):
    # From below, so that the lamp is behind the scene, and at an exposure at which its glow is not white.
    hand.page.evaluate(f"() => {{ const c = ({CANVAS}).camera(); c.zoom(4); c.widen(1.5); c.elevation = -0.8; }}")
    typed(hand, "exposure", "-4")
    hand.page.get_by_label("background", exact=True).select_option(label="color")
    hand.page.get_by_label("its color").fill("#336699")
    hand.still()
    plain = hand.pixels()
    hand.page.get_by_label("background", exact=True).select_option(label="blurred light")
    hand.still()
    camera, shown = hand.camera(), hand.pixels()
    height, width = shown.shape[:2]
    forward = np.subtract(camera["target"], camera["eye"])
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    eye = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], width, height)
    row, column = np.nonzero(np.asarray(systems["lobes"].coverage(eye)) == 0)
    row, column = row[::97], column[::97]
    np.testing.assert_allclose(plain[row, column], np.broadcast_to([0.2, 0.4, 0.6], (len(row), 3)), atol=1 / 255)
    reach = np.tan(camera["angle"] / 2)
    across = reach * (2 * (column + 0.5) / width - 1)[:, None] * width / height * right
    upward = reach * (1 - 2 * (row + 0.5) / height)[:, None] * np.cross(right, forward)
    ways = forward + across + upward
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    radiance = np.asarray(lights["lamp"].radiance, float).reshape(-1, 3)
    to = np.asarray(cubemap.direction(size=8), float).reshape(-1, 3)
    area = np.asarray(cubemap.solid_angle(size=8), float).reshape(-1)
    weight = area * np.exp((ways @ to.T - 1) / 0.2**2)
    expected = (weight @ radiance) / weight.sum(1, keepdims=True)
    expected = np.asarray(image.display(expected, stops=-4.0))
    off = np.abs(shown[row, column] - expected)
    assert np.ptp(expected) > 0.5
    assert off.mean() < 0.012  # of a picture of 32 rows
    assert off.max() < 0.08
    picture = saved(hand, width, height, transparent=False)
    off = np.abs(picture[..., :3] - shown)
    assert off.mean() < 0.3 / 255


def test_a_video_shows_the_camera_go_around(browser, hand, systems, lights):
    hand.page.get_by_role("button", name="save a picture").click()
    hand.page.get_by_label("what").select_option("orbit")
    for name, value in (("width in pixels", 64), ("height in pixels", 48), ("seconds", 1)):
        hand.page.get_by_label(name).fill(str(value))
    with hand.page.expect_download(timeout=120_000) as download:
        hand.page.get_by_role("button", name="save", exact=True).click()
    data = base64.b64encode(download.value.path().read_bytes()).decode()
    kind = download.value.suggested_filename.removeprefix("jaxprt.")
    player = browser.new_page()  # the viewer's own page loads nothing
    found = player.evaluate(
        """async ([data, kind]) => {
            const video = document.createElement("video"), canvas = document.createElement("canvas");
            video.src = `data:video/${kind};base64,${data}`;
            const seek = (time) => new Promise((resolve, reject) => {
                [video.onseeked, video.onerror] = [resolve, () => reject(new Error(video.error.message))];
                video.currentTime = time;
                setTimeout(() => reject(new Error(`no picture at ${time}`)), 20000);
            });
            const frames = [];
            for (const time of [1e6, 0.1, 0.5, 0.93]) {
                await seek(time);
                Object.assign(canvas, { width: video.videoWidth, height: video.videoHeight });
                const context = canvas.getContext("2d");
                context.drawImage(video, 0, 0);
                frames.push(Array.from(context.getImageData(0, 0, canvas.width, canvas.height).data));
            }
            return { width: canvas.width, height: canvas.height, duration: video.duration, frames };
        }""",
        [data, kind],
    )
    player.close()
    assert (found["width"], found["height"]) == (64, 48)
    assert found["duration"] == pytest.approx(1, abs=0.4)
    _, first, half, last = (np.reshape(frame, (48, 64, 4))[..., :3] / 255 for frame in found["frames"])
    camera, state = hand.camera(), hand.state()
    offset = np.subtract(camera["eye"], camera["target"])
    for picture, share in ((first, 0.1), (half, 0.5), (last, 0.93)):
        offsets = [np.asarray(stages.about(2 * np.pi * (share + late / 30))) @ offset for late in (-1, 0, 1)]
        eyes = [np.add(camera["target"], around) for around in offsets]
        cameras = [Camera(eye, camera["target"], [0.0, 1.0, 0.0], camera["angle"], 64, 48) for eye in eyes]
        shown = [image.display(systems["lobes"].picture(lights["lamp"], eye), stops=state["stops"]) for eye in cameras]
        assert min(np.abs(picture - np.asarray(expected)).mean() for expected in shown) < 0.012
    assert np.abs(first - half).mean() > 0.03


def test_the_materials_are_saved_as_they_are_now(hand):
    typed(hand, "metallic", "1")
    hand.page.get_by_role("button", name="save a picture").click()
    hand.page.get_by_label("what").select_option("materials")
    with hand.page.expect_download() as download:
        hand.page.get_by_role("button", name="save", exact=True).click()
    told = json.loads(download.value.path().read_text())["materials"]
    assert told["ball"]["metallic"] == 1
    assert told["ball"]["roughness"] == pytest.approx(0.5)
    assert set(told["ground"]) == {"diffuse"}


def test_it_starts_at_the_automatic_exposure_of_the_object_in_each_light(hand, systems, lights):
    scene, view_of = systems["lobes"], hand.camera()
    height, width = 96, round(96 * hand.pixels().shape[1] / hand.pixels().shape[0])
    camera = Camera(view_of["eye"], view_of["target"], [0.0, 1.0, 0.0], view_of["angle"], width, height)
    hidden = sides.hidden_backs(scene.scene)[np.asarray(scene.mesh.region)[np.asarray(scene.mesh.face)[:, 0]]]
    mesh, cover = seen_from_front(scene.mesh, camera, hidden), scene.coverage(camera)
    hand.page.locator("canvas.canvas").focus()
    for number, light in enumerate(lights.values()):
        color = scene.radiance(light, eye=np.asarray(view_of["eye"]))
        expected = float(image.automatic_exposure(image.render(mesh, color, camera), coverage=cover))
        assert hand.state()["light"] == number
        assert hand.state()["stops"] == pytest.approx(expected, abs=EXPOSURE)
        hand.page.keyboard.press("l")
        hand.settle()


def test_the_scene_is_shown_small_in_each_light_and_a_click_takes_it(hand, systems, lights):
    buttons = [hand.page.get_by_role("button", name=f"light: {name}") for name in lights]
    for number, button in enumerate(buttons):
        button.wait_for()
        assert button.get_attribute("aria-pressed") == str(number == 0).lower()
    hand.pictured()
    camera = hand.camera()
    eye = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], 72, 54)
    cover = np.asarray(systems["lobes"].coverage(eye)) == 1
    for pixel, light in zip(hand.small(), lights.values(), strict=True):
        picture = systems["lobes"].picture(light, eye, shadows="vertices")
        expected = np.asarray(image.display(picture, stops=systems["lobes"].exposure(picture, eye)))
        off = np.abs(pixel[..., :3] / 255 - expected)[cover]
        assert off.mean() < 0.006
    buttons[1].click()
    hand.settle()
    assert hand.state()["light"] == 1
    assert buttons[1].get_attribute("aria-pressed") == "true"


def saved(hand, width, height, *, transparent):
    """The pixels of a picture that the dialog saves, in [0, 1]."""
    hand.page.get_by_role("button", name="save a picture").click()
    hand.page.get_by_label("width in pixels").fill(str(width))
    hand.page.get_by_label("height in pixels").fill(str(height))
    hand.page.get_by_label("transparent background").set_checked(transparent)
    with hand.page.expect_download(timeout=60_000) as download:
        hand.page.get_by_role("button", name="save", exact=True).click()
    assert download.value.suggested_filename == "jaxprt.png"
    picture = np.asarray(Image.open(download.value.path())) / 255
    hand.page.get_by_label("width in pixels").wait_for(state="hidden")
    return picture


def test_a_picture_of_any_size_is_saved_with_alpha(hand, systems, lights, session, monkeypatch):
    typed(hand, "rotation °", "40")
    state, camera = hand.state(), hand.camera()
    eye = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], 50, 30)
    light = rotate(lights["lamp"], stages.about(state["turn"]))
    expected = image.display(systems["lobes"].picture(light, eye, samples=16), stops=state["stops"])
    np.testing.assert_allclose(saved(hand, 50, 30, transparent=False), expected, atol=0.6 / 255)
    clear = saved(hand, 50, 30, transparent=True)
    np.testing.assert_allclose(clear[..., 3], systems["lobes"].coverage(eye, samples=16), atol=0.6 / 255)
    hand.page.get_by_role("button", name="save a picture").click()
    for name in ("width", "height"):
        hand.page.get_by_label(f"{name} in pixels").fill("8000")
    hand.page.get_by_role("button", name="save", exact=True).click()
    hand.page.get_by_text("a picture must have at most 16777216 pixels, got 8000 x 8000").wait_for()
    hand.page.get_by_label("width in pixels").fill("50")
    hand.page.get_by_label("height in pixels").fill("30")
    picture = session.stages.picture

    def slow(*arguments, **options):
        time.sleep(1.5)
        return picture(*arguments, **options)

    monkeypatch.setattr(session.stages, "picture", slow)
    hand.page.get_by_label("transparent background").set_checked(False)
    bar = hand.page.get_by_role("progressbar", name="a picture of 50 x 30 pixels")
    with hand.page.expect_download():
        hand.page.get_by_role("button", name="save", exact=True).click()
        bar.wait_for()
        assert hand.page.locator(".stagetext").text_content() == "a picture of 50 x 30 pixels"
    bar.wait_for(state="hidden")
    hand.page.get_by_role("button", name="save a picture").click()
    hand.page.get_by_role("button", name="save", exact=True).click()
    hand.page.get_by_role("button", name="cancel").click()
    hand.page.get_by_role("button", name="save a picture").click()  # while Python is still at what was given up
    assert hand.page.get_by_label("what").is_enabled()
    assert hand.page.locator("dialog .note").text_content() == ""
    hand.page.get_by_role("button", name="cancel").click()


def test_the_dialog_opens_with_what_was_saved_last_and_without_what_was_canceled(hand):
    page = hand.page
    fields = [page.get_by_label(name) for name in ("width in pixels", "height in pixels", "transparent background")]
    opener, cancel = (page.get_by_role("button", name=name) for name in ("save a picture", "cancel"))

    def shown():
        opener.click()
        return fields[0].input_value(), fields[1].input_value(), fields[2].is_checked()

    first = shown()
    canvas = hand.page.evaluate(f"() => [({CANVAS}).width, ({CANVAS}).height].map(String)")
    assert first == (*canvas, False)
    fields[0].fill("7")
    fields[2].set_checked(True)
    cancel.click()
    assert shown() == first
    for field in fields[:2]:
        field.fill("8000")
    page.get_by_role("button", name="save", exact=True).click()
    page.get_by_text("a picture must have at most 16777216 pixels, got 8000 x 8000").wait_for()
    cancel.click()
    assert shown() == first
    assert page.locator("dialog .note").text_content() == ""
    cancel.click()
    saved(hand, 50, 30, transparent=True)
    assert shown() == ("50", "30", True)
    cancel.click()


def test_an_exported_page_saves_pictures_by_its_graphics_card(browser, systems, lights, tmp_path):
    piece = view.export(systems["harmonics"], tmp_path / "page.html", environments=lights)
    hand = Hand(browser, piece.path.as_uri())
    hand.page.wait_for_function(f"() => ({CANVAS}).pixels().stats.samples === 9", timeout=60_000)
    hand.page.wait_for_timeout(300)
    shown = hand.pixels()
    height, width = shown.shape[:2]
    picture = saved(hand, width, height, transparent=False)
    assert picture.shape == (height, width, 4)
    np.testing.assert_array_equal(picture[..., 3], 1)
    off = np.abs(picture[..., :3] - shown)
    assert off.mean() < 1 / 255
    assert np.quantile(off, 0.99) < 0.1  # along edges
    clear = saved(hand, width, height, transparent=True)
    inside = clear[..., 3] == 1
    assert 0.2 < inside.mean() < 0.9
    np.testing.assert_allclose(clear[inside], picture[inside], atol=1.5 / 255)
    assert np.all(clear[clear[..., 3] == 0] == 0)
    assert not hand.errors
    hand.page.close()


def test_the_theme_follows_the_system_until_a_button_changes_it(browser, server):
    tab = browser.new_context(viewport={"width": 584, "height": 320}, color_scheme="light").new_page()
    ground = f"() => getComputedStyle({ROOT}.querySelector('.panel')).backgroundColor"

    def brightness():
        return np.mean(json.loads(tab.evaluate(ground).replace("rgb(", "[").replace(")", "]")))

    tab.goto(server.url)
    tab.get_by_role("button", name="dark or light").wait_for()
    assert brightness() > 200
    tab.get_by_role("button", name="dark or light").click()
    assert brightness() < 60
    tab.reload()
    tab.get_by_role("button", name="dark or light").wait_for()
    assert brightness() < 60
    tab.context.close()


def test_thirty_parts_are_folded_found_by_name_and_picked_in_the_picture(browser, lights, shoot):
    ball, material = builtin.sphere(rings=6, sectors=12), TexturedMaterial((0.3, 0.3, 0.1), metallic=0.5, roughness=0.5)
    parts = []
    for k in range(30):
        place = np.float32([k % 6 - 2.5, k // 6 - 2, 0])
        mesh = prt.scene.mesh.make_mesh(0.4 * np.asarray(ball.position) + place, ball.face)
        parts.append(Part(f"piece {k}", mesh, material))
    scene = Scene(parts, cameras=[Camera([0.0, 0.0, 9.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.7, 64, 64)])
    made = prt.precompute(scene, refine=False, system=prt.relit.Harmonics(2), size=8, progress=False)
    server = Server(Session(made, environments=lights))
    hand = Hand(browser, server.url)
    resized(hand, 784, 520)
    page = hand.page
    assert page.evaluate(OPENED) == []
    shoot(hand, "thirty parts")
    page.get_by_label("find a part").fill("piece 2")
    assert page.locator("details.part").filter(visible=True).count() == 11  # 2, and 20 to 29
    # The middle of the picture is that of the third row, between the third and the fourth ball.
    height = 520 / (2 * 9 * np.tan(0.35))
    page.keyboard.down("Alt")
    page.mouse.click(260 + 0.5 * height, 260 - height)
    page.keyboard.up("Alt")
    assert page.evaluate(OPENED) == ["piece 21"]
    shoot(hand, "picked")
    typed(hand, "roughness", "0.9")
    assert hand.state()["materials"] == {"piece 21": {"roughness": 0.9}}
    page.mouse.dblclick(260 + 1.5 * height, 260)
    hand.settle()
    assert page.evaluate(OPENED) == ["piece 16", "piece 21"]
    page.close()
    assert not hand.errors
    server.close()
