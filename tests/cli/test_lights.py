"""The command `jaxprt lights`: a sheet of one scene in many lights."""

import json

import jax.numpy as jnp
import numpy as np
from PIL import Image

import jaxprt as prt
from jaxprt.files import captions

SMALL = ("--ground", "--size", "32", "--light-size", "8", "--lobes", "1", "--brdf", "lambert", "--refine", "off")


def test_each_light_has_its_picture_and_its_name_on_the_sheet(main, place, tmp_path, capsys):
    path, store = tmp_path / "sheet.png", tmp_path / "store"
    skies = [place / "sky.exr", place / "dusk.exr"]
    options = ["--turn", "0,90", "--output", path, "--store", store, "--json"]
    assert main("lights", *SMALL, *options, place / "mesh.obj", *skies) == 0
    assert json.loads(capsys.readouterr().out)["lights"] == ["sky_0", "sky_90", "dusk_0", "dusk_90"]
    sheet = np.asarray(Image.open(path)) / 255
    assert sheet.shape == (2 * (32 + 28), 2 * 32, 3)
    pictures = [sheet[60 * row : 60 * row + 32, 32 * column : 32 * column + 32] for row in (0, 1) for column in (0, 1)]
    names = [
        sheet[60 * row + 32 : 60 * row + 60, 32 * column : 32 * column + 32] for row in (0, 1) for column in (0, 1)
    ]
    for number, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        assert 0.01 < np.mean(name < 0.5) < 0.5
        assert all(np.abs(picture - other).mean() > 1e-3 for other in pictures[number + 1 :])
    # The same picture as `jaxprt relight` makes, but for the exposure of each.
    out = tmp_path / "out"
    relight = ["--system", "lobe", "--lobes", "1", "--size", "32", "--light-size", "8", "--ground", "--brdf", "lambert"]
    assert main("relight", *relight, "--refine", "off", "--output", out, place / "mesh.obj", skies[1]) == 0
    linear, _ = prt.files.read_image(out / "dusk_lobe.exr")
    found = np.asarray(prt.image.decode_srgb(jnp.asarray(pictures[2])))
    inside = np.all((found > 0.05) & (found < 0.95), -1)
    ratio = found[inside] / linear[inside]
    assert np.std(ratio) < 0.03 * np.mean(ratio)


def test_names_become_smaller_and_lose_their_middle_where_they_are_too_wide():
    long = "a_really_long_name_of_an_environment_map_180"
    shown, height = captions.fitting(long, 128)
    assert height == 9
    assert shown.startswith("a_really")
    assert shown.endswith("_180")
    assert "…" in shown
    assert captions.fitting("uffizi_latlong_256x128", 128)[0] == "uffizi_latlong_256x128"
    assert captions.fitting("sky", 128) == ("sky", 16)


def test_what_a_sheet_cannot_have_is_refused(main, place, tmp_path, capsys):
    path = tmp_path / "sheet.png"
    for wrong, words in (
        (["--output", tmp_path / "sheet.jpg"], "must end in .png"),
        (["--lobes", "1,2"], "of one system and one number of lobes, got several"),
        (["--columns", "0"], "'--columns': must be a whole number of at least 1, got 0"),
    ):
        assert main("lights", *SMALL, "--output", path, *wrong, place / "mesh.obj", place / "sky.exr") == 2
        told = capsys.readouterr().err
        assert words in told
    assert not path.exists()


def test_a_broken_light_is_told_before_anything_is_precomputed(main, place, tmp_path, capsys):
    (tmp_path / "broken.hdr").write_bytes(b"#?RADIANCE\n")
    lights = place / "sky.exr", tmp_path / "broken.hdr"
    assert main("lights", *SMALL, "--store", tmp_path / "store", place / "mesh.obj", *lights) == 2
    assert "broken.hdr must be" in capsys.readouterr().err
    assert not list((tmp_path / "store").iterdir())
