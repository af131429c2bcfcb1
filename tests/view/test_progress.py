"""A session that starts without a scene: what it tells meanwhile, and how better scenes replace each other."""

import dataclasses
import threading

import equinox as eqx
import jax
import numpy as np
import pytest
from jax._src import compiler

import jaxprt as prt
from jaxprt import files
from jaxprt.view import Server, Session
from jaxprt.view.messages import Reply
from jaxprt.view.progress import EndedError, Progress
from jaxprt.view.unshadowed import Unshadowed
from tests.view.hand import CANVAS, Hand


@pytest.fixture
def empty():
    """A session without a scene, whose thread has ended after the test."""
    made = Session()
    yield made
    made.end()
    for thread in threading.enumerate():
        if thread.name == "jaxprt-prepare":
            thread.join(60)


def progress(session) -> dict:
    reply = session.answer({"kind": "progress"})
    assert reply.content["kind"] == "progress"
    return reply.content


def test_a_scene_that_was_there_from_the_start_is_finished(session):
    assert progress(session) | {"stage": "", "fraction": 0.0} == {
        "kind": "progress",
        "stage": "",
        "fraction": 0.0,
        "version": 1,
        "lights": 2,
        "finished": True,
    }
    assert session.answer({"kind": "scene"}).content["version"] == 1


def test_without_a_scene_progress_is_told_and_other_questions_say_why_they_wait(empty, look):
    empty.report("tracing rays", 0.25)
    state = {"kind": "progress", "stage": "tracing rays", "fraction": 0.25, "version": 0, "lights": 0}
    state |= {"finished": False}
    assert progress(empty) == state
    assert empty.answer({"kind": "scene"}).content == state
    for kind in ("look", "still", "sky", "drop"):
        message = empty.answer(look | {"kind": kind, "name": "sky.hdr", "width": 8, "height": 8}, [b"bytes"]).content
        assert message["kind"] == "error"
        assert "must have a scene, and is still preparing it" in message["message"]


def test_a_better_scene_has_a_higher_version_and_the_lights_that_were_dropped_meanwhile(
    empty, systems, lights, look, tmp_path
):
    harmonics = {"lobes": systems["harmonics"]}
    empty.show(harmonics, environments=lights, preview=True)
    scene = empty.answer({"kind": "scene"}).content
    assert (scene["version"], scene["rests"], scene["finished"]) == (1, [], False)
    path = tmp_path / "new.exr"
    files.write_exr(path, np.full((8, 16, 3), 0.25, np.float32))
    assert empty.answer({"kind": "drop", "name": "new.exr"}, [path.read_bytes()]).content["light"] == 2
    empty.show(systems)
    scene = empty.answer({"kind": "scene"}).content
    assert (scene["version"], scene["rests"]) == (2, ["still", "exact", "picture"])
    assert scene["lights"] == ["lamp", "gray", "new"]
    assert empty.answer(look | {"light": 2, "version": 2}).content["kind"] == "color"


def test_the_share_of_the_whole_way_never_falls_and_ends_at_one():
    told = Progress()
    told.plan([("rays", 0.1), ("divide", 0.4), ("rays", 0.1), ("rays", 1.0), ("compile", 0.4)])

    def share(stage, part):
        told.report(stage, part)
        return told.content()["fraction"]

    assert share("read", None) is None
    way = [("rays", 0.0), ("rays", 0.5), ("rays", 1.0), ("divide", 0.0), ("divide", 0.5), ("divide", 1.0)]
    shares = [share(*step) or 0.0 for step in way]
    np.testing.assert_allclose(shares, [0.0, 0.025, 0.05, 0.05, 0.15, 0.25])
    # What was not planned, and what nobody can measure, leave it where it is.
    assert [share("pack", 0.7), share("think", None)] == pytest.approx([0.25, 0.25])
    # The same stage again, and rays that come once less than planned.
    np.testing.assert_allclose([share("rays", 0.5), share("rays", 1.0), share("compile", 0.0)], [0.275, 0.3, 0.3])
    assert [share("compile", 0.5), share("compile", 1.0)] == pytest.approx([0.65, 1.0])
    assert share("rays", 0.0) == pytest.approx(1.0)


@pytest.mark.parametrize("kind", ["look", "still", "exact"])
def test_answers_for_an_older_scene_are_late(empty, systems, lights, look, kind):
    empty.show(systems, environments=lights, preview=True)
    empty.show(systems)
    asked = look | {"kind": kind, "version": 1, "width": 8, "height": 8}
    assert empty.answer(asked).content == {"kind": "late", "seq": 1}


def test_a_picture_under_way_is_given_up_when_a_better_scene_comes(empty, systems, lights, look, monkeypatch):
    empty.show(systems, environments=lights)

    def picture(self, look, width, height, *, samples, between):
        empty.show(systems)
        between()

    monkeypatch.setattr("jaxprt.view.stages.Stages.picture", picture)
    asked = look | {"kind": "still", "width": 8, "height": 8}
    assert empty.answer(asked).content == {"kind": "late", "seq": 1}


def test_an_error_of_the_preparation_is_told_to_the_page_and_raised_where_it_is_waited_for(empty):
    def fail():
        raise ValueError("the file must have triangles, got none")

    empty.prepare(fail)
    with pytest.raises(ValueError, match="must have triangles"):
        empty.progress.wait()
    state = progress(empty)
    assert (state["finished"], state["error"]) == (True, "the file must have triangles, got none")


def test_the_error_is_raised_at_once_when_a_page_was_told(empty):
    def fail():
        raise OSError("the disk is full")

    empty.prepare(fail)
    told = threading.Thread(target=lambda: [None for _ in iter(lambda: "error" in progress(empty), True)])
    told.start()
    with pytest.raises(OSError, match="the disk is full"):
        empty.progress.wait(patience=1e6)  # no test lasts so long
    told.join()


def test_each_step_of_what_is_prepared_waits_for_answers(empty, monkeypatch):
    monkeypatch.setattr("jaxprt.view.session._YIELD", 60)
    asked, let, order = threading.Event(), threading.Event(), []

    def answer(message, buffers):
        asked.set()
        let.wait(60)
        order.append("answer")
        return Reply({"kind": "sky"}, [])

    monkeypatch.setattr(empty, "_sky", answer)
    page = threading.Thread(target=empty.answer, args=({"kind": "sky"},))
    page.start()
    assert asked.wait(60)
    step = threading.Thread(target=lambda: (empty.report("tracing rays", 0.5), order.append("step")))
    step.start()
    step.join(0.2)
    let.set()
    step.join(60)
    page.join(60)
    assert order == ["answer", "step"]


def test_a_session_that_ends_stops_its_preparation_at_the_next_report(empty):
    began, ended, steps = threading.Event(), threading.Event(), []

    def make():
        began.set()
        ended.wait(60)
        steps.append("report")
        empty.report("tracing rays", 0.5)
        steps.append("after")

    empty.prepare(make)
    assert began.wait(60)
    empty.end()
    ended.set()
    empty.progress.wait()
    assert steps == ["report"]
    with pytest.raises(EndedError):
        empty.report("tracing rays", 1.0)


def test_looks_are_answered_while_a_picture_compiles(session, look, monkeypatch):
    def changed(number):
        state = {"turn": 0.1 * number, "materials": {"ball": {"f0": 0.02 * number}}}
        return look | {"system": "harmonics", "viewer": "a", "eye": [2.0, 1.5 + 0.1 * number, 4.0], **state}

    assert session.answer(changed(1)).content["kind"] == "color"
    began, release, replies = threading.Event(), threading.Event(), []
    compile_now = compiler.compile_or_get_cached

    def held(*argument, **named):
        if threading.current_thread() is still:
            began.set()
            release.wait(600)
        return compile_now(*argument, **named)

    monkeypatch.setattr(compiler, "compile_or_get_cached", held)
    # A picture of a size that no other test asks for.
    asked = changed(1) | {"kind": "still", "viewer": "b", "width": 23, "height": 19}
    still = threading.Thread(target=lambda: replies.append(session.answer(asked)))
    still.start()
    assert began.wait(600)
    for number in range(2, 22):
        assert session.answer(changed(number)).content["kind"] == "color"
    assert still.is_alive()
    assert not replies
    release.set()
    still.join()
    assert replies[0].content["kind"] == "still"


def test_after_the_preparation_the_first_changes_compile_no_program(empty, systems, lights, look):
    size = {"width": 64, "height": 48}
    empty.answer({"kind": "progress", **size})
    look |= {"system": "harmonics"}
    empty.prepare(lambda: empty.show({"harmonics": systems["harmonics"]}, environments=lights))
    empty.progress.wait()
    while not progress(empty)["finished"]:
        assert empty.answer(look).content["kind"] == "color"
    compiled = []

    def count(event: str, duration_secs: float, **more):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(duration_secs)

    scene = empty.answer({"kind": "scene"}).content
    asked = look | {"eye": scene["eye"], "target": scene["target"]}
    jax.monitoring.register_event_duration_secs_listener(count)
    try:
        for change in (
            {"turn": 0.3},
            {"eye": [2.0, 1.0, 3.0]},
            {"materials": {"ball": {"roughness": 0.7, "f0": 0.3}}},
            {"materials": {"ground": {"diffuse": [0.1, 0.2, 0.3]}}},
            {"kind": "still", **size},
        ):
            assert empty.answer(asked | change).content["kind"] in ("color", "still")
    finally:
        jax.monitoring.unregister_event_duration_listener(count)
    assert not compiled


def test_the_page_tells_what_is_done_and_keeps_its_state_when_a_better_scene_comes(browser, empty, systems, lights):
    server = Server(empty)
    page = browser.new_page(viewport={"width": 480, "height": 320})
    page.goto(server.url)
    root = "document.getElementById('viewer').shadowRoot"
    empty.report("tracing rays", 0.25)
    page.wait_for_function(f"() => {root}?.querySelector('.stagetext')?.textContent === 'tracing rays: 25 %'")
    empty.show({"harmonics": systems["harmonics"]}, environments=lights, preview=True)
    page.wait_for_function(f"() => {CANVAS}?.stats?.shown >= 0", timeout=120_000)
    assert not page.evaluate(f"() => {root}.querySelector('.panel').textContent.includes('picture at rest')")
    changed = {"ball": {"roughness": 0.7}}
    page.evaluate(f"(materials) => {{ Object.assign({CANVAS}.state, {{ materials, light: 1 }}); }}", changed)
    empty.show({"harmonics": systems["harmonics"]})
    page.wait_for_function(f"() => {root}.querySelector('.panel').textContent.includes('picture at rest')")
    state = page.evaluate(f"() => {CANVAS}.state")
    assert (state["materials"], state["light"]) == (changed, 1)
    empty.progress.finish()
    page.wait_for_function(f"() => {root}.querySelector('.stagetext').hidden", timeout=120_000)
    page.close()
    server.close()


def test_opened_files_are_prepared_in_place_of_the_scene(empty, systems, lights):
    """With what belongs to them, in a folder of their own; the scene before stays until theirs comes."""
    assert "`jaxprt view` opens files" in empty.answer({"kind": "open", "names": ["a.obj"]}, [b""]).content["message"]
    empty.show({"lobes": systems["harmonics"]}, environments=lights)
    begun, go, seen = threading.Event(), threading.Event(), []

    def opener(paths):
        seen.append({path.relative_to(path.parents[1]).as_posix(): path.read_bytes() for path in paths})
        begun.set()
        go.wait(60)
        empty.report("reading", 0.5)  # which ends the first one: another has been opened
        if b"broken" in seen[-1].values():
            raise ValueError(f"{paths[0]} must be whole, got a part")
        empty.show({"lobes": systems["harmonics"]})

    empty.opener = opener
    for names, words in (
        (["../a.obj"], "names of files must be relative and without .., got '../a.obj'"),
        (["/a.obj"], "got '/a.obj'"),
        ([3], "got '3'"),
        ([], "names must be those of the 1 files that came, at least one"),
    ):
        assert words in empty.answer({"kind": "open", "names": names}, [b"a"]).content["message"]
    first = {"model/a.obj": b"first", "model/a.mtl": b"paint"}
    assert empty.answer({"kind": "open", "names": list(first)}, list(first.values())).content == {"kind": "open"}
    assert begun.wait(60)
    begun.clear()
    empty.answer({"kind": "open", "names": ["model\\b.obj"]}, [b"second"])
    assert begun.wait(60)
    assert seen == [first, {"model/b.obj": b"second"}]
    assert empty.version == 1
    go.set()
    empty.progress.wait()
    assert empty.version == 2  # the second one alone
    empty.answer({"kind": "open", "names": ["model/c.obj"]}, [b"broken"])
    with pytest.raises(ValueError, match=r"^model/c.obj must be whole, got a part"):
        empty.progress.wait()
    assert empty.version == 2


def test_the_page_opens_a_scene_that_is_dropped_with_a_camera_of_its_own(browser, empty, systems, lights):
    empty.show(systems, environments=lights)
    empty.progress.finish()
    closer = dataclasses.replace(systems["lobes"].camera, eye=np.array([1.0, 0.75, 2.0], np.float32))
    other = eqx.tree_at(lambda relit: relit.camera, systems["harmonics"], closer)

    def opener(paths):
        assert [path.name for path in paths] == ["a.obj", "a.mtl"]
        empty.show_unshadowed(Unshadowed.of(other.scene, prt.relit.Harmonics(2)), name="lobes", environments=lights)
        empty.show({"lobes": other})

    empty.opener = opener
    server = Server(empty)
    hand = Hand(browser, server.url)
    hand.drag((100, 100), (140, 120))
    hand.drop({"a.obj": b"text", "a.mtl": b"text"})
    hand.page.wait_for_function(
        f"() => Math.abs(({CANVAS}).camera().distance - {np.hypot(np.hypot(1.0, 0.75), 2.0)}) < 1e-4"
    )
    hand.settle()
    assert hand.page.get_by_role("button", name="undo").is_disabled()
    assert not hand.errors
    hand.page.close()
    server.close()
