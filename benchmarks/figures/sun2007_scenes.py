"""Sun et al. 2007: the figures with reflected light, 1, 8, 11 and 13 to 15, from `benchmarks.paper_figures`."""

import pathlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from benchmarks import paper_figures, path_tracing
from benchmarks.figures import drawing
from benchmarks.figures.run import Run
from benchmarks.paper_figures import Figures

COLUMNS = {"1": 4, "8": 4, "11": 3, "13": 3, "ring": 3, "14": 4, "15": 3}  # of pictures in a row


def draw(number: str, name: str, run: Run) -> Iterator[dict[str, Any]]:
    """Draws one of `COLUMNS` and gives its lines; with Mitsuba's pictures where Mitsuba can run."""
    store = None if run.quick else run.store / "scenes"
    figures = Figures(quick=run.quick, store=store, compare=path_tracing.available())
    yield from write(figures, number, run.picture(f"{name}.jpg"))


def write(figures: Figures, number: str, path: pathlib.Path) -> list[dict[str, Any]]:
    """Writes the picture of a figure, and returns its lines."""
    sheet = paper_figures.FIGURES[number](figures)
    captions, pictures = zip(*paper_figures.exposed(sheet.pictures, like=sheet.like).items(), strict=True)
    starts = range(0, len(pictures), COLUMNS[number])
    rows, names = ([row[n : n + COLUMNS[number]] for n in starts] for row in (pictures, captions))
    drawing.sheet(path, rows, names)
    return sheet.lines


def figure(number: str, name: str) -> Callable[[Run], Iterator[dict[str, Any]]]:
    """A figure as `benchmarks.figures` calls it."""
    return partial(draw, number, name)


NAMES = {number: f"sun2007_figure_{number}" for number in COLUMNS if number != "ring"} | {"ring": "sun2007_caustic"}
FIGURES = {name: figure(number, name) for number, name in NAMES.items()}
