"""Every figure that README and docs print outside of the measured pages, with the committed line that it came from.

    python -m benchmarks.figures.quoted [--keep]

Pages in docs/measured and docs/figures hold what was measured; other pages quote it. `docs/figures/quoted.jsonl` has
a line for each quoted figure: its page, the figure, and the section of a measured page that has it. Where the page
itself is the one place that prints it, the line has the command that measures it, or how it is computed. The program
prints these lines and names figures without one, sections that no longer have the figure, and lines of figures that are
gone. `--keep` adds lines for new figures; write their sources into the file before it is committed.
"""

import argparse
import collections
import json
import pathlib
import re
from collections.abc import Sequence
from typing import NamedTuple

ROOT = pathlib.Path(__file__).parents[2]
REGISTER = pathlib.Path("docs/figures/quoted.jsonl")
MEASURED = ("docs/measured", "docs/figures")
HERE = "here: "  # starts the source of a figure that no other page prints; one of these follows:
_COMMANDS = "python -m ", "make ", "pytest ", "prt."
_READ = "computed", "an option's ", "a constant ", "the printed ", "the length "
NOWHERE = "nowhere"  # the source of a new figure, to be replaced by hand

_NUMBER = r"(?<![\w.^])-?(?:\d{1,3}(?:,\d{3})+|\d+)?(?:\.\d+|(?<=\d))"
_UNIT = r"%|µs|ms|s\b|min\b|minutes|hours|kB|MB|GB|frames a second|processor seconds"
_RUN = re.compile(rf"(?:{_NUMBER}(?:,? and |, | to | / ))*{_NUMBER} (?:{_UNIT})")
_ONE = re.compile(_NUMBER)
_CODE = re.compile(r"^(`{3,}).*?^\1\s*$", re.MULTILINE | re.DOTALL)
_HEADING = re.compile(r"^#{1,6}\s+(.+?)\s*$", re.MULTILINE)


class Quoted(NamedTuple):
    """A figure on a page.

    Attributes:
        page: The page, relative to the repository.
        figure: The numbers and their unit, such as "11 to 14 s".
        place: Counts equal figures of the page, from 1.
    """

    page: str
    figure: str
    place: int

    @property
    def numbers(self) -> list[tuple[float, float]]:
        """Each number, and half of a unit in its last digit."""
        return _values(self.figure)

    @property
    def percent(self) -> bool:
        """Whether the numbers are percentages."""
        return self.figure.endswith("%")


def _values(text: str) -> list[tuple[float, float]]:
    plain = [number.replace(",", "") for number in _ONE.findall(text) if number.strip("-")]
    return [(float(number), 0.5 * 10.0 ** -len(number.partition(".")[2])) for number in plain]


def quotes(page: str, text: str) -> list[Quoted]:
    """The figures of a page, in their order; code has none.

    Args:
        page: Name of the page.
        text: The Markdown of the page.
    """
    plain = re.sub(r"`[^`\n]*`", "", _CODE.sub("", text))
    counts = collections.Counter[str]()
    result = []
    for match in _RUN.finditer(re.sub(r"\s+", " ", plain)):
        counts[match.group()] += 1
        result.append(Quoted(page, match.group(), counts[match.group()]))
    return result


def pages(root: pathlib.Path = ROOT) -> list[str]:
    """README and all pages that quote: those of docs that are not measured pages."""
    names = ["README.md", *(path.relative_to(root).as_posix() for path in sorted((root / "docs").rglob("*.md")))]
    return [name for name in names if not name.startswith((*MEASURED, "docs/notebooks"))]


def sections(root: pathlib.Path = ROOT) -> dict[str, str]:
    """The text of each section of the measured pages, by "page#anchor"."""
    result = {}
    for path in sorted(path for folder in MEASURED for path in (root / folder).glob("*.md")):
        plain = _CODE.sub("", path.read_text(encoding="utf-8"))
        headings = list(_HEADING.finditer(plain))
        ends = [heading.start() for heading in headings[1:]] + [len(plain)]
        for heading, end in zip(headings, ends, strict=True):
            anchor = re.sub(r"[^\w\- ]", "", heading.group(1).lower()).replace(" ", "-")
            result[f"{path.relative_to(root).as_posix()}#{anchor}"] = plain[heading.start() : end]
    return result


def says(section: str, quoted: Quoted) -> bool:
    """Whether a section has all numbers of a figure, as they stand or to be rounded; shares may stand for percent."""
    values = [value for value, _ in _values(section)]
    values += [100 * value for value in values if quoted.percent and abs(value) < 1]
    return all(any(abs(value - wanted) <= half * (1 + 1e-6) for value in values) for wanted, half in quoted.numbers)


def register(root: pathlib.Path = ROOT) -> dict[Quoted, str]:
    """The committed lines: where each figure is from."""
    lines = [json.loads(line) for line in (root / REGISTER).read_text(encoding="utf-8").splitlines()]
    return {Quoted(line["page"], line["figure"], line["place"]): line["from"] for line in lines}


def all_quotes(root: pathlib.Path = ROOT) -> list[Quoted]:
    """The figures of all pages."""
    return [quoted for page in pages(root) for quoted in quotes(page, (root / page).read_text(encoding="utf-8"))]


def faults(root: pathlib.Path = ROOT) -> list[str]:
    """Figures without a line, figures that their section does not have, and lines of figures that are gone."""
    lines, measured, quoted = register(root), sections(root), all_quotes(root)
    result = []
    for figure in quoted:
        source, name = lines.get(figure), f"{figure.page}: {figure.figure!r} ({figure.place})"
        if source is None:
            result.append(f"{name} has no line in {REGISTER}")
        elif source.startswith(HERE):
            if not source.removeprefix(HERE).startswith(_COMMANDS + _READ):
                result.append(f"{name} has no command: {source!r}")
        elif source not in measured:
            result.append(f"{name} is of {source}, which is not there")
        elif not says(measured[source], figure):
            result.append(f"{name} differs from {source}")
    gone = lines.keys() - set(quoted)
    return result + [f"{figure.page} no longer has {figure.figure!r} ({figure.place})" for figure in sorted(gone)]


def main(options: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--keep", action="store_true", help="add lines for new figures, and remove those of gone ones")
    if parser.parse_args(options).keep:
        lines = register()
        rows = [{**figure._asdict(), "from": lines.get(figure, NOWHERE)} for figure in all_quotes()]
        text = "".join(json.dumps(row, ensure_ascii=False) + "\n" for row in rows)
        (ROOT / REGISTER).write_text(text, encoding="utf-8")
    for figure, source in register().items():
        print(f"{figure.page}: {figure.figure} <- {source}")
    for fault in faults():
        print(fault)


if __name__ == "__main__":
    main()
