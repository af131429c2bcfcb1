"""The command `python -m jaxprt view`: files become a scene and lights, and a page is served."""

import argparse
import http.client
import urllib.parse

import numpy as np
import pytest

import jaxprt as prt
from jaxprt import files
from jaxprt.__main__ import main
from jaxprt.cli import play
from jaxprt.view import messages

OBJ = "v 0 1 0\nv -1 -0.5 1\nv 1 -0.5 1\nv 0 -0.5 -1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.fixture(autouse=True)
def small(coarse, bound, monkeypatch):
    """Coarse tables and lights."""
    bound(monkeypatch, prt.load_environment, size=8)
    for name in ("tabulate",):
        bound(monkeypatch, getattr(prt.lobe, name), resolution=8)
    monkeypatch.setattr(play, "_ROUGHNESS", (0.5, 0.6))


@pytest.fixture
def place(tmp_path):
    (tmp_path / "first.obj").write_text(OBJ)
    (tmp_path / "second.obj").write_text(OBJ)
    files.write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 0.5, np.float32))
    return tmp_path


def options(*argument: str) -> argparse.Namespace:
    return play._parser().parse_args(list(argument))


def test_files_are_told_by_their_names_and_parts_without_a_material_are_plastic(place):
    given = options(*(str(place / name) for name in ("first.obj", "sky.exr", "second.obj")), "--ground")
    scene = play._scene(given)
    assert len({part.name for part in scene.parts}) == 3
    assert [float(part.material.specular) for part in scene.parts] == [1, 1, 0]
    assert list(play._lights(given.files)) == ["sky"]


def test_without_files_there_are_the_chess_pieces_in_two_lights():
    scene = play._scene(options())
    assert [part.name for part in scene.parts] == ["pieces", "light squares", "dark squares"]
    assert list(play._lights([])) == ["daylight", "studio"]


def test_a_page_without_python_is_written(place, monkeypatch, capsys):
    monkeypatch.setattr(prt, "precompute", lambda scene, **more: precompute(scene, **more | {"size": 8}))
    page = place / "piece.html"
    assert main(["view", str(place / "first.obj"), str(place / "sky.exr"), "--lobes", "1", "--export", str(page)]) == 0
    assert f"{page}, {page.stat().st_size:,} bytes" in capsys.readouterr().out
    several = ["view", str(place / "first.obj"), "--lobes", "1,2", "--export", str(page)]
    assert main(several) == 2
    assert "one number of lobes" in capsys.readouterr().err
    assert main(["view", str(place / "first.obj"), "--export", "piece.txt"]) == 2
    assert "--export takes a file *.html, got piece.txt" in capsys.readouterr().err


def test_the_page_of_files_is_served(place, monkeypatch, capsys):
    monkeypatch.setattr(prt.scene.builtin, "daylight", None)
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
    store = str(place / "store")
    monkeypatch.setattr(prt, "precompute", lambda scene, **more: precompute(scene, **more | {"size": 8}))
    assert main(["view", str(place / "first.obj"), str(place / "sky.exr"), "--output", store, "--lobes", "1,2"]) == 0
    assert answers[0]["lights"] == ["sky"]
    assert list(answers[0]["systems"]) == ["1 lobes", "2 lobes"]
    assert answers[0]["vertices"] == 4
    assert "http://127.0.0.1:" in capsys.readouterr().out


precompute = prt.precompute


@pytest.mark.parametrize(
    ("argument", "words"),
    [
        (["--lobes", "0"], "--lobes must be from 1 to 64, got 0"),
        (["--port", "70000"], "--port must be from 0 to 65535, got 70000"),
        (["--ground"], "--ground needs a mesh"),
        (["nothing.obj"], "nothing.obj"),
        (["nothing.exr"], "nothing.exr"),
    ],
)
def test_what_cannot_be_shown_is_an_error(argument, words, capsys):
    assert main(["view", *argument]) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("set_by_hand", [False, True])
def test_programs_are_kept_unless_the_environment_says_where(set_by_hand, monkeypatch, tmp_path):
    for name in ("JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if set_by_hand:
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    said = {}
    monkeypatch.setattr(play.jax.config, "update", said.__setitem__)
    play.keep_programs()
    expected = {} if set_by_hand else {"jax_compilation_cache_dir": str(tmp_path / "jaxprt" / "programs")}
    assert said.get("jax_compilation_cache_dir") == expected.get("jax_compilation_cache_dir")
