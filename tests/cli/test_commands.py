"""The commands `plan`, `measure`, `info` and `completion`, and what all of them are given."""

import importlib.metadata
import inspect
import json
import os
import signal
import subprocess
import sys
import time

import click
import numpy as np
import pytest

import jaxprt as prt
from jaxprt.cli import inputs, options, planned
from jaxprt.cli import report as cli_report
from jaxprt.cli.main import COMMANDS, program
from jaxprt.relit import registry


def test_a_plan_is_printed_and_kept_and_relights(main, place, tmp_path, monkeypatch, capsys):
    files = [place / "sun.exr", place / "mesh.obj", "--brdf", "lambert"]
    arguments = [*files, "--light-size", "8"]
    target = ["--error", "0.5", "--output", tmp_path / "kept"]
    assert main("plan", *arguments, *target) == 0
    table = capsys.readouterr().out
    assert "error asked 50 %, 30 frames per second\nmesh: 4 vertices" in table
    monkeypatch.setattr(planned, "plan", None)  # Nothing is planned again.
    assert main("plan", *arguments, *target, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["groups"][0]["parts"] == list(told["reflected"]) == ["mesh"]
    chosen = told["groups"][0]["chosen"]["recipe"]
    assert f"* {100 * told['error']:6.1f} %" in table
    assert chosen["system"] == "Harmonics"
    assert main("plan", *arguments, "--error", "0.4", "--output", tmp_path / "kept") == 2
    assert "kept/plan was made for another scene, lights, error or rate" in capsys.readouterr().err
    made = []

    def make(view, recipe, output, **options):
        made.append((view, recipe, options))
        raise RuntimeError("enough")

    monkeypatch.setattr(cli_report, "make", make)
    assert main("relight", *files, "--plan", tmp_path / "kept", "--output", tmp_path / "out") == 1
    ((view, recipe, options),) = made
    assert vars(recipe["mesh"]) == {name: value for name, value in chosen.items() if name != "system"}
    assert view.lights["sun"].radiance.shape[-2] == 8  # the plan's size
    assert options["bounces"] == told["bounces"]
    assert main("relight", *arguments, "--plan", place, "--output", tmp_path / "out") == 2
    assert "--plan must be a folder of `jaxprt plan`" in capsys.readouterr().err


def test_a_planned_scene_names_its_recipes(place, tmp_path):
    lights = inputs.lights([place / "sun.exr"], light_size=8)
    scene = inputs.scene([place / "mesh.obj"], brdf=prt.brdf.Lambert(), refine=False)
    view = cli_report.View(scene, lights, inputs.camera(scene.parts))
    _, cost = cli_report.make(view, None, tmp_path, error=0.5, environments=list(lights.values()), bounces=None)
    assert cost["mesh"]["recipe"] == "Harmonics"


def test_a_scene_is_measured_as_its_report_says(main, place, tmp_path, capsys):
    arguments = [place / "mesh.obj", place / "sun.exr", "--light-size", "8", "--brdf", "ggx:roughness=.6"]
    assert main("measure", *arguments, "--lobes", "1,2", "--output", tmp_path, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["systems"]) == ["lobe_1", "lobe_2"]  # from rays that are traced once
    lobes = told["systems"]["lobe_2"]
    assert told["lights"] == ["sun"]
    assert lobes["parts"][0]["vertices"] == 4
    assert 0 <= lobes["parts"][0]["vertex_error"]["sun"] < 0.3
    assert lobes["bytes"] >= lobes["parts"][0]["bytes"] > 0
    assert min(lobes["light_seconds"], lobes["view_seconds"]) > 0


def test_the_fit_of_a_brdf_is_measured_on_a_sphere(main, place, capsys):
    arguments = ["--fit", "cook-torrance:roughness=.4", place / "sun.exr", "--light-size", "8", "--system", "lobe"]
    assert main("measure", *arguments, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["material"]["model"] == "CookTorrance"
    error = {(row["lobes"], row["texels"]): row["error sun"] for row in told["rows"]}
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


def test_info_says_what_meshes_and_environments_hold(main, place, capsys):
    assert main("info", place / "mesh.obj", place / "sun.exr", "--light-size", "16", "--json") == 0
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
    assert main("info", place / "mesh.obj", place / "sun.exr") == 0
    rows = capsys.readouterr().out
    assert ": scene of 1 parts, 4 vertices, 4 triangles, 2 x 1.5 x 2 units, 0 cameras\n  0 'mesh': 4 vertices" in rows
    assert "\n  radiance from 0.5 to 90, mean over the sphere " in rows


def test_info_says_what_is_left_out_and_what_folders_hold(main, place, tmp_path, capsys):
    store, checksum = tmp_path / "seen.prt", tmp_path / "seen.prt" / "checksum.npy"
    prt.files.save(tmp_path / "light", prt.load_environment(place / "sun.exr", size=8))
    prt.visibility.precompute(prt.scene.builtin.sphere(rings=6, sectors=8), size=8, run=prt.Run(store))
    mesh = tmp_path / "mesh.obj"
    mesh.write_text("mtllib absent.mtl\nusemtl wood\n" + (place / "mesh.obj").read_text())
    assert main("info", tmp_path, mesh) == 0
    told = capsys.readouterr().out
    assert "light: object of Environment, " in told
    assert "blocks are finished" in told
    assert "left out: " in told
    assert "absent.mtl" in told

    def facts(*paths):
        assert main("info", *paths, "--json") == 0
        return json.loads(capsys.readouterr().out)

    saved, whole = facts(tmp_path / "light", store)
    assert saved["bytes"] == sum(path.stat().st_size for path in (tmp_path / "light").iterdir())
    assert whole["finished"] == whole["blocks"] > 0
    with checksum.open("r+b") as file:
        file.truncate(file.seek(0, 2) - 4)  # of a run that was stopped before its last block
    assert facts(store)[0]["finished"] == whole["blocks"] - 1
    np.save(checksum, np.zeros(whole["blocks"], np.uint32))
    assert facts(store)[0]["finished"] == 0
    (tmp_path / "empty").mkdir()
    assert main("info", tmp_path / "empty") == 2
    assert "must be a folder that jaxprt wrote" in capsys.readouterr().err


def test_info_says_how_brdf_files_are_used(main, data, capsys):
    names = ["lafortune_measured.json", "ngan2005_wardduer.fit", "ngan2005_he.fit", "merl_npf_512x256_rgb32f.bin"]
    paths = [data / "brdf" / name for name in (*names, "cayman.brdf")]
    assert main("info", *paths, "--json") == 2  # one of them cannot be used; the others are told
    written = capsys.readouterr()
    told = json.loads(written.out)
    assert "must be one of NganBlinnPhong, NganCookTorrance, NganLafortune, NganWardDuer, got NganHe" in written.err
    assert [row["form"] for row in told] == ["lafortune", "ngan", "npf", "scattered"]
    assert [len(row["materials"]) for row in told[:3]] == [6, 86, 100]
    assert told[0]["use"] == f"lafortune:{paths[0]},material=clay"
    assert told[1]["model"] == "WardDuer"
    assert told[3]["samples"] == 1439
    assert main("info", __file__) == 2
    assert "must be a mesh or an environment" in capsys.readouterr().err


def test_lights_are_turned_counterclockwise_as_seen_from_above(place):
    lights = inputs.lights([place / "sun.exr"], turn=(0.0, 90.0), light_size=16)
    assert list(lights) == ["sun_0", "sun_90"]
    still, turned = (np.asarray(light.radiance).sum(-1) for light in lights.values())
    solid, direction = prt.sphere.cubemap.solid_angle(size=16), prt.sphere.cubemap.direction(size=16)
    before, after = (np.einsum("fij,fij,fijk->k", light, solid, direction) for light in (still, turned))
    np.testing.assert_allclose(after, [before[2], before[1], -before[0]], atol=0.02 * np.linalg.norm(before))
    np.testing.assert_allclose(turned.mean(), still.mean(), rtol=1e-2)


def test_environments_are_told_by_their_content_where_the_suffix_says_nothing(place, tmp_path):
    (tmp_path / "sky").write_bytes((place / "sun.exr").read_bytes())
    assert inputs.split_files([tmp_path / "sky", place / "mesh.obj"]) == ([place / "mesh.obj"], [tmp_path / "sky"])


def test_without_files_there_are_the_chess_pieces_whose_materials_are_named_or_numbered(chosen):
    parsed = chosen("--material", "2=ward", "--material", "pieces=metallic-roughness:roughness=.3")
    parts = options.call(inputs.scene, parsed, playable=True).parts
    assert [part.name for part in parts] == ["pieces", "light squares", "dark squares"]
    assert [type(part.material).__name__ for part in parts] == ["TexturedMaterial", "TexturedMaterial", "Ward"]
    assert parts[0].material.roughness == np.float32(0.3)
    assert list(options.call(inputs.lights, parsed, light_size=8)) == ["daylight", "studio"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_for_completion_is_printed(shell, main, capsys):
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
def test_shells_complete_commands_options_systems_and_materials(words, expected, main, monkeypatch, capsys):
    monkeypatch.setenv("_JAXPRT_COMPLETE", "zsh_complete")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    main()
    assert capsys.readouterr().out.split("\n")[1::3] == expected


def test_every_command_and_option_says_what_it_does():
    for name in COMMANDS:
        command = program.get_command(click.Context(program), name)
        assert name == "completion" or f"\n  jaxprt {name} " in inspect.cleandoc(command.help)
        for option in command.params:
            assert not isinstance(option, click.Option) or option.help, (name, option.name)


def test_options_have_the_defaults_and_words_of_what_commands_call(main, capsys):
    assert main("relight", "--help") == 0
    help = " ".join(capsys.readouterr().out.split())
    assert "--system [planned|lobe|harmonic|separable|clusters|dynamic],.." in help
    assert "and term [default: separable 96]; Number of wavelet coefficients of each cluster [default: clusters" in help
    assert "Largest relative L2 error of the radiance of each part. [default: 0.05, or the smallest error" in help
    assert "--size N Width and height of the pictures in pixels. [from 1 to 8192] [default: 512]" in help
    assert main("view", "--help") == 0
    assert "[default: lobe 8, dynamic 12]" in " ".join(capsys.readouterr().out.split())


def test_the_help_names_all_materials_and_files_without_importing_jax():
    script = "import sys; from jaxprt.cli.main import program\ntry: program(['--help'])\n"
    script += "finally: assert 'jax' not in sys.modules"
    help = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert "view        Show a scene in the interactive viewer in a browser.\n" in help
    words = " ".join(help.split())
    assert f"models {', '.join(registry.MATERIALS)} numbers" in words
    assert words.endswith(", ".join(map(inputs.form, inputs.FILES)))


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_ctrl_c_ends_a_process_with_130_and_without_a_traceback():
    script = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "  # background jobs ignore it
    script += "import jaxprt.cli.relight as r, time; print('up', flush=True); r._systems = lambda *_: time.sleep(60); "
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


def test_meshes_are_divided_to_the_error_that_is_asked_for(place):
    counts = [inputs.scene([place / "mesh.obj"], refine=refine).counts[0] for refine in (False, 0.2, 0.1)]
    assert counts[0] == 4 < counts[1] < counts[2]


@pytest.mark.parametrize(
    ("kind", "text", "value"),
    [
        (options.REFINE, "off", False),
        (options.REFINE, "0.02", 0.02),
        (options.REFINE, "0", 0.0),
        (options.BOUNCES, "all", "all"),
        (options.BOUNCES, "2", 2),
    ],
)
def test_numbers_have_words_for_some_values(kind, text, value):
    assert kind.convert(text, None, None) == value


@pytest.mark.parametrize("text", ["fine", "-1", "nan", "inf", ""])
def test_other_errors_of_divided_meshes_are_refused(text):
    with pytest.raises(click.UsageError, match='must be a finite number of at least 0, or "off", got '):
        options.REFINE.convert(text, None, None)
