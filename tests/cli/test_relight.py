"""The command `jaxprt relight`, on a mesh and a sky of a few triangles and pixels."""

import json
import math
import os
import re
import shutil
import subprocess
import sys

import numpy as np
import OpenImageIO
import pytest

import jaxprt as prt
from jaxprt.cli import report as cli_report

SYSTEMS = ("separable", "harmonic", "lobe")
PLAIN = ("--ground", "--azimuth", "-30", "--system", "separable")


@pytest.fixture(scope="module")
def run(main, place):
    """The function from arguments to the exit status of the command, on small pictures."""

    def relight(*more, output, mesh="mesh.obj", sky=("sky.exr",)):
        files = [*(place / name for name in sky), place / mesh]
        options = ["--size", "32", "--light-size", "8", "--brdf", "lambert", "--output", output]
        system = [] if "--system" in more else ["--system", "separable"]
        keep = ["--keep", "8"] if "separable" in ",".join(map(str, [*system, *more])) else []
        return main("relight", *options, *keep, *system, *more, *files)

    return relight


def numbers(tree):
    """All numbers in a JSON value."""
    if isinstance(tree, dict):
        tree = list(tree.values())
    if isinstance(tree, list):
        return [number for each in tree for number in numbers(each)]
    return [tree] if isinstance(tree, int | float) else []


def report(output):
    """The report, which must be JSON as other programs read it: without NaN and infinity."""

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    found = json.loads((output / "report.json").read_text(), parse_constant=refuse)
    assert all(map(math.isfinite, numbers(found)))
    return found


@pytest.fixture(scope="module")
def plain(run, tmp_path_factory):
    """What a run of one system leaves, of a matte mesh on a coarse ground."""
    folder = tmp_path_factory.mktemp("relight") / "deep" / "plain"
    assert run(*PLAIN, output=folder) == 0
    return folder


def test_the_report_says_what_was_relit_and_how_well(place, plain):
    told = report(plain)
    assert told["meshes"] == [str(place / "mesh.obj")]
    assert told["up"] == "y"
    assert told["ground"] is True
    assert told["environments"] == {"sky": str(place / "sky.exr")}
    assert told["vertices"] == {"mesh": 4, "ground": 49}
    assert told["brdf"] == {name: {"model": "Lambert", "albedo": [0.5]} for name in ("mesh", "ground")}
    camera = told["camera"]
    assert (camera["width"], camera["height"]) == (32, 32)
    offset = np.subtract(camera["eye"], camera["target"])
    np.testing.assert_allclose(np.degrees(np.arctan2(offset[0], offset[2])), -30, atol=1e-3)
    light = told["lights"]["sky"]
    assert 0 < light["separable"]["picture_error"] < 0.5
    assert 0 < light["separable"]["picture_error_spread"] < 0.3 * light["separable"]["picture_error"]
    assert set(light["separable"]["vertex_error"]) == {"mesh", "ground"}
    assert 0 < light["exact_pixels_error"] < 0.2
    assert 0 < light["exact_picture_error"] < 0.3
    assert 100 < told["exact"]["pixels"] < 300
    assert told["exact"]["picture_width"] == 32
    assert told["exact"]["vertices"] == {"mesh": 4, "ground": 39}
    assert told["precompute"]["separable"]["mesh"]["keep"] == 8
    assert min(numbers(told["times"])) > 0
    assert told["peak_bytes"] > 1e7


def test_a_picture_stands_before_the_reference_and_differs_from_it_by_the_difference(plain):
    row, _ = prt.files.read_image(plain / "sky.png")
    parts = [prt.files.read_image(plain / f"sky_{kind}.png")[0] for kind in ("separable", "reference")]
    np.testing.assert_array_equal(row, np.concatenate(parts, 1))
    kinds = ("separable", "reference", "separable_difference")
    image, reference, difference = (prt.files.read_image(plain / f"sky_{kind}.exr")[0] for kind in kinds)
    np.testing.assert_allclose(np.abs(image - reference), difference, atol=2e-3 * reference.max())


def test_a_second_run_takes_the_transport_from_the_first(run, plain, tmp_path, capsys):
    again = shutil.copytree(plain, tmp_path / "again")
    stored = {path: path.stat().st_mtime_ns for path in again.glob("*/*.prt/**/*") if path.is_file()}
    assert run(*PLAIN, output=again) == 0
    told = capsys.readouterr()
    assert "pictures and report.json are in" in told.out
    assert "error" not in told.err.lower()
    assert stored == {path: path.stat().st_mtime_ns for path in stored}
    first, second = (report(folder)["lights"]["sky"]["separable"]["vertex_error"] for folder in (plain, again))
    assert second == pytest.approx(first, rel=1e-3)
    assert run(*PLAIN, "--keep", "9", output=again) == 2
    words = r"separable.prt holds arrays that were computed from .*keep: stored 8, now 9.* name another --output"
    assert_told(capsys, words)


def test_a_state_of_the_viewer_is_what_is_drawn(run, tmp_path, capsys):
    file, state = tmp_path / "kept.json", {"jaxprt": "state", "light": "sky", "turn": 0.5, "tone": "neutral"}
    state |= {"eye": [1.0, 2.0, 3.0], "target": [0.0, 0.5, 0.0], "field_of_view": 0.5, "aspect": 1.0, "stops": -1.5}
    file.write_text(json.dumps(state))
    assert run(*PLAIN, "--state", file, output=tmp_path / "out") == 0
    told = report(tmp_path / "out")
    camera = told["camera"]
    assert (camera["width"], camera["height"]) == (32, 32)
    for name in ("eye", "target", "field_of_view"):
        np.testing.assert_allclose(camera[name], state[name], rtol=1e-6)
    assert told["lights"]["sky"]["exposure_stops"] == -1.5
    for wrong, words in (
        ({"light": "moon"}, "the state is of the light 'moon', got 'sky'"),
        ({"materials": {"mesh": {"roughness": 0.5}}}, "the material of part 'mesh' is a BRDF"),
    ):
        file.write_text(json.dumps(state | wrong))
        assert run(*PLAIN, "--state", file, output=tmp_path / "none") == 2
        assert_told(capsys, words)


@pytest.fixture(scope="module")
def glossy(run, place, tmp_path_factory):
    """What a run of a glossy BRDF by all systems leaves, with layers and the error table, under two skies of a name."""
    folder = tmp_path_factory.mktemp("glossy")
    (folder / "other").mkdir()
    shutil.copy(place / "dusk.exr", folder / "other" / "sky.exr")
    options = ["--table", "3", "--terms", "2", "--turn", "90", "--layers", "color,alpha,depth"]
    options += ["--system", ",".join(SYSTEMS), "--order", "4", "--window", "none", "--lobes", "1"]
    options += ["--brdf", "ashikhmin-shirley:diffuse=.2/.3/.4,specular=.1,nu=10"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli_report, "TABLE_LOBES", (1,))
        patch.setattr(cli_report, "POINTS", 90)
        assert run(*options, sky=("sky.exr", folder / "other" / "sky.exr"), output=folder) == 0
    return folder


def test_all_systems_leave_pictures_layers_and_an_error_table_under_each_sky(place, glossy):
    skies = {"sky": place / "sky.exr", "sky_2": glossy / "other" / "sky.exr"}
    kinds = ["reference", *SYSTEMS, *(f"{system}_difference" for system in SYSTEMS)]
    expected = {f"{sky}_{kind}.{suffix}" for sky in skies for kind in kinds for suffix in ("exr", "png")}
    expected |= {f"{sky}_{system}_layers.exr" for sky in skies for system in SYSTEMS} | {f"{sky}.png" for sky in skies}
    assert {path.name for path in glossy.iterdir()} == expected | {*SYSTEMS, "other", "report.json"}
    first, second = (prt.files.read_image(glossy / f"{sky}_separable.exr")[0] for sky in skies)
    assert first.shape == (32, 32, 3)
    assert np.abs(first - second).max() > 0.1
    file = OpenImageIO.ImageInput.open(str(glossy / "sky_separable_layers.exr"))
    assert file is not None
    assert list(file.spec().channelnames) == ["R", "G", "B", "A", "Z"]
    layers = np.asarray(file.read_image("float"))
    seen = layers[..., 3] == 1
    assert seen.any()
    np.testing.assert_allclose(layers[seen][:, :3], first[seen], rtol=1e-4, atol=1e-5)
    told = report(glossy)
    assert told["environments"] == {sky: str(path) for sky, path in skies.items()}
    assert all(0 < told["lights"][sky][system]["picture_error"] < 2 for sky in skies for system in SYSTEMS)
    separable, harmonic, lobe = ([row for row in told["table"] if row["system"] == system] for system in SYSTEMS)
    assert {(row["terms"], row["keep"]) for row in separable} == {(t, k) for t in (1, 4) for k in (32, 96)}
    assert {(row["degree"], row["laplacian"]) for row in harmonic} == {(d, w) for d in (1, 3) for w in (1.0, 0.4)}
    assert [(row["lobes"], row["texels"]) for row in lobe] == [(1, 0), (1, 16)]
    assert all(0 < row[f"error {sky}"] < 2 for row in told["table"] for sky in skies)
    made = told["precompute"]
    assert (made["harmonic"]["mesh"]["degree"], made["lobe"]["mesh"]["lobes"]) == (3, 1)
    assert made["lobe"]["mesh"]["texels"] == 16
    assert made["lobe"]["bytes"] > 0


def test_the_exact_picture_of_many_points_has_fewer_pixels_and_so_have_differences(glossy):
    assert report(glossy)["exact"]["picture_width"] == 16
    picture, right, off = (
        prt.files.read_image(glossy / f"sky_{kind}.exr")[0] for kind in ("lobe", "reference", "lobe_difference")
    )
    assert picture.shape == (32, 32, 3)
    assert right.shape == off.shape == (16, 16, 3)
    coarse = picture.reshape(16, 2, 16, 2, 3).mean((1, 3))
    assert np.linalg.norm(off - np.abs(coarse - right)) < 0.1 * np.linalg.norm(right)
    row, _ = prt.files.read_image(glossy / "sky.png")
    shown, _ = prt.files.read_image(glossy / "sky_reference.png")
    np.testing.assert_array_equal(row[:, -32:], np.kron(shown, np.ones((2, 2, 1))))


# The command prints warnings itself; here they would be errors before they reach it.
@pytest.mark.filterwarnings("default:.* pixels are negative:UserWarning")
def test_negative_pixels_are_told_on_stderr(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(prt.separable, "factor", stop)
    assert run(sky=("negative.exr",), output=tmp_path) == 130
    assert "Warning: " in (told := capsys.readouterr().err)
    assert "pixels are negative" in told


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mesh": "absent.obj"}, "Path '.*absent.obj' does not exist"),
        ({"mesh": "empty.obj"}, "empty.obj must hold vertices and faces"),
        ({"sky": ("absent.exr",)}, "absent.exr"),
        ({"sky": ("text.exr",)}, "text.exr"),
        ({"sky": ("square.exr",)}, "square.exr must be 2 : 1"),
        ({"sky": ("nan.exr",)}, "nan.exr must hold finite radiance"),
        ({"sky": ("sky.exr", "notes.txt")}, "files must be meshes and environments, .*; got .*notes.txt"),
    ],
)
def test_bad_files_are_named_on_stderr_with_status_2(run, tmp_path, capsys, options, message):
    assert run(output=tmp_path / "none", **options) == 2
    assert_told(capsys, message)
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", "0"], "'--size': must be a whole number from 1 to 8192, got 0"),
        (["--size", "many"], "'--size': must be a whole number from 1 to 8192, got 'many'"),
        (["--keep", "0"], "'--keep': must be a whole number of at least 1, got 0"),
        (["--keep", "30000"], "--keep must be at most 384, got 30000"),
        (["--lobes", "6"], "--lobes needs --system lobe or dynamic, got separable"),
        (
            ["--modes", "6", "--system", "lobe,harmonic"],
            "--modes needs --system clusters or dynamic, got lobe,harmonic",
        ),
        (["--brdf", "ashikhmin-shirley", "--terms", "3000"], "terms must be between 1 and .* got 3000"),
        (["--brdf", "ward:along=nan"], "along of ward must be a finite number, got 'nan'"),
        (["--brdf", "merl:absent.binary"], "absent.binary must be a BRDF in MERL's format, and there is no such file"),
        (["--lobes", "6,x"], "'--lobes': must be a whole number from 1 to 64, got 'x'"),
        (["--elevation", "95"], "'--elevation': must be a finite number from -90 to 90, got 95"),
        (["--turn", "0,inf"], "'--turn': must be a finite number, got inf"),
        (["--error", "1"], "'--error': must be a finite number above 0 and below 1, got 1"),
        (["--error", "0.1"], "--error needs --system planned, got separable"),
        (["--tone", "reinhard"], "'reinhard' is not one of 'srgb', 'filmic', 'agx', 'aces', 'neutral'"),
        (["--system", "planed"], "'planed' is not one of 'planned', 'lobe'"),
        (["--unknown"], "No such option '--unknown'"),
        (["--bounces", "few"], "a whole number of at least 0, or \"all\", got 'few'"),
        *(
            ([f"--part={part}"], f"'--part': must be K/N.* got {part}")
            for part in ("0/4", "5/4", "a/b", "2", "-1/2", "1/0")
        ),
        (["--animate", "1"], "'--animate': must be a whole number of at least 2, got 1"),
        (["--material", "7=lambert"], "--material must name one of the parts 0 'mesh', got '7'"),
        (["--material", "lambert"], "must be PART=MATERIAL, such as .* got 'lambert'"),
    ],
)
def test_bad_options_are_named_on_stderr_with_status_2(run, tmp_path, monkeypatch, capsys, options, message):
    if "3000" not in options:
        monkeypatch.setattr(prt.separable, "factor", stop)  # before anything is factored
    assert run(*options, output=tmp_path) == 2
    assert_told(capsys, message)


def assert_told(capsys, message):
    err = capsys.readouterr().err
    assert "Traceback" not in err
    assert [line for line in err.splitlines() if line.startswith("Error: ")], err
    assert re.search(message, err), err


def test_parts_share_a_folder_and_a_call_without_one_goes_on_to_the_pictures(run, tmp_path, monkeypatch, capsys):
    told = []
    for part in ("1/2", "2/2"):
        assert run("--ground", "--part", part, output=tmp_path) == 0
        told.append(capsys.readouterr().out)
    # Each part of the scene is a block, which the first of two parts leaves to the second.
    assert told[0].count("1 of its 1 blocks are missing: run the other parts") == 2
    assert "all parts are done: the same command without --part" in told[1]
    assert not (tmp_path / "report.json").exists()
    monkeypatch.setattr(prt.separable.sparse, "compress", None)  # Nothing is computed again.

    def draw(*_):
        raise RuntimeError("it would draw")

    monkeypatch.setattr(cli_report, "compare", draw)
    assert run("--ground", output=tmp_path) == 1
    assert_told(capsys, "it would draw")


def test_an_output_that_is_a_file_is_refused(run, tmp_path, capsys):
    (tmp_path / "file").write_text("precious")
    assert run(output=tmp_path / "file") == 2
    assert_told(capsys, "--output must be a folder that can be made, got .*file: File exists")
    assert run(output=tmp_path / "file" / "within") == 2
    assert_told(capsys, "--output must be a folder that can be made, got .*within: Not a directory")
    assert (tmp_path / "file").read_text() == "precious"


def test_an_output_that_cannot_be_written_to_is_refused_before_anything_is_computed(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(prt.separable, "factor", stop)
    monkeypatch.setattr(os, "access", lambda path, mode: path != tmp_path)  # Root may write everywhere.
    assert run(output=tmp_path) == 2
    assert_told(capsys, f"--output must be a folder that can be written to, got {tmp_path}")


def test_too_little_memory_ends_in_one_line(run, tmp_path, monkeypatch, capsys):
    def fail(*_, **__):
        raise MemoryError("Unable to allocate 9 TiB")

    monkeypatch.setattr(prt.separable, "factor", fail)
    assert run(output=tmp_path) == 1
    assert_told(capsys, "Error: Unable to allocate 9 TiB")


def stop(*_, **__):
    raise KeyboardInterrupt


def test_the_module_runs_as_a_program():
    done = subprocess.run([sys.executable, "-m", "jaxprt", "--help"], check=True, capture_output=True, text=True)
    assert "Usage: jaxprt [OPTIONS] COMMAND" in done.stdout
    for name in ("relight", "view", "plan", "measure", "export", "info", "completion"):
        assert f"\n  {name} " in done.stdout
    assert not done.stderr


def test_materials_that_change_are_relit_with_bounces_and_animated(run, tmp_path, capsys):
    glossy = ["--material", "mesh=cook-torrance:diffuse=.5,specular=.6/.5/.3,roughness=.4"]
    assert run("--ground", "--system", "lobe", "--bounces", "2", "--animate", "2", *glossy, output=tmp_path) == 0
    told = report(tmp_path)["lights"]["sky"]["lobe"]
    assert 0.03 < told["reflected_fraction"] < 0.2
    assert told["picture_error"] < 0.3
    frames = [prt.files.read_image(tmp_path / "animation" / f"frame_{n:04d}.png")[0] for n in range(2)]
    assert np.abs(frames[0] - frames[1]).max() > 0.05
    whole, direct = (prt.files.read_image(tmp_path / f"sky_{name}.exr")[0] for name in ("lobe_bounces", "lobe"))
    assert whole.mean() > direct.mean()
    assert "comes from other surfaces" in capsys.readouterr().out
