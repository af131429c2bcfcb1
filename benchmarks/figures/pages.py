"""Writes pictures and tables into the pages in docs/figures, from the lines of measured figures.

They stand between `<!-- lines: NAME -->` and `<!-- end -->`, where NAME is that of a figure.
"""

import json
import pathlib
import re
from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.relight_harmonic import PAPER
from benchmarks.tables import table as wang_table

_SHADED = "buddha"  # the row whose times without drawing are named
_PLACE = re.compile(r"(<!-- lines: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
Lines = Sequence[dict[str, Any]]


def write(docs: pathlib.Path) -> None:
    """Fills the tables of all pages."""
    for page in sorted(docs.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        page.write_text(filled(text, docs), encoding="utf-8")


def filled(text: str, docs: pathlib.Path) -> str:
    """A page with the tables of all figures that have lines; the others say that they have none."""

    def one(match: re.Match) -> str:
        name = match.group(2)
        path = docs / "lines" / f"{name}.jsonl"
        if path.is_file():
            shown = [f"![{text}](pictures/{file})" for file, text in PICTURES.get(name, {}).items()]
            table = TABLES[name]([json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()])
            body = "\n\n".join([*shown, table])
        else:
            body = "Not measured yet."
        return f"{match.group(1)}\n{body}\n\n{match.group(3)}"

    return _PLACE.sub(one, text)


def markdown(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)


def percent(value: float | None, digits: int = 1) -> str:
    """A share as percent; nothing where it was not measured."""
    return "" if value is None else f"{100 * value:.{digits}f} %"


def sun_5(lines: Lines) -> str:
    """Four blocks of 48 settings, and what the iteration improves at the finest."""
    parts = []
    for norm in dict.fromkeys(line["norm"] for line in lines):
        for kind in dict.fromkeys(line["lobes"] for line in lines):
            mine = [line for line in lines if (line["norm"], line["lobes"]) == (norm, kind)]
            mine = [line for line in mine if "resolution" not in line]
            grid = {(line["n_h"], line["n_w"]): line["squared_error"] for line in mine if "n_h" in line}
            terms = sorted({n for _, n in grid})
            rows = [[h, *(f"{grid[h, n]:.4g}" for n in terms)] for h in sorted({h for h, _ in grid})]
            swept = next(line for line in mine if "ranks" in line)
            ranks = tuple(swept["ranks"])
            parts += [
                f"Norm: {norm}; lobes: {kind}.",
                markdown(["n_h", *(f"n_w = {n}" for n in terms)], rows),
                f"Two sweeps of the iteration change the error at {ranks} to {swept['iterated_squared_error']:.4g}.",
            ]
    alone = [line for line in lines if "resolution" in line]
    rows = [[x["resolution"], x["texels"], f"{x['squared_error']:.4g}", percent(x["beyond_70_degrees"])] for x in alone]
    head = ["resolution", "texels inside", f"squared error by {alone[0]['terms']} terms", "squares of views beyond 70°"]
    parts += [
        "The sharpest material of the set alone, norm of the disk, by resolution of the maps.",
        markdown(head, rows),
    ]
    return "\n\n".join(parts)


def sun_6(lines: Lines) -> str:
    """A row for each material."""
    kinds = list(dict.fromkeys(line["lobes"] for line in lines))
    rows = []
    for name in dict.fromkeys(line["material"] for line in lines):
        mine = {line["lobes"]: line for line in lines if line["material"] == name}
        first = mine[kinds[0]]
        cells = [f"{percent(mine[k]['error'], 0)} ({percent(mine[k]['left'], 0)})" for k in kinds]
        rows.append([name, f"{first['m']:.3g}", f"{first['f0']:.3g}", *cells])
    return markdown(["material", "m", "F0", *kinds], rows)


def sun_7(lines: Lines) -> str:
    """One row of numbers."""
    line = lines[0]
    head = ["materials", "F0 from, to", "m from, to", "median F0, m", "with m below 0.02", "triangles"]
    spans = [f"{line[key][0]:.3g}, {line[key][1]:.3g}" for key in ("f0", "m")]
    middle = f"{line['median_f0']:.3g}, {line['median_m']:.3g}"
    return markdown(head, [[line["materials"], *spans, middle, line["below_m_0.02"], line["triangles"]]])


def sun_principal(lines: Lines) -> str:
    """A row for each set and norm."""
    rows = [
        [line["set"], line["norm"], *(f"{each:.3g}" for each in line["squared_error"]), f"{line['paper']:.3g}"]
        for line in lines
    ]
    count = max(len(line["squared_error"]) for line in lines)
    return markdown(["set", "norm", *map(str, range(1, count + 1)), "paper, 4 and a diffuse one"], rows)


def kautz_2(lines: Lines) -> str:
    """A row for each band."""
    rows = [
        [x["band"], percent(x["energy"]), percent(x["energy"] / (2 * x["band"] + 1)), percent(x["largest_step"])]
        for x in lines
    ]
    head = ["band", "share of all squares", "the same for each component", "largest step between texels"]
    return markdown(head, rows)


_NUMBERS = {"norm": 2, "mean": 3, "peak": 2, "inside": 2, "chest": 3, "away": 4, "brighter": 1} | dict.fromkeys(
    ("blue_over_red", "red_over_blue", "red_over_blue_exact"), 2
)  # digits of radiances and of their ratios


def chosen(*columns: str) -> Callable[[Lines], str]:
    """A table of some keys: names as they are, errors and other shares as percent."""

    def cell(key: str, value: Any) -> str:
        if value is None:
            return ""
        if key in ("sent", "changed") or "error" in key or key == "negative":
            return percent(value)
        if key in _NUMBERS:
            return f"{value:.{_NUMBERS[key]}f}"
        if key == "color":
            return ", ".join(f"{part:.2f}" for part in value)
        if key.endswith("seconds"):
            return f"{value:.1f} s"
        if key == "share":
            return percent(value, 2)
        return f"{value:,}" if isinstance(value, int) else f"{value}"

    def table(lines: Lines) -> str:
        heads = [key.replace("_", " ") for key in columns]
        return markdown(heads, [[cell(key, line.get(key)) for key in columns] for line in lines])

    return table


def kautz_table(lines: Lines) -> str:
    """Frames a second beside the paper's."""
    cases = ("general", "transfer", "fixed light", "fixed view")
    rows = []
    for name in dict.fromkeys(line["row"] for line in lines):
        own = [line for line in lines if line["row"] == name and "fixed view, transfer" not in line["case"]]
        mine = {line["case"].split(",")[0]: line for line in own}
        paper = PAPER.get(name)
        errors = [percent(mine[case].get("radiance_error")) for case in ("general", "transfer")]
        rows.append([name, f"{mine['general']['vertices']:,}", *(fps(mine[case]) for case in cases), *errors])
        if paper is not None:
            rows.append(["in the paper", f"{paper.vertices:,}", *(f"{each:g}" for each in paper.frames), "", ""])
    shading = {
        line["case"].split(",")[0]: line
        for line in lines
        if line["row"] == _SHADED and "fixed view, t" not in line["case"]
    }
    head = ["row", "vertices", "no transfer", "transfer", "fixed light", "fixed view"]
    table = markdown([*head, "error without transfer", "error with transfer"], rows)
    if len(shading) < len(cases):
        return table
    times = ", ".join(f"{1000 * shading[case]['seconds']:.2g}" for case in cases)
    return f"{table}\n\nWithout drawing, the four cases of {_SHADED} take {times} ms."


def fps(line: dict[str, Any]) -> str:
    """Frames a second of a case with drawing."""
    return f"{line['frames_per_second']:.0f}"


def wang_4(lines: Lines) -> str:
    """Errors of the terms of the pictures, for the five resolutions."""
    rows, counts = [], sorted({line["terms"] for line in lines})
    for brdf in dict.fromkeys(line["brdf"] for line in lines):
        for resolution in dict.fromkeys(line["resolution"] for line in lines):
            mine = [x for x in lines if (x["brdf"], x["resolution"]) == (brdf, resolution)]
            rows.append([brdf, resolution, *(f"{x['rms']:.3g} ({percent(x['relative'], 0)})" for x in mine)])
    return markdown(["BRDF", "resolution", *(f"{n} term{'s' * (n > 1)}" for n in counts)], rows)


TABLES: dict[str, Callable[[Lines], str]] = {
    "kautz2002_figure_1": chosen("panel", "vertices", "error", "negative"),
    "kautz2002_figure_2": kautz_2,
    "kautz2002_figure_3": chosen("light", "vertices", "error", "negative"),
    "kautz2002_figure_7": chosen("light", "brdf", "error", "negative"),
    "kautz2002_figure_8": chosen(
        "mesh", "light", "brdf", "error", "negative", "interpolated_seconds", "projected_seconds"
    ),
    "kautz2002_table_1": kautz_table,
    "wang2004_figure_1": chosen("mesh", "light", "error", "ground_error", "negative"),
    "wang2004_figure_3": chosen("keep", "share", "error", "penumbra_error"),
    "wang2004_figure_4": wang_4,
    "wang2004_figure_4_bunny": chosen("brdf", "light", "terms", "error"),
    "wang2004_varying": chosen("of_each", "terms", "bytes_of_a_vertex", "error"),
    "wang2004_table_2": lambda lines: wang_table([dict(line) for line in lines]).strip(),
    "sun2007_figure_1": chosen("f0", "m", "sent", "changed", "red_over_blue"),
    "sun2007_figure_4": chosen("material", "component", "share", "norm"),
    "sun2007_figure_5": sun_5,
    "sun2007_figure_6": sun_6,
    "sun2007_figure_7": sun_7,
    "sun2007_figure_8": chosen("light", "mean", "peak", "error"),
    "sun2007_figure_11": chosen("picture", "chest", "blue_over_red", "error", "error_whole"),
    "sun2007_figure_13": chosen(
        "part", "exponent", "changed", "red_over_blue", "red_over_blue_exact", "error", "error_whole"
    ),
    "sun2007_caustic": chosen("exponent", "inside", "peak", "error_inside", "error_wall", "error_whole"),
    "sun2007_figure_14": chosen("metal", "m", "sent", "color"),
    "sun2007_figure_15": chosen("picture", "away", "brighter", "error", "error_whole"),
    "sun2007_principal": sun_principal,
}

# What the pictures of each figure show, for readers who do not see them.
PICTURES: dict[str, dict[str, str]] = {
    "sun2007_figure_1": {
        "sun2007_figure_1.jpg": "A bust of four materials with balls of the same, and what it sends to the walls",
    },
    "sun2007_figure_4": {
        "sun2007_figure_4.jpg": "A material, what its lobes leave, and its lobes of 0, 7, 14 and 21 degrees",
    },
    "sun2007_figure_8": {
        "sun2007_figure_8.jpg": "One bounce off a ring with light of three resolutions, and by Mitsuba",
    },
    "sun2007_figure_11": {
        "sun2007_figure_11.jpg": "A bird on blue ground by Mitsuba, in direct light and with two bounces",
    },
    "sun2007_figure_13": {
        "sun2007_figure_13.jpg": "A base of three exponents, a dragon of three, and what it sends to the base",
    },
    "sun2007_caustic": {
        "sun2007_caustic.jpg": "A ring of three exponents with its caustic, and by Mitsuba",
    },
    "sun2007_figure_14": {
        "sun2007_figure_14.jpg": "A watch of steel, gold, copper with steel, and black steel",
    },
    "sun2007_figure_15": {
        "sun2007_figure_15.jpg": "Chess in direct light, with two bounces, and by Mitsuba",
    },
    "sun2007_figure_5": {
        "sun2007_figure_5.png": "Squared error against the rank, in both norms",
    },
    "sun2007_figure_6": {
        "sun2007_figure_6.jpg": "Exact, by the tensor alone, and with one to four lobes",
    },
    "sun2007_figure_7": {
        "sun2007_figure_7.png": "Measured points and triangles",
    },
    "kautz2002_figure_1": {
        "kautz2002_figure_1.jpg": "The teapot in a point light, glossy, brushed, brushed with shadows",
    },
    "kautz2002_figure_2": {
        "kautz2002_figure_2.jpg": "Coefficients over the view, and the squares of each band",
    },
    "kautz2002_figure_3": {
        "kautz2002_figure_3.jpg": "A brushed bust in four environments",
    },
    "kautz2002_figure_7": {
        "kautz2002_figure_7.jpg": "The Buddha with a Phong lobe, and brushed in two directions",
    },
    "kautz2002_figure_8": {
        "kautz2002_figure_8.jpg": "Two models and three measured paints on a bust, the teapot and the dragon",
    },
    "wang2004_figure_1": {
        "wang2004_figure_1.jpg": "The dragon in Uffizi and the bunny in Grace",
    },
    "wang2004_figure_3": {
        "wang2004_figure_3.jpg": "The shadow by 32 to 2048 coefficients, and by all",
    },
    "wang2004_figure_4": {
        "wang2004_figure_4_errors.png": "Error by number of terms, for five resolutions",
        "wang2004_figure_4_maps.jpg": "The first eight light maps of the four BRDFs",
    },
    "wang2004_varying": {
        "wang2004_varying.jpg": "A bunny in bands of a matte and two brushed materials: 1, 4 and 16 terms, and exact",
    },
    "wang2004_figure_4_bunny": {
        "wang2004_figure_4_bunny.jpg": "The bunny by four terms of four BRDFs",
    },
}
