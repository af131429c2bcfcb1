"""The scenes of Sun et al. 2007: each region has a material, stopped runs count, points keep their places."""

import numpy as np
import pytest

from benchmarks import paper_figures, paper_scenes
from jaxprt import image


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


def test_pictures_fade_into_white_at_edges_also_where_they_are_brighter_than_the_screen():
    bright = np.array([8.0, 8.0, 8.0, 1.0])
    picture = np.stack([bright, bright / 2, bright * 0])[None]
    (found,) = paper_figures.exposed({"bright": picture}, brighter=2.0).values()
    np.testing.assert_allclose(found, 1, atol=1e-6)
    dark = np.array([1e-9, 1e-9, 1e-9, 1.0])
    shown = paper_figures.exposed({"dark": np.stack([dark, dark / 2, dark * 0])[None], "bright": picture})["dark"]
    np.testing.assert_allclose(shown[0, :, 0], image.display(np.array([0.0, 0.5, 1.0])), atol=1e-5)


def test_the_table_has_the_last_line_of_each_case_beside_the_papers_figures():
    size = {"vertices": 13072, "regions": 2, "adjustable": 2, "bytes": 100e6, "peak_bytes": 4e9}
    lines = [{**size, "case": "bird, precompute", "seconds": seconds} for seconds in (1.0, 300.0)]
    lines += [{**size, "case": f"bird, frame, new {kind}", "fps": 10.0} for kind in paper_scenes.KINDS]
    _, _, *rows = paper_scenes.table([*lines, {**size, "case": "chess, precompute", "seconds": 1.0}]).splitlines()
    cells = [each.strip() for each in rows[0].split("|")]
    assert len(rows) == 1
    assert cells[2:7] == ["13,072 (13,000)", "2, 2 (2 free)", "5.0 (396)", "100 (148)", "4.0"]
    assert cells[7:10] == ["10.0 (121.58)", "10.0 (28.73)", "10.0 (5.82)"]
