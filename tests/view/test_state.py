"""States of the viewer: undo and redo, addresses, and files that Python draws again."""

import dataclasses
import io
import json
import urllib.parse

import numpy as np
import pytest
from PIL import Image

import jaxprt as prt
from jaxprt import image
from jaxprt.view import Server, Session
from jaxprt.view.state import load_state
from tests.view.hand import CANVAS, TOLD, Hand

LAMP = {"direction": [0.0, 1.0, 0.5], "angle": 0.2, "radiance": [9.0, 8.0, 7.0]}
SETTLED = 0.4  # seconds after which a state can be taken back


def shown(hand):
    """The state in the address."""
    return json.loads(urllib.parse.unquote(hand.page.url.partition("#")[2]))


def close_to(camera, other):
    for name in ("azimuth", "elevation", "distance", "target", "angle"):
        np.testing.assert_allclose(camera[name], other[name], rtol=1e-6, atol=1e-8)


def wait_for_history(hand):
    hand.settle()
    hand.page.wait_for_timeout(1000 * SETTLED)


def test_every_change_is_taken_back_and_done_again(hand):
    changes = {
        "a drag": lambda: hand.drag((100, 100), (140, 120)),
        "the wheel": lambda: hand.page.mouse.wheel(0, -200),
        "the light": lambda: hand.page.keyboard.press("l"),
        "its turn": lambda: hand.page.keyboard.press("]"),
        "exposure": lambda: hand.page.keyboard.press("."),
        "the background": lambda: hand.page.keyboard.press("g"),
        "all of the scene": lambda: hand.page.keyboard.press("f"),
    }
    hand.page.locator("canvas.canvas").focus()
    wait_for_history(hand)
    states, cameras = [hand.state()], [hand.camera()]
    for change in changes.values():
        change()
        wait_for_history(hand)
        states.append(hand.state())
        cameras.append(hand.camera())
    back = hand.page.get_by_role("button", name="undo")
    for key, order in (("Control+z", range(len(changes) - 1, -1, -1)), ("Control+Shift+z", range(1, len(changes) + 1))):
        for number in order:
            hand.page.keyboard.press(key)
            hand.finish()
            close_to(hand.camera(), cameras[number])
            if states[number]["auto"]:  # found anew
                assert hand.state()["stops"] == pytest.approx(states[number]["stops"], abs=0.11)
            assert hand.state() | {"stops": 0} == states[number] | {"stops": 0}
        assert back.is_disabled() == (key == "Control+z")
    back.click()
    hand.settle()
    close_to(hand.camera(), cameras[-2])
    hand.page.keyboard.press("[")  # what was taken back is gone
    wait_for_history(hand)
    assert hand.page.get_by_role("button", name="redo").is_disabled()


def test_the_wheel_keeps_what_is_under_the_pointer_and_angles_what_is_in_the_middle(hand):
    place = f"""([x, y]) => {{ const c = ({CANVAS}).camera(), box = ({CANVAS}).getBoundingClientRect();
        const ray = c.ray(box.width / box.height);
        const u = 2 * (x - box.left) / box.width - 1, v = 1 - 2 * (y - box.top) / box.height;
        return [0, 1, 2].map((i) => c.eye[i] + c.distance * (ray[i] * u + ray[3 + i] * v + ray[6 + i])); }}"""
    for at in ((60, 60), (250, 200)):
        before = hand.page.evaluate(place, at)
        hand.page.mouse.move(*at)
        hand.page.mouse.wheel(0, -300)
        hand.settle()
        np.testing.assert_allclose(hand.page.evaluate(place, at), before, atol=1e-6)
    camera = hand.camera()
    angle = hand.page.get_by_label("view angle °, typed")
    angle.fill("20")
    angle.press("Enter")
    hand.finish()
    assert angle.input_value() == "20"
    assert hand.camera()["angle"] == pytest.approx(np.radians(20))
    size = [found["distance"] * np.tan(found["angle"] / 2) for found in (camera, hand.camera())]
    assert size[1] == pytest.approx(size[0])
    assert hand.camera()["target"] == camera["target"]


def test_all_of_a_part_is_shown(hand, systems):
    position = np.asarray(systems["lobes"].scene["ball"].mesh.position)
    hand.page.mouse.dblclick(160, 150)  # the ball
    hand.settle()
    hand.page.keyboard.press("f")
    hand.settle()
    camera = hand.camera()
    np.testing.assert_allclose(camera["target"], (position.min(0) + position.max(0)) / 2, atol=1e-5)
    radius = np.linalg.norm(position.max(0) - position.min(0)) / 2
    assert camera["distance"] == pytest.approx(radius / np.sin(0.35), rel=1e-4)  # of a square picture


def test_a_turn_goes_on_for_a_moment_unless_less_motion_is_asked_for(hand):
    drag = f"""() => {{ const canvas = {CANVAS};
        canvas.setPointerCapture = () => {{}};
        const at = (x) => ({{ pointerId: 1, clientX: x, clientY: 100 }});
        const send = (kind, x) => canvas.dispatchEvent(new PointerEvent(kind, at(x)));
        send("pointerdown", 100);
        for (let x = 100; x < 140; x += 4) send("pointermove", x);
        send("pointerup", 136);
        return canvas.camera().azimuth; }}"""
    released = hand.page.evaluate(drag)
    hand.finish()
    assert hand.camera()["azimuth"] == released
    hand.page.emulate_media(reduced_motion="no-preference")
    released = hand.page.evaluate(drag)
    hand.finish()
    assert hand.camera()["azimuth"] < released - 0.01


def test_the_address_holds_the_state_and_a_file_shows_it_again(browser, server, hand):
    hand.page.evaluate(f"(lamp) => {{ ({CANVAS}).state.lamps = [lamp]; }}", LAMP)
    hand.drag((100, 100), (130, 110))
    hand.page.keyboard.press("l")
    hand.page.keyboard.press(".")
    wait_for_history(hand)
    state, camera, text = hand.state(), hand.camera(), json.dumps(shown(hand))
    other = Hand(browser, hand.page.url)
    wait_for_history(other)
    assert other.state() == state
    close_to(other.camera(), camera)
    other.page.keyboard.press("r")
    wait_for_history(other)
    other.drop({"kept.json": text.encode()})
    wait_for_history(other)
    assert other.state() == state
    close_to(other.camera(), camera)
    strange = json.loads(text) | {"light": "moon", "materials": {"ball": {"roughness": 0.4}, "roof": {"roughness": 1}}}
    other.drop({"kept.json": json.dumps(strange).encode()})
    wait_for_history(other)
    assert other.page.evaluate(f"() => {TOLD}") == "the scene lacks the light moon, the part roof of the state"
    assert other.state()["materials"] == {"ball": {"roughness": 0.4}}
    before = other.state()
    for wrong, words in (
        ("{", "kept.json: "),
        ("{}", 'kept.json: a state must be JSON with "jaxprt": "state"'),
        (json.dumps(strange | {"lamps": 3}), "kept.json: lamps of a state must be a list"),
        (json.dumps(strange | {"eye": [1, 2]}), "kept.json: eye of a state must be three numbers"),
    ):
        other.drop({"kept.json": wrong.encode()})
        other.page.wait_for_timeout(200)
        assert other.page.evaluate(f"() => {TOLD}").startswith(words)
        assert other.state() == before
    other.page.close()
    assert not other.errors


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("%7B%22jaxprt", "the address holds no state: "),
        ("%E0%A4%A", "the address holds no state: "),
        (
            '{"jaxprt":"state","light":"moon","eye":[2,1.5,4],"target":[0,0,0],"field_of_view":0.7}',
            "the scene lacks the",
        ),
    ],
)
def test_an_address_that_does_not_fit_is_told_until_something_changes(browser, server, text, words):
    made = Hand(browser, f"{server.url}#{text}")
    made.finish()
    assert made.page.evaluate(f"() => {TOLD}").startswith(words)
    made.drag((100, 100), (110, 100))
    made.page.wait_for_function(f"() => !{TOLD}")
    made.page.close()
    assert not made.errors


def test_a_picture_that_is_higher_than_wide_shows_as_much_across(browser, server, hand):
    narrow = Hand(browser, server.url)
    narrow.page.set_viewport_size({"width": 200, "height": 400})
    narrow.page.wait_for_function(f"() => ({CANVAS}).clientWidth % 320 > 0")  # drawn at another width
    narrow.page.keyboard.press("r")
    narrow.settle()
    box = narrow.page.locator("canvas.canvas").bounding_box()
    further = hand.camera()["distance"] * box["height"] / box["width"]
    assert narrow.camera()["distance"] == pytest.approx(further)
    narrow.page.close()


def test_python_draws_a_state_as_the_viewer_did(session, systems, lights, look, tmp_path):
    """By the scene, the light and the camera that a state's file makes, without the session."""
    material = {"ball": {"roughness": 0.7, "metallic": 1.0}}
    asked = look | {"kind": "picture", "width": 48, "height": 32, "stops": -1.0, "tone": "neutral", "turn": 0.7}
    asked |= {"lamps": [LAMP], "materials": material}
    saved = session.answer(asked).buffers[0]
    file = tmp_path / "kept.json"
    fields = {name: asked[name] for name in ("eye", "target", "field_of_view", "turn", "lamps", "materials", "stops")}
    file.write_text(json.dumps(fields | {"jaxprt": "state", "light": "lamp", "tone": "neutral", "aspect": 1.5}))
    state = load_state(file)
    scene = systems["lobes"].without_bounces()
    changed = {part.name: part.material for part in state.changed(scene.scene).parts if part.name == "ball"}
    picture = scene.picture(state.environment(lights), state.camera(32), materials=changed, samples=16)
    expected = np.asarray(image.display(picture, tone=state.tone, stops=state.stops))
    np.testing.assert_allclose(np.asarray(Image.open(io.BytesIO(saved))) / 255, expected, atol=1 / 255)


def test_states_that_are_none_are_refused(tmp_path, systems, lights):
    file = tmp_path / "kept.json"
    right = {"jaxprt": "state", "light": "lamp", "eye": [1, 2, 3], "target": [0, 0, 0], "field_of_view": 0.7}
    right |= {"turn": 0.0, "tone": "srgb", "aspect": 1.0}
    for wrong, words in (
        ({"jaxprt": "page"}, 'must be a state of the viewer, JSON with "jaxprt": "state"'),
        (right | {"eye": [1, 2]}, "eye must be 3 numbers, got 2"),
        (right | {"aspect": 0}, "aspect must be from 0.001 to 1000, got 0"),
        (right | {"tone": "sepia"}, "tone must be one of srgb, .*, got 'sepia'"),
    ):
        file.write_text(json.dumps(wrong))
        with pytest.raises(ValueError, match=words):
            load_state(file)
    file.write_text(json.dumps(right | {"light": "moon", "materials": {"roof": {"roughness": 0.1}}}))
    with pytest.raises(ValueError, match="the state is of the light 'moon', got 'lamp', 'gray'"):
        load_state(file).environment(lights)
    with pytest.raises(ValueError, match="the state is of a scene with the part 'roof', got 'ball', 'ground'"):
        load_state(file).changed(systems["lobes"].scene)


def test_places_of_a_state_are_those_of_the_file(browser, systems, lights, tmp_path):
    """A scene far from zero is drawn about its own origin, which the page adds again."""
    part, origin = systems["harmonics"].scene["ball"], (1e6, 2.0, -3e5)
    far = dataclasses.replace(part.mesh, origin=origin)
    scene = prt.Scene([dataclasses.replace(part, mesh=far)])
    made = prt.precompute(scene, refine=False, system=prt.relit.Harmonics(2), size=8, progress=False)
    server = Server(Session(made, environments=lights))
    hand = Hand(browser, server.url)
    hand.drag((100, 100), (140, 120))
    wait_for_history(hand)
    camera, state = hand.camera(), shown(hand)
    np.testing.assert_allclose(camera["target"], 0, atol=1e-5)
    np.testing.assert_allclose(state["target"], origin, atol=1e-3)
    np.testing.assert_allclose(np.subtract(state["eye"], origin), camera["eye"], atol=1e-3)
    file = tmp_path / "kept.json"
    file.write_text(json.dumps(state))
    np.testing.assert_allclose(load_state(file).camera(32).local(origin).eye, camera["eye"], atol=1e-3)
    other = Hand(browser, hand.page.url)
    wait_for_history(other)
    np.testing.assert_allclose(other.camera()["eye"], camera["eye"], atol=1e-3)
    for tab in (hand, other):
        tab.page.close()
        assert not tab.errors
    server.close()
