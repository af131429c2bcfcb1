import csv

import jax.numpy as jnp
import numpy as np
import pytest

from jaxprt.brdf import CookTorrance, load_merl, load_npf, measured
from tests.upper import evaluate, relative

MERL = (90, 90, 180)
SCALE = np.array([1.0, 1.15, 1.66]) / 1500
# A lobe over a base of three colors, at directions at least 12 degrees above the horizon: what interpolation between
# cells of the MERL grid costs. Below, 1 / (cos_i cos_o) grows faster than cells follow it.
INTERPOLATION = 0.003
MODEL = CookTorrance(diffuse=[0.1, 0.2, 0.3], specular=[0.5, 0.3, 0.2], roughness=0.1, f0=0.2)


def pairs(count=4000, seed=0, lowest=0.0):
    direction = np.random.default_rng(seed).standard_normal((2, 2 * count, 3))
    direction[..., 2] = np.abs(direction[..., 2])
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    # Half of them next to the mirror direction, where the lobe is.
    direction[1, count:] = direction[0, count:] * [-1, -1, 1] + 0.15 * direction[1, count:]
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return jnp.asarray(direction[:, (direction[..., 2] > lowest).all(0)], jnp.float32)


def turned(vector, theta, phi):
    """Rotates by theta about y, then by phi about z."""
    x, y, z = np.moveaxis(vector, -1, 0)
    x, z = x * np.cos(theta) + z * np.sin(theta), z * np.cos(theta) - x * np.sin(theta)
    return np.stack([x * np.cos(phi) - y * np.sin(phi), x * np.sin(phi) + y * np.cos(phi), z], -1)


def directions(theta_h, theta_d, phi_d, phi_h=0.3):
    """Rusinkiewicz 1998, figure 1: the light is theta_d, phi_d from the half vector, before that is turned."""
    angles = np.broadcast_arrays(theta_h, theta_d, phi_d)
    pole = np.zeros((*angles[0].shape, 3)) + [0.0, 0, 1]
    wi = turned(turned(pole, angles[1], angles[2]), angles[0], phi_h)
    half = turned(pole, angles[0], phi_h)
    return wi, 2 * np.sum(wi * half, -1, keepdims=True) * half - wi


@pytest.fixture(scope="module")
def merl_file(tmp_path_factory):
    """A file in the MERL format, from the model; -1 below the horizon as in the database."""
    wi, wo = directions(*measured.cell_angles(MERL))
    value = np.asarray(evaluate(MODEL, jnp.float32(wi), jnp.float32(wo)), float)
    value = np.where((wi[..., 2:] > 0) & (wo[..., 2:] > 0), value / SCALE, -1)
    path = tmp_path_factory.mktemp("merl") / "model.binary"
    write(path, np.moveaxis(value, -1, 0))
    return path


def write(path, plane, shape=MERL):
    path.write_bytes(np.array(shape, "<i4").tobytes() + np.ascontiguousarray(plane, "<f8").tobytes())
    return path


@pytest.fixture(scope="module")
def merl(merl_file):
    return load_merl(merl_file)


def planes(path):
    return np.fromfile(path, "<f8", offset=12).reshape(3, *MERL)


def test_table_is_met_at_the_centers_of_its_cells(x64):
    shape = (7, 6, 8)
    root = np.random.default_rng(1).uniform(0.1, 1, (*shape, 3))
    wi, wo = directions(*measured.cell_angles(shape))
    above = measured.lower_cosine(shape) > 0
    np.testing.assert_array_equal(above, (wi[..., 2] > 0) & (wo[..., 2] > 0))
    found = evaluate(measured.HalfDifferenceTable(root), jnp.asarray(wi[above]), jnp.asarray(wo[above]))
    np.testing.assert_allclose(found, root[above] ** 3, rtol=1e-9)


def test_angles_repeat_after_half_a_turn_without_a_seam(x64):
    root = np.random.default_rng(2).uniform(0.1, 1, (5, 5, 6, 1))
    table = measured.HalfDifferenceTable(root)
    phi = np.array([1e-9, -1e-9, np.pi - 1e-9, np.pi + 1e-9])
    around = np.ravel(evaluate(table, *map(jnp.asarray, directions(0.4, 0.5, phi))))
    np.testing.assert_allclose(around, around[0], rtol=1e-7)


def test_merl_table_is_the_model_that_it_was_made_of(merl):
    wi, wo = pairs(lowest=np.sin(np.radians(12)))
    expected = evaluate(MODEL, wi, wo)
    assert relative(evaluate(merl, wi, wo) - expected, expected) < INTERPOLATION
    assert merl.filled == 0


def test_tables_are_reciprocal_nonnegative_and_dark_below_the_horizon(merl, data):
    wi, wo = map(np.asarray, pairs(seed=3))
    below = np.float32([1.0, 1, -1])
    npf = load_npf(data / "brdf/merl_npf_512x256_rgb32f.bin", "chrome")
    for brdf in (merl, npf):
        found = np.asarray(evaluate(brdf, wi, wo))
        # Float32 angles next to the pole of a lobe that falls by decades.
        assert relative(evaluate(brdf, wo, wi) - found, found) < 1e-4
        assert np.all(np.isfinite(found))
        assert np.all(found >= 0)
        assert np.all(np.asarray(evaluate(brdf, wi * below, wo)) == 0)
        assert np.all(np.asarray(evaluate(brdf, wi, wo * below)) == 0)


def _small():
    random = np.random.default_rng(4)
    table = measured.tabulate(random.uniform(0.0, 2, (9, 8, 6, 3)), np.ones((9, 8, 6), bool))
    factors = (random.uniform(0.1, 1, shape) for shape in ((3,), (3,), (9, 3), (9, 3), (9, 3)))
    return {"half-difference": table, "microfacet": measured.MicrofacetTable(*(jnp.float32(f) for f in factors))}


def test_table_is_the_same_from_all_sides_where_the_turn_is_undefined(x64):
    table = _small()["half-difference"]
    for theta_h, theta_d in ((1e-5, 0.7), (0.5, 1e-5)):
        around = evaluate(table, *map(jnp.asarray, directions(theta_h, theta_d, np.linspace(0, 6, 13))))
        np.testing.assert_allclose(around, np.broadcast_to(around[0], (13, 3)), rtol=1e-2)


def test_missing_cells_take_the_nearest_value_across_the_seam():
    value, valid = np.full((6, 6, 8, 1), np.nan), np.zeros((6, 6, 8), bool)
    value[3, 3, 7], valid[3, 3, 7] = 8.0, True
    value[3, 3, 3], valid[3, 3, 3] = 1.0, True
    root = np.asarray(measured.tabulate(value, valid).root)[3, 3, :, 0]
    np.testing.assert_allclose(root[[6, 7, 0]], 2)
    np.testing.assert_allclose(root[[2, 3, 4]], 1)


def test_invalid_cells_of_merl_files_are_filled_and_counted(merl_file, merl, tmp_path):
    plane = planes(merl_file)
    above = measured.lower_cosine(MERL) > 0
    hole = np.zeros(MERL, bool)
    hole[20:23, 40:42, 100:110] = True
    plane[1, hole] = -1e-3  # One color is enough.
    brdf = load_merl(write(tmp_path / "hole.binary", plane))
    assert brdf.filled == pytest.approx(np.sum(hole & above) / above.sum(), rel=1e-4)
    assert np.sum(hole & above) == hole.sum()
    root, whole = np.asarray(brdf.root), np.asarray(merl.root)
    assert relative((root - whole)[hole], whole[hole]) < 0.1
    np.testing.assert_array_equal(root[~hole & above], whole[~hole & above])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", r"must begin with three int32 \(90, 90, 180\), got 0 bytes"),
        (np.array([90, 90, 90], "<i4").tobytes(), r"must be \(90, 90, 180\), got \(90, 90, 90\)"),
        (np.array(MERL, ">i4").tobytes(), r"the dimensions must be \(90, 90, 180\), got \(1509949440"),
        (np.array(MERL, "<i4").tobytes() + b"\0" * 800, "must have 34992012 bytes, got 812"),
    ],
)
def test_files_that_are_not_merl_are_refused(tmp_path, content, message):
    path = tmp_path / "broken.binary"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"broken.binary: .*{message}"):
        load_merl(path)


def test_merl_files_without_a_number_are_refused(tmp_path):
    plane = np.full((3, *MERL), -1.0)
    with pytest.raises(ValueError, match=r"must hold at least one cell without a negative value, got none of 1458000"):
        load_merl(write(tmp_path / "empty.binary", plane))
    plane[2, 5, 6, 7] = np.nan
    with pytest.raises(ValueError, match=r"finite, got 1 that are not, the first .* \(2, 5, 6, 7\): nan"):
        load_merl(write(tmp_path / "broken.binary", plane))


def test_merl_values_that_no_surface_has_are_refused_by_their_number_and_place(tmp_path, monkeypatch):
    monkeypatch.setattr(measured, "_MERL_SHAPE", (2, 2, 4))
    plane = np.full((3, 2, 2, 4), 30.0)
    for value in (1e300, 1e16, np.finfo(float).max):
        plane[1, 1, 0, 2:] = value
        with pytest.raises(ValueError, match=r"hot.binary: .* at most 1.5e\+15, got 2 .*\(1, 1, 0, 2\): ") as error:
            load_merl(write(tmp_path / "hot.binary", plane, (2, 2, 4)))
        assert str(error.value).endswith(str(value))
    plane[1, 1, 0, 2:] = 1e15
    brdf = load_merl(write(tmp_path / "hot.binary", plane, (2, 2, 4)))
    np.testing.assert_allclose(np.asarray(brdf.root, float)[1, 1, 2:, 1] ** 3, 1.5e12 / 1.5 * 1.15 / 1.5, rtol=1)
    assert np.all(np.isfinite(np.asarray(brdf.root) ** 3))
    # A negative value marks a cell that was not measured, however large it is.
    plane[1, 1, 0, 2:] = -1e300
    assert np.all(np.isfinite(np.asarray(load_merl(write(tmp_path / "cold.binary", plane, (2, 2, 4))).root)))


@pytest.fixture
def npf(data):
    return data / "brdf/merl_npf_512x256_rgb32f.bin"


def published(row, wi, wo):
    """pi f with floors in place of interpolation for D and F, as the table's description has it."""
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    theta_h, theta_d, theta_i, theta_o = (
        np.arccos(np.clip(c, -1, 1)) / (np.pi / 2) for c in (half[:, 2], np.sum(half * wi, -1), wi[:, 2], wo[:, 2])
    )
    distribution, masking, fresnel = row[2:272].reshape(3, 90, 3)
    lobe = distribution[np.floor(90 * np.sqrt(theta_h)).astype(int)] * fresnel[np.floor(90 * theta_d).astype(int)]
    for theta, w in ((theta_i, wi), (theta_o, wo)):
        center = (np.arange(1, 90) + 0.5) / 90
        lobe = lobe * np.stack([np.interp(theta, center, g) for g in masking[1:].T], -1) / w[:, 2:]
    return row[0] + row[1] * lobe


@pytest.mark.parametrize("material", ["gold-metallic-paint", "chrome", "pink-fabric"])
def test_microfacet_table_is_the_published_product_at_the_centers_of_bins(npf, material, x64):
    theta_h, theta_d, _ = measured.cell_angles((90, 90, 1))
    theta_h, theta_d = np.broadcast_arrays(theta_h[:80:7, :, 0], theta_d[:, 2:80:5, 0])
    wi, wo = (w.reshape(-1, 3) for w in directions(theta_h, theta_d, 1.3))
    wi, wo = (w[(wi[:, 2] > 0.1) & (wo[:, 2] > 0.1)] for w in (wi, wo))
    row = np.fromfile(npf, "<f4").reshape(256, 512, 3)[
        (npf.parent / "merl_npf_materials.txt").read_text().split().index(material)
    ]
    # The bins' floors are one rounding away at the centers, where the interpolant equals them.
    expected = published(row.astype(float), wi, wo)
    found = np.pi * np.asarray(evaluate(load_npf(npf, material), wi, wo))
    assert relative(found - expected, expected) < 1e-6


def test_first_bins_that_were_not_fitted_are_not_black(npf):
    up = jnp.array([[0.0, 0.6, 0.8]])
    retro = evaluate(load_npf(npf, "white-marble"), up, up)
    aside = evaluate(load_npf(npf, "white-marble"), up, jnp.array([[0.0, 0.6 - 0.025, 0.81815]]))
    np.testing.assert_allclose(retro, aside, rtol=0.05)


def albedo(brdf, angle, rows=200, columns=64):
    """Reflected share of the light from one direction, by quadrature over half vectors: dwo = 4 (h.wi) dwh."""
    x = (np.arange(rows) + 0.5) / rows
    theta, phi = np.meshgrid(np.pi / 2 * x**2.5, (np.arange(columns) + 0.5) * 2 * np.pi / columns, indexing="ij")
    wi = np.array([np.sin(angle), 0, np.cos(angle)])
    half = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    cos_d = half @ wi
    wo = 2 * cos_d[..., None] * half - wi
    area = 2 * np.pi / columns * np.sin(theta) * (np.pi / 2 * 2.5 * x**1.5 / rows)[:, None]
    weight = np.where((cos_d > 0) & (wo[..., 2] > 0), 4 * cos_d * area * wo[..., 2], 0)
    wo = jnp.asarray(wo.reshape(-1, 3), jnp.float32)
    return weight.ravel() @ np.asarray(evaluate(brdf, jnp.broadcast_to(jnp.float32(wi), wo.shape), wo))


def test_all_materials_reflect_less_than_they_receive(npf):
    for material in (npf.parent / "merl_npf_materials.txt").read_text().split():
        brdf = load_npf(npf, material)
        assert max(albedo(brdf, angle).max() for angle in (0.1, 1.0, 1.4)) < 0.8, material


def test_fits_by_others_to_the_same_materials_agree(npf, data):
    """Ngan, Durand, Matusik 2005: their diffuse reflectance, with the color scale of the MERL format."""
    wi, wo = jnp.array([[0.574, 0, 0.819]]), jnp.array([[0.0, 0.574, 0.819]])  # Far from the mirror direction.
    ratio = []
    with open(data / "brdf/ngan2005_cooktorrance.csv", newline="") as file:
        for line in csv.DictReader(file):
            diffuse = np.array([float(line[f"kd_{color}"]) for color in "rgb"]) * 1500 * SCALE
            ratio.append(np.pi * np.asarray(evaluate(load_npf(npf, line["material"]), wi, wo))[0] / diffuse)
    assert len(ratio) == 86
    np.testing.assert_allclose(np.median(ratio, 0), 1, atol=0.03)


def test_bad_tables_of_factors_are_refused(npf, tmp_path):
    with pytest.raises(ValueError, match=r"one of 100 names such as gold-metallic-paint.*, got 'gold-metalic-paint'"):
        load_npf(npf, "gold-metalic-paint")
    names = tmp_path / "names.txt"
    names.write_text("zinc iron")
    path = tmp_path / "table.bin"
    path.write_bytes(b"\0" * 100)
    with pytest.raises(ValueError, match=r"table.bin: must have 1572864 bytes, got 100"):
        load_npf(path, "iron", names=names)
    table = np.zeros((256, 512, 3), "<f4")
    table[1, 2, 1] = np.nan
    path.write_bytes(table.tobytes())
    with pytest.raises(ValueError, match=r"got 1 that are not, the first value of iron at column, color \(2, 1\): nan"):
        load_npf(path, "iron", names=names)
    assert not np.any(evaluate(load_npf(path, "zinc", names=names), *pairs(5)))
    table[1] = 1e20  # finite in float32, but not the product of the factors
    path.write_bytes(table.tobytes())
    with pytest.raises(ValueError, match=r"table.bin: every product must be at most 1e\+12 per sr, got 3 .*\(0,\): "):
        load_npf(path, "iron", names=names)
    names.write_text("iron zinc iron")
    with pytest.raises(ValueError, match=r"names.txt: materials must have different names, .* first 'iron'"):
        load_npf(path, "iron", names=names)
    names.write_text("iron " * 300)
    with pytest.raises(ValueError, match=r"names.txt: must hold at most 256 names, got 300"):
        load_npf(path, "iron", names=names)


def test_value_per_cosine_is_bounded_at_grazing_angles(npf):
    brdf = load_npf(npf, "white-marble")
    low = jnp.array([[1.0, 0, 1e-6], [1.0, 0, 1e-3], [1.0, 0, 8e-3]])
    found = evaluate(brdf, low, jnp.broadcast_to(jnp.array([-0.6, 0, 0.8]), low.shape))
    np.testing.assert_allclose(found, jnp.broadcast_to(found[2], found.shape), rtol=0.1)
