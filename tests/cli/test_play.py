"""The commands `jaxprt view` and `jaxprt export`: files become a scene and lights, and a page is served or written."""

import http.client
import json
import socket
import threading
import urllib.parse

import equinox as eqx
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.cli import inputs, options, play
from jaxprt.view import Session, messages
from jaxprt.view.progress import Progress


def test_files_are_told_by_their_names_and_parts_without_a_material_are_plastic(chosen, place):
    parsed = chosen(*(place / name for name in ("mesh.obj", "sky.exr", "two.obj")), "--ground")
    scene = options.call(inputs.scene, parsed, playable=True)
    assert len({part.name for part in scene.parts}) == 3
    assert [float(part.material.specular) for part in scene.parts] == [1, 1, 0]
    assert list(options.call(inputs.lights, parsed, light_size=8)) == ["sky"]


def test_the_first_camera_frames_the_object_and_not_the_ground_below(place):
    alone, grounded = (inputs.scene([place / "mesh.obj"], ground=ground, refine=False) for ground in (False, True))
    expected = prt.scene.camera.orbit(alone.mesh, azimuth=0.5, elevation=0.3)
    assert eqx.tree_equal(grounded.cameras, (expected,))
    assert not alone.cameras
    low, high = (np.ptp(np.asarray(scene.mesh.position), axis=0).max() for scene in (alone, grounded))
    assert high > 2 * low


def test_previews_divided_meshes_and_systems_are_one_way(chosen, place, monkeypatch):
    session, shares = Session(), []
    report = session.report

    def heard(stage, share):
        report(stage, share)
        shares.append(session.progress.content()["fraction"])

    monkeypatch.setattr(session, "report", heard)
    play.prepare(session, chosen(place / "mesh.obj", "--lobes", "1,2", "--light-size", "8"))
    told = [share for share in shares if share is not None]
    assert len(told) > 2, told
    assert told == sorted(told)
    assert 0.2 < told[-1] < 1, told


def test_a_page_a_baked_scene_and_probes_are_written(main, place, tmp_path, capsys):
    out = [tmp_path / name for name in ("piece.html", "baked.glb", "probes.json")]
    arguments = [place / "mesh.obj", place / "gray.exr", "--light-size", "8", "--lobes", "1", "--error", "0.15"]
    written = [word for path in out for word in ("--output", path)]
    assert main("export", *arguments, *written, "--json", "--tool", "three.js,unity") == 0
    told = json.loads(capsys.readouterr().out)
    assert [row["kind"] for row in told] == ["page", "baked", "probes"]
    assert [row["bytes"] for row in told] == [path.stat().st_size for path in out]
    assert 0 <= told[0]["error"] < 0.15  # visibility of 8 texels along an edge
    assert (told[1]["light"], told[1]["exposure"] > 0) == ("gray", True)
    probes = json.loads(out[2].read_text())
    assert list(probes) == ["three.js", "Unity"]
    constant = np.zeros((9, 3))
    constant[0] = 0.5 * np.sqrt(4 * np.pi)  # the light is 0.5 everywhere
    np.testing.assert_allclose(probes["three.js"]["gray"], constant, atol=1e-5)


def test_a_scene_with_transfer_is_written(main, place, tmp_path, capsys):
    out = tmp_path / "prt.glb"
    arguments = [place / "mesh.obj", place / "gray.exr", "--light-size", "8", "--lobes", "1"]
    assert main("export", *arguments, "--format", "gltf", "--degree", "2", "--output", out) == 0
    assert "with transfer of degree 2 in vertex attributes, and lights gray" in capsys.readouterr().out
    data = out.read_bytes()
    head = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert head["asset"]["extras"]["prt"]["degree"] == 2
    assert {"_PRT_0", "_PRT_1", "_PRT_2"} < set(head["meshes"][0]["primitives"][0]["attributes"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--output", "piece.txt"], "--output must end in .html, .glb, .json, got piece.txt"),
        (["--output", "absent/piece.html"], "got absent/piece.html: there is no absent"),
        (["--output", "piece.html", "--lobes", "1,2"], "one number of lobes"),
        (["--output", "piece.html", "--system", "lobe,harmonic"], "one system"),
        ([], "Missing option '--output'"),
    ],
)
def test_exports_that_cannot_be_written_are_refused_before_anything_is_computed(
    arguments, words, main, monkeypatch, capsys
):
    monkeypatch.setattr(inputs, "lights", None)
    assert main("export", *arguments) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "reason"), [("file/probes.json", "Not a directory"), ("x" * 300 + ".json", "File name")]
)
def test_an_export_to_a_place_that_cannot_be_written_names_it_and_the_reason(
    name, reason, main, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(inputs, "lights", None)
    (tmp_path / "file").write_text("precious")
    fine, path = tmp_path / "fine.json", tmp_path / name
    assert main("export", "--output", fine, "--output", path) == 1
    assert f"Error: --output must be a file that can be written, got {path}: {reason}" in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "precious"
    assert not fine.exists()


def test_folders_that_cannot_be_made_are_refused_before_anything_is_computed(main, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(inputs, "lights", None)
    monkeypatch.setattr(inputs, "scene", None)
    (tmp_path / "file").write_text("precious")
    within = tmp_path / "file" / "within"
    assert main("export", "--output", tmp_path / "piece.html", "--store", within) == 2
    assert f"--store must be a folder that can be made, got {within}: Not a directory" in capsys.readouterr().err
    assert main("view", "--output", within) == 2
    assert f"--output must be a folder that can be made, got {within}: Not a directory" in capsys.readouterr().err


def test_the_page_of_files_is_served(main, place, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(inputs.builtin, "daylight", None)
    opened = []
    monkeypatch.setattr(play.webbrowser, "open", opened.append)
    answers = []

    def look(self):
        url = urllib.parse.urlsplit(self.url)
        connection = http.client.HTTPConnection(url.hostname, url.port)
        connection.request("POST", url.path + "ask", messages.pack({"kind": "scene"}, []))
        answers.append(messages.unpack(connection.getresponse().read())[0])
        connection.close()
        raise KeyboardInterrupt

    monkeypatch.setattr(prt.view.Server, "wait", look)
    arguments = [place / "mesh.obj", place / "sky.exr", "--lobes", "1,2", "--light-size", "8"]
    assert main("view", *arguments, "--output", tmp_path) == 0
    assert answers[0]["lights"] == ["sky"]
    assert list(answers[0]["systems"]) == ["1 lobes", "2 lobes"]
    assert answers[0]["vertices"] == 4
    assert "http://127.0.0.1:" in capsys.readouterr().out


def test_what_a_file_lacks_is_told_after_the_page_is_there(main, place, capsys):
    assert main("view", place / "broken.glb", "--no-browser") == 2
    said = capsys.readouterr()
    assert "http://127.0.0.1:" in said.out
    assert "broken.glb" in said.err
    assert "Traceback" not in said.err


def test_ctrl_c_during_the_preparation_ends_it_and_the_command(main, monkeypatch, capsys):
    began, interrupted, ended = threading.Event(), threading.Event(), threading.Event()

    def prepare(session, chosen):
        session.report("tracing rays", 0.1)
        began.set()
        interrupted.wait(60)
        try:
            session.report("tracing rays", 0.2)
        finally:
            ended.set()

    def interrupt(self, *, patience):
        assert began.wait(60)
        raise KeyboardInterrupt

    monkeypatch.setattr(play, "prepare", prepare)
    monkeypatch.setattr(Progress, "wait", interrupt)
    assert main("view", "--no-browser") == 130
    assert "jaxprt: stopped; the same command goes on from here" in capsys.readouterr().err
    interrupted.set()
    assert ended.wait(60)


def test_a_port_that_is_taken_is_refused_before_anything_is_computed(main, monkeypatch, capsys):
    monkeypatch.setattr(play, "prepare", None)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main("view", "--port", port) == 2
    assert f"--port must be free, got {port}: another program uses it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        (["--port", "70000"], "'--port': must be a whole number from 0 to 65535, got 70000"),
        (["--ground"], "--ground needs a mesh"),
        (["--light-size", "12"], "--light-size must be a power of two, got 12"),
        (["nothing.obj"], "nothing.obj"),
        (["nothing.exr"], "nothing.exr"),
    ],
)
def test_what_cannot_be_shown_is_an_error(argument, words, main, capsys):
    assert main("view", *argument) == 2
    assert words in capsys.readouterr().err


def test_a_page_far_from_the_scene_is_refused_with_the_cause_and_written_where_its_error_is_accepted(
    main, data, tmp_path, capsys
):
    arguments = [data / "foreign/craft_speederD.gltf", data / "env/polyhaven_spiaggia_di_mondello_1k.hdr"]
    page, sizes = tmp_path / "ship.html", ["--light-size", "8", "--lobes", "1", "--refine", "off"]
    assert main("export", *arguments, *sizes, "--output", page) == 2
    told = capsys.readouterr().err
    assert "error must be at least 0." in told
    assert "for this page, got 0.05: its pictures are" in told
    assert "in the light 'polyhaven_spiaggia_di_mondello_1k'" in told
    assert "% by edges of shadows that lie between vertices: divide the meshes finer (refine)" in told
    assert not page.exists()
    assert main("export", *arguments, *sizes, "--output", page, "--error", "1") == 0
    assert page.exists()
    assert "edges of shadows that lie between vertices" in capsys.readouterr().out
