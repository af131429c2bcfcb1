import functools

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import CookTorrance, load_scattered, measured, scattered
from tests.upper import evaluate, relative

WAVELENGTH = np.arange(400.0, 701, 10)
MATERIALS = ["acryl_blue", "cayman", "mystique"]
# Median over single samples left out of |error| / |value|, and L2 error over the 98 % of them outside of the highlight,
# whose width of half a degree no sample but its own tells.
LEFT_OUT = {"acryl_blue": (0.15, 0.3), "cayman": (0.15, 0.15), "mystique": (0.4, 0.2)}
# How far the largest of 16 samples around may be exceeded: 1.25 to 1.85 measured, 16 to 24 with a smoothing of 0.01.
SWING = 3.0
# Of the cube root at the samples: .128, .102, .123 measured. Part is smoothing, part the table: the brightest sample,
# 80 degrees from the normal, comes out a third too dark with 48 cells in theta_d and 5 % with 192.
SMOOTHED = 0.14


@pytest.fixture(scope="module")
def made(data):
    """Directions and colors of a material's samples, and the BRDF that is made of them."""

    @functools.cache
    def of(material):
        path = data / f"brdf/{material}.brdf"
        return *scattered.read_scattered(path), load_scattered(path)

    return of


def upper(count, seed=0, lowest=0.2):
    direction = np.random.default_rng(seed).standard_normal((count, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + lowest
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def values(brdf, wi, wo):
    return np.asarray(evaluate(brdf, jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32)), float)


def write(path, samples, wavelength=WAVELENGTH, head="# a comment\n"):
    rows = "\n".join(" ".join(f"{x:.8g}" for x in row) for row in np.atleast_2d(samples))
    path.write_text(f"{head}{len(wavelength)}\n# nm\n{' '.join(map(str, wavelength))}\n{rows}\n")
    return path


def samples(count=30):
    random = np.random.default_rng(5)
    angle = random.uniform([0.1, 0, 0.1, -3], [1.3, 0, 1.3, 3], (count, 4))
    return np.concatenate([angle, random.uniform(0, 0.1, (count, len(WAVELENGTH)))], 1)


@pytest.mark.parametrize("material", MATERIALS)
def test_samples_left_out_are_predicted(data, material):
    wi, wo, color = scattered.read_scattered(data / f"brdf/{material}.brdf")
    assert len(color) == 1439
    out = np.random.default_rng(0).permutation(len(color)) % 10 == 0
    found = values(scattered.interpolate_scattered(wi[~out], wo[~out], color[~out]), wi[out], wo[out])
    expected = color[out]
    error, size = np.abs(found - expected).sum(1), expected.sum(1)
    median, rest = LEFT_OUT[material]
    assert np.median(error / (size + 1e-9)) < median
    matte = size < np.quantile(size, 0.98)
    assert relative((found - expected)[matte], expected[matte]) < rest


@pytest.mark.parametrize("material", MATERIALS)
def test_values_between_samples_are_like_those_of_the_samples_around(made, material):
    """Leaving out single samples does not show how splines swing between the few angles of incidence; this does."""
    wi, wo, color, brdf = made(material)
    a, b = upper(1000, 14, lowest=0.25), upper(1000, 15, lowest=0.25)
    # Isotropic and reciprocal: the angle between the directions, and both cosines, the larger first.
    place, query = (
        np.stack([np.sum(i * o, -1), np.maximum(i[:, 2], o[:, 2]), np.minimum(i[:, 2], o[:, 2])], -1)
        for i, o in ((wi, wo), (a, b))
    )
    near = np.argsort(np.sum((query[:, None] - place) ** 2, -1), 1)[:, :16]
    gray = color.mean(1)
    half = np.linalg.norm((a + b)[:, :2], axis=1) / np.linalg.norm(a + b, axis=1)
    found = values(brdf, a, b).mean(1)[half > 0.1]
    highest = gray[near].max(1)[half > 0.1]
    assert np.all(found < SWING * highest + 0.01 * np.median(gray))


@pytest.mark.parametrize("material", MATERIALS)
def test_measured_materials_are_brdfs(made, material):
    wi, wo, color, brdf = made(material)
    assert relative(np.cbrt(values(brdf, wi, wo)) - np.cbrt(color), np.cbrt(color)) < SMOOTHED
    wi, wo = upper(4000, 1, lowest=0), upper(4000, 2, lowest=0)
    found = values(brdf, wi, wo)
    assert np.all(found >= 0)
    assert np.all(found <= 1.001 * color.max(0))
    assert relative(values(brdf, wo, wi) - found, found) < 1e-5
    mirrored = np.array([1, -1, 1])
    assert relative(values(brdf, wi * mirrored, wo * mirrored) - found, found) < 1e-4
    turn = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
    assert relative(values(brdf, wi @ turn, wo @ turn) - found, found) < 1e-4
    assert np.mean(found, 0).max() * np.pi < 1


def test_a_smooth_brdf_is_recovered_from_scattered_samples():
    model = CookTorrance(diffuse=[0.3, 0.2, 0.1], specular=0.3, roughness=0.4)
    wi, wo = upper(800, 3), upper(800, 4)
    value = values(model, wi, wo)
    brdf = scattered.interpolate_scattered(wi, wo, value, smoothing=1e-6, resolution=(60, 40, 24))
    wi, wo = upper(500, 5, lowest=0.4), upper(500, 6, lowest=0.4)
    expected = values(model, wi, wo)
    found = values(brdf, wi, wo)
    assert np.median(np.abs(found - expected) / expected) < 1e-3
    assert (
        relative(found - expected, expected) < 0.04
    )  # In the highlight's thinly sampled parts; .09 with half as many.


def test_interpolation_commutes_with_scaling_permuting_exchanging_and_turning():
    wi, wo = upper(60, 7), upper(60, 8)
    value = np.random.default_rng(9).uniform(0.01, 1, (60, 2))
    small = {"resolution": (8, 8, 6)}
    expected = scattered.interpolate_scattered(wi, wo, value, **small).root
    turn = np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]])
    for found in (
        scattered.interpolate_scattered(wi, wo, 8 * value, **small).root / 2,
        scattered.interpolate_scattered(wi[::-1], wo[::-1], value[::-1], **small).root,
        scattered.interpolate_scattered(wo, wi, value, **small).root,
        scattered.interpolate_scattered(wi @ turn, wo @ turn, value, **small).root,
        scattered.interpolate_scattered(wi * [1, -1, 1], wo * [1, -1, 1], value, **small).root,
        scattered.interpolate_scattered(np.r_[wi, wo], np.r_[wo, wi], np.r_[value, value], **small).root,
    ):
        assert relative(found - expected, expected) < 1e-4


def test_cells_beyond_the_measured_directions_are_counted():
    wi, wo = upper(50, 12, lowest=1.0), upper(50, 13, lowest=1.0)
    brdf = scattered.interpolate_scattered(wi, wo, np.ones((50, 1)), resolution=(20, 20, 6))
    lowest = measured.lower_cosine((20, 20, 6))
    inside = np.sum(lowest >= min(wi[:, 2].min(), wo[:, 2].min()))
    assert brdf.filled == pytest.approx(1 - inside / np.sum(lowest > 0), rel=1e-5)


def test_equal_reflectance_is_white():
    color = scattered.spectrum_to_rgb(np.array([np.ones(31), np.full(31, 0.2)]), WAVELENGTH)
    np.testing.assert_allclose(color, [[1, 1, 1], [0.2, 0.2, 0.2]], rtol=1e-12)


@pytest.mark.parametrize("step", [5.0, 20.0])
def test_colors_agree_with_tabulated_matching_functions(step):
    """Mitsuba's tables of the observer, of D65, and its primaries, over the whole spectrum."""
    mitsuba = pytest.importorskip("mitsuba")
    mitsuba.set_variant("scalar_rgb")
    fine = np.arange(380.0, 781)
    observer = np.array([np.array(mitsuba.cie1931_xyz(float(w))) for w in fine])
    daylight = np.array([float(mitsuba.cie_d65(float(w))) for w in fine])
    wavelength = np.arange(400, 701, step)
    for center, width in ((450, 60), (520, 50), (580, 80), (640, 60)):
        spectrum = 0.3 + 0.5 * np.exp(-(((fine - center) / width) ** 2))
        xyz = (spectrum * daylight) @ observer / (daylight @ observer[:, 1])
        expected = np.array(mitsuba.xyz_to_srgb(mitsuba.Color3f(*xyz.tolist())))
        found = scattered.spectrum_to_rgb(np.interp(wavelength, fine, spectrum), wavelength)
        np.testing.assert_allclose(found, expected, atol=0.015)


def test_written_samples_are_read(tmp_path):
    row = samples()
    wi, wo, color = scattered.read_scattered(write(tmp_path / "good.brdf", row))
    np.testing.assert_allclose(np.arccos(wi[:, 2]), row[:, 0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(wo[:, 1], wo[:, 0]), row[:, 3], rtol=1e-6)
    np.testing.assert_allclose(np.arccos(wo[:, 2]), row[:, 2], rtol=1e-6)
    np.testing.assert_allclose(color, scattered.spectrum_to_rgb(row[:, 4:], WAVELENGTH), rtol=1e-6)


def _changed(place, value):
    def change(row):
        row[place] = value
        return row

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.ravel()[:-3], r"each sample must have 4 angles and 31 values, got 29 samples and 32 further"),
        (lambda row: row[:5], "at least 10 different samples, got 5"),
        (lambda row: np.repeat(row[:1], 20, 0), "at least 10 different samples, got 1"),
        (_changed((3, 7), np.nan), r"finite, got 1 that are not, the first number at sample, column \(3, 7\): nan"),
        (_changed((4, 8), -0.1), r"non-negative, got 1 that are not, the first value .* \(4, 4\): -0.1"),
        (_changed((5, 2), 1.6), r"theta in \[0, pi/2\), got 1 that are not, the first angle .* \(5, 1\): 1.6"),
    ],
)
def test_bad_samples_are_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=f"bad.brdf: .*{message}"):
        load_scattered(write(tmp_path / "bad.brdf", change(samples())))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "must begin with the number of wavelengths, at least 2, got an empty file"),
        ("1.5 2", "at least 2, got 1.5"),
        ("3\n400 500 450 0 0", r"3 increasing wavelengths in nm, got \[400.0, 500.0, 450.0\]"),
        ("2\n400 700\n0 0 x 0 1 1", "line 3 must hold numbers, got 'x'"),
        ("2\n400 700\n0 0 0 0 1 1", "reach from 430 to 650 nm"),
    ],
)
def test_files_that_are_not_samples_are_refused(tmp_path, text, message):
    path = tmp_path / "bad.brdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"bad.brdf: .*{message}"):
        scattered.read_scattered(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": (8, 8, 5)}, "the last even"),
        ({"resolution": (8, 1, 4)}, "at least 2"),
        ({"smoothing": -1.0}, "smoothing must be at least 0, got -1.0"),
        ({"smoothing": float("nan")}, "smoothing must be at least 0, got nan"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        scattered.interpolate_scattered(upper(20), upper(20, 1), np.ones((20, 3)), **options)


def test_samples_on_one_plane_are_refused():
    wi = upper(30)
    with pytest.raises(ValueError, match="must not all lie on one plane"):
        scattered.interpolate_scattered(wi, wi, np.ones((30, 1)))
