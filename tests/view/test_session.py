"""Answers of a session: colors and pictures of the state that is asked for, and words where it is wrong."""

import dataclasses
import io
import json
import tempfile
import threading
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

import jaxprt as prt
from jaxprt import files, image, require
from jaxprt.relit import canvas, pictures
from jaxprt.scene import Camera, Environment
from jaxprt.scene.environment import environment_from_image, rotate
from jaxprt.sphere import cubemap
from jaxprt.systems import reference
from jaxprt.view import Session, messages, stages
from jaxprt.visibility import blocks

EYE = jnp.array([2.0, 1.5, 4.0])


def halves(reply) -> np.ndarray:
    """Colors of an answer, in linear radiance."""
    assert reply.content["kind"] in ("color", "still", "sky"), reply.content
    return reply.content["scale"] * np.frombuffer(reply.buffers[0], "<f2").astype(np.float32).reshape(-1, 3)


def turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def near(value, expected):
    np.testing.assert_allclose(value, expected, rtol=2e-3, atol=2e-3 * np.max(expected))


def test_corners_go_around_counterclockwise_seen_from_the_front(lights):
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    normal = np.array([[0, 0, -1.0]] * 3)
    mesh = prt.scene.mesh.make_mesh(corner, np.array([[0, 1, 2]]), normal=normal)
    scene = prt.Scene([prt.Part("flap", mesh, prt.brdf.Lambert(0.5))])
    with pytest.warns(UserWarning, match="part 'flap' from behind"):
        made = prt.precompute(scene, refine=False, system=prt.relit.Harmonics(1), size=8, progress=False)
    face = np.frombuffer(Session(made, environments=lights).answer({"kind": "scene"}).buffers[1], "<u4")
    np.testing.assert_array_equal(face, [2, 1, 0])


def test_a_scene_is_told_with_what_can_change(session, systems):
    reply = session.answer({"kind": "scene"})
    scene = systems["lobes"]
    json.dumps(reply.content, allow_nan=False)
    position, face = (np.frombuffer(data, kind) for data, kind in zip(reply.buffers, ("<f4", "<u4"), strict=True))
    np.testing.assert_array_equal(position.reshape(-1, 3), scene.mesh.position)
    np.testing.assert_array_equal(face.reshape(-1, 3), scene.mesh.face)
    ball, ground = reply.content["parts"]
    assert ball["free"]["roughness_range"] == [0, 1]
    assert ball["free"]["f0"] == pytest.approx(0.04)
    assert ball["free"]["metallic"] == 0
    assert set(ground["free"]) == {"diffuse"}
    assert [part["vertices"] for part in (ball, ground)] == [len(part.mesh.position) for part in scene.scene.parts]
    assert reply.content["systems"] == {"lobes": {"bounces": True}, "harmonics": {"bounces": False}}


def test_a_picture_and_the_scene_are_files_of_other_programs(session, systems, lights, look, tmp_path):
    material = {"ball": {"roughness": 0.7, "diffuse": [0.1, 0.2, 0.3]}}
    asked = look | {
        "kind": "picture",
        "width": 24,
        "height": 16,
        "transparent": True,
        "samples": 4,
        "materials": material,
    }
    path = tmp_path / "picture.exr"
    path.write_bytes(session.answer(asked | {"format": "exr"}).buffers[0])
    pixel, _ = files.read_image(path)
    scene, camera = systems["lobes"].without_bounces(), Camera([2, 1.5, 4], [0, 0, 0], [0, 1, 0], 0.7, 24, 16)
    changed = {"ball": stages.change_material(scene.scene["ball"].material, "ball", material["ball"])}
    expected = scene.picture(lights["lamp"], camera, materials=changed, background=None)
    np.testing.assert_allclose(pixel, expected, atol=2e-3 * float(jnp.max(expected)))
    assert session.answer(asked | {"format": "gif"}).content["message"] == "the format must be png or exr, got 'gif'"
    path = tmp_path / "scene.glb"
    path.write_bytes(session.answer(asked | {"kind": "glb"}).buffers[0])
    again = prt.load_scene(path)
    assert again.names == scene.scene.names
    np.testing.assert_allclose(again["ball"].material.base_color, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(again["ball"].material.roughness, 0.7, rtol=1e-6)
    np.testing.assert_allclose(again["ground"].mesh.position, scene.scene["ground"].mesh.position, atol=1e-6)


@pytest.mark.parametrize(("system", "bounces"), [("lobes", True), ("harmonics", False)])
def test_a_look_is_the_radiance_of_its_state(session, systems, lights, look, system, bounces):
    look |= {"system": system, "bounces": bounces, "turn": 0.7, "eye": [1.0, 2.0, 3.0]}
    scene = systems[system]
    if not bounces:
        scene = scene.without_bounces()
    expected = scene.radiance(rotate(lights["lamp"], turned(0.7)), eye=jnp.array([1.0, 2.0, 3.0]))
    near(halves(session.answer(look)), expected)


def test_materials_of_a_look_are_those_of_the_scene_with_them(session, systems, lights, look):
    scene = systems["lobes"]
    old = scene.scene["ball"].material
    change = {"roughness": 0.7, "metallic": 0.3, "f0": 0.5, "diffuse": [0.1, 0.2, 0.3], "specular": [1, 0.5, 0.2]}
    look["materials"] = {"ball": change}
    new = dataclasses.replace(
        old,
        roughness=0.7,
        metallic=0.3,
        base_color=jnp.array([0.1, 0.2, 0.3]),
        specular_color=jnp.array([1, 0.5, 0.2]) * 0.5 / 0.04,
    )
    near(
        halves(session.answer(look)), scene.without_bounces().radiance(lights["lamp"], eye=EYE, materials={"ball": new})
    )


def test_a_saved_picture_is_that_of_the_scene_and_its_alpha_is_what_surfaces_cover(session, systems, lights, look):
    asked = look | {"kind": "picture", "width": 24, "height": 16, "stops": -1.0, "tone": "filmic", "turn": 0.7}
    scene = systems["lobes"].without_bounces()
    camera = Camera(look["eye"], look["target"], [0.0, 1.0, 0.0], look["field_of_view"], 24, 16)
    light = rotate(lights["lamp"], turned(0.7))

    def saved(transparent):
        reply = session.answer(asked | {"transparent": transparent})
        assert reply.content == {"kind": "picture", "width": 24, "height": 16}
        return np.asarray(Image.open(io.BytesIO(reply.buffers[0]))) / 255

    picture = scene.picture(light, camera, samples=16)
    np.testing.assert_allclose(saved(False), image.display(picture, tone="filmic", stops=-1.0), atol=0.6 / 255)
    clear, cover = saved(True), np.asarray(scene.coverage(camera, samples=16))
    np.testing.assert_allclose(clear[..., 3], cover, atol=0.6 / 255)
    assert {0.0, 1.0} < set(cover.ravel().tolist())  # and some between them
    alone = scene.picture(light, camera, samples=16, background=None)[..., :3]
    straight = np.asarray(alone)[cover > 0] / cover[cover > 0, None]
    shown = image.display(jnp.asarray(straight), tone="filmic", stops=-1.0)
    np.testing.assert_allclose(clear[cover > 0, :3], shown, atol=0.6 / 255)
    np.testing.assert_array_equal(clear[cover == 0], 0)


def test_a_light_that_turns_leaves_the_view_alone(session, look, monkeypatch):
    made = []
    once = stages.Stages._once

    def counted(self, stage, key, make):
        return once(self, stage, key, lambda: (made.append(stage), make())[1])

    monkeypatch.setattr(stages.Stages, "_once", counted)
    session.answer(look | {"bounces": True})
    made.clear()
    session.answer(look | {"bounces": True, "turn": 0.3})
    assert sorted(made) == ["color", "environment", "light", "shade"]
    made.clear()
    session.answer(look | {"bounces": True, "turn": 0.3, "eye": [0.0, 1.0, 5.0]})
    assert sorted(made) == ["color", "view"]
    made.clear()
    session.answer(look | {"bounces": True, "turn": 0.3, "eye": [0.0, 1.0, 5.0], "materials": {"ball": {"f0": 0.3}}})
    assert sorted(made) == ["color", "material", "shade", "view"]


@pytest.mark.parametrize("kind", ["look", "still"])
def test_a_new_light_eye_or_material_compiles_no_program_again(session, look, kind):
    asked = look | {"kind": kind, "bounces": True, "width": 48, "height": 32}
    compiled = []

    def count(event: str, duration_secs: float, **more):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration_secs)

    def change(number: int) -> dict:
        lamp = {"direction": [0.2, 1.0, 0.1 * number], "angle": 0.1 * (number + 1), "radiance": [5.0, 4.0, number]}
        ball = {"f0": 0.03 * number, "diffuse": [0.1 * number, 0.2, 0.3], "roughness": 0.7 + 0.02 * number}
        state = {"turn": 0.3 * (number + 1), "eye": [2.0, 1.0 + 0.1 * number, 4.0 - 0.1 * number]}
        return state | {"lamps": [lamp], "materials": {"ball": ball, "ground": {"diffuse": [0.1 * number, 0.5, 0.5]}}}

    session.answer(asked)
    session.answer(asked | change(0))
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        for number in range(1, 11):
            assert session.answer(asked | change(number) | {"light": number % 2}).content["kind"] in ("color", "still")
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert not compiled


def test_pictures_at_rest_are_those_of_the_scene(session, systems, lights, look):
    scene = systems["lobes"]
    reply = session.answer(look | {"kind": "still", "width": 48, "height": 32})
    camera = Camera(EYE, [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.7, 48, 32)
    expected = scene.without_bounces().picture(lights["lamp"], camera)
    near(halves(reply).reshape(32, 48, 3), expected)


def test_the_exact_picture_comes_with_the_error_of_the_other_and_without_a_background_if_asked(
    session, systems, lights, look
):
    asked = look | {"kind": "exact", "width": 24, "height": 16, "eye": [6.0, 2.0, 8.0]}
    whole, clear = (session.answer(asked | {"transparent": each}) for each in (False, True))
    assert whole.content["exact"]
    assert 0 < whole.content["error"] < 0.5
    camera = Camera(asked["eye"], look["target"], [0.0, 1.0, 0.0], look["field_of_view"], 24, 16)
    cover = np.asarray(systems["lobes"].coverage(camera)).reshape(-1, 1)
    alpha = np.frombuffer(zlib.decompress(clear.buffers[1]), np.uint8).reshape(-1, 1) / 255
    np.testing.assert_allclose(alpha, cover, atol=0.6 / 255)
    assert {0.0, 1.0} < set(cover.ravel().tolist())
    assert not halves(clear)[cover[:, 0] == 0].any()
    behind = np.asarray(prt.image.sky(lights["lamp"], camera)).reshape(-1, 3)
    near(cover * halves(clear) + (1 - cover) * behind, halves(whole))


def test_coarse_pictures_are_smaller_and_like_the_others(session, look):
    size = {"width": 48, "height": 32}
    whole, coarse = (session.answer(look | size | {"kind": "still", "coarse": each}) for each in (False, True))
    assert [coarse.content[name] for name in size] == [24, 16]
    mean = halves(whole).reshape(16, 2, 24, 2, 3).mean((1, 3)).reshape(-1, 3)
    assert image.relative_l2(halves(coarse), mean) < 0.3  # edges have steps
    exact = session.answer(look | {"kind": "exact", "coarse": True, "width": 96, "height": 64})
    assert [exact.content[name] for name in size] == [24, 16]
    assert "error" not in exact.content
    assert image.relative_l2(halves(exact), halves(coarse)) < 0.5


def counted(monkeypatch, module, name, then=lambda count: None):
    """Counts the calls of a function; `then` is called with their number after each."""
    function, calls = getattr(module, name), []

    def counting(*argument, **named):
        result = function(*argument, **named)
        calls.append(name)
        then(len(calls))
        return result

    monkeypatch.setattr(module, name, counting)
    return calls


def test_a_picture_under_way_is_given_up_within_a_row_of_the_next_look(session, look, monkeypatch):
    monkeypatch.setattr(canvas, "ROW", 128)
    asked = look | {"kind": "still", "viewer": "a", "width": 48, "height": 32}
    moved = {3: {"viewer": "b", "seq": 9}}  # after how many rows which viewer moves

    def move(count):
        if count in moved:
            assert session.answer(look | moved[count]).content["kind"] == "color"

    rows = counted(monkeypatch, pictures, "radiance", move)
    whole = session.answer(asked)
    assert whole.content["kind"] == "still"  # another viewer's moves leave it alone
    count = len(rows)
    assert count > 4
    moved[count + 2] = {"viewer": "a", "seq": 2}
    assert session.answer(asked).content == {"kind": "late", "seq": 1}
    assert len(rows) == count + 2
    again = session.answer(asked | {"seq": 2})
    assert again.buffers == whole.buffers


def test_the_exact_picture_is_given_up_within_a_block_of_the_next_look(session, look, monkeypatch):
    asked = look | {"kind": "exact", "width": 24, "height": 16}
    sums = counted(monkeypatch, reference, "integrate", lambda count: count == 2 and session.answer(look | {"seq": 2}))
    assert session.answer(asked).content == {"kind": "late", "seq": 1}
    assert 2 <= len(sums) <= 2 + blocks.cores()
    given_up = len(sums)
    assert session.answer(asked | {"seq": 2}).content["exact"]
    assert len(sums) > given_up + 2 * (2 + blocks.cores())


def test_bytes_are_exposed_and_encoded_for_a_display(session, look):
    linear = halves(session.answer(look))
    data = zlib.decompress(session.answer(look | {"stops": 1.5}).buffers[0])
    level = np.cumsum(np.frombuffer(data, np.uint8).reshape(3, -1), axis=1, dtype=np.uint8).T
    expected = image.display(image.expose(jnp.asarray(linear), stops=1.5))
    np.testing.assert_allclose(level / 255, expected, atol=0.6 / 255)


def test_radiance_beyond_half_floats_keeps_its_ratios(systems, look):
    bright = {"bright": Environment(np.full((6, 8, 8, 3), 1e7))}
    plain = {"bright": Environment(np.ones((6, 8, 8, 3)))}
    value, unit = (halves(Session(systems, environments=light).answer(look)) for light in (bright, plain))
    near(value, 1e7 * unit)


def test_a_small_lamp_has_its_flux_in_its_direction(session, lights, look):
    lamp = {"direction": [0.3, 1.0, 0.2], "angle": 0.05, "radiance": [100.0, 50.0, 25.0]}
    found = messages.look(look | {"light": 1, "lamps": [lamp]}, systems=["lobes"], lights=2)
    added = np.asarray(session.stages.environment(found).radiance - lights["gray"].radiance)
    flux = np.asarray(cubemap.solid_angle(size=8))[..., None] * added
    expected = 2 * np.pi * (1 - np.cos(0.05)) * np.array([100, 50, 25])
    np.testing.assert_allclose(flux.sum((0, 1, 2)), expected, rtol=1e-5)
    middle = np.einsum("frt,frtc->c", flux[..., 0], np.asarray(cubemap.direction(size=8)))
    assert middle @ [0.3, 1.0, 0.2] > np.cos(0.12) * np.linalg.norm(middle) * np.linalg.norm([0.3, 1.0, 0.2])


def test_the_picture_of_the_sky_has_up_on_top_and_z_in_the_middle(systems, look):
    side = np.zeros((6, 8, 8, 3))
    side[0], side[2], side[4] = [1, 0, 0], [0, 1, 0], [0, 0, 1]  # +x red, +y green, +z blue
    reply = Session(systems, environments={"axes": Environment(side)}).answer(look | {"kind": "sky"})
    sky = halves(reply).reshape(reply.content["height"], reply.content["width"], 3)
    near(np.stack([sky[0, 100], sky[64, 128], sky[64, 64]]), [[0, 1, 0], [0, 0, 1], [1, 0, 0]])


def test_the_sky_of_a_file_comes_in_levels_and_lamps_are_disks_on_it(systems, look):
    pixels = np.full((256, 512, 3), 0.25, np.float32)
    pixels[100:104, 300:304] = 9
    light = environment_from_image(pixels, size=8)
    lamp = {"direction": [1.0, 0.0, 0.0], "angle": 0.05, "radiance": [2.0, 3.0, 4.0]}
    asked = look | {"kind": "sky", "lamps": [lamp], "rows": 1024}
    reply = Session(systems, environments={"file": light}).answer(asked)
    size = {name: reply.content[name] for name in ("width", "height", "levels")}
    assert size == {"width": 512, "height": 256, "levels": 2}
    level = halves(reply).reshape(-1)
    fine, coarse = level[: 3 * 256 * 512].reshape(256, 512, 3), level[3 * 256 * 512 :].reshape(128, 256, 3)
    near(fine[102, 302], [9, 9, 9])
    near(fine[30, 30], [0.25] * 3)
    near(fine[127, 127], [2.25, 3.25, 4.25])
    near(coarse[63, 63], [2.25, 3.25, 4.25])
    # The disk has the solid angle 2 pi (1 - cos .05) and a smooth rim.
    covered = np.sum(fine[:, 64:192, 0] - 0.25) / 2 * (np.pi / 256) ** 2
    assert covered == pytest.approx(2 * np.pi * (1 - np.cos(0.05)), rel=0.02)
    assert Session(systems, environments={"file": light}).answer(look | {"kind": "sky"}).content["height"] == 128


def test_a_dropped_file_becomes_a_light(session, look, tmp_path):
    path = tmp_path / "gray.exr"
    files.write_exr(path, np.full((8, 16, 3), 0.25, np.float32))
    reply = session.answer({"kind": "drop", "name": "gray.exr"}, [path.read_bytes()])
    assert reply.content == {"kind": "lights", "lights": ["lamp", "gray", "gray"], "light": 2}
    np.testing.assert_allclose(np.frombuffer(reply.buffers[0], "<f4"), np.full(6 * 8 * 8 * 3, 0.25), rtol=1e-5)
    near(halves(session.answer(look | {"light": 2})) * 2, halves(session.answer(look | {"light": 1})))
    other = session.answer({"kind": "lights", "first": 1})
    assert other.content == reply.content | {"light": 1}
    assert other.buffers[1:] == reply.buffers
    assert "first must be from 0 to 3, got 4" in session.answer({"kind": "lights", "first": 4}).content["message"]


HEADER = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
FILES = [
    ("notes.txt", b"no light", "one that starts with the text 'no light'"),
    ("c.exr", b"\x00\xff", "the bytes 00 ff"),
    ("a.exr", b"\x76\x2f\x31\x01 cut", "a.exr"),
    ("b.hdr", b"", "no bytes"),
    ("a.hdr", HEADER + b"-Y 15000 +X 30000\n" + bytes(100), "a.hdr must have 1 to 268435456 pixels, got 30000 x 15000"),
    ("b.hdr", HEADER + b"-Y 8000 +X 16000\n" + bytes(100), "b.hdr: 16000 x 8000 pixels (width x height) of 3 channels"),
]


def test_files_that_are_no_environment_or_too_large_are_refused_by_name(session, look, monkeypatch):
    monkeypatch.setattr(require, "available_memory", lambda: 10**9)
    for name, data, words in FILES:
        reply = session.answer({"kind": "drop", "name": name}, [data])
        assert reply.content["kind"] == "error"
        assert words in reply.content["message"]
    assert session.answer(look).content["kind"] == "color"


WRONG = {
    "kind": ({"kind": "dance"}, "the kind of a message must be one of scene, look"),
    "system": ({"system": "magic"}, "the system must be one of lobes, harmonics, got 'magic'"),
    "light": ({"light": 2}, "the light must be a number from 0 to 1, got 2"),
    "light of truth": ({"light": True}, "the light must be a number from 0 to 1, got True"),
    "turn": ({"turn": float("nan")}, "turn must be a finite number, got nan"),
    "text": ({"turn": "1"}, "turn must be a finite number, got '1'"),
    "eye": ({"eye": [0, 0]}, "eye must be 3 numbers, got 2"),
    "target": ({"target": [2.0, 1.5, 4.0]}, "eye and target must be different points"),
    "angle": ({"field_of_view": 4}, "field_of_view must be from 0.001 to"),
    "size": ({"kind": "still", "width": 0, "height": 4}, "width must be from 1 to 2048, got 0"),
    "picture": ({"kind": "picture", "width": 4, "height": 9000}, "height must be from 1 to 8192, got 9000"),
    "pixels": (
        {"kind": "picture", "width": 8000, "height": 4000},
        "must have at most 16777216 pixels, got 8000 x 4000",
    ),
    "clear": (
        {"kind": "picture", "width": 4, "height": 4, "transparent": 1},
        "transparent must be true or false, got 1",
    ),
    "part": ({"materials": {"cat": {"f0": 0.1}}}, "materials must be for the parts ball, ground, got one for 'cat'"),
    "range": ({"materials": {"ball": {"f0": 2}}}, "f0 must be from 0 to 1, got 2"),
    "name": (
        {"materials": {"ball": {"fur": 1}}},
        "must be a dictionary with keys among roughness, exponent, metallic, f0, diffuse, specular",
    ),
    "rough": ({"materials": {"ball": {"roughness": 1.1}}}, "roughness must be from 0 to 1, got 1.1"),
    "gloss": ({"materials": {"ground": {"f0": 0.1, "specular": [1, 1, 1]}}}, None),
    "lamp": ({"lamps": [{"direction": [0, 0, 0], "angle": 1, "radiance": [1, 1, 1]}]}, "must have a length"),
    "lamps": ({"lamps": 3}, "lamps must be a list, got 3"),
    "stops": ({"stops": 1e9}, "stops must be from -60 to 60"),
    "kind of a list": ({"kind": ["look"]}, "the kind of a message must be one of scene, look"),
    "system of a list": ({"system": ["lobes"]}, "the system must be one of lobes, harmonics, got a list"),
    "light of a fraction": ({"light": 0.5}, "the light must be a number from 0 to 1, got 0.5"),
    "light beyond float64": ({"light": 10**400}, "the light must be a number from 0 to 1, got an integer of 1329 bits"),
    "turn beyond float64": ({"turn": 10**400}, "turn must be a finite number, got an integer of 1329 bits"),
    "turn of a list": ({"turn": [1]}, "turn must be a finite number, got a list"),
    "seq below 0": ({"seq": -1}, "seq must be from 0 to"),
    "eye beyond float64": ({"eye": [10**400, 0, 0]}, "eye must be a finite number"),
    "eye of text": ({"eye": "abc"}, "eye must be a list, got 'abc'"),
    "width of text": ({"kind": "exact", "width": "8", "height": 4}, "width must be a finite number, got '8'"),
    "coarse of text": (
        {"kind": "still", "width": 8, "height": 4, "coarse": "no"},
        "coarse must be true or false, got 'no'",
    ),
    "bounces of a number": ({"bounces": 1}, "bounces must be true or false, got 1"),
    "viewer of a list": ({"viewer": [1]}, "viewer must be text, got a list"),
    "vertices of a list": ({"vertices": []}, "vertices must be all, seen or unseen, got '[]'"),
    "materials of a list": ({"materials": [1]}, "materials must be a dictionary from names of parts, got a list"),
    "material of a number": ({"materials": {"ball": 3}}, "must be a dictionary with keys among"),
    "parameter of none": ({"materials": {"ball": {"diffuse": None}}}, "diffuse must be a list, got None"),
    "lamp of a number": ({"lamps": [3]}, "a lamp must have a direction, an angle and a radiance, got 3"),
    "lamp beyond float64": ({"lamps": [{"direction": [0, 1, 0], "angle": 10**400}]}, "angle must be a finite number"),
    "many lamps": ({"lamps": [{}] * 1001}, "lamps must be at most 1000, got 1001"),
    "sky of another light": ({"kind": "sky", "light": "0"}, "the light must be a number from 0 to 1, got '0'"),
    "drop of a number": ({"kind": "drop", "name": 3}, "name must be text, got 3"),
}


def test_wrong_messages_are_answered_by_what_was_required(session, look):
    for name, (fields, words) in WRONG.items():
        reply = session.answer(look | fields)
        if words is None:  # without a specular weight its color means nothing
            assert reply.content["kind"] == "color", name
            continue
        assert reply.content["kind"] == "error", name
        assert words in reply.content["message"], name
    assert session.answer(look).content["kind"] == "color"


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("../../secret/a.hdr", "a.hdr"),
        ("/etc/a.hdr", "a.hdr"),
        ("C:\\lights\\a.hdr", "a.hdr"),
        ("a\0.hdr", "a.hdr"),
        ("a" * 5000 + ".hdr", "a" * 96 + ".hdr"),
        ("a.h d r/../..", ".."),
        ("a." + "x" * 5000, "x" * 100),
        ("", "light.hdr"),
        ("\ud800.hdr", ".hdr"),
    ],
)
def test_names_of_dropped_files_lead_nowhere(session, name, shown, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    reply = session.answer({"kind": "drop", "name": name}, [b"no light"])
    assert reply.content["kind"] == "error"
    assert shown in reply.content["message"]
    assert not list(tmp_path.iterdir())
    assert messages.unpack(messages.pack(*reply))[0] == reply.content


def test_threads_get_the_answers_to_their_own_questions(session, look):
    asked = [look | {"seq": k, "turn": 0.4 * (k % 3), "materials": {"ball": {"f0": 0.1 * (k % 2)}}} for k in range(12)]
    alone = [halves(session.answer(each)) for each in asked]
    found: dict[int, np.ndarray] = {}
    threads = [
        threading.Thread(target=lambda k=k, each=each: found.update({k: halves(session.answer(each))}))
        for k, each in enumerate(asked)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    for k, expected in enumerate(alone):
        np.testing.assert_array_equal(found[k], expected)


@pytest.mark.usefixtures("unchecked")
def test_scenes_and_lights_that_do_not_fit_are_refused(systems, lights):
    with pytest.raises(ValueError, match="must have a system, got none"):
        Session({}, environments=lights)
    with pytest.raises(TypeError, match=r"the system 'a' must be of class RelitScene, which jaxprt.precompute makes"):
        Session({"a": systems["lobes"].scene}, environments=lights)
    with pytest.raises(ValueError, match="must have a light, got none"):
        Session(systems, environments={})
    with pytest.raises(ValueError, match="lights must be of one size, got faces of 4, 8 texels"):
        Session(systems, environments=lights | {"small": Environment(np.ones((6, 4, 4, 3)))})
    with pytest.raises(ValueError, match=r"the light must be one environment \[6, 8, 8, c\], got \[6, 16, 16, 3\]"):
        Session(systems, environments={"fine": Environment(np.ones((6, 16, 16, 3)))})
    with pytest.raises(ValueError, match=r"the light 'two' must be one light"):
        Session(systems, environments={"two": Environment(np.ones((2, 6, 8, 8, 3)))})


def test_vertices_that_the_eye_can_see_come_first_and_the_others_later(session, look):
    whole = halves(session.answer(look))
    first, later = (session.answer(look | {"vertices": which}) for which in ("seen", "unseen"))
    seen, unseen = (
        np.unpackbits(np.frombuffer(each.buffers[1], np.uint8))[: len(whole)] > 0 for each in (first, later)
    )
    np.testing.assert_array_equal(seen, ~unseen)
    assert 0.2 < seen.mean() < 0.8
    np.testing.assert_array_equal(halves(first), whole[seen])
    np.testing.assert_array_equal(halves(later), whole[unseen])
    mesh = session.stages.scene.mesh
    position, face = np.asarray(mesh.position, float), np.asarray(mesh.face)
    corner = position[face]
    front = (
        np.einsum("fi,fi->f", np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), EYE - corner[:, 0])
        > 1e-9
    )
    assert seen[face[front]].all()  # all corners of what is drawn
    assert session.answer(look | {"vertices": "some"}).content["kind"] == "error"


def test_messages_come_through_as_they_went_and_bytes_in_another_form_are_refused():
    content, buffers = {"kind": "look", "x": [1, 2.5]}, [b"abc", b"", bytes(range(16))]
    assert messages.unpack(messages.pack(content, buffers)) == (content, buffers)
    for data in (b"", b"abc", b"\xff\xff\xff\xff{}", messages.pack({"a": 1}, [bytes(64)])[:-40]):
        with pytest.raises(ValueError, match=f"the viewer sends, got {len(data)} bytes in another form"):
            messages.unpack(data)
    for stops in (None, 0.0):  # of looks from absurd places
        data, scale = messages.encode(np.array([[np.nan, np.inf, -np.inf], [1, 2, 3]]), stops=stops)
        assert np.isfinite(scale)
        assert stops is not None or np.isfinite(np.frombuffer(data, "<f2").astype(float)).all()
