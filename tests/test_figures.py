"""Figures of the papers run to their end on small cases, and their pages hold what was measured."""

import json
import pathlib

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from benchmarks import accuracy, relight_harmonic
from benchmarks.figures import __main__ as program
from benchmarks.figures import drawing, pages, quoted, sun2007
from jaxprt.scene import builtin

pytestmark = pytest.mark.documents

DOCS = pathlib.Path(__file__).parents[1] / "docs" / "figures"


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda path: path.stem)
def test_tables_of_pages_are_those_of_the_measured_lines(page):
    text = page.read_text(encoding="utf-8")
    assert pages.filled(text, DOCS) == text


def test_tables_of_errors_are_those_of_the_measured_lines():
    measured = DOCS.parent / "measured"
    lines = [json.loads(line) for line in (measured / "accuracy.jsonl").read_text(encoding="utf-8").splitlines()]
    assert accuracy.tables(lines) in (measured / "accuracy.md").read_text(encoding="utf-8")


def test_pictures_are_small_enough_and_named_by_a_page():
    text = "".join(path.read_text(encoding="utf-8") for path in DOCS.glob("*.md"))
    for picture in (DOCS / "pictures").iterdir():
        assert picture.stat().st_size < 300_000
        assert f"pictures/{picture.name}" in text


def test_every_figure_that_a_page_quotes_has_a_line_and_is_that_of_its_section():
    assert not quoted.faults()


def test_figures_without_a_line_other_figures_and_lines_of_gone_figures_are_told(tmp_path):
    for folder in quoted.MEASURED:
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "docs/measured/times.md").write_text("# Times\n\n| light | 0.0622 |\n\n## Sums\n\n1,204 ms, .5 s\n")
    (tmp_path / "README.md").write_text(
        "It is 6.2 % off, takes 1,204 ms and\nthen .45 to\n.5 s, `9 s`, 4 MB.\n\n```text\n7 s\n```\n"
    )
    assert [tuple(figure)[1:] for figure in quoted.all_quotes(tmp_path)] == [
        *(("6.2 %", 1), ("1,204 ms", 1), (".45 to .5 s", 1), ("4 MB", 1))
    ]
    sources = {"6.2 %": "#times", "1,204 ms": "#times", ".45 to .5 s": "#sums", "3 s": "#sums"}
    rows = [{"figure": figure, "from": f"docs/measured/times.md{anchor}"} for figure, anchor in sources.items()]
    text = "".join(json.dumps({"page": "README.md", "place": 1, **row}) + "\n" for row in rows)
    (tmp_path / quoted.REGISTER).write_text(text)
    for source in ("from memory", "python -m benchmarks.x"):
        row = {"page": "README.md", "figure": "4 MB", "place": 1, "from": f"here: {source}"}
        (tmp_path / quoted.REGISTER).write_text(text + json.dumps(row) + "\n")
        assert any("4 MB" in fault for fault in quoted.faults(tmp_path)) == (source == "from memory")
    (tmp_path / quoted.REGISTER).write_text(text)
    faults = quoted.faults(tmp_path)
    assert [fault.partition(" (")[0] for fault in faults] == [
        *("README.md: '1,204 ms'", "README.md: '.45 to .5 s'", "README.md: '4 MB'", "README.md no longer has '3 s'")
    ]
    assert "differs from" in faults[0]
    assert "has no line" in faults[2]


def test_every_figure_has_a_table():
    assert set(program.FIGURES) == set(pages.TABLES)


def test_a_figure_writes_its_lines_its_picture_and_its_table(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("<!-- lines: sun2007_figure_7 -->\n<!-- end -->\n")
    program.main(["sun2007_figure_7", "--quick", "--docs", str(tmp_path), "--store", str(tmp_path / "store")])
    (line,) = [json.loads(each) for each in (tmp_path / "lines" / "sun2007_figure_7.jsonl").read_text().splitlines()]
    assert line["materials"] == 6
    assert line["m"] == pytest.approx([0.1, 0.5])
    with Image.open(tmp_path / "pictures" / "sun2007_figure_7.png") as picture:
        assert min(picture.size) >= 384
    assert "| 6 | 0.05, 1 | 0.1, 0.5 |" in page.read_text()


def test_unknown_figures_are_refused(capsys):
    with pytest.raises(SystemExit):
        program.main(["figure_99"])
    assert "got figure_99" in capsys.readouterr().err


@pytest.mark.parametrize("vertices", [200, 777])
def test_a_mesh_is_divided_to_a_number_of_vertices(vertices):
    ball = builtin.sphere(rings=8, sectors=16)
    made = relight_harmonic.divided(ball, vertices)
    assert len(made.position) == max(vertices, len(ball.position))
    np.testing.assert_array_equal(made.position[: len(ball.position)], ball.position)


def test_all_settings_come_from_one_core_and_full_ranks_leave_nothing():
    tensor = jnp.asarray(np.random.default_rng(0).normal(size=(4, 5, 5)), jnp.float32)
    whole = sun2007.squared_norm(tensor)
    left = sun2007.settings(tensor, whole, (1, 4), (2, 5))
    # The first mode alone cut: what its smaller singular values hold.
    value = np.linalg.svd(np.asarray(tensor).reshape(4, -1), compute_uv=False)
    assert left[4, 5] == pytest.approx(0, abs=1e-5)
    assert left[1, 5] == pytest.approx(np.sum(value[1:] ** 2) / whole, rel=1e-4)
    assert left[1, 2] > left[1, 5]


def test_a_sheet_has_its_pictures_side_by_side_under_their_captions(tmp_path):
    red, blue = (np.broadcast_to(np.array(each, float), (40, 50, 3)) for each in ([1, 0, 0], [0, 0, 1]))
    drawing.sheet(tmp_path / "sheet.jpg", [[red, blue]], [["one", "two\nlines"]], gap=6)
    with Image.open(tmp_path / "sheet.jpg") as picture:
        assert picture.size == (112, 40 + 2 * 22 + 6)
        row = np.asarray(picture)[64]
    np.testing.assert_allclose(row[[25, 81]], [[254, 0, 0], [0, 0, 254]], atol=4)


@pytest.mark.long
@pytest.mark.parametrize("name", program.FIGURES)
def test_the_small_case_of_every_figure_runs_to_its_end(name, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"<!-- lines: {name} -->\n<!-- end -->\n")
    program.main([name, "--quick", "--docs", str(tmp_path), "--store", str(tmp_path / "store")])
    for file in pages.PICTURES.get(name, {}):
        assert (tmp_path / "pictures" / file).stat().st_size < 300_000
        assert f"pictures/{file}" in page.read_text()
