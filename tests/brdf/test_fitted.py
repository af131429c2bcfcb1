"""Fits read from files: the models that they state, and what is refused."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import load_lafortune, load_ngan, load_scattered, navigation
from tests.upper import evaluate, pairs, relative


def test_lafortune_coefficients_make_their_model(data):
    path = data / "brdf/lafortune_measured.json"
    wi, wo = pairs(50)
    entry = json.loads(path.read_text())["materials"]["clay"]
    expected = np.broadcast_to(np.array(entry["diffuse"]) / np.pi, wi.shape)
    for lobe in entry["lobes"]:
        cxy, cz, exponent = (np.array(lobe[key]) for key in ("Cxy", "Cz", "n"))
        base = cxy * np.sum((wi * wo)[:, :2], 1, keepdims=True) + cz * (wi * wo)[:, 2:]
        expected = expected + np.maximum(base, 0) ** exponent
    found = np.asarray(evaluate(load_lafortune(path, "clay"), jnp.float32(wi), jnp.float32(wo)))
    # Exponents of 200 magnify the rounding of float32.
    assert relative(found - expected, expected) < 1e-4


BEYOND = 10**400


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda entry: entry.pop("diffuse"), "must be JSON with materials"),
        (lambda entry: entry.update(diffuse=[0.1, -0.1, 0]), r"first diffuse at color \(1,\): -0.1"),
        (lambda entry: entry.update(diffuse=[0.1, 1e30, 0]), r"first diffuse at color \(1,\): 1e\+30"),
        (lambda entry: entry.update(diffuse=["0.1", "0.1", "0.1"]), "diffuse must be three numbers"),
        (lambda entry: entry.update(diffuse=[BEYOND, 0, 0]), "diffuse must be numbers that float64 can hold"),
        (lambda entry: entry.update(lobes=[3]), "got clay in another form"),
        (lambda entry: entry["lobes"][0].update(n=[1, 2, 0]), r"every n must be positive.*\(0, 2\): 0.0"),
        (lambda entry: entry["lobes"][1].update(Cz=[1, float("nan"), 0]), r"every Cz must be finite.*\(1, 1\): nan"),
        (lambda entry: entry["lobes"][0].update(Cxy=[-1, 1e30, 1]), r"got 1 that are not, .* \(0, 1\): Cxy 1e\+30"),
        (lambda entry: entry["lobes"][0].update(Cz=[1, 10, 10], n=[1, 1, 90]), r"\(0, 2\): Cxy -1, Cz 10, n 90"),
        (lambda entry: entry["lobes"][0].update(n=[1e30, 1, 1], Cz=[2, 1, 1]), r"\(0, 0\): Cxy -1, Cz 2, n 1e\+30"),
    ],
)
def test_bad_lafortune_files_are_refused(tmp_path, change, message):
    lobe = {"Cxy": [-1, -1, -1], "Cz": [1, 1, 1], "n": [5, 5, 5]}
    entry = {"diffuse": [0.1, 0.2, 0.3], "lobes": [lobe, dict(lobe)]}
    change(entry)
    path = tmp_path / "coefficients.json"
    path.write_text(json.dumps({"materials": {"clay": entry}}))
    with pytest.raises(ValueError, match=f"coefficients.json: .*({message})"):
        load_lafortune(path, "clay")
    with pytest.raises(ValueError, match=r"material must be one of 1 names such as clay, got 'clya'"):
        load_lafortune(path, "clya")


DEEP = "[" * 100_000


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"{", "got other content"),
        (b"\xff\xfe", "got other content"),
        (b"[]", "an object in braces, got a list"),
        (b"{}", "got a file without materials"),
        (b'{"materials": {}}', "got a file without materials"),
        (b'{"materials": {"clay": 3}}', "got clay in another form"),
        (b'{"materials": {"clay": {}, "clay": {}}}', "the name 'clay' 2 times"),
        (f'{{"materials": {DEEP}'.encode(), "nested too deeply"),
        (b'{"materials": ' + b"1" * 5000 + b"}", "got other content"),
    ],
)
def test_files_that_are_not_of_lafortune_fits_are_refused(tmp_path, content, message):
    path = tmp_path / "coefficients.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"coefficients\.json.*{message}"):
        load_lafortune(path, "clay")


GOOD = "nickel = Aggregate(Lambertian(albedo = [0.1, 0.2, 0.3]), {})\n"
WARD = "NganWardDuer(albedo = [0.3, 0.2, 0.1], roughness = 0.1)"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (GOOD.format(WARD.replace("0.1)", "1e400)")), "roughness must be from 0 to 1e.09, got 1e400"),
        (GOOD.format(WARD.replace("0.1)", "-0.1)")), "roughness must be from 0 to 1e.09, got -0.1"),
        (GOOD.format(WARD.replace("roughness", "sharpness")), "it must have albedo, roughness once, got albedo"),
        (GOOD.format(WARD.replace("[0.3, 0.2, 0.1]", "[0.3, 0.2]")), r"albedo must be 3 numbers, got '\[0.3, 0.2\]'"),
        (GOOD.format(WARD).replace("[0.1, 0.2, 0.3]", "[1e30, 1, 1]"), "the diffuse albedo must be from 0 to 1e"),
        (GOOD.format(WARD) * 2, "materials must have different names, got 1 names twice, first 'nickel'"),
        (
            GOOD.format("NganLafortune(albedo = [1, 1, 1], Cxy = -1, Cz = 1, sharpness = 0)"),
            "sharpness must be positive",
        ),
        (GOOD.format("NganLafortune(albedo = [1, 1, 1], Cxy = 0, Cz = 0, sharpness = 2)"), "Cxy or Cz not 0"),
        (
            GOOD.format("NganLafortune(albedo = [9, 9, 9], Cxy = -1, Cz = 1, sharpness = 1e-4)"),
            "lobes must be at most 1e\\+12 high, got 3",
        ),
        ("a" * 100_000, "must have lines such as"),
    ],
)
def test_bad_numbers_of_ngans_fits_are_refused(tmp_path, text, message):
    path = tmp_path / "ngan.fit"
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"ngan\.fit: .*{message}"):
        load_ngan(path, "nickel")


def test_tables_of_fits_with_numbers_beyond_those_of_surfaces_are_refused(tmp_path):
    path = tmp_path / "fits.csv"
    head = "material,kd_r,kd_g,kd_b,ks_r,ks_g,ks_b,m,F0\n"
    path.write_text(head + "a,0.1,0.1,0.1,1e30,0.1,0.1,0.1,0.1\n")
    with pytest.raises(ValueError, match=r"fits\.csv: line 2: ks_r must be finite and not negative, at most 1e\+09"):
        navigation.cook_torrance(path=path)


def test_scattered_values_that_no_surface_has_are_refused(tmp_path):
    path = tmp_path / "points.brdf"
    path.write_text("2 400 700\n" + "0.1 0 0.2 0 0.5 0.5\n" * 3 + "0.1 0 0.2 0 0.5 1e30\n")
    with pytest.raises(ValueError, match=r"points\.brdf: .* at most 1e\+12 per sr, got 1 .*\(3, 1\): 1e\+30"):
        load_scattered(path)
