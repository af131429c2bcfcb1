"""The scenes of Sun et al. 2007: each region has a material, stopped runs count, points keep their places."""

import numpy as np
import pytest

from benchmarks import paper_figures, paper_scenes, path_tracing
from jaxprt import bounces, image
from jaxprt.relit import paths
from jaxprt.sphere import cubemap
from jaxprt.systems import standard


@pytest.mark.parametrize("name", paper_scenes.RECIPES)
def test_every_region_is_free_or_has_an_albedo(name):
    recipe = paper_scenes.RECIPES[name]
    regions = np.unique(np.asarray(recipe.mesh(True).region)).tolist()
    assert sorted([*recipe.free, *recipe.fixed]) == regions
    if recipe.published is not None:
        assert len(recipe.free) >= recipe.published.adjustable


def test_seconds_of_runs_add_up_until_all_is_there(tmp_path):
    path = tmp_path / "scene" / "seconds.json"
    try:
        raise SystemExit(143)  # What main makes of a signal.
    except SystemExit:
        paper_scenes._spent(path, 5.0)
    done, peak = paper_scenes._spent(path, 2.0)
    assert (done, peak > 0) == (7.0, True)
    assert paper_scenes._spent(path, 100.0) == (done, peak)


def test_the_background_does_not_count_in_what_a_picture_is_off():
    exact = np.zeros((4, 4, 4))
    exact[1:3] = [0.5, 0.5, 0.5, 1]
    exact[0] = [0.1, 0.1, 0.1, 0.5]  # an edge
    mine = exact.copy()
    mine[:2, :2, :3] = 0.6
    expected = np.sqrt(2 * 0.01 / (8 * 0.25))
    assert paper_figures.off(mine, exact) == pytest.approx(expected)


def test_sharp_light_paths_send_the_albedo_of_each_channel_at_each_exponent(monkeypatch):
    monkeypatch.setattr(paper_scenes, "_FINE", 12)
    path = paper_scenes.sharp_path(8)
    assert path.sent is not None
    sent = np.asarray(path.sent.factor) @ np.asarray(bounces.functions.albedo(path.brdf))
    (knot,) = path.sent.knot
    exact = [paths.channels(standard.BLINN_PHONG.family(place)) for place in knot]
    np.testing.assert_allclose(sent, exact, rtol=1e-3)
    assert np.all(np.diff(knot) > 0)


def test_noise_of_the_exact_picture_is_no_error():
    rng = np.random.default_rng(0)
    truth, one, other = np.full((200, 200, 4), 0.5), *rng.normal(0.5, 0.2, (2, 200, 200, 4))
    mine = truth + [0.05, 0.05, 0.05, 0]
    for picture in (truth, one, other, mine):
        picture[..., 3] = 1
    exact = path_tracing.Exact(one, other)
    assert exact.off(mine) == pytest.approx(0.1, abs=0.01)
    assert exact.off(truth) < 0.02
    assert paper_figures.off(truth, one) > 0.3
    half = np.arange(200)[None] + np.zeros((200, 1)) < 100
    mine[:, 100:, :3] += 0.2
    assert exact.off(mine, half) == pytest.approx(0.1, abs=0.01)


def test_a_white_surface_that_faces_the_lamp_has_a_radiance_of_one_more_than_the_dim_light():
    direction, size = np.array([0.3, 0.8, -0.5]), 64
    light = paper_figures.soft_box(direction, 14, 0.2, size=size)
    cosine = np.asarray(cubemap.direction(size=size)) @ (direction / np.linalg.norm(direction))
    weight = np.maximum(cosine, 0) * np.asarray(cubemap.solid_angle(size=size))
    irradiance = np.sum(weight[..., None] * np.asarray(light.radiance), (0, 1, 2))
    np.testing.assert_allclose(irradiance / np.pi, 1.2, rtol=0.01)


def test_pictures_fade_into_white_at_edges_also_where_they_are_brighter_than_the_screen():
    bright = np.array([8.0, 8.0, 8.0, 1.0])
    picture = np.stack([bright, bright / 2, bright * 0])[None]
    (found,) = paper_figures.exposed({"bright": picture}, brighter=2.0).values()
    np.testing.assert_allclose(found, 1, atol=1e-6)
    dark = np.array([1e-9, 1e-9, 1e-9, 1.0])
    shown = paper_figures.exposed({"dark": np.stack([dark, dark / 2, dark * 0])[None], "bright": picture})["dark"]
    np.testing.assert_allclose(shown[0, :, 0], image.display(np.array([0.0, 0.5, 1.0])), atol=1e-5)


def test_the_table_has_the_last_line_of_each_case_beside_the_papers_figures():
    size = {"vertices": 13072, "regions": 2, "adjustable": 2, "bytes": 60e6, "direct_bytes": 40e6, "peak_bytes": 4e9}
    off = {"frame_error": 0.12, "picture_error": 0.034, "direct_error": 0.5}
    lines = [{**size, "case": "bird, precompute", "seconds": seconds, **off} for seconds in (1.0, 300.0)]
    lines += [{**size, "case": f"bird, frame, new {kind}", "fps": 10.0} for kind in paper_scenes.KINDS]
    _, _, *rows = paper_scenes.table([*lines, {**size, "case": "chess, precompute", "seconds": 1.0}]).splitlines()
    cells = [each.strip() for each in rows[0].split("|")]
    assert len(rows) == 1
    assert cells[2:7] == ["13,072 (13,000)", "2, 2 (2 free)", "5.0 (396)", "100 (148)", "4.0"]
    assert cells[7:10] == ["10.0 (121.58)", "10.0 (28.73)", "10.0 (5.82)"]
    assert cells[10:13] == ["12.0 %", "3.4 %", "50.0 %"]
