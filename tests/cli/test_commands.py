"""The commands `plan`, `measure`, `info` and `completion`, and what all of them are given."""

import importlib.metadata
import inspect
import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import click
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.cli import inputs, measure, options, planned, play, relight
from jaxprt.cli import report as cli_report
from jaxprt.cli.main import program
from jaxprt.relit import measuring

OBJ = "v 0 1 0\nv -1 -0.5 1\nv 1 -0.5 1\nv 0 -0.5 -1\nf 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n"


@pytest.fixture(autouse=True)
def small(coarse, bound, monkeypatch):
    """Coarse tables, and few pixels that are judged."""
    bound(monkeypatch, prt.lobe.tabulate, resolution=8)
    monkeypatch.setattr(measuring, "_PICTURE", 32)
    monkeypatch.setattr(measuring, "_PIXELS", 20)
    monkeypatch.setattr(measure, "_RINGS", 6)
    monkeypatch.setattr(measure, "_SECTORS", 8)
    monkeypatch.setattr(cli_report, "TABLE_LOBES", (1, 4))
    monkeypatch.setattr(cli_report, "TABLE_TEXELS", (0, 16))


@pytest.fixture
def place(tmp_path):
    (tmp_path / "mesh.obj").write_text(OBJ)
    sky = np.full((8, 16, 3), 0.5, np.float32)
    sky[3, 4] = 90
    prt.files.write_exr(tmp_path / "sky.exr", sky)
    return tmp_path


def main(*arguments):
    """Exit status of the command line."""
    with pytest.raises(SystemExit) as end:
        program(list(map(str, arguments)), prog_name="jaxprt")
    return end.value.code or 0


def test_a_plan_is_printed_and_kept_and_relights(place, monkeypatch, capsys):
    given = [place / "sky.exr", place / "mesh.obj", "--brdf", "lambert", "--light-size", "8"]
    kept = ["--error", "0.5", "--output", place / "kept"]
    assert main("plan", *given, *kept) == 0
    table = capsys.readouterr().out
    assert "error asked 50 %, 30 frames per second\nmesh: 4 vertices" in table
    monkeypatch.setattr(planned, "plan", None)  # Nothing is planned again.
    assert main("plan", *given, *kept, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["groups"][0]["parts"] == list(told["reflected"]) == ["mesh"]
    chosen = told["groups"][0]["chosen"]["recipe"]
    assert f"* {100 * told['error']:6.1f} %" in table
    assert chosen["system"] == "Harmonics"
    assert main("plan", *given, "--error", "0.4", "--output", place / "kept") == 2
    assert "kept/plan was made for another scene, lights, error or rate" in capsys.readouterr().err
    made = []

    def make(view, recipe, *arguments, **options):
        made.append((view, recipe, options))
        raise RuntimeError("enough")

    monkeypatch.setattr(cli_report, "make", make)
    assert main("relight", *given[:-2], "--plan", place / "kept", "--output", place / "out") == 1
    ((view, recipe, options),) = made
    assert vars(recipe["mesh"]) == {name: value for name, value in chosen.items() if name != "system"}
    assert view.lights["sky"].radiance.shape[-2] == 8  # the plan's size
    assert options["bounces"] == told["bounces"]
    assert main("relight", *given, "--plan", place, "--output", place / "out") == 2
    assert "--plan must be a folder of `jaxprt plan`" in capsys.readouterr().err


def test_a_scene_is_measured_as_its_report_says(place, capsys):
    given = [place / "mesh.obj", place / "sky.exr", "--light-size", "8", "--brdf", "ggx:roughness=.6"]
    assert main("measure", *given, "--lobes", "1,2", "--output", place / "kept", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["systems"]) == ["lobe_1", "lobe_2"]  # from rays that are traced once
    found = told["systems"]["lobe_2"]
    assert told["lights"] == ["sky"]
    assert found["parts"][0]["vertices"] == 4
    assert 0 <= found["parts"][0]["vertex_error"]["sky"] < 0.3
    assert found["bytes"] >= found["parts"][0]["bytes"] > 0
    assert min(found["light_seconds"], found["view_seconds"]) > 0


def test_the_fit_of_a_brdf_is_measured_on_a_sphere(place, capsys):
    given = ["--fit", "cook-torrance:roughness=.4", place / "sky.exr", "--light-size", "8", "--system", "lobe"]
    assert main("measure", *given, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["material"]["model"] == "CookTorrance"
    error = {(row["lobes"], row["texels"]): row["error sky"] for row in told["rows"]}
    assert error[4, 16] < error[1, 0] < 1
    assert main("measure", "--fit", "lambert", place / "mesh.obj") == 2
    assert "takes environments only, got a mesh: use --brdf" in capsys.readouterr().err
    assert main("measure", "--fit", "lambert", "--system", "clusters") == 2
    assert "--fit needs --system separable, harmonic, lobe, got clusters" in capsys.readouterr().err


def test_info_without_files_says_that_the_compiler_of_users_computes_right_sums():
    users = {**os.environ, "XLA_FLAGS": ""}  # with the optimization that tests leave out
    result = subprocess.run(
        [sys.executable, "-m", "jaxprt", "info", "--json"], env=users, capture_output=True, text=True, check=True
    )
    told = json.loads(result.stdout)
    assert told["wrong_sums"] == 0
    assert told["jaxlib"] == importlib.metadata.version("jaxlib")


def test_info_says_what_meshes_and_environments_hold(place, capsys):
    assert main("info", place / "mesh.obj", place / "sky.exr", "--light-size", "16", "--json") == 0
    mesh, sky = json.loads(capsys.readouterr().out)
    assert (mesh["kind"], mesh["vertices"], mesh["triangles"], mesh["cameras"]) == ("scene", 4, 4, [])
    assert mesh["bounds"] == [[-1, -0.5, -1], [1, 1, 1]]
    assert mesh["parts"][0]["material"]["base_color"] == [0.5, 0.5, 0.5]
    assert sky["pixels"] == [16, 8]
    assert sky["radiance"] == {"least": 0.5, "most": 90}
    latitude = np.pi / 2 - np.pi / 8 * np.array([3, 4])
    pixel = np.pi / 8 * (np.sin(latitude[0]) - np.sin(latitude[1]))
    np.testing.assert_allclose(sky["mean_radiance"], 0.5 + 89.5 * pixel / (4 * np.pi), rtol=1e-4)
    share = sky["brightest_share"]
    assert 0 < share["1"] < share["10"] < share["100"] < 1
    assert share["100"] > 90 * pixel / (4 * np.pi) / sky["mean_radiance"][0] * 0.99


def test_info_says_what_is_left_out_and_what_folders_hold(place, capsys):
    prt.files.save(place / "kept" / "light", prt.load_environment(place / "sky.exr", size=8))
    ball = prt.scene.builtin.sphere(rings=6, sectors=8)
    prt.visibility.precompute(ball, size=8, run=prt.Run(place / "kept" / "seen.prt"))
    (place / "mesh.obj").write_text("mtllib absent.mtl\nusemtl wood\n" + OBJ)
    assert main("info", place / "kept", place / "mesh.obj") == 0
    told = capsys.readouterr().out
    assert "light: object of Environment, " in told
    assert "blocks are finished" in told
    assert "left out: " in told
    assert "absent.mtl" in told
    assert main("info", place / "kept" / "light", place / "kept" / "seen.prt", "--json") == 0
    saved, store = json.loads(capsys.readouterr().out)
    assert saved["bytes"] == sum(each.stat().st_size for each in (place / "kept" / "light").iterdir())
    assert store["finished"] == store["blocks"] > 0
    with (place / "kept" / "seen.prt" / "checksum.npy").open("r+b") as file:
        file.truncate(file.seek(0, 2) - 4)  # of a run that was stopped before its last block
    assert main("info", place / "kept" / "seen.prt", "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["finished"] == store["blocks"] - 1
    np.save(place / "kept" / "seen.prt" / "checksum.npy", np.zeros(store["blocks"], np.uint32))
    assert main("info", place / "kept" / "seen.prt", "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["finished"] == 0
    assert main("info", place) == 0
    (place / "empty").mkdir()
    assert main("info", place / "empty") == 2
    assert "must be a folder that jaxprt wrote" in capsys.readouterr().err


def test_info_says_how_brdf_files_are_used(data, capsys):
    names = ["lafortune_measured.json", "ngan2005_wardduer.fit", "ngan2005_he.fit", "merl_npf_512x256_rgb32f.bin"]
    paths = [data / "brdf" / name for name in (*names, "cayman.brdf")]
    assert main("info", *paths, "--json") == 2  # one of them cannot be used; the others are told
    written = capsys.readouterr()
    told = json.loads(written.out)
    assert "must be one of NganBlinnPhong, NganCookTorrance, NganLafortune, NganWardDuer, got NganHe" in written.err
    assert [each["form"] for each in told] == ["lafortune", "ngan", "npf", "scattered"]
    assert [len(each["materials"]) for each in told[:3]] == [6, 86, 100]
    assert told[0]["use"] == f"lafortune:{paths[0]},material=clay"
    assert told[3]["samples"] == 1439
    assert main("info", __file__) == 2
    assert "must be a mesh or an environment" in capsys.readouterr().err


def test_lights_are_turned_counterclockwise_as_seen_from_above(place):
    options = play.parse_options([str(place / "sky.exr"), "--turn", "0,90", "--light-size", "16"])
    lights = inputs.lights(options)
    assert list(lights) == ["sky_0", "sky_90"]
    still, turned = (np.asarray(each.radiance).sum(-1) for each in lights.values())
    solid, direction = prt.sphere.cubemap.solid_angle(size=16), prt.sphere.cubemap.direction(size=16)
    before, after = (np.einsum("fij,fij,fijk->k", each, solid, direction) for each in (still, turned))
    np.testing.assert_allclose(after, [before[2], before[1], -before[0]], atol=0.02 * np.linalg.norm(before))
    np.testing.assert_allclose(turned.mean(), still.mean(), rtol=1e-2)


def test_environments_are_told_by_their_content_where_the_suffix_says_nothing(place):
    (place / "sky").write_bytes((place / "sky.exr").read_bytes())
    assert inputs.split_files([place / "sky", place / "mesh.obj"]) == ([place / "mesh.obj"], [place / "sky"])


def test_parts_take_materials_by_name_and_by_number():
    given = play.parse_options(["--material", "2=ward", "--material", "pieces=metallic-roughness:roughness=.3"])
    kinds = [type(part.material).__name__ for part in inputs.scene(given, playable=True).parts]
    assert kinds == ["TexturedMaterial", "TexturedMaterial", "Ward"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_completion_is_printed(shell, capsys):
    assert main("completion", shell) == 0
    assert "_JAXPRT_COMPLETE" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("jaxprt rel", ["relight"]),
        ("jaxprt relight --system lobe,har", ["lobe,harmonic"]),
        ("jaxprt relight --brdf coo", ["cook-torrance:"]),
        ("jaxprt relight --brdf ward:al", ["ward:along="]),
        ("jaxprt view --light", ["--light-size"]),
    ],
)
def test_shells_complete_commands_options_systems_and_materials(words, expected, monkeypatch, capsys):
    monkeypatch.setenv("_JAXPRT_COMPLETE", "zsh_complete")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    main()
    found = capsys.readouterr().out.split("\n")[1::3]
    assert found == expected


def test_every_command_and_option_says_what_it_does():
    for name, command in program.commands.items():
        assert name == "completion" or f"\n  jaxprt {name} " in inspect.cleandoc(command.help)
        for each in command.params:
            assert not isinstance(each, click.Option) or each.help, (name, each.name)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_ends_a_process_with_130_and_without_a_traceback(place):
    script = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "  # background jobs ignore it
    script += "import jaxprt.cli.relight as r, time; print('up', flush=True); r._run = lambda *_: time.sleep(60); "
    script += "from jaxprt.cli.main import run; run()"
    process = subprocess.Popen(
        [sys.executable, "-c", script, "relight"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "up\n"
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == "jaxprt: stopped; the same command goes on from here\n"


def test_relight_knows_all_systems():
    assert set(relight.SYSTEMS) == {"planned", "lobe", "harmonic", "separable", "clusters", "dynamic"}


def test_meshes_are_divided_to_the_error_that_is_asked_for(place):
    chosen = {"files": [place / "mesh.obj"], "outside": False, "up": "y", "ground": False, "brdf": None, "material": ()}
    counts = [len(inputs.scene(SimpleNamespace(**chosen, refine=refine)).mesh.position) for refine in (False, 0.2, 0.1)]
    assert counts[0] == 4 < counts[1] < counts[2]


@pytest.mark.parametrize(("text", "value"), [("off", False), ("0.02", 0.02), ("0", 0.0)])
def test_errors_of_divided_meshes_are_numbers_or_off(text, value):
    assert options.Refinement().convert(text, None, None) == value


@pytest.mark.parametrize("text", ["fine", "-1", "nan", "inf", ""])
def test_other_errors_of_divided_meshes_are_refused(text):
    with pytest.raises(click.UsageError, match="must be an error of at least 0"):
        options.Refinement().convert(text, None, None)
