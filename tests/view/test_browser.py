"""The viewer in a real browser: hands move the state, and the canvas shows what Python draws of it.

Headless Chromium, found as `chromium`; skipped where there is none, unless JAXPRT_BROWSER_REQUIRED is set.
"""

import base64
import pathlib
import threading
import time

import numpy as np
import pytest

import jaxprt as prt
from benchmarks.endurance import growth, held
from jaxprt import files, image, view
from jaxprt.image import tonemap
from jaxprt.scene import Camera
from jaxprt.scene.environment import rotate
from jaxprt.systems import standard
from jaxprt.view import Server, Session
from tests.view.hand import CANVAS, TOLD, Hand


def drawn(hand, systems, lights, shadows="rays"):
    """The picture that Python draws of the state of a tab."""
    state, camera = hand.state(), hand.camera()
    scene = systems[state["system"]]
    if not state["bounces"]:
        scene = scene.without_bounces()
    c, s = np.cos(state["turn"]), np.sin(state["turn"])
    light = rotate(list(lights.values())[state["light"]], np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    height, width = hand.pixels().shape[:2]
    view = Camera(camera["eye"], camera["target"], [0.0, 1.0, 0.0], camera["angle"], width, height)
    return np.asarray(
        image.display(image.expose(scene.picture(light, view, shadows=shadows), stops=float(state["stops"])))
    )


def test_the_canvas_shows_what_python_draws(hand, systems, lights):
    hand.page.locator("canvas.canvas").focus()
    hand.still()
    off = np.abs(hand.pixels() - drawn(hand, systems, lights)).max(-1)
    assert np.quantile(off, 0.997) < 2.5 / 255  # Rays of a few pixels pass an edge on the other side.
    assert np.mean(off) < 0.5 / 255


def test_while_it_moves_the_canvas_shows_radiance_of_vertices_within_antialiasing(hand, systems, lights):
    hand.page.locator("canvas.canvas").focus()
    hand.page.keyboard.press("p")
    hand.drag((100, 150), (150, 170))
    hand.page.keyboard.press("]")
    hand.settle()
    time.sleep(0.3)
    off = np.abs(hand.pixels() - drawn(hand, systems, lights, shadows="vertices")).max(-1)
    assert np.quantile(off, 0.9) < 0.03
    assert np.mean(off) < 0.02


def test_drags_and_keys_move_the_state(hand):
    first = hand.camera()
    hand.drag((100, 100), (140, 120))
    assert hand.camera()["azimuth"] == pytest.approx(first["azimuth"] - 0.4)
    assert hand.camera()["elevation"] == pytest.approx(first["elevation"] + 0.2)
    hand.drag((100, 100), (132, 100), button="right")
    moved = np.subtract(hand.camera()["target"], first["target"])
    assert np.linalg.norm(moved) == pytest.approx(0.1 * 2 * first["distance"] * np.tan(0.35), rel=1e-3)
    hand.page.keyboard.down("Shift")
    hand.drag((100, 100), (150, 100))
    hand.page.keyboard.up("Shift")
    assert hand.state()["turn"] == pytest.approx(0.5)
    hand.page.mouse.wheel(0, 100)
    hand.settle()
    assert hand.camera()["distance"] == pytest.approx(first["distance"] * np.exp(0.1))
    start = hand.state()["stops"]
    hand.page.keyboard.press(".")
    assert hand.state()["stops"] == pytest.approx(start + 0.5)
    assert not hand.state()["auto"]
    for keys, name, value in (
        ("l", "light", 1),
        ("b", "bounces", False),
        ("s", "system", "harmonics"),
    ):
        hand.page.keyboard.press(keys)
        hand.settle()
        assert hand.state()[name] == value
    hand.page.keyboard.press("r")
    hand.settle()
    assert hand.camera()["eye"] == pytest.approx(first["eye"])
    assert hand.state()["turn"] == 0
    assert hand.state()["auto"]


@pytest.fixture
def touch(hand):
    """Puts fingers on the page, at places by their numbers, moves them and takes them away."""
    tab = hand.page.context.new_cdp_session(hand.page)

    def send(kind, places):
        points = [{"id": number, "x": x, "y": y} for number, (x, y) in enumerate(places)]
        tab.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    def move(start, end, steps=5):
        start, end = np.array(start, float), np.array(end, float)
        send("touchStart", start)
        for share in np.linspace(0, 1, steps + 1)[1:]:
            send("touchMove", start + share * (end - start))
        send("touchEnd", [])
        hand.settle()

    return move


def test_one_finger_orbits_and_two_zoom_and_pan(hand, touch):
    first = hand.camera()
    touch([(100, 100)], [(140, 120)])
    turned = hand.camera()
    assert turned["azimuth"] == pytest.approx(first["azimuth"] - 0.4)
    assert turned["elevation"] == pytest.approx(first["elevation"] + 0.2)
    assert turned["distance"] == first["distance"]
    touch([(130, 160), (190, 160)], [(100, 160), (220, 160)])  # twice as far apart around the middle of the picture
    pinched = hand.camera()
    assert pinched["distance"] == pytest.approx(first["distance"] / 2)
    assert pinched["azimuth"] == turned["azimuth"]
    np.testing.assert_allclose(pinched["target"], first["target"], atol=0.02 * first["distance"])
    touch([(100, 100), (160, 100)], [(100, 132), (160, 132)])
    panned = hand.camera()
    moved = np.subtract(panned["target"], pinched["target"])
    assert np.linalg.norm(moved) == pytest.approx(0.1 * 2 * pinched["distance"] * np.tan(0.35), rel=0.02)
    assert panned["distance"] == pytest.approx(pinched["distance"], rel=0.02)


def test_a_double_click_looks_at_a_point_of_the_surface(hand):
    hand.page.mouse.dblclick(
        *hand.page.evaluate(
            f"() => {{ const b = ({CANVAS}).getBoundingClientRect(); return [b.width / 2, b.height / 2]; }}"
        )
    )
    hand.settle()
    assert np.linalg.norm(hand.camera()["target"]) == pytest.approx(1, abs=0.03)  # the ball's radius


def test_a_point_in_the_plane_and_a_color_change_the_material(hand):
    plane = hand.page.locator("canvas.plane")
    plane.scroll_into_view_if_needed()
    box = plane.bounding_box()
    before = hand.pixels()
    hand.drag((box["x"] + 20, box["y"] + 100), (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2))
    assert hand.state()["materials"]["ball"] == pytest.approx({"roughness": 0.5, "f0": 0.25}, abs=0.02)
    hand.page.get_by_label("base color").first.fill("#0000ff")
    hand.settle()
    assert hand.state()["materials"]["ball"]["diffuse"] == pytest.approx([0, 0, 1])
    assert np.abs(hand.pixels() - before).max() > 0.1


def test_a_dropped_file_is_the_light_and_another_one_says_what_is_wrong(hand, tmp_path):
    path = tmp_path / "red.exr"
    files.write_exr(path, np.broadcast_to(np.float32([0.5, 0, 0]), (8, 16, 3)))
    hand.drop({"red.exr": path.read_bytes()})
    hand.page.wait_for_function(f"() => ({CANVAS}).state.light === 2")
    hand.settle()
    for _ in range(20):
        time.sleep(0.3)
        shown = hand.pixels()
        if shown[..., 1:].max() < 0.02:
            break
    assert shown[..., 1:].max() < 0.02
    assert shown[..., 0].mean() > 0.3
    hand.drop({"poem.txt": b"roses are red"})
    hand.page.wait_for_function(f"() => {TOLD}.includes('poem.txt')")
    assert hand.state()["light"] == 2


def test_many_fast_drags_leave_no_queue_and_end_at_the_newest_state(hand):
    hand.page.mouse.move(50, 50)
    hand.page.mouse.down()
    before = hand.stats()
    for k in range(200):
        hand.page.mouse.move(50 + k % 60, 50 + k % 45)
    hand.page.mouse.up()
    hand.settle()
    hand.wait("got === stats.sent")  # a busy browser may take what the eye cannot see later
    after = hand.stats()
    assert 20 <= after["seq"] - before["seq"] <= 200  # a busy browser takes several moves for one
    assert after["sent"] - before["sent"] <= after["seq"] - before["seq"] + 1
    time.sleep(0.2)
    assert hand.stats()["sent"] == after["sent"]


@pytest.fixture
def pictures(session, monkeypatch):
    """Pictures at rest that take 600 ms more, and counts of them."""
    picture, lock = session.stages.picture, threading.Lock()
    counts = {"under way": 0, "most": 0, "given up": 0, "asked": []}

    def count(change):
        with lock:
            counts["under way"] += change
            counts["most"] = max(counts["most"], counts["under way"])

    def slow(look, width, height, *, samples, between):
        counts["asked"].append((width, height, samples))
        count(1)
        try:
            last = time.monotonic() + 0.6
            while time.monotonic() < last:
                between()
                time.sleep(0.01)
            return picture(look, width, height, samples=samples, between=between)
        except Exception:
            counts["given up"] += 1
            raise
        finally:
            count(-1)

    monkeypatch.setattr(session.stages, "picture", slow)
    return counts


def test_fast_moves_leave_at_most_one_picture_under_way_and_the_last_one_arrives(hand, pictures):
    hand.page.mouse.move(50, 50)
    hand.page.mouse.down()
    for k in range(200):
        hand.page.mouse.move(50 + k % 60, 50 + k % 45)
        if k % 50 == 49:
            asked = len(pictures["asked"])
            while len(pictures["asked"]) == asked:  # a picture begins as soon as the hand rests
                time.sleep(0.01)
            assert pictures["under way"] == 1
    hand.page.mouse.move(60, 60)
    hand.page.mouse.up()
    moved = hand.stats()["stills"]
    hand.wait(f"stills > {moved}")
    assert pictures["most"] == 1
    assert pictures["given up"] >= 4
    assert pictures["under way"] == 0


def test_a_coarse_picture_comes_first_where_whole_ones_take_long(hand, pictures, systems, lights):
    hand.page.locator("canvas.canvas").focus()
    pictures["asked"].clear()
    for _ in range(3):
        hand.page.keyboard.press("]")
        hand.still()
    whole = (*hand.pixels().shape[1::-1], 4)
    coarse = (whole[0] // 2, whole[1] // 2, 1)
    assert pictures["asked"][-2:] == [coarse, whole]
    assert pictures["asked"].count(coarse) == hand.stats()["coarse"]
    np.testing.assert_allclose(hand.pixels(), drawn(hand, systems, lights), atol=2.5 / 255)


def test_two_viewers_at_once_and_a_tab_opened_again(browser, server, hand):
    other = Hand(browser, server.url)
    other.drag((50, 50), (90, 50), steps=15)
    hand.drag((50, 50), (50, 90))
    assert hand.camera()["azimuth"] != other.camera()["azimuth"]
    for each in (other, hand):  # each counts its own looks: one that moves less gets its pictures, too
        before = each.stats()["stills"]
        each.page.keyboard.press("]")
        each.settle()
        each.wait(f"stills > {before}")
    other.page.close()
    again = Hand(browser, server.url)
    assert (
        again.camera()["azimuth"] != hand.camera()["azimuth"]
        or again.camera()["elevation"] != hand.camera()["elevation"]
    )
    again.page.close()


def test_a_light_that_was_dropped_on_another_page_is_there_when_the_hand_comes_back(browser, server, hand, tmp_path):
    path = tmp_path / "green.exr"
    files.write_exr(path, np.broadcast_to(np.float32([0, 0.5, 0]), (8, 16, 3)))
    other = Hand(browser, server.url)
    hand.drop({path.name: path.read_bytes()})
    hand.page.wait_for_function(f"() => ({CANVAS}).state.light >= 2")
    other.page.mouse.move(60, 60)
    root = "document.querySelector('#viewer').shadowRoot"
    other.page.wait_for_function(f"() => [...{root}.querySelectorAll('option')].some((each) => each.text === 'green')")
    other.settle()
    assert other.state()["light"] == 0
    other.page.close()


def test_a_server_that_was_killed_is_told_and_the_viewer_goes_on_when_it_is_back(browser, systems, lights):
    server = Server(Session(systems, environments=lights))
    hand = Hand(browser, server.url)
    port, token = server._server.server_port, server._server.token
    server.close()
    hand.page.mouse.move(60, 60)
    hand.page.mouse.down()
    hand.page.mouse.move(90, 60)
    hand.page.mouse.up()  # colors may come from the GPU; the picture at rest that follows is Python's
    hand.page.wait_for_function(f"() => {TOLD}.includes('no answer from Python')")
    back = Server(Session(systems, environments=lights), port=port)
    back._server.token = token
    hand.wait("stills > 0")
    hand.page.wait_for_function(f"() => {TOLD} === ''")
    assert not hand.errors
    hand.page.close()
    back.close()


@pytest.mark.long
def test_five_hundred_looks_of_two_browsers_end_right_and_leave_little_behind(browser, second, systems, lights):
    server = Server(Session(systems, environments=lights))
    hands, random, counts = [Hand(each, server.url) for each in (browser, second)], np.random.default_rng(0), []
    for number in range(500):
        hand = hands[number % 2]
        way = (np.array([150, 150]) + random.uniform(-30, 30, 2)).tolist()
        hand.drag((150, 150), way) if number % 5 else hand.page.keyboard.press("]")
        hand.settle()
        if number % 25 == 0:  # a tab that asks and is gone
            gone = browser.new_page()
            gone.goto(server.url, wait_until="commit")
            gone.close()
        if number % 100 == 51:
            hand.page.context.set_offline(True)
            hand.page.mouse.move(150, 150)
            hand.page.mouse.down()
            hand.page.mouse.move(160, 150)
            hand.page.mouse.up()
            hand.page.wait_for_function(f"() => {TOLD}.includes('no answer from Python')")
            hand.page.context.set_offline(False)
            hand.page.wait_for_function(f"() => {TOLD} === ''")
        counts.append(held())
    assert (more := growth(counts))["more_files"] <= 2, more
    assert more["more_mappings"] < 500, more
    assert more["more_bytes"] < 1e8, more
    for hand in hands:
        hand.drag((150, 150), (160, 150))
        hand.still()
        off = np.abs(hand.pixels() - drawn(hand, systems, lights)).max(-1)
        assert np.quantile(off, 0.997) < 2.5 / 255
        assert not hand.errors
        hand.page.close()
    server.close()


def test_a_lost_context_comes_back(hand):
    hand.still()
    before, stats = hand.pixels(), hand.stats()
    hand.page.evaluate(
        f"""() => {{
            const lose = ({CANVAS}).getContext('webgl2').getExtension('WEBGL_lose_context');
            lose.loseContext();
            setTimeout(() => lose.restoreContext(), 200);
        }}"""
    )
    hand.page.wait_for_function(f"() => {TOLD}.includes('context was lost')")
    hand.wait(f"seq > {stats['seq']}")  # once it has come back, all is asked for anew
    hand.settle()
    hand.wait(f"stills > {stats['stills']}")
    time.sleep(0.5)
    assert np.abs(hand.pixels() - before).mean() < 0.02


def test_a_far_kernel_sends_bytes_of_what_is_seen_first(hand, session, monkeypatch):
    hand.page.evaluate(f"() => ({CANVAS}).focus()")
    for key in "pg":  # colors of the vertices alone
        hand.page.keyboard.press(key)
    hand.settle()
    near, answer, asked = hand.pixels(), session.answer, []

    def slow(message, buffers=()):
        time.sleep(0.2)
        asked.append(message.get("vertices"))
        return answer(message, buffers)

    monkeypatch.setattr(session, "answer", slow)
    for key in "]]]][[[[":
        hand.page.keyboard.press(key)
        hand.settle()
    hand.page.wait_for_timeout(1500)
    assert "seen" in asked
    assert [each for each in asked if each][-1] == "unseen"
    assert hand.state()["turn"] == pytest.approx(0, abs=1e-9)
    off = np.abs(hand.pixels() - near)  # bytes are interpolated as displays have them, and half floats as radiance
    assert off.mean() < 1 / 255
    assert off.max() < 0.1


def test_the_plane_of_blinn_phong_changes_exponent_and_reflectance(browser, lights):
    ball = prt.Part("ball", prt.scene.builtin.sphere(rings=8, sectors=16), prt.brdf.BlinnPhong(0.3, 0.2, 20.0))
    made = prt.precompute(prt.Scene([ball]), refine=False, system=prt.relit.Lobes(), size=8, progress=False)
    server = Server(Session(made, environments=lights))
    hand = Hand(browser, server.url)
    plane = hand.page.locator("canvas.plane")
    box = plane.bounding_box()
    plane.click(position={"x": 0.25 * box["width"], "y": 0.5 * box["height"]})
    hand.settle()
    found = hand.state()["materials"]["ball"]
    inside = (0.25 * 264 - 12) / 240  # the plane has a margin
    assert found["exponent"] == pytest.approx(standard.BLINN_PHONG.most_exponent ** (1 - inside), rel=0.1)
    assert found["f0"] == pytest.approx(0.25, abs=0.02)
    assert hand.stats()["errors"] == 0
    hand.page.close()
    server.close()


def test_the_page_displays_colors_by_the_tone_curves_of_python(hand):
    """The canvas without a picture at rest and a background shows vertex colors by each curve."""
    hand.page.evaluate(f"() => Object.assign(({CANVAS}).state, {{ still: false, background: false }})")
    hand.drag((60, 60), (66, 60))  # drops a picture at rest that came before
    place = "document.querySelector('#viewer').shadowRoot.querySelectorAll('select')"
    shown = {}
    for number, tone in enumerate(tonemap.TONES):
        hand.page.evaluate(
            f"() => {{ const select = [...{place}].find((each) => each.options[1]?.text === 'filmic');"
            f" select.value = {number}; select.onchange(); }}"
        )
        hand.finish()  # where answers take long, Python applies the curve
        assert hand.state()["tone"] == tone
        shown[tone] = hand.pixels()
    linear = np.asarray(image.decode_srgb(shown["srgb"].reshape(-1, 3)))
    inside = (linear.max(-1) < 0.97) & (linear.min(-1) > 0.03)  # neither clamped nor coarse in bytes
    assert inside.mean() > 0.05
    for tone in tonemap.TONES[1:]:
        expected = np.asarray(image.encode_srgb(tonemap.apply_curve(linear[inside], tone, np)))
        found = shown[tone].reshape(-1, 3)[inside]
        # Bytes of the first picture, and their slope.
        assert np.median(np.abs(found - expected)) < 0.006
        assert np.percentile(np.abs(found - expected), 99) < 0.03


def test_what_is_drawn_has_the_shape_of_the_window(browser):
    code = base64.b64encode((pathlib.Path(view.__file__).parent / "browser" / "common.js").read_bytes()).decode()
    page = browser.new_page()
    for width, height, ratio in ((3840, 2000, 1), (2560, 1440, 1), (1176, 800, 2), (1464, 1000, 3), (320, 320, 1)):
        size = page.evaluate(
            f"""async () => (await import("data:text/javascript;base64,{code}"))
            .drawnSize({{ width: {width}, height: {height} }}, {ratio})"""
        )
        assert size["width"] / size["height"] == pytest.approx(width / height, rel=1e-3)
        assert 0.5 * min(2, ratio) * width < size["width"] <= min(2 * width, 2048)
    page.close()
